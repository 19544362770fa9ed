"""Light: what is asked for, how samples are shaded and what arrives."""

import math
from dataclasses import replace

import numpy as np
import pytest

from vvgt_cli.cameras.sets import look_at
from vvgt_cli.closed_form.columns import COLUMNS, X, Z
from vvgt_cli.closed_form.lit import FIXED, SUMS, _shade, point_normals
from vvgt_cli.dvr import RenderSettings, Scene, render_view, render_view_reference
from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.light import sphere
from vvgt_cli.dvr.reference import normals, trilinear
from vvgt_cli.dvr.vtk import view_renderer
from vvgt_cli.errors import UsageError
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.lighting import Lighting, LightOptions, parse_lighting
from vvgt_cli.volume import Volume

ABOVE = (0.0, 0.0, 1.0)
SLANTED = (0.6, -0.48, 0.64)
FINE = RenderSettings(step=0.125, samples=1)


def function(x, opacity, rgb=None):
    at = np.asarray(x, float)
    colors = np.ones((len(at), 3)) if rgb is None else np.asarray(rgb, float)
    return TransferFunction("t", PiecewiseOpacity(at, np.asarray(opacity, float)), ColorMap(at, colors))


def blob(n=16, bad=False, dtype=np.float32, **place):
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, k) for k in (n, n + 4, n + 8)], indexing="ij")
    data = np.exp(-2 * (x * x + 1.5 * y * y + 0.7 * z * z) + 0.4 * np.sin(3 * x + y))
    if dtype != np.float32:
        data = data * 180
    data = data.astype(dtype)
    if bad:
        data[4:6, 8:10, 12] = np.nan
    top = 1.0 if dtype == np.float32 else 180.0
    nodes = np.array([0.0, 0.3, 0.5, 1.0]) * top
    tf = function(nodes, [0, 0, 0.6, 0.2], [[0, 0, 1], [0, 1, 0], [1, 1, 0], [1, 0, 0]])
    return Scene.build(Volume(data, (1.0, 1.0, 1.5), **place), tf, 1.0)


def camera(size=24, eye=(2.2, -1.6, 1.1)):
    return look_at(eye, width=size, height=size, fov=40)


LIGHTS = {
    "headlight": Lighting(),
    "above": Lighting(False, (ABOVE,), 0.2, 0.6, 0.4, 4.5),
    "two and the headlight": Lighting(True, (SLANTED, (0.0, 1.0, 0.0)), 0.1, 0.4, 0.1, 30.0),
    "bright": Lighting(True, (), 3.0, 2.0, 5.0, 1.0),
}


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize("bad", [False, True])
def test_the_kernel_shades_as_its_twin(name, bad):
    scene = blob(bad=bad).lit(LIGHTS[name])
    image, twin = render_view(scene, camera(12), FINE), render_view_reference(scene, camera(12), step=1 / 16)
    error = np.abs(image - twin)
    assert np.isfinite(image).all()
    assert error.mean() < 5e-4
    assert bad or error.max() < 5e-3
    assert (image[..., :3] <= image[..., 3:] + 1e-6).all()
    dark = render_view(blob(bad=bad), camera(12), FINE)
    assert np.abs(image - dark)[..., :3].max() > 0.05
    np.testing.assert_allclose(image[..., 3], dark[..., 3], atol=1e-6)


def test_no_lines_where_the_gradient_of_a_thin_shell_changes_its_sign():
    z, y, x = np.meshgrid(*[np.arange(24.0) - 11.5] * 3, indexing="ij")
    shell = 100 * np.exp(-((np.sqrt(x * x + y * y + z * z) - 8) ** 2) / 4)
    tf = function([0, 20, 100], [0, 0, 0.3])
    scene = Scene.build(Volume(shell.astype(np.float32), (1.0, 1.0, 1.0)), tf, 1.0).lit(LIGHTS["headlight"])
    image = render_view(scene, camera(32), RenderSettings(samples=1))
    assert np.abs(image - render_view_reference(scene, camera(32), step=1 / 32)).max() < 0.012


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers_are_shaded_as_floats(dtype):
    scene = blob(dtype=dtype).lit(LIGHTS["two and the headlight"])
    twin = render_view_reference(scene, camera(12), step=1 / 16)
    assert np.abs(render_view(scene, camera(12), FINE) - twin).max() < 5e-3


def test_the_normal_is_the_analytic_one_inside():
    scene = blob(40)
    points = np.random.default_rng(0).uniform(8, 30, (200, 3))
    step = 1e-3
    slopes = [
        (trilinear(scene.volume, points + step * u) - trilinear(scene.volume, points - step * u)) / scene.step[axis]
        for axis, u in enumerate(np.eye(3))
    ]
    exact = np.stack(slopes, axis=1)
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    assert ((normals(scene, points) * exact).sum(axis=1) > 0.995).mean() > 0.95


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("nx", [2, 3, 4, 9])
def test_normals_are_the_twins_at_edges_too(dtype, nx):
    rng = np.random.default_rng(nx)
    data = (rng.integers(0, 200, (5, 4, nx)) * np.ones(1)).astype(dtype)
    data[:2] = 7  # nothing differs there
    if dtype == np.float32:
        data[4, 3, 1] = np.nan
    scene = Scene.build(Volume(data, (1.0, 1.0, 1.5)), function([0, 200], [0.1, 0.6]), 1.0)
    voxels = rng.uniform(-0.5, np.array([nx, 4, 5]) - 0.5, (300, 3))
    voxels[::3] = np.round(voxels[::3])
    found, twin = np.empty((300, 4)), normals(scene, voxels)
    point_normals(scene.voxels, scene.shaded, scene.optics, scene.step, voxels, found)
    assert 0.05 < (~twin.any(axis=1)).mean() < 0.9
    np.testing.assert_array_equal(found[:, :3].any(axis=1), twin.any(axis=1))
    np.testing.assert_allclose(found[:, :3], twin, atol=1e-6)


def test_without_a_gradient_there_is_ambient_light_alone():
    """VTK's rule, by both mappers; and a ramp along z shows |n . l| of the light to the digit."""
    flat = Scene.build(Volume(np.full((6, 6, 6), 0.5)), function([0, 1], [0.3, 0.3], [[0.2, 0.4, 0.8]] * 2), 1.0)
    lit = flat.lit(Lighting(True, (ABOVE,), 0.25, 0.9, 0.9))
    view = camera(1, eye=(4, 0.1, 0.1))
    np.testing.assert_allclose(
        render_view(lit, view, FINE)[0, 0, :3], 0.25 * render_view(flat, view, FINE)[0, 0, :3], rtol=1e-6
    )
    ramp = np.broadcast_to(np.linspace(0, 1, 12)[:, None, None], (12, 12, 12)).astype(np.float32)
    dark = Scene.build(Volume(ramp), function([0, 1], [0.3, 0.3]), 1.0)
    seen = render_view(dark.lit(Lighting(False, (SLANTED,), 0, 1, 0)), view, FINE)[0, 0, :3]
    np.testing.assert_allclose(seen, abs(SLANTED[2]) * render_view(dark, view, FINE)[0, 0, :3], rtol=1e-5)


def test_a_light_turns_with_the_world():
    """A direction is of the world: the volume's axes are turned by a quarter, and the light with them."""
    quarter = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    turned = np.array(quarter).reshape(3, 3)
    straight = blob().lit(Lighting(False, (SLANTED,)))
    other = blob(direction=quarter).lit(Lighting(False, (tuple(turned @ SLANTED),)))
    np.testing.assert_allclose(other.light.directions, straight.light.directions, atol=1e-12)


def test_a_skys_light_at_a_gaussian_is_interpolated_between_cells():
    random, half, step = np.random.default_rng(4), np.array([3.0, 2.0, 1.0]), np.array([0.1, 0.2, 0.3])
    places, shade = random.uniform(0, (24, 20, 16), (50, 3)), random.uniform(size=(3, 4, 5, 6)).astype(np.float32)
    light = Light(1.0, 0.0, 0.0, 1.0, 1, np.zeros((0, 3)), shade, 1, 0.25, np.ones(3), np.zeros(3))
    moments, rows, out = np.ones((50, COLUMNS)), np.arange(50), np.empty((50, SUMS))
    moments[:, X : Z + 1] = places * step - half
    _shade(light, np.zeros((50, 3)), moments, rows, rows + 1, half, step, out)
    np.testing.assert_allclose(out[:, FIXED.start + 1], trilinear(Volume(shade[1]), places / 4 - 0.5), atol=1e-6)


def test_directions_are_spread_evenly():
    around = sphere(96)
    np.testing.assert_allclose(around.T @ around / 96, np.eye(3) / 3, atol=0.01)


# What is asked for.


def lighting(*lights, preset=None, space=None, **options):
    return LightOptions(tuple(lights), **options).lighting(preset, space)


def test_directions_in_words_numbers_and_axes():
    assert lighting() is None
    assert lighting("none") is None
    assert lighting("headlight") == Lighting()
    found = lighting("0,0,-2", "-x", "above", "headlight")
    assert found.headlight
    assert found.directions == ((0, 0, -1), (-1, 0, 0), (0, 0, 1))
    assert lighting("left").directions == ((-1, 0, 0),)
    assert lighting("left", space="LPS").directions == ((1, 0, 0),)
    assert lighting("anterior", space="RAS").directions == ((0, 1, 0),)
    assert lighting("1e-200,0,1e-200").directions[0] == pytest.approx((math.sqrt(0.5), 0, math.sqrt(0.5)))


def test_presets_are_taken_and_overruled():
    preset = Lighting(ambient=0.2, diffuse=1.0, specular=0.0)
    assert lighting(preset=preset) == preset
    assert lighting("none", preset=preset) is None
    assert lighting("above", preset=preset) == replace(preset, headlight=False, directions=(ABOVE,))
    assert lighting(preset=preset, ambient=0.5) == replace(preset, ambient=0.5)
    assert not lighting("above", preset=preset).depends_on_view
    assert lighting("above").depends_on_view
    assert preset.depends_on_view
    assert not replace(preset, diffuse=0.0).depends_on_view


@pytest.mark.parametrize(
    ("lights", "options", "message"),
    [
        (("0,0,0",), {}, "--light 0,0,0: its length is 0"),
        (("sideways",), {}, "--light sideways; expected studio, overcast, window, sun, FILE.hdr, headlight, X,Y,Z, x"),
        (("anterior",), {}, "--light anterior: the volume states no anatomical space"),
        (("none", "above"), {}, "--light none --light above: expected none, or other lights"),
        ((), {"ambient": 0.3}, "--ambient: there is no light; add --light headlight"),
        (("headlight",), {"ambient": -0.1}, "--ambient -0.1: expected 0 to 1000"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(lights, options, message):
    with pytest.raises(UsageError) as error:
        lighting(*lights, **options)
    assert message in str(error.value)


def test_directions_stay_to_the_bit_however_often_they_are_written():
    for seed in range(200):
        x, y, z = np.random.default_rng(seed).normal(size=3)
        once = lighting(f"{x},{y},{z}")
        assert parse_lighting(once.text()) == once


@pytest.mark.parametrize("name", LIGHTS)
def test_a_header_line_gives_the_light_back(name):
    assert parse_lighting(LIGHTS[name].text()) == LIGHTS[name]


@pytest.mark.parametrize("text", ["", "0.1 0.2", "0.1 0.7 0.2 10.0", "0.1 0.7 0.2 10.0 headlight lamp"])
def test_other_lines_are_refused(text):
    with pytest.raises((ValueError, UsageError, TypeError)):
        parse_lighting(text)


# VTK.


def test_renderers_say_which_light_they_do_not_know():
    with pytest.raises(UsageError, match="no skies"):
        view_renderer(blob().lit(LightOptions(("sun",)).lighting(None, None)))
