"""How near live files are to their volumes under functions that nothing was made for, beside conversions for these.

python benchmarks/live.py SCENES.tsv DATA FUNCTIONS -o docs/live.csv [--scene NAME] [--gaussians N] [--direct]
python benchmarks/live.py SCENES.tsv DATA FUNCTIONS --lit [-o FILE.csv] [--scene NAME] [--gaussians N]
python benchmarks/live.py --table docs/live.csv

A file is made for the scene's function, and shown under a band, a step and a ramp that follow from the histogram. With
--lit the scene's own function is shown instead, under lights, beside the closed form that is made for each.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import click
import numpy as np
from dvr_scenes import print_table, read_scenes, write_rows

from vvgt_cli.cameras.sets import pixel_width
from vvgt_cli.conversion.fitting import fit, work_of
from vvgt_cli.conversion.live import box_lighting, fog, fog_start, function_table, widen_narrow, with_values
from vvgt_cli.conversion.opened import degree_of, open_field
from vvgt_cli.conversion.recolored import visible_cloud
from vvgt_cli.conversion.request import ConvertRequest, FitOptions
from vvgt_cli.conversion.stage import Work
from vvgt_cli.conversion.stages import ClosedFormStage
from vvgt_cli.field.field import Resident
from vvgt_cli.field.layered import OpenedFile
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.live import apply_look, baked
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.histogram import background_bins
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.score.views import score_test_views
from vvgt_cli.volume import Statistics

SIZE = 1080


def functions(numbers: Statistics) -> dict[str, TransferFunction]:
    """A tent of 6 % of the range at the 70th percentile of the foreground, a step at its median, a ramp over all."""
    counts, lo, hi = numbers.histogram.astype(float), numbers.lo, numbers.hi
    first, last = background_bins(counts)
    counts[first:last] = 0
    if last > first and first < len(counts) - last:
        counts[:first] = 0
    rank = np.concatenate([[0.0], np.cumsum(counts)]) / counts.sum()
    median, middle = (float(np.interp(p, rank, numbers.edges)) for p in (0.5, 0.7))
    foot, part = float(numbers.edges[last]) if last > first else lo, 0.03 * (hi - lo)
    colors = ColorMap(np.array([lo, (lo + hi) / 2, hi]), np.array([[0.1, 0.2, 0.8], [0.9, 0.8, 0.3], [0.8, 0.1, 0.1]]))
    tints = [[1, 0.6, 0.2], [1, 0.6, 0.2], [0.3, 0.7, 1], [0.3, 0.7, 1]]
    two = ColorMap(np.array([lo, middle - part, middle + part, hi]), np.array(tints))
    nodes = {
        "band": ([middle - part, middle, middle + part], [0, 0.3, 0], two),
        "step": ([median - part / 6, median + part / 6], [0, 0.6], colors),
        "ramp": ([foot, hi], [0, 0.25], colors),
    }
    return {
        name: TransferFunction(name, PiecewiseOpacity(np.array(x), np.array(y, float)), tint)
        for name, (x, y, tint) in nodes.items()
    }


def direct(field: Resident, tf: TransferFunction, gaussians: int) -> Gaussians:
    """An ordinary conversion for a function."""
    source = SourceRequest(OpenedFile((field.source.volume,)), tf=tf, unit_distance="mean-spacing", labels="none")
    request = ConvertRequest(source, None, FitOptions(max_gaussians=gaussians, screen=SIZE))
    run = Run(Console(quiet=True), ConversionReport("convert"))
    with open_field(run, request) as opened:
        work = work_of(run, request, opened)
        fit(work, request)
    return work.current()


def placed(field: Resident, gaussians: int) -> Gaussians:
    """Of a live file, box frame."""
    source = field.source
    run = Run(Console(quiet=True), ConversionReport("convert"))
    assert isinstance(source.tf, TransferFunction)
    foggy = field.with_look(source.with_function(fog(source.statistics, source.tf)))
    return widen_narrow(with_values(run, foggy, fog_start(run, foggy, FitOptions(gaussians, SIZE))), SIZE)


def score(field: Resident, gaussians: Gaussians) -> float:
    """dB on three test views."""
    return score_test_views(field.views, gaussians, SIZE, every=False).psnr


def measured_lit(name: str, field: Resident, gaussians: int) -> list[dict[str, Any]]:
    """A row a light."""
    live, table, rows = placed(field, gaussians), function_table(field.source), []
    for title, lights in {"none": (), "headlight": ("headlight",), "0.3,-0.8,0.5": ("0.3,-0.8,0.5",)}.items():
        source = replace(field.source, lighting=LightOptions(lights).lighting(None, None) if lights else None)
        lit = Resident(source)
        run = Run(Console(quiet=True), ConversionReport("init"))
        fit = FitOptions(max_gaussians=gaussians, screen=SIZE)
        work = Work(run, lit, fit, degree=degree_of(ConvertRequest(SourceRequest("-"), None, fit), source))
        ClosedFormStage().run(work)
        shown = visible_cloud(live, table, box_lighting(source), pixel_width(SIZE))
        scores = {"live": score(lit, shown), "closed form": score(lit, work.current())}
        rows.append({"scene": name, "gaussians": gaussians, "light": title, **scores})
        print(rows[-1], flush=True)
    return rows


def measured(name: str, field: Resident, gaussians: int, beside: bool) -> list[dict[str, Any]]:
    """A row a function."""
    source, start = field.source, time.process_time()
    live = placed(field, gaussians)
    seconds = time.process_time() - start
    assert isinstance(source.tf, TransferFunction)
    rows, pixel = [], pixel_width(SIZE)
    for title, tf in functions(source.statistics).items():
        spacing = float(np.mean(source.volume.spacing))
        shown = field.with_look(source.with_function(replace(tf, opacity_unit_distance=spacing)))
        table = function_table(shown.source)
        looks = {
            "live": apply_look(live, table, pixel),
            "other viewers": baked(live, table, pixel),
        }  # fmt: skip
        if beside:
            looks["converted for it"] = direct(field, tf, gaussians)
        scores = {look: score(shown, some) for look, some in looks.items()}
        rows.append({"scene": name, "gaussians": gaussians, "function": title, **scores, "seconds": seconds})
        print(rows[-1], flush=True)
    return rows


@click.command()
@click.argument("paths", nargs=-1)
@click.option("-o", "--output")
@click.option("--scene", "names", multiple=True)
@click.option("--gaussians", multiple=True, type=int, default=(100_000, 300_000))
@click.option("--direct", "beside", is_flag=True)
@click.option("--lit", is_flag=True)
@click.option("--table", "table")
def main(
    paths: tuple[str, ...], output: str | None, names: tuple[str, ...], gaussians: tuple[int, ...], beside: bool,
    lit: bool, table: str | None,
) -> None:  # fmt: skip
    """See the module."""
    if table:
        print_table(table)
        return
    rows = []
    for name, source in read_scenes(*paths, names or None):  # type: ignore[misc]
        field = Resident(source)
        for count in gaussians:
            rows += measured_lit(name, field, count) if lit else measured(name, field, count, beside)
    write_rows(output, rows)


if __name__ == "__main__":
    main()
