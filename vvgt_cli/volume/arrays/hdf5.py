"""HDF5 (``.h5``, ``.hdf5``): one dataset, ``FILE:/path/to/dataset``; a contiguous one is memory-mapped. Read by h5py.

Axes come from dimension scales where there are any (https://docs.hdfgroup.org, "HDF5 Dimension Scales"), else from the
conventions of `conventions`, else from names beside the dataset (`beside`). CF attributes of scaling and missing values
are applied.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.arrays import MAX_CHUNK
from vvgt_cli.volume.arrays.beside import GROUPS, Neighbour, choose_grid, with_neighbours
from vvgt_cli.volume.arrays.conventions import conventional_axes, coordinates_of, turned_by_itk
from vvgt_cli.volume.blocks import data_file, load_block, size_text
from vvgt_cli.volume.labelled import ATTRIBUTES, GEOMETRY, Axis, axis, described_by, flags_of, labelled_volume
from vvgt_cli.volume.libraries import need, read_part
from vvgt_cli.volume.microscopy import bigdataviewer
from vvgt_cli.volume.microscopy.imaris import is_imaris, read_imaris
from vvgt_cli.volume.reading import ReadOptions, Volume, printable, text_of, volume_name

MAX_VISITED = 100_000
MAX_LINKS = 16  # that HDF5 follows
MAX_BESIDE = 1000  # members of a group that are looked at for coordinates


def read_hdf5(path: Path, options: ReadOptions) -> Volume:
    """Read one dataset of an HDF5 file, or what Imaris or BigDataViewer have in one."""
    h5py = need("h5py", "hdf5", str(path), "HDF5")
    with h5py.File(path, "r") as file:
        if is_imaris(file):
            return read_imaris(file, path, options, partial(checked_dataset, h5py, path, file))
    if (volume := bigdataviewer.read_beside(path, options)) is not None:
        return volume
    if options.level is not None:
        raise UsageError(f"{path}: of neither Imaris nor BigDataViewer, which have levels; leave out --level")
    return read_dataset(path, options)


def read_dataset(path: Path, options: ReadOptions) -> Volume:
    """Read one dataset of an HDF5 file, as it is."""
    h5py = need("h5py", "hdf5", str(path), "HDF5")
    with h5py.File(path, "r") as file:
        dataset = _choose(h5py, file, options.array, path)
        source, place = f"{path}:{printable(dataset.name)}", Path(dataset.file.filename)  # a link's may lie beside
        check_storage(h5py, dataset, source)
        mapped = _mapped(dataset, place)
        stored = mapped if mapped is not None else lambda index: dataset[index]
        name = f"{volume_name(path)}:{dataset.name.strip('/')}"
        attributes = {key: dataset.attrs[key] for key in ATTRIBUTES if key in dataset.attrs}
        attributes |= {key: up.attrs[key] for up in (file, dataset.parent) for key in GEOMETRY if key in up.attrs}
        read, held = partial(_coordinates, h5py, path), partial(checked_dataset, h5py, path)
        axes = scaled_axes(dataset, read)
        if not any(a.name or a.centres is not None for a in axes):
            axes, more = conventional_axes(file, dataset, source, held) or (axes, {})
            attributes |= more
        attributes |= flags_of(h5py.check_enum_dtype(dataset.dtype))
        axes = with_neighbours(axes, _beside(h5py, dataset, read), source, options.spacing is not None)
        _warn_of_xdmf(path, axes, options)
        chunks = dataset.chunks or dataset.shape
        if mapped is None and options.stored:
            stored = partial(read_part, place, dataset.name)
        volume = labelled_volume(stored, dataset.dtype, axes, attributes, options, source, name, chunks)
        return turned_by_itk(dataset.parent, volume, held)


def _warn_of_xdmf(path: Path, axes: list[Axis], options: ReadOptions) -> None:
    """Warn where no coordinates are known and a file of XDMF, which states them, lies beside."""
    files = [path.with_suffix(suffix) for suffix in (".xdmf", ".xmf")]
    beside = [file.name for file in files if file.is_file()]
    if beside and options.spacing is None and all(a.centres is None for a in axes):
        warnings.warn(f"{path}: states no spacing, which is taken as 1; {beside[0]} may: give that file", stacklevel=3)


def checked_dataset(h5py: Any, path: Path, group: Any, name: str, needed: bool = True) -> Any:
    """Return a dataset in a group whose values can be read, by a path that leads into no file elsewhere.

    Return None where there is none and it is not ``needed``.
    """
    _check_links(h5py, group, name)
    if isinstance(dataset := group.get(name), h5py.Dataset):
        check_storage(h5py, dataset, f"{path}:{printable(dataset.name)}")
        return dataset
    if needed:
        place = printable(f"{group.name.rstrip('/')}/{name}")
        raise DataError(f"{path}:{place}: no dataset; check that the file is whole")
    return None


def _choose(h5py: Any, file: Any, wanted: str | None, path: Path) -> Any:
    if wanted is not None:
        _check_links(h5py, file, wanted)
        item = file.get(wanted)
        if isinstance(item, h5py.Dataset):
            choose_grid({item.name: (item.shape or (), item.dtype.name)}, item.name, str(path))
            return item
        file, wanted = (item, None) if isinstance(item, h5py.Group) else (file, wanted)
    known = {d.name: (d.shape, d.dtype.name) for d in datasets(h5py, file)}
    how = f"choose one as {path}:{printable(next(iter(known), '/path'))} (or with --array)"
    return file[choose_grid(known, wanted, str(path), "dataset", how)]


def datasets(h5py: Any, group: Any) -> list[Any]:
    """List the datasets of numbers with 1 to 5 axes, but for those that describe others, such as bounds of cells."""
    listed: list[Any] = []
    described: set[str] = set()
    seen = 0

    def visit(name: str, item: Any) -> bool | None:
        nonlocal seen
        seen += 1
        described.update(described_by(item.attrs))
        numbers = isinstance(item, h5py.Dataset) and item.dtype.kind in "iufb"
        text = numbers and item.dtype == np.uint8 and name.endswith("Metadata")  # of Velox
        if numbers and not text and 1 <= len(item.shape or ()) <= 5:
            listed.append(item)
        return True if seen >= MAX_VISITED else None

    group.visititems(visit)
    return [d for d in listed if d.name.rpartition("/")[2] not in described] or listed


def _coordinates(h5py: Any, path: Path, item: Any) -> tuple[np.ndarray, dict[str, Any]]:
    """Read coordinates and what describes them, if their values can be read."""
    check_storage(h5py, item, f"{path}:{printable(item.name)}")
    return coordinates_of(item)


def _beside(h5py: Any, dataset: Any, read: Callable[[Any], Any]) -> dict[str, Neighbour]:
    """List the datasets in the group of another, and in groups of coordinates beside that or above."""
    here, neighbours = dataset.parent, {}

    def visit(name: str, item: Any) -> bool | None:  # of no links, which may lead into other files
        group = item.parent
        coordinates = GROUPS.fullmatch(group.name.rpartition("/")[2]) and group.parent in (here, here.parent)
        near = isinstance(item, h5py.Dataset) and item != dataset and (group == here or coordinates)
        if near and not _is_bare(item):
            neighbours[item.name.removeprefix(here.name).strip("/")] = Neighbour.of(item.shape, partial(read, item))
        return True if len(neighbours) >= MAX_BESIDE else None

    here.parent.visititems(visit)
    return neighbours


def _check_links(h5py: Any, file: Any, wanted: str, turns: Iterator[int] | None = None) -> None:
    """Refuse a path, from a file or a group, that leads into a file outside of its folder, or over too many links."""
    turns = turns or iter(range(MAX_LINKS))
    place = file.file if wanted.startswith("/") else file
    for part in wanted.split("/"):
        if part in ("", "."):
            continue
        link = place.get(part, getlink=True) if isinstance(place, h5py.Group) else None
        if isinstance(link, h5py.ExternalLink | h5py.SoftLink) and next(turns, None) is None:
            raise DataError(f"{place.file.filename}:{printable(wanted)}: too many links; expected at most {MAX_LINKS}")
        if isinstance(link, h5py.ExternalLink):
            with h5py.File(data_file(Path(place.file.filename), link.filename, exact=True), "r") as beside:
                _check_links(h5py, beside, link.path, turns)
        if isinstance(link, h5py.SoftLink):
            _check_links(h5py, place, link.path, turns)
        place = place.get(part) if link is not None else None


def check_storage(h5py: Any, dataset: Any, source: str, depth: int = MAX_LINKS) -> None:
    """Refuse values in files outside of this one's folder, filters that are not there, and chunks beyond all bounds.

    Sources of virtual datasets, which may be virtual themselves to a ``depth``, are held to the same.
    """
    if dataset.external:
        raise DataError(f"{source}: its values lie in other files (external storage); try h5repack to bring them in")
    if dataset.is_virtual:
        path = Path(dataset.file.filename)
        for name, part in {(one.file_name, one.dset_name) for one in dataset.virtual_sources()}:
            with h5py.File(path if name == "." else data_file(path, name, exact=True), "r") as beside:
                _check_links(h5py, beside, part)
                item = beside.get(part)
                if not isinstance(item, h5py.Dataset) or not depth:
                    raise DataError(f"{source}: {name}:{printable(part)}, its source, has no values")
                check_storage(h5py, item, source, depth - 1)
    if dataset.chunks and int(np.prod(dataset.chunks, dtype=object)) * dataset.dtype.itemsize > MAX_CHUNK:
        raise DataError(f"{source}: chunks of {dataset.chunks} values; expected at most {size_text(MAX_CHUNK)} each")
    plan = dataset.id.get_create_plist()
    for k in range(plan.get_nfilters()):
        code, _, _, label = plan.get_filter(k)
        if h5py.h5z.filter_avail(code):
            continue
        try:
            import hdf5plugin  # noqa: F401  registers its filters
        except ImportError:
            name = label.decode("utf-8", "replace") or "unnamed"
            raise DataError(
                f"{source}: packed with filter {code} ({name}), which h5py does not have; try: pip install hdf5plugin"
            ) from None


def _mapped(dataset: Any, path: Path) -> np.ndarray | None:
    """Return the values memory-mapped, where they lie in the file in one piece as they are."""
    offset = None if dataset.chunks or dataset.is_virtual else dataset.id.get_offset()
    if offset is None or dataset.dtype.kind not in "iuf" or not dataset.size:
        return None
    return load_block(path, dataset.dtype, dataset.shape, offset=offset)


def scaled_axes(dataset: Any, read: Callable[[Any], Any]) -> list[Axis]:
    """Return the axes of a dataset by its dimension scales, slowest first; without any they have no name."""
    axes = []
    for size, dimension in zip(dataset.shape, dataset.dims, strict=True):
        scales = [scale for scale in dimension.values() if scale.shape == (size,) and scale.dtype.kind in "iuf"]
        if not scales:
            names = list(dimension.keys())
            axes.append(axis(dimension.label or (names[0] if names else ""), size))
            continue
        own = scales[0].name.rpartition("/")[2]
        name = next((n for n in (own, dimension.label, *dimension.keys()) if axis(n, size).role), own)
        if len(scales) > 1:
            others = ", ".join(printable(scale.name) for scale in scales[1:])
            warnings.warn(f"{printable(dataset.name)}: coordinates are those of {own}, not of {others}", stacklevel=3)
        axes.append(axis(name, size, *(() if _is_bare(scales[0]) else read(scales[0]))))
    return axes


def _is_bare(scale: Any) -> bool:
    """Tell whether a dataset stands for a dimension of NetCDF alone, without coordinates."""
    return text_of(scale.attrs.get("NAME", "")).startswith("This is a netCDF dimension")
