"""Parts of rays through a block of a volume, as the ray caster (`kernel`) has them of the whole.

A ray is cut into the same segments whatever the blocks, and a segment is that block's in which its middle lies. What
blocks show of a ray is put together front to back: premultiplied colours compose.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from vvgt_cli.dvr.kernel import FLAGS, OPAQUE, U, box_span, composite, inverse, sample, skip, table_coordinate
from vvgt_cli.dvr.layout import TUPLES, Optics, Voxels
from vvgt_cli.dvr.runs import BORROWED
from vvgt_cli.dvr.vectors import Quad, lane, zeros4
from vvgt_cli.jit.decorators import inlined, kernel

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
def _cast(
    voxels: Voxels, optics: Optics, empty: np.ndarray, p: tuple[float, float, float], d: tuple[float, float, float],
    t0: float, dt: float, first: int, last: int, step: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Premultiplied (r, g, b, alpha) of segments ``first`` to ``last``, the latter not among them.

    ``p`` in voxels of the block; segment i goes from t0 + i dt on.
    """
    (px, py, pz), (dx, dy, dz) = p, d
    seen: Quad = zeros4()
    trans = 1.0
    opaque = OPAQUE * min(step * step, 1.0)
    ix, iy, iz, per_step = inverse(dx), inverse(dy), inverse(dz), 1.0 / dt
    u0, known = -1.0, False
    i, stop = first, first
    while i <= last and trans >= opaque:
        if i >= stop:
            at = i - 1 if known else i  # the segment that comes from there is still to be seen
            start = skip(voxels.values.shape, empty, px, py, pz, dx, dy, dz, ix, iy, iz, t0, dt, per_step, last, at)
            if start >= last:
                break
            if start > at:
                known, i = False, start
            stop = i + LEAP
        t = t0 + i * dt
        u1 = table_coordinate(sample(voxels.values, px + t * dx, py + t * dy, pz + t * dz), optics)
        low = min(u0, u1)
        if known and low >= 0.0 and max(u0, u1) > optics.dark[U(int(low))]:
            seen, trans = composite(u0, u1, dt, optics, seen, trans)
        u0, known = u1, True
        i += 1
    return lane(seen, 0), lane(seen, 1), lane(seen, 2), 1.0 - trans


@kernel("Voxels Optics u1:3 f8:2 f8:1 f8:1 f8:2 f8:1 f8 i8:2 f8:2 f4:3", TUPLES, parallel=True, fastmath=FLAGS,
        error_model="numpy")  # fmt: skip
def cast_segments(
    voxels: Voxels, optics: Optics, empty: np.ndarray, faces: np.ndarray, begin: np.ndarray, eye: np.ndarray,
    basis: np.ndarray, lens: np.ndarray, step: float, pixels: np.ndarray, offsets: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """What a block shows of rays, into ``out`` (n, m, 4) float32 premultiplied; zeros where nothing.

    ``voxels``, ``empty``: of the block with a voxel around it, whose first voxel is ``begin`` (3,) of the whole volume;
    ``faces`` (3, 3): the block's lower and upper faces, infinite where the volume ends, and the volume's voxels, each
    (x, y, z); ``pixels`` (n, 2: column, row), ``offsets`` (m, 2) as `render_tiles` has them, ``step`` at most 1, and
    ``eye``, ``basis``, ``lens`` too, in voxels of the whole volume.
    """
    nx, ny, nz = int(faces[2, 0]), int(faces[2, 1]), int(faces[2, 2])
    px, py, pz = eye[0], eye[1], eye[2]
    local = px - begin[0], py - begin[1], pz - begin[2]
    for n in nb.prange(len(pixels)):
        for ray in range(len(offsets)):
            a = (pixels[n, 0] + 0.5 + offsets[ray, 0] - lens[2]) * lens[0]
            b = (pixels[n, 1] + 0.5 + offsets[ray, 1] - lens[3]) * lens[1]
            norm = 1.0 / math.sqrt(a * a + b * b + 1.0)
            dx = (basis[0, 0] * a + basis[1, 0] * b + basis[2, 0]) * norm
            dy = (basis[0, 1] * a + basis[1, 1] * b + basis[2, 1]) * norm
            dz = (basis[0, 2] * a + basis[1, 2] * b + basis[2, 2]) * norm
            t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
            if not t1 > t0:
                continue
            count = max(math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step), 1)
            dt = (t1 - t0) / count
            first, last = _owned(px, dx, faces[0, 0], faces[1, 0], t0, dt, count)
            low, high = _owned(py, dy, faces[0, 1], faces[1, 1], t0, dt, count)
            first, last = max(first, low), min(last, high)
            low, high = _owned(pz, dz, faces[0, 2], faces[1, 2], t0, dt, count)
            first, last = max(first, low), min(last, high)
            if first >= last:
                continue
            red, green, blue, alpha = _cast(
                voxels, optics, empty, local, (dx, dy, dz), t0, dt, first, last, step
            )  # fmt: skip
            pixel = out[n, ray]
            pixel[0], pixel[1], pixel[2], pixel[3] = red, green, blue, alpha
