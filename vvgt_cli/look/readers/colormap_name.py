"""A matplotlib colour-map name with an opacity ramp: ``NAME[:LO,HI[:MAX]]``.

The colours spread over the data range. Opacity is 0 up to the fraction LO of the range, rises linearly to
MAX at HI and stays there; LO, HI and MAX are in [0, 1] and default to 0, 1 and 1.
``viridis``, ``magma:0.2,0.8`` and ``bone:0.3,0.35:0.9`` are examples.
"""

from __future__ import annotations

import difflib

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.readers.named import names

FORM = "NAME[:LO,HI[:MAX]] with LO, HI and MAX in [0, 1], such as viridis:0.2,0.8:0.5"
MAX_NODES = 256


def read(source: str) -> TransferFunction:
    """The function of a name, on fractions of the data range.

    Raises:
        UsageError: not a colour map of matplotlib's, or a ramp that is none.
    """
    name, *rest = source.split(":")
    lo, hi, top = _ramp(source, rest)
    colors = _colors(name)
    return TransferFunction(
        f"{name} (opacity ramp {lo:g} to {hi:g}, up to {top:g})",
        PiecewiseOpacity(np.array([lo, hi]), np.array([0.0, top])),
        ColorMap(np.linspace(0, 1, len(colors)), colors),
        domain="fraction",
    )


def _ramp(source: str, rest: list[str]) -> tuple[float, float, float]:
    try:
        if len(rest) > 2:
            raise ValueError
        lo, hi = (float(v) for v in rest[0].split(",")) if rest else (0.0, 1.0)
        top = float(rest[1]) if len(rest) > 1 else 1.0
    except ValueError:
        raise UsageError(f"transfer function {source!r}; expected {FORM}") from None
    if not (0 <= lo <= hi <= 1 and 0 < top <= 1):
        raise UsageError(f"transfer function {source!r}: ramp {lo:g} to {hi:g}, up to {top:g}; expected {FORM}")
    return lo, hi, top


def _colors(name: str) -> np.ndarray:
    """RGB samples (n, 3) of a matplotlib colour map, from its first colour to its last."""
    try:
        from matplotlib import colormaps
    except ImportError:  # pyvista brings it
        raise UsageError(
            f"transfer function {name!r}: no such file, and matplotlib, which knows colour maps, is not installed; "
            "try: pip install matplotlib"
        ) from None
    if name not in colormaps:
        close = difflib.get_close_matches(name, [*names(), *colormaps], n=3)
        hint = f"; did you mean {', '.join(close)}?" if close else ", such as viridis"
        raise UsageError(
            f"transfer function {name!r}: neither a file, a name of 'vvgt tf list' nor a matplotlib colour map{hint}"
        )
    chosen = colormaps[name]
    return np.asarray(chosen(np.linspace(0, 1, min(max(chosen.N, 2), MAX_NODES))), dtype=np.float64)[:, :3]
