"""The scenes of a list, and tables of CSV: shared by the benchmarks of the volume renderer."""

from __future__ import annotations

import csv
import io
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from closed_form import read_options, scene_rows

from vvgt_cli.field.source import SourceRequest, StyledVolume, load


def read_scenes(
    listing: str, data: str, functions: str, names: tuple[str, ...] | None = None
) -> Iterator[tuple[str, StyledVolume]]:
    """Name and source of each scene of a tab-separated list (columns scene, volume, options, function)."""
    for name, volume, options, function in scene_rows(listing):
        if names is None or name in names:
            request = SourceRequest(
                str(Path(data) / volume),
                read_options(options),
                str(Path(functions) / function),
                unit_distance="mean-spacing",
            )
            yield name, load(request)


def commit() -> str:
    """Short name of the commit that is measured."""
    return subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()


def write_rows(path: str | None, rows: list[dict[str, Any]]) -> None:
    """CSV to ``path``, or to standard output; floats with four digits."""
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({key: f"{value:.4g}" if isinstance(value, float) else value for key, value in row.items()})
    if path:
        Path(path).write_text(out.getvalue())
    else:
        print(out.getvalue(), end="")


def print_table(path: str) -> None:
    """The CSV as a Markdown table, without the columns that are the same in all rows; these stand under it."""
    rows = list(csv.DictReader(Path(path).read_text().splitlines()))
    same = [key for key in rows[0] if len(rows) > 1 and len({row[key] for row in rows}) == 1]
    columns = [key for key in rows[0] if key not in same]
    print("| " + " | ".join(columns) + " |\n" + "| --- " * len(columns) + "|")
    for row in rows:
        print("| " + " | ".join(row[key] for key in columns) + " |")
    if same:
        print("\n" + ", ".join(f"{key} {rows[0][key]}" for key in same) + ".")
