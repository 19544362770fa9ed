"""Cuts of a pyramid on disk, as Gaussians part by part, and the plan of the file that they are made for."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vvgt_cli.closed_form.columns import COLUMNS
from vvgt_cli.conversion.level_selection import FIELDS, CutErrors
from vvgt_cli.conversion.request import HARMONIC_BYTES, VERTEX_BYTES
from vvgt_cli.dvr.layout import Light
from vvgt_cli.errors import DataError, NothingVisible
from vvgt_cli.field.block_store import COARSE, ROW, RUN, TREES, BlockStore
from vvgt_cli.field.digests import digest
from vvgt_cli.field.grid import Boxes, CellGrid
from vvgt_cli.files import write_arrays
from vvgt_cli.gaussians import Gaussians, PlyOptions, concatenate
from vvgt_cli.gaussians.outputs import write_text
from vvgt_cli.gaussians.ply import as_stored
from vvgt_cli.jit.ahead import MERGE, SHADE, for_degree
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.score.record import plain

if TYPE_CHECKING:
    from vvgt_cli.closed_form.tree import Leaves
    from vvgt_cli.field.blocked import Pass
    from vvgt_cli.field.tiles import TiledPyramid
    from vvgt_cli.score.record import Run


ENOUGH = 1 << 14  # mean Gaussians of a part from which it is not widened
LARGEST = 1 << 28  # bytes of its voxels while they are read
PLAN, LIGHT = "plan.json", "light.npz"
A_SCORE, A_RAY = 20, 20  # bytes of the scores of a base cell and its ancestors, and of a ray within a block
A_NORMAL = 24  # bytes of the normal of a base cell under a light
KEPT = 2.2  # Gaussians on disk a Gaussian of the file: with its coarser levels, in the store and in the output


class TileGaussians(NamedTuple):
    """The Gaussians of a tile.

    Attributes:
        levels: Gaussians of each level, box frame.
        spreads: `spread_of` the cells of each level.
        normals: (n, 3) normals of the first level's; None without a light.
    """

    levels: list[Gaussians]
    spreads: list[np.ndarray]
    normals: np.ndarray | None


class Parts(NamedTuple):
    """A division of the tiles into cubes, each of which is worked on by one worker.

    Attributes:
        width: edge of a cube in tiles, a power of two, so that the tiles of a cube follow each other in Morton order.
        ends: end of each cube's range of tiles.
    """

    width: int
    ends: tuple[int, ...]

    def rows(self, number: int) -> tuple[int, int]:
        """Return the range of tiles of part ``number``."""
        return self.ends[number - 1] if number else 0, self.ends[number]


@dataclass(frozen=True)
class Cut:
    """A pyramid with what Gaussians need of the whole volume. A pickled one is a reference to its folder.

    Attributes:
        pyramid: the pyramid; the scores of its cells must have been saved (`TreeBlocks`).
        plan: plan of the file.
        key: digest of the plan and of what the blocks depend on.
    """

    pyramid: TiledPyramid
    plan: CutPlan
    key: str

    @property
    def store(self) -> BlockStore:
        """Return the store of the blocks."""
        return self.pyramid.store

    def __reduce__(self) -> Any:
        """Return what opens the same cut in another process, once for all tasks there."""
        return open_cut, (self.store, self.key)

    def parts(self, threshold: float) -> Parts:
        """Divide the tiles into cubes of enough Gaussians for a threshold, with voxels that fit in memory."""
        grid, width = self.plan.grid, 1
        places = self.pyramid.top.index[: len(self.pyramid)]
        total = int(self.pyramid.counts(threshold).sum())
        while True:
            numbers = np.unique(places // width, axis=0)
            wider = float((2 * width * grid.tile).prod()) * self.plan.voxel_bytes
            if len(numbers) == 1 or total >= ENOUGH * len(numbers) or wider > LARGEST:
                break
            width *= 2
        cubes = places // width
        first = np.flatnonzero(np.any(cubes[1:] != cubes[:-1], axis=1)) + 1
        return Parts(width, (*first.tolist(), len(places)))

    def everywhere(self, threshold: float) -> np.ndarray:
        """Return one threshold for every tile, (tiles, 1)."""
        return np.full((len(self.pyramid), 1), threshold)

    def box(self, parts: Parts, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the first voxel of a part, and the end of its range, (3,) each."""
        grid, edge = self.plan.grid, parts.width * self.plan.grid.tile
        lo: np.ndarray = np.array(self.pyramid.top.index[parts.ends[number] - 1]) // parts.width * edge
        return lo, np.minimum(lo + edge, grid.dims)

    def nodes(self, begin: int, end: int, thresholds: np.ndarray, least: bool = True) -> list[TileGaussians]:
        """Return the nodes of the tiles from ``begin`` to ``end``, with a level for each of their ``thresholds``.

        Tiles are made together, since the colours of neighbours depend on each other.

        Args:
            begin: first tile.
            end: end of the tiles' range.
            thresholds: (tiles, n) thresholds of all tiles.
            least: whether a level of a tile has at least the tile's own cell.
        """
        from vvgt_cli.closed_form.tree import Leaves, spread_of

        cuts = list(self.pyramid.cuts(begin, end, thresholds, least))
        sizes = np.array([[len(leaves) for leaves in node] for node in cuts])
        whole = [self._gaussians(Leaves.joined([node[k] for node in cuts])) for k in range(sizes.shape[1])]
        made = []
        for node, size, last in zip(cuts, sizes, np.cumsum(sizes, axis=0), strict=True):
            gaussians = [each.take(np.arange(e - n, e)) for each, n, e in zip(whole, size, last, strict=True)]
            made.append(TileGaussians(gaussians, [spread_of(leaves) for leaves in node], self._normals(node[0])))
        return made

    def over_tiles(self, threshold: float) -> tuple[Gaussians, np.ndarray | None] | None:
        """Return the Gaussians, and normals, of cells that stand for several tiles each; None if there are none."""
        leaves = self.pyramid.leaves_over_tiles(threshold)
        return None if leaves is None else (self._gaussians(leaves), self._normals(leaves))

    def _gaussians(self, leaves: Leaves) -> Gaussians:
        return as_stored(self.pyramid.gaussians_of(leaves))

    def _normals(self, leaves: Leaves) -> np.ndarray | None:
        """Return the normals (n, 3) of cells; None without a light."""
        from vvgt_cli.closed_form.lit import MEAN, directions

        return None if self.pyramid.shading is None else directions(leaves.moments[:, COLUMNS:][:, MEAN])


@dataclass(frozen=True)
class TreeBlocks:
    """The task of saving the trees of each block's tiles."""

    cut: Cut
    kind: str = TREES

    def __len__(self) -> int:
        """Return the number of blocks."""
        return len(self.cut.plan.grid.blocks)

    def __call__(self, number: int) -> None:
        """Save the trees of block ``number``."""
        self.cut.pyramid.save(number)


@lru_cache(maxsize=1)  # a worker opens it once for all of its tasks
def open_cut(store: BlockStore, key: str) -> Cut:
    """Return the cut of blocks whose summaries are gathered.

    Args:
        store: the blocks.
        key: see `Cut`.

    Raises:
        DataError: a file is missing or damaged.
    """
    from vvgt_cli.field.tiles import TiledPyramid

    plan = CutPlan.load(store)
    light = load_light(store, plan)
    return Cut(TiledPyramid.load(store, plan.grid, plan.size, plan.labels, light, plan.degree), plan, key)


def cut_of(run: Run, run_pass: Pass) -> Cut:
    """Return the pyramid of all blocks, ready to be cut.

    Args:
        run: gets a stage.
        run_pass: runs passes over the blocks.

    Raises:
        NothingVisible: nothing is visible from any view.
        DataError: blocks are missing or damaged.
    """
    from vvgt_cli.field.tiles import gather

    store = run_pass.store
    plan = CutPlan.load(store)
    lit = SHADE if load_light(store, plan) else ()
    run.compile(for_degree((*MERGE, *lit), plan.degree))
    with run.stage("pyramid") as stage:
        store.prepare(COARSE)
        if store.missing(COARSE, [0]):
            gather(store, plan.grid)
        open_cut.cache_clear()  # an earlier run's
        cut = open_cut(store, digest(*((store.folder / name).read_text("utf-8") for name in (PLAN, RUN)))[:16])
        open_cut.cache_clear()  # this process holds the cut itself
        run_pass(TreeBlocks(cut), "pyramid", cut.pyramid.blocks)
        stage.note = f"{cut.pyramid.base} cells in {len(cut.pyramid)} tiles"
    if not len(cut.pyramid):
        raise NothingVisible(plan.volume["name"], plan.function["name"])
    return cut


@dataclass(frozen=True)
class CutPlan:
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
            write_arrays(store.folder / LIGHT, light._asdict())
        write_text(store.folder / PLAN, json.dumps(plain(asdict(self)), indent=1), overwrite=True)

    @classmethod
    def load(cls, store: BlockStore) -> CutPlan:
        """Read the plan beside blocks; raise DataError if it is missing or damaged."""
        path = store.folder / PLAN
        try:
            content = json.loads(path.read_text("utf-8"))
            grid, ply = content["grid"], content["ply"]
            boxes = Boxes(*(tuple(grid["blocks"][key]) for key in ("dims", "edge")))
            grid = CellGrid(**{**{key: _tupled(value) for key, value in grid.items()}, "blocks": boxes})
            options = PlyOptions(**{key: _tupled(value) for key, value in ply.items()})
            if options.light is not None:
                light = {key: _tupled(value) for key, value in ply["light"].items()}
                options = replace(options, light=Lighting(**light))
            return replace(cls(**{**content, "grid": grid, "ply": options}), axes=tuple(content["axes"]))
        except FileNotFoundError:
            raise DataError(
                f"{path}: missing, since not all shards have counted their blocks; run the same array again"
            ) from None
        except (ValueError, KeyError, TypeError) as error:
            raise DataError(f"{path}: damaged ({error}); remove it and run a shard again") from error


def load_light(store: BlockStore, plan: CutPlan) -> Light | None:
    """Read the light beside a plan, None for none; raise DataError if the file is missing or damaged."""
    if plan.ply.light is None:
        return None
    path = store.folder / LIGHT
    try:
        with np.load(path) as arrays:
            return Light(**{key: arrays[key] if arrays[key].ndim else arrays[key].item() for key in Light._fields})
    except (OSError, ValueError, KeyError) as error:
        raise DataError(f"{path}: damaged ({error}); remove {PLAN} beside it and run a shard again") from error


def _tupled(value: Any) -> Any:
    return tuple(map(_tupled, value)) if isinstance(value, list) else value


def disk_bytes(grid: CellGrid, voxels: float, budget: int, rays: int, lit: bool, degree: int) -> int:
    """Estimate the bytes of blocks and output on disk, for ``voxels`` that are visible and ``rays`` that are marched.

    With ``lit`` cells have normals; ``degree`` is that of the Gaussians' harmonics.
    """
    cells = voxels / float(grid.cell.prod())
    met = rays * max(grid.blocks.shape) / 2  # blocks along a ray, half of which show something of it
    coarse = math.prod(-(-grid.dims // grid.tile)) * grid.tile_cells**3 * (8 / 8**grid.march + 4 / 8**grid.field)
    row, vertex = ROW + A_SCORE + A_NORMAL * lit, VERTEX_BYTES + HARMONIC_BYTES[degree]
    return int(cells * row + coarse + met * A_RAY + KEPT * min(budget, cells) * vertex)


def save(
    store: BlockStore, kind: str, number: int, nodes: Sequence[TileGaussians], more: dict[str, np.ndarray]
) -> None:
    """Save nodes of one part."""
    arrays: dict[str, np.ndarray] = {
        "counts": np.array([[len(level) for level in node.levels] for node in nodes]),
        "spreads": np.array([node.spreads for node in nodes]),
    }
    if nodes[0].normals is not None:
        arrays["normals"] = np.concatenate([node.normals for node in nodes])
    for k in range(len(nodes[0].levels)):
        whole = concatenate([node.levels[k] for node in nodes]).arrays()
        arrays |= {f"{name}-{k}": array for name, array in whole.items()}
    store.save(kind, number, **(more | arrays))


@dataclass(frozen=True)
class StoredGaussians:
    """The Gaussians of a cut, in the store.

    Attributes:
        store: store of the parts.
        kind: kind of the results.
        ends: end of each part's range of nodes.
    """

    store: BlockStore
    kind: str
    ends: tuple[int, ...]

    def level(self, k: int, begin: int, end: int) -> Iterator[Gaussians]:
        """Yield the Gaussians of level ``k`` of nodes ``begin`` to ``end``; raise DataError if a part is damaged."""
        for number in range(int(np.searchsorted(self.ends, begin, "right")), len(self.ends)):
            first = self.ends[number - 1] if number else 0
            if first >= end:
                return
            names = [one for one in self.store.names(self.kind, number) if one.endswith(f"-{k}")]
            part = self.store.load(self.kind, number, names=["counts", *names])
            whole, counts = Gaussians(**{name.rpartition("-")[0]: part[name] for name in names}), part["counts"][:, k]
            for row, (n, e) in enumerate(zip(counts, np.cumsum(counts), strict=True), first):
                if begin <= row < end:
                    yield whole.take(np.arange(e - n, e))

    def parts(self) -> Iterator[tuple[Gaussians, np.ndarray | None]]:
        """Yield the Gaussians of the first level and their normals, None without a light, part by part."""
        for number in range(len(self.ends)):
            part = self.store.load(self.kind, number)
            named = {name.removesuffix("-0"): array for name, array in part.items() if name.endswith("-0")}
            yield Gaussians(**named), part.get("normals")

    def field(self, name: str) -> np.ndarray:
        """Return an array of all parts: "counts" or "spreads" of nodes' levels, "opacity_logits-0" of Gaussians."""
        parts = [self.store.load(self.kind, number, names=[name])[name] for number in range(len(self.ends))]
        return np.concatenate(parts)

    def errors(self) -> CutErrors:
        """Return the errors of refined levels."""
        fields = {name: self.field(name) for name in FIELDS}
        return CutErrors(np.zeros(fields["counts"].shape[1]), **fields)


@dataclass(frozen=True)
class FinishedParts:
    """The Gaussians of a cut, on disk part by part.

    Attributes:
        cut: the cut.
        threshold: threshold of scores of its cells.
        stored: Gaussians of cells within tiles.
        over: Gaussians and normals of cells that stand for several tiles each; None if there are none.
        removed: how many Gaussians fewer than the budget there are because they would be faint.
    """

    cut: Cut
    threshold: float
    stored: StoredGaussians
    over: tuple[Gaussians, np.ndarray | None] | None
    removed: int = 0

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return int(self.stored.field("counts").sum()) + (0 if self.over is None else len(self.over[0]))

    def __iter__(self) -> Iterator[tuple[Gaussians, np.ndarray | None]]:
        """Yield Gaussians, box frame, and normals, None without a light, of each part."""
        yield from self.stored.parts()
        if self.over is not None:
            yield self.over

    def gathered(self) -> Gaussians:
        """Return all Gaussians, box frame."""
        return concatenate([gaussians for gaussians, _ in self])

    def why_fewer(self) -> str:
        """Return the reason, to end a message with, why there are fewer Gaussians than the budget, if so."""
        from vvgt_cli.closed_form.closed_form import NEARLY

        budget = self.cut.plan.budget
        if self.removed or len(self) + 7 >= NEARLY * budget:
            return ""
        return f", no more: {self.cut.pyramid.base} cells suffice for the screen and {budget} Gaussians"


@dataclass(frozen=True)
class Levels:
    """The levels of every tile, on disk part by part.

    Attributes:
        cut: the pyramid that they are cut from.
        stored: their Gaussians.
        errors: errors of the cuts that they were chosen from, or their own where they are refined.
        choices: (tiles, levels) columns of ``errors``.
        removed: how many Gaussians fewer than the budget the finest has because they would be faint.
    """

    cut: Cut
    stored: StoredGaussians
    errors: CutErrors
    choices: np.ndarray
    removed: int = 0
