"""NRRD data in several files: ``data file: LIST [n]`` and ``data file: FORMAT MIN MAX STEP [n]``.

Format: https://teem.sourceforge.net/nrrd/format.html#detached
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory, count
from vvgt_cli.volume.headers import MAX_HEADER

MOST = 100_000  # files


def data_names(path: Path, named: str, n: int) -> tuple[list[str], int] | None:
    """File names and how many axes each file holds; None where ``named`` is one file's name.

    Args:
        path: the header, whose lines behind ``LIST`` are names.
        named: value of the field.
        n: axes of the array.

    Raises:
        DataError: a list without names, a pattern that is none, or axes that do not fit.
    """
    words = named.split()
    if words and words[0] == "LIST":
        lines = path.read_bytes()[:MAX_HEADER].decode("utf-8", "replace").splitlines()
        start = next(k for k, line in enumerate(lines) if re.match(r"data ?file:\s*LIST", line, re.IGNORECASE))
        names, rest = [line.strip() for line in lines[start + 1 :] if line.strip()], words[1:]
    elif re.search(r"%0?\d*d", named) and len(words) >= 4:
        try:
            lo, hi, step = (int(w) for w in words[1:4])
            number = re.fullmatch(r"([^%]*)%(0?)(\d*)d([^%]*)", words[0])
            if number is None or step == 0 or not 0 <= (hi - lo) // step < MOST:
                raise ValueError
        except ValueError:
            raise DataError(
                f"{path}: data file {named!r}; expected NAME%03d MIN MAX STEP, as slice%03d.raw 1 99 1"
            ) from None
        before, zero, width, after = number.groups()
        form = f"{{:{zero}{width}d}}" if len(width) < 3 else "{:d}"
        names = [before + form.format(k) + after for k in range(lo, hi + (1 if step > 0 else -1), step)]
        rest = words[4:]
    else:
        return None
    axes = int(rest[0]) if rest and rest[0].isdecimal() else n - 1
    if not names or len(names) > MOST or not 1 <= axes <= n:
        raise DataError(f"{path}: data file {named!r} with {len(names)} names of {axes} axes each; expected slices")
    return names, axes


def load_files(
    path: Path,
    names: list[str],
    axes: int,
    shape: tuple[int, ...],
    dtype: np.dtype,
    load: Callable[[str, tuple[int, ...]], np.ndarray],
) -> np.ndarray:
    """The blocks of several files, one behind the other along the slowest axes.

    Args:
        path: the header, for messages.
        names: in the order of the array.
        axes: that each file holds (the fastest ones; all: slabs of the slowest axis).
        shape: of the whole, slowest first.
        dtype: of the values.
        load: name and shape to block.

    Raises:
        DataError: files and sizes that do not fit.
    """
    n = len(shape)
    part = shape[n - axes :]
    if axes == n and shape[0] % len(names) == 0:
        part = (shape[0] // len(names), *shape[1:])
    if count(part) * len(names) != count(shape):
        raise DataError(
            f"{path}: {len(names)} data files of {' x '.join(map(str, reversed(part)))} values; expected "
            f"{' x '.join(map(str, reversed(shape)))} in all"
        )
    check_memory(count(shape) * dtype.itemsize, str(path))
    out = np.empty((len(names), *part), dtype)
    for k, name in enumerate(names):
        out[k] = load(name, part)
    return out.reshape(shape)
