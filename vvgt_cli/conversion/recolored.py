"""Gaussians that carry values, under a function: on the data values that their file says, without the volume."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians, PlyHeader, PlyOptions
from vvgt_cli.gaussians.header import FileFacts
from vvgt_cli.gaussians.live import Table, shown_by
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.volume import Volume


@dataclass(frozen=True)
class FunctionRequest:
    """A function, as the options of commands say it.

    Attributes:
        tf: file or colour-map name, or a function.
        tf_range: "data", "rescale" or "LO,HI".
        unit_distance: a length, "paraview", "mean-spacing", or None: the function's own, else "paraview".
    """

    tf: str | TransferFunction
    tf_range: str = "data"
    unit_distance: str | None = None


def under_function(gaussians: Gaussians, facts: FileFacts, tf: TransferFunction, options: PlyOptions) -> Gaussians:
    """What Gaussians that carry values are under a function on data values, unit frame.

    Raises:
        DataError: not one of them is visible.
    """
    assert facts.live is not None
    assert facts.scale is not None
    assert options.unit_distance is not None
    table = Table.of(tf, facts.live.lo, facts.live.hi, options.unit_distance * facts.scale)
    found = shown_by(gaussians, table)
    if not len(found):
        raise DataError(f"{tf.name}: not one of {len(gaussians)} Gaussians is visible; try another function")
    return found


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

    tf = read_transfer_function(function.tf) if isinstance(function.tf, str) else function.tf
    tf_range = parse_tf_range(function.tf_range)
    if header.live is None:
        raise DataError(
            f"{name}: its Gaussians carry no values, so that they have one look alone; expected a .ply of 'vvgt "
            "convert --live'"
        )
    numbers = header.live.statistics()
    shown = resolve(tf, numbers, tf_range)
    check_visible(shown, numbers)
    distance, label = unit_distance(function.unit_distance, volume_of(name, header), tf)
    old = header if isinstance(header, PlyOptions) else layout_of(header)
    options = replace(old, live=None, unit_distance=distance, unit_distance_label=label, function=shown.name)
    return shown, options


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
