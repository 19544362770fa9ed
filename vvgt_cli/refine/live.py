"""Descent on Gaussians that carry values: views under several functions, with what they show in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numba as nb
import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.live import (
    LENGTH,
    LONGEST,
    MEANS,
    SHORTEST,
    SPREAD,
    SPREADS,
    TAU,
    THINNEST,
    VALUE,
    Table,
    baked,
    directions,
)
from vvgt_cli.gaussians.live_facts import GRADIENT
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.jit.decorators import inlined, kernel
from vvgt_cli.refine import steps
from vvgt_cli.refine.states import WARM_UP, OwnFrame
from vvgt_cli.splat import Projection
from vvgt_cli.splat.render import moments, own_frame_backward, project_factors

LOGIT, COLOR = 9, 10  # rows of slopes
MOST, LEAST = 13.8, 1e-30  # logit; extinction that a colour is divided by

_jit = inlined()


@_jit
def _cell(place: float, count: int) -> tuple[int, float]:
    """Row or column below a place in [0, 1], and how far beyond it."""
    at = min(max(place, 0.0), 1.0) * (count - 1)
    i = min(int(at), count - 2)
    return i, at - i


@_jit
def _channel(sums: np.ndarray, i: int, j: int, f: float, g: float, n: int) -> tuple[float, float, float]:
    """A channel between rows and columns, and its slopes along both."""
    a, b, c, d = sums[i, j, n], sums[i, j + 1, n], sums[i + 1, j, n], sums[i + 1, j + 1, n]
    low, high = a * (1 - g) + b * g, c * (1 - g) + d * g
    return low * (1 - f) + high * f, high - low, (b - a) * (1 - f) + (d - c) * f


@kernel("f4:3 f4:2 f4:1 f4:2 f4:2 f4:3 f4:2 f4:3 f4:1 f4:2", parallel=True, error_model="numpy")
def look_up(
    sums: np.ndarray, places: np.ndarray, lengths: np.ndarray, along: np.ndarray, means: np.ndarray,
    factors: np.ndarray, moved: np.ndarray, thinner: np.ndarray, logits: np.ndarray, colors: np.ndarray,
) -> None:  # fmt: skip
    """What `vvgt_cli.gaussians.live.shown_by` says, of all Gaussians.

    Args:
        sums: (MEANS, SPREADS, 6) of a table.
        places: (K, 3) shares of its rows and columns; the third is not used.
        lengths: (K,) logs.
        along: (K, 3) direction in which values rise, own axes, as long as the share of the spread that it explains.
        means, factors: (K, 3), (K, 3, 3) of the Gaussians.
        moved, thinner, logits, colors: the same under the function, its logits (K,) and colours (K, 3).
    """
    for k in nb.prange(len(places)):
        i, f = _cell(places[k, 0], MEANS)
        j, g = _cell(places[k, 1], SPREADS)
        tau = max(_channel(sums, i, j, f, g, TAU)[0], LEAST)
        for c in range(3):
            colors[k, c] = _channel(sums, i, j, f, g, c)[0] / tau
        first = _channel(sums, i, j, f, g, TAU + 1)[0] / tau
        variance = max(_channel(sums, i, j, f, g, TAU + 2)[0] / tau - first * first, 0.0)
        share = along[k, 0] ** 2 + along[k, 1] ** 2 + along[k, 2] ** 2
        thin = np.sqrt(max(1 - share * (1 - variance), THINNEST * THINNEST))
        bend = (thin - 1) / max(share, LEAST)
        for row in range(3):
            m = factors[k, row]
            arm = m[0] * along[k, 0] + m[1] * along[k, 1] + m[2] * along[k, 2]
            moved[k, row] = means[k, row] + arm * first
            for c in range(3):
                thinner[k, row, c] = m[c] + arm * bend * along[k, c]
        depth = tau * np.exp(lengths[k]) / np.sqrt(thin)
        logits[k] = min(max(np.log(max(np.expm1(min(depth, MOST)), 1e-6)), -MOST), MOST)


@kernel("f4:3 f4:2 f4:1 f4:2", parallel=True, error_model="numpy")
def chain(sums: np.ndarray, places: np.ndarray, lengths: np.ndarray, slopes: np.ndarray) -> None:
    """Slopes (COUNT, K) to logit and colour, in place, to log length and places; zero where nothing is shown.

    That a Gaussian's place and width change with its value is left out.
    """
    for k in nb.prange(len(places)):
        i, f = _cell(places[k, 0], MEANS)
        j, g = _cell(places[k, 1], SPREADS)
        tau, down, across = _channel(sums, i, j, f, g, TAU)
        by_logit, by_mean, by_spread = slopes[LOGIT, k], 0.0, 0.0
        if not tau > LEAST:
            for n in range(LOGIT, COLOR + 3):
                slopes[n, k] = 0.0
            continue
        for n in range(3):
            color, by_row, by_column = _channel(sums, i, j, f, g, n)
            by_mean += slopes[COLOR + n, k] * (by_row - color / tau * down) / tau
            by_spread += slopes[COLOR + n, k] * (by_column - color / tau * across) / tau
        depth = tau * np.exp(lengths[k])
        ratio = depth / -np.expm1(-depth) if depth > 1e-6 else 1.0  # of logit to log length
        slopes[LOGIT, k] = by_logit * ratio
        slopes[COLOR, k] = (by_mean + by_logit * ratio / tau * down) * (MEANS - 1)
        slopes[COLOR + 1, k] = (by_spread + by_logit * ratio / tau * across) * (SPREADS - 1)
        slopes[COLOR + 2, k] = 0.0


class UnderFunctions(OwnFrame):
    """`OwnFrame` in which the log length takes the place of the logit, and value and spread that of the colour.

    Every view is of one function, by its camera's name; the tables turn what is shared into its colours and opacities.
    """

    RATES = np.array([0.05, 0.025, 0.0125, 0.03, 0.0005, 0.0])
    STEADY = False  # every look is at other functions' views than the last steps

    def __init__(
        self, gaussians: Gaussians, cameras: Sequence[Camera], tables: Sequence[Table], which: Mapping[str, int],
        rule: Rule = INRIA,
    ) -> None:  # fmt: skip
        assert gaussians.live is not None
        live = gaussians.live
        super().__init__(baked(gaussians, tables[0]), cameras, rule)
        self.table, self.which, self.live = tables[0], which, live
        self.sums = [np.ascontiguousarray(table.sums, np.float32) for table in tables]
        means, factors = self.arrays[:2]
        row, column = self.table.places(live[:, VALUE], live[:, SPREAD])
        places = np.stack([row / (MEANS - 1), column / (SPREADS - 1), np.zeros(len(row))], axis=1)
        self.arrays = means, factors, np.log(live[:, LENGTH]), np.ascontiguousarray(places, np.float32)
        along = np.einsum("kij,ki->kj", factors, live[:, GRADIENT])  # its columns are in another order than the file's
        along *= (directions(gaussians)[1] / np.maximum(np.linalg.norm(along, axis=1), LEAST))[:, None]
        self.along = np.ascontiguousarray(along, np.float32)
        shapes = means.shape, factors.shape, (len(means),), means.shape
        self.shown = [np.empty(shape, np.float32) for shape in shapes]  # means, factors, logits, colours

    def colors_from(self, camera: Camera) -> np.ndarray:
        """Of the picture that `project` was asked for last."""
        return self.shown[3]

    def project(self, camera: Camera, rule: Rule = INRIA) -> Projection:
        """Under the function of the camera's view."""
        means, factors, logs, places = self.arrays
        look_up(self.sums[self.which[camera.name]], places, logs, self.along, means, factors, *self.shown)
        moved, thinner, logits, _ = self.shown
        return project_factors(moved, thinner, logits, camera, rule)

    def descend(
        self, camera: Camera, projection: Projection, image: np.ndarray, grad: np.ndarray, error: float, share: float,
        speed: float,
    ) -> None:  # fmt: skip
        """See `OwnFrame`."""
        means, factors, logs, places = self.arrays
        moved, thinner, _, colors = self.shown
        pairs = moments(projection, colors, image, grad)
        slopes = own_frame_backward(moved, thinner, colors, camera, projection, pairs, None)
        chain(self.sums[self.which[camera.name]], places, logs, slopes.rows)
        self.step += 1
        pace = speed * min(1.0, 2 * (1 - share))
        pace *= min(self.LARGEST, (error / self.ERROR) ** 0.5) * min(1.0, self.step / WARM_UP)
        rates = self.RATES * pace if self.shared is None else self.RATES * self.OWN * pace
        steps.own_frame(
            slopes.rows, rates, self.CLIPS, self.spread,
            *self.BETAS, self.step, means, factors, logs, places, 0.0, self.first, self.second,
            *self.common(slopes.rows),
        )  # fmt: skip
        np.minimum(places, 1, out=places)
        np.clip(logs, np.log(SHORTEST), np.log(LONGEST), out=logs)

    def gaussians(self) -> Gaussians:
        """As a file has them, without a look: transparent by half, and black."""
        means, factors, logs, places = self.arrays
        self.arrays = means, factors, np.zeros_like(logs), np.zeros_like(means)
        try:
            found = super().gaussians()
        finally:
            self.arrays = means, factors, logs, places
        gradient = np.linalg.solve(factors.astype(np.float64).transpose(0, 2, 1), self.along[:, :, None])[:, :, 0]
        length = np.maximum(np.linalg.norm(gradient, axis=1), LEAST)
        live = self.live.copy()
        live[:, [VALUE, SPREAD]] = self.table.of_places(places[:, 0], places[:, 1])
        live[:, LENGTH] = np.exp(logs)
        live[:, GRADIENT] = gradient * (np.linalg.norm(self.along, axis=1) / length)[:, None]
        return Gaussians(**(found.arrays() | {"live": live}))
