"""The columns of a standard `.ply`, which all other formats encode, and conversions from and to Gaussians."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians, PlyHeader, PlyOptions, as_ply, read_ply
from vvgt_cli.gaussians.header import parse_header, rest_names
from vvgt_cli.gaussians.ply import property_names
from vvgt_cli.gaussians.types import HARMONICS

ROW_BYTES = 400  # memory that reading a Gaussian takes
COLUMNS = ("means", "log_scales", "quaternions", "logits", "f_dc", "f_rest")
DEGREES = {count: degree for degree, count in HARMONICS.items()}


@dataclass(frozen=True)
class Splats:
    """K Gaussians as stored in a standard `.ply` (docs/conventions.md), in the frame and orientation of the file.

    Attributes:
        means: (K, 3) float32.
        log_scales: (K, 3) float32, natural logarithms.
        quaternions: (K, 4) float32, (w, x, y, z), of norm 1.
        logits: (K,) float32, logits of opacity.
        f_dc: (K, 3) float32, harmonics of degree 0.
        f_rest: (K, M, 3) float32, harmonics above, M = 0, 3, 8 or 15.
        comments: comment lines of the header, without the word "comment".
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    logits: np.ndarray
    f_dc: np.ndarray
    f_rest: np.ndarray
    comments: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.means)

    def take(self, order: np.ndarray) -> Splats:
        """Return the permutation or subset that ``order`` selects."""
        return replace(self, **{name: getattr(self, name)[order] for name in COLUMNS})

    def moved(self, offset: np.ndarray) -> Splats:
        """Return the columns with means moved by an offset (3,)."""
        return replace(self, means=(self.means.astype(np.float64) + offset).astype(np.float32))


def joined(parts: Sequence[Splats]) -> Splats:
    """Concatenate columns, with the comments of the first; raise DataError if the degrees of harmonics differ."""
    degrees = sorted({DEGREES[part.f_rest.shape[1]] for part in parts})
    if len(degrees) > 1:
        raise DataError(f"Gaussians with harmonics of degrees {degrees}; expected one")
    columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS}
    return replace(parts[0], **columns)


def splats_of(gaussians: Gaussians, options: PlyOptions) -> Splats:
    """Return the columns that `write_ply` would write, with its errors."""
    return columns_of(as_ply(gaussians, options), "Gaussians")


def columns_of(content: bytes, name: str) -> Splats:
    """Return the columns of a standard `.ply`, or raise DataError."""
    header = parse_header(content, name)
    rows = np.frombuffer(content, header.dtype, header.count, header.size)

    def columns(*names: str) -> np.ndarray:
        return np.stack([rows[name] for name in names], axis=-1)

    rest = rest_names(header.sh_degree)
    f_rest = columns(*rest) if rest else np.zeros((header.count, 0), np.float32)
    quaternions = columns("rot_0", "rot_1", "rot_2", "rot_3").astype(np.float64)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Splats(
        columns("x", "y", "z"),
        columns("scale_0", "scale_1", "scale_2"),
        quaternions.astype(np.float32),
        rows["opacity"].copy(),
        columns("f_dc_0", "f_dc_1", "f_dc_2"),
        np.ascontiguousarray(f_rest.reshape(header.count, 3, -1).transpose(0, 2, 1)),
        header.comments,
    )


def ply_bytes(splats: Splats) -> bytes:
    """Encode columns as a standard `.ply`."""
    count, degree = len(splats), DEGREES[splats.f_rest.shape[1]]
    names = property_names(degree)
    rows = np.zeros((count, len(names)), "<f4")
    rest = splats.f_rest.transpose(0, 2, 1).reshape(count, -1)
    rows[:, :3], rows[:, 6:9], rows[:, 9 : 9 + rest.shape[1]] = splats.means, splats.f_dc, rest
    rows[:, -8], rows[:, -7:-4], rows[:, -4:] = splats.logits, splats.log_scales, splats.quaternions
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property float {name}" for name in names] + [f"comment {line}" for line in splats.comments]
    return "\n".join([*lines, "end_header", ""]).encode() + rows.tobytes()


def gaussians_of(splats: Splats, name: str) -> tuple[Gaussians, PlyHeader]:
    """Return Gaussians and header as `read_ply` would read them from a file of these columns, with its errors."""
    stream = io.BytesIO(ply_bytes(splats))
    stream.name = name
    return read_ply(stream)


def opacities_of(logits: np.ndarray) -> np.ndarray:
    """Return the opacity (K,) float32 of logits."""
    return (1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -700, 700)))).astype(np.float32)


def log_scales_of(scales: np.ndarray) -> np.ndarray:
    """Return the natural logarithms (K, 3) float32 of standard deviations, -80 and above so that they are finite."""
    with np.errstate(divide="ignore"):
        return np.maximum(np.log(scales.astype(np.float64)), -80).astype(np.float32)


def morton_order(means: np.ndarray) -> np.ndarray:
    """Return the order (K,) along the Morton curve, which keeps neighbours in space close together."""
    low, high = means.min(axis=0), means.max(axis=0)
    cells = ((means - low) / np.maximum(high - low, 1e-30) * 1023).astype(np.uint32)
    return np.argsort(interleave(cells[:, ::-1]), kind="stable")


_SPREAD = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
           (2, 0x1249249249249249))  # fmt: skip


def interleave(cells: np.ndarray) -> np.ndarray:
    """Return the Z-order codes (n,) int64 of ``cells`` (n, 3) non-negative integers below 2^21, first axis first."""
    bits = cells.astype(np.uint64)
    for shift, mask in _SPREAD:  # bit i moves to bit 3 i
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    first, second, third = bits.T.astype(np.int64)
    return first << 2 | second << 1 | third
