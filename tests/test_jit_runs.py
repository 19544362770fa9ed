"""What commands have compiled, and what runs where numba is off."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from vvgt_cli.gaussians import Gaussians, write_ply
from vvgt_cli.jit import ahead
from vvgt_cli.jit.compile import usual_jobs
from vvgt_cli.score.record import Run


def some(count: int = 60, degree: int = 0) -> Gaussians:
    """Gaussians here and there."""
    rng = np.random.default_rng(0)
    means, colors, log_scales = rng.uniform(-0.4, 0.4, (count, 3)), rng.random((count, 3)), np.full((count, 3), -3.0)
    harmonics = rng.normal(0, 0.02, (count, (degree + 1) ** 2 - 1, 3)) if degree else None
    return Gaussians(means, log_scales, rng.normal(size=(count, 4)), rng.normal(size=count), colors, harmonics)


def as_python(*line: object) -> subprocess.CompletedProcess[str]:
    """A command with numba off."""
    command = [sys.executable, "-m", "vvgt_cli.commands.main", *map(str, line)]
    return subprocess.run(command, env=os.environ | {"NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True)


def test_view_has_harmonics_compiled_where_there_are_some(vvgt, tmp_path: Path, monkeypatch) -> None:
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(Run, "compile", lambda run, kernels, volume=None: asked.append(tuple(kernels)))
    for degree in (0, 2):
        write_ply(str(tmp_path / "a.ply"), some(degree=degree))
        vvgt.ok("view", tmp_path / "a.ply", "-o", tmp_path / f"a{degree}.spz")
    assert asked == [ahead.DRAW, ahead.for_degree(ahead.DRAW, 2)]


def test_drawing_runs_as_python_where_numba_is_off(vvgt, tmp_path: Path) -> None:
    write_ply(str(tmp_path / "a.ply"), some())
    line = ("render", tmp_path / "a.ply", "--orbit", "2", "--size", "24", "-o")
    vvgt.ok(*line, tmp_path / "compiled")
    plain = as_python(*line, tmp_path / "plain")
    assert plain.returncode == 0, plain.stderr
    for name in ("orbit_000.png", "orbit_001.png"):
        assert (tmp_path / "plain" / name).read_bytes() == (tmp_path / "compiled" / name).read_bytes()


@pytest.mark.parametrize("command", ["convert", "init", "render-views"])
def test_volumes_are_not_drawn_as_python_and_it_says_so(tmp_path: Path, command: str) -> None:
    out = tmp_path / ("views" if command == "render-views" else "a.ply")
    done = as_python(command, "example:marschner-lobb:8", "-qo", out)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "NUMBA_DISABLE_JIT is set" in done.stderr
    assert not list(tmp_path.iterdir())


def test_nothing_is_compiled_where_numba_is_off(monkeypatch) -> None:
    assert len(usual_jobs(ahead.DRAW, ("float32",))) == len(ahead.DRAW)
    monkeypatch.setattr("numba.config.DISABLE_JIT", 1)
    assert usual_jobs(ahead.DRAW) == []
