"""`Session`: a volume that several functions are tried on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Unpack

from vvgt_cli.errors import UsageError
from vvgt_cli.library.inputs import GoalLike, LooksLike, Reading, VolumeLike, content_of
from vvgt_cli.volume.stored import Stored

if TYPE_CHECKING:
    from vvgt_cli.conversion.clouds import Clouds
    from vvgt_cli.conversion.result import Conversion
    from vvgt_cli.volume import Volume


class Session:
    """A volume, read, counted and laid out once, for one function after the other.

    >>> import vvgt_cli as vvgt
    >>> session = vvgt.Session("example:blob:16")
    >>> few = {"max_gaussians": 20, "size": 32, "steps": 0}
    >>> [len(session.convert(tf, few).gaussians) for tf in ("gray", "viridis")]
    [20, 20]

    It stands for the volume wherever the library takes one.

    Args:
        volume, reading: as of `convert`.

    Raises:
        DataError, UsageError: as `convert`.
    """

    def __init__(self, volume: VolumeLike, **reading: Unpack[Reading]) -> None:
        self.content = content_of(volume, reading)
        if isinstance(self.volume.data, Stored):
            raise UsageError(
                f"{self.volume.name}: a Dask array, which is not held in memory; convert it without a session, or pass "
                "what its compute() returns"
            )
        self.content.prepare()

    @property
    def volume(self) -> Volume:
        """What was read: of colours and channels the first."""
        return self.content.volumes[0]

    def convert(self, look: LooksLike = None, goal: GoalLike = None, **options: Any) -> Conversion | Clouds:
        """The volume under another look, or several: `convert`, with its options, without reading again."""
        from vvgt_cli.library.functions import convert

        return convert(self, look, goal, **options)
