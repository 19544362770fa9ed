"""The numba ray caster of optics grids: extinction and colour are interpolated, not classified (conventions: Optics).

As `kernel`, whose pixels, bricks and cameras it shares; along a segment extinction times (r, g, b, 1) is linear.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vvgt_cli.dvr.kernel import FLAGS, OPAQUE, PARTS, SUB_DEPTH, TILE, U, absorbed, box_span, inverse, skip, tiles_of
from vvgt_cli.dvr.layout import GRID, LIT_GRID, Light, Texels, Voxels
from vvgt_cli.dvr.runs import BORROWED
from vvgt_cli.dvr.shading import shading
from vvgt_cli.dvr.vectors import Quad, add, lane, mix, scale, texel, zeros4
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.parts import Part, take_turn

LEAP = 8  # samples between two looks at the empty-space map

_jit = inlined(fastmath=FLAGS, error_model="numpy", **BORROWED)


@_jit
def texel_at(values: np.ndarray, x: float, y: float, z: float) -> Quad:
    """Trilinear voxel of ``values`` (nz, ny, nx, 4) at voxel coordinates, clamped to the edge voxels."""
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
def composite(a: Quad, b: Quad, dt: float, seen: Quad, trans: float) -> tuple[Quad, float]:
    """``seen`` (r, g, b, alpha) and ``trans`` behind a segment of length dt; the optics go linearly from a to b."""
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


@_jit
def cast(
    texels: Texels, voxels: Any, empty: np.ndarray, light: Any, px: float, py: float, pz: float,
    dx: float, dy: float, dz: float, step: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """`kernel.cast` of a grid; ``voxels`` hold its extinction where there is a ``light`` (`Light`), both else None."""
    values = texels.values
    nz, ny, nx, _ = values.shape
    seen, trans = zeros4(), 1.0
    red = green = blue = 0.0
    t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
    if not t1 > t0:
        return 0.0, 0.0, 0.0, 0.0
    count = max(int(math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step)), 1)  # noqa: RUF046 # for GPUs
    dt = (t1 - t0) / count
    opaque = OPAQUE * min(step * step, 1.0)
    ix, iy, iz, per_step = inverse(dx), inverse(dy), inverse(dz), 1.0 / dt
    a, known = zeros4(), False
    i, stop = 0, 0
    while i <= count and trans >= opaque:
        if i >= stop:
            at = i - 1 if known else i  # the segment that comes from there is still to be seen
            start = skip((nz, ny, nx), empty, px, py, pz, dx, dy, dz, ix, iy, iz, t0, dt, per_step, count, at)
            if start > count:
                break
            if start > at:
                known, i = False, start
            stop = i + LEAP
        t = t0 + i * dt
        b = texel_at(values, px + t * dx, py + t * dy, pz + t * dz)
        if known and lane(a, 3) + lane(b, 3) > 0.0:
            if light is None:
                seen, trans = composite(a, b, dt, seen, trans)
            else:
                own, trans = composite(a, b, dt, zeros4(), trans)
                s = t - 0.5 * dt
                factor, white = shading(
                    voxels.values, light, px + s * dx, py + s * dy, pz + s * dz,
                    dx * light.edge[0], dy * light.edge[1], dz * light.edge[2],
                )  # fmt: skip
                most = lane(own, 3)
                white *= most
                red += min(factor * lane(own, 0) + white, most)
                green += min(factor * lane(own, 1) + white, most)
                blue += min(factor * lane(own, 2) + white, most)
        a, known = b, True
        i += 1
    if light is None:
        red, green, blue = lane(seen, 0), lane(seen, 1), lane(seen, 2)
    return red, green, blue, 1.0 - trans


_tile = tiles_of(cast)


@parallel_kernel("Texels u1:3 f8:1 f8:2 f8:1 f8 i8:1 f8:2 b1:2 i8 f4:3", GRID, fastmath=FLAGS, error_model="numpy")
def render_grid_tiles(
    part: Part, texels: Texels, empty: np.ndarray, eye: np.ndarray, basis: np.ndarray, lens: np.ndarray, step: float,
    order: np.ndarray, offsets: np.ndarray, mask: np.ndarray, known: int, out: np.ndarray,
) -> None:  # fmt: skip
    """`kernel.render_tiles` of a grid."""
    across = (out.shape[1] + TILE - 1) // TILE
    index = take_turn(part)
    while index < len(order):
        top, left = order[index] // across * TILE, order[index] % across * TILE
        _tile(texels, None, empty, None, eye, basis, lens, step, top, left, offsets, mask, known, out)
        index = take_turn(part)


@parallel_kernel(
    "Texels Voxels u1:3 Light f8:1 f8:2 f8:1 f8 i8:1 f8:2 b1:2 i8 f4:3",
    LIT_GRID,
    fastmath=FLAGS,
    error_model="numpy",
)
def render_lit_grid_tiles(
    part: Part, texels: Texels, voxels: Voxels, empty: np.ndarray, light: Light, eye: np.ndarray, basis: np.ndarray,
    lens: np.ndarray, step: float, order: np.ndarray, offsets: np.ndarray, mask: np.ndarray, known: int,
    out: np.ndarray,
) -> None:  # fmt: skip
    """The same under ``light`` (`Light`): normals are the gradient of the extinction ``voxels``."""
    across = (out.shape[1] + TILE - 1) // TILE
    index = take_turn(part)
    while index < len(order):
        top, left = order[index] // across * TILE, order[index] % across * TILE
        _tile(texels, voxels, empty, light, eye, basis, lens, step, top, left, offsets, mask, known, out)
        index = take_turn(part)
