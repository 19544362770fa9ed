"""Conversions that go on from an earlier one of the same volume: when, how near, and what is refused."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

import vvgt_cli as vvgt
from tests.refused import refused
from vvgt_cli.conversion.place import to_box_frame, to_unit_frame
from vvgt_cli.conversion.previous_look import MAX_RATIO, OPAQUE, PreviousLook, recolor_earlier

GOAL = {"max_gaussians": 400, "screen": 96, "steps": 24}
SPACING = (1.0, 1.0, 1.5)
SHELL = {
    "points": [
        {"x": 0.2, "rgb": [0.2, 0.4, 0.9], "opacity": 0.0},
        {"x": 0.5, "rgb": [0.9, 0.8, 0.3], "opacity": 0.4},
        {"x": 0.9, "rgb": [0.9, 0.3, 0.1], "opacity": 0.1},
    ],
    "opacity_unit_distance": 2.0,
}

OUTSIDE = {
    "points": [
        {"x": 0.01, "rgb": [1, 1, 1], "opacity": 0.0},
        {"x": 0.04, "rgb": [1, 1, 1], "opacity": 0.8},
        {"x": 0.08, "rgb": [1, 1, 1], "opacity": 0.0},
    ],
    "opacity_unit_distance": 1.0,
}  # where the shell has no Gaussians


def shell(**changes):
    """The function with other opacities (``times``), colours (so much ``turned``) or values (``moved``)."""
    points = [dict(p) for p in SHELL["points"]]
    for p in points:
        p["opacity"] *= changes.get("times", 1.0)
        p["rgb"] = [c + changes.get("turned", 0.0) * (d - c) for c, d in zip(p["rgb"], p["rgb"][::-1], strict=True)]
        p["x"] += changes.get("moved", 0.0)
    return {**SHELL, "points": points}


@pytest.fixture(scope="module")
def values():
    z, y, x = np.mgrid[-1:1:24j, -1:1:28j, -1:1:32j]
    values = np.exp(-2 * (x**2 + 1.5 * (y - 0.1) ** 2 + z**2)) * (1 - 0.4 * np.exp(-9 * ((x - 0.3) ** 2 + y**2)))
    return values.astype(np.float32)


@pytest.fixture(scope="module")
def session(values):
    return vvgt.Session(values, spacing=SPACING)


@pytest.fixture(scope="module")
def earlier(session):
    return session.convert(SHELL, **GOAL)


def started_warm(result):
    return not [why for name, why in result.report.skipped if name == PreviousLook.name]


def names(result):
    return [stage.name for stage in result.stages]


@pytest.mark.parametrize(
    ("changes", "less"), [({"times": 0.5}, 0), ({"turned": 0.4}, 0.8), ({"moved": 0.02}, 0)]
)  # so few Gaussians are too wide for colours of their own
def test_another_function_is_as_near_as_by_itself(session, earlier, changes, less):
    tf = shell(**changes)
    alone, later = session.convert(tf, **GOAL), session.convert(tf, **GOAL, after=earlier)
    assert started_warm(later)
    assert later.scores["psnr"] > alone.scores["psnr"] - less
    assert "closed form" in names(alone)
    assert names(later)[-5:] == ["earlier", "check views", "views", "refinement", "test views"]
    assert later.report.refinement["steps"] == 24
    assert later.report.refinement["standard"] == earlier.report.refinement["psnr_after"]
    assert np.array_equal(session.convert(tf, **GOAL, after=earlier).gaussians.means, later.gaussians.means)


def test_another_light_and_another_size(session, earlier):
    lit = vvgt.Look(SHELL, light="headlight")
    alone, later = session.convert(lit, **GOAL), session.convert(lit, **GOAL, after=earlier)
    assert started_warm(later)
    assert later.gaussians.degree == 2
    assert later.scores["psnr"] > alone.scores["psnr"] - 0.5
    unlit = session.convert(SHELL, **GOAL, after=later)
    assert started_warm(unlit)
    assert unlit.gaussians.degree == 0
    assert unlit.report.refinement["standard"] == earlier.report.refinement["psnr_after"]  # by itself, not the last
    small = {**GOAL, "screen": 64}
    assert started_warm(other := session.convert(SHELL, **small, after=earlier))
    assert other.ply.screen_size == 64


@pytest.mark.parametrize(
    ("look", "goal", "why"),
    [
        (OUTSIDE, {}, "differs too much"),
        (SHELL, {"max_gaussians": 300}, "Gaussians"),
        (SHELL, {"steps": 0}, "no steps"),
        (vvgt.Look(SHELL, light=vvgt.LightOptions(("sun",))), {}, "a sky"),
    ],
)
def test_what_is_too_far_is_converted_by_itself(session, earlier, look, goal, why):
    asked = {**GOAL, **goal}
    later, alone = session.convert(look, **asked, after=earlier), session.convert(look, **asked)
    assert why in dict(later.report.skipped)[PreviousLook.name]
    assert np.array_equal(later.gaussians.means, alone.gaussians.means)
    assert np.array_equal(later.gaussians.colors, alone.gaussians.colors)
    assert names(later)[-1] == "conditions"


def test_a_volume_that_went_on_is_released_at_once(session, earlier):
    gc.disable()
    try:
        later = session.convert(SHELL, **GOAL, after=earlier)
        assert started_warm(later)
        field = weakref.ref(later.field)
        del later
        assert field() is None
    finally:
        gc.enable()


def test_refused(session, earlier):
    refused(vvgt.UsageError, "same volume", vvgt.convert, "example:blob:16", "viridis", **GOAL, after=earlier)
    refused(
        vvgt.UsageError, r"after with --live: .*remove it", session.convert, SHELL, **GOAL, after=earlier, live=True
    )
    with pytest.raises(vvgt.UsageError, match=r"after with labels: .*remove it"):
        vvgt.convert("example:blob:16", **GOAL, after=earlier, split_labels=True)
    refused(vvgt.UsageError, r"after with .*give one function", session.convert, [SHELL, "gray"], **GOAL, after=earlier)


def test_the_same_look_changes_nothing(session, earlier):
    field = earlier.field
    same, before = recolor_earlier(earlier, field), to_box_frame(earlier.gaussians, field.source.volume)
    assert np.allclose(same.opacity, before.opacity.clip(*OPAQUE), atol=1e-6)
    assert np.allclose(same.colors, np.maximum(before.colors, 0), atol=1e-6)
    assert np.array_equal(same.means, before.means)


def test_depth_goes_with_extinction(session, earlier):
    thin = session.convert(shell(times=0.5), **{**GOAL, "steps": 0})
    found = recolor_earlier(earlier, thin.field)
    before = to_box_frame(earlier.gaussians, earlier.field.source.volume)
    seen = (before.opacity > 0.05) & (before.opacity < 0.9)
    ratio = np.log1p(-found.opacity[seen]) / np.log1p(-before.opacity[seen])
    assert np.median(ratio) == pytest.approx(np.log1p(-0.2) / np.log1p(-0.4), rel=0.15)
    assert ratio.min() >= 1 / MAX_RATIO
    assert replace(found, means=before.means).degree == 0
    assert to_unit_frame(found, thin.field.source.volume).means.shape == before.means.shape


def test_in_blocks_too(values):
    first, second = (
        vvgt.convert(values, SHELL, **GOAL, spacing=SPACING, blocks=16),
        vvgt.Session(values, spacing=SPACING).convert(SHELL, **GOAL),
    )
    tf = shell(times=0.5)
    blocked = vvgt.convert(values, tf, **GOAL, after=first, spacing=SPACING, blocks=16)
    assert started_warm(blocked)
    assert started_warm(vvgt.convert(values, tf, **GOAL, after=second, spacing=SPACING, blocks=16))
    whole = vvgt.convert(values, tf, **GOAL, after=second, spacing=SPACING)
    assert blocked.scores["psnr"] == pytest.approx(whole.scores["psnr"], abs=0.1)
    values = values.copy()
    values[12, 12, 12] = 0
    refused(vvgt.UsageError, "same volume", vvgt.convert, values, tf, **GOAL, after=first, spacing=SPACING, blocks=16)
