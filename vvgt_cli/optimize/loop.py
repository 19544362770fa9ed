"""The loop: a view a step, looks at the check views in between, the best kept."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.metrics import psnr
from vvgt_cli.optimize import OptimizeOptions, OptimizeRecord, Progress
from vvgt_cli.optimize.states import Fields, OwnFrame
from vvgt_cli.splat import blend

GAIN = 0.01  # dB: less is none
MEMORY = 0.9  # of the running error, a step
SLOWER = 0.5  # rates, after a look that found no gain
State = OwnFrame | Fields
Check = tuple[Sequence[Camera], np.ndarray]


def run(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    images: np.ndarray,
    options: OptimizeOptions,
    check: Check | None,
    progress: Progress | None,
) -> tuple[Gaussians, OptimizeRecord]:
    """`optimize` without its defaults."""
    for name, (some, views) in {"training": (cameras, images), "check": check or (cameras, images)}.items():
        _fit(name, some, views)
    began = time.perf_counter()
    record = OptimizeRecord()
    state: State = (OwnFrame if options.method == "frame" else Fields)(gaussians, cameras)
    judge = _Judge(state, check, record)
    error, speed, order = None, 1.0, views_in_turn(len(cameras), options.seed)
    judge.look(0.0)
    record.psnr_before = judge.best
    while record.steps < options.steps:
        elapsed = time.perf_counter() - began
        if options.time_budget is not None and elapsed >= options.time_budget:
            record.reason = "time"
            break
        view = next(order)
        share = max(record.steps / options.steps, elapsed / options.time_budget if options.time_budget else 0.0)
        error = step(state, cameras[view], images[view], options, error, speed * _pace(share))
        record.steps += 1
        if progress:
            progress(record.steps, options.steps)
        if check and (record.steps % options.check_every == 0 or record.steps == options.steps):
            if not judge.look(time.perf_counter() - began):
                speed *= SLOWER
            if options.target_psnr is not None and judge.best is not None and judge.best >= options.target_psnr:
                record.reason = "target"
                break
            if judge.idle >= options.patience:
                record.reason = "no gain"
                break
    result = judge.result(gaussians)
    record.seconds = time.perf_counter() - began
    return result, record


def step(
    state: State, camera: Camera, target: np.ndarray, options: OptimizeOptions, error: float | None, pace: float
) -> float:
    """Forward, loss, backward, update for one view; takes and returns the running RMS error."""
    from vvgt_cli.optimize.loss import loss_gradient
    from vvgt_cli.optimize.ssim import add_ssim_gradient

    projection = state.project(camera)
    image = blend(projection, state.colors, camera.height, camera.width)
    grad = np.empty_like(image)
    l1, l2, alpha = np.float32(options.l1), np.float32(options.l2), np.float32(options.alpha)
    squares = loss_gradient(image, target, l1, l2, alpha, grad)
    if options.ssim > 0:
        add_ssim_gradient(image, target, options.ssim, grad)
    now = math.sqrt(squares / ((3 + options.alpha) * camera.height * camera.width))
    error = now if error is None else MEMORY * error + (1 - MEMORY) * now
    state.descend(camera, projection, image, grad, error, pace)
    return error


def views_in_turn(count: int, seed: int) -> Iterator[int]:
    """All views in random order, then again in another."""
    rng = np.random.default_rng(seed)
    while True:
        yield from map(int, rng.permutation(count))


def _pace(share: float) -> float:
    """Half a cosine over the run."""
    return 0.5 * (1 + math.cos(math.pi * min(share, 1.0)))


def _fit(name: str, cameras: Sequence[Camera], images: np.ndarray) -> None:
    if not len(cameras) or len(cameras) != len(images):
        raise DataError(f"{len(images)} {name} images for {len(cameras)} cameras; expected as many, and at least one")
    for camera, image in zip(cameras, images, strict=True):
        if image.shape != (camera.height, camera.width, 4):
            expected = (camera.height, camera.width, 4)
            raise DataError(f"{name} view {camera.name}: image of shape {image.shape}; expected {expected}")


class _Judge:
    """Looks at the check views, and remembers the best state that they have seen."""

    def __init__(self, state: State, check: Check | None, record: OptimizeRecord) -> None:
        self.state, self.check, self.record = state, check, record
        self.best: float | None = None
        self.kept: tuple[np.ndarray, ...] | None = None
        self.idle = 0

    def look(self, seconds: float) -> bool:
        """Score the state; True if it is the best so far. One that is worse is put back to the best."""
        if self.check is None:
            return True
        scores = []
        for camera, view in zip(*self.check, strict=True):
            image = blend(self.state.project(camera), self.state.colors, camera.height, camera.width)
            scores.append(psnr(view[..., :3], image[..., :3]))
        now, self.idle = float(np.mean(scores)), self.idle + 1
        self.record.checks.append((self.record.steps, seconds, now))
        if self.best is None or now > self.best + GAIN:
            self.idle = 0
        if self.best is None or now > self.best:
            self.best, self.kept, self.record.kept = now, tuple(a.copy() for a in self.state.arrays), self.record.steps
            return True
        assert self.kept is not None
        for array, kept in zip(self.state.arrays, self.kept, strict=True):
            array[...] = kept
        return False

    def result(self, start: Gaussians) -> Gaussians:
        """The best state as Gaussians; the input itself where nothing was better."""
        record = self.record
        record.psnr_after = self.best
        if self.check is None:
            record.kept = record.steps
        elif self.kept is not None:
            for array, kept in zip(self.state.arrays, self.kept, strict=True):
                array[...] = kept
        return self.state.gaussians() if record.kept else start
