"""BigDataViewer: an XML file that places the views (setups at time points) of HDF5, N5 or OME-Zarr beside it.

Format: https://imagej.net/plugins/bdv and bigdataviewer-core; as Fiji, BigStitcher, pybdv and npy2bdv write it.
"""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from vvgt_cli.errors import DataError, UsageError, VvgtError
from vvgt_cli.volume.components import choose_component
from vvgt_cli.volume.microscopy.image import MAX_XML, choose_image, safe_xml
from vvgt_cli.volume.readers import HEAD_BYTES, lazy
from vvgt_cli.volume.reading import ReadOptions, Volume, magnitude, need, printable
from vvgt_cli.volume.space import one_unit, placed
from vvgt_cli.volume.stored import loaded

READ = {  # by the XML element that names the data: reader, and the array of time t, setup s and level l
    "hdf5": (lazy("arrays.hdf5.read_dataset"), "t{t:05d}/s{s:02d}/{l}/cells"),
    "n5": (lazy("arrays.n5.read_array"), "setup{s}/timepoint{t}/s{l}"),
    "zarr": (lazy("arrays.zarr.read_zarr"), "s{s}-t{t}.zarr/{l}"),
}
VIEW = re.compile(r"/?(?:t(?P<t>\d+)/s(?P<s>\d+)/(?P<l>\d+)/cells|setup(?P<s5>\d+)/timepoint(?P<t5>\d+)/s(?P<l5>\d+))")
MAX_TIMES, MAX_LEVELS = 1_000_000, 64
ALIKE = 1e-3  # relative difference up to which a registration has the proportions of the voxel sizes


@dataclass(frozen=True)
class _Setup:
    """A channel: its id, name, image (tile, angle, ...), stated size (x, y, z), voxel sizes and their unit."""

    number: int
    name: str = ""
    image: str = "image"
    size: Sequence[float] = ()
    spacing: Sequence[float] = ()
    unit: str = ""


@dataclass(frozen=True)
class _Dataset:
    """What an XML file says: the data, their kind (of `READ`), setups and time points; ``source`` is for messages.

    By time point and setup: ``affines`` (4, 4) from voxels to the world, views that are ``missing``, and ``groups`` of
    OME-Zarr.
    """

    source: Path
    data: Path
    kind: str
    setups: Sequence[_Setup]
    times: Sequence[int]
    affines: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)
    missing: set[tuple[int, int]] = field(default_factory=set)
    groups: dict[tuple[int, int], str] = field(default_factory=dict)

    def present(self, time: int, setup: _Setup) -> tuple[int, int]:
        """Return time and setup of a view, or of the setup's first where that one is missing."""
        views = ((t, setup.number) for t in (time, *self.times))
        if (view := next((view for view in views if view not in self.missing), None)) is None:
            raise DataError(f"{self.source}: setup {setup.number} has no values at any time point; expected some")
        return view

    def read(self, view: tuple[int, int], level: int) -> Volume:
        """Read a view's values, to stay in their file, with its place in units of its own."""
        read, array = READ[self.kind]
        group = self.groups.get(view)
        array = f"{group}/{level}" if group else array.format(t=view[0], s=view[1], l=level)
        try:
            volume: Volume = read(self.data, ReadOptions(array=array, stored=True))
        except UsageError as error:
            raise DataError(
                f"{self.source}: setup {view[1]} at time point {view[0]} is not in {self.data.name} (no {array}), nor "
                "listed as missing; expected its values: export it again, or choose another --time or --channel"
            ) from error
        return volume

    def levels(self, view: tuple[int, int]) -> list[tuple[int, ...]]:
        """List the shapes (z, y, x) of the levels of a view."""
        shapes: list[tuple[int, ...]] = []
        with suppress(VvgtError):
            while len(shapes) < MAX_LEVELS:
                shapes.append(self.read(view, len(shapes)).data.shape)
        return shapes


def read_bdv(path: Path, options: ReadOptions) -> Volume:
    """Read a channel of a time step at ``options.level``; ``options.array`` chooses among tiles, angles and so on."""
    return _read(_described(path), options)


def read_beside(path: Path, options: ReadOptions) -> Volume | None:
    """Read an HDF5 file or N5 folder by the XML file beside it; return None where BigDataViewer did not lay it out."""
    bdv = _of_data(path, options.spacing is None)
    return None if bdv is None else _read(bdv, options)


def _of_data(path: Path, tell: bool) -> _Dataset | None:
    """Return what the XML beside data says, else the views that they hold; None of data that have another layout."""
    if path.is_dir():
        kind, names = "n5", [f"{p.parent.name}/{p.name}/s0" for p in path.glob("setup*/timepoint*")]
    else:
        kind, names = "hdf5", []
        with need("h5py", "hdf5", str(path), "HDF5").File(path, "r") as file:
            if any(re.fullmatch(r"s\d+", name) and "resolutions" in file[name] for name in file):
                names = [f"{t}/{s}/0/cells" for t in file if t.startswith("t") for s in file[t]]
    views = {view[:2] for view in map(_view_of, names) if view}
    if not views:
        return None
    for xml in sorted(filter(Path.is_file, path.resolve().parent.glob("*.xml"))):
        with open(xml, "rb") as file:
            mine = b"<SpimData" in file.read(HEAD_BYTES)
        if mine and (bdv := _described(xml)).data.resolve() == path.resolve():
            return replace(bdv, source=path)
    if tell:
        warnings.warn(
            f"{path}: without the XML file of BigDataViewer that names it, voxel sizes are taken as 1; add it, or "
            "state --spacing X Y Z", stacklevel=2,
        )  # fmt: skip
    times, setups = (sorted({view[k] for view in views}) for k in (0, 1))
    return _Dataset(
        path, path, kind, [_Setup(s) for s in setups], times, missing={*itertools.product(times, setups)} - views
    )


def _view_of(name: str) -> tuple[int, int, int] | None:
    """Return time point, setup and level of an array's path."""
    match = VIEW.fullmatch(name)
    return match and tuple(int(match[key] or match[f"{key}5"]) for key in "tsl")  # type: ignore[return-value]


def _read(bdv: _Dataset, options: ReadOptions) -> Volume:
    source, setups = str(bdv.source), bdv.setups
    if view := _view_of(options.array or ""):
        setups = [one for one in setups if one.number == view[1]]
        if not setups or view[0] not in bdv.times:
            raise UsageError(f"{source}: no {options.array}; expected a view of its setups and time points")
        options = replace(options, time=bdv.times.index(view[0]), level=options.level or view[2])
    else:
        images = list(dict.fromkeys(one.image for one in setups))
        facts = [", ".join(one.name for one in setups if one.image == image) for image in images]
        chosen = images[choose_image(images, facts, options.array, "images", source)]
        setups = [one for one in setups if one.image == chosen]
    time, names = bdv.times[options.step(len(bdv.times), source)], [one.name for one in setups]
    kind = bdv.read(bdv.present(time, setups[0]), 0).data.dtype
    channel = choose_component(len(setups), kind, options.component, f"{source}:", names, channels=True)
    if channel is not None:
        volume = _view(bdv, time, setups[channel], options)
        return volume if options.stored else loaded(volume)
    parts = [loaded(_view(bdv, time, one, options)) for one in setups]
    for part in parts[1:]:
        part.check_grid(part.name, parts[0], parts[0].name, "choose one channel (--channel), not their magnitude")
    return replace(parts[0], data=magnitude([part.data for part in parts]))


def _view(bdv: _Dataset, time: int, setup: _Setup, options: ReadOptions) -> Volume:
    """Read a view, left in its file, at the place that its registration gives it."""
    view, level = bdv.present(time, setup), options.level or 0
    if level and level >= (count := len(bdv.levels(view))):
        raise UsageError(f"{bdv.source}: --level {level}: expected full, or 0 to {count - 1}")
    finest, volume = bdv.read(view, 0), bdv.read(view, level)
    if len(setup.size) and [*finest.dims] != [*setup.size]:
        dims, stated = (" x ".join(f"{n:g}" for n in some) for some in (finest.dims, setup.size))
        raise DataError(
            f"{bdv.source}: setup {setup.number} has {dims} voxels; expected {stated}, as its XML file says"
        )
    data = volume.data
    if view[0] != time:
        warnings.warn(f"{bdv.source}: setup {setup.number} is missing at time point {time}: all 0", stacklevel=2)
        data = np.zeros(data.shape, data.dtype)
    factor = np.array(volume.spacing) / finest.spacing
    shift = (np.array(volume.origin) - finest.origin) / finest.spacing
    matrix, name = _affine(bdv, time, setup), f"{bdv.data.stem}:{setup.name or setup.number}"
    steps, origin = (matrix[:3, :3] * factor).T, (matrix @ [*shift, 1.0])[:3]
    _, unit = one_unit([setup.unit], str(bdv.source), options.spacing is not None)
    return placed(data, steps, origin, options, name, unit=unit)


def _affine(bdv: _Dataset, time: int, setup: _Setup) -> np.ndarray:
    """Return the affine (4, 4) of a view, voxels to the world.

    Registrations may count in voxels, turning nothing, or in the smallest voxel size: those with the proportions of
    the voxel sizes are scaled to them. Others are taken as they are, with a message.
    """
    spacing = np.array(setup.spacing if len(setup.spacing) else (1.0, 1.0, 1.0))
    matrix: np.ndarray = bdv.affines.get((time, setup.number), np.diag([*spacing, 1.0]))
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if not len(setup.spacing) or not lengths.all():
        return matrix
    if np.array_equal(matrix[:3, :3], np.eye(3)):
        return np.asarray(np.diag([*spacing, 1.0]) @ matrix)
    ratio = spacing / lengths
    if np.ptp(ratio) <= ALIKE * ratio.max():
        return np.asarray(np.diag([ratio.mean()] * 3 + [1.0]) @ matrix)
    steps, stated = (" ".join(f"{n:.4g}" for n in some) for some in (lengths, spacing))
    warnings.warn(
        f"{bdv.source}: setup {setup.number} is registered with voxels of {steps}, which are taken, not its voxel size "
        f"{stated} (--spacing X Y Z sets it)", stacklevel=2,
    )  # fmt: skip
    return matrix


def _described(path: Path) -> _Dataset:
    """Read an XML file; raise DataError where it is damaged, states too little, or its data are not beside it."""
    if path.stat().st_size > MAX_XML:
        raise DataError(f"{path}: {path.stat().st_size} bytes; expected an XML file of at most {MAX_XML}")
    root = safe_xml(path.read_text("utf-8-sig"), str(path))
    loader = root.find("SequenceDescription/ImageLoader")
    kind = next((key for key in READ if loader is not None and loader.find(key) is not None), "")
    if loader is None or not kind:
        stated = "" if loader is None else loader.get("format", "")
        raise DataError(
            f"{path}: image loader {stated[:40]!r}; expected HDF5, N5 or OME-Zarr: resave it as one of them"
        )
    sequence: Any = root.find("SequenceDescription")
    try:
        names = {one.findtext("id"): one.findtext("name", "") for one in root.iterfind(".//Attributes/Channel")}
        setups = [_setup(one, names) for one in sequence.iterfind("ViewSetups/ViewSetup")]
        times = _times(sequence.find("Timepoints"))
        affines = {_pair(one): _product(one) for one in root.iterfind("ViewRegistrations/ViewRegistration")}
        missing = {_pair(one) for one in sequence.iterfind("MissingViews/MissingView")}
        groups = {
            _pair(one): one.get("path", "") or one.findtext("path", "") for one in loader.iterfind("zgroups/zgroup")
        }
    except (ValueError, TypeError) as error:
        raise DataError(f"{path}: damaged ({error}); expected setups, time points and registrations") from error
    if not setups or not times:
        raise DataError(f"{path}: {len(setups)} setups at {len(times)} time points; expected at least one of each")
    stated = (loader.findtext(kind) or "").strip()
    inner = PurePosixPath(stated.replace("\\", "/").removeprefix("file:"))
    homes = {path.parent.resolve(), path.resolve().parent}
    for place in (path.parent / (root.findtext("BasePath") or ".").strip() / inner, path.parent / inner.name):
        if inner.name and place.exists() and any(place.resolve().is_relative_to(home) for home in homes):
            return _Dataset(path, place, kind, setups, times, affines, missing, groups)
    raise DataError(
        f"{path}: its data {stated[:80]!r} are not beside it; expected {path.parent / printable(inner.name)}"
    )


def _setup(element: Element, channels: dict[str | None, str]) -> _Setup:
    facts = {one.tag: (one.text or "").strip() for one in element.iterfind("attributes/*")}
    channel, name = channels.get(facts.pop("channel", None), ""), element.findtext("name", "").strip()
    spacing, size = (_numbers(element.findtext(key, ""), 3) for key in ("voxelSize/size", "size"))
    if not all(n > 0 for n in (*spacing, *size)):
        raise ValueError(f"sizes {spacing}, {size}")
    name = channel if channel and (not name or name.isdigit()) else name
    image = ", ".join(f"{key} {value}" for key, value in facts.items()) or "image"
    unit = element.findtext("voxelSize/unit", "")[:40]
    return _Setup(int(element.findtext("id", "")), name[:80], image[:80], size, spacing, unit)


def _numbers(text: str | None, n: int) -> list[float]:
    """Return ``n`` finite numbers, or none of an empty text; raise ValueError."""
    numbers = [float(word) for word in (text or "").split()]
    if len(numbers) not in (0, n) or not np.isfinite(numbers).all():
        raise ValueError(f"{n} numbers {(text or '')[:80]!r}")
    return numbers


def _pair(element: Element) -> tuple[int, int]:
    """Return time point and setup of a view."""
    return int(element.get("timepoint", element.get("tp", ""))), int(element.get("setup", ""))


def _product(element: Element) -> np.ndarray:
    """Return the product (4, 4) of a view's transforms, of which the last is applied first."""
    matrix: Any = np.eye(4)
    for one in element.iterfind("ViewTransform/affine"):
        matrix = matrix @ [*np.reshape(_numbers(one.text, 12), (3, 4)), [0, 0, 0, 1]]
    return np.asarray(matrix)


def _times(element: Element | None) -> Sequence[int]:
    """List the time points of a range, a list, or a pattern such as ``0-8:2, 12``."""
    if element is None:
        return [0]
    text = {
        "range": f"{element.findtext('first')}-{element.findtext('last')}",
        "list": ",".join(one.findtext("id", "") for one in element.iterfind("timepoint")),
    }.get(element.get("type", ""), element.findtext("integerpattern", ""))
    spans = [re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*(?::\s*(\d+)\s*)?)?", part) for part in text.split(",")]
    if not all(spans):
        raise ValueError(f"time points {text[:80]!r}")
    ranges = [range(int(m[1]), int(m[2] or m[1]) + 1, int(m[3] or 1)) for m in spans if m]
    return list(itertools.islice(itertools.chain(*ranges), MAX_TIMES))
