"""Blender's add-on in Blender itself: imported points in their places and colours, and a Volume object by its ramp."""

import json
import os
import subprocess
import sys
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vvgt_cli.cameras import Camera
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.gaussians import Gaussians, read_ply, write_ply
from vvgt_cli.gaussians.ply import PlyOptions
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.images.metrics import psnr
from vvgt_cli.splat import render

ROOT = Path(__file__).parents[1]
SCALE, CENTRE = 0.05, (10.0, -20.0, 30.0)
PLACED = PlyOptions(scale=SCALE, centre=CENTRE)
FILES = {  # and the rotation from the world to Blender, about the centre
    "z.ply": (replace(PLACED, up="z"), np.eye(3)),
    "none.ply": (PLACED, np.eye(3)),
    "world.ply": (replace(PLACED, frame="world"), np.eye(3)),
    "y.ply": (replace(PLACED, up="y"), np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])),
}


def grid() -> Gaussians:
    """16 opaque, distinct Gaussians in a plane that +y looks at."""
    x, z = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.75, 0.75, 4), np.linspace(-0.75, 0.75, 4)))
    means = np.stack([x, 0 * x, z], 1)
    colors = np.random.default_rng(5).uniform(0, 1, (16, 3))
    shapes = np.log(np.tile([0.12, 0.02, 0.08], (16, 1)))
    arrays = (means, shapes, np.tile([1.0, 0, 0, 0], (16, 1)), np.full(16, 9.0), colors)
    return Gaussians(*(a.astype(np.float32) for a in arrays))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """What `blender_scene.py` leaves."""
    python = os.environ.get("BLENDER_PYTHON")
    if python is None:
        pytest.skip("no Blender: set BLENDER_PYTHON to a Python with bpy (pip install bpy)")
    folder = tmp_path_factory.mktemp("blender")
    with tarfile.open(ROOT / "tests" / "fixtures" / "vdb" / "grids.tar.xz") as archive:
        archive.extract("./sphere.vdb", folder, filter="data")
    for name, (options, _) in FILES.items():
        write_ply(folder / name, grid(), options)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    vvgt = [sys.executable, "-m", "vvgt_cli.commands.main"]
    subprocess.run([*vvgt, "view", folder / "z.ply", "-o", folder / "z.spz"], env=environment, check=True)
    views = dict.fromkeys([*FILES, "z.spz"]) | {"z.ply": [(10, -120, 30), CENTRE, 40]}
    (folder / "views.json").write_text(json.dumps(views))
    command = {"VVGT": f"env PYTHONPATH={ROOT} {' '.join(vvgt)}"}
    done = subprocess.run(
        [python, ROOT / "tests" / "blender_scene.py", folder, ROOT / "vvgt_cli" / "integrations" / "blender"],
        env=os.environ | command, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (folder / "facts.json").exists(), done.stdout[-1500:] + done.stderr[-3000:]
    return folder, json.loads((folder / "facts.json").read_text())


def pixels(path: Path) -> np.ndarray:
    """A picture of Blender's, straight alpha, in [0, 1]."""
    return np.asarray(Image.open(path)).astype(np.float64) / 255


def linear(display: np.ndarray) -> np.ndarray:
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def drawn(path: Path, view: list, size: int, light: bool) -> np.ndarray:
    """Our picture of a file, RGBA with straight alpha; blended in ``light`` as Blender does, else as viewers do."""
    gaussians, header = open_gaussians(str(path))
    if light:
        gaussians = replace(gaussians, colors=linear(np.maximum(gaussians.colors, 0)).astype(np.float32))
    eye, target = (header.scale * (np.array(place) - header.centre) for place in view[:2])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0, 0, 1)) / np.linalg.norm(np.cross(forward, (0, 0, 1)))
    turn = np.stack([right, np.cross(forward, right), forward])
    focal = size / 2 / np.tan(np.radians(view[2]) / 2)
    found = render(gaussians, Camera(turn, -turn @ eye, focal, focal, size / 2, size / 2, size, size), INRIA)
    return found.astype(np.float64)


@pytest.mark.long
def test_imported_points_are_where_the_file_has_them(scene) -> None:
    folder, _ = scene
    world = grid().means.astype(float) / SCALE + CENTRE
    for name, (_, turn) in FILES.items():
        found = np.load(folder / f"{name}.npz")
        assert found["places"] == pytest.approx((world - CENTRE) @ turn.T + CENTRE, abs=0.01), name
        assert np.linalg.det(turn) == 1
    assert np.load(folder / "z.spz.npz")["places"] == pytest.approx(world, abs=0.01)


@pytest.mark.long
def test_imported_colours_are_the_files_on_blenders_screen(scene) -> None:
    folder, facts = scene
    assert facts["transform"] == "Standard"
    found = np.load(folder / "z.ply.npz")
    assert found["color"][:, :3] == pytest.approx(linear(read_ply(folder / "z.ply")[0].colors), abs=1e-5)
    picture = pixels(folder / "z.ply.png")
    size, focal = len(picture), len(picture) / 2 / np.tan(np.radians(20))
    columns = (size / 2 + focal * grid().means[:, 0] / SCALE / 100).astype(int)
    rows = (size / 2 - focal * grid().means[:, 2] / SCALE / 100).astype(int)
    assert np.abs(picture[rows, columns, :3] - grid().colors).max() <= 1 / 255
    assert picture[rows, columns, 3].min() > 0.7


@pytest.mark.long
def test_a_volume_object_is_where_blender_has_it(scene) -> None:
    folder, facts = scene
    header = read_ply(folder / "volume.ply")[1]
    own = np.array([[1, 0, 0, -16], [0, 1, 0, -15], [0, 0, 1, -14], [0, 0, 0, 1]])  # of the grid, a ball
    expected = np.array(facts["matrix"]) @ own
    corners = np.array([[0, 0, 0, 1], [34, 0, 0, 1], [0, 34, 0, 1], [0, 0, 34, 1]]).T
    assert np.reshape(header.affine, (3, 4)) @ corners == pytest.approx((expected @ corners)[:3], abs=0.01)
    found = np.load(folder / "volume.ply.npz")
    gaussians = open_gaussians(str(folder / "volume.ply"))[0]
    assert found["places"] == pytest.approx(gaussians.means / header.scale + header.centre, abs=0.01)
    mass = np.exp(gaussians.log_scales.sum(axis=1).astype(float)) * found["opacity"][:, 0]
    assert mass @ found["places"] / mass.sum() == pytest.approx((expected @ [17, 17, 17, 1])[:3], abs=0.2)
    assert header.up == "z"
    assert header.camera == pytest.approx((*facts["camera"][0], *header.camera[3:6], 40), abs=1e-4)


@pytest.mark.long
def test_the_pictures_are_blenders_own(scene) -> None:
    folder, facts = scene
    volume, imported = (pixels(folder / name) for name in ("volume.png", "volume.ply.png"))
    ours = drawn(folder / "volume.ply", facts["camera"], len(volume), light=False)
    over_black = volume[..., :3] * volume[..., 3:]
    found = psnr(over_black.astype(np.float32), ours[..., :3].astype(np.float32))
    blended = drawn(folder / "volume.ply", facts["camera"], len(volume), light=True)
    theirs = linear(imported[..., :3]) * imported[..., 3:]
    points = psnr(theirs.astype(np.float32), blended[..., :3].astype(np.float32))
    print(f"Cycles' volume against our Gaussians: {found:.1f} dB; Cycles' Gaussians against ours: {points:.1f} dB")
    assert found > 35
    assert points > 35


@pytest.mark.long
def test_what_is_not_taken_is_named(scene) -> None:
    _, facts = scene
    assert facts["without"] == []
    assert facts["more"] == ["scattering", "Blackbody"]
    assert facts["refused"].startswith(
        "Error: ramped: node 'Noise Texture' cannot be taken; expected a grid, Color Ramp"
    )
