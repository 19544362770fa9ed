"""GRIB 1 and 2, one variable at one time, read by ecCodes, which trusts its files, in a process of its own."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.components import ArrayInfo, choose_array
from vvgt_cli.volume.labelled import Axis, labelled_volume
from vvgt_cli.volume.reading import ReadOptions, Volume, check_memory, need, volume_name

GRIB = "GRIB"  # in the place of a program of `vtk_child`
MISSING = -1e100
_TIME = ("validityDate", "validityTime", "dataDate", "dataTime", "stepRange")
_UNITS = {"isobaricInhPa": "hPa", "isobaricInPa": "Pa", "hybrid": "level"}


def grib_volume(path: Path, options: ReadOptions) -> Volume:
    """Read one variable at one time; levels are z, upwards, members of an ensemble are variables of their own."""
    codes, source = need("eccodes", "grib", str(path), "GRIB"), str(path)
    fields: dict[str, dict[tuple[Any, ...], dict[float, int]]] = {}  # variable, time, level, byte
    with open(path, "rb") as file:
        while (message := codes.codes_grib_new_from_file(file, headers_only=True)) is not None:
            names = [str(codes.codes_get(message, key)) for key in ("shortName", "typeOfLevel")]
            names += [str(codes.codes_get(message, "number"))] if codes.codes_is_defined(message, "number") else []
            when = tuple(codes.codes_get(message, key) for key in _TIME)
            levels = fields.setdefault("/".join(names), {}).setdefault(when, {})
            level = codes.codes_get(message, "level", float)
            if levels.setdefault(level, at := int(codes.codes_get(message, "offset"))) != at:
                raise DataError(f"{source}: two messages of {'/'.join(names)} have level {level:g} at one time")
            codes.codes_release(message)
        infos = [ArrayInfo(name, "point", 1, "float32") for name in fields]
        name = infos[choose_array(infos, options.array, source)].name
        whens = sorted(fields[name])
        dates = [datetime.strptime(f"{when[0]:08d}{when[1]:04d}", "%Y%m%d%H%M") for when in whens]
        hours = [(date - dates[0]).total_seconds() / 3600 for date in dates]
        levels = fields[name][whens[options.step(len(whens), source, times=hours)]]
        down = not name.split("/")[1].startswith(("height", "theta", "potential"))
        planes, axes = [], [Axis("", 0)]
        for level in sorted(levels):
            file.seek(levels[level])
            message = codes.codes_grib_new_from_file(file)
            here = _grid(codes, message, source)
            check_memory(4 * len(levels) * here[0].size * here[1].size, source)
            codes.codes_set(message, "missingValue", MISSING)
            title, value_unit = (codes.codes_get(message, key) for key in ("name", "units"))
            values = np.asarray(codes.codes_get_values(message)).reshape([a.size for a in here])
            planes.append(np.where(values == MISSING, np.nan, values).astype(np.float32))
            codes.codes_release(message)
            if planes[1:] and any(np.any(a.centres != b.centres) for a, b in zip(axes, here, strict=True)):
                raise DataError(f"{source}: {name} has levels on different grids; expected one")
            axes = here
        attributes = {"long_name": title, "units": value_unit}
        unit = _UNITS.get(name.split("/")[1], "m" if "height" in name else "level")
        heights = np.array(sorted(levels)) * (-1.0 if down else 1.0)
        axes = [Axis("level", len(planes), heights, unit, "z"), *axes]
        plain, block = replace(options, time=None), np.stack(planes)
        return labelled_volume(
            block, block.dtype, axes, attributes, plain, f"{source}:{name}", f"{volume_name(path)}:{name}"
        )


def _grid(codes: Any, message: Any, source: str) -> list[Axis]:
    """Return the axes of a message's values, whichever way they are scanned, from the places of all points."""
    nx, ny = codes.codes_get(message, "Ni"), codes.codes_get(message, "Nj")
    places = [codes.codes_get_array(message, key) for key in ("latitudes", "longitudes")]
    for shape, order in (((ny, nx), 1), ((nx, ny), -1)) if nx * ny == places[0].size else ():
        outer, inner = (place.reshape(shape) for place in places[::order])
        if (outer == outer[:, :1]).all() and (inner == inner[:1]).all():
            y, x = (outer[:, 0], inner[0])[::order]
            axes = [Axis("latitude", ny, y, "degrees_north", "y")]
            axes += [Axis("longitude", nx, np.unwrap(x, period=360), "degrees_east", "x")]
            return axes[::order]
    kind = codes.codes_get(message, "gridType")
    raise DataError(
        f"{source}: values on a grid of type {kind}; expected latitudes by longitudes: try 'cdo -f nc4 "
        "remapbil,r360x180 IN OUT.nc' (setgridtype,regular for a reduced Gaussian grid, sp2gpl for a spectral one)"
    )
