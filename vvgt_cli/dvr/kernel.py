"""The numba ray caster: pre-integrated emission-absorption with empty-space leaping (conventions: Optics).

Rays are p + t d: p, d (x, y, z) in voxels from the first voxel's centre, t in unit-frame lengths. ``voxels`` and
``optics`` are `layout.Voxels` and `layout.Optics`; u is a coordinate in the tables, in [0, bins]; ``light`` and means
are vectors (r, g, b, alpha or tau); ``empty`` (bz, by, bx) uint8 is `Scene.empty`.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from vvgt_cli.dvr.layout import BRICK, BRICK_BITS, Optics, Voxels
from vvgt_cli.dvr.runs import Run, run_range
from vvgt_cli.dvr.vectors import Quad, Vector, add, lane, mix, row, scale, sub, texel
from vvgt_cli.jit.decorators import inlined

OPAQUE = 1e-3  # times step^2, as the error of integration goes: the transmittance at which a ray ends
SUB_DEPTH = 1.0  # optical depth of a sub-segment: colour is constant within one; 0.3 is no more accurate
PARTS = 32  # the most sub-segments; at the largest extinctions what lies behind the first few is not seen
FINER, CURVED = 8, 4  # parts of a segment along which extinction is not flat; not even, and the scalar not linear
BENT = 0.1  # share of the values met that lies beyond the ends of a segment from which on the scalar is not linear
FAINT = 0.05  # transmittance behind which no segment is sampled finer
BEND = 0.5  # times the second difference of samples: by how much the scalar leaves the line between two of them
AROUND = 0.25  # times the range of a run: how near to something visible it is looked at
TILE = 16  # pixels along the edge of a tile: its rays share what they read
FLAGS = {"contract", "nsz", "arcp", "afn"}  # no nnan/ninf: non-finite voxels are data

_x = 0.5 + 0.5 * np.cos((np.arange(8) + 0.5) * math.pi / 8)  # Chebyshev's points of [0, 1]
ABSORBED: tuple[float, ...] = tuple(np.linalg.solve(np.vander(_x, increasing=True), -np.expm1(-_x) / _x).tolist())

U = nb.uint64

_jit = inlined(fastmath=FLAGS, error_model="numpy", borrowed=True)


@_jit
def sample(values: np.ndarray, x: float, y: float, z: float) -> float:
    """Interpolate ``values`` (nz, ny, nx) trilinearly at voxel coordinates, clamped to the edge voxels.

    NaN where a corner is not finite.
    """
    nz, ny, nx = values.shape
    x = min(max(x, 0.0), nx - 1.0)
    y = min(max(y, 0.0), ny - 1.0)
    z = min(max(z, 0.0), nz - 1.0)
    i, j, k = int(x), int(y), int(z)
    fx, fy, fz = x - i, y - j, z - k
    gx, gy = 1.0 - fx, 1.0 - fy
    # unsigned: no wrap-around tests on the eight loads
    i1, j1, k1 = U(min(i + 1, nx - 1)), U(min(j + 1, ny - 1)), U(min(k + 1, nz - 1))
    i0, j0, k0 = U(i), U(j), U(k)
    c00: float = values[k0, j0, i0] * gx + values[k0, j0, i1] * fx
    c01: float = values[k0, j1, i0] * gx + values[k0, j1, i1] * fx
    c10: float = values[k1, j0, i0] * gx + values[k1, j0, i1] * fx
    c11: float = values[k1, j1, i0] * gx + values[k1, j1, i1] * fx
    return (c00 * gy + c01 * fy) * (1.0 - fz) + (c10 * gy + c11 * fy) * fz


@_jit
def table_coordinate(value: float, optics: Optics) -> float:
    """Return a value's table coordinate in [0, bins], or -1 for a value that is not finite."""
    if not (abs(value) < np.inf):
        return -1.0
    return min(max((value - optics.lo) * optics.inv_width, 0.0), float(optics.nodes.shape[0] - 1))


@_jit
def _integrals(u: float, optics: Optics) -> Quad:
    """Integrate (tau r, tau g, tau b, tau) over [0, u]: trapezoid, exact where tau is linear within a bin."""
    index = min(int(u), optics.nodes.shape[0] - 2)
    f = u - index
    h = 0.5 * f * f
    linear = add(scale(f - h, row(optics.nodes, U(index))), scale(h, row(optics.nodes, U(index + 1))))
    return add(row(optics.cumulative, U(index)), linear)


@_jit
def _point(u: float, optics: Optics) -> Quad:
    """Return (tau r, tau g, tau b, tau) at one table coordinate."""
    index = min(int(u), optics.nodes.shape[0] - 2)
    f = u - index
    return add(scale(1.0 - f, row(optics.nodes, U(index))), scale(f, row(optics.nodes, U(index + 1))))


@_jit
def mean_quad(u0: float, u1: float, optics: Optics) -> Quad:
    """Average (tau r, tau g, tau b, tau) while the table coordinate goes linearly from u0 to u1."""
    width = u1 - u0
    if abs(width) < 0.5:
        return _point(0.5 * (u0 + u1), optics)
    return scale(1.0 / width, sub(_integrals(u1, optics), _integrals(u0, optics)))


@_jit
def mean_optics(u0: float, u1: float, optics: Optics) -> tuple[float, float, float, float]:
    """Return `mean_quad` as a tuple."""
    mean = mean_quad(u0, u1, optics)
    return lane(mean, 0), lane(mean, 1), lane(mean, 2), lane(mean, 3)


@_jit
def box_span(
    px: float, py: float, pz: float, dx: float, dy: float, dz: float, nx: int, ny: int, nz: int
) -> tuple[float, float]:
    """Return entry and exit t >= 0 of a ray through the box [-1/2, n - 1/2]^3; entry >= exit: missed."""
    t0, t1 = 0.0, np.inf
    for p, d, n in ((px, dx, nx), (py, dy, ny), (pz, dz, nz)):
        if d == 0.0:
            if p < -0.5 or p > n - 0.5:
                return 1.0, 0.0
        else:
            a, b = (-0.5 - p) / d, (n - 0.5 - p) / d
            t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    return t0, t1


@_jit
def absorbed(depth: float) -> float:
    """Return (1 - exp(-x)) / x for x >= 0, to 2e-10."""
    if depth > 1.0:
        return (1.0 - math.exp(-depth)) / depth
    c0, c1, c2, c3, c4, c5, c6, c7 = ABSORBED
    even = depth * depth
    low = (c0 + depth * c1) + even * (c2 + depth * c3)
    high = (c4 + depth * c5) + even * (c6 + depth * c7)
    return low + even * even * high


@_jit
def composite(u0: float, u1: float, dt: float, optics: Optics, light: Quad, trans: float) -> tuple[Quad, float]:
    """Return ``light`` (r, g, b, alpha) and ``trans`` behind a segment of length dt, along which u0 goes to u1."""
    segment = scale(dt, mean_quad(u0, u1, optics))
    depth = max(lane(segment, 3), 0.0)
    if depth <= SUB_DEPTH or abs(u1 - u0) < 0.5:
        f = absorbed(depth) * trans
        return add(light, scale(f, segment)), trans - f * depth
    parts = min(int(depth / SUB_DEPTH) + 1, PARTS)
    width = (u1 - u0) / parts
    for part in range(parts):
        mean = mean_quad(u0 + part * width, u0 + (part + 1) * width, optics)
        segment = scale(dt / parts, mean)
        depth = max(lane(segment, 3), 0.0)
        f = absorbed(depth) * trans
        light, trans = add(light, scale(f, segment)), trans - f * depth
    return light, max(trans, 0.0)


@_jit
def is_flat(optics: Optics) -> bool:
    """Return whether no segment needs finer samples: extinction is even at all values."""
    return optics.even[0] >= optics.even.shape[0] - 1


@_jit
def values_met(before: float, u0: float, u1: float, flat: bool) -> tuple[float, float]:
    """Return roughly the table coordinates that a segment from u0 to u1 meets; below 0 where an end is not finite.

    The scalar is no line between samples, which matters unless the function is ``flat``. Its bend follows from the
    sample ``before`` (-1: none).
    """
    low, high = min(u0, u1), max(u0, u1)
    if flat or low < 0.0:
        return low, high
    bend = BEND * abs(u1 - 2.0 * u0 + before) if before >= 0.0 else 0.0
    return max(low - bend, 0.0), high + bend


@_jit
def spread(total: float, first: float, second: float, parts: int) -> tuple[float, float]:
    """Return where an even distribution with these moments, of ``parts`` of length 1, begins and ends, within them."""
    if total <= 0.0:
        return 0.0, 0.0
    middle = first / total
    half = math.sqrt(3.0 * max(second / total - middle * middle, 0.0) + 0.25)
    half = min(half, middle, parts - middle)
    return middle - half, middle + half


@_jit
def pass_segment(
    voxels: Voxels, optics: Optics, p: Vector, d: Vector, t: float, dt: float, u0: float, u1: float,
    met: tuple[float, float], light: Quad, trans: float,
) -> tuple[Quad, float, float, float]:  # fmt: skip
    """Apply `composite` from t to t + dt of the ray p + t d; in parts if extinction is not flat (`FINER`, `CURVED`).

    ``met``: `values_met`. The last two are where absorption begins and ends, were it even.
    """
    parts, bin_ = 1, U(int(met[0]))
    if trans >= FAINT and met[1] > optics.even[bin_]:
        if met[1] > optics.flat[bin_]:
            parts = FINER
        elif met[1] - max(u0, u1) > BENT * (met[1] - met[0]):
            parts = CURVED
    if parts == 1:
        light, trans = composite(u0, u1, dt, optics, light, trans)
        return light, trans, t, t + dt
    (px, py, pz), (dx, dy, dz), part = p, d, dt / parts
    a, whole, place, squared = u0, trans, 0.0, 0.0
    for n in range(1, parts + 1):
        s = t + n * part
        b = u1
        if n < parts:
            b = table_coordinate(sample(voxels.values, px + s * dx, py + s * dy, pz + s * dz), optics)
        if min(a, b) >= 0.0 and max(a, b) > optics.dark[U(int(min(a, b)))]:
            ahead = trans
            light, trans = composite(a, b, part, optics, light, trans)
            place += (ahead - trans) * (n - 0.5)
            squared += (ahead - trans) * (n - 0.5) * (n - 0.5)
        a = b
    start, end = spread(whole - trans, place, squared, parts)
    return light, trans, t + part * start, t + part * end


@_jit
def inverse(d: float) -> float:
    """Return 1 / d, or so large for d = 0 that a face across that axis is never reached."""
    return 1.0 / d if d != 0.0 else 1e300


@_jit
def leap(
    px: float, py: float, pz: float, ix: float, iy: float, iz: float, reach: int, bi: int, bj: int, bk: int
) -> float:
    """Return the t at which the empty cube of bricks within ``reach`` of (bi, bj, bk) ends; ix, iy, iz: `inverse`."""
    x = (bi + reach if ix > 0.0 else bi - reach + 1) * BRICK
    y = (bj + reach if iy > 0.0 else bj - reach + 1) * BRICK
    z = (bk + reach if iz > 0.0 else bk - reach + 1) * BRICK
    return min((x - px) * ix, (y - py) * iy, (z - pz) * iz)


@_jit
def _brick(p: float, d: float, t: float, n: int) -> int:
    """Return the brick along one axis in which the ray p + t d is, clamped to the volume."""
    return min(max(int(p + t * d), 0), n - 1) >> BRICK_BITS


@_jit
def skip(
    shape: tuple[int, int, int], empty: np.ndarray, px: float, py: float, pz: float, dx: float, dy: float, dz: float,
    ix: float, iy: float, iz: float, t0: float, dt: float, per_step: float, count: int, i: int,
) -> int:  # fmt: skip
    """Return the sample after sample i from which on the ray may meet something visible; > count: none.

    Leaps from one empty cube of bricks to the next while what lies between is empty too: bricks that share a face make
    a box, and a cube of more than one brick holds the brick that the ray comes from. The last sample in empty space is
    returned, where the next segment starts.
    """
    nz, ny, nx = shape
    bi, bj, bk = _brick(px, dx, t0 + i * dt, nx), _brick(py, dy, t0 + i * dt, ny), _brick(pz, dz, t0 + i * dt, nz)
    reach = int(empty[U(bk), U(bj), U(bi)])
    if reach == 0:
        return i
    while True:
        i = max(int((leap(px, py, pz, ix, iy, iz, reach, bi, bj, bk) - t0) * per_step), i)
        if i >= count:
            return count + 1
        t = t0 + (i + 1) * dt
        bi, bj, bk = _brick(px, dx, t, nx), _brick(py, dy, t, ny), _brick(pz, dz, t, nz)
        reach = int(empty[U(bk), U(bj), U(bi)])
        if reach == 0:
            return i
        if reach == 1:
            t = t0 + i * dt
            ci, cj, ck = _brick(px, dx, t, nx), _brick(py, dy, t, ny), _brick(pz, dz, t, nz)
            if abs(ci - bi) + abs(cj - bj) + abs(ck - bk) > 1:
                return i
        i += 1


@_jit
def any_light(run: Run, u0: float, dark: np.ndarray, flat: bool) -> bool:
    """Return whether a segment of a run (RUN,) that comes from u0 (-1: none) may have extinction, or nearly so."""
    lowest: float
    highest: float
    lowest, highest = run_range(run)
    if u0 >= 0.0:
        lowest, highest = min(lowest, u0), max(highest, u0)
    around = 0.0 if flat else AROUND * (highest - lowest)
    return lowest < 0.0 or highest + around > dark[U(int(max(lowest - around, 0.0)))]


@_jit
def texel_at(values: np.ndarray, x: float, y: float, z: float) -> Quad:
    """Interpolate ``values`` (nz, ny, nx, 4) trilinearly at voxel coordinates, clamped to the edge voxels."""
    nz, ny, nx, _ = values.shape
    x = min(max(x, 0.0), nx - 1.0)
    y = min(max(y, 0.0), ny - 1.0)
    z = min(max(z, 0.0), nz - 1.0)
    i, j, k = int(x), int(y), int(z)
    right, down, back = min(i + 1, nx - 1) - i, (min(j + 1, ny - 1) - j) * nx, (min(k + 1, nz - 1) - k) * nx * ny
    n = (k * ny + j) * nx + i
    c00 = mix(texel(values, U(n)), texel(values, U(n + right)), x - i)
    c01 = mix(texel(values, U(n + down)), texel(values, U(n + down + right)), x - i)
    n += back
    c10 = mix(texel(values, U(n)), texel(values, U(n + right)), x - i)
    c11 = mix(texel(values, U(n + down)), texel(values, U(n + down + right)), x - i)
    return mix(mix(c00, c01, y - j), mix(c10, c11, y - j), z - k)


@_jit
def blend_texels(a: Quad, b: Quad, dt: float, seen: Quad, trans: float) -> tuple[Quad, float]:
    """Return ``seen`` (r, g, b, alpha) and ``trans`` behind a segment of length dt; optics go linearly from a to b."""
    segment = scale(0.5 * dt, add(a, b))
    depth = lane(segment, 3)
    if depth <= SUB_DEPTH:
        f = absorbed(depth) * trans
        return add(seen, scale(f, segment)), trans - f * depth
    parts = min(int(depth / SUB_DEPTH) + 1, PARTS)
    for part in range(parts):
        segment = scale(dt / parts, mix(a, b, (part + 0.5) / parts))
        depth = lane(segment, 3)
        f = absorbed(depth) * trans
        seen, trans = add(seen, scale(f, segment)), trans - f * depth
    return seen, max(trans, 0.0)
