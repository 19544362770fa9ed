"""What a run starts from: a volume under a transfer function, read and checked."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from vvgt_cli.volume import Volume
from vvgt_cli.volume.options import ReadOptions

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene
    from vvgt_cli.volume.statistics import Statistics


@dataclass(frozen=True)
class SourceRequest:
    """What to read.

    Attributes:
        volume: path, `example:NAME`, or "-" for raw values on standard input.
        read: how to read it.
        tf: transfer-function file or colour-map name; None makes one from the histogram.
        tf_range: "data", "rescale" or "LO,HI".
        unit_distance: a length, "paraview", "mean-spacing", or None: the function's own, else "paraview".
    """

    volume: str
    read: ReadOptions = field(default_factory=ReadOptions)
    tf: str | None = None
    tf_range: str = "data"
    unit_distance: str | None = None


@dataclass(frozen=True)
class Source:
    """What was read: the function is visible somewhere in the volume.

    ``unit_distance`` is the world length that opacity refers to, ``unit_label`` how it was chosen.
    """

    volume: Volume
    statistics: Statistics
    tf: Any  # vvgt_cli.transfer.TransferFunction
    unit_distance: float
    unit_label: str

    def scene(self) -> Scene:
        """The volume laid out for the kernels."""
        from vvgt_cli.dvr import Scene

        limits = (self.statistics.lo, self.statistics.hi)
        return Scene.build(self.volume, self.tf, self.unit_distance, limits)


def load(request: SourceRequest) -> Source:
    """Read the function, then the volume, and bring them together.

    Raises:
        DataError: a file that is not what it must be, or a function that shows nothing of this volume.
        UsageError: options that do not fit the file.
    """
    from vvgt_cli.synth.sources import open_volume
    from vvgt_cli.transfer import check_visible, from_histogram, read_transfer_function, resolve, unit_distance
    from vvgt_cli.volume.statistics import statistics

    tf = read_transfer_function(request.tf) if request.tf else None  # small: its errors come first
    volume = open_volume(request.volume, request.read)
    numbers = statistics(volume)
    tf = resolve(tf, numbers, request.tf_range) if tf else from_histogram(numbers)
    distance, label = unit_distance(request.unit_distance, volume, tf)
    check_visible(tf, numbers)
    return Source(volume, numbers, tf, distance, label)
