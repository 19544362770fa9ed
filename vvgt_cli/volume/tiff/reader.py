"""TIFF (``.tif``, ``.tiff``), OME-TIFF, ImageJ's and BigTIFF among them: axes by tifffile, pixels by OpenImageIO.

tifffile says which page is which slice, channel and time. Its decoders are not used where OpenImageIO has one: those
unpack a page to its size and no further, and need no further package. Pixels that lie together plainly are
memory-mapped. What OpenImageIO does not decode is left to tifffile, which wants imagecodecs for it.

Voxel sizes and names of channels follow OME-XML and ImageJ's description: OME model 2016-06
(https://docs.openmicroscopy.org/ome-model); ImageJ's description as its encoder has it.
"""

from __future__ import annotations

import itertools
import logging
import math
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from threading import Lock
from typing import Any
from xml.etree import ElementTree

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.labelled import decode
from vvgt_cli.volume.microscopy.image import Micrograph, choose_image, hex_color, picture_volume
from vvgt_cli.volume.reading import ReadOptions, Slices, Volume, load_block, printable, size_text, triple, volume_name
from vvgt_cli.volume.space import MICROMETRE, metres
from vvgt_cli.volume.tiff.decode import Pages
from vvgt_cli.volume.tiff.ome import ome_tag, open_tiff
from vvgt_cli.volume.tiff.pages import check_pages
from vvgt_cli.volume.types import float_dtype

_SIZES = {  # tags of programs that state voxel sizes in forms that are not read
    33550: "ModelPixelScale", 34264: "ModelTransformation", 34412: "CZ_LSMINFO", 34118: "CZ_SEM", 34680: "FEI_SFEG",
    34682: "FEI_TITAN", 51123: "MicroManagerMetadata", 33628: "UIC1tag", 33629: "UIC2tag",
}  # fmt: skip
_NODATA = 42113  # of GDAL
_AXES = {"X": "columns", "Y": "rows", "Z": "slices", "T": "time steps", "C": "channels", "S": "samples"}


@dataclass(frozen=True)
class SeriesAxes:
    """The positions of voxels along the axes of a series.

    Attributes:
        axes: letters as tifffile has them, unknown ones that stand for slices made Z.
        shape: sizes along them.
        lead: how many of them count pages; the rest lie in a page.
        color: pixels are colours, as their photometric tag says.
    """

    axes: str
    shape: tuple[int, ...]
    lead: int
    color: bool = False

    def of(self, letters: str) -> list[int]:
        """Return the positions of axes of more than one value."""
        return [k for k, a in enumerate(self.axes) if a in letters and self.shape[k] > 1]

    def count(self, letters: str) -> int:
        """Return the number of values along axes together."""
        return math.prod(self.shape[k] for k in self.of(letters))

    @property
    def paged(self) -> bool:
        """Whether slices are pages of rows and columns."""
        space = self.of("XYZ")
        return len(space) == 3 and [self.axes[k] for k in space if k < self.lead] == ["Z"]

    def index(self, time: int, channel: int, box: Slices) -> tuple[int | slice, ...]:
        """Return the index of a box (z, y, x) along every axis; samples of a pixel count faster than channels."""
        places: dict[str, int | slice] = {"T": time, **dict(zip("ZYX", box, strict=True))}
        index = [places.get(a, 0) if n > 1 else 0 for a, n in zip(self.axes, self.shape, strict=True)]
        for k in reversed(self.of("CS")):
            channel, index[k] = divmod(channel, self.shape[k])
        return tuple(index)

    def zyx(self, values: np.ndarray) -> np.ndarray:
        """Return what was read at an `index` as (z, y, x)."""
        kept = [self.axes[k] for k in self.of("XYZ")]
        field = values.transpose([kept.index(a) for a in "ZYX" if a in kept])
        return field[tuple(slice(None) if a in kept else None for a in "ZYX")]


def read_tiff(path: Path, options: ReadOptions, slices: int = 1) -> Volume:
    """Read a volume from a TIFF file; rows from the top are y. Resolution tags alone are not spacing.

    Spacing is in micrometres where OME-XML or ImageJ's description has one, else 1.

    A volume has so many ``slices`` if the file is the first of them; 0 for the others, which say nothing of what the
    first has said.
    """
    check_pages(path)
    with _silent(), open_tiff(path) as file, Pages(path) as pages:
        root = ElementTree.fromstring(file.ome_metadata) if file.is_ome and file.ome_metadata else None
        count_planes(file)
        series, number = _series(file, options.array, path)
        facts = _facts(file, root, series, number, path)
        layout = _layout(series, path)
        mapped = None
        if _mappable(series):
            mapped = load_block(path, series.dtype.newbyteorder(file.byteorder), layout.shape, offset=series.dataoffset)
        stored = options.stored and options.component != "magnitude" and (mapped is not None or layout.paged)
        again = partial(_opened, path, number) if stored else lambda: (series, pages)
        sizes, kind = triple(map(layout.count, "ZYX")), np.dtype(series.dtype)
        read: Any = partial(_read, layout, kind, cache(again), Lock(), mapped)
        nodata = printable(str(series.keyframe.tags.valueof(_NODATA, default="nan")).strip("\0 "))[:40]
        missing = _number(nodata)
        if missing is not None and math.isnan(missing):
            nodata, missing = "nan", None
        if marked := missing is not None and not layout.color:
            kind = float_dtype(kind)
            always = kind if stored or slices != 1 else None
            read, nodata = partial(_known, read, missing, always, str(path)), "nan"
        picture = Micrograph(
            layout.count("T"), layout.count("CS"), sizes, kind, read, (1, *sizes[1:]),
            facts.spacing, names=facts.channels, colors=facts.colors, rgb=layout.color, samples=bool(layout.of("S")),
            mapped=mapped is not None and not marked, tells=False,
        )  # fmt: skip
        if slices:
            _warn_of_unread(series.keyframe.tags, nodata, facts, options, path)
        if mapped is None:
            _whole(series, path)
        volume = picture_volume(picture, replace(options, stored=stored), str(path), volume_name(path))
    if doubts := facts.doubts(options, max(slices, len(volume.data)), str(path)):
        warnings.warn(f"{path}: {'; '.join(doubts)} (--spacing X Y Z sets it)", stacklevel=2)
    if facts.scaling != (1.0, 0.0) and options.component == "magnitude":
        raise UsageError(f"{path}: calibrated values, of which no magnitude is taken; choose one channel")
    steps = (_positive(edge) or own for edge, own in zip(facts.spacing, volume.spacing, strict=True))
    origin = triple(0.0 - n * step for n, step in zip(facts.zero, steps, strict=True))
    return replace(
        volume, unit=facts.length, slope=facts.scaling[0], intercept=facts.scaling[1], value_unit=facts.value_unit,
        origin=origin,
    )  # fmt: skip


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _warn_of_unread(tags: Any, nodata: str, facts: Facts, options: ReadOptions, path: Path) -> None:
    """Warn of a calibration, tags that state sizes, where no others do, or missing values, which are not read."""
    if facts.function is not None:
        warnings.warn(f"{path}: values are not calibrated as ImageJ's function {facts.function!r} says", stacklevel=3)
    names = [name for code, name in _SIZES.items() if code in tags]
    if names and facts.spacing == (None, None, None) and options.spacing is None:
        warnings.warn(f"{path}: sizes in {', '.join(names)} are not read; --spacing X Y Z sets them", stacklevel=3)
    if nodata.lower() not in ("", "nan"):
        warnings.warn(f"{path}: voxels of {nodata} (GDAL_NODATA) are read as values, not as missing", stacklevel=3)


def _opened(path: Path, number: int) -> tuple[Any, Pages, Any]:
    """Open a series for as long as its volume lives; return it, its pages, and the file to keep it open."""
    file = open_tiff(path)
    return file.series[number], Pages(path), file


def _read(
    layout: SeriesAxes, dtype: np.dtype, opened: Callable[[], Any], turn: Lock, mapped: np.ndarray | None,
    time: int, channel: int, box: Slices,
) -> np.ndarray:  # fmt: skip
    """Read a box (z, y, x): of the map, where there is one, else page by page."""
    index = layout.index(time, channel, box)
    if mapped is not None:
        return layout.zyx(mapped[index])
    out = np.empty([i.stop - i.start for i in index if isinstance(i, slice)], dtype)
    lead, inner, within = layout.shape[: layout.lead], layout.shape[layout.lead :], index[layout.lead :]
    rows = out.reshape(-1, *(i.stop - i.start for i in within if isinstance(i, slice)))
    places = itertools.product(
        *(range(i.start, i.stop) if isinstance(i, slice) else (i,) for i in index[: layout.lead])
    )
    with turn:  # one file, one reader: workers may have threads
        series, pages, *_ = opened()
        for row, place in zip(rows, places, strict=True):
            number = int(np.ravel_multi_index(place, lead)) if place else 0
            row[...] = pages.decoded(series[number], series).reshape(inner)[within]
    return layout.zyx(out)


def _known(read: Any, nodata: float, kind: np.dtype | None, source: str, *place: Any) -> np.ndarray:
    """Read a box, NaN where it is ``nodata``: of a type ``kind``; where that is None, of floats only if some are."""
    values, *_ = decode(read(*place), {"_FillValue": nodata}, source)
    return np.ascontiguousarray(values, kind)


@contextmanager
def _silent() -> Iterator[None]:
    """Keep tifffile from logging: what matters of it becomes an error here."""
    logger = logging.getLogger("tifffile")
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


def _series(file: Any, wanted: str | None, path: Path) -> tuple[Any, int]:
    """Return the series asked for, or the only one that is an image of its own, and its number."""
    images = [(k, s) for k, s in enumerate(file.series) if not (s.keyframe.is_reduced or s.keyframe.is_mask)]
    if not images:
        raise DataError(f"{path}: no pages but thumbnails and masks; expected slices")
    facts = [f"{' x '.join(map(str, s.shape))}, axes {s.axes}, {s.dtype}" for _, s in images]
    deep = [s.kind == "ome" and "Z" in s.axes for _, s in images]  # of plain pages sizes differ by damage, too
    names, keys = [s.name for _, s in images], [str(k) for k, _ in images]
    number, series = images[choose_image(names, facts, wanted, "series", str(path), deep, keys)]
    return series, number


def _facts(file: Any, root: Any, series: Any, number: int, path: Path) -> Facts:
    """Return the facts of a series; check that its pages are those that they describe."""
    facts = Facts()
    if root is not None:
        facts = ome_facts(root, number, series.name, len(file.series), path)
        if series.kind not in ("ome", "imagej", "mmstack"):
            raise DataError(f"{path}: its OME-XML does not fit its pages; check that the file is whole")
    if facts.spacing == (None, None, None) and file.is_imagej and not file.is_shaped:
        first = file.pages.first
        x, y = (r if code in first.tags else None for code, r in zip((282, 283), first.get_resolution(), strict=True))
        description = imagej_facts(file.imagej_metadata or {}, (x, y), int(first.tags.valueof(296, default=1)))
        kind = "colours" if series.keyframe.photometric == 2 else np.dtype(series.dtype).name
        facts = replace(description, channels=facts.channels, **_calibration(file.imagej_metadata or {}, kind))
        if facts.images > 1 and series.kind != "imagej" and root is None:
            short = first.dataoffsets[0] + facts.images * first.nbytes - path.stat().st_size if first.is_final else 0
            missing = f" ({size_text(short)} are missing)" if short > 0 else ""
            text = f"{path}: ImageJ's description tells of {facts.images} images that are not there{missing}"
            raise DataError(f"{text}; is it whole?")
    return facts


def _layout(series: Any, path: Path) -> SeriesAxes:
    """Return the axes of a series, and how they lie in its pages."""
    axes, shape = series.get_axes(False), tuple(map(int, series.get_shape(False)))
    keyframe = series.keyframe
    if keyframe.photometric == 3 and not (keyframe.is_imagej or series.kind in ("ome", "imagej")):
        raise DataError(f"{path}: pixels are numbers of a palette's colours; expected scalars: convert to grey first")
    strange = [k for k, a in enumerate(axes) if a not in _AXES and shape[k] > 1]
    deep = any(a == "Z" and n > 1 for a, n in zip(axes, shape, strict=True))
    if len(strange) == 1 and not deep and axes[strange[0]] in "IQ":
        axes = axes.replace("Z", "Q")
        axes = axes[: strange[0]] + "Z" + axes[strange[0] + 1 :]
    elif strange:
        raise DataError(
            f"{path}: axes {_described(axes, shape)}; expected slices, rows, columns, channels and time steps: "
            "write the others as files of their own"
        )
    lead = next((k for k in range(len(shape), -1, -1) if math.prod(shape[k:]) == keyframe.size), None)
    one = bool(series.is_truncated) and _mappable(series)  # one directory, whose planes lie behind each other
    if lead is None or (math.prod(shape[:lead]) != len(series) and not one):
        raise DataError(
            f"{path}: {len(series)} pages of {keyframe.size} values; expected {' x '.join(map(str, shape))}; check "
            "that the file is whole"
        )
    layout = SeriesAxes(axes, shape, lead, keyframe.photometric == 2)
    if any(len(layout.of(letter)) > 1 for letter in _AXES):
        raise DataError(f"{path}: axes {_described(axes, shape)}; expected one of each")
    return layout


def _described(axes: str, shape: tuple[int, ...]) -> str:
    return ", ".join(f"{n} {_AXES.get(a, a)}" for a, n in zip(axes, shape, strict=True) if n > 1) or "of one value each"


def _mappable(series: Any) -> bool:
    """Return whether the values of a series lie together plainly; those of one directory may begin anywhere."""
    aligned = bool(series.keyframe.is_memmappable) or bool(series.is_truncated)
    return series.dataoffset is not None and not series.is_multifile and aligned


def _whole(series: Any, path: Path) -> None:
    """Refuse a series that lacks planes."""
    missing = [number for number, page in enumerate(series[:]) if page is None]
    if missing:
        raise DataError(
            f"{path}: {len(missing)} of {len(series)} planes are missing, the first is number {missing[0]}; check that "
            "the file, or the set, is whole"
        )


_OTHER_NAMES = {"A": "angstrom", "in": "inch", "inches": "inch", "pixels": "pixel"}
_PER = {2: "inch", 3: "cm"}  # ResolutionUnit, tag 296


@dataclass(frozen=True)
class Facts:
    """The facts that are stated of an image.

    Attributes:
        spacing: voxel edges (x, y, z) in micrometres (in the file's numbers where its unit is no length); None unsaid.
        channels: names of the channels, where they have any.
        colors: RGB in [0, 1] of the channels, where they have any.
        images: images that must be there for the description to hold; 0 where it does not say.
        trouble: why the spacing cannot be used: units that do not compare, a size that is no number.
        assumed: what was assumed for the spacing.
        length: unit of the spacing, "um" or unknown.
        scaling: slope and intercept of the values.
        value_unit: unit of the values; "" unknown.
        function: ImageJ's function that would calibrate the values, which is not read; None if there is none.
        zero: voxel (x, y, z), counted from 0, whose centre is the world's origin.
    """

    spacing: tuple[float | None, float | None, float | None] = (None, None, None)
    channels: list[str] = field(default_factory=list)
    colors: list[tuple[float, float, float] | None] = field(default_factory=list)
    images: int = 0
    trouble: str = ""
    assumed: tuple[str, ...] = ()
    length: str = ""
    scaling: tuple[float, float] = (1.0, 0.0)
    value_unit: str = ""
    function: Any = None
    zero: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def doubts(self, options: ReadOptions, slices: int, source: str) -> list[str]:
        """Return what is assumed for the spacing; raise UsageError if it is unusable and none is given."""
        if options.spacing is not None or self.spacing == (None, None, None):
            return []
        if self.trouble:
            raise UsageError(f"{source}: {self.trouble}; try --spacing X Y Z")
        x, y, z = self.spacing
        width = [] if x and y else [f"no width or no height of its pixels; taken as {x or y or z or 1.0:g}"]
        depth = [] if z or slices == 1 else ["no distance between its slices; taken as wide as its pixels"]
        return [*self.assumed, *width, *depth]


def ome_facts(root: ElementTree.Element, series: int, name: str, count: int, path: Path) -> Facts:
    """Return the facts of image ``series`` of ``count``, by its ``name`` where others of the XML have no pages.

    Raise DataError where several images, or none, have that name.
    """
    images = [(image.get("Name", ""), p) for image in root if ome_tag(image) == "Image" for p in image]
    images = [(title, p) for title, p in images if ome_tag(p) == "Pixels"]
    if len(images) != count:
        named = [(title, p) for title, p in images if title == name]
        if len(named) != 1:
            raise DataError(
                f"{path}: OME-XML of {len(images)} images, pages of {count}; expected as many: is the set whole?"
            )
        images, series = named, 0
    pixels = images[series][1]
    sizes = {f"PhysicalSize{axis}": pixels.get(f"PhysicalSize{axis}") for axis in "XYZ"}
    units = [pixels.get(f"PhysicalSize{axis}Unit", "µm") for axis in "XYZ"]
    names, colors = [], []
    for channel in (c for c in pixels if ome_tag(c) == "Channel"):
        name, samples = channel.get("Name", ""), int(channel.get("SamplesPerPixel", 1))
        names += [name] if samples == 1 else [f"{name}:{k}" if name else "" for k in range(min(samples, 1000))]
        colors += [_color(channel.get("Color"))] * min(samples, 1000)
    return replace(_micrometres(sizes, units), channels=names if any(names) else [], colors=colors)


def _color(text: str | None) -> tuple[float, float, float] | None:
    """Convert OME's signed 32-bit RGBA to RGB; None for none, and for black, which shows nothing."""
    number = re.fullmatch(r"-?\d{1,10}", text or "")
    return hex_color(f"{(int(number[0]) & 0xFFFFFFFF) >> 8:06x}") if number else None


def imagej_facts(stated: dict[str, Any], resolution: tuple[float | None, float | None], tag: int) -> Facts:
    """Return what ImageJ's description says, as ImageJ reads it (ij.io.TiffDecoder and FileOpener, 1.54).

    ImageJ counts the ``resolution`` (pixels per unit along x and y, or None) in the description's unit (micrometres per
    centimetre, by ``tag`` 296, excepted), takes 72 dots per inch for no size, and leaves out a distance between slices
    that is 1.
    """
    if "scales" in stated:  # SCIFIO's lists, in parallel
        scales = dict(zip(*(str(stated.get(key, "")).split(",") for key in ("axes", "scales")), strict=False))
        x, y, z = (_positive(scales.get(axis)) for axis in "XYZ")
        resolution, tag, stated = (x and 1 / x, y and 1 / y), 1, {"spacing": z, **stated}
    origin = [_number(str(stated.get(f"{axis}origin"))) or 0.0 for axis in "xyz"]
    zero = triple(np.nan_to_num(origin, posinf=0, neginf=0).tolist())
    channels, slices, frames = (int(stated.get(key, 1)) for key in ("channels", "slices", "frames"))
    images, assumed, name = channels * slices * frames, [], str(stated.get("unit", "")).strip()
    unit, per = _unit(name), _PER.get(tag, "")
    across = [1 / n if n else None for n in map(_positive, resolution)]
    if per and (unit in ("", "pixel") or (per == "inch" != unit and across[0] == 1 / 72)):
        across = [None, None]  # dots of a printer
    elif per and _metres(unit) not in (None, _metres(per)):
        metric = per == "cm" and _metres(unit) == MICROMETRE
        across = [n and n * (1e4 if metric else 1) for n in across]
        if unit != "um" or not metric:
            assumed.append(f"resolution per {per} by its tag, in {name} by ImageJ's description; "
                           f"taken per {per if metric else name}")  # fmt: skip
    depth = stated.get("spacing") or None
    if unit in ("", "pixel") and depth is None and not set(across) - {None, 1.0}:
        return Facts(images=images, zero=zero)
    if None in across:
        assumed.append("no size of its pixels; taken as 1")
    if depth is None and max(images, int(stated.get("images", 1))) > channels * frames:
        depth = 1.0
        assumed.append("no distance between its slices; taken as 1, as ImageJ takes it")
    sizes = {
        "x": across[0] or 1,
        "y": across[1] or 1,
        "spacing": abs(depth) if isinstance(depth, float | int) else depth,
    }
    facts = _micrometres(sizes, [name, str(stated.get("yunit", name)), str(stated.get("zunit", name))])
    return replace(facts, images=images, assumed=tuple(assumed), zero=zero)


def _calibration(stated: dict[str, Any], kind: str) -> dict[str, Any]:
    """Return the `Facts` of values of a ``kind`` by ImageJ's calibration, as ImageJ reads it (ij.io.FileOpener, 1.54).

    A straight line is applied (ij.measure.Calibration): so it writes signed values, which it stores as unsigned; it
    reads signed ones as unsigned, too. Values of 32 bits have a unit alone, colours nothing.
    """
    unit = printable(str(stated.get("vunit", "")))[:40]
    facts: dict[str, Any] = {"value_unit": "" if unit == "Gray Value" else unit}
    if kind not in ("uint8", "uint16", "int16"):
        return {} if kind == "colours" else facts
    if stated.get("cf", 20) == 20:  # none
        return {}
    numbers = (stated.get(key) for key in ("c0", "c1"))
    offset, slope = (n if isinstance(n, int | float) and abs(n) < 1e30 else math.nan for n in numbers)
    if stated["cf"] != 0 or not slope or not math.isfinite(slope + offset) or "c2" in stated:
        return {"function": stated["cf"]}
    return facts | {"scaling": (float(slope), float(offset + (32768 * slope if kind == "int16" else 0)))}


def count_planes(file: Any) -> None:
    """Make the planes of one directory slices if ImageJ's description counts more of them than it gives axes."""
    stated = file.imagej_metadata if file.is_imagej and not file.pages.is_multipage else None
    images = int(stated.get("images", 1)) if stated else 1
    if stated and images > math.prod(int(stated.get(key, 1)) for key in ("channels", "slices", "frames")):
        stated.update(channels=1, slices=images, frames=1)


def _positive(value: Any) -> float | None:
    """Return a size as a number above 0, None where there is none, NaN where it is text but no number."""
    try:
        number = float(value or 0)
    except (TypeError, ValueError):
        return math.nan
    return number if math.isfinite(number) and number > 0 else None


def _micrometres(sizes: dict[str, Any], units: list[str]) -> Facts:
    """Return the spacing in micrometres, or as stated if its one unit is none of length, from sizes along x, y, z."""
    numbers = [_positive(size) for size in sizes.values()]
    odd = [key for key, n in zip(sizes, numbers, strict=True) if n is not None and math.isnan(n)]
    plain = [_unit(unit) for unit in units]
    lengths = [_metres(unit) for unit in plain]
    stated = {u: m for u, m, n in zip(plain, lengths, numbers, strict=True) if n is not None}
    if odd or None in stated.values():
        mixed = f"voxel sizes in {', '.join(stated)}; expected one unit" if len(stated) > 1 else ""
        return Facts(triple(numbers), trouble=f"{odd[0]} is {sizes[odd[0]]!r}; expected a number" if odd else mixed)
    return Facts(
        triple(
            None if n is None else float(f"{n * float(m or 1) / MICROMETRE:.15g}")
            for n, m in zip(numbers, lengths, strict=True)
        ),
        length="um" if stated else "",
    )


def _unit(text: str) -> str:
    text = re.sub(r"\\u([0-9a-f]{4})", lambda code: chr(int(code[1], 16)), text.strip(), flags=re.I)
    return _OTHER_NAMES.get(text, text)


def _metres(unit: str) -> float | None:
    return 0.0254 if unit == "inch" else metres(unit)
