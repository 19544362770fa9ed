"""Cases of transfer functions: tables against the function itself in float64, and what they promise of darkness."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.scenes import RAMP_RGB, RAMP_X, RAMP_Y, function, ramp, step
from vvgt_cli.errors import DataError
from vvgt_cli.look import TransferFunction, from_histogram, resolve
from vvgt_cli.look.tables import MAX_OPACITY, Optics, build_tables, extinction
from vvgt_cli.volume import Volume, statistics

STAGE = "function"
LARGEST = -math.log1p(-MAX_OPACITY)


def _tables(tf: TransferFunction, lo: float, hi: float, distance: float, slope: float) -> Optics:
    function: Any = tf  # frozen, the protocol's name is not
    return build_tables(function, (lo, hi), slope=slope, unit_distance=distance, world_per_unit=1.0)


def _table(tf: TransferFunction, lo: float = 0.0, hi: float = 1.0, distance: float = 1.0, slope: float = 1.0) -> Figure:
    """Tabulated extinction and colour at the bin edges, and their integral, against the function."""
    tables = _tables(tf, lo, hi, distance, slope)
    n = tables.bins
    require(np.isfinite(tables.nodes).all() and np.isfinite(tables.cumulative).all(), "values that are not finite")
    require((tables.nodes >= 0).all(), "negative extinction or colour")
    require((np.diff(tables.cumulative, axis=0) >= 0).all(), "an integral that falls")
    stored = tables.lo + np.arange(n + 1) / tables.inv_width
    x = np.clip(stored * slope, min(lo, hi), max(lo, hi))
    tau = extinction(tf.opacity(x), distance)
    inner = np.diff(np.searchsorted(tf.breakpoints(), x)) == 0  # no node within the bin on its left
    same = np.concatenate([[True], inner]) & np.concatenate([inner, [True]])
    exact = np.column_stack([tau[:, None] * tf.color(x), tau])
    scale = max(float(exact.max()), float(tables.nodes.max()), 1e-300)
    return Figure(
        "error of the table, relative", float(np.abs(tables.nodes - exact)[same].max(initial=0) / scale), 3e-6
    )  # constants get a range of 1e-6


def _dark(tf: TransferFunction) -> Figure:
    """Random intervals: transparent if and only if the table says so."""
    tables = _tables(tf, 0.0, 1.0, 1.0, 1.0)
    rng = np.random.default_rng(0)
    ends = np.sort(rng.uniform(0, tables.bins, (400, 2)) * rng.choice([1.0, 0.1], (400, 1)), axis=1)
    wrong = 0
    for low, high in ends:
        says = high <= tables.dark[int(low)]
        inside = np.interp(np.linspace(low, high, 400), np.arange(tables.bins + 1), tables.nodes[:, 3])
        wrong += bool(says and inside.max() > 0)
        wrong += bool(not says and tables.nodes[int(low) : math.ceil(high) + 1, 3].max() <= 0)
    return Figure("intervals judged wrongly", wrong, 0)


def _cap(distance: float) -> Figure:
    """Opacity 1 is an optical depth of 11.5 per unit distance, not infinity."""
    tables = _tables(function([0, 1], [1, 1]), 0, 1, distance, 1.0)
    return Figure("off the cap, relative", abs(tables.largest_extinction() * distance / LARGEST - 1), 1e-12)


def _outside() -> Figure:
    """NaN is transparent, and beyond the nodes their values stay."""
    tf = ramp()
    at = tf.opacity(np.array([np.nan, -np.inf, -1e300, 1e300, np.inf]))
    return Figure("opacity off", float(np.abs(at - [0, 0, 0, RAMP_Y[-1], RAMP_Y[-1]]).max()), 0)


def _bounded(sharpness: float, midpoint: float) -> Figure:
    """Bent segments stay between their ends, and colours in [0, 1]."""
    from vvgt_cli.look import PiecewiseOpacity

    x = np.array([0.0, 0.4, 0.4, 1.0])
    y = np.array([0.1, 0.9, 0.2, 0.7])
    curve = PiecewiseOpacity(x, y, np.full(4, midpoint), np.full(4, sharpness))
    values = curve(np.linspace(-0.5, 1.5, 5001))
    require(np.isfinite(values).all(), "values that are not finite")
    return Figure("beyond the ends by", float(max(0.1 - values.min(), values.max() - 0.9, 0.0)), 0)


def _stretched(lo: float, hi: float) -> Figure:
    """Stretched to a range, the function is the same at the same fractions."""
    tf, f = ramp(), np.linspace(0, 1, 101)
    wide = tf.rescaled(lo, hi)
    x = lo * (1 - f) + hi * f
    require(np.isfinite(wide.breakpoints()).all(), "nodes that are not finite")
    return Figure("opacity off", float(np.abs(wide.opacity(x) - tf.opacity(f)).max()), 1e-6)


def _made(data: np.ndarray) -> Figure:
    """A function made from the histogram shows something of the data and is finite."""
    numbers = statistics(Volume(data))
    tf = resolve(from_histogram(numbers), numbers)
    x = np.linspace(numbers.lo, numbers.hi, 1001)
    y, rgb = tf.opacity(x), tf.color(x)
    require(np.isfinite(y).all() and np.isfinite(rgb).all(), "values that are not finite")
    require(y.max() > 0, "a function that shows nothing")
    return Figure("beyond [0, 1] by", float(max(y.max() - 1, rgb.max() - 1, -rgb.min(), 0.0)), 0)


def _refused(x: object, y: object) -> Figure:
    try:
        function(x, y)
    except DataError:
        return Figure("accepted", 0, 0)
    return Figure("accepted", 1, 0)


def cases() -> Iterator[Case]:
    """All of them."""
    tables = {
        "step function": _p(step(0.8)),
        "step between two floats": _p(step(0.8, 1.2e-16)),
        "two nodes at one place": _p(function([0, 0.5, 0.5, 1], [0, 0, 1, 1])),
        "opacity 1 everywhere": _p(function([0, 1], [1, 1])),
        "spike of a millionth of the range": _p(function([0, 0.5, 0.5 + 1e-6, 0.5 + 2e-6, 1], [0, 0, 1, 0, 0])),
        "one node": _p(function([0.5], [0.4])),
        "constant data": _p(ramp(), 0.5, 0.5),
        "data beyond the last node": _p(ramp(), 5.0, 9.0),
        "data before the first node": _p(ramp(), -9.0, -5.0),
        "values of 1e-30": _p(ramp(1e-30), 0, 1e-30),
        "values of 1e30": _p(ramp(1e30), -1e30, 1e30),
        "unit distance 1e-30": _p(ramp(), 0, 1, 1e-30),
        "unit distance 1e30": _p(ramp(), 0, 1, 1e30),
        "stored values that fall": _p(ramp(), 0, 1, 1.0, -0.25),
        "thousand nodes": _p(function(np.linspace(0, 1, 1000), np.random.default_rng(0).uniform(0, 1, 1000))),
    }
    for name, run in tables.items():
        yield Case(STAGE, f"table: {name}", run)
    yield Case(STAGE, "dark intervals of a ramp", partial(_dark, function(RAMP_X, RAMP_Y, RAMP_RGB)))
    yield Case(
        STAGE, "dark intervals of a comb", partial(_dark, function(np.linspace(0, 1, 41), np.arange(41) % 4 == 2))
    )
    for distance in (1e-6, 1.0, 1e6):
        yield Case(STAGE, f"opacity 1 per {distance:g}", partial(_cap, distance))
    yield Case(STAGE, "NaN, infinities, beyond the nodes", _outside)
    for sharpness, midpoint in ((0.0, 0.0), (0.0, 1.0), (0.5, 0.001), (1.0, 0.5)):
        yield Case(STAGE, f"sharpness {sharpness:g}, midpoint {midpoint:g}", partial(_bounded, sharpness, midpoint))
    for lo, hi in ((0.0, 1e-30), (-1e300, 1e300), (1e6, 1e6 + 1)):
        yield Case(STAGE, f"stretched to [{lo:g}, {hi:.8g}]", partial(_stretched, lo, hi))
    made = {
        "constant": np.full((3, 3, 3), 4.0),
        "two values": (np.indices((4, 4, 4)).sum(axis=0) % 2).astype(np.uint8),
        "one outlier of 1e30": np.where(np.arange(64).reshape(4, 4, 4) == 5, 1e30, 0.0),
    }
    for name, data in made.items():
        yield Case(STAGE, f"from the histogram: {name}", partial(_made, data))
    for name, x, y in (("NaN opacity", [0, 1], [0, np.nan]), ("opacity 2", [0, 1], [0, 2]), ("no nodes", [], [])):
        yield Case(STAGE, f"refused: {name}", partial(_refused, x, y))


_p = partial(partial, _table)
