"""Optics grids: against the float64 twin, quadrature, the scalar scene that they come from, and themselves turned."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from tests.closed_form_scenes import Ramp, Tent, scene_of, score
from tests.stiff_scenes import camera, quadrature
from vvgt_cli.cameras import default_views
from vvgt_cli.checks.self_test import require_cuts_keep_mass
from vvgt_cli.closed_form import VbmOptions, backproject, initialise
from vvgt_cli.closed_form.closed_form import closed_form
from vvgt_cli.closed_form.moments import base_cells
from vvgt_cli.dvr import RenderSettings, Scene, render_view, render_view_reference, render_views
from vvgt_cli.dvr.layout import Texels
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume, shapes

FINE = RenderSettings(step=0.0625, samples=1)
LIT = Lighting(headlight=True, directions=((0.6, -0.48, 0.64),))


@dataclass(frozen=True)
class Named:
    name: str = "grid"


def random_grid(shape=(9, 10, 11), top: float = 3.0, share: float = 0.5, seed: int = 0) -> np.ndarray:
    """Independent voxels, a ``share`` of them empty."""
    rng = np.random.default_rng(seed)
    tau = rng.random(shape) * top * (rng.random(shape) > share)
    return np.concatenate([rng.random((*shape, 3)) * tau[..., None], tau[..., None]], axis=-1).astype(np.float32)


def grid_scene(grid: np.ndarray, spacing=(1.0, 1.0, 1.0), lighting: Lighting | None = None) -> Scene:
    return Scene.of_grid(Volume(grid[..., 3], spacing), Named(), 1.0, grid.copy(), lighting)


def classified(volume: Volume, tf: object, finer: int = 1) -> Scene:
    """A scalar scene as a grid of its own voxels, or of finer ones, trilinear between its centres."""
    scene = scene_of(volume, tf)
    fine = replace(volume, spacing=tuple(s / finer for s in volume.spacing))
    axes = [np.clip((np.arange(n * finer) + 0.5) / finer - 0.5, 0, n - 1) for n in volume.data.shape]
    values = volume.data.astype(np.float64)
    for axis, at in enumerate(axes):
        low = np.minimum(at.astype(int), len(values) * 0 + values.shape[axis] - 2).clip(0)
        share = np.reshape(at - low, [-1 if a == axis else 1 for a in range(3)])
        values = np.take(values, low, axis) * (1 - share) + np.take(values, low + 1, axis) * share
    tau = -np.log1p(-np.clip(tf.opacity(values.ravel()), 0, 1 - 1e-5)) / scene.unit_distance
    grid = np.concatenate([tf.color(values.ravel()) * tau[:, None], tau[:, None]], axis=1)
    grid = grid.reshape(*values.shape, 4).astype(np.float32)
    return Scene.of_grid(replace(fine, data=grid[..., 3]), Named(), scene.unit_distance, grid)


# ---- pictures


@pytest.mark.parametrize("top", [1e-3, 3.0, 1e3])
@pytest.mark.parametrize("lighting", [None, LIT], ids=["unlit", "lit"])
def test_pictures_are_the_twins(top: float, lighting: Lighting | None) -> None:
    scene = grid_scene(random_grid(top=top), (1.0, 1.3, 0.7), lighting)
    view = camera(12, 12) if top < 10 else camera(6, 6)  # the twin takes eight times as many steps then
    ours, twin = render_view(scene, view, FINE), render_view_reference(scene, view, step=1 / (256 if top > 10 else 32))
    assert twin.max() > min(top / 1e3, 0.9)
    stiff = lighting is not None and top > 10  # shading is constant along a segment
    assert np.abs(ours - twin).mean() < (1e-2 if stiff else 2e-3) * twin.max()
    assert (ours[..., :3] <= ours[..., 3:] + 2e-6).all()


def test_a_grid_of_one_extinction_and_colour_has_the_exact_picture() -> None:
    grid = np.broadcast_to(np.array([0.1, 0.2, 0.3, 0.4], np.float32), (4, 4, 8, 4))
    image = render_view(grid_scene(grid), camera(1, 1, (5, 0, 0)), RenderSettings(step=4.0, samples=1))
    alpha = -np.expm1(-0.4 * 8)
    np.testing.assert_allclose(image[0, 0], [alpha / 4, alpha / 2, alpha * 3 / 4, alpha], rtol=1e-6)


def test_leaps_over_empty_space_change_nothing() -> None:
    grid = np.zeros((40, 33, 50, 4), np.float32)
    grid[10:14, 20:30, 33:36] = random_grid((4, 10, 3))
    scene = grid_scene(grid)
    assert scene.empty.max() > 1
    full = replace(scene, empty=np.zeros_like(scene.empty))
    for eye in ((2.2, -1.6, 1.1), (3.0, 0.0, 0.0), (0.1, 0.1, 0.1)):
        one, other = (render_view(s, camera(24, 24, eye)) for s in (scene, full))
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_no_colour_is_invented_between_voxels() -> None:
    """Red around blue: every pixel is a mix of both, where a scalar 1 around 3 would show what 2 has."""
    z, y, x = np.mgrid[:16, :16, :16] - 7.5
    radius = np.sqrt(x * x + y * y + z * z)
    grid = np.zeros((16, 16, 16, 4), np.float32)
    grid[radius < 7] = 0.05, 0, 0, 0.05
    grid[radius < 4] = 0, 0, 1, 1
    image = render_view(grid_scene(grid), camera(48, 48))
    assert image[..., 0].max() > 0.1 < image[..., 2].max()
    np.testing.assert_allclose(image[..., 0] + image[..., 2], image[..., 3], atol=1e-5)
    made = initialise(grid_scene(grid), VbmOptions(300, 48)).gaussians
    assert np.abs(made.colors[:, 1]).max() < 1e-6
    np.testing.assert_allclose(made.colors.sum(axis=1), 1, atol=1e-5)


def test_layouts_that_kernels_do_not_know_are_refused() -> None:
    for wrong in (random_grid().astype(np.float64), random_grid()[..., :3], random_grid()[:, ::2]):
        with pytest.raises(ValueError, match="grid"):
            Texels(wrong)


# ---- closed form


@pytest.mark.parametrize("level", [-2, 0, 1])
def test_mass_and_colour_are_exact(level: int) -> None:
    grid = random_grid()
    scene = grid_scene(grid, (1.0, 1.5, 0.5))
    moments = base_cells(scene, np.full(3, level)).moments.sum(axis=0)
    exact = scene.grid.astype(np.float64).reshape(-1, 4).sum(axis=0) * scene.step.prod()
    assert moments[0] == pytest.approx(quadrature(scene, 4), rel=1e-9)
    inner = grid_scene(np.pad(grid, [(2, 2)] * 3 + [(0, 0)]))  # nothing is cut at the rim: the voxels' own sum
    sums = base_cells(inner, np.full(3, level)).moments.sum(axis=0)
    exact = inner.grid.astype(np.float64).reshape(-1, 4).sum(axis=0) * inner.step.prod()
    np.testing.assert_allclose(sums[[10, 11, 12, 0]], exact, rtol=1e-6)


def test_first_moments_converge_to_quadrature() -> None:
    scene = grid_scene(random_grid())
    at = np.stack(np.meshgrid(*[(np.arange(n * 8) + 0.5) / 8 - 0.5 for n in (11, 10, 9)], indexing="ij"), -1)
    from vvgt_cli.dvr.reference import optics_at

    tau = optics_at(scene, at.reshape(-1, 3))[0]
    exact = (tau[:, None] * ((at.reshape(-1, 3) + 0.5) * scene.step - scene.half)).sum(axis=0) * (scene.step / 8).prod()
    off = []
    for points in (2, 8):
        moments = base_cells(scene, np.zeros(3, np.int64), points).moments.sum(axis=0)
        off.append(np.abs(moments[1:4] - exact).max() / moments[0])
    assert off[0] < 5e-3
    assert off[1] < 1e-6


def test_cuts_keep_the_mass() -> None:
    require_cuts_keep_mass(closed_form(grid_scene(random_grid((20, 20, 20), share=0.8)), 300, 64).tree)


def test_the_same_bytes_twice_and_turned_volumes_are_as_good() -> None:
    def bytes_of(g: Gaussians) -> list[bytes]:
        return [a.tobytes() for a in (g.means, g.log_scales, g.quaternions, g.opacity_logits, g.colors)]

    grid = random_grid((14, 10, 12), share=0.7)
    cameras = default_views("test", 3, size=48)
    turn = np.eye(3)[[2, 0, 1]]
    turned = np.ascontiguousarray(grid.transpose(1, 2, 0, 3))
    views = render_views(grid_scene(grid), cameras)
    other = [replace(c, rotation=c.rotation @ turn.T) for c in cameras]
    np.testing.assert_allclose(render_views(grid_scene(turned), other), views, atol=2e-3)
    first, again, third = (initialise(grid_scene(g), VbmOptions(800, 48)).gaussians for g in (grid, grid, turned))
    assert bytes_of(first) == bytes_of(again)
    assert score(third, other, views) == pytest.approx(score(first, cameras, views), abs=0.3)


def test_units_of_length_do_not_matter() -> None:
    grid = random_grid((14, 10, 12), share=0.7)
    one = initialise(grid_scene(grid), VbmOptions(300, 48)).gaussians
    other = initialise(grid_scene(grid / 1024, (1024.0,) * 3), VbmOptions(300, 48)).gaussians
    np.testing.assert_array_equal(one.means, other.means)
    np.testing.assert_array_equal(one.opacity_logits, other.opacity_logits)


@pytest.mark.parametrize("tf", [Ramp(0.5), Tent(0.5, 0.3, 0.5)], ids=["linear", "tent"])
def test_a_scalar_scene_as_a_grid_converges_to_it(tf) -> None:
    volume = shapes.random_field((12, 11, 10), cycles=2, seed=3)
    cameras = default_views("test", 3, size=48)
    scalar = scene_of(volume, tf)
    views, mass = render_views(scalar, cameras), base_cells(scalar, np.zeros(3, np.int64)).moments[:, 0].sum()
    pictures, masses = [], []
    for finer in (1, 2, 4):
        grid = classified(volume, tf, finer)
        pictures.append(float(np.abs(render_views(grid, cameras) - views).mean()))
        masses.append(abs(base_cells(grid, np.zeros(3, np.int64)).moments[:, 0].sum() / mass - 1))
    if tf.name == "ramp":  # linear where it is premultiplied alone: extinction is exact
        assert max(masses) < 1e-3
    else:
        assert masses[2] < masses[1] < masses[0]
    assert pictures[2] < 0.5 * pictures[1] < 0.3 * pictures[0]
    gaussians = [initialise(s, VbmOptions(1500, 48)).gaussians for s in (scalar, classified(volume, tf, 4))]
    assert score(gaussians[1], cameras, views) == pytest.approx(score(gaussians[0], cameras, views), abs=0.5)


def test_views_mend_it_and_light_falls_on_it() -> None:
    scene = grid_scene(random_grid((14, 14, 14), 1.0, 0.8))
    cameras = default_views("train", 6, size=48)
    for lit, degree in ((scene, 0), (scene.lit(Lighting()), 2)):
        views = render_views(lit, cameras, RenderSettings(samples=1))
        start = initialise(lit, VbmOptions(1500, 48, degree=degree))
        mended, _ = backproject(start, cameras, views)
        before, after = score(start.gaussians, cameras, views), score(mended, cameras, views)
        assert before > 20
        assert after > before
    assert mended.degree == 2


def test_nothing_visible_is_nothing() -> None:
    scene = grid_scene(np.zeros((6, 6, 6, 4), np.float32))
    assert not render_view(scene, camera(8, 8)).any()
    assert not len(initialise(scene, VbmOptions(100, 64)).gaussians)
    assert not render(initialise(grid_scene(random_grid()), VbmOptions(1, 64)).gaussians, camera(8, 8)).max() > 1
