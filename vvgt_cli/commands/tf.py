"""`vvgt tf`: transfer functions written in another format, suggested for a volume, or drawn over its histogram."""

from __future__ import annotations

from pathlib import Path

from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.outputs import STDOUT, Output, check_outputs, write_text
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.volume import ReadOptions


def convert_transfer_function(
    tf: str, output: str, form: str, tf_range: str, overwrite: bool, console: Console | None = None
) -> None:
    """Read a function and write it to a JSON file.

    Args:
        tf: file, ``FILE#NAME``, or the name of a colour map.
        output: the file, or "-" for standard output.
        form: "minimal" or "paraview".
        tf_range: "data", or "LO,HI" to stretch the nodes to.
        overwrite: replace a file that exists.
        console: for messages.

    Raises:
        UsageError: an output that may not be written, ``rescale`` (there are no data), or fractions without LO,HI.
        DataError: not a function, or one that the format cannot store.
    """
    from vvgt_cli.look import read_transfer_function
    from vvgt_cli.look.convert import placed, to_text
    from vvgt_cli.look.function import PER_VOXEL
    from vvgt_cli.look.resolve import parse_tf_range

    check_outputs([Output("OUT", output, (".json",), binary=False)], [tf.partition("#")[0]], overwrite)
    limits = parse_tf_range(tf_range)
    if limits == "rescale":
        raise UsageError("--tf-range rescale needs the data, and this command reads none; give --tf-range LO,HI")
    function = placed(read_transfer_function(tf), None if isinstance(limits, str) else limits)
    text = to_text(function, form)
    distance = PER_VOXEL if function.opacity_unit_label == PER_VOXEL else f"{function.opacity_unit_distance or 0:g}"
    if form == "paraview" and distance != "0":
        (console or Console()).message(
            f"{output}: a ParaView preset stores no unit distance: set it to {distance} there, or give "
            f"--opacity-unit-distance {distance} here"
        )
    if form == "paraview" and function.lighting is not None:
        (console or Console()).message(f"{output}: a ParaView preset stores no shading; use --light headlight with it")
    write_text(output, text, overwrite)


def suggest_transfer_functions(
    volume: str, count: int, output: str, read: ReadOptions, overwrite: bool, console: Console | None = None
) -> list[Path]:
    """Write ``count`` minimal-JSON functions into the folder ``output``, made if missing; return their paths.

    Raises:
        UsageError: a file that exists, or a folder that cannot be made.
        DataError: invalid input, or data of a single value.
    """
    from vvgt_cli.look.suggest import fitting, suggest
    from vvgt_cli.volume import read_volume, statistics

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
        grid = read_volume(volume, read)
        stats = statistics(grid)
        stage.note = f"{grid.name}: values {stats.lo:g} to {stats.hi:g}"
    with run.stage("suggest") as stage:
        suggestions = suggest(stats, count, sum(grid.dims) / 3, sum(grid.spacing) / 3)
        folder.mkdir(exist_ok=True)
        for path, suggestion in zip(paths, suggestions, strict=True):
            write_text(str(path), suggestion.to_json(), overwrite)
        stage.note = f"{count} functions in {folder}"
    for path, suggestion in zip(paths, suggestions, strict=True):
        run.console.message(f"{path}: {suggestion.name}, {100 * suggestion.share:.3g} % of the voxels")
    preset = fitting(stats, grid)
    run.console.message(f"preset that fits: --tf {preset}" if preset else "no preset fits ('vvgt tf list')")
    return paths


def show_transfer_function(
    tf: str, output: str, volume: str | None, read: ReadOptions, tf_range: str, overwrite: bool
) -> None:
    """Draw ``tf`` into a PNG, over the histogram of ``volume`` where one is given.

    Raises:
        UsageError, DataError: an output that may not be written, or inputs that are not what they must be.
    """
    from vvgt_cli.look import draw, read_transfer_function, resolve
    from vvgt_cli.volume import read_volume, statistics

    if output == STDOUT:
        raise UsageError("-o -: a picture goes to a file; expected a name ending in .png")
    if volume is None and (tf_range != "data" or read != ReadOptions()):
        raise UsageError("--tf-range and reading options need --volume")
    check_outputs([Output("-o", output, (".png",))], [tf, volume], overwrite)
    function = read_transfer_function(tf)
    stats = None
    if volume is not None:
        data = read_volume(volume, read)
        stats = statistics(data)
        function = resolve(function, stats, tf_range, data.hounsfield)
    draw(function, stats, output, overwrite)
