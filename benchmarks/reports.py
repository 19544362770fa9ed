"""`vvgt report` of a list of scenes, and an index of them.

    PYTHONPATH=. python benchmarks/reports.py SCENES.tsv DATA_DIR TF_DIR -o docs/reports [--only SCENE] [-- OPTIONS ...]

The list has a line a scene: name, volume, options of reading, function, separated by tabs. Opacity is per mean spacing.
Scenes that have their report.json are left out, so that the same command goes on where it was. `index.md` holds a row a
scene, from the JSON. For a machine that does nothing else: runs are timed once. `--publish DIR` copies pages, curves
and numbers to DIR, as docs/reports has them: pictures as JPEG, without the machine's folders.
"""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import click
from closed_form import scene_rows

COLUMNS = ("quickest", "knee", "nearest", "3DGS", "iVR-GS setting")


def row(found: dict) -> dict[str, str]:
    """Seconds and dB of the runs that say most."""
    runs = {run["name"]: run for run in found["runs"]}
    by_label = {run["label"]: run for run in found["runs"]}
    front = found["front"]
    chosen = {"quickest": runs[front[0]], "knee": runs[found["knee"]], "nearest": runs[front[-1]]}
    chosen |= {name: by_label[name] for name in COLUMNS[3:] if name in by_label}
    return {
        name: f"{run['scores']['psnr']:.1f} dB, {run['cost']:.1f} s"
        + (f" ({run['label']})" if run["label"] != name else "")
        for name, run in chosen.items()
    }


def index(folder: Path) -> str:
    """A Markdown table of every report in ``folder``."""
    lines = ["# Reports", "", f"| scene | {' | '.join(COLUMNS)} |", "| --- |" + " --- |" * len(COLUMNS)]
    machines = set()
    for path in sorted(folder.glob("*/report.json")):
        found = json.loads(path.read_text("utf-8"))
        cells = row(found)
        name = path.parent.name
        lines.append(f"| [{name}]({name}/report.html) | {' | '.join(cells.get(c, '-') for c in COLUMNS)} |")
        machines.add(
            f"{found['machine']['cpu']}, {found['machine']['threads']} threads; vvgt {found['versions']['vvgt']}"
        )
    return "\n".join([*lines, "", *sorted(machines), ""])


PICTURE_OR_FOLDER = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=]+)|(?<![\w.:/<])/(?:[\w.-]+/)+(?=[\w.-]+)")


def shorter(found: re.Match[str]) -> str:
    """An embedded PNG as an embedded JPEG, a tenth as large; nothing in place of a folder."""
    import OpenImageIO as oiio

    if not found[1]:
        return ""
    with tempfile.TemporaryDirectory() as folder:
        png, jpeg = str(Path(folder) / "a.png"), str(Path(folder) / "a.jpg")
        Path(png).write_bytes(base64.b64decode(found[1]))
        image = oiio.ImageBuf(png)
        image.specmod().attribute("Compression", "jpeg:88")
        if not image.write(jpeg):
            raise SystemExit(image.geterror())
        return f"data:image/jpeg;base64,{base64.b64encode(Path(jpeg).read_bytes()).decode()}"


def publish(folder: Path, to: Path) -> None:
    """Each scene's page as NAME.html, its curve as NAME.png and its numbers as NAME.csv, and the index of them."""
    to.mkdir(parents=True, exist_ok=True)
    for path in sorted(folder.glob("*/report.html")):
        name = path.parent.name
        (to / f"{name}.html").write_text(PICTURE_OR_FOLDER.sub(shorter, path.read_text("utf-8")), "utf-8")
        shutil.copyfile(path.parent / "psnr-seconds.png", to / f"{name}.png")
        shutil.copyfile(path.parent / "report.csv", to / f"{name}.csv")
    (to / "index.md").write_text(index(folder).replace("/report.html)", ".html)"), "utf-8")


@click.command()
@click.argument("paths", nargs=3)
@click.option("-o", "--output", required=True, help="Folder: one within it a scene.")
@click.option("--only", multiple=True, help="Scenes to measure (default: all).")
@click.option("--publish", "to", help="Folder to copy pages to.")
@click.argument("options", nargs=-1, type=click.UNPROCESSED)
def main(paths, output, only, to, options):
    """Make every report that is not there yet."""
    scenes, data, functions = map(Path, paths)
    folder = Path(output)
    folder.mkdir(parents=True, exist_ok=True)
    for name, volume, reading, function in scene_rows(scenes):
        if (only and name not in only) or (folder / name / "report.json").exists():
            continue
        call = [sys.executable, "-m", "vvgt_cli.commands.main", "report", str(data / volume), *reading.split()]
        call += ["--tf", str(functions / function), "--opacity-unit-distance", "mean-spacing"]
        print(name, file=sys.stderr)
        subprocess.run([*call, "-o", str(folder / name), "--overwrite", *options], check=True)
    (folder / "index.md").write_text(index(folder), "utf-8")
    if to:
        publish(folder, Path(to))


if __name__ == "__main__":
    main()
