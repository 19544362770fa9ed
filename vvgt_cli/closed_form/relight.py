"""Light on Gaussians that carry the axis of the normals under them (docs/live.md)."""

from __future__ import annotations

import numpy as np

from vvgt_cli.closed_form.lit import FIXED, NORMALS, SUMS, TINT, colored
from vvgt_cli.dvr.light import scene_light
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.look.lighting import Lighting

DEGREE = 2  # of harmonics under a light that depends on the view


def relight(gaussians: Gaussians, axis: np.ndarray, lighting: Lighting) -> Gaussians:
    """Colour Gaussians under a light that is no sky.

    Args:
        gaussians: of one colour each.
        axis: (K, 3) in their frame, as long as the normals agree (`normal_axis` of `gaussian_samples`): that share has
            a normal along it, the rest normals in all directions; zeros where there are none: ambient light only.
        lighting: directions in the same frame.
    """
    light = scene_light(lighting, np.eye(3), np.ones(3), (1, 1, 1))
    share = np.linalg.norm(axis.astype(np.float64), axis=1)
    normals, rest = axis / np.maximum(share, 1e-30)[:, None], np.where(share > 0, 1 - share, 0)
    sums = np.zeros((len(gaussians), SUMS))
    sums[:, 0] = 1
    sums[:, NORMALS] = share[:, None] * normals[:, [0, 0, 0, 1, 1, 2]] * normals[:, [0, 1, 2, 1, 2, 2]]
    sums[:, TINT] = gaussians.colors
    lights, mean = len(light.directions) + int(light.head), 1 / (light.power + 1)  # mean of abs(n . h)^power
    diffuse = share * np.abs(normals @ light.directions.T).sum(axis=1) + rest * lights / 2
    sums[:, FIXED] = gaussians.colors * (light.ambient + light.diffuse * diffuse)[:, None]
    sums[:, FIXED] += (light.specular * lights * mean * rest)[:, None]
    return colored(gaussians, light, sums, DEGREE if lighting.depends_on_view else 0)
