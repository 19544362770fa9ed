"""Volumes that are not one scalar field: label maps, colours, channels, and layers that add up (docs/layers.md)."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vvgt_cli.dvr.layers import Layer
from vvgt_cli.errors import DataError, SeveralComponents, UsageError
from vvgt_cli.synth.sources import open_volume
from vvgt_cli.transfer import (
    ColorMap,
    PiecewiseOpacity,
    TransferFunction,
    check_visible,
    from_histogram,
    read_transfer_function,
    resolve,
    unit_distance,
)
from vvgt_cli.transfer.histogram import UNIT_SHARE
from vvgt_cli.transfer.label_files import read_labels
from vvgt_cli.transfer.labels import LabelTable, distinct
from vvgt_cli.volume import ReadOptions, Volume, statistics
from vvgt_cli.volume.label_maps import labels_in, recognised

AUTO, NONE = "auto", "none"
SEGMENTATION = ".seg.nrrd"  # a label map whose header is its table
COLOR, ALL = "color", "all"  # of --component
LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709
CHANNEL_COLORS = ((0, 1, 0), (1, 0, 1), (0, 1, 1), (1, 0.5, 0), (0.4, 0.4, 1), (1, 1, 0), (1, 0, 0))
DARK, BRIGHT = 0.5, 0.998  # shares of a channel's voxels between which its opacity rises
KEYS = {"tf": str, "labels": str, "distance": str, "array": str, "component": str, "channel": str, "time": int}


@dataclass(frozen=True)
class LayerRequest:
    """A volume to be laid over the first.

    Attributes:
        volume: path, or a volume.
        tf: its function; None makes one.
        labels: its table of labels, ``auto``, ``none``, or None: ``auto`` where it is recognised.
        distance: world length that its opacity is per, as `SourceRequest.unit_distance`.
        read: how to read it.
    """

    volume: str | Volume
    tf: str | TransferFunction | None = None
    labels: str | LabelTable | None = None
    distance: str | None = None
    read: ReadOptions = field(default_factory=ReadOptions)


def parse_layer(text: str, space: str | None = None) -> LayerRequest:
    """``FILE[,tf=TF][,labels=TABLE][,component=N]...``.

    Raises:
        UsageError: a key that is none.
    """
    path, *rest = re.split(r",(?=[a-z]+=)", text)
    given: dict[str, Any] = {}
    for part in rest:
        key, _, value = part.partition("=")
        if key not in KEYS or not value or (KEYS[key] is int and not value.isdecimal()):
            raise UsageError(
                f"--layer {text}: {part!r}; expected FILE and any of {', '.join(f'{k}=...' for k in KEYS)}"
            )
        given["component" if key == "channel" else key] = KEYS[key](value)
    if not path:
        raise UsageError(f"--layer {text}: no file; expected FILE, as seg.nrrd or pet.nii,tf=hot.json")
    component = given.pop("component", None)
    if component is not None and component.isdecimal():
        component = int(component)
    tf, labels, distance = (given.pop(key, None) for key in ("tf", "labels", "distance"))
    return LayerRequest(path, tf, labels, distance, ReadOptions(component=component, space=space, **given))


@dataclass(frozen=True)
class Content:
    """What a file holds.

    Attributes:
        volumes: the scalar field; or red, green, blue and perhaps opacity; or a channel each.
        color: they are colours.
        colors: RGB of each channel, None where the file says none.
        path: of the file, None where it is in memory.
    """

    volumes: tuple[Volume, ...]
    color: bool = False
    colors: Sequence[tuple[float, float, float] | None] = ()
    path: str | None = None


def open_parts(source: str, read: ReadOptions) -> Content:
    """A volume; where ``read.component`` is "color" or "all", or the file says that it holds colours, its components.

    Raises:
        DataError, UsageError: as `open_volume`; components that are no colours.
    """
    asked = read.component if read.component in (COLOR, ALL) else None
    try:
        volume = open_volume(source, replace(read, component=None) if asked else read)
    except SeveralComponents as error:
        if not asked and not error.color:
            raise
        if asked == COLOR and error.count not in (3, 4):
            raise UsageError(
                f"{source}: {error.count} components; expected three or four for --component color"
            ) from None
        parts = tuple(open_volume(source, replace(read, component=k)) for k in range(error.count))
        if asked == ALL:
            colors = error.colors or [None] * error.count
            return Content(tuple(replace(v, name=f"{v.name} {k}") for k, v in enumerate(parts)), False, colors)
        return Content(parts, True)
    if asked:
        raise UsageError(f"{source}: one component; leave out --component {asked}")
    return Content((volume,), path=source)


def is_plain(opened: Content, tf: object, labels: str | LabelTable | None, layers: Sequence[LayerRequest]) -> bool:
    """Whether it is one scalar field under a function; a label map that is recognised is not."""
    if opened.color or len(opened.volumes) > 1 or layers or labels not in (None, NONE):
        return False
    return tf is not None or labels == NONE or not recognised(opened.volumes[0])


def layers_of(
    opened: Content,
    tf: str | TransferFunction | None,
    labels: str | LabelTable | None,
    tf_range: str | tuple[float, float] = "data",
    distance: str | None = None,
) -> list[Layer]:
    """The layers that a file's content makes.

    Args:
        opened: the content.
        tf: function, None makes one; of colours its opacity is taken, over their luminance or opacity.
        labels: table of labels, its file, ``auto``, ``none`` or None.
        tf_range, distance: of functions.

    Raises:
        DataError: labels that do not fit the table, nothing that is visible.
        UsageError: a table and a function at once.
    """
    volume = opened.volumes[0]
    if labels not in (None, NONE) and (opened.color or len(opened.volumes) > 1):
        raise UsageError(f"{volume.name}: several components; expected one of labels: choose it with --component N")
    if labels not in (None, NONE) and tf is not None:
        raise UsageError(f"{volume.name}: both a function and a table of labels; expected one of --tf and --labels")
    if labels is None and tf is None and not opened.color and len(opened.volumes) == 1 and recognised(volume):
        labels = AUTO
        warnings.warn(
            f"{volume.name}: taken as a label map, by its name and its few integers (--labels none: as scalars)",
            stacklevel=2,
        )
    if labels not in (None, NONE):
        own = opened.path if labels == AUTO and str(opened.path).endswith(SEGMENTATION) else labels
        return [_labelled(volume, own, distance)]
    function = read_transfer_function(tf) if isinstance(tf, str) else tf
    if opened.color:
        return [_colored(opened.volumes, function, tf_range, distance)]
    if len(opened.volumes) > 1:
        return [_channel(v, k, opened.colors[k], function, tf_range, distance) for k, v in enumerate(opened.volumes)]
    numbers = statistics(volume)
    shown = resolve(function, numbers, tf_range) if function else from_histogram(numbers, volume.hounsfield)
    check_visible(shown, numbers)
    return [Layer(volume, shown, *unit_distance(distance, volume, function or shown))]


def _labelled(volume: Volume, labels: str | LabelTable | None, distance: str | None) -> Layer:
    numbers = labels_in(volume)
    if isinstance(labels, str) and labels != AUTO:
        table = read_labels(labels).of(numbers, volume.name)
    elif isinstance(labels, LabelTable):
        table = labels.of(numbers, volume.name)
    elif any(numbers):
        table = distinct(numbers)
    else:
        raise DataError(f"{volume.name}: no label but 0; expected some to show")
    return Layer(volume, table, *unit_distance(distance, volume))


def _colored(
    volumes: Sequence[Volume], tf: TransferFunction | None, tf_range: str | tuple[float, float], distance: str | None
) -> Layer:
    """Colours as they are; opacity from theirs, or from luminance, under the function or in proportion."""
    red, green, blue = volumes[:3]
    kind = red.data.dtype
    white = float(np.iinfo(kind).max) if kind.kind in "iu" else 1.0
    source = volumes[3] if len(volumes) > 3 else _luminance(red, green, blue)
    numbers = statistics(source)
    ramp = _function("opacity of the file" if len(volumes) > 3 else "opacity by luminance", 0.0, white, (1, 1, 1))
    shown = resolve(tf, numbers, tf_range) if tf else ramp
    check_visible(shown, numbers)
    source = replace(source, name=red.name)
    return Layer(source, shown, *unit_distance(distance, source, shown), (red, green, blue), white)


def _luminance(*bands: Volume) -> Volume:
    """(nz, ny, nx) float32, in the data values of the colours."""
    out = np.zeros(bands[0].data.shape, np.float32)
    for weight, band in zip(LUMINANCE, bands, strict=True):
        for z in range(len(out)):
            out[z] += weight * (band.slope * band.data[z].astype(np.float32) + band.intercept)
    return replace(bands[0], data=out, slope=1.0, intercept=0.0)


def _channel(
    volume: Volume,
    number: int,
    color: tuple[float, float, float] | None,
    tf: TransferFunction | None,
    tf_range: str | tuple[float, float],
    distance: str | None,
) -> Layer:
    """A channel in its colour; the function's opacity, or a ramp over its brighter voxels."""
    from vvgt_cli.transfer.resolve import percentiles

    rgb = color or CHANNEL_COLORS[number % len(CHANNEL_COLORS)]
    numbers = statistics(volume)
    if tf is not None:
        shown = resolve(tf, numbers, tf_range)
        lo, hi = shown.node_range()
        shown = replace(shown, color_map=_function("", lo, max(hi, lo + 1e-9), rgb).color_map)
    else:
        lo, hi = percentiles(numbers, np.array([DARK, BRIGHT]))
        shown = _function(f"channel {number}", float(lo), float(hi) if hi > lo else float(lo) + 1, rgb)
    return Layer(volume, shown, *unit_distance(distance, volume, shown))


def _function(name: str, lo: float, hi: float, rgb: Sequence[float]) -> TransferFunction:
    """One colour, opacity from 0 at ``lo`` to 1 at ``hi``."""
    x = np.array([lo, hi])
    opacity, colors = PiecewiseOpacity(x, np.array([0.0, 1.0])), ColorMap(x, np.array([rgb, rgb], float))
    return TransferFunction(name, opacity, colors, opacity_unit_share=UNIT_SHARE, opacity_unit_label="automatic")
