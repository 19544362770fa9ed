"""The float64 twin of the splatter: one Gaussian after the other over the whole image, nothing clever."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.constants import NEAR
from vvgt_cli.gaussians.harmonics import view_colors, view_slopes
from vvgt_cli.gaussians.rules import INRIA, Rule


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Return rotation matrices (K, 3, 3) float64 of quaternions (K, 4), (w, x, y, z) of any norm > 0."""
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
    """Return ``R diag(s^2) R^T``, (K, 3, 3) float64, unit-frame lengths squared."""
    factors = rotations(gaussians.quaternions) * np.exp(gaussians.log_scales.astype(np.float64))[:, None, :]
    result: np.ndarray = factors @ factors.transpose(0, 2, 1)
    return result


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
    opacity = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
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


def gather_reference(gaussians: Gaussians, camera: Camera, fields: np.ndarray) -> np.ndarray:
    """Sum w and w x ``fields`` (4, height, width) over all pixels, w = T alpha: (K, 5) float64."""
    out = np.zeros((len(gaussians), 5))
    for k, weight in weights(gaussians, camera):
        out[k, 0] = weight.sum()
        out[k, 1:] = (weight * fields).sum(axis=(1, 2))
    return out


def image_gradients(
    gaussians: Gaussians, camera: Camera, grad: np.ndarray, rule: Rule = INRIA
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return gradients by screen quantities of a loss whose gradient by the picture is ``grad`` (h, w, 4).

    Back to front: with B the picture behind a splat, seen without what is in front, the picture is
    ``... + T (alpha (c, 1) + (1 - alpha) B)``, so that dL/dalpha = T ((c, 1) - B) . grad.

    Returns:
        centres (K, 2), inverse projected covariances (K, 2, 2) symmetric, opacity logits (K,), colours as they are seen
        (K, 3).
    """
    count = len(gaussians)
    centres, flat, _ = project(gaussians, camera, rule)
    opacity = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    drawn = drawn_opacity(gaussians, flat, rule)
    pixels = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1)
    seen = view_colors(gaussians, camera.position)
    colors = np.column_stack([np.maximum(seen, 0), np.ones(count)])
    out = np.zeros((count, 2)), np.zeros((count, 2, 2)), np.zeros(count), np.zeros((count, 4))
    behind = np.zeros((camera.height, camera.width, 4))
    for k, alpha, trans in reversed(list(layers(gaussians, camera, rule))):
        out[3][k] = ((trans * alpha)[..., None] * grad).sum(axis=(0, 1))
        slope = trans * ((colors[k] - behind) * grad).sum(axis=-1)  # dL/dalpha
        slope[(alpha == 0) | (alpha == rule.max_alpha)] = 0
        moved = slope * alpha  # dL/d(log opacity)
        rest = np.exp(-rule.reach) if rule.shifted else 0.0
        bent = moved + np.where(alpha > 0, slope * drawn[k] * rest / (1 - rest), 0)  # dL/d(exponent)
        d, inverse = pixels - centres[k], np.linalg.inv(flat[k])
        out[0][k] = (bent[..., None] * (d @ inverse)).sum(axis=(0, 1))
        out[1][k] = -0.5 * np.einsum("yx,yxi,yxj->ij", bent, d, d)
        if rule.compensate:  # log of the factor is half of log det S - log det S'; by S'^-1: -S' dS S'
            own = np.linalg.inv(flat[k] - rule.dilation * np.eye(2))
            out[1][k] -= moved.sum() * 0.5 * flat[k] @ (own - inverse) @ flat[k]
        out[2][k] = moved.sum() * (1 - opacity[k])
        behind = alpha[..., None] * colors[k] + (1 - alpha)[..., None] * behind
    return *out[:3], np.where(seen >= 0, out[3][:, :3], 0)


def space_gradients(
    gaussians: Gaussians, camera: Camera, centres: np.ndarray, inverses: np.ndarray, rule: Rule = INRIA
) -> tuple[np.ndarray, np.ndarray]:
    """Return gradients by means (K, 3) and covariances (K, 3, 3), given those of `image_gradients`."""
    means, spatial = np.zeros((len(gaussians), 3)), np.zeros((len(gaussians), 3, 3))
    points = gaussians.means.astype(np.float64) @ camera.rotation.T + camera.translation
    local = camera.rotation @ covariances(gaussians) @ camera.rotation.T
    for k, (x, y, z) in enumerate(points):
        if not z > NEAR:
            continue
        fx, fy = camera.fx, camera.fy
        jacobian = np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
        inverse = np.linalg.inv(jacobian @ local[k] @ jacobian.T + rule.dilation * np.eye(2))
        flat = -inverse @ inverses[k] @ inverse  # d(S^-1) = -S^-1 dS S^-1
        spatial[k] = camera.rotation.T @ jacobian.T @ flat @ jacobian @ camera.rotation
        lens = 2 * flat @ jacobian @ local[k]  # dL/dJ
        by_x = np.array([[0, 0, -fx / z**2], [0, 0, 0]])  # dJ/dx
        by_y = np.array([[0, 0, 0], [0, 0, -fy / z**2]])
        by_z = np.array([[-fx / z**2, 0, 2 * fx * x / z**3], [0, -fy / z**2, 2 * fy * y / z**3]])
        bent = [(lens * by).sum() for by in (by_x, by_y, by_z)]
        means[k] = camera.rotation.T @ (jacobian.T @ centres[k] + bent)
    return means, spatial


def render_backward_reference(
    gaussians: Gaussians, camera: Camera, grad: np.ndarray, rule: Rule = INRIA
) -> dict[str, np.ndarray]:
    """Return `render_backward` in float64: dL/d(field) for each field; ``grad`` (h, w, 4) is dL/d(picture)."""
    centres, inverses, logits, colors = image_gradients(gaussians, camera, grad, rule)
    means, spatial = space_gradients(gaussians, camera, centres, inverses, rule)
    harmonics, through = view_slopes(gaussians, camera.position, colors)
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    factors = rotations(gaussians.quaternions) * scales[:, None, :]
    to_factors = 2 * spatial @ factors  # Sigma = M M^T
    to_rotations = to_factors * scales[:, None, :]
    norms = np.linalg.norm(gaussians.quaternions.astype(np.float64), axis=1, keepdims=True)
    unit = gaussians.quaternions / norms
    to_unit = np.einsum("kij,kqij->kq", to_rotations, rotation_derivatives(unit))
    return {
        "means": means + through,
        "log_scales": (to_factors * factors).sum(axis=1),
        "quaternions": (to_unit - (to_unit * unit).sum(axis=1, keepdims=True) * unit) / norms,
        "opacity_logits": logits,
        "colors": colors,
        "harmonics": harmonics,
    }


def rotation_derivatives(unit: np.ndarray) -> np.ndarray:
    """Return (K, 4, 3, 3) derivatives of the rotation matrix by w, x, y, z of unit quaternions (K, 4)."""
    w, x, y, z = unit.T
    o = np.zeros_like(w)
    tables = (
        [[o, -z, y], [z, o, -x], [-y, x, o]],
        [[o, y, z], [y, -2 * x, -w], [z, w, -2 * x]],
        [[-2 * y, x, w], [x, o, z], [-w, z, -2 * y]],
        [[-2 * z, -w, x], [w, -2 * z, y], [x, y, o]],
    )
    return 2 * np.moveaxis(np.array(tables), -1, 0)
