"""MIP and X-ray of live Gaussians: pictures of their values in grey."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.conversion.recolored import FunctionRequest, resolve_look
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import Gaussians, PlyHeader, PlyOptions
from vvgt_cli.gaussians.live import Table
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.tables import exposed_distance

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
    name: str, gaussians: Gaussians, header: PlyHeader | PlyOptions, rule: str, function: FunctionRequest | None = None,
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
    tf, _ = resolve_look(name, header, function or FunctionRequest())
    assert isinstance(tf, TransferFunction)
    distance = exposed_distance(tf, facts.statistics(), edge)
    table = Table.of_function(tf, facts.lo, facts.hi, distance, facts.grain * NO_GRAIN)
    return lambda camera: grey(xray(gaussians, table, camera))
