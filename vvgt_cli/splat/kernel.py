"""Numba kernels of the splatter's first half: projection and tile lists. Twin: `splat.reference`."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from vvgt_cli.splat.constants import DILATION, MIN_ALPHA, NEAR, TILE


@nb.njit(parallel=True, cache=True)
def project(means, log_scales, quats, logits, rot, trans, lens, flat, depth, extent):
    """EWA projection of every Gaussian.

    ``lens`` (fx, fy, cx, cy, width, height). Fills ``flat`` (K, 6) float32: centre x, y, conic a, b, c, opacity;
    ``depth`` (K,) float32; ``extent`` (K, 4) int32: pixel box x0, y0, x1, y1 (empty where nothing is seen).
    """
    fx, fy, cx, cy, width, height = lens
    for k in nb.prange(means.shape[0]):
        extent[k, 0] = extent[k, 1] = extent[k, 2] = extent[k, 3] = 0
        depth[k] = 0
        m0, m1, m2 = np.float64(means[k, 0]), np.float64(means[k, 1]), np.float64(means[k, 2])
        x = rot[0, 0] * m0 + rot[0, 1] * m1 + rot[0, 2] * m2 + trans[0]
        y = rot[1, 0] * m0 + rot[1, 1] * m1 + rot[1, 2] * m2 + trans[1]
        z = rot[2, 0] * m0 + rot[2, 1] * m1 + rot[2, 2] * m2 + trans[2]
        opacity = 1.0 / (1.0 + math.exp(-np.float64(logits[k])))
        if not z > NEAR or opacity < MIN_ALPHA:
            continue
        w, a, b, c = np.float64(quats[k, 0]), np.float64(quats[k, 1]), np.float64(quats[k, 2]), np.float64(quats[k, 3])
        n = 1.0 / math.sqrt(w * w + a * a + b * b + c * c)
        w, a, b, c = w * n, a * n, b * n, c * n
        inv = 1.0 / z
        jx, jy = fx * inv, fy * inv
        jxz, jyz = -fx * x * inv * inv, -fy * y * inv * inv
        sxx = sxy = syy = 0.0
        for axis in range(3):  # column `axis` of R diag(s), into the camera, then through the Jacobian
            if axis == 0:
                r0, r1, r2 = 1 - 2 * (b * b + c * c), 2 * (a * b + w * c), 2 * (a * c - w * b)
            elif axis == 1:
                r0, r1, r2 = 2 * (a * b - w * c), 1 - 2 * (a * a + c * c), 2 * (b * c + w * a)
            else:
                r0, r1, r2 = 2 * (a * c + w * b), 2 * (b * c - w * a), 1 - 2 * (a * a + b * b)
            s = math.exp(np.float64(log_scales[k, axis]))
            v0 = (rot[0, 0] * r0 + rot[0, 1] * r1 + rot[0, 2] * r2) * s
            v1 = (rot[1, 0] * r0 + rot[1, 1] * r1 + rot[1, 2] * r2) * s
            v2 = (rot[2, 0] * r0 + rot[2, 1] * r1 + rot[2, 2] * r2) * s
            px, py = jx * v0 + jxz * v2, jy * v1 + jyz * v2
            sxx += px * px
            sxy += px * py
            syy += py * py
        sxx += DILATION
        syy += DILATION
        det = sxx * syy - sxy * sxy
        if not (det > 0.0 and det < np.inf):
            continue
        u, v = fx * x * inv + cx, fy * y * inv + cy
        reach = 2.0 * math.log(opacity / MIN_ALPHA)
        ex, ey = math.sqrt(reach * sxx), math.sqrt(reach * syy)
        x0, x1 = max(math.ceil(u - ex - 0.5), 0.0), min(math.floor(u + ex - 0.5) + 1.0, width)
        y0, y1 = max(math.ceil(v - ey - 0.5), 0.0), min(math.floor(v + ey - 0.5) + 1.0, height)
        if not (x1 > x0 and y1 > y0):
            continue
        extent[k, 0], extent[k, 1], extent[k, 2], extent[k, 3] = int(x0), int(y0), int(x1), int(y1)
        flat[k, 0], flat[k, 1] = u, v
        flat[k, 2], flat[k, 3], flat[k, 4] = syy / det, -sxy / det, sxx / det
        flat[k, 5] = opacity
        depth[k] = z


@nb.njit(cache=True)
def tile_lists(order, extent, tiles_x, tiles_y):
    """Gaussians of each tile in the given (depth) order.

    Returns ``start`` (tiles + 1,), ``members`` (pairs,) Gaussian of each entry, ``slots`` (pairs,) place of the
    entry's pair in a list grouped by Gaussian, ``first`` (K + 1,) where each Gaussian's group begins there.
    """
    count = np.zeros(tiles_x * tiles_y + 1, np.int64)
    first = np.zeros(extent.shape[0] + 1, np.int64)
    for k in range(extent.shape[0]):
        pairs = 0
        if extent[k, 2] > extent[k, 0]:
            for ty in range(extent[k, 1] // TILE, (extent[k, 3] - 1) // TILE + 1):
                for tx in range(extent[k, 0] // TILE, (extent[k, 2] - 1) // TILE + 1):
                    count[ty * tiles_x + tx + 1] += 1
                    pairs += 1
        first[k + 1] = first[k] + pairs
    start = np.cumsum(count)
    fill = start[:-1].copy()
    members = np.empty(start[-1], np.int32)
    slots = np.empty(start[-1], np.int64)
    for index in range(order.shape[0]):
        k = order[index]
        slot = first[k]
        if extent[k, 2] <= extent[k, 0]:
            continue
        for ty in range(extent[k, 1] // TILE, (extent[k, 3] - 1) // TILE + 1):
            for tx in range(extent[k, 0] // TILE, (extent[k, 2] - 1) // TILE + 1):
                tile = ty * tiles_x + tx
                members[fill[tile]] = k
                slots[fill[tile]] = slot
                fill[tile] += 1
                slot += 1
    return start, members, slots, first
