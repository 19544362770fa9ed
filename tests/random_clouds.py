"""Random Gaussians of tests."""

import numpy as np

from vvgt_cli.gaussians import Gaussians


def random_cloud(
    count: int, seed: int = 0, size: float = 0.05, spread: float = 0.3, opacity: tuple[float, float] = (0.0, 2.0),
    box: float = 0.6, colors: tuple[float, float] = (0.0, 1.0),
) -> Gaussians:  # fmt: skip
    """Return centres in a cube, edges about ``size``, logits about a mean; ``spread`` and deviation are normal."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-box, box, (count, 3)),
        np.log(size) + rng.normal(0, spread, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(*opacity, count),
        rng.uniform(*colors, (count, 3)),
    )


def turns(quaternions: np.ndarray) -> np.ndarray:
    """Return rotation matrices (K, 3, 3) of quaternions (K, 4), (w, x, y, z) of any norm."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T.astype(float)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def extreme_cloud(count: int = 80) -> Gaussians:
    """Return needles, discs, points and giants of 1e-11 to 55, clear and opaque, beside and behind cameras."""
    rng = np.random.default_rng(0)
    return Gaussians(
        rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-2, 1, (count, 1)),
        rng.uniform(-25, 4, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(-60, 60, count),
        rng.uniform(0, 40, (count, 3)),
    )
