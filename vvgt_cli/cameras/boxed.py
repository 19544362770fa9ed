"""Conversion of cameras from the unit frame to the box frame, in which the scene is aligned with its index axes.

Rotating the scene is the same as rotating the camera. A reflected scene is rendered as its mirror image, and the
picture is flipped afterwards.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vvgt_cli.cameras.types import Camera

_MIRROR = np.array([-1.0, 1.0, 1.0])  # swaps left and right in camera axes


def camera_in_box(camera: Camera, axes: np.ndarray) -> tuple[Camera, bool]:
    """Return the camera that sees in the box frame what ``camera`` sees in the unit frame.

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
