"""Reading as functions, and sessions: a volume for several conversions."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, Unpack

from vvgt_cli.commands.convert import convert
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians import Gaussians, PlyHeader
from vvgt_cli.library.inputs import LooksLike, PathLike, Reading, VolumeLike, content_of, volume_of
from vvgt_cli.volume import Volume
from vvgt_cli.volume.stored import Stored

if TYPE_CHECKING:
    from vvgt_cli.conversion.clouds import Clouds
    from vvgt_cli.conversion.result import Conversion


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
    >>> few = {"max_gaussians": 20, "screen": 32, "steps": 0}
    >>> [len(session.convert(tf, **few).gaussians) <= 20 for tf in ("gray", "viridis")]
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

    def convert(self, look: LooksLike = None, **options: Any) -> Conversion | Clouds | str | None:
        """Convert the volume under another look, or several, with the options of `convert`."""
        return convert(self, look, **options)
