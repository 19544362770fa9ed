"""What a file of another format is worth: it is read again, and drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.blocks import spread_blocks
from vvgt_cli.cameras.sets import SIZE
from vvgt_cli.conversion.place import into_box
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


def _is_drawn(output: str, options: PlyOptions) -> bool:
    """Whether viewers draw the columns of a file of another format. A live page computes its look and light anew."""
    found = format_of(output)
    return found is not None and (found.suffix != ".html" or options.live is None)


def report_agreement(run: Run, output: str, gaussians: Gaussians, options: PlyOptions) -> None:
    """Say how near pictures of a file just written are to those of the Gaussians; of a `.ply` nothing.

    Args:
        run: gets a stage.
        output: the file.
        gaussians: in the unit frame, as they were before.
        options: that they were written with.
    """
    from vvgt_cli.images.metrics import psnr
    from vvgt_cli.splat import render

    if not _is_drawn(output, options):
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
        stage.note = f"{np.mean(found):.2f} dB from the Gaussians as they were, {len(found)} views of {size} px"


def tell_cost(
    run: Run, output: str, gaussians: Gaussians, options: PlyOptions, scene: Scene | Viewed, volume: Volume
) -> None:
    """Say how much further from its volume a file just written is than the Gaussians were; of a `.ply` nothing.

    Args:
        run: gets a stage.
        output: the file.
        gaussians: in the unit frame, as they were before.
        options: that they were written with.
        scene, volume: what they are of.
    """
    from vvgt_cli.dvr import RenderSettings

    if not _is_drawn(output, options):
        return
    with run.stage("read back") as stage:
        size, rule = options.made_for or SIZE, options.rule or INRIA
        before, after = (
            score_test_views(
                scene, into_box(g, volume), size, RenderSettings(), rule=rule, perceptual=False, only=PREVIEW_VIEWS
            ).psnr
            for g in (gaussians, in_unit_frame(*read_splats(output)))
        )
        stage.note = f"PSNR {after:.2f} dB, a .ply has {before:.2f}: the format costs {before - after:.2f} dB"
