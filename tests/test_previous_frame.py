"""Frames of a series that go on from the one before: what stays stays bit for bit, in files, pages and pictures."""

import base64
import json
import re
import struct
from dataclasses import replace
from pathlib import Path

import nibabel
import numpy as np
import pytest

from tests.headers import uncertified
from tests.processes import replaced
from tests.random_clouds import random_cloud
from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.blocks import BLOCK
from vvgt_cli.conversion.changes import EDGE, REACH, Changes, changes
from vvgt_cli.conversion.convert import convert_one
from vvgt_cli.conversion.previous_frame import PreviousFrame, RememberedViews
from vvgt_cli.conversion.request import ConvertRequest, FitOptions
from vvgt_cli.dvr import RenderSettings
from vvgt_cli.field.field import Resident
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply
from vvgt_cli.gaussians.formats.gsply_files import read_compressed_ply
from vvgt_cli.gaussians.formats.page_file import patch, stored_frames
from vvgt_cli.gaussians.formats.splats import splats_of
from vvgt_cli.look import PiecewiseOpacity
from vvgt_cli.look.readers.minimal import read
from vvgt_cli.refine import OptimizeOptions, optimize
from vvgt_cli.splat import render
from vvgt_cli.splat.reference import covariances
from vvgt_cli.volume import Volume

N = 40
TF = {"points": [
    {"x": 10, "rgb": [0.2, 0.4, 1], "opacity": 0}, {"x": 60, "rgb": [1, 0.6, 0.2], "opacity": 0.1},
    {"x": 100, "rgb": [1, 1, 0.9], "opacity": 0.3},
]}  # fmt: skip
HOW = ("--max-gaussians", "400", "--screen", "96", "--steps", "30")


def patched(base: bytes, runs: bytes) -> bytes:
    """Apply a `patch` to ``base``."""
    out, at = bytearray(base), 0
    while at < len(runs):
        place, length = struct.unpack_from("<II", runs, at)
        out[place : place + length] = runs[at + 8 : at + 8 + length]
        at += 8 + length
    return bytes(out)


def body(radius: float) -> np.ndarray:
    """A ball that stands still, and a smaller one of that radius, float32 (N, N, N)."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, N)] * 3, indexing="ij")
    soft = lambda d: 100 / (1 + np.exp(np.clip(20 * d, -50, 50)))  # noqa: E731
    still = soft(np.sqrt((x + 0.45) ** 2 + y**2 + z**2) - 0.4)
    return np.maximum(still, soft(np.sqrt((x - 0.6) ** 2 + y**2 + z**2) - radius)).round().astype(np.float32)


@pytest.fixture
def beat(tmp_path: Path) -> Path:
    """Four frames, the last as the third, and a function."""
    for k, radius in enumerate((0.2, 0.208, 0.216, 0.216)):
        np.save(tmp_path / f"v_{k}.npy", body(radius))
    (tmp_path / "tf.json").write_text(json.dumps(TF))
    return tmp_path


def sources(folder: Path, *values: np.ndarray, **more) -> list:
    (folder / "tf.json").write_text(json.dumps(TF))
    for k, one in enumerate(values):
        np.save(folder / f"s_{k}.npy", one)
    whole = load(SourceRequest(str(folder / "s_0.npy"), tf=str(folder / "tf.json"), **more))
    others = [load(SourceRequest(str(folder / f"s_{k}.npy"), tf=str(folder / "tf.json"), **more)) for k in (0, 1)]
    return [replace(one, statistics=whole.statistics) for one in others]


@pytest.mark.parametrize(
    ("place", "value", "seen"),
    [((20, 21, 8), 90, True), ((20, 21, 8), 60.0004, False), ((3, 3, 3), 8, False), ((3, 3, 3), 12, True)],
    ids=["inside", "by nearly nothing", "below the function", "into the function"],
)
def test_blocks_that_differ_are_found(tmp_path, place, value, seen):
    values = np.where(body(0.2) > 50, 60, 0).astype(np.float32)
    other = values.copy()
    other[place] = value
    found = changes(*sources(tmp_path, values, other))
    assert found.blocks.any() == seen
    if seen:  # a voxel and its neighbours
        expected = np.zeros_like(found.blocks)
        for voxel in np.ndindex(3, 3, 3):
            expected[tuple((np.array(place) + voxel - 1) // EDGE)] = True
        np.testing.assert_array_equal(found.blocks, expected)


def test_a_change_beside_what_is_seen_counts(tmp_path):
    """Values between voxels are interpolated: the surface moves where the empty voxel beside it changes."""
    values = np.zeros((N, N, N), np.float32)
    values[10:30, 10:30, 10:30] = 60
    other = values.copy()
    other[20, 20, 30] = 9  # shown by nothing itself
    assert changes(*sources(tmp_path, values, other)).blocks.any()
    other = values.copy()
    other[20, 20, 33] = 9
    assert not changes(*sources(tmp_path, values, other)).blocks.any()


def test_what_is_compared_at_once_changes_nothing(tmp_path, monkeypatch):
    two = sources(tmp_path, body(0.2), body(0.3))
    whole = changes(*two).blocks
    assert 0 < whole.sum() < whole.size
    monkeypatch.setattr("vvgt_cli.conversion.changes.AT_ONCE", N * N)
    np.testing.assert_array_equal(changes(*two).blocks, whole)


def some_changes() -> Changes:
    blocks = np.random.default_rng(5).random((7, 8, 9)) > 0.97
    return Changes(blocks, np.array([0.9, 0.8, 0.7]), 2 * np.array([0.9, 0.8, 0.7]) / [9, 8, 7])


def test_gaussians_that_meet_them():
    found, g = some_changes(), random_cloud(300, 0, 0.05, 0.5, (0.5, 1))
    reach = REACH * np.sqrt(np.einsum("kii->ki", covariances(g)))
    expected = np.zeros(len(g), bool)
    for z, y, x in np.argwhere(found.blocks):
        low = np.array([x, y, z]) * found.edge - found.half
        expected |= ((g.means + reach >= low) & (g.means - reach < low + found.edge)).all(axis=1)
    assert 20 < expected.sum() < 280
    np.testing.assert_array_equal(found.meet(g), expected)


def test_pixels_that_show_them():
    found = some_changes()
    rng = np.random.default_rng(0)
    corner = np.argwhere(found.blocks)[:, ::-1].repeat(50, axis=0)
    points = (corner + rng.random(corner.shape)) * found.edge - found.half
    for camera in default_views("test", 4, size=200):
        shown = found.seen_by(camera)
        assert shown.mean() < 0.7
        x, y, z = camera.rotation @ points.T + camera.translation[:, None]
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (u >= 0) & (u < 200) & (v >= 0) & (v < 200)
        assert shown[(v[inside] // BLOCK).astype(int), (u[inside] // BLOCK).astype(int)].all()


def test_pictures_of_the_next_frame_are_as_drawn_again(tmp_path):
    first, second = (Resident(one) for one in sources(tmp_path, body(0.2), body(0.26)))
    kept = RememberedViews(200, first)
    camera, how = default_views("test", 5, size=190)[3], RenderSettings(samples=1)
    kept.view(camera, how)
    found = changes(first.source, second.source)
    assert 0.02 < found.blocks.mean() < 0.2
    kept.invalidate(found)
    drawn = []

    class Counted:
        def view(self, camera, settings, blocks):
            drawn.append(blocks)
            return second.view(camera, settings, blocks)

    kept.views = Counted()
    np.testing.assert_array_equal(kept.view(camera, how), second.view(camera, how))
    assert 0 < len(drawn[0].numbers) < 0.8 * 144
    kept.view(camera, how)
    assert len(drawn) == 1


def test_descent_moves_what_is_free():
    g = random_cloud(60, 0, 0.05, 0.3, (0.3, 0.9))
    cameras = default_views("train", 4, size=48)
    images = np.stack([render(replace(g, colors=1 - g.colors), camera) for camera in cameras])
    free = np.arange(60) % 3 == 0
    found, _ = optimize(g, cameras, images, OptimizeOptions(steps=6), free=free)
    np.testing.assert_array_equal((found.colors != g.colors).any(axis=1), free)
    np.testing.assert_allclose(covariances(found)[~free], covariances(g)[~free], rtol=1e-4, atol=1e-9)


def test_what_is_right_already_is_not_moved_with_what_is_wrong():
    g = random_cloud(600, 0, 0.02, 0.1, (0.3, 0.9))
    wrong = np.arange(600) % 30 == 0
    other = replace(g, colors=np.where(wrong[:, None], 1 - g.colors, g.colors))
    cameras = default_views("train", 6, size=48)
    images = np.stack([render(other, camera) for camera in cameras])
    found, _ = optimize(g, cameras, images, OptimizeOptions(steps=30), free=np.ones(600, bool))
    moved = np.abs(found.colors - g.colors).mean(axis=1)
    assert np.median(moved[~wrong]) < 0.1 * np.median(moved[wrong])


def test_what_comes_back_moves_back(vvgt, beat, monkeypatch):
    """The views of the third frame were last drawn of the first, which shows the same, and those of the fifth of the
    second, as none is drawn of the fourth; the Gaussians do not."""
    monkeypatch.setattr("vvgt_cli.conversion.previous_frame.VIEWS", 12)
    for k, radius in enumerate((0.2, 0.208, 0.2, 0.2, 0.208)):
        np.save(beat / f"v_{k}.npy", body(radius))
    vvgt.ok("convert", beat / "v_*.npy", "--tf", beat / "tf.json", *HOW, "-o", beat / "f_{}.ply")
    index = json.loads((beat / "f_index.json").read_text())["files"]
    assert [row.get("moved", 0) > 20 for row in index] == [False, True, True, False, True]
    assert index[2]["psnr"] > index[0]["psnr"] - 0.1
    assert index[4]["psnr"] > index[1]["psnr"] - 0.1


def test_patches():
    base = np.random.default_rng(2).integers(0, 256, 5000, np.uint8)
    other = base.copy()
    for at in (0, 700, 710, 3000, 4990):
        other[at : at + 10] += 1
    runs = patch(base.tobytes(), other.tobytes())
    assert len(runs) < 120
    assert patched(base.tobytes(), runs) == other.tobytes()
    assert patch(base.tobytes(), base.tobytes()) == b""


def rows(file: Path) -> np.ndarray:
    """(K, n) of a file's columns."""
    g: Gaussians = read_ply(str(file))[0]
    return np.column_stack([array.reshape(len(g), -1) for array in g.arrays().values()])


def test_frames_share_what_stands_still_whatever_their_comments_say():
    gaussians = random_cloud(600, 1, 0.05, 0.3, (0.0, 1.0))
    clouds = [(f"{k}", splats_of(gaussians, PlyOptions(function="f" * n))) for k, n in enumerate((3, 12, 5, 12))]
    held = stored_frames(clouds)
    assert [frame.whole for frame in held] == [None, 0, 0, 0]
    for (name, splats), (content, _) in zip(clouds[1:], held[1:], strict=True):
        found = read_compressed_ply(patched(held[0].content, content), name)
        assert found.comments[: len(splats.comments)] == splats.comments
        assert len(content) < 1000


@pytest.mark.parametrize(
    "more", [(), pytest.param(("--light", "headlight"), marks=pytest.mark.long), ("--blocks", "16")]
)
def test_what_stands_still_stays_bit_for_bit(vvgt, beat, more):
    run = ("convert", beat / "v_*.npy", "--tf", beat / "tf.json", *HOW, *more)
    vvgt.ok(*run, "-o", beat / "f_{}.ply")
    files = [rows(beat / f"f_{k}.ply") for k in range(4)]
    index = json.loads((beat / "f_index.json").read_text())["files"]
    assert "moved" not in index[0]
    for k in (1, 2, 3):
        differ = (files[k] != files[k - 1]).any(axis=1)
        assert differ.sum() == index[k]["moved"]
        still = files[k - 1][:, 0] < -0.2  # the other ball
        assert not differ[still].any(), files[k - 1][differ & still][:, :6]
        assert still.sum() > 50
    assert index[3]["moved"] == 0
    assert 0 < max(row["moved"] for row in index[1:]) < 0.7 * len(files[0])
    vvgt.ok("convert", beat / "v_2.npy", "--tf", beat / "tf.json", *HOW, *more, "-o", beat / "a.ply")
    alone = json.loads((beat / "f_index.json").read_text())
    assert alone["files"][2]["psnr"] > alone["files"][0]["psnr"] - 0.6
    vvgt.ok(*run, "-o", beat / "f.html")
    check_page(beat)


def check_page(folder: Path) -> None:
    """The page holds what the files do, and the frames that go on as little as differs."""
    text = (folder / "f.html").read_text("utf-8")
    frames = json.loads(re.search(r'id="scene">(.*?)</script>', text, re.S)[1])["frames"]
    held = [base64.b64decode(re.search(rf'id="{frame["element"]}">([^<]*)</script>', text)[1]) for frame in frames]
    assert [frame.get("whole") for frame in frames] == [None, 0, 0, 0]
    whole = [held[0], *(patched(held[0], runs) for runs in held[1:])]
    for k, content in enumerate(whole):
        found = np.sort(read_compressed_ply(content, "page").logits)
        own = np.sort(read_ply(str(folder / f"f_{k}.ply"))[0].opacity_logits)
        assert np.abs(1 / (1 + np.exp(-found)) - 1 / (1 + np.exp(-own))).max() < 1 / 200
    assert whole[2].split(b"end_header\n")[1] == whole[3].split(b"end_header\n")[1]  # certificates differ
    assert len(held[1]) < len(held[0])


def test_what_frames_leave_to_later_ones_is_in_the_memory_that_is_asked_for(beat, monkeypatch):
    asked = []

    def check(plan, pictures=0, beside=None):
        if beside is not None:  # not after the closed form
            asked.append(pictures + beside(plan.workload))

    monkeypatch.setattr("vvgt_cli.conversion.fitting.check_memory", check)
    start = PreviousFrame(96)
    for k in (0, 1, 2, 0):
        source = SourceRequest(str(beat / f"v_{k}.npy"), tf=str(beat / "tf.json"))
        request = ConvertRequest(source=source, fit=FitOptions(400, 96, steps=100), output=str(beat / f"{k}.ply"))
        convert_one(replace(request, overwrite=True), warm=start)
    turns = len(start._last.shown)
    assert turns > 3
    pictures = sum(picture.nbytes for _, picture, _ in start._pictures._kept.values())
    a_set = sum(array.nbytes for array in start._last.gaussians.arrays().values())
    assert len(start._last.gaussians) == 400
    assert 1 <= asked[0] / (pictures + (turns + 1) * a_set) < 1.1
    assert asked[1] < asked[0] - pictures
    assert asked[1] - asked[3] == 2 * a_set  # those of frames 1 and 2 are there by then


def test_no_more_steps_than_were_asked_for(vvgt, beat):
    run = ("convert", beat / "v_[01].npy", "--tf", beat / "tf.json", *HOW[:-1], "3", "-o", beat / "f_{}.ply")
    assert "differences " in vvgt.ok(*run, "--report", beat / "f_{}.json").err
    assert json.loads((beat / "f_1.json").read_text())["refinement"]["steps"] <= 3


def test_a_frame_that_shows_something_else_is_converted_by_itself(vvgt, beat):
    np.save(beat / "v_1.npy", body(0.2)[:, :, ::-1])
    done = vvgt.ok("convert", beat / "v_[01].npy", "--tf", beat / "tf.json", *HOW, "-o", beat / "f_{}.ply")
    assert "skipped: starting from the previous frame" in done.err
    vvgt.ok("convert", beat / "v_1.npy", "--tf", beat / "tf.json", *HOW, "-o", beat / "a.ply")
    assert uncertified(beat / "a.ply") == uncertified(beat / "f_1.ply")


@pytest.mark.parametrize(
    "more",
    [("--shard", "1/1"), ("--light", "sun", "--steps", "4")],
    ids=lambda more: more[0],
)
def test_what_cannot_go_on_is_converted_frame_by_frame(vvgt, beat, more):
    """A part of a series (here all of it) goes on too; the others have each frame by itself."""
    for file in ("v_2.npy", "v_3.npy"):
        (beat / file).unlink()
    done = vvgt.ok(
        "convert", beat / "v_*.npy", "--tf", beat / "tf.json", *replaced(HOW, *more), "-o", beat / "f_{}.ply"
    )
    assert ("differences " in done.err) == (more[0] == "--shard")


def test_a_label_that_disappears_is_a_change(tmp_path):
    one = np.zeros((N, N, N), np.uint8)
    one[5:20, 5:35, 5:35] = 1
    both = one.copy()
    both[25:35, 10:30, 10:30] = 2
    np.save(tmp_path / "one.npy", one)
    np.save(tmp_path / "both.npy", both)
    a, b = (load(SourceRequest(str(tmp_path / f"{name}.npy"), labels="auto")) for name in ("both", "one"))
    assert changes(a, b).blocks.sum() == changes(b, a).blocks.sum() > 0


def test_scalars_beside_a_layer_are_compared_as_alone(tmp_path):
    """Between voxels, by data values, over the range of all frames."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, N)] * 3, indexing="ij")
    values = np.where(np.sqrt(x**2 + y**2 + z**2) < 0.5, 100, 0).astype(np.float32)
    layer = Volume(np.ones((N, N, N), np.uint8), name="layer")
    nodes = PiecewiseOpacity(np.array([40.0, 50, 60]), np.array([0.0, 0.9, 0]))
    band = replace(read({"name": "t", **TF}, "tf"), opacity_nodes=nodes)
    pairs = (
        (Volume(values), Volume(np.roll(values, 3, 2))),  # nothing at voxels is within the band
        (Volume(values, slope=0.5), Volume(values, slope=0.7)),
    )
    for pair in pairs:
        found = []
        for layers in ((), (SourceRequest(layer, tf="gray"),)):
            whole = load(SourceRequest(pair[0], tf=band)).statistics
            a, b = (load(SourceRequest(one, tf=band, statistics=(whole,), layers=layers)) for one in pair)
            found.append(changes(a, b).blocks)
        assert found[0].any()
        np.testing.assert_array_equal(*found)


def test_what_fades_below_a_later_frames_range_is_a_change(tmp_path):
    shell = {"points": [{"x": x, "rgb": [1, 0, 0], "opacity": o} for x, o in ((15, 0), (20, 0.1), (25, 0), (75, 0))]}
    shell["points"].append({"x": 80, "rgb": [0, 0, 1], "opacity": 0.9})
    (tmp_path / "two.json").write_text(json.dumps(shell))
    first = np.full((N, N, N), 40, np.float32)
    first[10:30, 10:30, 10:30] = 20
    later = first.copy()
    first[15:25, 15:25, 15:25], later[15:25, 15:25, 15:25] = 100, 50
    whole = load(SourceRequest(Volume(first), tf=str(tmp_path / "two.json"))).statistics
    a, b = (load(SourceRequest(Volume(v), tf=str(tmp_path / "two.json"), statistics=(whole,))) for v in (first, later))
    assert changes(a, b).blocks.any()


def test_frames_beneath_a_finer_layer_are_converted_by_themselves(vvgt, tmp_path):
    for k, one in enumerate((body(0.2), body(0.3)[:, ::-1])):
        np.save(tmp_path / f"v_{k}.npy", one)
    (tmp_path / "tf.json").write_text(json.dumps(TF))
    fine = nibabel.Nifti1Image(np.ones((4, 4, 4), np.uint8), np.diag([0.5, 0.5, 0.5, 1]))
    nibabel.save(fine, tmp_path / "fine.nii")
    how = ("--layer", f"{tmp_path / 'fine.nii'},labels=auto", *HOW[:-1], "4", "-o", tmp_path / "o_{}.ply")
    vvgt.ok("convert", tmp_path / "v_*.npy", "--tf", tmp_path / "tf.json", *how)
    first, second = (read_ply(tmp_path / f"o_{k}.ply")[0] for k in (0, 1))
    assert first.means.shape != second.means.shape or not np.array_equal(first.means, second.means)


def test_a_frame_without_any_visible_label_is_skipped(vvgt, tmp_path):
    for k, number in enumerate((3, 1, 3)):
        one = np.zeros((16, 16, 16), np.uint8)
        one[4:12, 4:12, 4:12], one[0, 0, 0] = number, 5
        np.save(tmp_path / f"lab{k}.npy", one)
    table = {str(k): {"name": f"n{k}", "color": [1, 0, 0], "opacity": int(k == 3)} for k in (1, 3, 5)}
    (tmp_path / "lab.json").write_text(json.dumps(table))
    how = ("--labels", tmp_path / "lab.json", "--steps", 0, "--max-gaussians", 200, "--screen", 64)
    done = vvgt.ok("convert", tmp_path / "lab*.npy", *how, "-o", tmp_path / "o_{}.ply")
    assert "skipped: lab1.npy" in done.err
    assert sorted(path.name for path in tmp_path.glob("o_*.ply")) == ["o_0.ply", "o_2.ply"]
    assert json.loads((tmp_path / "o_index.json").read_text())["empty"] == [1]
