"""The volume itself on its page, under looks that it was not made with, against `vvgt render` of the same camera."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import first_of_orbit, page_picture

from vvgt_cli.commands.main import run
from vvgt_cli.images import read_png
from vvgt_cli.images.metrics import psnr

SIZE = 100
MADE = ["--steps", "0", "--max-gaussians", "500", "--screen", "64", "--quiet"]
DISTANCE = 0.1
SHELL = {
    "points": [
        {"x": 0.3, "rgb": [0.1, 0.4, 1], "opacity": 0}, {"x": 0.6, "rgb": [1, 0.9, 0.5], "opacity": 0.9},
        {"x": 1, "rgb": [1, 0.2, 0.1], "opacity": 0.9},
    ],
    "opacity_unit_distance": DISTANCE,
}  # fmt: skip
NODES = json.dumps([{"x": p["x"], "y": p["opacity"], "rgb": p["rgb"]} for p in SHELL["points"]])
EDIT = f"const layer = vvgt.live.look.layers[0]; layer.unit_distance *= {DISTANCE} / layer.opacity_unit_distance; layer.opacity_unit_distance = {DISTANCE}; vvgt.live.set({NODES});"  # noqa: E501
LAMP = "vvgt.live.lamp.set({{...vvgt.live.lamp.state(), kind: '{}', ambient: 0.1, diffuse: 0.7, specular: 0.2, power: 10}});"  # noqa: E501
LOOKS: dict[str, tuple[str, list[str], float]] = {  # what is done on the page, options of the command, least dB
    "unlit": (EDIT + LAMP.format("none"), [], 48),
    "lit": (EDIT + LAMP.format("headlight"), ["--light", "headlight"], 44),
    "MIP": (EDIT + "vvgt.live.look.draw(1);", ["--rule", "mip"], 40),
    "X-ray": (EDIT + "vvgt.live.look.draw(2);", ["--rule", "xray"], 48),
}
CUT = "vvgt.live.cut.change({ kind: 'plane', normal: vvgt.live.cut.axes[0], at: 0.5 });"
pytestmark = pytest.mark.long


def pictured(page: Path, folder: Path, before: str) -> np.ndarray:
    """Picture (SIZE, SIZE, 3) of the volume on a page, after JavaScript."""
    picture, noted = page_picture(
        page.as_uri(), folder, SIZE, camera=first_of_orbit(), before=f"{{ {before} vvgt.live.look.show(true); }}"
    )
    assert noted["errors"] == []
    return picture


def rendered(folder: Path, *source: str) -> np.ndarray:
    out = folder / "ours.png"
    assert (
        run(["render", *source, "--size", str(SIZE), "--background", "0,0,0", "--quiet", "-o", str(out), "--overwrite"])
        == 0
    )
    return read_png(out)[..., :3]


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("field")
    (folder / "tf.json").write_text(json.dumps(SHELL))
    made = ["convert", "example:marschner-lobb:24", "--tf", "viridis", *MADE, "-o", str(folder / "a.html")]
    assert run(made) == 0
    return folder


@pytest.mark.parametrize("name", LOOKS)
def test_other_looks_are_those_of_the_command(field: Path, tmp_path: Path, name: str) -> None:
    script, options, least = LOOKS[name]
    grey = options[:1] == ["--rule"]
    source = ["example:marschner-lobb:24", "--tf", str(field / "tf.json"), *options]
    out = tmp_path / "ours.png"
    background = [] if grey else ["--background", "0,0,0"]
    assert run(["render", *source, *background, "--size", str(SIZE), "--quiet", "-o", str(out)]) == 0
    found = psnr(read_png(out)[..., :3], pictured(field / "a.html", tmp_path, script))
    print(f"{name}: {found:.2f} dB")
    assert found > least


def test_a_cut_is_a_volume_that_ends_there(tmp_path: Path) -> None:
    """Half of a volume, in the place of the whole."""
    data = np.zeros((20, 20, 20), np.float32)
    data[4:16, 4:16, 4:16] = 0.8
    for name, values in (("whole", data), ("half", np.where(np.arange(20) < 10, data, 0).astype(np.float32))):
        np.save(tmp_path / f"{name}.npy", values)
    page = tmp_path / "cut.html"
    assert run(["convert", str(tmp_path / "whole.npy"), "--tf", "viridis", *MADE, "-o", str(page)]) == 0
    white = [{"x": x, "rgb": [1, 1, 1], "opacity": y} for x, y in ((0, 0), (0.4, 0), (0.4, 0.2), (1, 0.2))]
    (tmp_path / "white.json").write_text(json.dumps({"points": white, "opacity_unit_distance": DISTANCE}))
    source = ("--tf", str(tmp_path / "white.json"))
    half, whole = (rendered(tmp_path, str(tmp_path / f"{name}.npy"), *source) for name in ("half", "whole"))
    nodes = json.dumps([{"x": p["x"], "y": p["opacity"], "rgb": p["rgb"]} for p in white])
    seen = pictured(page, tmp_path, EDIT + f"vvgt.live.set({nodes});" + LAMP.format("none") + CUT)
    print(f"cut: {psnr(half, seen):.2f} dB, whole {psnr(whole, seen):.2f} dB")
    assert psnr(half, seen) > max(24, psnr(whole, seen) + 10)  # whose last voxel is half there


def test_labels_are_hidden_and_coloured(tmp_path: Path) -> None:
    z, y, x = np.mgrid[:24, :20, :16]
    one = (x - 5) ** 2 + (y - 6) ** 2 + (z - 7) ** 2 < 20
    data = one + 2 * ((x - 9) ** 2 + (y - 13) ** 2 + (z - 16) ** 2 < 25)
    np.save(tmp_path / "map.npy", data.astype(np.uint8))
    entries: dict[str, dict[str, Any]] = {
        "1": {"name": "one", "color": [1, 0.2, 0.1], "opacity": 0.9},
        "2": {"name": "two", "color": [0.2, 0.9, 0.3], "opacity": 0.5},
    }
    (tmp_path / "all.json").write_text(json.dumps(entries))
    entries["2"]["opacity"] = 0.0
    (tmp_path / "one.json").write_text(json.dumps(entries))
    source, page = [str(tmp_path / "map.npy"), "--light", "none", "--labels"], tmp_path / "map.html"
    assert run(["convert", *source, str(tmp_path / "all.json"), *MADE, "-o", str(page)]) == 0
    one, both = (rendered(tmp_path, *source, str(tmp_path / f"{name}.json")) for name in ("one", "all"))
    hide = "document.querySelectorAll('#live .organs .eye')[1].click();"
    seen = pictured(page, tmp_path, hide)
    print(f"a label hidden: {psnr(one, seen):.2f} dB, both {psnr(both, seen):.2f} dB")
    assert psnr(one, seen) > max(42, psnr(both, seen) + 10)


def test_without_3d_textures_the_conversion_is_shown(field: Path, tmp_path: Path) -> None:
    page = tmp_path / "none.html"
    broken = "<script>HTMLCanvasElement.prototype.getContext = new Proxy(HTMLCanvasElement.prototype.getContext, { apply: (f, self, all) => (self.id === 'volume' ? null : Reflect.apply(f, self, all)) })</script><main"  # noqa: E501
    page.write_text((field / "a.html").read_text("utf-8").replace("<main", broken, 1), "utf-8")
    wait = "await new Promise((done) => { setTimeout(done, 3000); });"
    job = f"(async () => {{ {EDIT} {wait} document.title = document.querySelector('#live p').textContent; if (!document.title.startsWith('This browser cannot show the volume itself')) throw new Error(document.title); }})()"  # noqa: E501
    picture, _ = page_picture(page.as_uri(), tmp_path, SIZE, before=job)
    assert picture.max() > 0.2
