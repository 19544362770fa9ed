"""Charts of runs, drawn by matplotlib: PNG files for papers, and SVG for the page, which follows its light or dark."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.files import atomic_write
from vvgt_cli.score.curves import KINDS, OTHER, SCORING, STAGES, ReportRuns, Run, cost, pareto, psnr, short, stage_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FILES = ("psnr-seconds.png", "psnr-gaussians.png", "psnr-megabytes.png", "stages.png")
AXES: tuple[tuple[str, str, Callable[[Run], float]], ...] = (  # title, label and value of the x axis
    ("Error against time", "seconds to the file", cost),
    ("Error against Gaussians", "Gaussians", lambda run: float(run["gaussians"])),
    ("Error against file size", "megabytes", lambda run: run["bytes"] / 1e6),
)
WIDTH, HEIGHT, ROW = 4.8, 3.7, 0.24  # inches, of a chart and of a bar: the page stretches them to its columns
MARKS = ("o", "D", "s", "^", "h", "*")  # of `KINDS`
COLORS = ("#0072b2", "#a8527e", "#00845f", "#c05a00", "#7a6a00", "#333333")  # of `KINDS`, or of several series
INK, SOFT, GRID = "#1c1f23", "#5d656f", "#e3e5e8"
VARIABLES = {color: f"var(--k{n})" for n, color in enumerate(COLORS)}  # of the page's style sheet
VARIABLES |= {INK: "var(--ink)", SOFT: "var(--soft)", GRID: "var(--line)"}
TITLE = "title: "  # prefix of the ids of elements with a tooltip
STYLE: dict[Any, Any] = {
    "font.size": 9.5, "xtick.labelsize": 9, "ytick.labelsize": 9, "legend.fontsize": 8.5, "text.parse_math": False,
    "text.color": INK, "axes.labelcolor": INK, "axes.edgecolor": SOFT, "xtick.color": SOFT, "ytick.color": SOFT,
    "grid.color": GRID, "axes.axisbelow": True, "axes.spines.top": False, "axes.spines.right": False,
    "legend.frameon": False, "font.sans-serif": ["DejaVu Sans"], "svg.fonttype": "none", "svg.hashsalt": "vvgt",
}  # fmt: skip
PLACES = (
    (8, 0, "left", "center"), (-8, 0, "right", "center"), (0, 8, "center", "bottom"), (0, -8, "center", "top"),
    (5, 5, "left", "bottom"), (-5, 5, "right", "bottom"), (5, -5, "left", "top"), (-5, -5, "right", "top"),
)  # fmt: skip


@dataclass(frozen=True)
class Chart:
    """A drawing of runs.

    Attributes:
        file: the name of its PNG.
        title: its heading on the page.
        figure: the drawing.
    """

    file: str
    title: str
    figure: Figure

    def svg(self) -> str:
        """Return the chart as an SVG element in the colours of the page, with a tooltip for each mark and bar."""
        import matplotlib

        stream, none = io.StringIO(), dict.fromkeys(("Creator", "Date", "Format", "Type"))
        with matplotlib.rc_context(STYLE):
            self.figure.savefig(stream, format="svg", transparent=True, metadata=none)
        _, _, text = stream.getvalue().partition("<svg")
        head, _, body = text.partition(">")
        body = re.sub(f'<g id="{TITLE}(.*?)">', r"<g><title>\1</title>", body)
        body = re.sub(r' id="\w[^"]*_\d+"', "", body)  # unused ids, which other charts repeat
        for color, variable in VARIABLES.items():
            body = body.replace(color, variable)
        (box,) = re.findall('viewBox="[^"]*"', head)
        return f'<svg {box} role="img" aria-label="{escape(self.title)}">{body}'


def draw(series: Sequence[ReportRuns]) -> list[Chart]:
    """Draw the charts of one report, or of several over each other; deterministic.

    Returns:
        PSNR over each of `AXES`, coloured by kind of run or by series, and the seconds of each stage: one of `FILES`
        each.
    """
    import matplotlib
    from matplotlib.figure import Figure

    charts = []
    with matplotlib.rc_context(STYLE):
        for file, (title, label, value) in zip(FILES, AXES, strict=False):
            figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
            _scatter(figure.add_subplot(xscale="log", xlabel=label, ylabel="PSNR, dB"), series, value)
            charts.append(Chart(file, title, figure))
        figure = Figure(figsize=(WIDTH, 1.5 + ROW * sum(len(one.runs) for one in series)), layout="constrained")
        _stages(figure.add_subplot(xlabel="seconds"), series)
    return [*charts, Chart(FILES[-1], "Where the time goes", figure)]


def write_plots(folder: Path, charts: Sequence[Chart], overwrite: bool) -> None:
    """Write the charts as PNG; raise UsageError if a file exists and ``overwrite`` is not set."""
    for chart in charts:
        with atomic_write(folder / chart.file, overwrite) as temporary:
            chart.figure.savefig(temporary, format="png", dpi=200, metadata={"Software": None})


def log_ticks(lo: float, hi: float) -> list[float]:
    """Return the powers of ten in [lo, hi], or 1, 3; 1, 2, 5; 1, 2, 3, ... times them where these are fewer than 3."""
    exponents = range(math.floor(math.log10(lo)), math.ceil(math.log10(hi)) + 1)
    for digits in ((1,), (1, 3), (1, 2, 5), tuple(range(1, 10))):
        ticks = [d * 10.0**e for e in exponents for d in digits if lo <= d * 10.0**e <= hi]
        if len(ticks) >= 3:
            break
    return ticks


def _scatter(axes: Any, series: Sequence[ReportRuns], value: Callable[[Run], float]) -> None:
    """Draw a mark for each run; runs on the Pareto front are ringed and joined."""
    several, used, labels = len(series) > 1, set(), []
    for n, one in enumerate(series):
        runs = [run for run in one.scored() if value(run) > 0]
        best = pareto(runs) if value is cost else []
        color = COLORS[n % 4] if several else INK
        axes.plot(
            [cost(run) for run in best], [float(psnr(run) or 0) for run in best], color=color, alpha=0.6, zorder=1
        )
        for run in runs:
            x, y, kind = value(run), float(psnr(run) or 0), KINDS.index(run["kind"])
            color, name = (COLORS[n % 4], one.name) if several else (COLORS[kind], run["kind"])
            title = f"{y:.2f} dB, {cost(run):.2f} s, {run['gaussians']} Gaussians"
            mark = axes.plot([x], [y], MARKS[kind], color=color, label="" if name in used else name)[0]
            mark.set_gid(f"{TITLE}{run['name']}: {title}")
            if run in best:
                axes.plot([x], [y], "o", markersize=12, markerfacecolor="none", markeredgecolor=color)
            used.add(name)
            labels.append((run not in best, x, y, str(run.get("label") or run["name"]), color if several else INK))
    if several:
        for kind in sorted({KINDS.index(run["kind"]) for one in series for run in one.scored()}):
            axes.plot([], [], MARKS[kind], color=SOFT, label=KINDS[kind])
    elif (vtk := series[0].document.get("vtk_psnr")) is not None:  # an upper bound for files
        axes.axhline(vtk, color=SOFT, linewidth=1, linestyle="--", zorder=0, label="VTK")
    axes.margins(0.08)
    ticks = log_ticks(*axes.get_xlim())
    axes.set_xticks(ticks, [short(tick) for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.grid()
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=4, handletextpad=0.2, columnspacing=1.2)
    _label(axes, sorted(labels, key=lambda label: label[0]))


def _label(axes: Any, labels: Sequence[tuple[Any, float, float, str, str]]) -> None:
    """Write texts (order, x, y, text, colour) beside their marks where nothing lies yet, else nowhere."""
    from matplotlib.transforms import Bbox

    axes.figure.draw_without_rendering()  # the layout
    reach = 6 * axes.figure.dpi / 72
    spots = axes.transData.transform([(x, y) for _, x, y, _, _ in labels])
    taken = [Bbox([spot - reach, spot + reach]) for spot in spots]
    for line in axes.lines:
        ends = line.get_transform().transform(line.get_xydata())
        for a, b in pairwise(ends):
            taken += [Bbox([a + share * (b - a) - 1, a + share * (b - a) + 1]) for share in np.linspace(0, 1, 200)]
    for _, x, y, text, color in labels:
        for dx, dy, across, along in PLACES:
            note = axes.annotate(
                text, (x, y), (dx, dy), textcoords="offset points", ha=across, va=along, fontsize=8.5, color=color
            )
            box = note.get_window_extent()
            inside = (box.min > axes.bbox.min).all() and (box.max < axes.bbox.max).all()
            if inside and not box.count_overlaps(taken):
                taken.append(box)
                break
            note.remove()


def _stages(axes: Any, series: Sequence[ReportRuns]) -> None:
    """Draw a bar for each run, a segment for each stage; scoring, which makes no file, is hatched."""
    rows = [run for one in series for run in one.runs]
    ends = [0.0] * len(rows)
    for stage in stage_names(rows):
        widths = [float(sum(s["seconds"] for s in run["stages"] if s["name"] == stage)) for run in rows]
        hatched = {"label": f"{stage} (not counted)", "hatch": "////", "edgecolor": SOFT, "linewidth": 0}
        style = hatched if stage in SCORING else {"label": stage}
        bars = axes.barh(range(len(rows)), widths, left=ends, color=STAGES.get(stage, OTHER), **style)
        for bar, width in zip(bars, widths, strict=True):
            bar.set_gid(f"{TITLE}{stage}: {width:.2f} s")
        ends = [end + width for end, width in zip(ends, widths, strict=True)]
    for place, (end, run) in enumerate(zip(ends, rows, strict=True)):
        axes.text(end, place, f" {cost(run):.2f} s", verticalalignment="center", fontsize=8.5, in_layout=False)
    axes.set_yticks(range(len(rows)), [run["name"] for run in rows], fontsize=8.5)
    axes.margins(y=0.01)
    axes.set_xlim(0, 1.2 * max(ends, default=1))
    axes.invert_yaxis()
    axes.tick_params(axis="y", length=0)
    axes.figure.legend(loc="outside upper left", ncols=3, handlelength=1.2, columnspacing=1.2)
