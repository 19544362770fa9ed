"""Fit closed-form Gaussians to views without moving them: cells split by error, colours by least squares.

Colours and spherical harmonics from views, solved together: pictures are linear in both.

A colour that is seen is ``x . b`` with the unknowns x (1 + M a channel: the colour, then its harmonics) and b = (1, Y),
the harmonics Y where it is seen from. The preconditioner is, of each Gaussian, the matrix ``sum w b b^T`` over views, w
its blending weight in a view: the bound of the normal equations that the weight alone is where there is one colour.

What views do not tell, the start does: ``prior |x - x0|^2``, for harmonics with a weight in pixels of `PIXELS` and, of
all that is seen of a Gaussian, `SHARE`. The mean square of a harmonic is 1/(4 pi) = 0.08.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import INRIA, Gaussians, Rule
from vvgt_cli.progress import ProgressCallback
from vvgt_cli.splat import Projection, blend, gather, project, render
from vvgt_cli.splat.render import seen_colors

SEEN = 1e-2  # blending weight (pixels, over all views) below which views say nothing about a splat
PRIOR = 1.0  # pixels of weight that the closed form's colour counts for
ROUNDS = 6
ENOUGH = 0.005  # share of the squared error below which another round is not worth its time
BRIGHTEST = 2.0  # colours are kept in [0, 2]: more would flare up where other views thin the splats in front


def weights_and_errors(
    gaussians: Gaussians, cameras: Sequence[Camera], views: np.ndarray, rule: Rule = INRIA, power: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Return (K,) sums over views (n, h, w, 4) and pixels of blending weight, and of it times errors of RGBA.

    ``power`` is that of the errors.
    """
    sums = np.zeros((len(gaussians), 5))
    for camera, view in zip(cameras, views, strict=True):
        projection = project(gaussians, camera, rule)
        error = (np.abs(view - render(gaussians, camera, projection=projection)) ** power).sum(axis=-1)
        gather(projection, np.broadcast_to(error, (4, *error.shape)), sums)
    return sums[:, 0], sums[:, 1]


def blending_weights(gaussians: Gaussians, cameras: Sequence[Camera], rule: Rule = INRIA) -> np.ndarray:
    """Sum blending weight, T alpha, over views and pixels, (K,)."""
    sums = np.zeros((len(gaussians), 5))
    for camera in cameras:
        nothing = np.zeros((4, camera.height, camera.width), np.float32)
        gather(project(gaussians, camera, rule), nothing, sums)
    return sums[:, 0]


def solve_colors(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    views: np.ndarray,
    rounds: int = ROUNDS,
    progress: ProgressCallback | None = None,
    twice_every: int = 0,
    rule: Rule = INRIA,
) -> Gaussians:
    """Solve for least-squares colours by preconditioned conjugate gradients: images are linear in them.

    Minimises ``sum |blend(c) - view|^2 + PRIOR |c - c0|^2`` over all views and RGB; ``views`` (n, h, w, 4) float32
    premultiplied. The preconditioner is the blending weight of each splat, so that one round is the normalised
    back-projection of the residual. Rounds end early where one lowers the squared error by less than `ENOUGH`. Every
    ``twice_every``-th view (0: none) counts as seen at twice its size; ``rule`` is that of the views. Colours and
    harmonics are solved together: see the module.
    """
    projections = [
        project(gaussians, camera, rule.at(0.5) if twice_every and i % twice_every == twice_every - 1 else rule)
        for i, camera in enumerate(cameras)
    ]
    if gaussians.harmonics is None:
        colors = np.clip(_descend(System(gaussians, projections), views, rounds, progress), 0, BRIGHTEST)
        return replace(gaussians, colors=colors)
    system = ViewDependentSystem(gaussians, projections, [camera.position for camera in cameras])
    return system.gaussians(_descend(system, views, rounds, progress), BRIGHTEST)


class System:
    """Pictures as a linear function of unknowns, channel by channel: one colour a Gaussian, (K, 3).

    Attributes:
        start: unknowns to begin with, float64.
    """

    def __init__(self, gaussians: Gaussians, projections: Sequence[Projection]) -> None:
        """Prepare for ``projections`` of the views."""
        self.given, self.projections = gaussians, projections
        self.start: np.ndarray = gaussians.colors.astype(np.float64)
        self.weight = np.zeros((len(gaussians), 1))

    def forward(self, view: int, unknowns: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Render the RGB picture (h, w, 3) of a view, of ``shape`` (h, w, ...); colours have signs."""
        return blend(self.projections[view], unknowns, shape[0], shape[1])[..., :3]

    def back(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Apply the adjoint of `forward`, summed over the views' ``images``; float64 like the unknowns."""
        sums = np.zeros((len(self.start), 5))
        for projection, image in zip(self.projections, images, strict=True):
            gather(projection, _fields(image), sums)
        self.weight = np.maximum(sums[:, :1], SEEN) + PRIOR
        return sums[:, 1:4]

    def pull(self, change: np.ndarray) -> np.ndarray:
        """Return half the gradient of the penalty on a ``change`` of the unknowns."""
        return PRIOR * change

    def scaled(self, gradient: np.ndarray) -> np.ndarray:
        """Return the preconditioned gradient; call `back` first."""
        return gradient / self.weight


def _descend(system: System, views: np.ndarray, rounds: int, progress: ProgressCallback | None) -> np.ndarray:
    """Return the unknowns after conjugate gradients of `solve_colors`."""
    unknowns = system.start.copy()
    rows = tuple(range(unknowns.ndim - 1))  # all axes but the channels
    residuals = [view[..., :3] - system.forward(i, unknowns, view.shape) for i, view in enumerate(views)]
    gradient = system.back(residuals)
    direction = system.scaled(gradient)
    slope = (gradient * direction).sum(axis=rows)
    error = sum(float(np.vdot(r, r)) for r in residuals)
    for done in range(rounds):
        images = [system.forward(i, direction, view.shape) for i, view in enumerate(views)]
        curvature = sum((image.astype(np.float64) ** 2).sum(axis=(0, 1)) for image in images)
        curvature = curvature + (direction * system.pull(direction)).sum(axis=rows)
        length = np.where(curvature > 0, slope / np.where(curvature > 0, curvature, 1), 0)
        unknowns += length * direction
        gained = float((length * slope).sum())  # an exact line search lowers the squared error by this
        last = done == rounds - 1 or gained <= ENOUGH * error
        if progress:
            progress(rounds if last else done + 1, rounds)
        if last:
            break
        error -= gained
        for residual, image in zip(residuals, images, strict=True):
            residual -= length.astype(np.float32) * image
        gradient = system.back(residuals) - system.pull(unknowns - system.start)
        scaled = system.scaled(gradient)
        new = (gradient * scaled).sum(axis=rows)
        direction = scaled + np.where(slope > 0, new / np.where(slope > 0, slope, 1), 0) * direction
        slope = new
    return unknowns


def _fields(image: np.ndarray) -> np.ndarray:
    """Return RGB (h, w, 3) as `gather` takes it, (4, h, w) float32: behind the sums' column of weights."""
    fields = np.zeros((4, *image.shape[:2]), np.float32)
    fields[:3] = image.transpose(2, 0, 1)
    return fields


PIXELS = 1.0
SHARE = 0.001
CHUNK = 1 << 14  # Gaussians whose matrices are inverted at once


class ViewDependentSystem(System):
    """A `System` with unknowns (K, 1 + M, 3): colours, then harmonics."""

    def __init__(self, gaussians: Gaussians, projections: Sequence[Projection], eyes: Sequence[np.ndarray]) -> None:
        """Prepare for ``projections`` of the views and their ``eyes`` (3,)."""
        assert gaussians.harmonics is not None
        super().__init__(gaussians, projections)
        self.eyes = eyes
        self.start = np.concatenate([gaussians.colors[:, None], gaussians.harmonics], axis=1).astype(np.float64)
        self.prior: np.ndarray | None = None  # (K, 1 + M, 1), once `back` has seen the weights
        self.inverse: np.ndarray | None = None  # (K, 1 + M, 1 + M) float32

    def forward(self, view: int, unknowns: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Implement `System.forward`."""
        colors, harmonics = (np.ascontiguousarray(part, np.float32) for part in (unknowns[:, 0], unknowns[:, 1:]))
        return super().forward(view, seen_colors(self.given.means, colors, harmonics, self.eyes[view]), shape)

    def back(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Implement `System.back`."""
        from vvgt_cli.splat import harmonics

        means, out = self.given.means, np.zeros_like(self.start)
        matrices = None
        if self.inverse is None:
            matrices = np.zeros((len(means), *(self.start.shape[1],) * 2), np.float32)
        for eye, projection, image in zip(self.eyes, self.projections, images, strict=True):
            sums = np.zeros((len(means), 5))
            gather(projection, _fields(image), sums)
            harmonics.deposit(means, eye, np.ascontiguousarray(sums[:, 1:4]), out)
            if matrices is not None:
                harmonics.deposit_squares(means, eye, np.ascontiguousarray(sums[:, 0]), matrices)
        if matrices is not None:
            self._invert(matrices)
        return out

    def _invert(self, matrices: np.ndarray) -> None:
        """Return priors from the weights, which stand in the corner of ``matrices``, and inverses of both together."""
        self.prior = np.full((*self.start.shape[:2], 1), PRIOR)
        self.prior[:, 1:, 0] = PIXELS + SHARE * matrices[:, :1, 0]
        for first in range(0, len(matrices), CHUNK):
            part = slice(first, first + CHUNK)
            whole = matrices[part] + self.prior[part] * np.eye(self.start.shape[1])
            matrices[part] = np.linalg.inv(whole)
        self.inverse = matrices

    def pull(self, change: np.ndarray) -> np.ndarray:
        """Implement `System.pull`."""
        assert self.prior is not None
        return self.prior * change

    def scaled(self, gradient: np.ndarray) -> np.ndarray:
        """Return the gradient times the inverse of each Gaussian's own matrix."""
        assert self.inverse is not None
        return np.matmul(self.inverse, gradient.astype(np.float32)).astype(np.float64)

    def gaussians(self, unknowns: np.ndarray, brightest: float) -> Gaussians:
        """Return Gaussians with colours in [0, ``brightest``], and harmonics that nowhere change them by more."""
        colors, harmonics = np.clip(unknowns[:, 0], 0, brightest), unknowns[:, 1:]
        size = np.linalg.norm(harmonics, axis=1, keepdims=True)  # the most of any direction is this, times a factor
        most = size * np.sqrt(harmonics.shape[1] / (4 * np.pi))
        return replace(
            self.given, colors=colors, harmonics=harmonics * np.minimum(1, brightest / np.maximum(most, 1e-30))
        )
