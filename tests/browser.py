"""Web viewers in headless Chromium: `tests/viewers` has the pages, their packages live in a cache folder."""

import json
import math
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vvgt_cli.cameras import Camera, orbit_views
from vvgt_cli.gaussians.formats.nodes import HALF_TURN
from vvgt_cli.images import read_png

PAGES = Path(__file__).parent / "viewers"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def browser() -> str:
    """Path of Chromium; the test is skipped where there is none."""
    for name in BROWSERS:
        if path := shutil.which(name):
            return path
    pytest.skip(f"none of {', '.join(BROWSERS)} on the path (Debian: apt-get install chromium)")


def packages() -> Path:
    """Folder whose ``node_modules`` holds what `tests/viewers/package.json` names; made on the first call."""
    if not (shutil.which("node") and shutil.which("npm")):
        pytest.skip("node and npm are not on the path")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vvgt-viewers"
    wanted, done = PAGES / "package.json", cache / "installed.json"
    if not done.is_file() or done.read_bytes() != wanted.read_bytes():
        cache.mkdir(parents=True, exist_ok=True)
        shutil.copy(wanted, cache / "package.json")
        command = ["npm", "install", "--no-audit", "--no-fund", "--no-package-lock"]
        run = subprocess.run(command, cwd=cache, capture_output=True, text=True, timeout=600)
        if run.returncode:
            pytest.skip(f"npm install: {run.stderr.strip().splitlines()[-1:]}")
        shutil.copy(wanted, done)
    return cache


def shoot(
    viewer: str, file: Path, cameras: Sequence[Camera | None], size: int, folder: Path, options: str = ""
) -> list[np.ndarray]:
    """Pictures (size, size, 3) of ``file`` over black by a page of `tests/viewers`, opened with ``options``.

    A camera of None: from z = 3 of the viewer's own axes, y up.

    Cameras are square, have their principal point in the middle, and are in the frame of the `.ply`, which a `.glb` of
    ours turns.
    """
    turn = HALF_TURN if file.suffix == ".glb" else np.eye(3)
    cameras = [camera and replace(camera, rotation=camera.rotation @ turn) for camera in cameras]
    outputs = [folder / f"{viewer}-{file.stem}-{size}-{index}.png" for index in range(len(cameras))]
    job = {
        "viewer": viewer,
        "file": str(file),
        "size": size,
        "cameras": [camera and _pose(camera) for camera in cameras],
        "out": [str(path) for path in outputs],
        "options": options,
    }
    jobs = folder / f"{viewer}-{file.stem}-{size}.json"
    jobs.write_text(json.dumps({"browser": browser(), "jobs": [job]}))
    command = ["node", str(PAGES / "shots.mjs"), str(jobs), str(packages())]
    run = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert run.returncode == 0, run.stderr
    return [read_png(path)[..., :3] for path in outputs]


def page_picture(url: str, folder: Path, size: int, **job: Any) -> tuple[np.ndarray, dict[str, Any]]:
    """Picture (size, size, 3) where a page begins, after what ``job`` does, and what the browser noted: `page.mjs`."""
    job = {"browser": browser(), "url": url, "size": size, "camera": None, "frame": None} | job
    out, jobs = folder / "page.png", folder / "page.json"
    jobs.write_text(json.dumps(job | {"out": str(out)}))
    command = ["node", str(PAGES / "page.mjs"), str(jobs), str(packages())]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr
    return read_png(out)[..., :3], json.loads(done.stdout.splitlines()[-1])


def first_of_orbit() -> dict[str, object]:
    """The first view of `vvgt render --orbit`, as `page.mjs` takes it."""
    x, y, z = orbit_views(1)[0].position.tolist()
    return {"position": [-x, z, y], "target": [0, 0, 0], "up": [0, 1, 0], "fov": 40}


def _pose(camera: Camera) -> dict[str, object]:
    fov = math.degrees(2 * math.atan(camera.height / (2 * camera.fy)))
    return {"rotation": camera.rotation.tolist(), "translation": camera.translation.tolist(), "fov": fov}
