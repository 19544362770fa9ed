"""The kernels that cast rays: through a volume's values or an optics grid, whole or in blocks, lit or not.

Rays are p + t d: p, d (x, y, z) in voxels from the first voxel's centre, t in unit-frame lengths. A ray is cut into
segments of equal length dt between its entry into the box at t0 and its exit; segment i goes from t0 + i dt on. Blocks
of a volume cut rays into the same segments, and the block in which a segment's middle lies owns it, so that what the
blocks show of a ray composes, front to back, to what the whole ray shows.

Arguments: ``voxels`` and ``optics`` are `layout.Voxels` and `layout.Optics`; ``mixture`` is None, or the
`layout.Mixture` of an optics grid, of which ``voxels`` and ``optics`` then hold the extinction; ``light`` is None or a
`layout.Light`;
``empty`` (bz, by, bx) uint8 as `Scene.empty`. Which of them are None is known when a kernel is compiled: each of the
twelve kernels holds one loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec

import numpy as np

from vvgt_cli.dvr.kernel import (
    FAINT,
    FINER,
    FLAGS,
    OPAQUE,
    PARTS,
    SUB_DEPTH,
    TILE,
    U,
    absorbed,
    any_light,
    blend_texels,
    box_span,
    inverse,
    is_flat,
    mean_quad,
    pass_segment,
    sample,
    skip,
    spread,
    table_coordinate,
    texel_at,
    values_met,
)
from vvgt_cli.dvr.layout import LIT, LIT_GRID, MIXED, TUPLES, UNMIXED, Light, Mixture, Optics, Voxels
from vvgt_cli.dvr.runs import RUN, Run, sample_run, stack_run
from vvgt_cli.dvr.shading import gradient, shade_at, shading, unit
from vvgt_cli.dvr.vectors import Quad, Vector, add, dot, lane, mix, scale, sub, vector, zeros4
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations, next_iteration

P = ParamSpec("P")
TURNING = 0.03  # of the light: what a segment absorbs from which on the normal may turn within it
TURNS, ALIKE = 12, 0.9  # normals that are shaded where it does; squared cosine from which on it does not
LEAP = 8  # samples of a grid between two looks at the empty-space map

_jit = inlined(fastmath=FLAGS, error_model="numpy", borrowed=True)
_exact = inlined(error_model="numpy", borrowed=True)  # the same on both sides of a face of blocks: no fast mathematics


@_jit
def slope_on_ray(values: np.ndarray, light: Light, p: Vector, d: Vector, t: float) -> Quad:
    """Return `gradient` at p + t d."""
    return gradient(values, light.edge, p[0] + t * d[0], p[1] + t * d[1], p[2] + t * d[2])


@_jit
def shade_segment(
    own: Quad,
    light: Light,
    values: np.ndarray,
    p: Vector,
    d: Vector,
    look: Vector,
    start: float,
    end: float,
    trans: float,
) -> tuple[float, float, float]:
    """Shade a segment's ``own`` (r, g, b, alpha), seen along ``look``; no colour exceeds its alpha.

    ``trans`` of the light passes what is before it. It absorbs from ``start`` to ``end`` of the ray p + t d; in the
    middle light is taken that is traced to a grid, and the normal of a segment that absorbs at most `TURNING`. Of
    others two normals are shaded, or `TURNS` where the gradient, quadratic along the ray, turns: where its sign changes
    a surface is dark on so short a way that single samples of it would draw lines.
    """
    most, middle = lane(own, 3), 0.5 * (start + end)
    if light.traced:
        x, y, z = p[0] + middle * d[0], p[1] + middle * d[1], p[2] + middle * d[2]
        red, green = shade_at(light, 0, x, y, z) * lane(own, 0), shade_at(light, 1, x, y, z) * lane(own, 1)
        return min(red, most), min(green, most), min(shade_at(light, 2, x, y, z) * lane(own, 2), most)
    red = green = blue = 0.0
    thin = most <= TURNING * trans
    a = slope_on_ray(values, light, p, d, middle if thin else start)
    b, bend, times = a, zeros4(), 1
    if not thin:
        b = slope_on_ray(values, light, p, d, end)
        if not dot(a, a) < np.inf:
            a = b
        elif not dot(b, b) < np.inf:
            b = a
        along = dot(a, b)
        times = 2 if along > 0.0 and along * along > ALIKE * dot(a, a) * dot(b, b) else TURNS
        halfway = slope_on_ray(values, light, p, d, middle) if times == TURNS else a
        if times == TURNS and dot(halfway, halfway) < np.inf:
            bend = sub(scale(4.0, halfway), scale(2.0, add(a, b)))
    for n in range(times):
        f = (n + 0.5) / times
        factor, white = shading(light, unit(add(mix(a, b, f), scale(f * (1.0 - f), bend))), look)
        white *= most
        red, green = red + min(factor * lane(own, 0) + white, most), green + min(factor * lane(own, 1) + white, most)
        blue += min(factor * lane(own, 2) + white, most)
    return red / times, green / times, blue / times


@_jit
def _through_values(
    voxels: Voxels, optics: Optics, empty: np.ndarray, light: Any, p: Vector, d: Vector,
    t0: float, dt: float, first: int, last: int, step: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Return premultiplied (r, g, b, alpha) of the segments from ``first`` to before ``last`` of a volume's values."""
    (px, py, pz), (dx, dy, dz) = p, d
    run, seen, flat = stack_run(), zeros4(), is_flat(optics)
    trans, red, green, blue = 1.0, 0.0, 0.0, 0.0
    opaque = OPAQUE * min(step * step, 1.0)
    ix, iy, iz, per_step = inverse(dx), inverse(dy), inverse(dz), 1.0 / dt
    look = d if light is None else (dx * light.edge[0], dy * light.edge[1], dz * light.edge[2])
    before = u0 = -1.0  # -1: no sample there, or not finite
    i = max(first - 1, 0)
    while i <= last and trans >= opaque:
        at = i - 1 if u0 >= 0.0 else i  # the segment that comes from there is still to be seen
        start = skip(voxels.values.shape, empty, px, py, pz, dx, dy, dz, ix, iy, iz, t0, dt, per_step, last, at)
        if start >= last:
            break
        if start > at:
            before, u0, i = -1.0, -1.0, max(start - 1, 0)  # one earlier, for what bends the next
        t = t0 + i * dt
        sample_run(voxels, px + t * dx, py + t * dy, pz + t * dz, dx * dt, dy * dt, dz * dt, optics, run)
        if any_light(run, u0, optics.dark, flat):
            for n in range(min(RUN, last + 1 - i)):
                u1 = run[n]
                met = values_met(before, u0, u1, flat)
                if i + n > first and met[0] >= 0.0 and met[1] > optics.dark[U(int(met[0]))]:
                    here = t + (n - 1) * dt
                    if light is None:
                        seen, trans, _, _ = pass_segment(voxels, optics, p, d, here, dt, u0, u1, met, seen, trans)
                    else:
                        ahead = trans
                        own, trans, begin, end = pass_segment(
                            voxels, optics, p, d, here, dt, u0, u1, met, zeros4(), trans
                        )  # fmt: skip
                        if lane(own, 3) > 0.0:
                            r, g, b_ = shade_segment(own, light, voxels.values, p, d, look, begin, end, ahead)
                            red, green, blue = red + r, green + g, blue + b_
                    if trans < opaque:
                        break
                before, u0 = u0, u1
        before, u0 = run[RUN - 2], run[RUN - 1]
        i += RUN
    if light is None:
        red, green, blue = lane(seen, 0), lane(seen, 1), lane(seen, 2)
    return red, green, blue, 1.0 - trans


@_jit
def _layer(mixture: Mixture, k: int) -> Optics:
    """Return the tables of layer ``k`` of scalars."""
    even = mixture.even[k]
    return Optics(0.0, 1.0, mixture.nodes[k], mixture.cumulative[k], mixture.dark[k], even, even)


@_jit
def _sample_layers(mixture: Mixture, scalars: Any, x: float, y: float, z: float, out: Run) -> Quad:
    """Write the table coordinate of each layer of scalars at voxel coordinates, -1: unknown; return the texel there."""
    if scalars is not None:
        for k in range(scalars.shape[0]):
            out[k] = table_coordinate(sample(scalars[k], x, y, z), _layer(mixture, k))
    return texel_at(mixture.grid, x, y, z)


@_jit
def _layer_mean(mixture: Mixture, k: int, u0: float, u1: float) -> Quad:
    """Return `mean_quad` of layer ``k`` of scalars; zeros where an end is unknown."""
    return mean_quad(u0, u1, _layer(mixture, k)) if min(u0, u1) >= 0.0 else zeros4()


@_jit
def _pass_layers(
    mixture: Mixture, p: Vector, d: Vector, t: float, dt: float, a: Quad, b: Quad, before: Run, then: Run, now: Run,
    inner: Run, own: Any, seen: Quad, trans: float,
) -> tuple[Quad, float, float, float]:  # fmt: skip
    """Return `pass_segment` of a mixture with scalars, from texel ``a`` and coordinates ``then`` to ``b`` and ``now``.

    ``before`` (coordinates a segment earlier) becomes ``then``, that ``now``; ``inner`` is overwritten. ``own`` is None
    or is filled with (r, g, b, alpha) of each layer of scalars and, behind them, of the texels.
    """
    count, whole, place, squared = mixture.scalars.shape[0], trans, 0.0, 0.0
    total, shown, steep = scale(0.5, add(a, b)), lane(a, 3) + lane(b, 3) > 0.0, False
    for k in range(count):
        low, high = values_met(before[k], then[k], now[k], False)
        before[k] = then[k]
        if low < 0.0:  # the face of a layer, or a voxel that is none, lies between
            if high > mixture.dark[k, U(int(max(high, 0.0)))]:
                shown = steep = True
        elif high > mixture.dark[k, U(int(low))]:
            total, shown = add(total, _layer_mean(mixture, k, then[k], now[k])), True
            steep |= high > mixture.even[k, U(int(low))]
    if own is not None:
        for n in range(4 * count + 4):
            own[n] = 0.0
    if not shown:
        for k in range(count):
            then[k] = now[k]
        return seen, trans, t, t
    parts = min(int(dt * lane(total, 3) / SUB_DEPTH) + 1, PARTS)
    if steep and trans >= FAINT:
        parts = max(parts, FINER)
    (px, py, pz), (dx, dy, dz), part = p, d, dt / parts
    for n in range(1, parts + 1):
        s, c = t + n * part, b
        if n < parts:
            c = _sample_layers(mixture, mixture.scalars, px + s * dx, py + s * dy, pz + s * dz, inner)
        else:
            for k in range(count):
                inner[k] = now[k]
        total = scale(0.5 * part, add(a, c))
        for k in range(count):
            total = add(total, scale(part, _layer_mean(mixture, k, then[k], inner[k])))
        depth = max(lane(total, 3), 0.0)
        f = absorbed(depth) * trans
        if own is None:
            seen = add(seen, scale(f, total))
        else:
            for k in range(count + 1):
                one = scale(0.5, add(a, c)) if k == count else _layer_mean(mixture, k, then[k], inner[k])
                for n4 in range(4):
                    own[4 * k + n4] += f * part * lane(one, n4)
        for k in range(count):
            then[k] = inner[k]
        a, trans, place = c, trans - f * depth, place + f * depth * (n - 0.5)
        squared += f * depth * (n - 0.5) * (n - 0.5)
    start, end = spread(whole - trans, place, squared, parts)
    return seen, trans, t + part * start, t + part * end


@_jit
def _through_mixture(
    mixture: Mixture, scalars: Any, voxels: Voxels, empty: np.ndarray, light: Any, p: Vector, d: Vector,
    t0: float, dt: float, first: int, last: int, step: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Return `_through_values` of an optics grid of ``scalars`` and texels; along a segment the latter are linear."""
    (px, py, pz), (dx, dy, dz), shape = p, d, voxels.values.shape
    before, then, now, inner, parts = stack_run(), stack_run(), stack_run(), stack_run(), stack_run()
    seen: Quad = zeros4()
    trans, red, green, blue = 1.0, 0.0, 0.0, 0.0
    opaque = OPAQUE * min(step * step, 1.0)
    ix, iy, iz, per_step = inverse(dx), inverse(dy), inverse(dz), 1.0 / dt
    look = d if light is None else (dx * light.edge[0], dy * light.edge[1], dz * light.edge[2])
    a, known = zeros4(), False
    i = stop = max(first - 1, 0)  # one earlier, for what bends the next
    while i <= last and trans >= opaque:
        if i >= stop:
            at = i - 1 if known else i
            start = skip(shape, empty, px, py, pz, dx, dy, dz, ix, iy, iz, t0, dt, per_step, last, at)
            if start >= last:
                break
            if start > at:
                known, i = False, max(start - 1, i)
            stop = i + LEAP
        t = t0 + i * dt
        b = _sample_layers(mixture, scalars, px + t * dx, py + t * dy, pz + t * dz, now)
        here, ahead = t - dt, trans
        if not known or i <= first:
            if scalars is not None:
                for k in range(scalars.shape[0]):
                    before[k], then[k] = then[k] if known else -1.0, now[k]
        elif light is None:
            if scalars is not None:
                seen, trans, _, _ = _pass_layers(
                    mixture, p, d, here, dt, a, b, before, then, now, inner, None, seen, trans
                )
            elif lane(a, 3) + lane(b, 3) > 0.0:
                seen, trans = blend_texels(a, b, dt, seen, trans)
        else:
            own, begin, end = zeros4(), here, t
            if scalars is not None:
                _, trans, begin, end = _pass_layers(
                    mixture, p, d, here, dt, a, b, before, then, now, inner, parts, own, trans
                )  # fmt: skip
                for k in range(scalars.shape[0]):
                    own = vector(parts[4 * k], parts[4 * k + 1], parts[4 * k + 2], parts[4 * k + 3])
                    if lane(own, 3) > 0.0:
                        r, g, b_ = shade_segment(own, light, scalars[k], p, d, look, begin, end, ahead)
                        red, green, blue = red + r, green + g, blue + b_
                k = 4 * scalars.shape[0]
                own = vector(parts[k], parts[k + 1], parts[k + 2], parts[k + 3])
            elif lane(a, 3) + lane(b, 3) > 0.0:
                own, trans = blend_texels(a, b, dt, own, trans)
            if lane(own, 3) > 0.0:
                r, g, b_ = shade_segment(own, light, voxels.values, p, d, look, begin, end, ahead)
                red, green, blue = red + r, green + g, blue + b_
        a, known = b, True
        i += 1
    if light is None:
        red, green, blue = lane(seen, 0), lane(seen, 1), lane(seen, 2)
    return red, green, blue, 1.0 - trans


@_jit
def _march(
    voxels: Voxels, optics: Optics, mixture: Any, empty: np.ndarray, light: Any, p: Vector, d: Vector,
    t0: float, dt: float, first: int, last: int, step: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Return premultiplied (r, g, b, alpha) of the segments from ``first`` to before ``last`` of a ray."""
    if mixture is None:
        return _through_values(voxels, optics, empty, light, p, d, t0, dt, first, last, step)
    else:  # noqa: RET505 - numba leaves out the branch that is not taken
        return _through_mixture(mixture, mixture.scalars, voxels, empty, light, p, d, t0, dt, first, last, step)


@_jit
def _whole(
    voxels: Voxels, optics: Optics, mixture: Any, empty: np.ndarray, light: Any, p: Vector, d: Vector, step: float
) -> tuple[float, float, float, float]:
    """Return premultiplied (r, g, b, alpha) along a ray; ``step`` is the sampling distance in voxels."""
    nz, ny, nx = voxels.values.shape
    (px, py, pz), (dx, dy, dz) = p, d
    t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
    if not t1 > t0:
        return 0.0, 0.0, 0.0, 0.0
    count = max(math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step), 1)
    return _march(voxels, optics, mixture, empty, light, p, d, t0, (t1 - t0) / count, 0, count, step)


def _direction(basis: np.ndarray, lens: np.ndarray, x: float, y: float) -> Vector:
    """Return the direction of the ray through a point of the picture, in voxels; arguments as of `_tiles`."""
    a, b = (x - lens[2]) * lens[0], (y - lens[3]) * lens[1]
    norm = 1.0 / math.sqrt(a * a + b * b + 1.0)
    return (
        (basis[0, 0] * a + basis[1, 0] * b + basis[2, 0]) * norm,
        (basis[0, 1] * a + basis[1, 1] * b + basis[2, 1]) * norm,
        (basis[0, 2] * a + basis[1, 2] * b + basis[2, 2]) * norm,
    )


direction, exact_direction = _jit(_direction), _exact(_direction)


@_jit
def _pixel(
    voxels: Voxels, optics: Optics, mixture: Any, empty: np.ndarray, light: Any, eye: np.ndarray, basis: np.ndarray,
    lens: np.ndarray, step: float, col: int, row: int, offsets: np.ndarray,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Sum (r, g, b, alpha) over the rays at ``offsets`` from the centre of pixel (``col``, ``row``)."""
    acc0 = acc1 = acc2 = acc3 = 0.0
    for ray in range(len(offsets)):
        d = direction(basis, lens, col + 0.5 + offsets[U(ray), 0], row + 0.5 + offsets[U(ray), 1])
        p = eye[0], eye[1], eye[2]
        red, green, blue, alpha = _whole(voxels, optics, mixture, empty, light, p, d, step)
        acc0, acc1, acc2, acc3 = acc0 + red, acc1 + green, acc2 + blue, acc3 + alpha
    return acc0, acc1, acc2, acc3


def _tiles(
    thread: ThreadSlice, voxels: Voxels, optics: Optics, mixture: Mixture | None, empty: np.ndarray,
    light: Light | None,
    eye: np.ndarray, basis: np.ndarray, lens: np.ndarray, step: float, order: np.ndarray, offsets: np.ndarray,
    mask: np.ndarray, known: int, out: np.ndarray,
) -> None:  # fmt: skip
    """Render one view into ``out`` (h, w, 4) float32, rays at ``offsets`` (n, 2) in pixels where ``mask`` is set.

    ``eye`` (3,) voxels and ``basis`` (3, 3: rows right, down, forward) in voxels per unit-frame length;
    ``lens`` is (1/fx, 1/fy, cx, cy), pixels; ``order`` (tiles,) of the tiles (row-major); ``mask`` (h, w) bool;
    ``step`` in voxels along a ray; ``known``: number of rays whose mean ``out`` holds already.
    """
    height, width = out.shape[:2]
    across, share = (width + TILE - 1) // TILE, 1.0 / (known + len(offsets))
    index = next_iteration(thread)
    while index < len(order):
        top, left = order[index] // across * TILE, order[index] % across * TILE
        for line in range(top, min(top + TILE, height)):
            for col in range(left, min(left + TILE, width)):
                if not mask[line, col]:
                    continue
                red, green, blue, alpha = _pixel(
                    voxels, optics, mixture, empty, light, eye, basis, lens, step, col, line, offsets
                )  # fmt: skip
                pixel = out[line, col]
                if known > 0:
                    red, green, blue = red + known * pixel[0], green + known * pixel[1], blue + known * pixel[2]
                    alpha += known * pixel[3]
                pixel[0], pixel[1], pixel[2], pixel[3] = red * share, green * share, blue * share, alpha * share
        index = next_iteration(thread)


@_exact
def _owned(p: float, d: float, lo: float, hi: float, t0: float, dt: float, count: int) -> tuple[int, int]:
    """Return the first segment with its middle from face ``lo`` to ``hi`` along one axis, and that after the last."""
    if d == 0.0:
        return (0, count) if lo <= p < hi else (0, 0)
    a, b = ((lo - p) / d - t0) / dt - 0.5, ((hi - p) / d - t0) / dt - 0.5
    first, last = math.ceil(min(max(a, 0.0), float(count))), math.ceil(min(max(b, 0.0), float(count)))
    return (first, last) if d > 0.0 else (last, first)


@_exact
def _ray(
    faces: np.ndarray, p: Vector, basis: np.ndarray, lens: np.ndarray, step: float, column: float, row: float
) -> tuple[Vector, float, float, int, int]:
    """Return a ray's direction, where its segments begin, their length, the first and last.

    The latter two are the block's own, as ``faces`` (3, 3) of `cast_segments` say; none where they are the same.
    """
    nx, ny, nz = int(faces[2, 0]), int(faces[2, 1]), int(faces[2, 2])
    px, py, pz = p
    dx, dy, dz = exact_direction(basis, lens, column, row)
    t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
    if not t1 > t0:
        return (dx, dy, dz), 0.0, 1.0, 0, 0
    count = max(math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step), 1)
    dt = (t1 - t0) / count
    first, last = _owned(px, dx, faces[0, 0], faces[1, 0], t0, dt, count)
    low, high = _owned(py, dy, faces[0, 1], faces[1, 1], t0, dt, count)
    first, last = max(first, low), min(last, high)
    low, high = _owned(pz, dz, faces[0, 2], faces[1, 2], t0, dt, count)
    return (dx, dy, dz), t0, dt, max(first, low), min(last, high)


@_jit
def _pixel_segments(
    voxels: Voxels, optics: Optics, mixture: Any, empty: np.ndarray, light: Any, faces: np.ndarray, begin: np.ndarray,
    eye: np.ndarray, basis: np.ndarray, lens: np.ndarray, step: float, pixel: np.ndarray, offsets: np.ndarray,
    out: np.ndarray,
) -> None:  # fmt: skip
    """Fill ``out`` (m, 4) of one ``pixel`` (2,)."""
    p = (eye[0], eye[1], eye[2])
    local = (eye[0] - begin[0], eye[1] - begin[1], eye[2] - begin[2])
    for m in range(len(offsets)):
        x, y = pixel[0] + 0.5 + offsets[m, 0], pixel[1] + 0.5 + offsets[m, 1]
        d, t0, dt, first, last = _ray(faces, p, basis, lens, step, x, y)
        if first < last:
            red, green, blue, alpha = _march(
                voxels, optics, mixture, empty, light, local, d, t0, dt, first, last, step
            )  # fmt: skip
            out[m, 0], out[m, 1], out[m, 2], out[m, 3] = red, green, blue, alpha


def _segments(
    thread: ThreadSlice, voxels: Voxels, optics: Optics, mixture: Mixture | None, empty: np.ndarray,
    light: Light | None,
    faces: np.ndarray, begin: np.ndarray, eye: np.ndarray, basis: np.ndarray, lens: np.ndarray, step: float,
    pixels: np.ndarray, offsets: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Write what a block shows of rays into ``out`` (n, m, 4) float32 premultiplied, which holds zeros.

    Everything up to ``light`` is of the block with two voxels around it, whose first voxel is
    ``begin`` (3,) of the whole volume; ``faces`` (3, 3): the block's lower and upper faces, infinite where the volume
    ends, and the volume's voxels, each (x, y, z); ``pixels`` (n, 2: column, row), ``offsets`` (m, 2), ``eye``,
    ``basis`` and ``lens`` as in `_tiles`, in voxels of the whole volume; ``step`` at most 1.
    """
    for n in iterations(thread, len(pixels)):
        _pixel_segments(
            voxels, optics, mixture, empty, light, faces, begin, eye, basis, lens, step, pixels[n], offsets, out[n]
        )  # fmt: skip


@parallel_kernel("Voxels Optics f8:2 f8:1 f8:1 f8:2 f8:1 f8 f4:2", TUPLES, fastmath=FLAGS, error_model="numpy")
def greatest(
    thread: ThreadSlice, voxels: Voxels, optics: Optics, faces: np.ndarray, begin: np.ndarray, eye: np.ndarray,
    basis: np.ndarray, lens: np.ndarray, step: float, out: np.ndarray,
) -> None:  # fmt: skip
    """Raise ``out`` (h, w) float32 to the greatest table coordinate that a block shows along each pixel's ray.

    ``optics`` has one bin, so that coordinates are in [0, 1]; values are taken at the middles of the segments; other
    arguments as of `_segments`.
    """
    run, p = stack_run(), (eye[0], eye[1], eye[2])
    x, y, z = eye[0] - begin[0], eye[1] - begin[1], eye[2] - begin[2]
    for row in iterations(thread, out.shape[0]):
        for column in range(out.shape[1]):
            (dx, dy, dz), t0, dt, i, last = _ray(faces, p, basis, lens, step, column + 0.5, row + 0.5)
            most = out[row, column]
            while i < last and most < 1.0:
                t = t0 + (i + 0.5) * dt
                sample_run(voxels, x + t * dx, y + t * dy, z + t * dz, dx * dt, dy * dt, dz * dt, optics, run)
                for n in range(min(RUN, last - i)):
                    most = max(most, run[n])
                i += RUN
            out[row, column] = most


VIEW, BLOCK = "f8:1 f8:2 f8:1 f8 i8:1 f8:2 b1:2 i8 f4:3", "f8:2 f8:1 f8:1 f8:2 f8:1 f8 i8:2 f8:2 f4:3"


def _kernel(
    body: Callable[Concatenate[ThreadSlice, P], None], name: str, more: str, grid: str, light: str
) -> Callable[P, None]:
    """Make the kernel ``name`` of a ``body`` for a ``grid``: "none", or "grid" without or "mixed" with scalars."""
    types = f"Voxels Optics {'none' if grid == 'none' else 'Mixture'} u1:3 {light} {more}"
    tuples = {"none": LIT, "grid": {**LIT_GRID, **UNMIXED}, "mixed": {**LIT_GRID, **MIXED}}[grid]
    return parallel_kernel(types, tuples, name=name, fastmath=FLAGS, error_model="numpy")(body)


render_tiles = _kernel(_tiles, "render_tiles", VIEW, "none", "none")
render_lit_tiles = _kernel(_tiles, "render_lit_tiles", VIEW, "none", "Light")
render_grid_tiles = _kernel(_tiles, "render_grid_tiles", VIEW, "grid", "none")
render_lit_grid_tiles = _kernel(_tiles, "render_lit_grid_tiles", VIEW, "grid", "Light")
render_mixed_tiles = _kernel(_tiles, "render_mixed_tiles", VIEW, "mixed", "none")
render_lit_mixed_tiles = _kernel(_tiles, "render_lit_mixed_tiles", VIEW, "mixed", "Light")
cast_segments = _kernel(_segments, "cast_segments", BLOCK, "none", "none")
cast_lit_segments = _kernel(_segments, "cast_lit_segments", BLOCK, "none", "Light")
cast_grid_segments = _kernel(_segments, "cast_grid_segments", BLOCK, "grid", "none")
cast_lit_grid_segments = _kernel(_segments, "cast_lit_grid_segments", BLOCK, "grid", "Light")
cast_mixed_segments = _kernel(_segments, "cast_mixed_segments", BLOCK, "mixed", "none")
cast_lit_mixed_segments = _kernel(_segments, "cast_lit_mixed_segments", BLOCK, "mixed", "Light")
