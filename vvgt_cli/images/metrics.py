"""PSNR, SSIM, FLIP and texture, as defined in the conventions ("Units of a report").

LDR-FLIP, the perceived difference when alternating between two images, is OpenImageIO's: Andersson, Nilsson,
Akenine-Möller, Oskarsson, Åström, Fairchild: "FLIP: A Difference Evaluator for Alternating Images", HPG 2020.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import zip_longest
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.images.compose import over

CAP = 150.0  # dB: an RMS error of 3e-8, half a float32 step at 1; the value of identical images
RADIUS, SIGMA = 5, 1.5  # of SSIM's window, 11 x 11
C1, C2 = 0.01**2, 0.03**2  # of SSIM
FOREGROUND = 0.01  # alpha of the reference above which a pixel is foreground
FINE, COARSE = 1.2, 5.0  # standard deviations in pixels of the blurs whose difference is texture
REACH = 3.0  # standard deviations at which a blur is truncated
ROWS = 64  # outputs of a product in `correlate`; the share of useful work is largest near the kernel's size
BLOCK = 32  # pixels along an edge of the blocks in which texture is measured
OPAQUE, SMOOTH = 0.97, 1.0  # least alpha, and largest texture of the reference (levels of 255), of measured blocks
WORST = 0.1  # share of the blocks that count as the worst


def psnr(reference: np.ndarray, ours: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return ``-10 log10(mean squared error)`` in dB of images in [0, 1] (clipped), at most `CAP`.

    Images are (h, w) or (h, w, c); pixels in ``mask`` (h, w) count, by default all. Raise DataError where shapes
    differ, none counts or one is not finite.
    """
    reference, ours = np.asarray(reference), np.asarray(ours)
    if reference.shape != ours.shape:
        raise DataError(f"PSNR of images {reference.shape} and {ours.shape}; expected the same shape")
    if mask is not None:
        reference, ours = reference[mask], ours[mask]
    if reference.size == 0:
        raise DataError("PSNR of no pixels; expected at least one")
    difference = np.clip(reference, 0, 1) - np.clip(ours, 0, 1)
    error = float(np.mean(np.square(difference, dtype=np.float64)))
    if not math.isfinite(error):
        raise DataError("PSNR of images that are not finite; expected finite values")
    return min(CAP, -10 * math.log10(error)) if error > 0 else CAP


def mean_psnr(
    references: Iterable[np.ndarray], ours: Iterable[np.ndarray], weights: Sequence[np.ndarray] | None = None
) -> float:
    """Return the mean PSNR (dB) of RGB of pictures (h, w, 4), premultiplied.

    Args:
        references: pictures of the volume.
        ours: pictures to compare.
        weights: (h, w) factors of the differences in each picture, which then counts by the sum of its weighted alpha.

    Raises:
        DataError: shapes differ, or a picture is not finite.
    """
    pairs = zip(references, ours, strict=True)
    if weights is None:
        return float(np.mean([psnr(a[..., :3], b[..., :3]) for a, b in pairs]))
    weighted = [(w[..., None] * a, w[..., None] * b) for (a, b), w in zip(pairs, weights, strict=True)]
    shares = [float(a[..., 3].sum()) + 1e-6 for a, _ in weighted]
    return float(np.average([psnr(a[..., :3], b[..., :3]) for a, b in weighted], weights=shares))


def visible_difference(
    references: Sequence[np.ndarray], ours: Sequence[np.ndarray], weights: Sequence[np.ndarray] | None = None
) -> float:
    """Return the difference of sRGB values, 0 to 1, that 99 % of the pixels with matter do not exceed in any channel.

    It orders pictures as the 99th percentile of FLIP there (docs/log/steps.md), and needs no whole pictures.

    Args:
        references: pictures of the volume, (h, w, 4) premultiplied over black.
        ours: pictures to compare.
        weights: (h, w) factors of the differences in each picture; pixels below 0.5 do not count.
    """
    found = []
    for i, (a, b) in enumerate(zip(references, ours, strict=True)):
        matter = np.maximum(a[..., 3], b[..., 3]) > FOREGROUND
        if weights is not None:
            matter &= weights[i] > 0.5
        found.append(np.abs(a[..., :3] - np.clip(b[..., :3], 0, 1)).max(axis=-1)[matter])
    differences = np.concatenate(found)
    return float(np.quantile(differences, 0.99)) if len(differences) else 0.0


def ssim(reference: np.ndarray, ours: np.ndarray) -> float:
    """Return the mean SSIM of RGB images in [0, 1]: 11 x 11 Gaussian window, sigma 1.5, data range 1.

    The mean is over channels and over the pixels whose window lies inside the image, like scikit-image's
    ``structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1)``.
    Structural similarity: Wang, Bovik, Sheikh, Simoncelli 2004.

    Args:
        reference: (h, w, c), h and w at least 11.
        ours: an image of the same shape.

    Raises:
        DataError: the shapes differ, or an image is smaller than the window.
    """
    reference, ours = np.asarray(reference), np.asarray(ours)
    if reference.shape != ours.shape or reference.ndim != 3:
        raise DataError(f"SSIM of images {reference.shape} and {ours.shape}; expected the same (h, w, c)")
    if min(reference.shape[:2]) < 2 * RADIUS + 1:
        raise DataError(f"SSIM of an image of {reference.shape[:2]} pixels; expected at least 11 x 11")
    return float(np.mean([_ssim(reference[..., c], ours[..., c]) for c in range(reference.shape[2])]))


def _ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean SSIM of a channel (h, w)."""
    kernel = _gaussian(RADIUS, SIGMA)
    # differences from mid-grey keep the cancellation in the variances small in float32
    a = np.ascontiguousarray(a, dtype=np.float32) - np.float32(0.5)
    b = np.ascontiguousarray(b, dtype=np.float32) - np.float32(0.5)
    mean_a, mean_b, aa, bb, ab = (separable(image, kernel, kernel) for image in (a, b, a * a, b * b, a * b))
    variances = (aa - mean_a * mean_a) + (bb - mean_b * mean_b)
    covariance = ab - mean_a * mean_b
    mean_a += np.float32(0.5)
    mean_b += np.float32(0.5)
    structure = (2 * covariance + np.float32(C2)) / (variances + np.float32(C2))
    luminance = (2 * mean_a * mean_b + np.float32(C1)) / (mean_a * mean_a + mean_b * mean_b + np.float32(C1))
    return float((structure * luminance).mean(dtype=np.float64))


def _gaussian(radius: int, sigma: float) -> np.ndarray:
    """Return the kernel (2 radius + 1,) float64 of a blur, with a sum of 1."""
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    return kernel / kernel.sum()


def correlate(image: np.ndarray, kernel: np.ndarray, axis: int) -> np.ndarray:
    """Correlate an image (h, w) with ``kernel`` (k,) along an axis, which shrinks by k - 1 to the valid part.

    As products with short banded matrices, which is fast without SciPy.
    """
    if axis == 1:
        return correlate(image.T, kernel, 0).T
    count = image.shape[0] - kernel.size + 1
    outputs = min(ROWS, count)
    band = np.zeros((outputs, outputs + kernel.size - 1), image.dtype)  # row i holds the kernel from column i
    for i in range(outputs):
        band[i, i : i + kernel.size] = kernel
    out = np.empty((count, image.shape[1]), image.dtype)
    for start in range(0, count, ROWS):
        size = min(ROWS, count - start)
        reach = size + kernel.size - 1
        np.matmul(band[:size, :reach], image[start : start + reach], out=out[start : start + size])
    return out


def separable(image: np.ndarray, along_x: np.ndarray, along_y: np.ndarray) -> np.ndarray:
    """Correlate an image (h, w) with the outer product of two kernels, valid part only."""
    return correlate(correlate(image, along_x, 1), along_y, 0)


@dataclass(frozen=True)
class ViewScore:
    """Scores of one view; None where a score is undefined.

    Attributes:
        psnr: dB, RGB over black, whole frame; at most 150 (identical images).
        psnr_white, psnr_alpha: the same over white, and of alpha.
        psnr_foreground, psnr_white_foreground, psnr_alpha_foreground: over the pixels whose reference alpha
            is above 0.01; None without any.
        ssim: over black, whole frame; None for images smaller than 11 x 11, or if not requested.
        flip: LDR-FLIP over black at 67 pixels per degree, 0 is best; None if not requested.
    """

    psnr: float
    psnr_white: float
    psnr_alpha: float
    psnr_foreground: float | None
    psnr_white_foreground: float | None
    psnr_alpha_foreground: float | None
    ssim: float | None
    flip: float | None


@dataclass(frozen=True)
class Scores(ViewScore):
    """Means of `ViewScore` over views; ``dataclasses.asdict`` returns JSON values.

    Views without foreground are excluded from the means, unless no view has any.

    Attributes:
        views: number of views.
        views_without_foreground: number of views with no reference alpha above 0.01.
        per_view: the scores of each view, in order.
    """

    views: int
    views_without_foreground: int
    per_view: list[ViewScore]


def score_view(reference: np.ndarray, ours: np.ndarray, *, perceptual: bool = True) -> ViewScore:
    """Score one view (h, w, 4), premultiplied; SSIM and FLIP if it is ``perceptual`` (0.2 s at 800 x 800).

    Raise DataError for other shapes, or a value that is not finite.
    """
    reference = np.asarray(reference, dtype=np.float32)
    ours = np.asarray(ours, dtype=np.float32)
    if reference.shape != ours.shape or reference.ndim != 3 or reference.shape[2] != 4 or 0 in reference.shape:
        raise DataError(f"views of shape {reference.shape} and {ours.shape}; expected the same (h, w, 4)")
    for name, image in (("reference", reference), ("our view", ours)):
        if not np.isfinite(image).all():
            raise DataError(f"{name}: {np.count_nonzero(~np.isfinite(image))} values are not finite; expected none")
    pairs = {
        "": (np.clip(reference[..., :3], 0, 1), np.clip(ours[..., :3], 0, 1)),
        "_white": (np.clip(over(reference, 1.0), 0, 1), np.clip(over(ours, 1.0), 0, 1)),
        "_alpha": (reference[..., 3], ours[..., 3]),
    }
    seen = reference[..., 3] > FOREGROUND
    scores: dict[str, Any] = {}
    for name, pair in pairs.items():
        scores |= {f"psnr{name}": psnr(*pair), f"psnr{name}_foreground": psnr(*pair, seen) if seen.any() else None}
    return ViewScore(
        **scores,
        ssim=ssim(*pairs[""]) if perceptual and min(seen.shape) > 2 * RADIUS else None,
        flip=flip(*pairs[""]) if perceptual else None,
    )


def score_views(reference: Iterable[np.ndarray], ours: Iterable[np.ndarray], *, perceptual: bool = True) -> Scores:
    """Score views (n, h, w, 4), or iterables that are read one at a time, by `score_view`; raise DataError for none."""
    views = []
    for a, b in zip_longest(reference, ours):
        if a is None or b is None:
            raise DataError(f"{'more' if b is None else 'fewer'} reference views than ours; expected the same number")
        views.append(score_view(a, b, perceptual=perceptual))
    return mean_scores(views)


def mean_scores(views: list[ViewScore]) -> Scores:
    """Average scores over views as described in `Scores`; raise DataError if there are no views."""
    if not views:
        raise DataError("no views to score; expected at least one")
    seen = [view for view in views if view.psnr_foreground is not None]
    means: dict[str, Any] = {}
    for entry in fields(ViewScore):
        known = [number for view in seen or views if (number := getattr(view, entry.name)) is not None]
        means[entry.name] = float(np.mean(known)) if known else None
    return Scores(**means, views=len(views), views_without_foreground=len(views) - len(seen), per_view=views)


@dataclass(frozen=True)
class Texture:
    """Texture of smooth areas: the root mean square of `band` over a block and its channels, in levels of 255.

    The eye notices a lattice of Gaussians long before it affects squared errors: where the volume's picture is opaque
    and smooth, the picture of the Gaussians should be smooth as well.

    Attributes:
        blocks: number of blocks that are opaque and smooth in the reference; without any the other values are None.
        ours, reference: mean over the blocks.
        ours_worst, reference_worst: mean over the tenth of the blocks with the most texture in that picture.
    """

    blocks: int
    ours: float | None
    reference: float | None
    ours_worst: float | None
    reference_worst: float | None


def texture(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> Texture:
    """Measure the texture of (reference, ours), (h, w, 4) each, in blocks where references are opaque and smooth.

    Raise DataError for other shapes.
    """
    blocks = [np.empty((2, 0))]
    for reference, ours in pairs:
        if reference.shape != ours.shape or reference.ndim != 3 or reference.shape[2] != 4:
            raise DataError(f"views of shape {reference.shape} and {ours.shape}; expected the same (h, w, 4)")
        if min(reference.shape[:2]) >= BLOCK:
            both = np.stack([_blocks(np.square(band(i))).mean(axis=(1, 3, 4)) ** 0.5 for i in (reference, ours)])
            blocks.append(both[:, (_blocks(reference[..., 3]).min(axis=(1, 3)) > OPAQUE) & (both[0] < SMOOTH)])
    theirs, own = np.concatenate([both.astype(np.float32) for both in blocks], axis=1)
    if not len(own):
        return Texture(0, None, None, None, None)
    worst = max(round(WORST * len(own)), 1)
    tenths = (float(np.sort(numbers)[-worst:].mean()) for numbers in (own, theirs))
    return Texture(len(own), float(own.mean()), float(theirs.mean()), *tenths)


def band(image: np.ndarray) -> np.ndarray:
    """Return the difference of RGB (h, w, 3), in levels of 255, blurred by `FINE` and by `COARSE` pixels."""
    levels = np.clip(np.asarray(image[..., :3], np.float32), 0, 1) * 255  # as on a screen
    return _blurred(levels, FINE) - _blurred(levels, COARSE)


def _blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    """Blur an image (h, w, 3) float32, continuing its edges."""
    reach = math.ceil(REACH * sigma)
    kernel = _gaussian(reach, sigma).astype(np.float32)
    padded = np.pad(image, ((reach, reach), (reach, reach), (0, 0)), mode="edge")
    planes = [separable(np.ascontiguousarray(padded[..., c]), kernel, kernel) for c in range(3)]
    return np.stack(planes, axis=2)


def _blocks(image: np.ndarray) -> np.ndarray:
    """Reshape (h, w, ...) to (rows, BLOCK, columns, BLOCK, ...), without the remainder at the lower and right edge."""
    rows, columns = image.shape[0] // BLOCK, image.shape[1] // BLOCK
    whole = image[: rows * BLOCK, : columns * BLOCK]
    return whole.reshape(rows, BLOCK, columns, BLOCK, *image.shape[2:])


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
