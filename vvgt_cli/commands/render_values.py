"""MIP and X-ray of a volume by the ray caster; of live Gaussians: `vvgt_cli.conversion.grey`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.conversion.grey import Draw, grey
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.field.grid import Boxes
from vvgt_cli.field.rays import HALO
from vvgt_cli.field.reader import Box, Scalars
from vvgt_cli.field.source import Source
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.tables import Optics, exposed_distance
from vvgt_cli.volume import Statistics

RAYS = 2  # along a pixel's edge
STEP = 0.25  # voxels between samples
Part = tuple[Box, np.ndarray, np.ndarray]  # voxels with a halo; the first one (3,) without it, and the end, (x, y, z)


def as_xray(source: Source) -> Source:
    """Return a volume under the extinction of its X-ray, unlit.

    Raises:
        UsageError: labels, channels or layers.
    """
    source.require_scalar_field()
    layer = source.layers[0]
    assert isinstance(layer.tf, TransferFunction)
    distance = exposed_distance(layer.tf, source.statistics, 2 / source.volume.unit_frame().scale)
    return replace(source, layers=(replace(layer, unit_distance=distance),), lighting=None)


def absorbed(draw: Draw) -> Draw:
    """Return the function that draws what is absorbed in the pictures of ``draw``."""
    return lambda camera: grey(draw(camera)[..., 3])


def mip_of(field: Blocked | Source) -> Draw:
    """Return the function that draws the MIP of a volume in blocks or in memory, for cameras in its box frame.

    Raises:
        UsageError: labels, channels or layers.
    """
    source = field.source if isinstance(field, Blocked) else field
    source.require_scalar_field()
    if isinstance(field, Blocked):
        return lambda camera: grey(_greatest(source, _blocks(field), camera))
    from vvgt_cli.dvr.scene import kernel_values

    values, slope, intercept = kernel_values(source.volume)
    whole = Box(values, None, _of_range(source.statistics, slope, intercept), np.zeros(3, np.int64))
    part = whole, whole.begin, np.array(source.volume.dims)
    return lambda camera: grey(_greatest(source, [part], camera))


def _blocks(field: Blocked) -> Iterator[Part]:
    """Yield the blocks of a volume."""
    reader, volume = field.reader, field.source.volume
    assert isinstance(reader, Scalars)
    optics = _of_range(field.source.statistics, reader.rule.slope, reader.rule.intercept)
    blocks = Boxes(volume.dims, (field.edge, field.edge, field.edge))
    for number in range(len(blocks)):
        lo, hi = blocks.at(number)
        box = reader.box(np.maximum(lo - HALO, 0), np.minimum(hi + HALO, volume.dims))
        yield replace(box, optics=optics), lo, hi


def _greatest(source: Source, parts: Iterable[Part], camera: Camera) -> np.ndarray:
    """Return the mean over a pixel of the greatest values along its rays, (h, w) float32 of the range of values."""
    from vvgt_cli.dvr.march import greatest
    from vvgt_cli.dvr.render import Box as Frame
    from vvgt_cli.dvr.render import camera_arrays

    n, frame, dims = RAYS, source.volume.unit_frame(), np.array(source.volume.dims)
    larger = replace(
        camera, fx=n * camera.fx, fy=n * camera.fy, cx=n * camera.cx, cy=n * camera.cy,
        width=n * camera.width, height=n * camera.height,
    )  # fmt: skip
    rays = camera_arrays(Frame(np.array(frame.half), np.array(frame.step)), larger)
    out = np.zeros((larger.height, larger.width), np.float32)
    for box, lo, hi in parts:
        faces = np.stack([np.where(lo == 0, -np.inf, lo - 0.5), np.where(hi == dims, np.inf, hi - 0.5), dims])
        greatest(box.voxels, box.optics, faces, box.begin.astype(np.float64), *rays, STEP, out)
    mean: np.ndarray = out.reshape(camera.height, n, camera.width, n).mean(axis=(1, 3))
    return mean


def _of_range(statistics: Statistics, slope: float, intercept: float) -> Optics:
    """Return tables whose coordinate goes from 0 to 1 over the range of data values."""
    width = (statistics.hi - statistics.lo) or 1.0
    return Optics.linear(1.0)._replace(lo=(statistics.lo - intercept) / slope, inv_width=slope / width)
