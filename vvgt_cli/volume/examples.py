"""``example:NAME`` sources: a table that rooms add to, with the real volumes of pyvista's wheel in it."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.registry import read_volume
from vvgt_cli.volume.types import Volume

# (text behind the name, options) -> Volume
Maker = Callable[[str, ReadOptions], Volume]

_EXAMPLES: dict[str, Maker] = {}


def register_example(name: str, make: Maker) -> None:
    """Make ``example:NAME`` (and ``example:NAME:rest``, if the maker takes a rest) a source."""
    _EXAMPLES[name] = make


def open_example(text: str, options: ReadOptions) -> Volume:
    """Open ``NAME`` or ``NAME:rest``.

    Raises:
        UsageError: unknown name (the error lists those that exist), or options that an example does not take.
    """
    name, _, rest = text.partition(":")
    if name not in _EXAMPLES:
        raise UsageError(f"example:{name}: no such example; expected one of {', '.join(sorted(_EXAMPLES))}")
    if options.raw_flags:
        raise UsageError(f"example:{name}: an example has its own layout; leave out {' '.join(options.raw_flags)}")
    return _EXAMPLES[name](rest, options)


def _bundled(name: str, filename: str) -> Maker:
    def make(rest: str, options: ReadOptions) -> Volume:
        if rest:
            raise UsageError(f"example:{name}:{rest}: this example has one size; expected example:{name}")
        spec = find_spec("pyvista")  # finds the folder without importing it
        folders = list(spec.submodule_search_locations or []) if spec else []
        for folder in folders:
            path = Path(folder) / "examples" / filename
            if path.is_file():
                return read_volume(str(path), options)
        raise DataError(f"example:{name}: pyvista is installed without examples/{filename}; install pyvista >= 0.45")

    return make


register_example("frog", _bundled("frog", "frog_tissues.vti"))
register_example("channels", _bundled("channels", "channels.vti"))
