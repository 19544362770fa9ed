"""Files of simulation programs, by VTK's readers: EnSight, Exodus, OpenFOAM, XDMF, CGNS, Plot3D, and VTKHDF.

All of it runs in a process of its own (`vvgt_cli.volume.vtk.child`): the readers trust their files.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import any_case, data_file
from vvgt_cli.volume.headers import MARK
from vvgt_cli.volume.vtk.index import MAX_BYTES, chosen_time
from vvgt_cli.volume.vtk.leaves import Leaf, arrays_in, leaves_of
from vvgt_cli.volume.vtk.messages import quiet_vtk
from vvgt_cli.volume.vtk.xml import walk_xml

MAX_NAMES = 100_000  # files that a case may name
SKIPS = "OpenFOAM"  # whose reader goes on without the fields that it cannot read


def read_program(
    program: str, path: Path, time: int | None, array: str | None = None
) -> tuple[list[Leaf], list[float]]:
    """Read the datasets of a time step of a format of `PROGRAMS`, and the times of all steps.

    Raises:
        DataError: damaged, or a file that it names is missing or lies elsewhere, or VTK cannot read field ``array``.
        UsageError: several time steps and none chosen, or one that there is not.
    """
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline

    with quiet_vtk() as message:
        reader = PROGRAMS[program](path)
        reader.UpdateInformation()
        facts = reader.GetOutputInformation(0)
        times = list(facts.Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS()) or ())
        first_error = message(errors=True)
        chosen = chosen_time(times, time, str(path))
        if chosen is None:
            reader.Update()
        else:
            reader.UpdateTimeStep(chosen)
        output = reader.GetOutputDataObject(0)
        leaves = [leaf for leaf in leaves_of(output) if leaf.data.GetNumberOfPoints() > 0]
        error, errors = message(errors=True) or first_error, message(errors=True, every=True)
    if program == SKIPS and leaves and error and not first_error and _mesh_is_sound(program, path, chosen):
        held = {info.name for info in arrays_in(leaves)}
        lost = [name for k in range(reader.GetNumberOfCellArrays()) if (name := reader.GetCellArrayName(k)) not in held]
        lost = [
            name for name in lost if re.search(rf"\b{re.escape(name)}\b", errors)
        ] or lost  # others have other times
        if array in lost:
            raise DataError(f"{path}: VTK cannot read field {array} ({error}); expected plain values in its file")
        warnings.warn(
            f"{path}: without {', '.join(lost) or 'some values'}, which VTK cannot read ({error})", stacklevel=2
        )
        return leaves, times
    if error or not leaves:
        fault = f"cannot read it ({error})" if leaves else f"finds no dataset in it ({error or 'no message'})"
        raise DataError(f"{path}: VTK {fault}; is the {program} file whole?")
    return leaves, times


def _mesh_is_sound(program: str, path: Path, time: float | None) -> bool:
    """Return whether VTK reads a time step without an error when all fields are switched off."""
    with quiet_vtk() as message:
        reader = PROGRAMS[program](path)
        reader.DisableAllCellArrays()
        reader.DisableAllPointArrays()
        reader.UpdateTimeStep(0.0 if time is None else time)
        return not message(errors=True)


def _check_names(path: Path, names: Sequence[str]) -> None:
    """Refuse files named by another that do not lie in its folder, or are not there; a pattern stands for several."""
    if len(names) > MAX_NAMES:
        raise DataError(f"{path}: it names {len(names)} files; expected at most {MAX_NAMES}")
    for named in dict.fromkeys(names):
        if not re.search(r"[*%]", named):
            data_file(path, named, exact=True)  # VTK opens it
        elif Path(named).is_absolute() or ".." in Path(named).parts:
            raise DataError(f"{path.name}: it names {named!r}; expected files in its own folder")


def _small(path: Path) -> str:
    """Read the text of a file that describes others."""
    if path.stat().st_size > MAX_BYTES:
        raise DataError(f"{path}: {path.stat().st_size} bytes; expected at most {MAX_BYTES >> 20} MiB of text")
    return path.read_text("utf-8-sig", "replace")


def _reader(module: str, kind: str, path: Path) -> Any:
    """Make a reader of one of VTK's modules for a file."""
    reader = getattr(import_module(f"vtkmodules.{module}"), kind)()
    reader.SetFileName(str(path))
    return reader


def _ensight(path: Path) -> Any:
    from vtkmodules.vtkIOEnSight import vtkGenericEnSightReader

    section, names = "", []
    if path.read_bytes().startswith(MARK):
        raise DataError(f"{path}: begins with a byte order mark, which VTK's reader stops at; save it as plain text")
    for line in _small(path).splitlines():
        line = line.partition("#")[0].strip()
        if re.fullmatch(r"[A-Z]+", line):
            section = line
        key, colon, value = line.partition(":")
        words = re.findall(r'"[^"]*"|\S+', value)
        files = section == "GEOMETRY" or (section == "VARIABLE" and "constant" not in key)
        if colon and files and words:
            words = [word for word in words if word != "change_coords_only"]
            names.append(words[-1].strip('"'))
    _check_names(path, names)
    reader = vtkGenericEnSightReader()
    reader.SetFilePath(str(path.parent))
    reader.SetCaseFileName(path.name)
    reader.ReadAllVariablesOn()
    return reader


def _exodus(path: Path) -> Any:
    reader = _reader("vtkIOExodus", "vtkExodusIIReader", path)
    reader.GenerateObjectIdCellArrayOff()
    reader.UpdateInformation()
    for kind in (reader.NODAL, reader.ELEM_BLOCK):
        reader.SetAllArrayStatus(kind, 1)
    return reader


def _times(folder: Path) -> set[float]:
    """Return the times that the folders of an OpenFOAM case are named by."""
    number = re.compile(r"\d*\.?\d+(?:e[+-]?\d+)?", re.I)
    return {float(p.name) for p in folder.glob("*") if number.fullmatch(p.name) and p.is_dir()}


def _openfoam(path: Path) -> Any:
    """Make the reader of a case: of its decomposed parts where they have times that the whole case lacks."""
    case, asked = path.parent, path.stem.lower()
    whole = any(p.is_dir() for pattern in ("polyMesh", "*/polyMesh") for p in (case / "constant").glob(pattern))
    mine, parts = _times(case), _times(case / "processor0")
    if any(_times(p) - mine - parts for p in case.glob("processors*")):
        text = f"{path}: its processors folder (OpenFOAM's collated format) holds times, which VTK does not read; try"
        text += " reconstructPar, or mpirun -np N foamFormatConvert -parallel -fileHandler uncollated"
        if not whole and not parts:
            raise DataError(text)
        warnings.warn(text, stacklevel=2)
    if not whole and not (case / "processor0").is_dir():
        raise DataError(f"{path}: no case beside it; expected a folder with constant/polyMesh or processor0 in it")
    decomposed = not whole or bool((parts and asked == "decomposed") or (parts - mine and asked != "reconstructed"))
    if whole and parts - mine:
        here, there = ("decomposed", "reconstructed") if decomposed else ("reconstructed", "decomposed")
        warnings.warn(
            f"{path}: the {here} case is read; decomposed it has {len(parts)} times up to {max(parts):g}, "
            f"reconstructed {len(mine)} up to {max(mine, default=0):g}; read {there}.foam, an empty file, for that",
            stacklevel=2,
        )
    reader = _reader("vtkIOParallel", "vtkPOpenFOAMReader", path)
    reader.SetCaseType(0 if decomposed else 1)
    reader.CreateCellToPointOff()  # values as they are stored
    reader.UpdateInformation()
    reader.EnableAllCellArrays()
    reader.EnableAllPointArrays()
    for name in [reader.GetPatchArrayName(k) for k in range(reader.GetNumberOfPatchArrays())]:
        reader.SetPatchArrayStatus(name, name.endswith("internalMesh"))  # of each region
    return reader


def _xdmf(path: Path) -> Any:
    names: list[str] = []
    texts: list[str] = []
    coded = False

    def start(tag: str, attributes: dict[str, str], _: int) -> None:
        nonlocal coded
        coded = tag == "DataItem" and attributes.get("Format", "XML").upper() in ("HDF", "HDF5", "H5", "BINARY", "TIFF")
        texts.clear()
        if tag.endswith("include") and "href" in attributes:
            names.append(attributes["href"])

    def text(data: str) -> None:
        if coded:
            texts.append(data)

    def end(tag: str) -> None:
        nonlocal coded
        named = "".join(texts).strip()
        if coded and named:
            names.append(named.rpartition(":")[0] if ":" in named else named)
        coded = False
        texts.clear()

    walk_xml(path, start, end, text)
    _check_names(path, names)
    return _reader("vtkIOXdmf2", "vtkXdmfReader", path)


def _cgns(path: Path) -> Any:
    reader = _reader("vtkIOCGNSReader", "vtkCGNSReader", path)
    reader.UpdateInformation()
    reader.EnableAllBases()
    reader.EnableAllPointArrays()
    reader.EnableAllCellArrays()
    return reader


def _plot3d(path: Path) -> Any:
    """Make the reader of ``NAME.xyz`` with ``NAME.q`` or ``.f`` beside it, or of ParaView's ``.p3d`` (JSON)."""
    from vtkmodules.vtkIOParallel import vtkMultiBlockPLOT3DReader

    kinds = {"xyz": ".xyz", "q": ".q", "function": ".f"}
    if path.suffix.lower() == ".p3d":
        try:
            stated = json.loads(_small(path))["filenames"]
            rows = [{kind: str(row[kind]) for kind in kinds if kind in row} for row in stated]
        except (ValueError, TypeError, KeyError) as error:
            raise DataError(
                f'{path}: damaged ({error}); expected JSON with "filenames", an "xyz" among them'
            ) from error
        reader = _reader("vtkIOParallel", "vtkPlot3DMetaReader", path)
    else:
        beside = {kind: any_case(path.with_suffix(suffix)) for kind, suffix in kinds.items()} | {"xyz": path}
        rows = [{kind: file.name for kind, file in beside.items() if file.is_file()}]
        reader = vtkMultiBlockPLOT3DReader()
        reader.SetAutoDetectFormat(True)
        for kind, put in (("q", reader.SetQFileName), ("function", reader.SetFunctionFileName)):
            if kind in rows[0]:
                put(str(beside[kind]))
        reader.SetXYZFileName(str(path))
    if not rows or any(len(row) < 2 or "xyz" not in row for row in rows):
        raise DataError(f"{path}: coordinates alone; expected values beside them, in {path.stem}.q or {path.stem}.f")
    _check_names(path, [name for row in rows for name in row.values()])
    return reader


PROGRAMS: dict[str, Callable[[Path], Any]] = {  # what makes VTK's reader of a file, all arrays enabled
    "VTKHDF": partial(_reader, "vtkIOHDF", "vtkHDFReader"),
    "EnSight": _ensight,
    "Exodus": _exodus,
    "OpenFOAM": _openfoam,
    "XDMF": _xdmf,
    "CGNS": _cgns,
    "Plot3D": _plot3d,
}
