"""Opening of files under their look: a scalar field, label maps, colours, channels; and layers (docs/layers.md)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.dvr.layers import Layer
from vvgt_cli.dvr.sky import LUMINANCE
from vvgt_cli.errors import DataError, SeveralComponents, UsageError
from vvgt_cli.look import (
    ColorMap,
    PiecewiseOpacity,
    TransferFunction,
    from_histogram,
    read_transfer_function,
    resolve,
    unit_distance,
)
from vvgt_cli.look.histogram import UNIT_SHARE
from vvgt_cli.look.label_files import holds_table, table_beside, table_for
from vvgt_cli.look.labels import AUTO, NO_LABELS, LabelTable, default_name, distinct, hex_color, palette
from vvgt_cli.volume import ReadOptions, Statistics, Volume, read_volume, statistics
from vvgt_cli.volume.components import channel_numbers
from vvgt_cli.volume.examples import tissues
from vvgt_cli.volume.label_maps import labels_in, recognised
from vvgt_cli.volume.segments import Segment
from vvgt_cli.volume.space import beside
from vvgt_cli.volume.stored import Stored, chunks_of, loaded, read_block

if TYPE_CHECKING:
    from vvgt_cli.dvr.scene import PreparedVolume

COLOR, ALL = "color", "all"  # values of --component
CHANNEL_COLORS = ((0, 1, 0), (1, 0, 1), (0, 1, 1), (1, 0.5, 0), (0.4, 0.4, 1), (1, 1, 0), (1, 0, 0))
MAX_CHANNELS = 6  # shown together by default: colours of more are hard to distinguish
DARK, BRIGHT = 0.5, 0.998  # quantiles of a channel's voxels between which its opacity rises


@dataclass(frozen=True)
class OpenedFile:
    """The content of a file.

    Attributes:
        volumes: the scalar field; or red, green, blue and optionally opacity; or one volume per channel; or label maps.
        color: the volumes are colours.
        colors: RGB of each channel, that of the file or a default.
        path: path of the file, None for content in memory.
        overlapping: the volumes are layers of a segmentation with overlapping segments.
        stored: values stay in the file, and derived volumes are computed block by block.
        names: names of the channels, where they have any.
        numbers: numbers of the channels in the file, where they are several.
        components_message: the reader's message about several components if all are shown by default, else None.
    """

    volumes: tuple[Volume, ...]
    color: bool = False
    colors: Sequence[tuple[float, float, float]] = ()
    path: str | None = None
    overlapping: bool = False
    stored: bool = False
    names: Sequence[str] = ()
    numbers: Sequence[int] = ()
    components_message: str | None = None

    @property
    def single_volume(self) -> bool:
        """Whether this is a single volume of scalars or labels."""
        return not self.color and len(self.volumes) == 1

    @cached_property
    def classified(self) -> tuple[Volume, ...]:
        """Volumes that functions apply to: opacity or luminance of colours, else the volumes themselves."""
        if not self.color:
            return self.volumes
        source = self.volumes[3] if len(self.volumes) > 3 else _luminance(self.stored, *self.volumes[:3])
        return (replace(source, name=self.volumes[0].name),)

    @cached_property
    def statistics(self) -> Statistics:
        """Statistics of the first volume, which must be in memory; cached for several functions."""
        return statistics(self.volumes[0])

    @cached_property
    def layout(self) -> PreparedVolume:
        """Layout of the first volume for the kernels; cached for several functions."""
        from vvgt_cli.dvr.scene import PreparedVolume

        return PreparedVolume.of(self.volumes[0])

    def loaded(self) -> OpenedFile:
        """Return the same content, with lazily computed arrays loaded into memory."""
        return self._of(tuple(map(loaded, self.volumes)))

    def beside(self, other: Volume | None) -> OpenedFile:
        """Return the same content in the space and unit of another volume, if there is one; see `space.beside`."""
        return self if other is None else self._of(tuple(beside(volume, other) for volume in self.volumes))

    def _of(self, volumes: tuple[Volume, ...]) -> OpenedFile:
        same = all(a is b for a, b in zip(volumes, self.volumes, strict=True))
        return self if same else replace(self, volumes=volumes)

    def prepare(self) -> None:
        """Compute a scalar field's statistics and layout once, instead of once per function."""
        if self.single_volume:
            _ = self.statistics, self.layout  # both are cached


class Access:
    """Access to volumes and statistics of their values; here to volumes that are read whole."""

    def __init__(self) -> None:
        """Begin without statistics; those of the last volume are kept."""
        self._last: tuple[Volume, Statistics] | None = None

    def open(self, source: str | Volume | OpenedFile, read: ReadOptions, other: Volume | None = None) -> OpenedFile:
        """Open a file, or content that is already open, in the space and unit of an ``other`` volume."""
        if isinstance(source, str):
            return open_content(source, read).beside(other)
        content = content_of(source).loaded().beside(other)
        if content is source and content.single_volume:
            self._last = content.volumes[0], content.statistics
        return content

    def statistics(self, volume: Volume) -> Statistics:
        """Return the statistics of a volume's data values."""
        if self._last is None or self._last[0] is not volume:
            self._last = volume, statistics(volume)
        return self._last[1]

    def labels(self, volume: Volume) -> list[int]:
        """Return the labels that a volume holds, ascending."""
        return labels_in(volume)


IN_MEMORY = Access()


def content_of(source: Volume | OpenedFile) -> OpenedFile:
    """Wrap a volume as content, unless it is content already."""
    return source if isinstance(source, OpenedFile) else OpenedFile((source,))


def open_content(source: str, read: ReadOptions) -> OpenedFile:
    """Open a file as one volume, or as its components if ``read.component`` or the file asks for that.

    Components are returned for "color", "all" and several names or numbers, for a file of colours, and by default for
    up to `MAX_CHANNELS` channels of a microscope.

    Raises:
        DataError, UsageError: see `read_volume`; also for components that are not colours, and channels that are not
            there.
    """
    word = read.component if isinstance(read.component, str) else ""
    several = "," in word
    asked = word if several or word in (COLOR, ALL) else None
    try:
        volume = read_volume(source, replace(read, component=None) if asked else read)
    except SeveralComponents as error:
        overlapping = not asked and holds_table(source)
        by_default = not (asked or error.color or overlapping)
        if by_default and not (error.channels and error.count <= MAX_CHANNELS):
            raise
        if asked == COLOR and error.count not in (3, 4):
            raise UsageError(f"{source}: {error.count} components; expected 3 or 4 for --component color") from None
        color = asked == COLOR or (error.color and not asked and not overlapping)
        if color and read.keep_largest is not None:
            raise UsageError(f"--keep-largest: {source} has colours; expected scalars: give a --mask") from None
        numbers: Sequence[int] = range(error.count)
        if several:
            numbers = channel_numbers(word.split(","), error.count, error.names, source)
            if len(numbers) == 1:
                return open_content(source, replace(read, component=numbers[0]))
        parts = tuple(read_volume(source, replace(read, component=k)) for k in numbers)
        if color:
            return OpenedFile(parts, True, stored=read.stored)
        colors = [(error.colors and error.colors[k]) or CHANNEL_COLORS[k % len(CHANNEL_COLORS)] for k in numbers]
        names = [error.names[k] for k in numbers] if error.names else []
        named = tuple(replace(v, name=f"{v.name} {k}") for k, v in zip(numbers, parts, strict=True))
        message = str(error) if by_default else None
        return OpenedFile(named, False, colors, source, overlapping, read.stored, names, numbers, message)
    if several:
        volume = read_volume(source, read)  # the name of its one channel, or an error
    elif asked:
        raise UsageError(f"{source}: one component; expected several: omit --component {asked}")
    return OpenedFile((volume,), path=source, stored=read.stored)


def layers_of(
    opened: OpenedFile,
    tf: str | TransferFunction | None,
    labels: str | LabelTable | None,
    tf_range: str | tuple[float, float] = "data",
    distance: str | None = None,
    whole: Sequence[Statistics] = (),
    access: Access = IN_MEMORY,
) -> list[Layer]:
    """Return the layers of a file's content.

    Args:
        opened: the content.
        tf: function, None for an automatic one; for colours it gives opacity by luminance or stored opacity.
        labels: label table, its file, ``auto``, ``none`` or None.
        tf_range: range option of the functions.
        distance: unit distance option of the functions.
        whole: statistics of `OpenedFile.classified` over a whole series, by default those of the volumes.
        access: access to the values.

    Raises:
        DataError: the labels do not match the table.
        UsageError: there is both a label table and a function.
    """
    labels = _chosen_labels(opened, tf, labels, access)
    if labels is not None and labels != NO_LABELS:
        maps = [one for one in opened.volumes if any(access.labels(one))] if opened.overlapping else opened.volumes[:1]
        if not maps:
            raise DataError(f"{opened.path}: no label other than 0 in any layer; expected some to show")
        beside = None if labels != AUTO or maps[0].segments else table_beside(opened.path)
        if beside:
            warnings.warn(f"{opened.path}: {beside} may name its labels (try --labels {beside})", stacklevel=3)
        known = tissues(opened.path)
        tables = [_labelled(volume, labels, distance, access, known, empty=bool(whole)) for volume in maps]
        return told_apart(tables, set()) if opened.overlapping else tables
    function = read_transfer_function(tf) if isinstance(tf, str) else tf
    sources = opened.classified
    stats = whole or [access.statistics(volume) for volume in sources]
    shown = functions_of(opened, stats, function, tf_range)
    colors = (opened.volumes[0], opened.volumes[1], opened.volumes[2]) if opened.color else None
    layers = []
    for volume, one, its in zip(sources, shown, stats, strict=True):
        given = function if function is not None and opened.single_volume else one
        there = bool(one.support(its.lo, its.hi))
        layers.append(Layer(volume, one, *unit_distance(distance, volume, given), colors, _white(opened), there))
    return layers


def _chosen_labels(
    opened: OpenedFile, tf: str | TransferFunction | None, labels: str | LabelTable | None, access: Access
) -> str | LabelTable | None:
    """Return the requested labels, or ``auto`` for a recognised label map; arguments as in `layers_of`."""
    volume = opened.volumes[0]
    if opened.overlapping:
        if tf is not None or labels == NO_LABELS:
            raise UsageError(
                f"{opened.path}: {len(opened.volumes)} layers of segments that overlap; expected labels: omit "
                "--tf and --labels none, or take one layer with --component N"
            )
        return labels or AUTO
    if labels not in (None, NO_LABELS) and not opened.single_volume:
        raise UsageError(f"{volume.name}: several components; expected a label map: choose one with --component N")
    if labels not in (None, NO_LABELS) and tf is not None:
        raise UsageError(f"{volume.name}: both a function and a table of labels; expected one of --tf and --labels")
    if labels is None and tf is None and opened.single_volume and recognised(volume, access.labels):
        reason = "its name and its few whole numbers" if volume.segments is None else "its segments"
        warnings.warn(f"{volume.name}: read as a label map by {reason} (try --labels none: scalars)", stacklevel=3)
        return AUTO
    return labels


def functions_of(
    opened: OpenedFile,
    stats: Sequence[Statistics],
    tf: TransferFunction | None,
    tf_range: str | tuple[float, float] = "data",
) -> list[TransferFunction]:
    """Return a function on data values per volume of `OpenedFile.classified`; ``stats`` are the volumes' statistics."""
    if opened.color:
        kind = "opacity of the file" if len(opened.volumes) > 3 else "opacity by luminance"
        return [resolve(tf, stats[0], tf_range) if tf else _function(kind, 0.0, _white(opened), (1, 1, 1))]
    if opened.single_volume:
        one = opened.volumes[0]
        if tf is None:
            return [from_histogram(stats[0], one.hounsfield, one.preset)]
        return [resolve(tf, stats[0], tf_range, one.hounsfield)]
    if opened.components_message:
        _warn_all_channels(opened, tf)
    names = opened.names or [""] * len(stats)
    rows = zip(opened.numbers, names, opened.colors, stats, strict=True)
    return [_channel(k, name, color, its, tf, tf_range) for k, name, color, its in rows]


def _warn_all_channels(opened: OpenedFile, tf: TransferFunction | None) -> None:
    """Warn that all channels are shown; refuse a function, which could belong to any of them."""
    if tf is not None:
        raise UsageError(f"{opened.components_message} (--tf is for one channel; with all, each has its own opacity)")
    known = opened.names or [""] * len(opened.volumes)
    shown = [
        f"{k}{f' {name!r}' if name else ''} #{hex_color(color)}"
        for k, name, color in zip(opened.numbers, known, opened.colors, strict=True)
    ]
    warnings.warn(
        f"{opened.path}: {len(shown)} channels, all shown: {', '.join(shown)} (try --channel N for one)", stacklevel=4
    )


def _white(opened: OpenedFile) -> float:
    """Return the data value that stands for a colour of 1."""
    kind = opened.volumes[0].data.dtype
    return float(np.iinfo(kind).max) if opened.color and kind.kind in "iu" else 1.0


def _labelled(
    volume: Volume, labels: str | LabelTable, distance: str | None, access: Access, known: Sequence[Segment],
    empty: bool = False,
) -> Layer:  # fmt: skip
    """Return a label map under its table; ``known``: its labels, if its file describes none.

    Raise DataError if it has no labels, unless it may be ``empty``.
    """
    labels_there = access.labels(volume)
    if not any(labels_there) and not empty:
        raise DataError(f"{volume.name}: no label other than 0; expected some to show")
    table = distinct(labels_there)
    if any(labels_there):
        table = table_for(labels, labels_there, volume.name, volume.segments or known)
    shows = any(label.opacity > 0 for label in table.labels)
    return Layer(volume, table, *unit_distance(distance, volume), shows=shows)


def told_apart(layers: Sequence[Layer], used: set[tuple[float, float, float]]) -> list[Layer]:
    """Return layers of labels whose automatic colours are not ``used``, to which theirs are added.

    A label without a name that is alone in its layer is called as its volume.
    """
    shown = []
    for layer in layers:
        if isinstance(table := layer.tf, LabelTable):
            own = {label.color for label in table.structures}
            free = (color for color in palette() if color not in used | own)
            labels = []
            for label in table.labels:
                alone = table.structures == (label,) and label.name == default_name(label.number)
                again = label.automatic and label.number and label.color in used
                color, name = next(free, label.color) if again else label.color, layer.volume.name
                labels.append(replace(label, color=color, name=name if alone else label.name))
            table = replace(table, labels=tuple(labels))
            used |= {label.color for label in table.structures}
        shown.append(replace(layer, tf=table))
    return shown


def _luminance(stored: bool, *bands: Volume) -> Volume:
    """Return the luminance (nz, ny, nx) float32 of colours, in their data values; lazy if they are ``stored``."""

    def block(slices: tuple[slice, ...]) -> np.ndarray:
        z, y, x = slices
        out = np.zeros((z.stop - z.start, y.stop - y.start, x.stop - x.start), np.float32)
        lo, hi = np.array([x.start, y.start, z.start]), np.array([x.stop, y.stop, z.stop])
        for weight, band in zip(LUMINANCE, bands, strict=True):
            own = read_block(band, lo, hi)
            for k in range(len(out)):
                out[k] += weight * (band.slope * own[k].astype(np.float32) + band.intercept)
        return out

    shape, kind = bands[0].data.shape, np.dtype(np.float32)
    lazy: Any = Stored(block, kind, shape, chunks_of(bands[0]), bands[0].name)
    return replace(bands[0], data=lazy if stored else lazy[:], slope=1.0, intercept=0.0)


def _channel(
    number: int,
    name: str,
    rgb: tuple[float, float, float],
    stats: Statistics,
    tf: TransferFunction | None,
    tf_range: str | tuple[float, float],
) -> TransferFunction:
    """Return the function of a channel: its colour with the given function's opacity, or a ramp over bright voxels."""
    from vvgt_cli.look.resolve import percentiles

    if tf is not None:
        shown = resolve(tf, stats, tf_range)
        lo, hi = shown.node_range()
        return replace(shown, color_map=_function("", lo, max(hi, lo + 1e-9), rgb).color_map)
    lo, hi = percentiles(stats, np.array([DARK, BRIGHT]))
    return _function(
        f"channel {number}{f' {name}' if name else ''}", float(lo), float(hi) if hi > lo else float(lo) + 1, rgb
    )


def _function(name: str, lo: float, hi: float, rgb: Sequence[float]) -> TransferFunction:
    """Return a function of one colour, with opacity from 0 at ``lo`` to 1 at ``hi``."""
    x = np.array([lo, hi])
    opacity, colors = PiecewiseOpacity(x, np.array([0.0, 1.0])), ColorMap(x, np.array([rgb, rgb], float))
    return TransferFunction(name, opacity, colors, opacity_unit_share=UNIT_SHARE, opacity_unit_label="automatic")
