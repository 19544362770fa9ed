"""Stiff and extreme scenes through function tables, ray caster, light, closed form and whole conversions."""

from dataclasses import replace

import numpy as np
import pytest

from tests.stiff_scenes import (
    GRIDS,
    RAMP_Y,
    SCALARS,
    TYPES,
    build,
    camera,
    function,
    in_turns,
    quadrature,
    ramp,
    rough,
    smooth,
    solid_beside_nothing,
    step,
)
from vvgt_cli.cameras import default_views
from vvgt_cli.checks.self_test import (
    FINE,
    bound_long_steps,
    compare_with_twin,
    convert_scene,
    require_cuts_keep_mass,
    require_in_range,
    require_valid,
)
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.closed_form.closed_form import closed_form
from vvgt_cli.closed_form.moments import base_cells
from vvgt_cli.dvr import RenderSettings, render_view, render_views
from vvgt_cli.gaussians.frames import view_colors
from vvgt_cli.look import PiecewiseOpacity
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.look.tables import build_tables, extinction
from vvgt_cli.splat import render

STIFF = SCALARS | GRIDS
LIT = [name for name in SCALARS if name not in {f"type {kind}" for kind in TYPES}]
EVERYTHING = Lighting(True, ((0.6, -0.48, 0.64), (0.0, 0.0, 1.0)))
SIZE = 64
STIFFEST = (  # for every change; the others are long
    "depth 1e+06 a voxel", "shell of a thousandth", "spacing (1.0, 1.0, 1000.0)", "values of 1e+300", "a block of nan",
    "a single visible voxel", "labels of depth 1e+06 a voxel", "a voxel of a label of opacity 1",
    "layers that meet in half a voxel",
)  # fmt: skip
assert set(STIFFEST) <= set(STIFF)


def scenes(names):
    """Parametrise by names of scenes, all but `STIFFEST` for the long tier."""
    return pytest.mark.parametrize(
        "name", [pytest.param(name, marks=[pytest.mark.long] * (name not in STIFFEST)) for name in names]
    )


def assert_within(figure):
    assert figure.value <= figure.limit, figure


# ---- functions


def random_nodes(count: int = 1000):
    return function(np.linspace(0, 1, count), np.random.default_rng(0).uniform(0, 1, count))


TABLES = {  # function, range, unit distance, slope of the stored values
    "step": (step(0.8),),
    "step between two floats": (step(0.8, 1.2e-16),),
    "two nodes at one place": (function([0, 0.5, 0.5, 1], [0, 0, 1, 1]),),
    "opacity 1": (function([0, 1], [1, 1]),),
    "spike of a millionth": (function([0, 0.5, 0.5 + 1e-6, 0.5 + 2e-6, 1], [0, 0, 1, 0, 0]),),
    "one node": (function([0.5], [0.4]),),
    "constant data": (ramp(), 0.5, 0.5),
    "beyond the nodes": (ramp(), 5.0, 9.0),
    "before the nodes": (ramp(), -9.0, -5.0),
    "values of 1e-30": (ramp(1e-30), 0, 1e-30),
    "values of 1e30": (ramp(1e30), -1e30, 1e30),
    "unit distance 1e-30": (ramp(), 0, 1, 1e-30),
    "unit distance 1e30": (ramp(), 0, 1, 1e30),
    "values that fall": (ramp(), 0, 1, 1.0, -0.25),
    "thousand nodes": (random_nodes(),),
}


@pytest.mark.parametrize("name", TABLES)
def test_tables_equal_the_function_in_float64(name):
    tf, lo, hi, distance, slope = (*TABLES[name], *(None, 0.0, 1.0, 1.0, 1.0)[len(TABLES[name]) :])
    tables = build_tables(tf, (lo, hi), slope=slope, unit_distance=distance, world_per_unit=1.0)
    assert np.isfinite(tables.nodes).all()
    assert np.isfinite(tables.cumulative).all()
    assert (tables.nodes >= 0).all()
    assert (np.diff(tables.cumulative, axis=0) >= 0).all()
    x = np.clip((tables.lo + np.arange(tables.bins + 1) / tables.inv_width) * slope, min(lo, hi), max(lo, hi))
    tau = extinction(tf.opacity(x), distance)
    no_node_between = np.diff(np.searchsorted(tf.breakpoints(), x)) == 0
    same = np.concatenate([[True], no_node_between]) & np.concatenate([no_node_between, [True]])
    exact = np.column_stack([tau[:, None] * tf.color(x), tau])
    scale = max(float(exact.max()), float(tables.nodes.max()), 1e-300)
    assert np.abs(tables.nodes - exact)[same].max(initial=0) <= 3e-6 * scale  # constants get a range of 1e-6


@pytest.mark.parametrize(("sharpness", "midpoint"), [(0.0, 0.0), (0.0, 1.0), (0.5, 0.001), (1.0, 0.5)])
def test_bent_segments_stay_between_their_ends(sharpness, midpoint):
    x, y = np.array([0.0, 0.4, 0.4, 1.0]), np.array([0.1, 0.9, 0.2, 0.7])
    values = PiecewiseOpacity(x, y, np.full(4, midpoint), np.full(4, sharpness))(np.linspace(-0.5, 1.5, 5001))
    assert 0.1 <= values.min() <= values.max() <= 0.9


def test_functions_are_stretched_to_extreme_ranges_and_transparent_at_nan():
    f = np.linspace(0, 1, 101)
    for lo, hi in ((0.0, 1e-30), (-1e300, 1e300), (1e6, 1e6 + 1)):
        wide = ramp().rescaled(lo, hi)
        np.testing.assert_allclose(wide.opacity(lo * (1 - f) + hi * f), ramp().opacity(f), atol=1e-6)
    ends = ramp().opacity(np.array([np.nan, -np.inf, -1e300, 1e300, np.inf]))
    assert ends.tolist() == [0, 0, 0, RAMP_Y[-1], RAMP_Y[-1]]


# ---- views


@scenes(STIFF)
def test_views_match_the_twin_and_long_steps_stay_bounded(name):
    stiff = STIFF[name]
    scene, view = stiff.make(), camera(fov=stiff.fov)
    assert_within(compare_with_twin(scene, view, stiff.step, stiff.error))
    assert_within(bound_long_steps(scene, view))


@scenes(LIT)
def test_lit_views_match_the_twin_and_lit_gaussians_are_finite(name):
    """Under a headlight; every third also under two more lights."""
    stiff, at = SCALARS[name], LIT.index(name)
    for lighting in (Lighting(), EVERYTHING)[: 1 + (at % 3 == 0)]:  # shading is that of the middle of a step
        lit = stiff.make().lit(lighting)
        assert_within(compare_with_twin(lit, camera(10, 10, fov=stiff.fov), stiff.step, 2 * stiff.error))
    degree = at % 4
    made = initialise(stiff.make().lit(EVERYTHING), VbmOptions(200, SIZE, degree=degree)).gaussians
    if len(made):
        assert made.degree == degree
        for view in default_views("train", 6, size=SIZE):
            assert np.abs(view_colors(made, view.position)).max() <= 4
            assert np.isfinite(render(made, view)).all()


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)])
def test_a_light_along_an_axis_seen_along_it(axis):
    lit = build(smooth(), ramp()).lit(Lighting(False, (axis,)))
    assert_within(compare_with_twin(lit, camera(eye=tuple(4 * a for a in axis)), 1 / 32, 5e-3))


def test_extreme_coefficients_and_noise():
    scene, view = build(smooth(), ramp()), camera(eye=(2, -2, 1))
    for power in (0.0, 1000.0):
        assert_within(compare_with_twin(scene.lit(Lighting(specular=1, specular_power=power)), view, 1 / 32, 5e-3))
    black = render_view(scene.lit(replace(EVERYTHING, ambient=0, diffuse=0, specular=0)), view, FINE)
    assert not black[..., :3].any()
    np.testing.assert_array_equal(black[..., 3], render_view(scene, view, FINE)[..., 3])
    assert_within(compare_with_twin(build(rough(), ramp()).lit(EVERYTHING), camera(), 1 / 32, 1e-2))
    require_valid(render_view(build(rough(), step(1.0)).lit(EVERYTHING), camera(), FINE))


@pytest.mark.parametrize("scene", [in_turns(0.3), in_turns(1.0), solid_beside_nothing()])
def test_no_colour_between_two_labels_is_invented(scene):
    seen = render_view(scene, camera(), RenderSettings(samples=1))
    assert seen.any()
    assert seen[..., 1].max() <= 1e-6
    assert np.abs(initialise(scene, VbmOptions(300, SIZE)).gaussians.colors[:, 1]).max() <= 1e-6


# ---- closed form and conversion


@scenes(STIFF)
def test_optical_mass_equals_quadrature_and_every_cut_keeps_it(name):
    stiff = STIFF[name]
    scene = stiff.make()
    cells = base_cells(scene, np.zeros(3, np.int64))
    assert np.isfinite(cells.moments).all()
    assert cells.moments[:, 0].sum() == pytest.approx(quadrature(scene, stiff.points), rel=stiff.mass)
    cameras = default_views("train", size=SIZE)
    form = closed_form(scene, 300, SIZE, cameras)
    if len(form.tree):
        require_cuts_keep_mass(form.tree)
        require_in_range(form.gaussians(), scene, 300)
    else:  # thinner than the gaps between rays
        assert not render_views(scene, cameras, RenderSettings(samples=1)).any()


def test_one_gaussian_keeps_the_mass_of_a_faint_ball():
    at = (np.arange(12) + 0.5) / 6 - 1
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    scene = build(np.exp(-(x * x + y * y + z * z) / (2 * 0.25**2)), function([0, 1], [0, 0.02]))
    ours = render(initialise(scene, VbmOptions(1, SIZE)).gaussians, camera(SIZE, SIZE))[..., 3].sum()
    exact = render_view(scene, camera(SIZE, SIZE), RenderSettings(step=0.25, samples=1))[..., 3].sum()
    assert ours == pytest.approx(exact, rel=0.05)  # the cut at 1/255


@scenes(STIFF)
def test_no_stage_of_a_conversion_loses(name):
    assert_within(convert_scene(STIFF[name].make()))
