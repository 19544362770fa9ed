"""Streamed SOG: spatial nodes in levels by measured error, in files of SOG images, with `lod-meta.json`.

The format is that of PlayCanvas 2.23.3 (`scene/gsplat-unified/gsplat-octree.js`, `gsplat-lod-table.js`) and
splat-transform 3.7.0 (`writers/write-lod.ts`). A node is a tile of the pyramid (`vvgt_cli.field.tiled_tree`), with
levels by `level_selection`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.shards.level_selection import measure_cuts
from vvgt_cli.conversion.shards.plan import PLAN
from vvgt_cli.conversion.shards.streamed_files import Files, Level, files_of
from vvgt_cli.errors import UsageError
from vvgt_cli.field.digests import digest
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.formats.page_file import upright
from vvgt_cli.gaussians.formats.splats import Splats, splats_of
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.gaussians.header import comment_lines
from vvgt_cli.score.record import Run, plain
from vvgt_cli.version import VERSION

if TYPE_CHECKING:
    from vvgt_cli.conversion.shards.cut import Cut, Node
    from vvgt_cli.conversion.shards.regions import Refiner
    from vvgt_cli.field.block_store import BlockStore

# Scale of the unit frame. The engine shows level 0 within 5 (`lodBaseDistance`) and level 1 within 15, so that the
# whole is seen in level 1 from where `vvgt render --orbit` begins, at 3 in the unit frame.
SCALE = 4.0
NEAREST = 5 / SCALE  # distance in the unit frame up to which level 0 is shown; each further level three times as far
REACH = 2.0  # standard deviations from the centres to the bounds of a node


@contextmanager
def folder_of(output: str) -> Iterator[None]:
    """Make the folder of a manifest, and remove it after the block if it is empty."""
    folder = Path(output).absolute().parent
    made = not folder.exists() and folder.parent.is_dir()
    if made:
        folder.mkdir()
    try:
        yield
    finally:
        if made:
            with suppress(OSError):
                folder.rmdir()


def write_streamed(
    run: Run,
    store: BlockStore,
    cut: Cut,
    output: str,
    overwrite: bool,
    refiner: Callable[[], Refiner | None] = lambda: None,
) -> None:
    """Write the files and, last, the manifest.

    Progress is recorded in ``store``: errors of groups of nodes, refined regions, and complete files.

    Args:
        run: gets the stages.
        store: blocks of the cut.
        cut: pyramid to take the levels from.
        output: path of the manifest.
        overwrite: replace an existing one.
        refiner: returns what refines the levels, each at the distance at which it is shown, or None.

    Raises:
        UsageError: the frame is not the unit frame.
    """
    if cut.plan.ply.frame != "unit":
        raise UsageError(f"-o {output}: levels need distances in the unit frame; remove --frame")
    tiled_tree = cut.tiled_tree
    with run.stage("errors") as stage:
        key = digest((store.folder / PLAN).read_text("utf-8"))[:16]
        errors = measure_cuts(cut, store, f"errors-{key}")
        choices = errors.levels()
        levels = [Level(number) for number in range(len(choices))]
        stage.note = f"{len(levels)} levels of {len(tiled_tree.tiles)} nodes"
    thresholds = errors.thresholds[np.stack(choices, axis=1)]
    groups = cut.nodes(thresholds)
    if (refine := refiner()) is not None:
        refined = refine(run, cut, thresholds, [NEAREST * 3 ** (level.number - 0.5) for level in levels])
        key, groups, errors = refined.key, refined.nodes(), refined.errors()
        choices = [np.full(len(tiled_tree.tiles), level.number) for level in levels]
    before, nodes, folder = files_of(Path(output)), list[dict[str, Any]](), Path(output).absolute().parent
    files = Files(folder, store, f"written-{digest(key, str(folder))[:16]}")
    with run.stage("write") as stage, atomic_write(Path(output), overwrite) as temporary:
        for some in groups:
            for node in some:
                own = [choice[len(nodes)] for choice in choices]
                nodes.append(_node(cut, files, levels, node) | errors.facts(len(nodes), own))
        for level in levels:
            files.write(level)
        facts = [errors.rms(choice) for choice in choices]
        temporary.write_text(
            json.dumps(plain(_manifest(cut, levels, files.names, nodes, facts)), separators=(",", ":"))
        )
        total = sum(level.bytes for level in levels)
        stage.note = f"{output}: {len(nodes)} nodes, {len(files.names)} files, {total / 1e6:.1f} MB; Gaussians "
        stage.note += ", ".join(f"{level.gaussians:,}" for level in levels)
        if levels[0].gaussians < cut.plan.budget // 2:
            stage.note += f", no more: {tiled_tree.base} cells suffice for the screen and {cut.plan.budget} Gaussians"
    files.remove_others(before)
    run.report.gaussians, run.report.bytes = levels[0].gaussians, total


def _node(cut: Cut, files: Files, levels: list[Level], node: Node) -> dict[str, Any]:
    """Add a node to the files, and return its entry in the manifest."""
    axes, options = (
        np.array(cut.plan.axes).reshape(3, 3),
        replace(upright(cut.plan.ply), sh_degree=cut.plan.degree, comments=False),
    )
    lods, low, high = {}, np.full(3, np.inf), np.full(3, -np.inf)
    for level, gaussians, spread in zip(levels, node.levels, node.spreads, strict=True):
        splats = _scaled(gaussians, axes, options)
        reach = REACH * np.exp(splats.log_scales.max(axis=1, keepdims=True))
        low = np.minimum(low, (splats.means - reach).min(axis=0))
        high = np.maximum(high, (splats.means + reach).max(axis=0))
        lods[str(level.number)] = files.add(level, splats)
        level.spread += spread
    return {
        "bound": {"min": low.tolist(), "max": high.tolist()},
        "lods": lods,
        "spreads": [SCALE * float(np.sqrt(square / weight)) for weight, square in node.spreads],
    }


def _scaled(gaussians: Gaussians, axes: np.ndarray, options: PlyOptions) -> Splats:
    splats = splats_of(transform(gaussians, axes), options)
    return replace(
        splats, means=splats.means * np.float32(SCALE), log_scales=splats.log_scales + np.float32(math.log(SCALE))
    )


def _manifest(
    cut: Cut, levels: list[Level], names: list[str], nodes: list[dict[str, Any]], errors: list[float]
) -> dict[str, Any]:
    low = np.min([node["bound"]["min"] for node in nodes], axis=0)
    high = np.max([node["bound"]["max"] for node in nodes], axis=0)
    comments = [line.removeprefix("comment ") for line in comment_lines(upright(cut.plan.ply))]
    facts = [
        {
            "gaussians": level.gaussians,
            "bytes": level.bytes,
            "files": level.files,
            "spread": SCALE * float(np.sqrt(level.spread[1] / level.spread[0])),
            "rms": errors[level.number],
        }
        for level in levels
    ]
    return {
        "version": 1,
        "asset": {"generator": f"vvgt {VERSION}"},
        "count": sum(level.gaussians for level in levels),
        "counts": [level.gaussians for level in levels],
        "lodLevels": len(levels),
        "lodErrors": True,
        "filenames": names,
        "tree": {"bound": {"min": low.tolist(), "max": high.tolist()}, "children": nodes},
        "vvgt": {"schema": 1, "scale": SCALE, "size": cut.plan.size, "levels": facts, "comments": comments},
    }
