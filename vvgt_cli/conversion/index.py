"""The index of several clouds of one run (frames, functions, labels) and their files (docs/report.md)."""

from __future__ import annotations

import bisect
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import read_text
from vvgt_cli.gaussians.formats import SUFFIXES, format_of, is_splats
from vvgt_cli.gaussians.formats.streamed import MANIFEST, is_streamed, split_name
from vvgt_cli.gaussians.outputs import Output, write_text
from vvgt_cli.score.record import SCHEMA, ConversionReport, plain
from vvgt_cli.volume.readers import volume_name
from vvgt_cli.volume.tiff.slices import matching

FORMAT = "vvgt-clouds"
FRAMES, FUNCTIONS, LABELS = "frames", "functions", "labels"  # kinds of batches
INDEX = "index"  # stem of the index
FIELD = re.compile(r"\{([^{}]*)\}")  # a place in the name of an output
_FRAME = re.compile(r"(step)?(:0?\d{0,2}d)?|time(:\d{0,2}(\.\d{1,2})?[efg])?|stem")  # what may stand in one
_HEAD = 256  # characters that tell an index from another JSON file


def is_pattern(output: str) -> bool:
    """Return whether an output has places for a frame's number, step, time or stem, or a name: ``out_{:04d}.ply``."""
    return FIELD.search(output) is not None


def function_name(tf: str) -> str:
    """Return the name of a function: that of its file without folder and endings, or NAME of FILE#NAME."""
    file, _, pick = tf.rpartition("#")
    if ":" in tf and not os.path.exists(file or tf):  # a colour map or levels, with numbers
        return tf
    return pick if file else Path(tf).name.partition(".")[0]


def put_name(
    option: str, pattern: str, kind: str, stem: str, facts: Mapping[str, Any] = MappingProxyType({})
) -> str:  # fmt: skip
    """Return a pattern with what stands for a frame, or the name of a function or label, in its places.

    Args:
        option: option with the pattern, for the message.
        pattern: ``out_{}.ply``; for `FRAMES` also ``out_{:04d}.ply``, ``{step}``, ``{time}`` and ``{stem}``.
        kind: `FRAMES`, `FUNCTIONS` or `LABELS`.
        stem: number or name.
        facts: "step", "time" and "stem" of a frame, as far as its input states them.

    Raises:
        UsageError: the pattern has no such place, one of them twice, or one that the input says nothing of.
    """
    places, what = FIELD.findall(pattern), f"{kind[:-1]}'s name, as out_{{}}"
    keys = [text.partition(":")[0] for text in places]
    known = all(_FRAME.fullmatch(text) if kind == FRAMES else not text for text in places)
    if not (known and 0 < len(keys) == len(set(keys))) or set(FIELD.sub("", pattern)) & set("{}"):
        if kind == FRAMES:
            what = "frame's number {} or {:04d}, {step} or {time} that its input states, or {stem}, its input's name"
        end = f"/{MANIFEST}" if is_streamed(pattern) else ".ply"
        raise UsageError(f"{option} {pattern}: expected one place for the {what}{end if kind != FRAMES else ''}")

    def value(place: re.Match[str]) -> str:
        key, _, form = place[1].partition(":")
        one = facts.get(key) if key else stem
        if one is None:
            raise UsageError(
                f"{option} {pattern}: the input of frame {stem} states no {key}; expected another place, such as {{}}"
            )
        if form:
            return format(float(one) if key == "time" else int(one), form)
        return f"{one:.12g}" if isinstance(one, float) else str(one)

    return FIELD.sub(value, pattern)


def frame_facts(paths: Sequence[str | None]) -> list[dict[str, Any]]:
    """Return "step" and "stem" of the files of a series, as far as their names have them, empty for None.

    The step is the last number that differs from name to name, folders included, with its zeros; else the last number.
    """
    stems = [Path(path or "") for path in paths]
    for suffix in sorted(SUFFIXES, key=len, reverse=True):
        stems = [path.with_name(volume_name(path).removesuffix(suffix)) if path.name else path for path in stems]
    numbers = [re.findall(r"\d+", str(path)) for path in stems if path.name]
    alike = len({len(row) for row in numbers}) == 1
    varying = [k for k, column in enumerate(zip(*numbers, strict=True)) if len(set(column)) > 1] if alike else []
    facts = []
    for path in stems:
        own = [re.findall(r"\d+", str(path))[varying[-1]]] if varying and path.name else re.findall(r"\d+", path.name)
        facts.append({"stem": path.name} if path.name else {})
        facts[-1] |= {"step": own[-1]} if own else {}
    return facts


def index_path(pattern: str) -> str:
    """Return the path of the index: ``out_index.json`` for ``out_{}.ply``, ``index.json`` for ``{}/out.ply``."""
    parts = Path(pattern).parts
    first = next(k for k, part in enumerate(parts) if is_pattern(part))
    name = re.sub(r"\{.*\}", INDEX, parts[first])
    if first == len(parts) - 1:
        known = format_of(name)
        name = name[: -len(known.suffix)] if known else str(Path(name).with_suffix(""))
    return str(Path(*parts[:first], f"{name}.json"))


def index_output(pattern: str) -> Output:
    """Return the index as an output of a run."""
    return Output("-o", index_path(pattern), (".json",), binary=False)


def entry(
    name: str, gaussians: int | None, size: int, report: ConversionReport, facts: Mapping[str, Any], file: str
) -> dict[str, Any]:
    """Return the row of a cloud in an index, with its mean PSNR (dB) over the test views where some were drawn."""
    scored = {} if report.scores is None else {"psnr": report.scores["psnr"]}
    return {"name": name, "gaussians": gaussians, "bytes": size, **scored, **facts, "file": file}


def write_index(
    path: str, kind: str, volume: str, files: Sequence[dict[str, Any]], facts: Mapping[str, Any], overwrite: bool
) -> None:
    """Write an index atomically; the paths of ``files`` are relative to it."""
    index = {"format": FORMAT, "schema": SCHEMA, "kind": kind, "volume": volume, **facts, "files": list(files)}
    write_text(path, json.dumps(plain(index), indent=1, allow_nan=False) + "\n", overwrite)


def is_index(path: str | Path) -> bool:
    """Return whether a file is an index, by its first characters."""
    if not str(path).lower().endswith(".json") or not Path(path).is_file():
        return False
    with open(path, encoding="utf-8", errors="replace") as stream:
        return f'"{FORMAT}"' in stream.read(_HEAD)


def read_index(path: str | Path) -> dict[str, Any]:
    """Read the document of an index; raise DataError if it names no files, or some outside its folder."""
    try:
        index: dict[str, Any] = json.loads(read_text(Path(path)))
        names = [PurePosixPath(row["file"]) for row in index["files"]]
        known = (index["format"], index["schema"]) == (FORMAT, SCHEMA)
        numbers = [*index.get("empty", []), *(row.get("frame", 0) for row in index["files"])]
        known = known and all(isinstance(k, int) for k in numbers)
        known = known and isinstance(index["kind"], str) and all(isinstance(row["name"], str) for row in index["files"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        known, names = False, []
    if not known or not names or any(name.is_absolute() or ".." in name.parts for name in names):
        raise DataError(f"{path}: not an index of 'vvgt convert' (schema {SCHEMA}) with one file or more")
    return index


def shown_name(name: str, facts: Mapping[str, Any]) -> str:
    """Return the name of a cloud in the list of a page: of a frame, whose own name is a file's, its time or number."""
    if "frame" not in facts:
        return name
    time = facts.get("time")
    return f"frame {facts['frame']}" if time is None else f"t = {time:g} {facts.get('time_unit', '')}".rstrip()


def indexed_files(path: str | Path) -> list[tuple[str, str]]:
    """List name on a page and file of each cloud of an index; raise DataError as `read_index`, or if one is missing."""
    folder = Path(path).parent
    clouds = [(shown_name(row["name"], row), folder / row["file"]) for row in read_index(path)["files"]]
    if gone := [file for _, file in clouds if not file.is_file()]:
        raise DataError(f"{path}: its file {gone[0]} is missing; run the conversion again")
    return [(name, str(file)) for name, file in clouds]


def named_files(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return name and path of the files that names, globs and indexes of `vvgt convert` stand for.

    Raises:
        UsageError: as `expanded`.
        DataError: as `indexed_files`.
    """
    files: list[tuple[str, str]] = []
    for name in names:
        name = os.path.join(name, MANIFEST) if os.path.isfile(os.path.join(name, MANIFEST)) else name
        files += indexed_files(name) if is_index(name) else [(Path(file).name, file) for file in expanded(name)]
    return files


def movie_frames(name: str) -> tuple[str | None, ...]:
    """Return the files of `named_files` in order, and None for each frame that an index says to be empty.

    Raises:
        DataError, UsageError: as `named_files`.
    """
    files: list[str | None] = [file for _, file in named_files([name])]
    if is_index(name):
        index = read_index(name)
        taken = [row["frame"] for row in index["files"] if "frame" in row]
        for k in sorted(index.get("empty", [])):
            place = bisect.bisect(taken, k)
            files.insert(place, None)
            taken.insert(place, k)
    return tuple(files)


def expanded(name: str) -> list[str]:
    """Return the files of a glob, sorted by their numbers, or the name; raise UsageError if a glob matches none."""
    levels = split_name(name)
    if not set(name) & set("*?[") or os.path.exists(name) or (levels and levels[0].is_file()) or ":/" in name:
        return [name]
    files = [str(path) for path in matching(name)]
    if not files:
        raise UsageError(f"{name}: no such files; expected files of Gaussians ({', '.join(SUFFIXES)}), or a volume")
    return files if any(map(is_splats, files)) else [name]  # a glob may be a volume: slices
