"""Camera and lights of a vtkRenderer, as the command's options take them; imports the standard library alone."""

from __future__ import annotations

import math
from typing import Any

HEADLIGHT, SCENE = 1, 3  # vtkLight's types; 2 moves with the camera


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
    text = ",".join(repr(float(v)) for v in (*eye, *target, angle))
    return text, ("-" if up[axis] < 0 else "") + "xyz"[axis], notes


def lights_of(renderer: Any) -> tuple[list[str], list[str]]:
    """Return the lights of a renderer as ``--light`` takes them, and notes."""
    found = renderer.GetLights()
    lights = [found.GetItemAsObject(k) for k in range(found.GetNumberOfItems())]
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
    return (["headlight"] if moving or not names else []) + names, notes
