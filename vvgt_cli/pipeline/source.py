"""What a run starts from: a volume under a transfer function, read and checked."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from vvgt_cli.errors import UsageError
from vvgt_cli.volume import ReadOptions, Statistics, Volume

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene


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
    from vvgt_cli.transfer.resolve import parse_tf_range
    from vvgt_cli.volume import statistics

    tf_range = parse_tf_range(request.tf_range)
    tf = read_transfer_function(request.tf) if request.tf else None  # small: its errors come first
    if tf is None and tf_range != "data":
        raise UsageError("--tf-range says where the nodes of a function lie; it needs --tf")
    volume = open_volume(request.volume, request.read)
    distance, label = unit_distance(request.unit_distance, volume, tf)
    numbers = statistics(volume)
    tf = resolve(tf, numbers, tf_range) if tf else from_histogram(numbers)
    check_visible(tf, numbers)
    return Source(volume, numbers, tf, distance, label)
