"""LDR-FLIP, the perceived difference when alternating between two images, by OpenImageIO.

Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild: "FLIP: A Difference Evaluator for Alternating
Images", HPG 2020.
"""

from __future__ import annotations

import numpy as np

from vvgt_cli.errors import DataError

PIXELS_PER_DEGREE = 67.0206  # 0.7 m from a 0.7 m wide display of 3840 pixels


def flip(reference: np.ndarray, ours: np.ndarray, pixels_per_degree: float = PIXELS_PER_DEGREE) -> float:
    """Return the mean LDR-FLIP error in [0, 1] of sRGB images in [0, 1], (h, w, 3) each (clipped).

    Raises:
        DataError: the shapes differ or are not (h, w, 3).
    """
    import OpenImageIO as oiio

    reference, ours = np.asarray(reference), np.asarray(ours)
    if reference.shape != ours.shape or reference.ndim != 3 or reference.shape[2] != 3 or 0 in reference.shape:
        raise DataError(f"FLIP of images {reference.shape} and {ours.shape}; expected the same (h, w, 3)")
    a, b = (oiio.ImageBuf(np.clip(image, 0, 1).astype(np.float32, order="C")) for image in (reference, ours))
    for buffer in (a, b):
        buffer.specmod().attribute("oiio:ColorSpace", "srgb_rec709_scene")
    error = oiio.ImageBufAlgo.FLIP_diff(a, b, hdr=0, ppd=pixels_per_degree)
    pixels = error.get_pixels(oiio.FLOAT)
    if pixels is None:
        raise DataError(f"FLIP of images {reference.shape}: {error.geterror()}")
    return float(pixels.mean(dtype=np.float64))
