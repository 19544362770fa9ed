"""COLMAP models: rotations as quaternions, lenses shared, bytes as COLMAP's own library writes them."""

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vvgt_cli.cameras import default_views, look_at
from vvgt_cli.cameras.files import colmap_model
from vvgt_cli.cameras.types import quaternion
from vvgt_cli.gaussians.frames import rotations

unit = st.floats(-1, 1)


@given(st.tuples(unit, unit, unit, unit).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_quaternions_give_their_rotation_back(q):
    rotation = rotations(np.array([q]) / np.linalg.norm(q))[0]
    back = np.array(quaternion(rotation))
    assert back[0] >= 0
    assert np.linalg.norm(back) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(rotations(back[None])[0], rotation, atol=1e-12)


def test_pycolmap_writes_back_the_same_bytes(tmp_path):
    """Nothing is lost on the way through COLMAP; lenses that differ become cameras of their own."""
    wide = look_at((0.0, -3.0, 1.0), width=60, height=40, fov=50, name="wide")
    cameras = [*default_views("train", 3, size=32), wide]
    rng = np.random.default_rng(0)
    points, colors = rng.uniform(-1, 1, (40, 3)), rng.random((40, 3))
    files = colmap_model(cameras, [f"a/{camera.name}.png" for camera in cameras], points, colors)
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert sorted((c.width, c.height, *c.params) for c in model.cameras.values()) == sorted(
        {(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in cameras}
    )
    for i, camera in enumerate(cameras, 1):
        image = model.images[i]
        assert image.name == f"a/{camera.name}.png"
        matrix = image.cam_from_world().matrix()
        np.testing.assert_allclose(matrix[:, :3], camera.rotation, atol=1e-12)
        np.testing.assert_allclose(matrix[:, 3], camera.translation, atol=1e-12)
    for i in range(40):
        np.testing.assert_array_equal(model.points3D[i + 1].xyz, points[i])
        np.testing.assert_array_equal(model.points3D[i + 1].color, np.rint(colors[i] * 255))
    (tmp_path / "out").mkdir()
    model.write_binary(str(tmp_path / "out"))
    for name in ("cameras.bin", "points3D.bin"):
        assert sorted((tmp_path / "out" / name).read_bytes()) == sorted(files[name])  # order is COLMAP's
