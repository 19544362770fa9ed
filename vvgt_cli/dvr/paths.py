"""The kernels that trace paths of light: where rays are first scattered, and the light that arrives there.

Woodcock's tracking (1965) through the largest extinction of each brick; what the sky sends straight to a place by ratio
tracking (Novak et al. 2014), weighed against what scattered rays find by the balance heuristic (Veach 1997). Matter
scatters by a mix, as Exposure Render has it (Kroes et al. 2012): Henyey and Greenstein's phase function (1941), and a
matt surface turned to where the matter ends, whose share is the difference of opacity across it. Albedo is the look's
colour to the power of `GAMMA`. Paths in white opaque matter go on for long: after `DENSE` scatterings they see matter
that is at most so dense, the less the longer they are, so that they come out near by instead of being given up.

Rays, ``voxels``, ``optics``, ``texels`` and ``empty`` are as in `march`; ``most`` (bz, by, bx) float64 is the largest
extinction of each brick, ``limit`` that of all: denser matter counts as that dense. The numbers of a path follow from
the seed and the path's number alone.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vvgt_cli.dvr.kernel import FLAGS, U, box_span, inverse, mean_optics, sample, table_coordinate, texel_at
from vvgt_cli.dvr.layout import BRICK, BRICK_BITS, LIT_GRID, TUPLES, Optics, Texels, Voxels
from vvgt_cli.dvr.shading import normal
from vvgt_cli.dvr.sky import SKY, Sky
from vvgt_cli.dvr.vectors import Vector, lane
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, next_iteration

GAMMA = 2.2  # sRGB's, nearly
BOUNCES = 256  # times a path is scattered at most
DENSE = 32  # of them before the densest matter counts as less dense, by the cube of their number
CERTAIN = 3  # of them before chance ends paths that carry little
NUDGE = 1e-9  # voxels beyond a brick's face
CHUNK = 64  # points that a thread takes at once
FAINT = 1e-2  # transmittance below which chance ends a ray to the sky

_jit = inlined(fastmath=FLAGS, error_model="numpy", borrowed=True)


@_jit
def _random(state: np.ndarray) -> float:
    """Return the next number in [0, 1) of ``state`` (1,) uint64 (splitmix64, Steele et al. 2014)."""
    state[0] += U(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> U(30))) * U(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> U(27))) * U(0x94D049BB133111EB)
    return float((z ^ (z >> U(31))) >> U(11)) * (1.0 / 9007199254740992.0)


@_jit
def _begin(state: np.ndarray, seed: int, number: int) -> None:
    """Set ``state`` to where the numbers of path ``number`` begin."""
    state[0] = U(seed) * U(0xD1342543DE82EF95) + U(number) * U(0xDA942042E4DD58B5)
    _random(state)
    state[0] ^= state[0] >> U(29)
    state[0] *= U(0xBF58476D1CE4E5B9)


@_jit
def _extinction(voxels: Voxels, optics: Optics, limit: float, x: float, y: float, z: float) -> float:
    u = table_coordinate(sample(voxels.values, x, y, z), optics)
    return min(max(mean_optics(u, u, optics)[3], 0.0), limit) if u >= 0.0 else 0.0


@_jit
def _face(p: float, d: float, brick: int, reach: int) -> float:
    """Return t at which the bricks within ``reach`` of a brick end along an axis; the rim belongs to the first."""
    if d > 0.0:
        return ((brick + reach) * BRICK - p) / d
    low = brick - reach + 1
    return (low * BRICK - p) * inverse(d) if low > 0 and d < 0.0 else np.inf


@_jit
def _next(
    voxels: Voxels, optics: Optics, empty: np.ndarray, most: np.ndarray, limit: float, p: Vector, d: Vector,
    t: float, state: np.ndarray, shadow: bool,
) -> tuple[float, float]:  # fmt: skip
    """Return t of the next scattering after t, infinite if there is none, and the transmittance to there.

    With ``shadow`` nothing scatters: t is infinite, and the transmittance estimated.
    """
    (px, py, pz), (dx, dy, dz) = p, d
    nz, ny, nx = voxels.values.shape
    t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
    t, passed = max(t, t0), 1.0
    nudge = NUDGE / math.sqrt(dx * dx + dy * dy + dz * dz)
    while t < t1:
        bi = min(max(int(px + t * dx), 0), nx - 1) >> BRICK_BITS
        bj = min(max(int(py + t * dy), 0), ny - 1) >> BRICK_BITS
        bk = min(max(int(pz + t * dz), 0), nz - 1) >> BRICK_BITS
        top, reach = min(most[U(bk), U(bj), U(bi)], limit), max(int(empty[U(bk), U(bj), U(bi)]), 1)
        end = min(_face(px, dx, bi, reach), _face(py, dy, bj, reach), _face(pz, dz, bk, reach), t1)
        while t < end and top > 0.0:
            t -= math.log(1.0 - _random(state)) / top
            if t >= end:
                break
            tau = _extinction(voxels, optics, limit, px + t * dx, py + t * dy, pz + t * dz)
            if shadow:
                passed *= 1.0 - min(tau / top, 1.0)
                if passed < FAINT:
                    if not _random(state) * FAINT < passed:
                        return np.inf, 0.0
                    passed = FAINT
            elif _random(state) * top < tau:
                return t, passed
        t = end + nudge
    return np.inf, passed


@_jit
def _surface(
    voxels: Voxels, optics: Optics, edge: np.ndarray, limit: float, x: float, y: float, z: float
) -> tuple[float, float, float, float]:
    """Return where matter ends, a unit vector of the box frame, and the difference of opacity a voxel on both sides."""
    n0, n1, n2 = normal(voxels.values, edge, x, y, z)
    if n0 == 0.0 and n1 == 0.0 and n2 == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    h = (edge[0] + edge[1] + edge[2]) / 3.0
    a, b, c = n0 * h / edge[0], n1 * h / edge[1], n2 * h / edge[2]
    before = math.exp(-h * _extinction(voxels, optics, limit, x - a, y - b, z - c))
    after = math.exp(-h * _extinction(voxels, optics, limit, x + a, y + b, z + c))
    if after < before:
        return -n0, -n1, -n2, before - after
    return n0, n1, n2, after - before


@_jit
def _turned(d: Vector, cosine: float, turn: float) -> Vector:
    """Return the unit vector at an angle of ``cosine`` to the unit vector d, ``turn`` around it (Duff et al. 2017)."""
    sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
    a, b = sine * math.cos(turn), sine * math.sin(turn)
    sign = 1.0 if d[2] >= 0.0 else -1.0
    f = -1.0 / (sign + d[2])
    g = d[0] * d[1] * f
    return (
        a * (1.0 + sign * d[0] * d[0] * f) + b * g + cosine * d[0],
        a * sign * g + b * (sign + d[1] * d[1] * f) + cosine * d[1],
        -a * sign * d[0] - b * d[1] + cosine * d[2],
    )


@_jit
def _phase(cosine: float, g: float) -> float:
    """Return Henyey and Greenstein's phase function, per steradian."""
    below = max(1.0 + g * g - 2.0 * g * cosine, 1e-12)
    return (1.0 - g * g) / (12.566370614359172 * below * math.sqrt(below))


@_jit
def _phase_cosine(g: float, r: float) -> float:
    """Return the cosine that a number in [0, 1) draws from `_phase`."""
    if abs(g) < 1e-3:
        return 1.0 - 2.0 * r
    s = (1.0 - g * g) / (1.0 - g + 2.0 * g * r)
    return min(max((1.0 + g * g - s * s) / (2.0 * g), -1.0), 1.0)


@_jit
def _texel(sky: Sky, d: Vector) -> int:
    """Return the number of the sky's texel in the direction of a unit vector."""
    rows, columns = sky.radiance.shape[0], sky.radiance.shape[1]
    row = min(max(int((1.0 - d[2]) * 0.5 * rows), 0), rows - 1)
    turn = math.atan2(d[1], d[0]) * 0.15915494309189535
    column = min(int((turn if turn >= 0.0 else turn + 1.0) * columns), columns - 1)
    return int(row * columns + column)


@_jit
def _density(sky: Sky, texel: int) -> float:
    """Return the probability per steradian that `_drawn` draws a direction in a texel."""
    before = sky.cumulative[U(texel - 1)] if texel > 0 else 0.0
    share: float = sky.cumulative[U(texel)] - before
    return share * float(sky.cumulative.shape[0]) * 0.07957747154594767


@_jit
def _drawn(sky: Sky, state: np.ndarray) -> tuple[Vector, int]:
    """Draw a direction of the sky, as bright ones are likely, and return its texel with it."""
    r, low, high = _random(state), 0, sky.cumulative.shape[0] - 1
    while low < high:
        middle = (low + high) >> 1
        if sky.cumulative[U(middle)] > r:
            high = middle
        else:
            low = middle + 1
    rows, columns = sky.radiance.shape[0], sky.radiance.shape[1]
    z = 1.0 - (low // columns + _random(state)) * 2.0 / rows
    turn = (low % columns + _random(state)) * 6.283185307179586 / columns
    across = math.sqrt(max(1.0 - z * z, 0.0))
    return (across * math.cos(turn), across * math.sin(turn), z), low


@_jit
def _color(voxels: Voxels, optics: Optics, texels: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return red, green and blue of the matter at voxel coordinates, linear, in [0, 1]."""
    if texels is None:
        u = max(table_coordinate(sample(voxels.values, x, y, z), optics), 0.0)
        red, green, blue, tau = mean_optics(u, u, optics)
    else:
        matter = texel_at(texels.values, x, y, z)
        red, green, blue, tau = lane(matter, 0), lane(matter, 1), lane(matter, 2), lane(matter, 3)
    share = 1.0 / tau if tau > 0.0 else 0.0
    return (
        min(max(red * share, 0.0), 1.0) ** GAMMA, min(max(green * share, 0.0), 1.0) ** GAMMA,
        min(max(blue * share, 0.0), 1.0) ** GAMMA,
    )  # fmt: skip


@_jit
def _arriving(
    voxels: Voxels, optics: Optics, texels: Any, empty: np.ndarray, most: np.ndarray, limit: float, edge: np.ndarray,
    sky: Sky, g: float, p: Vector, w: Vector, state: np.ndarray,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the red, green and blue that one path brings to p, where a ray along the unit vector w is scattered."""
    red, green, blue, wr, wg, wb = 0.0, 0.0, 0.0, 1.0, 1.0, 1.0
    for bounce in range(BOUNCES):
        x, y, z = p
        densest = limit * min(DENSE / max(bounce, 1), 1.0) ** 3
        n0, n1, n2, q = _surface(voxels, optics, edge, limit, x, y, z)
        e, k = _drawn(sky, state)
        cosine = max(n0 * e[0] + n1 * e[1] + n2 * e[2], 0.0)
        f = (1.0 - q) * _phase(w[0] * e[0] + w[1] * e[1] + w[2] * e[2], g) + q * cosine * 0.3183098861837907
        if f > 0.0:
            d = e[0] / edge[0], e[1] / edge[1], e[2] / edge[2]
            f *= _next(voxels, optics, empty, most, densest, p, d, 0.0, state, True)[1] / (f + _density(sky, k))
            bright = sky.radiance[U(k // sky.radiance.shape[1]), U(k % sky.radiance.shape[1])]
            red, green, blue = red + wr * f * bright[0], green + wg * f * bright[1], blue + wb * f * bright[2]
        r, turn = _random(state), 6.283185307179586 * _random(state)
        on_surface = _random(state) < q
        v = _turned((n0, n1, n2), math.sqrt(r), turn) if on_surface else _turned(w, _phase_cosine(g, r), turn)
        cosine = max(n0 * v[0] + n1 * v[1] + n2 * v[2], 0.0)
        f = (1.0 - q) * _phase(w[0] * v[0] + w[1] * v[1] + w[2] * v[2], g) + q * cosine * 0.3183098861837907
        d = v[0] / edge[0], v[1] / edge[1], v[2] / edge[2]
        t, _ = _next(voxels, optics, empty, most, densest, p, d, 0.0, state, False)
        if not t < np.inf:
            k = _texel(sky, v)
            f /= f + _density(sky, k)
            bright = sky.radiance[U(k // sky.radiance.shape[1]), U(k % sky.radiance.shape[1])]
            return red + wr * f * bright[0], green + wg * f * bright[1], blue + wb * f * bright[2]
        p, w = (x + t * d[0], y + t * d[1], z + t * d[2]), v
        c = _color(voxels, optics, texels, p[0], p[1], p[2])
        wr, wg, wb = wr * c[0], wg * c[1], wb * c[2]
        if bounce >= CERTAIN:
            stays = min(max(wr, wg, wb), 1.0)
            if not _random(state) < stays:
                return red, green, blue
            wr, wg, wb = wr / stays, wg / stays, wb / stays
    return red, green, blue


@parallel_kernel("Voxels Optics u1:3 f8:3 f8 f8:1 i8 f8:2 f8:2", TUPLES, fastmath=FLAGS, error_model="numpy")
def first_scatterings(
    thread: ThreadSlice, voxels: Voxels, optics: Optics, empty: np.ndarray, most: np.ndarray, limit: float,
    edge: np.ndarray, seed: int, rays: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Write where each of ``rays`` (n, 6), a place in voxels and a unit vector, scatters first into ``out`` (n, 3).

    NaN where it does not. ``edge`` (3,) of `Light`.
    """
    state, index = np.empty(1, np.uint64), next_iteration(thread)
    while index * CHUNK < len(rays):
        for n in range(index * CHUNK, min(index * CHUNK + CHUNK, len(rays))):
            row = rays[n]
            _begin(state, seed, n)
            p, d = (row[0], row[1], row[2]), (row[3] / edge[0], row[4] / edge[1], row[5] / edge[2])
            t, _ = _next(voxels, optics, empty, most, limit, p, d, 0.0, state, False)
            for axis in range(3):
                out[n, axis] = p[axis] + t * d[axis] if t < np.inf else np.nan
        index = next_iteration(thread)


def _gather(
    thread: ThreadSlice, voxels: Voxels, optics: Optics, texels: Texels | None, empty: np.ndarray, most: np.ndarray,
    limit: float, edge: np.ndarray, sky: Sky, g: float, seed: int, points: np.ndarray, first: np.ndarray,
    last: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Add up what paths ``first`` to ``last`` (n,) of each point bring into ``out`` (n, 7).

    Red, green and blue, their squares' sum, and the matter's colour there, linear. ``points`` (n, 6): places in voxels,
    and the unit vector along which the ray came that is scattered there; ``g`` of the phase function.
    """
    state, index = np.empty(1, np.uint64), next_iteration(thread)
    while index * CHUNK < len(points):
        for n in range(index * CHUNK, min(index * CHUNK + CHUNK, len(points))):
            row, total = points[n], out[n]
            total[4], total[5], total[6] = _color(voxels, optics, texels, row[0], row[1], row[2])
            for path in range(first[n], last[n]):
                _begin(state, seed + path, n)
                r, g_, b = _arriving(
                    voxels, optics, texels, empty, most, limit, edge, sky, g, (row[0], row[1], row[2]),
                    (row[3], row[4], row[5]), state,
                )  # fmt: skip
                total[0], total[1], total[2] = total[0] + r, total[1] + g_, total[2] + b
                total[3] += (r + g_ + b) * (r + g_ + b) / 9.0
        index = next_iteration(thread)


_ARGUMENTS = "u1:3 f8:3 f8 f8:1 Sky f8 i8 f8:2 i8:1 i8:1 f8:2"
gather = parallel_kernel(
    f"Voxels Optics none {_ARGUMENTS}", {**TUPLES, Sky: SKY}, "gather", fastmath=FLAGS, error_model="numpy"
)(_gather)
gather_grid = parallel_kernel(
    f"Voxels Optics Texels {_ARGUMENTS}", {**LIT_GRID, Sky: SKY}, "gather_grid", fastmath=FLAGS, error_model="numpy"
)(_gather)
