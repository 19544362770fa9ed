"""Cases of every way of a conversion: lit, labels, live and streamed, each in blocks as it is in memory."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.scenes import function, ramp, rough, smooth, step
from vvgt_cli.conversion.convert import convert_in_memory, initialise_only
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.conversion.place import into_box
from vvgt_cli.conversion.request import ConvertRequest, FitOptions
from vvgt_cli.conversion.shards.run import init_in_blocks
from vvgt_cli.field.settings import SMALLEST, BlockOptions
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.labels import Label, LabelTable
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.progress import Console
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume

STAGE = "ways"
SIZE, BUDGET, STEPS = 48, 200, 8
BLOCKS = BlockOptions(SMALLEST)
EDGE = 20  # voxels: blocks meet within
SAME = 0.002  # of the largest value: half a level of 255
SOG = 0.01  # the same, with what SOG rounds
HEAD = LightOptions(lights=("headlight",))


@dataclass(frozen=True)
class Stiff:
    """A volume that does not fit into one block, and its look."""

    name: str
    data: Callable[[], np.ndarray]
    tf: TransferFunction | LabelTable
    edge: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def request(self, live: bool = False, light: LightOptions | None = None) -> ConvertRequest:
        """Of a conversion in memory, of a few steps."""
        distance = f"{float(np.mean(self.edge))!r}"
        source = SourceRequest(Volume(self.data(), self.edge), unit_distance=distance, light=light or LightOptions())
        fit = FitOptions(BUDGET, SIZE, steps=None if live else STEPS)
        source = replace(source, labels=self.tf) if isinstance(self.tf, LabelTable) else replace(source, tf=self.tf)
        return ConvertRequest(source, fit=fit, live=live)


def _corner() -> np.ndarray:
    """One voxel that shows, where eight blocks meet."""
    data = np.zeros((EDGE,) * 3)
    data[SMALLEST, SMALLEST, SMALLEST] = 1.0
    return data


def _holes() -> np.ndarray:
    data = rough((EDGE,) * 3, 7)
    data[SMALLEST - 2 : SMALLEST + 2, 4:9] = np.nan
    return data


def _stripes() -> np.ndarray:
    """Labels 0 to 3 in layers of one voxel."""
    layers: np.ndarray = np.indices((EDGE,) * 3)[0] % 4
    return layers.astype(np.uint8)


TABLE = LabelTable(
    "check",
    (Label(1, "faint", (1.0, 0, 0), 1e-6), Label(2, "solid", (0, 1.0, 0), 1.0), Label(3, "half", (0, 0, 1.0), 0.5)),
)
SHELL = function([0, 0.499, 0.5, 0.501, 1], [0, 0, 0.9, 0, 0])
SCALARS = (
    Stiff("step function, depth 0.01 a voxel", partial(smooth, EDGE), step(0.01)),
    Stiff("step function of opacity 1", partial(smooth, EDGE), step(1.0)),
    Stiff("shell of a thousandth of the range", partial(smooth, EDGE), SHELL),
    Stiff("a single voxel that shows", _corner, function([0, 1], [0, 1])),
    Stiff("a block of nan", _holes, function([0, 1], [0.2, 0.4])),
    Stiff("values of 1e-30", lambda: 1e-30 * smooth(EDGE), ramp(1e-30)),
    Stiff("lengths of 1e+30", partial(smooth, EDGE), ramp(), (1e30,) * 3),
    Stiff("spacing 20:1 along z", partial(rough, (EDGE,) * 3), ramp(), (1.0, 1.0, 20.0)),
)
LABELS = (Stiff("labels in layers of one voxel, opacity 1e-6 to 1", _stripes, TABLE),)


def _pictures(gaussians: Gaussians, volume: Volume) -> np.ndarray:
    """Four views of what lies in the unit frame; finite."""
    box = into_box(gaussians, volume)
    found: np.ndarray = np.stack([render(box, view) for view in default_views("check", 4, size=SIZE)])
    require(np.isfinite(found).all(), "a picture that is not finite")
    return found


def _apart(one: np.ndarray, other: np.ndarray, limit: float) -> Figure:
    require(one.any(), "nothing is seen: the case compares nothing")
    scale = max(float(one.max()), 1e-12)
    return Figure("difference from memory's, mean", float(np.abs(one - other).mean()) / scale, limit)


def _in_blocks(row: Stiff, live: bool, light: LightOptions | None) -> Figure:
    """A conversion in blocks shows what one in memory does."""
    request, console = row.request(live, light), Console(quiet=True)
    whole, parts = (convert_in_memory(replace(request, blocks=blocks), console) for blocks in (None, BLOCKS))
    volume = whole.field.source.volume
    if live:
        kept = [found.gaussians.live for found in (whole, parts)]
        require(all(one is not None and np.isfinite(one).all() for one in kept), "values that are not finite")
    return _apart(_pictures(whole.gaussians, volume), _pictures(parts.gaussians, volume), SAME)


def _streamed(row: Stiff) -> Figure:
    """The finest level of a folder shows what the closed form does."""
    with tempfile.TemporaryDirectory(prefix="vvgt-") as name:
        folder, console = Path(name), Console(quiet=True)
        request = replace(row.request(), output=str(folder / "a.ply"))
        request = replace(request, fit=replace(request.fit, steps=None))
        initialise_only(request, console)
        init_in_blocks(replace(request, output=str(folder / "lod" / "lod-meta.json"), blocks=BLOCKS), console)
        volume = Volume(row.data(), row.edge)
        found = [open_gaussians(str(folder / place))[0] for place in ("a.ply", "lod/lod-meta.json")]
        return _apart(_pictures(found[0], volume), _pictures(found[1], volume), SOG)


def cases() -> Iterator[Case]:
    """All of them."""
    for row in (*SCALARS, *LABELS):
        yield Case(STAGE, f"in blocks: {row.name}", partial(_in_blocks, row, False, None))
        yield Case(STAGE, f"live, in blocks: {row.name}", partial(_in_blocks, row, True, None))
        yield Case(STAGE, f"streamed: {row.name}", partial(_streamed, row))
    for row in SCALARS[1::2]:
        yield Case(STAGE, f"lit, in blocks: {row.name}", partial(_in_blocks, row, False, HEAD))
        yield Case(STAGE, f"lit, live, in blocks: {row.name}", partial(_in_blocks, row, True, HEAD))
