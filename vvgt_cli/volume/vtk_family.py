"""Readers of VTK's meshes and grids, of what consists of several VTK files, and of other programs' that VTK reads."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from vvgt_cli.volume.grib import GRIB
from vvgt_cli.volume.headers import MARK
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import HEAD_BYTES, Reader, register
from vvgt_cli.volume.types import Volume
from vvgt_cli.volume.vtk_child import contents_by_child, volume_by_child
from vvgt_cli.volume.vtk_hdf import read_vtkhdf
from vvgt_cli.volume.vtk_index import INDEX, PIECES, SINGLE, Index, files_of, read_index
from vvgt_cli.volume.vtk_legacy import is_legacy
from vvgt_cli.volume.vtk_programs import PROGRAMS
from vvgt_cli.volume.vtk_xml import GRIDS, INDEXES, xml_kind

SUFFIXES = (".pvtu", ".pvtr", ".pvts", ".vtm", ".vtmb", ".vtpd", ".vtpc", ".vth", ".vthb", ".pvd", ".series")


def is_index(head: bytes) -> bool:
    """Whether a file begins as an index of datasets (one of the pieces of an image is none)."""
    if head.removeprefix(MARK).lstrip().startswith(b"{"):
        return b'"file-series-version"' in head
    kind = xml_kind(head)
    return kind in INDEXES and kind != "PImageData"


def read_indexed(path: Path, options: ReadOptions) -> Volume:
    """Read what an index names: a single file as that file's reader does, several as one volume.

    Raises:
        DataError: damaged, or files that are missing, lie elsewhere or are no datasets.
        UsageError: a choice of step, array or component that is missing or does not exist.
    """
    found = _single(read_index(path), options.time)
    if found is None:
        return volume_by_child(INDEX, path, options)
    from vvgt_cli.volume.registry import read_volume

    file, time = found
    return read_volume(str(file), replace(options, time=time, crop=None, mask=None))


def _single(index: Index, time: int | None, above: tuple[Path, ...] = ()) -> tuple[Path, int | None] | None:
    """The only file that an index leads to, and the step to read of it; None where there are several."""
    timed = bool(index.times)
    entries = index.at(time) if timed else index.entries
    if len(entries) != 1 or index.kind in PIECES:
        return None
    file = next(files_of(index, entries, above))[0]
    rest = None if timed else time
    with open(file, "rb") as stream:
        head = stream.read(HEAD_BYTES)
    return _single(read_index(file), rest, (*above, index.path.resolve())) if is_index(head) else (file, rest)


def _contents(program: str, path: Path, options: ReadOptions) -> dict[str, Any]:
    return contents_by_child(program, path, options)


register(
    Reader(
        "VTK index", SUFFIXES, is_index, read_indexed, named_arrays=True, times=True, resamples=True,
        contents=partial(_contents, INDEX),
    )
)  # fmt: skip
for _program in PROGRAMS.values():
    register(
        Reader(
            _program.name, _program.suffixes, _program.sniff,
            read_vtkhdf if _program.name == "VTKHDF" else partial(volume_by_child, _program.name),
            named_arrays=True, times=True, resamples=True, by_name=_program.by_name, empty=_program.by_name,
            within=_program.within, contents=partial(_contents, _program.name),
        )
    )  # fmt: skip
register(
    Reader(
        "GRIB", (".grib", ".grib1", ".grib2", ".grb", ".grb1", ".grb2"), lambda head: b"GRIB" in head[:64],
        partial(volume_by_child, GRIB), named_arrays=True, times=True, resamples=True,
    )
)  # fmt: skip
for _name, _suffixes, _sniff in (
    ("VTK grid", (".vtu", ".vtr", ".vts"), lambda head: xml_kind(head) in GRIDS),
    ("legacy VTK grid", (), lambda head: is_legacy(head, grid=True)),
):
    register(
        Reader(
            _name, _suffixes, _sniff, partial(volume_by_child, SINGLE), named_arrays=True, resamples=True,
            contents=partial(_contents, SINGLE),
        )
    )  # fmt: skip
