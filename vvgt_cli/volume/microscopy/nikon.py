"""Nikon (``.nd2``): one position of a file, frame by frame. Read by nd2, which maps uncompressed frames."""

from __future__ import annotations

import re
import struct
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import unpack
from vvgt_cli.volume.microscopy.image import EXTRA, Bounded, Color, Micrograph, choose_image, picture_volume
from vvgt_cli.volume.reading import ReadOptions, Slices, Volume, library_errors, need, volume_name

CHUNK_MAGIC = 0x0ABECEDA
MAP_END = b"ND2 CHUNK MAP SIGNATURE 0000001!"
END, CHUNK = struct.Struct("<32sQ"), struct.Struct("<IIQ")  # the end of the file; before every chunk
MAX_FRAMES = 10_000_000  # frames


def read_nd2(path: Path, options: ReadOptions) -> Volume:
    """Read one position of an ND2 file; spacing in micrometres."""
    nd2 = need("nd2", EXTRA, str(path), "ND2")
    there = _frames(path)
    with Bounded(path) as stream, nd2.ND2File(stream) as file:
        sizes = {str(a): int(n) for a, n in file.sizes.items()}
        odd = [a for a, n in sizes.items() if a not in "TPZCYXS" and n > 1]
        if odd or min(sizes.values(), default=0) < 1 or not {"Y", "X"} <= set(sizes):
            raise DataError(f"{path}: axes {sizes}; expected X and Y, and Z, T, P (positions), C or S at most")
        place = _position(file, sizes, options, path)
        loops = [a for a in sizes if a not in "CYXS"]
        frames = int(np.prod([sizes[a] for a in loops], dtype=object))
        complete = sum(k in there for k in range(min(frames, MAX_FRAMES)))
        if complete < frames:
            raise DataError(f"{path}: of {frames} frames {complete} are there; check that the file is whole")
        names, colors = _channels(file)
        attributes = file.attributes
        packed = (
            (there, attributes.heightPx * (attributes.widthBytes or 0))
            if attributes.compressionType == "lossless"
            else None
        )
        known = next((c.volume.axesCalibrated for c in file.metadata.channels or ()), (False,) * 3)
        x, y, z = (float(v) if ok else None for v, ok in zip(file.voxel_size(), known, strict=True))
        stack = next((one.parameters for one in file.experiment if one.type == "ZStackLoop"), None)
        if z and stack and (stack.stepUm < 0) == stack.bottomToTop:
            z = -z
        times, channels, samples, nz, ny, nx = (sizes.get(axis, 1) for axis in "TCSZYX")
        read = _reader(path, sizes, loops, place, np.dtype(file.dtype), packed)
        picture = Micrograph(
            times, channels * samples, (nz, ny, nx), np.dtype(file.dtype), read, (1, ny, nx),
            (x, y, z if nz > 1 else None), names=names if samples == 1 else (), colors=colors,
            rgb=samples > 1 and channels == 1,
        )  # fmt: skip
        name = volume_name(path) + (f":{place}" if sizes.get("P", 1) > 1 else "")
        return picture_volume(picture, options, str(path), name)


def _frames(path: Path) -> dict[int, int]:
    """Return the position of each frame in the file, by number, from its map of chunks: nd2 reads zeros for others.

    Raises:
        DataError: no map of chunks at the file's end.
    """
    size = path.stat().st_size
    with Bounded(path) as file:
        file.seek(max(size - END.size, 0))
        name, place = END.unpack(file.read(END.size).ljust(END.size, b"\0"))
        if name != MAP_END or place >= size:
            raise DataError(f"{path}: no map of chunks at its end; check that the ND2 file is whole")
        file.seek(place)
        magic, title, length = CHUNK.unpack(file.read(CHUNK.size).ljust(CHUNK.size, b"\0"))
        file.seek(place + CHUNK.size + title)
        data = file.read(length)
    begins: dict[int, int] = {}
    at = 0
    while magic == CHUNK_MAGIC:
        end = data.find(b"!", at) + 1
        if not end or data[at:end] == MAP_END or end + 16 > len(data):
            break
        number = re.fullmatch(rb"ImageDataSeq\|(\d{1,10})!", data[at:end])
        if number and (begin := struct.unpack_from("<Q", data, end)[0]) < size:
            begins[int(number[1])] = begin
        at = end + 16
    return begins


def _position(file: Any, sizes: dict[str, int], options: ReadOptions, path: Path) -> int:
    """Return the number of the position asked for."""
    count = sizes.get("P", 1)
    names = [f"position {k}" for k in range(count)]
    for loop in file.experiment:
        if getattr(loop, "type", "") == "XYPosLoop":
            names = [str(p.name or names[k]) for k, p in enumerate(loop.parameters.points[:count])]
    facts = " x ".join(f"{n} {a}" for a, n in sizes.items() if a != "P") + f" {file.dtype}"
    return choose_image(names, [facts] * len(names), options.array, "positions", str(path))


def _channels(file: Any) -> tuple[list[str], list[Color]]:
    """Return names and colours of the channels."""
    names: list[str] = []
    colors: list[Color] = []
    for one in file.metadata.channels or ():
        names.append(str(one.channel.name))
        rgb = [int(v) / 255 for v in tuple(one.channel.color)[:3]]
        colors.append((rgb[0], rgb[1], rgb[2]) if any(rgb) else None)
    return names, colors


def _reader(
    path: Path, sizes: dict[str, int], loops: list[str], place: int, dtype: np.dtype,
    packed: tuple[dict[int, int], int] | None,
) -> Any:  # fmt: skip
    """Make a function that reads boxes frame by frame.

    ``packed`` holds the positions of compressed frames and the bytes of an unpacked one.
    """
    turn = Lock()  # one file, one reader: workers may have threads
    channels, samples, ny, nx = (sizes.get(axis, 1) for axis in "CSYX")

    @cache
    def opened() -> Any:
        import nd2

        return nd2.ND2File(Bounded(path))

    def unpacked(number: int) -> np.ndarray:
        """Unpack a frame (c, y, x, s) of zlib data to its size and no further, as nd2 would not."""
        where, size = packed or ({}, 0)
        with Bounded(path) as file:
            file.seek(where[number])
            _, title, length = CHUNK.unpack(file.read(CHUNK.size))
            file.seek(title + 8, 1)  # the name and the time
            values = np.frombuffer(unpack("zlib", file.read(length - 8), size), dtype)
        rows = values.reshape(ny, -1)[:, : nx * channels * samples]
        return rows.reshape(ny, nx, channels, samples).transpose(2, 0, 1, 3)

    def read(time: int, channel: int, box: Slices) -> np.ndarray:
        z, y, x = box
        sample = channel % samples if samples != 3 else 2 - channel % samples  # NIS-Elements stores blue, green, red
        out = np.empty([k.stop - k.start for k in box], dtype)
        with turn, library_errors(str(path), "ND2"):
            for k in range(z.start, z.stop):
                at = {"T": time, "P": place, "Z": k}
                number = int(np.ravel_multi_index([at[a] for a in loops], [sizes[a] for a in loops])) if loops else 0
                frame = np.asarray(opened().read_frame(number)) if packed is None else unpacked(number)
                frame = frame.reshape(channels, ny, nx, samples)
                out[k - z.start] = frame[channel // samples, y, x, sample]
        return out

    return read
