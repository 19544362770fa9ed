"""Colours and spherical harmonics from views, solved together: pictures are linear in both.

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

from vvgt_cli.gaussians import Gaussians
from vvgt_cli.splat import Projection, blend, gather
from vvgt_cli.splat.render import seen_colors

PIXELS = 1.0
SHARE = 0.001
CHUNK = 1 << 14  # Gaussians whose matrices are inverted at once


class ViewDependentSystem:
    """A `vvgt_cli.closed_form.fit.System` with unknowns (K, 1 + M, 3): colours, then harmonics."""

    def __init__(
        self, gaussians: Gaussians, eyes: Sequence[np.ndarray], projections: Sequence[Projection], prior: float
    ) -> None:
        """Prepare for ``eyes`` (3,) and ``projections`` of the views; ``prior`` of the colours, pixels."""
        assert gaussians.harmonics is not None
        self.given, self.eyes, self.projections = gaussians, eyes, projections
        self.start = np.concatenate([gaussians.colors[:, None], gaussians.harmonics], axis=1).astype(np.float64)
        self.color_prior = prior
        self.prior: np.ndarray | None = None  # (K, 1 + M, 1), once `back` has seen the weights
        self.inverse: np.ndarray | None = None  # (K, 1 + M, 1 + M) float32

    def forward(self, view: int, unknowns: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Render the RGB picture (h, w, 3) of a view, of ``shape`` (h, w, ...)."""
        colors, harmonics = (np.ascontiguousarray(part, np.float32) for part in (unknowns[:, 0], unknowns[:, 1:]))
        seen = seen_colors(self.given.means, colors, harmonics, self.eyes[view])
        return blend(self.projections[view], seen, shape[0], shape[1])[..., :3]

    def back(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Apply the adjoint of `forward`, summed over the views' ``images``."""
        from vvgt_cli.splat import harmonics

        means, out = self.given.means, np.zeros_like(self.start)
        matrices = None
        if self.inverse is None:
            matrices = np.zeros((len(means), *(self.start.shape[1],) * 2), np.float32)
        for eye, projection, image in zip(self.eyes, self.projections, images, strict=True):
            fields = np.zeros((4, *image.shape[:2]), np.float32)
            fields[:3] = image.transpose(2, 0, 1)
            sums = np.zeros((len(means), 5))
            gather(projection, fields, sums)
            harmonics.deposit(means, eye, np.ascontiguousarray(sums[:, 1:4]), out)
            if matrices is not None:
                harmonics.deposit_squares(means, eye, np.ascontiguousarray(sums[:, 0]), matrices)
        if matrices is not None:
            self._invert(matrices)
        return out

    def _invert(self, matrices: np.ndarray) -> None:
        """Return priors from the weights, which stand in the corner of ``matrices``, and inverses of both together."""
        self.prior = np.full((*self.start.shape[:2], 1), self.color_prior)
        self.prior[:, 1:, 0] = PIXELS + SHARE * matrices[:, :1, 0]
        for first in range(0, len(matrices), CHUNK):
            part = slice(first, first + CHUNK)
            whole = matrices[part] + self.prior[part] * np.eye(self.start.shape[1])
            matrices[part] = np.linalg.inv(whole)
        self.inverse = matrices

    def pull(self, change: np.ndarray) -> np.ndarray:
        """Return half the gradient of the penalty on a ``change`` of the unknowns."""
        assert self.prior is not None
        result: np.ndarray = self.prior * change
        return result

    def scaled(self, gradient: np.ndarray) -> np.ndarray:
        """Return the gradient times the inverse of each Gaussian's own matrix."""
        assert self.inverse is not None
        result: np.ndarray = np.matmul(self.inverse, gradient.astype(np.float32)).astype(np.float64)
        return result

    def gaussians(self, unknowns: np.ndarray, brightest: float) -> Gaussians:
        """Return Gaussians with colours in [0, ``brightest``], and harmonics that nowhere change them by more."""
        colors, harmonics = np.clip(unknowns[:, 0], 0, brightest), unknowns[:, 1:]
        size = np.linalg.norm(harmonics, axis=1, keepdims=True)  # the most of any direction is this, times a factor
        most = size * np.sqrt(harmonics.shape[1] / (4 * np.pi))
        return replace(
            self.given, colors=colors, harmonics=harmonics * np.minimum(1, brightest / np.maximum(most, 1e-30))
        )
