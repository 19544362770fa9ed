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
_WHOLE = (0, 0, 0, 1, 1, 1)  # range of colours of SuperSplat 1, whose chunks have none
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_FRACTION = 20  # bits of a coordinate behind the point, where its 23 leave as many: 1e-6
_COMMENT = 16  # gzip's flag for a comment in its header (RFC 1952)
_FLAGS = 14  # byte of the header; 1: opacity is to be compensated ("antialiased")
_FRONT = struct.Struct("<2sBBIBB")  # magic, method, flags, time, extra flags, system


def gsply(source: str) -> Any:
    """The library.

    Raises:
        DataError: it is not installed.
    """
    return need("gsply", EXTRA, source, "this format")


def compressed_ply(splats: Splats, name: str, order: np.ndarray | None = None) -> bytes:
    """A `.compressed.ply`: 16 bytes a Gaussian and 72 for 256 of them, which lie near each other.

    ``order`` (K,) of the Gaussians; by default along Morton's curve.
    """
    library = gsply(name)
    s = splats.take(morton_order(splats.means) if order is None else order)
    rest = s.f_rest if s.f_rest.shape[1] else None
    content: bytes = library.compress_to_bytes(s.means, s.log_scales, s.quaternions, s.logits, s.f_dc, rest)
    said = "".join(f"comment {line}\n" for line in s.comments).encode()
    head, end, body = content.partition(b"end_header\n")
    return head + said + end + body


def read_compressed_ply(content: bytes, name: str) -> Splats:
    """The columns of a `.compressed.ply`.

    Raises:
        DataError: gsply cannot read it, or is not installed.
    """
    library = gsply(name)
    lines, size = header_lines(content[: 1 << 18], name)
    with library_errors(name, "a compressed .ply"):
        data = library.decompress_from_bytes(_in_order(content, lines, size))
        return _columns(data, [line[8:] for line in lines if line.startswith("comment ")])


def _in_order(content: bytes, lines: list[str], at: int) -> bytes:
    """Put the file's columns in the order that gsply expects, and a range of colours in every chunk."""
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
    """An `.spz` of version 3, in the axes of the `.ply`; its gzip header's comment holds the `.ply`'s comments."""
    return _packed(_version_3(splats, name), splats.comments)


def spz_4(splats: Splats, name: str) -> bytes:
    """An `.spz` of version 4, with records that hold the comments and say that the axes are the `.ply`'s."""
    return spz4.from_version_3(_version_3(splats, name), splats.comments, name)


def zstandard(source: str) -> None:
    """What `spz_4` needs.

    Raises:
        DataError: gsply or numcodecs is not installed.
    """
    gsply(source)
    spz4.library(source)


def _version_3(splats: Splats, name: str) -> bytes:
    """The content of an `.spz` of version 3, not packed, with the flag of Gaussians that are to be compensated."""
    library = gsply(name)
    largest = max(float(np.abs(splats.means).max()), 1e-6)
    bits = min(int(np.floor(np.log2((2**23 - 1) / largest))), _FRACTION)
    if bits < 1:
        raise DataError(f"{name}: positions up to {largest:g}; expected less than 4e6 in an .spz; try --frame unit")
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
    """gzip with comments, and the same bytes every time."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    said = "\n".join(comments).encode("ascii", "replace").replace(b"\0", b" ")
    front = _FRONT.pack(b"\x1f\x8b", 8, _COMMENT if said else 0, 0, 2, 255) + (said + b"\0" if said else b"")
    return front + packer.compress(content) + packer.flush() + struct.pack("<II", zlib.crc32(content), len(content))


def read_spz(content: bytes, name: str) -> Splats:
    """The columns of an `.spz` of version 1 to 4.

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
    """Those that `_packed` left."""
    if len(content) < _FRONT.size or _FRONT.unpack_from(content)[2] != _COMMENT:
        return []
    said = content[_FRONT.size : max(content.find(b"\0", _FRONT.size), 0)]  # none where it has no end
    return said.decode("ascii", "replace").splitlines()


def _columns(data: Any, comments: list[str]) -> Splats:
    count = len(data.means)
    rest = np.zeros((count, 0, 3)) if data.shN is None else np.reshape(data.shN, (count, -1, 3))
    found = (data.means, data.scales, data.quats, np.reshape(data.opacities, count), data.sh0, rest)
    means, log_scales, quaternions, logits, f_dc, f_rest = (np.array(column, np.float32) for column in found)
    return Splats(means, log_scales, quaternions, logits, f_dc, f_rest, tuple(comments))
