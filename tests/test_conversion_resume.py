"""Conversions that are ended at every stage and go on: the bytes are those of one that never was."""

from pathlib import Path

import numpy as np
import pytest

from tests.processes import replaced
from vvgt_cli.conversion import convert, fitting
from vvgt_cli.conversion.stages import scores, views
from vvgt_cli.dvr import RenderSettings
from vvgt_cli.refine import loop
from vvgt_cli.refine.states import OwnAxes

LINE = ("convert", "example:blob:8", "--max-gaussians", "200", "--screen", "32", "--steps", "24")


@pytest.fixture
def folder(tmp_path: Path, vvgt, monkeypatch) -> Path:
    """The working folder, with what a run that is not ended writes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(views, "ray_settings", by_start)
    vvgt.ok(*LINE, "-o", "whole.ply")
    return tmp_path


def ended(monkeypatch, target: str, calls: int) -> None:
    """Let the function end the run at its call number ``calls`` (from 0)."""
    module, _, name = target.rpartition(".")
    owner = {"loop": loop, "fitting": fitting, "convert": convert, "scores": scores, "states": OwnAxes}[module]
    own, count = getattr(owner, name), [0]

    def call(*args, **kwargs):
        count[0] += 1
        if count[0] > calls:
            raise KeyboardInterrupt
        return own(*args, **kwargs)

    monkeypatch.setattr(owner, name, call)


def by_start(scene, start, *_):
    """Rays of views that depend on the very Gaussians that they are chosen for."""
    return RenderSettings(samples=1, step=0.5 + float(np.abs(start.means).mean()) % 0.25)


@pytest.mark.parametrize(
    ("target", "calls", "left"),
    [
        ("fitting._improve", 0, {"closed-form.npz"}),  # its pyramid is needed again: cells are still to be cut by error
        ("states.step", 0, {"closed-form.npz", "cells.npz"}),
        ("states.step", 4, {"closed-form.npz", "cells.npz", "refinement.npz"}),
        ("scores.score_test_views", 0, {"closed-form.npz", "cells.npz", "refinement.npz", "fitted.npz"}),
        ("convert.write_gaussians", 0, {"closed-form.npz", "cells.npz", "refinement.npz", "fitted.npz"}),
    ],
)
def test_a_conversion_resumes_where_it_was_ended(target, calls, left, folder, vvgt, monkeypatch):
    line = (*LINE, "-o", "a.ply", "--checkpoint", "kept")
    with monkeypatch.context() as patch:
        patch.setattr(loop, "KEEP", 0.0)
        ended(patch, target, calls)
        assert vvgt(*line).code == 130
    assert {path.name for path in (folder / "kept").glob("*")} == left
    with monkeypatch.context() as patch:  # nothing is done twice
        if "fitted.npz" in left:
            ended(patch, "fitting._improve", 0)
        ended(patch, "states.step", 20 if "refinement.npz" in left else 24)
        if "cells.npz" in left:
            patch.setattr("vvgt_cli.closed_form.initialise", None)
            patch.setattr("vvgt_cli.closed_form.closed_form.ClosedForm.cut_by_error", None)
        result = vvgt(*line)
    assert result.code == 0, result.err
    assert (folder / "a.ply").read_bytes() == (folder / "whole.ply").read_bytes()
    assert sorted(path.name for path in folder.iterdir()) == ["a.ply", "whole.ply"]


@pytest.mark.parametrize("more", [("--steps", "0"), ("--steps", "4"), ("--target-psnr", "60")])
def test_stages_that_cut_the_pyramid_again_have_it(more, folder, vvgt, monkeypatch):
    line = (*replaced(LINE, *more), "--overwrite", "-o")
    vvgt.ok(*line, "whole.ply")
    with monkeypatch.context() as patch:
        ended(patch, "scores.score_test_views", 0)
        assert vvgt(*line, "a.ply", "--checkpoint", "kept").code == 130
    (folder / "kept" / "fitted.npz").unlink()
    vvgt.ok(*line, "a.ply", "--checkpoint", "kept")
    assert (folder / "a.ply").read_bytes() == (folder / "whole.ply").read_bytes()


def test_what_is_kept_of_another_degree_is_another_conversion(folder, vvgt, monkeypatch):
    line = (*LINE, "--light", "headlight", "--checkpoint", "kept", "-o", "a.ply")
    with monkeypatch.context() as patch:
        ended(patch, "scores.score_test_views", 0)
        assert vvgt(*line).code == 130
    assert "belongs to another volume or other options" in vvgt.fails(2, *line, "--sh-degree", "0")


def test_what_is_kept_of_another_conversion_or_is_damaged(folder, vvgt, monkeypatch):
    line = (*LINE, "-o", "a.ply", "--checkpoint", "kept")
    with monkeypatch.context() as patch:
        ended(patch, "scores.score_test_views", 0)
        assert vvgt(*line).code == 130
    assert "fitted.npz: belongs to another volume or other options" in vvgt.fails(
        2, *replaced(line, "--max-gaussians", "100")
    )
    kept = folder / "kept" / "fitted.npz"
    whole = kept.read_bytes()
    for content in (b"", whole[: len(whole) // 2], whole.replace(b"means", b"moons")):
        kept.write_bytes(content)
        assert "not a checkpoint of 'vvgt convert'" in vvgt.fails(1, *line)


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (("--time-budget", "9"), "give one of them"),
        (("--checkpoint", "no/where"), "cannot be made (No such file or directory)"),
        (("-o", "a_{}.ply"), "a series resumes from its manifest"),
    ],
)
def test_a_conversion_that_cannot_resume_is_reported(more, told, tmp_path, vvgt, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert told in vvgt.fails(2, *replaced((*LINE, "-o", "a.ply", "--checkpoint", "kept"), *more))
    assert not list(tmp_path.iterdir())
