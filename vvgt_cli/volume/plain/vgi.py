"""VGStudio's ``.vgi`` beside the raw file that it describes, which is memory-mapped.

A block ``{volume1}`` has its file in a section ``[file1]``; a section ``[geometry]`` of another block says how large
voxels are. Fields as open_iA and DREAM3D read them; the place in VGStudio's scene is not read.
"""

from __future__ import annotations

import math
import warnings
from pathlib import Path, PureWindowsPath

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.headers import HeaderFields, fields_of_sections
from vvgt_cli.volume.reading import ReadOptions, Volume, choose, data_file, load_block, one_unit, volume_name

_KINDS = {"float": "f", "unsigned integer": "u", "signed integer": "i"}
_BYTES = {"f": (4, 8), "u": (1, 2, 4, 8), "i": (1, 2, 4, 8)}


def read_vgi(path: Path, options: ReadOptions) -> Volume:
    """Read a volume that a VGStudio header describes.

    Raises:
        DataError: fields that are missing, or do not fit each other or the file; a volume of several files.
        UsageError: several volumes and no ``array`` chosen (`SeveralArrays`), or none such.
    """
    fields = fields_of_sections(path)
    names = [key.partition("/")[0] for key in fields if key.endswith("/file1/name")]
    name = names[choose(names, names, options.array, str(path), "volume")]
    values = _mapped(path, fields, f"{name}/file1/")
    there = [*values.shape[::-1]]
    stated = fields.sizes("size", fields.get(f"{name}/representation/size", fields[f"{name}/file1/size"]))
    if there != stated or f"{name}/file2/name" in fields:
        raise DataError(f"{path}: {name} of {stated} voxels, its first file of {there}; expected all of it in one file")
    places = [key.removesuffix("geometry/resolution") for key in fields if key.endswith("/geometry/resolution")]
    place = next((p for p in places if fields.get(f"{p}volume/volume") == name), *places[:1] or [""]) + "geometry/"
    _, unit = one_unit([fields.get(f"{place}unit", "")], str(path), options.spacing is not None)
    if not places and options.spacing is None:
        warnings.warn(f"{path}: no resolution; voxels are taken as 1 wide (--spacing X Y Z sets it)", stacklevel=2)
    edges = fields.floats("resolution", fields.get(f"{place}resolution", "1 1 1"), 3)
    return Volume(values, options.spacing_or(tuple(edges)), name=volume_name(path), unit=unit)


def _mapped(path: Path, fields: HeaderFields, start: str) -> np.ndarray:
    """Map the values (z, y, x) of the file that the fields beginning with ``start`` describe."""
    sizes = fields.sizes("Size", fields.need(f"{start}size"))
    stated, n = fields.get(f"{start}datatype", "").lower(), fields.integer(f"{start}bitsperelement", 0) // 8
    kind = _KINDS.get(stated, "")
    form, skip = fields.get(f"{start}fileformat", "raw"), fields.integer(f"{start}skipheader", 0)
    if len(sizes) != 3 or n not in _BYTES.get(kind, ()) or form != "raw" or skip < 0:
        layout = f"FileFormat {form}, Size {sizes}, Datatype {stated!r} of {8 * n} bits"
        raise DataError(f"{path}: {layout}; expected raw, three numbers, and float, or integers of up to 64 bits")
    if any(fields.floats("Mirror", fields.get(f"{start}mirror", "0 0 0"), 3)):
        warnings.warn(f"{path}: Mirror {fields[f'{start}mirror']} is not applied; axes are as stored", stacklevel=3)
    source = data_file(path, PureWindowsPath(fields[f"{start}name"]).name)
    need, there = skip + math.prod(sizes) * n, source.stat().st_size
    if there != need:
        raise DataError(f"{path}: {source.name} has {there} bytes; expected {need} by its Size and BitsPerElement")
    return load_block(source, np.dtype(f"<{kind}{n}"), (sizes[2], sizes[1], sizes[0]), offset=skip)
