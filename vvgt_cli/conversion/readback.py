"""The error of a file in another format, measured by reading it back and drawing it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.blocks import spread_blocks
from vvgt_cli.cameras.sets import SIZE
from vvgt_cli.conversion.place import to_box_frame
from vvgt_cli.gaussians import Gaussians, PlyOptions, in_unit_frame
from vvgt_cli.gaussians.formats import format_of, read_splats
from vvgt_cli.gaussians.rules import INRIA, rule_of
from vvgt_cli.score.record import Run
from vvgt_cli.score.viewing import PREVIEW_VIEWS
from vvgt_cli.score.views import score_test_views

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene
    from vvgt_cli.dvr.render import Viewed
    from vvgt_cli.volume import Volume


def _stores_pictures(output: str, options: PlyOptions) -> bool:
    """Return whether a file of another format stores the look; a live page computes look and light itself."""
    found = format_of(output)
    return found is not None and (found.suffix != ".html" or options.live is None)


def report_agreement(run: Run, output: str, gaussians: Gaussians, options: PlyOptions) -> None:
    """Report how close pictures of a written file are to those of the Gaussians, unless it is a `.ply`.

    Args:
        run: gets a stage.
        output: the written file.
        gaussians: Gaussians before writing, unit frame.
        options: layout of the file.
    """
    from vvgt_cli.images.metrics import psnr
    from vvgt_cli.splat import render

    if not _stores_pictures(output, options):
        return
    with run.stage("read back") as stage:
        back = in_unit_frame(*read_splats(output))
        size, rule = options.made_for or SIZE, rule_of(options.rule or INRIA)
        cameras, found = default_views("test", size=size), []
        for i in PREVIEW_VIEWS:
            blocks = spread_blocks(size, size, i)
            both = [render(g, cameras[i], rule, blocks=blocks)[..., :3] for g in (gaussians, back)]
            before, after = (np.clip(image if blocks is None else blocks.pick(image), 0, 1) for image in both)
            found.append(psnr(before, after))
        stage.note = f"{np.mean(found):.2f} dB from the Gaussians before writing, {len(found)} views of {size} px"


def report_format_cost(
    run: Run, output: str, gaussians: Gaussians, options: PlyOptions, scene: Scene | Viewed, volume: Volume
) -> None:
    """Report how much PSNR against the volume a written file has lost by its format, unless it is a `.ply`.

    Args:
        run: gets a stage.
        output: the written file.
        gaussians: Gaussians before writing, unit frame.
        options: layout of the file.
        scene: scene of the volume.
        volume: volume of the Gaussians.
    """
    from vvgt_cli.dvr import RenderSettings

    if not _stores_pictures(output, options):
        return
    with run.stage("read back") as stage:
        size, rule = options.made_for or SIZE, options.rule or INRIA
        before, after = (
            score_test_views(
                scene, to_box_frame(g, volume), size, RenderSettings(), rule=rule, perceptual=False, only=PREVIEW_VIEWS
            ).psnr
            for g in (gaussians, in_unit_frame(*read_splats(output)))
        )
        stage.note = f"PSNR {after:.2f} dB, a .ply would have {before:.2f}: the format costs {before - after:.2f} dB"
