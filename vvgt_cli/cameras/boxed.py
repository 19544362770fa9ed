"""Cameras of the unit frame taken to the box frame, where scenes lie along their index axes.

A pinhole sees straight lines, so a turn of the scene is a turn of the camera. What a reflection makes of a scene no
camera sees, but its mirror image: the picture is turned round afterwards.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vvgt_cli.cameras.types import Camera

_MIRROR = np.array([-1.0, 1.0, 1.0])  # of camera axes: left and right exchanged


def boxed(camera: Camera, axes: np.ndarray) -> tuple[Camera, bool]:
    """The camera that sees in the box frame what ``camera`` sees in the unit frame.

    Args:
        camera: in the unit frame.
        axes: (3, 3) with ``unit = axes @ box``; orthogonal, else its nearest orthogonal matrix is taken.

    Returns:
        (camera, mirrored): whether left and right of its picture are to be exchanged.
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
    """What draws pictures (h, w, ...) for cameras of the unit frame, from what draws them in the box frame."""

    def image(camera: Camera) -> np.ndarray:
        inside, mirrored = boxed(camera, axes)
        picture = draw(inside)
        return np.ascontiguousarray(picture[:, ::-1]) if mirrored else picture

    return image
