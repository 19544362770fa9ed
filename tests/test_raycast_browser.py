"""The volume itself on its page, under looks that it was not made with, against `vvgt render` of the same camera."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
import pytest
from browser import first_of_orbit, page_picture

from tests.test_page_where import Person
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
    """Half of a volume, in the place of the whole: of its voxels, of which the last fades, and of finer ones."""
    data = np.zeros((20, 20, 20), np.float32)
    data[4:16, 4:16, 4:16] = 0.8
    for name, values in (("whole", data), ("half", np.where(np.arange(20) < 10, data, 0).astype(np.float32))):
        np.save(tmp_path / f"{name}.npy", values)
    page = tmp_path / "cut.html"
    assert run(["convert", str(tmp_path / "whole.npy"), "--tf", "viridis", *MADE, "-o", str(page)]) == 0
    white = [{"x": x, "rgb": [1, 1, 1], "opacity": y} for x, y in ((0, 0), (0.4, 0), (0.4, 0.2), (1, 0.2))]
    (tmp_path / "white.json").write_text(json.dumps({"points": white, "opacity_unit_distance": DISTANCE}))
    source = ("--tf", str(tmp_path / "white.json"))
    x = np.arange(5 * 20)  # five for each voxel, from which the same values are interpolated
    finer = np.apply_along_axis(lambda row: np.interp((x - 2) / 5, np.arange(20), row), 2, data)
    np.save(tmp_path / "finer.npy", np.where(x < 50, finer, 0).astype(np.float32))
    exact = rendered(tmp_path, str(tmp_path / "finer.npy"), "--spacing", "0.2", "1", "1", *source)
    half, whole = (rendered(tmp_path, str(tmp_path / f"{name}.npy"), *source) for name in ("half", "whole"))
    nodes = json.dumps([{"x": p["x"], "y": p["opacity"], "rgb": p["rgb"]} for p in white])
    seen = pictured(page, tmp_path, EDIT + f"vvgt.live.set({nodes});" + LAMP.format("none") + CUT)
    print(f"cut: {psnr(half, seen):.2f} dB, whole {psnr(whole, seen):.2f} dB, exact {psnr(exact, seen):.2f} dB")
    assert psnr(exact, seen) > psnr(half, seen) + 6
    assert psnr(half, seen) > max(24, psnr(whole, seen) + 10)  # whose last voxel is half there


@pytest.mark.parametrize("light", ["none", "headlight"])
def test_labels_are_hidden_and_coloured(tmp_path: Path, light: str) -> None:
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
    source, page = [str(tmp_path / "map.npy"), "--light", light, "--labels"], tmp_path / "map.html"
    assert run(["convert", *source, str(tmp_path / "all.json"), *MADE, "-o", str(page)]) == 0
    one, both = (rendered(tmp_path, *source, str(tmp_path / f"{name}.json")) for name in ("one", "all"))
    hide = "document.querySelectorAll('#live .organs .eye')[1].click();"
    seen = pictured(page, tmp_path, hide)
    print(f"a label hidden: {psnr(one, seen):.2f} dB, both {psnr(both, seen):.2f} dB")
    assert psnr(one, seen) > max(57, psnr(both, seen) + 10)


@pytest.mark.parametrize(("light", "coarser"), [("none", 1), ("headlight", 1), ("none", 4)])
def test_a_layer_that_goes_on_beyond_the_first_volume(tmp_path: Path, light: str, coarser: int) -> None:
    z, y, x = np.mgrid[:24, :24, :24]
    waves = (np.sin(0.7 * x) * np.cos(0.6 * y) + z / 24).astype(np.float32)
    (tmp_path / "tf.json").write_text(json.dumps(SHELL))
    path, page, first = tmp_path / "waves.nii", tmp_path / "layers.html", tmp_path / "first.nii"
    nib.save(nib.Nifti1Image(waves.T, np.eye(4)), path)
    part = waves[4:, :, 4:20].T[::coarser, ::coarser, ::coarser]
    shift = (coarser - 1) / 2
    place = np.diag([coarser, coarser, coarser, 1.0])
    place[:3, 3] = 4 + shift, shift, 4 + shift
    nib.save(nib.Nifti1Image(part, place), first)
    source = [str(first), "--tf", "viridis", "--light", light, "--layer", f"{path},tf={tmp_path / 'tf.json'}"]
    assert run(["convert", *source, *MADE, "-o", str(page)]) == 0
    found = psnr(rendered(tmp_path, *source), pictured(page, tmp_path, ""))
    print(f"{light}, {coarser}: {found:.2f} dB")
    assert found > 40


BALLS = ((12, 16, 16, 6), (34, 16, 16, 6))  # x, y, z of the middle and radius, voxels


@pytest.fixture(scope="module")
def someone() -> Iterator[Person]:
    found = Person((260, 260))
    yield found
    found.process.communicate(timeout=60)


@pytest.fixture(scope="module")
def balls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Page of two balls of values to 1, seen along y."""
    folder = tmp_path_factory.mktemp("balls")
    z, y, x = np.mgrid[:32, :32, :46]
    away = [np.sqrt((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) - r for a, b, c, r in BALLS]
    np.save(folder / "balls.npy", np.clip(0.5 - np.minimum(*away) / 4, 0, 1).astype(np.float32))
    assert run(["convert", str(folder / "balls.npy"), "--tf", "viridis", *MADE, "-o", str(folder / "balls.html")]) == 0
    return folder / "balls.html"


STEEP = json.dumps([{"x": x, "y": y, "rgb": [1, 0.8, 0.6]} for x, y in ((0, 0), (0.45, 0), (0.55, 0.95), (1, 0.95))])
FOG = json.dumps([{"x": x, "y": y, "rgb": [1, 0.8, 0.6]} for x, y in ((0, 0), (0.2, 0), (1, 0.02))])
SHOWN = "vvgt.live.look.shows"
VOLUME = """(async () => {
  const picture = await vvgt.live.look.picture([120, 120], 1);
  const { data } = picture.getContext('2d').getImageData(0, 0, 120, 120), seen = [0, 0];
  for (let k = 0; k < 14400; k++) seen[k % 120 >= 60 ? 1 : 0] += data[4 * k] > 20 ? 1 : 0;
  return seen;
})()"""  # pixels of the left and right half that show something


FRONT = """(async () => {
  const { lens } = vvgt.where;
  lens.set({ target: [0, 0, 0], distance: 3, ...lens.toward([0, 0, -1], [0, 1, 0]) });
  lens.middle = [130, 130];
  for (let k = 0; k < 3; k++) await new Promise((done) => vvgt.viewer.app.once('frameend', done));
})()"""
DONE = "!document.querySelector('#live .whole + span').textContent"


def begin(person: Person, page: Path) -> None:
    """Open a page, seen from the front, under a steep function."""
    person("open", page.as_uri())
    person("eval", f"vvgt.live.set({STEEP})")
    person("until", SHOWN)
    person("eval", FRONT)


def do(person: Person, selector: str) -> None:
    """Click something in the panel, which is folded in a small window."""
    person("eval", f"document.querySelector('#live {selector}').click()")


def test_a_piece_is_kept(someone: Person, balls: Path) -> None:
    begin(someone, balls)
    left, right = someone("eval", VOLUME)
    assert min(left, right) > 100
    someone("press", "Escape")
    do(someone, ".keep")
    someone("click", *someone("eval", "vvgt.where.lens.project(vvgt.where.world.at([12, 16, 16]))"))
    someone(
        "until",
        "!document.querySelector('#live .whole').hidden && !document.querySelector('#live .whole + span').textContent",
    )
    kept = someone("eval", VOLUME)
    print(f"pixels left and right: {left}, {right}; kept: {kept}")
    assert kept[0] == pytest.approx(left, rel=0.02)
    assert kept[1] == 0
    assert "piece=" in someone("eval", "vvgt.where.link()")
    do(someone, ".whole")
    assert someone("eval", VOLUME) == [left, right]
    someone("press", "Control+z")
    someone("until", DONE)
    assert someone("eval", VOLUME) == kept


def test_other_functions_with_surfaces_are_lit(someone: Person, balls: Path) -> None:
    someone("open", balls.as_uri())
    kind = "vvgt.live.lamp.state().kind"
    for nodes, expected in ((FOG, "none"), (STEEP, "headlight")):
        someone("eval", f"vvgt.live.set({nodes})")
        someone("until", f"vvgt.live.look.nodes[0].length === {len(json.loads(nodes))}")
        assert someone("eval", kind) == expected
    someone("press", "Control+z")
    assert someone("eval", kind) == "none"
    choose = "(list) => { list.value = 'none'; list.dispatchEvent(new Event('change')); }"
    someone("eval", f"({choose})(document.querySelector('#live .light select'))")
    someone("eval", f"vvgt.live.set({STEEP})")
    someone("until", "vvgt.live.look.nodes[0].length === 4")
    assert someone("eval", kind) == "none"  # as was chosen


def test_window_and_level(someone: Person, balls: Path) -> None:
    someone("open", balls.as_uri())
    assert someone("eval", "document.querySelector('#live .greys').hidden")
    someone("press", "k")
    do(someone, ".fold")
    white = VOLUME.replace("> 20", "> 250")
    before = someone("eval", white)
    someone("eval", "document.querySelector('#live .greys input').focus()")
    for _ in range(3):
        someone("press", "PageDown")
    someone("press", "Tab")
    for _ in range(2):
        someone("press", "PageDown")
    ends, after = someone("eval", "vvgt.live.grey.ends()"), someone("eval", white)
    print(f"black and white at {ends}; white pixels {before}, {after}")
    assert ends == pytest.approx([0.3 - 0.35, 0.3 + 0.35], abs=0.011)
    assert sum(after) > 1.1 * sum(before)
    assert "window=" in someone("eval", "vvgt.where.link()")
    someone("press", "Control+z")
    assert someone("eval", "vvgt.live.grey.ends()") != pytest.approx(ends, abs=1e-3)


LOSE = "(window.lose = vvgt.live.look.canvas.getContext('webgl2').getExtension('WEBGL_lose_context')).loseContext()"


def test_lost_graphics_come_back(someone: Person, balls: Path) -> None:
    begin(someone, balls)
    before = someone("eval", VOLUME)
    someone("eval", LOSE)
    someone("until", "!vvgt.live.look.shows")
    someone("eval", "window.lose.restoreContext()")
    someone("until", SHOWN)
    assert someone("eval", VOLUME) == before
    someone("eval", LOSE)
    someone("until", "document.querySelector('#live p').textContent.includes('its graphics were lost')")
    someone("eval", "window.lose.restoreContext()")
    someone("until", SHOWN)
    assert someone("eval", "document.querySelector('#live p').textContent") == ""


def test_a_series_has_the_values_of_each_frame(someone: Person, tmp_path: Path) -> None:
    z, y, x = np.mgrid[:24, :24, :24]
    for k in range(2):
        away = np.sqrt((x - 6 - 12 * k) ** 2 + (y - 12) ** 2 + (z - 12) ** 2)
        np.save(tmp_path / f"f{k}.npy", np.clip(1.5 - away / 4, 0, 1).astype(np.float32))
    page = tmp_path / "run.html"
    assert run(["convert", str(tmp_path / "f*.npy"), "--tf", "viridis", *MADE, "-o", str(page)]) == 0
    begin(someone, page)
    for k in (0, 1, 0):
        someone("eval", f"vvgt.show({k})")
        seen = someone("eval", VOLUME)
        print(f"frame {k}: {seen}")
        assert seen[k] > 20 * max(seen[1 - k], 5)


WITHOUT = {  # what is not there, and what the page says
    "3D textures": (
        "HTMLCanvasElement.prototype, 'getContext', (f, self, all) =>"
        " (self.id === 'volume' ? null : Reflect.apply(f, self, all))",
        "it has no WebGL 2",
    ),
    "large ones": (
        "WebGL2RenderingContext.prototype, 'getParameter', (f, self, all) =>"
        " (all[0] === self.MAX_3D_TEXTURE_SIZE ? 16 : Reflect.apply(f, self, all))",
        "it draws at most 16 voxels along an axis",
    ),
}


@pytest.mark.parametrize("what", WITHOUT)
def test_without_3d_textures_the_conversion_is_shown(field: Path, tmp_path: Path, what: str) -> None:
    page = tmp_path / "none.html"
    of, said = WITHOUT[what]
    broken = f"<script>((of, name, apply) => {{ of[name] = new Proxy(of[name], {{ apply }}); }})({of})</script><main"
    page.write_text((field / "a.html").read_text("utf-8").replace("<main", broken, 1), "utf-8")
    wait = "await new Promise((done) => { setTimeout(done, 3000); });"
    job = f"(async () => {{ {EDIT} {wait} document.title = document.querySelector('#live p').textContent; if (!document.title.startsWith('This browser cannot show the volume itself: {said}')) throw new Error(document.title); }})()"  # noqa: E501
    picture, _ = page_picture(page.as_uri(), tmp_path, SIZE, before=job)
    assert picture.max() > 0.2
