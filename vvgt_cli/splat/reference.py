"""The float64 twin of the splatter: one Gaussian after the other over the whole image, nothing clever."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.splat.constants import DILATION, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """(K, 4) quaternions (w, x, y, z) of any norm > 0 -> (K, 3, 3) rotation matrices, float64."""
    q = np.asarray(quaternions, np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        axis=1,
    )  # (K, 3, 3)


def covariances(gaussians: Gaussians) -> np.ndarray:
    """``R diag(s^2) R^T``, (K, 3, 3) float64, unit-frame lengths squared."""
    factors = rotations(gaussians.quaternions) * np.exp(gaussians.log_scales.astype(np.float64))[:, None, :]
    return factors @ factors.transpose(0, 2, 1)


def project(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """EWA projection (Zwicker et al. 2002; Kerbl et al. 2023, eq. 5), float64.

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
    flat = jacobian @ local @ jacobian.transpose(0, 2, 1) + DILATION * np.eye(2)
    centres = np.stack([camera.fx * x * inv + camera.cx, camera.fy * y * inv + camera.cy], -1)
    centres[~seen] = np.nan
    return centres, flat, z


def weights(gaussians: Gaussians, camera: Camera) -> Iterator[tuple[int, np.ndarray]]:
    """Front-to-back blending in order of the centres' depth: Gaussian k and its weight T alpha, (height, width)."""
    centres, flat, depths = project(gaussians, camera)
    opacity = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    px, py = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    trans = np.ones((camera.height, camera.width))
    alive = np.ones_like(trans, dtype=bool)
    for k in np.argsort(depths.astype(np.float32), kind="stable"):  # float32: ties as the fast kernel has them
        if not np.isfinite(centres[k, 0]):
            continue
        inverse = np.linalg.inv(flat[k])
        dx, dy = px - centres[k, 0], py - centres[k, 1]
        power = 0.5 * (inverse[0, 0] * dx * dx + inverse[1, 1] * dy * dy) + inverse[0, 1] * dx * dy
        alpha = np.minimum(MAX_ALPHA, opacity[k] * np.exp(-power))
        alpha[alpha < MIN_ALPHA] = 0
        after = trans * (1 - alpha)
        alive &= (after >= MIN_TRANSMITTANCE) | (alpha == 0)
        yield int(k), np.where(alive, alpha * trans, 0)
        trans = np.where(alive, after, trans)


def render_reference(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """(height, width, 4) float64 premultiplied RGBA; negative colours are 0."""
    colors = np.maximum(gaussians.colors.astype(np.float64), 0)
    image = np.zeros((camera.height, camera.width, 4))
    for k, weight in weights(gaussians, camera):
        image += weight[..., None] * np.append(colors[k], 1.0)
    return image


def gather_reference(gaussians: Gaussians, camera: Camera, fields: np.ndarray) -> np.ndarray:
    """(K, 5) float64 sums over all pixels of w and of w x ``fields`` (4, height, width), w = T alpha."""
    out = np.zeros((len(gaussians), 5))
    for k, weight in weights(gaussians, camera):
        out[k, 0] = weight.sum()
        out[k, 1:] = (weight * fields).sum(axis=(1, 2))
    return out
