"""Writers of volumes, plane by plane, in the format of the file's ending (docs/commands/voxelize.md)."""

from __future__ import annotations

import gzip
import io
import itertools
import math
import os
import shutil
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.files import atomic_write, check_disk_space
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.libraries import need
from vvgt_cli.volume.space import METRES, in_space, metres
from vvgt_cli.volume.types import RIGHT, Volume

SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".mha", ".vti", ".npy", ".zarr", ".vdb")
AT_ONCE = 128 << 20  # bytes
_NAMES = {  # of types, in NRRD and in MetaImage
    "f4": ("float", "FLOAT"), "u1": ("uint8", "UCHAR"), "u2": ("uint16", "USHORT"), "i4": ("int32", "INT"),
}  # fmt: skip


@dataclass(frozen=True)
class Planes:
    """Values on a grid, made when they are asked for.

    Attributes:
        grid: a volume whose place they have; its own values do not count.
        dtype: of the values: float32, uint8, uint16 or int32.
        components: numbers in a voxel.
        make: makes the values of some planes, (planes, ny, nx) or (planes, ny, nx, components).
        background: value of most voxels.
    """

    grid: Volume
    dtype: np.dtype
    components: int
    make: Callable[[range], np.ndarray]
    background: float = 0.0

    @property
    def nbytes(self) -> int:
        """Bytes of all values."""
        return math.prod(self.grid.dims) * self.components * self.dtype.itemsize

    def slabs(self, component: int | None = None) -> Iterator[np.ndarray]:
        """Yield contiguous little-endian slabs, of all components or of one."""
        for slab in map(self.make, slabs(self.grid.dims)):
            part = slab if component is None or slab.ndim == 3 else slab[..., component]
            yield np.ascontiguousarray(part, self.dtype.newbyteorder("<"))

    def whole(self) -> np.ndarray:
        """Return all values, (nz, ny, nx) or (nz, ny, nx, components); raise DataError if memory is too small."""
        check_memory(2 * self.nbytes, " x ".join(map(str, self.grid.dims)) + " voxels", "give fewer, by --dims")
        return np.concatenate(list(self.slabs()))


def slabs(dims: tuple[int, int, int]) -> Iterator[range]:
    """Yield the planes of a grid in slabs of which four numbers a voxel take `AT_ONCE` bytes, or one plane."""
    nx, ny, nz = dims
    deep = max(AT_ONCE // (16 * nx * ny), 1)
    for z in range(0, nz, deep):
        yield range(z, min(z + deep, nz))


def write_volume(path: str | os.PathLike[str], planes: Planes, overwrite: bool = False) -> int:
    """Write values in the format of the name, and return the bytes; raise DataError or UsageError where it cannot."""
    name = str(path)
    suffix = next((s for s in SUFFIXES if name.lower().endswith(s)), "")
    if not suffix:
        raise UsageError(f"-o {name}: expected a name ending in {' or '.join(SUFFIXES)}")
    if suffix not in (".nii.gz", ".zarr", ".vdb"):
        check_disk_space(path, planes.nbytes)
    with atomic_write(path, overwrite) as temporary:
        if suffix == ".zarr":
            return _write_zarr(temporary, name, planes)
        if suffix == ".vdb":
            return temporary.write_bytes(_vdb(planes))
        parts = [None] if suffix not in (".nii", ".nii.gz") else [*range(planes.components)]
        head, tail = _HEADS[suffix.removesuffix(".gz")](planes, name)
        with open(temporary, "wb") as file:
            out: IO[bytes] = gzip.GzipFile("", "wb", 3, file, 0) if suffix == ".nii.gz" else file  # type: ignore[assignment]
            out.write(head)
            for part in parts:
                for slab in planes.slabs(part):
                    out.write(slab.data)
            out.write(tail)
            out.close()
        return temporary.stat().st_size


def write_nrrd(path: str | os.PathLike[str], volume: Volume, overwrite: bool = False) -> int:
    """Write a volume's data values as float32 under a name that ends in .nrrd, as `write_volume`."""

    def make(z: range) -> np.ndarray:
        values = volume.data[z.start : z.stop].astype(np.float32)
        return np.asarray(values * np.float32(volume.slope) + np.float32(volume.intercept))

    return write_volume(path, Planes(volume, np.dtype(np.float32), 1, make), overwrite)


def _nifti(planes: Planes, name: str) -> tuple[bytes, bytes]:
    nib, grid = need("nibabel", "neuro", name, "a NIfTI file"), planes.grid
    placed = grid if grid.space is None else in_space(grid, "RAS")
    large = max(grid.dims) > 32767
    header = nib.Nifti2Header() if large else nib.Nifti1Header()
    header.set_data_shape((*grid.dims, 1, planes.components) if planes.components > 1 or large else grid.dims)
    header.set_data_dtype(planes.dtype)
    header["pixdim"][1:4] = grid.spacing
    header.set_sform(placed.affine, 1 if grid.space else 2)
    unit = "mm" if grid.space else {"m": "meter", "mm": "mm", "um": "micron"}.get(grid.unit, "unknown")
    header.set_xyzt_units(unit)
    if planes.components > 1:
        header.set_intent("vector")
    stream = io.BytesIO()
    header.write_to(stream)
    return stream.getvalue(), b""


def _nrrd(planes: Planes, _: str) -> tuple[bytes, bytes]:
    volume, components, several = planes.grid, planes.components, planes.components > 1
    vectors = " ".join(
        f"({','.join(repr(v) if v else '0' for v in axis)})" for axis in volume.affine[:3, :3].T.tolist()
    )
    space = {"RAS": "right-anterior-superior", "LPS": "left-posterior-superior"}.get(volume.space or "")
    header = [
        "NRRD0004",
        f"type: {_NAMES[planes.dtype.str[1:]][0]}",
        f"dimension: {3 + several}",
        f"space: {space}" if space else "space dimension: 3",
        f"sizes: {f'{components} ' * several}{' '.join(map(str, volume.dims))}",
        f"space directions: {'none ' * several}{vectors}",
        f"space origin: ({','.join(repr(float(o)) for o in volume.origin)})",
        *(["kinds: vector domain domain domain"] if several else []),
        *([f"space units: {' '.join([chr(34) + volume.unit + chr(34)] * 3)}"] if volume.unit and not space else []),
        "endian: little",
        "encoding: raw",
    ]
    return ("\n".join(header) + "\n\n").encode(), b""


def _meta(planes: Planes, _: str) -> tuple[bytes, bytes]:
    grid = planes.grid if planes.grid.space is None else in_space(planes.grid, "LPS")
    fields = {
        "ObjectType": "Image", "NDims": 3, "BinaryData": True, "BinaryDataByteOrderMSB": False,
        "TransformMatrix": _words(grid.axes.T.ravel()), "Offset": _words(grid.origin),
        "AnatomicalOrientation": "RAI" if grid.space else "???", "ElementSpacing": _words(grid.spacing),
        "DistanceUnits": grid.unit or "?", "DimSize": _words(grid.dims), "ElementNumberOfChannels": planes.components,
        "ElementType": f"MET_{_NAMES[planes.dtype.str[1:]][1]}", "ElementDataFile": "LOCAL",
    }  # fmt: skip
    return "".join(f"{key} = {value}\n" for key, value in fields.items()).encode(), b""


def _vti(planes: Planes, _: str) -> tuple[bytes, bytes]:
    grid = planes.grid
    extent = " ".join(f"0 {n - 1}" for n in grid.dims)
    place = f'Origin="{_words(grid.origin)}" Spacing="{_words(grid.spacing)}" Direction="{_words(grid.direction)}"'
    kind = {"f": "Float", "u": "UInt", "i": "Int"}[planes.dtype.kind] + str(8 * planes.dtype.itemsize)
    array = f'type="{kind}" Name="values" NumberOfComponents="{planes.components}"'
    head = (
        '<?xml version="1.0"?>\n<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" '
        f'header_type="UInt64">\n<ImageData WholeExtent="{extent}" {place}>\n<Piece Extent="{extent}">'
        f'<PointData Scalars="values"><DataArray {array} format="appended" offset="0"/></PointData></Piece>\n'
        '</ImageData>\n<AppendedData encoding="raw">_'
    )
    return head.encode() + struct.pack("<Q", planes.nbytes), b"</AppendedData>\n</VTKFile>\n"


def _npy(planes: Planes, _: str) -> tuple[bytes, bytes]:
    shape = planes.grid.dims[::-1] + ((planes.components,) if planes.components > 1 else ())
    head, stream = {"descr": planes.dtype.newbyteorder("<").str, "fortran_order": False, "shape": shape}, io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, head)
    return stream.getvalue(), b""


_HEADS = {".nii": _nifti, ".nrrd": _nrrd, ".mha": _meta, ".vti": _vti, ".npy": _npy}


def _words(values: Any) -> str:
    return " ".join(repr(v) for v in np.asarray(values).tolist())


def _write_zarr(folder: Path, name: str, planes: Planes) -> int:
    """Write an OME-Zarr image (0.5) of one level; raise UsageError for axes that its metadata cannot state."""
    zarr, grid, several = need("zarr", "zarr", name, "Zarr"), planes.grid, planes.components > 1
    if np.abs(grid.axes - np.eye(3)).max() > RIGHT:
        raise UsageError(f"-o {name}: OME-Zarr states no directions, and this grid is turned; choose .nrrd or .nii.gz")
    shape, chunk = ((planes.components,) if several else ()) + grid.dims[::-1], (64,) * 3
    names = METRES.get(metres("mm" if grid.space else grid.unit) or 0.0, ())
    unit = next((word for word in names if word.endswith("meter") or word == "angstrom"), None)
    axes: list[dict[str, str]] = [{"name": n, "type": "space"} | ({"unit": unit} if unit else {}) for n in "zyx"]
    scale, origin = list(grid.spacing[::-1]), list(grid.origin[::-1])
    if several:
        axes, scale, origin = [{"name": "c", "type": "channel"}, *axes], [1.0, *scale], [0.0, *origin]
    steps = [{"type": "scale", "scale": scale}, {"type": "translation", "translation": origin}]
    image = {"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": steps}]}
    try:
        group = zarr.open_group(folder, mode="w")
        group.attrs["ome"] = {"version": "0.5", "multiscales": [image]}
        array = group.create_array("0", shape=shape, chunks=((1,) if several else ()) + chunk, dtype=planes.dtype)
        for part in range(planes.components):
            z = 0
            for slab in planes.slabs(part):
                array[(part, slice(z, z + len(slab))) if several else slice(z, z + len(slab))] = slab
                z += len(slab)
    except BaseException:
        with suppress(OSError):
            shutil.rmtree(folder)
        raise
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def _vdb(planes: Planes) -> bytes:
    """Return an OpenVDB file (format 224, not compressed): of one component, or ``density`` and ``color`` of four."""
    values, one = planes.whole().astype("<f4", copy=False), planes.components == 1
    grids = {"values": values[..., None]} if one else {"density": values[..., :1], "color": values[..., 1:]}
    body = b" BDV\0\0\0\0" + struct.pack("<IIIB", 224, 10, 0, 1) + b"0" * 36 + struct.pack("<Ii", 0, len(grids))
    for name, field in grids.items():
        kind = "float" if field.shape[3] == 1 else "vec3s"
        head = _text(name) + _text(f"Tree_{kind}_5_4_3") + _text("")
        data = struct.pack("<II", 0, 0) + _text("AffineMap") + planes.grid.affine.T.astype("<f8").tobytes()
        data += _tree(np.ascontiguousarray(field.transpose(2, 1, 0, 3)), planes.background)
        start = len(body) + len(head) + 24
        body += head + struct.pack("<qqq", start, start, start + len(data)) + data
    return body


def _tree(field: np.ndarray, background: float) -> bytes:
    """Return the nodes and leaves of a field (x, y, z, components) where it is not its background."""
    width, fill = field.shape[3], np.full(field.shape[3], background, "<f4").tobytes()
    roots, leaves = [], []
    for corner in itertools.product(*(range(0, n, 4096) for n in field.shape[:3])):
        nodes = []  # lower nodes, of 128 voxels
        spans = (range(a, min(a + 4096, n), 128) for a, n in zip(corner, field.shape, strict=False))
        for i, j, k in itertools.product(*spans):
            part = field[i : i + 128, j : j + 128, k : k + 128]
            whole = np.full((128, 128, 128, width), background, "<f4")
            whole[: part.shape[0], : part.shape[1], : part.shape[2]] = part
            bricks = whole.reshape(16, 8, 16, 8, 16, 8, width).transpose(0, 2, 4, 1, 3, 5, 6).reshape(4096, 512, width)
            active = (bricks != np.float32(background)).any(axis=2)
            there = active.any(axis=1)
            if there.any():
                nodes.append(((i - corner[0], j - corner[1], k - corner[2]), _inner(there, fill)))
                leaves.append((active[there], bricks[there]))
        if nodes:
            upper = np.zeros((32, 32, 32), bool)
            for at, _ in nodes:
                upper[tuple(np.array(at) // 128)] = True
            roots.append(struct.pack("<3i", *corner) + _inner(upper.ravel(), fill) + b"".join(n for _, n in nodes))
    masks = [_bits(mask) for active, _ in leaves for mask in active]
    stored = [value.tobytes() for _, bricks in leaves for value in bricks]
    head = struct.pack("<i", 1) + fill + struct.pack("<II", 0, len(roots)) + b"".join(roots)
    return head + b"".join(masks) + b"".join(m + b"\6" + v for m, v in zip(masks, stored, strict=True))


def _inner(child: np.ndarray, fill: bytes) -> bytes:
    return _bits(child) + bytes(child.size // 8) + b"\6" + fill * child.size


def _bits(mask: np.ndarray) -> bytes:
    return np.packbits(mask, bitorder="little").tobytes()


def _text(name: str) -> bytes:
    return struct.pack("<I", len(name)) + name.encode()
