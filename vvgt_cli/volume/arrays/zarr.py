"""Zarr 2 and 3: a folder (``STORE.zarr``, ``STORE.zarr:/path/to/array``), OME-Zarr images among them. Read by zarr.

Axes: coordinate arrays of the dimensions' names beside the array, as xarray writes them, or the scale and translation
of OME-Zarr (https://ngff.openmicroscopy.org). Codecs are compared with a list before zarr sees them: one of numcodecs'
unpickles.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.arrays import MAX_CHUNK
from vvgt_cli.volume.arrays.beside import Neighbour, choose_grid, warn_of_curvilinear, with_neighbours
from vvgt_cli.volume.labelled import Axis, axis, labelled_volume
from vvgt_cli.volume.microscopy.image import hex_color
from vvgt_cli.volume.reading import ReadOptions, Segment, Volume, need, segments_in

_CODECS = {
    *("blosc", "zstd", "gzip", "zlib", "lz4", "bz2", "lzma", "shuffle", "delta", "fixedscaleoffset", "quantize"),
    *("packbits", "astype", "bitround", "crc32", "crc32c", "adler32", "fletcher32", "bytes", "transpose"),
    "sharding_indexed",
}
_METADATA = ("zarr.json", ".zarray", ".zgroup")
MAX_METADATA = 16 << 20


def holds_zarr(path: Path) -> bool:
    """Tell whether a folder is a Zarr array or group."""
    return any((path / name).is_file() for name in _METADATA)


def read_zarr(path: Path, options: ReadOptions) -> Volume:
    """Read one array of a Zarr store."""
    zarr = need("zarr", "zarr", str(path), "Zarr")
    place, facts = _choose(path, options.array, options.level)
    array = _array(zarr, place)
    attributes = _marked(array)
    names = facts.get("dimension_names") or attributes.get("_ARRAY_DIMENSIONS") or [""] * array.ndim
    group = _group_of(path, place)
    axes = _ome_axes(group, place, array.shape, options.spacing is not None) or [
        axis(str(name or ""), size) for name, size in zip(names, array.shape, strict=True)
    ]
    beside = _beside(zarr, path, place, [a.name for a in axes if a.centres is None])
    axes = with_neighbours(axes, beside, str(place), options.spacing is not None)
    coordinates = str(attributes.get("coordinates", "")).split()
    warn_of_curvilinear([n for n in coordinates if n in beside and not beside[n].size], axes, str(place))
    volume = labelled_volume(
        lambda index: np.asarray(array[index]), array.dtype, axes, attributes, options, str(place),
        name_in(path, place), array.chunks,
    )  # fmt: skip
    if (labels := _ome(group).get("image-label")) is None:
        return volume
    return replace(volume, segments=segments_in(lambda: _segments(labels), str(place)))


def _segments(labels: dict[str, Any]) -> list[Segment]:
    """Return the segments of OME-Zarr's ``image-label``: named by the first text of their properties."""
    colors = {int(one["label-value"]): [v / 255 for v in one["rgba"]] for one in labels.get("colors") or []}
    properties = {int(one["label-value"]): one for one in labels.get("properties") or []}
    segments = []
    for number in colors.keys() | properties.keys():
        named = {key: text for key, text in properties.get(number, {}).items() if isinstance(text, str)}
        name = next((named[key] for key in ("name", "class", "label") if key in named), next(iter(named.values()), ""))
        red, green, blue, opacity = colors.get(number, (0.0, 0.0, 0.0, None))
        color = None if opacity is None else (red, green, blue)
        segments.append(Segment(number, name, color, opacity=opacity if number else 0.0))
    return segments


def _array(zarr: Any, place: Path) -> Any:
    """Open an array and check its codecs before and after, as a server may have sent zarr other metadata."""
    _check_codecs(place, _metadata(place))
    server: Any = None if isinstance(place, Path) else place  # `remote.Remote`
    array = zarr.open_array(**(server.store() if server else {"store": place}), mode="r")
    _check_codecs(place, array.metadata.to_dict())
    if int(np.prod(array.chunks, dtype=object)) * array.dtype.itemsize > MAX_CHUNK:
        raise DataError(f"{place}: chunks of {array.chunks} values; expected at most 2 GiB each")
    if server:
        server.allow(min(int(np.prod(array.shards or array.chunks, dtype=object)) * array.dtype.itemsize, MAX_CHUNK))
    return array


def _marked(array: Any) -> dict[str, Any]:
    """Return an array's attributes with its ``_FillValue`` where xarray puts it.

    That is the fill value of a version 2 array with named dimensions, where it is not 0, Zarr's default, for values
    that are not packed; version 3 has floats of 8 bytes as base64.
    """
    attributes = dict(array.attrs)
    if "_ARRAY_DIMENSIONS" in attributes and (array.fill_value or "scale_factor" in attributes):
        attributes.setdefault("_FillValue", array.fill_value)
    text = attributes.get("_FillValue")
    if isinstance(text, str) and len(text) == 12:
        attributes["_FillValue"] = np.frombuffer(base64.b64decode(text), "<f8")
    return attributes


def name_in(path: Path, place: Path) -> str:
    """Return the name of a volume at a place in a store."""
    stem = path.name.removesuffix(".zip").removesuffix(".ozx")
    stem = stem.removesuffix(".n5").removesuffix(".zarr").removesuffix(".ome") or path.name
    inner = place.relative_to(path).as_posix()
    return stem if inner == "." else f"{stem}:{inner}"


def inside(path: Path, wanted: str | None) -> Path:
    """Return the place in a store that an option names, by default the store; raise UsageError if it lies elsewhere."""
    here = path / (wanted or "").strip("/") if wanted else path
    if not here.resolve().is_relative_to(path.resolve()):
        raise UsageError(f"{path}: array {wanted}; expected a path inside the store")
    return here


def json_object(file: Path) -> dict[str, Any]:
    """Read a file of metadata; raise DataError for more than `MAX_METADATA` bytes, or no JSON object."""
    with file.open("rb") as stream:
        text = stream.read(MAX_METADATA + 1)
    if len(text) > MAX_METADATA:
        raise DataError(f"{file}: more than 16 MiB; expected metadata of at most that")
    content = json.loads(text)
    if not isinstance(content, dict):
        raise DataError(f"{file}: expected a JSON object of metadata")
    return content


def _metadata(folder: Path) -> dict[str, Any]:
    """Read the metadata of an array or a group; empty where there are none."""
    for name in _METADATA:
        file = folder / name
        if file.is_file():
            kind = {".zarray": {"node_type": "array"}, ".zgroup": {"node_type": "group"}}.get(name, {})
            return kind | json_object(file)
    return {}


def _choose(path: Path, wanted: str | None, number: int | None) -> tuple[Path, dict[str, Any]]:
    """Return folder and metadata of the array asked for, else of the image's level ``number``, else of the only one."""
    here = inside(path, wanted)
    facts = _metadata(here)
    if facts.get("node_type") == "array":
        choose_grid({here.name: (facts["shape"], _type(facts))}, here.name, str(path))
        if number is not None:
            raise UsageError(f"{path}: an array without levels; leave out --level {number}")
        return here, facts
    level = _multiscale(here)
    if number is not None and not level:
        raise UsageError(f"{path}: no OME-Zarr image, which alone has levels; leave out --level {number}")
    if level:
        if (number or 0) >= len(level["datasets"]):
            raise UsageError(f"{path}: --level {number}: expected full, or 0 to {len(level['datasets']) - 1}")
        place = here / str(level["datasets"][number or 0]["path"])
        if place.resolve().is_relative_to(path.resolve()):
            return place, _metadata(place)
    fits = {folder.relative_to(path).as_posix(): (folder, f) for folder, f in _arrays(here if facts else path)}
    shapes = {name: (f["shape"], _type(f)) for name, (_, f) in fits.items()}
    how = f"choose one as {path}:/PATH (or with --array)"
    return fits[choose_grid(shapes, None if facts else wanted, str(path), how=how)]


def _type(facts: dict[str, Any]) -> str:
    """Return the type of an array's values, as either version names it."""
    return str(facts.get("data_type", facts.get("dtype")))


def _arrays(root: Path) -> list[tuple[Path, dict[str, Any]]]:
    """List the arrays below a group."""
    arrays: list[tuple[Path, dict[str, Any]]] = []
    groups = [root]
    while groups:
        for folder in sorted((p for p in groups.pop(0).iterdir() if not p.is_symlink()), key=str):
            facts = _metadata(folder)
            if facts.get("node_type") == "array" and facts.get("shape"):
                arrays.append((folder, facts))
            elif facts.get("node_type") == "group":
                groups.append(folder)
    return arrays


def _check_codecs(place: Path, facts: dict[str, Any]) -> None:
    """Refuse codecs that are not known to be harmless, wherever the metadata name them."""
    named = []
    waiting: list[Any] = [facts.get(key) for key in ("compressor", "filters", "codecs")]
    while waiting:
        item = waiting.pop()
        if isinstance(item, list):
            waiting += item
        elif isinstance(item, dict):
            named.append(str(item.get("id", item.get("name", ""))))
            inner = item.get("configuration", {})
            waiting += [inner.get(key) for key in ("codecs", "index_codecs")] if isinstance(inner, dict) else []
        elif isinstance(item, str):
            named.append(item)
    for name in named:
        if name.removeprefix("numcodecs.") not in _CODECS:
            raise DataError(f"{place}: codec {name!r}; expected one of {', '.join(sorted(_CODECS))}")


def _beside(zarr: Any, path: Path, place: Path, names: Sequence[str]) -> dict[str, Neighbour]:
    """List the arrays along one axis beside another: those of some names alone where a server lists no folders."""

    def line(folder: Path) -> tuple[np.ndarray, dict[str, Any]]:
        array = _array(zarr, folder)
        return np.asarray(array[:]), _marked(array)

    group = place.parent
    folders = [group / name for name in names if name and "/" not in name and name not in (".", "..")]
    with suppress(OSError, NotImplementedError):
        folders += [f for f in group.iterdir() if not f.is_symlink()] if str(place) != str(path) else []
    neighbours = {}
    for folder in folders:
        facts = _metadata(folder) if str(folder) != str(place) else {}
        if facts.get("node_type") == "array":
            neighbours[folder.name] = Neighbour.of(facts.get("shape", ()), partial(line, folder))
    return neighbours


def _ome(group: Path) -> dict[str, Any]:
    """Return the attributes of a group that OME-Zarr defines; from version 0.5 on they lie in ``ome``."""
    old = group / ".zattrs"
    attributes = json_object(old) if old.is_file() else _metadata(group).get("attributes")
    attributes = attributes if isinstance(attributes, dict) else {}
    inner = attributes.get("ome")
    return inner if isinstance(inner, dict) else attributes


def _multiscale(group: Path) -> dict[str, Any]:
    """Return the first image of an OME-Zarr group; empty where it has none."""
    images = _ome(group).get("multiscales")
    if isinstance(images, list) and images and isinstance(images[0], dict) and images[0].get("datasets"):
        return images[0]
    return {}


def _group_of(path: Path, place: Path) -> Path:
    """Return the group of OME-Zarr that an array is in, which may be above one of its own (``scale0/image``)."""
    above = place.parent
    nested = len(place.relative_to(path).parts) > 1
    return above.parent if nested and not _multiscale(above) and _multiscale(above.parent) else above


def _ome_axes(group: Path, place: Path, shape: tuple[int, ...], spacing_given: bool) -> list[Axis]:
    """Return the axes of a level of an OME-Zarr image; none where the array is not one.

    Images of versions before 0.3 state no axes: they are t, c, z, y, x.

    Raises:
        DataError: axes that do not fit the array.
        UsageError: a transformation of another kind, and no spacing given.
    """
    image = _multiscale(group)
    level = next((d for d in image.get("datasets", []) if str(group / str(d.get("path"))) == str(place)), None)
    if level is None:
        return []
    described = image.get("axes") or list("tczyx")
    if len(described) != len(shape):
        raise DataError(
            f"{place}: OME-Zarr {image.get('version', 'of no version')} with {len(shape)} axes of values; expected "
            f"{len(described)} ({'as its metadata list' if image.get('axes') else 't, c, z, y, x'})"
        )
    scale, shift = np.ones(len(shape)), np.zeros(len(shape))
    for step in [step for of in (level, image) for step in of.get("coordinateTransformations") or []]:
        kind = step.get("type", "identity")
        if not spacing_given and kind != "identity" and (kind not in step or kind not in ("scale", "translation")):
            raise UsageError(
                f"{place}: OME-Zarr with a transformation {str(step)[:80]}; expected scale and translation as lists of "
                "numbers: try --spacing X Y Z"
            )
        factor = np.asarray(step.get("scale", np.ones(len(shape))), np.float64)
        scale, shift = scale * factor, shift * factor + np.asarray(step.get("translation", np.zeros(len(shape))))
    roles = {"time": "t", "channel": "c"}
    axes = []
    for k, (entry, size) in enumerate(zip(described, shape, strict=True)):
        facts = entry if isinstance(entry, dict) else {"name": str(entry)}
        name = str(facts.get("name", "")).lower()
        role = roles.get(str(facts.get("type", "")), name if name in ("x", "y", "z", "t", "c") else "")
        unit = str(facts.get("unit", "") or "")
        placed = role not in ("t", "c") or (role == "t" and unit)
        centres = shift[k] + scale[k] * np.arange(size) if placed else None
        labels, colors = _rendering(group, size) if role == "c" else ((), ())
        axes.append(Axis(name, size, centres, unit, role, labels, colors, abs(float(scale[k]))))
    return axes


def _rendering(group: Path, count: int) -> tuple[tuple[str, ...], tuple[tuple[float, float, float] | None, ...]]:
    """Return names and RGB of the channels by the rendering settings (``omero``); none where their number differs."""
    omero = _ome(group).get("omero")
    channels = omero.get("channels") if isinstance(omero, dict) else None
    if not isinstance(channels, list) or len(channels) != count or not all(isinstance(c, dict) for c in channels):
        return (), ()
    names = tuple(str(c.get("label") or "")[:80] for c in channels)
    return names if any(names) else (), tuple(hex_color(c.get("color")) for c in channels)
