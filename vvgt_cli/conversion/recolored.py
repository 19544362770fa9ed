"""Gaussians that carry values, under a function: on the data values that their file says, without the volume."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import Gaussians, PlyHeader, PlyOptions
from vvgt_cli.gaussians.header import FileFacts
from vvgt_cli.gaussians.live import Table, seen_under, shown_by
from vvgt_cli.gaussians.live_facts import GRADIENT
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.lighting import Lighting, LightOptions
from vvgt_cli.volume import Volume


@dataclass(frozen=True)
class FunctionRequest:
    """A look, as the options of commands say it.

    Attributes:
        tf: file or colour-map name, or a function; None: that which the file has.
        tf_range: "data", "rescale" or "LO,HI".
        unit_distance: a length, "paraview", "mean-spacing", or None: the function's own, else "paraview".
        light: what falls on it; without options what the function's file says, else what the file was made under.
    """

    tf: str | TransferFunction | None = None
    tf_range: str = "data"
    unit_distance: str | None = None
    light: LightOptions = field(default_factory=LightOptions)


def under_function(gaussians: Gaussians, facts: FileFacts, tf: TransferFunction, options: PlyOptions) -> Gaussians:
    """What Gaussians that carry values are under a function on data values and the light of ``options``, unit frame.

    Raises:
        DataError: not one of them is visible.
    """
    assert facts.live is not None
    assert facts.scale is not None
    assert options.unit_distance is not None
    table = Table.of(tf, facts.live.lo, facts.live.hi, options.unit_distance * facts.scale)
    found = lit_by(gaussians, table, options.light)
    if not len(found):
        raise DataError(f"{tf.name}: not one of {len(gaussians)} Gaussians is visible; try another function")
    return found


def lit_by(gaussians: Gaussians, table: Table, lighting: Lighting | None) -> Gaussians:
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
) -> tuple[TransferFunction, PlyOptions]:
    """A function on the data values of a file, and how a file of its look is laid out.

    Raises:
        DataError: a file without values, a function that is none, or shows nothing of the range of values.
        UsageError: a range or a distance that is none.
    """
    from vvgt_cli.conversion.gaussian_files import layout_of
    from vvgt_cli.look import check_visible, read_transfer_function, resolve, unit_distance
    from vvgt_cli.look.resolve import parse_tf_range

    given = read_transfer_function(function.tf) if isinstance(function.tf, str) else function.tf
    tf_range = parse_tf_range(function.tf_range)
    if header.live is None:
        raise DataError(
            f"{name}: its Gaussians carry no values, so that they have one look alone; expected a .ply of 'vvgt "
            "convert --live'"
        )
    numbers = header.live.statistics()
    tf = given or header.live.tf(name)
    shown = resolve(tf, numbers, tf_range)
    check_visible(shown, numbers)
    asked = function.unit_distance
    if given is None and asked is None and header.unit_distance is not None:
        asked = repr(header.unit_distance)
    distance, label = unit_distance(asked, volume_of(name, header), tf)
    light = light_of(function.light, tf.lighting or header.light, header.space)
    old = header if isinstance(header, PlyOptions) else layout_of(header)
    options = replace(old, live=None, unit_distance=distance, unit_distance_label=label, light=light, sh_degree=None)
    return shown, options


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
