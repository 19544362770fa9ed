"""`vvgt infer`: Gaussians improved by an exported network, kept if the views agree."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from vvgt_cli.commands import options as shared

if TYPE_CHECKING:
    from vvgt_cli.cameras import Camera
    from vvgt_cli.conversion.result import Result
    from vvgt_cli.library.inputs import PathLike
    from vvgt_cli.progress import Console
    from vvgt_cli.score.record import Run

CHECK_VIEWS = 4  # views that the network is not shown, as many as the default check set


def infer(
    ply: PathLike, output: PathLike | None = None, *, views: PathLike, model: str, provider: str = "cpu",
    report: PathLike | None = None, overwrite: bool = False, progress: bool | Console = False,
) -> Result:  # fmt: skip
    """Improve Gaussians with a network that looks at views of their volume: ``vvgt infer``.

    Args:
        ply: a file, "-" is standard input.
        output: ``.ply`` to write; "-" is standard output, None writes nothing.
        views: folder of ``vvgt render-views``.
        model: folder of a model, or the name of one that is shipped.
        provider: "cpu" or "cuda".
        report: JSON to write.
        overwrite: replace files that exist.
        progress: print messages and bars on standard error.

    Returns:
        The better Gaussians, or those of the file if the check views show no gain.

    Raises:
        UsageError: an output that may not be written, or an unknown model or provider.
        DataError: Gaussians, views or a model that are not valid.
    """
    from vvgt_cli.library.inputs import written

    name = os.fspath(ply)
    make = partial(_improved, name, os.fspath(views), model, provider)
    return written(make, "infer", [name], output, report, overwrite=overwrite, progress=progress)


@shared.command("infer", short_help="Improve a .ply with an exported network.")
@click.argument("ply", metavar="IN.ply")
@click.option("--views", required=True, metavar="DIR", help="Views of the volume, written by 'vvgt render-views'.")
@click.option(
    "--model", required=True, metavar="NAME", help="Folder written by 'vvgt export', or the name of a shipped model."
)
@click.option("-o", "--output", required=True, metavar="OUT.ply", help="Output file; - is standard output.")
@click.option(
    "--provider", type=click.Choice(["cpu", "cuda"]), default="cpu", show_default=True, help="Device for onnxruntime."
)
@shared.report_option
@shared.overwrite_option
@shared.common_options
def command(console: Console, **options: Any) -> None:
    """Improve the Gaussians of IN.ply with a network that looks at views of their volume.

    The network reads a fixed number of training views, chosen far apart. Up to four other views check the result: if
    their PSNR does not rise, the Gaussians of IN.ply are written unchanged and a message says so. IN.ply may be "-".

    Example:
      vvgt render-views head.nrrd --tf bone.json -o views
      vvgt init head.nrrd --tf bone.json -o - | vvgt infer - --views views --model vvgt-small -o head.ply
    """
    infer(**options, progress=console)


def divide(cameras: Sequence[Camera], wanted: int) -> tuple[list[int], list[int]]:
    """Return the indices of the views that the network reads, and of those that check its result.

    The check views are other views, as far apart as possible; if there are none, the views that it reads.
    """
    from vvgt_cli.cameras import farthest_cameras

    read = farthest_cameras(cameras, wanted)
    others = [i for i in range(len(cameras)) if i not in read]
    check_views = [others[i] for i in farthest_cameras([cameras[i] for i in others], CHECK_VIEWS)] if others else read
    return read, check_views


def _improved(name: str, folder: str, model: str, provider: str, run: Run) -> Result:
    from dataclasses import replace

    import numba

    from vvgt_cli.conversion.gaussian_files import file_rule, layout_of, open_gaussians
    from vvgt_cli.conversion.result import Result
    from vvgt_cli.images.files import load_views
    from vvgt_cli.jit.ahead import INFER
    from vvgt_cli.network.card import find_model
    from vvgt_cli.network.runtime import Model
    from vvgt_cli.score.views import Views

    with run.stage("read") as stage:
        network = Model.open(find_model(model), numba.get_num_threads(), provider)
        gaussians, header = open_gaussians(name)
        cameras, images = load_views(folder, "train")
        edge = cameras[0].width
        rule = file_rule(header).at(edge / (header.screen_size or edge))
        read, check_views = divide(cameras, network.card.network.total_views)
        stage.note = f"{len(gaussians)} Gaussians, {len(cameras)} views, model {network.card.name}"
    run.compile(INFER)
    with run.stage("network") as stage:
        shown = [cameras[i] for i in read]
        better = network.improve(gaussians, shown, images[read], progress=run.console.bar("network"), rule=rule)
        stage.note = f"reads {len(read)} views"
    with run.stage("check views") as stage:
        views = Views(cameras, images).take(check_views)
        before, after = views.psnr(gaussians, rule), views.psnr(better, rule)
        stage.psnr, stage.kept = after, after > before
        own = "" if set(check_views) - set(read) else ", all read by the network"
        stage.note = f"from {before:.2f} dB on {len(check_views)} views{own}"
    run.report.options = {
        "model": network.card.name,
        "provider": provider,
        "read": [cameras[i].name for i in read],
        "check_views": [cameras[i].name for i in check_views],
        "psnr_before": before,
        "psnr_after": after,
    }
    return Result(better if stage.kept else gaussians, run.report, replace(layout_of(header), certificate=None))
