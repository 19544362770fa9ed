"""Tables of labels: 3D Slicer's, ITK-SNAP's .label, FreeSurfer's LUT, CSV and TSV, .seg.nrrd, DICOM SEG, and JSON.

- 3D Slicer (.ctbl, .txt), `number name R G B A` with 0 to 255 each.
- FreeSurfer (FreeSurferColorLUT.txt): the same, but A is transparency; 0 is opaque. `_is_opacity` tells them apart.
- CSV and TSV: a row of names of columns (`COLUMNS`), as 3D Slicer 5.9, FastSurfer and BIDS (dseg.tsv) write them.
- ITK-SNAP: `number R G B A VIS MSH "name"`, colours 0 to 255, A in [0, 1], VIS 0 or 1.
- .seg.nrrd: `Segment0_LabelValue:=1`, `Segment0_Name:=`, `Segment0_Color:=0.5 0.4 0.1`.
- DICOM SEG: segment numbers, labels and recommended CIELab colours, else distinct ones.
- JSON: `{"1": {"name": "liver", "color": [0.6, 0.3, 0.2], "opacity": 0.8}}`; a colour may be "#aabbcc".

Groups of labels come from coded terms or, in JSON, from "parents" (`vvgt_cli.look.terms`).
"""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.look.labels import AUTO, MAX_NAME, SOLID, Label, LabelTable, clean_name, distinct
from vvgt_cli.look.readers.fields import json_of, number, rgb, text_of
from vvgt_cli.look.terms import Codes, codes_of, codes_of_row, codes_of_tags, parents_of
from vvgt_cli.volume.dicom.segmentation import is_segmentation_file
from vvgt_cli.volume.dicom.segmentation import segments as dicom_segments

SEGMENTATION = ".seg.nrrd"  # a label map whose header is its table
SEPARATED = (".csv", ".tsv")
TABLES, TEXTS = (".ctbl", ".label", *SEPARATED), (".txt", ".lut", ".json")  # endings of tables, and of possible ones
COLUMNS = {  # names of columns in lower case; the first whose cell is not empty is used
    "number": ("labelvalue", "index", "id", "value", "no.", "label"),
    "name": ("name", "labelname", "label", "label name"),
    "r": ("color_r", "r", "red"),
    "g": ("color_g", "g", "green"),
    "b": ("color_b", "b", "blue"),
    "a": ("color_a", "a", "alpha"),
    "color": ("color", "colour"),
}
NAMELESS = ("index", "name", "r", "g", "b", "a")
MAX_NUMBER = 2**31  # of a label
HEADER = 2**20  # bytes of a .seg.nrrd that are looked at
EXPECTED = (
    "expected a table of labels: 3D Slicer (.ctbl), ITK-SNAP (.label), FreeSurfer (number name R G B A), .csv or .tsv "
    "(index, name, R, G, B or color), .seg.nrrd, "
    'DICOM SEG, or JSON {"1": {"name": ..., "color": [r, g, b], "opacity": a}}'
)
_INTEGER, _DECIMAL = re.compile(r"-?[0-9]{1,10}"), re.compile(r"-?[0-9]{1,10}(\.[0-9]{1,20})?")
# place for errors, label, name, colour in [0, 1], A / 255 or None, whether it is switched on, codes
Row = tuple[str, int, str, Any, float | None, bool, Codes]
_SNAP = re.compile(
    r'(-?[0-9]{1,10})\s+([0-9]{1,3})\s+([0-9]{1,3})\s+([0-9]{1,3})\s+([0-9]{1,3}(?:\.[0-9]*)?)\s+([01])\s+([01])\s+"(.*)"'
)


def holds_table(source: str | None) -> bool:
    """Return whether a file is a label map with its own table: a .seg.nrrd, or a DICOM segmentation."""
    return source is not None and (source.endswith(SEGMENTATION) or is_segmentation_file(source))


def is_table(path: Path) -> bool:
    """Return whether a file holds a table of labels and nothing else, by its name and first line."""
    suffix = path.suffix.lower()
    if suffix not in TEXTS:
        return suffix in TABLES
    try:
        text = text_of(path, "a table of labels")
        if text.lstrip().startswith("{"):
            parsed = json_of(text, path, "a table of labels")
            return bool(parsed) and all(_INTEGER.fullmatch(key) and isinstance(v, dict) for key, v in parsed.items())
    except DataError:
        return False
    rows = (line.strip() for line in text.splitlines())
    first = next((row for row in rows if row and not row.startswith("#")), "")
    return bool(_SNAP.fullmatch(first) or _plain(first))


def table_for(labels: str | LabelTable, numbers: Sequence[int], where: str) -> LabelTable:
    """Return the table of a volume's labels, ascending ``numbers``: read from a file, or ``auto``, or one that is read.

    Raises:
        DataError: the table does not match the labels; see `read_labels`, too.
        UsageError: no such file.
    """
    if labels == AUTO:
        return distinct(numbers)
    table = read_labels(labels) if isinstance(labels, str) else labels
    if table is not labels:
        table.warn_hidden(numbers, where)
    return table.restricted_to(numbers, where)


def read_labels(source: str) -> LabelTable:
    """Read the table in a file.

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
        found = (_separated if path.suffix.lower() in SEPARATED else _lines)(text, path)
    return _table(found, str(path))


def segments_of(source: str, layer: int) -> LabelTable:
    """Read the segments of one layer of an overlapping .seg.nrrd, or one segment of a DICOM SEG (a layer each).

    The label numbers are those of the layer.

    Raises:
        DataError: no segment in this layer, or faulty ones.
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
        raise DataError(f"{what}: no labels; {EXPECTED}")
    return LabelTable(Path(what).name, tuple(sorted(found, key=lambda label: label.number)))


def _lines(text: str, path: Path) -> list[Label]:
    """Read labels from a table of lines; those that begin with # are skipped."""
    rows: list[Row] = []
    opacity = path.suffix.lower() == ".ctbl"
    for n, line in enumerate(map(str.strip, text.splitlines()), 1):
        if not line or line.startswith("#"):
            continue
        here = f"{path}: line {n}"
        if snap := _SNAP.fullmatch(line):
            color, opacity = [int(v) / 255 for v in snap.groups()[1:4]], True
            rows.append((here, int(snap[1]), snap[8], color, float(snap[5]), snap[6] == "1", ()))
        elif plain := _plain(line):
            value, name, numbers, last = plain
            rows.append((here, int(value), name, [float(v) / 255 for v in numbers], last, True, ()))
        else:
            raise DataError(f"{here}: {line[:60]!r}; {EXPECTED}")
    return _labels(rows, path, text, opacity)


def _separated(text: str, path: Path) -> list[Label]:
    """Read labels from a CSV or TSV table, with the columns `NAMELESS` without a row of names, or raise DataError."""
    lines = [line for line in text.splitlines(keepends=True) if line.strip() and not line.startswith("#")] or [""]
    comma, rows, head = max("\t,;", key=lines[0].count), list[Row](), list[str]()
    try:
        head = [cell.strip().lower() for cell in next(csv.reader(lines, delimiter=comma), [])]
        names, body = (NAMELESS, lines) if _INTEGER.fullmatch("".join(head[:1])) else (head, lines[1:])
        for n, cells in enumerate(csv.DictReader(body, names, delimiter=comma), 1):
            texts = {key: " ".join(cell.splitlines()).strip() for key, cell in cells.items() if isinstance(cell, str)}
            found = {key: next((texts[k] for k in keys if texts.get(k)), "") for key, keys in COLUMNS.items()}
            value, color = found["number"].removesuffix(".0"), [found[key] for key in "rgb" if found[key]]
            numbers = all(_DECIMAL.fullmatch(found[key] or "0") for key in "rgba")
            if not _INTEGER.fullmatch(value) or len(color) in (1, 2) or not numbers:
                raise DataError(f"{path}: row {n}: label {value[:20]!r}, colour {', '.join(color)[:40]}; {EXPECTED}")
            shown = [float(v) / 255 for v in color] or _hex(found["color"])
            last = float(found["a"]) / 255 if found["a"] else None
            rows.append((f"{path}: row {n}", int(value), found["name"], shown, last, True, codes_of_row(texts)))
    except csv.Error as error:
        raise DataError(f"{path}: {error}; {EXPECTED}") from None
    return _labels(rows, path, text, "color_a" in head)


def _labels(rows: list[Row], path: Path, text: str, opacity: bool) -> list[Label]:
    """Make labels from rows, with distinct colours for those without; ``opacity``: column A is known to be opacity."""
    opacity = opacity or _is_opacity([row[4] for row in rows if row[1] and row[4] is not None], path, text)
    channels = [v * 255 for row in rows for v in row[3] or ()]
    if channels and max(channels) <= 1 and any(v % 1 for v in channels):
        raise DataError(f"{path}: no colour above 1; expected red, green and blue from 0 to 255")
    colors: dict[int, Any] = {}
    if blank := [row[1] for row in rows if row[3] is None]:
        warnings.warn(f"{path.name}: {len(blank)} labels have no colour; given distinct ones", stacklevel=2)
        colors = {label.number: list(label.color) for label in distinct(sorted(set(blank))).labels}
    found = []
    for here, value, name, color, last, shown, codes in rows:
        alpha = 0.0 if not value else SOLID if last is None else last if opacity else 1 - last
        found.append(_label(here, value, name, color or colors[value], alpha, shown, codes))
    return found


def _is_opacity(alphas: list[float], path: Path, text: str) -> bool:
    """Return whether column A of a table is opacity (3D Slicer), not transparency (FreeSurfer).

    FreeSurfer's tables have 0 throughout and 3D Slicer's 255, or comments that name the program. ``alphas`` is A / 255
    of every label but 0.
    """
    comments = " ".join(line for line in text.splitlines() if line.startswith("#")).lower()
    if not any(alphas):
        return False
    if min(alphas) >= 1 or "color table file" in comments or "slicer" in comments:
        return True
    if "freesurfer" in comments or "label name" in comments:
        return False
    opacity = 2 * sum(a > 0.5 for a in alphas) > len(alphas)
    slicer = "opacity, as in 3D Slicer; for transparency begin the table with '#No. Label Name: R G B A'"
    freesurfer = "transparency, as in FreeSurfer; for opacity let its name end in .ctbl (or call A Color_A in a .csv)"
    warnings.warn(f"{path.name}: column A is read as {slicer if opacity else freesurfer}", stacklevel=2)
    return opacity


def _hex(text: str) -> list[float] | None:
    """Parse a colour ``#rrggbb``; return None for other texts."""
    digits = text.removeprefix("#")
    return [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)] if re.fullmatch("[0-9a-fA-F]{6}", digits) else None


def _plain(line: str) -> tuple[str, str, Sequence[str], float | None] | None:
    """Parse ``number name R G B [A]`` into label, name, (R, G, B) and A / 255; return None for other lines.

    If a name ends in numbers, the last four are R, G, B and A. The line is split into words because a regular
    expression would take cubic time on a line of blanks.
    """
    words = line.split()
    last = next((k for k, word in enumerate(reversed(words)) if not _DECIMAL.fullmatch(word)), len(words))
    many = min(last, len(words) - 2, 4)  # of the numbers at the end; label and name come before
    if many < 3 or not _INTEGER.fullmatch(words[0]):
        return None
    name = line.split(None, 1)[1].rsplit(None, many)[0].strip('"')
    return words[0], name, words[-many:][:3], float(words[-1]) / 255 if many == 4 else None


def _segments(header: str, what: str, layer: int | None = None) -> list[Label]:
    """Read the segments in a NRRD header, of one layer or of all."""
    segments: dict[str, dict[str, str]] = {}
    for index, key, value in re.findall(r"^Segment([0-9]{1,9})_(\w+):=(.*)$", header, re.M):
        segments.setdefault(index, {})[key] = value.strip()
    found = []
    for index, segment in segments.items():
        if layer is not None and segment.get("Layer", "0") != str(layer):
            continue
        color, label = segment.get("Color", "").split(), segment.get("LabelValue", str(int(index) + 1))
        if not re.fullmatch(r"\d{1,10}", label) or not all(_is_number(c) for c in color):
            raise DataError(f"{what}: segment {index}: label {label!r}, colour {color}; expected numbers")
        name = segment.get("Name", segment.get("ID", ""))
        codes = codes_of_tags(segment.get("Tags", ""))
        found.append(_label(f"{what}: segment {index}", int(label), name, list(map(float, color)), SOLID, codes=codes))
    return found


def _dicom(source: str) -> list[Label]:
    """Read the segments of a DICOM segmentation; 0 is the background."""
    found = dicom_segments(source)
    colors = {label.number: label.color for label in distinct(sorted({one.number for one in found})).labels}
    labels = []
    for one in found:
        color, opacity = list(one.color or colors[one.number]), SOLID if one.number else 0.0
        labels.append(_label(source, one.number, one.name, color, opacity, codes=codes_of(one.terms)))
    return labels


def table_of(parsed: Any, what: str) -> LabelTable:
    """Return the table in a parsed JSON file, or raise DataError."""
    if not isinstance(parsed, dict):
        raise DataError(f"{what}: JSON that is no object; {EXPECTED}")
    found = []
    for key, entry in parsed.items():
        if not re.fullmatch(r"-?\d{1,10}", key) or not isinstance(entry, dict):
            raise DataError(f"{what}: {key[:40]!r}; {EXPECTED}")
        color = entry.get("color")
        color = _hex(color) or color if isinstance(color, str) else color
        opacity = number(f"{what}: label {key}: opacity", entry.get("opacity", SOLID if int(key) else 0.0))
        name = str(entry.get("name", ""))
        groups, shown = entry.get("parents", []), entry.get("visible", True)
        groups = [groups] if isinstance(groups, str) else groups
        if not isinstance(groups, list) or not all(isinstance(one, str) and one for one in groups):
            raise DataError(f"{what}: label {key}: parents {str(groups)[:40]!r}; expected names of groups: [..., ...]")
        if not isinstance(shown, bool):
            raise DataError(f"{what}: label {key}: visible {str(shown)[:40]!r}; expected true or false")
        label = _label(f"{what}: label {key}", int(key), name, color, opacity, shown)
        found.append(replace(label, parents=tuple(one[:MAX_NAME] for one in groups)) if groups else label)
    return _table(found, what)


def _is_number(text: str) -> bool:
    return re.fullmatch(r"\d+(\.\d*)?([eE][+-]?\d+)?", text) is not None


def _label(
    what: str, value: int, name: str, color: Any, opacity: float, shown: bool = True, codes: Codes = ()
) -> Label:
    """Make a label from checked values."""
    if not 0 <= opacity <= 1:
        raise DataError(f"{what}: opacity {opacity:g}; expected 0 to 1")
    if abs(value) > MAX_NUMBER:
        raise DataError(f"{what}: label {value}; expected a 32-bit number")
    name = clean_name(what, value, name)
    parents = parents_of(name, codes)
    seen, hidden = (opacity, 0.0) if shown else (0.0, opacity)
    return Label(value, name, rgb(f"{what}: colour", color), seen, parents, codes, hidden)
