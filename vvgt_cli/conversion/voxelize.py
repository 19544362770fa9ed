"""Gaussians back on a grid of voxels: values or labels of live files, or the extinction and colour of any."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vvgt_cli.conversion.recolored import grid_of, layer_number
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.reader import hollow
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.header import FileFacts
from vvgt_cli.gaussians.live_facts import LABEL_ROW, LAYER_ID, LiveFacts
from vvgt_cli.gaussians.opacity import dilogarithm, projected_areas
from vvgt_cli.look.recognise import background_bins
from vvgt_cli.volume import Volume
from vvgt_cli.volume.blocks import check_memory
from vvgt_cli.volume.space import SPACES
from vvgt_cli.volume.stored import read_block
from vvgt_cli.volume.types import triple
from vvgt_cli.volume.writers import Planes

DENSE_SOFT, DENSE_REACH = 0.5, 3.5  # voxels that bells are widened by, which keeps their mass; deviations
LABEL_REACH = 1.5  # deviations: the corners of a uniform cube are at 3, the middles of its faces at 1.7
FLOAT = np.dtype(np.float32)


def place_of(header: FileFacts) -> np.ndarray:
    """Return the affine (4, 4) from the unit frame of a file to its world, which is that frame if none is stated."""
    found = np.eye(4)
    if header.scale is not None and header.centre is not None:
        found[:3, :3] /= header.scale
        found[:3, 3] = header.centre
    return found


def planes_of(
    name: str, header: FileFacts, gaussians: Gaussians, dims: Sequence[int] | None = None,
    spacing: Sequence[float] | None = None, like: Volume | None = None, layer: int | str | None = None,
    density: bool = False,
) -> Planes:  # fmt: skip
    """Return what Gaussians (unit frame) hold on a grid; arguments and errors are those of `vvgt_cli.voxelize`."""
    if density and layer is not None:
        raise UsageError("--layer selects values; remove it, or --density")
    if not density and header.live is None:
        raise DataError(
            f"{name}: its Gaussians carry no values; expected a .ply of 'vvgt convert --live', or --density for the "
            "extinction and colour of any"
        )
    grid = make_grid(name, header, gaussians, dims, spacing, like)
    if density:
        return density_planes(header, gaussians, grid)
    return live_planes(name, header, gaussians, layer, grid)


def make_grid(
    name: str, header: FileFacts, gaussians: Gaussians, dims: Sequence[int] | None, spacing: Sequence[float] | None,
    like: Volume | None,
) -> Volume:  # fmt: skip
    """Return a grid without values: that of ``like``, or the file's with other ``dims`` or ``spacing``.

    A file that states no grid has the box of its Gaussians, along the axes of its world.

    Raises:
        UsageError: neither a grid nor its dims or spacing, or more than one of them.
        DataError: a grid that memory cannot hold a plane of.
    """
    if like is not None:
        if dims or spacing:
            raise UsageError("--like gives the whole grid; remove --dims and --spacing")
        found = replace(hollow(like, like.dims), segments=None)
    else:
        found = _regridded(_own_grid(name, header, gaussians, bool(dims or spacing)), dims, spacing)
    nx, ny, _ = found.dims
    check_memory(32 * nx * ny, f"one plane of {' x '.join(map(str, found.dims))} voxels", "give fewer voxels by --dims")
    return found


def _own_grid(name: str, header: FileFacts, gaussians: Gaussians, chosen: bool) -> Volume:
    space, unit = header.space if header.space in SPACES else None, header.length_unit or ""
    if header.live is not None and header.affine is not None:
        return replace(grid_of(name, header), space=space, unit=unit)
    if not chosen:
        raise UsageError(f"{name}: its header states no grid; expected --dims X Y Z, --spacing X Y Z or --like VOLUME")
    place, reach = place_of(header), 3 * np.exp(gaussians.log_scales.max(axis=1, keepdims=True).astype(np.float64))
    low, high = (gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)
    edges, first = (high - low) * place[0, 0], low * place[0, 0] + place[:3, 3]
    origin = first + edges / 2  # one voxel as large as the box
    blank = np.zeros((1, 1, 1), np.uint8)
    return Volume(blank, triple(edges.tolist()), tuple(origin.tolist()), name=name, space=space, unit=unit)


def _regridded(grid: Volume, dims: Sequence[int] | None, spacing: Sequence[float] | None) -> Volume:
    """Return a grid in the same box: of ``dims`` voxels, or with ``spacing``, or both, in its middle."""
    if not dims and not spacing:
        return grid
    if spacing and not all(math.isfinite(s) and s > 0 for s in spacing):
        raise UsageError(f"--spacing {' '.join(map(str, spacing))}: expected three positive numbers")
    extent = np.array(grid.extent)
    counts = np.array(dims) if dims else np.maximum(np.rint(extent / np.array(spacing)), 1)
    if counts.prod(dtype=float) > 2**53:
        raise UsageError(f"--spacing: {counts.prod(dtype=float):.3g} voxels; expected a spacing that fits the grid")
    edges = np.array(spacing) if spacing else extent / counts
    middle = grid.affine[:3, :3] @ ((np.array(grid.dims) - 1) / 2) + grid.origin
    origin = middle - grid.axes @ (edges * (counts - 1) / 2)
    found = hollow(grid, [int(n) for n in counts])
    return replace(found, spacing=triple(edges.tolist()), origin=tuple(origin.tolist()))


def live_planes(name: str, header: FileFacts, gaussians: Gaussians, layer: int | str | None, grid: Volume) -> Planes:
    """Return the values, or the labels, that Gaussians of a file carry, of one ``layer`` by number or name.

    Raises:
        UsageError: no layer is named of several, or none is called so.
    """
    assert header.live is not None
    assert gaussians.live is not None
    layers = header.live.layers
    if layer is None and len(layers) > 1:
        listed = ", ".join(f"{k} ({one.name})" for k, one in enumerate(layers))
        raise UsageError(f"{name}: has {len(layers)} layers; expected --layer, one of {listed}")
    number = 0 if layer is None else layer_number(name, layers, str(layer))
    facts, own = layers[number], gaussians
    if len(layers) > 1:
        own = gaussians.take(np.flatnonzero(gaussians.live[:, LAYER_ID] == number))
    named = replace(grid, quantity=facts.quantity, value_unit=facts.unit, hounsfield=facts.unit == "HU")
    return (_labels if facts.labels else _values)(name, header, own, facts, named)


def _values(name: str, header: FileFacts, gaussians: Gaussians, facts: LiveFacts, grid: Volume) -> Planes:
    from vvgt_cli.closed_form.values_back import Bells, LiveValues

    place, background = np.linalg.inv(place_of(header)), background_of(facts)
    own, bells = (Bells.of(gaussians, place @ one.affine) for one in (grid_of(name, header), grid))
    values = LiveValues.of(gaussians, own, background).refined(facts.dims)
    return Planes(
        grid, FLOAT, 1, lambda planes: values.on(bells, grid.dims, planes).clip(facts.lo, facts.hi), background
    )


def background_of(facts: LiveFacts) -> float:
    """Return the most frequent value of the background of a histogram, which no Gaussians carry."""
    counts, edges = np.array(facts.histogram), facts.statistics().edges
    first, last = background_bins(counts)
    peak = first + int(np.argmax(counts[first : last or 1]))
    return facts.lo if peak == 0 else float(edges[peak] + edges[peak + 1]) / 2


def _labels(name: str, header: FileFacts, gaussians: Gaussians, facts: LiveFacts, grid: Volume) -> Planes:
    """Return the label of the nearest body at each voxel, by the bells' greatest, and 0 outside of all."""
    from vvgt_cli.closed_form.values_back import SOFT, Bells

    assert gaussians.live is not None
    numbers = np.array([label.number for label in facts.labels])
    own = numbers[gaussians.live[:, LABEL_ROW].astype(np.int64)]
    fields, slopes = np.stack([np.ones(len(own)), own], axis=1), np.zeros((len(own), 3))
    bells = Bells.of(gaussians, np.linalg.inv(place_of(header)) @ grid.affine)
    smallest, largest = min(numbers.min(), 0), numbers.max()
    dtype = np.dtype(np.uint8 if largest < 256 else np.uint16) if smallest == 0 and largest < 65536 else np.dtype("i4")

    def make(planes: range) -> np.ndarray:
        return bells.sums(fields, slopes, grid.dims, planes, SOFT, LABEL_REACH, True)[..., 1].astype(dtype)

    return Planes(grid, dtype, 1, make)


def density_planes(header: FileFacts, gaussians: Gaussians, grid: Volume) -> Planes:
    """Return extinction per world length, then red, green and blue (degree 0), of any Gaussians.

    A Gaussian's optical mass is what `vvgt_cli.gaussians.opacity` takes its opacity from, along its three axes.
    """
    from vvgt_cli.closed_form.values_back import Bells

    place = place_of(header)
    bells = Bells.of(gaussians, np.linalg.inv(place) @ grid.affine)
    areas = projected_areas(np.exp(2 * gaussians.log_scales.astype(np.float64)), 0.0).mean(axis=1)
    mass = dilogarithm(gaussians.opacity.astype(np.float64)) * areas * place[0, 0] ** 2
    volume = np.linalg.det(bells.widened(DENSE_SOFT)) * abs(np.linalg.det(grid.affine[:3, :3]))
    peak = mass / ((2 * math.pi) ** 1.5 * volume)
    fields = np.concatenate([np.ones((len(peak), 1)), gaussians.colors.clip(0, None)], axis=1) * peak[:, None]
    slopes = np.zeros((len(peak), 3))

    def make(planes: range) -> np.ndarray:
        sums = bells.sums(fields, slopes, grid.dims, planes, DENSE_SOFT, DENSE_REACH)
        sums[..., 1:] /= np.where(sums[..., :1] > 0, sums[..., :1], 1)
        return sums

    return Planes(replace(grid, value_unit=f"1/{grid.unit or 'mm'}" if grid.unit or grid.space else ""), FLOAT, 4, make)


def array_of(planes: Planes) -> Volume:
    """Return values in memory as a volume, of a density its extinction alone; raise DataError if they do not fit."""
    whole = planes.whole()
    return replace(planes.grid, data=whole if whole.ndim == 3 else np.ascontiguousarray(whole[..., 0]))


def values_error(header: FileFacts, gaussians: Gaussians, volume: Volume) -> tuple[float, float] | None:
    """Return PSNR (dB over the file's range) and largest error of live values on their volume's grid.

    None for labels, several layers, and a volume without a finite value.
    """
    facts = header.live
    if facts is None or facts.others or facts.labels or gaussians.live is None or facts.dims != volume.dims:
        return None
    planes = live_planes(volume.name, header, gaussians, None, grid_of(volume.name, header))
    squares, count, largest, z = 0.0, 0, 0.0, 0
    nx, ny, _ = volume.dims
    for slab in planes.slabs():
        part = read_block(volume, np.array([0, 0, z]), np.array([nx, ny, z + len(slab)]))
        wrong = np.abs(part.astype(np.float64) * volume.slope + volume.intercept - slab)
        wrong, z = wrong[np.isfinite(wrong)], z + len(slab)
        squares, count = squares + float((wrong**2).sum()), count + wrong.size
        largest = max(largest, wrong.max(initial=0))
    if not count or facts.hi <= facts.lo:
        return None
    rms = math.sqrt(squares / count) / (facts.hi - facts.lo)
    return (-20 * math.log10(rms) if rms > 0 else 150.0), float(largest)
