"""What web viewers draw of a volume's Gaussians, unlit and lit, in every format that they read: docs/log/viewers.md.

python benchmarks/viewers.py VOLUME [--tf TF] [--viewer NAME]... [--format .spz]... --pictures FOLDER [--page PAGE]

Needs Chromium, node and npm, as `make viewers` does. FOLDER keeps the files, and sheet.png: every picture, a quarter as
wide, in the order of the rows, which are printed (viewer, format, unlit or lit, dB of its picture against our drawing
by its rule, side of the highlights). Then the table: with --page, in place of the one there. A picture that FOLDER has
of the same bytes and version is not taken again: a command that was stopped goes on.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import date
from hashlib import sha256
from pathlib import Path

import click
import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.commands.main import run
from vvgt_cli.conversion.gaussian_files import layout_of
from vvgt_cli.gaussians import Gaussians, in_unit_frame, read_ply
from vvgt_cli.gaussians.formats import SUFFIXES, encoded, format_of
from vvgt_cli.gaussians.frames import transform, up_matrix, upright_matrix
from vvgt_cli.images import read_png, write_png
from vvgt_cli.images.metrics import psnr
from vvgt_cli.splat import render

sys.path.append(str(Path(__file__).parent.parent / "tests"))
from browser import packages, shoot

VIEW, SIZE, WIDE = 3, 400, 6  # test view, pixels of a picture, pictures across the sheet
LIGHT = ("--light=-0.6,0.5,0.62", "--ambient", "0.2", "--diffuse", "0.5", "--specular", "0.5")  # from one side
SURE = 3  # dB by which the right side, or none, must be nearer than the other


@dataclass(frozen=True)
class Viewer:
    """A page of `tests/viewers`: the name and the npm package of its program, and how it draws and reads.

    Attributes:
        rule: the rule of our drawing.
        refused: endings that it does not read.
        options: of the page.
    """

    name: str
    package: str
    rule: str
    refused: tuple[str, ...] = ()
    options: str = ""


NOT_SPLATS = (".usdc", ".usdz", ".html")  # no program that draws USD's splats runs here; the page draws itself
FORMATS = tuple(ending for ending in SUFFIXES if ending not in NOT_SPLATS)
VIEWERS = {
    "supersplat": Viewer(
        "SuperSplat's viewer", "@playcanvas/supersplat-viewer", "playcanvas", (".spz", ".v4.spz", ".glb")
    ),
    "playcanvas": Viewer("PlayCanvas", "playcanvas", "playcanvas", (".spz", ".glb")),
    "spark": Viewer("Spark", "@sparkjsdev/spark", "spark", (".v4.spz", ".glb")),
    "three": Viewer("three.js", "three", "three", (".compressed.ply", ".sog"), "stored"),
    "babylon": Viewer("Babylon.js", "babylonjs", "babylon"),
    "cesium": Viewer("CesiumJS, in a tile", "cesium", "cesium", (".ply", ".compressed.ply", ".v4.spz", ".sog", ".glb")),
    "splats3d": Viewer(
        "GaussianSplats3D", "@mkkellogg/gaussian-splats-3d", "viser", (".spz", ".v4.spz", ".sog", ".glb")
    ),
    "gsplatjs": Viewer("gsplat.js", "gsplat", "viser", tuple(set(FORMATS) - {".ply"})),
}
NOT_RUN = "RealityKit, Scaniverse, Unity, Unreal; Omniverse and Houdini, for `.usdc` and `.usdz`"


def version(viewer: str) -> str:
    """Return the version of a viewer's program."""
    package = packages() / "node_modules" / VIEWERS[viewer].package / "package.json"
    return str(json.loads(package.read_text())["version"])


def picture(viewer: str, file: Path, seen: Camera) -> np.ndarray:
    """Return what a viewer draws of a file, (SIZE, SIZE, 3), kept beside the file as a `.png`."""
    digest = sha256(f"{version(viewer)} {SIZE} {seen.rotation.tolist()}".encode() + file.read_bytes()).hexdigest()
    kept = file.with_name(f"{viewer}-{file.name}-{digest[:12]}.png")
    if not kept.exists():
        write_png(kept, shoot(viewer, file, [seen], SIZE, file.parent, VIEWERS[viewer].options)[0])
    return read_png(kept)[..., :3]


Row = tuple[float, str] | None  # dB of a viewer's picture against our drawing, side of highlights; None: it fails


def side_of(shot: np.ndarray, stored: Gaussians, draw) -> str:  # type: ignore[no-untyped-def]
    """Return "right" or "wrong", by what is nearer to the picture: ours, or harmonics turned by 180 degrees."""
    if stored.harmonics is None:
        return ""
    turned = transform(stored, np.diag([-1.0, -1, 1])).harmonics
    right, wrong, none = (psnr(draw(replace(stored, harmonics=one)), shot) for one in (stored.harmonics, turned, None))
    return "right" if right > max(wrong, none) + SURE else "wrong" if wrong > none else "none"


def rows(
    path: Path, viewers: tuple[str, ...], formats: tuple[str, ...], shots: list[np.ndarray]
) -> Iterator[tuple[str, str, Row]]:
    """Viewer, format and row, None where the viewer fails to open the file; pictures are added to ``shots``."""
    stored, header = read_ply(path)
    camera = default_views("test", size=SIZE)[VIEW]
    turn = up_matrix(header.up) @ upright_matrix(header.up).T  # from z up to the axes of the file
    seen = replace(camera, rotation=camera.rotation @ turn.T)
    for ending in formats:
        file = path.with_suffix(ending)
        if ending != ".ply":
            gaussians = in_unit_frame(stored, header)
            file.write_bytes(encoded(format_of(file), gaussians, layout_of(header), file.name))
        for viewer in viewers:
            how = VIEWERS[viewer]

            def draw(gaussians: Gaussians, rule: str = how.rule) -> np.ndarray:
                return np.clip(render(gaussians, seen, rule=rule)[..., :3], 0, 1)

            if ending in how.refused:
                continue
            try:
                shots.append(picture(viewer, file, seen))
            except (AssertionError, subprocess.TimeoutExpired) as error:
                click.echo(f"{viewer} {ending}: {str(error).strip()[-300:]}", err=True)
                yield viewer, ending, None
                continue
            yield viewer, ending, (psnr(draw(stored), shots[-1]), side_of(shots[-1], stored, draw))


def table(found: dict[tuple[str, str], list[Row]], formats: tuple[str, ...], what: str) -> str:
    """Markdown: a line an engine, with dB unlit, dB lit and the side of highlights by format."""
    lines = [f"| {what} | `{'` | `'.join(formats)}` |", "| --- " * (len(formats) + 1) + "|"]
    for viewer in dict.fromkeys(name for name, _ in found):
        cells = []
        for ending in formats:
            pair = found.get((viewer, ending), [])
            said = [f"{row[0]:.1f} {row[1]}".strip() if row else "fails" for row in pair]
            cells.append(", ".join(said) or "not read")
        lines.append(f"| {VIEWERS[viewer].name} {version(viewer)} | {' | '.join(cells)} |")
    return "\n".join([*lines, f"| {NOT_RUN} | {' | '.join(['do not run here'] * len(formats))} |"])


@click.command()
@click.argument("volume")
@click.option("--tf")
@click.option("--max-gaussians", default="20000", show_default=True)
@click.option("--steps", default="32", show_default=True)
@click.option("--viewer", "viewers", multiple=True, type=click.Choice(list(VIEWERS)), default=list(VIEWERS))
@click.option("--format", "formats", multiple=True, type=click.Choice(FORMATS), default=FORMATS)
@click.option("--pictures", required=True, type=click.Path(path_type=Path), help="Folder of files and pictures.")
@click.option("--page", type=click.Path(exists=True, path_type=Path), help="Markdown whose table is replaced.")
def main(
    volume: str, tf: str | None, max_gaussians: str, steps: str, viewers: tuple[str, ...], formats: tuple[str, ...],
    pictures: Path, page: Path | None,
) -> None:  # fmt: skip
    """Convert VOLUME without and with a light, and compare what viewers draw of it with our drawing."""
    pictures.mkdir(parents=True, exist_ok=True)
    found, shots = dict[tuple[str, str], list[Row]](), list[np.ndarray]()
    for name, light in (("unlit", ("--light", "none")), ("lit", LIGHT)):
        path, look = pictures / f"{name}.ply", [*(("--tf", tf) if tf else ()), *light, "--screen", str(SIZE)]
        count = ("--max-gaussians", max_gaussians, "--steps", steps)
        if run(["convert", volume, *look, *count, "--quiet", "--overwrite", "-o", str(path)]):
            raise SystemExit(1)
        for viewer, ending, row in rows(path, viewers, formats, shots):
            found.setdefault((viewer, ending), []).append(row)
            click.echo(",".join([viewer, ending, name, *(f"{row[0]:.2f} {row[1]}".split() if row else ["fails"])]))
    text = table(found, formats, f"dB unlit, dB lit, highlights; {date.today()}")
    click.echo(text)
    if page:
        page.write_text(
            re.sub(r"\| dB unlit, dB lit.*?\n(?!\|)", lambda _: f"{text}\n", page.read_text(), flags=re.DOTALL)
        )
    small = [shot[::4, ::4] for shot in shots] + [np.zeros_like(shots[0][::4, ::4])] * (-len(shots) % WIDE)
    sheet = np.vstack([np.hstack(small[k : k + WIDE]) for k in range(0, len(small), WIDE)])
    write_png(pictures / "sheet.png", sheet, overwrite=True)


if __name__ == "__main__":
    main()
