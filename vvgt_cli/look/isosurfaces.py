"""`Isosurfaces`: a function made of levels, as ``iso:LEVEL[,COLOR][,above|below][:LEVEL...]``, or ``--iso`` gives them.

A level is a data value, or ``3sigma``, standard deviations above the mean. The innermost surface on each side of the
background is a solid body, so that it is opaque however steep the values are; those around it are thin and translucent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.look.function import PER_VOXEL, ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.look.recognise import background_bins, moments
from vvgt_cli.volume.stats import Statistics

PREFIX, SIGMA, ABOVE, BELOW = "iso:", "sigma", "above", "below"
FORM = "LEVEL[,COLOR][,above|below] with LEVEL a number or such as 3sigma: 0.03, 0.03,#88aaff or 0,below"
COLORS = ((0.3, 0.52, 0.86), (0.86, 0.33, 0.26), (0.95, 0.78, 0.36), (0.36, 0.68, 0.46), (0.62, 0.45, 0.78))
NEUTRAL = (0.87, 0.85, 0.8)
EDGE = 0.02  # half the width of a surface's rise, as a share of the way from its level to the background
FINEST = 2.0**-20  # least value of that half, as a share of half the range of the data
SHELL, TRANSLUCENT = 0.3, 0.8  # width of an outer surface as a share of the way to the next one, and its opacity
RGB = tuple[float, float, float]


@dataclass(frozen=True)
class Isosurfaces(TransferFunction):
    """Levels that become surfaces when the data are known (`placed`).

    Attributes:
        texts: the levels as they were given.
        levels: value, unit (sigma or ""), colour, and side that is inside ("": the one away from the background).
    """

    texts: tuple[str, ...] = ()
    levels: tuple[tuple[float, str, RGB | None, str], ...] = ()

    def placed(self, statistics: Statistics, hounsfield: bool) -> TransferFunction:
        """Return the function on data values.

        The values above a level are inside where it lies above the background, and always in Hounsfield units. Level 0
        of data of both signs is that of a signed distance, which is negative inside.

        Raises:
            DataError: a level is outside of the data.
            UsageError: every value is inside of a surface.
        """
        counts, edges = (np.asarray(a, dtype=np.float64) for a in (statistics.histogram, statistics.edges))
        lo, hi, (mean, deviation) = float(statistics.lo), float(statistics.hi), moments(counts, edges)
        first, last = background_bins(counts)
        around = float(np.interp(0.5, np.cumsum(counts) / counts.sum(), edges[1:]))
        if first < last and (first == 0) != (last == counts.size):  # it begins where the data do
            around = lo if first == 0 else hi
        elif first < last:
            around = moments(counts[first:last], edges[first : last + 1])[0]
        rows: list[tuple[float, bool, RGB | None]] = []
        for value, unit, rgb, side in self.levels:
            x = mean + value * deviation if unit else value
            if not lo < x < hi:
                raise DataError(f"{self.name}: the data lie in [{lo:g}, {hi:g}]; expected a level between, not {x:g}")
            rows.append((x, side == ABOVE if side else hounsfield or (x != 0 and x > around), rgb))
        rows.sort(key=lambda row: row[0])
        below = sum(not above for _, above, _ in rows)
        if any(above for _, above, _ in rows[:below]):
            raise UsageError(f"{self.name}: every value is inside of a surface; expected 'below' for low levels alone")
        ends = np.diff(np.array([lo, *(x for x, _, _ in rows), hi]) / 4)
        nodes = []
        for k, (x, above, rgb) in enumerate(rows):
            half = max(min(abs(EDGE * x - EDGE * around), *ends[k : k + 2]), FINEST * (hi / 2 - lo / 2))
            color = rgb or (COLORS[(len(rows) - 1 - k) % len(COLORS)] if len(rows) > 1 else NEUTRAL)
            inwards, inner = (1, rows[k + 1 :]) if above else (-1, rows[:k][::-1])
            nodes.append((min(max(x - inwards * half, lo), hi), 0.0, color))
            if inner:
                nodes += [(x, TRANSLUCENT, color), (x + SHELL * (inner[0][0] - x), 0.0, color)]
            else:
                nodes.append((x + inwards * half, 1.0, color))
        at, opacity, colors = (np.array(column) for column in zip(*nodes, strict=True))
        function = PiecewiseOpacity(at, opacity), ColorMap(at, colors)
        return TransferFunction(self.name, *function, opacity_unit_label=PER_VOXEL, lighting=self.lighting)


def isosurfaces(levels: Sequence[object], name: str = "") -> Isosurfaces:
    """Return the function of levels, each a number or a text of `FORM`; raise UsageError for others."""
    texts = tuple(map(str, levels))
    parsed = tuple(map(_level, texts))
    if not texts or len({level[:2] for level in parsed}) < len(texts):
        raise UsageError(f"isosurfaces {' '.join(texts)}: expected levels, each once")
    x = np.array([level[0] for level in parsed])
    return Isosurfaces(
        name or f"isosurface{'s' * (len(texts) > 1)} {' '.join(texts)}", PiecewiseOpacity(x, np.ones(x.size)),
        ColorMap(x, np.array([level[2] or NEUTRAL for level in parsed])), domain="level", opacity_unit_label=PER_VOXEL,
        lighting=Lighting(ambient=0.2, diffuse=0.8, specular=0.2, specular_power=20), texts=texts, levels=parsed,
    )  # fmt: skip


def with_levels(
    tf: str | TransferFunction | None, levels: Sequence[object], labels: object = None
) -> str | TransferFunction | None:
    """Return ``tf``, or the name of the function of ``levels`` if there are any; raise UsageError for both."""
    if levels and (tf or labels not in (None, "none")):
        raise UsageError(f"isosurfaces and {'a function (tf)' if tf else 'a table of labels'}: expected one of them")
    return PREFIX + ":".join(map(str, levels)) if levels else tf


def _level(text: str) -> tuple[float, str, RGB | None, str]:
    from matplotlib.colors import to_rgb

    number, *rest = text.split(",")
    colors = [word for word in rest if word not in (ABOVE, BELOW)]
    unit = SIGMA if number.endswith(SIGMA) else ""
    try:
        value, color = float(number.removesuffix(unit)), to_rgb(colors[0]) if colors else None
    except ValueError:
        value, color = math.nan, None
    if not math.isfinite(value) or len(colors) > 1 or len(rest) - len(colors) > 1:
        raise UsageError(f"isosurface {text}: expected {FORM}")
    return value, unit, color, next((word for word in rest if word not in colors), "")
