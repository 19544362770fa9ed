"""Scores of a merge: Gaussians against stored rays through all voxels, without the volume."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.blocks import spread_blocks
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.field import Picture
from vvgt_cli.field.rays import RayFile, composed
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.score.viewing import PREVIEW_VIEWS

if TYPE_CHECKING:
    from vvgt_cli.conversion.shards.plan import Plan
    from vvgt_cli.gaussians import Gaussians
    from vvgt_cli.images.metrics import Scores

FEW = 64  # blocks of 16 x 16 px of each test view
RAYS = 2  # rays along a pixel's edge
A_GAUSSIAN = 400  # bytes to draw a Gaussian


def scored_views(size: int) -> list[Picture]:
    """List the blocks of three test views of ``size`` px."""
    from vvgt_cli.dvr import RenderSettings

    cameras = default_views("test", size=size)
    settings = RenderSettings(samples=RAYS)
    return [Picture(cameras[i], settings, spread_blocks(size, size, i, FEW)) for i in PREVIEW_VIEWS]


def score_gaussians(gaussians: Gaussians, store: BlockStore, plan: Plan, rule: str | Rule = INRIA) -> Scores:
    """Score Gaussians (box frame), drawn by a rule, against the stored views of the volume.

    Raises:
        DataError: a block is missing or damaged.
    """
    from vvgt_cli.images.metrics import score_views
    from vvgt_cli.splat import render

    rays = RayFile(str(store.folder / f"{plan.rays}.npz"), plan.rays)
    x, y, z = plan.grid.blocks.dims
    seen = composed(rays, store, range(len(plan.grid.blocks)), (x, y, z))
    views = scored_views(plan.size)

    def picked(view: Picture) -> np.ndarray:
        drawn = render(gaussians, view.camera, rule, blocks=view.blocks)
        shown = drawn if view.blocks is None else drawn[view.blocks.mask()]
        return shown.reshape(-1, 1, 4)

    whole = [rays.mean(axis=1, keepdims=True).astype(np.float32) for rays in seen]
    return score_views(whole, map(picked, views), perceptual=False)


def score_text(scores: Scores, size: int) -> str:
    """Return the scores as a message."""
    from vvgt_cli.score.views import psnr_note

    return f"{psnr_note(scores)}, blocks of {scores.views} views of {size} px, through all voxels"


def drawing_bytes(gaussians: int, size: int) -> int:
    """Return the bytes of memory for scoring a number of Gaussians."""
    return A_GAUSSIAN * gaussians + 2 * 16 * size**2
