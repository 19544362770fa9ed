"""Gaussians that carry what the volume is under them, and their look under any function (docs/live.md).

Of each Gaussian the field's mean value m and standard deviation s under it, and a length L. Under a function of
extinction e and colour c its extinction is the mean of e over the normal law N(m, s), its colour the mean of c weighted
by e, and its opacity 1 - exp(-extinction L). Both means are a table over m and s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from statistics import NormalDist

import numpy as np

from vvgt_cli.gaussians.types import Gaussians
from vvgt_cli.look.tables import extinction
from vvgt_cli.look.types import TransferFunctionLike

MEANS, SPREADS = 256, 32  # rows and columns of a table
WIDEST = 0.25  # share of the range of values: the largest spread of a table
BEND = 1.5  # power of the column by which spreads grow: small ones lie closer
NODES = 33  # of the normal law, of equal weight
FINE = 1 << 14  # values over the range that a function is tabulated at
SHORTEST, LONGEST = 1e-4, 1e2  # unit-frame lengths that L is kept within
OPAQUE = 1 - 1e-6  # largest opacity that a look has, and one less the smallest: logits are finite


@dataclass(frozen=True)
class Table:
    """A function's means over normal laws of values.

    Attributes:
        lo, hi: range of the values; beyond it the ends' colour and extinction are taken.
        sums: (MEANS, SPREADS, 4) float64 extinction times (r, g, b, 1) per unit-frame length.
    """

    lo: float
    hi: float
    sums: np.ndarray

    @classmethod
    def of(cls, tf: TransferFunctionLike, lo: float, hi: float, unit_distance: float) -> Table:
        """Of a function on data values whose opacity is per ``unit_distance``, a unit-frame length."""
        x = lo + (hi - lo) * np.linspace(0, 1, FINE)
        tau = extinction(tf.opacity(x), unit_distance)
        fine = np.concatenate([tf.color(x) * tau[:, None], tau[:, None]], axis=1)
        law = NormalDist()
        nodes = np.array([law.inv_cdf((k + 0.5) / NODES) for k in range(NODES)])
        at = np.linspace(0, 1, MEANS)[:, None, None] + spreads()[:, None] * nodes
        return cls(lo, hi, fine[np.rint(at.clip(0, 1) * (FINE - 1)).astype(np.int64)].mean(axis=2))

    @cached_property
    def colors(self) -> np.ndarray:
        """(MEANS, SPREADS, 4) float32 r, g, b and extinction: what a page fetches."""
        tau = self.sums[..., 3:]
        return np.concatenate([self.sums[..., :3] / np.maximum(tau, 1e-30), tau], axis=2).astype(np.float32)

    def places(self, values: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column, not whole, (K,) float64 of values and spreads (K,)."""
        width = (self.hi - self.lo) or 1.0
        row = ((values - self.lo) / width).clip(0, 1) * (MEANS - 1)
        return row, (spread / width / WIDEST).clip(0, 1) ** (1 / BEND) * (SPREADS - 1)

    def at(self, values: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """(K, 4) `sums` between the rows and columns of values and spreads (K,)."""
        row, column = self.places(values.astype(np.float64), spread.astype(np.float64))
        i, j = np.minimum(row.astype(np.int64), MEANS - 2), np.minimum(column.astype(np.int64), SPREADS - 2)
        f, g = (row - i)[:, None], (column - j)[:, None]
        s = self.sums
        near, far = s[i, j] * (1 - g) + s[i, j + 1] * g, s[i + 1, j] * (1 - g) + s[i + 1, j + 1] * g
        found: np.ndarray = near * (1 - f) + far * f
        return found


def spreads() -> np.ndarray:
    """(SPREADS,) standard deviations of a table's columns, shares of the range of values."""
    found: np.ndarray = WIDEST * (np.arange(SPREADS) / (SPREADS - 1)) ** BEND
    return found


def lengths(gaussians: Gaussians, tau: np.ndarray) -> np.ndarray:
    """L (K,) of Gaussians whose opacity stands for the mean extinction ``tau`` (K,), unit-frame lengths."""
    logits = gaussians.opacity_logits.astype(np.float64)
    depth = np.logaddexp(0, logits)  # -log(1 - opacity)
    found: np.ndarray = (depth / np.maximum(tau, 1e-30)).clip(SHORTEST, LONGEST)
    return found


def shown_by(gaussians: Gaussians, table: Table) -> Gaussians:
    """Gaussians that carry values, with the colours and opacities that a function gives them."""
    assert gaussians.live is not None
    value, spread, length = gaussians.live[:, :3].T
    sums = table.at(value, spread)
    opacity = -np.expm1(-sums[:, 3] * length.astype(np.float64))
    opacity = opacity.clip(1 - OPAQUE, OPAQUE)
    colors = sums[:, :3] / np.maximum(sums[:, 3:], 1e-30)
    logits = np.log(opacity) - np.log1p(-opacity)
    return replace(gaussians, opacity_logits=logits, colors=colors, harmonics=None)


def from_places(table: Table, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """(K, 2) values and spreads of places in a table, shares (K,) of its rows and of its columns."""
    width = (table.hi - table.lo) or 1.0
    value = table.lo + width * row.astype(np.float64)
    return np.stack([value, width * WIDEST * column.astype(np.float64) ** BEND], axis=1)
