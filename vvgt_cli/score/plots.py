"""The charts of the page as PNG files, for papers and slides."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vvgt_cli.errors import UsageError
from vvgt_cli.files import atomic_write
from vvgt_cli.score.charts import log_ticks
from vvgt_cli.score.curves import KINDS, OTHER, SCORING, STAGES, Series, short, stage_names
from vvgt_cli.score.page import AXES, ceiling, points

MARKS = ("o", "D", "s", "^", "h", "*")
COLORS = ("#0072b2", "#a8527e", "#00845f", "#c05a00", "#7a6a00", "#333333")
FILES = ("psnr-seconds.png", "psnr-gaussians.png", "psnr-megabytes.png", "stages.png")


def _figure(size: tuple[float, float]) -> tuple[Any, Any]:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:  # pyvista brings it
        raise UsageError("drawing plots needs matplotlib; try: pip install matplotlib") from None
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def write_plots(folder: Path, series: Sequence[Series], overwrite: bool) -> None:
    """Write `FILES`.

    Raises:
        UsageError: matplotlib is missing, or a file exists.
    """
    for name, (axis, label, _) in zip(FILES, AXES, strict=False):
        figure, axes = _figure((6.4, 4.4))
        _scatter(axes, series, axis)
        if (level := ceiling(series)) is not None:
            axes.axhline(level, color="#888888", lw=1, ls="--", zorder=0, label="VTK")
        axes.set(xscale="log", xlabel=label, ylabel="PSNR, dB")
        places = log_ticks(*axes.get_xlim())
        axes.set_xticks(places, [short(place) for place in places])
        axes.set_xticks([], minor=True)
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0, 1), ncols=4)
        _save(figure, folder / name, overwrite)
    count = sum(len(one.runs) for one in series)
    figure, axes = _figure((6.4, 1.4 + 0.28 * count))
    _stages(axes, series)
    _save(figure, folder / FILES[-1], overwrite)


def _save(figure: Any, path: Path, overwrite: bool) -> None:
    with atomic_write(path, overwrite) as temporary:
        figure.savefig(temporary, format="png", metadata={"Software": None})


def _scatter(axes: Any, series: Sequence[Series], axis: str) -> None:
    several, named = len(series) > 1, set()
    for n, marks in enumerate(points(series, axis)):
        line = sorted((p for p in marks if p.front), key=lambda p: p.x)
        color = COLORS[n % 4] if several else "#444444"
        axes.plot([p.x for p in line], [p.y for p in line], color=color, lw=1.2, alpha=0.6, zorder=1)
        for p in marks:
            name = series[n].name if several else KINDS[p.shape]
            label = None if name in named else name
            named.add(name)
            color = COLORS[n % 4] if several else COLORS[p.shape]
            axes.scatter([p.x], [p.y], marker=MARKS[p.shape], color=color, s=36, label=label, zorder=2)
            axes.annotate(p.label, (p.x, p.y), xytext=(6, -9), textcoords="offset points", fontsize=7, parse_math=False)


def _stages(axes: Any, series: Sequence[Series]) -> None:
    rows = [(one, run) for one in series for run in one.runs]
    names = [f"{one.name}: {run['name']}" if len(series) > 1 else run["name"] for one, run in rows]
    ends = [0.0] * len(rows)
    for stage in stage_names([run for _, run in rows]):
        widths = [sum(s["seconds"] for s in run["stages"] if s["name"] == stage) for _, run in rows]
        if any(widths):
            label = f"{stage} (not counted)" if stage in SCORING else stage
            axes.barh(range(len(rows)), widths, left=ends, color=STAGES.get(stage, OTHER), label=label)
            ends = [end + width for end, width in zip(ends, widths, strict=True)]
    axes.set_yticks(range(len(rows)), names, fontsize=8, parse_math=False)
    axes.invert_yaxis()
    axes.set_xlabel("seconds")
    axes.legend(frameon=False, fontsize=7, loc="lower left", bbox_to_anchor=(0, 1), ncols=4)
