"""The page of `vvgt view`, and the one in a file, in a real browser that reaches nothing but its own address."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import PAGES, browser, packages

from tests.test_formats_server import shown
from vvgt_cli.cameras import orbit_views
from vvgt_cli.cli.main import run
from vvgt_cli.gaussians import read_ply
from vvgt_cli.gaussians.formats import read_splats
from vvgt_cli.images import read_png
from vvgt_cli.images.metrics import psnr
from vvgt_cli.splat import render

SIZE = 400
pytestmark = pytest.mark.long


def shoot(url: str, folder: Path, frame: int | None = None) -> tuple[np.ndarray, dict[str, Any]]:
    """Picture (SIZE, SIZE, 3) where the page begins, and what the browser noted."""
    job = {"browser": browser(), "url": url, "size": SIZE, "camera": None, "frame": frame, "out": str(folder / "a.png")}
    (folder / "job.json").write_text(json.dumps(job))
    command = ["node", str(PAGES / "page.mjs"), str(folder / "job.json"), str(packages())]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr
    noted = json.loads(done.stdout.splitlines()[-1])
    assert noted["asked"] == []
    assert noted["text"] == ""
    return read_png(folder / "a.png")[..., :3], noted


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "frog.ply"
    assert run(["init", "example:frog", "--max-gaussians", "20000", "--quiet", "-o", str(path)]) == 0
    return path


def ours(file: Path) -> np.ndarray:
    """As `vvgt render --orbit` draws its first view, by the file's rule; the file is not turned."""
    camera = orbit_views(1, size=SIZE)[0]
    return render(read_ply(file)[0], camera, rule="inria")[..., :3]


def test_view_shows_what_render_draws(file: Path, tmp_path: Path) -> None:
    with shown(file.name, folder=file.parent) as (_, url):
        shot, noted = shoot(url, tmp_path)
    same = psnr(ours(file), shot)
    print(f"the page against our drawing: {same:.2f} dB; {noted['seconds']:.1f} s to the first picture")
    other = psnr(render(read_ply(file)[0], orbit_views(1, size=SIZE)[0], rule="playcanvas")[..., :3], shot)
    assert same > max(40, other + 3)
    assert noted["frames"] == 1
    for mirrored in (shot[:, ::-1], shot[::-1]):
        assert psnr(ours(file), mirrored) < 30


def test_the_page_in_a_file_shows_the_same(file: Path, tmp_path: Path) -> None:
    assert run(["view", str(file), "-o", str(tmp_path / "frog.html"), "--quiet"]) == 0
    shot, _ = shoot((tmp_path / "frog.html").as_uri(), tmp_path)
    same = psnr(ours(file), shot)
    print(f"the page in a file against our drawing by its rule: {same:.2f} dB")
    assert same > 38  # the splats in it are compressed
    assert len(read_splats(tmp_path / "frog.html")[0]) == len(read_ply(file)[0])


def test_a_series_goes_to_its_frames(file: Path, tmp_path: Path) -> None:
    from vvgt_cli.gaussians import write_ply

    gaussians = read_ply(file)[0]
    white = replace(gaussians, colors=np.ones_like(gaussians.colors))
    for name, frame in (("f0.ply", gaussians), ("f1.ply", white)):
        write_ply(tmp_path / name, frame)
    with shown("f*.ply", folder=tmp_path) as (_, url):
        shot, noted = shoot(url, tmp_path, frame=1)
    assert noted["frames"] == 2
    expected = render(white, orbit_views(1, size=SIZE)[0], rule="inria")[..., :3]
    assert psnr(expected, shot) > 38
    assert psnr(ours(file), shot) < 25


def test_a_page_of_several_in_a_file_goes_to_each(file: Path, tmp_path: Path) -> None:
    from vvgt_cli.gaussians import write_ply

    gaussians = read_ply(file)[0]
    white = replace(gaussians, colors=np.ones_like(gaussians.colors))
    for name, frame in (("f0.ply", gaussians), ("f1.ply", white)):
        write_ply(tmp_path / name, frame)
    files = [str(tmp_path / f"f{k}.ply") for k in (0, 1)]
    assert run(["view", *files, "-o", str(tmp_path / "both.html"), "--quiet"]) == 0
    expected = render(white, orbit_views(1, size=SIZE)[0], rule="inria")[..., :3]
    for frame, picture in ((0, ours(file)), (1, expected)):
        shot, noted = shoot((tmp_path / "both.html").as_uri(), tmp_path, frame=frame)
        assert noted["frames"] == 2
        assert psnr(picture, shot) > 36
