"""`vvgt convert` without one of its parts, each in turn: what it is worth. A CSV row a conversion, and a table.

    PYTHONPATH=. NUMBA_NUM_THREADS=1 python benchmarks/parts.py SCENES.tsv DATA_DIR TF_DIR -o docs/parts.csv
    PYTHONPATH=. python benchmarks/parts.py --table docs/parts.csv

PSNR of the ten test views, on black; `start` is that of the check views before the steps. Seconds are those of the
processor, without the scores. `--only SCENE` measures one scene; what follows `--` are options of `vvgt convert`.
"""

from __future__ import annotations

import contextlib
import csv
import json
import shlex
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

import click
from closed_form import scene_rows
from dvr_scenes import commit, write_rows

from vvgt_cli.commands.main import run

NONE = 10**12
PARTS: dict[str, dict[str, Any]] = {
    "all": {},
    "colours not sharpened": {"vvgt_cli.closed_form.pyramid.sharpened": lambda found, *_: found},
    "no cells by error": {"vvgt_cli.conversion.stages.cells.CellsByError.run": lambda *_: None},
    "hidden cells too": {"vvgt_cli.closed_form.closed_form.UNSEEN": 0.0},
    "no floor of slopes": {"vvgt_cli.refine.states.DAMPING": 0.0},
    "no steps in common": {"vvgt_cli.refine.shared.LEAST": NONE},
}


def conversion(call: list[str], part: str) -> dict[str, Any]:
    """Scores and seconds of one conversion."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as patches:
        for name, value in PARTS[part].items():
            patches.enter_context(mock.patch(name, value))
        report = str(Path(folder) / "a.json")
        began = time.process_time()
        if run(["convert", *call, "-o", str(Path(folder) / "a.ply"), "--report", report, "-q"]):
            raise SystemExit(1)
        whole = time.process_time() - began
        found = json.loads(Path(report).read_text("utf-8"))
    share = (
        1 - sum(s["seconds"] for s in found["stages"] if s["name"] in ("test views", "conditions")) / found["seconds"]
    )
    before = (found["refinement"] or {}).get("psnr_before") or 0.0
    return {"start": before, "psnr": found["scores"]["psnr"], "seconds": whole * share}


def table(path: str) -> str:
    """Markdown: PSNR by part and scene, means, and the mean of seconds."""
    rows = list(csv.DictReader(Path(path).read_text("utf-8").splitlines()))
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    lines = [f"| | {' | '.join(scenes)} | mean | start | s |", "| --- |" + " --- |" * (len(scenes) + 3)]
    for part in dict.fromkeys(row["part"] for row in rows):
        own = {row["scene"]: row for row in rows if row["part"] == part}
        cells = [f"{float(own[scene]['psnr']):.2f}" if scene in own else "-" for scene in scenes]
        means = [sum(float(row[key]) for row in own.values()) / len(own) for key in ("psnr", "start", "seconds")]
        lines.append(f"| {part} | {' | '.join(cells)} | {means[0]:.2f} | {means[1]:.2f} | {means[2]:.1f} |")
    return "\n".join(lines)


@click.command(help=__doc__)
@click.argument("paths", nargs=-1)
@click.option("-o", "--output")
@click.option("--table", "shown", type=click.Path(exists=True))
@click.option("--only", multiple=True)
def main(paths: tuple[str, ...], output: str | None, shown: str | None, only: tuple[str, ...]) -> None:
    if shown:
        print(table(shown))
        return
    scenes, data, functions = map(Path, paths[:3])
    rows: list[dict[str, Any]] = []
    for name, volume, reading, function in scene_rows(scenes):
        if only and name not in only:
            continue
        call = [str(data / volume), *shlex.split(reading), "--tf", str(functions / function)]
        call += ["--opacity-unit-distance", "mean-spacing", *paths[3:]]
        for part in PARTS:
            rows.append({"scene": name, "part": part, **conversion(call, part), "commit": commit()})
            print(rows[-1], flush=True)
            write_rows(output, rows)


if __name__ == "__main__":
    main()
