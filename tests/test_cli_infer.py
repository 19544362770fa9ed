"""`vvgt infer` on models built by hand: what is kept, what is dropped, what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from network_models import as_rows
from onnx_models import write_model

from vvgt_cli.commands.infer import divide
from vvgt_cli.commands.main import run
from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.conversion.stage import Work
from vvgt_cli.conversion.stages import Network
from vvgt_cli.gaussians import PlyOptions, read_ply, write_ply
from vvgt_cli.images.files import load_views
from vvgt_cli.network.card import ModelCard
from vvgt_cli.network.prepare import prepare
from vvgt_cli.network.runtime import Model
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.score.views import Views

DARK = 0.2
BRIGHTER, DARKER = (*[0.0] * 11, *[DARK] * 3), (*[0.0] * 11, *[-DARK] * 3)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Views of a volume, its Gaussians with colours too dark by `DARK`, and two models; to be read only."""
    folder = tmp_path_factory.mktemp("infer")
    volume = ("example:blob:16", "--tf", "viridis")
    views = ("--views", 6, "--test-views", 1, "--size", 32, "-o", folder / "views")
    assert run([str(arg) for arg in ("render-views", *volume, *views, "--quiet")]) == 0
    start = ("init", *volume, "--max-gaussians", 300, "--screen", 32, "-o", folder / "init.ply", "--quiet")
    assert run([str(arg) for arg in start]) == 0
    gaussians, _ = read_ply(folder / "init.ply")
    world = PlyOptions(frame="world", up="z", scale=0.5, centre=(3.0, 4.0, 5.0), unit_distance=0.7)
    write_ply(folder / "in.ply", replace(gaussians, colors=gaussians.colors - DARK), world)
    write_model(folder / "brighter", BRIGHTER)
    write_model(folder / "darker", DARKER)
    return folder


def call(made, model, output, *more):
    return "infer", made / "in.ply", "--views", made / "views", "--model", made / model, "-o", output, *more


def test_a_gain_is_kept_and_the_file_is_as_the_one_read(made, tmp_path, vvgt):
    assert "dropped" not in vvgt.ok(*call(made, "brighter", tmp_path / "out.ply", "--report", tmp_path / "r.json")).err
    (before, old), (after, new) = read_ply(made / "in.ply"), read_ply(tmp_path / "out.ply")
    assert np.allclose(after.colors, before.colors + DARK, atol=1e-5)
    assert np.allclose(after.means, before.means, atol=1e-5)
    assert (new.frame, new.up, new.scale, new.centre, new.unit_distance) == ("world", "z", 0.5, (3.0, 4.0, 5.0), 0.7)
    assert old.comments == new.comments
    options = json.loads((tmp_path / "r.json").read_text())["options"]
    assert options["psnr_after"] > options["psnr_before"] + 2
    assert len(options["read"]) == 3
    assert not set(options["read"]) & set(options["check_views"])


def test_without_a_gain_the_input_is_written_and_it_is_said(made, tmp_path, vvgt):
    assert "no gain: dropped" in vvgt.ok(*call(made, "darker", tmp_path / "out.ply")).err
    (before, _), (after, _) = read_ply(made / "in.ply"), read_ply(tmp_path / "out.ply")
    assert np.allclose(as_rows(after), as_rows(before), atol=1e-5)


@pytest.mark.parametrize(("model", "kept"), [("brighter", True), ("darker", False)])
def test_the_stage_keeps_what_the_check_views_agree_with(made, model, kept):
    cameras, images = load_views(made / "views", "train")
    few = Views(cameras, images)
    gaussians, _ = read_ply(made / "init.ply")
    dark = replace(gaussians, colors=gaussians.colors - DARK)
    run_ = Run(Console(quiet=True), ConversionReport("convert"))
    work = Work(run_, None, FitOptions(), gaussians=dark, train=few.take([0, 1, 2]), check=few.take([3, 4]))
    work.train_rule = work.rule
    Network(str(made / model)).run(work)
    assert np.allclose(work.gaussians.colors, dark.colors + (DARK if kept else 0), atol=1e-5)
    stage = run_.report.stages[0]
    assert (stage.name, stage.kept) == ("network", kept)
    assert (stage.psnr > stage.psnr_before) == kept


def test_rounds_run_on_their_own_output_and_on_other_views(made, monkeypatch):
    model = Model.open(made / "brighter")
    config = replace(model.card.network, rounds=3, image=replace(model.card.network.image, views=2))
    monkeypatch.setattr(ModelCard, "network", config)
    seen = []
    monkeypatch.setattr("vvgt_cli.network.runtime.prepare", lambda g, c, *rest: seen.append(c) or prepare(g, c, *rest))
    cameras, images = load_views(made / "views", "train")
    gaussians, _ = read_ply(made / "init.ply")
    out = model.improve(gaussians, cameras, images)
    assert np.allclose(out.colors, gaussians.colors + 3 * DARK, atol=1e-5)
    names = [camera.name for cameras in seen for camera in cameras]
    assert len(names) == len(set(names)) == 6


def test_the_same_bytes_again_and_through_pipes(made, tmp_path, vvgt, monkeypatch):
    outputs = []
    for name in ("a.ply", "b.ply"):
        assert vvgt(*call(made, "brighter", tmp_path / name, "--quiet", "--threads", 2)).err == ""
        outputs.append((tmp_path / name).read_bytes())
    assert outputs[0] == outputs[1]
    with (made / "in.ply").open() as stream:
        monkeypatch.setattr("sys.stdin", stream)
        piped = vvgt("infer", "-", "--views", made / "views", "--model", made / "brighter", "-o", "-")
    assert piped.out == outputs[0]


def test_with_too_few_views_those_that_were_read_judge(made):
    from vvgt_cli.cameras import default_views

    read, judges = divide(default_views("train", 3), 8)
    assert read == judges == [0, 1, 2]
    read, judges = divide(default_views("train"), 8)
    assert (len(read), len(judges)) == (8, 4)
    assert not set(read) & set(judges)


CASES = {
    "no model": (("--model", "no/such"), 2, "no such folder"),
    "folder without a card": (("--model", "."), 2, "card.json"),
    "no views": (("--views", "."), 1, "transforms_train.json"),
    "no input": (("IN", "no.ply"), 1, "no.ply"),
    "suffix": (("-o", "out.txt"), 2, ".ply"),
    "report suffix": (("--report", "out.txt"), 2, ".json"),
    "provider": (("--provider", "abacus"), 2, "abacus"),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_gets_one_line_and_leaves_nothing(case, made, tmp_path, vvgt, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (change, value), code, message = CASES[case]
    args = list(call(made, "brighter", "out.ply"))
    if change == "IN":
        args[1] = value
    elif change in args:
        args[args.index(change) + 1] = value
    else:
        args += [change, value]
    result = vvgt.fails(code, *args)
    assert message in result
    assert "internal" not in result
    assert not list(Path().iterdir())


def test_nothing_is_overwritten_unasked(made, tmp_path, vvgt):
    (tmp_path / "out.ply").write_bytes(b"mine")
    assert "--overwrite" in vvgt.fails(2, *call(made, "brighter", tmp_path / "out.ply"))
    assert (tmp_path / "out.ply").read_bytes() == b"mine"


def test_threads_come_from_the_option_or_the_environment(made, tmp_path, vvgt, monkeypatch):
    import numba

    from vvgt_cli.network import runtime

    asked = []
    opened = runtime._session
    monkeypatch.setattr(
        runtime, "_session", lambda path, threads, provider: asked.append(threads) or opened(path, threads, provider)
    )
    limit = numba.config.NUMBA_NUM_THREADS
    try:
        vvgt(*call(made, "brighter", tmp_path / "a.ply", "--threads", 1))
        monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
        monkeypatch.setenv("SLURM_CPUS_PER_TASK", "2")
        vvgt(*call(made, "brighter", tmp_path / "b.ply"))
    finally:
        numba.set_num_threads(limit)
    assert asked == [1, 1, min(2, limit), min(2, limit)]
