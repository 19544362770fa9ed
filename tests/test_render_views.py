"""`vvgt render-views`: what it writes is what was rendered, and other programs read it."""

import json
import shutil

import numpy as np
import pytest

import vvgt_cli
from tests.processes import replaced
from tests.refused import refused
from tests.view_sets import BACKGROUND, BASE, TF, VOLUME, make_views
from vvgt_cli.cameras import look_at
from vvgt_cli.cameras.files import camera_to_opengl, read_cameras, transforms_json
from vvgt_cli.commands.view_sets import camera_views, folders_of
from vvgt_cli.dvr import RenderSettings, render_view
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.images import over, read_exr, read_png
from vvgt_cli.images.files import load_views


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A finished folder; read only."""
    return make_views(tmp_path_factory)


@pytest.fixture
def copied(made, tmp_path):
    return shutil.copytree(made, tmp_path / "views")


@pytest.fixture(scope="module")
def expected():
    """Cameras and images by split, from the renderer itself."""
    scene = load(SourceRequest(VOLUME, tf=TF)).scene()
    views = camera_views("sphere", 3, 2, 24)
    return {
        split: [(v.camera, render_view(scene, v.camera, RenderSettings())) for v in views if v.split == split]
        for split in ("train", "test")
    }


def project(camera, point):
    x, y, z = camera.rotation @ point + camera.translation
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def test_the_folder_holds_what_the_page_says(made):
    names = sorted(str(path.relative_to(made)) for path in made.rglob("*") if path.is_file())
    views = [f"train/train_{i:03d}" for i in range(3)] + [f"test/test_{i:03d}" for i in range(2)]
    images = [f"{view}.{suffix}" for view in views for suffix in ("exr", "png")]
    images += [f"images/train_{i:03d}.png" for i in range(3)]
    model = [f"sparse/0/{name}.bin" for name in ("cameras", "images", "points3D")]
    texts = ["transforms.json", "transforms_train.json", "transforms_test.json", "manifest.json"]
    assert names == sorted([*images, *model, *texts, "points3d.ply", "contact.png"])


@pytest.mark.parametrize("cameras", [[], [look_at((3, 0, 0)), look_at((0, 3, 0))]])
def test_cameras_need_names_of_their_own(cameras, tmp_path):
    refused(UsageError, "of one name", vvgt_cli.render_views, VOLUME, TF, tmp_path / "v", cameras=cameras)


@pytest.mark.parametrize("split", ["train", "test"])
def test_exr_is_the_rendered_array_with_its_camera(made, expected, split):
    for camera, image in expected[split]:
        read, header = read_exr(made / split / f"{camera.name}.exr")
        assert read.tobytes() == image.tobytes()
        assert header.rotation.tobytes() == camera.rotation.tobytes()
        assert header.translation.tobytes() == camera.translation.tobytes()
        assert (header.fx, header.fy, header.cx, header.cy, header.width, header.height, header.name) == (
            camera.fx, camera.fy, camera.cx, camera.cy, 24, 24, camera.name
        )  # fmt: skip


def test_png_is_straight_alpha_beside_and_opaque_for_colmap(made, expected):
    for camera, image in expected["train"]:
        straight = read_png(made / f"train/{camera.name}.png")  # premultiplied on reading
        np.testing.assert_allclose(straight, np.clip(image, 0, 1), atol=1.01 / 255)
        opaque = read_png(made / f"images/{camera.name}.png")
        assert opaque.shape == (24, 24, 3)
        np.testing.assert_allclose(opaque, np.clip(over(image, BACKGROUND), 0, 1), atol=0.51 / 255)


def test_transforms_hold_the_cameras_and_the_split(made, expected):
    document = json.loads((made / "transforms.json").read_text())
    assert document["camera_model"] == "OPENCV"
    assert document["ply_file_path"] == "points3d.ply"
    assert all(key in document for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"))
    paths = [frame["file_path"] for frame in document["frames"]]
    assert document["train_filenames"] == paths[:3]
    assert document["val_filenames"] == document["test_filenames"] == paths[3:]
    assert all((made / path).is_file() for path in paths)
    cameras = [camera for split in ("train", "test") for camera, _ in expected[split]]
    for read, camera in zip(read_cameras(made / "transforms.json"), cameras, strict=True):
        np.testing.assert_allclose(read.rotation, camera.rotation, atol=1e-12)
        np.testing.assert_allclose(read.translation, camera.translation, atol=1e-12)
        assert (read.fx, read.cx, read.width, read.name) == (camera.fx, camera.cx, camera.width, camera.name)


@pytest.mark.parametrize("split", ["train", "test"])
def test_blender_style_for_the_original_code(made, expected, split):
    document = json.loads((made / f"transforms_{split}.json").read_text())
    assert document["camera_angle_x"] == pytest.approx(np.radians(40))
    for frame, (camera, _) in zip(document["frames"], expected[split], strict=True):
        assert frame["file_path"] == f"./{split}/{camera.name}"
        assert (made / (frame["file_path"] + ".png")).is_file()


def test_opengl_matrices_see_a_point_where_we_do(made, expected):
    """+x right, +y up, -z forward: a mirrored or rolled pose would move this point by pixels."""
    point = np.array([0.3, -0.2, 0.1])
    document = json.loads((made / "transforms.json").read_text())
    cameras = [camera for split in ("train", "test") for camera, _ in expected[split]]
    for frame, camera in zip(document["frames"], cameras, strict=True):
        matrix = np.array(frame["transform_matrix"])
        np.testing.assert_array_equal(matrix, camera_to_opengl(camera))
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
        x, y, z = (np.linalg.inv(matrix) @ [*point, 1])[:3]
        u = document["cx"] + document["fl_x"] * x / -z
        v = document["cy"] - document["fl_y"] * y / -z
        assert (u, v) == pytest.approx(project(camera, point), abs=1e-9)


def test_pycolmap_reads_the_model_and_projects_as_we_do(made, expected):
    import pycolmap

    model = pycolmap.Reconstruction(str(made / "sparse" / "0"))
    cameras = {f"{camera.name}.png": camera for camera, _ in expected["train"]}
    assert sorted(image.name for image in model.images.values()) == sorted(cameras)
    assert [camera.model.name for camera in model.cameras.values()] == ["PINHOLE"]
    assert len(model.points3D) > 100
    for image in model.images.values():
        assert (made / "images" / image.name).is_file()
        for point in list(model.points3D.values())[::50]:
            np.testing.assert_allclose(
                image.project_point(point.xyz), project(cameras[image.name], point.xyz), atol=0.01
            )


def test_points_are_the_volume(made):
    header, _, body = (made / "points3d.ply").read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[2].startswith("element vertex ")
    names = [line.split()[1:] for line in lines if line.startswith("property")]
    assert [name for _, name in names] == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]
    table = np.frombuffer(body, [("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    assert len(table) == int(lines[2].split()[2])
    assert (np.abs(table["xyz"]) <= 1).all()
    assert not table["normal"].any()
    curve = load(SourceRequest(VOLUME, tf=TF)).tf.color(np.linspace(0, 1, 256))
    apart = np.linalg.norm(table["rgb"][::20, None] / 255 - curve, axis=-1).min(axis=1)
    assert np.quantile(apart, 0.9) < 0.05  # with red and blue exchanged: above 0.3


def test_load_views_prefers_exr_and_falls_back_to_png(copied, expected):
    cameras, images = load_views(copied, "test")
    assert [camera.name for camera in cameras] == [camera.name for camera, _ in expected["test"]]
    np.testing.assert_array_equal(images, np.stack([image for _, image in expected["test"]]))
    for path in (copied / "test").glob("*.exr"):
        path.unlink()
    assert 0 < np.abs(load_views(copied, "test")[1] - images).max() < 1.01 / 255
    (copied / "test" / "test_001.png").unlink()
    refused(DataError, "test_001: no such image", load_views, copied, "test")
    refused(DataError, "transforms_check", load_views, copied, "check")


def test_half_rounds_to_half(vvgt, tmp_path, expected):
    vvgt.ok(*replaced(BASE, "--test-views", 0), "--half", "--format", "exr", "-o", tmp_path / "h")
    camera, image = expected["train"][1]
    read, _ = read_exr(tmp_path / "h" / "train" / f"{camera.name}.exr")
    np.testing.assert_array_equal(read, image.astype(np.float16).astype(np.float32))
    # without PNG there is nothing that COLMAP's images could name
    assert not any((tmp_path / "h" / name).exists() for name in ("images", "sparse", "transforms_test.json"))
    np.testing.assert_array_equal(load_views(tmp_path / "h")[1][1], read)


def test_several_functions_get_a_folder_each(vvgt, tmp_path):
    tf = tmp_path / "a.b.json"
    tf.write_text('{"points": [{"x": 0, "opacity": 0}, {"x": 1, "opacity": 1, "rgb": [1, 0, 0]}]}')
    how = "--tf magma --views 1 --test-views 0 --size 16 --format exr -o"
    vvgt.ok("render-views", VOLUME, "--tf", tf, how, tmp_path / "v")
    assert sorted(path.name for path in (tmp_path / "v").iterdir()) == ["a", "magma"]
    red, other = (load_views(tmp_path / "v" / name)[1][0] for name in ("a", "magma"))
    assert (red[..., 1:3] == 0).all()
    assert red[..., 0].max() > 0.1
    assert other[..., 2].max() > 0.1
    twice = vvgt.fails(2, "render-views", VOLUME, "--tf", "magma", "--tf", "magma", "-o", tmp_path / "w")
    assert "2 looks, named magma; expected one name each" in twice


def test_names_of_folders(tmp_path):
    names = ["bone", "Cool to Warm", "viridis:0,10", ".."]
    assert [path.name for path in folders_of(tmp_path, names)] == ["bone", "Cool_to_Warm", "viridis_0_10", "function"]
    assert folders_of(tmp_path, ["a"]) == [tmp_path]
    refused(UsageError, "a b and a_b would both go to", folders_of, tmp_path, ["a b", "a_b"])


def test_cameras_of_a_file_with_their_split(vvgt, tmp_path, made):
    document = json.loads((made / "transforms.json").read_text())
    for frame in document["frames"]:
        frame["file_path"] = frame["file_path"].replace("_0", ".0")
    document["test_filenames"] = [frame["file_path"] for frame in document["frames"][3:]]
    (tmp_path / "t.json").write_text(json.dumps(document))
    how = ("--cameras", tmp_path / "t.json", "--size 16 --format exr -o", tmp_path / "v")
    vvgt.ok("render-views", VOLUME, "--tf", TF, *how)
    cameras, images = load_views(tmp_path / "v")
    assert [camera.name for camera in cameras] == ["train_000", "train_001", "train_002"]  # a dot would be a suffix
    assert images.shape == (3, 16, 16, 4)
    assert len(load_views(tmp_path / "v", "test")[0]) == 2
    np.testing.assert_allclose(cameras[1].rotation, read_cameras(made / "transforms.json")[1].rotation, atol=1e-12)


def test_cameras_of_several_sizes_share_a_contact_sheet(vvgt, tmp_path):
    views = [
        look_at((0, -3, 1), width=40, height=16, name="wide"),
        look_at((3, 0, 1), width=16, height=400, name="tall"),
    ]
    (tmp_path / "t.json").write_text(transforms_json(views))
    call = ("render-views", VOLUME, "--tf", TF, "--cameras", tmp_path / "t.json", "-o", tmp_path / "v")
    vvgt.ok(*call)
    document = json.loads((tmp_path / "v" / "transforms.json").read_text())
    assert [(frame["w"], frame["h"]) for frame in document["frames"]] == [(40, 16), (16, 400)]
    assert "camera_angle_x" in json.loads((tmp_path / "v" / "transforms_train.json").read_text())["frames"][1]
    sheet = read_png(tmp_path / "v" / "contact.png")
    assert sheet.shape == (133, 40 + 4 + 40, 3)  # the tall one at a third
    assert all(tile.max() > 0.1 for tile in (sheet[:, :40], sheet[:, 44:]))
    refused(DataError, "2 sizes", load_views, tmp_path / "v")
    kept = json.loads((tmp_path / "t.json").read_text())
    kept["test_filenames"] = ["wide.png", "tall.png"]
    (tmp_path / "t.json").write_text(json.dumps(kept))
    assert "expected some training views" in vvgt(*call).error
    for frame, name in zip(kept["frames"], ("a.1.png", "a_1.png"), strict=True):
        frame["file_path"] = name
    (tmp_path / "t.json").write_text(json.dumps(kept))
    assert "two views become 'a_1'" in vvgt(*call).error


def test_orbit():
    views = camera_views("orbit", 5, 1, 20, radius=2.0)
    assert [view.stem for view in views] == [*(f"train/orbit_{i:03d}" for i in range(5)), "test/test_000"]
    heights = [view.camera.position[2] for view in views[:5]]
    np.testing.assert_allclose(heights, 2 * np.sin(np.radians(20)))


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--cameras", "nowhere.json"), 2, "--cameras nowhere.json: no such file"),
        (("--samples", "0"), 2, "--samples"),
        (("--samples", "3", "--renderer", "vtk"), 2, "one ray per pixel"),
        (("--shard", "3/2"), 2, "I from 1 to N"),
        (("--shard", "1/2", "--overwrite"), 2, "--overwrite with --shard"),
        (("--views", "0"), 2, "--views"),
        (("--background", "2", "0", "0"), 2, "--background"),
    ],
)
def test_wrong_calls_get_one_line_and_leave_nothing(vvgt, tmp_path, arguments, code, message):
    assert message in vvgt.fails(code, "render-views", VOLUME, *arguments, "-o", tmp_path / "v")
    assert not (tmp_path / "v").exists()


def test_options_that_a_file_of_cameras_decides(vvgt, tmp_path, made):
    for option in ("--views", "--test-views", "--fov", "--radius"):
        given = ("--cameras", made / "transforms.json", option, 3, "-o", tmp_path / "v")
        result = vvgt.fails(2, "render-views", VOLUME, *given)
        assert option in result
    (tmp_path / "file").write_text("")
    assert "is a file" in vvgt(*BASE, "-o", tmp_path / "file").error
    assert "no directory" in vvgt(*BASE, "-o", tmp_path / "a" / "b").error
