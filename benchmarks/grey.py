"""MIP and X-ray of live files by the command and by their pages, beside the volume's own: docs/live.md.

python benchmarks/grey.py SCENES.tsv DATA FUNCTIONS [--pictures FOLDER] -o grey.csv [--scene NAME] [--gaussians N]
    [--size PX] [--no-page]
python benchmarks/grey.py --table grey.csv

Needs Chromium, node and npm, as `make viewers` does. FOLDER (out/grey) keeps the files and every picture. "command" and
"page" are PSNR in dB against `vvgt render VOLUME --rule mip` (or xray), first view of an orbit; "agreement" that of the
two. WebGL in software takes minutes a page at 1080 px, and seconds at 400.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import click
import numpy as np
from closed_form import scene_rows
from dvr_scenes import print_table, write_rows

from vvgt_cli.commands.main import run
from vvgt_cli.images import read_png, write_png
from vvgt_cli.images.metrics import psnr

sys.path.append(str(Path(__file__).parent.parent / "tests"))
from browser import page_picture

RULES = "mip", "xray"  # as many presses of k


def do(*words: object) -> None:
    """Run vvgt in this process."""
    if run([*map(str, words), "--quiet", "--overwrite"]):
        raise SystemExit(1)


def drawn(out: Path, rule: str, size: int, *file: object) -> np.ndarray:
    """Picture (size, size, 3) of the command."""
    do("render", *file, "--rule", rule, "--size", size, "-o", out)
    return read_png(out)[..., :3]


@click.command()
@click.argument("paths", nargs=-1)
@click.option("-o", "--output")
@click.option("--scene", "names", multiple=True)
@click.option("--gaussians", default=300_000)
@click.option("--size", default=1080)
@click.option("--page/--no-page", "paged", default=True)
@click.option("--pictures", "folder", default="out/grey", type=click.Path(path_type=Path, resolve_path=True))
@click.option("--table", "table")
def main(
    paths: tuple[str, ...], output: str | None, names: tuple[str, ...], gaussians: int, size: int, paged: bool,
    folder: Path, table: str | None,
) -> None:  # fmt: skip
    """See the module."""
    if table:
        print_table(table)
        return
    folder.mkdir(parents=True, exist_ok=True)
    listing, data, functions = map(Path, paths)
    rows = []
    for name, volume, options, function in scene_rows(listing, names):
        file, page = folder / f"{name}.ply", folder / f"{name}.html"
        source = (data / volume, *shlex.split(options), "--tf", functions / function)
        made = ("--opacity-unit-distance", "mean-spacing", "--live", "--max-gaussians", gaussians)
        do("convert", *source, *made, "-o", file)
        do("convert", *source, "--steps", "0", "-o", page)
        for presses, rule in enumerate(RULES, 1):
            out = folder / f"{name}-{rule}-{size}"
            own = drawn(out.with_suffix(".volume.png"), rule, size, *source)
            ours = drawn(out.with_suffix(".command.png"), rule, size, file)
            rows.append({"scene": name, "rule": rule, "gaussians": gaussians, "size": size, "command": psnr(own, ours)})
            if paged:
                shown = page_picture(page.as_uri(), folder, size, actions=[{"key": "k"}] * presses)[0]
                write_png(out.with_suffix(".page.png"), shown)
                rows[-1] |= {"page": psnr(own, shown), "agreement": psnr(ours, shown)}
            click.echo(rows[-1])
    write_rows(output, rows)


if __name__ == "__main__":
    main()
