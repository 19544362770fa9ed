"""Slices by the numbers in their file names: order, gaps, and names that are of several stacks."""

from __future__ import annotations

import glob
import math
import re
import warnings
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from vvgt_cli.errors import DataError

_SHOWN = 3  # numbers or files that a message names


def by_number(path: Path) -> list[tuple[int, str]]:
    """Return the sorting key of a file name: runs of digits count by value."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name) if part]


def in_order(files: list[Path], source: str) -> tuple[list[Path], int]:
    """Return the files of a numbered series, sorted by the number that differs in every name, and its step.

    Files that are sorted by `by_number` but have no numbers in common stay in that order. Warnings name files that are
    skipped and numbers that are missing.

    Raises:
        DataError: several numbers vary independently (channels, times, positions), or several series count alike.
    """
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path in files:
        groups.setdefault(tuple(re.split(r"\d+", path.name.lower())), []).append(path)
    main = max(groups.values(), key=len)
    alone = [group[0] for group in groups.values() if len(group) == 1]
    series = [path for group in groups.values() if len(group) > 1 for path in group]
    texts = [re.findall(r"\d+", path.name) for path in series]
    columns = [tuple(map(int, column)) for column in zip(*texts, strict=False)]
    if len(alone) >= len(main) or not columns:
        return files, 1
    if alone:
        warnings.warn(f"{source}: skipped {listed(alone)}: not numbered as the other slices", stacklevel=2)
    parts = re.split(r"(\d+)", main[0].name)
    for k in (k for k in range(len(columns) - 1) if parts[2 * k + 2] == "."):  # decimals: 0.5, 1.0, 1.5
        places = [float(f"{text[k]}.{text[k + 1]}") for text in texts]
        if len(_steps(places)) == 1:
            return [path for _, path in sorted(zip(places, series, strict=True))], 1
    counting = [column for column in columns if len(set(column)) == len(series)]
    if not counting:
        _refuse(main[0], series, columns, source)
        return sorted(series, key=by_number), 1
    numbers = min(counting, key=lambda column: (len(_steps(column)) > 1, max(column) - min(column)))
    step = int(min(_steps(numbers)))
    gaps = [n for a, b in pairwise(sorted(numbers)) for n in range(a + step, min(b, a + 5 * step), step)]
    if gaps:
        warnings.warn(f"{source}: no slices numbered {listed(gaps)}; read as if evenly spaced", stacklevel=2)
    return [path for _, path in sorted(zip(numbers, series, strict=True))], step


def listed(items: Sequence[Path | int]) -> str:
    """Return the first few numbers, or names of files, and that there are more."""
    return ", ".join(str(getattr(i, "name", i)) for i in items[:_SHOWN]) + (", ..." if len(items) > _SHOWN else "")


def _steps(numbers: Sequence[float]) -> set[float]:
    return {round(b - a, 9) for a, b in pairwise(sorted(numbers))}


def _refuse(first: Path, series: list[Path], columns: list[tuple[int, ...]], source: str) -> None:
    """Raise `DataError` if the numbers in names fill more than half of a grid; warn if not: clock times do not."""
    parts = re.split(r"(\d+)", first.name)
    labels = [(re.findall(r"([A-Za-z]+)[-_= ]?$", part) or ["number"])[0] for part in parts[::2]]
    sizes = {k: len(set(column)) for k, column in enumerate(columns) if len(set(column)) > 1}
    ranges = ", ".join(f"{labels[k]} {min(columns[k])} to {max(columns[k])}" for k in sizes)
    text = f"{source}: no one number counts the slices in the names of its {len(series)} files ({ranges})"
    if 2 * len(series) <= math.prod(sizes.values()):
        warnings.warn(f"{text}; they are in the order of the first", stacklevel=3)
        return
    at = 1 + 2 * max(sizes, key=lambda k: (labels[k].lower() in ("z", "slice", "section"), sizes[k]), default=0)
    before, after = (glob.escape("".join(some)) for some in (parts[:at], parts[at + 1 :]))
    wide, narrow = (f"{before}{digits}{after}" for digits in ("*", "[0-9]" * len(parts[at])))
    matched = {tuple(re.split(r"\d+", path.name)) for path in series if path.match(wide)}
    way_out = Path(glob.escape(str(first.parent))) / (wide if len(matched) == 1 else narrow)
    raise DataError(f"{text}, so they look like several stacks; give one, as '{way_out}'")
