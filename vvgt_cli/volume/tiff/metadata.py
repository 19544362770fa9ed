"""Facts of a TIFF's images by OME-XML and ImageJ's description: voxel sizes in micrometres, names of channels.

Formats: OME model 2016-06 (https://docs.openmicroscopy.org/ome-model); ImageJ's description as its encoder has it.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.space import metres
from vvgt_cli.volume.tiff.pages import MAX_PAGES, check_pages
from vvgt_cli.volume.types import triple

MICROMETRE = 1e-6  # metres
_MOST_FILES = 10_000
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
    """

    spacing: tuple[float | None, float | None, float | None] = (None, None, None)
    channels: list[str] = field(default_factory=list)
    colors: list[tuple[float, float, float] | None] = field(default_factory=list)
    images: int = 0
    trouble: str = ""
    assumed: tuple[str, ...] = ()
    length: str = ""

    def voxel(self, options: ReadOptions, slices: int, source: str) -> tuple[tuple[float, float, float], list[str]]:
        """Return the spacing (x, y, z) to use, and what was assumed for it.

        Raises:
            UsageError: sizes that cannot be used, and no spacing given.
        """
        if self.trouble and options.spacing is None:
            raise UsageError(f"{source}: {self.trouble}; try --spacing X Y Z")
        if options.spacing is not None or self.spacing == (None, None, None):
            return options.spacing_or((1.0, 1.0, 1.0)), []
        x, y, z = self.spacing
        across = x or y or z or 1.0
        width = [] if x and y else [f"no width or no height of its pixels; taken as {across:g}"]
        depth = [] if z or slices == 1 else ["no distance between its slices; taken as wide as its pixels"]
        return (x or across, y or across, z or across), [*self.assumed, *width, *depth]


def ome_root(xml: str, path: Path) -> ElementTree.Element:
    """Parse OME-XML that is safe to be read by a library, and return its root.

    Raises:
        DataError: XML that declares entities, is damaged, or names sizes, ranges or files that cannot be.
    """
    if "<!DOCTYPE" in xml or "<!ENTITY" in xml:
        raise DataError(f"{path}: OME-XML that declares entities; expected plain OME-XML")
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise DataError(f"{path}: damaged OME-XML ({error}); check that the file is whole") from error
    names: set[str] = set()
    for element in root.iter():
        _check_element(element, path)
        if _tag(element) == "UUID" and element.get("FileName"):
            names.add(str(element.get("FileName")))
    if len(names) > _MOST_FILES:
        raise DataError(f"{path}: OME-XML of {len(names)} files; expected at most {_MOST_FILES}")
    for name in sorted(names - {path.name}):
        if Path(name).name != name or "\\" in name:
            raise DataError(f"{path}: OME-XML names the file {name!r}; expected names in its own folder")
        beside = path.with_name(name)
        if not beside.is_file():
            raise DataError(f"{path}: OME-XML names the file {name}, which is not beside it; fetch the whole set")
        check_pages(beside)
    return root


def _check_element(element: ElementTree.Element, path: Path) -> None:
    tag = _tag(element)
    if tag == "BinaryOnly":
        raise DataError(
            f"{path}: one of a set whose OME-XML is in {element.get('MetadataFile', 'another file')}; give that file "
            "if it is a TIFF, else export the image as one OME-TIFF"
        )
    if tag == "Pixels":
        sizes = [int(element.get(f"Size{axis}", 0)) for axis in "XYZCT"]
        if min(sizes) < 1 or math.prod(sizes[2:]) > MAX_PAGES:
            raise DataError(f"{path}: OME-XML of sizes {sizes}; expected at least 1 and at most {MAX_PAGES} planes")
        if sorted(element.get("DimensionOrder", "")) != list("CTXYZ"):
            raise DataError(f"{path}: OME-XML with DimensionOrder {element.get('DimensionOrder')!r}; expected as XYZCT")
    if tag == "TiffData":
        numbers = [int(value) for key, value in element.items() if key in ("IFD", "NumPlanes", "PlaneCount")]
        if any(not 0 <= n <= MAX_PAGES for n in numbers):
            raise DataError(f"{path}: OME-XML with TiffData of {numbers}; expected 0 to {MAX_PAGES}")
    if tag.startswith("Along") and element.get("Start") is not None:
        start, stop, step = (
            float(element.get(key, default)) for key, default in (("Start", 0), ("End", 0), ("Step", 1))
        )
        if not abs(stop - start) <= 1e6 * abs(step):
            raise DataError(f"{path}: OME-XML with {tag} from {start} to {stop} by {step}; expected at most 10^6 steps")


def _tag(element: ElementTree.Element) -> str:
    return str(element.tag).rpartition("}")[2]


def ome_facts(root: ElementTree.Element, series: int, count: int) -> Facts:
    """Return the facts of image ``series`` of ``count``; none where the XML has another number of images."""
    images = [p for image in root if _tag(image) == "Image" for p in image if _tag(p) == "Pixels"]
    if len(images) != count:
        return Facts()
    pixels = images[series]
    sizes = {f"PhysicalSize{axis}": pixels.get(f"PhysicalSize{axis}") for axis in "XYZ"}
    units = [pixels.get(f"PhysicalSize{axis}Unit", "µm") for axis in "XYZ"]
    names, colors = [], []
    for channel in (c for c in pixels if _tag(c) == "Channel"):
        name, samples = channel.get("Name", ""), int(channel.get("SamplesPerPixel", 1))
        names += [name] if samples == 1 else [f"{name}:{k}" for k in range(min(samples, 1000))]
        colors += [_color(channel.get("Color"))] * min(samples, 1000)
    return replace(_micrometres(sizes, units), channels=names if any(names) else [], colors=colors)


def _color(text: str | None) -> tuple[float, float, float] | None:
    """Convert OME's signed 32-bit RGBA to RGB; None for none, and for black, which shows nothing."""
    if text is None or not re.fullmatch(r"-?\d{1,10}", text):
        return None
    value = int(text) & 0xFFFFFFFF
    red, green, blue = value >> 24, value >> 16 & 255, value >> 8 & 255
    return (red / 255, green / 255, blue / 255) if red + green + blue else None


def imagej_facts(stated: dict[str, Any], resolution: tuple[float | None, float | None], tag: int) -> Facts:
    """Return what ImageJ's description says, as ImageJ reads it (ij.io.TiffDecoder and FileOpener, 1.54).

    ImageJ counts the resolution in the description's unit (micrometres per centimetre excepted), takes 72 dots per
    inch for no size, and leaves out a distance between slices that is 1.

    Args:
        stated: its entries.
        resolution: pixels per unit along x and y (tags 282 and 283); None where the file has none.
        tag: ResolutionUnit (tag 296); 1 where the file has none.
    """
    if "scales" in stated:  # SCIFIO's lists, in parallel
        scales = dict(zip(*(str(stated.get(key, "")).split(",") for key in ("axes", "scales")), strict=False))
        x, y, z = (_positive(scales.get(axis)) for axis in "XYZ")
        resolution, tag, stated = (x and 1 / x, y and 1 / y), 1, {"spacing": z, **stated}
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
        return Facts(images=images)
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
    return replace(facts, images=images, assumed=tuple(assumed))


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
