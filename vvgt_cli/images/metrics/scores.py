"""The numbers of a report, by the rules of the conventions ("Units of a report")."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from itertools import zip_longest
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.images.compose import over
from vvgt_cli.images.metrics.flip import flip
from vvgt_cli.images.metrics.psnr import psnr
from vvgt_cli.images.metrics.ssim import RADIUS, ssim

FOREGROUND = 0.01  # reference alpha above which a pixel is foreground


@dataclass(frozen=True)
class ViewScore:
    """Scores of one view; None where a number has no meaning for it.

    Attributes:
        psnr: dB, RGB over black, whole frame; at most 150 (identical images).
        psnr_white, psnr_alpha: the same over white, and of alpha.
        psnr_foreground, psnr_white_foreground, psnr_alpha_foreground: over the pixels whose reference alpha
            is above 0.01; None without any.
        ssim: over black, whole frame; None for images smaller than 11 x 11, or not asked for.
        flip: LDR-FLIP over black at 67 pixels per degree, 0 is best; None if not asked for.
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
    """Means over views of the numbers of `ViewScore`; ``dataclasses.asdict`` gives what JSON can hold.

    Views without foreground are counted and left out of every mean (of the whole-frame ones only while
    some view has a foreground).

    Attributes:
        views: views compared.
        views_without_foreground: of them, those with no reference alpha above 0.01.
        per_view: the numbers of each view, in order.
    """

    views: int
    views_without_foreground: int
    per_view: list[ViewScore]


def score_view(reference: np.ndarray, ours: np.ndarray, *, perceptual: bool = True) -> ViewScore:
    """Scores of one view.

    Args:
        reference, ours: (h, w, 4) premultiplied RGBA, display-referred.
        perceptual: compute SSIM and FLIP too (about 0.2 s a view of 800 x 800).

    Raises:
        DataError: shapes that differ or are not (h, w, 4), a value that is not finite.
    """
    reference = np.asarray(reference, dtype=np.float32)
    ours = np.asarray(ours, dtype=np.float32)
    if reference.shape != ours.shape or reference.ndim != 3 or reference.shape[2] != 4 or 0 in reference.shape:
        raise DataError(f"views of shape {reference.shape} and {ours.shape}; expected the same (h, w, 4)")
    for name, image in (("reference", reference), ("our view", ours)):
        if not np.isfinite(image).all():
            raise DataError(f"{name}: {np.count_nonzero(~np.isfinite(image))} values are not finite; expected none")
    seen = reference[..., 3] > FOREGROUND
    black, white, alpha = (
        (view(reference), view(ours)) for view in (_over_black, _over_white, lambda image: image[..., 3])
    )
    inside = seen if seen.any() else None
    return ViewScore(
        psnr=psnr(*black),
        psnr_white=psnr(*white),
        psnr_alpha=psnr(*alpha),
        psnr_foreground=None if inside is None else psnr(*black, inside),
        psnr_white_foreground=None if inside is None else psnr(*white, inside),
        psnr_alpha_foreground=None if inside is None else psnr(*alpha, inside),
        ssim=ssim(*black) if perceptual and min(seen.shape) > 2 * RADIUS else None,
        flip=flip(*black) if perceptual else None,
    )


def score_views(reference: Iterable[np.ndarray], ours: Iterable[np.ndarray], *, perceptual: bool = True) -> Scores:
    """Scores of our views against the reference's.

    Args:
        reference, ours: (n, h, w, 4) premultiplied RGBA, or iterables of (h, w, 4) that are read one view at a time.
        perceptual: compute SSIM and FLIP too.

    Raises:
        DataError: no views, numbers of views or shapes that differ, a value that is not finite.
    """
    views = []
    for a, b in zip_longest(reference, ours):
        if a is None or b is None:
            raise DataError(f"{'more' if b is None else 'fewer'} views in the reference than of ours; expected as many")
        views.append(score_view(a, b, perceptual=perceptual))
    return mean_scores(views)


def mean_scores(views: list[ViewScore]) -> Scores:
    """Means over views, by the rule of `Scores`.

    Raises:
        DataError: no views.
    """
    if not views:
        raise DataError("no views to score; expected at least one")
    seen = [view for view in views if view.psnr_foreground is not None]
    means: dict[str, Any] = {f.name: _mean([getattr(v, f.name) for v in seen or views]) for f in fields(ViewScore)}
    return Scores(**means, views=len(views), views_without_foreground=len(views) - len(seen), per_view=views)


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def _over_black(image: np.ndarray) -> np.ndarray:
    result: np.ndarray = np.clip(image[..., :3], 0, 1)
    return result


def _over_white(image: np.ndarray) -> np.ndarray:
    result: np.ndarray = np.clip(over(image, 1.0), 0, 1)
    return result
