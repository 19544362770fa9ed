"""The loop: a view a step, scores on the check views in between, the best kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from vvgt_cli.cameras import BLOCK, Blocks, Camera
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.progress import ProgressCallback
from vvgt_cli.refine.checkpoint import Checks, fingerprint, resume, save
from vvgt_cli.refine.options import Check, OptimizeOptions, OptimizeRecord, Train
from vvgt_cli.refine.states import Densified, Fields, OnHost, OwnAxes, State

UNSEEN = 12 / 255  # `visible_difference` halfway to an early end that is hardly seen at the end (docs/log/steps.md)
SLOWER = 0.5  # rates after a fall
SCORES = 8  # on the check views in a run, where that leaves enough steps between two
SETTLING = 0.5  # share of the run from which on scores without gain count: rates fall only then
NEAR, FORGOTTEN, LITTLE = 0.3, 0.9, 1e-3  # 1 - cosine between views that are near; what was seen, a step; among equals
KEEP = 30.0  # seconds after which a run is kept, scored or not


def run(
    gaussians: Gaussians, cameras: Sequence[Camera], images: np.ndarray, options: OptimizeOptions, check: Check | None,
    progress: ProgressCallback | None, stop: Callable[[], bool] | None, free: np.ndarray | None,
    weights: Sequence[np.ndarray] | None,
) -> tuple[Gaussians, OptimizeRecord]:  # fmt: skip
    """Run `optimize` without its defaults."""
    _check_views("training", cameras, images, None, weights)
    if check is not None:
        _check_views("check", *check)
    record = OptimizeRecord()
    state = begin(gaussians, cameras, options, free)
    checks = Checks(state, check, record, options.check_rule)
    others = [*(() if weights is None else weights), *([] if free is None else [free])]
    keep, course = _checkpoint(options, gaussians, (cameras, images), check, others, state, checks)
    entered, middle = time.perf_counter(), 0 if options.early is None else options.early // 2
    order = spread_views(cameras, options.seed)
    if not record.checks:
        checks.measure(0.0)
        record.psnr_before = checks.best
    saved = entered
    spent, began = course.elapsed, time.perf_counter() - course.elapsed
    if course.ends is not None:
        options = replace(options, steps=course.ends)
    for _ in range(record.steps):
        next(order)
    while True:
        course.elapsed = time.perf_counter() - began
        reason = _reason(options, checks, course.elapsed, stop)
        if reason:
            record.reason = reason
            break
        view = next(order)
        share = _share(options, record.steps, course.elapsed)
        weight = None if weights is None else weights[view]
        state.step(cameras[view], images[view], share, course.speed, weight)
        record.steps += 1
        if record.steps == middle:
            checks.measure(time.perf_counter() - began)
            record.difference = checks.difference
            course.ends = options.early if checks.difference <= UNSEEN else options.steps
            options = replace(options, steps=course.ends)
        expected = _expected(options, record.steps, course.elapsed)
        if progress:
            progress(record.steps, expected)
        if record.steps >= course.scored + max(options.check_every, expected // SCORES):
            course.scored = record.steps
            if checks.measure(time.perf_counter() - began, share >= SETTLING):
                course.speed *= SLOWER
        elif time.perf_counter() < saved + KEEP:
            continue
        keep()
        saved = time.perf_counter()
    keep()  # before the last score: a run that goes on from here would not have it
    checks.measure(time.perf_counter() - began)
    result = checks.result(gaussians)
    record.seconds = spent + time.perf_counter() - entered
    return result, record


@dataclass
class _Course:
    """Values that change from step to step beside the state."""

    speed: float = 1.0
    elapsed: float = 0.0
    scored: int = 0
    ends: int | None = None  # the step after which the run ends, once decided halfway to an early end


def _checkpoint(
    options: OptimizeOptions, gaussians: Gaussians, train: Train, check: Check | None, others: list[np.ndarray],
    state: State, checks: Checks,
) -> tuple[Callable[[], None], _Course]:  # fmt: skip
    """Return the run's checkpoint and its start: the end of the last one where there is a file, else the given one."""
    path = options.checkpoint
    if path is None:
        return lambda: None, _Course()
    key = fingerprint(gaussians, options, train, check, others=others)
    course = _Course(**(resume(path, key, state, checks, checks.record) or {}))
    return lambda: save(path, key, state, checks, checks.record, asdict(course)), course


def begin(
    gaussians: Gaussians, cameras: Sequence[Camera], options: OptimizeOptions, free: np.ndarray | None = None
) -> State:
    """Return the state that a method descends on: Gaussians that carry values with the look that they have."""
    kinds: dict[str, Callable[..., OnHost]] = {"axes": OwnAxes, "adam": Fields, "3dgs": Densified}
    gaussians = replace(gaussians, live=None)
    if options.device == "cpu":
        return kinds[options.method](gaussians, cameras, options, free)
    from vvgt_cli.refine.on_device import OwnAxesOnDevice

    return OwnAxesOnDevice(gaussians, cameras, options, free)


def spread_views(cameras: Sequence[Camera], seed: int) -> Iterator[int]:
    """Yield all views, then all again, each from where fewest of the last ones were seen from.

    A step follows one view's slopes; those of views side by side are alike, so that views far apart in a row make a
    better mean of all. ``seed`` decides which is first, and between equals.
    """
    places = np.array([camera.position for camera in cameras])
    places /= np.maximum(np.linalg.norm(places, axis=1), 1e-12)[:, None]
    near = np.exp((places @ places.T - 1) / NEAR)
    seen = np.random.default_rng(seed).random(len(cameras)) * LITTLE
    while True:
        left = np.ones(len(cameras), bool)
        while left.any():
            view = int(np.argmin(np.where(left, seen, np.inf)))
            left[view] = False
            seen = FORGOTTEN * seen + near[view]
            yield view


def _share(options: OptimizeOptions, steps: int, elapsed: float) -> float:
    """Return the completed share of the run, by steps or by time, whichever is more."""
    by_steps = steps / options.steps if options.steps else 0.0
    by_time = elapsed / options.time_budget if options.time_budget else 0.0
    return min(max(by_steps, by_time), 1.0)


def _expected(options: OptimizeOptions, steps: int, elapsed: float) -> int:
    """Estimate the total number of steps."""
    share = _share(options, steps, elapsed)
    return max(steps, round(steps / share)) if options.time_budget and share > 0 else options.steps or steps


def _reason(options: OptimizeOptions, checks: Checks, elapsed: float, stop: Callable[[], bool] | None) -> str | None:
    """Return why to stop before the next step; None to go on."""
    if options.steps is not None and checks.record.steps >= options.steps:
        return "unseen" if checks.record.steps == options.early else "steps"
    if options.time_budget is not None and elapsed >= options.time_budget:
        return "time"
    if options.target_psnr is not None and checks.best is not None and checks.best >= options.target_psnr:
        return "target"
    if checks.idle >= options.patience:
        return "no gain"
    return "interrupted" if stop and stop() else None


def _check_views(
    name: str, cameras: Sequence[Camera], images: np.ndarray, blocks: Sequence[Blocks] | None = None,
    weights: Sequence[np.ndarray] | None = None,
) -> None:  # fmt: skip
    """Raise DataError unless each view has an image of its size and, if there are any, weights of that size."""
    if not len(cameras) or len(cameras) != len(images):
        raise DataError(f"{len(images)} {name} images for {len(cameras)} cameras; expected as many, and at least one")
    for i, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        expected = (camera.height, camera.width, 4)
        if blocks is not None:
            expected = (blocks[i].numbers.size * BLOCK, BLOCK, 4)
        if image.shape != expected:
            raise DataError(f"{name} view {camera.name}: image of shape {image.shape}; expected {expected}")
    if weights is not None and (shapes := [w.shape for w in weights]) != [image.shape[:2] for image in images]:
        raise DataError(f"{name} views: weights of shapes {shapes[:3]}; expected {images[0].shape[:2]} for each image")
