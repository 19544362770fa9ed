"""A network of a few thousand weights, and scenes to put through it."""

from dataclasses import replace

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.network import GeometryConfig, ImageConfig, NetworkConfig

TINY = NetworkConfig(
    name="tiny",
    image=ImageConfig(
        size=28, views=3, width=16, heads=2, encoder=1, alternating=2, taps=(0, 1), map_width=8, registers=1
    ),
    geometry=GeometryConfig(
        widths=(8,) * 5, heads=(2,) * 5, decoder_widths=(8,) * 4, decoder_heads=(2,) * 4, window=8, epipolar_width=8
    ),
)
FED = replace(TINY, rendering=True, geometry=replace(TINY.geometry, gradients=True))  # with the inputs beyond the paper


def scene(count=60, views=3, seed=0, size=32):
    """Random Gaussians, cameras and images."""
    rng = np.random.default_rng(seed)
    gaussians = Gaussians(
        rng.uniform(-0.6, 0.6, (count, 3)), rng.normal(-3, 0.3, (count, 3)), rng.normal(size=(count, 4)),
        rng.normal(size=count), rng.random((count, 3)),
    )  # fmt: skip
    images = rng.random((views, size, size, 4), dtype=np.float32)
    return gaussians, default_views("train", views, size=size), images


def as_rows(gaussians):
    """(K, 14) of all fields, for comparing."""
    g = gaussians
    return np.column_stack([g.means, g.log_scales, g.quaternions, g.opacity_logits, g.colors])
