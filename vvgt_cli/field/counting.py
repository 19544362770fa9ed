"""Statistics of values, counted block by block: `Access` to volumes that are never whole in memory.

Blocks are counted in any order and added up. Everything that is added is whole numbers and extremes, so that the
figures are those of `stats.statistics`, to the bit, however the volume is cut.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from vvgt_cli.closed_form.samples import SAMPLE, sample_spacing, samples_in
from vvgt_cli.errors import UsageError
from vvgt_cli.field.block_store import COUNTS, HISTOGRAM, LABELS, BlockStore
from vvgt_cli.field.grid import Boxes
from vvgt_cli.field.layered import Access, OpenedFile, content_of, open_content
from vvgt_cli.field.reader import CLASSIFIED, VolumeOrigin
from vvgt_cli.field.settings import shape_of
from vvgt_cli.volume import BINS, ReadOptions, Statistics, Volume, check_range, edges_of, integer_statistics
from vvgt_cli.volume.blocks import Packed
from vvgt_cli.volume.label_maps import MAX_LABELS, whole_numbers
from vvgt_cli.volume.stored import read_block


@dataclass(frozen=True)
class CountBlocks:
    """The counting of values, with samples of them.

    Attributes:
        place: origin of the volume.
        boxes: its division.
        slices: slices of a box that are in memory at a time.
        store: destination of the results.
        kind: kind of the results.
        limits: range of the histogram, in a second pass.
        labels: collect the distinct values of a type that is too wide to be counted.
    """

    place: VolumeOrigin
    boxes: Boxes
    slices: int
    store: BlockStore
    kind: str
    limits: tuple[float, float] | None = None
    labels: bool = False

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.boxes)

    def __call__(self, number: int) -> None:
        """Count box ``number``."""
        volume = self.place.volume()
        lo, hi = self.boxes.at(number)
        size = np.minimum(SAMPLE, self.boxes.dims)
        places, weights = samples_in(self.boxes.dims, lo, hi)
        wanted = len(places) if self.limits is None else 0
        bricks = np.empty((wanted, *size[::-1]), volume.data.dtype.newbyteorder("="))
        total: Tally | None = None
        unique = np.empty(0)
        for z in range(lo[2], hi[2], self.slices):
            begin, end = np.array([lo[0], lo[1], z]), np.array([hi[0], hi[1], min(z + self.slices, hi[2])])
            values = read_block(volume, begin, end)
            part = tally(values, volume, self.limits)
            total = part if total is None else total.plus(part)
            if self.labels and len(unique) <= MAX_LABELS:
                unique = np.union1d(unique, values[np.isfinite(values)])
            for n in range(wanted):
                if z <= places[n, 2] < end[2]:
                    bricks[n] = _brick(volume, values, begin, end, places[n], size)
            del values  # free them before the next slices are read
        assert total is not None, "a box has a slice"
        self.store.save(
            self.kind,
            number,
            counts=total.counts,
            ends=np.array([total.lo, total.hi, *total.stored]),
            numbers=np.array([total.nan, total.finite], np.int64),
            histogram=total.histogram,
            samples=bricks,
            weights=weights,
            unique=unique,
        )

    def merged(self) -> Tally:
        """Return the sum over all boxes; raise DataError if a result is missing or damaged."""
        whole: Tally | None = None
        for number in range(len(self)):
            part = self.store.load(self.kind, number, names=("counts", "ends", "numbers", "histogram"))
            lo, hi, low, high = part["ends"].tolist()
            nan, finite = part["numbers"].tolist()
            one = Tally(part["counts"], lo, hi, (low, high), nan, finite, part["histogram"])
            whole = one if whole is None else whole.plus(one)
        assert whole is not None, "a volume has a block"
        return whole

    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Return sampled bricks (n, z, y, x) of stored values, and how many voxels (n,) each stands for."""
        parts = [self.store.load(self.kind, number, names=("samples", "weights")) for number in range(len(self))]
        return np.concatenate([part["samples"] for part in parts]), np.concatenate([part["weights"] for part in parts])

    def unique(self) -> np.ndarray:
        """Return the distinct finite values (n,), ascending."""
        parts = [self.store.load(self.kind, number, names=("unique",))["unique"] for number in range(len(self))]
        return np.unique(np.concatenate(parts))


def _brick(
    volume: Volume, values: np.ndarray, begin: np.ndarray, end: np.ndarray, first: np.ndarray, size: np.ndarray
) -> np.ndarray:
    """Return ``size`` voxels from ``first`` (3,), from the loaded ``values`` if they lie in ``begin`` to ``end``."""
    if (first + size > end).any():
        return read_block(volume, first, first + size)
    (x, y, z), (i, j, k) = first - begin, size
    return values[z : z + k, y : y + j, x : x + i]


class BlockAccess(Access):
    """`Access` block by block; each volume is counted once, on first use."""

    def __init__(
        self, store: BlockStore, edge: int, run: Callable[[CountBlocks], object], histogram: bool
    ) -> None:  # fmt: skip
        """Prepare for counting; ``histogram`` asks for one even for types that are not counted value by value."""
        self._store, self._edge, self._run, self._histogram = store, edge, run, histogram
        self._places: dict[int, tuple[Volume, VolumeOrigin]] = {}
        self._done: dict[int, tuple[CountBlocks, Tally, Statistics]] = {}
        self._count = 0

    def open(self, source: str | Volume | OpenedFile, read: ReadOptions, other: Volume | None = None) -> OpenedFile:
        """Open a file without reading its values, or accept content in memory; see `Access.open`."""
        if not isinstance(source, str):
            content = content_of(source).beside(other)
            for volume in (*content.volumes, *content.classified):
                self._places[id(volume)] = volume, VolumeOrigin(volume, read)
            return content
        read = replace(read, stored=True, packed=True)
        there = other and replace(other, data=np.zeros((1, 1, 1), np.uint8), slope=1.0, intercept=0.0)  # for workers
        content = open_content(source, read).beside(there)
        for number, volume in enumerate(content.volumes):
            self._places[id(volume)] = volume, VolumeOrigin(source, read, number, there)
        if content.color:
            volume = content.classified[0]
            self._places[id(volume)] = volume, VolumeOrigin(source, read, CLASSIFIED, there)
        return content

    def place(self, volume: Volume) -> VolumeOrigin:
        """Return the origin of a volume that was opened here."""
        return self._places[id(volume)][1]

    def counts(self, volume: Volume) -> tuple[CountBlocks, Tally, Statistics]:
        """Return a volume's counting task, its counts and its statistics; raise DataError if no voxel is finite."""
        if id(volume) not in self._done:
            self._done[id(volume)] = self._counted(volume)
        return self._done[id(volume)]

    def _counted(self, volume: Volume) -> tuple[CountBlocks, Tally, Statistics]:
        suffix = str(self._count) if self._count else ""
        self._count += 1
        if isinstance(volume.data, Packed):
            raise UsageError(
                f"{volume.name}: compressed as one stream, which cannot be read in blocks; decompress it (raw, .nhdr "
                "and .nii files are mapped), or store it in chunks (Zarr, HDF5)"
            )
        shape, spacing = shape_of(volume, self._edge), sample_spacing(volume.dims)
        x, y, z = (max(e, spacing) for e in shape)  # boxes are aligned to the lattice of samples
        labels = not counted(volume) and volume.data.dtype.kind in "iu"
        first = CountBlocks(
            self.place(volume), Boxes(volume.dims, (x, y, z)), max(math.prod(shape) // (x * y), 1), self._store,
            COUNTS + suffix, labels=labels,
        )  # fmt: skip
        self._run(first)
        whole = with_limits(first.merged(), volume)
        histogram = None
        if self._histogram and not counted(volume):
            second = replace(first, kind=HISTOGRAM + suffix, limits=(whole.lo, whole.hi), labels=False)
            self._run(second)
            histogram = second.merged().histogram
        return first, whole, statistics_of(whole, volume, histogram)

    def statistics(self, volume: Volume) -> Statistics:
        """Return the statistics of a volume's data values."""
        return self.counts(volume)[2]

    def labels(self, volume: Volume) -> list[int]:
        """Return a volume's labels, ascending; raise DataError for too many, or data that are not integers."""
        task, whole, _ = self.counts(volume)
        if counted(volume):
            kind = volume.data.dtype.newbyteorder("=")
            bits = np.flatnonzero(whole.counts).astype(f"u{kind.itemsize}")
            stored = bits.view(kind if kind.kind in "iu" else bits.dtype).astype(np.float64)
        else:
            if not task.labels:
                task = replace(task, kind=task.kind.replace(COUNTS, LABELS), labels=True)
                self._run(task)
            stored = task.unique()
        return list(map(int, whole_numbers(stored, volume)))


PARTS = 4  # of a block, counted at once


@dataclass(frozen=True)
class Tally:
    """Counts over some blocks.

    Attributes:
        counts: (256 or 65536,) of every stored value of an 8- or 16-bit type (as its bytes, unsigned), (0,) of others.
        lo, hi: least and greatest finite data value, of other types.
        stored: least and greatest finite stored value.
        nan, finite: voxels that are NaN, and those that are finite.
        histogram: (256,) finite values over the range, once that is known; (0,) before.
    """

    counts: np.ndarray
    lo: float = np.inf
    hi: float = -np.inf
    stored: tuple[float, float] = (np.inf, -np.inf)
    nan: int = 0
    finite: int = 0
    histogram: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))

    def plus(self, other: Tally) -> Tally:
        """Add another tally to this one."""
        return Tally(
            self.counts + other.counts,
            min(self.lo, other.lo),
            max(self.hi, other.hi),
            (min(self.stored[0], other.stored[0]), max(self.stored[1], other.stored[1])),
            self.nan + other.nan,
            self.finite + other.finite,
            self.histogram + other.histogram,
        )


def counted(volume: Volume) -> bool:
    """Tell whether every value of the volume's type is counted, so that a histogram needs no second pass."""
    return volume.data.dtype.kind in "iub" and volume.data.dtype.itemsize <= 2


def tally(values: np.ndarray, volume: Volume, limits: tuple[float, float] | None = None) -> Tally:
    """Tally a block of stored values (z, y, x), native, C-contiguous; with ``limits`` (data values) only a histogram.

    The block is made read-only.
    """
    if counted(volume):
        from vvgt_cli.volume.count_kernel import LANES, count_values

        counts = np.zeros((PARTS, LANES, 256**values.dtype.itemsize), np.int64)
        values.flags.writeable = False  # kernels are compiled for such
        count_values(values.view(f"u{values.dtype.itemsize}"), counts)
        return Tally(counts.sum(axis=(0, 1)))
    values = values if values.dtype == np.float32 else values.astype(np.float64)
    values.flags.writeable = False
    return _range(values, volume) if limits is None else _binned(values, volume, limits)


def _range(values: np.ndarray, volume: Volume) -> Tally:
    """Find the range and count the finite voxels of ``values``, float32 or float64."""
    from vvgt_cli.volume.count_kernel import FINITE, HIGH, LOW, NAN, STORED_HIGH, STORED_LOW, range_values

    ends, numbers = np.empty((PARTS, 4)), np.zeros((PARTS, 2), np.int64)
    range_values(values, volume.slope, volume.intercept, volume.data.dtype.kind != "f", ends, numbers)
    low, high = ends.min(axis=0), ends.max(axis=0)
    nan, finite = int(numbers[:, NAN].sum()), int(numbers[:, FINITE].sum())
    none, stored = np.empty(0, np.int64), (float(low[STORED_LOW]), float(high[STORED_HIGH]))
    return Tally(none, float(low[LOW]), float(high[HIGH]), stored, nan, finite) if finite else Tally(none, nan=nan)


def _binned(values: np.ndarray, volume: Volume, limits: tuple[float, float]) -> Tally:
    """Make a histogram of ``values``, float32 or float64, over ``limits``."""
    from vvgt_cli.volume.count_kernel import LANES, bin_values

    edges = edges_of(*limits)
    lo, hi = float(edges[0]), float(edges[-1])
    counts = np.zeros((PARTS, LANES, BINS + 1), np.int64)
    bin_values(values, volume.slope, volume.intercept, lo, hi, 1.0 if np.isfinite(hi - lo) else 0.5, counts)
    return Tally(np.empty(0, np.int64), histogram=counts.sum(axis=(0, 1))[:BINS])


def with_limits(whole: Tally, volume: Volume) -> Tally:
    """Check the sum over all blocks and complete it with its limits; errors are those of `check_range`."""
    if counted(volume):
        stats = integer_statistics(whole.counts, volume)
        ends = (stats.lo - volume.intercept) / volume.slope, (stats.hi - volume.intercept) / volume.slope
        return replace(whole, lo=stats.lo, hi=stats.hi, stored=(min(ends), max(ends)), finite=volume.data.size)
    check_range(whole.lo, whole.hi, volume, whole.nan)
    return whole


def statistics_of(whole: Tally, volume: Volume, histogram: np.ndarray | None = None) -> Statistics:
    """Return the statistics of `with_limits` of all blocks and of the histogram of a second pass over them.

    Without ``histogram`` (a function is given, in data values) all values count in the lowest bin.
    """
    if counted(volume):
        return integer_statistics(whole.counts, volume)
    if histogram is None:
        histogram = np.zeros(BINS, np.int64)
        histogram[0] = whole.finite
    infinite = volume.data.size - whole.finite - whole.nan
    return Statistics(whole.lo, whole.hi, whole.nan, infinite, histogram, edges_of(whole.lo, whole.hi))
