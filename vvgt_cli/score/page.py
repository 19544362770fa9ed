"""A self-contained HTML page of reports: charts, a table, and pictures to compare."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from vvgt_cli.score.charts import Chart
from vvgt_cli.score.curves import ReportRuns, Run, cost, knee, pareto, psnr, short, worst_condition

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


def page(series: Sequence[ReportRuns], charts: Sequence[Chart], title: str, pictures: Pictures | None = None) -> str:
    """Return the page of one report, with pictures to compare, or of several over each other."""
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


def _head(series: Sequence[ReportRuns], title: str) -> str:
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


def _facts(series: Sequence[ReportRuns]) -> str:
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


def _unit_costs(series: Sequence[ReportRuns]) -> str:
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


def _table(series: Sequence[ReportRuns]) -> str:
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


def _machine(one: ReportRuns, named: bool) -> str:
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


CSS = """
:root{color-scheme:light dark;--paper:#fbfbfa;--card:#fff;--ink:#1c1f23;--soft:#5d656f;--line:#e3e5e8;
--k0:#0072b2;--k1:#a8527e;--k2:#00845f;--k3:#c05a00;--k4:#7a6a00;--k5:#333}
@media(prefers-color-scheme:dark){:root{--paper:#14171a;--card:#1c2024;--ink:#e8eaec;--soft:#9aa3ad;--line:#2e343a;
--k0:#56b4e9;--k1:#d995ba;--k2:#2fc79b;--k3:#f0954a;--k4:#d3c04a;--k5:#ddd}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);
font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
main{max-width:1240px;margin:0 auto;padding:28px 20px 60px}
h1{font-size:1.7rem;line-height:1.2;margin:0 0 .2em;overflow-wrap:anywhere}
h2{font-size:1.1rem;margin:0 0 .6em}
p{margin:.3em 0}.soft{color:var(--soft)}small{color:var(--soft)}
section{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:18px;margin-top:18px;min-width:0}
.facts{display:grid;grid-template-columns:repeat(auto-fit,minmax(170px,1fr));gap:12px;margin-top:18px}
.facts div{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:12px 16px}
.facts b{display:block;font-size:1.35rem;line-height:1.3;font-variant-numeric:tabular-nums}
.grid2{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,440px),1fr));gap:18px}
.grid2 section{margin-top:0}.grid2{margin-top:18px}
svg{display:block;width:100%;height:auto}svg text{font-family:inherit!important}
.scroll{overflow-x:auto}table{border-collapse:collapse;width:100%;font-size:.875rem;font-variant-numeric:tabular-nums}
th,td{padding:6px 10px;text-align:right;border-bottom:1px solid var(--line);white-space:nowrap}
th{color:var(--soft);font-weight:600}th:first-child,td:first-child{text-align:left}
tr.best td:first-child{font-weight:700}
code{display:block;background:var(--paper);border:1px solid var(--line);border-radius:6px;padding:10px 12px;
font:13px/1.5 ui-monospace,Menlo,Consolas,monospace;overflow-wrap:anywhere;white-space:pre-wrap}
dl{display:grid;grid-template-columns:max-content 1fr;gap:3px 16px;margin:12px 0 0;font-size:.9rem}
dt{color:var(--soft)}dd{margin:0;overflow-wrap:anywhere}
.tools{display:flex;flex-wrap:wrap;gap:10px 18px;align-items:center;margin-bottom:12px;font-size:.9rem}
select{font:inherit;color:inherit;background:var(--paper);border:1px solid var(--line);border-radius:6px;
padding:5px 8px;max-width:100%}
.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,300px),1fr));gap:16px}
figure{margin:0;min-width:0}figcaption{font-size:.875rem;color:var(--soft);margin-top:6px}
.stage{position:relative;aspect-ratio:1;background:#000;border-radius:8px;overflow:hidden}
.stage img{position:absolute;inset:0;width:100%;height:100%;object-fit:contain}
.wipe .ours{clip-path:inset(0 0 0 var(--at,50%))}
.wipe::after{content:"";position:absolute;top:0;bottom:0;left:var(--at,50%);width:2px;margin-left:-1px;background:#fff;
mix-blend-mode:difference}
.wipe input{position:absolute;inset:0;width:100%;height:100%;margin:0;opacity:0;cursor:ew-resize}
.wipe:focus-within{outline:3px solid var(--k0);outline-offset:2px}
.tag{position:absolute;top:8px;padding:1px 8px;border-radius:9px;background:#0009;color:#fff;font-size:.75rem}
.tag.l{left:8px}.tag.r{right:8px}
.gap{isolation:isolate}.gap .ours{mix-blend-mode:difference}
input[type=range]{accent-color:var(--k0)}
@media(max-width:560px){main{padding:18px 12px 40px}section{padding:14px 12px}h1{font-size:1.35rem}
.facts{grid-template-columns:1fr}
.facts b{font-size:1.1rem}dl{grid-template-columns:1fr;gap:0}dd{margin-bottom:6px}}
"""

SCRIPT = """
(() => {
  const data = JSON.parse(document.getElementById("images").textContent);
  const [run, view, gain] = ["run", "view", "gain"].map(name => document.getElementById(name));
  const set = (name, source) => document.querySelectorAll("img." + name).forEach(image => { image.src = source; });
  const show = () => {
    const ours = data.runs[run.value];
    set("reference", data.reference[view.value]);
    set("ours", ours.images[view.value]);
    document.getElementById("score").textContent = ours.scores[view.value];
    document.getElementById("ours-name").textContent = ours.name;
  };
  const slide = event => event.target.parentElement.style.setProperty("--at", event.target.value + "%");
  const brighten = () => {
    document.querySelector(".gap").style.filter = "brightness(" + gain.value + ")";
    document.getElementById("gain-value").textContent = gain.value;
  };
  run.addEventListener("change", show);
  view.addEventListener("change", show);
  document.getElementById("wipe").addEventListener("input", slide);
  gain.addEventListener("input", brighten);
  show();
  brighten();
})();
"""
