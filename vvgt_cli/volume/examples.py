"""``example:NAME`` sources: analytic volumes of any size, and the real ones of pyvista's wheel."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import shapes
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.registry import read_volume
from vvgt_cli.volume.segments import Segment
from vvgt_cli.volume.types import Volume

# (text behind the name, options) -> Volume
Maker = Callable[[str, ReadOptions], Volume]

# The tissues of the Whole Frog by number, as VTK's examples of it name them, in colours near those of a body. Numbers
# above 15 are a few hundred voxels between tissues, which nobody names.
FROG = (
    ("blood", (0.65, 0.08, 0.08)), ("brain", (0.92, 0.75, 0.7)), ("duodenum", (0.83, 0.58, 0.42)),
    ("eye retina", (0.3, 0.2, 0.15)), ("eye white", (0.95, 0.95, 0.92)), ("heart", (0.7, 0.17, 0.14)),
    ("ileum", (0.87, 0.63, 0.52)), ("kidney", (0.52, 0.22, 0.17)), ("large intestine", (0.7, 0.5, 0.36)),
    ("liver", (0.46, 0.21, 0.15)), ("lung", (0.9, 0.62, 0.6)), ("nerve", (0.95, 0.88, 0.6)),
    ("skeleton", (0.93, 0.88, 0.77)), ("spleen", (0.42, 0.14, 0.2)), ("stomach", (0.85, 0.68, 0.58)),
)  # fmt: skip

_SIZE = re.compile(r"(\d{1,6})(?:x(\d{1,6})x(\d{1,6}))?")


def open_example(text: str, options: ReadOptions) -> Volume:
    """Open ``NAME`` or ``NAME:rest``; raise UsageError for unknown names, or options that an example does not take."""
    name, _, rest = text.partition(":")
    if name not in EXAMPLES:
        raise UsageError(f"example:{name}: no such example; expected one of {', '.join(sorted(EXAMPLES))}")
    if options.raw_flags:
        raise UsageError(f"example:{name}: an example has its own layout; leave out {' '.join(options.raw_flags)}")
    return EXAMPLES[name](rest, options)


def tissues(path: str | None) -> tuple[Segment, ...]:
    """Return what is known of the labels of an example, a label map if it is read as one; none of other volumes."""
    known = FROG if path == "example:frog" else ()
    return tuple(Segment(number, name, color) for number, (name, color) in enumerate(known, 1))


def _bundled(name: str, filename: str) -> Maker:
    def make(rest: str, options: ReadOptions) -> Volume:
        if rest:
            raise UsageError(f"example:{name}:{rest}: this example has one size; expected example:{name}")
        spec = find_spec("pyvista")  # finds the folder without importing it
        folders = list(spec.submodule_search_locations or []) if spec else []
        for folder in folders:
            path = Path(folder) / "examples" / filename
            if path.is_file():
                return read_volume(str(path), replace(options, crop=None, mask=None, keep_largest=None))  # done later
        raise DataError(f"example:{name}: pyvista is installed without examples/{filename}; install pyvista >= 0.45")

    return make


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


EXAMPLES = {
    "frog": _bundled("frog", "frog_tissues.vti"),
    "channels": _bundled("channels", "channels.vti"),
    "marschner-lobb": _sized("marschner-lobb", shapes.marschner_lobb, 64),
    "blob": _sized("blob", shapes.blob, 64),
    "slab": _sized("slab", shapes.slab, 64),
    "sphere": _sized("sphere", shapes.sphere, 64),
    "checkerboard": _sized("checkerboard", shapes.checkerboard, 32),
    "random": _sized("random", shapes.random_field, 64),
}
