"""`tf suggest`: transfer functions for ranges of a volume's values, written to files."""

from __future__ import annotations

from pathlib import Path

from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.outputs import write_text
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.volume import ReadOptions


def suggest_transfer_functions(
    volume: str, count: int, output: str, read: ReadOptions, overwrite: bool, console: Console | None = None
) -> list[Path]:
    """Write ``count`` minimal-JSON functions into the folder ``output``, made if missing; return their paths.

    Raises:
        UsageError: a file that exists, or a folder that cannot be made.
        DataError: invalid input, or data of a single value.
    """
    from vvgt_cli.look.presets import fitting
    from vvgt_cli.look.suggest import suggest
    from vvgt_cli.synth.sources import open_volume
    from vvgt_cli.volume import statistics

    folder = Path(output)
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"-o {folder}: is a file; expected a directory for the functions")
    if not folder.parent.is_dir():
        raise UsageError(f"-o {folder}: no directory {folder.parent}; make it first")
    paths = [folder / f"band_{k:0{len(str(count))}d}.json" for k in range(1, count + 1)]
    for path in paths:
        if path.exists() and not overwrite:
            raise UsageError(f"{path} exists; give --overwrite to replace it, or another directory")
    run = Run(console or Console(), ConversionReport("tf suggest"))
    with run.stage("read") as stage:
        grid = open_volume(volume, read)
        numbers = statistics(grid)
        stage.note = f"{grid.name}: values {numbers.lo:g} to {numbers.hi:g}"
    with run.stage("suggest") as stage:
        suggestions = suggest(numbers, count, sum(grid.dims) / 3, sum(grid.spacing) / 3)
        folder.mkdir(exist_ok=True)
        for path, suggestion in zip(paths, suggestions, strict=True):
            write_text(str(path), suggestion.to_json(), overwrite)
        stage.note = f"{count} functions in {folder}"
    for path, suggestion in zip(paths, suggestions, strict=True):
        run.console.message(f"{path}: {suggestion.name}, {100 * suggestion.share:.3g} % of the voxels")
    preset = fitting(numbers, grid)
    run.console.message(f"preset that fits: --tf {preset}" if preset else "no preset fits ('vvgt tf list')")
    return paths
