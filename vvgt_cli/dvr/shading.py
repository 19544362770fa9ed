"""Blinn-Phong shading of samples, as VTK shades volumes (docs/light.md): what kernels that know of light call."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.runs import BORROWED
from vvgt_cli.jit.decorators import inlined

FLAGS = {"contract", "nsz", "arcp", "afn"}  # no nnan/ninf: non-finite voxels are data
U = nb.uint64

_jit = inlined(fastmath=FLAGS, error_model="numpy", **BORROWED)


@_jit
def _places(p: float, n: int) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64, float]:
    """Voxels before, at, after and beyond a clamped coordinate along an axis of ``n``, and its share."""
    p = min(max(p, 0.0), n - 1.0)
    i = int(p)
    return U(max(i - 1, 0)), U(i), U(min(i + 1, n - 1)), U(min(i + 2, n - 1)), p - i


@_jit
def _difference(
    values: np.ndarray, k: np.uint64, j: np.uint64, i: np.uint64, c: np.uint64, b: np.uint64, a: np.uint64
) -> float:
    """Difference of two voxels, exact for all types of values."""
    return np.float64(values[k, j, i]) - np.float64(values[c, b, a])


@_jit
def normal(values: np.ndarray, edge: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Direction (x, y, z) of the gradient at voxel coordinates, box frame; zeros where there is none.

    Central differences at the eight voxels around, interpolated trilinearly; ``values`` (nz, ny, nx), ``edge`` (3,) of
    `Light`. There is none where all differences are zero, or one is not finite.
    """
    nz, ny, nx = values.shape
    i_, i0, i1, i2, fx = _places(x, nx)
    j_, j0, j1, j2, fy = _places(y, ny)
    k_, k0, k1, k2, fz = _places(z, nz)
    gx = gy = gz = 0.0
    for b in range(2):
        for c in range(2):
            i, wx = (i1, fx) if b else (i0, 1.0 - fx)
            j, wy = (j1, fy) if c else (j0, 1.0 - fy)
            before, after = _difference(values, k1, j, i, k_, j, i), _difference(values, k2, j, i, k0, j, i)
            gz += wx * wy * ((1.0 - fz) * before + fz * after)
            k, wz = (k1, fz) if c else (k0, 1.0 - fz)
            before, after = _difference(values, k, j1, i, k, j_, i), _difference(values, k, j2, i, k, j0, i)
            gy += wx * wz * ((1.0 - fy) * before + fy * after)
            j, wy = (j1, fy) if b else (j0, 1.0 - fy)
            before, after = _difference(values, k, j, i1, k, j, i_), _difference(values, k, j, i2, k, j, i0)
            gx += wy * wz * ((1.0 - fx) * before + fx * after)
    gx, gy, gz = gx / edge[0], gy / edge[1], gz / edge[2]
    squared = gx * gx + gy * gy + gz * gz
    if not (0.0 < squared < np.inf):
        return 0.0, 0.0, 0.0
    length = math.sqrt(squared)
    return gx / length, gy / length, gz / length


@_jit
def shade_at(light: Light, channel: int, x: float, y: float, z: float) -> float:
    """``light.shade`` of a channel at voxel coordinates, trilinear between the cells' centres."""
    nz, ny, nx = light.shade.shape[1:]
    x = min(max((x + light.origin[0] + 0.5) * light.inv_cell - 0.5, 0.0), nx - 1.0)
    y = min(max((y + light.origin[1] + 0.5) * light.inv_cell - 0.5, 0.0), ny - 1.0)
    z = min(max((z + light.origin[2] + 0.5) * light.inv_cell - 0.5, 0.0), nz - 1.0)
    i, j, k = int(x), int(y), int(z)
    fx, fy, fz = x - i, y - j, z - k
    total = 0.0
    for c in range(2):
        for b in range(2):
            row = light.shade[U(channel), U(min(k + c, nz - 1)), U(min(j + b, ny - 1))]
            along = row[U(i)] * (1.0 - fx) + row[U(min(i + 1, nx - 1))] * fx
            total += along * (fy if b else 1.0 - fy) * (fz if c else 1.0 - fz)
    return total


@_jit
def openness(light: Light, x: float, y: float, z: float) -> float:
    """How open the place is: 1 without occlusion."""
    if light.occlusion == 0:
        return 1.0
    return shade_at(light, light.shade.shape[0] - 1, x, y, z)


@_jit
def arrives(light: Light, which: int, x: float, y: float, z: float) -> float:
    """Part of a light's that arrives: 1 without shadows."""
    if light.shadows == 0:
        return 1.0
    return shade_at(light, which, x, y, z)


@_jit
def fixed_diffuse(light: Light, n0: float, n1: float, n2: float, x: float, y: float, z: float) -> float:
    """Sum over the lights at infinity of what arrives times abs(n . l), of a normal n at voxel coordinates."""
    total = 0.0
    for which in range(light.directions.shape[0]):
        toward = light.directions[which]
        total += arrives(light, which, x, y, z) * abs(n0 * toward[0] + n1 * toward[1] + n2 * toward[2])
    return total


@_jit
def _fixed_highlights(
    light: Light, n0: float, n1: float, n2: float, d0: float, d1: float, d2: float, x: float, y: float, z: float
) -> float:
    """Sum over the lights at infinity of what arrives times abs(n . h)^power; the eye looks along the unit vector d."""
    total = 0.0
    for which in range(light.directions.shape[0]):
        toward = light.directions[which]
        h0, h1, h2 = toward[0] - d0, toward[1] - d1, toward[2] - d2
        length = math.sqrt(h0 * h0 + h1 * h1 + h2 * h2)
        if length > 1e-9:  # not looking straight into the light
            cosine = min(abs(n0 * h0 + n1 * h1 + n2 * h2) / length, 1.0)
            total += arrives(light, which, x, y, z) * cosine**light.power
    return total


@_jit
def shading(
    values: np.ndarray, light: Light, x: float, y: float, z: float, d0: float, d1: float, d2: float
) -> tuple[float, float]:
    """(factor of the colour, white to add) at voxel coordinates, seen along the unit vector d (box frame)."""
    open_ = openness(light, x, y, z)
    n0, n1, n2 = normal(values, light.edge, x, y, z)
    if n0 == 0.0 and n1 == 0.0 and n2 == 0.0:
        return open_ * light.ambient, 0.0
    diffuse, white = fixed_diffuse(light, n0, n1, n2, x, y, z), 0.0
    facing = min(abs(n0 * d0 + n1 * d1 + n2 * d2), 1.0)
    if light.head:
        diffuse += facing
    if light.specular > 0.0:
        white = _fixed_highlights(light, n0, n1, n2, d0, d1, d2, x, y, z)
        if light.head:
            white += facing**light.power
    return open_ * (light.ambient + light.diffuse * diffuse), light.specular * white
