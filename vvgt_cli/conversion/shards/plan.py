"""What the blocks of a run have in common and its file depends on, beside them on disk: enough to merge without the
volume."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from vvgt_cli.conversion.request import HARMONIC_BYTES, VERTEX_BYTES
from vvgt_cli.dvr.layout import Light
from vvgt_cli.errors import DataError
from vvgt_cli.field.block_store import ROW, BlockStore
from vvgt_cli.field.grid import Boxes, CellGrid
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians import PlyOptions
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.score.record import plain

PLAN, LIGHT = "plan.json", "light.npz"
A_SCORE, A_RAY = 20, 20  # bytes: of a base cell's scores with those above it, of what a block shows of a ray
A_NORMAL = 24  # bytes of a base cell, where there is light
A_GAUSSIAN = 8  # base cells there may be a Gaussian, where the budget is so large that it decides


@dataclass(frozen=True)
class Plan:
    """See the module.

    Attributes:
        grid: the cells.
        budget, size: most Gaussians, and pixels of the screen that they are made for.
        axes: (9,) row-major world directions of the index axes, as `Volume.direction`.
        ply: how the file is written.
        volume, function: as reports show them.
        rays: name of the file of the rays that it is scored by.
        labels: it is one of labels alone.
        degree: of the harmonics that colours have under a light.
    """

    grid: CellGrid
    budget: int
    size: int
    axes: tuple[float, ...]
    ply: PlyOptions
    volume: dict[str, Any]
    function: dict[str, Any]
    rays: str
    labels: bool = False
    degree: int = 0

    def save(self, store: BlockStore, light: Light | None) -> None:
        """Write it beside the parts, and before it what falls on the volume."""
        if light is not None:
            with atomic_write(store.folder / LIGHT, overwrite=True) as temporary, open(temporary, "wb") as stream:
                np.savez(stream, allow_pickle=False, **light._asdict())
        with atomic_write(store.folder / PLAN, overwrite=True) as temporary:
            temporary.write_text(json.dumps(plain(asdict(self)), indent=1), "utf-8")

    @classmethod
    def load(cls, store: BlockStore) -> Plan:
        """The plan beside parts.

        Raises:
            DataError: there is none, or it is damaged.
        """
        path = store.folder / PLAN
        try:
            found = json.loads(path.read_text("utf-8"))
            grid, ply = found["grid"], found["ply"]
            boxes = Boxes(*(tuple(grid["blocks"][key]) for key in ("dims", "edge")))
            grid = CellGrid(**{**{key: _tupled(value) for key, value in grid.items()}, "blocks": boxes})
            options = PlyOptions(**{key: _tupled(value) for key, value in ply.items()})
            if options.light is not None:
                light = {key: _tupled(value) for key, value in ply["light"].items()}
                options = replace(options, light=Lighting(**light))
            return replace(cls(**{**found, "grid": grid, "ply": options}), axes=tuple(found["axes"]))
        except FileNotFoundError:
            raise DataError(
                f"{path}: is missing: not all shards have counted their blocks; run the same array again"
            ) from None
        except (ValueError, KeyError, TypeError) as error:
            raise DataError(f"{path}: damaged ({error}); remove it and run a shard again") from error


def load_light(store: BlockStore, plan: Plan) -> Light | None:
    """What falls on the volume, None for nothing.

    Raises:
        DataError: the file beside the plan is missing or damaged.
    """
    if plan.ply.light is None:
        return None
    path = store.folder / LIGHT
    try:
        with np.load(path) as found:
            return Light(**{key: found[key] if found[key].ndim else found[key].item() for key in Light._fields})
    except (OSError, ValueError, KeyError) as error:
        raise DataError(f"{path}: damaged ({error}); remove {PLAN} beside it and run a shard again") from error


def _tupled(value: Any) -> Any:
    return tuple(map(_tupled, value)) if isinstance(value, list) else value


def most_cells(budget: int) -> int:
    """Base cells that a budget has use for, on disk: as many as in memory, more where there are more Gaussians."""
    from vvgt_cli.closed_form.closed_form import most_cells as in_memory

    return max(in_memory(budget), A_GAUSSIAN * budget)


def disk_bytes(grid: CellGrid, voxels: float, budget: int, rays: int, lit: bool, degree: int) -> int:
    """What parts and output take on disk, about, where ``voxels`` are visible and ``rays`` are marched.

    ``lit``: cells have normals, ``degree``: of the Gaussians' harmonics.
    """
    cells = voxels / float(grid.cell.prod())
    met = rays * max(grid.blocks.shape) / 2  # blocks along a ray, half of which show something of it
    coarse = math.prod(-(-grid.dims // grid.tile)) * grid.tile_cells**3 * (8 / 8**grid.march + 4 / 8**grid.field)
    row, vertex = ROW + A_SCORE + A_NORMAL * lit, VERTEX_BYTES + HARMONIC_BYTES[degree]
    return int(cells * row + coarse + met * A_RAY + min(budget, cells) * vertex)
