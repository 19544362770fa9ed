"""vtk.js folders: ``index.json`` of an image beside ``data``, written by vtkJSONDataSetWriter or vtk.js itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import data_file, load_block
from vvgt_cli.volume.components import ArrayInfo, choose_array, select_component
from vvgt_cli.volume.reading import IDENTITY, MAX_HEADER, ReadOptions, Volume, placed

INDEX, MARK = "index.json", b'"vtkClass"'
_TYPES = {f"{kind}{8 * n}Array": f"{code}{n}" for kind, code in (("Int", "i"), ("Uint", "u")) for n in (1, 2, 4, 8)}
_TYPES |= {"Uint8ClampedArray": "u1", "Float32Array": "f4", "Float64Array": "f8"}


def holds_vtkjs(folder: Path) -> bool:
    """Tell whether a folder has an index of a vtk.js dataset."""
    if not (folder / INDEX).is_file():
        return False
    with open(folder / INDEX, "rb") as file:
        return MARK in file.read(256)


def read_vtkjs(folder: Path, options: ReadOptions) -> Volume:
    """Read the point data of an image; arrays that are not compressed are memory-mapped."""
    index, source = folder / INDEX, str(folder)
    with open(index, "rb") as file:
        facts: dict[str, Any] = json.loads(file.read(MAX_HEADER))
    if facts.get("vtkClass") != "vtkImageData":
        raise DataError(f"{index}: a {str(facts.get('vtkClass'))[:40]}; expected vtkImageData: save it as .vtu or .vti")
    extent = np.array(facts["extent"], np.int64).reshape(3, 2)
    data = {str(one["data"]["name"]): one["data"] for one in facts.get("pointData", {}).get("arrays", [])}
    infos = [
        ArrayInfo(name, "point", int(one.get("numberOfComponents", 1)), np.dtype(_TYPES[one["dataType"]]).name)
        for name, one in data.items()
    ]
    info = infos[choose_array(infos, options.array, source)]
    ref, shape = data[info.name]["ref"], (*(extent[:, 1] - extent[:, 0] + 1)[::-1].tolist(), info.components)
    name = f"{ref.get('basepath', 'data')}/{ref['id']}"
    packed = not (folder / name).is_file()
    place = data_file(index, f"{name}.gz" if packed else name)
    dtype = np.dtype(info.dtype).newbyteorder(">" if ref.get("encode") == "BigEndian" else "<")
    block = load_block(place, dtype, shape, encoding="gzip" if packed else "raw")
    axes = np.array(facts.get("direction", IDENTITY), np.float64).reshape(3, 3)  # one axis after the other
    steps = axes * np.reshape(np.array(facts["spacing"], np.float64), (3, 1))
    origin = np.array(facts["origin"], np.float64) + extent[:, 0] @ steps
    field, _ = select_component(block, options.component, source, label=f"array {info.name!r}")
    return placed(field, steps, origin, options, folder.resolve().name)
