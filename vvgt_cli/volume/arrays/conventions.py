"""Axes that conventions on top of HDF5 state: openPMD, NeXus, Velox, BigDataViewer, DREAM.3D, ilastik, Fiji's plugin.

Sources: openPMD standard 1.1 and 2.0 (https://github.com/openPMD/openPMD-standard), NXdata of the NeXus manual
(https://manual.nexusformat.org), vigra's ``axistags``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.headers import text_of
from vvgt_cli.volume.labelled import AXIS_ATTRIBUTES, CF_ATTRIBUTES, Axis, axis, even_axis
from vvgt_cli.volume.reading import Volume, unit_rows

_ITK = re.compile(r"/ITKImage/\d+")
Held = Callable[..., Any]  # `hdf5.checked_dataset` of a group and a path in it


def coordinates_of(dataset: Any) -> tuple[np.ndarray, dict[str, Any]]:
    """Read a dataset of coordinates along an axis, as stored, and the attributes that describe them."""
    keys = ("name", *AXIS_ATTRIBUTES, *CF_ATTRIBUTES)
    stated = {key: dataset.attrs[key] for key in keys if key in dataset.attrs}
    return np.asarray(dataset[()]), stated


def conventional_axes(file: Any, dataset: Any, source: str, held: Held) -> tuple[list[Axis], dict[str, Any]] | None:
    """Return a dataset's axes without dimension scales, slowest first, and CF attributes of its scaling.

    Return None where no convention is followed; raise DataError for a geometry that is stated and cannot be read.
    """
    group, sizes = dataset.parent, dataset.attrs.get("element_size_um", ())  # z, y, x
    if "openPMD" in file.attrs and ("axisLabels" in dataset.attrs or "axisLabels" in group.attrs):
        return _openpmd(dataset, source)
    axes: list[Axis] = []
    more: dict[str, Any] = {}
    if text_of(group.attrs.get("NX_class", "")) == "NXdata" and "axes" in group.attrs:
        axes, more = _nexus(group, dataset, held), _nexus_scaling(group, dataset.name.rpartition("/")[2], held)
    elif "_SIMPL_GEOMETRY/SPACING" in group.parent and len(dataset.shape) >= 3:
        axes = _dream3d(group.parent, dataset, held)
    elif _ITK.fullmatch(group.name):
        axes = _itk(group, dataset, held)
    elif view := re.fullmatch(r"/t\d+/(s\d+)/(\d+)/cells", dataset.name):
        return _bigdataviewer(file, view[1], int(view[2]), dataset, held)
    elif re.fullmatch("/Data/Image/[^/]+/Data", dataset.name) and len(dataset.shape) == 3:
        axes = _velox(group, dataset, held)
    elif "axistags" in dataset.attrs:
        axes = _vigra(json.loads(text_of(dataset.attrs["axistags"])).get("axes", []), dataset)
    elif np.size(sizes) == 3 and len(dataset.shape) >= 3:
        steps = np.ravel(sizes).astype(np.float64)
        axes = [*(Axis("", n) for n in dataset.shape[:-3]), *_even("zyx", dataset.shape[-3:], 0 * steps, steps, "um")]
    return (axes, more) if axes else None


def _even(names: Sequence[str], sizes: Sequence[int], first: Any, steps: Any, unit: str = "") -> list[Axis]:
    """Return even axes from their first coordinates and steps."""
    stated = {"units": unit} if unit else {}
    return [even_axis(*one, stated) for one in zip(names, sizes, first, steps, strict=False)]


def _itk(group: Any, dataset: Any, held: Held) -> list[Axis]:
    """Return the axes of an image of ITK (HDF5ImageIO), whose facts are in the order x, y, z."""
    steps, first = (np.ravel(held(group, key))[::-1] for key in ("Spacing", "Origin"))
    spatial = _even("tzyx"[-len(steps) :], dataset.shape, first, steps)
    return [*spatial, *(Axis("components", n, role="c") for n in dataset.shape[len(steps) :])]


def turned_by_itk(group: Any, volume: Volume, held: Held) -> Volume:
    """Return the volume in the anatomical space of ITK, if an image of it is in the group: an axis a row."""
    if not _ITK.fullmatch(group.name):
        return volume
    axes, stated = np.eye(3), np.asarray(held(group, "Directions"), np.float64)[:3, :3]
    axes[: len(stated), : len(stated)] = stated
    return replace(volume, direction=unit_rows(axes)[1], space="LPS")


def _openpmd(dataset: Any, source: str) -> tuple[list[Axis], dict[str, Any]]:
    """Return the axes of a mesh record, in metres, and the factor to SI units of its values.

    Labels, spacing and offset are in the order of the array's indices, reversed for a Fortran code, whose arrays HDF5
    shows the other way round.
    """
    mesh = dataset.attrs if "axisLabels" in dataset.attrs else dataset.parent.attrs
    geometry, n = text_of(mesh.get("geometry", "cartesian")), len(dataset.shape)
    if geometry != "cartesian":
        raise DataError(
            f"{source}: openPMD geometry {geometry[:40]!r}; expected cartesian: resample it first (openPMD-viewer's "
            "get_field(theta=None) gives a cartesian grid)"
        )
    labels = [text_of(label) for label in np.asarray(mesh["axisLabels"]).reshape(-1)]
    stated = [(mesh, "gridSpacing", 1.0), (mesh, "gridGlobalOffset", 0.0), (dataset.attrs, "position", 0.0)]
    numbers = [np.ravel(where.get(key, default)) for where, key, default in (*stated, (mesh, "gridUnitSI", 1.0))]
    if len(labels) != n or not {one.size for one in numbers} <= {1, n}:
        raise DataError(f"{source}: openPMD axes {', '.join(labels)} for {n} axes of values; expected as many")
    spacing, offset, position, unit = (np.broadcast_to(one.astype(np.float64), n) for one in numbers)
    order = slice(None, None, -1 if text_of(mesh.get("dataOrder", "C")) == "F" else 1)
    step, start = (spacing * unit)[order], ((offset + position * spacing) * unit)[order]
    axes = _even(labels[order], dataset.shape, start, step, "m")
    return axes, {"scale_factor": dataset.attrs["unitSI"]} if "unitSI" in dataset.attrs else {}


def _nexus(group: Any, dataset: Any, held: Held) -> list[Axis]:
    """Return the axes of an NXdata group's signal, by the coordinates beside it; none where they do not fit."""
    names = [text_of(name) for name in np.asarray(group.attrs["axes"]).reshape(-1)]
    names = names[0].split(":") if len(names) == 1 and len(dataset.shape) > 1 else names
    if len(names) != len(dataset.shape):
        return []
    axes = []
    for name, size in zip(names, dataset.shape, strict=True):
        beside = None if name == "." else held(group, name, needed=False)
        if beside is None or beside.shape != (size,) or beside.dtype.kind not in "iuf":
            axes.append(axis("" if name == "." else name, size))
            continue
        axes.append(axis(name, size, *coordinates_of(beside)))
    return axes


def _bigdataviewer(file: Any, setup: str, level: int, dataset: Any, held: Held) -> tuple[list[Axis], dict[str, Any]]:
    """Return the axes of a view of BigDataViewer in voxels of the finest level, and the sign of its values.

    Without the setup's attribute ``dataType``, int16 stands for uint16 (bigdataviewer-core, ``Hdf5ImageLoader``).
    """
    factors = held(file, f"{setup}/resolutions")[level][::-1]
    axes = _even("zyx", dataset.shape, (factors - 1) / 2, factors)
    unsigned = text_of(file[setup].attrs.get("dataType", "uint16")).startswith("uint")
    return axes, {"_Unsigned": "true"} if unsigned else {}


def _velox(group: Any, dataset: Any, held: Held) -> list[Axis]:
    """Return the axes y, x and frames of an image of Velox; its metadata are JSON in bytes, a column a frame."""
    stated = held(group, "Metadata")[:, 0].tobytes() if "Metadata" in group else b"{}"
    facts = json.loads(stated.partition(b"\0")[0]).get("BinaryResult", {})
    axes = []
    for name, side, size in zip("yx", ("height", "width"), dataset.shape, strict=False):
        step = float(facts.get("PixelSize", {}).get(side) or 0)
        centres = step * np.arange(size) if step > 0 else None
        axes.append(axis(name, size, centres, {"units": facts.get(f"PixelUnit{name.upper()}", "")}))
    return [*axes, Axis("frame", dataset.shape[2], None, "", "t")]


def _nexus_scaling(group: Any, name: str, held: Held) -> dict[str, Any]:
    """Return the scaling of an NXdata field, ``(value + offset) * scaling_factor``, as CF has it."""
    factor, offset = (
        next((float(np.ravel(one)[0]) for k in (f"{name}_{key}", key) if (one := held(group, k, needed=False))), plain)
        for key, plain in (("scaling_factor", 1.0), ("offset", 0.0))
    )
    return {"scale_factor": factor, "add_offset": offset * factor} if (factor, offset) != (1, 0) else {}


def _dream3d(above: Any, dataset: Any, held: Held) -> list[Axis]:
    """Return the axes of cells of DREAM.3D, whose origin is a corner; spacing and origin are in the order x, y, z."""
    steps, first = (np.ravel(held(above, f"_SIMPL_GEOMETRY/{key}"))[::-1] for key in ("SPACING", "ORIGIN"))
    spatial = _even("zyx", dataset.shape, first + steps / 2, steps)
    return [*spatial, *(Axis("components", n, None, "", "c") for n in dataset.shape[3:])]


def _vigra(tags: Sequence[Any], dataset: Any) -> list[Axis]:
    """Return the axes of vigra's ``axistags``; none where they do not fit."""
    if len(tags) != len(dataset.shape):
        return []
    axes = []
    for tag, size in zip(tags, dataset.shape, strict=True):
        name, step = str(tag.get("key", "")), float(tag.get("resolution") or 0.0)
        placed = step > 0 and name in ("x", "y", "z")
        role = name if name in ("x", "y", "z", "t", "c") else ""
        axes.append(even_axis(name, size, 0.0, step) if placed else Axis(name, size, role=role))
    return axes
