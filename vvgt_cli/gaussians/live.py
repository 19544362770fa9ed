"""Gaussians that carry the volume's values, and their look under any function (docs/live.md).

Each Gaussian stores the mean value m and standard deviation s of the field under it, the edge L of a cube of the volume
that it represents, the direction of the mean gradient, with the share r of s that the gradient explains as its length,
and the axis of the normals, for light (`closed_form.lit.relight`). For a function with extinction e and colour c,
the values are modelled as a normal distribution N(m, s). Each value covers w = 1 - exp(-e g) of the background over a
voxel's edge g. The Gaussian's extinction E covers as much as the values do on average; its colour is the mean of c
weighted by w, minus what neighbours, whose values have a wider spread, will mix in. Weighted by w, z = (v - m) / s has
a mean and a variance, by which the Gaussian moves along the gradient and becomes thinner in that direction. Where only
a tail of the distribution is seen, the extinction is lowered. Opaque Gaussians, with a large 1 - exp(-E L), become flat
in the surface, whose normal is the gradient, or the axis of the normals as far as that explains little. The opacity is
that of the optical mass E L^3 (`vvgt_cli.gaussians.opacity`). The means are tabulated over m and s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from vvgt_cli.gaussians.constants import MIN_ALPHA
from vvgt_cli.gaussians.frames import axes_of, factored
from vvgt_cli.gaussians.live_facts import AXIS, GRADIENT, LABEL_ROW, LAYER_ID
from vvgt_cli.gaussians.opacity import logits_of, mean_opacity, projected_areas
from vvgt_cli.gaussians.types import Gaussians
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.labels import Label
from vvgt_cli.look.tables import extinction

MEANS, SPREADS = 256, 32  # rows and columns of a table
WIDEST = 0.25  # largest spread of a table, as a share of the range of values
BEND = 1.5  # exponent of the column for spreads, which places small ones closer together
NODES = 33  # samples of the normal distribution, of equal weight
FINE = 1 << 14  # values over the range at which a function is tabulated
SHORTEST, LONGEST = 1e-5, 2.0  # bounds of L, unit-frame lengths
CLEAR = MIN_ALPHA / 8  # optical depth below which nothing is visible, however thin
SHARP = 0.3  # factor of an opaque Gaussian's variance across its surface
TAIL = 1.4, 2.0  # mean abs(z) of what is seen, from which on it counts less, and from which on not at all
AROUND = 1.6  # spread of the values of a Gaussian and its neighbours, which overlap it, per its own spread
AMOUNT = 0.45  # share of the neighbours' effect on its colour to compensate (as in `closed_form.sharpen`)
OPAQUE = 1 - 1e-6  # largest opacity of a look; the smallest is 1 minus this, so that logits are finite
FACE_ON = 1.5  # power of the areas that opacities are weighted by: seen edge on, Gaussians of a sheet lie in a row
THINNEST = 0.15  # smallest factor of the width along the gradient
TAU, FIRST, SECOND = 3, 4, 5  # channels of a table, after r, g and b
VALUE, SPREAD, LENGTH = 0, 1, 2  # columns of `Gaussians.live`


@dataclass(frozen=True)
class Table:
    """A function's means over normal distributions of values.

    Attributes:
        lo, hi: range of the values; outside it the ends' colour and extinction are used.
        sums: (MEANS, SPREADS, 6) float64 extinction per unit-frame length times r, g, b, 1, z and z^2.
    """

    lo: float
    hi: float
    sums: np.ndarray

    @classmethod
    def of_function(cls, tf: TransferFunction, lo: float, hi: float, unit_distance: float, grain: float) -> Table:
        """Return the table of a function on data values, whose opacity is per ``unit_distance``.

        ``grain`` is a voxel's edge (`LiveFacts.grain`), over which a value covers the background; both are unit-frame
        lengths.
        """
        x = lo + (hi - lo) * np.linspace(0, 1, FINE)
        tau = extinction(tf.opacity(x), unit_distance)
        covers = -np.expm1(-tau * grain)
        fine = np.concatenate([tf.color(x) * covers[:, None], covers[:, None]], axis=1)
        nodes = law_nodes()
        found, near = _samples_of(fine, nodes), _samples_of(fine, AROUND * nodes).mean(axis=2)
        moments = found[..., TAU, None] * np.stack([nodes, nodes**2], axis=1)
        sums = np.concatenate([found.mean(axis=2), moments.mean(axis=2)], axis=2)
        covered = np.maximum(sums[..., [TAU]], 1e-30)
        own = sums[..., :TAU] / covered
        mixed = np.where(near[..., [TAU]] > 0, near[..., :TAU] / np.maximum(near[..., [TAU]], 1e-30), own)
        sums[..., :TAU] = (own + AMOUNT * (own - mixed)).clip(0, 1) * sums[..., [TAU]]
        sums *= np.minimum(-np.log1p(-np.minimum(covered, OPAQUE)) / grain, tau.max()) / covered
        return cls(lo, hi, sums)

    def places(self, values: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return fractional rows and columns (K,) float64 for values and spreads (K,)."""
        width = (self.hi - self.lo) or 1.0
        row = ((values.astype(np.float64) - self.lo) / width).clip(0, 1) * (MEANS - 1)
        return row, (spread.astype(np.float64) / width / WIDEST).clip(0, 1) ** (1 / BEND) * (SPREADS - 1)

    def at(self, values: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """Return `sums` (K, 6), interpolated at values and spreads (K,)."""
        row, column = self.places(values, spread)
        i, j = np.minimum(row.astype(np.int64), MEANS - 2), np.minimum(column.astype(np.int64), SPREADS - 2)
        f, g = (row - i)[:, None], (column - j)[:, None]
        s = self.sums
        near, far = s[i, j] * (1 - g) + s[i, j + 1] * g, s[i + 1, j] * (1 - g) + s[i + 1, j + 1] * g
        return near * (1 - f) + far * f

    def of(self, live: np.ndarray) -> np.ndarray:
        """Return the `sums` (K, 6) for rows of `Gaussians.live`."""
        return self.at(live[:, VALUE], live[:, SPREAD])


@dataclass(frozen=True)
class Palette:
    """The counterpart of `Table` for labels, which neither move nor thin a Gaussian.

    Attributes:
        sums: (labels, 6) float64 extinction per unit-frame length times r, g, b, 1, 0 and 1.
    """

    sums: np.ndarray

    @classmethod
    def of_labels(cls, labels: Sequence[Label], unit_distance: float) -> Palette:
        """Return the palette of labels whose opacity is per ``unit_distance``, a unit-frame length."""
        tau = extinction(np.array([label.opacity for label in labels]), unit_distance)
        per = np.array([(*label.color, 1.0, 0.0, 1.0) for label in labels])
        return cls(per * tau[:, None])

    def of(self, live: np.ndarray) -> np.ndarray:
        """Return the `sums` (K, 6) for rows of `Gaussians.live`."""
        return self.sums[live[:, LABEL_ROW].astype(np.int64)]


@dataclass(frozen=True)
class LayerTables:
    """The tables of several layers, by number of the layer."""

    tables: tuple[Table | Palette, ...]

    def of(self, live: np.ndarray) -> np.ndarray:
        """Return the `sums` (K, 6) for rows of `Gaussians.live`."""
        found = np.zeros((len(live), 6))
        for number, table in enumerate(self.tables):
            own = np.flatnonzero(live[:, LAYER_ID] == number)
            found[own] = table.of(live[own])
        return found


Looks = Table | Palette | LayerTables


def law_nodes() -> np.ndarray:
    """Return quantiles (NODES,) of the normal distribution, scaled to variance 1."""
    law = NormalDist()
    found = np.array([law.inv_cdf((k + 0.5) / NODES) for k in range(NODES)])
    return found / found.std()


def spreads() -> np.ndarray:
    """Return the standard deviations (SPREADS,) of a table's columns, as shares of the range of values."""
    return WIDEST * (np.arange(SPREADS) / (SPREADS - 1)) ** BEND


def _samples_of(fine: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return rows of ``fine`` (FINE, 4) at the samples of each distribution, (MEANS, SPREADS, NODES, 4)."""
    at = np.linspace(0, 1, MEANS)[:, None, None] + spreads()[:, None] * nodes
    return fine[np.rint(at.clip(0, 1) * (FINE - 1)).astype(np.int64)]


def lengths(mass: np.ndarray, tau: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Return L (K,), unit-frame lengths, from optical masses, mean extinctions and largest volumes, each (K,)."""
    return np.cbrt(np.minimum(mass / np.maximum(tau, 1e-30), most)).clip(SHORTEST, LONGEST)


def baked(gaussians: Gaussians, table: Looks, pixel: float = 0.0) -> Gaussians:
    """Give Gaussians the colours and opacities of a look for other viewers, without moving them; see `apply_look`."""
    assert gaussians.live is not None
    sums = table.of(gaussians.live)
    colors = sums[:, :TAU] / np.maximum(sums[:, TAU, None], 1e-30)
    variances = np.exp(2 * gaussians.log_scales.astype(np.float64))
    logits = logits_of(opacities(without_tails(sums) * _volumes(gaussians), variances, pixel), 1 - OPAQUE)
    return replace(gaussians, opacity_logits=logits, colors=colors, harmonics=None)


def visible_under(gaussians: Gaussians, table: Looks, pixel: float = 0.0) -> np.ndarray:
    """Return the indices, ascending, of Gaussians that a look may show: all but some that are surely invisible."""
    assert gaussians.live is not None
    least = np.exp(2 * gaussians.log_scales.astype(np.float64)) * THINNEST**2 * SHARP
    mass = table.of(gaussians.live)[:, TAU] * _volumes(gaussians)
    return np.flatnonzero(mass > CLEAR * projected_areas(least, pixel).min(axis=1))


def apply_look(gaussians: Gaussians, table: Looks, pixel: float = 0.0) -> Gaussians:
    """Return Gaussians that carry values as ordinary, unlit Gaussians under a look.

    ``pixel`` is the width of a pixel of the target screen at the volume's centre, unit frame.
    """
    assert gaussians.live is not None
    if not len(gaussians):
        return replace(gaussians, live=None, harmonics=None)
    sums = table.of(gaussians.live)
    whole, tau = np.maximum(sums[:, TAU], 1e-30), without_tails(sums)
    first = sums[:, FIRST] / whole
    variance = np.maximum(sums[:, SECOND] / whole - first**2, 0)
    along, explained = directions(gaussians)
    opaque, facing = -np.expm1(-tau * gaussians.live[:, LENGTH]), explained**2
    thin = np.sqrt(np.maximum(1 - facing * (1 - variance), THINNEST**2) * (1 - opaque * facing * (1 - SHARP)))
    flat = np.sqrt(1 - opaque * (1 - facing) * (1 - SHARP))
    axes = axes_of(gaussians)
    narrow = _narrowed(axes, along, thin)
    quaternions, log_scales = factored(_narrowed(narrow, _within(narrow, gaussians.live[:, AXIS]), flat))
    return Gaussians(
        gaussians.means + np.einsum("kij,kj->ki", axes, along) * (explained * first)[:, None],
        log_scales,
        quaternions,
        logits_of(opacities(tau * _volumes(gaussians), np.exp(2 * log_scales), pixel), 1 - OPAQUE),
        sums[:, :TAU] / whole[:, None],
    )


def without_tails(sums: np.ndarray) -> np.ndarray:
    """Return the extinctions (K,) of ``sums`` (K, 6), less where only a tail of the normal distribution is seen.

    No value of a linear field under a Gaussian is as far from its mean as those: what shows only them is beside a body.
    """
    tau = sums[:, TAU]
    first, last = TAIL
    return tau * ((last - np.abs(sums[:, FIRST]) / np.maximum(tau, 1e-30)) / (last - first)).clip(0, 1)


def opacities(mass: np.ndarray, variances: np.ndarray, pixel: float) -> np.ndarray:
    """Return the peak alpha (n,) like `peak_opacity`, but vanishing with the ``mass`` (n,), and nearer that face on."""
    areas = projected_areas(variances, pixel)
    depths = mass[:, None] / areas
    return mean_opacity(depths + np.minimum(depths, MIN_ALPHA), areas**FACE_ON)


def _volumes(gaussians: Gaussians) -> np.ndarray:
    """Return the unit-frame volumes (K,) that Gaussians represent."""
    assert gaussians.live is not None
    return gaussians.live[:, LENGTH].astype(np.float64) ** 3


def directions(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient directions in units of each Gaussian's own axes, (K, 3) unit vectors, and r (K,)."""
    assert gaussians.live is not None
    gradient = gaussians.live[:, GRADIENT].astype(np.float64)
    return _within(axes_of(gaussians), gradient), np.minimum(np.linalg.norm(gradient, axis=1), 1)


def _within(axes: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return directions (K, 3) in units of the axes (K, 3, 3), unit vectors; zeros for zeros."""
    own = np.einsum("kij,ki->kj", axes, directions)
    return own / np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-30)


def _narrowed(axes: np.ndarray, own: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return axes (K, 3, 3) that are ``times`` (K,) as long along the directions ``own`` (K, 3), see `_within`."""
    arm = np.einsum("kij,kj->ki", axes, own)
    return axes + (arm * (times - 1)[:, None])[:, :, None] * own[:, None, :]
