"""Tables of labels: 3D Slicer's, ITK-SNAP's .label, FreeSurfer's LUT, CSV and TSV, .seg.nrrd, DICOM SEG, and JSON.

- 3D Slicer (.ctbl, .txt), `number name R G B A` with 0 to 255 each.
- FreeSurfer (FreeSurferColorLUT.txt): the same, but A is transparency; 0 is opaque. `_is_opacity` tells them apart.
- CSV and TSV: a row of names of columns (`COLUMNS`), as 3D Slicer 5.9, FastSurfer and BIDS (dseg.tsv) write them.
- ITK-SNAP: `number R G B A VIS MSH "name"`, colours 0 to 255, A in [0, 1], VIS 0 or 1.
- .seg.nrrd: `Segment0_LabelValue:=1`, `Segment0_Name:=`, `Segment0_Color:=0.5 0.4 0.1`.
- DICOM SEG: segment numbers, labels and recommended CIELab colours.
- JSON: `{"1": {"name": "liver", "color": [0.6, 0.3, 0.2], "opacity": 0.8}}`; a colour may be "#aabbcc", or from 0 to
  255, with opacity as a fourth number. A list of such objects, with the number under a key of `COLUMNS`. Names alone:
  `{"1": "liver"}` or `{"liver": 1}`, also under "labels" (dataset.json of nnU-Net, whose regions are lists of numbers,
  and of the Medical Segmentation Decathlon) or by name in a map of such maps (TotalSegmentator).
- ParaView: categorical presets with `IndexedColors` and `Annotations` [value, name, ...].

Labels without a colour get distinct ones. Groups of labels come from coded terms or, in JSON, from "parents" and
regions (`vvgt_cli.look.labels`).
"""

from __future__ import annotations

import csv
import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.look.labels import (
    AUTO,
    MAX_NAME,
    SOLID,
    Codes,
    Label,
    LabelTable,
    clean_name,
    codes_of,
    codes_of_row,
    distinct,
    palette_color,
    parents_of,
)
from vvgt_cli.look.readers import lut, minimal, slicer
from vvgt_cli.look.readers.fields import json_of, number, rgb, table, text_of
from vvgt_cli.look.readers.paraview import choose
from vvgt_cli.volume.components import listed
from vvgt_cli.volume.dicom import segmentation as dicom
from vvgt_cli.volume.dicom.segmentation import is_segmentation_file
from vvgt_cli.volume.headers import MARK
from vvgt_cli.volume.medical import nrrd
from vvgt_cli.volume.segments import MAX_NUMBER, Segment

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
    "color": ("color", "colour", "rgb", "rgba", "rgb_triplet"),
}
LISTS = ("labels", "categories")  # keys of a JSON object under which labels lie
NAMELESS = ("index", "name", "r", "g", "b", "a")
EXPECTED = (
    "expected a table of labels: 3D Slicer (.ctbl), ITK-SNAP (.label), FreeSurfer (number name R G B A), .csv or .tsv "
    "(index, name, R, G, B or color), .seg.nrrd, "
    'DICOM SEG, or JSON {"1": {"name": ..., "color": [r, g, b], "opacity": a}}, {"1": name} or {name: 1}'
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
    if suffix not in (*TEXTS, *SEPARATED):
        return suffix in TABLES
    try:
        text = text_of(path, "a table of labels")
        if text.lstrip().startswith(("{", "[")):
            parsed = json_of(text, path)
            function = '"RGBPoints"' in text or any(one.matches(parsed) for one in (slicer, minimal, lut))
            alone = isinstance(parsed, dict) and [*map(type, parsed.values())] == [int]  # {"a": 1} may be anything
            return not function and not alone and bool(table_of(parsed, str(path)))
    except DataError:
        return False
    rows = (line.strip() for line in text.splitlines())
    first = next((row for row in rows if row and not row.startswith("#")), "")
    if suffix in SEPARATED:
        head = [cell.strip().lower() for cell in re.split("[\t,;]", first)]
        numbers, rest = (
            set(COLUMNS["number"]) & set(head),
            {name for key in COLUMNS for name in COLUMNS[key]} & set(head),
        )
        named = len(head) > 1 and not _DECIMAL.fullmatch(head[1])
        return bool(numbers and len(rest) > 1) or (named and bool(_INTEGER.fullmatch(head[0])))
    return bool(_SNAP.fullmatch(first) or _plain(first))


def table_for(
    labels: str | LabelTable, numbers: Sequence[int], where: str, segments: Sequence[Segment] | None = None
) -> LabelTable:
    """Return the table of a volume's labels, ascending ``numbers``: read from a file, or one that is read, or ``auto``.

    ``auto`` takes the names and colours of ``segments``, and distinct colours for what they leave out.

    Raises:
        DataError: the table does not match the labels; see `read_labels`, too.
        UsageError: no such file.
    """
    if labels == AUTO:
        own = {one.number: one for one in labels_of(segments or (), where)}
        auto = distinct([n for n in numbers if n or not own])
        if own and (missing := [n for n in numbers if n and n not in own]):
            text = f"{where}: its header does not name labels {listed(missing, ', ')}; they get distinct colours"
            warnings.warn(text, stacklevel=2)
        return replace(auto, name=where if own else auto.name, labels=tuple(own.get(e.number, e) for e in auto.labels))
    given = read_labels(labels) if isinstance(labels, str) else labels
    if given is not labels:
        given.warn_hidden(numbers, where)
    return given.restricted_to(numbers, where)


def read_labels(source: str) -> LabelTable:
    """Read the table in a file.

    Raises:
        UsageError: no such file.
        DataError: not a table of labels, or a faulty one.
    """
    path, pick = Path(source), ""
    if not path.is_file() and "#" in source:
        source, _, pick = source.rpartition("#")
        path = Path(source)
    if not path.is_file():
        raise UsageError(f"--labels {source}: no such file; {EXPECTED}, or auto, or none")
    with path.open("rb") as stream:
        head = stream.read(8)
    if is_segmentation_file(source):
        return _table(labels_of(dicom.segments(source), source), source)
    if head.removeprefix(MARK).startswith(b"NRRD"):
        return _table(labels_of(nrrd.segments(nrrd.read_header(path)[0]), source), source)
    if (text := text_of(path, "a table of labels")).lstrip().startswith(("{", "[")):
        return table_of(json_of(text, path, "a table of labels"), str(path), pick)
    if pick:
        raise DataError(f"{path}: holds one table; omit #{pick}")
    return _table((_separated if path.suffix.lower() in SEPARATED else _lines)(text, path), str(path))


def table_beside(source: str | None) -> str | None:
    """Return the dataset.json of nnU-Net or the Medical Segmentation Decathlon beside or above a file, if it fits."""
    files = [folder / "dataset.json" for folder in Path(source).absolute().parents[:2]] if source else []
    return next((os.path.relpath(file) for file in files if file.is_file() and is_table(file)), None)


def _table(labels: list[Label], what: str) -> LabelTable:
    if not labels:
        raise DataError(f"{what}: no labels; {EXPECTED}")
    return LabelTable(Path(what).name, tuple(sorted(labels, key=lambda label: label.number)))


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
            fields = {key: next((texts[k] for k in keys if texts.get(k)), "") for key, keys in COLUMNS.items()}
            value, color = fields["number"].removesuffix(".0"), [fields[key] for key in "rgb" if fields[key]]
            numbers = all(_DECIMAL.fullmatch(fields[key] or "0") for key in "rgba")
            if not _INTEGER.fullmatch(value) or len(color) in (1, 2) or not numbers:
                raise DataError(f"{path}: row {n}: label {value[:20]!r}, colour {', '.join(color)[:40]}; {EXPECTED}")
            shown = [float(v) / 255 for v in color] or _hex(fields["color"])
            last = float(fields["a"]) / 255 if fields["a"] else None
            rows.append((f"{path}: row {n}", int(value), fields["name"], shown, last, True, codes_of_row(texts)))
    except csv.Error as error:
        raise DataError(f"{path}: {error}; {EXPECTED}") from None
    return _labels(rows, path, text, "color_a" in head)


def _labels(rows: list[Row], path: Path, text: str, opacity: bool) -> list[Label]:
    """Make labels from rows, with distinct colours for those without; ``opacity``: column A is known to be opacity."""
    opacity = opacity or _is_opacity([row[4] for row in rows if row[1] and row[4] is not None], path, text)
    channels = [v * 255 for row in rows for v in row[3] or ()]
    if channels and max(channels) <= 1 and any(v % 1 for v in channels):
        raise DataError(f"{path}: no colour above 1; expected red, green and blue from 0 to 255")
    if blank := [row[1] for row in rows if row[3] is None]:
        warnings.warn(f"{path.name}: {len(blank)} labels have no colour; given distinct ones", stacklevel=2)
    labels = []
    for here, value, name, color, last, shown, codes in rows:
        alpha = 0.0 if not value else SOLID if last is None else last if opacity else 1 - last
        labels.append(_label(here, value, name, color, alpha, shown, codes))
    return labels


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


def table_of(parsed: Any, what: str, pick: str = "") -> LabelTable:
    """Return the table in a parsed JSON file, or raise DataError; ``pick`` names one of several in it."""
    presets = parsed if isinstance(parsed, list) else [parsed]
    if presets and all(isinstance(one, dict) and "IndexedColors" in one for one in presets):
        return _table(_annotated(presets, what, pick), what)
    if isinstance(parsed, dict):
        parsed = next((parsed[key] for key in LISTS if key in parsed), parsed)
    if isinstance(parsed, list):
        if pick:
            raise DataError(f"{what}: holds one table; omit #{pick}")
        records = [_record(one, what) for one in parsed]
        alphas = {key: alpha for key, entry in records if (alpha := entry.pop("alpha")) is not None and int(key)}
        most = 255 if any(alpha > 1 for alpha in alphas.values()) else 1
        for key, entry in records:
            if key in alphas and any(alphas.values()):  # FreeSurfer's are all 0
                entry.setdefault("opacity", min(alphas[key] / most, 1))
        return _table(_entries(records, what), what)
    if not isinstance(parsed, dict):
        raise DataError(f"{what}: JSON that is no object; {EXPECTED}")
    nested = all(one and isinstance(one, dict) and not _INTEGER.fullmatch(key) for key, one in parsed.items())
    tables = parsed if nested and parsed else {"": parsed}  # TotalSegmentator's maps by name
    if pick not in tables and (pick or len(tables) > 1):
        raise DataError(f"{what}: {pick!r}; expected FILE#NAME with one of {listed(list(tables), ', ')}")
    return _table(_entries(list((tables[pick] if pick in tables else next(iter(tables.values()))).items()), what), what)


def _record(one: Any, what: str) -> tuple[str, Any]:
    """Return number and entry of a label that is one of a list, an object with keys as in `COLUMNS`."""
    lower = {key.lower(): value for key, value in one.items()} if isinstance(one, dict) else {}
    fields = {key: next((lower[k] for k in keys if lower.get(k) is not None), None) for key, keys in COLUMNS.items()}
    if not _INTEGER.fullmatch(str(fields["number"])):
        raise DataError(f"{what}: {str(one)[:40]!r}, without a number; {EXPECTED}")
    color = fields["color"]
    channels = [v for key in "rgb" if isinstance(v := fields[key], int | float)]
    if color is None and len(channels) == 3:
        color = [int(v) if float(v).is_integer() else v for v in channels]
    entry = {key: value for key, value in (("name", fields["name"]), ("color", color)) if value is not None}
    entry["alpha"] = fields["a"] if isinstance(fields["a"], int | float) else None
    return str(fields["number"]), {key: lower[key] for key in ("opacity", "parents", "visible") if key in lower} | entry


def _entries(entries: list[tuple[str, Any]], what: str) -> list[Label]:
    """Return the labels of a JSON table's keys and values; its colours end at 255 if one is above 1."""
    regions = dict[str, list[int]]()
    known = list[tuple[str, dict[str, Any]]]()
    for key, entry in entries:
        numbers = entry if isinstance(entry, list) else [entry]
        colored = entry.startswith("#") if isinstance(entry, str) else len(numbers) in (3, 4)
        if _INTEGER.fullmatch(key) and (colored or isinstance(entry, dict | str)):
            known.append((key, entry if isinstance(entry, dict) else {"color" if colored else "name": entry}))
        elif numbers and all(type(one) is int for one in numbers):
            regions[key] = numbers
        else:
            raise DataError(f"{what}: {key[:40]!r}; {EXPECTED}")
    channels = [v for _, e in known if isinstance(e.get("color"), list) for v in e["color"]]
    most = 255 if any(type(v) is int and v > 1 for v in channels) else 1
    return [_entry(f"{what}: label {key}", int(key), e, most) for key, e in known] + _of_regions(regions, what)


def _entry(here: str, value: int, entry: dict[str, Any], most: float = 1) -> Label:
    """Return the label of an entry of a JSON table, whose channels end at ``most``, or raise DataError."""
    color, seen = entry.get("color"), SOLID if value else 0.0
    if isinstance(color, str):
        color = _hex(color) or color
    elif isinstance(color, list):
        parts = [number(f"{here}: colour", v) / most for v in color]
        color, seen = (parts[:3], parts[3]) if len(parts) == 4 else (parts, seen)
    opacity = number(f"{here}: opacity", entry.get("opacity", seen))
    groups, shown = entry.get("parents", []), entry.get("visible", True)
    groups = [groups] if isinstance(groups, str) else groups
    if not isinstance(groups, list) or not all(isinstance(one, str) and one for one in groups):
        raise DataError(f"{here}: parents {str(groups)[:40]!r}; expected names of groups: [..., ...]")
    if not isinstance(shown, bool):
        raise DataError(f"{here}: visible {str(shown)[:40]!r}; expected true or false")
    name = entry.get("name")
    label = _label(here, value, "" if name is None else str(name), color, opacity, shown)
    return replace(label, parents=tuple(one[:MAX_NAME] for one in groups)) if groups else label


def _of_regions(regions: dict[str, list[int]], what: str) -> list[Label]:
    """Return the labels of names and numbers, of which a region of nnU-Net has several: {"whole": [1, 2], "core": [2]}.

    A label is called as the smallest region that it is in, and is in the groups of the larger ones. Raise DataError for
    two names of one number.
    """
    labels = []
    for one in sorted({one for numbers in regions.values() for one in numbers}):
        *groups, name = sorted((key for key in regions if one in regions[key]), key=lambda key: -len(regions[key]))
        if groups and len(regions[groups[-1]]) == 1:
            raise DataError(f"{what}: label {one} is {name[:40]!r} and {groups[-1][:40]!r}; expected one name")
        label = _label(f"{what}: label {one}", one, name, None, SOLID if one else 0.0)
        labels.append(replace(label, parents=tuple(groups)) if groups else label)
    return labels


def _annotated(presets: list[dict[str, Any]], what: str, pick: str) -> list[Label]:
    """Return the labels of a categorical preset of ParaView, or raise DataError.

    ``Annotations`` are value, name, value, name, ...; ``IndexedColors`` (r, g, b, ...) are theirs in turn.
    """
    preset = choose(presets, what, pick)
    words, colors = preset.get("Annotations"), table(f"{what}: IndexedColors", preset["IndexedColors"], 3, "r, g, b")
    if not isinstance(words, list) or not words or not all(_INTEGER.fullmatch(str(one)) for one in words[::2]):
        raise DataError(f"{what}: no Annotations with numbers of labels; expected [number, name, number, name, ...]")
    pairs = enumerate(zip(words[::2], words[1::2], strict=False))
    shown = [(int(value), {"name": name, "color": colors[k % len(colors)].tolist()}) for k, (value, name) in pairs]
    return [_entry(f"{what}: label {value}", value, entry) for value, entry in shown]


def labels_of(segments: Sequence[Segment], what: str) -> list[Label]:
    """Return the labels of segments; 0 is the background unless its opacity is stated."""
    labels = []
    for one in segments:
        opacity = (SOLID if one.number else 0.0) if one.opacity is None else one.opacity
        color = None if one.color is None else list(one.color)
        labels.append(_label(what, one.number, one.name, color, opacity, codes=codes_of(one.terms)))
    return labels


def _label(
    what: str, value: int, name: str, color: Any, opacity: float, shown: bool = True, codes: Codes = ()
) -> Label:
    """Make a label from checked values, in a colour by its number if it has no ``color``."""
    if not 0 <= opacity <= 1:
        raise DataError(f"{what}: opacity {opacity:g}; expected 0 to 1")
    if abs(value) > MAX_NUMBER:
        raise DataError(f"{what}: label {value}; expected a 32-bit number")
    name = clean_name(what, value, name)
    parents = parents_of(name, codes)
    seen, hidden = (opacity, 0.0) if shown else (0.0, opacity)
    given = palette_color(value) if color is None else rgb(f"{what}: colour", color)
    return Label(value, name, given, seen, parents, codes, hidden, automatic=color is None)
