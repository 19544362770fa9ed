"""`PiecewiseOpacity`: vtkPiecewiseFunction, vectorised."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from vvgt_cli.look.curve import LINEAR_BELOW, bend, compress, hermite_weight, sorted_nodes, unit_interval


@dataclass(frozen=True)
class PiecewiseOpacity:
    """Opacity over the scalar, as vtkPiecewiseFunction computes it (clamping on, duplicate nodes allowed).

    Nodes are sorted by x on construction. Where several nodes share an x the value *at* it is the last
    one's. Sharpness above 0.99 is not a hard step here: VTK overwrites its own step with the curve.

    Attributes:
        x: (n,) node positions, data values.
        y: (n,) opacity per unit distance, in [0, 1].
        midpoint, sharpness: (n,) in [0, 1], of the segment to the right of each node; default 0.5 and 0.
        log_scale: interpolate in log10(x) (segments that start at x > 0).

    Raises:
        DataError: no nodes, lengths that differ, values not finite or outside [0, 1].
    """

    x: np.ndarray
    y: np.ndarray
    midpoint: np.ndarray = field(default_factory=lambda: np.empty(0))
    sharpness: np.ndarray = field(default_factory=lambda: np.empty(0))
    log_scale: bool = False

    def __post_init__(self) -> None:
        count = np.shape(self.x)[0] if np.ndim(self.x) else 0
        midpoint = self.midpoint if np.size(self.midpoint) else np.full(count, 0.5)
        sharpness = self.sharpness if np.size(self.sharpness) else np.zeros(count)
        names = ("x", "y", "midpoint", "sharpness")
        arrays = sorted_nodes("opacity function", self.x, self.y, midpoint, sharpness)
        for name, values in zip(names, arrays, strict=True):
            if name != "x":
                unit_interval("opacity function", "opacity" if name == "y" else name, values)
            object.__setattr__(self, name, values)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Opacity at x of any shape, float64; 0 at NaN."""
        x = np.asarray(x, dtype=np.float64)
        if self.x.size == 1:
            return np.where(np.isnan(x), 0.0, self.y[0])
        right = np.searchsorted(self.x, x, side="right")
        left = np.clip(right - 1, 0, self.x.size - 2)
        y1, y2, h = self.y[left], self.y[left + 1], self.sharpness[left]
        w = bend(self._position(x, left), self.midpoint[left])
        curved = h >= LINEAR_BELOW
        if curved.any():
            w = np.where(curved, hermite_weight(compress(w, h), h), w)
        value = np.clip((1 - w) * y1 + w * y2, np.minimum(y1, y2), np.maximum(y1, y2))
        value = np.where(right >= self.x.size, self.y[-1], np.where(right == 0, self.y[0], value))
        return np.where(np.isnan(x), 0.0, value)

    def _position(self, x: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Position in [0, 1] of x in the segment that starts at node ``left``."""
        x1, x2 = self.x[left], self.x[left + 1]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            s = (x - x1) / (x2 - x1)
            if self.log_scale:
                logged = (np.log10(x) - np.log10(x1)) / (np.log10(x2) - np.log10(x1))
                s = np.where(x1 > 0, logged, s)
        result: np.ndarray = np.clip(np.nan_to_num(s, nan=0.0), 0.0, 1.0)
        return result

    def moved(self, x: np.ndarray) -> PiecewiseOpacity:
        """The same values at other (n,) node positions, given in the order of ``self.x``."""
        return replace(self, x=x)

    def support(self, lo: float, hi: float) -> list[tuple[float, float]]:
        """Intervals of [lo, hi] where the opacity is above 0, ascending and disjoint.

        A segment counts as a whole when either of its ends is above 0. ``lo == hi`` gives one empty
        interval at that value when it is visible.
        """
        if lo == hi:
            return [(lo, hi)] if self(np.array([lo]))[0] > 0 else []
        ends = np.concatenate([[-np.inf], self.x, [np.inf]])
        y = np.concatenate([self.y[:1], self.y, self.y[-1:]])
        intervals: list[tuple[float, float]] = []
        for a, b, ya, yb in zip(ends[:-1], ends[1:], y[:-1], y[1:], strict=True):
            a, b = max(float(a), lo), min(float(b), hi)
            if a >= b or max(ya, yb) <= 0:
                continue
            if intervals and intervals[-1][1] == a:
                intervals[-1] = (intervals[-1][0], b)
            else:
                intervals.append((a, b))
        return intervals
