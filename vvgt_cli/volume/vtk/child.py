"""VTK's readers in a process of their own: what brings one down is one line of error.

The request is a line of JSON on standard input, the answer one on standard output, with the values behind it.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import IO, Any, cast

import numpy as np

from vvgt_cli.errors import DataError, SeveralArrays, SeveralComponents, SeveralSteps, UsageError, VvgtError
from vvgt_cli.resources import free_memory
from vvgt_cli.volume.arrays.grib import GRIB, grib_volume
from vvgt_cli.volume.blocks import fill
from vvgt_cli.volume.libraries import library_errors
from vvgt_cli.volume.readers import HDF5, HEAD_BYTES, volume_name
from vvgt_cli.volume.reading import ArrayInfo, ReadOptions, Volume, check_memory, count
from vvgt_cli.volume.vtk import GRIDS, IMAGE, INDEX, INDEXES, SINGLE, is_index, xml_kind
from vvgt_cli.volume.vtk.grids import arrays_of, values_of
from vvgt_cli.volume.vtk.index import PIECES, Index, files_of, read_index
from vvgt_cli.volume.vtk.leaves import Leaf, arrays_in, leaves_of
from vvgt_cli.volume.vtk.messages import checked, quiet_vtk
from vvgt_cli.volume.vtk.programs import read_program
from vvgt_cli.volume.vtk.resample import MAX_EDGE
from vvgt_cli.volume.vtk.xml import scan

SECONDS, A_BYTE, A_VOXEL = 60, 1e-6, 4e-6  # processor time: at least, of a byte of the files, of a sample
START = f"from {__name__} import main; main()"
IDLE, LOOK = 60.0, 2.0  # s without any processor time after which it counts as hung, and between looks
STOPPED = {-getattr(signal, name, -1 << 30) for name in ("SIGXCPU", "SIGKILL")}  # exit statuses; no others on Windows
ERRORS = (SeveralSteps, SeveralArrays, SeveralComponents)  # with attributes, which go from process to process
KEYS = ("dims", "spacing", "array", "component", "time")
DESCRIPTION = ("name", "quantity", "value_unit", "unit")
MAX_ROWS = 50  # of steps, arrays or blocks each that `contents_of` lists
LARGEST = 1 << 20  # bytes of the line of an answer


def volume_by_child(program: str, path: Path, options: ReadOptions) -> Volume:
    """Read a file of `vtk.programs.PROGRAMS`, of an index, or of a mesh or grid as a volume."""
    facts, values = _asked(program, path, options, "volume")
    place = {key: tuple(facts[key]) for key in ("spacing", "origin", "direction")}
    return Volume(values, **{key: facts[key] for key in DESCRIPTION}, **place)  # type: ignore[arg-type]  # three numbers each


def read_indexed(path: Path, options: ReadOptions) -> Volume:
    """Read what an index names: a single file as that file's reader does, several as one volume."""
    single = _single(read_index(path), options.time)
    if single is None:
        return volume_by_child(INDEX, path, options)
    from vvgt_cli.volume.registry import read_volume

    file, time = single
    return read_volume(str(file), replace(options, time=time, crop=None, mask=None, keep_largest=None))


def _single(index: Index, time: int | None, above: tuple[Path, ...] = ()) -> tuple[Path, int | None] | None:
    """Return the only file that an index leads to, and the step to read of it; None where there are several."""
    timed = bool(index.times)
    entries = index.at(time) if timed else index.entries
    if len(entries) != 1 or index.kind in PIECES:
        return None
    file = next(files_of(index, entries, above))[0]
    rest = None if timed else time
    with open(file, "rb") as stream:
        head = stream.read(HEAD_BYTES)
    return _single(read_index(file), rest, (*above, index.path.resolve())) if is_index(head) else (file, rest)


def contents_by_child(program: str, path: Path, options: ReadOptions) -> dict[str, Any]:
    """List steps, arrays and blocks, each with the option that chooses it; errors are those of `volume_by_child`."""
    return _asked(program, path, options, "contents")[0]


def _asked(program: str, path: Path, options: ReadOptions, task: str) -> tuple[dict[str, Any], np.ndarray]:
    size = path.stat().st_size if program in (SINGLE, IMAGE) else _bytes_near(path)
    samples = count(options.dims) if options.dims else min(40 * size, MAX_EDGE**3)
    seconds = math.ceil(SECONDS + A_BYTE * size + A_VOXEL * samples)
    request = {
        "program": program, "path": str(path), "task": task, "free": free_memory(), "seconds": seconds,
        "options": {key: getattr(options, key) for key in KEYS},
    }  # fmt: skip
    reply, status = run(request)
    if reply is None:
        raise _ended(path, program, status, seconds)
    facts, values = reply
    for line in facts.pop("notes", ()):
        warnings.warn(line, stacklevel=2)
    if "error" in facts:
        raise _error(facts)
    return facts, values


def run(request: dict[str, Any]) -> tuple[tuple[dict[str, Any], np.ndarray] | None, int]:
    """Run a request in a process; return its answer, None where it gives none, and its exit status."""
    paths = os.pathsep.join(filter(None, [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")]))
    with subprocess.Popen(
        [sys.executable, "-c", START], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": paths},
    ) as child:  # fmt: skip
        to, back, ended = cast(IO[bytes], child.stdin), cast(IO[bytes], child.stdout), Event()
        Thread(target=_watch, args=(child, ended), daemon=True).start()
        try:
            with suppress(BrokenPipeError):  # it has ended: what it left says how
                to.write(json.dumps(request).encode() + b"\n")
                to.close()
            reply = received(back)
        except BaseException:
            child.kill()
            raise
        finally:
            ended.set()
    return reply, child.returncode


def _watch(child: subprocess.Popen[bytes], ended: Event) -> None:
    """Kill a child that sleeps for good: a lock of a library that broke down is never free again."""
    stat, last, idle = Path(f"/proc/{child.pid}/stat"), "", 0.0
    while not ended.wait(LOOK) and idle < IDLE:
        try:
            used = " ".join(stat.read_text().rpartition(")")[2].split()[11:13])
        except OSError:  # it has ended, or this system has no such file
            return
        idle = idle + LOOK if used == last else 0.0
        last = used
    if not ended.is_set():
        child.kill()


def _bytes_near(path: Path) -> int:
    """Count the bytes of the files in a file's folder: those that it may name."""
    total = 0
    for n, (folder, _, names) in enumerate(os.walk(path.parent)):
        total += sum(os.stat(file).st_size for name in names if os.path.isfile(file := os.path.join(folder, name)))
        if n > 1000:
            break
    return total


def received(stream: IO[bytes]) -> tuple[dict[str, Any], np.ndarray] | None:
    """Read facts and values, None where they end early."""
    line = stream.readline(LARGEST)
    if not line.endswith(b"\n"):
        return None
    facts = json.loads(line)
    dtype, shape = np.dtype(facts.pop("dtype", "u1")), tuple(facts.pop("shape", (0,)))
    need = count(shape) * dtype.itemsize
    check_memory(need, str(facts.get("name")))
    values, filled = fill(stream, need)
    return (facts, values.view(dtype).reshape(shape)) if filled == need else None


def _ended(path: Path, program: str, status: int, seconds: int) -> DataError:
    own = {INDEX: "VTK", SINGLE: "VTK", IMAGE: "VTK"}
    who = "ecCodes" if program == GRIB else f"VTK's reader of {own.get(program, program)} files"
    if status in STOPPED:
        return DataError(
            f"{path}: {who} was stopped (after {seconds} s, a minute of standstill, or for its memory); is it whole?"
        )
    what = signal.Signals(-status).name if status < 0 else f"status {status}"
    return DataError(f"{path}: {who} broke down ({what}), or had too little memory; is the file whole?")


def _error(facts: dict[str, Any]) -> VvgtError:
    """Make the error that an answer reports."""
    kind = next((kind for kind in (*ERRORS, UsageError) if kind.__name__ == facts["error"]), DataError)
    error = kind.__new__(kind)
    error.args = (facts["text"],)
    vars(error).update(facts.get("state", {}))
    return error


def answer(request: dict[str, Any]) -> tuple[dict[str, Any], np.ndarray | None]:
    """Answer a request with facts and values. Runs in the child."""
    path = Path(request["path"])
    given: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in request["options"].items()
    }
    options = ReadOptions(**given)
    caught: list[Any] = []
    try:
        kind = "GRIB" if request["program"] == GRIB else "a file for VTK"
        with library_errors(str(path), kind), warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            facts, values = _work(request["program"], path, options, request["task"])
    except VvgtError as error:
        facts, values = {"error": type(error).__name__, "text": str(error), "state": vars(error)}, None
        if isinstance(error, SeveralArrays) and request["program"] not in (GRIB, IMAGE):  # others list them
            facts |= {"error": "UsageError", "state": {}}
    again = facts.get("error") in [kind.__name__ for kind in ERRORS]  # the question repeats them
    notes = [str(one.message) for one in caught if one.category is UserWarning and not again]
    return {**facts, "notes": notes}, values


def _work(program: str, path: Path, options: ReadOptions, task: str) -> tuple[dict[str, Any], np.ndarray | None]:
    from vvgt_cli.volume.vtk.leaves import volume_of

    if task == "contents":
        return contents_of(program, path, options), None
    if program == GRIB:
        volume = grib_volume(path, options)
    else:
        leaves, _ = datasets(program, path, options.time, options.array)
        volume = volume_of(leaves, replace(options, time=None), str(path), volume_name(path))
    values = np.ascontiguousarray(volume.data)
    place = {key: [float(v) for v in getattr(volume, key)] for key in ("spacing", "origin", "direction")}
    return {
        **{key: getattr(volume, key) for key in DESCRIPTION},
        "dtype": values.dtype.str,
        "shape": values.shape,
        **place,
    }, values


def bound(free: int | None, seconds: int) -> None:
    """Let this process have ``free`` bytes more, and ``seconds`` of processor time, if the system has limits."""
    try:
        import resource
    except ImportError:  # Windows
        return

    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    if free is not None and pages:
        limit = pages * resource.getpagesize() + free
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def send(stream: IO[bytes], facts: dict[str, Any], values: np.ndarray | None) -> None:
    """Write an answer, for `received`."""
    stream.write(json.dumps(facts).encode() + b"\n")
    if values is not None:
        stream.write(values.reshape(-1).view(np.uint8).data)


def main() -> None:
    """Answer one request; libraries that print do so elsewhere."""
    with os.fdopen(os.dup(1), "wb") as stream:
        os.dup2(2, 1)
        request = json.loads(sys.stdin.readline())
        import vtkmodules.vtkCommonCore  # noqa: F401  its libraries count as there already

        bound(request["free"], request["seconds"])
        send(stream, *answer(request))
    os._exit(0)  # whatever a damaged file left behind is not taken apart


def datasets(program: str, path: Path, time: int | None, array: str | None = None) -> tuple[list[Leaf], list[float]]:
    """Read the datasets of a time step, and the times of all steps.

    Raises:
        DataError: damaged, or a file that is named is missing or lies elsewhere.
        UsageError: several time steps and none chosen, or one that there is not.
    """
    if program in (SINGLE, IMAGE):
        return list(_dataset(path, ())), []
    if program != INDEX:
        return read_program(program, path, time, array)
    index = read_index(path)
    return list(_indexed(index, time, ())), index.times


def _indexed(index: Index, time: int | None, above: tuple[Path, ...]) -> Iterator[Leaf]:
    entries = index.at(time)
    pieces = index.kind.startswith("P")
    for k, (file, entry) in enumerate(files_of(index, entries, above)):
        label = entry.block or (f"piece {k}" if pieces else "")
        for leaf in _dataset(file, (*above, index.path.resolve())):
            yield replace(leaf, level=entry.level or leaf.level, name="/".join(filter(None, (label, leaf.name))))


def _dataset(path: Path, above: tuple[Path, ...]) -> Iterator[Leaf]:
    """Read the datasets in a file that an index names."""
    with open(path, "rb") as file:
        head = file.read(HEAD_BYTES)
    kind = xml_kind(head)
    if kind in INDEXES:
        yield from _indexed(read_index(path), None, above)
        return
    if head.startswith(HDF5):
        yield from read_program("VTKHDF", path, None)[0]
        return
    with quiet_vtk() as message:
        reader = _reader(path, kind, head)
        reader.SetFileName(str(path))
        reader.Update()
        data = checked(reader.GetOutputDataObject(0), reader, message, path, "it")
    yield from leaves_of(data)


def _reader(path: Path, kind: str | None, head: bytes) -> Any:
    from vtkmodules import vtkIOXML
    from vtkmodules.vtkIOLegacy import vtkDataSetReader

    if kind in ("ImageData", "PolyData", *GRIDS):
        scan(path)  # raises where the end of the file is missing
        return getattr(vtkIOXML, f"vtkXML{kind}Reader")()
    if head.startswith(b"# vtk DataFile"):
        reader = vtkDataSetReader()
        for what in ("Scalars", "Vectors", "Normals", "Tensors", "ColorScalars", "TCoords", "Fields"):
            getattr(reader, f"ReadAll{what}On")()
        return reader
    raise DataError(f"{path}: no dataset of VTK's ({kind or head[:16]!r}); expected a file that an index may name")


def contents_of(program: str, path: Path, options: ReadOptions) -> dict[str, Any]:
    """List steps, arrays and blocks (by default of the first step) with the option of each, or raise DataError."""
    leaves, times = datasets(program, path, options.time or 0)
    steps = [{"step": k, "time": t, "option": f"--time {k}"} for k, t in enumerate(times)] if len(times) > 1 else []
    rows = {"steps": steps, "arrays": [_array(info, leaves) for info in arrays_in(leaves)], "blocks": _blocks(leaves)}
    return {key: _short(value) for key, value in rows.items() if value}


def _short(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    left = len(rows) - MAX_ROWS
    return rows if left <= 0 else [*rows[:MAX_ROWS], {"more": left}]


def _array(info: ArrayInfo, leaves: Sequence[Leaf]) -> dict[str, Any]:
    """Make the row of an array: the range of vectors is that of their lengths."""
    lo, hi, holders = np.inf, -np.inf, 0
    for leaf in leaves:
        if not any(
            (a.name, a.where, a.components) == (info.name, info.where, info.components) for a in arrays_of(leaf.data)
        ):
            continue
        holders += 1
        values = values_of(leaf.data, info)
        values = values if values.ndim == 1 else np.linalg.norm(values, axis=1)
        values = values[np.isfinite(values)]
        if values.size:
            lo, hi = min(lo, float(values.min())), max(hi, float(values.max()))
    span = [lo, hi] if lo <= hi else None
    return {
        "array": info.name, "data": info.where, "dtype": info.dtype, "components": info.components, "range": span,
        "blocks": holders, "option": f"--array {info.name}",
    }  # fmt: skip


def _blocks(leaves: Sequence[Leaf]) -> list[dict[str, Any]]:
    """Make a row of each dataset, where there are several."""
    rows = []
    for leaf in leaves if len(leaves) > 1 else ():
        data = leaf.data
        sizes = data.GetDimensions() if data.IsA("vtkImageData") else None
        kind = data.GetClassName().removeprefix("vtk")
        row = {"block": leaf.name, "type": kind, "points": data.GetNumberOfPoints(), "cells": data.GetNumberOfCells()}
        rows.append(
            {**row, **({"dims": list(sizes)} if sizes else {}), **({"level": leaf.level} if leaf.level else {})}
        )
    return rows
