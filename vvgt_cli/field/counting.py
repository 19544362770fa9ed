"""Statistics of values, counted block by block: `Access` to volumes that are never whole in memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vvgt_cli.closed_form.samples import SAMPLE, sample_spacing, samples_in
from vvgt_cli.errors import Unsuitable, UsageError
from vvgt_cli.field.block_store import COUNTS, HISTOGRAM, LABELS, BlockStore
from vvgt_cli.field.grid import Boxes
from vvgt_cli.field.layered import Content, content_of, open_content
from vvgt_cli.field.reader import CLASSIFIED, Place
from vvgt_cli.field.settings import counted_boxes, slices_at_once
from vvgt_cli.volume import ReadOptions, Statistics, Volume
from vvgt_cli.volume.label_maps import MOST
from vvgt_cli.volume.stored import read_block, readable_in_blocks
from vvgt_cli.volume.tallies import Tally, counted, statistics_of, tally, with_limits


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

    place: Place
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
        found: Tally | None = None
        unique = np.empty(0)
        for z in range(lo[2], hi[2], self.slices):
            begin, end = np.array([lo[0], lo[1], z]), np.array([hi[0], hi[1], min(z + self.slices, hi[2])])
            values = read_block(volume, begin, end)
            part = tally(values, volume, self.limits)
            found = part if found is None else found.plus(part)
            if self.labels and len(unique) <= MOST:
                unique = np.union1d(unique, values[np.isfinite(values)])
            for n in range(wanted):
                if z <= places[n, 2] < end[2]:
                    bricks[n] = _brick(volume, values, begin, end, places[n], size)
            del values  # free them before the next slices are read
        assert found is not None, "a box has a slice"
        self.store.save(
            self.kind,
            number,
            counts=found.counts,
            ends=np.array([found.lo, found.hi, *found.stored]),
            numbers=np.array([found.nan, found.finite], np.int64),
            histogram=found.histogram,
            samples=bricks,
            weights=weights,
            unique=unique,
        )

    def merged(self) -> Tally:
        """Return the sum over all boxes.

        Raises:
            DataError: a result is missing or damaged.
        """
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
        found = [self.store.load(self.kind, number, names=("samples", "weights")) for number in range(len(self))]
        return np.concatenate([part["samples"] for part in found]), np.concatenate([part["weights"] for part in found])

    def unique(self) -> np.ndarray:
        """Return the distinct finite values (n,), ascending."""
        found = [self.store.load(self.kind, number, names=("unique",))["unique"] for number in range(len(self))]
        return np.unique(np.concatenate(found))


def _brick(
    volume: Volume, values: np.ndarray, begin: np.ndarray, end: np.ndarray, first: np.ndarray, size: np.ndarray
) -> np.ndarray:
    """Return ``size`` voxels from ``first`` (3,), from the loaded ``values`` if they lie in ``begin`` to ``end``."""
    if (first + size > end).any():
        return read_block(volume, first, first + size)
    (x, y, z), (i, j, k) = first - begin, size
    return values[z : z + k, y : y + j, x : x + i]


class BlockAccess:
    """`vvgt_cli.field.layered.Access` block by block; each volume is counted once, on first use."""

    def __init__(
        self, store: BlockStore, edge: int, run: Callable[[CountBlocks], object], histogram: bool
    ) -> None:  # fmt: skip
        """Prepare for counting.

        Args:
            store: destination of the results.
            edge: edge of blocks in voxels.
            run: runs the missing blocks of a task.
            histogram: whether a histogram is needed even for types that are not counted value by value.
        """
        self._store, self._edge, self._run, self._histogram = store, edge, run, histogram
        self._places: dict[int, tuple[Volume, Place]] = {}
        self._done: dict[int, tuple[CountBlocks, Tally, Statistics]] = {}
        self._count = 0

    def open(self, source: str | Volume | Content, read: ReadOptions) -> Content:
        """Open a file without reading its values, or accept content in memory."""
        if not isinstance(source, str):
            content = content_of(source)
            for volume in (*content.volumes, *content.classified):
                self._places[id(volume)] = volume, Place(volume, read)
            return content
        read = replace(read, stored=True, packed=True)
        content = open_content(source, read)
        for number, volume in enumerate(content.volumes):
            self._places[id(volume)] = volume, Place(source, read, number)
        if content.color:
            volume = content.classified[0]
            self._places[id(volume)] = volume, Place(source, read, CLASSIFIED)
        return content

    def place(self, volume: Volume) -> Place:
        """Return the origin of a volume that was opened here."""
        return self._places[id(volume)][1]

    def counts(self, volume: Volume) -> tuple[CountBlocks, Tally, Statistics]:
        """Return the counting task of a volume, its counts and its statistics.

        Raises:
            DataError: no voxel has a finite value.
        """
        if id(volume) not in self._done:
            self._done[id(volume)] = self._counted(volume)
        return self._done[id(volume)]

    def _counted(self, volume: Volume) -> tuple[CountBlocks, Tally, Statistics]:
        suffix = str(self._count) if self._count else ""
        self._count += 1
        if not readable_in_blocks(volume):
            raise UsageError(
                f"{volume.name}: compressed as one stream, which cannot be read in blocks; decompress it (raw, .nhdr "
                "and .nii files are mapped), or store it in chunks (Zarr, HDF5)"
            )
        edge = self._edge
        boxes = counted_boxes(volume, edge, sample_spacing(volume.dims))
        labels = not counted(volume) and volume.data.dtype.kind in "iu"
        first = CountBlocks(
            self.place(volume), boxes, slices_at_once(volume, edge, boxes), self._store, COUNTS + suffix, labels=labels
        )
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
        """Return the labels that a volume holds, ascending.

        Raises:
            DataError: data values are not integers, or there are too many distinct ones.
        """
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
        if len(stored) > MOST:
            raise Unsuitable(f"{volume.name}: more than {MOST} distinct values; expected a label map")
        values = np.unique(volume.slope * stored + volume.intercept)
        if (values != np.round(values)).any():
            odd = values[values != np.round(values)][0]
            raise Unsuitable(
                f"{volume.name}: {volume.data.dtype} values such as {odd:g}; expected integers, as in a label map: "
                "omit --labels for scalars"
            )
        return [int(value) for value in values]
