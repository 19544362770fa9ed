"""Small OpenVDB files, format version 224 without compression, as Archive.cc and Compression.h lay them out."""

import struct
from pathlib import Path

import numpy as np

VERSION, NO_MASK = 224, 6  # 6: all values follow


def vdb(path: Path, grids: dict[str, np.ndarray], spacing: float = 0.1) -> Path:
    """Write grids by name: (nz, ny, nx) float32 with edges up to 128, active where they are not 0."""
    body = b" BDV\0\0\0\0" + struct.pack("<IIIB", VERSION, 10, 0, 1) + b"0" * 36 + struct.pack("<Ii", 0, len(grids))
    for name, values in grids.items():
        head = text(name) + text("Tree_float_5_4_3") + text("")
        data = struct.pack("<II", 0, 0) + text("UniformScaleMap") + struct.pack("<15d", *[spacing] * 15)
        data += tree(np.pad(values, [(0, -n % 8) for n in values.shape]).T.astype("<f4"))  # x, y, z
        start = len(body) + len(head) + 24
        body += head + struct.pack("<qqq", start, start, start + len(data)) + data
    path.write_bytes(body)
    return path


def text(name: str) -> bytes:
    return struct.pack("<I", len(name)) + name.encode()


def tree(values: np.ndarray) -> bytes:
    """One node of each of the two levels, and the leaves that hold something."""
    nx, ny, nz = (n // 8 for n in values.shape)
    leaves = values.reshape(nx, 8, ny, 8, nz, 8).transpose(0, 2, 4, 1, 3, 5)
    there = leaves.any(axis=(3, 4, 5))
    lower = np.zeros((16, 16, 16), bool)
    lower[:nx, :ny, :nz] = there
    upper = np.arange(32**3) == 0
    masks = [bits(leaf != 0) for leaf in leaves[there]]
    out = struct.pack("<ifIIiii", 1, 0.0, 0, 1, 0, 0, 0) + inner(upper) + inner(lower.ravel()) + b"".join(masks)
    return out + b"".join(m + bytes([NO_MASK]) + v.tobytes() for m, v in zip(masks, leaves[there], strict=True))


def inner(child: np.ndarray) -> bytes:
    return bits(child) + bits(np.zeros_like(child)) + bytes([NO_MASK]) + bytes(4 * child.size)


def bits(mask: np.ndarray) -> bytes:
    return np.packbits(mask.ravel(), bitorder="little").tobytes()


def plume(n: int = 32, peak: float = 1.0) -> dict[str, np.ndarray]:
    """A rising plume of smoke with a flame at its foot, by name: ``density`` and ``flame``, (n, n, n) float32."""
    z, y, x = np.mgrid[:n, :n, :n] / (n - 1)
    width = 0.08 + 0.25 * z
    wave = 0.05 * np.sin(12 * z) * z
    r = np.hypot(x - 0.5 - wave, y - 0.5 + wave) / width
    lumps = 1 + 0.5 * np.sin(25 * x) * np.sin(23 * y) * np.sin(21 * z - 1)
    smoke = np.clip(1 - r * lumps, 0, None) * np.clip(6 * (1 - z), 0, 1)
    flame = np.clip(1 - 1.5 * r, 0, None) * np.clip(1 - 2.5 * z, 0, None)
    return {"density": (peak * smoke).astype(np.float32), "flame": flame.astype(np.float32)}
