"""The commands as functions, with the options of docs/commands."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Unpack

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.conversion.result import Conversion
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians import Gaussians, PlyHeader
from vvgt_cli.library.inputs import (
    Goal,
    GoalLike,
    LookLike,
    LooksLike,
    PathLike,
    Reading,
    VolumeLike,
    blocks_of,
    console_of,
    looks_of,
    source_of,
    volume_of,
    with_look,
)
from vvgt_cli.volume import Volume

if TYPE_CHECKING:
    import numpy as np

    from vvgt_cli.conversion.clouds import Clouds


def convert(
    volume: VolumeLike,
    look: LooksLike = None,
    goal: GoalLike = None,
    *,
    split_labels: bool = False,
    live: bool = False,
    after: Conversion | None = None,
    blocks: int | str | None = None,
    progress: bool = False,
    **reading: Unpack[Reading],
) -> Conversion | Clouds:
    """Convert a volume under a transfer function to 3D Gaussians: ``vvgt convert`` without files.

    >>> import vvgt_cli as vvgt
    >>> result = vvgt.convert("example:marschner-lobb:24", goal={"max_gaussians": 200, "size": 64, "steps": 0})
    >>> result.scores["psnr"] > 15
    True

    Args:
        volume: a path (or ``example:NAME``); an array (nz, ny, nx), of numpy or Dask, with ``spacing`` (x, y, z) or
            ``affine`` (4, 4); an xarray.DataArray; a pyvista.ImageData; or a `Volume`. A file of several time steps
            without ``time``, or a glob of volumes, is a series. Dask arrays are never computed as a whole.
        look: function, light, labels and layers: a `Look`, or the function alone. Several: a list, or a mapping
            of names to looks.
        goal: budget, screen, limits: a `Goal`, or a mapping of some of its attributes.
        split_labels: return a result for each label of a label map.
        live: let Gaussians carry data values, so that `Result.recolor` shows them under any function (docs/live.md).
        after: an earlier conversion of the same volume to start from: its Gaussians, under the new look, are refined by
            a few steps where that is about as accurate, which is several times as fast (docs/python.md).
        blocks: voxels along the edge of blocks, or "auto"; None: only for large files.
        progress: print messages and bars on standard error.
        **reading: how to read the volume; see `Reading`.

    Returns:
        Gaussians in the unit frame with scores, stages, `save`, `render` and `preview`; for several frames, looks or
        labels `Clouds`, a mapping of names to results with a `save` for all.

    Raises:
        DataError: the input is invalid, or nothing is visible.
        UsageError: options contradict each other.
    """
    from vvgt_cli.conversion.convert_batch import convert_to_memory

    if not isinstance(after, Conversion | None):
        raise UsageError("after: expected the result of convert for one volume and look")
    looks, several = looks_of(look)
    source = source_of(volume, None, reading)
    request = replace(Goal.of(goal).request(source), blocks=blocks_of(blocks), live=live)
    requests = {name: replace(request, source=with_look(source, one)) for name, one in looks.items()}
    return convert_to_memory(
        requests, as_clouds=several, split_labels=split_labels, after=after, console=console_of(progress)
    )


def read_volume(volume: VolumeLike, **reading: Unpack[Reading]) -> Volume:
    """Read a volume from a file, or from data in memory.

    >>> import numpy as np, vvgt_cli as vvgt
    >>> vvgt.read_volume(np.zeros((4, 5, 6)), spacing=(1, 1, 2)).dims
    (6, 5, 4)

    Args:
        volume: as in `convert`.
        **reading: as in `convert`.

    Raises:
        DataError, UsageError: see `convert`.
    """
    return volume_of(volume, reading)


def read_ply(path: PathLike) -> tuple[Gaussians, PlyHeader]:
    """Read Gaussians (unit frame) and the header of a standard ``.ply``, or another format by the name's ending.

    Raises:
        DataError: not a 3DGS ``.ply``, or an empty one.
    """
    from vvgt_cli.conversion.gaussian_files import open_gaussians

    return open_gaussians(os.fspath(path))


def render_views(
    volume: VolumeLike,
    look: LookLike = None,
    cameras: Sequence[Camera] | int = 24,
    *,
    size: int = 400,
    step: float = 0.5,
    **reading: Unpack[Reading],
) -> tuple[list[Camera], np.ndarray]:
    """Render pictures of a volume in memory; ``vvgt render-views`` writes them for trainers.

    >>> import vvgt_cli as vvgt
    >>> cameras, images = vvgt.render_views("example:blob:16", cameras=2, size=32)
    >>> images.shape
    (2, 32, 32, 4)

    Args:
        volume: as in `convert`.
        look: as in `convert`.
        cameras: cameras in the unit frame, all of one size, or the number of training views.
        size: pixels along the edge of the training views.
        step: step along a ray, in voxels.

    Returns:
        cameras, images: (n, h, w, 4) float32, premultiplied RGBA.

    Raises:
        DataError, UsageError: see `convert`; cameras differ in size.
    """
    import numpy as np

    from vvgt_cli.cameras.boxed import render_in_box
    from vvgt_cli.dvr import RenderSettings, render_view
    from vvgt_cli.field.source import load

    views = default_views("train", cameras, size=size) if isinstance(cameras, int) else list(cameras)
    if len({(view.width, view.height) for view in views}) != 1:
        raise UsageError(f"{len(views)} cameras of several sizes; expected one or more of one size")
    source = load(source_of(volume, look, reading))
    scene = source.scene()
    draw = render_in_box(lambda view: render_view(scene, view, RenderSettings(step=step)), source.volume.axes)
    return views, np.stack([draw(view) for view in views])
