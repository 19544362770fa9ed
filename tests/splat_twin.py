"""The float64 twins of the splatter's gradients and of `gather`, to compare the kernels with."""

import math

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.constants import NEAR
from vvgt_cli.gaussians.frames import basis, directions, rotations, term_slopes, view_colors
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.gaussians.types import HARMONICS
from vvgt_cli.splat.reference import covariances, drawn_opacity, layers, project, weights


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


def basis_slopes(directions: np.ndarray, degree: int) -> np.ndarray:
    """Return the derivatives (K, M, 3) of the polynomials of `basis` by the direction (K, 3).

    Only the component perpendicular to the direction is meaningful, as directions have unit length.
    """
    d = np.asarray(directions, np.float64)
    rows = [np.stack(np.broadcast_arrays(*row, d[:, 0])[:3], -1) for row in term_slopes(*d.T)[: HARMONICS[degree]]]
    return np.stack(rows, axis=1) if rows else np.zeros((len(d), 0, 3))


def view_slopes(gaussians: Gaussians, eye: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return gradients with respect to harmonics (K, M, 3) and means (K, 3), given those for `view_colors`, (K, 3)."""
    if gaussians.harmonics is None:
        return np.zeros((len(gaussians), 0, 3)), np.zeros((len(gaussians), 3))
    toward, distance = directions(gaussians.means, eye)
    by_term = np.einsum("kmc,kc->km", gaussians.harmonics.astype(np.float64), slopes)
    bent = np.einsum("km,kmi->ki", by_term, basis_slopes(toward, gaussians.degree))
    across = bent - (bent * toward).sum(axis=1, keepdims=True) * toward
    means = across / np.where(distance > 0, distance, math.inf)[:, None]
    return basis(toward, gaussians.degree)[:, :, None] * slopes[:, None, :], means
