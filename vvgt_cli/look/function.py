"""Transfer functions: `TransferFunction`, made of a `PiecewiseOpacity` and a `ColorMap`, both evaluated by VTK."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.volume.types import triple

DOMAINS = {  # of nodes: words of an axis, and, where the data decide their values, of messages
    "data": ("data value", ""),
    "fraction": ("fraction of the data range", ""),
    "percentile": ("fraction of the voxels", "percentiles"),
    "foreground": ("fraction of the voxels in front of the background", "percentiles of the foreground"),
    "sigma": ("standard deviations above the mean", "standard deviations"),
    "mean": ("multiples of the foreground's mean", "multiples of the mean"),
    "level": ("level", "levels"),
}
BY = {domain: words for domain, (_, words) in DOMAINS.items() if words}
PER_VOXEL = "mean-spacing"  # as --opacity-unit-distance calls it
SPACES = ("RGB", "HSV", "Lab", "Prolab", "Diverging", "Lab/CIEDE2000", "Step")  # ParaView's ColorSpace
PATH_SAMPLES = 1025  # colours, of 8 bits a channel, by which a CIEDE2000 path between two nodes is kept


class Named(Protocol):
    """Anything that gives a scene its colours."""

    @property
    def name(self) -> str:
        """Return the name that reports use."""
        ...


@dataclass(frozen=True)
class PiecewiseOpacity:
    """Opacity over the scalar: a vtkPiecewiseFunction with clamping, which may have several nodes at one position.

    Nodes are sorted by x on construction. The value at an x that several nodes share is the last one's.

    Attributes:
        x: (n,) node positions, data values.
        y: (n,) opacity per unit distance, in [0, 1].
        midpoint, sharpness: (n,) in [0, 1], of the segment to the right of each node; default 0.5 and 0.

    Raises:
        DataError: no nodes, lengths that differ, values not finite or outside [0, 1].
    """

    x: np.ndarray
    y: np.ndarray
    midpoint: np.ndarray = field(default_factory=lambda: np.empty(0))
    sharpness: np.ndarray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        """Check and sort the nodes."""
        _check_nodes(self, "opacity function", "y", "opacity")

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the opacity at x of any shape, float64; 0 at NaN."""
        from vtkmodules.vtkCommonDataModel import vtkPiecewiseFunction

        function = vtkPiecewiseFunction()
        function.AllowDuplicateScalarsOn()
        for node in np.column_stack([self.x, self.y, self.midpoint, self.sharpness]).tolist():
            function.AddPoint(*node)
        return np.where(np.isnan(x), 0.0, _each(function.GetValue, x, np.float64))

    def support(self, lo: float, hi: float) -> list[tuple[float, float]]:
        """Return the intervals of [lo, hi] where the opacity is above 0, ascending and disjoint.

        A segment counts as a whole when either of its ends is above 0. ``lo == hi`` gives one empty
        interval at that value when it is visible.
        """
        if lo == hi:
            return [(lo, hi)] if self(np.array([lo]))[0] > 0 else []
        ends = np.concatenate([[-np.inf], self.x, [np.inf]])
        y = np.concatenate([self.y[:1], self.y, self.y[-1:]])
        intervals: list[tuple[float, float]] = []
        for (a, b), highest in zip(pairwise(ends.clip(lo, hi).tolist()), np.maximum(y[:-1], y[1:]), strict=True):
            if a == b or highest <= 0:
                continue
            if intervals and intervals[-1][1] == a:
                intervals[-1] = (intervals[-1][0], b)
            else:
                intervals.append((a, b))
        return intervals


@dataclass(frozen=True)
class ColorMap:
    """Colour over the scalar: a vtkColorTransferFunction with clamping, which may have several nodes at one position.

    Nodes are sorted by x on construction. The colour at an x that several nodes share is the first one's.

    Attributes:
        x: (n,) node positions, data values.
        rgb: (n, 3) in [0, 1].
        midpoint, sharpness: (n,) in [0, 1], of the segment to the right of each node; default 0.5 and 0.
        space: one of `SPACES` (ParaView's ColorSpace).
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
        """Check and sort the nodes."""
        if self.space not in SPACES:
            raise DataError(f"colour function: colour space {self.space!r}; expected one of {', '.join(SPACES)}")
        count = np.shape(self.x)[0] if np.ndim(self.x) else 0
        if np.shape(self.rgb) != (count, 3):
            raise DataError(f"colour function: {count} nodes, colours of shape {np.shape(self.rgb)}; expected (n, 3)")
        _check_nodes(self, "colour function", "rgb", "colour")

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return RGB at data values x of any shape, float64, one axis of 3 behind it; ``nan_color`` at NaN."""
        nodes = self.x
        if self.log_scale and nodes[0] > 0:  # VTK's own logarithmic scale rounds x, which may cross a node
            x, nodes = np.log10(np.clip(x, nodes[0], nodes[-1])), np.log10(nodes)
        if self.space == "Lab/CIEDE2000" and nodes.size > 1:
            return self._along_paths(np.asarray(x), nodes)
        function = _vtk_colors(self.space, self.hsv_wrap, nodes, self.rgb, self.midpoint, self.sharpness)
        function.SetNanColor(*self.nan_color)
        return _each(function.GetColor, x, np.dtype((np.float64, 3)))

    def _along_paths(self, x: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return RGB at x between nodes (n,), interpolated between the samples of `_ciede2000_path`."""
        bends = zip(self.midpoint.tolist(), self.sharpness.tolist(), strict=True)
        pairs = pairwise(triple(map(float, rgb)) for rgb in self.rgb)
        colors = np.concatenate([_ciede2000_path(a, b, *bend) for (a, b), bend in zip(pairs, bends, strict=False)])
        places = np.concatenate([np.linspace(a, b, PATH_SAMPLES) for a, b in pairwise(nodes)])
        # from right to left: of samples at one position `interp` takes the last
        along = np.stack([np.interp(-x, -places[::-1], channel[::-1]) for channel in colors.T], axis=-1)
        ends = ((x <= nodes[0], self.rgb[0]), (x > nodes[-1], self.rgb[-1]), (np.isnan(x), self.nan_color))
        for there, color in ends:
            along[there] = color
        return along


def _check_nodes(nodes: PiecewiseOpacity | ColorMap, what: str, column: str, called: str) -> None:
    """Check the arrays of a function and sort them as VTK does (equal positions keep their order), float64.

    Empty midpoints and sharpness become 0.5 and 0; ``column`` is the attribute with the values, ``called`` so in
    messages.

    Raises:
        DataError: no node, lengths that differ, a value that is not finite, or one outside [0, 1] (positions aside).
    """
    arrays = {name: np.asarray(getattr(nodes, name), np.float64) for name in ("x", column, "midpoint", "sharpness")}
    x = arrays["x"]
    if x.ndim != 1 or not x.size:
        raise DataError(f"{what}: no nodes; expected at least one")
    for name, default in (("midpoint", 0.5), ("sharpness", 0.0)):
        arrays[name] = arrays[name] if arrays[name].size else np.full(x.size, default)
    for name, values in arrays.items():
        if len(values) != x.size:
            raise DataError(f"{what}: {x.size} node positions but {len(values)} values; expected as many")
        if not np.isfinite(values).all():
            raise DataError(f"{what}: a node is not finite; expected numbers")
        if name != "x" and (bad := values[(values < 0) | (values > 1)]).size:
            raise DataError(f"{what}: {called if name == column else name} {bad[0]:g}; expected a number in [0, 1]")
        object.__setattr__(nodes, name, values[np.argsort(x, kind="stable")])


def _each(function: Callable[[float], Any], x: np.ndarray, kind: Any) -> np.ndarray:
    """Apply ``function`` to each element of x, any shape; return an array of dtype ``kind``."""
    values, places = np.unique(np.asarray(x, np.float64), return_inverse=True)
    distinct = np.fromiter(map(function, values.tolist()), kind, values.size)
    return distinct[places.reshape(np.shape(x))]


def _vtk_colors(space: str, hsv_wrap: bool, *columns: np.ndarray) -> Any:
    """Return the vtkColorTransferFunction of nodes: x, RGB, midpoints and sharpness."""
    from vtkmodules.vtkRenderingCore import vtkColorTransferFunction

    function = vtkColorTransferFunction()
    function.AllowDuplicateScalarsOn()
    getattr(function, f"SetColorSpaceTo{space.replace('/', '')}")()
    function.SetHSVWrap(hsv_wrap)
    for node in np.column_stack(columns).tolist():
        function.AddRGBPoint(*node)
    return function


@lru_cache(maxsize=256)
def _ciede2000_path(
    start: tuple[float, float, float], end: tuple[float, float, float], midpoint: float, sharpness: float
) -> np.ndarray:
    """Return RGB (`PATH_SAMPLES`, 3) at even steps between two nodes; cached because VTK searches for 70 ms."""
    # with a node more on either side: only between nodes does a path begin and end on VTK's grid of colours
    nodes = [[-1.0, *start, 0.5, 0], [0.0, *start, midpoint, sharpness], [1.0, *end, 0.5, 0], [2.0, *end, 0.5, 0]]
    function = _vtk_colors("Lab/CIEDE2000", False, np.array(nodes))
    table = np.empty(3 * PATH_SAMPLES)
    function.GetTable(0.0, 1.0, PATH_SAMPLES, table)
    return table.reshape(-1, 3)


@dataclass(frozen=True)
class TransferFunction:
    """Colour and opacity per unit distance of a scalar.

    Attributes:
        name: for reports; mentions opacity or colour that were chosen because the source has none.
        opacity_nodes: opacity per unit distance over the scalar.
        color_map: colour over the scalar.
        opacity_unit_distance: world length that the opacities are per, if the source states one.
        opacity_unit_label: source of ``opacity_unit_distance``: the ``file``, or a default of its program; `PER_VOXEL`
            without a distance: opacities are per mean edge of a voxel.
        opacity_unit_share: the same as a share of the longest edge of the volume's box (Inviwo); not both.
        domain: meaning of the node positions: ``data`` values; a ``fraction`` in [0, 1] of the data range; a
            ``percentile`` / 100 of the voxels, or of those in the ``foreground``; ``sigma``, standard deviations above
            the mean; ``mean``, multiples of the mean of the foreground above 0; or ``level``, of `Isosurfaces`.
            `vvgt_cli.look.resolve.resolve` turns all into data values.
        lighting: requested by the source, None if it requests none.
        otherwise: the function for data that are not in Hounsfield units, if this one is for those.

    Raises:
        DataError: unknown domain, unit distance not finite and above 0, fractions outside [0, 1].
    """

    name: str
    opacity_nodes: PiecewiseOpacity
    color_map: ColorMap
    opacity_unit_distance: float | None = None
    domain: str = "data"
    opacity_unit_share: float | None = None
    opacity_unit_label: str = "file"
    lighting: Lighting | None = None
    otherwise: TransferFunction | None = None

    def __post_init__(self) -> None:
        """Check domain, unit distance and node range."""
        if self.domain not in DOMAINS:
            raise DataError(f"{self.name}: node domain {self.domain!r}; expected one of {', '.join(DOMAINS)}")
        distance = self.opacity_unit_distance
        if distance is not None and not (math.isfinite(distance) and distance > 0):
            raise DataError(f"{self.name}: opacity unit distance {distance}; expected a positive number")
        lo, hi = self.node_range()
        if self.domain in ("fraction", "percentile", "foreground") and not 0 <= lo <= hi <= 1:
            raise DataError(f"{self.name}: nodes in [{lo:g}, {hi:g}]; expected x in [0, 1] for a {self.domain}")

    @property
    def of_histogram(self) -> bool:
        """Return whether the node positions depend on the histogram, not on the range of the data alone."""
        return self.domain not in ("data", "fraction") or self.otherwise is not None

    def opacity(self, x: np.ndarray) -> np.ndarray:
        """Return the opacity in [0, 1] per unit distance at data values x (n,), float64 -> (n,); 0 at NaN."""
        return self.opacity_nodes(x)

    def color(self, x: np.ndarray) -> np.ndarray:
        """Return RGB in [0, 1] at data values x (n,), float64 -> (n, 3)."""
        return self.color_map(x)

    def limits(self, x: np.ndarray) -> np.ndarray:
        """Return [opacity, R, G, B] at the floating-point numbers just below and just above each x (n,), (n, 2, 4)."""
        beside = np.nextafter(x[:, None], [-np.inf, np.inf])
        return np.concatenate([self.opacity(beside)[..., None], self.color(beside)], axis=-1)

    def node_range(self) -> tuple[float, float]:
        """Return the smallest and largest node position; beyond them the function is constant."""
        points = self.breakpoints()
        return float(points[0]), float(points[-1])

    def breakpoints(self) -> np.ndarray:
        """Return the positions of all nodes of opacity and colour, ascending, without repeats, (m,) float64."""
        return np.unique(np.concatenate([self.opacity_nodes.x, self.color_map.x]))

    def support(self, lo: float, hi: float) -> list[tuple[float, float]]:
        """Return the intervals of [lo, hi] where opacity is above 0, ascending and disjoint."""
        return self.opacity_nodes.support(lo, hi)

    def moved(self, positions: np.ndarray, domain: str = "data") -> TransferFunction:
        """Return the same function with the `breakpoints` (m,) moved to ``positions`` (m,), non-decreasing."""
        points, opacity, colors = self.breakpoints(), self.opacity_nodes, self.color_map
        return replace(
            self,
            opacity_nodes=replace(opacity, x=positions[np.searchsorted(points, opacity.x)]),
            color_map=replace(colors, x=positions[np.searchsorted(points, colors.x)]),
            domain=domain,
            otherwise=None,
        )

    def rescaled(self, lo: float, hi: float) -> TransferFunction:
        """Return the function stretched linearly so that `node_range` becomes [lo, hi], as ParaView applies a preset.

        Raises:
            DataError: [lo, hi] not finite or not ascending, or a function of one single position.
        """
        first, last = self.node_range()
        if not (math.isfinite(lo) and math.isfinite(hi) and lo < hi):
            raise DataError(f"{self.name}: cannot stretch to [{lo:g}, {hi:g}]; expected two ascending numbers")
        if first == last:
            raise DataError(f"{self.name}: all nodes lie at {first:g}; a range to stretch needs two positions")
        fraction = (self.breakpoints() - first) / (last - first)
        return self.moved(lo * (1 - fraction) + hi * fraction)
