"""Scores over views: means, backgrounds, foreground, and what JSON can hold."""

import json
from dataclasses import asdict

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError
from vvgt_cli.images.metrics import CAP, score_view, score_views


def views(count=3, size=24, seed=0):
    """Premultiplied views of a disc, the rest empty."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:size, 0:size]
    inside = ((x - size / 2) ** 2 + (y - size / 2) ** 2 < (size / 3) ** 2)[None, ..., None]
    alpha = rng.uniform(0.2, 1, (count, size, size, 1)) * inside
    return np.concatenate([rng.random((count, size, size, 3)) * alpha, alpha], axis=-1).astype(np.float32)


def test_whole_frame_over_black_white_and_of_alpha():
    reference = views()
    ours = reference.copy()
    ours[..., 0] += 0.03 * (reference[..., 3] > 0)
    scores = score_views(reference, ours)
    clipped = np.clip(ours[..., :3], 0, 1) - reference[..., :3]
    expected = -10 * np.log10((clipped.astype(float) ** 2).mean(axis=(1, 2, 3)))
    assert scores.psnr == pytest.approx(expected.mean(), abs=1e-6)
    assert scores.psnr_alpha == CAP
    white = [np.clip(v[..., :3] + 1 - v[..., 3:], 0, 1) for v in (reference, ours)]
    expected = -10 * np.log10(((white[0] - white[1]) ** 2).mean(axis=(1, 2, 3)))
    assert scores.psnr_white == pytest.approx(expected.mean(), abs=1e-4)
    assert [v.psnr for v in scores.per_view] == [score_view(a, b).psnr for a, b in zip(reference, ours, strict=True)]
    assert scores.views == 3
    assert scores.views_without_foreground == 0


def test_foreground_is_where_the_reference_has_alpha():
    reference = views(1)
    ours = reference.copy()
    seen = reference[0, ..., 3] > 0.01
    ours[0, ~seen, :3] = 0.5  # only outside
    scores = score_views(reference, ours)
    assert scores.psnr_foreground == CAP
    assert scores.psnr < 12
    ours = reference.copy()
    ours[0, seen, 3] -= 0.1
    share = seen.mean()
    scores = score_views(reference, ours)
    assert scores.psnr_alpha_foreground == pytest.approx(20, abs=1e-4)
    assert scores.psnr_alpha == pytest.approx(20 - 10 * np.log10(share), abs=1e-4)


def test_views_without_foreground_are_counted_and_excluded():
    reference = views(3)
    reference[1] = 0
    reference[1, 3, 3] = 0.005  # below the threshold
    ours = np.clip(reference + 0.01, 0, 1)
    ours[1] = 0
    scores = score_views(reference, ours)
    assert scores.views_without_foreground == 1
    assert scores.per_view[1].psnr_foreground is None
    kept = [scores.per_view[0], scores.per_view[2]]
    for name in ("psnr", "psnr_white", "psnr_foreground", "ssim", "flip"):
        assert getattr(scores, name) == pytest.approx(np.mean([getattr(v, name) for v in kept]))
    empty = score_views(reference[1:2], ours[1:2])
    assert empty.psnr_foreground is None
    assert empty.views_without_foreground == 1
    assert empty.psnr > 40


def test_identical_views_and_json():
    reference = views(2)
    scores = score_views(reference, reference.copy())
    assert (scores.psnr, scores.psnr_white, scores.psnr_foreground) == (CAP, CAP, CAP)
    assert scores.ssim == pytest.approx(1, abs=1e-6)
    assert scores.flip == 0
    assert json.loads(json.dumps(asdict(scores), allow_nan=False))["per_view"][1]["psnr"] == CAP


def test_perceptual_scores_are_none_when_not_requested_or_impossible():
    reference = views(1)
    scores = score_views(reference, reference, perceptual=False)
    assert scores.ssim is None
    assert scores.flip is None
    small = score_views(reference[:, :8, :8], reference[:, :8, :8])
    assert small.ssim is None
    assert small.flip == 0


def test_views_are_read_one_at_a_time():
    reference = views(4)
    held = []

    def render():
        for view in reference:
            held.append(len(held))
            yield view

    assert score_views((v for v in reference), render()) == score_views(reference, reference)
    assert len(held) == 4


def test_views_that_do_not_fit_are_refused():
    reference = views(2)
    refused(DataError, "more reference views", score_views, reference, reference[:1])
    refused(DataError, "fewer reference views", score_views, reference[:1], reference)
    refused(DataError, "same", score_views, reference, reference[..., :3])
    refused(DataError, "no views", score_views, [], [])
    broken = reference.copy()
    broken[1, 2, 3, 0] = np.nan
    refused(DataError, "our view: 1 values are not finite", score_views, reference, broken)
