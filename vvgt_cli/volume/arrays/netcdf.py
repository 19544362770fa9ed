"""NetCDF 3 and 4 (``.nc``), one variable on its CF axes. Read by netCDF4."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from vvgt_cli.volume.arrays.netcdf3 import check_header
from vvgt_cli.volume.components import choose
from vvgt_cli.volume.labelled import DESCRIBES, Axis, axis, described_by, labelled_volume
from vvgt_cli.volume.libraries import library_errors, need
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.readers import volume_name
from vvgt_cli.volume.types import Volume

_TURN = Lock()  # the library is not for several threads


def read_netcdf(path: Path, options: ReadOptions) -> Volume:
    """Read one variable of a NetCDF file, on the axes that its coordinate variables describe.

    With ``options.stored`` its values stay in the file, and are read box by box.

    Raises:
        DataError: netCDF4 is not installed, no variable of numbers, a damaged file.
        UsageError: several variables and none chosen, or choices that `labelled_volume` asks for.
    """
    library = need("netCDF4", "netcdf", str(path), "NetCDF")
    with open(path, "rb") as stream:
        if stream.read(3) == b"CDF":
            check_header(path)
    with library_errors(str(path), "NetCDF"), library.Dataset(str(path), "r") as file:
        file.set_auto_maskandscale(False)
        variable = _choose(file, options.array, path)
        attributes = {key: variable.getncattr(key) for key in variable.ncattrs()}
        kind = np.dtype(variable.dtype).str[1:]
        if "_FillValue" not in attributes and kind[1:] != "1" and kind in library.default_fillvals:
            attributes["_FillValue"] = library.default_fillvals[kind]  # what the library fills unwritten values with
        source = f"{path}:{variable.name}"
        axes = [_axis(variable, name, size) for name, size in zip(variable.dimensions, variable.shape, strict=True)]
        _warn_of_curvilinear(variable, attributes, source)
        name = f"{volume_name(path)}:{variable.name}"
        where = f"{variable.group().path.rstrip('/')}/{variable.name}"
        by_box = options.stored and options.dims is None and options.component != "magnitude"
        read = partial(_part, path, where) if by_box else lambda index: variable[index]
        chunks = _chunks(variable) if by_box else None
        return labelled_volume(read, np.dtype(variable.dtype), axes, attributes, options, source, name, chunks)


def _warn_of_curvilinear(variable: Any, attributes: dict[str, Any], source: str) -> None:
    """Warn where places are coordinates of two or more axes (CF, 5.2), which are not read."""
    names = str(attributes.get("coordinates", "")).split()
    group = variable.group()
    odd = [n for n in names if n in group.variables and len(set(group[n].dimensions) & set(variable.dimensions)) > 1]
    if odd:
        warnings.warn(
            f"{source}: its places are curvilinear ({', '.join(odd)}), which is not read: voxels lie on an even grid "
            "of its axes (cdo remapbil or Resample in ParaView makes a regular one)", stacklevel=2,
        )  # fmt: skip


def _part(path: Path, where: str, index: tuple[Any, ...]) -> np.ndarray:
    """Read a part of a variable from a file that is open no longer than that."""
    import netCDF4

    with _TURN, netCDF4.Dataset(str(path), "r") as file:
        file.set_auto_maskandscale(False)
        return np.asarray(file[where][index])


def _chunks(variable: Any) -> list[int]:
    """Return the values along each axis that the file packs together; a slice of plain values."""
    found = variable.chunking()
    if isinstance(found, list | tuple):
        return [int(n) for n in found]
    return [1] * (len(variable.shape) - 2) + list(variable.shape[-2:])


def _choose(file: Any, wanted: str | None, path: Path) -> Any:
    """Return the variable asked for, else the only one of three axes or more (of two, if there is none)."""
    found: dict[str, Any] = {}
    groups = [("", file)]
    while groups:
        prefix, group = groups.pop(0)
        found |= {prefix + name: variable for name, variable in group.variables.items()}
        groups += [(f"{prefix}{name}/", inner) for name, inner in group.groups.items()]
    described = {
        name
        for variable in found.values()
        for name in described_by({key: variable.getncattr(key) for key in DESCRIBES if key in variable.ncattrs()})
    }
    fits = {
        name: variable
        for name, variable in found.items()
        if isinstance(variable.dtype, np.dtype) and variable.dtype.kind in "iuf" and len(variable.shape) >= 2
        and name.rpartition("/")[2] not in described
    }  # fmt: skip
    if wanted is not None and wanted.strip("/") in found:
        return found[wanted.strip("/")]
    deep = {name: variable for name, variable in fits.items() if sum(n > 1 for n in variable.shape) >= 3} or fits
    rows = [f"{name} ({', '.join(v.dimensions)}: {' x '.join(map(str, v.shape))})" for name, v in deep.items()]
    return list(deep.values())[choose(list(deep), rows, wanted, str(path), "variable")]


def _axis(variable: Any, name: str, size: int) -> Axis:
    """Return an axis with its coordinate variable: that of its own name, in the variable's group or one above."""
    group = variable.group()
    while group is not None:
        found = group.variables.get(name)
        if found is not None and found.shape == (size,) and np.dtype(found.dtype).kind in "iuf":
            stated = {key: found.getncattr(key) for key in found.ncattrs()}
            scale, offset = float(stated.get("scale_factor", 1.0)), float(stated.get("add_offset", 0.0))
            return axis(name, size, np.asarray(found[:], np.float64) * scale + offset, stated)
        group = group.parent
    return axis(name, size)
