"""Random Gaussians of tests."""

from __future__ import annotations

import numpy as np

from vvgt_cli.gaussians import Gaussians


def random_cloud(count: int, seed: int, size: float, spread: float, opacity: tuple[float, float]) -> Gaussians:
    """Centres in a cube, edges about ``size``, logits of opacity about a mean; ``spread`` and deviation are normal."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-0.6, 0.6, (count, 3)),
        np.log(size) + rng.normal(0, spread, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(*opacity, count),
        rng.uniform(0, 1, (count, 3)),
    )
