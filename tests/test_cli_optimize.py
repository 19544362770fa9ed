"""`vvgt optimize`: nearer to the views, never worse, stopped by budgets and by Ctrl-C with a valid file."""

import json
import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from tests.processes import start
from vvgt_cli.cameras.files import read_cameras
from vvgt_cli.commands.main import run
from vvgt_cli.commands.optimize import load_sets
from vvgt_cli.gaussians import PlyOptions, read_ply, write_ply
from vvgt_cli.images import write_exr

SCENE = ("example:blob:16", "--tf", "viridis")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """`views` (9 to train on, 2 to test) and `in.ply`; to be read only."""
    folder = tmp_path_factory.mktemp("optimize")
    small = ("--views", "9", "--test-views", "2", "--size", "32", "--format", "exr")
    assert run(["render-views", *SCENE, *small, "-o", str(folder / "views"), "-q"]) == 0
    shape = ("--screen", "32", "--max-gaussians", "100", "--up", "z", "--sh-degree", "1", "--frame", "world")
    assert run(["init", *SCENE, *shape, "-o", str(folder / "in.ply"), "-q"]) == 0
    return folder


@pytest.mark.parametrize("degree", [0, 2])
def test_the_degree_that_is_asked_for_is_refined_and_written(degree, folder, call):
    """IN.ply is padded to degree 1."""
    result = call("--steps", 30, "--sh-degree", degree, "--report", "r.json")
    assert result.code == 0, result.err
    assert json.loads(Path("r.json").read_text())["options"]["sh_degree"] == degree
    gaussians, header = read_ply("out.ply")
    assert header.sh_degree == gaussians.degree == degree
    again = run(["optimize", "out.ply", "--views", str(folder / "views"), "--steps", "0", "-qo", "again.ply"])
    assert again == 0  # turned back from world, z up, and placed there again
    for field, array in read_ply("again.ply")[0].arrays().items():
        np.testing.assert_allclose(array, getattr(gaussians, field), rtol=1e-4, atol=1e-5)


@pytest.fixture
def call(folder, tmp_path, monkeypatch, vvgt):
    monkeypatch.chdir(tmp_path)
    return lambda *args: vvgt("optimize", folder / "in.ply", "--views", folder / "views", "-o", "out.ply", *args)


def test_a_file_comes_nearer_and_keeps_its_layout(folder, call):
    result = call("--steps", 30, "--report", "r.json")
    assert result.code == 0, result.err
    report = json.loads(Path("r.json").read_text())
    stages = {stage["name"]: stage for stage in report["stages"]}
    assert list(stages) == ["read", "views", "refinement", "test views", "write"]
    assert stages["refinement"]["psnr"] > stages["refinement"]["psnr_before"] + 3
    assert report["refinement"]["steps"] == 30
    assert report["refinement"]["checks"][0][2] == stages["refinement"]["psnr_before"]
    assert report["scores"]["views"] == 2
    before, after = read_ply(folder / "in.ply")[1], read_ply("out.ply")[1]
    assert before == after  # count, frame, up, harmonics, unit distance: all that the header says
    assert [line.split()[0] for line in result.err.splitlines()] == ["read", "views", "refinement", "test", "write"]
    assert "every 8th training view, held out" in result.err


@pytest.mark.parametrize("method", ["adam", "3dgs"])
def test_methods_to_compare_with(call, method):
    assert call("--steps", 20, "--method", method, "--report", "-", "-q").code == 0
    assert read_ply("out.ply")[1].count <= 100


def test_a_file_of_another_program_gets_no_comments(folder, call, vvgt, tmp_path):
    write_ply(tmp_path / "plain.ply", read_ply(folder / "in.ply")[0], PlyOptions(comments=False))
    result = vvgt("optimize", "plain.ply", "--views", folder / "views", "--steps", 0, "-o", "-", "-q")
    assert result.out == (tmp_path / "plain.ply").read_bytes()


def test_what_is_worse_is_not_written(folder, vvgt, tmp_path, monkeypatch):
    """Black views to train on, true ones to decide by."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(folder / "views", "mixed")
    shutil.copy("mixed/transforms_test.json", "mixed/transforms_check.json")
    for image in Path("mixed/train").glob("*.exr"):
        write_exr(image, np.zeros((32, 32, 4), np.float32), overwrite=True)
    vvgt.ok("optimize", folder / "in.ply", "--views", folder / "views", "--steps", 40, "-o", "good.ply")
    args = ("good.ply", "--views", "mixed", "--steps", 400, "-o", "out.ply", "--report", "r.json")
    result = vvgt("optimize", *args)
    assert (result.code, "ended early" in result.err) == (0, True), result.err
    stage = json.loads(Path("r.json").read_text())["stages"][2]
    assert stage["psnr"] >= stage["psnr_before"]
    assert stage["kept"] == (stage["psnr"] > stage["psnr_before"])
    _, check, remark = load_sets("mixed")
    assert (len(check.cameras), remark) == (2, "")


def test_a_target_and_a_time_budget_end_a_run(call):
    result = call("--steps", 500, "--target-psnr", 1)
    assert (result.code, "0 steps" in result.err, "target reached" in result.err) == (0, True, True)
    result = call("--time-budget", 1e-9, "--overwrite")
    assert (result.code, "time is up" in result.err) == (0, True)


CASES = {
    "no views": (("in.ply", "--views", "none", "--steps", 1, "-o", "o.ply"), 1, "none/transforms_train.json"),
    "no ply": (("no.ply", "--views", "views", "--steps", 1, "-o", "o.ply"), 1, "no.ply"),
    "no budget": (("in.ply", "--views", "views", "-o", "o.ply"), 2, "--steps N or --time-budget"),
    "two budgets": (("in.ply", "--views", "views", "--steps", 1, "--time-budget", 1, "-o", "o.ply"), 2, "give either"),
    "over itself": (("in.ply", "--views", "views", "--steps", 1, "-o", "in.ply", "--overwrite"), 2, "input"),
    "suffix": (("in.ply", "--views", "views", "--steps", 1, "-o", "o.splat"), 2, ".ply"),
    "limit": (("in.ply", "--views", "views", "--steps", 1, "-o", "o.ply", "--max-gaussians", 9), 2, "--method 3dgs"),
    "method": (("in.ply", "--views", "views", "--steps", 1, "-o", "o.ply", "--method", "sgd"), 2, "sgd"),
    "one view": (("in.ply", "--views", "one", "--steps", 1, "-o", "o.ply"), 1, "two or more"),
    "broken view": (("in.ply", "--views", "broken", "--steps", 1, "-o", "o.ply"), 1, "train_001.exr"),
    "no cameras": (("in.ply", "--views", "empty", "--steps", 1, "-o", "o.ply"), 1, "frames"),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_gets_one_line_and_leaves_nothing(case, folder, tmp_path, monkeypatch, vvgt):
    monkeypatch.chdir(tmp_path)
    shutil.copy(folder / "in.ply", "in.ply")
    for name in ("views", "one", "broken", "empty"):
        shutil.copytree(folder / "views", name)
    (tmp_path / "broken/train/train_001.exr").write_bytes(b"v/1\x01")
    for name, count in (("one", 1), ("empty", 0)):
        path = tmp_path / name / "transforms_train.json"
        content = json.loads(path.read_text())
        path.write_text(json.dumps(content | {"frames": content["frames"][:count]}))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    args, code, message = CASES[case]
    result = vvgt("optimize", *args)
    assert (result.code, message in result.error, result.out) == (code, True, b""), result.err
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="processor time of a child is in /proc")
def test_ctrl_c_writes_what_there_is(folder, tmp_path):
    code = "import sys; from vvgt_cli.commands.main import main; main()"
    args = [folder / "in.ply", "--views", folder / "views", "--steps", 10**7, "-o", tmp_path / "out.ply"]
    child = start("-c", code, "optimize", *args)
    said = [child.stderr.readline(), child.stderr.readline()]  # read, views: the descent begins
    assert said[1].startswith("views"), said
    spent = lambda: sum(map(int, Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()[11:13]))  # noqa: E731
    begun = spent()
    while child.poll() is None and spent() < begun + os.sysconf("SC_CLK_TCK"):  # a second: kernels are loaded
        time.sleep(0.05)
    child.send_signal(signal.SIGINT)
    rest = child.communicate(timeout=120)[1]
    assert child.returncode == 0, rest
    assert "interrupted" in rest
    assert read_ply(tmp_path / "out.ply")[1].count == read_ply(folder / "in.ply")[1].count
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.ply"]


def test_the_frame_of_a_file_is_kept_where_it_was_made_elsewhere(folder, call, tmp_path, vvgt):
    world = PlyOptions(frame="world", up="x", scale=0.5, centre=(3.0, -2.0, 9.0))
    write_ply(tmp_path / "far.ply", read_ply(folder / "in.ply")[0], world)
    vvgt.ok("optimize", "far.ply", "--views", folder / "views", "--steps", 0, "-o", "same.ply", "-q")
    far, same = read_ply(tmp_path / "far.ply"), read_ply(tmp_path / "same.ply")
    assert (same[1].screen_size, same[1].rule) == (
        read_cameras(folder / "views" / "transforms_train.json")[0].width,
        "inria",
    )
    named = ("frame", "up", "scale", "centre", "unit_distance", "sh_degree", "count")
    assert [getattr(far[1], name) for name in named] == [getattr(same[1], name) for name in named]
    np.testing.assert_allclose(same[0].means, far[0].means, rtol=1e-5)
