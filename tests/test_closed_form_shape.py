"""From moments to splats: opacity, rotation, shape, and the offset of opaque surfaces."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.closed_form_scenes import Above, Ramp, Tent, scene_of
from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.closed_form.cell_kernels import principal_axes
from vvgt_cli.closed_form.closed_form import closed_form
from vvgt_cli.closed_form.moments import base_cells
from vvgt_cli.closed_form.shape import ROUND, make_gaussians, widened
from vvgt_cli.closed_form.surface_offset import flattened, opaque_field, surface_offset
from vvgt_cli.closed_form.wavelet import box_surrogate
from vvgt_cli.dvr import render_view
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.constants import MAX_ALPHA, MIN_ALPHA
from vvgt_cli.gaussians.frames import rotations
from vvgt_cli.gaussians.opacity import dilogarithm, inverse_dilogarithm, opacity_when_reshaped, peak_opacity
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume, shapes


def test_dilogarithm_is_the_mass_of_a_splat() -> None:
    """The image integral of -ln(1 - o g), g a unit Gaussian, is 2 pi Li2(o)."""
    r = (np.arange(200_000) + 0.5) * (9 / 200_000)
    for o in (0.05, 0.4, 0.9, 0.99):
        mass = -(2 * math.pi * r * np.log1p(-o * np.exp(-0.5 * r * r))).sum() * (9 / 200_000)
        assert 2 * math.pi * dilogarithm(np.array(o)) == pytest.approx(mass, rel=2e-5)


def test_inverse_dilogarithm() -> None:
    o = np.linspace(0, MAX_ALPHA, 3001)
    np.testing.assert_allclose(inverse_dilogarithm(dilogarithm(o)), o, atol=1e-9)
    assert (np.diff(dilogarithm(o)) > 0).all()
    assert inverse_dilogarithm(np.array([1.7, 1e9])).tolist() == [MAX_ALPHA, MAX_ALPHA]


def test_peak_opacity_bounds_and_order() -> None:
    variances = 10.0 ** np.random.default_rng(0).uniform(-12, 2, (500, 3))
    for mass in (0.0, 1e-9, 1e-3, 1.0, 1e6):
        opacity = peak_opacity(np.full(500, mass), variances, 0.005)
        assert (opacity >= 0).all()
        assert (opacity <= MAX_ALPHA).all()
    rising = peak_opacity(np.logspace(-8, 3, 200), np.broadcast_to([1e-4, 2e-4, 4e-4], (200, 3)), 0.005)
    assert (np.diff(rising) >= 0).all()
    assert rising[0] == pytest.approx(MIN_ALPHA, rel=0.01)  # with no mass to show: just cut
    assert rising[-1] == pytest.approx(MAX_ALPHA)


def test_peak_opacity_does_not_depend_on_the_order_of_axes() -> None:
    variances = np.array([[1e-4, 3e-4, 9e-4], [9e-4, 1e-4, 3e-4], [3e-4, 9e-4, 1e-4]])
    opacity = peak_opacity(np.full(3, 1e-3), variances, 0.005)
    np.testing.assert_allclose(opacity, opacity[0], rtol=1e-12)


@pytest.mark.parametrize("sigma_px", [0.4, 2.0, 9.0])
@pytest.mark.parametrize("peak_depth", [0.05, 0.3, 1.0])
def test_rendered_mass(sigma_px: float, peak_depth: float) -> None:
    """Sum of -ln(1 - alpha) x pixel area over the picture of one isotropic Gaussian: its optical mass within 1 %."""
    camera = look_at((0, 0, 4), width=96, height=96)
    pixel = 4 / camera.fx
    variance = (sigma_px * pixel) ** 2
    mass = peak_depth * 2 * math.pi * (variance + 0.3 * pixel**2)
    opacity = peak_opacity(np.array([mass]), np.full((1, 3), variance), pixel)
    splat = make_gaussians(np.zeros((1, 3)), np.full((1, 3), variance), np.eye(3)[None], opacity, np.ones((1, 3)))
    measured = []
    for dx, dy in np.random.default_rng(0).random(
        ({0.4: 150, 2.0: 20, 9.0: 1}[sigma_px], 2)
    ):  # which pixels the cut leaves out
        alpha = render(splat, replace(camera, cx=48 + dx, cy=48 + dy))[..., 3].astype(np.float64)
        measured.append(-np.log1p(-alpha).sum() * pixel**2)
    assert np.mean(measured) == pytest.approx(mass, rel=0.01)


def test_make_gaussians_refuses_what_is_not_finite() -> None:
    with pytest.raises(DataError, match="not finite"):
        make_gaussians(np.full((1, 3), np.nan), np.ones((1, 3)), np.eye(3)[None], np.array([0.5]), np.zeros((1, 3)))


def test_box_surrogate_is_the_best_fit() -> None:
    """Sigma and amplitude of the isotropic Gaussian nearest in L2 to a unit box, by brute force in 3D."""
    sigma, kept = box_surrogate()
    x = (np.arange(80) + 0.5) / 80 * 4 - 2
    box = (np.abs(x) < 0.5).astype(float)
    box3 = box[:, None, None] * box[:, None] * box

    def error(s: float, mass: float) -> float:
        g = np.exp(-0.5 * (x / s) ** 2) / (math.sqrt(2 * math.pi) * s)
        return float(((box3 - mass * g[:, None, None] * g[:, None] * g) ** 2).sum())

    best = error(sigma, kept)
    for ds, dm in ((0.02, 0), (-0.02, 0), (0, 0.03), (0, -0.03)):
        assert error(sigma + ds, kept + dm) > best
    assert 0.2 < sigma < 0.8


def surfaces(volume: Volume, tf=None):
    scene = scene_of(volume, tf or Above(1.0))
    return scene, opaque_field(base_cells(scene, np.zeros(3, np.int64)), scene.step, scene.half)


def test_a_field_of_wider_cells_holds_their_means(monkeypatch: pytest.MonkeyPatch) -> None:
    _, fine = surfaces(shapes.sphere(16, 0.6))
    monkeypatch.setattr("vvgt_cli.closed_form.surface_offset.MAX_FIELD", fine.field.size // 8)
    _, wide = surfaces(shapes.sphere(16, 0.6))
    nz, ny, nx = wide.field.shape
    assert 2 * np.array(wide.field.shape) == pytest.approx(fine.field.shape)
    means = fine.field.reshape(nz, 2, ny, 2, nx, 2).mean(axis=(1, 3, 5))
    np.testing.assert_allclose(wide.field, means, atol=1e-6)
    assert wide.field.max() == pytest.approx(1)


def moved(opaque, points: np.ndarray, sigma: float, reach: float = 2.0, pixel: float = 0.02) -> np.ndarray:
    count = len(points)
    axes = np.broadcast_to(np.eye(3), (count, 3, 3))
    return surface_offset(
        opaque, points, np.full((count, 3), sigma**2), axes, np.full(count, reach), 0.3 * pixel**2, 6 * pixel
    )


def test_inset_of_a_ball_is_radial() -> None:
    scene, opaque = surfaces(shapes.sphere(40, 0.6))
    assert opaque.any
    rng = np.random.default_rng(0)
    ray = rng.standard_normal((400, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    points = ray * rng.uniform(0.56, 0.61, (400, 1))
    shift = moved(opaque, points, 0.03)
    inwards = -(shift * ray).sum(axis=1)
    assert (inwards > 0.01).all()
    assert np.linalg.norm(shift + inwards[:, None] * ray, axis=1).max() < 0.25 * inwards.max()
    # the surface ends where it is wanted: reach x sqrt(variance + dilation) further out
    depth = 0.6 - np.linalg.norm(points + shift, axis=1)
    wanted = 2.0 * math.sqrt(0.03**2 + 0.3 * 0.02**2)
    np.testing.assert_allclose(depth, wanted, atol=0.75 * float(scene.step[0]))
    # a cell counts as opaque from half the depth 5 on: the body reaches 0.3 voxels further than its surface
    np.testing.assert_allclose(np.median(depth), wanted, atol=0.4 * float(scene.step[0]))


def test_inset_leaves_the_inside_alone() -> None:
    _, opaque = surfaces(shapes.sphere(40, 0.6))
    deep = np.random.default_rng(0).uniform(-0.2, 0.2, (100, 3))
    np.testing.assert_array_equal(moved(opaque, deep, 0.03), 0)
    np.testing.assert_array_equal(moved(opaque, np.full((1, 3), 0.95), 0.03), 0)  # no body near
    np.testing.assert_array_equal(moved(opaque, np.array([[0.58, 0, 0]]), 0.03, reach=0.0), 0)


@pytest.mark.parametrize("voxels", [3, 4, 6])
def test_inset_stops_in_the_middle_of_a_plate(voxels: int) -> None:
    data = np.zeros((40, 40, 40), np.float32)
    data[18 : 18 + voxels] = 1
    scene, opaque = surfaces(Volume(data), Above(1.0, 0.5))
    step = float(scene.step[2])
    middle = (18 + voxels / 2) * step - 1
    rng = np.random.default_rng(0)
    points = np.zeros((200, 3))
    points[:, :2] = rng.uniform(-0.5, 0.5, (200, 2))
    points[:, 2] = middle + rng.choice([-1, 1], 200) * rng.uniform(0.15, 0.6, 200) * voxels * step
    shift = moved(opaque, points, 0.2)  # wants far more depth than there is
    side = np.sign(points[:, 2] - middle)
    assert (side * shift[:, 2] <= 0).all()
    after = side * (points[:, 2] + shift[:, 2] - middle)
    assert after.min() > -0.3 * step  # the search goes by quarter cells
    assert after.max() < 0.5 * step
    np.testing.assert_allclose(shift[:, :2], 0, atol=1e-9)


def test_covariances_are_flattened_along_the_normal_of_a_surface() -> None:
    _, opaque = surfaces(shapes.sphere(40, 0.6))
    ray = np.random.default_rng(0).standard_normal((400, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    cov = np.broadcast_to(np.eye(3), (400, 3, 3)).copy()
    by = np.linspace(0.1, 0.9, 400)
    taken = cov - flattened(opaque, 0.6 * ray, cov, by)
    np.testing.assert_allclose(np.trace(taken, axis1=1, axis2=2), by)
    np.testing.assert_allclose(np.einsum("ki,kij,kj->k", ray, taken, ray), by, rtol=0.01)
    np.testing.assert_array_equal(flattened(opaque, 0.2 * ray, cov, by), cov)  # deep inside there is no surface


def test_filled_cells_lie_flat_under_a_surface() -> None:
    """The shortest axis is the normal of an opaque ball, whose filled cells have no axes of their own."""
    splats = closed_form(scene_of(shapes.sphere(40, 0.6), Above(1.0)), 6000, 400).gaussians()
    scales = np.exp(splats.log_scales.astype(np.float64))
    shortest = rotations(splats.quaternions)[np.arange(len(splats)), :, scales.argmin(axis=1)]
    place = np.linalg.norm(splats.means, axis=1)
    outer = place > 0.5
    assert outer.sum() > 2000
    assert np.quantile(np.abs((shortest * splats.means).sum(axis=1) / place)[outer], 0.05) > 0.9


def test_translucent_scenes_have_no_surfaces() -> None:
    for tf in (Ramp(0.5), Tent()):
        _, opaque = surfaces(shapes.random_field(24, cycles=4), tf)
        assert not opaque.any


@pytest.mark.parametrize("radius", [0.5, 0.8])
def test_silhouette_of_a_ball(radius: float) -> None:
    """The alpha = 0.5 contour of an opaque ball in its splats: within 1 px of the ray caster's, in every direction."""
    size = 128
    scene = scene_of(shapes.sphere(40, radius), Above(1.0))
    splats = closed_form(scene, 6000, size).gaussians(style=ROUND)
    for camera in default_views("test", 3, size=size):
        truth, ours = render_view(scene, camera)[..., 3], render(splats, camera)[..., 3]
        radii = [math.sqrt((alpha > 0.5).sum() / math.pi) for alpha in (truth, ours)]
        assert radii[1] == pytest.approx(radii[0], abs=0.6)
        # no hole inside, nothing outside, beyond a pixel of the contour
        y, x = np.mgrid[:size, :size] + 0.5
        r = np.hypot(x - size / 2, y - size / 2)
        assert ours[r < radii[0] - 1].min() > 0.5
        assert ours[r > radii[0] + 1].max() < 0.5


@pytest.mark.parametrize("spread", [1.0, 1e-6, 0.0])
def test_principal_axes_against_lapack(spread: float) -> None:
    """Random, nearly isotropic, flat and diagonal covariances, of every size."""
    rng = np.random.default_rng(0)
    factors = rng.normal(size=(200, 3, 3)) * spread + np.eye(3)
    factors[50:100, :, 2] = 0
    factors[100:120] *= np.eye(3)
    cov = factors @ factors.transpose(0, 2, 1) * 10.0 ** rng.integers(-12, 6, 200)[:, None, None]
    values, vectors = np.empty((200, 3)), np.empty((200, 3, 3))
    principal_axes(cov, values, vectors)
    size = np.abs(cov).max(axis=(1, 2))[:, None]
    np.testing.assert_allclose(values / size, np.linalg.eigvalsh(cov) / size, atol=1e-14)
    rebuilt = (vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1)
    np.testing.assert_allclose(rebuilt / size[..., None], cov / size[..., None], atol=1e-13)
    np.testing.assert_allclose(vectors @ vectors.transpose(0, 2, 1), np.broadcast_to(np.eye(3), cov.shape), atol=1e-13)


def test_opacity_follows_a_change_of_shape_as_the_mass_has_it() -> None:
    rng = np.random.default_rng(3)
    mass, pixel = rng.uniform(1e-5, 2e-4, 200), 0.004
    before = np.exp(rng.uniform(-10, -8, (200, 1))) * np.ones(3)  # of balls, whose areas are the same from all sides
    after = before * rng.uniform(1.0, 1.6, (200, 1))
    opacity = peak_opacity(mass, before, pixel)
    inside = opacity < MAX_ALPHA
    found = opacity_when_reshaped(opacity, before, after, pixel)
    np.testing.assert_allclose(found[inside], peak_opacity(mass, after, pixel)[inside], atol=1e-6)
    np.testing.assert_allclose(opacity_when_reshaped(opacity, before, before, pixel), opacity, atol=1e-9)
    assert inside.sum() > 50


def test_wider_gaussians_keep_their_shortest_axis_their_place_and_their_mass() -> None:
    variances = np.array([[1e-6, 4e-5, 9e-5], [3e-5, 3e-5, 3e-5]])
    axes, color = np.tile(np.eye(3), (2, 1, 1)), np.full((2, 3), 0.5)
    flat = make_gaussians(np.zeros((2, 3)), variances, axes, np.array([0.6, 0.6]), color)
    wide = widened(flat, 1.3, 1e-9)
    np.testing.assert_allclose(np.exp(wide.log_scales - flat.log_scales)[0], [1, 1.3, 1.3], rtol=1e-5)
    np.testing.assert_array_equal(wide.means, flat.means)
    np.testing.assert_array_equal(wide.log_scales[1], flat.log_scales[1])  # a ball has no shortest axis
    assert wide.opacity_logits[1] == pytest.approx(flat.opacity_logits[1], abs=1e-5)
    opacity = 1 / (1 + np.exp(-wide.opacity_logits.astype(float)))
    assert opacity[0] == pytest.approx(
        float(inverse_dilogarithm(dilogarithm(np.array(0.6)) / 1.69)), abs=0.03
    )  # seen flat; less from the side
    saturated = replace(flat, opacity_logits=np.full(2, 4.6, np.float32))
    assert np.isfinite(widened(saturated, 1.1, 1e-3).opacity_logits).all()
