"""The float64 twin of the path tracer: one path after another scattering, all paths at once, by other estimators.

Tracking through one largest extinction, the sky found by scattered rays alone, optics straight from the function.
"""

import numpy as np

from vvgt_cli.dvr.reference import normals, optics_at

GAMMA = 2.2


def inside(scene, at):
    return ((at > -0.5) & (at < np.array(scene.volume.dims) - 0.5)).all(axis=1)


def scattered(scene, at, along, top, rng):
    """Move places (n, 3), voxels, along unit vectors to where they scatter next; NaN where they leave."""
    at, moving = at.copy(), np.arange(len(at))
    while len(moving):
        at[moving] += along[moving] / scene.step * rng.exponential(1 / top, len(moving))[:, None]
        stays = inside(scene, at[moving])
        at[moving[~stays]] = np.nan
        moving = moving[stays]
        moving = moving[rng.random(len(moving)) * top >= optics_at(scene, at[moving])[0]]
    return at


def surface(scene, at):
    """Outward unit vectors (n, 3) and the share (n,) of the surface's response."""
    normal, h = normals(scene, at), scene.step.mean()
    before, after = (np.exp(-h * optics_at(scene, at + s * normal * h / scene.step)[0]) for s in (-1, 1))
    return np.where((after < before)[:, None], -normal, normal), np.abs(after - before)


def around(axis, cosine, rng):
    """Unit vectors at angles of ``cosine`` (n,) to unit vectors (n, 3)."""
    other = rng.normal(size=axis.shape)
    other -= (other * axis).sum(axis=1, keepdims=True) * axis
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    return cosine[:, None] * axis + np.sqrt(1 - cosine**2)[:, None] * other


def cosines(g, r):
    if g == 0:
        return 1 - 2 * r
    return (1 + g * g - ((1 - g * g) / (1 - g + 2 * g * r)) ** 2) / (2 * g)


def arriving(scene, light, points, rng, bounces=64, g=0.0):
    """Light (n, 3) that a path brings to each of points (n, 6); ``light``: radiance (n, 3) from unit vectors."""
    top = scene.optics.largest_extinction()
    at, along, weight = points[:, :3].copy(), points[:, 3:].copy(), np.ones((len(points), 3))
    out, alive = np.zeros((len(points), 3)), np.arange(len(points))
    for _ in range(bounces):
        normal, share = surface(scene, at[alive])
        matt = rng.random(len(alive)) < share
        lobe = around(np.where(matt[:, None], normal, 1), np.sqrt(rng.random(len(alive))), rng)
        phase = around(along[alive], cosines(g, rng.random(len(alive))), rng)
        along[alive] = np.where(matt[:, None], lobe, phase)
        at[alive] = scattered(scene, at[alive], along[alive], top, rng)
        gone = alive[~np.isfinite(at[alive, 0])]
        out[gone] = weight[gone] * light(along[gone])
        alive = np.setdiff1d(alive, gone)
        weight[alive] *= optics_at(scene, at[alive])[1] ** GAMMA
    return out


def path_view(matter, sky, half, camera, samples, seed=0):
    """One view (height, width, 4), premultiplied RGBA, path-traced from the eye with the package's kernels.

    ``matter`` in the scene's own voxels, ``half`` (3,) of `Scene`; ``samples`` paths a pixel, at random places of it.
    """
    pixels, rng = camera.height * camera.width, np.random.default_rng(seed)
    y, x = np.divmod(np.arange(pixels), camera.width)
    color, hits = np.zeros((3, pixels)), np.zeros(pixels)
    together = max((1 << 18) // pixels, 1)
    for begin in range(0, samples, together):
        count = min(together, samples - begin)
        place = np.stack([x, y, np.ones(pixels)], axis=1)[None] + rng.random((count, pixels, 3)) * [1, 1, 0]
        local = (place - [camera.cx, camera.cy, 0]) / [camera.fx, camera.fy, 1]
        along = (local / np.linalg.norm(local, axis=2, keepdims=True)).reshape(-1, 3) @ camera.rotation
        eye = np.broadcast_to((camera.position + half) / matter.step - 0.5, along.shape)
        found = matter.scattered(np.concatenate([eye, along], axis=1), seed + 2 * begin)
        one = np.ones(len(found), np.int64)
        light = matter.gathered(sky, seed + 2 * begin + 1, found[:, :6], 0 * one, one)
        pixel = found[:, 6].astype(np.int64) % pixels
        hits += np.bincount(pixel, minlength=pixels)
        for c in range(3):
            color[c] += np.bincount(pixel, light[:, c] * light[:, 4 + c], pixels)
    shown = np.minimum((color / np.maximum(hits, 1)) ** (1 / GAMMA), 1) * hits / samples
    return np.concatenate([shown, hits[None] / samples]).T.reshape(camera.height, camera.width, 4)
