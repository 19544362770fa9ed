"""Texture on smooth areas: what the eye sees of a lattice of Gaussians long before squared errors do.

Where the volume's picture is opaque and smooth a picture of its Gaussians should be smooth as well. Measured is a band
of wavelengths, what a blur of `FINE` pixels leaves and one of `COARSE` takes away, in blocks of `BLOCK` pixels that the
reference has opaque (alpha above `OPAQUE` throughout) and smooth (its own band below `SMOOTH` levels of 255).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.images.metrics.filters import separable

FINE, COARSE = 1.2, 5.0  # pixels, standard deviations
REACH = 3.0  # of them, on each side, is where a blur ends
BLOCK = 32  # pixels along an edge
OPAQUE = 0.97  # alpha
SMOOTH = 1.0  # levels of 255
WORST = 0.1  # share of the blocks


@dataclass(frozen=True)
class Texture:
    """Root mean square of the band over a block and its channels, in levels of 255.

    Attributes:
        blocks: that are opaque and smooth in the reference; without any the numbers are None.
        ours, reference: mean of the blocks.
        ours_worst, reference_worst: mean of the tenth of the blocks that have most of it, each picture's own tenth.
    """

    blocks: int
    ours: float | None
    reference: float | None
    ours_worst: float | None
    reference_worst: float | None


def texture(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> Texture:
    """Texture of pictures on what is smooth in their references.

    Args:
        pairs: (reference, ours) of each view, (h, w, 4) premultiplied, display-referred.

    Raises:
        DataError: shapes that differ or are not (h, w, 4).
    """
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for reference, ours in pairs:
        if reference.shape != ours.shape or reference.ndim != 3 or reference.shape[2] != 4:
            raise DataError(f"views of shape {reference.shape} and {ours.shape}; expected the same (h, w, 4)")
        if min(reference.shape[:2]) >= BLOCK:
            found.append(_of_view(reference, ours))
    theirs, own = (np.concatenate([pair[i] for pair in found] or [np.empty(0)]) for i in (0, 1))
    if not len(own):
        return Texture(0, None, None, None, None)
    return Texture(len(own), float(own.mean()), float(theirs.mean()), _worst(own), _worst(theirs))


def _of_view(reference: np.ndarray, ours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) of the reference and (n,) of ours, a number a block that is opaque and smooth in the reference."""
    theirs, own = (_blocks(np.square(band(image))).mean(axis=(1, 3, 4)) ** 0.5 for image in (reference, ours))
    chosen = (_blocks(reference[..., 3]).min(axis=(1, 3)) > OPAQUE) & (theirs < SMOOTH)
    return theirs[chosen], own[chosen]


def band(image: np.ndarray) -> np.ndarray:
    """(h, w, 3) of RGB in levels of 255, blurred by `FINE` less blurred by `COARSE` pixels; edges are continued."""
    levels = np.clip(np.asarray(image[..., :3], np.float32), 0, 1) * 255  # as a screen shows them
    result: np.ndarray = _blurred(levels, FINE) - _blurred(levels, COARSE)
    return result


def _blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    reach = int(np.ceil(REACH * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = (kernel / kernel.sum()).astype(np.float32)
    padded = np.pad(image, ((reach, reach), (reach, reach), (0, 0)), mode="edge")
    planes = [separable(np.ascontiguousarray(padded[..., c]), kernel, kernel) for c in range(3)]
    return np.stack(planes, axis=2)


def _blocks(image: np.ndarray) -> np.ndarray:
    """(h, w, ...) as (rows, BLOCK, columns, BLOCK, ...); what is left at the lower and right edge is left out."""
    rows, columns = image.shape[0] // BLOCK, image.shape[1] // BLOCK
    whole = image[: rows * BLOCK, : columns * BLOCK]
    return whole.reshape(rows, BLOCK, columns, BLOCK, *image.shape[2:])


def _worst(numbers: np.ndarray) -> float:
    return float(np.sort(numbers)[-max(round(WORST * len(numbers)), 1) :].mean())
