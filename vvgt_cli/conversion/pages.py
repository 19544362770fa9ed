"""`vvgt convert` of several clouds into one page: the frames of a series, several functions, the labels of a map."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vvgt_cli.conversion.frames import steps_of
from vvgt_cli.conversion.functions import convert_functions
from vvgt_cli.conversion.gaussian_files import write_page
from vvgt_cli.conversion.labels import convert_labels
from vvgt_cli.conversion.manifest import Shard
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.conversion.series import convert_series
from vvgt_cli.errors import SeveralSteps, UsageError
from vvgt_cli.files import temporary_folder
from vvgt_cli.gaussians.outputs import claimed
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.volume.tiff import SUFFIXES
from vvgt_cli.volume.tiff.slices import matching

MOST = 3_000_000  # Gaussians of all frames of a live page: 90 MB of it


def page_of_volume(request: ConvertRequest, alone: Callable[[], object], console: Console) -> None:
    """One volume, which ``alone`` converts, or the frames of a series: a file of several steps, or a glob of volumes.

    Raises:
        UsageError, DataError: as `convert` and `convert_series`.
    """
    if not is_glob_of_volumes(request.source.path):
        try:
            alone()
            return
        except SeveralSteps:
            pass
    if request.live:
        request = _bounded(request, console)
    _page(request, lambda one: convert_series(one, Shard(), console), console)


def _bounded(request: ConvertRequest, console: Console) -> ConvertRequest:
    """As many Gaussians a frame as a page of all frames can hold."""
    frames, asked = len(steps_of(request.source)), request.fit.max_gaussians
    most = max(MOST // frames, 1)
    if asked <= most:
        return request
    console.say(f"{request.output}: {frames} frames in one page; {most} Gaussians each in the place of {asked}")
    return replace(request, fit=replace(request.fit, max_gaussians=most))


def page_of_functions(request: ConvertRequest, functions: Sequence[str], console: Console) -> None:
    """One volume under several functions.

    Raises:
        UsageError, DataError: as `convert_functions`.
    """
    _page(request, lambda one: convert_functions(one, functions, console), console)


def page_of_labels(request: ConvertRequest, console: Console) -> None:
    """The labels of a map, each alone.

    Raises:
        UsageError, DataError: as `convert_labels`.
    """
    _page(request, lambda one: convert_labels(one, console), console)


def _page(request: ConvertRequest, make: Callable[[ConvertRequest], dict[str, Any]], console: Console) -> None:
    """Let ``make`` write a `.ply` a cloud into a folder that goes again, and join them by its index."""
    if request.report or request.preview or request.checkpoint:
        raise UsageError(
            f"{request.output} gets several clouds of Gaussians: --report, --preview and --checkpoint are of one each; "
            "leave them out, or give -o a place for the name or number, as out_{:04d}.ply"
        )
    if request.limits.max_megabytes is not None:
        raise UsageError(f"--max-size is of one file; {request.output} holds several: give --max-gaussians for each")
    assert request.output is not None
    run = Run(console, ConversionReport("convert"))
    with claimed(request.outputs(), request.inputs(), request.overwrite), temporary_folder(request.output) as folder:
        index = make(replace(request, output=str(folder / "{}.ply"), overwrite=True))
        clouds = [(row["name"], str(folder / row["file"])) for row in index["files"]]
        write_page(run, request.output, clouds, request.overwrite)
        run.finish()


def is_glob_of_volumes(path: str) -> bool:
    """Whether a path is a glob of files that are volumes of their own, and not slices of one."""
    if os.path.exists(path) or not set(path) & set("*?["):
        return False
    files = matching(path)
    if any(file.suffix.lower() not in SUFFIXES for file in files):
        return True
    return bool(files) and _pages(files[0]) > 1


def _pages(path: Path) -> int:
    """Of a TIFF; 1 where it cannot be read, which reading it says."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            return len(file.pages)
    except Exception:  # whatever a damaged file makes of it
        return 1
