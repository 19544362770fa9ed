"""The plan that the blocks of a run share, stored beside them, so that they can be merged without the volume."""

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
A_SCORE, A_RAY = 20, 20  # bytes of the scores of a base cell and its ancestors, and of a ray within a block
A_NORMAL = 24  # bytes of the normal of a base cell under a light
A_GAUSSIAN = 8  # base cells per Gaussian, for large budgets
KEPT = 2.2  # Gaussians on disk a Gaussian of the file: with its coarser levels, in the store and in the output


@dataclass(frozen=True)
class Plan:
    """The grid of cells, the budget and the layout of the output.

    Attributes:
        grid: grid of the cells.
        budget, size: maximal number of Gaussians, and pixels of the screen that they are made for.
        axes: (9,) row-major world directions of the index axes, as `Volume.direction`.
        ply: layout of the file.
        volume, function: entries of the report.
        rays: name of the file of the rays for scoring.
        labels: whether the volume is a label map alone.
        degree: degree of the harmonics of colours under a light.
        voxel_bytes: bytes of a voxel while a block is read.
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
    voxel_bytes: int = 1

    @property
    def written_degree(self) -> int:
        """Degree of the harmonics in the file."""
        return self.degree if self.ply.sh_degree is None else self.ply.sh_degree

    def save(self, store: BlockStore, light: Light | None) -> None:
        """Write the light, if any, and then the plan beside the blocks."""
        if light is not None:
            with atomic_write(store.folder / LIGHT, overwrite=True) as temporary, open(temporary, "wb") as stream:
                np.savez(stream, allow_pickle=False, **light._asdict())
        with atomic_write(store.folder / PLAN, overwrite=True) as temporary:
            temporary.write_text(json.dumps(plain(asdict(self)), indent=1), "utf-8")

    @classmethod
    def load(cls, store: BlockStore) -> Plan:
        """Read the plan beside blocks.

        Raises:
            DataError: the plan is missing or damaged.
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
                f"{path}: missing, since not all shards have counted their blocks; run the same array again"
            ) from None
        except (ValueError, KeyError, TypeError) as error:
            raise DataError(f"{path}: damaged ({error}); remove it and run a shard again") from error


def load_light(store: BlockStore, plan: Plan) -> Light | None:
    """Read the light beside a plan, None for none.

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
    """Return the maximal number of base cells on disk: that in memory, or more for large budgets."""
    from vvgt_cli.closed_form.closed_form import most_cells as in_memory

    return max(in_memory(budget), A_GAUSSIAN * budget)


def disk_bytes(grid: CellGrid, voxels: float, budget: int, rays: int, lit: bool, degree: int) -> int:
    """Estimate the bytes of blocks and output on disk, for ``voxels`` that are visible and ``rays`` that are marched.

    With ``lit`` cells have normals; ``degree`` is that of the Gaussians' harmonics.
    """
    cells = voxels / float(grid.cell.prod())
    met = rays * max(grid.blocks.shape) / 2  # blocks along a ray, half of which show something of it
    coarse = math.prod(-(-grid.dims // grid.tile)) * grid.tile_cells**3 * (8 / 8**grid.march + 4 / 8**grid.field)
    row, vertex = ROW + A_SCORE + A_NORMAL * lit, VERTEX_BYTES + HARMONIC_BYTES[degree]
    return int(cells * row + coarse + met * A_RAY + KEPT * min(budget, cells) * vertex)
