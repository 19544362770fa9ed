"""Streamed SOG: spatial nodes in levels by measured error, in files of SOG images, with `lod-meta.json`.

The format is that of PlayCanvas 2.23.3 (`scene/gsplat-unified/gsplat-octree.js`, `gsplat-lod-table.js`) and
splat-transform 3.7.0 (`writers/write-lod.ts`). A node is a tile of the pyramid (`vvgt_cli.field.tiled_tree`), with
levels by `level_selection`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.conversion.shards.level_selection import measure_cuts
from vvgt_cli.conversion.shards.regions import make_regions
from vvgt_cli.conversion.shards.streamed_files import WrittenFiles, divide, files_of, remove_others
from vvgt_cli.errors import UsageError
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians.formats.page_file import upright
from vvgt_cli.gaussians.header import comment_lines
from vvgt_cli.score.record import Run, plain
from vvgt_cli.version import VERSION

if TYPE_CHECKING:
    from vvgt_cli.conversion.shards.cut import Cut
    from vvgt_cli.conversion.shards.level_selection import CutErrors
    from vvgt_cli.conversion.shards.regions import Refiner
    from vvgt_cli.field.blocked import Pass

# Scale of the unit frame. The engine shows level 0 within 5 (`lodBaseDistance`) and level 1 within 15, so that the
# whole is seen in level 1 from where `vvgt render --orbit` begins, at 3 in the unit frame.
SCALE = 4.0
NEAREST = 5 / SCALE  # distance in the unit frame up to which level 0 is shown; each further level three times as far


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
    run_pass: Pass,
    cut: Cut,
    output: str,
    overwrite: bool,
    refiner: Callable[[], Refiner | None] = lambda: None,
) -> None:
    """Write the files and, last, the manifest.

    Each pass leaves its results in the store: errors of nodes, their Gaussians, and complete files.

    Args:
        run: gets the stages.
        run_pass: runs passes over the blocks of the cut.
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
        errors = measure_cuts(run_pass, cut)
        choices = np.stack(errors.levels(), axis=1)
        stage.note = f"{choices.shape[1]} levels of {len(tiled_tree.tiles)} nodes"
    if (refine := refiner()) is not None:
        refine = replace(refine, distances=tuple(NEAREST * 3 ** (k - 0.5) for k in range(choices.shape[1])))
    made = make_regions(run, run_pass, cut, errors.thresholds[choices], refine)
    if refine is not None:
        errors, choices = made.errors(), np.tile(np.arange(choices.shape[1]), (len(choices), 1))
    target, counts = Path(output), made.field("counts")
    before, folder = files_of(target), target.absolute().parent
    parts, places = divide(counts)
    axes, options = np.array(cut.plan.axes).reshape(3, 3), replace(upright(cut.plan.ply), comments=False)
    task = WrittenFiles(made, parts, folder, axes, SCALE, replace(options, sh_degree=cut.plan.degree))
    with run.stage("write") as stage, atomic_write(target, overwrite) as temporary:
        task.forget_changed()
        run_pass(task, "write")
        spreads = made.field("spreads")
        levels = _levels(task, counts, spreads, errors, choices)
        rows = zip(*task.bounds(len(counts)), places, spreads, strict=True)
        nodes = [_node(*row) | errors.facts(k, choices[k].tolist()) for k, row in enumerate(rows)]
        temporary.write_text(json.dumps(plain(_manifest(cut, levels, task.names, nodes)), separators=(",", ":")))
        total = sum(level["bytes"] for level in levels)
        stage.note = f"{output}: {len(nodes)} nodes, {len(parts)} files, {total / 1e6:.1f} MB; Gaussians "
        stage.note += ", ".join(f"{level['gaussians']:,}" for level in levels)
        if levels[0]["gaussians"] < cut.plan.budget // 2:
            stage.note += f", no more: {tiled_tree.base} cells suffice for the screen and {cut.plan.budget} Gaussians"
    remove_others(folder, before, task.names)
    run.report.gaussians, run.report.bytes = levels[0]["gaussians"], total


def _node(low: np.ndarray, high: np.ndarray, lods: list[dict[str, int]], spreads: np.ndarray) -> dict[str, Any]:
    """Return the entry of a node."""
    return {
        "bound": {"min": low.tolist(), "max": high.tolist()},
        "lods": {str(k): place for k, place in enumerate(lods)},
        "spreads": [SCALE * float(np.sqrt(square / weight)) for weight, square in spreads],
    }


def _levels(
    task: WrittenFiles, counts: np.ndarray, spreads: np.ndarray, errors: CutErrors, choices: np.ndarray
) -> list[dict[str, Any]]:
    """Return what the manifest says of each level."""
    found = []
    for k, sums in enumerate(spreads.sum(axis=0)):
        own = [number for number, part in enumerate(task.parts) if part.level == k]
        found.append(
            {
                "gaussians": int(counts[:, k].sum()),
                "bytes": sum(task.size(number) for number in own),
                "files": len(own),
                "spread": SCALE * float(np.sqrt(sums[1] / sums[0])),
                "rms": errors.rms(choices[:, k]),
            }
        )
    return found


def _manifest(
    cut: Cut, levels: list[dict[str, Any]], names: Sequence[str], nodes: list[dict[str, Any]]
) -> dict[str, Any]:
    low = np.min([node["bound"]["min"] for node in nodes], axis=0)
    high = np.max([node["bound"]["max"] for node in nodes], axis=0)
    comments = [line.removeprefix("comment ") for line in comment_lines(upright(cut.plan.ply))]
    return {
        "version": 1,
        "asset": {"generator": f"vvgt {VERSION}"},
        "count": sum(level["gaussians"] for level in levels),
        "counts": [level["gaussians"] for level in levels],
        "lodLevels": len(levels),
        "lodErrors": True,
        "filenames": list(names),
        "tree": {"bound": {"min": low.tolist(), "max": high.tolist()}, "children": nodes},
        "vvgt": {"schema": 1, "scale": SCALE, "size": cut.plan.size, "levels": levels, "comments": comments},
    }
