"""What `vvgt convert --dry-run` predicts against what then happens: a CSV row a conversion.

    PYTHONPATH=. python benchmarks/plan.py SCENES.tsv DATA_DIR TF_DIR -o docs/plan.csv
    PYTHONPATH=. python benchmarks/plan.py --table docs/plan.csv

Every conversion is a process of its own, by default, within 12 seconds, or with 20,000 Gaussians; seconds without
starting Python.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import click
from closed_form import scene_rows
from dvr_scenes import commit, print_table, write_rows

KINDS: dict[str, tuple[str, ...]] = {
    "default": (), "12 s": ("--time-budget", "12"), "20,000": ("--max-gaussians", "20000"),
}  # fmt: skip
FEW = 4  # scenes that get the last kind


def conversion(source: list[str], options: tuple[str, ...]) -> dict[str, Any]:
    """Predicted and measured seconds, memory and size of one conversion."""
    with tempfile.TemporaryDirectory() as folder:
        out, report = Path(folder) / "out.ply", Path(folder) / "out.json"
        command = [sys.executable, "-m", "vvgt_cli.commands.main", "convert", *source, *options]
        subprocess.run([*command, "-o", str(out), "--report", str(report), "-q"], check=True)
        found = json.loads(report.read_text())
    plan, memory = found["plan"], found["machine"]["peak_memory_bytes"]
    return {
        "predicted_s": plan["seconds"], "s": found["seconds"], "ratio": plan["seconds"] / found["seconds"],
        "predicted_gb": plan["memory"] / 1e9, "gb": memory / 1e9, "predicted_mb": plan["bytes"] / 1e6,
        "mb": found["bytes"] / 1e6, "steps": (found["refinement"] or {"steps": 0})["steps"],
        "psnr": found["scores"]["psnr"],
    }  # fmt: skip


@click.command(help=__doc__)
@click.argument("paths", nargs=-1)
@click.option("-o", "--output")
@click.option("--table", type=click.Path(exists=True))
def main(paths: tuple[str, ...], output: str | None, table: str | None) -> None:
    if table:
        print_table(table)
        return
    scenes, data, functions = map(Path, paths)
    listed = scene_rows(scenes)
    rows: list[dict[str, Any]] = []
    for kind, options in KINDS.items():
        for name, volume, extra, function in listed[: FEW if kind == "20,000" else None]:
            source = [str(data / volume), "--tf", str(functions / function), "--opacity-unit-distance", "mean-spacing"]
            row = conversion(source + shlex.split(extra), options)
            rows.append({"scene": name, "options": kind, **row, "commit": commit()})
            print(rows[-1], flush=True)
            write_rows(output, rows)


if __name__ == "__main__":
    main()
