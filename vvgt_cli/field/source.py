"""What a run starts from: a volume under a transfer function, read and checked."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from vvgt_cli.dvr.layers import Layer, common_grid, grid_of
from vvgt_cli.errors import DataError, SeveralSteps, UsageError
from vvgt_cli.field.digests import digest, volume_digest
from vvgt_cli.field.layered import AUTO, IN_MEMORY, NONE, Access, Content, content_of, is_plain, layers_of
from vvgt_cli.jit.ahead import for_grid, for_light
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.histogram import UNIT_SHARE
from vvgt_cli.look.labels import LabelTable, check_labels
from vvgt_cli.look.lighting import Lighting, LightOptions
from vvgt_cli.volume import ReadOptions, Statistics, Volume

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene
    from vvgt_cli.dvr.scene import PreparedVolume

OPTICS = 12  # hexadecimal digits of `Source.optics`
KEYS = {"tf": str, "labels": str, "distance": str, "array": str, "component": str, "channel": str, "time": int}


@dataclass(frozen=True)
class SourceRequest:
    """What to read.

    Attributes:
        volume: path, `example:NAME`, or "-" for raw values on standard input; or what is there already.
        read: how to read it.
        tf: transfer-function file or colour-map name, or a function; None makes one from the histogram.
        tf_range: "data", "rescale" or "LO,HI".
        unit_distance: a length, "paraview", "mean-spacing", or None: the function's own, else "paraview".
        statistics: what the functions' nodes follow from in place of the volume's own: those of the whole series, of
            every component.
        light: what falls on it; without options what the function's file says, else nothing.
        labels: table of its labels, the file of one, "auto", "none", or None: "auto" where it is recognised.
        layers: what is laid over it, each under its own look but the light.
    """

    volume: str | Volume | Content
    read: ReadOptions = field(default_factory=ReadOptions)
    tf: str | TransferFunction | None = None
    tf_range: str = "data"
    unit_distance: str | None = None
    statistics: tuple[Statistics, ...] = ()
    light: LightOptions = field(default_factory=LightOptions)
    labels: str | LabelTable | None = None
    layers: tuple[SourceRequest, ...] = ()

    @property
    def path(self) -> str:
        """Of the volume's file.

        Raises:
            UsageError: a volume that is there already.
        """
        if not isinstance(self.volume, str):
            raise UsageError(f"{content_of(self.volume).volumes[0].name}: a volume in memory; expected a path here")
        return self.volume

    def paths(self) -> list[str]:
        """What of it is read from files."""
        given = [self.volume, self.tf, self.labels, self.read.mask]
        given += [part for layer in self.layers for part in (layer.volume, layer.tf, layer.labels)]
        return [path for path in given if isinstance(path, str) and path not in (AUTO, NONE)]


def parse_layer(text: str, space: str | None = None) -> SourceRequest:
    """``FILE[,tf=TF][,labels=TABLE][,component=N]...``.

    Raises:
        UsageError: a key that is none.
    """
    path, *rest = re.split(r",(?=[a-z]+=)", text)
    given: dict[str, Any] = {}
    for part in rest:
        key, _, value = part.partition("=")
        if key not in KEYS or not value or (KEYS[key] is int and not value.isdecimal()):
            raise UsageError(
                f"--layer {text}: {part!r}; expected FILE and any of {', '.join(f'{k}=...' for k in KEYS)}"
            )
        given["component" if key == "channel" else key] = KEYS[key](value)
    if not path:
        raise UsageError(f"--layer {text}: no file; expected FILE, as seg.nrrd or pet.nii,tf=hot.json")
    component = given.pop("component", None)
    if component is not None and component.isdecimal():
        component = int(component)
    tf, labels, distance = (given.pop(key, None) for key in ("tf", "labels", "distance"))
    read = ReadOptions(component=component, space=space, **given)
    return SourceRequest(path, read, tf, unit_distance=distance, labels=labels)


@dataclass(frozen=True)
class Source:
    """What was read, and all that it is shown by: something of it is visible.

    Attributes:
        layers: what adds up to it; one where it is a scalar field.
        volume: the scalar field, or the grid that the layers add up on.
        statistics: of the first layer's volume.
        lighting: what falls on it, None for nothing.
        layout: the volume's, where it is known.
        series: as ``statistics``, of all frames of the series that it is one of, a layer each; else none.
    """

    layers: tuple[Layer, ...]
    volume: Volume
    statistics: Statistics
    lighting: Lighting | None = None
    layout: PreparedVolume | None = None
    series: tuple[Statistics, ...] = ()

    @property
    def overall(self) -> Statistics:
        """What frames of a series share: of all of them, else its own."""
        return self.series[0] if self.series else self.statistics

    def alone(self, number: int) -> Source:
        """Return one of the layers as a source of its own, unlit, with the statistics of the first layer."""
        layer = self.layers[number]
        return Source((layer,), layer.volume, self.statistics, series=self.series[number : number + 1])

    @property
    def volumes(self) -> list[Volume]:
        """Every volume that is read: that of each layer, and its colours."""
        return [volume for layer in self.layers for volume in (layer.volume, *(layer.colors or ()))]

    @property
    def gridded(self) -> bool:
        """Whether it is an optics grid: anything but one scalar field under a function."""
        return len(self.layers) > 1 or not self.layers[0].interpolated

    @property
    def tf(self) -> TransferFunction | LabelTable:
        """Of the first layer."""
        return self.layers[0].tf

    @property
    def unit_distance(self) -> float:
        """World length that the opacity of the first layer refers to."""
        return self.layers[0].unit_distance

    @property
    def unit_label(self) -> str:
        """How it was chosen."""
        return self.layers[0].unit_label

    @property
    def name(self) -> str:
        """Of the function, or of all layers."""
        return " + ".join(layer.name for layer in self.layers) if self.gridded else self.tf.name

    @property
    def labels_alone(self) -> bool:
        """Whether all of it is labels."""
        return all(isinstance(layer.tf, LabelTable) for layer in self.layers)

    def one_field(self) -> None:
        """Refuse an optics grid.

        Raises:
            UsageError: labels, channels or several volumes: there is no one value at a place.
        """
        if self.gridded:
            raise UsageError(
                f"{self.name}: labels, channels or layers, which have no one value at a place; expected one scalar "
                "field (--labels none takes numbers as values)"
            )

    def shown_by(self, tf: TransferFunction) -> Source:
        """The same volume under another function on data values, unlit.

        Raises:
            UsageError: an optics grid.
        """
        from vvgt_cli.look import unit_distance

        self.one_field()
        distance, label = unit_distance(None, self.volume, tf)
        layer = replace(self.layers[0], tf=tf, unit_distance=distance, unit_label=label)
        return replace(self, layers=(layer,), lighting=None)

    def labelled_by(self, tables: Sequence[LabelTable]) -> Source:
        """The same label maps under other tables, one a layer, opacity per `UNIT_SHARE` of the longest edge; unlit.

        Raises:
            UsageError: not labels alone.
        """
        if not self.labels_alone:
            raise UsageError(f"{self.name}: not labels alone; expected one label map (--labels)")
        distance = UNIT_SHARE * 2 / self.volume.unit_frame().scale
        layers = [
            replace(layer, tf=table, unit_distance=distance, unit_label=table.name)
            for layer, table in zip(self.layers, tables, strict=True)
        ]
        return replace(self, layers=tuple(layers), lighting=None)

    def look(self) -> str:
        """Digest of all that gives the volume its colours, other volumes included."""
        if isinstance(self.tf, TransferFunction) and not self.gridded:
            return digest(self.tf.opacity_nodes, self.tf.color_map)
        parts: list[Any] = []
        for layer in self.layers:
            tf = layer.tf
            parts += tf.labels if isinstance(tf, LabelTable) else (tf.opacity_nodes, tf.color_map)
            parts += [layer.unit_distance, layer.volume.affine, volume_digest(layer.volume), layer.white]
            parts += [volume_digest(band) for band in layer.colors or ()]
        return digest(*parts)

    def optics(self) -> str | None:
        """Digest of an optics grid's tables, functions and unit distances, not of its volumes; None of scalars."""
        return digest(*self._optics())[:OPTICS] if self.gridded else None

    def shown_as(self) -> str:
        """Digest of functions, tables, unit distances and light, not of any volume."""
        return digest(*self._optics(), self.lighting and self.lighting.text())[:OPTICS]

    def _optics(self) -> list[Any]:
        """Tables, functions and unit distances."""
        parts: list[Any] = []
        for layer in self.layers:
            tf = layer.tf
            if isinstance(tf, LabelTable):
                parts += [(e.number, e.color, e.opacity) for e in tf.labels if e.opacity > 0]
            else:
                parts += [tf.opacity_nodes, None if layer.colors else tf.color_map]
            parts.append(f"{layer.unit_distance:.6g}")
        return parts

    def kernels(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """The kernels of a command, of the kind of scene and light that this is."""
        lit = names if self.lighting is None else for_light(names, self.lighting.attenuated)
        return for_grid(lit) if self.gridded else lit

    def kernel_type(self) -> str:
        """Name of the type in which kernels read the volume's values."""
        from vvgt_cli.dvr.scene import kernel_type

        return "float32" if self.gridded else kernel_type(self.volume)

    def scene(self) -> Scene:
        """The volume laid out for the kernels."""
        from vvgt_cli.dvr import Scene

        if self.gridded:
            grid = grid_of(self.layers, self.volume)
            return Scene.of_grid(self.volume, self, self.unit_distance, grid, self.lighting, self.labels_alone)
        assert isinstance(self.tf, TransferFunction)
        limits = (self.statistics.lo, self.statistics.hi)
        return Scene.build(self.volume, self.tf, self.unit_distance, limits, lighting=self.lighting, layout=self.layout)


def load(request: SourceRequest, access: Access = IN_MEMORY) -> Source:
    """Read the function, then the volume, and bring them together; ``access`` reads it as a whole or in blocks.

    Raises:
        DataError: a file that is not what it must be, or a function that shows nothing of this volume.
        UsageError: options that do not fit the file.
    """
    return load_all(request, (request.tf,), access)[0]


def load_all(
    request: SourceRequest, tfs: Sequence[str | TransferFunction | None], access: Access = IN_MEMORY
) -> list[Source]:
    """One volume under each of several functions; ``request.tf`` is not used.

    Raises:
        DataError, UsageError: as `load`.
    """
    from vvgt_cli.look import check_visible, from_histogram, read_transfer_function, resolve, unit_distance
    from vvgt_cli.look.resolve import parse_tf_range

    tf_range = parse_tf_range(request.tf_range)
    functions = [
        read_transfer_function(tf) if isinstance(tf, str) else tf for tf in tfs
    ]  # small: their errors come first
    if None in functions and tf_range != "data":
        raise UsageError("--tf-range says where the nodes of a function lie; it needs --tf")
    content = access.open(request.volume, request.read)
    held = content is request.volume and access is IN_MEMORY  # for several functions
    if not is_plain(content, functions[0], request.labels, request.layers, access):
        return [_layered(request, content, tf, tf_range, access) for tf in functions]
    volume = content.volumes[0]
    unit_distance(request.unit_distance, volume)  # its errors come first
    lights = [request.light.lighting(None if tf is None else tf.lighting, volume.space) for tf in functions]
    numbers = content.statistics if held else access.statistics(volume)
    sources = []
    for tf, lighting in zip(functions, lights, strict=True):
        whole = request.statistics[0] if request.statistics else numbers
        if tf:
            shown = resolve(tf, whole, tf_range, volume.hounsfield)
        else:
            shown = from_histogram(whole, volume.hounsfield, volume.density)
        if tf is None and whole.lo == whole.hi:
            warnings.warn(
                f"{volume.name}: every voxel is {whole.lo:g}, so that only the box is seen; check --dtype, --component "
                "or --array, or give a --tf",
                stacklevel=2,
            )
        check_visible(shown, numbers)
        layer = Layer(volume, shown, *unit_distance(request.unit_distance, volume, tf or shown))
        layout = content.layout if held else None
        sources.append(Source((layer,), volume, numbers, lighting, layout, tuple(request.statistics)))
    return sources


def _layered(
    request: SourceRequest, content: Content, tf: TransferFunction | None, tf_range: str | tuple[float, float],
    access: Access,
) -> Source:  # fmt: skip
    """The optics grid that a volume and its layers add up to."""
    lighting = request.light.lighting(None if tf is None else tf.lighting, content.volumes[0].space)
    layers = layers_of(content, tf, request.labels, tf_range, request.unit_distance, request.statistics, access)
    for other in request.layers:
        try:
            inner = access.open(other.volume, other.read)
        except SeveralSteps as error:  # of a page, they are not its frames
            name, last = getattr(other.volume, "name", other.volume), error.steps - 1
            raise UsageError(
                f"{name}: {error.steps} time steps; expected one for a layer: --layer FILE,time=N (0 to {last})"
            ) from None
        layers += layers_of(inner, other.tf, other.labels, other.tf_range, other.unit_distance, access=access)
    numbers = access.statistics(layers[0].volume)
    _check_seen(layers, access)
    grid = common_grid(layers, content.stored)
    return Source(tuple(layers), grid, numbers, lighting, series=tuple(request.statistics))


def _check_seen(layers: Sequence[Layer], access: Access) -> None:
    """Refuse layers of which nothing is visible; of several one may be hidden, which is said of functions.

    Raises:
        DataError: each is transparent wherever it has values.
    """
    from vvgt_cli.look import check_visible

    seen = any(layer.shows for layer in layers)
    for layer in layers:
        if layer.shows or isinstance(layer.tf, LabelTable):
            continue
        try:
            check_visible(layer.tf, access.statistics(layer.volume))
        except DataError as error:
            if not seen:
                raise
            warnings.warn(f"{layer.volume.name}, {error}", stacklevel=4)
    check_labels([layer.tf for layer in layers])


def describe_source(source: Source) -> str:
    """One line: grid, type, values, function, unit distance."""
    volume, numbers = source.volume, source.statistics
    grid = " x ".join(map(str, volume.dims))
    holes = [f"{n} {what} (transparent)" for n, what in ((numbers.nan_count, "NaN"), (numbers.inf_count, "inf")) if n]
    values = ", ".join([f"values {numbers.lo:g} to {numbers.hi:g}", *holes])
    distance = f"opacity per {source.unit_distance:g} ({source.unit_label})"
    light = "" if source.lighting is None else f"; light {source.lighting.text()}"
    name = source.name if len(source.layers) > 1 else source.tf.name
    return f"{volume.name}: {grid} {volume.data.dtype.name}, {values}; {name}: {distance}{light}"


def volume_record(source: Source) -> dict[str, Any]:
    """The volume as reports show it."""
    volume, numbers = source.volume, source.statistics
    return {
        "name": volume.name,
        "dims": volume.dims,
        "dtype": volume.data.dtype.name,
        "spacing": volume.spacing,
        "space": volume.space or "none",
        "range": (numbers.lo, numbers.hi),
        "nan": numbers.nan_count,
        "inf": numbers.inf_count,
    }


def tf_record(source: Source, request: SourceRequest) -> dict[str, Any]:
    """The transfer function as reports show it."""
    return {
        "name": source.name if len(source.layers) > 1 else source.tf.name,
        "given": request.tf is not None,
        "tf_range": request.tf_range,
        "nodes": source.tf.node_range(),
        "unit_distance": source.unit_distance,
        "unit_distance_label": source.unit_label,
        **({} if source.lighting is None else {"light": source.lighting.text()}),
        **({"layers": [layer.name for layer in source.layers]} if source.gridded else {}),
    }
