"""A run that is interrupted and goes on ends with the bytes of one that was not."""

import itertools

import numpy as np
import pytest
from random_clouds import random_cloud

from tests.refused import refused
from vvgt_cli.cameras import default_views
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.refine import OptimizeOptions, optimize
from vvgt_cli.splat import render

FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "colors")
CAMERAS, CHECKS = default_views("train", 5, size=32), default_views("check", 2, size=32)


def cloud(count=40, seed=0, sigma=0.1):
    return random_cloud(count, seed, sigma, 0.2, (0, 1))


def views(g, cameras):
    return np.stack([render(g, camera) for camera in cameras])


TRUTH = cloud(seed=1)


def run(path=None, stop=None, method="axes", start=None, steps=30, early=None, **others):
    options = OptimizeOptions.of(
        method, steps=steps, early=early, check_every=5, max_gaussians=50, checkpoint=path and str(path)
    )
    images, check = views(TRUTH, CAMERAS), (CHECKS, views(TRUTH, CHECKS))
    return optimize(start or cloud(), CAMERAS, images, options, check, stop=stop, **others)


def after(steps):
    """Asked before each step: True at the one after ``steps``."""
    count = itertools.count()
    return lambda: next(count) == steps


@pytest.mark.parametrize(("method", "count"), [("axes", 40), ("adam", 40), ("3dgs", 40), ("axes", 700)])
def test_an_interrupted_run_ends_as_a_whole_one(method, count, tmp_path):
    """700 share what their steps have in common, which is found from the start again."""
    path, start = tmp_path / "run.npz", cloud(count)
    whole, expected = run(method=method, start=start)
    for steps in (7, 8):  # ends after 7, then after 15, where a look is due
        part, record = run(path, after(steps), method, start)
        assert record.reason == "interrupted"
        assert len(part)
    assert record.steps == 15
    result, record = run(path, method=method, start=start)
    assert (record.steps, record.kept, record.reason) == (30, expected.kept, "steps")
    assert [(step, db) for step, _, db in record.checks] == [(step, db) for step, _, db in expected.checks]
    for field in FIELDS:
        assert getattr(result, field).tobytes() == getattr(whole, field).tobytes(), field
    again, record = run(path, method=method, start=start)  # at its end: nothing is left to do
    assert record.steps == 30
    assert again.means.tobytes() == whole.means.tobytes()


@pytest.mark.parametrize(("unseen", "steps", "reason"), [(1.0, 14, "unseen"), (0.0, 30, "steps")])
def test_a_run_ends_early_where_no_difference_is_seen(unseen, steps, reason, tmp_path, monkeypatch):
    """Interrupted before and after the decision, it ends alike."""
    monkeypatch.setattr("vvgt_cli.refine.loop.UNSEEN", unseen)
    whole, expected = run(early=14)
    assert (expected.steps, expected.reason) == (steps, reason)
    assert 0 < expected.difference < 1
    assert np.isfinite(whole.means).all()
    path = tmp_path / "run.npz"
    for end in (5, 3):  # after 5 and 8 steps
        _, record = run(path, after(end), early=14)
    assert record.steps == 8
    assert (record.difference is None, record.reason) == (False, "interrupted")
    result, record = run(path, early=14)
    assert (record.steps, record.difference) == (steps, expected.difference)
    for field in FIELDS:
        assert getattr(result, field).tobytes() == getattr(whole, field).tobytes(), field


def test_an_early_end_is_that_of_as_few_steps(monkeypatch):
    monkeypatch.setattr("vvgt_cli.refine.loop.UNSEEN", 1.0)
    early, _ = run(early=14)
    few, _ = run(steps=14)
    assert early.means.tobytes() == few.means.tobytes()


def test_another_runs_checkpoint_is_refused(tmp_path):
    path = tmp_path / "run.npz"
    run(path, after(2))
    before = path.read_bytes()
    weights = [np.full((32, 32), 0.5, np.float32)] * len(CAMERAS)
    for other in (
        {"steps": 31}, {"start": cloud(seed=3)}, {"method": "adam"}, {"weights": weights},
        {"free": np.arange(40) < 20},
    ):  # fmt: skip
        refused(UsageError, r"run\.npz", run, path, **other)
    assert path.read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"nonsense" * 100])
def test_a_damaged_checkpoint_is_refused(content, tmp_path):
    path = tmp_path / "run.npz"
    path.write_bytes(content)
    refused(DataError, "not a checkpoint", run, path)
    np.savez(path, other=np.zeros(3))
    refused(DataError, "not a checkpoint", run, path)


@pytest.mark.parametrize(
    "change",
    [
        lambda arrays: arrays.update(state_array_1=arrays["state_array_1"][:, :1]),
        lambda arrays: arrays.update(state_first=arrays["state_first"].astype(np.float64)),
        lambda arrays: arrays.pop("state_second"),
    ],
)
def test_arrays_that_the_kernels_do_not_take_are_refused(change, tmp_path):
    path = tmp_path / "run.npz"
    run(path, after(6))
    with np.load(path) as file:
        arrays = dict(file)
    change(arrays)
    np.savez(path, **arrays)
    refused(DataError, "not a checkpoint", run, path)


def test_a_packed_checkpoint_is_refused(tmp_path):
    path = tmp_path / "run.npz"
    run(path, after(2))
    with np.load(path) as file:
        np.savez_compressed(path, **dict(file))
    refused(DataError, "compressed entries", run, path)
