"""A self-contained HTML page of reports: charts, a table, and pictures to compare."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from vvgt_cli.score.charts import Chart
from vvgt_cli.score.curves import Run, Series, cost, knee, pareto, psnr, short, worst_condition
from vvgt_cli.score.style import CSS, SCRIPT

GAIN = 8  # initial gain of the difference


@dataclass(frozen=True)
class Pictures:
    """The pictures that the page compares, PNG files as bytes.

    Attributes:
        views: numbers of the test views.
        reference: one file per view.
        ours: for each run, one file per view.
    """

    views: list[int]
    reference: list[bytes]
    ours: list[list[bytes]]


def page(series: Sequence[Series], charts: Sequence[Chart], title: str, pictures: Pictures | None = None) -> str:
    """Return the page of one report, or of several over each other.

    Args:
        series: the reports.
        charts: charts of their runs.
        title: the heading.
        pictures: pictures to compare, for one report.
    """
    notes = dict.fromkeys([chart.title for chart in charts], "") | {charts[0].title: FRONT_NOTE}
    drawn = [f"<section><h2>{one.title}</h2>{one.svg()}{notes[one.title]}</section>" for one in charts]
    parts = [_head(series, title), _facts(series), f'<div class="grid2">{"".join(drawn)}{_unit_costs(series)}</div>']
    if pictures:
        parts.append(_compare(series[0].runs, pictures))
    parts += [_table(series), *(_machine(one, len(series) > 1) for one in series)]
    script = f"<script>{SCRIPT}</script>" if pictures else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{CSS}</style></head><body><main>{''.join(parts)}</main>{script}</body></html>\n"
    )


FRONT_NOTE = (
    "<p><small>Ringed and joined: no run is both faster and more accurate. Seconds to the file: reading, views, "
    "every stage, writing; without scoring. PSNR: ten test views, whole frame over black.</small></p>"
)


def _head(series: Sequence[Series], title: str) -> str:
    lines = []
    for one in series:
        volume, tf = one.document.get("volume") or {}, one.document.get("transfer_function") or {}
        about = [one.name] if len(series) > 1 else []
        if volume:
            about += [f"{volume['name']}, {' × '.join(map(str, volume['dims']))} {volume['dtype']}"]
        if tf:
            about += [f"{tf['name']}, opacity per {tf['unit_distance']:g} ({tf['unit_distance_label']})"]
        lines.append(f'<p class="soft">{escape("; ".join(about))}</p>')
    return f"<h1>{escape(title)}</h1>{''.join(lines)}"


def _facts(series: Sequence[Series]) -> str:
    """Return the best run of each report; for a single report also the quickest and the knee."""
    chosen = [("nearest", max(one.scored(), key=lambda run: psnr(run) or 0)) for one in series]
    if len(series) == 1:
        runs = series[0].scored()
        chosen = [("quickest", min(runs, key=cost)), ("knee of the curve", knee(runs) or runs[0]), *chosen]
    cells = [
        f"<div><small>{what}</small><b>{psnr(run):.1f} dB</b><small>{escape(run['name'])}<br>{cost(run):.1f} s, "
        f"{short(run['gaussians'])} Gaussians</small></div>"
        for what, run in chosen
    ]
    return f'<div class="facts">{"".join(cells)}</div>'


def _unit_costs(series: Sequence[Series]) -> str:
    rows = []
    for one in series:
        for key, seconds in (one.document.get("unit_costs") or {}).items():
            text = f"{seconds * 1e3:.3g} ms" if seconds < 1 else f"{seconds:.3g} s"
            own = f"{one.name}: " if len(series) > 1 else ""
            rows.append(f"<tr><td>{escape(own + key)}</td><td>{text}</td></tr>")
    if not rows:
        return ""
    return f"<section><h2>Costs of stages</h2><table>{''.join(rows)}</table><p><small>Medians.</small></p></section>"


def _uri(png: bytes) -> str:
    import base64

    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _compare(runs: Sequence[Run], pictures: Pictures) -> str:
    data: dict[str, Any] = {
        "reference": [_uri(png) for png in pictures.reference],
        "runs": [
            {
                "name": run["name"],
                "images": [_uri(png) for png in own],
                "scores": [f"{run['scores']['per_view'][v]['psnr']:.2f} dB in this view" for v in pictures.views],
            }
            for run, own in zip(runs, pictures.ours, strict=True)
        ],
    }
    held = json.dumps(data).replace("<", "\\u003c")  # so that no name ends the script
    chosen = runs.index(max(runs, key=lambda run: psnr(run) or 0))
    options = "".join(
        f'<option value="{n}"{" selected" if n == chosen else ""}>{escape(run["name"])} ({psnr(run):.1f} dB)</option>'
        for n, run in enumerate(runs)
    )
    choices = "".join(f'<option value="{n}">test view {v + 1}</option>' for n, v in enumerate(pictures.views))
    both = (
        f'<img class="reference" alt="reference" src="{data["reference"][0]}">'
        f'<img class="ours" alt="ours" src="{data["runs"][chosen]["images"][0]}">'
    )
    return (
        '<section><h2>Pictures</h2><div class="tools">'
        f'<label>Run <select id="run">{options}</select></label>'
        f'<label>View <select id="view">{choices}</select></label>'
        f'<label>Difference × <span id="gain-value">{GAIN}</span> '
        f'<input id="gain" type="range" min="1" max="32" value="{GAIN}"></label></div>'
        f'<div class="pair"><figure><div class="stage wipe">{both}<span class="tag l">reference</span>'
        '<span class="tag r">ours</span><input id="wipe" type="range" min="0" max="100" value="50" '
        'aria-label="where the picture passes from the reference to ours"></div>'
        '<figcaption>Drag: reference on the left, <span id="ours-name"></span> on the right; <span id="score"></span>'
        f'</figcaption></figure><figure><div class="stage gap" style="filter:brightness({GAIN})">{both}</div>'
        "<figcaption>Difference, brightened.</figcaption></figure></div>"
        f'<script type="application/json" id="images">{held}</script></section>'
    )


def _cell(value: Any, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _table(series: Sequence[Series]) -> str:
    heads = ("run", "seconds", "PSNR", "foreground", "worst condition", "SSIM", "FLIP", "Gaussians", "MB")
    rows = []
    for one in series:
        best = {id(run) for run in pareto(one.scored())}
        for run in one.runs:
            scores = run.get("scores") or {}
            cells = [
                f"{cost(run):.2f}", _cell(scores.get("psnr"), 2), _cell(scores.get("psnr_foreground"), 2),
                _cell(worst_condition(run), 2), _cell(scores.get("ssim"), 4), _cell(scores.get("flip"), 4),
                f"{run['gaussians']:,}",
                f"{run['bytes'] / 1e6:.2f}",
            ]  # fmt: skip
            mark = ' class="best"' if id(run) in best else ""
            rows.append(f"<tr{mark}><td>{escape(run['name'])}</td>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    head = "".join(f"<th>{name}</th>" for name in heads)
    return (
        f'<section><h2>All runs</h2><div class="scroll"><table><tr>{head}</tr>{"".join(rows)}</table></div>'
        "<p><small>Bold: nothing is both faster and more accurate. Worst condition: the lowest PSNR of all rules, "
        "at the target size and on the next larger screen, in one view.</small></p></section>"
    )


def _machine(one: Series, named: bool) -> str:
    document = one.document
    machine, versions = document.get("machine") or {}, document.get("versions") or {}
    load, reference = machine.get("load"), document.get("reference") or {}
    rows = {
        "processor": f"{machine.get('cpu')}, {machine.get('cpus')} CPUs, {machine.get('threads')} threads used",
        "system": f"{machine.get('system')} {machine.get('architecture')}",
        "load at the end": "not known" if not load else ", ".join(f"{v:.2f}" for v in load) + " (1, 5, 15 minutes)",
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
    }
    if reference:
        rows["reference"] = (
            f"{reference['views']} test views of {reference['size']} px, steps of {reference['step']:g} voxels, "
            f"up to {reference['rays']} rays a pixel"
        )
    items = "".join(f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>" for key, value in rows.items())
    command = document.get("command_line")
    code = f"<code>{escape(command)}</code>" if command else ""
    head = f"Machine and command{f': {escape(one.name)}' if named else ''}"
    return f"<section><h2>{head}</h2>{code}<dl>{items}</dl></section>"
