"""N5: a folder (``STORE.n5``, ``STORE.n5:/path/to/array``) of blocks, pyramids (``s0``, ``s1``, ...) among them.

Format: https://github.com/saalfeldlab/n5, version 4. zarr no longer reads it. Blocks are unpacked to their size and no
further: gzip, bzip2, xz and LZ4 by what is here anyway, Blosc and Zstandard by numcodecs. Place and units: those of
n5-viewer, BigDataViewer and COSEM.
"""

from __future__ import annotations

import itertools
import math
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import blocks
from vvgt_cli.volume.arrays import MAX_CHUNK
from vvgt_cli.volume.arrays.beside import choose_grid
from vvgt_cli.volume.arrays.zarr import inside, json_object, name_in
from vvgt_cli.volume.labelled import Axis, labelled_volume
from vvgt_cli.volume.microscopy import bigdataviewer
from vvgt_cli.volume.microscopy.image import EXTRA
from vvgt_cli.volume.reading import ReadOptions, Volume, need
from vvgt_cli.volume.stored import put_overlap

METADATA = "attributes.json"
TYPES = {f"{kind}{bits}" for kind in ("uint", "int") for bits in (8, 16, 32, 64)} | {"float32", "float64"}
MAX_AXES = 5
MAX_VISITED = 10_000  # folders
LZ4_BLOCK = struct.Struct("<8sBiiI")  # of Java's LZ4BlockOutputStream


@dataclass(frozen=True)
class N5Array:
    """An array of a store.

    Attributes:
        place: its folder.
        shape, blocks: slowest axis first, as numpy has them: the file's are the other way round.
        dtype: of the values, as stored.
        compression: as the file has it.
        attributes: all of its metadata.
    """

    place: Path
    shape: tuple[int, ...]
    blocks: tuple[int, ...]
    dtype: np.dtype
    compression: dict[str, Any]
    attributes: dict[str, Any]

    def read(self, index: tuple[Any, ...]) -> np.ndarray:
        """Read a part, by a number or a slice with step 1 for each axis; missing blocks are 0."""
        spans = [(k, k + 1) if isinstance(k, int) else k.indices(n)[:2] for k, n in zip(index, self.shape, strict=True)]
        out = np.zeros([b - a for a, b in spans], self.dtype.newbyteorder("="))
        grid = [range(a // c, -(-b // c)) for (a, b), c in zip(spans, self.blocks, strict=True)]
        for at in itertools.product(*grid):
            if (block := self._block(at)) is not None:
                put_overlap(out, [a for a, _ in spans], block, [k * c for k, c in zip(at, self.blocks, strict=True)])
        return out[tuple(0 if isinstance(k, int) else slice(None) for k in index)]

    def _block(self, at: Sequence[int]) -> np.ndarray | None:
        file = self.place.joinpath(*(str(k) for k in reversed(at)))
        try:
            packed = file.read_bytes()
        except FileNotFoundError:
            return None
        mode, axes = struct.unpack_from(">HH", packed)
        sizes = struct.unpack_from(f">{axes}I", packed, 4) if axes == len(self.shape) else ()
        fits = all(0 < n <= c for n, c in zip(sizes[::-1], self.blocks, strict=bool(sizes)))
        if mode not in (0, 1) or not sizes or not fits:
            raise DataError(f"{file}: a block of mode {mode} and {sizes} values; expected at most {self.blocks[::-1]}")
        need_bytes = math.prod(sizes) * self.dtype.itemsize
        raw = unpack(self.compression, packed[4 + 4 * axes + 4 * (mode == 1) :], need_bytes, str(file))
        if len(raw) != need_bytes:
            raise DataError(f"{file}: {len(raw)} bytes; its {sizes} values need {need_bytes}; fetch the block again")
        return np.frombuffer(raw, self.dtype).reshape(sizes[::-1])


def unpack(compression: dict[str, Any], data: bytes, size: int, source: str) -> bytes:
    """Unpack ``data`` to at most ``size`` bytes; raise DataError for unknown or longer data, or without numcodecs."""
    kind = compression.get("type", "raw")
    if kind == "raw":
        return data[:size]
    if kind in ("gzip", "bzip2", "xz"):
        return blocks.unpack("zlib" if kind == "gzip" and compression.get("useZlib") is True else kind, data, size)
    if kind == "lz4":
        return _lz4(data, size)
    if kind in ("blosc", "zstd"):
        codecs = need(f"numcodecs.{kind}", EXTRA, source, f"N5 with {kind}")
        stated = struct.unpack_from("<I", data, 4)[0] if kind == "blosc" else size
        if stated != size or (kind == "zstd" and len(data) < 4):
            raise DataError(f"{source}: a block of {stated} bytes; expected {size}; fetch the block again")
        out = bytearray(size)
        codecs.decompress(data, out)
        return bytes(out)
    raise DataError(f"{source}: compression {str(kind)[:40]!r}; expected raw, gzip, bzip2, xz, lz4, blosc or zstd")


def _lz4(data: bytes, size: int) -> bytes:
    out, at = bytearray(), 0
    while len(out) < size:
        magic, token, packed, length, _ = LZ4_BLOCK.unpack_from(data, at)
        at += LZ4_BLOCK.size
        if magic != b"LZ4Block" or not 0 < length <= size - len(out) or not 0 <= packed <= len(data) - at:
            raise ValueError("an LZ4 block that does not fit")
        part = data[at : at + packed]
        out += part if token & 0xF0 == 0x10 else blocks.unpack("lz4", part, length)
        at += packed
    return bytes(out)


def holds_n5(path: Path) -> bool:
    """Tell whether a folder is an N5 store, or an array in one."""
    if not (path / METADATA).is_file():
        return path.suffix == ".n5"
    try:
        facts = _metadata(path)
    except (OSError, ValueError, DataError):
        return True
    return path.suffix == ".n5" or "n5" in facts or "dimensions" in facts


def _metadata(folder: Path) -> dict[str, Any]:
    return json_object(folder / METADATA) if (folder / METADATA).is_file() else {}


def read_n5(path: Path, options: ReadOptions) -> Volume:
    """Read one array of an N5 store, of a pyramid its finest or ``options.level``; BigDataViewer's by its XML."""
    volume = bigdataviewer.read_beside(path, options)
    return read_array(path, options) if volume is None else volume


def read_array(path: Path, options: ReadOptions) -> Volume:
    """Read one array of an N5 store, as it is."""
    place = _choose(path, options)
    array = _array(place)
    dtype, name = array.dtype.newbyteorder("="), name_in(path, place)
    return labelled_volume(array.read, dtype, _axes(array), {}, options, str(place), name, array.blocks)


def _levels(group: Path) -> list[Path]:
    """List the folders ``s0``, ``s1``, ... of arrays in a group that is no array itself."""
    if "dimensions" in _metadata(group):
        return []
    levels: list[Path] = []
    while "dimensions" in _metadata(group / f"s{len(levels)}") and len(levels) < 64:
        levels.append(group / f"s{len(levels)}")
    return levels


def _choose(path: Path, options: ReadOptions) -> Path:
    """Return the folder of the array asked for, or of the only one; for a pyramid, that of the level."""
    here = inside(path, options.array)
    if "dimensions" in (facts := _metadata(here)):
        choose_grid({here.name: (facts["dimensions"][::-1], str(facts.get("dataType")))}, here.name, str(path))
        if options.level is not None:
            raise UsageError(f"{path}: an array without levels; leave out --level {options.level}")
        return here
    fits = _arrays(here) if here.is_dir() else []
    wanted, known = (None, fits) if fits else (options.array, _arrays(path))
    finest = {p.relative_to(path).as_posix(): _metadata((_levels(p) or [p])[0]) for p in known}
    shapes = {name: (facts["dimensions"][::-1], str(facts.get("dataType"))) for name, facts in finest.items()}
    how = f"choose one as {path}:/PATH (or with --array)"
    chosen = path / choose_grid(shapes, wanted, str(path), how=how)
    levels = _levels(chosen)
    if (options.level or 0) >= max(len(levels), 1):
        raise UsageError(f"{path}: --level {options.level}: expected full, or 0 to {max(len(levels), 1) - 1}")
    return levels[options.level or 0] if levels else chosen


def _arrays(root: Path) -> list[Path]:
    """List the arrays and pyramids in a group and the groups below it."""
    arrays: list[Path] = []
    groups, seen = [root], 0
    while groups and seen < MAX_VISITED:
        group, seen = groups.pop(0), seen + 1
        facts = _metadata(group)
        if _levels(group) or len(facts.get("dimensions", ())) >= 2:
            arrays.append(group)
        elif "dimensions" not in facts:
            groups += sorted(p for p in group.iterdir() if p.is_dir() and not p.is_symlink())
    return arrays


def _array(place: Path) -> N5Array:
    facts = _metadata(place)
    sizes, blocks = facts.get("dimensions"), facts.get("blockSize")
    kind, packed = facts.get("dataType"), facts.get("compression", facts.get("compressionType", "raw"))
    compression = {"type": packed} if isinstance(packed, str) else packed
    good = all(
        isinstance(some, list) and 2 <= len(some) <= MAX_AXES and all(type(n) is int and 0 < n < 1 << 62 for n in some)
        for some in (sizes, blocks)
    )
    if not good or len(sizes) != len(blocks) or kind not in TYPES or not isinstance(compression, dict):  # type: ignore[arg-type]
        raise DataError(
            f"{place}: dimensions {str(sizes)[:80]}, blocks {str(blocks)[:80]} of {str(kind)[:40]}; expected 2 to "
            f"{MAX_AXES} sizes of each, and a type such as uint16"
        )
    dtype = np.dtype(str(kind)).newbyteorder(">")
    if math.prod(blocks) * dtype.itemsize > MAX_CHUNK:  # type: ignore[arg-type]
        raise DataError(f"{place}: blocks of {blocks} values; expected at most 2 GiB each")
    return N5Array(place, tuple(sizes[::-1]), tuple(blocks[::-1]), dtype, compression, facts)  # type: ignore[index]


def _axes(array: N5Array) -> list[Axis]:
    """Return the axes, slowest first; the first three in the file are x, y and z unless it names them."""
    n = len(array.shape)
    names, units, scale, shift = _transform(array, n)
    axes = []
    for name, unit, step, start, size in zip(names, units, scale, shift, array.shape, strict=True):
        role = name.lower() if name.lower() in ("x", "y", "z", "t", "c") else ""
        centres = start + step * np.arange(size) if role in ("x", "y", "z") and size <= 1 << 24 else None
        axes.append(Axis(name, size, centres, unit, role, step=abs(step)))
    return axes


def _transform(array: N5Array, n: int) -> tuple[list[str], list[str], list[float], list[float]]:
    """Return names, units, spacing and first position of the axes, slowest first."""
    facts = array.attributes
    stated = facts.get("transform")  # COSEM: in numpy's order
    if isinstance(stated, dict) and all(len(_list(stated.get(k), n)) == n for k in ("axes", "scale")):
        units = [str(u) for u in _list(stated.get("units"), n)] or [""] * n
        shift = _floats(stated.get("translate"), n) or [0.0] * n
        return [str(a) for a in stated["axes"]], units, _floats(stated["scale"], n) or [1.0] * n, shift
    within = array.place.name.startswith("s")
    above, finest = (_metadata(array.place.parent / name) if within else {} for name in ("", "s0"))
    spatial = min(n, 3)

    def stated_size(*places: Mapping[str, Any]) -> Any:
        return next((one[key] for one in places for key in ("pixelResolution", "resolution") if key in one), None)

    def lengths(size: Any) -> list[float]:
        return _floats(size.get("dimensions") if isinstance(size, dict) else size, spatial)

    own, size = stated_size(facts), stated_size(facts, above)
    resized = own is not None and lengths(own) != lengths(stated_size(finest, above))  # a level of a size of its own
    unit = next((f["units"] for f in (facts, above) if isinstance(f.get("units"), list)), None)
    unit = [size.get("unit")] * 3 if isinstance(size, dict) else unit
    steps = lengths(size) or [1.0] * spatial
    level = int(array.place.name[1:]) if re.fullmatch(r"s\d{1,3}", array.place.name) else 0
    levels: list[Any] = next(
        (above[k] for k in ("scales", "downsamplingFactors") if isinstance(above.get(k), list)), []
    )
    listed = levels[level] if level < len(levels) and not resized else None  # of all levels, by the group
    factors = _floats(facts.get("downsamplingFactors", listed), spatial) or [1.0] * spatial
    first = _floats(facts.get("offset"), spatial) or [0.0] * spatial
    named = _list(facts.get("axes"), n)  # fastest first, as the sizes
    names = [str(a) for a in named] if named else ["x", "y", "z", *[""] * n][:n]
    units = [str(u or "") for u in _list(unit, spatial)] or [""] * spatial
    rest = n - spatial
    # a mean of voxels lies in their middle
    shift = [s * (f - 1) / 2 + at for s, f, at in zip(steps, factors, first, strict=True)]
    scale = [s * f for s, f in zip(steps, factors, strict=True)]
    return names[::-1], ([*units, *[""] * rest])[::-1], ([*scale, *[1.0] * rest])[::-1], ([*shift, *[0.0] * rest])[::-1]


def _list(value: Any, n: int) -> list[Any]:
    """Return the first ``n`` items of a list that has as many, else nothing."""
    return value[:n] if isinstance(value, list) and len(value) >= n else []


def _floats(value: Any, n: int) -> list[float]:
    """Return ``n`` finite numbers, else nothing."""
    some = _list(value, n)
    good = all(isinstance(v, int | float) and math.isfinite(v) and abs(v) < 1e30 for v in some)
    return [float(v) for v in some] if good else []
