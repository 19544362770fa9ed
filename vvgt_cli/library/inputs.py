"""Arguments of the Python API: types, the requests that they stand for, volumes made of arrays, files of results."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any, BinaryIO, Protocol, TypeAlias, TypedDict

import numpy as np

from vvgt_cli.conversion.gaussian_files import write_gaussians
from vvgt_cli.conversion.index import function_name
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.conversion.result import Result
from vvgt_cli.errors import UsageError
from vvgt_cli.field.layered import OpenedFile, open_content
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.field.source import SourceRequest, parse_layer
from vvgt_cli.gaussians.outputs import Output, claimed, write_text
from vvgt_cli.look import LabelTable, LightOptions, TransferFunction
from vvgt_cli.look.isosurfaces import with_levels
from vvgt_cli.look.label_files import table_of
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.volume import ReadOptions, Volume
from vvgt_cli.volume.arrays.beside import Neighbour, choose_grid, warn_of_curvilinear, with_neighbours
from vvgt_cli.volume.components import contiguous
from vvgt_cli.volume.dask_arrays import Chunks, is_dask, lazy
from vvgt_cli.volume.labelled import axis, described_by, labelled_volume
from vvgt_cli.volume.space import SPACES, unit_rows
from vvgt_cli.volume.stored import Stored

PathLike = str | os.PathLike[str]
VolumeLike: TypeAlias = "PathLike | Volume | OpenedFile | ReadAlready | ArrayLike | VtkImage"
LightLike = LightOptions | Mapping[str, Any] | str | Sequence[float] | Sequence[str | Sequence[float]] | None
LabelsLike = PathLike | Mapping[Any, Mapping[str, Any] | str | int] | LabelTable
LayerLike = PathLike | SourceRequest
FunctionLike = PathLike | Mapping[str, Any] | TransferFunction


class ArrayLike(Protocol):
    """An array of NumPy, Dask or xarray."""

    @property
    def shape(self) -> tuple[Any, ...]:
        """Return the shape (nz, ny, nx)."""

    @property
    def dtype(self) -> Any:
        """Return the type of values."""


class ReadAlready(Protocol):
    """A `Session`."""

    @property
    def content(self) -> OpenedFile:
        """Return the content of its volume."""


class VtkImage(Protocol):
    """A vtkImageData, or a pyvista.ImageData."""

    def GetDimensions(self) -> Any:
        """Return the dimensions (nx, ny, nz)."""


@dataclass(frozen=True)
class Look:
    """A look: function, light, labels and layers of a volume, named as the options of commands.

    Attributes:
        tf: function: a file, a matplotlib colour map's name, a mapping as a JSON file holds it, or a
            `TransferFunction`; None chooses one from the data.
        tf_range: "data", "rescale" or (lo, hi): position of the function's nodes.
        opacity_unit_distance: world length of the opacities, "paraview" or "mean-spacing"; None: the function's own.
        light: "none", "headlight", a direction (x, y, z) or its name, several of these, or `LightOptions` or a mapping
            of their attributes; None: that of the function or label table (of the first layer), as presets such as
            ct-bone have.
        labels: table of a label map: a file, a mapping {label: {"name", "color", "opacity"}} or {label: name}, "auto"
            or "none".
        layers: volumes overlaid on it: values of ``--layer``, or `SourceRequest`.
        iso: a level of an isosurface or several, as values of ``--iso``, in place of ``tf``.
    """

    tf: FunctionLike | None = None
    tf_range: str | Sequence[float] = "data"
    opacity_unit_distance: str | float | None = None
    light: LightLike = None
    labels: LabelsLike | None = None
    layers: Sequence[LayerLike] = ()
    iso: float | str | Sequence[float | str] = ()

    @classmethod
    def of(cls, look: LookLike) -> Look:
        """Return a look as it is, or one with a function alone."""
        return look if isinstance(look, Look) else cls(look)

    def asked(self) -> dict[str, Any]:
        """Return all but the layers, as attributes of a request; raise DataError for an invalid function or table."""
        distance = self.opacity_unit_distance
        levels: Sequence[object] = [self.iso] if isinstance(self.iso, str | float | Real) else list(self.iso)
        return {
            "tf": with_levels(function_of(self.tf), levels, self.labels),
            "tf_range": self.tf_range if isinstance(self.tf_range, str) else _numbers(self.tf_range),
            "unit_distance": None if distance is None else str(distance),
            "light": light_of(self.light),
            "labels": labels_of(self.labels),
        }


LookLike = Look | FunctionLike | None
LooksLike = LookLike | Sequence[LookLike] | Mapping[str, LookLike]


def looks_of(look: LooksLike) -> tuple[dict[str, Look], bool]:
    """Return looks by name, and whether several were given.

    A mapping holds several looks if all its values are functions or looks; one of a function holds lists of numbers.

    Raises:
        UsageError: there is no look, or two share a name.
        DataError: a mapping is not a function.
    """
    if isinstance(look, Mapping):
        kinds = (Look, str, os.PathLike, Mapping, TransferFunction)
        if not look or not all(isinstance(one, kinds) for one in look.values()):
            return {"": Look.of(look)}, False
        return {str(name): Look.of(one) for name, one in look.items()}, True
    if not isinstance(look, list | tuple):
        alone: Any = look  # mypy takes a str for a sequence
        return {"": Look.of(alone)}, False
    looks = [Look.of(one) for one in look]
    names = [_name_of(one.tf) for one in looks]
    if not names or len(set(names)) < len(names):
        stated = ", ".join(dict.fromkeys(names)) or "none"
        raise UsageError(
            f"{len(looks)} looks, named {stated}; expected one name each: rename a file, or pass a "
            "mapping of names to looks"
        )
    return dict(zip(names, looks, strict=True)), True


def _name_of(function: FunctionLike | None) -> str:
    """Return the name of a function, or that of its file."""
    from vvgt_cli.look import read_transfer_function

    if function is None:
        return "automatic"
    if isinstance(function, Mapping):
        return read_transfer_function(function).name
    return function.name if isinstance(function, TransferFunction) else function_name(os.fspath(function))


class Reading(TypedDict, total=False):
    """Options of reading a volume; see `vvgt_cli.volume.ReadOptions`, and `volume_in_memory` for affine and origin."""

    dims: tuple[int, int, int]
    dtype: str
    byte_order: str
    header_bytes: int
    spacing: Sequence[float]
    array: str
    component: int | str | Sequence[int | str]
    time: int
    space: str
    suv: str
    crop: str
    mask: Any
    keep_largest: float
    affine: Any
    origin: Sequence[float]


def volume_of(volume: VolumeLike, reading: Reading, name: str = "array") -> Volume:
    """Read or wrap the volume of a caller.

    Args:
        volume: a path (or ``example:NAME``), a `Volume`, or what `volume_in_memory` takes.
        reading: how to read it.
        name: name of an array, for reports.

    Raises:
        DataError: the volume is invalid or damaged.
        UsageError: an option is unknown, or does not apply.
    """
    from vvgt_cli.volume import read_volume
    from vvgt_cli.volume.registry import cut

    given: dict[str, Any] = dict(reading)
    affine, origin = given.pop("affine", None), given.pop("origin", None)
    options = _options(given)
    if isinstance(volume, Volume):
        if reading:
            raise UsageError(f"{', '.join(reading)}: the Volume is read already; remove {', '.join(reading)}")
        return volume
    if isinstance(volume, str | os.PathLike):
        if affine is not None or origin is not None:
            raise UsageError("affine and origin are for arrays, and files have their own; remove them")
        return read_volume(os.fspath(volume), options)
    whole = volume_in_memory(volume, options, origin=origin, affine=affine, name=name)
    return cut(whole, replace(options, stored=isinstance(whole.data, Stored)))


def content_of(volume: VolumeLike, reading: Reading) -> OpenedFile:
    """Return the content of a volume, of a file with colours, channels or segments, or of a `Session`.

    Errors are those of `volume_of`.
    """
    if isinstance(volume, str | os.PathLike):
        return open_content(os.fspath(volume), _options(reading))
    content = getattr(volume, "content", volume)
    if not isinstance(content, OpenedFile):
        return OpenedFile((volume_of(volume, reading),))
    if reading:
        raise UsageError(f"{', '.join(reading)}: the session's volume is read already; remove {', '.join(reading)}")
    return content


def _options(reading: Mapping[str, Any]) -> ReadOptions:
    """Return the reading options of a caller; raise UsageError if one is unknown."""
    given = dict(reading)
    if unknown := sorted(set(given) - set(Reading.__annotations__)):
        look = "; of a look: vvgt.Look(tf, ...)" if unknown[0] in Look.__annotations__ else ""
        raise UsageError(f"{unknown[0]}: unknown option{look}; expected one of {', '.join(Reading.__annotations__)}")
    if "affine" in given or "origin" in given:
        raise UsageError("affine and origin are for arrays, and files have their own; remove them")
    for key in ("dims", "spacing"):
        if given.get(key) is not None:
            if np.ndim(given[key]) != 1:
                raise UsageError(f"{key}: {given[key]!r}; expected three numbers, along x, y and z")
            given[key] = tuple(float(v) if key == "spacing" else int(v) for v in given[key])
    if not isinstance(given.get("crop", ""), str | None):
        raise UsageError(f"crop: {given['crop']!r}; expected text, as '10:200,:,:64' (x, y, z)")
    if isinstance(parts := given.get("component"), list | tuple):
        given["component"] = parts[0] if len(parts) == 1 else ",".join(map(str, parts))
    if given.get("mask") is not None and not isinstance(given["mask"], str | Volume):
        mask = given["mask"]
        if isinstance(mask, os.PathLike):
            given["mask"] = os.fspath(mask)
        else:
            values: Any = lazy(mask, "mask") if is_dask(mask) else np.asarray(mask)
            given["mask"] = Volume(values, name="mask")
    return ReadOptions(**given)


def function_of(tf: FunctionLike | None) -> str | TransferFunction | None:
    """Return a caller's function: a path or name as it is, or a mapping read as a JSON file, or raise DataError."""
    from vvgt_cli.look import read_transfer_function

    if isinstance(tf, Mapping):
        return read_transfer_function(tf)
    if not isinstance(tf, str | os.PathLike | TransferFunction | None):
        raise UsageError(f"tf: {tf!r:.80}; expected a file, a name, a mapping or a TransferFunction")
    return os.fspath(tf) if isinstance(tf, os.PathLike) else tf


def source_of(volume: VolumeLike, look: LookLike, reading: Reading) -> SourceRequest:
    """Return the request for a volume under a look; errors are those of `volume_of` and `function_of`."""
    if isinstance(volume, str | os.PathLike):  # the source opens it: colours and channels are several volumes
        source = SourceRequest(os.fspath(volume), _options(reading))
    else:
        source = SourceRequest(content_of(volume, reading))
    return with_look(source, Look.of(look))


def requests_of(
    volume: VolumeLike, look: LooksLike, reading: Reading, *, blocks: int | str | BlockOptions | None, **options: Any
) -> tuple[dict[str, ConvertRequest], bool]:
    """Return the request of each look by its name, and whether several looks were given.

    Args:
        volume: as in `convert`.
        look: as in `convert`.
        reading: as in `convert`.
        blocks: as in `convert`.
        **options: further attributes of `ConvertRequest`; paths become text.

    Raises:
        DataError, UsageError: see `source_of` and `looks_of`.
    """
    looks, several = looks_of(look)
    source = source_of(volume, None, reading)
    given = {name: os.fspath(one) if isinstance(one, os.PathLike) else one for name, one in options.items()}
    request = ConvertRequest(source, blocks=blocks_of(blocks), **given)
    return {name: replace(request, source=with_look(source, one)) for name, one in looks.items()}, several


def with_look(source: SourceRequest, look: Look) -> SourceRequest:
    """Return the request for a source's volume under a look; errors are those of `function_of`."""
    layers = tuple(x if isinstance(x, SourceRequest) else parse_layer(os.fspath(x)) for x in look.layers)
    return replace(source, **look.asked(), layers=layers)


def live_look(look: Look) -> SourceRequest | None:
    """Return the request for live Gaussians under a look, with layers as ``--layer`` of `recolor` has them.

    It is None where nothing is asked for; errors as above.
    """
    asked = with_look(SourceRequest(""), look)
    for layer in asked.layers:
        if layer == SourceRequest(layer.path) or layer.read != ReadOptions():
            raise UsageError(
                f"--layer {layer.path}: expected LAYER,tf=TF, LAYER,iso=LEVEL or LAYER,labels=TABLE, and perhaps "
                "distance=LENGTH"
            )
    return None if asked == SourceRequest("") else asked


def labels_of(labels: LabelsLike | None) -> str | LabelTable | None:
    """Return a caller's label table: a path, ``auto`` or ``none`` as it is, or a mapping read as a JSON file.

    Raise DataError for a mapping that is not a table.
    """
    if isinstance(labels, Mapping):
        entries = {str(key): dict(entry) if isinstance(entry, Mapping) else entry for key, entry in labels.items()}
        return table_of(entries, "labels")
    return os.fspath(labels) if isinstance(labels, os.PathLike) else labels


def light_of(light: LightLike) -> LightOptions:
    """Return light options as they are, or made from their attributes, a name, three numbers, or several of these."""
    if isinstance(light, LightOptions | Mapping):
        return light if isinstance(light, LightOptions) else LightOptions(**light)
    if light is None or isinstance(light, str):
        return LightOptions(() if light is None else (light,))
    lights: list[Any] = list(light)
    if all(isinstance(one, Real) for one in lights):
        lights = [lights]
    return LightOptions(tuple(p if isinstance(p, str) else _numbers(p) for p in lights))


def _numbers(values: Sequence[float]) -> str:
    """Return numbers as options have them."""
    return ",".join(repr(float(v)) for v in values)


def ply_of(ply: PathLike | Result) -> str | BinaryIO:
    """Return the path of a ``.ply``, or a result as a stream of its file."""
    if isinstance(ply, Result):
        from vvgt_cli.gaussians import as_ply

        return io.BytesIO(as_ply(ply.gaussians, replace(ply.ply, frame="unit", up="none")))
    return os.fspath(ply)


def console_of(progress: bool | Console) -> Console:
    """Return a console that prints messages and bars, or is silent; that of the command line as it is."""
    return progress if isinstance(progress, Console) else Console(quiet=not progress)


def blocks_of(blocks: int | str | BlockOptions | None) -> BlockOptions | None:
    """Return a caller's options of blocks: the voxels along an edge, "auto", or all options as they are."""
    if blocks is None or isinstance(blocks, BlockOptions):
        return blocks
    return BlockOptions(None if isinstance(blocks, str) else blocks)


def volume_in_memory(
    data: Any, options: ReadOptions, *, origin: Sequence[float] | None = None, affine: Any = None, name: str = "array"
) -> Volume:
    """Make a volume of an object; nothing is copied where its layout allows that, and no Dask array is computed.

    Args:
        data: array of three axes, (nz, ny, nx) as slices are stacked, of which masked values become NaN; an
            xarray.DataArray, whose coordinates say where its values are; or a vtkDataSet (pyvista.ImageData, ...), of
            which an image is taken as it is and a mesh is resampled.
        options: spacing (x, y, z) of an array; array, component, time, dims as of a file; ``space`` is the one that the
            affine of an array leads to.
        origin: world position of the centre of voxel (0, 0, 0), (x, y, z), of an array.
        affine: (4, 4) or (3, 4) of an array: (i, j, k, 1), i along x (the last axis), to the world; in place of spacing
            and origin. nibabel's ``img.affine`` belongs to ``img.dataobj`` transposed.
        name: for reports.

    Raises:
        DataError: not three axes, values that are not real numbers, a place that is not one.
        UsageError: options that the object does not take.
    """
    given = {"origin": origin, "affine": affine, **{key: getattr(options, key) for key in ("space", "suv", "dtype")}}
    placed = [key for key, value in given.items() if value is not None]
    if hasattr(data, "IsA") and not isinstance(data, np.ndarray):  # pyvista's arrays have the methods of VTK's
        _refuse(placed, "a VTK dataset says itself what it holds and where it is")
        from vvgt_cli.volume.vtk.leaves import dataset_volume

        return dataset_volume(data, options, name, name)
    if hasattr(data, "dims") and hasattr(data, "coords") and hasattr(data, "attrs"):
        _refuse(placed, "a DataArray says itself what it holds, and its coordinates where it is")
        return _labelled(data, options, name)
    if np.ma.is_masked(data):
        data = data.astype(np.promote_types(data.dtype, np.float32)).filled(np.nan)
    values: Any = lazy(data, name) if is_dask(data) else np.asarray(data)
    return _array(values, options, origin, affine, name)


def _refuse(given: Sequence[str], why: str) -> None:
    if given:
        raise UsageError(f"{' and '.join(given)}: {why}; leave out {' and '.join(given)}")


def _labelled(data: Any, options: ReadOptions, name: str) -> Volume:
    """Read an xarray.DataArray; one of Dask block by block, or as a whole for a magnitude or another grid."""
    if hasattr(data, "data_vars"):  # a Dataset
        described = {name for one in data.variables.values() for name in described_by(one.attrs)}
        grids = {
            str(key): (one.shape, one.dtype.name)
            for key, one in data.data_vars.items()
            if key == options.array or (one.dtype.kind in "iufb" and key not in described)
        }
        data = data[choose_grid(grids, options.array, name, "variable")]
    axes = [axis(str(dim), size) for dim, size in zip(data.dims, data.shape, strict=True)]
    label = str(data.name or name)
    beside = {
        str(key): Neighbour.of(one.shape, lambda one=one: (one.values, one.attrs), str(one.dims[0]))
        for key, one in data.coords.items()
        if one.ndim == 1
    }
    axes = with_neighbours(axes, beside, label, options.spacing is not None)
    warn_of_curvilinear([str(key) for key, one in data.coords.items() if one.ndim > 1], axes, label)
    if data.chunks is None:
        return labelled_volume(lambda index: data[index].values, data.dtype, axes, data.attrs, options, label, label)
    read = Chunks(data.data, label)
    blockwise = options.component != "magnitude" and options.dims is None
    options = replace(options, stored=blockwise)
    return labelled_volume(read, data.dtype, axes, data.attrs, options, label, label, read.largest)


def _array(values: Any, options: ReadOptions, origin: Sequence[float] | None, affine: Any, name: str) -> Volume:
    chosen = [key for key in ("array", "component", "time", "suv") if getattr(options, key) is not None]
    _refuse([*chosen, *options.raw_flags], "an array is one volume")
    if affine is not None and (options.spacing is not None or origin is not None):
        raise UsageError("affine: holds spacing and origin too; leave out those or the affine")
    if options.space is not None and affine is None:
        raise UsageError(f"space {options.space}: says where an affine leads to; give affine too")
    ready = contiguous(values) if isinstance(values, np.ndarray) and values.ndim == 3 else values
    volume = Volume(ready, options.spacing or (1.0, 1.0, 1.0), name=name)
    if origin is not None:
        volume = replace(volume, origin=tuple(map(float, origin)))
    if affine is None:
        return volume
    matrix = np.asarray(affine, dtype=np.float64)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise UsageError(f"affine: {matrix.shape} {matrix.tolist()}; expected (4, 4) or (3, 4) finite numbers")
    spacing, direction = unit_rows(matrix[:3, :3].T.tolist())
    place: dict[str, Any] = {"spacing": spacing, "direction": direction, "origin": tuple(matrix[:3, 3].tolist())}
    return replace(volume, **place, space=options.space if options.space in SPACES else None)


def written(
    make: Callable[[Run], Result], name: str, inputs: Sequence[str], output: PathLike | None,
    report: PathLike | None = None, *, overwrite: bool, progress: bool | Console, suffixes: tuple[str, ...] = (".ply",),
) -> Result:  # fmt: skip
    """Return a result, written where there is an output, and its report; both are checked before the work begins.

    Args:
        make: makes the result.
        name: of the run.
        inputs: files that are read, which no output may replace.
        output: file of Gaussians, "-" for standard output, None for none.
        report: JSON to write, likewise.
        overwrite: replace files that exist.
        progress: print messages and bars on standard error, or the console that does.
        suffixes: endings that the output may have.

    Raises:
        UsageError, DataError: see `check_outputs`.
    """
    outputs = Output.of("-o", output, suffixes, splats=True) + Output.of("--report", report, (".json",), binary=False)
    run = Run(console_of(progress), ConversionReport(name))
    with claimed(outputs, inputs, overwrite):
        result = make(run)
        if output is not None:
            write_gaussians(run, os.fspath(output), result.gaussians, result.ply, overwrite)
        run.finish()
        if report is not None:
            write_text(report, run.report.to_json(), overwrite)
    return result
