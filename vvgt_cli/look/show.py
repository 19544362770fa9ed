"""Picture of a transfer function over the histogram."""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np

from vvgt_cli.files import atomic_write
from vvgt_cli.look.function import DOMAINS, TransferFunction
from vvgt_cli.volume.stats import Statistics

SAMPLES = 1024


def draw(
    tf: TransferFunction, statistics: Statistics | None, path: str | PathLike[str], overwrite: bool = False
) -> None:
    """Write a PNG: the opacity curve, filled with the function's colours, over the histogram (log counts).

    Without ``statistics`` the nodes are the range. Raise UsageError if the file exists and ``overwrite`` is not set.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.5), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    lo, hi = tf.node_range() if statistics is None else (float(statistics.lo), float(statistics.hi))
    if lo == hi:
        margin = abs(lo) * 0.5 or 0.5
        lo, hi = lo - margin, hi + margin
    if statistics is not None:
        _draw_histogram(axes, statistics)
    x = np.unique(np.concatenate([np.linspace(lo, hi, SAMPLES), np.clip(tf.breakpoints(), lo, hi)]))
    _draw_curve(axes, tf, x)
    axes.set(xlim=(lo, hi), ylim=(0, 1.02), xlabel=DOMAINS[tf.domain][0], ylabel="opacity per unit distance")
    axes.set_title(tf.name, parse_math=False)
    with atomic_write(path, overwrite) as temporary:
        figure.savefig(temporary, format="png", metadata={"Software": None})


def _draw_curve(axes: Any, tf: TransferFunction, x: np.ndarray) -> None:
    from matplotlib.patches import Polygon

    y = tf.opacity(x)
    colors = tf.color(np.linspace(x[0], x[-1], SAMPLES))[None]  # (1, SAMPLES, 3)
    outline = np.concatenate([[(x[0], 0)], np.column_stack([x, y]), [(x[-1], 0)]])
    area = Polygon(outline, closed=True, transform=axes.transData)
    axes.imshow(colors, aspect="auto", extent=(x[0], x[-1], 0, 1.02), clip_path=area, zorder=1)
    nodes = tf.opacity_nodes
    axes.plot(x, y, color="black", linewidth=1.2)
    axes.plot(nodes.x, nodes.y, "o", color="black", markerfacecolor="white", markersize=4, clip_on=False)
    bar = axes.inset_axes((0, -0.045, 1, 0.03), transform=axes.transAxes)
    bar.imshow(colors, aspect="auto", extent=(0, 1, 0, 1))
    bar.set_axis_off()
    axes.tick_params(axis="x", pad=10)


def _draw_histogram(axes: Any, statistics: Statistics) -> None:
    behind = axes.twinx()
    counts, edges = np.asarray(statistics.histogram), np.asarray(statistics.edges)
    behind.stairs(counts, edges, fill=True, color="0.85")
    behind.set_yscale("symlog", linthresh=1)
    behind.set(ylim=(0, max(1.0, float(counts.max()) * 2)), ylabel="voxels (log)")
    axes.set_zorder(behind.get_zorder() + 1)  # the curve in front
    axes.patch.set_visible(False)
