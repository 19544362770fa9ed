"""`vvgt tf`: transfer functions written in another format, suggested for a volume, or drawn over its histogram."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.commands.words import SectionedCommand
from vvgt_cli.errors import UsageError

if TYPE_CHECKING:
    from vvgt_cli.progress import Console


@click.group("tf", short_help="Show, convert and suggest transfer functions.")
def command() -> None:
    """Show, convert and suggest transfer functions."""


command.command_class = SectionedCommand


@command.command("show", short_help="Draw a transfer function over a histogram.")
@click.argument("tf")
@click.option("-o", "--output", required=True, metavar="OUT.png", help="Output file.")
@click.option("--volume", metavar="VOLUME", help="Volume whose histogram is drawn behind the function.")
@shared.tf_range_option
@shared.read_options
@shared.overwrite_option
@shared.common_options
def show(
    tf: str, output: str, volume: str | None, tf_range: str, read: dict[str, Any], overwrite: bool, console: Console
) -> None:
    """Draw the colours and opacity of TF, over the histogram of --volume if given.

    Example:
      vvgt tf show bone.json -o bone.png --volume head.nrrd
    """
    from vvgt_cli.gaussians.outputs import Output, check_outputs
    from vvgt_cli.look import draw, read_transfer_function, resolve
    from vvgt_cli.volume import ReadOptions, read_volume, statistics

    options = ReadOptions(**read)
    if volume is None and (tf_range != "data" or options != ReadOptions()):
        raise UsageError("--tf-range and reading options need --volume")
    check_outputs([Output("-o", output, (".png",))], [tf, volume], overwrite)
    function, stats = read_transfer_function(tf), None
    if volume is not None:
        data = read_volume(volume, options)
        stats = statistics(data)
        function = resolve(function, stats, tf_range, data.hounsfield)
    draw(function, stats, output, overwrite)


@command.command("convert", short_help="Write a transfer function in another format.")
@click.argument("tf", metavar="IN")
@click.argument("output", metavar="OUT")
@click.option(
    "--format", "form", type=click.Choice(["minimal", "paraview"]), default="minimal", show_default=True,
    help="Minimal JSON, which stores the unit distance, or a ParaView preset, which stores midpoints and sharpness.",
)  # fmt: skip
@shared.tf_range_option
@shared.overwrite_option
@shared.common_options
def convert(tf: str, output: str, form: str, tf_range: str, overwrite: bool, console: Console) -> None:
    """Convert the transfer function IN (any supported format, or the name of a colour map) to the JSON file OUT.

    Features that the format cannot store are an error, unit distance and light a message. OUT may be - for
    standard output.

    Examples:
      vvgt tf convert CT-Bone.vp bone.json
      vvgt tf convert plasma.itf plasma.json --tf-range 0,255 --format paraview
    """
    from vvgt_cli.gaussians.outputs import Output, check_outputs, write_text
    from vvgt_cli.look import PER_VOXEL, read_transfer_function
    from vvgt_cli.look.resolve import parse_tf_range, placed
    from vvgt_cli.look.to_json import to_text

    check_outputs([Output("OUT", output, (".json",), binary=False)], [tf.partition("#")[0]], overwrite)
    limits = parse_tf_range(tf_range)
    if limits == "rescale":
        raise UsageError("--tf-range rescale needs the data, and this command reads none; give --tf-range LO,HI")
    function = placed(read_transfer_function(tf), None if isinstance(limits, str) else limits)
    text = to_text(function, form)
    distance = PER_VOXEL if function.opacity_unit_label == PER_VOXEL else f"{function.opacity_unit_distance or 0:g}"
    if form == "paraview" and distance != "0":
        console.message(
            f"{output}: a ParaView preset stores no unit distance: set it to {distance} there, or give "
            f"--opacity-unit-distance {distance} here"
        )
    if form == "paraview" and function.lighting is not None:
        console.message(f"{output}: a ParaView preset stores no shading; use --light headlight with it")
    write_text(output, text, overwrite)


@command.command("list", short_help="List the named functions.")
@shared.common_options
def list_named(console: Console) -> None:
    """Print the names of the built-in functions, which --tf and 'vvgt tf' accept, and what each shows.

    Examples:
      vvgt tf list
      vvgt tf convert ct-bone mine.json
    """
    from vvgt_cli.look.readers.names import names

    known = names()
    for name, shows in known.items():
        click.echo(f"{name:<{max(map(len, known)) + 2}}{shows}")


@command.command("suggest", short_help="Suggest functions that each show one range of values.")
@click.argument("volume")
@click.option(
    "-n", "--number", type=click.IntRange(1, 100), default=10, show_default=True, metavar="N",
    help="Number of functions.",
)  # fmt: skip
@click.option("-o", "--output", required=True, metavar="DIR", help="Output directory, created if missing.")
@shared.read_options
@shared.overwrite_option
@shared.common_options
def suggest_functions(
    volume: str, number: int, output: str, read: dict[str, Any], overwrite: bool, console: Console
) -> None:
    """Write N transfer functions for VOLUME, each showing one range of values in its own colour.

    The background is excluded and the remaining values are divided evenly, half by value and half by number of
    voxels. The files are minimal JSON, ready to use or edit; their paths are printed.

    Example:
      vvgt tf suggest head.nrrd -n 10 -o bands
    """
    from vvgt_cli.gaussians.outputs import check_folder, write_text
    from vvgt_cli.look.suggest import fitting, suggest
    from vvgt_cli.score.record import ConversionReport, Run
    from vvgt_cli.volume import ReadOptions, read_volume, statistics

    folder = Path(output)
    check_folder(folder, "functions")
    paths = [folder / f"band_{k:0{len(str(number))}d}.json" for k in range(1, number + 1)]
    for path in paths:
        if path.exists() and not overwrite:
            raise UsageError(f"{path} exists; give --overwrite to replace it, or another directory")
    run = Run(console, ConversionReport("tf suggest"))
    with run.stage("read") as stage:
        grid = read_volume(volume, ReadOptions(**read))
        stats = statistics(grid)
        stage.note = f"{grid.name}: values {stats.lo:g} to {stats.hi:g}"
    with run.stage("suggest") as stage:
        suggestions = suggest(stats, number, sum(grid.dims) / 3, sum(grid.spacing) / 3)
        folder.mkdir(exist_ok=True)
        for path, suggestion in zip(paths, suggestions, strict=True):
            write_text(str(path), suggestion.to_json(), overwrite)
        stage.note = f"{number} functions in {folder}"
    for path, suggestion in zip(paths, suggestions, strict=True):
        console.message(f"{path}: {suggestion.name}, {100 * suggestion.share:.3g} % of the voxels")
    preset = fitting(stats, grid)
    console.message(f"preset that fits: --tf {preset}" if preset else "no preset fits ('vvgt tf list')")
    for path in paths:
        click.echo(path)
