"""Volumes with a closed form: float32 with cubic voxels, in a box centred on 0 with a longest edge of 2."""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.types import Volume

# voxels along each axis, or along (x, y, z)
Size = int | tuple[int, int, int]


def _dims(size: Size) -> tuple[int, int, int]:
    dims = (size, size, size) if isinstance(size, int) else size
    if min(dims) < 1:
        raise UsageError(f"size {' x '.join(map(str, dims))}: expected at least 1 voxel along each axis")
    check_memory(math.prod(dims) * 16, f"a volume of {' x '.join(map(str, dims))} voxels")
    return dims


def _axes(size: Size) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return voxel centres as x (1, 1, nx), y (1, ny, 1), z (nz, 1, 1), float64."""
    nx, ny, nz = _dims(size)
    h = 2.0 / max(nx, ny, nz)
    x, y, z = ((np.arange(n) - (n - 1) / 2) * h for n in (nx, ny, nz))
    return x[None, None, :], y[None, :, None], z[:, None, None]


def volume_of(values: np.ndarray, name: str) -> Volume:
    """Return values (nz, ny, nx) as a float32 volume with cubic voxels, centred on 0, longest edge 2."""
    nz, ny, nx = values.shape
    h = 2.0 / max(nx, ny, nz)
    origin = tuple(-(n - 1) / 2 * h for n in (nx, ny, nz))
    return Volume(np.ascontiguousarray(values, np.float32), (h, h, h), origin, name=name)


def marschner_lobb(size: Size = 64, frequency: float = 6.0, alpha: float = 0.25) -> Volume:
    """Return the Marschner-Lobb test signal, values in [0, 1].

    Marschner and Lobb, "An evaluation of reconstruction filters for volume rendering", 1994, equation 1:
    ``(1 - sin(pi z / 2) + alpha (1 + cos(2 pi f cos(pi r / 2)))) / (2 (1 + alpha))`` with r in the x-y plane.

    Args:
        size: voxels (the paper samples 40 along each axis).
        frequency: f; the highest local frequency is about pi f / 2 cycles per unit length.
        alpha: weight of the ripples.
    """
    x, y, z = _axes(size)
    ripples = np.cos(2 * np.pi * frequency * np.cos(np.pi * np.sqrt(x * x + y * y) / 2))
    return volume_of((1 - np.sin(np.pi * z / 2) + alpha * (1 + ripples)) / (2 * (1 + alpha)), "marschner-lobb")


def blob(size: Size = 64, sigma: float = 0.25) -> Volume:
    """Return a Gaussian ``exp(-r^2 / (2 sigma^2))`` at the centre, sigma in world units (the longest edge is 2)."""
    # as a product of three factors, so that only the result has the volume's size
    factors = [np.exp(-(axis**2) / (2 * sigma**2)) for axis in _axes(size)]
    return volume_of(factors[0] * factors[1] * factors[2], "blob")


def slab(size: Size = 64, thickness: float = 1.0, value: float = 1.0) -> Volume:
    """Return a homogeneous slab ``|z| <= thickness / 2`` across the box, 0 outside, with partial voxels antialiased."""
    nx, ny, nz = _dims(size)
    h = 2.0 / max(nx, ny, nz)
    z, half = _axes(size)[2], thickness / 2
    inside = np.maximum(np.minimum(z + h / 2, half) - np.maximum(z - h / 2, -half), 0) / h
    return volume_of(np.broadcast_to(inside * value, (nz, ny, nx)), "slab")


def sphere(size: Size = 64, radius: float = 0.7, value: float = 1.0, *, hard: bool = False) -> Volume:
    """Return a ball of ``value`` around the centre, 0 outside.

    Args:
        size: voxels.
        radius: radius in world units.
        value: value inside.
        hard: binary values instead of a linear ramp of one voxel across the surface (close to the covered share).
    """
    x, y, z = _axes(size)
    h = 2.0 / max(_dims(size))
    distance = radius - np.sqrt(x * x + y * y + z * z)
    inside = distance >= 0 if hard else np.clip(distance / h + 0.5, 0, 1)
    return volume_of(inside * value, "sphere")


def checkerboard(size: Size = 32, cells: int = 8) -> Volume:
    """Return alternating cubes of 0 and 1, ``cells`` along the longest axis; ``cells == size`` alternates voxels."""
    nx, ny, nz = _dims(size)
    edge = max(1, max(nx, ny, nz) // max(1, cells))
    x, y, z = (np.arange(n) // edge for n in (nx, ny, nz))
    return volume_of((x[None, None, :] + y[None, :, None] + z[:, None, None]) % 2, "checkerboard")


def constant(size: Size = 16, value: float = 1.0) -> Volume:
    """Return a volume with the same value everywhere."""
    nx, ny, nz = _dims(size)
    return volume_of(np.full((nz, ny, nx), value, np.float32), "constant")


def random_field(size: Size = 64, cycles: float = 8.0, seed: int = 0) -> Volume:
    """Return band-limited periodic noise with values over [0, 1]; the same seed gives the same volume.

    Args:
        size: voxels.
        cycles: highest spatial frequency in cycles along the longest edge; below size / 2 the samples determine
            the field.
        seed: seed of the white noise that is filtered.
    """
    nx, ny, nz = _dims(size)
    longest = max(nx, ny, nz)
    spectrum = np.fft.rfftn(np.random.default_rng(seed).standard_normal((nz, ny, nx)))
    kx, ky, kz = np.fft.rfftfreq(nx) * longest, np.fft.fftfreq(ny) * longest, np.fft.fftfreq(nz) * longest
    k2 = kx[None, None, :] ** 2 + ky[None, :, None] ** 2 + kz[:, None, None] ** 2
    spectrum[k2 > cycles**2] = 0
    field = np.fft.irfftn(spectrum, s=(nz, ny, nx), axes=(0, 1, 2))
    lo, hi = field.min(), field.max()
    return volume_of((field - lo) / (hi - lo) if hi > lo else np.zeros_like(field), "random")
