"""Conversions and reading as functions, and sessions: a volume for several conversions."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Unpack

from vvgt_cli.conversion.result import Conversion
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians import Gaussians, PlyHeader
from vvgt_cli.library.inputs import (
    Goal,
    GoalLike,
    LooksLike,
    PathLike,
    Reading,
    VolumeLike,
    blocks_of,
    console_of,
    content_of,
    looks_of,
    source_of,
    volume_of,
    with_look,
)
from vvgt_cli.volume import Volume
from vvgt_cli.volume.stored import Stored

if TYPE_CHECKING:
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


class Session:
    """A volume, read and laid out once, for conversions under one function after another.

    >>> import vvgt_cli as vvgt
    >>> session = vvgt.Session("example:blob:16")
    >>> few = {"max_gaussians": 20, "size": 32, "steps": 0}
    >>> [len(session.convert(tf, few).gaussians) <= 20 for tf in ("gray", "viridis")]
    [True, True]

    It can be passed wherever the library takes a volume.

    Args:
        volume, reading: as in `convert`.

    Raises:
        DataError, UsageError: see `convert`.
    """

    def __init__(self, volume: VolumeLike, **reading: Unpack[Reading]) -> None:
        """Read the volume; see the class."""
        self.content = content_of(volume, reading)
        if isinstance(self.volume.data, Stored):
            raise UsageError(
                f"{self.volume.name}: a Dask array, which is not in memory; convert it without a session, or pass "
                "the result of its compute()"
            )
        self.content.prepare()

    @property
    def volume(self) -> Volume:
        """Return the volume, or the first of colours and channels."""
        return self.content.volumes[0]

    def convert(self, look: LooksLike = None, goal: GoalLike = None, **options: Any) -> Conversion | Clouds:
        """Convert the volume under another look, or several, with the options of `convert`."""
        return convert(self, look, goal, **options)
