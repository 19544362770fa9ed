"""`vvgt convert`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Unpack

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.commands.words import ASIDE, command_line
from vvgt_cli.defaults import EARLY, INIT, MAX_STEPS, RULE, STEPS

if TYPE_CHECKING:
    from vvgt_cli.conversion.clouds import Clouds
    from vvgt_cli.conversion.result import Conversion
    from vvgt_cli.field.settings import BlockOptions
    from vvgt_cli.gaussians.story import StoryLike
    from vvgt_cli.library.inputs import LooksLike, PathLike, Reading, VolumeLike
    from vvgt_cli.progress import Console


def convert(
    volume: VolumeLike, look: LooksLike = None, output: PathLike | None = None, *, max_gaussians: int | None = None,
    screen: int | None = None, target: str | None = None, target_psnr: float | None = None,
    time_budget: float | None = None, max_megabytes: float | None = None, steps: int | None = None, init: str = INIT,
    model: str | None = None, rule: str | None = None, seed: int = 0, device: str = "cpu", live: bool = False,
    split_labels: bool = False, after: Conversion | None = None, frame: str = "unit", up: str = "auto",
    camera: tuple[float, ...] | None = None, sh_degree: int | None = None, comments: bool = True, values: bool = True,
    title: str | None = None, story: StoryLike | None = None, report: PathLike | None = None,
    preview: PathLike | None = None, checkpoint: PathLike | None = None, shard: str | None = None,
    dry_run: bool = False, all_views: bool = False, blocks: int | str | BlockOptions | None = None,
    overwrite: bool = False, progress: bool | Console = False, command: str | None = None, **reading: Unpack[Reading],
) -> Conversion | Clouds | str | None:  # fmt: skip
    """Convert a volume under a transfer function to 3D Gaussians: ``vvgt convert``.

    >>> import vvgt_cli as vvgt
    >>> result = vvgt.convert("example:marschner-lobb:24", max_gaussians=200, screen=64, steps=0)
    >>> result.scores["psnr"] > 15
    True

    Args:
        volume: a path (or ``example:NAME``); an array (nz, ny, nx), of numpy or Dask, with ``spacing`` (x, y, z) or
            ``affine`` (4, 4); an xarray.DataArray; a pyvista.ImageData; or a `Volume`. A file of several time steps
            without ``time``, or a glob of volumes, is a series. Dask arrays are never computed as a whole.
        look: function, light, labels and layers: a `Look`, or the function alone. Several: a list, or a mapping
            of names to looks.
        output: file to write, as ``-o``; None keeps the result in memory.
        max_gaussians: maximum number of Gaussians; None: that of the target, or 100,000.
        screen: pixels along the edge of the screen that the result is made for; None: the target's, or 1080.
        target: device that it is made for, as ``--for``.
        target_psnr: PSNR (dB) at which to stop.
        time_budget: seconds of the whole run.
        max_megabytes: maximal size of a ``.ply`` or a page, 10^6 bytes.
        steps: maximum number of steps of gradient descent; None: the default.
        init: closed form, "moments", "wavelet" or "uniform".
        model: network to run before the steps: a folder, or the name of a shipped one.
        rule: viewer to optimise for, by how it draws a Gaussian; None: the target's, or "inria".
        seed: random seed of ``init="uniform"``.
        device: "cpu" or "cuda", where views are drawn and steps are taken.
        live: let Gaussians carry data values, so that `Result.recolor` shows them under any function (docs/live.md).
        split_labels: make a result, or a file, of each label of a label map.
        after: an earlier conversion of the same volume to start from: its Gaussians, under the new look, are refined by
            a few steps where that is about as accurate, which is several times as fast (docs/python.md).
        frame: coordinates of the file, "unit" or "world".
        up: direction that viewers show upwards, as ``--up``.
        camera: where pages open: eye, target and field of view, seven numbers in the world.
        sh_degree: degree of the harmonics in the file; None: as computed.
        comments: write comments (frame, unit distance, certificate, ...) into the file.
        values: write the volume's values into a page.
        title: title of pages.
        story: for a page to tell: a ``story.json`` or its content (docs/page.md); needs a page as ``output``.
        report: JSON of times and errors to write.
        preview: PNG to write: volume, splats and difference.
        checkpoint: folder for the results of stages until the output is written.
        shard: ``I/N``, the part of a series to convert.
        dry_run: return the plan as text; write nothing.
        all_views: score on all ten test views, by SSIM and FLIP too, as with a report.
        blocks: voxels along the edge of blocks, or "auto"; None: only for large files.
        overwrite: replace files that exist.
        progress: print messages and bars on standard error.
        command: command line that the file records.
        **reading: how to read the volume; see `Reading`.

    Returns:
        Gaussians in the unit frame with scores, stages, `save`, `render` and `preview`; for several frames, looks or
        labels `Clouds`, a mapping of names to results with a `save` for all, or None where each has a file.

    Raises:
        DataError: the input is invalid, or nothing is visible.
        UsageError: options contradict each other.
    """
    from vvgt_cli.conversion.convert_batch import convert_all
    from vvgt_cli.conversion.request import FitOptions
    from vvgt_cli.conversion.result import Conversion
    from vvgt_cli.errors import UsageError
    from vvgt_cli.gaussians import PlyOptions
    from vvgt_cli.gaussians.formats import is_page
    from vvgt_cli.gaussians.story import read_story
    from vvgt_cli.library.inputs import console_of, requests_of

    if not isinstance(after, Conversion | None):
        raise UsageError("after: expected the result of convert for one volume and look")
    if output is not None and not is_page(output) and not values:
        raise UsageError(f"--no-values is for a page; got -o {output}; expected -o OUT.html")
    fit = FitOptions.of(
        target, max_gaussians=max_gaussians, screen=screen, init=init, rule=rule, seed=seed, steps=steps, model=model,
        device=device, target_psnr=target_psnr, time_budget=time_budget, max_megabytes=max_megabytes,
    )  # fmt: skip
    ply = PlyOptions(frame=frame, camera=camera, sh_degree=sh_degree, comments=comments)
    requests, several = requests_of(
        volume, look, reading, output=output, fit=fit, ply=ply,
        up=up, report=report, preview=preview, checkpoint=checkpoint, live=live, values=values, title=title,
        story=None if story is None else read_story(story),
        all_views=all_views, blocks=blocks, overwrite=overwrite, command=command,
    )  # fmt: skip
    return convert_all(
        requests, as_clouds=several, split_labels=split_labels, dry_run=dry_run, shard=shard, after=after,
        console=console_of(progress),
    )  # fmt: skip


@shared.command("convert", short_help="Convert a volume to a .ply of Gaussians.")
@click.argument("volume")
@shared.output_option
@shared.optics_options(" Repeatable: each function gets a file, named by {} in OUT.ply.", multiple=True)
@shared.target_option(
    "Device to make the file for: sets --max-gaussians, --max-megabytes, --screen and --rule where they are not given, "
    "and scores it as seen there, on a headset by both eyes."
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
@shared.rule_option(f"Viewer to optimise for, by how it draws a Gaussian. Default: {RULE}.")
@click.option(
    "--steps", type=click.IntRange(0, 10_000_000), metavar="N",
    help=f"Maximum number of gradient descent steps; 0 for none. Default: {STEPS}, {EARLY} where more would hardly be "
    f"seen, or up to {MAX_STEPS} with a target or time budget.",
)  # fmt: skip
@click.option(
    "--live", is_flag=True,
    help="Store data values with the Gaussians, so that 'vvgt recolor' can show them under any function.",
)  # fmt: skip
@shared.values_option
@click.option("--model", metavar="NAME", help="Trained network to run before the steps; discarded if it does not help.")
@shared.ply_options
@shared.placed_read_options
@shared.report_option
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
def command(**options: Any) -> None:
    """Convert VOLUME to a standard 3D Gaussian Splatting .ply.

    VOLUME is a file (NRRD, NIfTI, MetaImage, DICOM, TIFF, VTK, raw, ...), a folder of slices (DICOM, TIFF, PNG, BMP,
    JPEG), "example:NAME" for one of the volumes that come with the program, or "-" for raw values on standard input.
    Without --tf, a transfer function is made from the data.

    The result is scored on test views that it was not fitted to, and the error is printed. --target-psnr,
    --time-budget and --max-megabytes decide which stages run. Ctrl-C ends gradient descent early and writes the result.

    OUT.ply may end in .html (a page that opens in a browser), .spz, .v4.spz, .compressed.ply, .sog, .glb, .usdc or
    .usdz. FOLDER/lod-meta.json writes levels of detail that viewers load as they are needed.

    For a time series, VOLUME is a glob or a file with several time steps, and OUT.ply or FOLDER has a placeholder: {}
    or {:04d} for the frame's number, {step}, {time} or {stem} (name) of its input. All frames share one function and
    value range; run the command again to resume. A name ending in .html without a placeholder makes one page of all
    frames, functions or labels, one in .glb, .usdc or .usdz one file with a node for each function or label.

    Examples:
      vvgt convert example:frog -o frog.ply --preview frog.png
      vvgt convert map.mrc --iso 3sigma -o map.ply --max-gaussians 50000 --steps 200
      vvgt convert head.nrrd --tf bone.json -o head.html --for quest --time-budget 60
      vvgt convert huge.zarr -o huge/lod-meta.json --max-gaussians 10000000
      vvgt convert head.nrrd --tf bone.json -o head.ply --target-psnr 35 --max-megabytes 5
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
    line = command_line(click.get_current_context(), ASIDE, folders=False)
    plan = convert(**shared.arguments(**options), command=line)
    if options["dry_run"]:
        click.echo(plan)
