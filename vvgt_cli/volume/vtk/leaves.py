"""Many vtkDataSets as one volume: blocks, pieces and levels of refinement, each sampled where it lies.

Blocks of lower levels come first, so that finer ones replace them; what lies in no block, or in hidden cells, is NaN.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.components import ArrayInfo, choose_array, select_from_array
from vvgt_cli.volume.reading import IDENTITY, ReadOptions, Volume, check_memory, count, float_dtype, printable, triple
from vvgt_cli.volume.vtk.grids import arrays_of, check_cells, image_place, image_volume, shown, values_of, visible
from vvgt_cli.volume.vtk.resample import MAX_EDGE, Grid, grid_of, probe, sampled_volume

ALIGNED = 1e-3  # voxels that images of one lattice may lie off
EDGE = 1e-6  # of a cell: samples that lie on the face of a block are in it


@dataclass(frozen=True)
class Leaf:
    """A vtkDataSet among many.

    Attributes:
        data: vtkDataSet.
        level: of refinement, 0 the coarsest.
        name: of its block, may be empty.
    """

    data: Any
    level: int = 0
    name: str = ""


def leaves_of(root: Any, name: str = "") -> Iterator[Leaf]:
    """Yield the datasets in the vtkDataObject ``root``: itself, or its blocks that are there, with their levels."""
    from vtkmodules.vtkCommonDataModel import vtkCompositeDataSet

    if root is None or root.IsA("vtkDataSet"):
        if root is not None:
            yield Leaf(root, 0, name)
        return
    if not root.IsA("vtkCompositeDataSet"):
        return
    walk = root.NewIterator()
    amr = hasattr(walk, "GetCurrentLevel")
    walk.InitTraversal()
    while not walk.IsDoneWithTraversal():
        data = walk.GetCurrentDataObject()
        own = walk.GetCurrentMetaData() if walk.HasCurrentMetaData() else None
        label = own.Get(vtkCompositeDataSet.NAME()) if own is not None else None
        level = walk.GetCurrentLevel() if amr else 0
        if data is not None and data.IsA("vtkDataSet"):
            label = label or (f"level {level}" if amr else f"block {walk.GetCurrentFlatIndex()}")
            yield Leaf(data, level, "/".join(filter(None, (name, label))))
        walk.GoToNextItem()


def arrays_in(leaves: Sequence[Leaf]) -> list[ArrayInfo]:
    """List the arrays of all datasets, each once."""
    infos: dict[tuple[str, str], ArrayInfo] = {}
    for leaf in leaves:
        for info in arrays_of(leaf.data):
            before = infos.get((info.name, info.where))
            infos[info.name, info.where] = (
                info if before is None else replace(before, active=before.active or info.active)
            )
    return list(infos.values())


def dataset_volume(mesh: Any, options: ReadOptions, source: str, name: str) -> Volume:
    """Make a volume of a vtkDataSet (pyvista's are): an image as it is, any other grid or mesh of cells resampled.

    Errors are those of `Reader.read`.
    """
    if not mesh.IsA("vtkDataSet"):
        raise DataError(f"{source}: a {mesh.GetClassName()}; expected one image, grid or mesh of cells")
    return volume_of([Leaf(mesh)], options, source, name)


def volume_of(leaves: Sequence[Leaf], options: ReadOptions, source: str, name: str) -> Volume:
    """Make a volume of the array that is asked for, from all datasets with it; errors are those of `Reader.read`."""
    if not leaves:
        raise DataError(f"{source}: no dataset in it; expected an image, a grid or a mesh")
    for leaf in leaves:
        check_cells(leaf.data, source)
    filled = [leaf for leaf in leaves if leaf.data.GetNumberOfCells() > 0 and not leaf.data.IsA("vtkPolyData")]
    most = max((leaf.data.GetMaxSpatialDimension() for leaf in filled), default=0)
    deep = [leaf for leaf in filled if leaf.data.GetMaxSpatialDimension() == most]
    chosen = deep if deep and len(leaves) > 1 else leaves[:1]
    if chosen[0].data.IsA("vtkPolyData"):
        raise DataError(f"{source}: a surface (vtkPolyData); expected cells that fill a volume")
    infos = arrays_in(chosen)
    info = infos[choose_array(infos, options.array, source)]
    holders = [one for one in chosen if any((a.name, a.where) == (info.name, info.where) for a in arrays_of(one.data))]
    if len(holders) == 1 and holders[0].data.IsA("vtkImageData"):
        return image_volume(holders[0].data, info, options, source, name)
    if options.spacing is not None:
        raise UsageError(
            f"{source}: its points say where values are; leave out --spacing (--dims says how many to take)"
        )
    fields = [_field(leaf, info, options, source) for leaf in holders]
    dtype = np.result_type(*(values.dtype for _, values in fields))
    lattice = _lattice([leaf.data for leaf, _ in fields], info.where) if options.dims is None else None
    grid = lattice or _samples([leaf for leaf, _ in fields], options.dims, source)
    check_memory(count(grid.dims) * (float_dtype(dtype).itemsize + 1), source)
    out = np.full(grid.dims[::-1], np.nan, float_dtype(dtype))
    for leaf, values in sorted(fields, key=_coarseness):
        _paint(leaf.data, values, info.where, grid, lattice is not None, out)
    inside = ~np.isnan(out)
    if lattice is None:
        volume = sampled_volume(out, inside, dtype, grid, options.dims, source, name)
        return replace(volume, quantity=printable(info.name))
    whole = inside.all() and dtype.kind in "iu"
    kept = out.astype(dtype) if whole else out
    return Volume(kept, grid.spacing, grid.origin, name=name, quantity=printable(info.name))


def _coarseness(row: tuple[Leaf, np.ndarray]) -> tuple[int, float]:
    """Return a sorting key that puts coarse blocks first: by level, images of one level by their cells."""
    data = row[0].data
    return row[0].level, -float(np.prod(data.GetSpacing())) if data.IsA("vtkImageData") else 0.0


def _field(leaf: Leaf, info: ArrayInfo, options: ReadOptions, source: str) -> tuple[Leaf, np.ndarray]:
    """Return a dataset without its hidden cells, and the scalars (n,) of its points or cells."""
    data = leaf.data if leaf.data.IsA("vtkImageData") else shown(leaf.data)
    own = next((a for a in arrays_of(data) if (a.name, a.where) == (info.name, info.where)), info)
    if own.components != info.components:
        raise DataError(f"{source}: array {info.name!r} has {own.components} components in block {leaf.name}")
    values = values_of(data, own).reshape(1, 1, -1, own.components)
    field = select_from_array(values, info, options.component, source).ravel()
    if data.IsA("vtkImageData"):
        field = visible(data, field.reshape(image_place(data, info.where).dims[::-1]), info.where).ravel()
    return replace(leaf, data=data), field


def _lattice(images: Sequence[Any], where: str) -> Grid | None:
    """Find the one grid that images are boxes of; None where they are not, or it is larger than they are."""
    places = [image_place(image, where) for image in images if image.IsA("vtkImageData")]
    if len(places) < len(images) or any(place.direction != IDENTITY for place in places):
        return None
    steps = np.array([place.spacing for place in places])
    if (np.abs(steps - steps[0]) > 1e-9 * steps[0]).any():
        return None
    origins = np.array([place.origin for place in places])
    first = origins.min(axis=0)
    begin = (origins - first) / steps[0]
    if np.abs(begin - begin.round()).max() > ALIGNED:
        return None
    dims = (begin.round().astype(np.int64) + np.array([place.dims for place in places])).max(axis=0)
    if count(tuple(dims)) > 4 * sum(count(place.dims) for place in places):
        return None
    return Grid(triple(dims.tolist()), places[0].spacing, triple(first.tolist()))


def _samples(leaves: Sequence[Leaf], dims: tuple[int, int, int] | None, source: str) -> Grid:
    """Choose samples that fill all datasets: as fine as the finest level of images, else about as many as cells."""
    bounds = np.array([leaf.data.GetBounds() for leaf in leaves]).reshape(-1, 3, 2)
    box = np.stack([bounds[..., 0].min(axis=0), bounds[..., 1].max(axis=0)], axis=1)
    cells = sum(leaf.data.GetNumberOfCells() for leaf in leaves)
    if cells < 1:
        raise DataError(f"{source}: a mesh without cells; expected some to sample")
    images = [image_place(leaf.data, "point") for leaf in leaves if leaf.data.IsA("vtkImageData")]
    if dims is None and len(images) == len(leaves) and all(image.direction == IDENTITY for image in images):
        finest = np.min([image.spacing for image in images], axis=0)
        if (finest > 0).all() and np.isfinite(box).all():
            wanted = np.maximum(np.round((box[:, 1] - box[:, 0]) / finest), 1)
            dims = triple(np.ceil(wanted / max(wanted.max() / MAX_EDGE, 1)).astype(int).tolist())
    return grid_of(box, dims, cells, source)


def _paint(data: Any, values: np.ndarray, where: str, grid: Grid, aligned: bool, out: np.ndarray) -> None:
    """Put the values of a dataset into the samples ``out`` (nz, ny, nx) that lie in it, or are it (``aligned``)."""
    origin, step = np.array(grid.origin), np.array(grid.spacing)
    if aligned:
        place = image_place(data, where)
        begin = np.round((np.array(place.origin) - origin) / step).astype(int)
        end, sampled, inside = begin + place.dims, values.reshape(place.dims[::-1]), np.array(True)
    else:
        bounds = np.array(data.GetBounds()).reshape(3, 2)
        begin = np.maximum(np.ceil((bounds[:, 0] - origin) / step - EDGE), 0).astype(int)
        end = np.minimum(np.floor((bounds[:, 1] - origin) / step + EDGE) + 1, grid.dims).astype(int)
        if not (begin < end).all():
            return
        part = Grid(triple((end - begin).tolist()), grid.spacing, triple((origin + begin * step).tolist()))
        sampled, inside = probe(data, values, where, part)
    target = out[tuple(slice(a, b) for a, b in zip(begin[::-1], end[::-1], strict=True))]
    np.copyto(target, sampled, where=inside & ~np.isnan(sampled), casting="unsafe")
