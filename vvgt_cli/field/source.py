"""The input of a run: a volume and its look, read and checked."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from vvgt_cli.dvr.layers import Layer, common_grid, grid_of, smooth_labels
from vvgt_cli.errors import DataError, SeveralSteps, UsageError
from vvgt_cli.field.digests import digest, volume_digest
from vvgt_cli.field.layered import Access, OpenedFile, content_of, layers_of, open_content, told_apart
from vvgt_cli.jit.ahead import for_grid, for_light
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.histogram import UNIT_SHARE
from vvgt_cli.look.labels import AUTO, NO_LABELS, LabelTable, check_labels, palette
from vvgt_cli.look.lighting import Lighting, LightOptions
from vvgt_cli.volume import ReadOptions, Statistics, Volume

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene
    from vvgt_cli.dvr.scene import PreparedVolume
    from vvgt_cli.gaussians.formats.page_values import PageLayer, Values

OPTICS = 12  # hexadecimal digits of `StyledVolume.optics`
KEYS = {"tf": str, "labels": str, "distance": str, "array": str, "component": str, "channel": str, "time": int}


@dataclass(frozen=True)
class SourceRequest:
    """The volume to read, and the look to show it with.

    Attributes:
        volume: path, `example:NAME`, or "-" for raw values on standard input; or a volume in memory.
        read: how to read it.
        tf: transfer-function file, colour-map name or function; None derives one from the histogram.
        tf_range: "data", "rescale" or "LO,HI".
        unit_distance: a length, "paraview" or "mean-spacing"; None is the function's own distance, else "paraview".
        statistics: one per component, of the whole series; they replace the volume's own in placing the functions'
            nodes.
        light: lighting; by default that of the first layer's function or table, if it has any.
        labels: label table or its file, "auto" or "none"; None is "auto" for a recognised label map.
        layers: volumes laid over it, each with its own look but the same light.
    """

    volume: str | Volume | OpenedFile
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
        """Path of the volume's file; raises UsageError if the volume is already in memory."""
        if not isinstance(self.volume, str):
            raise UsageError(f"{self.content().volumes[0].name}: a volume in memory; expected a path here")
        return self.volume

    def content(self, *, stored: bool = False) -> OpenedFile:
        """Return the content of the volume's file, with values still in it if ``stored``, or the volume itself."""
        if not isinstance(self.volume, str):
            return content_of(self.volume)
        return open_content(self.volume, replace(self.read, stored=True, packed=True) if stored else self.read)

    def paths(self) -> list[str]:
        """Return the paths of all files that will be read."""
        given = [self.volume, self.tf, self.labels, self.read.mask]
        given += [part for layer in self.layers for part in (layer.volume, layer.tf, layer.labels)]
        return [path for path in given if isinstance(path, str) and path not in (AUTO, NO_LABELS)]


def layer_words(text: str) -> list[str]:
    """Split ``NAME[,KEY=VALUE]...`` into NAME, the longest that is a file if there is one, and ``KEY=VALUE``.

    ``iso=LEVEL`` is returned as ``tf=iso:LEVEL``.
    """
    words = re.split(r",(?=[a-z]+=)", text)
    n = next((k for k in range(len(words), 0, -1) if os.path.exists(",".join(words[:k]))), 1)
    return [",".join(words[:n]), *(re.sub("^iso=", "tf=iso:", word) for word in words[n:])]


def parse_layer(text: str) -> SourceRequest:
    """Parse a layer, ``FILE[,tf=TF][,iso=LEVEL][,labels=TABLE][,component=N]...``, or raise UsageError."""
    path, *rest = layer_words(text)
    given: dict[str, Any] = {}
    for part in rest:
        key, _, value = part.partition("=")
        if key not in KEYS or key in given or not value or (KEYS[key] is int and not value.isdecimal()):
            keys, part = ", ".join(f"{k}=..." for k in ("iso", *KEYS)), part.replace("tf=iso:", "iso=")
            raise UsageError(f"--layer {text}: {part!r}; expected FILE and any of {keys}")
        given["component" if key == "channel" else key] = KEYS[key](value)
    if not path:
        raise UsageError(f"--layer {text}: no file; expected FILE, as seg.nrrd or pet.nii,tf=hot.json")
    component = given.pop("component", None)
    if component is not None and component.isdecimal():
        component = int(component)
    tf, labels, distance = (given.pop(key, None) for key in ("tf", "labels", "distance"))
    read = ReadOptions(component=component, **given)
    return SourceRequest(path, read, tf, unit_distance=distance, labels=labels)


@dataclass(frozen=True)
class StyledVolume:
    """A volume that was read and its look, which leaves at least something visible.

    Attributes:
        layers: the layers that are summed; a scalar field has one.
        volume: the scalar field, or the common grid of the layers.
        statistics: statistics of the first layer's volume.
        lighting: the lighting, None for none.
        layout: the volume's layout for the kernels, where it is known.
        series: for a frame of a series, statistics over all frames, one per layer; else empty.
    """

    layers: tuple[Layer, ...]
    volume: Volume
    statistics: Statistics
    lighting: Lighting | None = None
    layout: PreparedVolume | None = None
    series: tuple[Statistics, ...] = ()

    @property
    def overall(self) -> Statistics:
        """Statistics over the whole series, or of the volume if it is not part of one."""
        return self.series[0] if self.series else self.statistics

    def single_layer(self, number: int) -> StyledVolume:
        """Return one of the layers as a source of its own, unlit, with the statistics of the first layer."""
        layer = self.layers[number]
        return StyledVolume((layer,), layer.volume, self.statistics, series=self.series[number : number + 1])

    @property
    def volumes(self) -> list[Volume]:
        """Every volume that is read: each layer's scalars and colours."""
        return [volume for layer in self.layers for volume in (layer.volume, *(layer.colors or ()))]

    @property
    def gridded(self) -> bool:
        """Whether this is an optics grid: anything other than one scalar field under a function."""
        return len(self.layers) > 1 or not self.layers[0].interpolated

    @property
    def tf(self) -> TransferFunction | LabelTable:
        """Transfer function or label table of the first layer."""
        return self.layers[0].tf

    @property
    def unit_distance(self) -> float:
        """World length that the first layer's opacity refers to."""
        return self.layers[0].unit_distance

    @property
    def unit_label(self) -> str:
        """How the unit distance was chosen."""
        return self.layers[0].unit_label

    @property
    def title(self) -> str:
        """What is shown, without naming a file or anybody: labels, or kind of scan and function; else the size."""
        from vvgt_cli.look.readers.names import names

        kind = self.volume.modality or ("CT" if self.volume.hounsfield else "")
        kind = kind or (self.volume.quantity if self.volume.value_unit else "")
        of, _, shows = self.name.partition("-") if self.name in names() else ("", "", "")
        known = [kind or (of.upper() if of in ("ct", "mr") else of), shows.replace("-", " ")]
        if self.labels_alone:
            count = sum(len(layer.tf.labels) for layer in self.layers if isinstance(layer.tf, LabelTable))
            known = [f"{count} labels" if count > 1 else "label map"]
        return ", ".join(filter(None, known)) or f"volume, {' x '.join(map(str, self.volume.dims))}"

    @property
    def name(self) -> str:
        """Name of the function, or the names of all layers."""
        return " + ".join(layer.name for layer in self.layers) if self.gridded else self.tf.name

    @property
    def look_name(self) -> str:
        """Name of the function of one layer, or the names of several."""
        return self.name if len(self.layers) > 1 else self.tf.name

    @property
    def mixed(self) -> bool:
        """Whether rays classify layers of scalars before they add them up."""
        return self.gridded and any(layer.interpolated for layer in self.layers)

    @property
    def smooth(self) -> bool:
        """Whether labels have smoothed normals: under light, with layers of scalars beside them at most."""
        return self.lighting is not None and smooth_labels(self.layers)

    @property
    def labels_alone(self) -> bool:
        """Whether every layer is a label map."""
        return all(isinstance(layer.tf, LabelTable) for layer in self.layers)

    def require_scalar_field(self) -> None:
        """Refuse an optics grid.

        Raises:
            UsageError: there are labels, channels or several layers, so a point has no single scalar value.
        """
        if self.gridded:
            raise UsageError(
                f"{self.name}: labels, channels or layers, which have no single value at a point; expected one scalar "
                "field (try --labels none to read label numbers as values)"
            )

    @property
    def page_layers(self) -> list[PageLayer | None]:
        """Layers for a page; None: one with colours."""
        from vvgt_cli.gaussians.formats.page_values import PageLayer

        known = self.overall if len(self.layers) == 1 else None
        return [
            None if layer.colors else PageLayer(layer.volume, layer.tf, layer.unit_distance, known, self.lighting)
            for layer in self.layers
        ]

    def values(self, room: float | None = None, share: int = 1) -> Values | None:
        """Return the grids of all layers for a page, read part by part; None if all layers have colours.

        ``room``: bytes that they may take there; ``share``: number of volumes on the page.
        """
        from vvgt_cli.gaussians.formats.page_values import values_of

        return values_of(self.page_layers, room, share)

    def with_function(self, tf: TransferFunction) -> StyledVolume:
        """Return the same volume under another function on data values, unlit; raise UsageError for an optics grid."""
        from vvgt_cli.look import unit_distance

        self.require_scalar_field()
        distance, label = unit_distance(None, self.volume, tf)
        layer = replace(self.layers[0], tf=tf, unit_distance=distance, unit_label=label)
        return replace(self, layers=(layer,), lighting=None)

    def with_tables(self, tables: Sequence[LabelTable]) -> StyledVolume:
        """Return the same label maps under other tables, one per layer, unlit.

        Opacity is per `UNIT_SHARE` of the longest edge.

        Raises:
            UsageError: some layer is not a label map.
        """
        if not self.labels_alone:
            raise UsageError(f"{self.name}: has layers other than labels; expected one label map (--labels)")
        distance = UNIT_SHARE * 2 / self.volume.unit_frame().scale
        layers = [
            replace(layer, tf=table, unit_distance=distance, unit_label=table.name)
            for layer, table in zip(self.layers, tables, strict=True)
        ]
        return replace(self, layers=tuple(layers), lighting=None)

    def look(self) -> str:
        """Return a digest of everything that determines the colours, other volumes included."""
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
        """Return a digest of an optics grid's tables, functions and unit distances; None for a scalar field."""
        return digest(*self._optics())[:OPTICS] if self.gridded else None

    def shown_as(self) -> str:
        """Return a digest of functions, tables, unit distances and light, but not of any volume."""
        return digest(*self._optics(), self.lighting and self.lighting.key())[:OPTICS]

    def _optics(self) -> list[Any]:
        """Return the tables, functions and unit distances as a flat list."""
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
        """Return the names of a command's kernels for this kind of scene and light."""
        light = self.lighting
        lit = names if light is None else for_light(names, light.sky is not None)
        return for_grid(lit, self.mixed) if self.gridded else lit

    def kernel_type(self) -> str:
        """Return the name of the type in which kernels read the volume's values."""
        from vvgt_cli.dvr.scene import kernel_type

        return "float32" if self.gridded else kernel_type(self.volume)

    def scene(self) -> Scene:
        """Return the volume, laid out for the kernels."""
        from vvgt_cli.dvr import Scene

        if self.gridded:
            grid = grid_of(self.layers, self.volume)
            about = self.volume, self, self.unit_distance
            return Scene.of_grid(*about, grid, self.lighting, self.labels_alone, self.layers)
        assert isinstance(self.tf, TransferFunction)
        limits = (self.statistics.lo, self.statistics.hi)
        return Scene.build(self.volume, self.tf, self.unit_distance, limits, lighting=self.lighting, layout=self.layout)


def load(request: SourceRequest, access: Access | None = None) -> StyledVolume:
    """Read the function and the volume; ``access`` decides whether the volume is read in blocks, by default whole.

    Raises:
        DataError: a file is not valid, or the function leaves the volume invisible.
        UsageError: the options do not suit the file.
    """
    from vvgt_cli.look import read_transfer_function
    from vvgt_cli.look.resolve import parse_tf_range

    # the function is small: report its errors before reading the volume
    tf = read_transfer_function(request.tf) if isinstance(request.tf, str) else request.tf
    tf_range = parse_tf_range(request.tf_range)
    if tf is None and request.tf_range != "data":
        raise UsageError("--tf-range: it places the nodes of a function; expected --tf as well")
    own = access or Access()
    content = own.open(request.volume, request.read)
    source = _styled(request, content, tf, tf_range, own)
    shared = access is None and content is request.volume and not source.gridded  # by several functions
    return replace(source, layout=content.layout) if shared else source


def _styled(
    request: SourceRequest, content: OpenedFile, tf: TransferFunction | None, tf_range: str | tuple[float, float],
    access: Access,
) -> StyledVolume:  # fmt: skip
    """Return a volume under its look; with other layers, labels or colours, the optics grid that they add up to."""
    layers = layers_of(content, tf, request.labels, tf_range, request.unit_distance, request.statistics, access)
    for other in request.layers:
        try:
            inner = access.open(other.volume, other.read, content.volumes[0])
        except SeveralSteps as error:  # a layer's time steps are not frames
            name, last = getattr(other.volume, "name", other.volume), error.steps - 1
            raise UsageError(
                f"{name}: {error.steps} time steps; expected one per layer: --layer FILE,time=N (0 to {last})"
            ) from None
        layers += layers_of(inner, other.tf, other.labels, other.tf_range, other.unit_distance, access=access)
    if request.layers:  # a frame's labels keep their looks: colours of its whole series are in use
        frames = bool(request.statistics) and isinstance(layers[0].tf, LabelTable)
        used = set(palette()[: max(int(request.statistics[0].hi), 0)] if frames else ())
        layers = [*layers[:frames], *told_apart(layers[frames:], used)]
    lighting = request.light.lighting(layers[0].tf.lighting, content.volumes[0].space)
    stats, series = access.statistics(layers[0].volume), tuple(request.statistics)
    _check_seen(layers, access, len(series))
    source = StyledVolume(tuple(layers), common_grid(layers, content.stored), stats, lighting, series=series)
    if tf is None and not source.gridded and source.overall.lo == source.overall.hi:
        warnings.warn(
            f"{source.volume.name}: every voxel is {source.overall.lo:g}, so only the box is visible; check --dtype, "
            "--component or --array, or pass --tf",
            stacklevel=3,
        )
    return source


def _check_seen(layers: Sequence[Layer], access: Access, frame: int) -> None:
    """Refuse layers that are all invisible; warn about a single invisible function among others.

    The first ``frame`` layers are those of a frame of a series, which may be dark.

    Raises:
        DataError: every layer is transparent wherever it has values, and none is a frame's.
    """
    from vvgt_cli.look import check_visible

    seen = frame > 0 or any(layer.shows for layer in layers)
    for layer in layers[frame:]:
        if layer.shows or isinstance(layer.tf, LabelTable):
            continue
        try:
            check_visible(layer.tf, access.statistics(layer.volume))
        except DataError as error:
            if not seen:
                raise
            warnings.warn(f"{layer.volume.name}, {error}", stacklevel=4)
    if not frame:
        check_labels([layer.tf for layer in layers])


def describe_source(source: StyledVolume) -> str:
    """Return one line that describes a source: grid, type, values, function, unit distance."""
    volume, stats = source.volume, source.statistics
    grid = " x ".join(map(str, volume.dims))
    holes = [f"{n} {what} (transparent)" for n, what in ((stats.nan_count, "NaN"), (stats.inf_count, "inf")) if n]
    values = ", ".join([f"values {stats.lo:g} to {stats.hi:g}", *holes])
    distance = f"opacity per {source.unit_distance:g} ({source.unit_label})"
    light = "" if source.lighting is None else f"; light {source.lighting.text()}"
    light += " (its own; --light none omits it)" if light and source.lighting == source.tf.lighting else ""
    return f"{volume.name}: {grid} {volume.data.dtype.name}, {values}; {source.look_name}: {distance}{light}"


def volume_record(source: StyledVolume) -> dict[str, Any]:
    """Return the volume's entry in a report."""
    volume, stats = source.volume, source.statistics
    return {
        "name": volume.name,
        "dims": volume.dims,
        "dtype": volume.data.dtype.name,
        "spacing": volume.spacing,
        "space": volume.space or "none",
        "range": (stats.lo, stats.hi),
        "nan": stats.nan_count,
        "inf": stats.inf_count,
    }


def tf_record(source: StyledVolume, request: SourceRequest) -> dict[str, Any]:
    """Return the transfer function's entry in a report."""
    return {
        "name": source.look_name,
        "given": request.tf is not None,
        "tf_range": request.tf_range,
        "nodes": source.tf.node_range(),
        "unit_distance": source.unit_distance,
        "unit_distance_label": source.unit_label,
        **({} if source.lighting is None else {"light": source.lighting.text()}),
        **({"layers": [layer.name for layer in source.layers]} if source.gridded else {}),
    }
