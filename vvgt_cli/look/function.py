"""`TransferFunction`: what a file, a colour-map name or the histogram becomes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.look.colormap import ColorMap
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.look.opacity import PiecewiseOpacity

DOMAINS = ("data", "fraction", "percentile", "foreground", "sigma")
PER_VOXEL = "mean-spacing"  # as --opacity-unit-distance calls it


@dataclass(frozen=True)
class TransferFunction:
    """Scalar to colour and opacity per unit distance; implements `TransferFunctionLike`.

    Attributes:
        name: for reports; says where opacity or colour were not given but chosen.
        opacity_nodes: opacity per unit distance over the scalar.
        color_map: colour over the scalar.
        opacity_unit_distance: world length that the opacities are per, when the source says one.
        opacity_unit_label: where ``opacity_unit_distance`` is from: the ``file``, or a default of its program;
            `PER_VOXEL` without a distance: opacities are per mean edge of a voxel.
        opacity_unit_share: the same as a share of the longest edge of the volume's box (Inviwo); not both.
        domain: what the node positions are: ``data`` values; a ``fraction`` in [0, 1] of the data range;
            a ``percentile`` / 100 of the voxels, or of those in the ``foreground``; or ``sigma``, standard deviations
            above the mean. `vvgt_cli.look.resolve.resolve` turns all into data values.
        lighting: that the source asks for, None where it asks for none.
        otherwise: the function for data that are not in Hounsfield units, where this one is for those.

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
        if self.domain not in DOMAINS:
            raise DataError(f"{self.name}: node domain {self.domain!r}; expected one of {', '.join(DOMAINS)}")
        distance = self.opacity_unit_distance
        if distance is not None and not (math.isfinite(distance) and distance > 0):
            raise DataError(f"{self.name}: opacity unit distance {distance}; expected a positive number")
        lo, hi = self.node_range()
        if self.domain not in ("data", "sigma") and not 0 <= lo <= hi <= 1:
            raise DataError(f"{self.name}: nodes in [{lo:g}, {hi:g}]; expected x in [0, 1] for a {self.domain}")

    @property
    def of_histogram(self) -> bool:
        """Whether nodes follow from the histogram of the data, not from their range alone."""
        return self.domain in ("percentile", "foreground", "sigma") or self.otherwise is not None

    def opacity(self, x: np.ndarray) -> np.ndarray:
        """Opacity in [0, 1] per unit distance at data values x (n,), float64 -> (n,); 0 at NaN."""
        return self.opacity_nodes(x)

    def color(self, x: np.ndarray) -> np.ndarray:
        """RGB in [0, 1] at data values x (n,), float64 -> (n, 3)."""
        return self.color_map(x)

    def node_range(self) -> tuple[float, float]:
        """Smallest and largest node position; beyond it the function is constant."""
        points = self.breakpoints()
        return float(points[0]), float(points[-1])

    def breakpoints(self) -> np.ndarray:
        """Positions of all nodes of opacity and colour, ascending, without repeats, (m,) float64."""
        return np.unique(np.concatenate([self.opacity_nodes.x, self.color_map.x]))

    def support(self, lo: float, hi: float) -> list[tuple[float, float]]:
        """Intervals of [lo, hi] where opacity is above 0, ascending and disjoint."""
        return self.opacity_nodes.support(lo, hi)

    def moved(self, positions: np.ndarray, domain: str = "data") -> TransferFunction:
        """The same function with the `breakpoints` (m,) moved to ``positions`` (m,), non-decreasing."""
        points = self.breakpoints()
        opacity = self.opacity_nodes.moved(positions[np.searchsorted(points, self.opacity_nodes.x)])
        color = self.color_map.moved(positions[np.searchsorted(points, self.color_map.x)])
        return replace(self, opacity_nodes=opacity, color_map=color, domain=domain)

    def rescaled(self, lo: float, hi: float) -> TransferFunction:
        """All nodes stretched linearly so that `node_range` becomes [lo, hi], as ParaView does on applying a preset.

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
