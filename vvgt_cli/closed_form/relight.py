"""Light on Gaussians that carry the direction of the gradient under them (docs/live.md)."""

from __future__ import annotations

import numpy as np

from vvgt_cli.closed_form.lit import ARRIVING, FIXED, NORMALS, TINT, colored
from vvgt_cli.dvr.light import scene_light
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.look.lighting import Lighting

DEGREE = 2  # of harmonics under a light that depends on the view


def relight(gaussians: Gaussians, gradient: np.ndarray, lighting: Lighting) -> Gaussians:
    """Colour Gaussians under a light, without shadows or occlusion.

    Args:
        gaussians: of one colour each.
        gradient: (K, 3) in their frame, of any length; zeros where there is none: ambient light only.
        lighting: directions in the same frame.
    """
    light = scene_light(lighting, np.eye(3), np.ones(3), (1, 1, 1), _unattenuated)
    length = np.linalg.norm(gradient.astype(np.float64), axis=1)
    normals = gradient / np.maximum(length, 1e-30)[:, None]
    sums = np.zeros((len(gaussians), ARRIVING + len(light.directions)))
    sums[:, 0] = 1
    sums[:, NORMALS] = normals[:, [0, 0, 0, 1, 1, 2]] * normals[:, [0, 1, 2, 1, 2, 2]]
    sums[:, TINT] = gaussians.colors
    diffuse = np.abs(normals @ light.directions.T).sum(axis=1)
    sums[:, FIXED] = gaussians.colors * (light.ambient + light.diffuse * diffuse)[:, None]
    sums[:, ARRIVING:] = 1
    return colored(gaussians, light, sums, DEGREE if lighting.depends_on_view else 0)


def _unattenuated(cell: int) -> np.ndarray:
    raise AssertionError("no shadows, no occlusion")
