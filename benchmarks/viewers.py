"""What web viewers draw of a volume's Gaussians, in every format that they read: docs/viewers.md, Comparison.

python benchmarks/viewers.py VOLUME --tf FUNCTION [--viewer NAME]... [--format .spz]... --pictures FOLDER

Needs Chromium, node and npm, as `make viewers` does. FOLDER keeps the files, and sheet.png: the volume, then every
picture, a quarter as wide, in the order of the rows. Prints a row for each (dB of the viewer against the volume, of our
drawing against it, and between the two), then the table.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.boxed import render_in_box
from vvgt_cli.commands.main import run
from vvgt_cli.conversion.gaussian_files import layout_of
from vvgt_cli.conversion.place import upright_axes
from vvgt_cli.dvr import render_view
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import in_unit_frame, read_ply
from vvgt_cli.gaussians.formats import encoded, format_of
from vvgt_cli.gaussians.frames import up_matrix, upright_matrix
from vvgt_cli.images import write_png
from vvgt_cli.images.metrics import psnr
from vvgt_cli.splat import render

sys.path.append(str(Path(__file__).parent.parent / "tests"))
from browser import shoot

VIEW, SIZE, WIDE = 3, 1080, 6  # test view, pixels of a picture, pictures across the sheet
VIEWERS = {  # page of tests/viewers: rule, options of the page, formats that it reads
    "supersplat": ("playcanvas", "", (".ply", ".compressed.ply", ".sog")),
    "playcanvas": ("playcanvas", "", (".ply", ".compressed.ply", ".sog")),
    "spark": ("spark", "", (".ply", ".compressed.ply", ".spz", ".sog")),
    "three": ("three", "stored", (".ply", ".spz", ".glb")),
    "babylon": ("babylon", "", (".ply", ".compressed.ply", ".spz", ".sog", ".glb")),
    "cesium": ("cesium", "", (".spz",)),
    "splats3d": ("viser", "", (".ply", ".compressed.ply")),
    "gsplatjs": ("viser", "", (".ply",)),
}
FORMATS = (".ply", ".compressed.ply", ".spz", ".sog", ".glb")


Row = tuple[float, float, float]  # dB: viewer against the volume, our drawing against it, viewer against our drawing


def compared(
    path: Path, volume: np.ndarray, viewers: tuple[str, ...], formats: tuple[str, ...], shots: list[np.ndarray]
) -> dict[tuple[str, str], Row]:
    """The rows of viewers and formats, printed as they come; pictures are added to ``shots``."""
    stored, header = read_ply(path)
    camera = default_views("test", size=SIZE)[VIEW]
    turn = up_matrix(header.up) @ upright_matrix(header.up).T  # from z up to the axes of the file
    seen = replace(camera, rotation=camera.rotation @ turn.T)
    found = {}
    for ending in formats:
        file = path.with_suffix(ending)
        if ending != ".ply":
            gaussians = in_unit_frame(stored, header)
            file.write_bytes(encoded(format_of(file), gaussians, layout_of(header), file.name))
        for viewer in viewers:
            rule, options, read = VIEWERS[viewer]
            if ending in read:
                shots += shoot(viewer, file, [seen], SIZE, path.parent, options)
                ours = np.clip(render(stored, seen, rule=rule)[..., :3], 0, 1)
                row = psnr(volume, shots[-1]), psnr(volume, ours), psnr(ours, shots[-1])
                found[viewer, ending] = row
                click.echo(f"{viewer},{ending},{row[0]:.2f},{row[1]:.2f},{row[2]:.2f}")
    return found


def table(found: dict[tuple[str, str], Row], formats: tuple[str, ...]) -> str:
    """Markdown: dB against the volume of our drawing and of each format, with dB against our drawing in brackets."""
    lines = [f"| | our drawing | `{'` | `'.join(formats)}` |", "| --- " * (len(formats) + 2) + "|"]
    for viewer, ours in {viewer: row[1] for (viewer, _), row in found.items()}.items():
        rows = [found.get((viewer, ending)) for ending in formats]
        cells = [f"{row[0]:.1f} ({row[2]:.1f})" if row else "" for row in rows]
        lines.append(f"| {viewer} | {ours:.1f} | {' | '.join(cells)} |")
    return "\n".join(lines)


@click.command()
@click.argument("volume")
@click.option("--tf", required=True)
@click.option("--max-gaussians", default="50000", show_default=True)
@click.option("--steps", default="32", show_default=True)
@click.option("--viewer", "viewers", multiple=True, type=click.Choice(list(VIEWERS)), default=list(VIEWERS))
@click.option("--format", "formats", multiple=True, type=click.Choice(FORMATS), default=FORMATS)
@click.option("--pictures", required=True, type=click.Path(path_type=Path), help="Folder of files and pictures.")
def main(
    volume: str, tf: str, max_gaussians: str, steps: str, viewers: tuple[str, ...], formats: tuple[str, ...],
    pictures: Path,
) -> None:  # fmt: skip
    """Convert VOLUME and compare what viewers draw of it."""
    pictures.mkdir(parents=True, exist_ok=True)
    path, look = pictures / "splats.ply", ("--tf", tf, "--opacity-unit-distance", "mean-spacing", "--screen", str(SIZE))
    count = ("--max-gaussians", max_gaussians, "--steps", steps)
    if run(["convert", volume, *look, *count, "--quiet", "--overwrite", "-o", str(path)]):
        raise SystemExit(1)
    source = load(SourceRequest(volume, tf=tf, unit_distance="mean-spacing"))
    scene, axes = source.scene(), upright_axes(source.volume, read_ply(path)[1].up)
    camera = default_views("test", size=SIZE)[VIEW]
    shots = [np.clip(render_in_box(lambda one: render_view(scene, one), axes)(camera)[..., :3], 0, 1)]
    click.echo(table(compared(path, shots[0], viewers, formats, shots), formats))
    small = [shot[::4, ::4] for shot in shots] + [np.zeros_like(shots[0][::4, ::4])] * (-len(shots) % WIDE)
    write_png(pictures / "sheet.png", np.vstack([np.hstack(small[k : k + WIDE]) for k in range(0, len(small), WIDE)]))


if __name__ == "__main__":
    main()
