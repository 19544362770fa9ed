"""Steps on numba's simulator of a CUDA device: `python -m tests.simulated_gpu IN OUT`, kernels run in Python."""

import os
import pickle
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.cameras import default_views, look_at
from vvgt_cli.cameras.blocks import Blocks
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import INRIA, RULES
from vvgt_cli.refine import OptimizeOptions

SIMULATED = {"NUMBA_ENABLE_CUDASIM": "1", "NUMBA_DISABLE_JIT": "1"}
STEPS = {"inria": (0, 2), "free": (2,), "few": (2,)}  # cameras of the steps of each case: a tile takes seconds
LEAST = 20  # Gaussians that share steps


def gaussians(count: int = 22, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-0.6, 0.6, (count, 3)), rng.uniform(-2.5, -1, (count, 3)), rng.normal(size=(count, 4)),
        rng.uniform(-2, 5, count), rng.uniform(-0.1, 1, (count, 3)),
    )  # fmt: skip


# two of a size that is no multiple of a tile, one within a tile
CAMERAS = [replace(camera, width=19, height=13) for camera in default_views("train", 2, size=16)]
CAMERAS.append(look_at((3, 1, 1), width=8, height=8))


def cases() -> dict[str, tuple[Gaussians, OptimizeOptions, np.ndarray | None, bool]]:
    """Start, options, those that are free, and whether views are weighted."""
    usual = OptimizeOptions.of("axes", device="cuda")
    rule = replace(usual, rule=RULES["playcanvas"], l1=0.3, texture=0.0)
    return {
        "inria": (gaussians(), usual, None, False),
        "free": (gaussians(), rule, np.arange(22) % 3 > 0, True),
        "few": (gaussians(LEAST - 1), replace(usual, rule=RULES["compensated"]), None, True),
    }


def take(state: Any, case: str, targets: list[np.ndarray], weights: list[np.ndarray] | None) -> dict[str, np.ndarray]:
    """Take the case's steps, and return what is saved; of the first case pictures before them, too."""
    before = {}
    if case == "inria":
        before["picture"] = state.picture(CAMERAS[0], INRIA)
        before["part"] = state.picture(CAMERAS[0], INRIA, Blocks(19, 13, np.array([1])))
    for n, i in enumerate(STEPS[case]):
        state.step(CAMERAS[i], targets[i], n / 8, 1.0, None if weights is None else weights[i])
    kept = {name: np.array(array) for name, array in state.saved().items()}
    state.restore(kept)
    again = state.saved()
    assert all(np.array_equal(kept[name], again[name]) for name in kept)
    return kept | before


def main(given: Path, out: Path) -> None:
    """Take all cases' steps with few threads a block, little room and short lists sorted in the block's memory.

    What the median of a few numbers is of, 2,048 on a device, took three quarters of the time.
    """
    from vvgt_cli.refine import on_device
    from vvgt_cli.splat import on_device as splatter

    on_device.ADDERS = splatter.SORTERS = splatter.SCANNERS = 4
    splatter.NEARBY, on_device.FEW = 8, 32
    make_room = splatter.Splatter._make_room
    splatter.Splatter._make_room = lambda self, pairs: make_room(self, pairs if self.room else 9)
    targets, weights, hosts = pickle.loads(given.read_bytes())
    ends = {}
    for case, (start, options, free, weighted) in cases().items():
        on_device.OwnAxes = lambda *_, case=case: hosts[case]  # as compiled code makes it
        state = on_device.OwnAxesOnDevice(start, CAMERAS, options, free)
        ends[case] = take(state, case, targets, weights if weighted else None)
    out.write_bytes(pickle.dumps(ends))


if __name__ == "__main__":
    assert all(os.environ.get(name) == value for name, value in SIMULATED.items())
    main(*map(Path, sys.argv[1:]))
