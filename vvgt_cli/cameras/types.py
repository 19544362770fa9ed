"""`Camera`: a pinhole with OpenCV axes, in the unit frame; quaternions of rotations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vvgt_cli.errors import DataError

_MIRROR = np.array([-1.0, 1.0, 1.0])  # swaps left and right in camera axes


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with OpenCV axes (x right, y down, z forward) and pixel centres at integer + 0.5.

    Attributes:
        rotation: (3, 3) float64 R of ``x_camera = R x_unit + t``, orthonormal, determinant +1.
        translation: (3,) float64 t, unit-frame lengths.
        fx, fy, cx, cy: intrinsics in pixels.
        width, height: image size in pixels.
        name: file stem of the view.
    """

    rotation: np.ndarray
    translation: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    name: str = "view"

    def __post_init__(self) -> None:
        """Convert pose arrays to float64 and check the camera."""
        rotation = np.asarray(self.rotation, dtype=np.float64)
        translation = np.asarray(self.translation, dtype=np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise DataError(f"camera {self.name}: R {rotation.shape}, t {translation.shape}; expected (3, 3) and (3,)")
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            raise DataError(f"camera {self.name}: the pose is not finite; expected finite numbers")
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5) or np.linalg.det(rotation) < 0:
            raise DataError(f"camera {self.name}: not a rotation; expected an orthonormal matrix with determinant +1")
        if min(self.width, self.height) < 1 or not (self.fx > 0 and self.fy > 0):
            raise DataError(
                f"camera {self.name}: {self.width} x {self.height} px, focal {self.fx}, {self.fy}; expected > 0"
            )
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @property
    def position(self) -> np.ndarray:
        """Centre of projection in the unit frame, (3,)."""
        return -self.rotation.T @ self.translation

    def middle(self, edge: int) -> Camera:
        """Return the middle of the picture of the same view, ``edge`` pixels wide and high."""
        x, y = (self.width - edge) // 2, (self.height - edge) // 2
        return replace(self, cx=self.cx - x, cy=self.cy - y, width=edge, height=edge)

    def resized(self, factor: float) -> Camera:
        """Return the same view with ``factor`` times the pixels along each axis."""
        return replace(
            self,
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=self.cx * factor,
            cy=self.cy * factor,
            width=round(self.width * factor),
            height=round(self.height * factor),
        )


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """Return unit quaternions (K, 4), of either sign, of matrices (K, 3, 3)."""
    r = np.moveaxis(rotations, 0, -1)
    table = np.zeros((4, 4, len(rotations)))
    table[0, 0] = r[0, 0] + r[1, 1] + r[2, 2]
    for a, (b, c) in enumerate(((1, 2), (2, 0), (0, 1))):
        table[a + 1, a + 1] = r[a, a] - r[b, b] - r[c, c]
        table[0, a + 1] = table[a + 1, 0] = r[c, b] - r[b, c]
        table[b + 1, c + 1] = table[c + 1, b + 1] = r[b, c] + r[c, b]
    return np.linalg.eigh(np.moveaxis(table, -1, 0))[1][:, :, -1]


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (4,) with w >= 0 of a matrix (3, 3)."""
    unsigned = quaternions(np.asarray(rotation, np.float64)[None])[0]
    return unsigned * np.copysign(1.0, unsigned[0])


def camera_in_box(camera: Camera, axes: np.ndarray) -> tuple[Camera, bool]:
    """Return the camera that sees in the box frame what ``camera`` sees in the unit frame.

    A reflected scene is rendered as its mirror image, and the picture is flipped afterwards.

    Args:
        camera: camera in the unit frame.
        axes: (3, 3) with ``unit = axes @ box``; the nearest orthogonal matrix is used.

    Returns:
        (camera, mirrored): the camera, and whether its picture must be flipped horizontally.
    """
    if np.array_equal(axes, np.eye(3)):
        return camera, False
    left, _, right = np.linalg.svd(axes)
    turn = left @ right
    rotation, translation = camera.rotation @ turn, camera.translation
    if np.linalg.det(turn) > 0:
        return replace(camera, rotation=rotation), False
    return replace(
        camera, rotation=rotation * _MIRROR[:, None], translation=translation * _MIRROR, cx=camera.width - camera.cx
    ), True


def render_in_box(draw: Callable[[Camera], np.ndarray], axes: np.ndarray) -> Callable[[Camera], np.ndarray]:
    """Convert a renderer of pictures (h, w, ...) for cameras in the box frame to one for cameras in the unit frame."""

    def image(camera: Camera) -> np.ndarray:
        inside, mirrored = camera_in_box(camera, axes)
        picture = draw(inside)
        return np.ascontiguousarray(picture[:, ::-1]) if mirrored else picture

    return image
