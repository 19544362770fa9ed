"""Gaussians from the moments of cells: the closed rule of Variable Basis Mapping."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vvgt_cli.closed_form.cell_kernels import principal_axes
from vvgt_cli.closed_form.columns import COLOR, MASS, SEEN, SEEN_COLOR
from vvgt_cli.closed_form.surface_offset import Opaque, flattened, surface_offset
from vvgt_cli.closed_form.tree import Leaves, central
from vvgt_cli.gaussians import MAX_ALPHA, Gaussians
from vvgt_cli.gaussians.opacity import opacity_when_reshaped, peak_opacity

FLOOR = 0.05  # smallest standard deviation, in the smaller of voxel and cell edge
TRANSLUCENT_SPREAD = 2.0  # what a cell that its mass fills adds to its second moment; nothing across a sheet
OPAQUE_SPREAD = np.array([0.85, 2.6, 2.6])  # factors of the ascending principal moments of an opaque cell
FACING = 0.5  # of a filled cell's variance: so much flatter it counts along a surface's normal where axes are chosen
LEAST_ALPHA = 1e-4  # of what has some mass
DEBLUR = 0.3  # px^2 that an opaque cell gives back: the renderer's dilation adds them


@dataclass(frozen=True)
class SurfaceStyle:
    """Style in which Gaussians are laid on opaque bodies, in cell edges or pixels.

    Attributes:
        tangent: smallest standard deviation along the surface, in cell edges.
        normal: smallest standard deviation across it, in pixels.
        chord: length in pixels of a grazing ray inside the body: how many splats it meets.
        dilation: px^2 that the offset allows for: 0.3 is right at the size aimed for, 0.075 at twice that.
    """

    tangent: float
    normal: float
    chord: float
    dilation: float


SHARP = SurfaceStyle(tangent=0.05, normal=0.05, chord=15, dilation=0.3)  # rough and thin bodies
MIDDLE = SurfaceStyle(tangent=0.3, normal=0.2, chord=15, dilation=0.22)
ROUND = SurfaceStyle(tangent=0.4, normal=0.6, chord=20, dilation=0.15)  # smooth bodies: no holes at larger sizes
STYLES = {"round": ROUND, "middle": MIDDLE, "sharp": SHARP}


def cell_gaussians(leaves: Leaves, voxel: float, pixel: float, opaque: Opaque, style: SurfaceStyle) -> Gaussians:
    """Return one Gaussian a cell.

    Args:
        leaves: the cells.
        voxel: finest voxel edge, unit frame.
        pixel: a pixel's width at the volume's centre, unit frame.
        opaque: where bodies are opaque; their surfaces are moved inwards.
        style: of opaque surfaces.

    The centre is the centroid of the extinction, the covariance its second moment times a spread (1 + 2 min(1,
    12 w / H^2) where the cell is translucent, `OPAQUE_SPREAD` where it is not), the colour the seen mean, the opacity
    that of the mass (`peak_opacity`). The shortest axis of an opaque cell is its own where it is flat, else the normal
    of the surface near it.
    """
    moments = leaves.moments
    mass, mean, cov = central(moments)
    edge = np.cbrt(leaves.edge.prod(axis=1))
    solid = -np.expm1(-2 * mass / edge**2)[:, None]
    variances, axes = np.empty_like(mean), np.empty_like(cov)
    if opaque.any:
        principal_axes(flattened(opaque, mean, cov, FACING / 12 * solid[:, 0] * edge**2), variances, axes)
        variances = ((cov @ axes) * axes).sum(axis=1)
    else:
        principal_axes(cov, variances, axes)  # ascending
    variances = np.maximum(variances, 1e-20)
    thin = variances * (1 + TRANSLUCENT_SPREAD * np.minimum(1, 12 * variances / edge[:, None] ** 2))
    spread = (1 - solid) * thin + solid * (variances * OPAQUE_SPREAD - DEBLUR * pixel**2)
    spread = np.maximum(spread, (FLOOR * np.minimum(voxel, edge))[:, None] ** 2)
    if opaque.any:
        floor = np.stack([np.full_like(edge, style.normal * pixel), style.tangent * edge, style.tangent * edge], 1)
        spread = np.maximum(spread, solid * floor**2)
        reach = np.sqrt(2 * np.log(np.clip(1.43 * style.chord * pixel / edge, 1.5, 90)))  # at most 3
        mean = mean + surface_offset(
            opaque, mean, spread, axes, solid[:, 0] * reach, style.dilation * pixel**2, 6 * pixel
        )
        mean = np.clip(mean, -opaque.half, opaque.half)  # where the box cuts a body
    opacity = peak_opacity(mass, spread, pixel)
    return make_gaussians(mean, spread, axes, opacity, visible_color(moments))


def widened(gaussians: Gaussians, factor: float, pixel: float) -> Gaussians:
    """Widen by ``factor`` along all axes but the shortest, of the same mass: neighbours on a surface overlap more.

    Cells stand on a lattice: Gaussians of standard deviation s at distances a ripple by ``2 exp(-2 pi^2 s^2 / a^2)`` of
    their mean. ``pixel``: as for `peak_opacity`.
    """
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    wider = np.where(scales > scales.min(axis=1, keepdims=True), factor * scales, scales)
    opacity = np.clip(opacity_when_reshaped(gaussians.opacity, scales**2, wider**2, pixel), LEAST_ALPHA, MAX_ALPHA)
    return replace(gaussians, log_scales=np.log(wider), opacity_logits=np.log(opacity / (1 - opacity)))


def visible_color(moments: np.ndarray) -> np.ndarray:
    """Return (n, 3) mean colour as the views see it; of all the extinction where they see none."""
    mass, seen = moments[:, [MASS]], moments[:, [SEEN]]  # (n, 1)
    hidden = seen <= 1e-12 * mass
    return np.where(hidden, moments[:, COLOR] / mass, moments[:, SEEN_COLOR] / np.where(hidden, 1, seen))


def make_gaussians(
    mean: np.ndarray, variances: np.ndarray, axes: np.ndarray, opacity: np.ndarray, color: np.ndarray
) -> Gaussians:
    """Pack means (n, 3), principal variances (n, 3) with ``axes`` (n, 3, 3; columns), alpha (n,) and RGB (n, 3)."""
    opacity = np.clip(opacity, LEAST_ALPHA, MAX_ALPHA)
    return Gaussians(mean, 0.5 * np.log(variances), quaternions(axes), np.log(opacity / (1 - opacity)), color)


def quaternions(axes: np.ndarray) -> np.ndarray:
    """Return unit quaternions (w, x, y, z) (n, 4) of rotations (n, 3, 3); a reflection flips the first column."""
    m = axes.copy()
    m[np.linalg.det(axes) < 0, :, 0] *= -1
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    squares = np.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], 1)
    a, b, c = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    d, e, f = m[:, 1, 0] + m[:, 0, 1], m[:, 2, 0] + m[:, 0, 2], m[:, 2, 1] + m[:, 1, 2]
    rows = np.stack(
        [
            np.stack([squares[:, 0], a, b, c], 1),
            np.stack([a, squares[:, 1], d, e], 1),
            np.stack([b, d, squares[:, 2], f], 1),
            np.stack([c, e, f, squares[:, 3]], 1),
        ],
        axis=1,
    )  # (n, 4 candidates, 4): each row is the quaternion times four times its own component
    best = rows[np.arange(len(m)), squares.argmax(axis=1)]
    return best / np.linalg.norm(best, axis=1, keepdims=True)
