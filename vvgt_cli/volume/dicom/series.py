"""The choice of the images in a DICOM folder that make the volume: one series, and in it one stack of slices.

Localisers (scouts), segmentations and single images of another orientation are skipped where one stack remains, and a
warning says so; where several remain, the error lists them.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, SeveralArrays, UsageError
from vvgt_cli.volume.components import listed
from vvgt_cli.volume.dicom.files import Source
from vvgt_cli.volume.dicom.segmentation import is_segmentation
from vvgt_cli.volume.headers import printable

_FEW = 2  # slices: fewer than make a stack, beside one that has more
_SPACE = ("sagittal", "coronal", "axial")

_PLACES = ("ImagePositionPatient", "PerFrameFunctionalGroupsSequence", "DetectorInformationSequence")

Files = list[tuple[Source, Any]]


def choose_series(headers: Sequence[tuple[Source, Any]], wanted: str | None, path: Path) -> tuple[str, Files, str]:
    """Choose the series asked for, or the only one.

    Args:
        headers: files and their headers.
        wanted: number, UID or description of a series; after it, or alone where there is one series, ``/K``, the number
            of a stack in it from 1, and the name of one of its volumes.
        path: for messages.

    Returns:
        The suffix of the volume's name, the files of the series, and the part of ``wanted`` that names a stack or a
        volume, "" where there is none.

    Raises:
        DataError: no images.
        UsageError: several series and none chosen, or none of that name.
    """
    found: dict[str, Files] = {}
    for file, header in headers:
        if "Rows" in header and "Columns" in header:
            found.setdefault(str(header.get("SeriesInstanceUID", "")), []).append((file, header))
    if not found:
        kinds = Counter(printable(str(header.get("Modality", "?")))[:16] for _, header in headers)
        listing = ", ".join(f"{n} {kind}" for kind, n in kinds.items()) or "no DICOM files"
        structures = kinds["RTSTRUCT"] == kinds.total() > 0
        hint = "; of contours (RTSTRUCT) nothing is filled: export them as a label map or SEG" if structures else ""
        raise DataError(f"{path}: no DICOM images ({listing}); expected files with rows and columns of pixels{hint}")
    if wanted is None:
        return "", _only(found, path), ""
    wanted = wanted.strip("/")
    ends = [len(wanted), *(k for k in range(len(wanted) - 1, 0, -1) if wanted[k] == "/")]
    for end in ends:
        if chosen := _named(found, wanted[:end]):
            return f":{wanted}", chosen, wanted[end:].strip("/")
    if len(found) == 1 and not wanted.partition("/")[0].isdecimal():
        return f":{wanted}", next(iter(found.values())), wanted
    raise UsageError(f"{path}: no one series {wanted!r}; it has {_listed(found)}; choose with --series SERIES")


def _only(found: dict[str, Files], path: Path) -> Files:
    """Return the single series of spatially located images, ignoring scouts and segmentations."""
    aside = {
        uid: files
        for uid, files in found.items()
        if all(_localiser(h) or is_segmentation(h) or not any(key in h for key in _PLACES) for _, h in files)
    }
    left = {uid: f for uid, f in found.items() if uid not in aside} or found
    if len(left) > 1:
        text = (
            f"{path}: several series: {_listed(found)}; choose one by number, UID or description with --series SERIES"
        )
        titles = [str(f[0][1].get("SeriesDescription", "")).strip() for f in found.values()]
        raise SeveralArrays(text, "--series", list(found), titles)
    if len(left) < len(found):
        warnings.warn(
            f"{path}: skipped: {_listed(aside)} (localisers, segmentations, images without a position)", stacklevel=2
        )
    return next(iter(left.values()))


def _named(found: dict[str, Files], wanted: str) -> Files:
    """Return the one series with this number, UID or description, else nothing."""
    fits = []
    for uid, files in found.items():
        keys = (str(files[0][1].get(key, "")).strip() for key in ("SeriesNumber", "SeriesDescription"))
        fits += [files] if wanted in (uid, *keys) else []
    return fits[0] if len(fits) == 1 else []


def _listed(found: dict[str, Files]) -> str:
    """List series for an error: number, description, modality, slices, UID."""
    parts = []
    for uid, files in found.items():
        header = files[0][1]
        slices = sum(int(h.get("NumberOfFrames", 1) or 1) for _, h in files)
        parts.append(
            f"{header.get('SeriesNumber', '?')} {str(header.get('SeriesDescription', '')).strip()[:64]!r} "
            f"({header.get('Modality', '?')}, {slices} slice{'s' * (slices != 1)}, {uid})"
        )
    return listed(parts)


def _localiser(header: Any) -> bool:
    return "LOCALIZER" in [str(word).upper() for word in header.get("ImageType") or []]


def one_stack(
    slices: list[Any], alike: Callable[[Any, Any], bool], number: int | None, title: str, path: Path
) -> list[Any]:
    """Return the slices of one size and orientation: the stack asked for, or the only one of more than `_FEW` slices.

    Args:
        slices: of a series; each with a ``header`` and ``rows`` (2, 3).
        alike: whether two slices may lie in one stack.
        number: of the stack, from 1, in the order of their first slices; None for the only one.
        title: how the series was asked for, "" where it was not.
        path: for messages.

    Raises:
        SeveralArrays: several stacks.
        UsageError: no such one.
    """
    stacks: list[list[Any]] = []
    for s in slices:
        home = next((stack for stack in stacks if alike(stack[0], s)), None)
        if home is None:
            stacks.append([s])
        else:
            home.append(s)
    name = title.removeprefix(":").rpartition("/")[0] if number is not None else title.removeprefix(":")
    name = name or str(slices[0].header.get("SeriesNumber") or slices[0].header.get("SeriesInstanceUID") or "?")
    listing = listed([f"{name}/{k}: {_of(stack)}" for k, stack in enumerate(stacks, 1)])
    if number is not None:
        if not 1 <= number <= len(stacks):
            raise UsageError(f"{path}: no stack {name}/{number}; it has {listing}; choose with --series SERIES/STACK")
        return stacks[number - 1]
    if len(stacks) == 1:
        return stacks[0]
    real = [stack for stack in stacks if not all(_localiser(s.header) for s in stack)] or stacks
    large = [stack for stack in real if len(stack) > _FEW] if len(real) > 1 else real
    if len(large) != 1:
        raise SeveralArrays(
            f"{path}: slices that differ in size, orientation or pixel spacing: {listing}; choose one with --series "
            "SERIES/STACK", "--series", [f"{name}/{k}" for k in range(1, len(stacks) + 1)], list(map(_of, stacks)),
        )  # fmt: skip
    rest = "; ".join(f"{name}/{k}: {_of(stack)}" for k, stack in enumerate(stacks, 1) if stack is not large[0])
    warnings.warn(f"{path}: skipped, of another size or orientation: {rest[:500]}", stacklevel=2)
    return large[0]


def _of(stack: list[Any]) -> str:
    first = stack[0]
    normal = np.abs(np.cross(first.rows[0], first.rows[1]))
    plane = _SPACE[int(normal.argmax())] if normal.max() > 0.95 else "oblique"
    scout = ", localiser" if _localiser(first.header) else ""
    size = f"{first.header.get('Columns')} x {first.header.get('Rows')}"
    return f"{len(stack)} {plane} slice{'s' * (len(stack) != 1)} of {size}{scout}"
