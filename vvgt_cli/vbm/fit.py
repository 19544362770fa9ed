"""What views can mend in closed-form Gaussians without moving them: cells split by error, colours by least squares."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.splat import Projection, blend, gather, project, render
from vvgt_cli.splat.rules import INRIA, Rule

SEEN = 1e-2  # blending weight (pixels, over all views) below which views say nothing about a splat
PRIOR = 1.0  # pixels of weight that the closed form's colour counts for
ROUNDS = 6
ENOUGH = 0.005  # share of the squared error below which another round is not worth its time
BRIGHTEST = 2.0  # colours are kept in [0, 2]: more would flare up where other views thin the splats in front

Progress = Callable[[int, int], None]


def image_errors(gaussians: Gaussians, cameras: Sequence[Camera], views: np.ndarray, rule: Rule = INRIA) -> np.ndarray:
    """(K,) sum over views and pixels of blending weight x absolute error of RGB and alpha; ``views`` (n, h, w, 4)."""
    sums = np.zeros((len(gaussians), 5))
    for camera, view in zip(cameras, views, strict=True):
        projection = project(gaussians, camera, rule)
        error = np.abs(view - render(gaussians, camera, projection=projection)).sum(axis=-1)
        gather(projection, np.ascontiguousarray(np.broadcast_to(error, (4, *error.shape)), np.float32), sums)
    return sums[:, 1]


def solve_colors(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    views: np.ndarray,
    rounds: int = ROUNDS,
    progress: Progress | None = None,
    twice_every: int = 0,
    rule: Rule = INRIA,
) -> Gaussians:
    """Least-squares colours by preconditioned conjugate gradients: images are linear in them.

    Minimises ``sum |blend(c) - view|^2 + PRIOR |c - c0|^2`` over all views and RGB; ``views`` (n, h, w, 4) float32
    premultiplied. The preconditioner is the blending weight of each splat, so that one round is the normalised
    back-projection of the residual. Rounds end early where one lowers the squared error by less than `ENOUGH`. Every
    ``twice_every``-th view (0: none) counts as seen at twice its size; ``rule`` is that of the views.
    """
    count = len(gaussians)
    projections = [
        project(gaussians, camera, rule.at(0.5) if twice_every and i % twice_every == twice_every - 1 else rule)
        for i, camera in enumerate(cameras)
    ]
    start = gaussians.colors.astype(np.float64)
    colors = start.copy()
    residuals = [_residual(p, view, colors) for p, view in zip(projections, views, strict=True)]
    sums = _back(projections, residuals, count)
    weight = np.maximum(sums[:, :1], SEEN) + PRIOR
    gradient = sums[:, 1:4]  # (K, 3)
    direction = gradient / weight
    slope = (gradient * direction).sum(axis=0)
    error = sum(float(np.vdot(r, r)) for r in residuals)
    for done in range(rounds):
        images = [_forward(p, direction, view.shape) for p, view in zip(projections, views, strict=True)]
        curvature = sum((image.astype(np.float64) ** 2).sum(axis=(0, 1)) for image in images)
        curvature = curvature + PRIOR * (direction**2).sum(axis=0)
        length = np.where(curvature > 0, slope / np.where(curvature > 0, curvature, 1), 0)
        colors += length * direction
        gained = float((length * slope).sum())  # an exact line search lowers the squared error by this
        last = done == rounds - 1 or gained <= ENOUGH * error
        if progress:
            progress(rounds if last else done + 1, rounds)
        if last:
            break
        error -= gained
        for residual, image in zip(residuals, images, strict=True):
            residual -= length.astype(np.float32) * image
        gradient = _back(projections, residuals, count)[:, 1:4] - PRIOR * (colors - start)
        scaled = gradient / weight
        new = (gradient * scaled).sum(axis=0)
        direction = scaled + np.where(slope > 0, new / np.where(slope > 0, slope, 1), 0) * direction
        slope = new
    return Gaussians(
        gaussians.means,
        gaussians.log_scales,
        gaussians.quaternions,
        gaussians.opacity_logits,
        np.clip(colors, 0, BRIGHTEST),
    )


def _forward(projection: Projection, colors: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """RGB image (h, w, 3) of signed colours."""
    return blend(projection, np.ascontiguousarray(colors, np.float32), shape[0], shape[1])[..., :3]


def _residual(projection: Projection, view: np.ndarray, colors: np.ndarray) -> np.ndarray:
    result: np.ndarray = view[..., :3] - _forward(projection, colors, view.shape)
    return result


def _back(projections: Sequence[Projection], images: Sequence[np.ndarray], count: int) -> np.ndarray:
    """(K, 5): blending weights, then the adjoint of `_forward` in columns 1 to 3."""
    sums = np.zeros((count, 5))
    for projection, image in zip(projections, images, strict=True):
        fields = np.zeros((4, *image.shape[:2]), np.float32)
        fields[:3] = image.transpose(2, 0, 1)
        gather(projection, fields, sums)
    return sums
