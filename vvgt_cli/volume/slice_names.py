"""Slices by the numbers in their file names: their order, gaps, and names that are of several stacks."""

from __future__ import annotations

import glob
import math
import re
import warnings
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from vvgt_cli.errors import DataError

_SLICE = ("z", "slice", "section", "plane")
_SHOWN = 3  # missing numbers and skipped files that a message names


def by_number(path: Path) -> list[tuple[int, str]]:
    """Return the sorting key of a file name: runs of digits count by value."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name) if part]


def in_order(files: list[Path], source: str) -> tuple[list[Path], int]:
    """Return the files of a numbered series, in order, and the step of their numbers.

    The number that differs in every name counts. Names without numbers in common are left in their order. Warnings
    name files that are skipped, numbers that are missing, and numbers that vary without counting (clock times).

    Args:
        files: sorted by `by_number`.
        source: for messages.

    Raises:
        DataError: several numbers vary independently (channels, times, positions), or several series count alike.
    """
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path in files:
        groups.setdefault(tuple(re.split(r"\d+", path.name.lower())), []).append(path)
    main = max(groups.values(), key=len)
    alone = [group[0] for group in groups.values() if len(group) == 1]
    if len(main) == 1 or len(alone) >= len(main):
        return files, 1
    if alone:
        warnings.warn(f"{source}: {listed(alone)} skipped: not numbered as the other slices", stacklevel=2)
    series = [path for path in files if path not in alone]
    texts = [re.findall(r"\d+", path.name) for path in series]
    columns = [tuple(map(int, column)) for column in zip(*texts, strict=False)]
    parts = re.split(r"(\d+)", main[0].name)
    for k in (k for k in range(len(columns) - 1) if parts[2 * k + 2] == "."):
        places = [float(f"{text[k]}.{text[k + 1]}") for text in texts]
        if len(_steps(places)) == 1:
            return [series[i] for i in sorted(range(len(series)), key=places.__getitem__)], 1
    counting = [column for column in columns if len(set(column)) == len(series)]
    if not counting:
        _refuse(main[0], parts, columns, source, len(series))
        return series, 1
    numbers = min(counting, key=lambda column: (len(_steps(column)) > 1, max(column) - min(column)))
    step = int(min(_steps(numbers)))
    gaps = [n for a, b in pairwise(sorted(numbers)) for n in range(a + step, min(b, a + (_SHOWN + 1) * step), step)]
    if gaps:
        shown = ", ".join(map(str, gaps[:_SHOWN])) + (", ..." if len(gaps) > _SHOWN else "")
        warnings.warn(f"{source}: no slices numbered {shown}; the others are taken as evenly spaced", stacklevel=2)
    return [path for _, path in sorted(zip(numbers, series, strict=True))], step


def listed(files: list[Path]) -> str:
    """Return the names of the first files, for a message."""
    return ", ".join(path.name for path in files[:_SHOWN]) + (
        f" and {len(files) - _SHOWN} more" * (len(files) > _SHOWN)
    )


def _steps(numbers: Sequence[float]) -> set[float]:
    return {round(b - a, 9) for a, b in pairwise(sorted(numbers))}


def _refuse(first: Path, parts: list[str], columns: list[tuple[int, ...]], source: str, n: int) -> None:
    """Raise `DataError` where the numbers in names make a grid that is filled by more than half, else warn."""
    labels = [(re.findall(r"([A-Za-z]+)[-_= ]?$", text) or [f"number {k + 1}"])[0] for k, text in enumerate(parts[::2])]
    sizes = {k: len(set(column)) for k, column in enumerate(columns) if len(set(column)) > 1}
    ranges = ", ".join(f"{labels[k]} {min(columns[k])} to {max(columns[k])}" for k in sizes)
    text = f"{source}: no one number counts the slices in the names of its {n} files ({ranges or 'equal numbers'})"
    if 2 * n <= math.prod(sizes.values()):
        warnings.warn(f"{text}; they are in the order of the first of them", stacklevel=3)
        return
    counter = max(sizes, key=lambda k: (labels[k].lower() in _SLICE, sizes[k]), default=0)
    pattern = "".join("*" if k == 2 * counter + 1 else glob.escape(part) for k, part in enumerate(parts))
    raise DataError(
        f"{text}, so they look like several stacks; give one, as '{Path(glob.escape(str(first.parent))) / pattern}'"
    )
