"""Pages that cast rays, under looks that they were not made with, against `vvgt render` of the volume.

python benchmarks/page.py SCENES.tsv DATA FUNCTIONS -o page.csv [--scene NAME] [--kind KIND] [--size PX]
    [--pictures FOLDER]
python benchmarks/page.py --table page.csv

Needs Chromium, node and npm, as `make viewers` does. A scene's options are --spacing, --crop, --layer and --labels, its
functions are files in FUNCTIONS or names, separated by spaces; "-": its own look. "first" and "rest" are PSNR in dB of
one frame and of 8 jittered ones, on strips of the first view of an orbit, as WebGL in software is slow. The kind "cut"
shows the upper half of x (of an upright volume), by a box on the page and by --crop. A function in a -labels.json file
is a table of labels.
"""

from __future__ import annotations

import base64
import json
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from closed_form import scene_rows
from dvr_scenes import print_table, write_rows

import vvgt_cli as vvgt
from vvgt_cli.field.source import load
from vvgt_cli.gaussians import PlyOptions
from vvgt_cli.gaussians.formats.page_look import look_entry
from vvgt_cli.images import read_png
from vvgt_cli.images.metrics import psnr
from vvgt_cli.library.inputs import Look, Reading, source_of

sys.path.append(str(Path(__file__).parent.parent / "tests"))
from browser import first_of_orbit
from test_page_where import Person

FRAMES = {"first": 1, "rest": 8}
STRIPS, ROWS = 8, 8  # of a picture, for want of time in software
KINDS = {
    "unlit": (0, "none", None),
    "lit": (0, "headlight", None),
    "mip": (1, "none", "mip"),
    "xray": (2, "none", "xray"),
    "cut": (0, "none", None),
}  # number on the page, light, rule
CAMERA = """(async () => {
  const { lens } = vvgt.where, { position, target } = FIRST;
  const away = position.map((x, k) => x - target[k]), distance = Math.hypot(...away);
  lens.set({ ...lens.pose(), target, distance });
  lens.set({ ...lens.pose(), ...lens.toward(away.map((x) => x / distance), [0, 1, 0]) });
  lens.middle = [SIZE / 2, SIZE / 2];
  await new Promise((done) => vvgt.viewer.app.once('frameend', done));
})()"""
LOOK = """(async () => {
  const { look } = vvgt.live, { layers, light, kind, cut, frames, tops, rows } = JOB;
  layers.forEach(({ nodes, labels, unit_distance, opacity_unit_distance }, k) => {
    Object.assign(look.layers[k], { unit_distance, opacity_unit_distance });
    if (labels.length) look.labels(labels, k);
    else look.apply(nodes, k);
  });
  look.light(light);
  look.draw(kind);
  vvgt.live.cut.change({ kind: 'box', box: [cut, 1, 0, 1, 0, 1] });
  const all = document.createElement('canvas'), to = all.getContext('2d'), begun = performance.now();
  [all.width, all.height] = [SIZE, tops.length * rows];
  for (const [k, top] of tops.entries()) {
    to.drawImage(await look.picture([SIZE, rows], frames, [0, top, SIZE, top + rows]), 0, k * rows);
  }
  return [all.toDataURL('image/png').split(',')[1], performance.now() - begun];
})()"""


def reading_and_look(options: str, data: Path) -> tuple[Reading, Look]:
    """What a scene's options say: --spacing X Y Z, --crop, --layer (files in ``data``) and --labels."""
    words, reading, look = shlex.split(options), Reading(), Look()
    while words:
        option = words.pop(0)
        if option == "--spacing":
            reading["spacing"] = tuple(float(words.pop(0)) for _ in range(3))
        elif option == "--crop":
            reading["crop"] = words.pop(0)
        elif option == "--layer":
            look = replace(look, layers=(*look.layers, str(data / words.pop(0))))
        else:
            table = words.pop(0)
            look = replace(look, labels=table if table == "auto" else str(data / table))
    return reading, look


def entry(file: str, look: Look, reading: Reading) -> dict[str, Any]:
    """A look as a page has it."""
    source = load(source_of(file, look, reading))
    values = source.values()
    assert values is not None
    return look_entry(values, PlyOptions(scale=source.volume.unit_frame().scale, up="z", light=source.lighting))


def moved(cameras: dict[str, Any], whole: vvgt.Volume, part: vvgt.Volume) -> dict[str, Any]:
    """Cameras of a volume as its part has them: a file's unit frame is that of its own box."""
    old, new = whole.unit_frame(), part.unit_frame()
    for frame in cameras["frames"]:
        for row, before, after in zip(frame["transform_matrix"][:3], old.centre, new.centre, strict=True):
            row[3] = (row[3] / old.scale + before - after) * new.scale
    return cameras


def tops(size: int) -> list[int]:
    """The first row of each strip."""
    return [(2 * k + 1) * size // (2 * STRIPS) - ROWS // 2 for k in range(STRIPS)]


def strips(picture: np.ndarray) -> np.ndarray:
    """What is scored of a picture (size, size, n)."""
    return np.concatenate([picture[top : top + ROWS] for top in tops(len(picture))])


def pictures(
    person: Person, look: dict[str, Any], kind: int, cut: float, size: int, out: Path
) -> dict[str, np.ndarray]:
    """Strips of pictures by the page, by `FRAMES`."""
    found = {}
    for name, frames in FRAMES.items():
        job = json.dumps({**look, "kind": kind, "cut": cut, "frames": frames, "tops": tops(size), "rows": ROWS})
        content, took = person("eval", LOOK.replace("JOB", job).replace("SIZE", str(size)))
        file = out.with_name(f"{out.stem}-{name}.png")
        file.write_bytes(base64.b64decode(content))
        print(f"{file.name}: {took / 1000:.1f} s", flush=True)
        found[name] = read_png(file)[..., :3]
    return found


@click.command()
@click.argument("paths", nargs=-1)
@click.option("-o", "--output")
@click.option("--scene", "names", multiple=True)
@click.option("--kind", "kinds", multiple=True, type=click.Choice(list(KINDS)), default=list(KINDS))
@click.option("--size", default=800)
@click.option("--pictures", "folder", default="out/page", type=click.Path(path_type=Path, resolve_path=True))
@click.option("--table", "table")
def main(
    paths: tuple[str, ...], output: str | None, names: tuple[str, ...], kinds: tuple[str, ...], size: int,
    folder: Path, table: str | None,
) -> None:  # fmt: skip
    """See the module."""
    if table:
        print_table(table)
        return
    folder.mkdir(parents=True, exist_ok=True)
    listing, data, functions = map(Path, paths)
    rows, opened, person = [], "", None
    for name, volume, options, function in scene_rows(listing, names):
        file = volume if volume.startswith("example:") else str(data / volume)
        reading, begun = reading_and_look(options, data)
        page = folder / f"{name}.html"
        volume = load(source_of(file, begun, reading)).volume
        width, turned = volume.dims[0], volume.axes[0, 0] < 0
        begin, _, rest = reading.get("crop", ":,:,:").partition(":")
        first, rest = int(begin or 0), rest.partition(",")[2]
        x = f"{first}:{first + width - width // 2}" if turned else f"{first + width // 2}:{first + width}"
        half, share = Reading(crop=f"{x},{rest}"), width // 2 / width
        if not page.exists():
            vvgt.convert(file, begun, page, max_gaussians=500, screen=64, steps=0, **reading)
        person = person or Person((size, size))
        if opened != name:
            person("open", page.as_uri())
            person("eval", "vvgt.live.look.show(true)")
            person("eval", CAMERA.replace("SIZE", str(size)).replace("FIRST", json.dumps(first_of_orbit())))
            opened = name
        for one in function.split():
            tf = None if one == "-" else functions / one if (functions / one).exists() else one
            table = one.endswith("-labels.json")
            distance = "mean-spacing" if one.endswith(".json") else None  # what a crop does not change
            for kind in kinds:
                number, light, rule = KINDS[kind]
                if number and (begun.layers or tf is None or table):
                    continue
                look = replace(begun, opacity_unit_distance=distance, light=light, **{"labels" if table else "tf": tf})
                cut = kind == "cut"
                out = folder / f"{name}-{Path(one).stem}-{kind}"
                own = out.with_name(f"{out.stem}.{size}.png")
                if not own.exists():
                    views = folder / name / "transforms.json"
                    if cut and not views.exists():
                        vvgt.render(file, views.parent, begun, orbit=1, size=size, **reading)
                        kept = load(source_of(file, begun, reading | half)).volume
                        views.write_text(json.dumps(moved(json.loads(views.read_text()), volume, kept)))
                    vvgt.render(
                        file, own, look, camera=views if cut else None, size=size, rule=rule,
                        background=None if rule else (0, 0, 0), **(reading | half if cut else reading),
                    )  # fmt: skip
                found = pictures(person, entry(file, look, reading), number, share if cut else 0, size, out)
                scores = {how: psnr(strips(read_png(own)[..., :3]), picture) for how, picture in found.items()}
                rows.append({"scene": name, "function": Path(one).stem, "kind": kind, "size": size, **scores})
                print(rows[-1], flush=True)
    write_rows(output, rows)
    assert person is not None
    person.process.communicate(timeout=60)


if __name__ == "__main__":
    main()
