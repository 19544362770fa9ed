"""Image-space refinement: gradient descent on Gaussians until their pictures match given views."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from vvgt_cli.progress import ProgressCallback
from vvgt_cli.refine.options import LOSS_3DGS, METHODS, Check, OptimizeOptions, OptimizeRecord

if TYPE_CHECKING:
    import numpy as np

    from vvgt_cli.cameras import Camera
    from vvgt_cli.gaussians import Gaussians


def optimize(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    images: np.ndarray,
    options: OptimizeOptions | None = None,
    check: Check | None = None,
    progress: ProgressCallback | None = None,
    stop: Callable[[], bool] | None = None,
    free: np.ndarray | None = None,
    weights: Sequence[np.ndarray] | None = None,
) -> tuple[Gaussians, OptimizeRecord]:
    """Minimise the difference between pictures of Gaussians and views by gradient descent.

    Args:
        gaussians: where to start.
        cameras: of the training views.
        images: (n, h, w, 4) float32 premultiplied.
        options: how, and when to stop.
        check: cameras and images of check views, `Blocks` of each where the images hold only those, and weights:
            what is returned is the best that they have seen, the input included. Without a check the last step's
            Gaussians are returned.
        progress: called after each step with the steps taken and expected.
        stop: asked before each step; True ends the run as a time budget would.
        free: (K,) bool, those that move, of the method "axes"; None: all.
        weights: of each training view, (h, w) factors of differences in the loss; None: 1.

    Raises:
        DataError: no views, or images or weights that do not fit their cameras.
    """
    from vvgt_cli.refine.loop import run

    return run(gaussians, cameras, images, options or OptimizeOptions(), check, progress, stop, free, weights)


def load_ahead() -> None:
    """Begin to load the kernels of a CUDA device, in the background: the first picture waits for the rest."""

    def run() -> None:
        from vvgt_cli.jit.gpu import load
        from vvgt_cli.refine.on_device import KERNELS

        with contextlib.suppress(Exception):  # of the driver or the compiler: whoever takes a step meets it again
            load(KERNELS)

    threading.Thread(target=run, daemon=True).start()


__all__ = ["LOSS_3DGS", "METHODS", "OptimizeOptions", "OptimizeRecord", "load_ahead", "optimize"]
