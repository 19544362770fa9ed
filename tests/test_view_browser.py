"""`vvgt view VOLUME` in a browser: the volume at once, its conversion, saved; a page within a notebook's."""

import json
import re
import subprocess
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from browser import PAGES, browser, first_of_orbit, packages

import vvgt_cli as vvgt
from tests.test_formats_browser import shoot
from tests.test_formats_server import shown
from vvgt_cli.cameras import orbit_views
from vvgt_cli.commands.main import run
from vvgt_cli.gaussians import read_ply
from vvgt_cli.gaussians.formats import read_splats
from vvgt_cli.images import read_png
from vvgt_cli.images.metrics import psnr
from vvgt_cli.splat import render

pytestmark = pytest.mark.long
NOTE = 'a </script> & $& "note"'
SHELL = {
    "points": [
        {"x": 0, "rgb": [1, 0.2, 0.1], "opacity": 0}, {"x": 0.35, "rgb": [1, 0.8, 0.2], "opacity": 0.02},
        {"x": 0.45, "rgb": [0.2, 0.6, 1], "opacity": 0.3}, {"x": 0.55, "rgb": [0.2, 0.4, 1], "opacity": 0},
        {"x": 1.5, "rgb": [1, 1, 1], "opacity": 0},
    ],
    "opacity_unit_distance": 0.04,
}  # fmt: skip


@pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids="{0[0]}".format)
def test_a_function_that_is_dragged_is_seen_at_once_and_then_converted(size: tuple[int, int], tmp_path: Path) -> None:
    (tmp_path / "shell.json").write_text(json.dumps(SHELL))
    with shown("example:blob:24", "--tf", "shell.json", folder=tmp_path) as (_, url):
        job = {
            "browser": browser(),
            "url": url,
            "size": size,
            "folder": str(tmp_path),
            "note": NOTE,
            "camera": first_of_orbit(),
        }
        (tmp_path / "job.json").write_text(json.dumps(job))
        command = ["node", str(PAGES / "served.mjs"), str(tmp_path / "job.json"), str(packages())]
        done = subprocess.run(command, capture_output=True, text=True, timeout=2400)
    assert done.returncode == 0, done.stderr
    noted = json.loads(done.stdout.splitlines()[-1])
    assert (noted["began"], noted["dragging"], noted["live"], noted["asked"]) == (*["volume"] * 3, "")
    assert noted["better"].startswith("converted, ")
    assert float(noted["better"].split()[1]) > 30
    assert max(noted["moved"]) < 2e-3  # it may still glide
    assert (noted["cut"], noted["uncut"], noted["changed"]) == ("volume", noted["better"], "volume")
    assert (noted["lit"][0], noted["lit"][1].split()[0]) == ("volume", "converted,")
    assert noted["refused"] == "not now"
    assert noted["slices"] == [24, 24, 24]
    assert b'id="values-0"' in (tmp_path / "blob-24.html").read_bytes()
    assert noted["saved"] == ["blob-24.ply", "blob-24.html", "tf.json"]
    scene = json.loads(re.search(r'id="scene">(.*?)</script>', (tmp_path / "blob-24.html").read_text("utf-8"), re.S)[1])
    link = dict(part.split("=", 1) for part in scene["link"].split("&"))
    assert json.loads(unquote(link["marks"])) == [["note", [[0, 0, 0]], NOTE]]
    assert "view" in link
    function = json.loads((tmp_path / "tf.json").read_text())
    assert [point["x"] for point in function["points"]] != [point["x"] for point in SHELL["points"]]
    pictures = {name: square(read_png(tmp_path / f"{name}.png")[..., :3]) for name in ("live", "better")}
    edge = len(pictures["live"])
    camera = orbit_views(1, size=edge)[0]
    _, (volume,) = vvgt.render_views("example:blob:24", function, cameras=[camera])
    live, better = (psnr(volume[..., :3], pictures[name]) for name in ("live", "better"))
    print(f"{size}: against the volume at {edge} px: rays {live:.2f} dB, converted {better:.2f} dB")
    assert live > max(38, better)
    saved = render(read_ply(tmp_path / "blob-24.ply")[0], camera, rule="inria")[..., :3]
    assert psnr(saved, pictures["better"]) > 38
    assert len(read_splats(tmp_path / "blob-24.html")[0]) == len(read_ply(tmp_path / "blob-24.ply")[0])


def square(image: np.ndarray) -> np.ndarray:
    """The middle of a picture."""
    height, width = image.shape[:2]
    edge = min(height, width)
    top, left = (height - edge) // 2, (width - edge) // 2
    return image[top : top + edge, left : left + edge]


def test_a_live_file_is_served_as_its_page_in_a_file_shows_it(tmp_path: Path) -> None:
    live = tmp_path / "blob.ply"
    how = ["--live", "--max-gaussians", "5000", "--screen", "256", "--quiet"]
    assert run(["convert", "example:blob:24", *how, "-o", str(live)]) == 0
    assert run(["view", str(live), "-o", str(tmp_path / "blob.html"), "--quiet"]) == 0
    one, _ = shoot((tmp_path / "blob.html").as_uri(), tmp_path)
    with shown("blob.ply", folder=tmp_path) as (_, url):
        other, _ = shoot(url, tmp_path)
    assert psnr(one, other) > 45


def test_a_result_is_shown_within_a_notebooks_page(tmp_path: Path) -> None:
    goal: dict[str, Any] = {"max_gaussians": 3000, "screen": 128}
    frame = vvgt.convert("example:blob:24", "viridis", **goal, live=True)._repr_html_()
    (tmp_path / "notebook.html").write_text(f"<!doctype html><body style='margin:0'>{frame}</body>")
    job = {"browser": browser(), "url": (tmp_path / "notebook.html").as_uri(), "out": str(tmp_path / "a.png")}
    (tmp_path / "job.json").write_text(json.dumps(job))
    command = ["node", str(PAGES / "framed.mjs"), str(tmp_path / "job.json"), str(packages())]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr
    noted = json.loads(done.stdout.splitlines()[-1])
    *wrong, changed = sorted(noted.pop("heard"), key=lambda one: one["vvgt"] == "changed")
    assert [one["message"].partition(" (")[0] for one in wrong] == [
        "cut.normal: expected 3 numbers",
        "light: expected kind none, headlight, direction; from other than 0, the others from 0 to 1000",
        "labels: the layer has a function",
        "cut: not in the documented form",
    ]
    assert changed == {"vvgt": "changed", "yaw": 90, "at": 0.25, "normal": [0, 0, 1]}
    assert noted == {"asked": [], "errors": [], "stored": False, "covered": [], "saved": "tf.json"}
    assert (read_png(tmp_path / "a.png")[..., :3].max(axis=-1) > 0.2).mean() > 0.02
