"""Contents of the files of VTK's family: datasets of a step, and lists of steps, arrays and blocks for `vvgt info`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.components import ArrayInfo
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.vtk import GRIDS, HDF5, INDEX, INDEXES, SINGLE, is_legacy, xml_kind
from vvgt_cli.volume.vtk.grids import arrays_of, check_legacy_grid, check_xml_grid, values_of
from vvgt_cli.volume.vtk.index import Index, files_of, read_index
from vvgt_cli.volume.vtk.leaves import Leaf, arrays_in, leaves_of
from vvgt_cli.volume.vtk.messages import quiet_vtk
from vvgt_cli.volume.vtk.programs import PROGRAMS, read_program

HEAD = 4096
LISTED = 50  # blocks and steps


def datasets(program: str, path: Path, time: int | None, array: str | None = None) -> tuple[list[Leaf], list[float]]:
    """Read the datasets of a time step, and the times of all steps.

    Raises:
        DataError: damaged, or a file that is named is missing or lies elsewhere.
        UsageError: several time steps and none chosen, or one that there is not.
    """
    if program == SINGLE:
        return list(_dataset(path, ())), []
    if program != INDEX:
        return read_program(PROGRAMS[program], path, time, array)
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
        head = file.read(HEAD)
    kind = xml_kind(head)
    if kind in INDEXES:
        yield from _indexed(read_index(path), None, above)
        return
    if head.startswith(HDF5):
        yield from read_program(PROGRAMS["VTKHDF"], path, None)[0]
        return
    with quiet_vtk() as message:
        reader = _reader(path, kind, head)
        reader.SetFileName(str(path))
        reader.Update()
        found, error = reader.GetOutputDataObject(0), message()
    if error or reader.GetErrorCode() or found is None:
        raise DataError(f"{path}: VTK cannot read it ({error or 'no message'}); is the file whole?")
    yield from leaves_of(found)


def _reader(path: Path, kind: str | None, head: bytes) -> Any:
    from vtkmodules import vtkIOXML
    from vtkmodules.vtkIOLegacy import vtkDataSetReader

    if kind in ("ImageData", "PolyData", *GRIDS):
        if kind in GRIDS:
            check_xml_grid(path)
        return getattr(vtkIOXML, f"vtkXML{kind}Reader")()
    if head.startswith(b"# vtk DataFile"):
        if is_legacy(head, grid=True):
            check_legacy_grid(path)
        reader = vtkDataSetReader()
        for what in ("Scalars", "Vectors", "Fields", "Tensors"):
            getattr(reader, f"ReadAll{what}On")()
        return reader
    raise DataError(f"{path}: no dataset of VTK's ({kind or head[:16]!r}); expected a file that an index may name")


def contents_of(program: str, path: Path, options: ReadOptions) -> dict[str, Any]:
    """List steps, arrays and blocks, each a row with the option that chooses it; by default those of the first step.

    Raises:
        DataError: as `datasets`.
    """
    leaves, times = datasets(program, path, options.time or 0)
    steps = [{"step": k, "time": t, "option": f"--time {k}"} for k, t in enumerate(times)] if len(times) > 1 else []
    rows = {"steps": steps, "arrays": [_array(info, leaves) for info in arrays_in(leaves)], "blocks": _blocks(leaves)}
    return {key: _short(value) for key, value in rows.items() if value}


def _short(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    left = len(rows) - LISTED
    return rows if left <= 0 else [*rows[:LISTED], {"more": left}]


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
