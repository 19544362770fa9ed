"""Gaussians that carry values, under a function: on the data values that their file says, without the volume."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import Gaussians, PlyHeader, PlyOptions
from vvgt_cli.gaussians.header import FileFacts
from vvgt_cli.gaussians.live import Palette, Table, seen_under, shown_by
from vvgt_cli.gaussians.live_facts import GRADIENT, LiveFacts
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.labels import LabelTable, distinct
from vvgt_cli.look.lighting import Lighting, LightOptions
from vvgt_cli.volume import Volume


@dataclass(frozen=True)
class FunctionRequest:
    """A look, as the options of commands say it.

    Attributes:
        tf: file or colour-map name, or a function; None: that which the file has.
        tf_range: "data", "rescale" or "LO,HI".
        unit_distance: a length, "paraview", "mean-spacing", or None: the function's own, else "paraview".
        labels: table of labels, its file, or "auto", of a file that carries labels; None: that which the file has.
        light: what falls on it; without options what the function's file says, else what the file was made under.
    """

    tf: str | TransferFunction | None = None
    tf_range: str = "data"
    unit_distance: str | None = None
    labels: str | LabelTable | None = None
    light: LightOptions = field(default_factory=LightOptions)


def under_function(
    gaussians: Gaussians, facts: FileFacts, tf: TransferFunction | LabelTable, options: PlyOptions
) -> Gaussians:
    """What Gaussians that carry values are under a function on data values (or labels under a table) and the light of
    ``options``, unit frame.

    Raises:
        DataError: not one of them is visible.
    """
    assert facts.live is not None
    assert facts.scale is not None
    assert options.unit_distance is not None
    table = looked_up(facts.live, tf, options.unit_distance * facts.scale)
    found = lit_by(gaussians, table, options.light)
    if not len(found):
        raise DataError(f"{tf.name}: not one of {len(gaussians)} Gaussians is visible; try another function")
    return found


def looked_up(facts: LiveFacts, tf: TransferFunction | LabelTable, unit_distance: float) -> Table | Palette:
    """A function, or a table of labels, as Gaussians look it up; opacity per unit-frame length.

    Raises:
        DataError: a label without an entry.
    """
    if not isinstance(tf, LabelTable):
        return Table.of_function(tf, facts.lo, facts.hi, unit_distance)
    entries = {label.number: label for label in tf.labels}
    return Palette.of_labels([entries[label.number] for label in facts.labels], unit_distance)


def lit_by(gaussians: Gaussians, table: Table | Palette, lighting: Lighting | None) -> Gaussians:
    """An ordinary cloud: what is visible of Gaussians that carry values, under a light in their frame."""
    seen = gaussians.take(seen_under(gaussians, table))
    assert seen.live is not None
    found = shown_by(seen, table)
    if lighting is None:
        return found
    from vvgt_cli.closed_form.relit import relit

    return relit(found, seen.live[:, GRADIENT], lighting)


def placed_function(
    name: str, header: PlyHeader | PlyOptions, function: FunctionRequest
) -> tuple[TransferFunction | LabelTable, PlyOptions]:
    """A function on the data values of a file, or a table of its labels, and how a file of its look is laid out.

    Raises:
        DataError: a file without values, a function that is none, or shows nothing of the range of values.
        UsageError: a range or a distance that is none; a function of labels, or a table of values.
    """
    from vvgt_cli.conversion.gaussian_files import layout_of
    from vvgt_cli.look import unit_distance

    if header.live is None:
        raise DataError(
            f"{name}: its Gaussians carry no values, so that they have one look alone; expected a .ply of 'vvgt "
            "convert --live'"
        )
    tf, shown = _table(name, header.live, function) if header.live.labels else _function(name, header.live, function)
    given, asked = function.labels if header.live.labels else function.tf, function.unit_distance
    if given is None and asked is None and header.unit_distance is not None:
        asked = repr(header.unit_distance)
    distance, label = unit_distance(asked, volume_of(name, header), tf if isinstance(tf, TransferFunction) else None)
    light = light_of(function.light, tf.lighting or header.light, header.space)
    old = header if isinstance(header, PlyOptions) else layout_of(header)
    options = replace(
        old, live=None, certificate=None, unit_distance=distance, unit_distance_label=label, light=light,
        sh_degree=None, function=shown.name,
    )  # fmt: skip
    return shown, options


def _function(name: str, facts: LiveFacts, function: FunctionRequest) -> tuple[TransferFunction, TransferFunction]:
    """A function as it was given, and on the data values of a file."""
    from vvgt_cli.look import check_visible, read_transfer_function, resolve
    from vvgt_cli.look.resolve import parse_tf_range

    if function.labels is not None:
        raise UsageError(f"{name}: its Gaussians carry values, not labels; give a function (--tf), not --labels")
    tf_range = parse_tf_range(function.tf_range)
    given = read_transfer_function(function.tf) if isinstance(function.tf, str) else function.tf
    tf = given or facts.tf(name)
    shown = resolve(tf, facts.statistics(), tf_range)
    check_visible(shown, facts.statistics())
    return tf, shown


def _table(name: str, facts: LiveFacts, function: FunctionRequest) -> tuple[LabelTable, LabelTable]:
    """A table of labels as it was given, twice."""
    from vvgt_cli.look.label_files import read_labels

    wrong = ["--tf"] * (function.tf is not None) + ["--tf-range"] * (function.tf_range != "data")
    if wrong:
        raise UsageError(
            f"{name}: its Gaussians carry labels, not values; leave out {' and '.join(wrong)} (--labels gives a table)"
        )
    numbers = [label.number for label in facts.labels]
    if function.labels is None:
        table = LabelTable("the labels of the file", facts.labels)
    elif function.labels == "auto":
        table = distinct(numbers)
    else:
        given = read_labels(function.labels) if isinstance(function.labels, str) else function.labels
        table = given.of(numbers, name)
    return table, table


def light_of(asked: LightOptions, preset: Lighting | None, space: str | None) -> Lighting | None:
    """The light on Gaussians that carry values, None for none.

    Raises:
        UsageError: lights that are none; shadows or occlusion, which the volume is needed for.
    """
    lighting = asked.lighting(preset, space if space in ("RAS", "LPS") else None)
    if lighting is not None and lighting.attenuated:
        raise UsageError(
            "--shadows and --ambient-occlusion need the volume, which Gaussians that carry values are shown without; "
            "leave them out"
        )
    return lighting


def volume_of(name: str, header: FileFacts) -> Volume:
    """The grid that a file is of, without values.

    Raises:
        DataError: a header that does not say where it is.
    """
    if header.live is None or header.affine is None or header.scale is None:
        raise DataError(f"{name}: its header does not say on which grid the values are; expected a file of 'vvgt'")
    affine = np.reshape(header.affine, (3, 4))
    spacing = np.linalg.norm(affine[:, :3], axis=0)
    data = np.broadcast_to(np.uint8(0), header.live.dims[::-1])
    direction = tuple((affine[:, :3] / spacing).ravel().tolist())
    x, y, z = spacing.tolist()
    return Volume(data, (x, y, z), tuple(affine[:, 3].tolist()), direction, name)


def shown(name: str, gaussians: Gaussians, header: PlyHeader, function: FunctionRequest | None) -> Gaussians:
    """The Gaussians of a file under a function that is given, as they are without.

    Raises:
        DataError, UsageError: as `placed_function` and `under_function`; a range or a distance without a function.
    """
    if function is None:
        return gaussians
    tf, options = placed_function(name, header, function)
    return under_function(gaussians, header, tf, options)
