"""Descent along own axes on a CUDA device: what the CPU's kernels call, a step a handful of launches.

What is computed from the start (the numbers that Gaussians share, the axes' order) is made on the CPU. ``now`` is a
view's numbers (`splat.on_device`) and `NOW` more: the view's place among the targets, the pace but for the error's
part, and what undoes the moments' start from zero. ``course`` (2,) float64: the running error, and the pace. A step for
which there are too many pairs (`Splatter.fits`) changes nothing, and is taken again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.blocks import Blocks
from vvgt_cli.errors import DeviceFailed
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import Rule
from vvgt_cli.jit.gpu import SIMULATED, Recorded, cuda, free_bytes, gpu_kernel, sent
from vvgt_cli.refine.loss import KERNEL, error_slope, smooth_share
from vvgt_cli.refine.options import OptimizeOptions
from vvgt_cli.refine.shared import AGREEING, BOUNDS, PACE, RECALL, sample_of
from vvgt_cli.refine.states import MEDIAN, MEMORY, SLOPE_CAP, OwnAxes, State
from vvgt_cli.refine.steps import COUNT, EPSILON, FEATURES, KNOWN, RUN, adam_parts, clip, move_one
from vvgt_cli.splat.buffer import ZERO, f32
from vvgt_cli.splat.lanes import LANES
from vvgt_cli.splat.on_device import KERNELS as splatting
from vvgt_cli.splat.on_device import PAIRS, THREADS, VIEW, Splatter, sort_block, view_numbers

A_GAUSSIAN, A_PIXEL = 700, 60  # bytes: with moments, features, slopes and lists of pairs; with slopes
NOW = 4
PLACE, STEADY_PACE, FIX1, FIX2 = range(VIEW, VIEW + NOW)
ERROR, OWN_PACE = 0, 1
REACH = len(KERNEL) // 2
ADDERS = THREADS  # of blocks that add up
PARTIAL, FORETOLD = THREADS * KNOWN, (KNOWN, FEATURES)  # of the memory that a block shares
FEW = 2 * MEDIAN  # of a sample, those that the median is of, at most


@cuda.jit(device=True)
def sum_block(value, sums):  # type: ignore[no-untyped-def]
    """Return the sum of a value of each thread of the block, in a fixed order; ``sums`` is room for them."""
    i, ways = cuda.threadIdx.x, 16
    cuda.syncthreads()
    sums[i] = value
    cuda.syncthreads()
    if i < ways:
        for other in range(i + ways, cuda.blockDim.x, ways):
            sums[i] += sums[other]
    cuda.syncthreads()
    total = sums[0]
    for other in range(1, min(ways, cuda.blockDim.x)):
        total += sums[other]
    return total


@gpu_kernel("f4:3 f4:4 f4:3 f8:1 f4:1 f4:3")
def find_texture(image, targets, weights, now, window, fine):  # type: ignore[no-untyped-def]
    """Write the errors less their blur, weighted as `loss.weigh` does, into ``fine`` (h, w, 3), a thread a pixel."""
    p, (height, width), view = cuda.grid(1), fine.shape[:2], int(now[PLACE])
    if p >= height * width:
        return
    y, x = p // width, p % width
    e0 = e1 = e2 = b0 = b1 = b2 = squares = ZERO
    for v in range(max(y - REACH, 0), min(y + REACH + 1, height)):
        for u in range(max(x - REACH, 0), min(x + REACH + 1, width)):
            part, scale = window[v - y + REACH] * window[u - x + REACH], f32(1)
            if weights.shape[0] > 0:
                scale = weights[view, v, u]
            s0, s1, s2 = targets[view, v, u, 0], targets[view, v, u, 1], targets[view, v, u, 2]
            b0 += part * s0
            b1 += part * s1
            b2 += part * s2
            squares += part * (s0 * s0 + s1 * s1 + s2 * s2)
            e0 += part * scale * (image[v, u, 0] - s0)
            e1 += part * scale * (image[v, u, 1] - s1)
            e2 += part * scale * (image[v, u, 2] - s2)
    share, own = smooth_share(b0, b1, b2, squares), f32(1)
    if weights.shape[0] > 0:
        own = weights[view, y, x]
    fine[y, x, 0] = share * (own * (image[y, x, 0] - targets[view, y, x, 0]) - e0)
    fine[y, x, 1] = share * (own * (image[y, x, 1] - targets[view, y, x, 1]) - e1)
    fine[y, x, 2] = share * (own * (image[y, x, 2] - targets[view, y, x, 2]) - e2)


@gpu_kernel("f4:3 f4:4 f4:3 f8:1 f4:1 f4:3 f4:1 f4:3 f8:1")
def grade(image, targets, weights, now, window, fine, losses, grad, squares):  # type: ignore[no-untyped-def]
    """Write the slope of the loss by the picture into ``grad`` (h, w, 4), and r^2 of each block into ``squares``.

    ``losses``: weights of |r|, r^2, alpha and texture; ``fine`` is empty without texture.
    """
    p, (height, width), view = cuda.grid(1), image.shape[:2], int(now[PLACE])
    sums = cuda.shared.array(THREADS, np.float64)
    total, l1, l2, alpha, texture = 0.0, losses[0], losses[1], losses[2], f32(2) * losses[3]
    if p < height * width:
        y, x = p // width, p % width
        scale = f32(1)
        if weights.shape[0] > 0:
            scale = weights[view, y, x]
        t0 = t1 = t2 = ZERO
        if fine.shape[0] > 0:
            for v in range(max(y - REACH, 0), min(y + REACH + 1, height)):
                for u in range(max(x - REACH, 0), min(x + REACH + 1, width)):
                    part = window[v - y + REACH] * window[u - x + REACH]
                    t0 += part * fine[v, u, 0]
                    t1 += part * fine[v, u, 1]
                    t2 += part * fine[v, u, 2]
            t0, t1, t2 = fine[y, x, 0] - t0, fine[y, x, 1] - t1, fine[y, x, 2] - t2
        for f in range(4):
            r, weight = scale * (image[y, x, f] - targets[view, y, x, f]), alpha if f == 3 else f32(1)
            rough = t0 if f == 0 else t1 if f == 1 else t2 if f == 2 else ZERO
            grad[y, x, f] = scale * (weight * error_slope(r, l1, l2) + texture * rough)
            total += np.float64(weight * r * r)
    total = sum_block(total, sums)
    if cuda.threadIdx.x == 0:
        squares[cuda.blockIdx.x] = total


@gpu_kernel("f4:2 f4:2 f4:2 f8:1 f4:1 i8 f8 f4:2 f4:2 f4:1")
def direct(rows, first, second, now, betas, every, damping, towards, sizes, floors):  # type: ignore[no-untyped-def]
    """Do what `OwnAxes.common` does for a field, a block each: its divisors' floor, and directions of the sample."""
    row, i, count = cuda.blockIdx.x, cuda.threadIdx.x, sizes.shape[1]
    sums = cuda.shared.array(THREADS, np.float64)  # one a line, by which the simulator tells them apart
    few = cuda.shared.array(FEW, np.float32)
    fixed = betas[0], betas[1], f32(now[FIX1]), f32(now[FIX2])
    for n in range(i, count, cuda.blockDim.x):
        k = n + n // RUN * RUN * (every - 1)
        parts = adam_parts(rows[row, k], first[row, k], second[row, k], fixed)
        towards[row, n], sizes[row, n] = parts[2], parts[3]
    cuda.syncthreads()
    stride, positive = max(count // MEDIAN, 1), 0.0
    for n in range(i, FEW, cuda.blockDim.x):
        size = sizes[row, n * stride] if n * stride < count else ZERO
        few[n] = size if size > ZERO else f32(math.inf)
        positive += 1.0 if size > ZERO else 0.0
    seen = int(sum_block(positive, sums))
    sort_block(few, 0, FEW)
    bound, total = ZERO, 0.0
    if seen > 0:
        bound = f32(SLOPE_CAP) * (f32(0.5) * (few[(seen - 1) // 2] + few[seen // 2]))
    for n in range(i, count, cuda.blockDim.x):
        size = sizes[row, n]
        total += np.float64(size if size < bound else bound)
    floor = f32(damping * sum_block(total, sums) / count + EPSILON)
    if i == 0:
        floors[row] = floor
    for n in range(i, count, cuda.blockDim.x):
        way = towards[row, n] / (sizes[row, n] + floor)
        towards[row, n] = way if abs(way) < f32(math.inf) else ZERO


@gpu_kernel("f4:2 f4:2 f4:2")
def regress(solver, towards, plain):  # type: ignore[no-untyped-def]
    """Write ``plain`` (KNOWN, FEATURES), as `steps.regress` does without its gain, a block a feature."""
    f, i = cuda.blockIdx.x, cuda.threadIdx.x
    sums = cuda.shared.array(PARTIAL, np.float32)
    for row in range(KNOWN):
        total = ZERO
        for n in range(i, towards.shape[1], cuda.blockDim.x):
            total += solver[f, n] * towards[row if row < 6 else row + 3, n]
        sums[row * THREADS + i] = total
    cuda.syncthreads()
    for row in range(i, KNOWN, cuda.blockDim.x):
        total = ZERO
        for n in range(cuda.blockDim.x):
            total += sums[row * THREADS + n]
        plain[row, f] = total


@gpu_kernel("f8:1 f8 f8:1 f8:1 i8:1 i8 f4:2 f8:1 f4:2 f8:1")
def set_pace(squares, pixels, now, ranges, status, room, plain, last, weights, course):  # type: ignore[no-untyped-def]
    """Go on with the running error and the pace, and with what `SharedSteps` remembers, one block.

    ``pixels``: by which squares are divided; ``ranges``: `OwnAxes.ERROR` and `LARGEST`; ``last`` (KNOWN x FEATURES +
    2,): the last prediction, its factor and agreement, empty where nothing is shared; ``weights`` (KNOWN, FEATURES)
    gets ``plain`` times the factor.
    """
    i, shared = cuda.threadIdx.x, plain.size if last.shape[0] > 0 else 0
    sums = cuda.shared.array(THREADS, np.float64)
    if status[PAIRS] > room:
        return
    total = size = before = agreeing = 0.0
    for n in range(i, squares.shape[0], cuda.blockDim.x):
        total += squares[n]
    for n in range(i, shared, cuda.blockDim.x):
        value = np.float64(plain[n // FEATURES, n % FEATURES])
        size += value * value
        before += last[n] * last[n]
        agreeing += value * last[n]
        weights[n // FEATURES, n % FEATURES] = last[shared] * value
        last[n] = value
    total, size = sum_block(total, sums), sum_block(size, sums)
    before, agreeing = sum_block(before, sums), sum_block(agreeing, sums)
    size = math.sqrt(size * before)
    if i == 0:
        error = math.sqrt(total / pixels)
        if course[ERROR] >= 0.0:
            error = MEMORY * course[ERROR] + (1.0 - MEMORY) * error
        course[ERROR], course[OWN_PACE] = error, now[STEADY_PACE] * min(ranges[1], math.sqrt(error / ranges[0]))
        if shared > 0 and 0.0 < size < math.inf:
            last[shared + 1] = RECALL * last[shared + 1] + (1.0 - RECALL) * agreeing / size
            factor = last[shared] * math.exp(PACE * (last[shared + 1] - AGREEING))
            last[shared] = min(max(factor, BOUNDS[0]), BOUNDS[1])


@gpu_kernel("f4:2 f4:2 f4:2 f8:1 f4:1 f4:1 i1:3 f4:2 f8:1 f8:1 f8 i8:1 i8 f8:1 u1:1 f4:2 f4:3 f4:1 f4:2")
def move(  # type: ignore[no-untyped-def]
    rows, first, second, now, betas, floors, features, weights, rates, clips, spread, status, room, course, held,
    means, factors, logits, colors,
):  # fmt: skip
    """Step a Gaussian down its slopes, as `steps.own_axes` does, unless it is ``held``; colours do not go below 0."""
    k, i = cuda.grid(1), cuda.threadIdx.x
    foretold = cuda.shared.array(FORETOLD, np.float32)
    way = cuda.local.array(COUNT, np.float32)
    for n in range(i, KNOWN * FEATURES if features.shape[0] > 0 else 0, cuda.blockDim.x):
        foretold[n // FEATURES, n % FEATURES] = weights[n // FEATURES, n % FEATURES]
    cuda.syncthreads()
    if k >= means.shape[0] or status[PAIRS] > room:
        return
    fixed, pace = (betas[0], betas[1], f32(now[FIX1]), f32(now[FIX2])), course[OWN_PACE]
    for field in range(COUNT):
        m, v, towards, size = adam_parts(rows[field, k], first[field, k], second[field, k], fixed)
        first[field, k], second[field, k] = m, v
        way[field] = towards / (size + floors[field])
    if held[k]:
        return
    if features.shape[0] > 0:
        for row in range(KNOWN):
            total = ZERO
            for f in range(FEATURES):
                total += foretold[row, f] * f32(features[k // LANES, f, k % LANES])
            way[row if row < 6 else row + 3] += total
    back, row0, row1, row2 = move_one(
        (way[0], way[1], way[2], way[3], way[4], way[5], way[6], way[7], way[8]),
        (
            factors[k, 0, 0], factors[k, 0, 1], factors[k, 0, 2], factors[k, 1, 0], factors[k, 1, 1], factors[k, 1, 2],
            factors[k, 2, 0], factors[k, 2, 1], factors[k, 2, 2],
        ),
        (f32(rates[0] * pace), f32(rates[1] * pace), f32(rates[2] * pace)), (f32(clips[0]), f32(clips[2])), f32(spread),
    )  # fmt: skip
    means[k, 0] -= back[0]
    means[k, 1] -= back[1]
    means[k, 2] -= back[2]
    factors[k, 0, 0], factors[k, 0, 1], factors[k, 0, 2] = row0
    factors[k, 1, 0], factors[k, 1, 1], factors[k, 1, 2] = row1
    factors[k, 2, 0], factors[k, 2, 1], factors[k, 2, 2] = row2
    logits[k] -= clip(way[9] * f32(rates[3] * pace), f32(clips[1]))
    for axis in range(3):
        colors[k, axis] = max(colors[k, axis] - way[10 + axis] * f32(rates[4] * pace), ZERO)


KERNELS = *splatting, find_texture, grade, direct, regress, set_pace, move


def unfit(gaussians: Gaussians, options: OptimizeOptions) -> str | None:
    """Return why descent from Gaussians by such options is the CPU's; None where a device does it."""
    if options.method != "axes":
        return f"the method {options.method}"
    if gaussians.harmonics is not None:
        return "colours that depend on the view"
    return "SSIM in the loss" if options.ssim > 0 else None


@contextmanager
def _failing() -> Iterator[None]:
    """Raise what fails in the body, of the driver, the compiler or numba, which share no class, as `DeviceFailed`."""
    try:
        yield
    except DeviceFailed:
        raise
    except Exception as fault:
        raise DeviceFailed(" ".join(f"{type(fault).__name__}: {fault}".split())[:200]) from None


class _Views:
    """Training views of one size: their pictures on the device, and what a step on one of them writes."""

    def __init__(self, state: OwnAxesOnDevice, cameras: list[Camera], weighted: bool) -> None:
        height, width, stream = cameras[0].height, cameras[0].width, state.stream
        self.splatter = Splatter(len(state.rows[0]), width, height, state.options.rule, stream, summed=True)
        self.places = {id(camera): place for place, camera in enumerate(cameras)}
        self.targets = cuda.device_array((len(cameras), height, width, 4), np.float32, stream=stream)
        self.weights = cuda.device_array((len(cameras) * weighted, height, width), np.float32, stream=stream)
        fine = (height, width, 3) if state.options.texture > 0 else (0, 0, 3)
        self.fine, self.grad = (
            cuda.device_array(shape, np.float32, stream=stream) for shape in (fine, (height, width, 4))
        )
        self.blocks = -(-height * width // THREADS), THREADS, stream
        self.squares = cuda.device_array(self.blocks[0], np.float64, stream=stream)
        self.pixels = float((3 + state.options.alpha) * height * width)
        self.here: set[int] = set()
        self.stream, self.launch = stream, partial(state.launch, self)
        self.again = Recorded(self.launch, stream)

    def send(self, camera: Camera, target: np.ndarray, weight: np.ndarray | None) -> int:
        """Send a view's picture unless it is there, and return its place among the views."""
        place = self.places[id(camera)]
        if place not in self.here:
            self.targets[place].copy_to_device(np.ascontiguousarray(target, np.float32), self.stream)
            if weight is not None:
                self.weights[place].copy_to_device(np.ascontiguousarray(weight, np.float32), self.stream)
            self.here.add(place)
        return place

    def settle(self) -> None:
        """Wait for a step; take it again where there was no room for its pairs."""
        while not self.splatter.fits():
            self.again = Recorded(self.launch, self.stream)
            self.again()


class OwnAxesOnDevice(State):
    """`OwnAxes` whose steps a CUDA device takes, and whose pictures it draws.

    A step is only begun: the next one, or whoever asks for the state, waits for it.

    Attributes:
        host: the state on the CPU, as it was when it was last asked for.
    """

    def __init__(
        self, gaussians: Gaussians, cameras: Sequence[Camera], options: OptimizeOptions, free: np.ndarray | None = None
    ) -> None:
        """Put the start on the device; ``free`` as of `OwnAxes`.

        Raises:
            DeviceFailed: less memory is free there than is needed.
        """
        self.host, self.options, self.cameras = OwnAxes(gaussians, cameras, options, free), options, list(cameras)
        self.views: dict[tuple[int, int], _Views] = {}
        self.drawn: dict[tuple[int, int, Rule], Splatter] = {}
        self.waiting: _Views | None = None
        with _failing():
            self._send(len(gaussians))

    def _send(self, count: int) -> None:
        """Take memory, and put there what does not change."""
        host, options = self.host, self.options
        shared = host.shared
        pixels = [camera.width * camera.height for camera in self.cameras]
        needed, available = A_GAUSSIAN * count + A_PIXEL * max(pixels) + 16 * sum(pixels), free_bytes()
        if needed > available:
            raise DeviceFailed(f"steps need {needed / 1e9:.1f} GB, of which {available / 1e9:.1f} are free")
        self.stream = stream = 0 if SIMULATED else cuda.stream()
        sample, held = np.zeros((COUNT, sample_of(count)[1]), np.float32), np.zeros(count, np.uint8)
        held[host.fixed] = 1
        floors, weights = np.full(COUNT, EPSILON, np.float32), np.zeros((KNOWN, FEATURES), np.float32)
        features = np.zeros((0, FEATURES, LANES), np.int8) if shared is None else shared.features
        solver = np.zeros((FEATURES, 0), np.float32) if shared is None else shared.solver
        losses = np.array([options.l1, options.l2, options.alpha, options.texture], np.float32)
        (self.held, self.rows, self.towards, self.sizes, self.floors, self.weights, self.plain, self.features,
         self.solver, self.losses, self.window, self.now, self.ranges, self.betas, self.rates, self.clips) = sent(
            (held, np.zeros((COUNT, count), np.float32), sample, sample, floors, weights, weights, features, solver,
             losses, KERNEL, np.zeros(VIEW + NOW), np.array([host.ERROR, host.LARGEST]),
             np.array(host.BETAS, np.float32), host.own_rates, host.CLIPS), stream,
        )  # fmt: skip
        self.sent = sent(self._changing(), stream)

    def _changing(self) -> tuple[np.ndarray, ...]:
        """Return what steps change, from the host: four arrays, two moments, the course, what `SharedSteps` has."""
        host = self.host
        course = np.array([-1.0 if math.isnan(host.error) else host.error, 0.0])
        last = np.empty(0) if host.shared is None else host.shared.last()
        return *host.arrays, host.first, host.second, course, last

    def step(
        self, camera: Camera, target: np.ndarray, share: float, speed: float, weight: np.ndarray | None = None
    ) -> None:
        """Begin a step; arguments as of `State.step`.

        Raises:
            DeviceFailed: the device is lost, or full.
        """
        size = camera.height, camera.width
        with _failing():
            if size not in self.views:
                alike = [other for other in self.cameras if (other.height, other.width) == size]
                self.views[size] = _Views(self, alike, weight is not None)
            place = self.views[size].send(camera, target, weight)  # while the step before is taken
            self._settle()
            pace, (b1, b2) = self.host.pace(share, speed), self.host.BETAS
            fixes = 1 / (1 - b1**self.host.taken), 1 / (1 - b2**self.host.taken)
            self.now.copy_to_device(np.append(view_numbers(camera), (place, pace, *fixes)), self.stream)
            self.waiting = self.views[size]
            self.waiting.again()

    def launch(self, views: _Views) -> None:
        """Launch the kernels of a step on the view in ``now``."""
        means, factors, logits, colors, first, second, course, last = self.sent
        host, stream, splatter, now = self.host, self.stream, views.splatter, self.now
        seen = splatter.image, views.targets, views.weights, now, self.window, views.fine
        splatter.draw(means, factors, logits, colors, now)
        if self.options.texture > 0:
            find_texture[views.blocks](*seen)
        grade[views.blocks](*seen, self.losses, views.grad, views.squares)
        splatter.slopes(means, factors, colors, now, views.grad, self.rows)
        moving, room = (self.rows, first, second, now, self.betas), (splatter.status, splatter.room)
        if host.damping:
            every = sample_of(len(self.held))[0]
            direct[COUNT, ADDERS, stream](*moving, every, host.damping, self.towards, self.sizes, self.floors)
        if host.shared is not None:
            regress[FEATURES, ADDERS, stream](self.solver, self.towards, self.plain)
        set_pace[1, ADDERS, stream](
            views.squares, views.pixels, now, self.ranges, *room, self.plain, last, self.weights, course
        )
        move[-(-len(self.held) // THREADS), THREADS, stream](
            *moving, self.floors, self.features, self.weights, self.rates, self.clips, host.spread, *room, course,
            self.held, means, factors, logits, colors,
        )  # fmt: skip

    def _settle(self) -> None:
        """Wait for the step that was begun last."""
        if self.waiting is not None:
            self.waiting.settle()
            self.waiting = None

    def picture(self, camera: Camera, rule: Rule, blocks: Blocks | None = None) -> np.ndarray:
        """Return (h, w, 4) as drawn by a rule; with ``blocks`` zero elsewhere.

        Raises:
            DeviceFailed: the device is lost, or full.
        """
        key = camera.width, camera.height, rule
        with _failing():
            self._settle()
            if key not in self.drawn:
                self.drawn[key] = Splatter(len(self.held), *key, self.stream)
            splatter, view = self.drawn[key], sent(view_numbers(camera), self.stream)
            tiles = None if blocks is None else sent(np.asarray(blocks.numbers, np.int64), self.stream)
            means, factors, logits, colors = self.sent[:4]
            splatter.draw(means, factors, logits, colors, view, tiles)
            while not splatter.fits():
                splatter.draw(means, factors, logits, colors, view, tiles)
            image: np.ndarray = splatter.image.copy_to_host(stream=self.stream)
        return image

    def _fetch(self) -> OwnAxes:
        """Return the state as it is now, on the host."""
        with _failing():
            self._settle()
            *arrays, first, second, course, last = (array.copy_to_host() for array in self.sent)
        host = self.host
        host.arrays, host.first, host.second = tuple(arrays), first, second
        host.error = math.nan if course[ERROR] < 0 else float(course[ERROR])
        if host.shared is not None:
            host.shared.restore({"last": last})
        return host

    def saved(self) -> dict[str, np.ndarray]:
        """Return what `OwnAxes` saves."""
        return self._fetch().saved()

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Put back what `saved` gave."""
        self.host.restore(saved)
        with _failing():
            self._settle()
            for there, here in zip(self.sent, self._changing(), strict=True):
                there.copy_to_device(here, self.stream)

    def gaussians(self) -> Gaussians:
        """Return the current Gaussians, as a file has them."""
        return self._fetch().gaussians()
