"""Volumes of a vtkRenderer, and its camera and lights as options of the command; imports numpy at most."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

HEADLIGHT, SCENE = 1, 3  # vtkLight's types; 2 moves with the camera


def volumes_of(renderer: Any) -> list[Any]:
    """Return the visible vtkVolumes of a renderer that have data."""
    collection = renderer.GetVolumes()
    volumes = [collection.GetItemAsObject(k) for k in range(collection.GetNumberOfItems())]
    mappers = [(volume, volume.GetMapper()) for volume in volumes if volume.GetVisibility()]
    return [volume for volume, mapper in mappers if mapper is not None and mapper.GetInputDataObject(0, 0) is not None]


def camera_of(renderer: Any) -> tuple[str, str, list[str]]:
    """Return a renderer's camera as ``--camera`` takes it, the world axis nearest its up for ``--up``, and notes."""
    camera = renderer.GetActiveCamera()
    eye, target, angle = camera.GetPosition(), camera.GetFocalPoint(), camera.GetViewAngle()
    notes = []
    if camera.GetUseHorizontalViewAngle():
        half = math.tan(math.radians(angle) / 2) / renderer.GetTiledAspectRatio()
        angle = 2 * math.degrees(math.atan(half))
    if camera.GetParallelProjection():
        notes.append("parallel projection (perspective instead)")
        away = camera.GetParallelScale() / math.tan(math.radians(angle) / 2)
        eye = [target[k] - away * camera.GetDirectionOfProjection()[k] for k in range(3)]
    up = camera.GetViewUp()
    axis = max(range(3), key=lambda k: abs(up[k]))
    sign = -1.0 if up[axis] < 0 else 1.0
    upright = [sign * (k == axis) for k in range(3)]
    if abs(roll := _roll(np.subtract(target, eye), up, upright)) > 1:
        notes.append(f"roll of the camera, {roll:.0f} degrees")
    text = ",".join(repr(float(v)) for v in (*eye, *target, angle))
    return text, ("-" if sign < 0 else "") + "xyz"[axis], notes


def _roll(forward: np.ndarray, up: Sequence[float], upright: Sequence[float]) -> float:
    """Return the angle, degrees, between two directions as they are seen along a third one."""
    right, other = np.cross(forward, up), np.cross(forward, upright)
    turned = np.cross(right, other) @ forward / (np.linalg.norm(forward) or 1.0)
    return math.degrees(math.atan2(turned, right @ other))


def lights_of(renderer: Any) -> tuple[list[str], list[str]]:
    """Return the lights of a renderer as ``--light`` takes them, and notes."""
    collection = renderer.GetLights()
    lights = [collection.GetItemAsObject(k) for k in range(collection.GetNumberOfItems())]
    lights = [light for light in lights if light.GetSwitch()]
    fixed = [light for light in lights if light.GetLightType() == SCENE]
    moving = len(lights) - len(fixed)
    notes = []
    if moving > 1 or any(light.GetLightType() not in (HEADLIGHT, SCENE) for light in lights):
        notes.append(f"{moving} lights that move with the camera (one at the eye instead)")
    if any(light.GetPositional() for light in fixed):
        notes.append("place of a light (at infinity instead)")
    if any(light.GetIntensity() != 1 or tuple(light.GetDiffuseColor()) != (1, 1, 1) for light in fixed):
        notes.append("intensity and colour of lights (white, 1 each, instead)")
    places = [(light.GetTransformedPosition(), light.GetTransformedFocalPoint()) for light in fixed]
    names = [",".join(repr(float(p[k] - q[k])) for k in range(3)) for p, q in places]
    if not lights and not renderer.GetAutomaticLightCreation():  # else VTK makes a headlight when it draws
        notes.append("absence of lights (headlight instead)")
    return (["headlight"] if moving or not names else []) + names, notes
