"""Tables of labels: 3D Slicer's .ctbl, ITK-SNAP's .label, FreeSurfer's LUT, .seg.nrrd, DICOM SEG, and JSON.

- 3D Slicer, `number name R G B A` with 0 to 255 each.
- FreeSurfer (FreeSurferColorLUT.txt): the same, but A is transparency; 0 is opaque.
- ITK-SNAP: `number R G B A VIS MSH "name"`, colours 0 to 255, A in [0, 1], VIS 0 or 1.
- .seg.nrrd: `Segment0_LabelValue:=1`, `Segment0_Name:=`, `Segment0_Color:=0.5 0.4 0.1`.
- DICOM SEG: segment numbers, labels and recommended CIELab colours, else distinct ones.
- JSON: `{"1": {"name": "liver", "color": [0.6, 0.3, 0.2], "opacity": 0.8}}`; a colour may be "#aabbcc".
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.look.labels import SOLID, Label, LabelTable, distinct
from vvgt_cli.look.readers.fields import json_of, number, rgb, text_of
from vvgt_cli.volume.dicom_seg import is_segmentation_file
from vvgt_cli.volume.dicom_seg import segments as dicom_segments

SEGMENTATION = ".seg.nrrd"  # a label map whose header is its table
TABLES, TEXTS = (".ctbl", ".label"), (".txt", ".lut", ".json")  # endings of tables, and of what may be one
MOST = 2**31  # of a label's number
HEADER = 2**20  # bytes of a .seg.nrrd that are looked at
EXPECTED = (
    "expected a table of labels: 3D Slicer (.ctbl), ITK-SNAP (.label), FreeSurfer (number name R G B A), .seg.nrrd, "
    'DICOM SEG, or JSON {"1": {"name": ..., "color": [r, g, b], "opacity": a}}'
)
_WHOLE = re.compile(r"-?[0-9]{1,10}")
_SNAP = re.compile(
    r'(-?[0-9]{1,10})\s+([0-9]{1,3})\s+([0-9]{1,3})\s+([0-9]{1,3})\s+([0-9]{1,3}(?:\.[0-9]*)?)\s+([01])\s+([01])\s+"(.*)"'
)


def holds_table(source: str | None) -> bool:
    """Whether a file is a label map that brings its own table: a .seg.nrrd, or a DICOM segmentation."""
    return source is not None and (source.endswith(SEGMENTATION) or is_segmentation_file(source))


def is_table(path: Path) -> bool:
    """Whether a file holds a table of labels and nothing else, by its name and the way that it begins."""
    suffix = path.suffix.lower()
    if suffix not in TEXTS:
        return suffix in TABLES
    try:
        text = text_of(path, "a table of labels")
        if text.lstrip().startswith("{"):
            parsed = json_of(text, path, "a table of labels")
            return bool(parsed) and all(_WHOLE.fullmatch(key) and isinstance(v, dict) for key, v in parsed.items())
    except DataError:
        return False
    rows = (line.strip() for line in text.splitlines())
    first = next((row for row in rows if row and not row.startswith("#")), "")
    return bool(_SNAP.fullmatch(first) or _plain(first))


def read_labels(source: str) -> LabelTable:
    """The table in a file.

    Raises:
        UsageError: no such file.
        DataError: not a table of labels, or a faulty one.
    """
    path = Path(source)
    if not path.is_file():
        raise UsageError(f"--labels {source}: no such file; {EXPECTED}, or auto, or none")
    with path.open("rb") as stream:
        head = stream.read(HEADER)
    if is_segmentation_file(source):
        return _table(_dicom(source), source)
    if not head.startswith(b"NRRD") and (text := text_of(path, "a table of labels")).lstrip().startswith(("{", "[")):
        return table_of(json_of(text, path, "a table of labels"), str(path))
    if head.startswith(b"NRRD"):
        found = _segments(head.partition(b"\n\n")[0].decode("utf-8", "replace"), str(path))
    else:
        found = _lines(text, path)
    return _table(found, str(path))


def segments_of(source: str, layer: int) -> LabelTable:
    """The segments of one layer of a .seg.nrrd in which segments overlap, or that of a DICOM SEG (a layer each).

    Numbers of labels are those of the layer.

    Raises:
        DataError: none in this layer, or faulty ones.
    """
    if is_segmentation_file(source):
        own = sorted((label for label in _dicom(source) if label.number), key=lambda label: label.number)
        return replace(_table(own[layer : layer + 1], source), name=f"{Path(source).name} segment {layer}")
    with Path(source).open("rb") as stream:
        head = stream.read(HEADER).partition(b"\n\n")[0].decode("utf-8", "replace")
    found = _table(_segments(head, source, layer), f"{source}: layer {layer}")
    return replace(found, name=f"{Path(source).name} layer {layer}")


def _table(found: list[Label], what: str) -> LabelTable:
    if not found:
        raise DataError(f"{what}: no label in it; {EXPECTED}")
    return LabelTable(Path(what).name, tuple(sorted(found, key=lambda label: label.number)))


def _lines(text: str, path: Path) -> list[Label]:
    """Of a table of lines; those that begin with # are left out."""
    found = []
    for n, line in enumerate(map(str.strip, text.splitlines()), 1):
        if not line or line.startswith("#"):
            continue
        color: Sequence[str]
        if snap := _SNAP.fullmatch(line):
            value, color, name, alpha = snap[1], snap.groups()[1:4], snap[8], float(snap[5]) * int(snap[6])
        elif plain := _plain(line):
            value, name, color, last = plain
            alpha = 1.0 if last is None else last if path.suffix.lower() == ".ctbl" else 1 - last
        else:
            raise DataError(f"{path}: line {n}: {line[:60]!r}; {EXPECTED}")
        alpha = alpha if int(value) else 0.0
        found.append(_label(f"{path}: line {n}", int(value), name, [int(v) / 255 for v in color], alpha))
    return found


def _plain(line: str) -> tuple[str, str, Sequence[str], float | None] | None:
    """Label, name, red, green and blue, and A over 255 of ``number name R G B [A]``; None where it is no such line.

    Of names that end in numbers the last four are R, G, B and A. By words: an expression over a line of blanks would
    take the third power of its length.
    """
    words = line.split()
    last = next((k for k, word in enumerate(reversed(words)) if not _WHOLE.fullmatch(word)), len(words))
    many = min(last, len(words) - 2, 4)  # of the numbers at the end; label and name come before
    if many < 3 or not _WHOLE.fullmatch(words[0]):
        return None
    name = line.split(None, 1)[1].rsplit(None, many)[0].strip('"')
    return words[0], name, words[-many:][:3], int(words[-1]) / 255 if many == 4 else None


def _segments(header: str, what: str, layer: int | None = None) -> list[Label]:
    """Of the segments that a NRRD header names, in one layer or in all."""
    parts: dict[str, dict[str, str]] = {}
    for index, key, value in re.findall(r"^Segment([0-9]{1,9})_(\w+):=(.*)$", header, re.M):
        parts.setdefault(index, {})[key] = value.strip()
    found = []
    for index, part in parts.items():
        if layer is not None and part.get("Layer", "0") != str(layer):
            continue
        color, label = part.get("Color", "").split(), part.get("LabelValue", str(int(index) + 1))
        if not re.fullmatch(r"\d{1,10}", label) or not all(_is_number(c) for c in color):
            raise DataError(f"{what}: segment {index}: label {label!r}, colour {color}; expected numbers")
        name = part.get("Name", part.get("ID", f"label {label}"))
        found.append(_label(f"{what}: segment {index}", int(label), name, [float(c) for c in color], SOLID))
    return found


def _dicom(source: str) -> list[Label]:
    """Of a DICOM segmentation; 0 is the background."""
    found = dicom_segments(source)
    colors = {label.number: label.color for label in distinct(sorted({one.number for one in found})).labels}
    return [Label(one.number, one.name, one.color or colors[one.number], SOLID if one.number else 0.0) for one in found]


def table_of(parsed: Any, what: str) -> LabelTable:
    """The table that a parsed JSON file holds.

    Raises:
        DataError: none, or a faulty one.
    """
    if not isinstance(parsed, dict):
        raise DataError(f"{what}: JSON that is no object; {EXPECTED}")
    found = []
    for key, entry in parsed.items():
        if not re.fullmatch(r"-?\d{1,10}", key) or not isinstance(entry, dict):
            raise DataError(f"{what}: {key[:40]!r}; {EXPECTED}")
        color = entry.get("color")
        if isinstance(color, str) and re.fullmatch(r"#[0-9a-fA-F]{6}", color):
            color = [int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        opacity = number(f"{what}: label {key}: opacity", entry.get("opacity", SOLID if int(key) else 0.0))
        name = str(entry.get("name", f"label {key}"))
        found.append(_label(f"{what}: label {key}", int(key), name, color, opacity))
    return _table(found, what)


def _is_number(text: str) -> bool:
    return re.fullmatch(r"\d+(\.\d*)?([eE][+-]?\d+)?", text) is not None


def _label(what: str, value: int, name: str, color: Any, opacity: float) -> Label:
    """A label of checked parts."""
    if not 0 <= opacity <= 1:
        raise DataError(f"{what}: opacity {opacity:g}; expected 0 to 1")
    if abs(value) > MOST:
        raise DataError(f"{what}: label {value}; expected a 32-bit number")
    return Label(value, name, rgb(f"{what}: colour", color), opacity)
