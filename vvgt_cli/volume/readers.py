"""The table of readers: what a format is, and how one is added.

A reader is a module that ends in one ``register(Reader(...))``; a scheme (``example:``) is one
``register_scheme(name, function)``. `registry` finds the reader of a file.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.types import Volume

HEAD_BYTES = 4096


@dataclass(frozen=True)
class Reader:
    """A volume format.

    Attributes:
        name: for messages.
        suffixes: lower-case endings of file names, with the dot.
        sniff: does a file with these first `HEAD_BYTES` (unzipped) bytes have this format?
        read: path and options to volume.
        unzips: reads gzip-compressed files by itself.
        named_arrays: takes ``--array``.
        times: takes ``--time``.
        raw_layout: takes dims, dtype, byte order and header bytes.
        by_name: tried on a file that only its name speaks for (formats without a fixed beginning).
        resamples: takes ``--dims`` as the grid to sample on.
        holds: does this folder hold the format? Of formats that are folders.
        by_whole: such a folder is one volume whatever else lies in it.
        within: formats that its files are recognised as; a file's name decides for it.
        empty: a file may be empty: others beside it hold the values.
        contents: steps, arrays and blocks of a file, each a list of rows, for `vvgt info`.
    """

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[bytes], bool]
    read: Callable[[Path, ReadOptions], Volume]
    unzips: bool = False
    named_arrays: bool = False
    times: bool = False
    raw_layout: bool = False
    by_name: bool = False
    resamples: bool = False
    holds: Callable[[Path], bool] | None = None
    by_whole: bool = False
    within: tuple[str, ...] = ()
    empty: bool = False
    contents: Callable[[Path, ReadOptions], dict[str, Any]] | None = None


Scheme = Callable[[str, ReadOptions], Volume]

READERS: list[Reader] = []
SCHEMES: dict[str, Scheme] = {}
STEPPED: set[str] = set()  # of these, what may have time steps


def register(reader: Reader) -> Reader:
    """Add a reader; the earlier one wins where two recognise a file."""
    if any(not s.startswith(".") or s != s.lower() for s in reader.suffixes):
        raise ValueError(f"{reader.name}: suffixes must be lower case and start with a dot")
    if reader.name in (r.name for r in READERS):
        raise ValueError(f"{reader.name}: registered twice")
    READERS.append(reader)
    return reader


def register_scheme(name: str, open_scheme: Scheme, times: bool = False) -> None:
    """Make ``NAME:rest`` a source: ``open_scheme(rest, options) -> Volume``; ``times``: it may have time steps."""
    SCHEMES[name] = open_scheme
    if times:
        STEPPED.add(name)


def known_suffixes() -> list[str]:
    """Every file-name ending that a reader is registered for."""
    return [suffix for reader in READERS for suffix in reader.suffixes]


def volume_name(path: Path) -> str:
    """Short name of a file: without folder, known endings and the raw layout in its name."""
    name = path.name
    for suffix in sorted(known_suffixes(), key=len, reverse=True):
        if name.lower().endswith(suffix):
            name = name[: -len(suffix)]
            break
    name = re.sub(r"_\d+x\d+x\d+_u?(int|float)\d+$", "", name)
    return name or path.name
