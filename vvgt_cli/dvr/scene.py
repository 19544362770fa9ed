"""`Scene`: a volume under a transfer function, laid out for the kernels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.dvr.layers import Layer, mixture_box, scalar_tables, smooth_labels
from vvgt_cli.dvr.layout import Light, Mixture, Texels, pairs_fit
from vvgt_cli.dvr.light import scene_light
from vvgt_cli.dvr.relief import Shaded, smoothed
from vvgt_cli.look import Lighting, Named, TransferFunction
from vvgt_cli.look.tables import Optics, build_tables
from vvgt_cli.volume import Volume

if TYPE_CHECKING:
    from vvgt_cli.dvr.traced import Scattering


@dataclass(frozen=True)
class PreparedVolume:
    """Part of a scene that does not depend on the function.

    Attributes:
        values, slope, intercept: of `kernel_values`.
        ranges: (bz, by, bx, 2) stored values of each brick, (inf, -inf) where none is finite.
    """

    values: np.ndarray
    slope: float
    intercept: float
    ranges: np.ndarray

    @classmethod
    def of(cls, volume: Volume) -> PreparedVolume:
        """Lay ``volume`` out."""
        from vvgt_cli.dvr import bricks

        values, slope, intercept = kernel_values(volume)
        return cls(values, slope, intercept, bricks.brick_ranges(values))


@dataclass(frozen=True)
class Scene(Shaded):
    """Volume under a transfer function, as every later stage reads it.

    Attributes:
        volume: the source.
        tf: the transfer function, in data values.
        unit_distance: world length that the function's opacity refers to.
        values: (nz, ny, nx) uint8, uint16 or float32 stored values in native byte order (a view where possible).
        optics: over stored values, extinction per unit-frame length.
        empty: (bz, by, bx) uint8 Chebyshev distance, in bricks, to the nearest brick with extinction (0: has some).
        half, step: (3,) float64 half extents and voxel edges in the unit frame, (x, y, z).
        lighting: in world axes; ``light`` the same as kernels take it; None: colours are the function's.
        grid: (nz, ny, nx, 4) float32 extinction times (r, g, b, 1) per unit-frame length, of an optics grid, with
            layers of scalars classified at voxels: what cells are made of, and skies' light. ``values`` and ``optics``
            then hold its extinction alone.
        mixture: the same as rays meet it, which classify scalars between voxels.
        labels: the grid is one of labels alone.
        smooth: it holds labels, and beside them layers of scalars at most.
        relief: (nz, ny, nx) float32, `smoothed` extinction of such labels under light; else None.
        rays: draws in place of the CPU's kernels (`vvgt_cli.dvr.cuda`).
    """

    volume: Volume
    tf: Named
    unit_distance: float
    values: np.ndarray
    optics: Optics
    empty: np.ndarray
    half: np.ndarray
    step: np.ndarray
    lighting: Lighting | None = None
    light: Light | None = None
    grid: np.ndarray | None = None
    mixture: Mixture | None = None
    labels: bool = False
    smooth: bool = False
    relief: np.ndarray | None = None
    rays: Callable[..., None] | None = None

    @property
    def texels(self) -> Texels:
        """`grid` as kernels take it."""
        assert self.grid is not None
        return Texels(self.grid)

    @classmethod
    def build(
        cls,
        volume: Volume,
        tf: TransferFunction,
        unit_distance: float,
        value_range: tuple[float, float] | None = None,
        bins: int | None = None,
        layout: PreparedVolume | None = None,
        lighting: Lighting | None = None,
    ) -> Scene:
        """Prepare ``volume`` under ``tf``; ``value_range`` (data values) and ``layout`` are taken as they are."""
        from vvgt_cli.dvr import bricks

        frame = volume.unit_frame()
        layout = layout or PreparedVolume.of(volume)
        values, slope, intercept, ranges = layout.values, layout.slope, layout.intercept, layout.ranges
        if value_range is None:
            ends = [
                slope * float(np.nanmin(ranges[..., 0])) + intercept,
                slope * float(np.nanmax(ranges[..., 1])) + intercept,
            ]
            value_range = (min(ends), max(ends))
        optics = build_tables(
            tf,
            value_range,
            slope=slope,
            intercept=intercept,
            unit_distance=unit_distance,
            world_per_unit=1 / frame.scale,
            voxel=float(np.mean(frame.step)),
            bins=bins,
        )
        empty = bricks.empty_distance(ranges, optics)
        scene = cls(volume, tf, unit_distance, values, optics, empty, np.array(frame.half), np.array(frame.step))
        return scene if lighting is None else scene.lit(lighting)

    @classmethod
    def of_grid(
        cls, volume: Volume, tf: Named, unit_distance: float, grid: np.ndarray, lighting: Lighting | None = None,
        labels: bool = False, layers: Sequence[Layer] = (),
    ) -> Scene:  # fmt: skip
        """Build from an optics grid (nz, ny, nx, 4) float32 per world length, scaled in place, on ``volume``'s grid.

        ``layers``: what it adds up; without them, rays interpolate the grid.
        """
        from vvgt_cli.dvr import bricks

        frame = volume.unit_frame()
        per_unit, half, step = 1 / frame.scale, np.array(frame.half), np.array(frame.step)
        grid *= np.float32(per_unit)
        values = read_only(grid[..., 3], grid.dtype)
        optics, tables = Optics.linear(float(values.max())), scalar_tables(layers, per_unit, float(np.mean(frame.step)))
        mixture = mixture_box(layers, tables, volume, np.zeros(3, np.int64), np.array(volume.dims), grid, per_unit)
        empty = bricks.empty_bricks(values, optics, mixture)
        scene = cls(
            volume, tf, unit_distance, values, optics, empty, half, step, grid=grid, mixture=mixture, labels=labels,
            smooth=labels or smooth_labels(layers),
        )  # fmt: skip
        return scene if lighting is None else scene.lit(lighting)

    def lit(self, lighting: Lighting) -> Scene:
        """Return the same scene under light; that of skies is traced here."""
        light = scene_light(lighting, self.volume.axes, self.step, self.values.shape, self.scattering)
        relief = smoothed(self.mixture.grid[..., 3]) if self.mixture is not None and self.smooth else None
        return replace(self, lighting=lighting, light=light, relief=relief)

    def scattering(self) -> Scattering:
        """Return the scene as paths are traced through it."""
        from vvgt_cli.dvr.traced import Scattering

        texels = None if self.grid is None else self.texels
        return Scattering(self.voxels, self.optics, texels, self.empty, self.step)


def kernel_values(volume: Volume) -> tuple[np.ndarray, float, float]:
    """Return stored values as uint8, uint16 or float32, with the slope and intercept that make them data values.

    The array is C-contiguous, in native byte order and read-only (kernels compile once, for mapped files and arrays
    in memory alike); it is a view of the volume's where that has such values already. int8 is raised to uint8. Types
    that float32 cannot hold (32-bit integers and up, doubles) are shifted and scaled in float64 by slabs, so that
    ranges of 1e-30 and 1e30 keep 24 bits. NaN stays, infinities stay or become NaN: neither is drawn.
    """
    rule = kernel_rule(volume, lambda: _finite_range(volume.data))
    return rule.laid_out(volume.data), rule.slope, rule.intercept


@dataclass(frozen=True)
class KernelRule:
    """Rule that turns stored values into those of kernels; the data value is ``slope * value + intercept``.

    Attributes:
        dtype: uint8, uint16 or float32.
        slope, intercept: see above.
        lo, half_width: values are shifted by ``lo`` and divided by twice ``half_width``; None: taken as they are.
        raised: int8 becomes uint8, 128 is added; of int16 interpolated values would lose bits that float32 keeps.
    """

    dtype: np.dtype
    slope: float
    intercept: float
    lo: float = 0.0
    half_width: float | None = None
    raised: bool = False

    def apply(self, stored: np.ndarray) -> np.ndarray:
        """Return stored values, any shape and byte order, as kernels read them."""
        if self.raised:
            return np.ascontiguousarray(stored).view(np.uint8) ^ np.uint8(128)
        if self.half_width is None:
            return stored.astype(self.dtype, copy=False)
        with np.errstate(invalid="ignore", over="ignore"):
            result: np.ndarray = ((stored.astype(np.float64) / 2 - self.lo / 2) / self.half_width).astype(np.float32)
        return result

    def laid_out(self, stored: np.ndarray) -> np.ndarray:
        """Return `apply` of stored values (nz, ny, nx), read-only, slab by slab; a view where they are that already."""
        if self.half_width is None and not self.raised:
            return read_only(stored.view(np.uint8) if stored.dtype == np.bool_ else stored, self.dtype)
        out = np.empty(stored.shape, self.dtype)
        for z, plane in enumerate(stored):  # the intermediate is float64
            out[z] = self.apply(plane)
        return read_only(out, out.dtype)


def kernel_rule(volume: Volume, limits: Callable[[], tuple[float, float]]) -> KernelRule:
    """Return the rule of `kernel_values`; ``limits``: least and greatest finite stored value, where they matter."""
    kind = volume.data.dtype.newbyteorder("=")
    if kind == np.bool_:
        kind = np.dtype(np.uint8)
    if kind in (np.uint8, np.uint16) and pairs_fit(volume.data.shape):
        return KernelRule(kind, volume.slope, volume.intercept)
    if kind == np.int8 and pairs_fit(volume.data.shape):
        return KernelRule(np.dtype(np.uint8), volume.slope, volume.intercept - 128 * volume.slope, raised=True)
    if kind.itemsize <= 2:  # exact in float32
        return KernelRule(np.dtype(np.float32), volume.slope, volume.intercept)
    lo, hi = limits()
    if kind == np.float32 and max(abs(lo), abs(hi)) < 1e30 and hi / 2 - lo / 2 > 1e-30:
        return KernelRule(kind, volume.slope, volume.intercept)
    half_width = hi / 2 - lo / 2 or 0.5  # halves: hi - lo may overflow
    slope, intercept = volume.slope * 2 * half_width, volume.slope * lo + volume.intercept
    return KernelRule(np.dtype(np.float32), slope, intercept, lo, half_width)


def kernel_type(volume: Volume) -> str:
    """Return the name of the type that `kernel_values` gives a volume's values."""
    return kernel_rule(volume, lambda: (0.0, 1.0)).dtype.name


def read_only(data: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Return ``data`` read-only, aligned, C-contiguous, of ``dtype``; copied (slab by slab) only where it is not."""
    if data.dtype == dtype and data.flags.c_contiguous and data.flags.aligned:
        out = data.view(np.ndarray)
    else:
        out = np.empty(data.shape, dtype)
        for z in range(len(data)):
            out[z] = data[z]
    out.flags.writeable = False
    return out


def _finite_range(data: np.ndarray) -> tuple[float, float]:
    lo, hi = np.inf, -np.inf
    for slab in data:
        finite = slab[np.isfinite(slab)] if slab.dtype.kind == "f" else slab
        if finite.size:
            lo, hi = min(lo, float(finite.min())), max(hi, float(finite.max()))
    return (lo, hi) if hi >= lo else (0.0, 0.0)
