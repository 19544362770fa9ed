"""transforms.json in and out, and the pose conventions between OpenCV and OpenGL."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.refused import refused
from vvgt_cli import files
from vvgt_cli.cameras import Camera, default_views, look_at, orbit_views
from vvgt_cli.cameras.files import camera_to_opengl, opengl_to_pose, read_cameras, transforms_json
from vvgt_cli.errors import DataError


def same_camera(a: Camera, b: Camera, atol=1e-12):
    np.testing.assert_allclose(a.rotation, b.rotation, atol=atol)
    np.testing.assert_allclose(a.translation, b.translation, atol=atol)
    assert (a.fx, a.fy, a.cx, a.cy, a.width, a.height) == (b.fx, b.fy, b.cx, b.cy, b.width, b.height)
    assert a.name == b.name


@given(st.lists(st.floats(-5, 5), min_size=3, max_size=3).filter(lambda e: np.linalg.norm(e) > 0.1))
def test_pose_round_trip(eye):
    camera = look_at(eye)
    rotation, translation = opengl_to_pose(camera_to_opengl(camera))
    np.testing.assert_allclose(rotation, camera.rotation, atol=1e-12)
    np.testing.assert_allclose(translation, camera.translation, atol=1e-11)


def test_opengl_axes_are_right_up_and_backwards():
    matrix = camera_to_opengl(look_at((3.0, 0.0, 0.0)))  # on +x, looking at the origin, +z up
    np.testing.assert_allclose(matrix[:3, 0], (0, 1, 0), atol=1e-12)  # right
    np.testing.assert_allclose(matrix[:3, 1], (0, 0, 1), atol=1e-12)  # up
    np.testing.assert_allclose(matrix[:3, 2], (1, 0, 0), atol=1e-12)  # against the view direction
    np.testing.assert_allclose(matrix[:3, 3], (3, 0, 0), atol=1e-12)


@pytest.mark.parametrize("mixed", [False, True])
def test_file_round_trip(tmp_path, mixed):
    cameras = default_views("test", size=64) + (orbit_views(3, size=48) if mixed else [])
    path = tmp_path / "transforms.json"
    path.write_text(transforms_json(cameras, ply_file_path="a.ply"))
    document = json.loads(path.read_text())
    assert ("fl_x" in document) is not mixed
    assert document["ply_file_path"] == "a.ply"
    for a, b in zip(read_cameras(path), cameras, strict=True):
        same_camera(a, b)


def test_size_scales_the_views(tmp_path):
    path = tmp_path / "transforms.json"
    path.write_text(transforms_json(orbit_views(2, size=100)))
    for camera, original in zip(read_cameras(path, size=250), orbit_views(2, size=100), strict=True):
        same_camera(camera, original.resized(2.5))


def test_blender_style(tmp_path):
    camera = look_at((0.0, -3.0, 1.0), width=80, height=80, fov=50, name="r_0")
    document = {"camera_angle_x": math.radians(50)}
    document["frames"] = [{"file_path": "./train/r_0", "transform_matrix": camera_to_opengl(camera).tolist()}]
    path = tmp_path / "transforms_train.json"
    path.write_text(json.dumps(document))
    (read,) = read_cameras(path, size=80)
    assert read.fx == pytest.approx(camera.fx)
    np.testing.assert_allclose(read.rotation, camera.rotation, atol=1e-12)
    refused(DataError, "--size", read_cameras, path)


FRAME = {"file_path": "a.png", "transform_matrix": camera_to_opengl(look_at((1.0, 2.0, 3.0))).tolist()}
LENS = {"w": 32, "h": 32, "fl_x": 40.0}
BAD = {
    "not json": ("{", "not JSON"),
    "deep": ("[" * 200_000, "not JSON"),
    "a list": ("[]", "no list 'frames'"),
    "no frames": (json.dumps(LENS), "no list 'frames'"),
    "text frame": (json.dumps({**LENS, "frames": ["a"]}), "frame 0 is str; expected an object"),
    "no matrix": (json.dumps({**LENS, "frames": [{}]}), "4 x 4"),
    "ragged": (json.dumps({**LENS, "frames": [{**FRAME, "transform_matrix": [[1], [2, 3]]}]}), "4 x 4"),
    "scaled": (
        json.dumps({**LENS, "frames": [{**FRAME, "transform_matrix": np.diag([2, 2, 2, 1]).tolist()}]}),
        "ortho",
    ),
    "nan": (json.dumps({**LENS, "frames": [{**FRAME, "transform_matrix": [[math.nan] * 4] * 3}]}), "not finite"),
    "fisheye": (json.dumps({**LENS, "camera_model": "OPENCV_FISHEYE", "frames": [FRAME]}), "pinhole"),
    "distorted": (json.dumps({**LENS, "k1": 0.1, "frames": [FRAME]}), "undistort"),
    "huge": (json.dumps({**LENS, "w": 10**9, "frames": [FRAME]}), "expected 1 to"),
    "text width": (json.dumps({**LENS, "w": "32", "frames": [FRAME]}), "expected a number"),
    "no lens": (json.dumps({"w": 32, "h": 32, "frames": [FRAME]}), "focal length"),
    "negative lens": (json.dumps({**LENS, "fl_x": -3, "frames": [FRAME]}), "expected > 0"),
    "negative up": (json.dumps({**LENS, "fl_y": -3, "frames": [FRAME]}), "expected > 0"),
    "twice": (json.dumps({**LENS, "frames": [FRAME, FRAME]}), "a second image"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_get_one_line(tmp_path, case):
    text, message = BAD[case]
    path = tmp_path / "transforms.json"
    path.write_text(text)
    refused(DataError, message, read_cameras, path)


def test_default_sets_share_no_view_and_look_at_the_origin():
    views = [camera for which in ("train", "check", "test") for camera in default_views(which, size=32)]
    assert len(views) == 38
    positions = np.array([camera.position for camera in views])
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 3, atol=1e-12)
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1)[~np.eye(38, dtype=bool)]
    assert gaps.min() > 0.1
    for camera in views:
        x, y, z = camera.translation  # the origin in camera axes
        np.testing.assert_allclose((x, y, z), (0, 0, 3), atol=1e-12)


@pytest.mark.parametrize("name", ["a\0b", "line\nbreak", "..\\..\\up"])
def test_an_image_that_is_no_file_name_is_refused(name, tmp_path):
    path = tmp_path / "t.json"
    path.write_text(transforms_json(default_views("check", 1, size=8), paths=[f"images/{name}.png"]))
    refused(DataError, "expected a plain file name", read_cameras, path)


def test_a_huge_file_is_not_parsed(tmp_path):
    path = tmp_path / "t.json"
    with path.open("wb") as file:
        file.truncate(files.MAX_TEXT + 1)
    refused(DataError, "more than 64 MiB", read_cameras, path)
