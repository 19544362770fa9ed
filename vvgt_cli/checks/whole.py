"""Cases of the whole way: volume to Gaussians, views, colours, descent, file and picture."""

from __future__ import annotations

import io
from collections.abc import Iterator
from functools import partial

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.scenes import Hard, hard_scenes
from vvgt_cli.closed_form import VbmOptions, backproject, initialise
from vvgt_cli.dvr import Scene, render_views
from vvgt_cli.gaussians import as_stored, read_ply, write_ply
from vvgt_cli.images.metrics import score_views
from vvgt_cli.refine import OptimizeOptions, optimize
from vvgt_cli.splat import render

STAGE = "whole way"
SIZE, BUDGET, STEPS = 48, 200, 25
SCENES = (
    "step function, depth 1e-06 a voxel", "step function, depth 1e+06 a voxel", "step function of opacity 1",
    "shell of a thousandth of the range", "constant", "one slice along z", "lengths of 1e+30", "values of 1e-30",
    "a block of nan", "checkerboard of voxels", "a single voxel that shows",
)  # fmt: skip


def _hard(row: Hard) -> Figure:
    return whole(row.make())


def whole(scene: Scene) -> Figure:
    """Each stage is no worse than the one before, and the file shows what was fitted."""
    cameras, judges = (default_views(which, 4, size=SIZE) for which in ("train", "check"))
    views, reference = render_views(scene, cameras), render_views(scene, judges)
    start = initialise(scene, VbmOptions(BUDGET, SIZE))
    require(0 < len(start.gaussians) <= BUDGET, f"{len(start.gaussians)} Gaussians for a budget of {BUDGET}")
    refitted, _ = backproject(start, cameras, views)
    options = OptimizeOptions(steps=STEPS, check_every=5)
    better, record = optimize(refitted, cameras, views, options, (judges, reference))
    stream = io.BytesIO()
    write_ply(stream, as_stored(better))
    stream.seek(0)
    gaussians, _ = read_ply(stream)
    images = [render(gaussians, camera) for camera in judges]
    require(all(np.isfinite(image).all() for image in images), "a picture that is not finite")
    score = score_views(reference, images, perceptual=False)
    assert record.psnr_before is not None
    return Figure("dB lost from closed form to file", record.psnr_before - score.psnr, 0.01)


def cases() -> Iterator[Case]:
    """All of them."""
    for row in hard_scenes():
        if row.name in SCENES:
            yield Case(STAGE, row.name, partial(_hard, row))
