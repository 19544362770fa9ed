"""Recolouring of live Gaussians, which carry data values, under a transfer function and without the volume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vvgt_cli.cameras.sets import SIZE, pixel_width
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.source import layer_words
from vvgt_cli.gaussians import MIN_ALPHA, Gaussians, PlyHeader, PlyOptions
from vvgt_cli.gaussians.header import FileFacts, legend_text
from vvgt_cli.gaussians.live import LayerTables, Looks, Palette, Table, apply_look, visible_under
from vvgt_cli.gaussians.live_facts import AXIS, LiveFacts
from vvgt_cli.look import LabelTable, Lighting, LightOptions, TransferFunction, check_labels
from vvgt_cli.look.resolve import unit_of_values
from vvgt_cli.volume import Volume


@dataclass(frozen=True)
class FunctionRequest:
    """A look, as the options of commands give it.

    Attributes:
        tf: file or colour-map name, or a function; None: the function of the file.
        tf_range: "data", "rescale" or "LO,HI".
        unit_distance: a length, "paraview", "mean-spacing", or None: the function's own, else "paraview".
        labels: for a label map, a table of labels, its file, or "auto"; None: the table of the file.
        light: options of the light; without options that of a new look (of the first layer's), else that of the
            Gaussians' file.
        layers: for a file of several layers or channels, looks of some of them; the others keep theirs.
    """

    tf: str | TransferFunction | None = None
    tf_range: str = "data"
    unit_distance: str | None = None
    labels: str | LabelTable | None = None
    light: LightOptions = field(default_factory=LightOptions)
    layers: tuple[LayerLook, ...] = ()

    def paths(self) -> list[str]:
        """Return the paths of the files that it names."""
        given = [self.tf, self.labels, *(look for one in self.layers for look in (one.tf, one.labels))]
        return [path for path in given if isinstance(path, str) and path != "auto"]


@dataclass(frozen=True)
class LayerLook:
    """The look of one of several layers; other attributes as in `FunctionRequest`.

    Attributes:
        layer: its number, its name, or a unique part of the name.
    """

    layer: str
    tf: str | TransferFunction | None = None
    labels: str | LabelTable | None = None
    unit_distance: str | None = None


@dataclass(frozen=True)
class SeveralLooks:
    """The function or label table of each of several layers, with its opacity unit distance (world length)."""

    looks: tuple[tuple[TransferFunction | LabelTable, float], ...]

    @property
    def name(self) -> str:
        """Return the names of all layers' functions, joined."""
        return " + ".join(tf.name for tf, _ in self.looks)


Look = TransferFunction | LabelTable | SeveralLooks


def parse_layer_look(text: str) -> LayerLook:
    """Parse ``LAYER[,tf=TF][,iso=LEVEL][,labels=TABLE][,distance=D]``; raise UsageError for other texts."""
    name, *rest = layer_words(text)
    given = dict(entry.split("=", 1) for entry in rest if "=" in entry)
    unknown = set(given) - {"tf", "labels", "distance"} or len(given) < len(rest)
    if not name or not rest or unknown or not all(given.values()):
        raise UsageError(
            f"--layer {text}: expected LAYER,tf=TF, LAYER,iso=LEVEL or LAYER,labels=TABLE, and perhaps distance=LENGTH"
        )
    return LayerLook(name, given.get("tf"), given.get("labels"), given.get("distance"))


def apply_function(
    gaussians: Gaussians, facts: FileFacts, tf: Look, options: PlyOptions, empty: bool = False
) -> Gaussians:
    """Return live Gaussians under a function on data values (or labels under a table) and a light, unit frame.

    Args:
        gaussians: live Gaussians, unit frame.
        facts: header of their file.
        tf: the look.
        options: unit distance, light and screen size of the result.
        empty: the result may be empty.

    Raises:
        DataError: none of them is visible, unless the result may be empty.
    """
    assert facts.live is not None
    assert facts.scale is not None
    assert options.unit_distance is not None
    table = lookup_table(facts.live, tf, options.unit_distance, facts.scale)
    visible = visible_cloud(gaussians, table, options.light, pixel_width(options.screen_size or SIZE))
    if not (len(visible) or empty):
        raise DataError(f"{tf.name}: not one of {len(gaussians)} Gaussians is visible; try another function")
    return visible


def lookup_table(facts: LiveFacts, tf: Look, distance: float, scale: float) -> Looks:
    """Build the lookup table of a function or a label table.

    Args:
        facts: header of the live Gaussians.
        tf: the look.
        distance: opacity unit distance, world length; several looks have their own.
        scale: unit-frame lengths per world length.

    Raises:
        DataError: a label without an entry.
    """
    if isinstance(tf, SeveralLooks):
        tables = [lookup_table(one, look, own, scale) for one, (look, own) in zip(facts.layers, tf.looks, strict=True)]
        return LayerTables(tuple(table for table in tables if not isinstance(table, LayerTables)))
    if not isinstance(tf, LabelTable):
        return Table.of_function(tf, facts.lo, facts.hi, distance * scale, facts.grain)
    entries = {label.number: label for label in tf.labels}
    return Palette.of_labels([entries[label.number] for label in facts.labels], distance * scale)


def visible_cloud(gaussians: Gaussians, table: Looks, lighting: Lighting | None, pixel: float) -> Gaussians:
    """Return the visible ones of live Gaussians as ordinary Gaussians, under a light in their frame.

    ``pixel`` is that of `vvgt_cli.gaussians.live.apply_look`.
    """
    seen = gaussians.take(visible_under(gaussians, table, pixel))
    assert seen.live is not None
    shown = apply_look(seen, table, pixel)
    there = np.flatnonzero(shown.opacity >= MIN_ALPHA)
    shown, axis = shown.take(there), seen.live[there, AXIS]
    if lighting is None:
        return shown
    from vvgt_cli.closed_form.relight import relight

    return relight(shown, axis, lighting)


def resolve_look(name: str, header: PlyHeader | PlyOptions, function: FunctionRequest) -> tuple[Look, PlyOptions]:
    """Resolve a look on the data values or labels of a file, and return it with the layout of a file of that look.

    Raises:
        DataError: a file without values, an unreadable function, or one that shows nothing of the range of values.
        UsageError: an invalid range or distance; a function for labels, or a table for values.
    """
    from vvgt_cli.look import check_visible

    if header.live is None:
        raise DataError(
            f"{name}: its Gaussians carry no values, so their look is fixed; expected a .ply of 'vvgt convert --live'"
        )
    if header.live.others:
        return _several(name, header, function)
    if function.layers:
        first = function.layers[0].layer
        raise UsageError(f"{name}: has one layer; expected --tf or --labels instead of --layer {first}")
    own, shown, distance, label = _layer_look(name, header, header.live, function, header.unit_distance)
    if isinstance(shown, LabelTable):
        check_labels([shown])
    else:
        check_visible(shown, header.live.statistics())
    light = light_of(function.light, own or header.light, header.space)
    return shown, _options(header, shown, distance, label, light)


def _layer_look(
    name: str, header: PlyHeader | PlyOptions, facts: LiveFacts, function: FunctionRequest, recorded: float | None
) -> tuple[Lighting | None, TransferFunction | LabelTable, float, str]:
    """Return the light of a new look, the look on the layer's values, its unit distance, and how that was chosen.

    ``recorded`` is the unit distance in the file.
    """
    from vvgt_cli.look import unit_distance

    tf, shown = _table(name, facts, function) if facts.labels else _function(name, facts, function)
    given, asked = function.labels if facts.labels else function.tf, function.unit_distance
    if given is None and asked is None and recorded is not None:
        asked = repr(recorded)
    distance = unit_distance(asked, grid_of(name, header), tf if isinstance(tf, TransferFunction) else None)
    return None if given is None else tf.lighting, shown, *distance


def _options(
    header: PlyHeader | PlyOptions, shown: Look, distance: float, label: str, light: Lighting | None
) -> PlyOptions:
    """Return the layout of a file of a look."""
    from vvgt_cli.conversion.gaussian_files import layout_of

    old, live = header if isinstance(header, PlyOptions) else layout_of(header), header.live
    tf = [one for one, _ in shown.looks] if isinstance(shown, SeveralLooks) else shown
    unit = "" if live is None else unit_of_values(live.unit, tf)
    return replace(
        old, live=None, certificate=None, unit_distance=distance, unit_distance_label=label, light=light,
        sh_degree=None, function=shown.name, optics=None,
        legend=None if live is None else legend_text(tf, live.lo, live.hi, unit, live.quantity),
    )  # fmt: skip


def _several(name: str, header: PlyHeader | PlyOptions, function: FunctionRequest) -> tuple[SeveralLooks, PlyOptions]:
    """Return the looks of several layers: those that are given, and the file's for the others."""
    assert header.live is not None
    layers = header.live.layers
    wrong = {"--tf": function.tf, "--labels": function.labels, "--opacity-unit-distance": function.unit_distance}
    wrong["--tf-range"] = None if function.tf_range == "data" else function.tf_range
    if given := [option for option, value in wrong.items() if value is not None]:
        raise UsageError(
            f"{name}: has {len(layers)} layers, each with its own look, as --layer LAYER,tf=TF; remove "
            f"{' and '.join(given)}; {_listed(layers)}"
        )
    asked = {layer_number(name, layers, one.layer): one for one in function.layers}
    placed = []
    for k, layer in enumerate(layers):
        one = asked.get(k, LayerLook(""))
        request = FunctionRequest(one.tf, "data", one.unit_distance, one.labels)
        placed.append(_layer_look(f"{name}, layer {k}", header, layer, request, layer.distance))
    light = light_of(function.light, placed[0][0] or header.light, header.space)
    looks = SeveralLooks(tuple((shown, distance) for _, shown, distance, _ in placed))
    return looks, _options(header, looks, *placed[0][2:], light)


def layer_number(name: str, layers: Sequence[LiveFacts], asked: str) -> int:
    """Return the number of a layer given by number, name, or a part of its name; raise UsageError unless one fits."""
    if asked.isdecimal() and int(asked) < len(layers):
        return int(asked)
    exact = [k for k, layer in enumerate(layers) if layer.name == asked]
    numbers = exact or [k for k, layer in enumerate(layers) if asked.lower() in layer.name.lower()]
    if len(numbers) != 1:
        raise UsageError(f"{name}: --layer {asked}: {len(numbers) or 'no'} layers of that name; {_listed(layers)}")
    return numbers[0]


def layer_look(
    header: PlyHeader | PlyOptions, key: int | str, look: str | TransferFunction | LabelTable
) -> LayerLook:  # fmt: skip
    """Return the look of a layer, a label table for labels and a function for values; raise UsageError for no layer."""
    layers = () if header.live is None else header.live.layers
    labels = bool(layers) and bool(layers[layer_number("result", layers, str(key))].labels)
    if isinstance(look, TransferFunction) or (isinstance(look, str) and not labels):
        return LayerLook(str(key), tf=look)
    return LayerLook(str(key), labels=look)


def _listed(layers: Sequence[LiveFacts]) -> str:
    return "expected " + ", ".join(f"{k} ({layer.name})" for k, layer in enumerate(layers))


def _function(name: str, facts: LiveFacts, function: FunctionRequest) -> tuple[TransferFunction, TransferFunction]:
    """Return a function as given, and on the data values of a file."""
    from vvgt_cli.look import read_transfer_function, resolve
    from vvgt_cli.look.resolve import parse_tf_range

    if function.labels is not None:
        raise UsageError(f"{name}: its Gaussians carry values, not labels; give a function (--tf), not --labels")
    tf_range = parse_tf_range(function.tf_range)
    given = read_transfer_function(function.tf) if isinstance(function.tf, str) else function.tf
    tf = given or facts.tf(name)
    return tf, resolve(tf, facts.statistics(), tf_range, facts.unit == "HU" or given is None)


def _table(name: str, facts: LiveFacts, function: FunctionRequest) -> tuple[LabelTable, LabelTable]:
    """Return the table of labels as given and as used, which are the same."""
    from vvgt_cli.look.label_files import table_for

    wrong = ["--tf"] * (function.tf is not None) + ["--tf-range"] * (function.tf_range != "data")
    if wrong:
        raise UsageError(f"{name}: its Gaussians carry labels, not values; replace {' and '.join(wrong)} by --labels")
    if function.labels is None:
        table = LabelTable("the labels of the file", facts.labels)
    else:
        table = table_for(function.labels, [label.number for label in facts.labels], name)
    return table, table


def light_of(asked: LightOptions, preset: Lighting | None, space: str | None) -> Lighting | None:
    """Return the light on live Gaussians, None for none.

    Raises:
        UsageError: invalid lights; skies, which need the volume.
    """
    lighting = asked.lighting(preset, space if space in ("RAS", "LPS") else None)
    if lighting is not None and lighting.sky is not None:
        raise UsageError(f"--light {lighting.sky}: skies need the volume, which live Gaussians are shown without")
    return lighting


def grid_of(name: str, header: FileFacts) -> Volume:
    """Return the grid of the volume of a file, without values; raise DataError if the header does not place it."""
    if header.live is None or header.affine is None or header.scale is None:
        raise DataError(f"{name}: its header does not describe the grid of the values; expected a file of 'vvgt'")
    affine = np.reshape(header.affine, (3, 4))
    spacing = np.linalg.norm(affine[:, :3], axis=0)
    data = np.broadcast_to(np.uint8(0), header.live.dims[::-1])
    direction = tuple((affine[:, :3] / spacing).ravel().tolist())
    x, y, z = spacing.tolist()
    return Volume(data, (x, y, z), tuple(affine[:, 3].tolist()), direction, name)


def recolored(
    name: str, gaussians: Gaussians, header: PlyHeader, function: FunctionRequest | None, empty: bool = False
) -> Gaussians:
    """Return the Gaussians of a file under the function that is given, unchanged without one.

    Raises:
        DataError, UsageError: see `resolve_look` and `apply_function`; a range or a distance without a function.
    """
    if function is None:
        return gaussians
    tf, options = resolve_look(name, header, function)
    return apply_function(gaussians, header, tf, options, empty)
