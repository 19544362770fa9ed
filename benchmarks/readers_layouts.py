"""Rows of benchmarks/readers.py whose files no library at hand writes: by hand, or by h5py in the format's layout."""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from readers import ORIGIN, SPACING, Row

from tests import microscopes

AT_0 = (0.0, 0.0, 0.0)
LEAF, LOWER, UPPER = 8, 128, 4096  # of OpenVDB's trees


def _minc2(folder: Path, values: np.ndarray) -> Path:
    """As libminc writes: https://en.wikibooks.org/wiki/MINC/Reference/MINC2.0_File_Format_Reference."""
    import h5py

    with h5py.File(folder / "v2.mnc", "w") as file:
        root = file.create_group("minc-2.0")
        for k, name in enumerate("xyz"):
            axis = root.create_dataset(f"dimensions/{name}space", data=np.int32(0))
            told = {"start": ORIGIN[k], "step": SPACING[k], "direction_cosines": np.eye(3)[k], "units": np.bytes_("mm")}
            for key, value in told.items():
                axis.attrs[key] = value
            axis.attrs["spacing"], axis.attrs["length"] = np.bytes_("regular__"), np.int32(values.shape[2 - k])
        chunks = tuple(min(32, n) for n in values.shape)
        image = root.create_dataset("image/0/image", data=values, chunks=chunks, compression="gzip", compression_opts=1)
        image.attrs["dimorder"], image.attrs["valid_range"] = (
            np.bytes_("zspace,yspace,xspace"),
            np.array([0.0, 32767.0]),
        )
        for name, value in (("min", 0.0), ("max", 32767.0)):
            ends = root.create_dataset(f"image/0/image-{name}", data=np.full(len(values), value))
            ends.attrs["dimorder"] = np.bytes_("zspace")
    return folder / "v2.mnc"


def _ims(folder: Path, values: np.ndarray) -> Path:
    """Of one level, in Imaris' chunks."""
    import h5py

    def told(group: Any, **attributes: object) -> None:
        for key, value in attributes.items():
            group.attrs[key] = np.array([c.encode() for c in str(value)], "S1")

    sizes = dict(zip("ZYX", values.shape, strict=True))
    with h5py.File(folder / "v.ims", "w") as file:
        group = file.create_group("DataSet/ResolutionLevel 0/TimePoint 0/Channel 0")
        told(group, **{f"ImageSize{axis}": n for axis, n in sizes.items()})
        chunks = tuple(min(n, edge) for n, edge in zip(values.shape, (16, 256, 256), strict=True))
        packing: Any = {"chunks": chunks, "compression": "gzip", "compression_opts": 2}
        group.create_dataset("Data", data=values.astype(np.uint16), **packing)
        image = file.create_group("DataSetInfo/Image")
        told(image, Unit="um", **sizes)
        for k, (start, step, n) in enumerate(zip(ORIGIN, SPACING, values.shape[::-1], strict=True)):
            told(image, **{f"ExtMin{k}": start - step / 2, f"ExtMax{k}": start + step * (n - 0.5)})
        told(file.create_group("DataSetInfo/Channel 0"), Name="DAPI", Color="1 1 1", ColorMode="BaseColor")
    return folder / "v.ims"


def _dataset(name: str) -> Any:
    def read(path: Path) -> Any:
        import h5py

        with h5py.File(path) as file:
            return file[name][()]

    return read


def _lif(folder: Path, values: np.ndarray) -> Path:
    content = microscopes.lif([("v", values.astype(np.uint16)[None, None])], SPACING, ORIGIN)
    (folder / "v.lif").write_bytes(content)
    return folder / "v.lif"


def _by_liffile(path: Path) -> Any:
    import liffile

    with liffile.LifFile(path) as file:
        return file.images[0].asarray()


def _nd2(folder: Path, values: np.ndarray) -> Path:
    square = (SPACING[0], SPACING[0], SPACING[2])  # its pixels are
    (folder / "v.nd2").write_bytes(microscopes.nd2(values.astype(np.uint16)[None, None], True, square))
    return folder / "v.nd2"


def _by_nd2(path: Path) -> Any:
    import nd2

    return nd2.imread(path)


def _n5(folder: Path, values: np.ndarray) -> Path:
    """https://github.com/saalfeldlab/n5, blocks of 64^3 in gzip, placed as COSEM does."""
    store, edge = folder / "v.n5", 64
    told = {
        "dimensions": values.shape[::-1], "blockSize": [edge] * 3, "dataType": "int16",
        "compression": {"type": "gzip", "level": 1},
        "transform": {"axes": list("zyx"), "units": ["um"] * 3, "scale": SPACING[::-1], "translate": ORIGIN[::-1]},
    }  # fmt: skip
    store.mkdir()
    (store / "attributes.json").write_text(json.dumps(told))
    for x, y, z in np.ndindex(*(-(-n // edge) for n in values.shape[::-1])):
        part = values[tuple(slice(edge * k, edge * (k + 1)) for k in (z, y, x))]
        head = struct.pack(">HH3I", 0, 3, *part.shape[::-1])
        (store / f"{x}/{y}").mkdir(parents=True, exist_ok=True)
        (store / f"{x}/{y}/{z}").write_bytes(head + gzip.compress(part.astype(">i2").tobytes(), 1))
    return store


def _words(*texts: str) -> bytes:
    return b"".join(struct.pack("<I", len(text)) + text.encode() for text in texts)


def _vdb(folder: Path, values: np.ndarray) -> Path:
    """Uncompressed, format 224, as openvdb/io/Archive.cc, tree/InternalNode.h and LeafNode.h write a tree of int32."""
    head = b" BDV\0\0\0\0" + struct.pack("<IIIB", 224, 10, 0, 1) + b"0" * 36 + struct.pack("<Ii", 0, 1)
    head += _words("values", "Tree_int32_5_4_3", "")
    grid = struct.pack("<II", 0, 0) + _words("ScaleTranslateMap")  # not compressed, no metadata
    s = np.array(SPACING)
    grid += struct.pack("<18d", *ORIGIN, *s, *s, *1 / s, *1 / s**2, *0.5 / s)
    edges = [-(-n // LEAF) * LEAF for n in values.shape[::-1]]
    padded, active = (np.zeros(edges, kind) for kind in (np.int32, bool))  # x, y, z
    padded[tuple(map(slice, values.shape[::-1]))] = values.T
    active[tuple(map(slice, values.shape[::-1]))] = True
    grid += struct.pack("<iiII3i", 1, 0, 0, 1, 0, 0, 0)  # buffers, background, no tile, a child, at the origin
    lowers = [-(-n // LOWER) for n in edges]
    topology, buffers = [_inner(lowers, UPPER // LOWER)], []
    for corner in np.ndindex(*lowers):
        part = tuple(slice(LOWER * k, LOWER * (k + 1)) for k in corner)
        leaves = [-(-n // LEAF) for n in padded[part].shape]
        topology.append(_inner(leaves, LOWER // LEAF))
        voxels, masks = (
            array[part]
            .reshape(*(n for k in leaves for n in (k, LEAF)))
            .transpose(0, 2, 4, 1, 3, 5)
            .reshape(-1, LEAF**3)
            for array in (padded, active)
        )
        bits = np.packbits(masks, axis=1, bitorder="little")
        topology.append(bits.tobytes())
        buffers += [m.tobytes() + b"\x06" + v.tobytes() for m, v in zip(bits, voxels, strict=True)]
    grid += b"".join(topology + buffers)
    start = len(head) + 24
    (folder / "v.vdb").write_bytes(head + struct.pack("<3q", start, start, start + len(grid)) + grid)
    return folder / "v.vdb"


def _inner(children: list[int], width: int) -> bytes:
    """Masks and tiles of an inner node with children in its first corner."""
    child = np.zeros((width,) * 3, bool)
    child[tuple(map(slice, children))] = True
    return np.packbits(child, bitorder="little").tobytes() + bytes(width**3 // 8) + b"\x06" + bytes(4 * width**3)


def _by_nibabel(path: Path) -> Any:
    import nibabel

    return np.asanyarray(nibabel.load(path).dataobj)


LAYOUTS = (
    Row("MINC 2", "h5py", "MINC", _minc2, _by_nibabel),
    Row(
        "Imaris", "h5py", "HDF5", _ims, _dataset("DataSet/ResolutionLevel 0/TimePoint 0/Channel 0/Data"),
    ),
    Row("LIF", "by hand", "LIF", _lif, _by_liffile),
    Row("ND2, lossless", "by hand", "ND2", _nd2, _by_nd2, origin=AT_0, spacing=(SPACING[0], SPACING[0], SPACING[2])),
    Row("N5, gzip", "by hand", "N5", _n5, None),
    Row("OpenVDB", "by hand", "OpenVDB", _vdb, None),
)  # fmt: skip
