"""Values of live files back on the grids of their volumes, beside ZFP and SZ3 (of pip: zfpy, pysz) on the same values.

python benchmarks/values_back.py SCENES.tsv DATA FUNCTIONS -o docs/values-back.csv [--scene NAME] [--gaussians N]
python benchmarks/values_back.py --table docs/values-back.csv

ZFP and SZ3 are given the largest tolerance at which they take no more bytes than the live file, or have its PSNR.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import click
import numpy as np
from dvr_scenes import print_table, read_scenes, write_rows
from live import placed

from vvgt_cli.conversion.place import to_unit_frame, with_place
from vvgt_cli.conversion.voxelize import planes_of
from vvgt_cli.field.field import Resident
from vvgt_cli.gaussians import PlyOptions, as_ply
from vvgt_cli.gaussians.live_facts import LiveFacts

STEPS = 12  # of the bisection of tolerances


def psnr(wrong: np.ndarray, span: float) -> float:
    rms = float(np.sqrt(np.mean(wrong.astype(np.float64) ** 2)))
    return float(20 * np.log10(span / rms)) if rms else 200.0


def zfp(values: np.ndarray, tolerance: float) -> tuple[int, np.ndarray]:
    import zfpy

    packed = zfpy.compress_numpy(values, tolerance=tolerance)
    return len(packed), zfpy.decompress_numpy(packed)


def sz3(values: np.ndarray, tolerance: float) -> tuple[int, np.ndarray]:
    import pysz

    how = pysz.szConfig(values.shape)
    how.errorBoundMode, how.absErrorBound = pysz.szErrorBoundMode.ABS, tolerance
    packed, _ = pysz.sz.compress(values, how)
    return packed.nbytes, pysz.sz.decompress(packed, values.dtype, values.shape)[0]


CODECS = {"zfp": zfp, "sz3": sz3}


def at_most(codec: Callable, values: np.ndarray, good: Callable[[int, np.ndarray], bool], span: float, fine: bool):
    """Bytes and dB at the coarsest (``fine``: the finest) tolerance, by bisection, that is ``good``."""
    low, high, found = -7.0, 0.0, None  # powers of ten, shares of the range
    for _ in range(STEPS):
        middle = (low + high) / 2
        size, back = codec(values, span * 10**middle)
        fits = good(size, back)
        if fits:
            found = size, psnr(back - values, span)
        low, high = (low, middle) if fits == fine else (middle, high)
    return found or (0, 0.0)


def measured(name: str, field: Resident, count: int) -> dict[str, object]:
    source, volume = field.source, field.source.volume
    began = time.process_time()
    live, made = to_unit_frame(placed(field, count), volume), time.process_time() - began
    options = with_place(PlyOptions(live=LiveFacts.of(volume, source.overall, source.tf)), volume)
    size, span = len(as_ply(live, options)), options.live.hi - options.live.lo
    values = (np.asarray(volume.data, np.float64) * volume.slope + volume.intercept).astype(np.float32)
    planes_of(name, options, live).whole()  # compiles the kernels
    began = time.process_time()
    planes = planes_of(name, options, live)
    found = planes.whole()
    seconds, wrong = time.process_time() - began, found - values
    ours = psnr(wrong, span)
    row: dict[str, object] = {
        "scene": name, "gaussians": len(live), "live_MB": size / 1e6, "volume_MB": volume.data.nbytes / 1e6,
        "made_s": made, "seconds": seconds, "psnr": ours,
        "psnr_covered": psnr(wrong[found != np.float32(planes.background)], span),
        "largest_%": float(100 * np.abs(wrong).max() / span),
    }  # fmt: skip
    for title, codec in CODECS.items():
        equal = at_most(codec, values, lambda n, _: n <= size, span, True)
        same = at_most(codec, values, lambda _, back: psnr(back - values, span) >= ours, span, False)
        row |= {f"{title}_at_equal_MB": equal[1], f"{title}_MB_at_equal_dB": same[0] / 1e6}
    print(row, flush=True)
    return row


@click.command()
@click.argument("paths", nargs=-1)
@click.option("-o", "--output")
@click.option("--scene", "names", multiple=True)
@click.option("--gaussians", multiple=True, type=int, default=(100_000,))
@click.option("--table", "table")
def main(
    paths: tuple[str, ...], output: str | None, names: tuple[str, ...], gaussians: tuple[int, ...], table: str | None
) -> None:
    """See the module."""
    if table:
        print_table(table)
        return
    fields = ((name, Resident(source)) for name, source in read_scenes(*paths, names or None))
    write_rows(output, [measured(name, field, count) for name, field in fields for count in gaussians])


if __name__ == "__main__":
    main()
