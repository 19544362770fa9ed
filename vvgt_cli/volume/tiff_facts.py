"""What OME-XML and ImageJ's description say of a TIFF's images: voxel sizes in micrometres, names of channels.

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
from vvgt_cli.volume.tiff_pages import MAX_PAGES, check_pages
from vvgt_cli.volume.types import triple

MICROMETRE = 1e-6  # metres
_MOST_FILES = 10_000
_OTHER_NAMES = {"Å": "angstrom", "in": "inch", "microns": "um"}


@dataclass(frozen=True)
class Facts:
    """What is said of an image.

    Attributes:
        spacing: voxel edges (x, y, z) in micrometres (in the file's numbers where its unit is no length); None unsaid.
        channels: names of the channels, where they have any.
        colors: RGB in [0, 1] of the channels, where they have any.
        images: images that must be there for the description to hold; 0 where it does not say.
        units: of the spacing, where they do not compare.
        length: unit of the spacing, "um" or unknown.
    """

    spacing: tuple[float | None, float | None, float | None] = (None, None, None)
    channels: list[str] = field(default_factory=list)
    colors: list[tuple[float, float, float] | None] = field(default_factory=list)
    images: int = 0
    units: str = ""
    length: str = ""

    def voxel(self, options: ReadOptions, slices: int, source: str) -> tuple[tuple[float, float, float], bool]:
        """The spacing to take, and whether the distance of several slices is a guess.

        Raises:
            UsageError: units that do not compare, and no spacing given.
        """
        if self.units and options.spacing is None:
            raise UsageError(f"{source}: voxel sizes in {self.units}; expected one unit: try --spacing X Y Z")
        if options.spacing is not None or self.spacing == (None, None, None):
            return options.spacing_or((1.0, 1.0, 1.0)), False
        x, y, z = self.spacing
        across = x or y or z or 1.0
        return options.spacing_or((x or across, y or across, z or across)), z is None and slices > 1


def ome_root(xml: str, path: Path) -> ElementTree.Element:
    """The root of OME-XML that is safe to be read by a library.

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
    """Facts of image number ``series`` of ``count``; none where the XML has another number of images."""
    images = [p for image in root if _tag(image) == "Image" for p in image if _tag(p) == "Pixels"]
    if len(images) != count:
        return Facts()
    pixels = images[series]
    numbers = [_positive(pixels.get(f"PhysicalSize{axis}")) for axis in "XYZ"]
    units = [pixels.get(f"PhysicalSize{axis}Unit", "µm") for axis in "XYZ"]
    names, colors = [], []
    for channel in (c for c in pixels if _tag(c) == "Channel"):
        name, samples = channel.get("Name", ""), int(channel.get("SamplesPerPixel", 1))
        names += [name] if samples == 1 else [f"{name}:{k}" for k in range(min(samples, 1000))]
        colors += [_color(channel.get("Color"))] * min(samples, 1000)
    return replace(_micrometres(numbers, units), channels=names if any(names) else [], colors=colors)


def _color(text: str | None) -> tuple[float, float, float] | None:
    """RGB of OME's signed 32-bit RGBA; None for none, and for black, which shows nothing."""
    if text is None or not re.fullmatch(r"-?\d{1,10}", text):
        return None
    value = int(text) & 0xFFFFFFFF
    red, green, blue = value >> 24, value >> 16 & 255, value >> 8 & 255
    return (red / 255, green / 255, blue / 255) if red + green + blue else None


def imagej_facts(told: dict[str, Any], resolution: tuple[float, float], unit: int) -> Facts:
    """Facts of ImageJ's description.

    Args:
        told: its entries.
        resolution: pixels per unit along x and y (tags 282 and 283).
        unit: tag 296; 1 where the resolution is in the description's own unit.
    """
    images = math.prod(int(told.get(key, 1)) for key in ("channels", "slices", "frames"))
    name = str(told.get("unit", "")).strip()
    units = [name, str(told.get("yunit", name)), str(told.get("zunit", name))]
    depth = _positive(told.get("spacing"))
    if not name and unit != 1:  # dots per inch of a printer
        return Facts((None, None, depth), images=images)
    across = [1 / n if _positive(n) else None for n in resolution]
    if not name and depth is None and across == [1.0, 1.0]:
        return Facts(images=images)
    return replace(_micrometres([*across, depth], units), images=images)


def _positive(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _micrometres(numbers: list[float | None], units: list[str]) -> Facts:
    """Spacing in micrometres; as it is where its one unit is none of length."""
    plain = [_unit(unit) for unit in units]
    lengths = [metres(unit) for unit in plain]
    told = {u: m for u, m, n in zip(plain, lengths, numbers, strict=True) if n is not None}
    if None in told.values():
        return Facts(triple(numbers), units=", ".join(told) if len(told) > 1 else "")
    return Facts(
        triple(
            None if n is None else float(f"{n * float(m or 1) / MICROMETRE:.15g}")
            for n, m in zip(numbers, lengths, strict=True)
        ),
        length="um" if told else "",
    )


def _unit(text: str) -> str:
    text = re.sub(r"\\u00b5", "µ", text.strip(), flags=re.I).replace("\u03bc", "µ")
    return _OTHER_NAMES.get(text, text)
