"""Streamed levels: predicted and measured errors of nodes, texture along nodes' edges, and dB of what viewers show.

vvgt convert VOLUME --tf TF -o FOLDER/lod-meta.json
python benchmarks/levels.py FOLDER VOLUME --tf TF -o docs/levels.csv --plot docs/levels.png

Errors are those of the manifest (docs/scale.md): a node's level against its finest, from three sides. Edges are where
colours of the nodes' numbers change in a picture; the control are the middles of nodes, found in the same way. Both are
looked at where the volume's picture is opaque and smooth. dB are those of the levels that the engine shows at a
distance, nearer than `RADIUS` by a longer lens, which it counts like a shorter distance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from dvr_scenes import write_rows

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.sets import RADIUS
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.conversion.place import to_box_frame
from vvgt_cli.dvr import Scene, render_view
from vvgt_cli.field.source import SourceRequest, StyledVolume, load
from vvgt_cli.gaussians import Gaussians, in_unit_frame
from vvgt_cli.gaussians.formats.splats import gaussians_of
from vvgt_cli.gaussians.formats.streamed import MANIFEST, StreamedLevels, nodes_of, read_manifest
from vvgt_cli.gaussians.frames import up_matrix
from vvgt_cli.images.metrics import OPAQUE, SMOOTH, band
from vvgt_cli.score.viewing import VIEWS, near_cameras
from vvgt_cli.splat import render

DISTANCES = (3.5, 2.4, 1.2, 0.6)  # unit frame
CHANGE = 0.12  # of a channel of the nodes' colours across an edge
NEAR, FAR = 4, 12  # pixels from an edge within which something is at it, and beyond which it is inside


def errors(folder: Path) -> list[dict[str, Any]]:
    """A row a node and level but the finest, lengths in the unit frame."""
    manifest, rows = read_manifest(folder / MANIFEST), []
    scale = manifest["vvgt"]["scale"]
    for number, node in enumerate(nodes_of(manifest, folder)):
        for level in range(1, manifest["lodLevels"]):
            count = node["lods"][str(level)]["count"]
            told = {"spread": node["spreads"][level] / scale, "rms": node["rms"][level]}
            rows.append({"level": level, "node": number, "gaussians": count} | told)
    return rows


def rank_correlation(rows: list[dict[str, Any]]) -> float:
    """Spearman's, of prediction and measurement."""
    ranks = [np.argsort(np.argsort([row[key] for row in rows])) for key in ("spread", "rms")]
    return float(np.corrcoef(*ranks)[0, 1])


def near(mask: np.ndarray, reach: int) -> np.ndarray:
    """Pixels within ``reach`` along both axes of any of a mask."""
    for axis in (0, 1):
        shifted = [np.roll(mask, shift, axis) for shift in range(-reach, reach + 1)]
        mask = np.any(shifted, axis=0)
    return mask


def changes(picture: np.ndarray) -> np.ndarray:
    """Pixels (h, w) bool across which a picture's colours change."""
    found = [np.abs(picture[..., :3] - np.roll(picture[..., :3], 2, axis)).max(axis=2) for axis in (0, 1)]
    marked: np.ndarray = np.maximum(*found) > CHANGE
    return marked


def painted(folder: Path, level: int, gaussians: Gaussians) -> list[Gaussians]:
    """In eight colours: by the node that each is in, and by cubes between the middles of nodes (the control)."""
    nodes = nodes_of(read_manifest(folder / MANIFEST), folder)
    bounds = np.array([[node["bound"]["min"], node["bound"]["max"]] for node in nodes])
    counts = [node["lods"][str(level)]["count"] for node in nodes]
    parts = np.split(gaussians.means, np.cumsum(counts)[:-1])
    middles = np.array([(part.min(axis=0) + part.max(axis=0)) / 2 for part in parts])
    edge = np.median(bounds[:, 1] - bounds[:, 0]) / read_manifest(folder / MANIFEST)["vvgt"]["scale"]
    places, node = np.rint((middles - middles.min(axis=0)) / edge).astype(int), np.repeat(np.arange(len(nodes)), counts)
    above = gaussians.means > middles[node]
    plain = replace(gaussians, harmonics=None)
    found = (places[node] % 2, (places[node] + above) % 2)
    return [replace(plain, colors=(0.2 + 0.6 * bits).astype(np.float32)) for bits in found]


def edges(
    folder: Path, level: int, gaussians: Gaussians, drawn: Gaussians, scene: Scene, size: int
) -> list[list[float]]:
    """Squared texture, levels of 255, of what is drawn less volume: nodes' edges, their middles, elsewhere."""
    by_node, by_middle = painted(folder, level, gaussians)
    squares: list[list[float]] = [[], [], []]
    whole = default_views("test", size=size)
    for camera in near_cameras(size) if level == 0 else [whole[i] for i in VIEWS]:
        reference, ours = render_view(scene, camera), render(drawn, camera)
        edge, inner = (changes(render(some, camera)) for some in (by_node, by_middle))
        smooth = near(np.abs(band(reference)).max(axis=2) > SMOOTH, 2)
        shown = (reference[..., 3] > OPAQUE) & ~smooth
        found = np.square(band(ours) - band(reference)).mean(axis=2)
        masks = (near(edge, NEAR), near(inner, NEAR), ~near(edge | inner, FAR))
        for some, mask in zip(squares, masks, strict=True):
            some += found[mask & shown].tolist()
    return squares


def plot(rows: list[dict[str, Any]], target: Path) -> None:
    """Measured over predicted, a colour a level."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.4), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    for level in sorted({row["level"] for row in rows}):
        some = [row for row in rows if row["level"] == level]
        label = f"level {level}, rank correlation {rank_correlation(some):.2f}"
        axes.scatter([row["spread"] for row in some], [row["rms"] for row in some], s=9, label=label)
    axes.set(xscale="log", yscale="log", xlabel="predicted: spread of the moments, unit-frame lengths")
    axes.set_ylabel("measured: rms where the node is seen")
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(target, metadata={"Software": None})


def shown(folder: Path, source: StyledVolume, scene: Scene, size: int) -> Iterator[str]:
    """A line a distance: mean PSNR (dB) of what the engine shows."""
    levels = StreamedLevels(folder / MANIFEST)
    turned = up_matrix(gaussians_of(levels.level(None), str(folder))[1].up) @ source.volume.axes
    for distance in DISTANCES:
        squares = []
        for k in VIEWS:
            camera = default_views("test", size=size, radius=max(distance, RADIUS))[k]
            longer = max(RADIUS / distance, 1.0)
            camera = replace(camera, fx=longer * camera.fx, fy=longer * camera.fy)
            field = math.degrees(2 * math.atan(camera.height / camera.fy / 2))
            read = gaussians_of(levels.seen_from(turned @ camera.position, field), str(folder))
            drawn = render(to_box_frame(in_unit_frame(*read), source.volume), camera)
            squares.append(np.square(np.clip(drawn, 0, 1) - np.clip(render_view(scene, camera), 0, 1))[..., :3].mean())
        yield f"distance {distance}: {-10 * np.log10(np.mean(squares)):.1f} dB"


def textures(folder: Path, whole: tuple[Path, ...], source: StyledVolume, scene: Scene, size: int) -> Iterator[str]:
    """A line a level, and a line of each file at the pixels of the level of its place."""
    for level in range(read_manifest(folder / MANIFEST)["lodLevels"]):
        gaussians = to_box_frame(open_gaussians(f"{folder}#{level}")[0], source.volume)
        files = [str(file) for file in whole[level : level + 1]]
        for name in (f"level {level}", *files):
            drawn = to_box_frame(open_gaussians(name)[0], source.volume) if name in files else gaussians
            found = [np.array(some) for some in edges(folder, level, gaussians, drawn, scene, size)]
            told = [f"{np.sqrt(some.mean()):.2f} ({len(some)} px)" if len(some) else "none" for some in found]
            yield f"{name}: texture {told[0]} at edges, {told[1]} at middles, {told[2]} elsewhere, levels of 255"


@click.command()
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
@click.argument("volume")
@click.option("--whole", multiple=True, type=click.Path(path_type=Path), help="Of vvgt init, as large as a level.")
@click.option("--tf")
@click.option("--opacity-unit-distance", "distance")
@click.option("--size", type=int, default=720, show_default=True)
@click.option("-o", "output", type=click.Path(path_type=Path), required=True)
@click.option("--plot", "target", type=click.Path(path_type=Path), required=True)
def main(
    folder: Path,
    volume: str,
    whole: tuple[Path, ...],
    tf: str | None,
    distance: str | None,
    size: int,
    output: Path,
    target: Path,
) -> None:
    """See the module."""
    rows = errors(folder)
    write_rows(output, rows)
    plot(rows, target)
    print(f"{len(rows)} nodes and levels, rank correlation {rank_correlation(rows):.2f} over all")
    source = load(SourceRequest(volume, tf=tf, unit_distance=distance))
    scene = source.scene()
    for line in (*textures(folder, whole, source, scene, size), *shown(folder, source, scene, size)):
        print(line)


if __name__ == "__main__":
    main()
