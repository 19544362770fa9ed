"""Random shapes like those of CT, MR and simulations (`SHAPES`), float32 with values near [0, 1].

A seed gives the same volume on every machine up to the last bits of Fourier transforms.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.synth.analytic import volume_of
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
    result: np.ndarray = field / field.std()
    return result


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
    result: np.ndarray = (field - field.min()) / (field.max() - field.min())
    return result


def wells(size: int, seed: int) -> np.ndarray:
    """Return sums of smooth bumps of both signs over [0, 1], like densities and potentials of molecules."""
    rng = np.random.default_rng(seed)
    line = (np.arange(size) + 0.5) * 2 / size - 1
    field = np.zeros((size,) * 3)
    for _ in range(rng.integers(6, 60)):
        place, width = rng.uniform(-0.7, 0.7, 3), np.exp(rng.uniform(np.log(0.06), np.log(0.3)))
        x, y, z = (np.exp(-0.5 * ((line - p) / width) ** 2) for p in place)
        field += rng.choice([-0.5, 1.0]) * rng.uniform(0.3, 1) * z[:, None, None] * y[None, :, None] * x[None, None, :]
    result: np.ndarray = (field - field.min()) / (field.max() - field.min())
    return result


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
    """Return a volume of one of `SHAPES`, ``size`` voxels per side.

    Raises:
        UsageError: the size is below `SMALLEST`, or does not fit in memory.
    """
    if size < SMALLEST:
        raise UsageError(f"{kind} of {size} voxels per side: expected at least {SMALLEST}")
    check_memory(size**3 * BYTES, f"{kind} of {size} x {size} x {size} voxels")
    return volume_of(SHAPES[kind](size, seed), f"{kind}-{seed}")
