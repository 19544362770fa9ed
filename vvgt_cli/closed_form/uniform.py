"""Random samples of the scene, for comparison (`--init uniform`): what iVR-GS and "w/o VBM" start from."""

from __future__ import annotations

import numpy as np

from vvgt_cli.closed_form.columns import FIRST, MASS
from vvgt_cli.closed_form.shape import make_gaussians, visible_color
from vvgt_cli.closed_form.tree import Tree
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.opacity import peak_opacity


def uniform_gaussians(tree: Tree, budget: int, pixel: float, seed: int) -> Gaussians:
    """Draw ``budget`` isotropic Gaussians uniformly where the scene has extinction that some view sees.

    A base cell's extinction is shared by the samples expected in it; sigma is half the mean distance of the samples.
    """
    base = np.flatnonzero(tree.children == 0)
    if not len(base) or budget < 1:
        base = base[:0]
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.integers(0, max(len(base), 1), budget if len(base) else 0))
    moments, edge = tree.moments[base[chosen]], np.broadcast_to(tree.edges[0], (len(chosen), 3))
    centre = moments[:, FIRST] / moments[:, [MASS]]
    points = centre + edge * (rng.random(centre.shape) - 0.5)
    volume = len(base) * (edge[0].prod() if len(edge) else 0.0)
    sigma = 0.5 * (volume / max(len(chosen), 1)) ** (1 / 3)
    variances = np.full((len(chosen), 3), sigma**2)
    mass = moments[:, MASS] * len(base) / max(len(chosen), 1)
    axes = np.broadcast_to(np.eye(3), (len(chosen), 3, 3))
    return make_gaussians(points, variances, axes, peak_opacity(mass, variances, pixel), visible_color(moments))
