"""Blinn-Phong shading of samples, as VTK shades volumes (docs/light.md): what kernels that know of light call."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.vectors import Quad, Vector, four, lane, mix, sub, vector
from vvgt_cli.jit.decorators import inlined

FLAGS = {"contract", "nsz", "arcp", "afn"}  # no nnan/ninf: non-finite voxels are data
U = nb.uint64

_jit = inlined(fastmath=FLAGS, error_model="numpy", borrowed=True)


@_jit
def _places(p: float, n: int) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64, float]:
    """Return voxels before, at, after and beyond a clamped coordinate along an axis of ``n``, and its share."""
    p = min(max(p, 0.0), n - 1.0)
    i = int(p)
    return U(max(i - 1, 0)), U(i), U(min(i + 1, n - 1)), U(min(i + 2, n - 1)), p - i


@_jit
def _line(values: np.ndarray, k: Any, j: Any, i: int) -> Quad:
    """Return the voxels before, at, after and beyond voxel ``i`` of row (k, j), clamped to the edge voxels."""
    nx = values.shape[2]
    if 0 < i < nx - 2:
        return four(values, (k * U(values.shape[1]) + j) * U(nx) + U(i - 1))
    row = values[k, j]
    return vector(
        float(row[U(max(i - 1, 0))]), float(row[U(i)]), float(row[U(min(i + 1, nx - 1))]),
        float(row[U(min(i + 2, nx - 1))]),
    )  # fmt: skip


@_jit
def gradient(values: np.ndarray, edge: np.ndarray, x: float, y: float, z: float) -> Quad:
    """Return the gradient (x, y, z, 0) at voxel coordinates, box frame.

    Central differences at the eight voxels around, interpolated trilinearly; ``values`` (nz, ny, nx), ``edge`` (3,) of
    `Light`.
    """
    nz, ny, nx = values.shape
    x = min(max(x, 0.0), nx - 1.0)
    i = int(x)
    fx = x - i
    j_, j0, j1, j2, fy = _places(y, ny)
    k_, k0, k1, k2, fz = _places(z, nz)
    v00, v01 = _line(values, k0, j0, i), _line(values, k0, j1, i)
    v10, v11 = _line(values, k1, j0, i), _line(values, k1, j1, i)
    here = mix(mix(v00, v01, fy), mix(v10, v11, fy), fz)  # equal lanes stay equal
    gx = (1.0 - fx) * (lane(here, 2) - lane(here, 0)) + fx * (lane(here, 3) - lane(here, 1))
    above = mix(sub(v01, _line(values, k0, j_, i)), sub(_line(values, k0, j2, i), v00), fy)
    below = mix(sub(v11, _line(values, k1, j_, i)), sub(_line(values, k1, j2, i), v10), fy)
    along = mix(above, below, fz)
    gy = (1.0 - fx) * lane(along, 1) + fx * lane(along, 2)
    above = mix(sub(v10, _line(values, k_, j0, i)), sub(_line(values, k2, j0, i), v00), fz)
    below = mix(sub(v11, _line(values, k_, j1, i)), sub(_line(values, k2, j1, i), v01), fz)
    along = mix(above, below, fy)
    gz = (1.0 - fx) * lane(along, 1) + fx * lane(along, 2)
    return vector(gx / edge[0], gy / edge[1], gz / edge[2], 0.0)


@_jit
def unit(slope: Quad) -> tuple[float, float, float]:
    """Return a gradient's direction (x, y, z); zeros where it is zero or not finite."""
    gx, gy, gz = lane(slope, 0), lane(slope, 1), lane(slope, 2)
    squared = gx * gx + gy * gy + gz * gz
    if not (0.0 < squared < np.inf):
        return 0.0, 0.0, 0.0
    length = math.sqrt(squared)
    return gx / length, gy / length, gz / length


@_jit
def normal(values: np.ndarray, edge: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the direction of `gradient`, as `unit`."""
    return unit(gradient(values, edge, x, y, z))


@_jit
def shade_at(light: Light, channel: int, x: float, y: float, z: float) -> float:
    """Interpolate ``light.shade`` of a channel at voxel coordinates, trilinear between the cells' centres."""
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
def fixed_diffuse(light: Light, n0: float, n1: float, n2: float) -> float:
    """Sum over the lights at infinity of abs(n . l), of a normal n."""
    total = 0.0
    for which in range(light.directions.shape[0]):
        toward = light.directions[which]
        total += abs(n0 * toward[0] + n1 * toward[1] + n2 * toward[2])
    return total


@_jit
def _power(x: float, power: float) -> float:
    """Return x^power, by squares for a whole number: the library's takes as long as all else of a sample."""
    left, result = int(power), 1.0
    if left != power or power > 256.0:
        result = x**power
        left = 0
    while left > 0:
        if left & 1:
            result *= x
        x *= x
        left >>= 1
    return result


@_jit
def _fixed_highlights(light: Light, n0: float, n1: float, n2: float, d0: float, d1: float, d2: float) -> float:
    """Sum over the lights at infinity of abs(n . h)^power; the eye looks along the unit vector d."""
    total = 0.0
    for which in range(light.directions.shape[0]):
        toward = light.directions[which]
        h0, h1, h2 = toward[0] - d0, toward[1] - d1, toward[2] - d2
        length = math.sqrt(h0 * h0 + h1 * h1 + h2 * h2)
        if length > 1e-9:  # not looking straight into the light
            cosine = min(abs(n0 * h0 + n1 * h1 + n2 * h2) / length, 1.0)
            total += _power(cosine, light.power)
    return total


@_jit
def shading(light: Light, normal: Vector, look: Vector) -> tuple[float, float]:
    """Return the factor of colours, and white to add, of a ``normal`` (zeros: none), seen along the unit ``look``.

    Both are of the box frame.
    """
    (n0, n1, n2), (d0, d1, d2) = normal, look
    if n0 == 0.0 and n1 == 0.0 and n2 == 0.0:
        return light.ambient, 0.0
    diffuse, white = fixed_diffuse(light, n0, n1, n2), 0.0
    facing = min(abs(n0 * d0 + n1 * d1 + n2 * d2), 1.0)
    if light.head:
        diffuse += facing
    if light.specular > 0.0:
        white = _fixed_highlights(light, n0, n1, n2, d0, d1, d2)
        if light.head:
            white += _power(facing, light.power)
    return light.ambient + light.diffuse * diffuse, light.specular * white
