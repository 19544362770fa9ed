"""Numba kernels of the splatter: projection, tile lists, blending, back-projection. Twin: `splat.reference`."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from vvgt_cli.splat.constants import DILATION, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR, TILE

f32 = np.float32
_A, _MIN_A, _MIN_T = f32(MAX_ALPHA), f32(MIN_ALPHA), f32(MIN_TRANSMITTANCE)
_E = tuple(f32(c) for c in (1.0, 1.0, 0.5, 1 / 6, 1 / 24, 1 / 120, 1 / 720))


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


@nb.njit(cache=True, fastmath=True)
def _row_span(u, v, a, b, c, opacity, y, x0, x1):
    """Columns [first, last) of pixel row y (centre y + 0.5) inside the 1/255 ellipse, within [x0, x1)."""
    dy = y + f32(0.5) - v
    reach = f32(2.0) * math.log(opacity / _MIN_A)
    inside = (b * b - a * c) * dy * dy + a * reach
    if inside < f32(0.0):
        return 0, 0
    half, mid = math.sqrt(inside) / a, u - b * dy / a
    return max(x0, int(math.floor(mid - half - f32(0.5)))), min(x1, int(math.ceil(mid + half + f32(0.5))))


@nb.njit(cache=True, fastmath=True, inline="always")
def _alpha(u, v, a, b, c, opacity, x, y):
    """min(0.99, o exp(-q/2)), 0 below 1/255; exp by a polynomial of x/8 (error below 4e-7) so that it vectorises."""
    dx, dy = x + f32(0.5) - u, y + f32(0.5) - v
    e = (f32(0.5) * (a * dx * dx + c * dy * dy) + b * dx * dy) * f32(-0.125)
    p = _E[0] + e * (_E[1] + e * (_E[2] + e * (_E[3] + e * (_E[4] + e * (_E[5] + e * _E[6])))))
    p *= p
    p *= p
    alpha = min(_A, opacity * p * p)
    return alpha if (alpha >= _MIN_A and e > f32(-0.75)) else f32(0.0)


@nb.njit(parallel=True, cache=True, fastmath=True)
def blend(start, members, extent, flat, colors, tiles_x, image):
    """Front-to-back blending of every tile into ``image`` (height, width, 4) float32; linear in ``colors`` (K, 3)."""
    height, width = image.shape[:2]
    for tile in nb.prange(start.shape[0] - 1):
        ox, oy = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        buf = np.zeros((4, TILE, TILE), np.float32)  # r, g, b, transmittance
        live = np.ones((TILE, TILE), np.float32)
        buf[3] = 1.0
        for entry in range(start[tile], start[tile + 1]):
            k = members[entry]
            u, v, a, b, c, opacity = flat[k, 0] - ox, flat[k, 1] - oy, flat[k, 2], flat[k, 3], flat[k, 4], flat[k, 5]
            red, green, blue = colors[k, 0], colors[k, 1], colors[k, 2]
            left, right = max(extent[k, 0] - ox, 0), min(extent[k, 2] - ox, TILE)
            for y in range(max(extent[k, 1] - oy, 0), min(extent[k, 3] - oy, TILE)):
                x0, x1 = _row_span(u, v, a, b, c, opacity, f32(y), left, right)
                for x in range(x0, x1):
                    alpha = _alpha(u, v, a, b, c, opacity, f32(x), f32(y))
                    t = buf[3, y, x]
                    after = t * (f32(1.0) - alpha)
                    on = f32(0.0) if after < _MIN_T and alpha > f32(0.0) else live[y, x]
                    live[y, x] = on
                    weight = alpha * t * on
                    buf[0, y, x] += weight * red
                    buf[1, y, x] += weight * green
                    buf[2, y, x] += weight * blue
                    buf[3, y, x] = t - weight
            if (entry & 31) == 31 and live.max() == f32(0.0):
                break
        for y in range(min(TILE, height - oy)):
            for x in range(min(TILE, width - ox)):
                image[oy + y, ox + x, 0] = buf[0, y, x]
                image[oy + y, ox + x, 1] = buf[1, y, x]
                image[oy + y, ox + x, 2] = buf[2, y, x]
                image[oy + y, ox + x, 3] = f32(1.0) - buf[3, y, x]


@nb.njit(parallel=True, cache=True, fastmath=True)
def gather(start, members, slots, extent, flat, tiles_x, fields, pairs):
    """For each (tile, Gaussian) pair: sums over its pixels of w and of w x 4 ``fields`` (4, height, width), w = T alpha.

    ``pairs`` (n, 5) float32 must be zero on entry; entries a closed pixel never reaches stay zero.
    """
    height, width = fields.shape[1:]
    for tile in nb.prange(start.shape[0] - 1):
        ox, oy = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        trans = np.ones((TILE, TILE), np.float32)
        live = np.ones((TILE, TILE), np.float32)
        local = np.zeros((4, TILE, TILE), np.float32)
        for f in range(4):
            for y in range(min(TILE, height - oy)):
                for x in range(min(TILE, width - ox)):
                    local[f, y, x] = fields[f, oy + y, ox + x]
        for entry in range(start[tile], start[tile + 1]):
            k = members[entry]
            u, v, a, b, c, opacity = flat[k, 0] - ox, flat[k, 1] - oy, flat[k, 2], flat[k, 3], flat[k, 4], flat[k, 5]
            s0 = s1 = s2 = s3 = s4 = f32(0.0)
            left, right = max(extent[k, 0] - ox, 0), min(extent[k, 2] - ox, TILE)
            for y in range(max(extent[k, 1] - oy, 0), min(extent[k, 3] - oy, TILE)):
                x0, x1 = _row_span(u, v, a, b, c, opacity, f32(y), left, right)
                for x in range(x0, x1):
                    alpha = _alpha(u, v, a, b, c, opacity, f32(x), f32(y))
                    t = trans[y, x]
                    after = t * (f32(1.0) - alpha)
                    on = f32(0.0) if after < _MIN_T and alpha > f32(0.0) else live[y, x]
                    live[y, x] = on
                    weight = alpha * t * on
                    trans[y, x] = t - weight
                    s0 += weight
                    s1 += weight * local[0, y, x]
                    s2 += weight * local[1, y, x]
                    s3 += weight * local[2, y, x]
                    s4 += weight * local[3, y, x]
            slot = slots[entry]
            pairs[slot, 0], pairs[slot, 1], pairs[slot, 2], pairs[slot, 3], pairs[slot, 4] = s0, s1, s2, s3, s4
            if (entry & 31) == 31 and live.max() == f32(0.0):
                break


@nb.njit(parallel=True, cache=True)
def reduce_pairs(first, pairs, out):
    """Add each Gaussian's pairs, in a fixed order: out (K, 5) float64 += sums."""
    for k in nb.prange(first.shape[0] - 1):
        for p in range(first[k], first[k + 1]):
            for c in range(5):
                out[k, c] += pairs[p, c]
