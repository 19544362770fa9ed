"""Which facts of a file survive in which format, and through which program.

python benchmarks/kept.py -o docs/kept.csv [--modules FOLDER]
python benchmarks/kept.py --table docs/kept.csv

FOLDER is the node_modules with gltf-validator. splat-transform is taken from the path; what is not there is "not run".
A program reads a file and writes one of the same format; a fact is kept if our reader finds it in that.
"""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
from dvr_scenes import write_rows

from vvgt_cli.conversion.place import with_place
from vvgt_cli.errors import VvgtError
from vvgt_cli.gaussians import Gaussians, PlyHeader, PlyOptions, write_ply
from vvgt_cli.gaussians.formats import SUFFIXES, encoded, format_of, read_splats
from vvgt_cli.gaussians.header import MIP, Certificate
from vvgt_cli.volume import Volume

ENDINGS = [suffix for suffix in SUFFIXES if suffix != ".usdz"]  # which is a .usdc in a zip
NOT_RUN, YES, NO = "not run", "yes", "no"
FACTS: dict[str, Callable[[PlyHeader], bool]] = {
    "certificate": lambda header: header.certificate is not None,
    "place in the world": lambda header: header.affine is not None,
    "size, rule": lambda header: header.screen_size is not None and header.rule is not None,
    "unit distance": lambda header: header.unit_distance is not None,
}
VALIDATE = """
require('gltf-validator').validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[1])))
  .then(r => console.log(JSON.stringify(r.issues.messages)));
"""


def example() -> tuple[Gaussians, PlyOptions]:
    """A thousand Gaussians in a place, with every fact."""
    rng = np.random.default_rng(0)
    gaussians = Gaussians(
        rng.uniform(-0.9, 0.9, (1000, 3)), rng.uniform(-5, -3, (1000, 3)), rng.normal(size=(1000, 4)),
        rng.normal(size=1000), rng.uniform(0.1, 0.9, (1000, 3)),
    )  # fmt: skip
    volume = Volume(np.zeros((20, 20, 20), np.uint8), (0.5, 0.5, 0.5), (-40.0, 20.0, 90.0), space="RAS")
    certificate = Certificate(
        "head", "ab" * 32, "0123456789ab", 1080, "compensated", 40.0, 3, 160000, texture=(0.5, 0.4)
    )
    options = PlyOptions(unit_distance=0.5, screen_size=1080, rule="compensated", certificate=certificate)
    return gaussians, with_place(options, volume)


def marked(path: Path) -> str:
    """Whether a file says, in the way of its format, that opacity is compensated ("antialiased")."""
    content = path.read_bytes()
    if path.name.endswith(".ply"):
        return YES if f"comment {MIP}".encode() in content[:65536] else NO
    if path.name.endswith(".spz"):
        import gzip

        return YES if (content if content[:4] == b"NGSP" else gzip.decompress(content))[14] & 1 else NO
    if path.name.endswith(".sog"):
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return YES if json.loads(archive.read("meta.json")).get("model") == "antialiased" else NO
    return "no such mark"


def facts_of(path: Path) -> dict[str, str]:
    """Every fact of a file, yes or no."""
    try:
        header = read_splats(path)[1]
    except VvgtError as error:
        return {name: f"not read: {str(error).rpartition(': ')[2][:40]}" for name in (*FACTS, "antialiased")}
    return {name: YES if holds(header) else NO for name, holds in FACTS.items()} | {"antialiased": marked(path)}


def through_splat_transform(path: Path, out: Path) -> bool:
    """Read and written by splat-transform; False where it cannot."""
    program = shutil.which("splat-transform")
    if program is None:
        raise FileNotFoundError
    version = ["--spz-version", "4" if ".v4" in path.name else "3"] if path.suffix == ".spz" else []
    done = subprocess.run([program, "-q", "-g", "cpu", "-w", *version, path, out], capture_output=True)
    return done.returncode == 0 and out.exists()


def through_gsply(path: Path, out: Path) -> bool:
    """Read and written by gsply."""
    import gsply

    if path.name.endswith((".v4.spz", ".sog", ".glb", ".usdc", ".html")):
        return False
    if path.suffix == ".spz":
        gsply.write_spz(out, gsply.read_spz(path), version=3)
    else:
        data = gsply.plyread(path)
        gsply.plywrite(out, data, compressed=path.name.endswith(".compressed.ply"))
    return out.exists()


def through_usd(path: Path, out: Path) -> bool:
    """Flattened and exported by usd-core."""
    from pxr import Usd

    return path.suffix == ".usdc" and bool(Usd.Stage.Open(str(path)).Flatten().Export(str(out)))


PROGRAMS = {"splat-transform": through_splat_transform, "gsply": through_gsply, "usd-core": through_usd}


def validated(path: Path, modules: Path | None) -> str:
    """What Khronos' validator says of a .glb."""
    if path.suffix != ".glb":
        return ""
    if modules is None or shutil.which("node") is None:
        return NOT_RUN
    command = ["node", "-e", VALIDATE, str(path)]
    said = subprocess.run(command, env={**os.environ, "NODE_PATH": str(modules)}, capture_output=True, check=True)
    other = [m for m in json.loads(said.stdout) if "KHR_gaussian_splatting" not in m["message"] + m["pointer"]]
    return f"{len(other)} findings but the extension" if other else "nothing but the unknown extension"


@click.command()
@click.option("--output", "-o", type=click.Path(path_type=Path))
@click.option("--modules", type=click.Path(exists=True, path_type=Path))
@click.option("--table", type=click.Path(exists=True, path_type=Path))
def main(output: Path | None, modules: Path | None, table: Path | None) -> None:
    """Write the CSV, or print it as a table."""
    if table:
        with table.open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        merged: dict[tuple[str, ...], list[dict[str, str]]] = {}
        for row in rows:  # facts that share a fate share a row
            merged.setdefault((row["format"], *list(row.values())[2:-1]), []).append(row)
        print("| " + " | ".join(rows[0]) + " |\n" + "| --- " * len(rows[0]) + "|")
        for (ending, *fates), those in merged.items():
            facts = "; ".join(row["fact"] for row in those)
            print(f"| `{ending}` | {facts} | {' | '.join(fates)} | {those[0]['glTF validator']} |")
        return
    gaussians, options = example()
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for ending in ENDINGS:
            path = Path(folder) / f"ours{ending}"
            if ending == ".ply":
                write_ply(path, gaussians, options)
            else:
                path.write_bytes(encoded(format_of(path), gaussians, options, str(path)))
            through = {}
            for name, program in PROGRAMS.items():
                out = Path(folder) / f"{name}{ending}"
                try:
                    through[name] = facts_of(out) if program(path, out) else {}
                except (FileNotFoundError, ImportError):
                    through[name] = dict.fromkeys((*FACTS, "antialiased"), NOT_RUN)
            for fact, read in facts_of(path).items():
                others = {name: facts.get(fact, "-") for name, facts in through.items()}
                row = {"format": ending, "fact": fact, "read back by us": read, **others}
                found.append(row | {"glTF validator": validated(path, modules) if fact == "certificate" else ""})
    write_rows(output, found)


if __name__ == "__main__":
    main()
