"""The index of several clouds of one run (frames, functions, labels): which file is what (docs/report.md)."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import read_text
from vvgt_cli.gaussians.formats import format_of
from vvgt_cli.gaussians.outputs import Output, write_text
from vvgt_cli.score.record import SCHEMA, ConversionReport, plain

FORMAT = "vvgt-clouds"
FRAMES, FUNCTIONS, LABELS = "frames", "functions", "labels"  # what the clouds are of one volume
INDEX = "index"  # in the place of a name
FIELD = re.compile(r"\{(?::0?\d{0,2}d)?\}")
_HEAD = 256  # characters that tell an index from another JSON file


def is_pattern(output: str) -> bool:
    """Whether an output's name has a place for a frame's number or a name, as ``out_{:04d}.ply``."""
    return FIELD.search(output) is not None


def function_name(tf: str) -> str:
    """Return the name of a function: its file's without folder and endings; of FILE#NAME the latter."""
    return tf.rpartition("#")[2] if "#" in tf else Path(tf).name.partition(".")[0]


def put_name(option: str, pattern: str, kind: str, stem: str) -> str:
    """Return a pattern with a frame's number, or the name of a function or label, in its place.

    Args:
        option: whose value the pattern is, for the message.
        pattern: such as ``out_{:04d}.ply`` or ``out_{}.ply``; a format of numbers is for `FRAMES` alone.
        kind: `FRAMES`, `FUNCTIONS` or `LABELS`.
        stem: the number or name; `INDEX` too.

    Raises:
        UsageError: not one such place.
    """
    places = FIELD.findall(pattern)
    if len(places) != 1 or set(FIELD.sub("", pattern)) & set("{}") or (places[0] != "{}" and kind != FRAMES):
        what = "frame's number, as out_{:04d}.ply" if kind == FRAMES else f"{kind[:-1]}'s name, as out_{{}}.ply"
        raise UsageError(f"{option} {pattern}: expected one place for the {what}")
    return pattern.replace(places[0], places[0].format(int(stem)) if stem.isdecimal() and kind == FRAMES else stem)


def index_path(pattern: str) -> str:
    """The index of the files of a pattern: ``out_index.json`` of ``out_{}.ply``, ``index.json`` of ``{}/out.ply``."""
    parts = Path(pattern).parts
    first = next(k for k, part in enumerate(parts) if is_pattern(part))
    name = FIELD.sub(INDEX, parts[first])
    if first == len(parts) - 1:
        known = format_of(name)
        name = name[: -len(known.suffix)] if known else str(Path(name).with_suffix(""))
    return str(Path(*parts[:first], f"{name}.json"))


def index_output(pattern: str) -> Output:
    """The index among the outputs of a run."""
    return Output("-o", index_path(pattern), (".json",), binary=False)


def entry(name: str, gaussians: int | None, size: int, psnr: float | None, **facts: Any) -> dict[str, Any]:
    """A cloud in an index, without its file."""
    scored = {} if psnr is None else {"psnr": psnr}
    return {"name": name, "gaussians": gaussians, "bytes": size, **scored, **facts}


def psnr_of(report: ConversionReport) -> float | None:
    """Mean over the test views, dB; None where none was drawn."""
    return None if report.scores is None else report.scores["psnr"]


def index_of(kind: str, volume: str, files: Sequence[dict[str, Any]], **facts: Any) -> dict[str, Any]:
    """The index as its JSON has it; each entry of ``files`` has its ``file`` beside the index."""
    found: dict[str, Any] = plain(
        {"format": FORMAT, "schema": SCHEMA, "kind": kind, "volume": volume, **facts, "files": list(files)}
    )
    return found


def write_index(path: str, index: dict[str, Any], overwrite: bool) -> None:
    """Write it, whole or not at all."""
    write_text(path, json.dumps(index, indent=1, allow_nan=False) + "\n", overwrite)


def is_index(path: str | Path) -> bool:
    """Whether a file is an index, by its beginning."""
    if not str(path).lower().endswith(".json") or not Path(path).is_file():
        return False
    with open(path, encoding="utf-8", errors="replace") as stream:
        return f'"{FORMAT}"' in stream.read(_HEAD)


def read_index(path: str | Path) -> dict[str, Any]:
    """An index's document.

    Raises:
        DataError: not one, one that names files outside its folder, or without any.
    """
    try:
        index: dict[str, Any] = json.loads(read_text(Path(path)))
        names = [PurePosixPath(row["file"]) for row in index["files"]]
        known = (index["format"], index["schema"]) == (FORMAT, SCHEMA)
        known = known and isinstance(index["kind"], str) and all(isinstance(row["name"], str) for row in index["files"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        known, names = False, []
    if not known or not names or any(name.is_absolute() or ".." in name.parts for name in names):
        raise DataError(f"{path}: not an index of 'vvgt convert' (schema {SCHEMA}) of one file or more")
    return index


def files_of(path: str | Path) -> list[tuple[str, str]]:
    """Name and file of each cloud of an index.

    Raises:
        DataError: as `read_index`; a file that is not there.
    """
    folder = Path(path).parent
    found = [(row["name"], folder / row["file"]) for row in read_index(path)["files"]]
    if gone := [file for _, file in found if not file.is_file()]:
        raise DataError(f"{path}: its file {gone[0]} is missing; run the conversion again")
    return [(name, str(file)) for name, file in found]
