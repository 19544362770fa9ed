"""Parts of rays through a block of a volume, as the ray caster (`kernel`) has them of the whole.

A ray is cut into the same segments whatever the blocks, and a segment is that block's in which its middle lies. What
blocks show of a ray is put together front to back: premultiplied colours compose.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from vvgt_cli.dvr.grid import composite as mixed
from vvgt_cli.dvr.grid import texel_at
from vvgt_cli.dvr.kernel import (
    FLAGS,
    OPAQUE,
    U,
    any_light,
    box_span,
    inverse,
    is_flat,
    pass_segment,
    skip,
    values_met,
)
from vvgt_cli.dvr.layout import GRID, LIT, LIT_GRID, TUPLES, Light, Optics, Texels, Voxels
from vvgt_cli.dvr.runs import BORROWED, RUN, sample_run, stack_run
from vvgt_cli.dvr.shading import shading
from vvgt_cli.dvr.vectors import Quad, lane, zeros4
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.parts import Part, turns_of

Vector = tuple[float, float, float]
LEAP = 8  # samples between two looks at the empty-space map

_jit = inlined(fastmath=FLAGS, error_model="numpy", **BORROWED)


@inlined(error_model="numpy", **BORROWED)  # exactly the same on both sides of a face: no fast mathematics
def _owned(p: float, d: float, lo: float, hi: float, t0: float, dt: float, count: int) -> tuple[int, int]:
    """First segment, and that behind the last, with its middle from face ``lo`` to face ``hi`` along one axis."""
    if d == 0.0:
        return (0, count) if lo <= p < hi else (0, 0)
    a, b = ((lo - p) / d - t0) / dt - 0.5, ((hi - p) / d - t0) / dt - 0.5
    first, last = math.ceil(min(max(a, 0.0), float(count))), math.ceil(min(max(b, 0.0), float(count)))
    return (first, last) if d > 0.0 else (last, first)


@_jit
def _lit(own: Quad, light: Light, values: np.ndarray, p: Vector, d: Vector, s: float) -> tuple[float, float, float]:
    """A segment's ``own`` (r, g, b, alpha) shaded at p + s d, seen along d; no colour is above its alpha."""
    factor, white = shading(
        values, light, p[0] + s * d[0], p[1] + s * d[1], p[2] + s * d[2],
        d[0] * light.edge[0], d[1] * light.edge[1], d[2] * light.edge[2],
    )  # fmt: skip
    most = lane(own, 3)
    white *= most
    red, green = min(factor * lane(own, 0) + white, most), min(factor * lane(own, 1) + white, most)
    return red, green, min(factor * lane(own, 2) + white, most)


@_jit
def _classified(
    voxels: Voxels, optics: Optics, empty: np.ndarray, light: Any, p: Vector, d: Vector,
    t0: float, dt: float, first: int, last: int, step: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Premultiplied (r, g, b, alpha) of segments ``first`` to ``last``, the latter not among them.

    ``p`` in voxels of the block; segment i goes from t0 + i dt on. ``light`` (`Light`) or None.
    """
    (px, py, pz), (dx, dy, dz) = p, d
    run, seen, flat = stack_run(), zeros4(), is_flat(optics)
    trans, red, green, blue = 1.0, 0.0, 0.0, 0.0
    opaque = OPAQUE * min(step * step, 1.0)
    ix, iy, iz, per_step = inverse(dx), inverse(dy), inverse(dz), 1.0 / dt
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
                        seen, trans, _ = pass_segment(voxels, optics, p, d, here, dt, u0, u1, met, seen, trans)
                    else:
                        own, trans, s = pass_segment(voxels, optics, p, d, here, dt, u0, u1, met, zeros4(), trans)
                        if lane(own, 3) > 0.0:
                            r, g, b_ = _lit(own, light, voxels.values, p, d, s)
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
def _interpolated(
    texels: Texels, voxels: Any, empty: np.ndarray, light: Any, p: Vector, d: Vector,
    t0: float, dt: float, first: int, last: int, step: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """`_classified` of an optics grid; ``voxels`` hold its extinction where there is a ``light``, else None."""
    (px, py, pz), (dx, dy, dz) = p, d
    nz, ny, nx, _ = texels.values.shape
    seen: Quad = zeros4()
    trans, red, green, blue = 1.0, 0.0, 0.0, 0.0
    opaque = OPAQUE * min(step * step, 1.0)
    ix, iy, iz, per_step = inverse(dx), inverse(dy), inverse(dz), 1.0 / dt
    a, known = zeros4(), False
    i, stop = first, first
    while i <= last and trans >= opaque:
        if i >= stop:
            at = i - 1 if known else i
            start = skip((nz, ny, nx), empty, px, py, pz, dx, dy, dz, ix, iy, iz, t0, dt, per_step, last, at)
            if start >= last:
                break
            if start > at:
                known, i = False, start
            stop = i + LEAP
        t = t0 + i * dt
        b = texel_at(texels.values, px + t * dx, py + t * dy, pz + t * dz)
        if known and lane(a, 3) + lane(b, 3) > 0.0:
            if light is None:
                seen, trans = mixed(a, b, dt, seen, trans)
            else:
                own, trans = mixed(a, b, dt, zeros4(), trans)
                r, g, b_ = _lit(own, light, voxels.values, p, d, t - 0.5 * dt)
                red, green, blue = red + r, green + g, blue + b_
        a, known = b, True
        i += 1
    if light is None:
        red, green, blue = lane(seen, 0), lane(seen, 1), lane(seen, 2)
    return red, green, blue, 1.0 - trans


@inlined(error_model="numpy", **BORROWED)  # as `_owned`
def _ray(
    faces: np.ndarray, p: Vector, basis: np.ndarray, lens: np.ndarray, step: float, column: float, row: float
) -> tuple[Vector, float, float, int, int]:
    """Direction of the ray through a place of the picture, where its segments begin, their length, the first and last.

    The latter two are the block's own, as ``faces`` (3, 3) of `cast_segments` say; none where they are the same.
    """
    nx, ny, nz = int(faces[2, 0]), int(faces[2, 1]), int(faces[2, 2])
    px, py, pz = p
    a, b = (column - lens[2]) * lens[0], (row - lens[3]) * lens[1]
    norm = 1.0 / math.sqrt(a * a + b * b + 1.0)
    dx = (basis[0, 0] * a + basis[1, 0] * b + basis[2, 0]) * norm
    dy = (basis[0, 1] * a + basis[1, 1] * b + basis[2, 1]) * norm
    dz = (basis[0, 2] * a + basis[1, 2] * b + basis[2, 2]) * norm
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


def _pixel_of(cast: Callable[..., tuple[float, float, float, float]]) -> Callable[..., None]:
    """The kernel that fills a pixel's rays by ``cast``, which is given two of voxels, optics and texels."""

    @_jit
    def fill(
        own: Any, other: Any, empty: np.ndarray, light: Any, faces: np.ndarray, begin: np.ndarray, eye: np.ndarray,
        basis: np.ndarray, lens: np.ndarray, step: float, pixel: np.ndarray, offsets: np.ndarray, out: np.ndarray,
    ) -> None:  # fmt: skip
        p = (eye[0], eye[1], eye[2])
        local = (eye[0] - begin[0], eye[1] - begin[1], eye[2] - begin[2])
        for m in range(len(offsets)):
            x, y = pixel[0] + 0.5 + offsets[m, 0], pixel[1] + 0.5 + offsets[m, 1]
            d, t0, dt, first, last = _ray(faces, p, basis, lens, step, x, y)
            if first < last:
                red, green, blue, alpha = cast(own, other, empty, light, local, d, t0, dt, first, last, step)
                out[m, 0], out[m, 1], out[m, 2], out[m, 3] = red, green, blue, alpha

    return fill


_classified_pixel, _interpolated_pixel = _pixel_of(_classified), _pixel_of(_interpolated)
ARGUMENTS = "f8:2 f8:1 f8:1 f8:2 f8:1 f8 i8:2 f8:2 f4:3"


@parallel_kernel(f"Voxels Optics u1:3 {ARGUMENTS}", TUPLES, fastmath=FLAGS, error_model="numpy")
def cast_segments(
    part: Part,
    voxels: Voxels, optics: Optics, empty: np.ndarray, faces: np.ndarray, begin: np.ndarray, eye: np.ndarray,
    basis: np.ndarray, lens: np.ndarray, step: float, pixels: np.ndarray, offsets: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """What a block shows of rays, into ``out`` (n, m, 4) float32 premultiplied; zeros where nothing.

    ``voxels``, ``empty``: of the block with a voxel around it, whose first voxel is ``begin`` (3,) of the whole volume;
    ``faces`` (3, 3): the block's lower and upper faces, infinite where the volume ends, and the volume's voxels, each
    (x, y, z); ``pixels`` (n, 2: column, row), ``offsets`` (m, 2) as `render_tiles` has them, ``step`` at most 1, and
    ``eye``, ``basis``, ``lens`` too, in voxels of the whole volume.
    """
    for n in turns_of(part, len(pixels)):
        _classified_pixel(
            voxels, optics, empty, None, faces, begin, eye, basis, lens, step, pixels[n], offsets, out[n]
        )  # fmt: skip


@parallel_kernel(f"Voxels Optics u1:3 Light {ARGUMENTS}", LIT, fastmath=FLAGS, error_model="numpy")
def cast_lit_segments(
    part: Part, voxels: Voxels, optics: Optics, empty: np.ndarray, light: Light, faces: np.ndarray, begin: np.ndarray,
    eye: np.ndarray, basis: np.ndarray, lens: np.ndarray, step: float, pixels: np.ndarray, offsets: np.ndarray,
    out: np.ndarray,
) -> None:  # fmt: skip
    """`cast_segments` under ``light`` (`Light`) of the block, which has two voxels around it."""
    for n in turns_of(part, len(pixels)):
        _classified_pixel(
            voxels, optics, empty, light, faces, begin, eye, basis, lens, step, pixels[n], offsets, out[n]
        )  # fmt: skip


@parallel_kernel(f"Texels u1:3 {ARGUMENTS}", GRID, fastmath=FLAGS, error_model="numpy")
def cast_grid_segments(
    part: Part, texels: Texels, empty: np.ndarray, faces: np.ndarray, begin: np.ndarray, eye: np.ndarray,
    basis: np.ndarray, lens: np.ndarray, step: float, pixels: np.ndarray, offsets: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """`cast_segments` of an optics grid."""
    for n in turns_of(part, len(pixels)):
        _interpolated_pixel(
            texels, None, empty, None, faces, begin, eye, basis, lens, step, pixels[n], offsets, out[n]
        )  # fmt: skip


@parallel_kernel(f"Texels Voxels u1:3 Light {ARGUMENTS}", LIT_GRID, fastmath=FLAGS, error_model="numpy")
def cast_lit_grid_segments(
    part: Part, texels: Texels, voxels: Voxels, empty: np.ndarray, light: Light, faces: np.ndarray, begin: np.ndarray,
    eye: np.ndarray, basis: np.ndarray, lens: np.ndarray, step: float, pixels: np.ndarray, offsets: np.ndarray,
    out: np.ndarray,
) -> None:  # fmt: skip
    """`cast_lit_segments` of an optics grid: normals are the gradient of the extinction ``voxels``."""
    for n in turns_of(part, len(pixels)):
        _interpolated_pixel(
            texels, voxels, empty, light, faces, begin, eye, basis, lens, step, pixels[n], offsets, out[n]
        )  # fmt: skip
