"""The numba ray caster: pre-integrated emission-absorption with empty-space leaping (conventions: Optics).

Rays are p + t d: p, d (x, y, z) in voxels from the first voxel's centre, t in unit-frame lengths. ``voxels`` and
``optics`` are `layout.Voxels` and `layout.Optics`; u is a coordinate in the tables, in [0, bins]; ``light`` and means
are vectors (r, g, b, alpha or tau); ``empty`` (bz, by, bx) uint8 is `Scene.empty`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np

from vvgt_cli.dvr.layout import BRICK, BRICK_BITS, TUPLES, Optics, Voxels
from vvgt_cli.dvr.runs import BORROWED, RUN, Run, run_range, sample_run, stack_run
from vvgt_cli.dvr.vectors import Quad, add, lane, row, scale, sub, zeros4
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.parts import Part, take_turn

OPAQUE = 1e-3  # times step^2, as the error of integration goes: the transmittance at which a ray ends
SUB_DEPTH = 1.0  # optical depth of a sub-segment: colour is constant within one; 0.3 is no more accurate
PARTS = 32  # the most sub-segments; at the largest extinctions what lies behind the first few is not seen
FINER = 8  # parts of a segment along which extinction is not flat
FAINT = 0.05  # transmittance behind which no segment is sampled finer
BEND = 0.5  # times the second difference of samples: by how much the scalar leaves the line between two of them
AROUND = 0.25  # times the range of a run: how near to something visible it is looked at
TILE = 16  # pixels along the edge of a tile: its rays share what they read
FLAGS = {"contract", "nsz", "arcp", "afn"}  # no nnan/ninf: non-finite voxels are data

_x = 0.5 + 0.5 * np.cos((np.arange(8) + 0.5) * math.pi / 8)  # Chebyshev's points of [0, 1]
ABSORBED: tuple[float, ...] = tuple(np.linalg.solve(np.vander(_x, increasing=True), -np.expm1(-_x) / _x).tolist())

U = nb.uint64
Vector = tuple[float, float, float]
Cast = Callable[..., tuple[float, float, float, float]]

_jit = inlined(fastmath=FLAGS, error_model="numpy", **BORROWED)


@_jit
def sample(values: np.ndarray, x: float, y: float, z: float) -> float:
    """Trilinear value of ``values`` (nz, ny, nx) at voxel coordinates, clamped to the edge voxels.

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
    """Table coordinate in [0, bins], or -1 for a value that is not finite."""
    if not (abs(value) < np.inf):
        return -1.0
    return min(max((value - optics.lo) * optics.inv_width, 0.0), float(optics.nodes.shape[0] - 1))


@_jit
def _integrals(u: float, optics: Optics) -> Quad:
    """Integrals over [0, u] of (tau r, tau g, tau b, tau): trapezoid, exact where tau is linear within a bin."""
    index = min(int(u), optics.nodes.shape[0] - 2)
    f = u - index
    h = 0.5 * f * f
    linear = add(scale(f - h, row(optics.nodes, U(index))), scale(h, row(optics.nodes, U(index + 1))))
    return add(row(optics.cumulative, U(index)), linear)


@_jit
def _point(u: float, optics: Optics) -> Quad:
    """(tau r, tau g, tau b, tau) at one table coordinate."""
    index = min(int(u), optics.nodes.shape[0] - 2)
    f = u - index
    return add(scale(1.0 - f, row(optics.nodes, U(index))), scale(f, row(optics.nodes, U(index + 1))))


@_jit
def _mean(u0: float, u1: float, optics: Optics) -> Quad:
    """Mean of (tau r, tau g, tau b, tau) while the table coordinate goes linearly from u0 to u1."""
    width = u1 - u0
    if abs(width) < 0.5:
        return _point(0.5 * (u0 + u1), optics)
    return scale(1.0 / width, sub(_integrals(u1, optics), _integrals(u0, optics)))


@_jit
def mean_optics(u0: float, u1: float, optics: Optics) -> tuple[float, float, float, float]:
    """`_mean` as a tuple."""
    mean = _mean(u0, u1, optics)
    return lane(mean, 0), lane(mean, 1), lane(mean, 2), lane(mean, 3)


@_jit
def box_span(
    px: float, py: float, pz: float, dx: float, dy: float, dz: float, nx: int, ny: int, nz: int
) -> tuple[float, float]:
    """Entry and exit t >= 0 of a ray through the box [-1/2, n - 1/2]^3; entry >= exit: missed."""
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
    """(1 - exp(-x)) / x for x >= 0, to 2e-10."""
    if depth > 1.0:
        return (1.0 - math.exp(-depth)) / depth
    c0, c1, c2, c3, c4, c5, c6, c7 = ABSORBED
    even = depth * depth
    low = (c0 + depth * c1) + even * (c2 + depth * c3)
    high = (c4 + depth * c5) + even * (c6 + depth * c7)
    return low + even * even * high


@_jit
def composite(u0: float, u1: float, dt: float, optics: Optics, light: Quad, trans: float) -> tuple[Quad, float]:
    """``light`` (r, g, b, alpha) and ``trans`` behind a segment of length dt; the coordinate goes from u0 to u1."""
    segment = scale(dt, _mean(u0, u1, optics))
    depth = max(lane(segment, 3), 0.0)
    if depth <= SUB_DEPTH or abs(u1 - u0) < 0.5:
        f = absorbed(depth) * trans
        return add(light, scale(f, segment)), trans - f * depth
    parts = min(int(depth / SUB_DEPTH) + 1, PARTS)
    width = (u1 - u0) / parts
    for part in range(parts):
        mean = _mean(u0 + part * width, u0 + (part + 1) * width, optics)
        segment = scale(dt / parts, mean)
        depth = max(lane(segment, 3), 0.0)
        f = absorbed(depth) * trans
        light, trans = add(light, scale(f, segment)), trans - f * depth
    return light, max(trans, 0.0)


@_jit
def is_flat(optics: Optics) -> bool:
    """Whether no segment needs finer samples: the whole function is flat."""
    found: bool = optics.flat[0] >= optics.flat.shape[0] - 1
    return found


@_jit
def values_met(before: float, u0: float, u1: float, flat: bool) -> tuple[float, float]:
    """Table coordinates that a segment from u0 to u1 meets, about; below 0 where an end is not finite.

    The scalar is no line between samples, which matters unless the function is ``flat``. Its bend follows from the
    sample ``before`` (-1: none).
    """
    low, high = min(u0, u1), max(u0, u1)
    if flat or low < 0.0:
        return low, high
    bend = BEND * abs(u1 - 2.0 * u0 + before) if before >= 0.0 else 0.0
    return max(low - bend, 0.0), high + bend


@_jit
def pass_segment(
    voxels: Voxels, optics: Optics, p: Vector, d: Vector, t: float, dt: float, u0: float, u1: float,
    met: tuple[float, float], light: Quad, trans: float,
) -> tuple[Quad, float, float]:  # fmt: skip
    """`composite` of the segment from t to t + dt of the ray p + t d; in `FINER` parts if extinction is not flat.

    ``met``: `values_met`. Last is the t at which, on average, the segment absorbs.
    """
    if trans < FAINT or is_flat(optics) or met[1] <= optics.flat[U(int(met[0]))]:
        light, trans = composite(u0, u1, dt, optics, light, trans)
        return light, trans, t + 0.5 * dt
    (px, py, pz), (dx, dy, dz), part = p, d, dt / FINER
    a, whole, place = u0, trans, 0.0
    for n in range(1, FINER + 1):
        s = t + n * part
        b = u1
        if n < FINER:
            b = table_coordinate(sample(voxels.values, px + s * dx, py + s * dy, pz + s * dz), optics)
        if min(a, b) >= 0.0 and max(a, b) > optics.dark[U(int(min(a, b)))]:
            ahead = trans
            light, trans = composite(a, b, part, optics, light, trans)
            place += (ahead - trans) * (n - 0.5)
        a = b
    return light, trans, t + part * place / (whole - trans) if whole > trans else t + 0.5 * dt


@_jit
def inverse(d: float) -> float:
    """1 / d, or so large for d = 0 that a face across that axis is never reached."""
    return 1.0 / d if d != 0.0 else 1e300


@_jit
def _exit(
    px: float, py: float, pz: float, ix: float, iy: float, iz: float, reach: int, bi: int, bj: int, bk: int
) -> float:
    """Ray parameter at which the cube of bricks within ``reach`` of (bi, bj, bk) ends; ix, iy, iz: `inverse`."""
    x = (bi + reach if ix > 0.0 else bi - reach + 1) * BRICK
    y = (bj + reach if iy > 0.0 else bj - reach + 1) * BRICK
    z = (bk + reach if iz > 0.0 else bk - reach + 1) * BRICK
    return min((x - px) * ix, (y - py) * iy, (z - pz) * iz)


@_jit
def leap(
    px: float, py: float, pz: float, dx: float, dy: float, dz: float, reach: int, bi: int, bj: int, bk: int
) -> float:
    """Ray parameter at which the empty cube of bricks around (bi, bj, bk) ends, from the ray's origin p."""
    return _exit(px, py, pz, inverse(dx), inverse(dy), inverse(dz), reach, bi, bj, bk)


@_jit
def _brick(p: float, d: float, t: float, n: int) -> int:
    """Brick along one axis in which the ray p + t d is, clamped to the volume."""
    return min(max(int(p + t * d), 0), n - 1) >> BRICK_BITS


@_jit
def skip(
    shape: tuple[int, int, int], empty: np.ndarray, px: float, py: float, pz: float, dx: float, dy: float, dz: float,
    ix: float, iy: float, iz: float, t0: float, dt: float, per_step: float, count: int, i: int,
) -> int:  # fmt: skip
    """The sample from which on, after sample i, the ray may meet something visible; > count: none.

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
        i = max(int((_exit(px, py, pz, ix, iy, iz, reach, bi, bj, bk) - t0) * per_step), i)
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
    """Whether some segment of a run (RUN,) that comes from u0 (-1: none) may have extinction, or nearly so."""
    lowest: float
    highest: float
    lowest, highest = run_range(run)
    if u0 >= 0.0:
        lowest, highest = min(lowest, u0), max(highest, u0)
    around = 0.0 if flat else AROUND * (highest - lowest)
    return lowest < 0.0 or highest + around > dark[U(int(max(lowest - around, 0.0)))]


@_jit
def cast(
    voxels: Voxels, optics: Optics, empty: np.ndarray, light: None, px: float, py: float, pz: float, dx: float,
    dy: float, dz: float, step: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Premultiplied (r, g, b, alpha) along a ray; ``step`` is the sampling distance in voxels, ``light`` None."""
    nz, ny, nx = voxels.values.shape
    run = stack_run()
    seen, trans = zeros4(), 1.0
    t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
    if not t1 > t0:
        return 0.0, 0.0, 0.0, 0.0
    count = max(math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step), 1)
    dt = (t1 - t0) / count
    opaque = OPAQUE * min(step * step, 1.0)
    ix, iy, iz, per_step = inverse(dx), inverse(dy), inverse(dz), 1.0 / dt
    p, d, flat = (px, py, pz), (dx, dy, dz), is_flat(optics)
    before = u0 = -1.0  # -1: no sample there, or not finite
    i = 0
    while True:
        at = i - 1 if u0 >= 0.0 else i  # the segment that comes from there is still to be seen
        start = skip(voxels.values.shape, empty, px, py, pz, dx, dy, dz, ix, iy, iz, t0, dt, per_step, count, at)
        if start > count:
            return lane(seen, 0), lane(seen, 1), lane(seen, 2), 1.0 - trans
        if start > at:
            before, u0, i = -1.0, -1.0, max(start - 1, 0)  # one earlier, for what bends the next
        t = t0 + i * dt
        sample_run(voxels, px + t * dx, py + t * dy, pz + t * dz, dx * dt, dy * dt, dz * dt, optics, run)
        if any_light(run, u0, optics.dark, flat):
            for n in range(min(RUN, count + 1 - i)):
                u1 = run[n]
                met = values_met(before, u0, u1, flat)
                if met[0] >= 0.0 and met[1] > optics.dark[U(int(met[0]))]:
                    seen, trans, _ = pass_segment(voxels, optics, p, d, t + (n - 1) * dt, dt, u0, u1, met, seen, trans)
                    if trans < opaque:
                        return lane(seen, 0), lane(seen, 1), lane(seen, 2), 1.0 - trans
                before, u0 = u0, u1
        before, u0 = run[RUN - 2], run[RUN - 1]
        i += RUN
        if i > count:
            return lane(seen, 0), lane(seen, 1), lane(seen, 2), 1.0 - trans


def pixels_of(cast: Cast) -> Callable[..., tuple[float, float, float, float]]:
    """Return the function that sums the rays of a pixel, which ``cast`` follows: `cast` or one with its arguments."""

    @_jit
    def pixel_sum(
        voxels: Voxels, optics: Optics, empty: np.ndarray, light: Any, eye: np.ndarray, basis: np.ndarray,
        lens: np.ndarray, step: float, col: int, row: int, offsets: np.ndarray,
    ) -> tuple[float, float, float, float]:  # fmt: skip
        """Sums (r, g, b, alpha) over the rays through the points ``offsets`` (n, 2: right, down) from a pixel's centre.

        Arguments as of `render_tiles`; the pixel is (``col``, ``row``).
        """
        acc0 = acc1 = acc2 = acc3 = 0.0
        for ray in range(len(offsets)):
            a = (col + 0.5 + offsets[U(ray), 0] - lens[2]) * lens[0]
            b = (row + 0.5 + offsets[U(ray), 1] - lens[3]) * lens[1]
            norm = 1.0 / math.sqrt(a * a + b * b + 1.0)
            dx = (basis[0, 0] * a + basis[1, 0] * b + basis[2, 0]) * norm
            dy = (basis[0, 1] * a + basis[1, 1] * b + basis[2, 1]) * norm
            dz = (basis[0, 2] * a + basis[1, 2] * b + basis[2, 2]) * norm
            red, green, blue, alpha = cast(voxels, optics, empty, light, eye[0], eye[1], eye[2], dx, dy, dz, step)
            acc0, acc1, acc2, acc3 = acc0 + red, acc1 + green, acc2 + blue, acc3 + alpha
        return acc0, acc1, acc2, acc3

    return pixel_sum


def tiles_of(cast: Cast) -> Callable[..., None]:
    """Return the loop over the pixels of a tile; ``cast`` as of `pixels_of`."""
    pixel_sum = pixels_of(cast)

    @_jit
    def tile(
        voxels: Voxels, optics: Optics, empty: np.ndarray, light: Any, eye: np.ndarray, basis: np.ndarray,
        lens: np.ndarray, step: float, top: int, left: int, offsets: np.ndarray, mask: np.ndarray, known: int,
        out: np.ndarray,
    ) -> None:  # fmt: skip
        """Pixels of the tile from (``left``, ``top``) on; arguments as of `render_tiles`."""
        height, width = out.shape[:2]
        share = 1.0 / (known + len(offsets))
        for line in range(top, min(top + TILE, height)):
            for col in range(left, min(left + TILE, width)):
                if not mask[line, col]:
                    continue
                red, green, blue, alpha = pixel_sum(
                    voxels, optics, empty, light, eye, basis, lens, step, col, line, offsets
                )  # fmt: skip
                pixel = out[line, col]
                if known > 0:
                    red, green, blue = red + known * pixel[0], green + known * pixel[1], blue + known * pixel[2]
                    alpha += known * pixel[3]
                pixel[0], pixel[1], pixel[2], pixel[3] = red * share, green * share, blue * share, alpha * share

    return tile


_tile = tiles_of(cast)


@parallel_kernel(
    "Voxels Optics u1:3 f8:1 f8:2 f8:1 f8 i8:1 f8:2 b1:2 i8 f4:3",
    TUPLES,
    fastmath=FLAGS,
    error_model="numpy",
)
def render_tiles(
    part: Part, voxels: Voxels, optics: Optics, empty: np.ndarray, eye: np.ndarray, basis: np.ndarray, lens: np.ndarray,
    step: float, order: np.ndarray, offsets: np.ndarray, mask: np.ndarray, known: int, out: np.ndarray,
) -> None:  # fmt: skip
    """Render one view into ``out`` (h, w, 4) float32, rays at ``offsets`` (n, 2) in pixels where ``mask`` is set.

    ``eye`` (3,) voxels and ``basis`` (3, 3: rows right, down, forward) in voxels per unit-frame length;
    ``lens`` is (1/fx, 1/fy, cx, cy), pixels; ``order`` (tiles,) of the tiles (row-major); ``mask`` (h, w) bool;
    ``step`` in voxels along a ray; ``known``: number of rays whose mean ``out`` holds already.
    """
    across = (out.shape[1] + TILE - 1) // TILE
    index = take_turn(part)
    while index < len(order):
        top, left = order[index] // across * TILE, order[index] % across * TILE
        _tile(voxels, optics, empty, None, eye, basis, lens, step, top, left, offsets, mask, known, out)
        index = take_turn(part)
