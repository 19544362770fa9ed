"""Groups of labels: by the coded terms of 3D Slicer and DICOM, or by the names of FreeSurfer's labels.

A term says what a segment is by codes: a category, a type with a modifier ("left"), and a region with a modifier (DICOM
PS3.3, C.8.20.4; 3D Slicer's terminologies). Sides are no groups there, since a segment's own name says them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

Codes = tuple[tuple[str, str, str], ...]  # (part, "scheme:value", meaning) of each part that is there
PARTS = ("category", "type", "type_modifier", "region", "region_modifier")
GROUPING = ("category", "region", "type")  # parts that are groups, from the outermost
_COLUMNS = ("Category", "Type", "TypeModifier", "Region", "RegionModifier")  # of a .csv of 3D Slicer, in PARTS' order
_CODE = ("CodingScheme", "CodeValue", "CodeMeaning")
_SIDES = {"l": "Left", "r": "Right"}
_TISSUES = {"ctx": "cortex", "wm": "white matter"}
_SURFACE = re.compile(r"(ctx|wm)[-_](l|r)h[-_]")
_SIDE = re.compile(r"(Left|Right)-")


def codes_of(terms: Sequence[Sequence[str]]) -> Codes:
    """Return the codes of (scheme, value, meaning), one for each of `PARTS` or none; omit those without meaning."""
    stated = zip(PARTS, terms, strict=False)
    return tuple((part, f"{scheme}:{value}", meaning) for part, (scheme, value, meaning) in stated if meaning.strip())


def codes_of_row(cells: Mapping[str, str]) -> Codes:
    """Return the codes in a row of a `.csv` of 3D Slicer; the names of its columns are in lower case."""
    return codes_of([[cells.get(f"{column}_{field}".lower(), "") for field in _CODE] for column in _COLUMNS])


def parents_of(name: str, codes: Codes) -> tuple[str, ...]:
    """Return the groups of a label, from the outermost: by its codes, else by a name of FreeSurfer's."""
    meanings = {part: meaning for part, _, meaning in codes}
    groups: list[str] = []
    for part in GROUPING:
        group = meanings.get(part, "")
        if group and group.casefold() not in (name.casefold(), *(groups[-1:] and [groups[-1].casefold()])):
            groups.append(group)
    if codes:
        return tuple(groups)
    if surface := _SURFACE.match(name):
        side = _SIDES[surface[2]]
        return side, f"{side} {_TISSUES[surface[1]]}"
    side_of = _SIDE.match(name)
    return (side_of[1],) if side_of else ()
