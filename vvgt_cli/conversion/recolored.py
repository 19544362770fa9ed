"""Live Gaussians, which carry data values, under a transfer function and without the volume; their MIP and X-ray."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from difflib import get_close_matches

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.sets import SIZE, pixel_width
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.source import SourceRequest, StyledVolume
from vvgt_cli.gaussians import MIN_ALPHA, Gaussians, PlyHeader, PlyOptions
from vvgt_cli.gaussians.header import FileFacts, legend_text
from vvgt_cli.gaussians.live import LayerTables, Looks, Palette, Table, apply_look, visible_under
from vvgt_cli.gaussians.live_facts import AXIS, LiveFacts
from vvgt_cli.look import LabelTable, Lighting, LightOptions, TransferFunction, check_labels
from vvgt_cli.look.resolve import unit_of_values
from vvgt_cli.look.tables import exposed_distance
from vvgt_cli.volume import Volume

# function or label table of each layer, with its opacity unit distance (world length)
LayerLooks = Sequence[tuple[TransferFunction | LabelTable, float]]


def looks_of(source: StyledVolume) -> LayerLooks:
    """Return the looks of a source."""
    return [(layer.tf, layer.unit_distance) for layer in source.layers]


def apply_function(
    gaussians: Gaussians, facts: FileFacts, looks: LayerLooks, options: PlyOptions, empty: bool = False
) -> Gaussians:
    """Return live Gaussians under functions on data values (or labels under a table) and a light, unit frame.

    Args:
        gaussians: live Gaussians, unit frame.
        facts: header of their file.
        looks: of its layers.
        options: light and screen size of the result.
        empty: the result may be empty.

    Raises:
        DataError: none of them is visible, unless the result may be empty.
    """
    assert facts.live is not None
    assert facts.scale is not None
    table = lookup_table(facts.live, looks, facts.scale)
    visible = visible_cloud(gaussians, table, options.light, pixel_width(options.screen_size or SIZE))
    if not (len(visible) or empty):
        raise DataError(f"{names_of(looks)}: not one of {len(gaussians)} Gaussians is visible; try another function")
    return visible


def names_of(looks: LayerLooks) -> str:
    """Return the names of all layers' functions, joined."""
    return " + ".join(tf.name for tf, _ in looks)


def lookup_table(facts: LiveFacts, looks: LayerLooks, scale: float) -> Looks:
    """Build the lookup table of looks, for live Gaussians with these facts; ``scale``: unit-frame per world length."""
    tables: list[Table | Palette] = []
    for layer, (tf, distance) in zip(facts.layers, looks, strict=True):
        if isinstance(tf, LabelTable):
            entries = {label.number: label for label in tf.labels}
            tables.append(Palette.of_labels([entries[label.number] for label in layer.labels], distance * scale))
        else:
            tables.append(Table.of_function(tf, layer.lo, layer.hi, distance * scale, layer.grain))
    return tables[0] if len(tables) == 1 else LayerTables(tuple(tables))


def visible_cloud(gaussians: Gaussians, table: Looks, lighting: Lighting | None, pixel: float) -> Gaussians:
    """Return the visible ones of live Gaussians as ordinary Gaussians, under a light in their frame.

    ``pixel`` is that of `vvgt_cli.gaussians.live.apply_look`.
    """
    seen = gaussians.take(visible_under(gaussians, table, pixel))
    assert seen.live is not None
    shown = apply_look(seen, table, pixel)
    there = np.flatnonzero(shown.opacity >= MIN_ALPHA)
    return lit(shown.take(there), seen.live[there, AXIS], lighting)


def lit(gaussians: Gaussians, axis: np.ndarray, lighting: Lighting | None) -> Gaussians:
    """Return Gaussians with their colours under a light in their frame; ``axis`` (K, 3) is that of their normals."""
    from vvgt_cli.closed_form.lit import relight

    return gaussians if lighting is None else relight(gaussians, axis, lighting)


def resolve_look(name: str, header: PlyHeader | PlyOptions, function: SourceRequest) -> tuple[LayerLooks, PlyOptions]:
    """Resolve the look of each layer of a file on its values or labels, and return it with the layout of such a file.

    Args:
        name: name of the file, for errors.
        header: its header; what the request leaves open (function, table, distance, light) is that of the file.
        function: request of a look for no volume. Its ``layers`` are those of the file, by number, name or a part of
            it as their ``volume``; the others keep their looks.

    Raises:
        DataError: a file without values, an unreadable function, or one that shows nothing of the range of values.
        UsageError: an invalid range or distance; a function for labels, or a table for values.
    """
    from vvgt_cli.conversion.gaussian_files import layout_of
    from vvgt_cli.look import check_visible

    if header.live is None:
        raise DataError(
            f"{name}: its Gaussians carry no values, so their look is fixed; expected a .ply of 'vvgt convert --live'"
        )
    live, layers = header.live, header.live.layers
    if live.others:
        asked = _of_layers(name, layers, function)
        placed = [
            _layer_look(f"{name}, layer {k}", header, layer, asked.get(k, SourceRequest("")), layer.distance)
            for k, layer in enumerate(layers)
        ]
    else:
        if function.layers:
            first = function.layers[0].path
            raise UsageError(f"{name}: has one layer; expected --tf or --labels instead of --layer {first}")
        placed = [_layer_look(name, header, live, function, header.unit_distance)]
        if isinstance(alone := placed[0][1], LabelTable):
            check_labels([alone])
        else:
            check_visible(alone, live.statistics())
    light = light_of(function.light, placed[0][0] or header.light, header.space)
    looks, (_, _, distance, label) = [(shown, distance) for _, shown, distance, _ in placed], placed[0]
    tf = [shown for shown, _ in looks] if live.others else looks[0][0]
    return looks, replace(
        header if isinstance(header, PlyOptions) else layout_of(header),
        live=None, certificate=None, unit_distance=distance, unit_distance_label=label, light=light,
        sh_degree=None, function=names_of(looks), optics=None,
        legend=legend_text(tf, live.lo, live.hi, unit_of_values(live.unit, tf), live.quantity),
    )  # fmt: skip


def _layer_look(
    name: str, header: PlyHeader | PlyOptions, facts: LiveFacts, function: SourceRequest, recorded: float | None
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


def _of_layers(name: str, layers: Sequence[LiveFacts], function: SourceRequest) -> dict[int, SourceRequest]:
    """Return what is requested for each of several layers, by its number; raise UsageError for a look of them all."""
    wrong = {"--tf": function.tf, "--labels": function.labels, "--opacity-unit-distance": function.unit_distance}
    wrong["--tf-range"] = None if function.tf_range == "data" else function.tf_range
    if given := [option for option, value in wrong.items() if value is not None]:
        raise UsageError(
            f"{name}: has {len(layers)} layers, each with its own look, as --layer LAYER,tf=TF; remove "
            f"{' and '.join(given)}; {_listed(layers)}"
        )
    return {layer_number(name, layers, one.path): one for one in function.layers}


def layer_number(name: str, layers: Sequence[LiveFacts], asked: str) -> int:
    """Return the number of a layer given by number, name, or a part of its name; raise UsageError unless one fits."""
    if asked.isdecimal() and int(asked) < len(layers):
        return int(asked)
    exact = [k for k, layer in enumerate(layers) if layer.name == asked]
    numbers = exact or [k for k, layer in enumerate(layers) if asked.lower() in layer.name.lower()]
    if len(numbers) != 1:
        near = get_close_matches(asked, [layer.name for layer in layers]) if not numbers else []
        hint = f"did you mean {' or '.join(near)}?" if near else _listed(layers)
        raise UsageError(f"{name}: --layer {asked}: {len(numbers) or 'no'} layers of that name; {hint}")
    return numbers[0]


def layer_look(
    header: PlyHeader | PlyOptions, key: int | str, look: str | TransferFunction | LabelTable
) -> SourceRequest:  # fmt: skip
    """Return the request for a layer, a table for labels and a function for values; raise UsageError for no layer."""
    layers = () if header.live is None else header.live.layers
    labels = bool(layers) and bool(layers[layer_number("result", layers, str(key))].labels)
    if isinstance(look, TransferFunction) or (isinstance(look, str) and not labels):
        return SourceRequest(str(key), tf=look)
    return SourceRequest(str(key), labels=look)


def _listed(layers: Sequence[LiveFacts]) -> str:
    return "expected " + ", ".join(f"{k} ({layer.name})" for k, layer in enumerate(layers))


def _function(name: str, facts: LiveFacts, function: SourceRequest) -> tuple[TransferFunction, TransferFunction]:
    """Return a function as given, and on the data values of a file."""
    from vvgt_cli.look import read_transfer_function, resolve
    from vvgt_cli.look.resolve import parse_tf_range

    if function.labels is not None:
        raise UsageError(f"{name}: its Gaussians carry values, not labels; give a function (--tf), not --labels")
    tf_range = parse_tf_range(function.tf_range)
    given = read_transfer_function(function.tf) if isinstance(function.tf, str) else function.tf
    tf = given or facts.tf(name)
    return tf, resolve(tf, facts.statistics(), tf_range, facts.unit == "HU" or given is None)


def _table(name: str, facts: LiveFacts, function: SourceRequest) -> tuple[LabelTable, LabelTable]:
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
    name: str, gaussians: Gaussians, header: PlyHeader | PlyOptions, function: SourceRequest, empty: bool = False
) -> tuple[Gaussians, PlyOptions]:
    """Return the Gaussians of a file under a function, and the layout of a file of them.

    Raises:
        DataError, UsageError: see `resolve_look` and `apply_function`; a range or a distance without a function.
    """
    looks, options = resolve_look(name, header, function)
    return apply_function(gaussians, header, looks, options, empty), options


MIP, XRAY = "mip", "xray"
NAMES = MIP, XRAY
NO_GRAIN = 1e-6  # part of a voxel over which values cover the background: an X-ray adds up extinction
Draw = Callable[[Camera], np.ndarray]


def grey(values: np.ndarray) -> np.ndarray:
    """Return values (h, w) as an opaque picture (h, w, 4) float32."""
    picture = np.ones((*values.shape, 4), np.float32)
    picture[..., :3] = values[..., None]
    return picture


def draw_gaussians(
    name: str, gaussians: Gaussians, header: PlyHeader | PlyOptions, rule: str, function: SourceRequest | None = None,
    edge: float = 2.0,
) -> Draw:  # fmt: skip
    """Return the function that draws live Gaussians; ``edge``, of their frame, is that of `exposed_distance`.

    Raises:
        DataError: Gaussians that carry no values, labels, or several layers; see also `resolve_look`.
        UsageError: a look for a MIP, which shows the values alone.
    """
    from vvgt_cli.splat.grey import mip, xray

    facts = header.live
    if facts is None or facts.others or facts.labels:
        what = "carry no values" if facts is None else "carry labels" if facts.labels else "are of several layers"
        raise DataError(
            f"{name}: --rule {rule}: its Gaussians {what}; expected a .ply that 'vvgt convert --live' makes of one "
            "volume of values"
        )
    if rule == MIP:
        if function is not None:
            raise UsageError(f"--rule {MIP}: shows values, whatever their look; omit function and light")
        return lambda camera: grey(mip(gaussians, camera, facts.lo, facts.hi))
    tf, _ = resolve_look(name, header, function or SourceRequest(""))[0][0]
    assert isinstance(tf, TransferFunction)
    distance = exposed_distance(tf, facts.statistics(), edge)
    table = Table.of_function(tf, facts.lo, facts.hi, distance, facts.grain * NO_GRAIN)
    return lambda camera: grey(xray(gaussians, table, camera))
