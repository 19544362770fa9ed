"""`vvgt convert`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.commands.words import ASIDE, command_line, typed
from vvgt_cli.defaults import MAX_STEPS, RULE, STEPS
from vvgt_cli.progress import Console


@shared.command("convert", short_help="Convert a volume to a .ply of Gaussians.")
@click.argument("volume")
@shared.output_option
@shared.optics_options(" Repeatable: each function gets a file, named by {} in OUT.ply.", multiple=True)
@shared.target_option(
    "Device to make the file for: sets --max-gaussians, --max-size, --size and --rule where they are not given, and "
    "scores it as seen there, on a headset by both eyes."
)
@shared.fit_options
@shared.limit_options
@shared.light_options
@click.option(
    "--preview", metavar="P.png", help="Save volume, splats and difference side by side, in three test views."
)
@click.option("--dry-run", is_flag=True, help="Print the plan with estimated time, memory and size; write nothing.")
@shared.title_option
@shared.story_option
@shared.overwrite_option
@shared.rule_option("Viewer to optimise for, by how it draws a Gaussian.", RULE)
@click.option(
    "--steps", type=click.IntRange(0, 10_000_000), metavar="N",
    help=f"Maximum number of gradient descent steps; 0 for none. Default: {STEPS}, or up to {MAX_STEPS} with a target "
    "or time budget.",
)  # fmt: skip
@click.option(
    "--live", is_flag=True,
    help="Store data values with the Gaussians, so that 'vvgt recolor' can show them under any function.",
)  # fmt: skip
@shared.values_option
@click.option("--model", metavar="NAME", help="Trained network to run before the steps; discarded if it does not help.")
@shared.ply_options
@shared.placed_read_options
@click.option("--report", metavar="R.json", help="Save times and errors of all stages as JSON; - is standard output.")
@click.option(
    "--checkpoint", metavar="FOLDER",
    help="Save progress here, so that the same command resumes after an interruption.",
)  # fmt: skip
@click.option(
    "--split-labels", is_flag=True,
    help="Write one file per label of a label map, named by {} in OUT.ply, and an index; or one page (.html), or one "
    ".glb, .usdc or .usdz with a node per label and, with --layer, per layer.",
)  # fmt: skip
@shared.device_option("views are drawn and steps are taken")
@shared.block_options
@click.option("--shard", metavar="I/N", help="Convert part I of N of a time series, for job arrays; I starts at 1.")
@shared.common_options
def command(
    volume: str, shard: str | None, dry_run: bool, split_labels: bool, live: bool, values: bool,
    title: str | None, story: str | None, console: Console, blocks: dict[str, Any], **options: Any,
) -> None:  # fmt: skip
    """Convert VOLUME to a standard 3D Gaussian Splatting .ply.

    VOLUME is a file (NRRD, NIfTI, MetaImage, DICOM, TIFF, VTK, raw, ...), a folder of slices (DICOM, TIFF, PNG, BMP,
    JPEG), "example:NAME" for one of the volumes that come with the program, or "-" for raw values on standard input.
    Without --tf, a transfer function is made from the data.

    The result is scored on test views that it was not fitted to, and the error is printed. --target-psnr,
    --time-budget and --max-size decide which stages run. Ctrl-C ends gradient descent early and writes the result.

    OUT.ply may end in .html (a page that opens in a browser), .spz, .compressed.ply, .sog, .glb, .usdc or .usdz.
    FOLDER/lod-meta.json writes levels of detail that viewers load as they are needed.

    For a time series, VOLUME is a glob or a file with several time steps, and OUT.ply or FOLDER has a placeholder: {}
    or {:04d} for the frame's number, {step}, {time} or {stem} (name) of its input. All frames share one function and
    value range; run the command again to resume. A name ending in .html without a placeholder makes one page of all
    frames, functions or labels, one in .glb, .usdc or .usdz one file with a node for each function or label.

    Examples:
      vvgt convert example:frog -o frog.ply --preview frog.png
      vvgt convert map.mrc --iso 3sigma -o map.ply --max-gaussians 50000 --steps 200
      vvgt convert head.nrrd --tf bone.json -o head.html --for quest --time-budget 60
      vvgt convert huge.zarr -o huge/lod-meta.json --max-gaussians 10000000
      vvgt convert head.nrrd --tf bone.json -o head.ply --target-psnr 35 --max-size 5
      vvgt convert - --dims 64 64 93 --dtype uint16 -o - < head.raw > head.ply
      vvgt convert 'run_*.vti' --tf tf.json -o 'out_{step}.ply'
      vvgt convert head.nrrd --tf bone.json --tf skin.json -o 'head_{}.ply'
      vvgt convert four.nii -o four.html
      vvgt convert head.nrrd --story story.json -o lesson.html
      vvgt convert cells.ome.tif --channel DAPI,GFP --time 0 -o cells.ply
      vvgt convert atlas.nii.gz --labels atlas.label --split-labels -o 'atlas_{}.ply'
      vvgt convert atlas.nii.gz --labels lut.txt --split-labels -o atlas.glb
      vvgt convert ct.nrrd --tf bone.json --layer organs.seg.nrrd -o both.ply
    """
    from vvgt_cli.conversion.convert_batch import convert_files
    from vvgt_cli.conversion.gaussian_files import is_page
    from vvgt_cli.errors import UsageError
    from vvgt_cli.gaussians.story import read_story

    given = {parameter.name for parameter in typed(click.get_current_context())}
    options["fit"]["rule"] = options.pop("rule")
    options["fit"] |= {name: None for name in ("max_gaussians", "size", "rule") if name not in given}
    line = command_line(click.get_current_context(), ASIDE, folders=False)
    request = shared.convert_request(volume, **options)
    functions = options["optics"]["tf"] or tuple(filter(None, [request.source.tf]))
    if not is_page(request.output) and not values:
        raise UsageError(f"--no-values is for a page; got -o {request.output}; expected -o OUT.html")
    request = replace(
        request, blocks=shared.block_options_of(blocks), live=live, values=values,
        command=line, title=title, story=read_story(story) if story else None,
    )  # fmt: skip
    plan = convert_files(
        request, functions, split_labels=split_labels, dry_run=dry_run, shard=shard, console=console
    )  # fmt: skip
    if plan is not None:
        click.echo(plan)
