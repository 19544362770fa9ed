"""Cases of what a network is given and gives back: order, tables and views, without a model."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.clouds import FIELDS, cloud, extremes
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.network import NAMED

STAGE = "network"
CONFIG = NAMED["small"]


def _there_and_back(gaussians: Gaussians, size: int = 32) -> Figure:
    """Input that is finite, and an output that changes nothing: the Gaussians that were given, in their order."""
    from vvgt_cli.network.prepare import pack, prepare

    cameras = default_views("train", 2, size=size)
    images = np.random.default_rng(0).random((2, size, size, 4), dtype=np.float32)
    scene = prepare(gaussians, cameras, images, CONFIG)
    for name, array in scene.arrays().items():
        require(array.dtype.kind != "f" or np.isfinite(array).all(), f"{name} that are not finite")
    require((np.sort(scene.order) == np.arange(len(gaussians))).all(), "an order that is no permutation")
    back = scene.restore(scene.rows)
    off = np.abs(pack(back).astype(np.float64) - pack(gaussians)).max()
    return Figure("changed by", float(off), 1e-6)


def _order(gaussians: Gaussians) -> Figure:
    """The order in the file does not matter to what the network is given."""
    from vvgt_cli.network.prepare import prepare

    cameras, images = default_views("train", 2, size=16), np.zeros((2, 16, 16, 4), np.float32)
    mixed = gaussians.take(np.random.default_rng(0).permutation(len(gaussians)))
    first, second = (prepare(g, cameras, images, CONFIG) for g in (gaussians, mixed))
    return Figure("rows that differ", int((first.rows != second.rows).any(axis=1).sum()), 0)


def _refused(gaussians: Gaussians) -> Figure:
    from vvgt_cli.network.prepare import prepare

    try:
        prepare(gaussians, default_views("train", 1, size=16), np.zeros((1, 16, 16, 4), np.float32), CONFIG)
    except DataError:
        return Figure("accepted", 0, 0)
    return Figure("accepted", 1, 0)


def _in_one_place(count: int) -> Gaussians:
    g = cloud(count)
    fields = {field: getattr(g, field) for field in FIELDS} | {"means": np.zeros((count, 3))}
    return Gaussians(**fields)


def cases() -> Iterator[Case]:
    """All of them."""
    for count in (1, 10, 3000):
        yield Case(STAGE, f"K = {count}", partial(_there_and_back, cloud(count)))
    yield Case(STAGE, "extreme Gaussians", partial(_there_and_back, extremes()))
    yield Case(STAGE, "all in one place", partial(_there_and_back, _in_one_place(500)))
    yield Case(STAGE, "views of one pixel", partial(_there_and_back, cloud(50), 1))
    yield Case(STAGE, "another order", partial(_order, cloud(1000)))
    yield Case(STAGE, "refused: K = 0", partial(_refused, cloud(0)))
