"""Surfaces of opaque bodies: how far a splat must lie inside, so that the pictures' silhouettes stay where they are.

A grazing ray meets several splats one behind the other; with all of them together it is half covered at a distance of
``z sqrt(n' S n + dilation)`` outside their centres, z = sqrt(2 ln(1.43 x splats met)). The centres are moved inwards by
what is missing to that distance, never past the middle of the body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vvgt_cli.closed_form.columns import MASS
from vvgt_cli.closed_form.moments import Cells
from vvgt_cli.closed_form.visibility import summed
from vvgt_cli.dvr.kernel import sample
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations

OPAQUE_DEPTH = 5.0  # optical depth a voxel at which a cell counts as wholly opaque; half of it is the surface
SURFACE = 0.5  # of that
LABEL_DEPTH = 1.0  # the same of labels that are opaque somewhere: extinction rises linearly from the empty voxel before
# their surface on, and a ray that grazes it goes through many voxels: half covered where it has hardly begun
MAX_FIELD = 1 << 26  # cells of the opacity field; finer scenes are averaged down to it
FLAT = 0.02  # change of opacity over a cell below which there is no surface to speak of


@dataclass(frozen=True)
class Opaque:
    """Saturated opacity on the grid of base cells.

    Attributes:
        field: (nz, ny, nx) float32 in [0, 1], min(1, optical depth a voxel / 5), of labels / 1.
        smooth: the same, blurred by the binomial [1, 4, 6, 4, 1] / 16 along each axis, for normals.
        edge: (3,) cell edge (x, y, z), unit frame.
        half: (3,) half extents of the box.
    """

    field: np.ndarray
    smooth: np.ndarray
    edge: np.ndarray
    half: np.ndarray

    @property
    def any(self) -> bool:
        """Whether any cell lies inside an opaque body."""
        return self.field.size > 0

    def within(self, points: np.ndarray) -> np.ndarray:
        """Return points (n, 3), unit frame, in cells from the centre of the first."""
        return (points + self.half) / self.edge - 0.5


def opaque_field(cells: Cells, step: np.ndarray, half: np.ndarray, labels: bool = False) -> Opaque:
    """Find where the scene, perhaps one of ``labels``, is opaque: empty fields where it is nowhere."""
    depth = opaque_depth(cells.moments[:, MASS], cells.edge, step)
    if not len(depth) or depth.max() < SURFACE:
        return nowhere(cells.edge, half)
    wider = field_coarsening(cells.edge, half, MAX_FIELD)
    edge = cells.edge * 2.0**wider
    shape = np.ceil(2 * half / edge - 1e-6).astype(np.int64)
    field = summed(cells.index, covered(depth, labels) / 8.0**wider, wider, shape).astype(np.float32)
    return smoothed(field, edge, half)


def nowhere(edge: np.ndarray, half: np.ndarray) -> Opaque:
    """Return the `Opaque` of a scene without opaque bodies."""
    none = np.empty((0, 0, 0), np.float32)
    return Opaque(none, none, edge, half)


def opaque_depth(mass: np.ndarray, edge: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return (n,) opacity of cells of ``mass`` (n,), 1 and more where opaque; edges of cell and voxel (3,)."""
    return mass / edge.prod() * (float(step.mean()) / OPAQUE_DEPTH)


def covered(depth: np.ndarray, labels: bool) -> np.ndarray:
    """Return (n,) the saturated opacity of cells of `opaque_depth`, all of ``labels`` or not."""
    return np.minimum(depth * (OPAQUE_DEPTH / LABEL_DEPTH if labels else 1.0), 1)


def field_coarsening(edge: np.ndarray, half: np.ndarray, most: int) -> int:
    """Return the power of two by which the field's cells are wider than ``edge`` (3,), for at most ``most``."""
    wider = 0
    while math.prod(np.ceil(2 * half / (edge * 2.0**wider) - 1e-6)) > most:
        wider += 1
    return wider


def smoothed(field: np.ndarray, edge: np.ndarray, half: np.ndarray) -> Opaque:
    """Return the `Opaque` of a ``field`` (nz, ny, nx) float32 of cells of ``edge`` (3,)."""
    smooth, other = field, np.empty_like(field)
    for dz, dy, dx in 2 * ((1, 0, 0), (0, 1, 0), (0, 0, 1)):
        target = np.empty_like(field) if smooth is field else other
        _blur(smooth, dz, dy, dx, target)
        smooth, other = target, other if smooth is field else smooth
    return Opaque(field, smooth, edge, half)


@parallel_kernel("f4:3 i8 i8 i8 f4:3")
def _blur(thread: ThreadSlice, field: np.ndarray, dz: int, dy: int, dx: int, out: np.ndarray) -> None:
    """Blur by [1, 2, 1] / 4 along the axis of which d is 1, edges clamped; ``field`` and ``out`` (nz, ny, nx)."""
    nz, ny, nx = field.shape
    for k in iterations(thread, nz):
        for j in range(ny):
            before = field[max(k - dz, 0), max(j - dy, 0)]
            after = field[min(k + dz, nz - 1), min(j + dy, ny - 1)]
            for i in range(nx):
                beside = before[max(i - dx, 0)] + after[min(i + dx, nx - 1)]
                out[k, j, i] = np.float32(0.5) * field[k, j, i] + np.float32(0.25) * beside


@inlined()
def _run(
    field: np.ndarray, x: float, y: float, z: float, dx: float, dy: float, dz: float, limit: int, inside: bool
) -> int:
    """Count steps along d, from 1 to ``limit``, until the field leaves (``inside``) or enters the body; limit if never.

    ``field`` (nz, ny, nx); the point and d in its cells, (x, y, z).
    """
    for i in range(1, limit):
        if (sample(field, x + i * dx, y + i * dy, z + i * dz) >= 0.5) != inside:
            return i - 1
    return limit


@inlined()
def _inwards(smooth: np.ndarray, x: float, y: float, z: float, edge: np.ndarray) -> tuple[float, float, float, float]:
    """Return the unit vector up the gradient of ``smooth`` (nz, ny, nx) at (x, y, z), in its cells, and its length.

    The length is twice that of the gradient; where it is 0 the vector is, too.
    """
    gx = (sample(smooth, x + 1, y, z) - sample(smooth, x - 1, y, z)) / edge[0]
    gy = (sample(smooth, x, y + 1, z) - sample(smooth, x, y - 1, z)) / edge[1]
    gz = (sample(smooth, x, y, z + 1) - sample(smooth, x, y, z - 1)) / edge[2]
    norm = math.sqrt(gx * gx + gy * gy + gz * gz)
    scale = 1 / norm if norm > 0 else 0.0
    return gx * scale, gy * scale, gz * scale, norm


@parallel_kernel("f4:3 f8:2 f8:1 f8:1 f8:3")
def _flatten(
    thread: ThreadSlice, smooth: np.ndarray, at: np.ndarray, edge: np.ndarray, by: np.ndarray, cov: np.ndarray
) -> None:
    """Take ``by`` (n,) times n n' off ``cov`` (n, 3, 3), n the normal of a surface ``at`` places (n, 3); else nothing.

    ``smooth``, ``edge`` (3,) of `Opaque`; places in its cells (`Opaque.within`).
    """
    small = min(edge[0], edge[1], edge[2])
    for k in iterations(thread, at.shape[0]):
        x, y, z = at[k, 0], at[k, 1], at[k, 2]
        normal = np.empty(3)
        normal[0], normal[1], normal[2], norm = _inwards(smooth, x, y, z, edge)
        if norm * small < FLAT:
            continue
        for i in range(3):
            for j in range(3):
                cov[k, i, j] -= by[k] * normal[i] * normal[j]


@parallel_kernel("f4:3 f4:3 f8:2 f8:1 f8:3 f8:1 f8 f8 f8:2")
def _shift(
    thread: ThreadSlice,
    field: np.ndarray, smooth: np.ndarray, at: np.ndarray, edge: np.ndarray, cov: np.ndarray, reach: np.ndarray,
    dilation: float, far: float, out: np.ndarray,
) -> None:  # fmt: skip
    """Write `surface_offset` into ``out`` (n, 3): ``field``, ``smooth``, ``edge`` (3,) of `Opaque`.

    Places ``at`` (n, 3) in its cells; ``cov`` (n, 3, 3), ``reach`` (n,) standard deviations, ``dilation``, ``far``:
    unit frame.
    """
    small = min(edge[0], edge[1], edge[2])
    stride = 0.25 * small
    limit = int(far / stride)
    for k in iterations(thread, at.shape[0]):
        x, y, z = at[k, 0], at[k, 1], at[k, 2]
        gx, gy, gz, norm = _inwards(smooth, x, y, z, edge)
        if norm * small < FLAT:
            continue
        across = (
            gx * (cov[k, 0, 0] * gx + 2 * cov[k, 0, 1] * gy + 2 * cov[k, 0, 2] * gz)
            + gy * (cov[k, 1, 1] * gy + 2 * cov[k, 1, 2] * gz)
            + gz * gz * cov[k, 2, 2]
        )
        wanted = reach[k] * math.sqrt(across + dilation)
        dx, dy, dz = gx * stride / edge[0], gy * stride / edge[1], gz * stride / edge[2]
        if sample(field, x, y, z) >= 0.5:
            depth = _run(field, x, y, z, -dx, -dy, -dz, limit, True)
            ahead = _run(field, x, y, z, dx, dy, dz, 2 * limit, True)
        else:
            depth = -(_run(field, x, y, z, dx, dy, dz, limit, False) + 1)
            if -depth > limit:
                continue  # no body near
            ahead = -depth + _run(field, x - depth * dx, y - depth * dy, z - depth * dz, dx, dy, dz, 2 * limit, True)
        missing = wanted - depth * stride
        middle = 0.5 * (ahead - depth) * stride
        move = min(missing, max(middle, 0.0))
        if move > 0:
            out[k, 0], out[k, 1], out[k, 2] = gx * move, gy * move, gz * move


def flattened(opaque: Opaque, means: np.ndarray, cov: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Reduce covariances (n, 3, 3) of cells at ``means`` (n, 3) by ``by`` (n,) along the normal of a surface there.

    Their axes are for telling which way a surface faces: what fills a cell evenly has axes of no meaning, and takes
    the surface's; what is flat by itself keeps its own. They need not be positive.
    """
    out = cov.copy()
    _flatten(opaque.smooth, opaque.within(means), opaque.edge, by, out)
    return out


def surface_offset(
    opaque: Opaque,
    means: np.ndarray,
    variances: np.ndarray,
    axes: np.ndarray,
    reach: np.ndarray,
    dilation: float,
    far: float,
) -> np.ndarray:
    """Return displacements (n, 3), unit frame, of Gaussians near the surface of an opaque body.

    Args:
        opaque: where the scene is opaque.
        means: (n, 3) of the Gaussians.
        variances: (n, 3), principal ones.
        axes: (n, 3, 3), principal axes as columns.
        reach: (n,) how many standard deviations outside its centre a Gaussian's silhouette lies.
        dilation: the renderer's, in unit-frame lengths squared.
        far: length over which a surface is looked for.
    """
    cov = (axes * variances[:, None, :]) @ axes.transpose(0, 2, 1)
    out = np.zeros_like(means)
    far = far + 3 * float(opaque.edge.max())
    _shift(opaque.field, opaque.smooth, opaque.within(means), opaque.edge, cov, reach, dilation, far, out)
    return out
