"""`.spz` (Niantic's, versions 3 and 4) and `.compressed.ply` (PlayCanvas') through gsply."""

from __future__ import annotations

import gzip
import struct
import tempfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats import spz4
from vvgt_cli.gaussians.formats.splats import Splats, morton_order
from vvgt_cli.gaussians.header import MIP, TYPES, header_lines
from vvgt_cli.volume.libraries import library_errors, need

EXTRA = "share"
_RANGES = [f"{end}_{of}{axis}" for of in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
_RANGES += [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
_FORMAT = "format binary_little_endian 1.0"
_WHOLE = (0, 0, 0, 1, 1, 1)  # colour range of SuperSplat 1, whose chunks state none
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_FRACTION = 20  # fractional bits of a coordinate of 23 bits, unless it is too large: 1e-6
_COMMENT = 16  # gzip's flag for a comment in its header (RFC 1952)
_FLAGS = 14  # byte of the header; 1: opacity is compensated for dilation ("antialiased")
_FRONT = struct.Struct("<2sBBIBB")  # magic, method, flags, time, extra flags, system


def gsply(source: str) -> Any:
    """Return the library.

    Raises:
        DataError: the library is not installed.
    """
    return need("gsply", EXTRA, source, "this format")


def compressed_ply(splats: Splats, name: str, order: np.ndarray | None = None) -> bytes:
    """Encode columns as a `.compressed.ply`: 16 bytes per Gaussian, and 72 per chunk of 256 neighbours.

    ``order`` (K,) of the Gaussians is by default along the Morton curve.
    """
    library = gsply(name)
    s = splats.take(morton_order(splats.means) if order is None else order)
    rest = s.f_rest if s.f_rest.shape[1] else None
    content: bytes = library.compress_to_bytes(s.means, s.log_scales, s.quaternions, s.logits, s.f_dc, rest)
    comments = "".join(f"comment {line}\n" for line in s.comments).encode()
    head, end, body = content.partition(b"end_header\n")
    return head + comments + end + body


def read_compressed_ply(content: bytes, name: str) -> Splats:
    """Read the columns of a `.compressed.ply`.

    Raises:
        DataError: gsply cannot read it, or is not installed.
    """
    library = gsply(name)
    lines, size = header_lines(content[: 1 << 18], name)
    with library_errors(name, "a compressed .ply"):
        data = library.decompress_from_bytes(_in_order(content, lines, size))
        return _columns(data, [line[8:] for line in lines if line.startswith("comment ")])


def _in_order(content: bytes, lines: list[str], at: int) -> bytes:
    """Reorder the file's columns as gsply expects, with a colour range in every chunk."""
    elements: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    for words in map(str.split, lines):
        if words[:1] == ["element"]:
            elements[words[1]] = int(words[2]), []
        elif words[:1] == ["property"]:
            elements[list(elements)[-1]][1].append((words[2], TYPES[words[1]]))
    tables = {}
    for element, (count, fields) in elements.items():
        tables[element] = np.frombuffer(content, fields, count, at)
        at += tables[element].nbytes
    rest = [f"f_rest_{k}" for k in range(len(elements["sh"][1]))] if "sh" in elements else []
    chunks, count = len(tables["chunk"]), len(tables["vertex"])
    if _FORMAT not in lines or len(tables.get("sh", tables["vertex"])) != count or count > 256 * chunks:
        raise ValueError(f"not {_FORMAT}, or {chunks} chunks of 256 for {count} vertices")
    ends = {} if "min_r" in (tables["chunk"].dtype.names or ()) else dict(zip(_RANGES[12:], _WHOLE, strict=True))
    head, body = ["ply", _FORMAT], b""
    for element, names, kind in (("chunk", _RANGES, "float"), ("vertex", _PACKED, "uint"), ("sh", rest, "uchar")):
        if names:
            columns = [tables[element][key] if key not in ends else [ends[key]] * chunks for key in names]
            head += [f"element {element} {len(columns[0])}", *(f"property {kind} {key}" for key in names)]
            body += np.stack(columns, axis=1).astype(TYPES[kind]).tobytes()
    return "\n".join([*head, "end_header", ""]).encode() + body


def spz(splats: Splats, name: str) -> bytes:
    """Encode columns as `.spz` version 3, in the axes of the `.ply`, with its comments in the gzip header."""
    return _packed(_version_3(splats, name), splats.comments)


def spz_4(splats: Splats, name: str) -> bytes:
    """Encode columns as `.spz` version 4, with records for the comments and for the axes, which are the `.ply`'s."""
    return spz4.from_version_3(_version_3(splats, name), splats.comments, name)


def zstandard(source: str) -> None:
    """Check the libraries of `spz_4`.

    Raises:
        DataError: gsply or numcodecs is not installed.
    """
    gsply(source)
    spz4.library(source)


def _version_3(splats: Splats, name: str) -> bytes:
    """Return the content of an `.spz` of version 3 before compression, with the flag for compensated opacity."""
    library = gsply(name)
    largest = max(float(np.abs(splats.means).max()), 1e-6)
    bits = min(int(np.floor(np.log2((2**23 - 1) / largest))), _FRACTION)
    if bits < 1:
        raise DataError(f"{name}: positions up to {largest:g}; expected less than 4e6 for .spz: try --frame unit")
    s = splats
    rest = s.f_rest if s.f_rest.shape[1] else None
    data = library.GSData.from_arrays(s.means, s.log_scales, s.quaternions, s.logits, s.f_dc, rest, format="ply")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "out.spz"
        library.write_spz(path, data, version=3, fractional_bits=bits)
        content = bytearray(gzip.decompress(path.read_bytes()))
    content[_FLAGS] |= MIP in s.comments
    return bytes(content)


def _packed(content: bytes, comments: tuple[str, ...]) -> bytes:
    """Compress by gzip with comments in its header, reproducibly."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    text = "\n".join(comments).encode("ascii", "replace").replace(b"\0", b" ")
    front = _FRONT.pack(b"\x1f\x8b", 8, _COMMENT if text else 0, 0, 2, 255) + (text + b"\0" if text else b"")
    return front + packer.compress(content) + packer.flush() + struct.pack("<II", zlib.crc32(content), len(content))


def read_spz(content: bytes, name: str) -> Splats:
    """Read the columns of an `.spz` of version 1 to 4.

    Raises:
        DataError: gsply cannot read it, or is not installed.
    """
    library = gsply(name)
    comments = _comments(content)
    if content.startswith(spz4.MAGIC):
        content, comments = spz4.to_version_3(content, name)
    with library_errors(name, "an .spz"), tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "in.spz"
        path.write_bytes(content)
        return _columns(library.read_spz(path), comments)


def _comments(content: bytes) -> list[str]:
    """Return the comments that `_packed` wrote."""
    if len(content) < _FRONT.size or _FRONT.unpack_from(content)[2] != _COMMENT:
        return []
    text = content[_FRONT.size : max(content.find(b"\0", _FRONT.size), 0)]  # empty if it is not terminated
    return text.decode("ascii", "replace").splitlines()


def _columns(data: Any, comments: list[str]) -> Splats:
    count = len(data.means)
    rest = np.zeros((count, 0, 3)) if data.shN is None else np.reshape(data.shN, (count, -1, 3))
    found = (data.means, data.scales, data.quats, np.reshape(data.opacities, count), data.sh0, rest)
    means, log_scales, quaternions, logits, f_dc, f_rest = (np.array(column, np.float32) for column in found)
    return Splats(means, log_scales, quaternions, logits, f_dc, f_rest, tuple(comments))
