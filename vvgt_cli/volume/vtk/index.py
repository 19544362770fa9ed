"""Index files of VTK's family: which files a dataset lies in, in which blocks, at which times.

``.pvtu`` ``.pvtr`` ``.pvts`` name pieces, ``.vtm`` ``.vtpd`` ``.vtpc`` blocks, ``.vth`` ``.vthb`` the blocks of each
level of refinement, ``.pvd`` and ParaView's ``.series`` (JSON) time steps. Names lead to files in the folder of the
index or below it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from vvgt_cli.errors import DataError
from vvgt_cli.volume.headers import MARK
from vvgt_cli.volume.reading import ReadOptions, data_file
from vvgt_cli.volume.vtk.xml import walk_xml

MAX_FILES = 100_000  # files that an index may name
DEEPEST = 8  # indexes that name indexes
MAX_BYTES = 64 << 20  # of an index
PIECES = {"PUnstructuredGrid", "PRectilinearGrid", "PStructuredGrid", "PImageData"}


@dataclass(frozen=True)
class Entry:
    """A file that an index names.

    Attributes:
        file: the name.
        time: of its step, NaN where there are none.
        level: of refinement, 0 the coarsest.
        block: names of the blocks that it is in.
    """

    file: str
    time: float = math.nan
    level: int = 0
    block: str = ""


@dataclass
class Index:
    """The contents of an index file.

    Attributes:
        path: of it.
        kind: type of its dataset; ``series`` of JSON.
        entries: the files that it names.
    """

    path: Path
    kind: str
    entries: list[Entry] = field(default_factory=list)

    @property
    def times(self) -> list[float]:
        """Times of the steps, ascending; none where they have none."""
        return sorted({entry.time for entry in self.entries if not math.isnan(entry.time)})

    def at(self, time: int | None) -> list[Entry]:
        """Return the entries of a time step, or raise UsageError."""
        chosen = chosen_time(self.times, time, str(self.path))
        return self.entries if chosen is None else [entry for entry in self.entries if entry.time == chosen]


def chosen_time(times: list[float], time: int | None, source: str) -> float | None:
    """Return the time of step ``time``, or the only one, else raise UsageError; None where there are none."""
    step = ReadOptions(time=time).step(max(len(times), 1), source, times=times)
    return times[step] if times else None


def read_index(path: Path) -> Index:
    """Read an XML or JSON index, none of its files; raise DataError if it names none, or more than `MAX_FILES`."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise DataError(f"{path}: {size} bytes; expected an index of at most {MAX_BYTES >> 20} MiB")
    with open(path, "rb") as file:
        head = file.read(4096).removeprefix(MARK).lstrip()
    index = _series(path) if head.startswith(b"{") else _parse(path)
    if not index.entries:
        raise DataError(f"{path}: an index that names no files; expected those of a dataset")
    return index


def _series(path: Path) -> Index:
    """Read ParaView's ``{"file-series-version": "1.0", "files": [{"name": ..., "time": ...}]}``."""
    index = Index(path, "series")
    try:
        rows = json.loads(path.read_text("utf-8-sig"))["files"]
        for k, row in enumerate(rows):
            time = float(row.get("time", k))
            _add(index, Entry(str(row["name"]), time if math.isfinite(time) else float(k)))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        text = " ".join(str(error).split())
        raise DataError(
            f"{path}: damaged ({text}); expected ParaView's JSON of a series, a name and a time for each file"
        ) from error
    return index


def _add(index: Index, entry: Entry) -> None:
    if len(index.entries) >= MAX_FILES:
        raise DataError(f"{index.path}: an index of more than {MAX_FILES} files; expected fewer")
    index.entries.append(entry)


def _parse(path: Path) -> Index:
    index = Index(path, "")
    blocks: list[tuple[str, str, int]] = []  # tag, name, level

    def start(tag: str, attributes: dict[str, str], _: int) -> None:
        if tag == "VTKFile":
            index.kind = attributes.get("type", "")
        name = attributes.get("name") or attributes.get("index", "")
        level = int(attributes.get("level", blocks[-1][2] if blocks else 0))
        file = attributes.get("Source" if tag == "Piece" else "file")
        if file and tag in ("DataSet", "Piece"):
            time = float(attributes.get("timestep") or "nan") if index.kind == "Collection" else math.nan
            label = "/".join([block[1] for block in blocks if block[1]] + [name or attributes.get("part", "")])
            _add(index, Entry(file, time, level, label.strip("/")))
        if tag in ("Block", "Partitions"):
            if len(blocks) > 100:
                raise DataError(f"{path}: more than 100 blocks within each other; expected fewer")
            blocks.append((tag, name, level))

    def end(tag: str) -> None:
        if blocks and blocks[-1][0] == tag:
            blocks.pop()

    try:
        walk_xml(path, start, end)
    except ValueError as error:
        raise DataError(f"{path}: a number in it is none ({error}); check that the file is whole") from error
    if index.kind == "Collection" and any(math.isinf(entry.time) for entry in index.entries):
        raise DataError(f"{path}: a time step that is not finite; expected numbers")
    return index


def files_of(index: Index, entries: list[Entry], above: tuple[Path, ...] = ()) -> Iterator[tuple[Path, Entry]]:
    """Yield the files of entries, in the folder of the index; raise DataError for others, or an index ``above``."""
    here = (*above, index.path.resolve())
    if len(here) > DEEPEST:
        raise DataError(f"{index.path}: more than {DEEPEST} indexes that name each other; expected fewer")
    for entry in entries:
        file = data_file(index.path, entry.file)
        if file.resolve() in here:
            raise DataError(f"{index.path}: an index that names itself ({entry.file!r}); expected files with values")
        yield file, entry
