"""Synthetic volumes, float32 with cubic voxels, centred on 0, longest edge 2.

Random shapes like those of CT, MR and simulations (`SHAPES`, values near [0, 1]), and volumes with a closed form (the
`example:` sources). A seed gives the same volume on every machine up to the last bits of Fourier transforms.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.types import Volume

SMALLEST = 8  # voxels per side
BYTES = 100  # peak memory per voxel


def _grid(size: int) -> np.ndarray:
    """Return the positions x, y, z of voxel centres in a box of [-1, 1], (3, n, n, n)."""
    line = (np.arange(size) + 0.5) * 2 / size - 1
    z, y, x = np.meshgrid(line, line, line, indexing="ij")
    return np.stack([x, y, z])


def _field(rng: np.random.Generator, size: int, slope: float, finest: float = np.inf) -> np.ndarray:
    """Return periodic noise (n, n, n) of variance 1 with amplitude k^-slope, up to ``finest`` cycles per box."""
    spectrum = np.fft.rfftn(rng.standard_normal((size, size, size)))
    line, half = np.fft.fftfreq(size, 1 / size), np.fft.rfftfreq(size, 1 / size)
    k = np.sqrt(half[None, None, :] ** 2 + line[None, :, None] ** 2 + line[:, None, None] ** 2)
    spectrum *= np.where((k > 0) & (k <= finest), np.maximum(k, 1) ** -slope, 0)
    field = np.fft.irfftn(spectrum, s=(size,) * 3, axes=(0, 1, 2))
    return np.asarray(field / field.std())


def _rotation(rng: np.random.Generator) -> np.ndarray:
    """Return a uniformly distributed rotation (3, 3), by QR of a Gaussian matrix with fixed signs."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    return q * np.sign(np.diag(r))


def _inside(distance: np.ndarray, size: int) -> np.ndarray:
    """Return the share of a voxel that lies inside, by a linear ramp of one voxel across the surface."""
    return np.clip(distance * size / 2 + 0.5, 0, 1)


def shells(size: int, seed: int) -> np.ndarray:
    """Return three to five nested bent ellipsoids with a value and some texture each (skin, skull, brain)."""
    rng = np.random.default_rng(seed)
    centred = np.tensordot(_rotation(rng), _grid(size), 1) / rng.uniform(0.65, 0.95, 3)[:, None, None, None]
    radius = np.linalg.norm(centred, axis=0) + 0.04 * _field(rng, size, 2.5, 6)
    out = np.zeros((size,) * 3)
    edge = 0.92
    for _ in range(rng.integers(3, 6)):
        value = rng.uniform(0.2, 1.0)
        texture = rng.uniform(0, 0.06) * _field(rng, size, 1.5, size / 6)
        bent = radius + 0.03 * _field(rng, size, 2.5, 10)
        cover = _inside(edge - bent, size)
        out += cover * (value + texture - out)
        edge *= rng.uniform(0.6, 0.93)
    return out


def tubes(size: int, seed: int) -> np.ndarray:
    """Return vessels in faint tissue: bent tubes, brightest in the middle, whose radii shrink along them."""
    rng = np.random.default_rng(seed)
    out = 0.08 + 0.02 * _field(rng, size, 1.5, size / 4)
    for _ in range(rng.integers(8, 20)):
        place, heading = rng.uniform(-0.8, 0.8, 3), rng.standard_normal(3)
        radius, value = rng.uniform(0.03, 0.1), rng.uniform(0.4, 1.0)
        for _ in range(rng.integers(40, 120)):
            heading = heading / np.linalg.norm(heading) + 0.25 * rng.standard_normal(3)
            place = place + 0.6 * radius * heading / np.linalg.norm(heading)
            radius = max(radius * 0.99, 2.0 / size)
            _stamp(out, place, radius, value)
    return out


def _stamp(out: np.ndarray, place: np.ndarray, radius: float, value: float) -> None:
    """Draw a ball whose value falls off towards its surface, keeping the larger value of each voxel."""
    size = len(out)
    middle = (place + 1) * size / 2 - 0.5  # in voxels, x y z
    reach = radius * size / 2 + 1
    low = np.maximum(np.ceil(middle - reach).astype(int), 0)
    high = np.minimum(np.floor(middle + reach).astype(int) + 1, size)
    if (low >= high).any():
        return
    x, y, z = (np.arange(a, b) - m for a, b, m in zip(low, high, middle, strict=True))
    distance = np.sqrt(z[:, None, None] ** 2 + y[None, :, None] ** 2 + x[None, None, :] ** 2) * 2 / size
    ball = _inside(radius - distance, size) * value * (1 - 0.5 * np.minimum(distance / radius, 1) ** 2)
    part = out[low[2] : high[2], low[1] : high[1], low[0] : high[0]]
    np.maximum(part, ball, out=part)


def plates(size: int, seed: int) -> np.ndarray:
    """Return metal parts: thin plates, bars and blocks at any angle, some drilled, each with a value."""
    rng = np.random.default_rng(seed)
    grid = _grid(size)
    out = np.zeros((size,) * 3)
    for _ in range(rng.integers(6, 14)):
        half = np.exp(rng.uniform(np.log(0.03), np.log(0.5), 3))
        local = np.tensordot(_rotation(rng), grid - rng.uniform(-0.5, 0.5, 3)[:, None, None, None], 1)
        depth = (half[:, None, None, None] - np.abs(local)).min(axis=0)
        if rng.random() < 0.5:  # a drilled hole along its first axis
            depth = np.minimum(depth, np.hypot(local[1], local[2]) - 0.5 * min(half[1], half[2]))
        cover = _inside(depth, size)
        out += cover * (rng.uniform(0.25, 1.0) - out)
    return out


def noise(size: int, seed: int) -> np.ndarray:
    """Return noise of all scales over [0, 1], from clouds to granite depending on the seed."""
    rng = np.random.default_rng(seed)
    field = _field(rng, size, rng.uniform(1.6, 2.6), size / 3)
    return np.asarray((field - field.min()) / (field.max() - field.min()))


def wells(size: int, seed: int) -> np.ndarray:
    """Return sums of smooth bumps of both signs over [0, 1], like densities and potentials of molecules."""
    rng = np.random.default_rng(seed)
    line = (np.arange(size) + 0.5) * 2 / size - 1
    field = np.zeros((size,) * 3)
    for _ in range(rng.integers(6, 60)):
        place, width = rng.uniform(-0.7, 0.7, 3), np.exp(rng.uniform(np.log(0.06), np.log(0.3)))
        x, y, z = (np.exp(-0.5 * ((line - p) / width) ** 2) for p in place)
        field += rng.choice([-0.5, 1.0]) * rng.uniform(0.3, 1) * z[:, None, None] * y[None, :, None] * x[None, None, :]
    return np.asarray((field - field.min()) / (field.max() - field.min()))


def bodies(size: int, seed: int) -> np.ndarray:
    """Return shells, most with vessels and some with metal parts, and the noise of a scanner."""
    rng = np.random.default_rng([seed, 1])
    out = shells(size, seed)
    if rng.random() < 0.8:
        vessels = tubes(size, seed)
        out += np.clip((vessels - 0.2) * 6, 0, 1) * (vessels * rng.uniform(0.6, 1.4) - out)
    if rng.random() < 0.4:
        parts = plates(size, seed)
        out = np.where(parts > 0, parts * rng.uniform(0.5, 1.2), out)
    return out + rng.uniform(0, 0.05) * _field(rng, size, rng.uniform(0.3, 1.5), size / 3)


SHAPES: dict[str, Callable[[int, int], np.ndarray]] = {
    "shells": shells,
    "tubes": tubes,
    "plates": plates,
    "noise": noise,
    "wells": wells,
    "bodies": bodies,
}


def make_shape(kind: str, size: int = 128, seed: int = 0) -> Volume:
    """Return one of `SHAPES`, ``size`` voxels per side; raise UsageError below `SMALLEST`, or beyond memory."""
    if size < SMALLEST:
        raise UsageError(f"{kind} of {size} voxels per side: expected at least {SMALLEST}")
    check_memory(size**3 * BYTES, f"{kind} of {size} x {size} x {size} voxels")
    return volume_of(SHAPES[kind](size, seed), f"{kind}-{seed}")


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


def marschner_lobb(size: Size = 64) -> Volume:
    """Return the Marschner-Lobb test signal, values in [0, 1]; the paper samples 40 voxels along each axis.

    Marschner and Lobb, "An evaluation of reconstruction filters for volume rendering", 1994, equation 1:
    ``(1 - sin(pi z / 2) + alpha (1 + cos(2 pi f cos(pi r / 2)))) / (2 (1 + alpha))`` with r in the x-y plane.
    """
    x, y, z = _axes(size)
    frequency, alpha = 6.0, 0.25  # f: locally up to about pi f / 2 cycles per unit length; weight of the ripples
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


def sphere(size: Size = 64, radius: float = 0.7, *, hard: bool = False) -> Volume:
    """Return a ball of 1 around the centre, 0 outside.

    Args:
        size: voxels.
        radius: radius in world units.
        hard: binary values instead of a linear ramp of one voxel across the surface (close to the covered share).
    """
    x, y, z = _axes(size)
    h = 2.0 / max(_dims(size))
    distance = radius - np.sqrt(x * x + y * y + z * z)
    inside = distance >= 0 if hard else np.clip(distance / h + 0.5, 0, 1)
    return volume_of(inside, "sphere")


def checkerboard(size: Size = 32, cells: int = 8) -> Volume:
    """Return alternating cubes of 0 and 1, ``cells`` along the longest axis; ``cells == size`` alternates voxels."""
    nx, ny, nz = _dims(size)
    edge = max(1, max(nx, ny, nz) // max(1, cells))
    x, y, z = (np.arange(n) // edge for n in (nx, ny, nz))
    return volume_of((x[None, None, :] + y[None, :, None] + z[:, None, None]) % 2, "checkerboard")


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
