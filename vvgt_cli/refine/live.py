"""Descent on Gaussians that carry values: views under several functions, with what they show in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numba as nb
import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.live import LONGEST, MEANS, SHORTEST, SPREADS, Table, from_places, shown_by
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.jit.decorators import inlined, kernel
from vvgt_cli.refine import steps
from vvgt_cli.refine.states import WARM_UP, OwnFrame
from vvgt_cli.splat import Projection
from vvgt_cli.splat.render import moments, own_frame_backward, project_factors

LOGIT, COLOR = 9, 10  # rows of slopes
MOST, LEAST = np.float32(13.8), np.float32(1e-30)  # logit; extinction that a colour is divided by

_jit = inlined()


@_jit
def _cell(place: float, count: int) -> tuple[int, float]:
    """Row or column below a place in [0, 1], and how far beyond it."""
    at = min(max(place, 0.0), 1.0) * (count - 1)
    i = min(int(at), count - 2)
    return i, at - i


@kernel("f4:3 f4:2 f4:1 f4:1 f4:2", parallel=True)
def look_up(sums: np.ndarray, places: np.ndarray, lengths: np.ndarray, logits: np.ndarray, colors: np.ndarray) -> None:
    """Logits (K,) and colours (K, 3) by a table's ``sums`` of ``places`` (K, 3; the third unused), logs of lengths."""
    for k in nb.prange(len(places)):
        i, f = _cell(places[k, 0], MEANS)
        j, g = _cell(places[k, 1], SPREADS)
        tau = (sums[i, j, 3] * (1 - g) + sums[i, j + 1, 3] * g) * (1 - f)
        tau += (sums[i + 1, j, 3] * (1 - g) + sums[i + 1, j + 1, 3] * g) * f
        for c in range(3):
            color = (sums[i, j, c] * (1 - g) + sums[i, j + 1, c] * g) * (1 - f)
            color += (sums[i + 1, j, c] * (1 - g) + sums[i + 1, j + 1, c] * g) * f
            colors[k, c] = color / max(tau, LEAST)
        depth = tau * np.exp(lengths[k])
        logits[k] = min(max(np.log(max(np.expm1(depth), LEAST)), -MOST), MOST)


@kernel("f4:3 f4:2 f4:1 f4:2", parallel=True)
def chain(sums: np.ndarray, places: np.ndarray, lengths: np.ndarray, slopes: np.ndarray) -> None:
    """Slopes (COUNT, K) to logit and colour, in place, to log length and places; zero where nothing is shown."""
    for k in nb.prange(len(places)):
        i, f = _cell(places[k, 0], MEANS)
        j, g = _cell(places[k, 1], SPREADS)
        tau = across = along = 0.0
        a, b, c, d = sums[i, j, 3], sums[i, j + 1, 3], sums[i + 1, j, 3], sums[i + 1, j + 1, 3]
        tau = (a * (1 - g) + b * g) * (1 - f) + (c * (1 - g) + d * g) * f
        by_logit, by_mean, by_spread = slopes[LOGIT, k], 0.0, 0.0
        if not tau > LEAST:
            slopes[LOGIT, k] = slopes[COLOR, k] = slopes[COLOR + 1, k] = slopes[COLOR + 2, k] = 0.0
            continue
        along = (c * (1 - g) + d * g) - (a * (1 - g) + b * g)  # of tau, over f and g
        across = (b * (1 - f) + d * f) - (a * (1 - f) + c * f)
        for n in range(3):
            a, b, c, d = sums[i, j, n], sums[i, j + 1, n], sums[i + 1, j, n], sums[i + 1, j + 1, n]
            color = ((a * (1 - g) + b * g) * (1 - f) + (c * (1 - g) + d * g) * f) / tau
            slope = slopes[COLOR + n, k] / tau
            by_mean += slope * ((c * (1 - g) + d * g) - (a * (1 - g) + b * g) - color * along)
            by_spread += slope * ((b * (1 - f) + d * f) - (a * (1 - f) + c * f) - color * across)
        length = np.exp(lengths[k])
        depth = tau * length
        ratio = depth / -np.expm1(-depth) if depth > 1e-6 else 1.0  # d logit / d log length
        by_mean += by_logit * ratio / tau * along
        by_spread += by_logit * ratio / tau * across
        slopes[LOGIT, k] = by_logit * ratio
        slopes[COLOR, k] = by_mean * (MEANS - 1)
        slopes[COLOR + 1, k] = by_spread * (SPREADS - 1)
        slopes[COLOR + 2, k] = 0.0


class UnderFunctions(OwnFrame):
    """`OwnFrame` in which the log length takes the place of the logit, and value and spread that of the colour.

    Every view is of one function, by its camera's name; the tables turn what is shared into its colours and opacities.
    """

    RATES = np.array([0.05, 0.025, 0.0125, 0.03, 0.002, 0.0])
    STEADY = False  # every look is at other functions' views than the last steps

    def __init__(
        self, gaussians: Gaussians, cameras: Sequence[Camera], tables: Sequence[Table], which: Mapping[str, int],
        rule: Rule = INRIA,
    ) -> None:  # fmt: skip
        assert gaussians.live is not None
        super().__init__(shown_by(gaussians, tables[0]), cameras, rule)
        self.table, self.which = tables[0], which
        self.sums = [np.ascontiguousarray(table.sums, np.float32) for table in tables]
        means, factors = self.arrays[:2]
        row, column = self.table.places(*gaussians.live[:, :2].T.astype(np.float64))
        places = np.stack([row / (MEANS - 1), column / (SPREADS - 1), np.zeros(len(row))], axis=1)
        logs = np.log(gaussians.live[:, 2])
        self.arrays = means, factors, logs.astype(np.float32), np.ascontiguousarray(places, np.float32)
        self.rest = gaussians.live[:, 3:]
        self.shown: tuple[np.ndarray, np.ndarray] = (
            np.empty(len(means), np.float32),
            np.empty((len(means), 3), np.float32),
        )

    def colors_from(self, camera: Camera) -> np.ndarray:
        """Of the picture that `project` was asked for last."""
        return self.shown[1]

    def project(self, camera: Camera, rule: Rule = INRIA) -> Projection:
        """Under the function of the camera's view."""
        means, factors, logs, places = self.arrays
        look_up(self.sums[self.which[camera.name]], places, logs, *self.shown)
        return project_factors(means, factors, self.shown[0], camera, rule)

    def descend(
        self, camera: Camera, projection: Projection, image: np.ndarray, grad: np.ndarray, error: float, share: float,
        speed: float,
    ) -> None:  # fmt: skip
        """See `OwnFrame`."""
        means, factors, logs, places = self.arrays
        pairs = moments(projection, self.shown[1], image, grad)
        slopes = own_frame_backward(means, factors, self.shown[1], camera, projection, pairs, None)
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
        """As a file has them, under the first function."""
        means, factors, logs, places = self.arrays
        look_up(self.sums[0], places, logs, *self.shown)
        self.arrays = means, factors, self.shown[0], self.shown[1]
        try:
            found = super().gaussians()
        finally:
            self.arrays = means, factors, logs, places
        values = from_places(self.table, places[:, 0], places[:, 1])
        live = np.concatenate([values, np.exp(logs)[:, None], self.rest], axis=1)
        return Gaussians(**(found.arrays() | {"live": live}))
