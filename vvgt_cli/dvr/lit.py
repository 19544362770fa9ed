"""The numba ray caster under light: `kernel.cast`, each visible segment shaded where it absorbs (docs/light.md)."""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.dvr.kernel import (
    FLAGS,
    OPAQUE,
    TILE,
    U,
    any_light,
    box_span,
    inverse,
    is_flat,
    pass_segment,
    skip,
    tiles_of,
    values_met,
)
from vvgt_cli.dvr.layout import LIT, Light, Optics, Voxels
from vvgt_cli.dvr.runs import BORROWED, RUN, sample_run, stack_run
from vvgt_cli.dvr.shading import shading
from vvgt_cli.dvr.vectors import lane, zeros4
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.parts import Part, take_turn

_jit = inlined(fastmath=FLAGS, error_model="numpy", **BORROWED)


@_jit
def cast(
    voxels: Voxels, optics: Optics, empty: np.ndarray, light: Light, px: float, py: float, pz: float, dx: float,
    dy: float, dz: float, step: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """`kernel.cast` under ``light`` (`Light`); no colour of a sample exceeds 1."""
    nz, ny, nx = voxels.values.shape
    run = stack_run()
    red = green = blue = 0.0
    trans = 1.0
    t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
    if not t1 > t0:
        return 0.0, 0.0, 0.0, 0.0
    count = max(math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step), 1)
    dt = (t1 - t0) / count
    opaque = OPAQUE * min(step * step, 1.0)
    ix, iy, iz, per_step = inverse(dx), inverse(dy), inverse(dz), 1.0 / dt
    p, d, flat = (px, py, pz), (dx, dy, dz), is_flat(optics)
    ux, uy, uz = dx * light.edge[0], dy * light.edge[1], dz * light.edge[2]
    before = u0 = -1.0  # -1: no sample there, or not finite
    i = 0
    while True:
        at = i - 1 if u0 >= 0.0 else i  # the segment that comes from there is still to be seen
        start = skip(voxels.values.shape, empty, px, py, pz, dx, dy, dz, ix, iy, iz, t0, dt, per_step, count, at)
        if start > count:
            return red, green, blue, 1.0 - trans
        if start > at:
            before, u0, i = -1.0, -1.0, max(start - 1, 0)  # one earlier, for what bends the next
        t = t0 + i * dt
        sample_run(voxels, px + t * dx, py + t * dy, pz + t * dz, dx * dt, dy * dt, dz * dt, optics, run)
        if any_light(run, u0, optics.dark, flat):
            for n in range(min(RUN, count + 1 - i)):
                u1 = run[n]
                met = values_met(before, u0, u1, flat)
                if met[0] >= 0.0 and met[1] > optics.dark[U(int(met[0]))]:
                    seen, trans, s = pass_segment(
                        voxels, optics, p, d, t + (n - 1) * dt, dt, u0, u1, met, zeros4(), trans
                    )
                    most = lane(seen, 3)
                    if most > 0.0:
                        factor, white = shading(
                            voxels.values, light, px + s * dx, py + s * dy, pz + s * dz, ux, uy, uz
                        )  # fmt: skip
                        white *= most
                        red += min(factor * lane(seen, 0) + white, most)
                        green += min(factor * lane(seen, 1) + white, most)
                        blue += min(factor * lane(seen, 2) + white, most)
                    if trans < opaque:
                        return red, green, blue, 1.0 - trans
                before, u0 = u0, u1
        before, u0 = run[RUN - 2], run[RUN - 1]
        i += RUN
        if i > count:
            return red, green, blue, 1.0 - trans


_tile = tiles_of(cast)


@parallel_kernel(
    "Voxels Optics u1:3 Light f8:1 f8:2 f8:1 f8 i8:1 f8:2 b1:2 i8 f4:3",
    LIT,
    fastmath=FLAGS,
    error_model="numpy",
)
def render_lit_tiles(
    part: Part,
    voxels: Voxels,
    optics: Optics,
    empty: np.ndarray,
    light: Light,
    eye: np.ndarray,
    basis: np.ndarray,
    lens: np.ndarray,
    step: float,
    order: np.ndarray,
    offsets: np.ndarray,
    mask: np.ndarray,
    known: int,
    out: np.ndarray,
) -> None:
    """`kernel.render_tiles` under ``light`` (`Light`)."""
    across = (out.shape[1] + TILE - 1) // TILE
    index = take_turn(part)
    while index < len(order):
        top, left = order[index] // across * TILE, order[index] % across * TILE
        _tile(voxels, optics, empty, light, eye, basis, lens, step, top, left, offsets, mask, known, out)
        index = take_turn(part)
