"""The loop: a view a step, scores on the check views in between, the best kept.

`Densified` is 3DGS as it was published (Kerbl et al. 2023), for comparison: Gaussians are cloned, split and pruned on
the way. There, of 30,000 steps, every 100th from the 500th to the 15,000th densifies; here the same shares of the run,
but not before `FEWEST` views have been seen since the last time. Opacities are reset in every 3,000th step, where that
leaves `RECOVERY` steps to recover in. Clones share the opacity of what they were cloned from, ``1 - sqrt(1 - o)`` each
(Rota Bulo et al. 2024): twice the original would darken the picture.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.blocks import BLOCK, Blocks
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.frames import rotations
from vvgt_cli.refine.checkpoint import fingerprint, resume, save
from vvgt_cli.refine.judge import Judge
from vvgt_cli.refine.options import Check, OptimizeOptions, OptimizeRecord, Progress, Train
from vvgt_cli.refine.states import Fields, OnHost, OwnAxes, State
from vvgt_cli.splat import Projection
from vvgt_cli.splat.render import moments, screen_slopes

SLOWER = 0.5  # rates after a fall
SCORES = 8  # on the check views in a run, where that leaves enough steps between two
SETTLING = 0.5  # share of the run from which on scores without gain count: rates fall only then
NEAR, FORGOTTEN, LITTLE = 0.3, 0.9, 1e-3  # 1 - cosine between views that are near; what was seen, a step; among equals
KEEP = 30.0  # seconds after which a run is kept, scored or not


def run(
    gaussians: Gaussians, cameras: Sequence[Camera], images: np.ndarray, options: OptimizeOptions, check: Check | None,
    progress: Progress | None, stop: Callable[[], bool] | None, free: np.ndarray | None,
    weights: Sequence[np.ndarray] | None,
) -> tuple[Gaussians, OptimizeRecord]:  # fmt: skip
    """Run `optimize` without its defaults."""
    _fit("training", cameras, images, None, weights)
    if check is not None:
        _fit("check", *check)
    record = OptimizeRecord()
    state = begin(gaussians, cameras, options, free)
    judge = Judge(state, check, record, options.judge)
    keep, course = _checkpoint(options, gaussians, (cameras, images), check, state, judge)
    entered, order = time.perf_counter(), spread_views(cameras, options.seed)
    if not record.checks:
        judge.measure(0.0)
        record.psnr_before = judge.best
    saved = entered
    spent, began = course.elapsed, time.perf_counter() - course.elapsed
    for _ in range(record.steps):
        next(order)
    while True:
        course.elapsed = time.perf_counter() - began
        reason = _reason(options, judge, course.elapsed, stop)
        if reason:
            record.reason = reason
            break
        view = next(order)
        share = _share(options, record.steps, course.elapsed)
        weight = None if weights is None else weights[view]
        state.step(cameras[view], images[view], share, course.speed, weight)
        record.steps += 1
        expected = _expected(options, record.steps, course.elapsed)
        if progress:
            progress(record.steps, expected)
        if record.steps >= course.scored + max(options.check_every, expected // SCORES):
            course.scored = record.steps
            if judge.measure(time.perf_counter() - began, share >= SETTLING):
                course.speed *= SLOWER
        elif time.perf_counter() < saved + KEEP:
            continue
        keep()
        saved = time.perf_counter()
    keep()  # before the last score: a run that goes on from here would not have it
    judge.measure(time.perf_counter() - began)
    result = judge.result(gaussians)
    record.seconds = spent + time.perf_counter() - entered
    return result, record


@dataclass
class _Course:
    """Values that change from step to step beside the state."""

    speed: float = 1.0
    elapsed: float = 0.0
    scored: int = 0


def _checkpoint(
    options: OptimizeOptions, gaussians: Gaussians, train: Train, check: Check | None, state: State, judge: Judge
) -> tuple[Callable[[], None], _Course]:
    """Return the run's checkpoint and its start: the end of the last one where there is a file, else the given one."""
    path = options.checkpoint
    if path is None:
        return lambda: None, _Course()
    key = fingerprint(gaussians, options, train, check)
    course = _Course(**(resume(path, key, state, judge, judge.record) or {}))
    return lambda: save(path, key, state, judge, judge.record, asdict(course)), course


def begin(
    gaussians: Gaussians, cameras: Sequence[Camera], options: OptimizeOptions, free: np.ndarray | None = None
) -> State:
    """Return the state that a method descends on: Gaussians that carry values with the look that they have."""
    kinds: dict[str, Callable[..., OnHost]] = {"frame": OwnAxes, "adam": Fields, "3dgs": Densified}
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


def _reason(options: OptimizeOptions, judge: Judge, elapsed: float, stop: Callable[[], bool] | None) -> str | None:
    """Return why to stop before the next step; None to go on."""
    if options.steps is not None and judge.record.steps >= options.steps:
        return "steps"
    if options.time_budget is not None and elapsed >= options.time_budget:
        return "time"
    if options.target_psnr is not None and judge.best is not None and judge.best >= options.target_psnr:
        return "target"
    if judge.idle >= options.patience:
        return "no gain"
    return "interrupted" if stop and stop() else None


def _fit(
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


FIRST, LAST, EVERY, RESET = 500 / 30_000, 0.5, 100 / 30_000, 3_000 / 30_000  # shares of the run
FEWEST, RECOVERY = 10, 300  # steps
SLOPE = 2e-4  # mean gradient of the loss a pixel, in half pictures, above which a Gaussian is cloned or split
DENSE = 0.01  # of the cameras' extent: larger ones are split, smaller ones cloned
FAINTEST = 0.005  # opacity below which a Gaussian is removed
RESET_TO = 0.01  # opacity
SHRINK = 1.6  # of the scales of the two that a split makes
FINAL_RATE = 0.01  # of positions, at the end of the run


class Densified(Fields):
    """`Fields` with 3DGS' density control and decaying rate of positions."""

    STEADY = False

    def __init__(
        self, gaussians: Gaussians, cameras: Sequence[Camera], options: OptimizeOptions, free: np.ndarray | None = None
    ) -> None:
        """Take the limit of Gaussians, or their number, and the random seed from ``options``."""
        super().__init__(gaussians, cameras, options, free)
        self.limit = max(options.max_gaussians or len(gaussians), 1)
        self.rng = np.random.default_rng(options.seed)
        eyes = np.array([camera.position for camera in cameras])
        self.extent = 1.1 * float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max()) or 1.0
        self.last = self.last_reset = 0
        self.share = self.share_reset = 0.0
        self._forget()

    def _forget(self) -> None:
        self.slopes, self.seen = np.zeros(len(self.arrays[0])), np.zeros(len(self.arrays[0]), np.int64)

    def descend(
        self, camera: Camera, projection: Projection, image: np.ndarray, grad: np.ndarray, share: float, speed: float
    ) -> None:
        """Take one step, with density control where it is due."""
        seen = self.colors_from(camera)
        pairs = moments(projection, seen, image, grad)
        size = 3 * camera.width * camera.height  # their loss is a mean, ours a sum
        self.slopes += screen_slopes(projection, pairs) * (0.5 * max(camera.width, camera.height) / size)
        self.seen += projection.extent[:, 2] > projection.extent[:, 0]
        self.update(camera, projection, pairs, seen, (self.RATES[0] * FINAL_RATE**share, *self.RATES[1:]))
        if FIRST <= share <= LAST and share >= self.share + EVERY and self.taken >= self.last + FEWEST:
            self._densify()
            self.last, self.share = self.taken, share
        if share <= LAST and share >= self.share_reset + RESET:
            if self.taken >= self.last_reset + RECOVERY:
                self._reset()
            self.last_reset, self.share_reset = self.taken, share

    def saved(self) -> dict[str, np.ndarray]:
        """Return all that the next steps depend on."""
        last = np.array([self.last, self.last_reset, self.share, self.share_reset], np.float64)
        drawn = np.array(json.dumps(self.rng.bit_generator.state))
        return super().saved() | {"slopes": self.slopes, "seen": self.seen, "last": last, "drawn": drawn}

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Put back what `saved` gave."""
        super().restore(saved)
        self.slopes, self.seen = saved["slopes"], saved["seen"]
        last, last_reset, self.share, self.share_reset = map(float, saved["last"])
        self.last, self.last_reset = int(last), int(last_reset)
        self.rng.bit_generator.state = json.loads(str(saved["drawn"]))

    def _densify(self) -> None:
        score = self.slopes / np.maximum(self.seen, 1)
        denser, origin = densify(self.gaussians(), score, self.limit, self.extent, self.rng)
        self.arrays = tuple(denser.arrays().values())
        self.running = [np.where(_wide(origin >= 0, moment), moment[origin], 0) for moment in self.running]
        self._forget()

    def _reset(self) -> None:
        logits, most = self.arrays[3], math.log(RESET_TO / (1 - RESET_TO))
        np.minimum(logits, most, out=logits)
        for moment in self.running[6:8]:
            moment[:] = 0


def densify(
    gaussians: Gaussians, score: np.ndarray, limit: int, extent: float, rng: np.random.Generator
) -> tuple[Gaussians, np.ndarray]:
    """Remove faint, clone small and split large Gaussians of large score, until there are ``limit``.

    Args:
        gaussians: K of them.
        score: (K,) mean length of the gradient with respect to the projected centre.
        limit: most Gaussians; of those worth splitting the ones with the largest scores come first.
        extent: of the cameras, a length.
        rng: draws where the halves of a split go.

    Returns:
        (Gaussians, origin): ``origin`` (K',) is the index that each had before, -1 for new ones.
    """
    g = gaussians
    opacity = 1 / (1 + np.exp(-g.opacity_logits.astype(np.float64)))
    keep = np.flatnonzero(opacity >= FAINTEST) if (opacity >= FAINTEST).any() else np.array([int(opacity.argmax())])
    keep = keep[np.argsort(-opacity[keep], kind="stable")[:limit]]
    keep.sort()
    order = keep[np.argsort(-score[keep], kind="stable")]
    chosen = order[score[order] > SLOPE][: max(limit - len(keep), 0)]
    scales = np.exp(g.log_scales[chosen].astype(np.float64))
    large = scales.max(axis=1) > DENSE * extent
    index = np.concatenate([keep, chosen])  # one of the two in its place, the other at the end
    origin = np.concatenate([keep, np.full(len(chosen), -1)])
    place = np.searchsorted(keep, chosen)
    origin[place[large]] = -1
    means, logs, logits = g.means[index].copy(), g.log_scales[index].copy(), g.opacity_logits[index].copy()
    turns = rotations(g.quaternions[chosen[large]])
    for rows in (place, len(keep) + np.arange(len(chosen))):
        moved = np.einsum("kij,kj->ki", turns, scales[large] * rng.normal(size=(int(large.sum()), 3)))
        means[rows[large]] += moved.astype(np.float32)
        logs[rows[large]] -= np.float32(math.log(SHRINK))
        shared = -np.expm1(0.5 * np.log1p(-np.minimum(opacity[chosen[~large]], 1 - 1e-6)))
        logits[rows[~large]] = np.log(shared / (1 - shared))
    return replace(g.take(index), means=means, log_scales=logs, opacity_logits=logits), origin


def _wide(mask: np.ndarray, like: np.ndarray) -> np.ndarray:
    return mask.reshape(-1, *(1,) * (like.ndim - 1))
