"""Light: what is asked for, how samples are shaded and what arrives."""

import math
from dataclasses import replace

import numpy as np
import pytest

from vvgt_cli.cameras.sets import look_at
from vvgt_cli.closed_form.columns import COLUMNS, X, Z
from vvgt_cli.closed_form.lit import ARRIVING, TINT, _shade, point_normals
from vvgt_cli.dvr import RenderSettings, Scene, render_view, render_view_reference
from vvgt_cli.dvr.backends import view_renderer
from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.light import ANGLE, OFFSET, RAYS, Matter, cone, sphere, transmittance
from vvgt_cli.dvr.reference import grid_values, normals, optics, trilinear
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
    "shadows": Lighting(False, (SLANTED,), shadows=True),
    "all": Lighting(True, (SLANTED, ABOVE), shadows=True, occlusion=0.3),
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


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers_are_shaded_as_floats(dtype):
    scene = blob(dtype=dtype).lit(LIGHTS["all"])
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
    point_normals(scene.voxels, scene.optics, scene.step, voxels, found)
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
    straight = blob().lit(Lighting(False, (SLANTED,), shadows=True))
    other = blob(direction=quarter).lit(Lighting(False, (tuple(turned @ SLANTED),), shadows=True))
    np.testing.assert_allclose(other.light.directions, straight.light.directions, atol=1e-12)
    np.testing.assert_allclose(other.light.shade, straight.light.shade, atol=1e-5)


def brute_force(scene, points, directions, offset):
    """Mean transmittance (n,) from points (n, 3), voxels, along unit ``directions``: steps of a 16th, in float64."""
    total = np.zeros(len(points))
    for d in directions / scene.step:
        pace, depth = np.linalg.norm(d), np.zeros(len(points))
        for t in np.arange(offset + 1 / 32, 60, 1 / 16):
            at = points + t * d / pace
            inside = ((at > -0.5) & (at < np.array(scene.volume.dims) - 0.5)).all(axis=1)
            tau = optics(scene, trilinear(scene.volume, at))[0]
            depth += np.where(inside, tau, 0) / 16 / pace
        total += np.exp(-depth)
    return total / len(directions)


def matter(scene):
    return Matter(scene.voxels, scene.optics, scene.empty, scene.step)


def test_the_grid_of_shadows_converges_to_rays_from_every_place():
    thick = blob(24)
    faint = function([0.0, 0.3, 0.5, 1.0], [0, 0, 0.1, 0.05])  # of what is thick no grid shows the first half voxel
    scene = Scene.build(thick.volume, faint, 1.0)
    directions, rng = cone(np.array(SLANTED), ANGLE, 3), np.random.default_rng(0)
    points = rng.uniform(0.2, 0.8, (60, 3)) * np.array(scene.volume.dims)
    exact = brute_force(scene, points, directions, 1.5)
    assert exact.min() < 0.5
    assert exact.max() > 0.9
    errors = []
    for cell in (8, 4, 2, 1):
        grid = transmittance(matter(scene), directions, cell, step=0.125, offset=1.5)
        errors.append(np.abs(grid_values(grid, (points + 0.5) / cell - 0.5) - exact).mean())
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.005
    assert errors[-1] < errors[-3] / 6  # second order


def test_shadows_of_the_lowest_and_the_highest_value_are_as_deep_as_any():
    tf = function([0, 1], [0.05, 0.05])
    found = []
    for value in (0.0, 0.5, 1.0):
        scene = Scene.build(Volume(np.full((16, 16, 16), value, np.float32)), tf, 1.0)
        found.append(transmittance(matter(scene), np.array([ABOVE, SLANTED]), 4, step=0.5, offset=1.0))
    assert found[1].min() < 0.7
    np.testing.assert_allclose(found[0], found[1], atol=1e-5)
    np.testing.assert_allclose(found[2], found[1], atol=1e-5)


def test_an_opaque_wall_throws_a_shadow():
    data = np.zeros((24, 24, 24), np.float32)
    data[16:19, :, :12] = 1.0  # a shelf over half of a block
    data[2:8] = 0.6
    scene = Scene.build(Volume(data), function([0, 0.4, 0.5, 1], [0, 0, 1, 1]), 1.0)
    above = scene.lit(Lighting(False, (ABOVE,), 0.0, 1.0, 0.0, shadows=True))
    shade = above.light.shade[0]
    assert shade[8, 12, 5] < 0.01
    assert shade[8, 12, 18] > 0.95
    assert 0.1 < shade[8, 12, 11:14].mean() < 0.9  # soft
    seen = render_view(above, look_at((2.0, 0.01, 2.4), width=64, height=64, fov=40), RenderSettings(samples=1))
    plain = render_view(scene.lit(replace(above.lighting, shadows=False)), camera(8), RenderSettings(samples=1))
    assert np.isfinite(seen).all()
    assert plain[..., :3].max() > 0.5


@pytest.mark.parametrize("thick", [1, 2, 3])
def test_a_thin_sheet_right_behind_empty_bricks_throws_its_shadow(thick):
    """A leap over what is empty ends at the sheet's brick, however far from the place the ray begins."""
    data = np.zeros((40, 24, 24), np.float32)
    data[16 : 16 + thick] = 1.0
    scene = Scene.build(Volume(data), function([0, 0.5, 1], [0, 0, 0.9]), 1.0)
    directions = np.array([[0.0, 0.0, 1.0], [0.28, 0.0, 0.96]])
    points = np.array([[12.0, 12.0, z] for z in (3.0, 5.0, 8.0)])
    for offset in (1.5, 4.0):
        found = grid_values(transmittance(matter(scene), directions, 1, step=0.125, offset=offset), points)
        np.testing.assert_allclose(found, brute_force(scene, points, directions, offset), atol=0.03)
        assert found.max() < 0.6


def test_occlusion_leaves_a_plane_open_and_darkens_a_corner():
    data = np.zeros((24, 24, 24), np.float32)
    data[:8] = 1.0
    data[:, :8] = 1.0
    scene = Scene.build(Volume(data), function([0, 0.5, 0.6, 1], [0, 0, 1, 1]), 1.0)
    shade = scene.lit(Lighting(occlusion=0.5)).light.shade[-1]
    assert shade.shape == (24, 24, 24)
    assert shade[8, 20, 12] > 0.9
    assert shade[8, 8, 12] < 0.75 * shade[8, 20, 12]
    assert shade[3, 3, 12] < 0.05


def test_the_openness_at_a_gaussian_is_interpolated_between_cells():
    random, half, step = np.random.default_rng(4), np.array([3.0, 2.0, 1.0]), np.array([0.1, 0.2, 0.3])
    places, shade = random.uniform(0, (24, 20, 16), (50, 3)), random.uniform(size=(1, 4, 5, 6)).astype(np.float32)
    light = Light(1.0, 0.0, 0.0, 1.0, 1, np.zeros((0, 3)), shade, 0, 1, 0.25, np.ones(3), np.zeros(3))
    moments, rows, out = np.ones((50, COLUMNS)), np.arange(50), np.empty((50, ARRIVING))
    moments[:, X : Z + 1] = places * step - half
    _shade(light, np.zeros((50, 3)), moments, rows, rows + 1, half, step, out)
    np.testing.assert_allclose(out[:, TINT.start], trilinear(Volume(shade[0]), places / 4 - 0.5), atol=1e-6)


def test_directions_are_spread_evenly():
    axis = np.array(SLANTED)
    spread = cone(axis, ANGLE, 200)
    np.testing.assert_allclose(np.linalg.norm(spread, axis=1), 1)
    assert math.degrees(np.arccos(np.clip(spread @ axis, -1, 1)).max()) < ANGLE
    np.testing.assert_allclose(spread.mean(axis=0) / np.linalg.norm(spread.mean(axis=0)), axis, atol=1e-3)
    around = sphere(96)
    np.testing.assert_allclose(around.T @ around / 96, np.eye(3) / 3, atol=0.01)
    assert RAYS > 1
    assert OFFSET > 0


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


@pytest.mark.parametrize(
    ("lights", "options", "message"),
    [
        (("0,0,0",), {}, "--light 0,0,0: its length is 0"),
        (("sideways",), {}, "--light sideways; expected studio, overcast, window, FILE.hdr, headlight, X,Y,Z, x"),
        (("anterior",), {}, "--light anterior: the volume states no anatomical space"),
        (("none", "above"), {}, "--light none --light above: expected none, or other lights"),
        ((), {"ambient": 0.3}, "--ambient: there is no light; add --light headlight"),
        (("headlight",), {"shadows": True}, "--shadows: a headlight casts no visible shadows"),
        (("headlight",), {"ambient": -0.1}, "--ambient -0.1: expected 0 to 1000"),
        (("headlight",), {"occlusion": 0.0}, "--ambient-occlusion 0: expected a length above 0"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(lights, options, message):
    with pytest.raises(UsageError) as error:
        lighting(*lights, **options)
    assert message in str(error.value)


@pytest.mark.parametrize("name", LIGHTS)
def test_a_header_line_gives_the_light_back(name):
    assert parse_lighting(LIGHTS[name].text()) == LIGHTS[name]


@pytest.mark.parametrize("text", ["", "0.1 0.2", "0.1 0.7 0.2 10.0", "0.1 0.7 0.2 10.0 headlight lamp"])
def test_other_lines_are_refused(text):
    with pytest.raises((ValueError, UsageError, TypeError)):
        parse_lighting(text)


# VTK.


def test_renderers_say_which_light_they_do_not_know():
    with pytest.raises(UsageError, match="neither our shadows nor"):
        view_renderer("vtk", blob().lit(LIGHTS["shadows"]))
