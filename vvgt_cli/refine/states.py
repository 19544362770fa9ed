"""States of gradient descent: a state takes steps, draws itself, and can be put back to where it was.

`Densified` is 3DGS as it was published (Kerbl et al. 2023), for comparison: Gaussians are cloned, split and pruned on
the way. There, of 30,000 steps, every 100th from the 500th to the 15,000th densifies; here the same shares of the run,
but not before `FEWEST` views have been seen since the last time. Opacities are reset in every 3,000th step, where that
leaves `RECOVERY` steps to recover in. Clones share the opacity of what they were cloned from, ``1 - sqrt(1 - o)`` each
(Rota Bulo et al. 2024): twice the original would darken the picture.
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vvgt_cli.cameras import Blocks, Camera
from vvgt_cli.gaussians import INRIA, SH_C0, Gaussians, Rule
from vvgt_cli.gaussians.frames import axes_of, rotations
from vvgt_cli.refine import steps
from vvgt_cli.refine.loss import picture_slope
from vvgt_cli.refine.options import OptimizeOptions
from vvgt_cli.refine.shared import NONE, sample_of, shared_steps
from vvgt_cli.refine.steps import EPSILON
from vvgt_cli.splat import Projection, blend, project
from vvgt_cli.splat.render import (
    fields_backward,
    own_axes_backward,
    pair_sums,
    project_factors,
    screen_slopes,
    seen_colors,
)

MEMORY = 0.9  # share of the running error that a step keeps
WARM_UP = 3  # steps
SMALLEST = 1e-7  # standard deviation, unit frame
DAMPING = 0.1  # of the mean size of slopes, added to one's own: what is hardly seen goes less far than the rest
MEDIAN = 512  # of the sample that the median is of, or less than twice as many; all, where there are fewer
DAMPING_OF_SOME = 1.0  # instead, where some are free: descended on before, so only what is wrong now goes far
SLOPE_CAP = 100.0  # times the median: what a slope counts at most in that mean
KNOWN_HARMONICS_RATE = 0.3  # of the rate of harmonics, where the start has some (docs/log/light.md)

DEFAULT = OptimizeOptions()


def _has_harmonics(harmonics: np.ndarray | None) -> bool:
    """Return whether the highest degree of ``harmonics`` (K, M, 3), which has most of them, holds something."""
    if harmonics is None:
        return False
    degree = math.isqrt(harmonics.shape[1] + 1) - 1
    return bool(harmonics[:, degree**2 - 1 :].any())


class State(ABC):
    """What a descent works on, whatever its method and wherever it is.

    Attributes:
        STEADY: whether a fallen score puts the state back to its best, and a run without gain may stop.
    """

    STEADY = True

    @abstractmethod
    def step(
        self, camera: Camera, target: np.ndarray, share: float, speed: float, weight: np.ndarray | None = None
    ) -> None:
        """Step towards a view, ``target`` (h, w, 4); ``share`` in [0, 1] of the run lies behind.

        Rates are multiplied by ``speed``, differences from the view by ``weight`` (h, w).
        """

    @abstractmethod
    def picture(self, camera: Camera, rule: Rule, blocks: Blocks | None = None) -> np.ndarray:
        """Return (h, w, 4) as drawn by a rule; with ``blocks`` zero elsewhere."""

    @abstractmethod
    def saved(self) -> dict[str, np.ndarray]:
        """Return the arrays that a resumed run needs; those that descend are ``array_0``, ``array_1`` and so on."""

    @abstractmethod
    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Put back what `saved` gave."""

    @abstractmethod
    def gaussians(self) -> Gaussians:
        """Return the current Gaussians, as a file has them."""


class OnHost(State):
    """A state whose steps the CPU takes.

    Attributes:
        COLORS: number of the colours among the arrays; harmonics, if there are any, follow.
        arrays: what is descended on.
        running: Adam's two moments of each array that it takes one by one.
        error: running RMS error of the pictures.
        taken: number of steps.
    """

    COLORS: int
    arrays: tuple[np.ndarray, ...]
    running: list[np.ndarray]

    def __init__(self, options: OptimizeOptions) -> None:
        """Begin before the first step."""
        self.options, self.error, self.taken = options, math.nan, 0

    def step(
        self, camera: Camera, target: np.ndarray, share: float, speed: float, weight: np.ndarray | None = None
    ) -> None:
        """Draw, differentiate the loss, and `descend`; arguments as of `State.step`."""
        projection = self.project(camera, self.options.rule)
        image = blend(projection, np.maximum(self.colors_from(camera), 0), camera.height, camera.width)
        grad, now = picture_slope(image, target, self.options, weight)
        self.error = now if math.isnan(self.error) else MEMORY * self.error + (1 - MEMORY) * now
        self.descend(camera, projection, image, grad, share, speed)

    def picture(self, camera: Camera, rule: Rule, blocks: Blocks | None = None) -> np.ndarray:
        """Implement `State.picture`."""
        colors = np.maximum(self.colors_from(camera), 0)
        return blend(self.project(camera, rule), colors, camera.height, camera.width, blocks)

    def saved(self) -> dict[str, np.ndarray]:
        """Return the fields, their moments, and what is counted."""
        named = {f"array_{i}": array for i, array in enumerate(self.arrays)}
        named |= {f"running_{i}": array for i, array in enumerate(self.running)}
        return named | {"step": np.array(self.taken), "error": np.array(self.error)}

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Put back what `saved` gave."""
        self.arrays = tuple(saved[f"array_{i}"] for i in range(len(self.arrays)))
        self.running = [saved[f"running_{i}"] for i in range(len(self.running))]
        self.taken, self.error = int(saved["step"]), float(saved["error"])

    @property
    def harmonics(self) -> np.ndarray | None:
        """Harmonics of the colours, where there are any."""
        return self.arrays[self.COLORS + 1] if len(self.arrays) > self.COLORS + 1 else None

    def colors_from(self, camera: Camera) -> np.ndarray:
        """Return (K, 3) colours as the camera sees them, which may be negative."""
        return seen_colors(self.arrays[0], self.arrays[self.COLORS], self.harmonics, camera.position)

    @abstractmethod
    def project(self, camera: Camera, rule: Rule = INRIA) -> Projection:
        """Return the projection of the current Gaussians, by ``rule``."""

    @abstractmethod
    def descend(
        self, camera: Camera, projection: Projection, image: np.ndarray, grad: np.ndarray, share: float, speed: float
    ) -> None:
        """Take one step from a picture and the slope of the loss by it, (h, w, 4); others as of `State.step`."""


class OwnAxes(OnHost):
    """Covariance ``M M^T``; steps ``mu += M d``, ``M <- M (I + E + E^2 / 2)``, of opacity logits, colours, harmonics.

    Rates are proportional to the square root of the running RMS error of the pictures, and from the middle of the run
    on fall in a straight line to zero. Where Gaussians share what their steps have in common (`shared_steps`), or some
    are fixed, rates are multiplied by `OWN`, and slopes that are small beside the others' count less.
    Harmonics up to a degree that the start has go by `KNOWN_HARMONICS_RATE` of the rate of those that begin at zero.
    """

    # d, E on and off the diagonal, logit, colour, and what harmonics together change it (RMS over directions)
    RATES = np.array([0.05, 0.025, 0.0125, 0.03, 0.008, 0.008])
    OWN = np.array([0.75, 1.0, 1.0, 0.75, 0.75, 1.0])
    CLIPS = np.array([0.5, 1.0, 0.3])  # d, logit, E
    ERROR, LARGEST = 0.05, 1.5
    BETAS, COLORS = (0.6, 0.999), 3

    def __init__(
        self, gaussians: Gaussians, cameras: Sequence[Camera], options: OptimizeOptions = DEFAULT,
        free: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """Keep only ``free`` (K,) bool moving; None: all."""
        super().__init__(options)
        harmonics = gaussians.harmonics
        self.arrays = (
            gaussians.means.copy(),
            np.ascontiguousarray(axes_of(gaussians), np.float32),
            gaussians.opacity_logits.copy(),
            np.maximum(gaussians.colors, 0) if harmonics is None else gaussians.colors.copy(),
            *([] if harmonics is None else [harmonics.copy()]),
        )
        self.harmonic_rate = float(self.RATES[5]) * (KNOWN_HARMONICS_RATE if _has_harmonics(harmonics) else 1.0)
        self.running = [np.zeros_like(array) for array in self.arrays[4:] for _ in range(2)]
        self.darkest = 0.0 if harmonics is None else -math.inf  # what is negative may be lighter from elsewhere
        self.first, self.second = (np.zeros((steps.COUNT, len(gaussians)), np.float32) for _ in range(2))
        pixel = float(np.median([np.linalg.norm(camera.position) / camera.fx for camera in cameras]))
        self.spread = options.rule.dilation * pixel**2
        # what has been descended on before is not wrong alike any more
        self.shared = shared_steps(*self.arrays[:4]) if free is None else None
        self.damping = DAMPING_OF_SOME if free is not None else DAMPING if self.shared is not None else 0.0
        self.own_rates = self.RATES * self.OWN if self.damping else self.RATES
        self.fixed = np.empty(0, np.int64) if free is None else np.flatnonzero(~free)
        self.there = tuple(array[self.fixed] for array in self.arrays)

    def project(self, camera: Camera, rule: Rule = INRIA) -> Projection:
        """Return the projection of the current Gaussians, by ``rule``."""
        means, factors, logits = self.arrays[:3]
        return project_factors(means, factors, logits, camera, rule)

    def descend(
        self, camera: Camera, projection: Projection, image: np.ndarray, grad: np.ndarray, share: float, speed: float
    ) -> None:
        """Take one step, with harmonics where there are any."""
        means, factors, logits, colors = self.arrays[:4]
        harmonics, seen = self.harmonics, self.colors_from(camera)
        pairs = pair_sums(projection, seen, image, grad)
        rows, by_harmonics = own_axes_backward(means, factors, seen, camera, projection, pairs, harmonics)
        rates, pace = self.rates(share, speed)
        steps.own_axes(
            rows, rates, self.CLIPS, self.spread,
            *self.BETAS, self.taken, means, factors, logits, colors, self.darkest, self.first, self.second,
            *self.common(rows),
        )  # fmt: skip
        if harmonics is not None and by_harmonics is not None:
            rate = self.harmonic_rate * math.sqrt(4 * math.pi / harmonics.shape[1]) * pace
            first, second = (array.reshape(-1) for array in self.running)
            values, slope = harmonics.reshape(-1), by_harmonics.reshape(-1)
            steps.adam(values, slope, rate, *self.BETAS, self.taken, first, second)
        if len(self.fixed):
            for array, there in zip(self.arrays, self.there, strict=True):
                array[self.fixed] = there

    def pace(self, share: float, speed: float) -> float:
        """Count a step, and return the factor of its rates but for that of the running error."""
        self.taken += 1
        return speed * min(1.0, 2 * (1 - share)) * min(1.0, self.taken / WARM_UP)

    def rates(self, share: float, speed: float) -> tuple[np.ndarray, float]:
        """Count a step, and return the rates of its fields as of `RATES`, and the factor that they share."""
        pace = self.pace(share, speed) * min(self.LARGEST, math.sqrt(self.error / self.ERROR))
        return self.own_rates * pace, pace

    def common(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what is added to Adam's divisors, features and shared weights; from slopes ``rows`` (COUNT, K)."""
        if not self.damping:
            return np.full(len(rows), EPSILON, np.float32), *NONE
        every, count = sample_of(rows.shape[1])
        directions, sizes = np.empty((2, len(rows), count), np.float32)
        steps.adam_sizes(rows, self.first, self.second, *self.BETAS, self.taken, every, directions, sizes)
        few = sizes[:, :: max(count // MEDIAN, 1)]
        medians = [np.median(row[row > 0]) if (row > 0).any() else 0.0 for row in few]
        most = np.array([SLOPE_CAP * median for median in medians], np.float64)
        floors = np.empty(len(rows), np.float32)
        steps.adam_directions(sizes, most, self.damping, directions, floors)
        if self.shared is None:
            return floors, *NONE
        return floors, self.shared.features, self.shared.weights(directions)

    def saved(self) -> dict[str, np.ndarray]:
        """Implement `State.saved`."""
        shared = {} if self.shared is None else self.shared.saved()
        return super().saved() | shared | {"first": self.first.T, "second": self.second.T}

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Put back what `saved` gave."""
        super().restore(saved)
        self.first, self.second = (np.ascontiguousarray(saved[name].T) for name in ("first", "second"))
        if self.shared is not None:
            self.shared.restore(saved)

    def gaussians(self) -> Gaussians:
        """Return Gaussians as a file has them: principal axes of ``M M^T``."""
        from vvgt_cli.closed_form.cell_kernels import principal_axes
        from vvgt_cli.closed_form.shape import quaternions

        means, factors, logits, *colors = self.arrays
        spreads = factors.astype(np.float64) @ factors.transpose(0, 2, 1)
        variances, axes = np.empty((len(means), 3)), np.empty((len(means), 3, 3))
        principal_axes(spreads, variances, axes)
        log_scales = 0.5 * np.log(np.maximum(variances, SMALLEST**2))
        return Gaussians(means, log_scales, quaternions(axes), logits, *colors)


class Fields(OnHost):
    """Adam on the fields of `Gaussians` with the rates of 3DGS (Kerbl et al. 2023), nothing else of theirs."""

    RATES = (5e-4, 5e-3, 1e-3, 5e-2, 2.5e-3 * SH_C0, 2.5e-3 / 20)  # lengths: 1.6e-4 x an extent of 3.3
    BETAS, COLORS = (0.9, 0.999), 4

    def __init__(
        self, gaussians: Gaussians, cameras: Sequence[Camera], options: OptimizeOptions = DEFAULT,
        free: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """Begin at ``gaussians``, with moments of 0; all of them move."""
        super().__init__(options)
        self.arrays = tuple(array.copy() for array in gaussians.arrays().values())
        self.running = [np.zeros_like(array) for array in self.arrays for _ in range(2)]

    def project(self, camera: Camera, rule: Rule = INRIA) -> Projection:
        """Return the projection of the current Gaussians, by ``rule``."""
        return project(self.gaussians(), camera, rule)

    def descend(
        self, camera: Camera, projection: Projection, image: np.ndarray, grad: np.ndarray, share: float, speed: float
    ) -> None:
        """Take one step; error and schedule do not matter: 3DGS' rates are constant over so few steps."""
        seen = self.colors_from(camera)
        self.update(camera, projection, pair_sums(projection, seen, image, grad), seen, self.RATES)

    def update(
        self, camera: Camera, projection: Projection, pairs: np.ndarray, seen: np.ndarray, rates: Sequence[float]
    ) -> None:
        """Apply Adam with ``rates`` to the fields, from `pair_sums` of a picture with the colours ``seen`` (K, 3)."""
        gaussians = self.gaussians()
        slopes = fields_backward(gaussians, camera, projection, pairs, seen)
        self.taken += 1
        for i, field in enumerate(gaussians.arrays()):
            columns = self.arrays[i], getattr(slopes, field), *self.running[2 * i : 2 * i + 2]
            values, slope, moment, square = (array.reshape(-1) for array in columns)
            steps.adam(values, slope, rates[i], *self.BETAS, self.taken, moment, square)

    def gaussians(self) -> Gaussians:
        """Return the current Gaussians."""
        return Gaussians(*self.arrays)


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
        pairs = pair_sums(projection, seen, image, grad)
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
        old = origin >= 0
        self.running = [np.where(old.reshape(-1, *(1,) * (m.ndim - 1)), m[origin], 0) for m in self.running]
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
    opacity = g.opacity
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
