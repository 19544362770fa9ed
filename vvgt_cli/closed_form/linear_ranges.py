"""Where a function is so straight that its mean over a range of values is its value at their mean."""

from __future__ import annotations

import numpy as np

from vvgt_cli.look.tables import Optics

BEND = 0.03  # of the extinction, by which a straight line may miss it; smooth bends miss their mean by a sixth of that
_last: tuple[np.ndarray, float, np.ndarray] | None = None  # nodes, bend and what came of them: blocks ask again


def linear_ranges(optics: Optics) -> np.ndarray:
    """Return the u (n + 1,) float64 up to which the optics are linear from bin i on.

    Within a window of bins, the slopes of tau and tau * (r, g, b) may differ by 4 `BEND` times the smallest slope of
    tau (all of one sign), or so little that what adds up is within 4 `BEND` of the smallest tau. So a part of a
    straight window is straight.
    """
    global _last
    bend = BEND
    if _last is not None and _last[0] is optics.nodes and _last[1] == bend:
        return _last[2]
    slopes = np.diff(optics.nodes, axis=0)
    count = len(slopes)
    levels = [(slopes.T, slopes.T, np.minimum(optics.nodes[:-1, 3], optics.nodes[1:, 3]))]
    while 2 << len(levels) - 1 <= count:  # of windows twice as long each
        low, high, least = levels[-1]
        half = 1 << len(levels) - 1
        levels.append((
            np.minimum(low[:, :-half], low[:, half:]), np.maximum(high[:, :-half], high[:, half:]),
            np.minimum(least[:-half], least[half:]),
        ))  # fmt: skip
    at = np.arange(count)
    low, high, least = np.full((4, count), np.inf), np.full((4, count), -np.inf), np.full(count, np.inf)
    for k in range(len(levels) - 1, -1, -1):  # the longest window, bit by bit
        wide, length = levels[k], 1 << k
        fits = np.flatnonzero(at + length <= count)
        start = at[fits]
        more = (
            np.minimum(low[:, fits], wide[0][:, start]), np.maximum(high[:, fits], wide[1][:, start]),
            np.minimum(least[fits], wide[2][start]),
        )  # fmt: skip
        rises = np.maximum(np.maximum(more[0][3], -more[1][3]), 0)
        allowed = 4 * bend * np.maximum(rises, more[2] / (start + length - fits)) + 1e-12 * np.abs(slopes).max()
        good = ((more[1] - more[0]) <= allowed).all(axis=0)
        took = fits[good]
        low[:, took], high[:, took], least[took] = more[0][:, good], more[1][:, good], more[2][good]
        at[took] += length
    out = np.append(at, count).astype(np.float64)
    _last = optics.nodes, bend, out
    return out
