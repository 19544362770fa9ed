"""Transfer functions by name: ours, such as ``ct-bone``, and matplotlib's colour maps with an opacity ramp.

``named.json`` has a list of ours, each in the minimal form. Those for CT are over Hounsfield units, and otherwise over
percentiles of the voxels in front of the background.

``NAME[:LO,HI[:MAX]]`` is a colour map of matplotlib: the colours spread over the data range, opacity is 0 up to the
fraction LO of the range, rises linearly to MAX at HI and stays there; LO, HI and MAX are in [0, 1] and default to 0, 1
and 1. ``viridis``, ``magma:0.2,0.8`` and ``bone:0.3,0.35:0.9`` are examples. ``iso:LEVEL[:LEVEL...]`` are isosurfaces
(`vvgt_cli.look.isosurfaces`).
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.isosurfaces import PREFIX, isosurfaces
from vvgt_cli.look.readers import minimal
from vvgt_cli.volume.components import expected

FILE = Path(__file__).with_name("named.json")
FORM = "NAME[:LO,HI[:MAX]] with LO, HI and MAX in [0, 1], such as viridis:0.2,0.8:0.5"
MAX_NODES = 256


@cache
def _entries() -> dict[str, dict[str, Any]]:
    return {entry["function"]["name"]: entry for entry in json.loads(FILE.read_text("utf-8"))}


def names() -> dict[str, str]:
    """Return a description of each named function, by name."""
    return {name: str(entry["shows"]) for name, entry in _entries().items()}


def titles() -> dict[str, str]:
    """Return one or two words for what each named function shows, by name: what pages call it."""
    return {name: str(entry["title"]) for name, entry in _entries().items()}


def named_function(name: str) -> TransferFunction:
    """Return one of our functions, with opacity per a share of the box's edge; raise KeyError for an unknown name."""
    return minimal.read(_entries()[name]["function"], name)


def read(source: str) -> TransferFunction:
    """Return the function of a name: ours, or a colour map on fractions of the data range, or raise UsageError."""
    if source in names():
        return named_function(source)
    if source.startswith(PREFIX):
        return isosurfaces(source.removeprefix(PREFIX).split(":"))
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
    """Return RGB samples (n, 3) of a matplotlib colour map, from its first colour to its last."""
    from matplotlib import colormaps

    if name not in colormaps:
        raise UsageError(
            f"transfer function {name!r}: neither a file, a name of 'vvgt tf list' nor a matplotlib colour map; "
            + expected(name, [*colormaps, *names()])
        )
    chosen = colormaps[name]
    return np.asarray(chosen(np.linspace(0, 1, min(max(chosen.N, 2), MAX_NODES))), dtype=np.float64)[:, :3]
