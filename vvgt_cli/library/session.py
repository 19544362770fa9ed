"""Sessions: a volume for several conversions."""

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
    """A volume, read and laid out once, for conversions under one function after another.

    >>> import vvgt_cli as vvgt
    >>> session = vvgt.Session("example:blob:16")
    >>> few = {"max_gaussians": 20, "size": 32, "steps": 0}
    >>> [len(session.convert(tf, few).gaussians) for tf in ("gray", "viridis")]
    [20, 20]

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
        from vvgt_cli.library.functions import convert

        return convert(self, look, goal, **options)
