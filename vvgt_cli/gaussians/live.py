"""Gaussians that carry what the volume is under them, and their look under any function (docs/live.md).

Of each Gaussian the field's mean value m and standard deviation s under it, the edge L of a cube as large as what it
stands for, and the direction of the mean gradient, as long as the share r of s that the gradient explains. Under a
function of extinction e and colour c the values under it are taken as a normal law N(m, s), of which each covers
w = 1 - exp(-e g) of what is behind a voxel, g, of it: E is the extinction that covers as much as they do together, the
colour is the mean of c weighted by w, less what neighbours, whose values are spread wider, will mix in. Where the value
z = (v - m) / s lies along the gradient, there lies the Gaussian: weighted by w, z has a mean and a variance, by which
the Gaussian moves along the gradient and becomes thinner there. What is opaque, 1 - exp(-E L), is smaller than fog,
which overlaps, and flat in the surface that the gradient is the normal of. The opacity is that of the optical mass
E L^3 (`vvgt_cli.gaussians.opacity`). The means are a table over m and s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from vvgt_cli.gaussians.constants import MIN_ALPHA
from vvgt_cli.gaussians.frames import factored, rotations
from vvgt_cli.gaussians.live_facts import GRADIENT, NUMBER, ROW
from vvgt_cli.gaussians.opacity import mean_opacity, projected_areas
from vvgt_cli.gaussians.types import Gaussians
from vvgt_cli.look.function import TransferFunctionLike
from vvgt_cli.look.labels import Label
from vvgt_cli.look.tables import extinction

MEANS, SPREADS = 256, 32  # rows and columns of a table
WIDEST = 0.25  # share of the range of values: the largest spread of a table
BEND = 1.5  # power of the column by which spreads grow: small ones lie closer
NODES = 33  # of the normal law, of equal weight
FINE = 1 << 14  # values over the range that a function is tabulated at
SHORTEST, LONGEST = 1e-5, 2.0  # unit-frame lengths that L is kept within
CLEAR = MIN_ALPHA / 8  # depth below which nothing is seen, however thin
SHARP, FLAT = 0.3, 0.8  # of the variance across the surface, and along the others, of what is opaque
AROUND = 1.6  # spread of the values of a Gaussian and its neighbours, which pictures mix with it, in its own
AMOUNT = 0.45  # of what they change of its colour, which is put in before (as `closed_form.sharpen` does)
OPAQUE = 1 - 1e-6  # largest opacity that a look has, and one less the smallest: logits are finite
THINNEST = 0.15  # times as wide as before, at least, along the gradient
TAU, FIRST, SECOND = 3, 4, 5  # of a table's channels, after r, g and b
VALUE, SPREAD, LENGTH = 0, 1, 2  # of the columns that Gaussians carry


@dataclass(frozen=True)
class Table:
    """A function's means over normal laws of values.

    Attributes:
        lo, hi: range of the values; beyond it the ends' colour and extinction are taken.
        sums: (MEANS, SPREADS, 6) float64 extinction per unit-frame length times r, g, b, 1, z and z^2.
    """

    lo: float
    hi: float
    sums: np.ndarray

    @classmethod
    def of_function(cls, tf: TransferFunctionLike, lo: float, hi: float, unit_distance: float, grain: float) -> Table:
        """Of a function on data values whose opacity is per ``unit_distance``; that and ``grain``: unit-frame lengths.

        ``grain``: a voxel's edge (`LiveFacts.grain`), over which values beside each other cover what is behind them.
        """
        x = lo + (hi - lo) * np.linspace(0, 1, FINE)
        tau = extinction(tf.opacity(x), unit_distance)
        covers = -np.expm1(-tau * grain)
        fine = np.concatenate([tf.color(x) * covers[:, None], covers[:, None]], axis=1)
        nodes = law_nodes()
        found, near = _under(fine, nodes), _under(fine, AROUND * nodes).mean(axis=2)
        moments = found[..., TAU, None] * np.stack([nodes, nodes**2], axis=1)
        sums = np.concatenate([found.mean(axis=2), moments.mean(axis=2)], axis=2)
        covered = np.maximum(sums[..., [TAU]], 1e-30)
        own = sums[..., :TAU] / covered
        mixed = np.where(near[..., [TAU]] > 0, near[..., :TAU] / np.maximum(near[..., [TAU]], 1e-30), own)
        sums[..., :TAU] = (own + AMOUNT * (own - mixed)).clip(0, 1) * sums[..., [TAU]]
        sums *= np.minimum(-np.log1p(-np.minimum(covered, OPAQUE)) / grain, tau.max()) / covered
        return cls(lo, hi, sums)

    def places(self, values: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column, not whole, (K,) float64 of values and spreads (K,)."""
        width = (self.hi - self.lo) or 1.0
        row = ((values.astype(np.float64) - self.lo) / width).clip(0, 1) * (MEANS - 1)
        return row, (spread.astype(np.float64) / width / WIDEST).clip(0, 1) ** (1 / BEND) * (SPREADS - 1)

    def at(self, values: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """(K, 6) `sums` between the rows and columns of values and spreads (K,)."""
        row, column = self.places(values, spread)
        i, j = np.minimum(row.astype(np.int64), MEANS - 2), np.minimum(column.astype(np.int64), SPREADS - 2)
        f, g = (row - i)[:, None], (column - j)[:, None]
        s = self.sums
        near, far = s[i, j] * (1 - g) + s[i, j + 1] * g, s[i + 1, j] * (1 - g) + s[i + 1, j + 1] * g
        found: np.ndarray = near * (1 - f) + far * f
        return found

    def of(self, live: np.ndarray) -> np.ndarray:
        """(K, 6) `sums` of what Gaussians carry."""
        return self.at(live[:, VALUE], live[:, SPREAD])


@dataclass(frozen=True)
class Palette:
    """A table of labels as `Table` has a function: no label moves or thins a Gaussian.

    Attributes:
        sums: (labels, 6) float64 extinction per unit-frame length times r, g, b, 1, 0 and 1.
    """

    sums: np.ndarray

    @classmethod
    def of_labels(cls, labels: Sequence[Label], unit_distance: float) -> Palette:
        """Of labels whose opacity is per ``unit_distance``, a unit-frame length."""
        tau = extinction(np.array([label.opacity for label in labels]), unit_distance)
        per = np.array([(*label.color, 1.0, 0.0, 1.0) for label in labels])
        return cls(per * tau[:, None])

    def of(self, live: np.ndarray) -> np.ndarray:
        """(K, 6) `sums` of what Gaussians carry."""
        found: np.ndarray = self.sums[live[:, ROW].astype(np.int64)]
        return found


@dataclass(frozen=True)
class Several:
    """Of several layers the table of each, by its number."""

    tables: tuple[Table | Palette, ...]

    def of(self, live: np.ndarray) -> np.ndarray:
        """(K, 6) `sums` of what Gaussians carry."""
        found = np.zeros((len(live), 6))
        for number, table in enumerate(self.tables):
            own = np.flatnonzero(live[:, NUMBER] == number)
            found[own] = table.of(live[own])
        return found


Looks = Table | Palette | Several


def law_nodes() -> np.ndarray:
    """(NODES,) quantiles of the normal law, stretched to its variance."""
    law = NormalDist()
    found = np.array([law.inv_cdf((k + 0.5) / NODES) for k in range(NODES)])
    stretched: np.ndarray = found / found.std()
    return stretched


def spreads() -> np.ndarray:
    """(SPREADS,) standard deviations of a table's columns, shares of the range of values."""
    found: np.ndarray = WIDEST * (np.arange(SPREADS) / (SPREADS - 1)) ** BEND
    return found


def _under(fine: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """(MEANS, SPREADS, NODES, 4) rows of ``fine`` (FINE, 4) at the values of each law, of ``nodes`` (NODES,)."""
    at = np.linspace(0, 1, MEANS)[:, None, None] + spreads()[:, None] * nodes
    found: np.ndarray = fine[np.rint(at.clip(0, 1) * (FINE - 1)).astype(np.int64)]
    return found


def lengths(mass: np.ndarray, tau: np.ndarray, most: np.ndarray) -> np.ndarray:
    """L (K,) of Gaussians of optical ``mass`` (K,) where the mean extinction is ``tau`` (K,), unit-frame lengths.

    ``most`` (K,): volume that they stand for at most.
    """
    found: np.ndarray = np.cbrt(np.minimum(mass / np.maximum(tau, 1e-30), most)).clip(SHORTEST, LONGEST)
    return found


def baked(gaussians: Gaussians, table: Looks, pixel: float = 0.0) -> Gaussians:
    """Gaussians that carry values, with the colours and opacities of a function, where they are: for other viewers.

    ``pixel``: as for `shown_by`.
    """
    assert gaussians.live is not None
    sums = table.of(gaussians.live)
    colors = sums[:, :TAU] / np.maximum(sums[:, TAU, None], 1e-30)
    variances = np.exp(2 * gaussians.log_scales.astype(np.float64))
    logits = _logits(opacities(sums[:, TAU] * _volumes(gaussians), variances, pixel))
    return replace(gaussians, opacity_logits=logits, colors=colors, harmonics=None)


def seen_under(gaussians: Gaussians, table: Looks, pixel: float = 0.0) -> np.ndarray:
    """Numbers of those that a function may show, ascending: all but some that nobody sees."""
    assert gaussians.live is not None
    least = np.exp(2 * gaussians.log_scales.astype(np.float64)) * THINNEST**2 * SHARP
    mass = table.of(gaussians.live)[:, TAU] * _volumes(gaussians)
    return np.flatnonzero(mass > CLEAR * projected_areas(least, pixel).min(axis=1))


def shown_by(gaussians: Gaussians, table: Looks, pixel: float = 0.0) -> Gaussians:
    """An ordinary cloud, unlit: what Gaussians that carry values are under a function, all of them.

    ``pixel``: a pixel's width at the volume's centre, unit frame, of the screen that they are made for.
    """
    assert gaussians.live is not None
    if not len(gaussians):
        return replace(gaussians, live=None, harmonics=None)
    sums = table.of(gaussians.live)
    tau = np.maximum(sums[:, TAU], 1e-30)
    first = sums[:, FIRST] / tau
    variance = np.maximum(sums[:, SECOND] / tau - first**2, 0)
    along, explained = directions(gaussians)
    opaque, facing = -np.expm1(-tau * gaussians.live[:, LENGTH]), explained**2
    thin = np.sqrt(np.maximum(1 - facing * (1 - variance), THINNEST**2) * (1 - opaque * facing * (1 - SHARP / FLAT)))
    axes = rotations(gaussians.quaternions.astype(np.float64))
    axes *= np.exp(gaussians.log_scales.astype(np.float64))[:, None, :]
    arm = np.einsum("kij,kj->ki", axes, along)
    quaternions, log_scales = factored(axes + (arm * (thin - 1)[:, None])[:, :, None] * along[:, None, :])
    variances = np.exp(2 * log_scales)
    shortest = np.arange(3) == variances.argmin(axis=1)[:, None]
    kept = np.where(shortest, (SHARP + (FLAT - SHARP) * facing)[:, None], FLAT)
    variances *= 1 - opaque[:, None] * (1 - kept)
    return Gaussians(
        gaussians.means + arm * (explained * first)[:, None],
        0.5 * np.log(variances),
        quaternions,
        _logits(opacities(tau * _volumes(gaussians), variances, pixel)),
        sums[:, :TAU] / tau[:, None],
    )


def opacities(mass: np.ndarray, variances: np.ndarray, pixel: float) -> np.ndarray:
    """Peak alpha (n,) as `peak_opacity`'s, but that what has hardly any mass (n,) is not seen."""
    areas = projected_areas(variances, pixel)
    depths = mass[:, None] / areas
    return mean_opacity(depths + np.minimum(depths, MIN_ALPHA), areas)


def _volumes(gaussians: Gaussians) -> np.ndarray:
    """(K,) unit-frame volumes that their extinction counts for."""
    assert gaussians.live is not None
    found: np.ndarray = gaussians.live[:, LENGTH].astype(np.float64) ** 3
    return found


def directions(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Where values rise in each Gaussian's own axes, in its standard deviations: (K, 3) unit vectors; and r (K,)."""
    assert gaussians.live is not None
    gradient = gaussians.live[:, GRADIENT].astype(np.float64)
    axes = rotations(gaussians.quaternions.astype(np.float64))
    along = np.einsum("kij,ki->kj", axes, gradient) * np.exp(gaussians.log_scales.astype(np.float64))
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-30)
    return along, np.minimum(np.linalg.norm(gradient, axis=1), 1)


def _logits(opacity: np.ndarray) -> np.ndarray:
    """Of opacities (K,), finite."""
    kept = opacity.clip(1 - OPAQUE, OPAQUE)
    found: np.ndarray = np.log(kept) - np.log1p(-kept)
    return found
