"""Colours of closed-form Gaussians against what pictures make of them: blur, and what shines through from behind.

A cell's colour is the mean of what is in it, but Gaussians overlap, so that a picture shows each mixed with its
neighbours. ``c + a (c - B c)``, B the mean over neighbours by how much they overlap, is a step of van Cittert's
iteration (Z. Physik 68, 1931) towards the colours that show the cells' own once they are mixed. Cells that are seen
much less than their neighbours, behind something opaque, ought not to be seen at all: as far as Gaussians leave gaps
before them, they do least harm in the colour of what is in front.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vvgt_cli.closed_form.moments import morton
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations

AMOUNT = np.float32(0.45)  # more makes the lattice of cells visible (docs/log/closed-form.md)
CURVES = 4  # Z-orders, each shifted against the one before by a fifth of the box: who is near is near along one of them
WINDOW = 6  # places along a curve, each way, in which neighbours are looked for
BITS = 20  # of a curve, an axis
TINY = 1e-300  # of what is divided by
DARKEST, BRIGHTEST = 0.0, 1.0  # as those of the function: what is stored in 8 bits holds no more


@parallel_kernel("i4:2 i4:2 f4:2 f8:1 f8:1 f8:1 f4:2 f4:2 f4:2 f8:1")
def mix_neighbours(
    thread: ThreadSlice,
    orders: np.ndarray, places: np.ndarray, means: np.ndarray, widths: np.ndarray, areas: np.ndarray, seen: np.ndarray,
    values: np.ndarray, mixed: np.ndarray, front: np.ndarray, around: np.ndarray,
) -> None:  # fmt: skip
    """Average the ``values`` (n, m) of each Gaussian and of those `WINDOW` near along any curve.

    They count by ``areas`` (n,) times ``exp(-d^2 / (2 (w_i^2 + w_k^2)))`` with ``widths`` w (n,) and distances d of
    ``means`` (n, 3): ``mixed`` (n, m), and ``around`` (n,) of what is ``seen`` (n,); times what is seen of them:
    ``front`` (n, m). ``orders`` (c, n) are the Gaussians along each curve, ``places`` (c, n) where each is.
    """
    several, n = orders.shape
    count = values.shape[1]
    for i in iterations(thread, n):
        total = max(areas[i], TINY)
        open_ = total * seen[i]
        sums, ahead = np.empty(count), np.empty(count)
        for m in range(count):
            sums[m], ahead[m] = total * values[i, m], open_ * values[i, m]
        for c in range(several):
            here = places[c, i]
            for place in range(max(here - WINDOW, 0), min(here + WINDOW + 1, n)):
                k = orders[c, place]
                known = place == here
                for other in range(c):  # counted along a curve before
                    known = known or abs(places[other, k] - places[other, i]) <= WINDOW
                if known:
                    continue
                x = np.float64(means[k, 0]) - means[i, 0]
                y = np.float64(means[k, 1]) - means[i, 1]
                z = np.float64(means[k, 2]) - means[i, 2]
                spread = max(widths[i] ** 2 + widths[k] ** 2, TINY)
                weight = areas[k] * np.exp(-0.5 * (x * x + y * y + z * z) / spread)
                total += weight
                open_ += weight * seen[k]
                for m in range(count):
                    sums[m] += weight * values[k, m]
                    ahead[m] += weight * seen[k] * values[k, m]
        around[i] = open_ / total
        for m in range(count):
            mixed[i, m] = sums[m] / total
            front[i, m] = ahead[m] / open_ if open_ > TINY else values[i, m]


def sharpened(gaussians: Gaussians, seen: np.ndarray, half: np.ndarray) -> Gaussians:
    """Return Gaussians with colours corrected so that, drawn over each other, they look like their cells.

    Harmonics are corrected too.

    Args:
        gaussians: of the closed form, box frame, their colours those of their cells.
        seen: (n,) mean transmittance from the cameras to each.
        half: (3,) half extents of the box.

    Returns:
        The same number in the same order; colours of degree 0 between `DARKEST` and `BRIGHTEST`, or what they were, if
        more.
    """
    if len(gaussians) < 2:
        return gaussians
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    widths = scales.mean(axis=1)
    areas = widths**2 * np.exp(-np.logaddexp(0, -gaussians.opacity_logits.astype(np.float64)))
    parts = [gaussians.colors] if gaussians.harmonics is None else [gaussians.colors, gaussians.harmonics]
    values = np.ascontiguousarray(np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1), np.float32)
    means, seen = np.ascontiguousarray(gaussians.means, np.float32), np.ascontiguousarray(seen, np.float64)
    mixed, front, around = np.empty_like(values), np.empty_like(values), np.empty(len(means))
    mix_neighbours(*curves(means, half), means, widths, areas, seen, values, mixed, front, around)
    hidden = np.clip(1 - seen / np.maximum(around, TINY), 0, 1).astype(np.float32)[:, None]
    sharp = values + (1 - hidden) * AMOUNT * (values - mixed) + hidden * (front - values)
    colors = np.clip(sharp[:, :3], DARKEST, np.maximum(BRIGHTEST, gaussians.colors))
    if gaussians.harmonics is None:
        return replace(gaussians, colors=colors)
    return replace(gaussians, colors=colors, harmonics=sharp[:, 3:].reshape(gaussians.harmonics.shape))


def curves(means: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Gaussians at ``means`` (n, 3) along `CURVES` Z-orders (c, n) int32, and their places there (c, n) int32.

    The orders are of the box of half extents ``half`` (3,): some of the Gaussians lie in them as they do among all.
    """
    within = np.clip(0.5 + means / (2 * float(np.max(half))), 0, 1)
    orders = np.empty((CURVES, len(means)), np.int32)
    places = np.empty_like(orders)
    for c in range(CURVES):
        cells = ((within + c / (CURVES + 1)) * (0.5 * (2**BITS - 1))).astype(np.int32)
        orders[c] = np.argsort(morton(cells), kind="stable")
        places[c, orders[c]] = np.arange(len(means), dtype=np.int32)
    return orders, places
