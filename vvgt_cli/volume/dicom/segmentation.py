"""DICOM segmentations (SEG and Label Map Segmentation; PS3.3, A.51, A.92 and C.8.20), read by highdicom as label maps.

A file holds bits a segment and slice, or numbers of segments; frames without any may be left out of it. RTSTRUCT is
another thing, contours, and not read: no library that is kept fills them.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, SeveralComponents, UsageError
from vvgt_cli.volume.reading import ReadOptions, Volume, check_memory, library_errors, listed, need, placed, triple
from vvgt_cli.volume.segments import Segment, segments_in

CLASSES = ("1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7")  # Segmentation, Label Map Segmentation
EXTRA, WHAT = "dicom-seg", "a DICOM segmentation"


def is_segmentation(header: Any) -> bool:
    """Tell whether a DICOM header is that of a segmentation."""
    return str(header.get("SOPClassUID", "")) in CLASSES


def is_segmentation_file(source: str) -> bool:
    """Tell whether a path is a file with a segmentation; False where pydicom is not installed."""
    path = Path(source)
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            if file.read(132)[128:] != b"DICM":
                return False
        import pydicom

        return is_segmentation(pydicom.dcmread(path, stop_before_pixels=True, specific_tags=["SOPClassUID"]))
    except Exception:  # whatever it is, who reads it says so
        return False


def names_of(header: Any) -> str:
    """List the segments of a header, for a message."""
    names = [str(segment.get("SegmentLabel", "?")) for segment in header.get("SegmentSequence", [])]
    return f"{len(names)} segments ({listed(names, ', ')})"


def segments(source: str) -> list[Segment]:
    """Read number, label and colour (recommended CIELab, or the palette's) of every segment, or raise DataError."""
    pydicom, highdicom = need("pydicom", EXTRA, source, WHAT), need("highdicom", EXTRA, source, WHAT)
    with library_errors(source, WHAT):
        header = pydicom.dcmread(source, stop_before_pixels=True)
        if not is_segmentation(header):
            raise DataError(f"{source}: DICOM of modality {header.get('Modality', '?')}; expected a segmentation (SEG)")
        kept = []
        for one in header.get("SegmentSequence", []):
            number, lab = int(one.SegmentNumber), one.get("RecommendedDisplayCIELabValue")
            color: tuple[float, float, float] | None
            if lab is not None:
                red, green, blue = highdicom.color.CIELabColor.from_dicom_value(lab).to_rgb(clip=True)
                color = (red / 255, green / 255, blue / 255)
            else:
                color = _palette_color(header, number)
            kept.append(Segment(number, str(one.get("SegmentLabel", f"segment {number}")), color, _terms(one)))
    return kept


def _terms(segment: Any) -> tuple[tuple[str, str, str], ...]:
    """Return `Segment.terms` of an item of SegmentSequence (PS3.3, C.8.20.4)."""

    def first(item: Any, keyword: str) -> Any:
        return next(iter(item.get(f"{keyword}Sequence") or ()), {})

    kind, region = first(segment, "SegmentedPropertyTypeCode"), first(segment, "AnatomicRegion")
    items = (
        first(segment, "SegmentedPropertyCategoryCode"), kind, first(kind, "SegmentedPropertyTypeModifierCode"),
        region, first(region, "AnatomicRegionModifier"),
    )  # fmt: skip
    fields = ("CodingSchemeDesignator", "CodeValue", "CodeMeaning")
    return tuple(triple(str(item.get(field, "")) for field in fields) for item in items)


def _palette_color(header: Any, number: int) -> tuple[float, float, float] | None:
    """Return the RGB of a segment by the palette (PS3.3, C.7.6.3.1.5 and 6); None without one."""
    if header.get("PhotometricInterpretation") != "PALETTE COLOR":
        return None
    rgb = []
    for name in ("Red", "Green", "Blue"):
        count, first, bits = header[f"{name}PaletteColorLookupTableDescriptor"].value
        kind = np.dtype("u1" if bits == 8 else "<u2")
        entries = np.frombuffer(header[f"{name}PaletteColorLookupTableData"].value, kind)[: count or 1 << 16]
        rgb.append(float(entries[min(max(number - first, 0), len(entries) - 1)]) / np.iinfo(kind).max)
    return rgb[0], rgb[1], rgb[2]


def read_segmentation(path: Path, options: ReadOptions) -> Volume:
    """Read a file as a label map, (slices, rows, columns) numbers of segments; positions are LPS.

    Raises:
        DataError: highdicom is not installed, fractions in place of segments, planes that make no even stack.
        SeveralComponents: segments overlap and none was chosen (``component`` counts them from 0).
        UsageError: no such segment.
    """
    source = str(path)
    highdicom = need("highdicom", EXTRA, source, WHAT)
    read = highdicom.seg.segread(path)
    if read.segmentation_type == highdicom.seg.SegmentationTypeValues.FRACTIONAL:
        raise DataError(
            f"{source}: {WHAT} of fractions; expected one of bits or of labels: export it as BINARY or LABELMAP"
        )
    grid = read.get_volume_geometry()
    if grid is None:
        raise DataError(f"{source}: planes that are no even stack; expected a segmentation of a volume")
    numbers = sorted(number for number in read.segment_numbers if number)
    check_memory(2 * math.prod(grid.spatial_shape), source)
    component, chosen = options.component, numbers
    if component is not None:
        if component not in range(len(numbers)):
            raise UsageError(f"{source}: no segment {component}; expected --component 0 to {len(numbers) - 1}")
        chosen = [numbers[int(component)]]
    try:
        combined = read.get_volume(segment_numbers=chosen, combine_segments=True)
    except RuntimeError as error:
        if "overlap" not in str(error):
            raise
        raise SeveralComponents(
            f"{source}: {len(numbers)} segments that overlap; expected one: choose it with --component 0 to "
            f"{len(numbers) - 1}",
            len(numbers),
        ) from None
    steps = combined.affine[:3, 2::-1].T  # of column, row and slice
    own = segments_in(lambda: [one for one in segments(source) if one.number in chosen], source)
    return placed(
        np.ascontiguousarray(combined.array), steps, combined.affine[:3, 3], options,
        path.resolve().name.removesuffix(".dcm"), space="LPS", reference=str(read.FrameOfReferenceUID), segments=own,
    )  # fmt: skip
