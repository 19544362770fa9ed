"""3DGS as it was published (Kerbl et al. 2023), for comparison: Gaussians are cloned, split and pruned on the way.

There, of 30,000 steps, every 100th from the 500th to the 15,000th densifies; here the same shares of the run, but not
before `FEWEST` views have been seen since the last time. Opacities are reset in every 3,000th step, where that
leaves `RECOVERY` steps to recover in. Clones share the opacity of what they were cloned from,
``1 - sqrt(1 - o)`` each (Rota Bulo et al. 2024): twice the original would darken the picture.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.frames import rotations
from vvgt_cli.refine.options import OptimizeOptions
from vvgt_cli.refine.states import Fields
from vvgt_cli.splat import Projection
from vvgt_cli.splat.render import moments, screen_slopes

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

    def __init__(self, gaussians: Gaussians, cameras: Sequence[Camera], options: OptimizeOptions) -> None:
        """Take the limit of Gaussians, or their number, and the random seed from ``options``."""
        super().__init__(gaussians, cameras)
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
        self,
        camera: Camera,
        projection: Projection,
        image: np.ndarray,
        grad: np.ndarray,
        error: float,
        share: float,
        speed: float,
    ) -> None:
        """Take one step, with density control where it is due."""
        seen = self.colors_from(camera)
        pairs = moments(projection, seen, image, grad)
        size = 3 * camera.width * camera.height  # their loss is a mean, ours a sum
        self.slopes += screen_slopes(projection, pairs) * (0.5 * max(camera.width, camera.height) / size)
        self.seen += projection.extent[:, 2] > projection.extent[:, 0]
        self.update(camera, projection, pairs, seen, (self.RATES[0] * FINAL_RATE**share, *self.RATES[1:]))
        if FIRST <= share <= LAST and share >= self.share + EVERY and self.step >= self.last + FEWEST:
            self._densify()
            self.last, self.share = self.step, share
        if share <= LAST and share >= self.share_reset + RESET:
            if self.step >= self.last_reset + RECOVERY:
                self._reset()
            self.last_reset, self.share_reset = self.step, share

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
        for index, moment in enumerate(self.running):
            kept = [np.where(_wide(origin >= 0, a), a[origin], 0) for a in moment]
            self.running[index] = (kept[0], kept[1])
        self._forget()

    def _reset(self) -> None:
        logits, most = self.arrays[3], math.log(RESET_TO / (1 - RESET_TO))
        np.minimum(logits, most, out=logits)
        for moment in self.running[3]:
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
