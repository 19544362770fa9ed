"""The table of readers: what a volume format is, and how one is added.

A family of formats is a folder whose ``__init__`` lists a `Reader` for each of them. A reader says how its files are
recognised; the module that reads them is imported when such a file comes. `registry` finds the reader of a file.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.types import Volume

GROUP = "vvgt.readers"  # of entry points
HEAD_BYTES = 4096
HDF5 = b"\x89HDF\r\n\x1a\n"  # which files of several formats begin with


def lazy(name: str, *first: Any) -> Callable[..., Any]:
    """Make a function that stands for another one and imports its module when it is called.

    Args:
        name: ``family.module.function`` in this subpackage.
        *first: arguments that go before those of the call.
    """
    return partial(_call, name, *first)


def _call(name: str, *arguments: Any) -> Any:
    module, _, function = name.rpartition(".")
    return getattr(import_module(f"vvgt_cli.volume.{module}"), function)(*arguments)


@dataclass(frozen=True)
class Reader:
    """A volume format.

    Attributes:
        name: for messages.
        suffixes: lower-case endings of file names, with the dot; one that ends in ``gz`` means that compressed files of
            the format are read.
        read: path and options to volume. Raises a `DataError` where a library is not installed, or the file is damaged,
            of another kind, larger than memory, or names files outside of its folder; a `UsageError` for a choice
            that is missing (`SeveralArrays`, `SeveralComponents` or `SeveralSteps`) or does not exist, and for options
            that do not suit.
        sniff: tells whether a file with these first `HEAD_BYTES`, decompressed, has the format; None where files begin
            in no certain way, so that the name decides.
        takes: which of the options ``array``, ``time``, ``dims``, ``dtype``, ``byte_order`` and ``header_bytes`` it
            takes; all readers take the others.
        by_name: also tried on files that `sniff` does not recognise.
        holds: tells whether a folder holds the format.
        whole: a folder that holds it is one volume, whatever other files lie in it.
        within: formats that its files are recognised as; the file's name decides between them.
        levels: files may have several resolutions, of which it takes the option ``level``.
        contents: path and options to lists of steps, arrays and blocks, for `vvgt info`.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[Path, ReadOptions], Volume]
    sniff: Callable[[bytes], bool] | None = None
    takes: tuple[str, ...] = ()
    by_name: bool = False
    holds: Callable[[Path], bool] | None = None
    whole: bool = False
    within: tuple[str, ...] = ()
    levels: bool = False
    contents: Callable[[Path, ReadOptions], dict[str, Any]] | None = None

    @property
    def nameable(self) -> bool:
        """Whether the name of a file alone says that it has the format: its files begin in no certain way."""
        return self.sniff is None and self.holds is None

    @property
    def resamples(self) -> bool:
        """Whether ``dims`` is the grid to sample values on, rather than the layout of a raw file."""
        return "dims" in self.takes and "dtype" not in self.takes


Scheme = Callable[[str, ReadOptions], Volume]

READERS: list[Reader] = []
_asked: list[str] = []  # groups whose readers have been registered
SCHEMES: dict[str, Scheme] = {}
STEPPED: set[str] = set()  # schemes whose volumes may have time steps


def register(*readers: Reader) -> None:
    """Add readers; of several that recognise a file, the one added first reads it."""
    for reader in readers:
        if any(not s.startswith(".") or s != s.lower() for s in reader.suffixes):
            raise ValueError(f"{reader.name}: suffixes must be lower case and start with a dot")
        if reader.name in (r.name for r in READERS):
            raise ValueError(f"{reader.name}: registered twice")
        READERS.append(reader)


def register_plugins() -> bool:
    """Register the readers of other packages, once a process; return whether there are any.

    An entry point of the group `GROUP` names a table of readers, as our families' ``FORMATS`` are. One that fails is a
    warning that names its package.
    """
    from importlib.metadata import entry_points  # takes a tenth of a second: asked for files that we do not know

    before = len(READERS)
    for entry in () if _asked else entry_points(group=GROUP):
        try:
            register(*entry.load())
        except Exception as error:
            package = entry.dist.name if entry.dist else entry.value
            why = f"{type(error).__name__}: {error}"
            warnings.warn(f"{package}: its readers cannot be used ({why}); update or remove this package", stacklevel=2)
    _asked.append(GROUP)
    return len(READERS) > before


def register_scheme(name: str, open_scheme: Scheme, times: bool = False) -> None:
    """Make ``NAME:rest`` a source: ``open_scheme(rest, options) -> Volume``; ``times``: it may have time steps."""
    SCHEMES[name] = open_scheme
    if times:
        STEPPED.add(name)


def known_suffixes() -> list[str]:
    """List the file name endings of all readers."""
    return [suffix for reader in READERS for suffix in reader.suffixes]


def is_glob(source: str) -> bool:
    """Return whether a source is a glob, and not the name of a file."""
    return bool(set(source) & set("*?[")) and "\0" not in source and not os.path.exists(source)


def volume_name(path: Path) -> str:
    """Return the short name of a file: without folder, known endings and the raw layout in its name."""
    name = path.name
    for suffix in sorted(known_suffixes(), key=len, reverse=True):
        if name.lower().endswith(suffix):
            name = name[: -len(suffix)]
            break
    name = re.sub(r"_\d+x\d+x\d+_u?(int|float)\d+$", "", name)
    return name or path.name
