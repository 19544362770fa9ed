"""Digests of a run's inputs, by which manifests and checkpoints recognise their files."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.volume import Volume, slabs
from vvgt_cli.volume.stored import chunks_of, read_block

AT_ONCE = 1 << 22  # voxels that are read at a time, or a row of chunks
LARGEST = 16 << 30  # bytes of values that are read a second time


def digest(*parts: Any) -> str:
    """Return the SHA-256 of values: of arrays by type, shape and bytes, of dataclasses by fields, else by repr."""
    state = hashlib.sha256()
    for part in parts:
        _feed(state, part)
    return state.hexdigest()


def _feed(state: Any, part: Any) -> None:
    if is_dataclass(part) and not isinstance(part, type):
        for entry in fields(part):
            _feed(state, entry.name)
            _feed(state, getattr(part, entry.name))
    elif isinstance(part, np.ndarray):
        state.update(f"{part.dtype.str}{part.shape}".encode())
        state.update(np.ascontiguousarray(part).data)
    else:
        state.update(f"{type(part).__name__}:{part!r};".encode())


def values_digest(volumes: Sequence[Volume]) -> str | None:
    """Return the SHA-256 of volumes' values, the same in memory and in blocks; None above `LARGEST` bytes."""
    if sum(volume.data.nbytes for volume in volumes) > LARGEST:
        return None
    state = hashlib.sha256()
    for volume in volumes:
        _feed(state, volume.dims)
        _feed(state, (volume.data.dtype.newbyteorder("=").str, float(volume.slope), float(volume.intercept)))
        for slices in _slice_digests(volume):
            state.update(slices)
    return state.hexdigest()


def _slice_digests(volume: Volume) -> Iterator[bytes]:
    """Yield the SHA-256 of each slice; whole rows of chunks are read at a time, and no chunk twice."""
    nx, ny, nz = volume.dims
    deep, wide, _ = chunks_of(volume)
    wide *= max(AT_ONCE // (deep * wide * nx), 1)
    deep *= max(AT_ONCE // (deep * min(wide, ny) * nx), 1)
    for z in range(0, nz, deep):
        states = [hashlib.sha256() for _ in range(z, min(z + deep, nz))]
        for y in range(0, ny, wide):
            rows = read_block(volume, np.array([0, y, z]), np.array([nx, min(y + wide, ny), z + len(states)]))
            for state, row in zip(states, rows, strict=True):
                state.update(row.data)
        yield from (state.digest() for state in states)


def volume_digest(volume: Volume) -> str:
    """Return the hexadecimal SHA-256 of a volume's grid, type, scaling and values, not its name or placement."""
    state = hashlib.sha256()
    _feed(state, volume.dims)
    for number in (*volume.spacing, volume.slope, volume.intercept):
        _feed(state, float(number))
    for _, slab in slabs(volume):
        _feed(state, slab)
    return state.hexdigest()


def cameras_digest(cameras: Sequence[Camera]) -> str:
    """Return the hexadecimal SHA-256 of cameras' names, poses and lenses, independent of the image size."""
    state = hashlib.sha256()
    for camera in cameras:
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy]) / camera.height
        for part in (camera.name, camera.rotation, camera.translation, lens):
            _feed(state, part)
    return state.hexdigest()
