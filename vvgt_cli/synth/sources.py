"""The entry point for all volume sources: files, ``-`` and ``example:`` names, with the analytic examples."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

from vvgt_cli.errors import UsageError
from vvgt_cli.synth import shapes
from vvgt_cli.volume.examples import Maker, register_example
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.registry import read_volume
from vvgt_cli.volume.types import Volume

_SIZE = re.compile(r"(\d{1,6})(?:x(\d{1,6})x(\d{1,6}))?")


def _sized(name: str, make: Callable[[shapes.Size], Volume], default: int) -> Maker:
    def open_analytic(rest: str, options: ReadOptions) -> Volume:
        match = _SIZE.fullmatch(rest or str(default))
        if match is None:
            raise UsageError(f"example:{name}:{rest}: expected a size, as example:{name}:64 or example:{name}:64x48x32")
        if options.array is not None or options.component not in (None, 0):
            raise UsageError(f"example:{name}: has a single unnamed scalar array; omit --array and --component")
        x, y, z = (int(match[1]), int(match[2] or match[1]), int(match[3] or match[1]))
        volume = make((x, y, z))
        return volume if options.spacing is None else replace(volume, spacing=options.spacing)

    return open_analytic


for _name, _make, _default in (
    ("marschner-lobb", shapes.marschner_lobb, 64),
    ("blob", shapes.blob, 64),
    ("slab", shapes.slab, 64),
    ("sphere", shapes.sphere, 64),
    ("checkerboard", shapes.checkerboard, 32),
    ("random", shapes.random_field, 64),
):
    register_example(_name, _sized(_name, _make, _default))


def open_volume(source: str, options: ReadOptions | None = None) -> Volume:
    """Open a volume: a file, ``-`` (raw bytes from standard input) or ``example:NAME[:SIZE]``.

    Args:
        source: the file or name.
        options: how to read it.

    Raises:
        DataError: see `read_volume`.
        UsageError: see `read_volume`; also if there is no such example (the error lists all).
    """
    return read_volume(source, options or ReadOptions())
