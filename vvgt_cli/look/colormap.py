"""`ColorMap`: vtkColorTransferFunction, vectorised."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.look import colorspace
from vvgt_cli.look.ciede2000 import along_path
from vvgt_cli.look.curve import (
    LINEAR_BELOW,
    STEP_ABOVE,
    bend,
    compress,
    hermite_weight,
    sorted_nodes,
    unit_interval,
)
from vvgt_cli.volume.types import triple

Space = Callable[[np.ndarray], np.ndarray]


def _same(rgb: np.ndarray) -> np.ndarray:
    return rgb


LINEAR_SPACES: dict[str, tuple[Space, Space]] = {  # spaces in which a segment is a straight line
    "RGB": (_same, _same),
    "HSV": (colorspace.rgb_to_hsv, colorspace.hsv_to_rgb),
    "Lab": (colorspace.rgb_to_lab, colorspace.lab_to_rgb),
    "Prolab": (colorspace.rgb_to_prolab, colorspace.prolab_to_rgb),
}
SPACES = (*LINEAR_SPACES, "Diverging", "Lab/CIEDE2000", "Step")
WHITE_LIGHTNESS = 88.0  # Moreland: lightness of the white between two saturated colours, at least
UNSATURATED = 0.05  # Msh saturation below which a hue means nothing


@dataclass(frozen=True)
class ColorMap:
    """Colour over the scalar, as vtkColorTransferFunction computes it (clamping on, duplicate nodes allowed).

    Nodes are sorted by x on construction. Where several nodes share an x the colour *at* it is the
    first one's. At sharpness > 0.99 the colour steps at the midpoint.

    Attributes:
        x: (n,) node positions, data values.
        rgb: (n, 3) in [0, 1].
        midpoint, sharpness: (n,) in [0, 1], of the segment to the right of each node; default 0.5 and 0.
        space: one of ``SPACES`` (ParaView's ColorSpace).
        hsv_wrap: in HSV go the short way round the hue circle.
        log_scale: interpolate in log10(x); without effect unless all nodes are above 0.
        nan_color: (3,) colour of NaN.

    Raises:
        DataError: no nodes, lengths that differ, values not finite or outside [0, 1], unknown space.
    """

    x: np.ndarray
    rgb: np.ndarray
    midpoint: np.ndarray = field(default_factory=lambda: np.empty(0))
    sharpness: np.ndarray = field(default_factory=lambda: np.empty(0))
    space: str = "RGB"
    hsv_wrap: bool = True
    log_scale: bool = False
    nan_color: tuple[float, float, float] = (0.5, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.space not in SPACES:
            raise DataError(f"colour function: colour space {self.space!r}; expected one of {', '.join(SPACES)}")
        count = np.shape(self.x)[0] if np.ndim(self.x) else 0
        if np.shape(self.rgb) != (count, 3):
            raise DataError(f"colour function: {count} nodes, colours of shape {np.shape(self.rgb)}; expected (n, 3)")
        midpoint = self.midpoint if np.size(self.midpoint) else np.full(count, 0.5)
        sharpness = self.sharpness if np.size(self.sharpness) else np.zeros(count)
        arrays = sorted_nodes("colour function", self.x, self.rgb, midpoint, sharpness)
        for name, values in zip(("x", "rgb", "midpoint", "sharpness"), arrays, strict=True):
            if name != "x":
                unit_interval("colour function", "colour" if name == "rgb" else name, values)
            object.__setattr__(self, name, values)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """RGB at data values x (n,), float64 -> (n, 3)."""
        x = np.asarray(x, dtype=np.float64)
        out = np.empty((*x.shape, 3))
        missing, under, over = np.isnan(x), x < self.x[0], x > self.x[-1]
        inside = ~(missing | under | over)
        out[missing] = self.nan_color
        out[under] = self.rgb[0]
        out[over] = self.rgb[-1]
        if inside.any():
            out[inside] = self._inside(x[inside])
        return out

    def moved(self, x: np.ndarray) -> ColorMap:
        """The same colours at other (n,) node positions, given in the order of ``self.x``."""
        return replace(self, x=x)

    def _inside(self, x: np.ndarray) -> np.ndarray:
        """Colours at x (n,) between the first and the last node -> (n, 3)."""
        right = np.searchsorted(self.x, x, side="left")
        out = np.repeat(self.rgb[:1], x.size, axis=0)
        between = right > 0
        if not between.any():
            return out
        left = right[between] - 1
        h = self.sharpness[left]
        s = bend(self._position(x[between], left), self.midpoint[left])
        curved = h >= LINEAR_BELOW
        step = h > STEP_ABOVE
        s_curved = compress(s, h)
        # Diverging takes the compressed position itself: VTK has no Hermite curve in Msh
        w = s_curved if self.space == "Diverging" else hermite_weight(s_curved, h)
        rgb = self._interpolate(left, np.where(curved, w, s))
        stepped = self.rgb[left + (s >= 0.5)]
        out[between] = np.where(step[:, None], stepped, np.where(curved[:, None], np.clip(rgb, 0, 1), rgb))
        return out

    def _position(self, x: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Position in [0, 1] of x in the segment that starts at node ``left``."""
        x1, x2 = self.x[left], self.x[left + 1]
        if self.log_scale and self.x[0] > 0:
            x, x1, x2 = np.log10(x), np.log10(x1), np.log10(x2)
        result: np.ndarray = (x - x1) / (x2 - x1)
        return result

    def _interpolate(self, left: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Colour at weight w (n,) of the right node in the segments ``left`` (n,) -> (n, 3)."""
        if self.space == "Step":
            result: np.ndarray = self.rgb[left + 1]
            return result
        if self.space == "Diverging":
            return _diverging(self.rgb[left], self.rgb[left + 1], w)
        if self.space == "Lab/CIEDE2000":
            out = np.empty((w.size, 3))
            for segment in np.unique(left):
                here = left == segment
                start, end = (triple(map(float, rgb)) for rgb in self.rgb[segment : segment + 2])
                out[here] = along_path(start, end, w[here])
            return out
        forward, backward = LINEAR_SPACES[self.space]
        nodes = forward(self.rgb)
        first, second = nodes[left], nodes[left + 1]
        if self.space == "HSV" and self.hsv_wrap:
            first, second = _short_way(first, second)
        mixed = (1 - w)[:, None] * first + w[:, None] * second
        if self.space == "HSV":
            mixed[:, 0] += mixed[:, 0] < 0
        return backward(mixed)


def _short_way(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower the larger of two hues that differ by more than half a turn by one turn; HSV (n, 3) each."""
    first, second = first.copy(), second.copy()
    difference = first[:, 0] - second[:, 0]
    first[:, 0] -= difference > 0.5
    second[:, 0] -= difference < -0.5
    return first, second


def _adjusted_hue(saturated: np.ndarray, other_m: np.ndarray) -> np.ndarray:
    """Hue for an unsaturated end of magnitude ``other_m`` (n,), from the saturated end's Msh (n, 3)."""
    m, s, h = saturated.T
    with np.errstate(divide="ignore", invalid="ignore"):
        spin = s * np.sqrt(np.maximum(other_m**2 - m**2, 0)) / (m * np.sin(s))
    spun = np.where(h > -0.3 * np.pi, h + spin, h - spin)
    result: np.ndarray = np.where(m >= other_m - 0.1, h, spun)
    return result


def _angle(turn: np.ndarray) -> np.ndarray:
    """Smaller angle in [0, pi] that a turn of any size amounts to."""
    turn = np.abs(turn) % (2 * np.pi)
    return np.where(turn > np.pi, 2 * np.pi - turn, turn)


def _diverging(rgb1: np.ndarray, rgb2: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Moreland's diverging map between colours (n, 3) at s (n,) in [0, 1] -> RGB (n, 3)."""
    msh1 = colorspace.lab_to_msh(colorspace.rgb_to_lab(rgb1))
    msh2 = colorspace.lab_to_msh(colorspace.rgb_to_lab(rgb2))
    far = _angle(msh1[:, 2] - msh2[:, 2]) > 0.33 * np.pi
    saturated = (msh1[:, 1] > UNSATURATED) & (msh2[:, 1] > UNSATURATED) & far
    white = np.zeros_like(msh1)
    white[:, 0] = np.maximum(np.maximum(msh1[:, 0], msh2[:, 0]), WHITE_LIGHTNESS)
    low = s < 0.5
    msh1 = np.where((saturated & ~low)[:, None], white, msh1)
    msh2 = np.where((saturated & low)[:, None], white, msh2)
    s = np.where(saturated, np.where(low, 2 * s, 2 * s - 1), s)
    grey1 = (msh1[:, 1] < UNSATURATED) & (msh2[:, 1] > UNSATURATED)
    grey2 = (msh2[:, 1] < UNSATURATED) & (msh1[:, 1] > UNSATURATED)
    hue1 = np.where(grey1, _adjusted_hue(msh2, msh1[:, 0]), msh1[:, 2])
    hue2 = np.where(grey2, _adjusted_hue(msh1, msh2[:, 0]), msh2[:, 2])
    turn = hue2 - hue1
    # VTK 9.7 goes the short way round after a turn below -pi; one above pi becomes its angle, which misses hue2
    shorter = np.where(turn > 0, _angle(turn), turn - 2 * np.pi * np.round(turn / (2 * np.pi)))
    msh1[:, 2], msh2[:, 2] = hue1, hue1 + np.where(np.abs(turn) > np.pi, shorter, turn)
    mixed = (1 - s)[:, None] * msh1 + s[:, None] * msh2
    return colorspace.lab_to_rgb(colorspace.msh_to_lab(mixed))
