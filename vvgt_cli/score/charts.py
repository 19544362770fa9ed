"""Charts as inline SVG and HTML: crisp at any size, coloured by the page's style sheet, nothing to load."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from vvgt_cli.score.curves import KINDS, OTHER, SCORING, STAGES, Run, cost, short, stage_names

WIDTH, HEIGHT = 440, 340  # of the drawing; fonts are 12.5 units, 9 px on a phone
LEFT, RIGHT, TOP, BOTTOM = 46, 14, 14, 44
MARK = 5.5
LETTER = 6.5  # width of one
HATCH = "background:repeating-linear-gradient(135deg,var(--line) 0 3px,var(--soft) 3px 4.5px)"
SHAPES = ("circle", "diamond", "square", "triangle", "hexagon", "star")


@dataclass(frozen=True)
class Point:
    """A run in a chart.

    Attributes:
        x, y: data values.
        label: beside the mark.
        shape: number of its kind in `KINDS`.
        color: class of its colour, "k0" or "c1", say.
        front: nothing beats it.
        title: shown by a pointer that rests on it.
    """

    x: float
    y: float
    label: str
    shape: int
    color: str
    front: bool
    title: str


def log_ticks(lo: float, hi: float) -> list[float]:
    """1, 2 and 5 of each decade within [lo, hi]; only the decades' own where that leaves enough, more where too few."""
    exponents = range(math.floor(math.log10(lo)), math.ceil(math.log10(hi)) + 1)
    for digits in ((1,), (1, 3), (1, 2, 5), tuple(range(1, 10))):
        ticks = [d * 10.0**e for e in exponents for d in digits if lo <= d * 10.0**e <= hi]
        if len(ticks) >= 3:
            break
    return ticks


def ticks(lo: float, hi: float, count: int = 6) -> list[float]:
    """About ``count`` round values within [lo, hi]."""
    rough = (hi - lo) / count
    power = 10.0 ** math.floor(math.log10(rough))
    size = next(m * power for m in (1, 2, 5, 10) if m * power >= rough)
    return [i * size for i in range(math.ceil(lo / size - 1e-9), math.floor(hi / size + 1e-9) + 1)]


@dataclass(frozen=True)
class _Frame:
    """Where data values lie in the drawing; x is logarithmic."""

    x: tuple[float, float]
    y: tuple[float, float]

    def at(self, x: float, y: float) -> tuple[float, float]:
        lo, hi = map(math.log, self.x)
        fx, fy = (math.log(x) - lo) / (hi - lo), (y - self.y[0]) / (self.y[1] - self.y[0])
        return LEFT + fx * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - fy * (HEIGHT - TOP - BOTTOM)


def _frame(points: Sequence[Point], ceiling: float | None) -> _Frame:
    """Room of 12 % and a half on either side."""
    xs, ys = [p.x for p in points], [p.y for p in points] + ([] if ceiling is None else [ceiling])
    wide = max(math.log(max(xs) / min(xs)), math.log(2))
    high = max(max(ys) - min(ys), 1.0)
    spread = math.exp(0.09 * wide)
    return _Frame((min(xs) / spread, max(xs) * spread), (min(ys) - 0.08 * high, max(ys) + 0.08 * high))


def scatter(
    points: Sequence[Point],
    x_label: str,
    y_label: str,
    lines: Sequence[Sequence[Point]] = (),
    ceiling: float | None = None,
) -> str:
    """A chart of marks over a logarithmic axis; ``lines`` are drawn through points in order, VTK's at ``ceiling``."""
    frame = _frame(points, ceiling)
    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(y_label)} against {escape(x_label)}">'
    ]
    parts += _axes(frame, x_label, y_label)
    if ceiling is not None:
        _, y = frame.at(frame.x[0], ceiling)
        parts.append(f'<line class="ceiling" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="tick" x="{WIDTH - RIGHT}" y="{y - 4:.1f}" text-anchor="end">VTK</text>')
    for line in lines:
        path = " ".join("{:.1f},{:.1f}".format(*frame.at(p.x, p.y)) for p in line)
        parts.append(f'<polyline class="front {line[0].color}" points="{path}"/>')
    spots = [frame.at(p.x, p.y) for p in points]
    for point, (x, y) in zip(points, spots, strict=True):
        ring = f'<circle class="ring" cx="{x:.1f}" cy="{y:.1f}" r="{MARK + 4}"/>' if point.front else ""
        parts.append(
            f'<g class="{point.color}">{ring}{mark(point.shape, x, y)}<title>{escape(point.title)}</title></g>'
        )
    parts += _labels(points, spots)
    return "".join(parts) + "</svg>"


def mark(shape: int, x: float, y: float) -> str:
    """A mark of a kind, filled by its parent's colour."""
    r = MARK
    if SHAPES[shape] == "circle":
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r}"/>'
    corners = {
        "diamond": ((0, -1.35), (1.35, 0), (0, 1.35), (-1.35, 0)),
        "square": ((-0.95, -0.95), (0.95, -0.95), (0.95, 0.95), (-0.95, 0.95)),
        "triangle": ((0, -1.25), (1.2, 0.95), (-1.2, 0.95)),
        "hexagon": ((0, -1.2), (1.04, -0.6), (1.04, 0.6), (0, 1.2), (-1.04, 0.6), (-1.04, -0.6)),
        "star": ((0, -1.5), (0.45, -0.45), (1.5, 0), (0.45, 0.45), (0, 1.5), (-0.45, 0.45), (-1.5, 0), (-0.45, -0.45)),
    }[SHAPES[shape]]
    path = " ".join(f"{x + r * dx:.1f},{y + r * dy:.1f}" for dx, dy in corners)
    return f'<polygon points="{path}"/>'


def _axes(frame: _Frame, x_label: str, y_label: str) -> list[str]:
    parts, bottom, right = [], HEIGHT - BOTTOM, WIDTH - RIGHT
    for value in log_ticks(*frame.x):
        x, _ = frame.at(value, frame.y[0])
        parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{bottom}"/>')
        parts.append(f'<text class="tick" x="{x:.1f}" y="{bottom + 17}" text-anchor="middle">{short(value)}</text>')
    for value in ticks(*frame.y):
        _, y = frame.at(frame.x[0], value)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="tick" x="{LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    parts.append(f'<text class="axis" x="{right}" y="{HEIGHT - 8}" text-anchor="end">{escape(x_label)}</text>')
    parts.append(f'<text class="axis" x="{LEFT + 6}" y="{TOP + 12}">{escape(y_label)}</text>')
    return parts


Box = tuple[float, float, float, float]


def _labels(points: Sequence[Point], spots: Sequence[tuple[float, float]]) -> list[str]:
    """Labels where nothing lies yet: right, left, above or below the mark; left out where no place is free."""
    taken: list[Box] = [(x - 9, y - 9, x + 9, y + 9) for x, y in spots]
    taken.append((LEFT, TOP, LEFT + 130, TOP + 18))  # the axis' name
    parts = []
    for n in sorted(range(len(points)), key=lambda n: not points[n].front):  # those of the front first
        (x, y), text = spots[n], points[n].label
        wide = LETTER * len(text)
        for dx, dy, anchor in ((12, 4, "start"), (-12, 4, "end"), (0, -12, "middle"), (0, 21, "middle")):
            left = x + dx - {"start": 0, "end": wide, "middle": wide / 2}[anchor]
            box = (left, y + dy - 11, left + wide, y + dy + 3)
            inside = box[0] > LEFT and box[2] < WIDTH and box[1] > TOP and box[3] < HEIGHT - BOTTOM
            if inside and not any(_overlap(box, other) for other in (*taken[:n], *taken[n + 1 :])):
                taken.append(box)
                place = f'x="{x + dx:.1f}" y="{y + dy:.1f}" text-anchor="{anchor}"'
                parts.append(f'<text class="name {points[n].color}" {place}>{escape(text)}</text>')
                break
    return parts


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def legend(shapes: Sequence[int], colors: Sequence[str]) -> str:
    """Names of kinds beside their marks."""
    items = []
    for shape, color in zip(shapes, colors, strict=True):
        icon = f'<svg viewBox="0 0 18 18" class="key {color}">{mark(shape, 9, 9)}</svg>'
        items.append(f"<span>{icon}{escape(KINDS[shape])}</span>")
    return "".join(items)


def stage_bars(runs: Sequence[Run], longest: float) -> str:
    """A bar a run, a segment a stage; ``longest`` seconds fill the width. Scoring is hatched: it makes no file."""
    names = stage_names(runs)
    paint = {name: HATCH if name in SCORING else f"background:{STAGES.get(name, OTHER)}" for name in names}
    rows = []
    for run in runs:
        seconds = {name: sum(s["seconds"] for s in run["stages"] if s["name"] == name) for name in names}
        segments = "".join(
            f'<i style="width:{100 * value / longest:.3f}%;{paint[name]}" title="{escape(name)}: {value:.2f} s"></i>'
            for name, value in seconds.items()
            if value > 0
        )
        rows.append(
            f'<div class="bar"><b>{escape(run["name"])}</b><div>{segments}</div><em>{cost(run):.2f} s</em></div>'
        )
    shown = {name: f"{name} (not counted)" if name in SCORING else name for name in names}
    keys = "".join(f'<span><i style="{paint[name]}"></i>{escape(shown[name])}</span>' for name in names)
    return f'<div class="keys">{keys}</div><div class="bars">{"".join(rows)}</div>'
