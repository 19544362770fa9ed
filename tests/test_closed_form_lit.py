"""Light in closed form: harmonics of the head-light and of highlights, colours of lit cells, normals."""

import numpy as np
import pytest

from tests.test_light import ABOVE, SLANTED, function
from tests.test_light_vtk import smooth_ball
from vvgt_cli.closed_form import METHODS, VbmOptions, initialise
from vvgt_cli.closed_form.lit import at_points, even, highlights, mean_normals
from vvgt_cli.dvr import Scene
from vvgt_cli.dvr.light import sphere
from vvgt_cli.dvr.reference import normals
from vvgt_cli.gaussians.frames import basis, view_colors
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.volume import Volume

DIRECTIONS = sphere(2000)


def some_normals(count=4, seed=0):
    n = np.random.default_rng(seed).normal(size=(count, 3))
    return n / np.linalg.norm(n, axis=1, keepdims=True)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_headlight_in_harmonics(degree):
    """Of |n . d| the best of a degree where it is seen; of the square of it, exact from degree 2 on."""
    n = some_normals()
    outer = n[:, :, None] * n[:, None, :]
    cosine = np.abs(n @ DIRECTIONS.T)
    for power, most in ((1.0, 0.05), (2.0, 1e-12)):
        mean, across = even(outer, power, degree)
        seen = mean[:, None] + across @ basis(DIRECTIONS, 2)[:, 3:8].T
        off = np.sqrt((cosine * (seen - cosine**power) ** 2).sum(axis=1) / cosine.sum(axis=1))
        assert off.max() < (most if degree >= 2 else 0.3)
        assert degree >= 2 or off.max() > 0.2


def test_mixed_normals_add_up():
    n = some_normals(6)
    outer = n[:, :, None] * n[:, None, :]
    mean, across = even(outer, 1.0, 2)
    together = even(outer.mean(axis=0, keepdims=True), 1.0, 2)
    np.testing.assert_allclose(together[0], [mean.mean()])
    np.testing.assert_allclose(together[1], [across.mean(axis=0)])
    half = even(0.5 * outer, 1.0, 2)  # half of the mass without a normal
    np.testing.assert_allclose(half[0], 0.5 * mean)


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_highlights_in_harmonics(degree):
    """The projection on the sphere: what is left over is at right angles to every harmonic."""
    n, lights = some_normals(), np.array([SLANTED, ABOVE])
    mean, terms = highlights(n[:, :, None] * n[:, None, :], lights, 4.0, degree)
    half = lights[:, None, :] - DIRECTIONS
    half /= np.linalg.norm(half, axis=2, keepdims=True)
    exact = sum(np.abs(n @ h.T) ** 4 for h in half)
    functions = basis(DIRECTIONS, degree)
    left = exact - mean[:, None] - terms @ functions.T
    assert np.abs(left.mean(axis=1)).max() < 5e-3
    if degree:
        assert np.abs(left @ functions / len(DIRECTIONS)).max() < 5e-3
    assert left.std() < 0.9 * exact.std() or degree == 0


def made(scene, degree, method="moments", budget=300):
    return initialise(scene, VbmOptions(budget, 64, method, degree=degree)).gaussians


@pytest.mark.parametrize("method", METHODS)
def test_a_ramp_is_lit_as_its_normal_says(method):
    ramp = np.broadcast_to(np.linspace(0, 1, 12)[:, None, None], (12, 12, 12)).astype(np.float32)
    dark = Scene.build(Volume(ramp), function([0, 1], [0.2, 0.2], [[0.2, 0.4, 0.8]] * 2), 1.0)
    color = np.array([0.2, 0.4, 0.8])
    fixed = made(dark.lit(Lighting(False, (SLANTED,), 0.1, 0.7, 0.0)), 0, method)
    assert fixed.harmonics is None
    np.testing.assert_allclose(
        fixed.colors, np.broadcast_to((0.1 + 0.7 * SLANTED[2]) * color, fixed.colors.shape), atol=1e-6
    )
    head = made(dark.lit(Lighting(True, (), 0.1, 0.7, 0.0)), 2, method)
    for eye in ((0.0, 0.0, 50.0), (0.0, 30.0, 40.0), (50.0, 0.0, 0.0)):
        cosine = eye[2] / 50
        seen = view_colors(head, np.array(eye))
        expected = (0.1 + 0.7 * (0.8 * cosine**2 + 4 / 15)) * color
        np.testing.assert_allclose(seen, np.broadcast_to(expected, seen.shape), atol=0.02)


@pytest.mark.parametrize("degree", [0, 2, 3])
@pytest.mark.parametrize("method", METHODS)
def test_a_ramp_shines_as_its_normal_says(method, degree):
    """Where all normals and colours are alike, a cell has the harmonics of its normal, to the last digits."""
    ramp = np.broadcast_to(np.linspace(0, 1, 12)[:, None, None], (12, 12, 12)).astype(np.float32)
    color = np.array([0.2, 0.4, 0.3])
    dark = Scene.build(Volume(ramp), function([0, 1], [0.2, 0.2], [color] * 2), 1.0)
    normal = np.diag([0.0, 0.0, 1.0])[None]
    lights = np.array([SLANTED, ABOVE])
    shone, shone_terms = highlights(normal, lights, 3.0, degree)
    arriving = 0.1 + 0.3 * (lights[:, 2] @ np.ones(2))
    fixed = made(dark.lit(Lighting(False, (SLANTED, ABOVE), 0.1, 0.3, 0.2, 3.0)), degree, method)
    expected = arriving * color + 0.2 * shone
    np.testing.assert_allclose(fixed.colors, np.broadcast_to(expected, fixed.colors.shape), atol=1e-6)
    spread, spread_across = even(normal, 1.0, degree)
    peak, peak_across = even(normal, 3.0, degree)
    head = made(dark.lit(Lighting(True, (), 0.1, 0.3, 0.2, 3.0)), degree, method)
    expected = (0.1 + 0.3 * spread) * color + 0.2 * peak
    np.testing.assert_allclose(head.colors, np.broadcast_to(expected, head.colors.shape), atol=1e-6)
    if degree:
        both = 0.2 * shone_terms[0, :, None] * np.ones(3)
        np.testing.assert_allclose(fixed.harmonics, np.broadcast_to(both, fixed.harmonics.shape), atol=1e-6)
        both = 0.3 * spread_across[0, :, None] * color + 0.2 * peak_across[0, :, None]
        np.testing.assert_allclose(head.harmonics[:, 3:8], np.broadcast_to(both, (len(head), 5, 3)), atol=1e-6)
        assert not head.harmonics[:, :3].any()


def test_of_an_opaque_body_the_surface_counts():
    """Inside a body of one value there is no gradient, and ambient light alone; nobody sees that."""
    z, y, x = np.indices((24, 24, 24)) - 11.5
    data = np.where(x * x + y * y + z * z < 81, 1.0, 0.0).astype(np.float32)
    dark = Scene.build(Volume(data), function([0, 0.5, 0.6, 1], [0, 0, 1, 1]), 1.0)
    lit = made(dark.lit(Lighting(True, (), 0.0, 1.0, 0.0)), 2, budget=60)
    outside = np.linalg.norm(lit.means, axis=1) > 0.5
    seen = view_colors(lit, np.array([3.0, 0, 0]))[:, 0]
    toward = lit.means[:, 0] / np.linalg.norm(lit.means, axis=1)
    front = outside & (toward > 0.8)
    assert front.any()
    assert np.median(seen[front]) > 0.7


def test_normals_of_a_ball_point_along_the_radius():
    scene = smooth_ball().lit(Lighting())
    gaussians = made(scene, 2)
    found = mean_normals(gaussians, lambda points: at_points(scene, points), scene.half)
    radius = gaussians.means / np.linalg.norm(gaussians.means, axis=1, keepdims=True)
    surface = np.linalg.norm(gaussians.means, axis=1) > 0.4
    assert np.median(-(found * radius).sum(axis=1)[surface]) > 0.99  # values fall outwards
    lengths = np.linalg.norm(found, axis=1)
    assert ((np.abs(lengths - 1) < 1e-9) | (lengths == 0)).all()
    centres = (gaussians.means + scene.half) / scene.step - 0.5
    assert np.median((normals(scene, centres) * found).sum(axis=1)[surface]) > 0.99
