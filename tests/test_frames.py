"""From files of any orientation to Gaussians, views and back: the right place, the right way round and up."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests import anatomy
from tests.random_clouds import random_cloud, turns
from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.cameras.files import read_cameras, transforms_json
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.cameras.types import camera_in_box
from vvgt_cli.gaussians import Gaussians, PlyHeader, in_unit_frame, read_ply
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.images.files import read_png
from vvgt_cli.splat import render
from vvgt_cli.volume import read_volume

SMALL = ("--max-gaussians", 400, "--screen", 64, "-q")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tf.json").write_text(anatomy.TF)


def in_format(name: str, data: np.ndarray, affine: np.ndarray) -> Path:
    """The volume written as one of the formats."""
    path = Path(name.replace(" ", "-"))
    if name.startswith("nifti"):
        return anatomy.nifti(path, data, affine, name.split()[1])
    if name.startswith("nrrd"):
        return anatomy.nrrd(path.with_suffix(".nrrd"), data, affine, name.split()[1])
    if name == "dicom":
        return anatomy.dicom(path, data, affine)
    if name == "vti":
        return anatomy.vti(path.with_suffix(".vti"), data, affine)
    return anatomy.itk(path.with_suffix(".mha"), data, affine)


def clouds(cloud: Gaussians) -> np.ndarray:
    """(3, 3) centres of the balls' Gaussians, weighted with their mass."""
    mass = np.exp(cloud.log_scales.astype(float).sum(axis=1)) / (1 + np.exp(-cloud.opacity_logits.astype(float)))
    owner = np.linalg.norm(cloud.means[:, None] - anatomy.CENTRES, axis=-1).argmin(axis=1)
    return np.stack([np.average(cloud.means[owner == b], axis=0, weights=mass[owner == b]) for b in range(3)])


def init(vvgt, source: object, output: str, *options: object) -> tuple[Gaussians, PlyHeader]:
    vvgt.ok("init", source, "--tf", "tf.json", *SMALL, "-o", output, *options)
    return read_ply(output)


@pytest.mark.parametrize("grid", ["oblique", "sagittal left"])
def test_world_positions_are_the_same_in_every_format(vvgt, grid: str) -> None:
    """Against the Gaussians of the bare values, put where the grid's affine says: within 1e-3 mm.

    The centres of the balls' Gaussians are the balls' within 0.5 mm, a third of a voxel: so far as sampling goes.
    """
    affine = anatomy.place(anatomy.GRIDS[grid])
    data = anatomy.balls(affine)
    np.save("bare.npy", data)
    bare, _ = init(vvgt, "bare.npy", "bare.ply", "--spacing", *anatomy.ZOOMS)
    frame = replace(read_volume("bare.npy"), spacing=anatomy.ZOOMS).unit_frame()
    index = (bare.means.astype(float) + frame.half) / frame.step - 0.5
    expected = index @ affine[:3, :3].T + affine[:3, 3]
    formats = ["nifti sform", "nifti qform", "nrrd left-posterior-superior", "nrrd LAS", "mha", "vti"]
    for name in [*formats, *(["dicom"] if grid in anatomy.RIGHT_HANDED else [])]:
        cloud, header = init(vvgt, in_format(name, data, affine), f"{name}.ply", "--frame", "world")
        np.testing.assert_allclose(cloud.means, expected, atol=1e-3, err_msg=name)
        np.testing.assert_allclose(clouds(cloud), anatomy.CENTRES, atol=0.5, err_msg=name)
        np.testing.assert_allclose(header.affine, affine[:3].ravel(), atol=1e-4)
        assert (header.space, header.up) == ("none" if name == "vti" else "RAS", "none")
    lps, header = init(vvgt, "mha.mha", "lps.ply", "--frame", "world", "--space", "LPS")
    np.testing.assert_allclose(lps.means, expected * (-1, -1, 1), atol=1e-3)
    assert header.space == "LPS"


def test_a_sheared_volume_is_reported_and_its_balls_are_in_place(vvgt) -> None:
    affine = anatomy.place(anatomy.OBLIQUE)
    affine[:3, 2] += 0.8 * affine[:3, 1] / 2
    path = anatomy.nifti(Path("v"), anatomy.balls(affine), affine)
    result = vvgt("init", path, "--tf", "tf.json", "-o", "a.ply", *SMALL[:-1], "--frame", "world")
    assert "v: index axes 72.3 degrees apart (a tilted gantry?): Gaussians are sheared" in result.err, result.err
    cloud = read_ply("a.ply")[0]
    np.testing.assert_allclose(clouds(cloud), anatomy.CENTRES, atol=0.5)
    around = [covariance(cloud, anatomy.CENTRES[b]) for b in range(3)]  # balls stay round
    for found in around:
        np.testing.assert_allclose(found / np.trace(found) * 3, np.eye(3), atol=0.25)
    error = vvgt("render-views", path, "--tf", "tf.json", "-o", "views").error
    assert "no pinhole camera sees a sheared volume" in error


def covariance(cloud: Gaussians, centre: np.ndarray) -> np.ndarray:
    """Of all Gaussians within 8 mm, their own extents included."""
    near = cloud.take(np.flatnonzero(np.linalg.norm(cloud.means - centre, axis=1) < 8))
    turned, sigma = turns(near.quaternions), np.exp(near.log_scales.astype(float))
    own = np.einsum("kab,kb,kcb->kac", turned, sigma**2, turned)
    mass = sigma.prod(axis=1) / (1 + np.exp(-near.opacity_logits.astype(float)))
    away = near.means - np.average(near.means, axis=0, weights=mass)
    return np.average(own + away[:, :, None] * away[:, None, :], axis=0, weights=mass)


FRONT = look_at((0.0, 4.0, 0.0), width=80, height=80, fov=30, name="front")  # from anterior, head up


def letter_seen() -> np.ndarray:
    """(80, 80): the F as `FRONT` sees it, flat; 16 x 20 mm of a box whose longest edge is given by the x axis."""
    pixels_per_mm = FRONT.fy / 4 * 2 / max(np.array(anatomy.DIMS) * anatomy.ZOOMS)
    y, x = np.mgrid[:80, :80] + 0.5 - 40
    column, row = np.floor(x / pixels_per_mm / 4 + 2).astype(int), np.floor(y / pixels_per_mm / 4 + 2.5).astype(int)
    inside = (column >= 0) & (column < 4) & (row >= 0) & (row < 5)
    return np.where(inside, anatomy.LETTER[row.clip(0, 4), column.clip(0, 3)], 0).astype(float)


def assert_reads_right(picture: np.ndarray, what: str, least: float = 0.8) -> None:
    """More like the F than like its mirror image, or the F upside down."""
    alike = [np.corrcoef(picture.ravel(), expected.ravel())[0, 1] for expected in poses()]
    assert alike[0] > least, (what, alike)
    assert max(alike[1:]) < alike[0] - 0.15, (what, alike)


def poses() -> list[np.ndarray]:
    seen = letter_seen()
    return [seen, seen[:, ::-1], seen[::-1], seen[::-1, ::-1]]


@pytest.mark.parametrize("grid", ["axial", "oblique left"])
def test_a_letter_is_never_mirrored(vvgt, grid: str) -> None:
    affine = anatomy.place(anatomy.GRIDS[grid])
    anatomy.nifti(Path("f"), anatomy.letter(affine), affine)
    Path("front.json").write_text(transforms_json([FRONT]))
    for frame in ("unit", "world"):
        _, header = init(vvgt, "f.nii", f"{frame}.ply", "--frame", frame)
        vvgt.ok("render", f"{frame}.ply", "--camera", "front.json", "-o", frame, "-q")
        assert_reads_right(read_png(f"{frame}/front.png")[..., 3], frame)
        assert header.up == ("z" if frame == "unit" else "none")
    # as SuperSplat shows it: PLY (x, y, z) at (-x, -y, z), +y up; the eye before it, at the patient's front
    shown = transform(read_ply("unit.ply")[0], np.diag([-1.0, -1, 1]))
    eye = look_at((0.0, 0.0, 4.0), up=(0.0, 1.0, 0.0), width=80, height=80, fov=30)
    assert_reads_right(render(shown, eye)[..., 3], "viewer")
    # the reference renderer, and the points that trainers start from
    options = ("--tf", "tf.json", "--cameras", "front.json", "--format", "both", "-o", "views", "-q")
    vvgt.ok("render-views", "f.nii", *options)
    assert_reads_right(read_png("views/train/front.png")[..., 3], "reference")
    assert_reads_right(splatted(read_points(Path("views/points3d.ply"))), "points", 0.5)


def read_points(path: Path) -> np.ndarray:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    kind = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    return np.frombuffer(body, kind, count)["xyz"].astype(float)


def splatted(points: np.ndarray) -> np.ndarray:
    """(80, 80): whether there is a point behind a pixel or beside it."""
    inside = points @ FRONT.rotation.T + FRONT.translation
    x, y = (inside[:, :2] / inside[:, 2:] * FRONT.fx + 40).astype(int).T
    picture = np.zeros((80, 80))
    for a in (-1, 0, 1):
        for b in (-1, 0, 1):
            picture[(y + a).clip(0, 79), (x + b).clip(0, 79)] = 1
    return picture


@pytest.mark.parametrize("up", ["superior", "left", "-x"])
def test_up_in_viewers(vvgt, up: str) -> None:
    affine = anatomy.place(anatomy.OBLIQUE * (1, 1, -1))
    anatomy.nifti(Path("b"), anatomy.balls(affine), affine)
    plain, _ = init(vvgt, "b.nii", "plain.ply", "--up", "none")
    for space in ("RAS", "LPS"):
        cloud, header = init(vvgt, "b.nii", f"{space}.ply", "--up", up, "--space", space)
        towards = {"superior": (0, 0, 1), "inferior": (0, 0, -1), "left": (-1, 0, 0), "anterior": (0, 1, 0)}
        direction = np.array(towards.get(up, (-1, 0, 0)))
        if space == "LPS" and up == "-x":
            direction = -direction  # an axis of the world, which is another
        np.testing.assert_allclose(-cloud.means[:, 1], plain.means @ direction, atol=1e-5)  # PLY -y is up
        back = in_unit_frame(cloud, header)
        signs = (1, 1, 1) if space == "RAS" else (-1, -1, 1)
        np.testing.assert_allclose(back.means, plain.means * signs, atol=1e-5)


@pytest.mark.parametrize("name", ["nifti sform", "dicom", "vti"])
def test_the_head_is_up_by_default(vvgt, name: str) -> None:
    """Superior is PLY -y, which viewers show upwards, in both spaces; in the world frame nothing is turned."""
    affine = anatomy.place(anatomy.CORONAL)
    path = in_format(name, anatomy.balls(affine), affine)
    plain, _ = init(vvgt, path, "plain.ply", "--up", "none")
    cloud, header = init(vvgt, path, "auto.ply")
    world = init(vvgt, path, "world.ply", "--frame", "world")[1]
    if name == "vti":
        assert (header.up, world.up) == ("none", "none")
        np.testing.assert_array_equal(cloud.means, plain.means)
        return
    assert (header.up, world.up) == ("z", "none")
    np.testing.assert_allclose(-cloud.means[:, 1], plain.means[:, 2], atol=1e-6)
    lps, header = init(vvgt, path, "lps.ply", "--space", "LPS")
    np.testing.assert_allclose(lps.means, cloud.means * (-1, 1, -1), atol=1e-5)  # half a turn about the way up
    assert header.up == "z"


@pytest.mark.parametrize("up", ["auto", "left"])
def test_an_orbit_circles_the_way_up(vvgt, up: str) -> None:
    """Eyes lie 20 degrees above the plane that the way up is normal to, and the tops of pictures that way."""
    affine = anatomy.place(anatomy.AXIAL)
    anatomy.nifti(Path("b"), anatomy.balls(affine), affine)
    init(vvgt, "b.nii", "b.ply", "--up", up)
    vvgt.ok("render", "b.ply", "--orbit", 5, "--size", 32, "-o", "turn", "-q")
    towards = np.array({"inferior": (0, 0, -1), "left": (-1, 0, 0), "y": (0, 1, 0)}.get(up, (0, 0, 1)), float)
    for camera in read_cameras("turn/transforms.json"):
        assert camera.position @ towards == pytest.approx(3 * np.sin(np.radians(20)), abs=1e-6)
        assert -camera.rotation[1] @ towards == pytest.approx(np.cos(np.radians(20)), abs=1e-6)  # camera -y is up


def test_up_needs_a_space_for_directions_of_the_body(vvgt) -> None:
    np.save("bare.npy", anatomy.balls(anatomy.place(anatomy.AXIAL)))
    result = vvgt("init", "bare.npy", "--tf", "tf.json", "-o", "a.ply", "--up", "superior")
    assert "--up superior: the volume states no anatomical space; try x, -x" in result.error
    assert result.code == 2
    assert init(vvgt, "bare.npy", "bare.ply")[1].up == "none"


def evaluated(vvgt, ply: str, volume: str, *options: str) -> dict:
    how = "--tf tf.json --screen 48 --no-conditions --step 0.5 --json"
    result = vvgt.ok("evaluate", ply, "--volume", volume, how, *options)
    return json.loads(result.out)["scores"] | {"said": result.err}


def test_evaluate_reads_every_frame_space_and_turn_back(vvgt) -> None:
    affine = anatomy.place(anatomy.GRIDS["oblique left"])
    data = anatomy.letter(affine) + anatomy.balls(affine)
    anatomy.nifti(Path("v"), data, affine)
    np.save("bare.npy", data)
    init(vvgt, "bare.npy", "bare.ply", "--spacing", *anatomy.ZOOMS)
    bare = evaluated(vvgt, "bare.ply", "bare.npy", "--spacing", *map(str, anatomy.ZOOMS))
    for k, options in enumerate(
        [(), ("--frame", "world"), ("--up", "none"), ("--frame", "world", "--up", "left", "--space", "LPS"),
         ("--space", "LPS"), ("--up", "none", "--no-comments")]
    ):  # fmt: skip
        init(vvgt, "v.nii", f"{k}.ply", *options)
        scores = evaluated(vvgt, f"{k}.ply", "v.nii")
        assert scores["psnr"] == pytest.approx(bare["psnr"], abs=2e-3), options
        assert "another volume" not in scores["said"]
    other = anatomy.nifti(Path("other"), data, anatomy.place(anatomy.CORONAL))
    assert "its header's affine differs from that of other" in evaluated(vvgt, "0.ply", str(other))["said"]


def test_no_comments_says_what_will_not_be_known(vvgt) -> None:
    affine = anatomy.place(anatomy.AXIAL)
    anatomy.nifti(Path("v"), anatomy.balls(affine), affine)
    result = vvgt("init", "v.nii", "--tf", "tf.json", "-o", "a.ply", *SMALL[:-1], "--no-comments")
    assert "--no-comments: the file will not record that it is in the unit frame with up z" in result.err


def test_refined_by_views_of_a_left_handed_volume(vvgt) -> None:
    """Views, `.ply` and refinement agree on where things are: the start is near, and steps bring it nearer."""
    affine = anatomy.place(anatomy.OBLIQUE * (1, -1, 1))
    anatomy.nifti(Path("v"), anatomy.letter(affine) + anatomy.balls(affine), affine)
    views = ("--views", 8, "--test-views", 2, "--size", 48, "-o", "views", "-q")
    vvgt.ok("render-views", "v.nii", "--tf", "tf.json", *views)
    init(vvgt, "v.nii", "in.ply")
    vvgt.ok("optimize", "in.ply", "--views", "views", "--steps", 12, "-o", "out.ply", "--report", "r.json")
    assert json.loads(Path("r.json").read_text())["scores"]["psnr"] > 24
    before, after = (read_ply(name)[1] for name in ("in.ply", "out.ply"))
    assert (after.affine, after.space, after.up, after.centre) == (before.affine, "RAS", "z", before.centre)
    assert evaluated(vvgt, "out.ply", "v.nii")["psnr"] > evaluated(vvgt, "in.ply", "v.nii")["psnr"]


def test_preview_is_the_right_way_round_and_up(vvgt) -> None:
    """The same world on a straight grid and on a left-handed, sagittal one: one preview, but for the sampling."""
    pictures = []
    for name, axes in (("straight", anatomy.AXIAL), ("left", np.array([[0.0, 0, 1], [1, 0, 0], [0, -1, 0]]))):
        zooms = np.diag(axes.T @ np.diag(anatomy.ZOOMS) @ axes)
        affine = np.eye(4)
        affine[:3, :3] = axes * zooms
        shape = np.abs(axes.T @ anatomy.DIMS).astype(int)
        affine[:3, 3] = np.array([12.0, -34, 56]) - affine[:3, :3] @ (shape - 1) / 2
        k, j, i = np.mgrid[: shape[2], : shape[1], : shape[0]]
        world = np.stack([i, j, k], -1) @ affine[:3, :3].T + affine[:3, 3]
        straight = anatomy.place(anatomy.AXIAL)
        index = np.round((world - straight[:3, 3]) / anatomy.ZOOMS).astype(int)
        both = anatomy.letter(straight) + anatomy.balls(straight)
        anatomy.nifti(Path(name), both[index[..., 2], index[..., 1], index[..., 0]], affine)
        options = ("--max-gaussians", 400, "--screen", 64, "--steps", 0, "--preview", f"{name}.png")
        options += ("-o", f"{name}.ply")
        vvgt.ok("convert", f"{name}.nii", "--tf", "tf.json", *options, "-q")
        pictures.append(read_png(f"{name}.png"))
    reference = slice(0, 64)
    np.testing.assert_allclose(pictures[0][:, reference], pictures[1][:, reference], atol=0.02)
    assert np.abs(pictures[0][:, 64:128] - pictures[1][:, 64:128]).mean() < 0.02


@pytest.mark.parametrize("matrix", [anatomy.OBLIQUE, anatomy.OBLIQUE * (1, -1, 1), -np.eye(3)])
def test_a_turned_scene_is_seen_by_a_turned_camera(matrix: np.ndarray) -> None:
    cloud = random_cloud(60, 3, 0.05, 0.6, (1, 1.2))
    camera: Camera = replace(default_views("train", size=64)[5], cx=30.0, cy=35.0)
    expected = render(transform(cloud, matrix), camera)
    inside, mirrored = camera_in_box(camera, matrix)
    seen = render(cloud, inside)
    assert mirrored == (np.linalg.det(matrix) < 0)
    np.testing.assert_allclose(seen[:, ::-1] if mirrored else seen, expected, atol=2e-4)


@pytest.mark.parametrize(
    "comment",
    ["vvgt space RPS", "vvgt space", "vvgt affine 1 0 0 0", "vvgt affine " + "0 " * 12, "vvgt affine " + "nan " * 12],
)
def test_comments_that_cannot_be_are_refused(vvgt, comment: str) -> None:
    np.save("bare.npy", anatomy.balls(anatomy.place(anatomy.AXIAL)))
    init(vvgt, "bare.npy", "a.ply")
    head, _, body = Path("a.ply").read_bytes().partition(b"end_header\n")
    lines = [line for line in head.split(b"\n") if not line.startswith(f"comment {comment[:9]}".encode())]
    Path("a.ply").write_bytes(b"\n".join([*lines[:-1], f"comment {comment}".encode(), b"end_header\n"]) + body)
    assert "expected one that vvgt writes" in vvgt("info", "a.ply").error


def test_info_says_axes_and_handedness(vvgt) -> None:
    affine = anatomy.place(anatomy.SAGITTAL * (1, 1, -1))
    anatomy.nifti(Path("v"), anatomy.balls(affine), affine)
    init(vvgt, "v.nii", "v.ply")
    for name in ("v.nii", "v.ply"):
        text = vvgt("info", name).out.decode()
        assert "i A-P, j S-I, k R-L" in text
        assert "handedness" in text
        facts = json.loads(vvgt("info", name, "--json").out)
        assert (facts["space"], facts["handedness"]) == ("RAS", "left")
        np.testing.assert_allclose(facts["affine"], affine[:3], atol=1e-4)
    assert json.loads(vvgt("info", "v.nii", "--space", "LPS", "--json").out)["space"] == "LPS"
