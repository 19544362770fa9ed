# ruff: noqa: F811
"""Labels, layers and light of live pages in a real browser, by clicking, dragging and typing."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import page_picture
from test_live_layers import pair  # noqa: F401

from vvgt_cli.cameras import orbit_views
from vvgt_cli.commands.main import run
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.gaussians import read_ply
from vvgt_cli.images import read_png
from vvgt_cli.images.metrics import psnr
from vvgt_cli.splat import render

SIZE = 300
DESK, PHONE = (1280, 800), (390, 844)
Actions = list[dict[str, Any]]
pytestmark = pytest.mark.long


def after(
    file: Path, actions: Actions, folder: Path, window: tuple[int, int] = DESK, before: str | None = None
) -> np.ndarray:
    """Picture (SIZE, SIZE, 3) of the page of a file, after JavaScript and ``actions`` in a window."""
    page = file.with_suffix(".html")
    if not page.exists():
        assert run(["view", str(file), "-o", str(page), "--quiet"]) == 0
    job = {"before": before, "actions": actions, "window": window, "look": str(folder / "look.png")}
    return page_picture(page.as_uri(), folder, SIZE, **job)[0]


def ours(file: Path, folder: Path, *look: str) -> np.ndarray:
    """What `vvgt recolor` makes of a file, as `vvgt render --orbit` begins."""
    out = folder / "ours.ply"
    assert run(["recolor", str(file), *look, "--quiet", "--overwrite", "-o", str(out)]) == 0
    return render(open_gaussians(str(out))[0], orbit_views(1, size=SIZE)[0], rule="inria")[..., :3]


@pytest.fixture(scope="module")
def lit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lit") / "ml.ply"
    source = ["convert", "example:marschner-lobb:32", "--live", "--light", "headlight", "--tf", "viridis"]
    assert run([*source, "--max-gaussians", "8000", "--size", "300", "--quiet", "-o", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """27 cubes, each a label, whose names are markup."""
    path = tmp_path_factory.mktemp("many") / "many.ply"
    z, y, x = np.mgrid[:27, :27, :27] // 9
    np.save(path.with_name("map.npy"), (1 + x + 3 * y + 9 * z).astype(np.uint8))
    entries = {n: {"name": f"<i>part {n}</i>", "color": (n % 7 / 6, n % 5 / 4, n % 3 / 2)} for n in range(1, 28)}
    path.with_name("names.json").write_text(json.dumps(entries))
    source = ["convert", str(path.with_name("map.npy")), "--live", "--labels", str(path.with_name("names.json"))]
    assert run([*source, "--max-gaussians", "4000", "--size", "300", "--quiet", "-o", str(path)]) == 0
    return path


def table(file: Path, folder: Path, shown: set[int]) -> str:
    header = read_ply(file)[1]
    entries = {
        str(e.number): {"name": e.name, "color": e.color, "opacity": e.opacity if e.number in shown else 0}
        for e in header.live.labels
    }
    (folder / "t.json").write_text(json.dumps(entries))
    return str(folder / "t.json")


def test_a_page_begins_with_the_files_light_and_the_ball_moves_it(lit: Path, tmp_path: Path) -> None:
    head = after(lit, [], tmp_path)
    same = psnr(ours(lit, tmp_path), head)
    print(f"the page under a head-light against our drawing: {same:.2f} dB")
    assert same > max(32, psnr(ours(lit, tmp_path, "--light", "none"), head) + 3)
    ball: Actions = [{"click": "#live summary"}, {"drag": "#live .light svg", "by": [-20, -12]}]
    for window in (DESK, PHONE):
        actions = ball if window == DESK else [{"click": "#live .fold"}, *ball]
        assert psnr(head, after(lit, actions, tmp_path, window)) < 35
        assert psnr(head, after(lit, [*actions, {"key": "Control+z"}], tmp_path, window)) > 45


def test_labels_are_switched_off_shown_alone_and_searched(labels: Path, tmp_path: Path) -> None:
    off: Actions = [{"click": "#live li:nth-child(1) .eye"}, {"click": "#live li:nth-child(3) .eye"}]
    wanted = ours(labels, tmp_path, "--labels", table(labels, tmp_path, set(range(1, 28)) - {1, 3}))
    every, shot = ours(labels, tmp_path), after(labels, off, tmp_path)
    print(f"two labels off: {psnr(wanted, shot):.2f} dB, not {psnr(every, shot):.2f}")
    assert psnr(wanted, shot) > max(28, psnr(every, shot) + 3)
    whole = after(labels, [*off, {"key": "Control+z"}, {"key": "Control+z"}], tmp_path)
    print(f"undone: {psnr(every, whole):.2f} dB, not {psnr(wanted, whole):.2f}")
    assert psnr(every, whole) > max(28, psnr(wanted, whole) + 3)
    solo: Actions = [
        {"click": "#live .fold"}, {"fill": "#live [type=search]", "text": "<i>part 7<"},
        {"click": "#live li:not([hidden]) .solo"},
    ]  # fmt: skip
    alone = ours(labels, tmp_path, "--labels", table(labels, tmp_path, {7}))
    shot = after(labels, solo, tmp_path, PHONE)
    print(f"one label alone: {psnr(alone, shot):.2f} dB")
    assert psnr(alone, shot) > 28


def test_a_frame_of_a_series_is_shown_under_the_function_of_the_page(tmp_path: Path) -> None:
    """Chosen in the list; under the file's function, and once the panel has shown another one."""
    for k in range(2):
        z, y, x = np.mgrid[:24, :24, :24] - 11.5
        ball = np.exp(-(((x - 5 * k) / 6) ** 2 + (y / 4) ** 2 + (z / 7) ** 2)).astype(np.float32)
        np.save(tmp_path / f"f{k}.npy", ball)
    source = [
        "convert", str(tmp_path / "f?.npy"), "--tf", "viridis", "--live", "--max-gaussians", "6000", "--size", "300",
    ]  # fmt: skip
    assert run([*source, "--quiet", "-o", str(tmp_path / "all.html")]) == 0
    assert run([*source, "--quiet", "-o", str(tmp_path / "f_{}.ply")]) == 0
    wanted = [ours(tmp_path / f"f_{k}.ply", tmp_path) for k in range(2)]
    shot = after(tmp_path / "all.ply", [{"select": "#series select", "text": "frame 1"}], tmp_path)
    print(f"the second frame: {psnr(wanted[1], shot):.2f} dB, not {psnr(wanted[0], shot):.2f}")
    assert psnr(wanted[1], shot) > max(32, psnr(wanted[0], shot) + 5)
    ramp: Actions = [{"click": "#live .preset"}, {"click": "#live .presets [title=step]"}]
    other = after(tmp_path / "all.ply", [*ramp, {"select": "#series select", "text": "frame 1"}], tmp_path)
    again = after(tmp_path / "all.ply", [{"select": "#series select", "text": "frame 1"}, *ramp], tmp_path)
    assert psnr(other, again) > 40
    assert psnr(other, shot) < 30


def test_a_frame_of_several_layers_is_shown_in_its_page(tmp_path: Path) -> None:
    """A label map over frames, hidden in the list before another frame is chosen."""
    z, y, x = np.mgrid[:24, :24, :24] - 11.5
    for k in range(2):
        np.save(tmp_path / f"f{k}.npy", np.exp(-(((x - 5 * k) / 6) ** 2 + (y / 4) ** 2 + (z / 7) ** 2)))
    np.save(tmp_path / "map.npy", ((z > 7) & (np.abs(x) < 6) & (np.abs(y) < 6)).astype(np.uint8))
    source = ["convert", str(tmp_path / "f?.npy"), "--tf", "viridis", "--layer", f"{tmp_path / 'map.npy'},labels=auto"]
    source += ["--live", "--max-gaussians", "6000", "--size", "300", "--quiet"]
    assert run([*source, "-o", str(tmp_path / "all.html")]) == 0
    assert run([*source, "-o", str(tmp_path / "f_{}.ply")]) == 0
    (tmp_path / "off.json").write_text(json.dumps({"1": {"color": [0, 0, 1], "opacity": 0}}))
    off = ("--layer", f"map,labels={tmp_path / 'off.json'}")
    wanted = [ours(tmp_path / f"f_{k}.ply", tmp_path) for k in range(2)]
    hidden = ours(tmp_path / "f_1.ply", tmp_path, *off)
    second: Actions = [{"select": "#series select", "text": "frame 1"}]
    shot = after(tmp_path / "all.ply", second, tmp_path)
    print(f"the second frame: {psnr(wanted[1], shot):.2f} dB, not {psnr(wanted[0], shot):.2f}")
    assert psnr(wanted[1], shot) > max(32, psnr(wanted[0], shot) + 5)
    hide: Actions = [{"select": "#live .layer", "text": "map"}, {"click": "#live .organs li .eye"}]
    shot = after(tmp_path / "all.ply", [*hide, *second], tmp_path)
    print(f"its label hidden: {psnr(hidden, shot):.2f} dB, not {psnr(wanted[1], shot):.2f}")
    assert psnr(hidden, shot) > max(32, psnr(wanted[1], shot) + 5)


def test_layers_are_changed_one_at_a_time(pair: Path, tmp_path: Path) -> None:
    """The function of the second one, chosen in the list, and then the label of the third one."""
    magma = {"points": [{"x": 0.3, "rgb": [0, 0.4, 1], "opacity": 0}, {"x": 0.6, "rgb": [1, 1, 1], "opacity": 0.9}]}
    (tmp_path / "other.json").write_text(json.dumps(magma))
    live = pair / "live.ply"
    begun = after(live, [], tmp_path)
    own = ours(live, tmp_path)
    print(f"layers as in the file: {psnr(own, begun):.2f} dB")
    assert psnr(own, begun) > 32
    nodes = json.dumps([{"x": p["x"], "y": p["opacity"], "rgb": p["rgb"]} for p in magma["points"]])
    look = ("--layer", f"right,tf={tmp_path / 'other.json'},distance=paraview")
    wanted = ours(live, tmp_path, *look)
    shot = after(live, [], tmp_path, before=f"window.vvgt.live.layers[1].set({nodes})")
    print(f"another function of the second: {psnr(wanted, shot):.2f} dB, not {psnr(own, shot):.2f}")
    assert psnr(wanted, shot) > max(32, psnr(own, shot) + 5)
    (tmp_path / "off.json").write_text(json.dumps({"3": {"name": "top", "color": [0, 0, 1], "opacity": 1e-6}}))
    wanted = ours(live, tmp_path, "--layer", f"top,labels={tmp_path / 'off.json'}")
    for window in (DESK, PHONE):
        actions: Actions = [{"select": "#live .layer", "text": "top_label"}, {"click": "#live .organs li .eye"}]
        shot = after(live, actions if window == DESK else [{"click": "#live .fold"}, *actions], tmp_path, window)
        print(f"{window}: the label of the third off: {psnr(wanted, shot):.2f} dB, not {psnr(own, shot):.2f}")
        assert psnr(wanted, shot) > max(32, psnr(own, shot) + 5)


def test_mip_and_x_ray_are_those_of_the_command(tmp_path: Path) -> None:
    """Chosen in the panel and by their key; undone, the look is back."""
    live = tmp_path / "live.ply"
    source = ["convert", "example:marschner-lobb:32", "--live", "--tf", "viridis", "--max-gaussians", "8000"]
    assert run([*source, "--size", "300", "--quiet", "-o", str(live)]) == 0
    whole = after(live, [], tmp_path)
    for number, (name, rule) in enumerate((("MIP", "mip"), ("X-ray", "xray")), 1):
        out = tmp_path / f"{rule}.png"
        assert run(["render", str(live), "--rule", rule, "--size", str(SIZE), "--quiet", "-o", str(out)]) == 0
        wanted = read_png(out)[..., :3]
        chosen = after(live, [{"select": "#live .kind", "text": name}], tmp_path)
        pressed = after(live, [{"key": "k"}] * number, tmp_path)
        print(f"{name}: {psnr(wanted, chosen):.2f} dB")
        assert psnr(wanted, chosen) > 40
        assert psnr(chosen, pressed) > 60
        assert psnr(whole, chosen) < 20
    assert psnr(whole, after(live, [{"key": "k"}, {"key": "Control+z"}], tmp_path)) > 45
