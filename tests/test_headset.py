"""The page in a headset: an emulated one, both eyes beside our own drawing."""

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import PAGES, browser, packages

from vvgt_cli.cameras import Camera
from vvgt_cli.commands.main import run
from vvgt_cli.gaussians import read_ply
from vvgt_cli.images import read_png
from vvgt_cli.images.metrics import psnr
from vvgt_cli.splat import render

pytestmark = pytest.mark.long
TURNED = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])  # the viewer's axes from the file's, without an upward axis
DOWN = np.diag([1.0, -1.0, -1.0])  # our cameras look along z, y down


def camera_of(eye: dict[str, Any]) -> Camera:
    """Our camera of an eye's matrices."""
    _, _, width, height = eye["viewport"]
    view, projection = (np.reshape(eye[name], (4, 4)).T for name in ("view", "projection"))
    focal = projection[0, 0] * width / 2, projection[1, 1] * height / 2
    middle = (1 - projection[0, 2]) * width / 2, (1 + projection[1, 2]) * height / 2
    return Camera(DOWN @ view[:3, :3] @ TURNED, DOWN @ view[:3, 3], *focal, *middle, int(width), int(height))


def test_both_eyes_see_the_file(tmp_path: Path) -> None:
    page, ply, out = tmp_path / "frog.html", tmp_path / "frog.ply", tmp_path / "eyes.png"
    for target in (page, ply):
        assert run(["init", "example:frog", "--max-gaussians", "20000", "-q", "--up", "none", "-o", str(target)]) == 0
    job = tmp_path / "job.json"
    job.write_text(json.dumps({"browser": browser(), "url": page.as_uri(), "out": str(out)}))
    found = subprocess.run(
        ["node", str(PAGES / "headset.mjs"), str(job), str(packages())], capture_output=True, text=True, timeout=900
    )
    assert found.returncode == 0, found.stderr
    told = json.loads(found.stdout)
    assert told["asked"] == []
    assert told["offered"] == ["VR", "AR"]
    assert told["after"]
    picture, splats = read_png(out)[..., :3], read_ply(ply)[0]
    cameras = [camera_of(eye) for eye in told["eyes"]]
    apart = cameras[0].position - cameras[1].position
    assert np.linalg.norm(apart) == pytest.approx(0.063, abs=0.002)
    x, y, z = np.mean([camera.position for camera in cameras], axis=0)  # eyes 1.6 m above the floor
    assert (np.hypot(x, y), z) == pytest.approx((2, 0.3), abs=0.05)
    for eye, camera in zip(told["eyes"], cameras, strict=True):
        left, below, width, height = (round(x) for x in eye["viewport"])
        top = len(picture) - below - height
        seen = picture[top : top + height, left : left + width]
        ours = render(splats, camera)[..., :3]
        assert (ours > 0.1).any(axis=2).mean() > 0.03
        agreement = psnr(seen, ours)
        print(f"{agreement:.1f} dB")
        assert agreement > 40
