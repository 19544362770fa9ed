"""What live pages cost: bytes of the file; processor seconds of the first page and of the better form, in pairs.

python benchmarks/live_page.py SCENES.tsv DATA FUNCTIONS -o live-page.csv [--scene NAME] [--rounds N] [--better]
python benchmarks/live_page.py --table live-page.csv

"closed form" is what `vvgt init` does, "first page" what `vvgt view VOLUME` does until there is a live page; with
--better "convert", and "better form", what `vvgt view VOLUME` then does for that function. All without the start of a
program; the least of N rounds in turns, after one that does not count. Beside the scenes the frog and its labels.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from closed_form import read_options, scene_rows
from dvr_scenes import print_table, write_rows

from vvgt_cli.commands.converter_process import LoadedVolume, MessageConsole
from vvgt_cli.conversion.convert import convert
from vvgt_cli.conversion.request import ConvertRequest, FitOptions
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians.formats import encoded, format_of
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.progress import Console

FROG = SourceRequest("example:frog", labels="auto")
QUIET = Console(quiet=True)
UNHEARD = MessageConsole(lambda message: None)


def megabytes(source: SourceRequest, gaussians: int) -> float:
    """Of the page of a source."""
    made = convert(ConvertRequest(source, fit=FitOptions(gaussians), live=True, scored=False), QUIET)
    known = format_of("page.html")
    assert known is not None
    return len(encoded(known, made.gaussians, made.ply, "page.html")) / 1e6


def seconds(pair: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """The least processor seconds of each."""
    found: dict[str, list[float]] = {name: [] for name in pair}
    for _ in range(rounds + 1):
        for name, what in pair.items():
            start = time.process_time()
            what()
            found[name].append(time.process_time() - start)
    return {name: min(times[1:]) for name, times in found.items()}


def measured(
    name: str, source: SourceRequest, gaussians: tuple[int, ...], rounds: int, better: bool
) -> list[dict[str, Any]]:
    """A row a number of Gaussians and light; seconds are of the default number, unlit."""
    rows: list[dict[str, Any]] = [
        {"scene": name, "light": light, "gaussians": count, "MB": megabytes(lit, count)}
        for light, lit in (("none", source), ("headlight", replace(source, light=LightOptions(("headlight",)))))
        for count in gaussians
    ]
    with tempfile.TemporaryDirectory() as folder:
        file = ConvertRequest(source, str(Path(folder, "a.ply")), overwrite=True)
        times = {"closed form": 0.0, "first page": 0.0, "convert": 0.0, "better form": 0.0}
        if rounds:
            times |= seconds(
                {
                    "closed form": lambda: convert(replace(file, scored=False), QUIET),
                    "first page": lambda: LoadedVolume(source, name, UNHEARD).send_live(UNHEARD),
                },
                rounds,
            )
        if rounds and better:
            tf = load(source).tf
            viewed = LoadedVolume(source, name, UNHEARD)
            viewed.send_live(UNHEARD)

            def under() -> None:
                viewed.last = None  # not going on from the round before
                viewed.convert(tf, UNHEARD)

            times |= seconds({"convert": lambda: convert(file, QUIET), "better form": under}, rounds)
    return [row | {key: value or None for key, value in times.items()} for row in rows]


@click.command()
@click.argument("paths", nargs=-1)
@click.option("-o", "--output")
@click.option("--scene", "names", multiple=True)
@click.option("--gaussians", multiple=True, type=int, default=(100_000, 300_000))
@click.option("--rounds", default=3)
@click.option("--better", is_flag=True)
@click.option("--table", "table")
def main(
    paths: tuple[str, ...], output: str | None, names: tuple[str, ...], gaussians: tuple[int, ...], rounds: int,
    better: bool, table: str | None,
) -> None:  # fmt: skip
    """See the module."""
    if table:
        print_table(table)
        return
    listing, data, functions = map(Path, paths)
    rows = []
    for name, volume, options, function in [*scene_rows(str(listing)), ("frog", "", "", "")]:
        if names and name not in names:
            continue
        source = SourceRequest(
            str(data / volume), read_options(options), str(functions / function), unit_distance="mean-spacing"
        )
        for row in measured(name, source if volume else FROG, gaussians, rounds, better):
            rows.append(row)
            print(row, flush=True)
    write_rows(output, rows)


if __name__ == "__main__":
    main()
