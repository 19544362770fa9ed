"""The float64 twin of the splatter: one Gaussian after the other over the whole image, nothing clever."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import INRIA, NEAR, Gaussians, Rule
from vvgt_cli.gaussians.frames import axes_of, view_colors
from vvgt_cli.gaussians.frames import rotations as rotations


def covariances(gaussians: Gaussians) -> np.ndarray:
    """Return ``R diag(s^2) R^T``, (K, 3, 3) float64, unit-frame lengths squared."""
    factors = axes_of(gaussians)
    return factors @ factors.transpose(0, 2, 1)


def project(gaussians: Gaussians, camera: Camera, rule: Rule = INRIA) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project Gaussians by EWA (Zwicker et al. 2002; Kerbl et al. 2023, eq. 5), float64.

    Returns:
        centres (K, 2) in pixels, covariances (K, 2, 2) in px^2 with the dilation, depths (K,).
        Rows with depth <= `NEAR` hold NaN centres.
    """
    points = gaussians.means.astype(np.float64) @ camera.rotation.T + camera.translation  # (K, 3)
    x, y, z = points.T
    seen = z > NEAR
    inv = 1 / np.where(seen, z, 1)
    zero = np.zeros_like(x)
    jacobian = np.stack(
        [
            np.stack([camera.fx * inv, zero, -camera.fx * x * inv * inv], -1),
            np.stack([zero, camera.fy * inv, -camera.fy * y * inv * inv], -1),
        ],
        axis=1,
    )  # (K, 2, 3)
    local = camera.rotation @ covariances(gaussians) @ camera.rotation.T
    flat = jacobian @ local @ jacobian.transpose(0, 2, 1) + rule.dilation * np.eye(2)
    centres = np.stack([camera.fx * x * inv + camera.cx, camera.fy * y * inv + camera.cy], -1)
    centres[~seen] = np.nan
    return centres, flat, z


def layers(gaussians: Gaussians, camera: Camera, rule: Rule = INRIA) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield, front to back by the centres' depth, Gaussian k, its alpha and the transmittance T in front of it.

    Both (height, width) float64; alpha is 0 where nothing is drawn: below the cut, and in pixels that have ended.
    """
    centres, flat, depths = project(gaussians, camera, rule)
    opacity = drawn_opacity(gaussians, flat, rule)
    px, py = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    trans = np.ones((camera.height, camera.width))
    alive = np.ones_like(trans, dtype=bool)
    for k in np.argsort(depths.astype(np.float32), kind="stable"):  # float32: ties as the fast kernel has them
        if not np.isfinite(centres[k, 0]):
            continue
        inverse = np.linalg.inv(flat[k])
        dx, dy = px - centres[k, 0], py - centres[k, 1]
        power = 0.5 * (inverse[0, 0] * dx * dx + inverse[1, 1] * dy * dy) + inverse[0, 1] * dx * dy
        rest = np.exp(-rule.reach) if rule.shifted else 0.0
        alpha = np.minimum(rule.max_alpha, opacity[k] * (np.exp(-power) - rest) / (1 - rest))
        alpha[(alpha < rule.min_alpha) | (power > rule.reach)] = 0
        alive &= (trans * (1 - alpha) >= rule.min_transmittance) | (alpha == 0)
        alpha = np.where(alive, alpha, 0)
        yield int(k), alpha, trans
        trans = trans * (1 - alpha)


def drawn_opacity(gaussians: Gaussians, flat: np.ndarray, rule: Rule) -> np.ndarray:
    """Return (K,) opacity by a rule for dilated covariances (K, 2, 2): compensated, 0 for what is skipped."""
    opacity = gaussians.opacity
    if rule.compensate:
        own = np.linalg.det(flat - rule.dilation * np.eye(2))
        opacity = opacity * np.sqrt(np.maximum(own, 0) / np.linalg.det(flat))
    return np.where(np.linalg.eigvalsh(flat)[:, 1] < rule.min_variance, 0, opacity)


def weights(gaussians: Gaussians, camera: Camera, rule: Rule = INRIA) -> Iterator[tuple[int, np.ndarray]]:
    """Yield Gaussian k and its weight T alpha, (height, width), front to back."""
    for k, alpha, trans in layers(gaussians, camera, rule):
        yield k, trans * alpha


def render_reference(gaussians: Gaussians, camera: Camera, rule: Rule = INRIA) -> np.ndarray:
    """Render (height, width, 4) float64 premultiplied RGBA; negative colours are 0."""
    colors = np.maximum(view_colors(gaussians, camera.position), 0)
    image = np.zeros((camera.height, camera.width, 4))
    for k, weight in weights(gaussians, camera, rule):
        image += weight[..., None] * np.append(colors[k], 1.0)
    return image
