"""Light traced along paths: against a twin, closed forms and the white furnace; skies; the grid and its views."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests import paths_twin
from tests.test_formats import errors
from tests.test_light import blob, camera, function
from vvgt_cli.dvr import RenderSettings, Scene, render_view, render_view_reference
from vvgt_cli.dvr.light import shade_cell, sphere
from vvgt_cli.dvr.sky import COLUMNS, ROWS, Sky, directions, sky_of
from vvgt_cli.dvr.traced import _doubled, _halved, lines
from vvgt_cli.errors import UsageError
from vvgt_cli.field.open import FieldNeeds, _settings
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import in_unit_frame, read_ply
from vvgt_cli.gaussians.formats import read_splats
from vvgt_cli.images.files import read_png
from vvgt_cli.look.lighting import SKIES, LightOptions, parse_lighting
from vvgt_cli.volume import Volume

FRONT = np.array([0.0, -1.0, 0.0])


def uniform(level=1.0):
    share = np.arange(1, ROWS * COLUMNS + 1) / (ROWS * COLUMNS)
    return Sky(np.full((ROWS, COLUMNS, 3), level), share)


def body(opacity=0.6, color=1.0, n=9, values=None):
    """A ramp along all axes, or a homogeneous cube, of one colour."""
    values = (
        np.add.outer(np.add.outer(np.arange(n), np.arange(n)), np.arange(n)) / (3 * n - 3.0)
        if values is None
        else values
    )
    tf = function([0, 0.4, 0.5, 1], [0, 0, opacity, opacity], [[color] * 3] * 4)
    return Scene.build(Volume(values.astype(np.float32)), tf, 1.0)


def light_at(matter, sky, points, paths, seed=3):
    first = np.zeros(len(points), np.int64)
    return matter.gathered(sky, seed, points, first, first + paths)[:, :3] / paths


def seen(scene, count=400, **more):
    matter = replace(scene.scattering(), **more)
    rays = lines(scene.values.shape, scene.step, 4 * count, np.random.default_rng(0))
    return matter, matter.scattered(rays, 5)[:count, :6]


@pytest.mark.parametrize("opacity", [1e-6, 0.3, 1 - 1e-5])
@pytest.mark.parametrize("phase", [0.0, 0.95])
def test_white_matter_in_a_white_furnace_is_white(opacity, phase):
    """Whatever scatters, as much light arrives as the sky sends: none gained, and none lost by long paths."""
    matter, points = seen(body(opacity, n=15), 300, phase=phase)
    if opacity == 1e-6:
        points = lines((15, 15, 15), matter.step, 300, np.random.default_rng(0))
    found = light_at(matter, uniform(), points, 100)
    assert found.mean() == pytest.approx(1, abs=0.012)


@pytest.mark.parametrize("unit", [1e6, 1.0, 1e-6])
def test_light_is_finite_in_time_and_never_more_than_the_skys(unit):
    """At optical depths of 1e-6 to 1e7 a voxel, black, grey and white."""
    for color in (0.0, 0.5, 1.0):
        values = np.random.default_rng(0).random((6, 7, 8)).astype(np.float32)
        scene = Scene.build(Volume(values), function([0, 0.5, 1], [0, 0.3, 1], [[color] * 3] * 3), unit)
        matter = replace(scene.scattering(), phase=0.95)
        points = lines((6, 7, 8), scene.step, 50, np.random.default_rng(0))
        found = light_at(matter, uniform(2.0), points, 20)
        assert np.isfinite(found).all()
        assert found.min() >= 0
        assert found.mean() < 2.1


def test_black_matter_gets_what_comes_straight():
    """In the middle of a homogeneous cube: the mean transmittance to its faces."""
    scene = body(0.2, 0.0, values=np.ones((7, 7, 7)))
    around = sphere(4000)
    depth = -math.log(0.8) * 3.5 / np.abs(around).max(axis=1)
    point = np.array([[3.0, 3.0, 3.0, 0.0, 0.0, 1.0]])
    found = light_at(scene.scattering(), uniform(), point, 4000)
    np.testing.assert_allclose(found, np.exp(-depth).mean(), rtol=0.02)


@pytest.mark.parametrize("g", [0.0, 0.7])
@pytest.mark.parametrize("name", ["studio", "window"])
def test_paths_bring_what_the_twins_do(name, g):
    scene, sky = blob(), sky_of(name, FRONT, np.eye(3))

    def light(along):
        row = np.clip(((1 - along[:, 2]) / 2 * ROWS).astype(int), 0, ROWS - 1)
        turn = np.arctan2(along[:, 1], along[:, 0]) / (2 * math.pi) % 1
        return sky.radiance[row, np.minimum((turn * COLUMNS).astype(int), COLUMNS - 1)]

    matter, points = seen(scene, 60, phase=g)
    found = light_at(matter, sky, points, 200).mean(axis=0)
    rng, twins = np.random.default_rng(1), []
    for _ in range(12):
        twins.append(paths_twin.arriving(scene, light, points, rng, g=g).mean(axis=0))
    error = np.std(twins, axis=0) / math.sqrt(len(twins))
    assert (np.abs(found - np.mean(twins, axis=0)) < 4 * error + 0.004).all()
    assert (error < 0.06).all()


def test_a_paths_numbers_depend_on_nothing_but_its_own():
    """So that threads, which take points in any order, change nothing."""
    matter, points = seen(blob(), 150)
    sky = sky_of("studio", FRONT, np.eye(3))
    whole = light_at(matter, sky, points, 3)
    np.testing.assert_array_equal(light_at(matter, sky, points[:90], 3), whole[:90])
    assert len(np.unique(whole[:, 0])) > 140
    assert np.abs(light_at(matter, sky, points, 3, seed=77) - whole).mean() > 0.01


def test_an_optics_grid_scatters_as_the_values_it_was_made_of():
    scene = body(0.3, 0.6)
    tau = np.clip((scene.values - 0.4) / 0.1, 0, 1) * 0.3
    grid = np.repeat(tau[..., None], 4, axis=3).astype(np.float32) * [0.6, 0.6, 0.6, 1]
    other = Scene.of_grid(scene.volume, scene.tf, 1.0, np.ascontiguousarray(grid, np.float32))
    sky = sky_of("overcast", FRONT, np.eye(3))
    matter, points = seen(scene)
    mean = light_at(matter, sky, points, 20).mean()
    assert light_at(other.scattering(), sky, points, 20).mean() == pytest.approx(mean, rel=0.1)


# Skies.


@pytest.mark.parametrize("name", SKIES)
def test_a_sky_is_exposed_for_a_white_surface(name):
    sky = sky_of(name, FRONT, np.eye(3))
    assert (sky.radiance >= 0).all()
    matt = np.clip(sphere(500) @ directions().T, 0, None) @ sky.radiance.reshape(-1, 3) * 4 / ROWS / COLUMNS
    assert matt.mean(axis=1).max() == pytest.approx(1, abs=0.02)
    assert sky.cumulative[-1] == 1


def test_a_sky_turns_with_its_viewer_and_stays_in_the_world():
    front, left = (sky_of("window", np.array(d, float), np.eye(3)).radiance for d in ((0, -1, 0), (-1, 0, 0)))
    np.testing.assert_allclose(np.roll(front, -COLUMNS // 4, axis=1), left, rtol=5e-3)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = sky_of("window", FRONT, quarter).radiance
    np.testing.assert_allclose(np.roll(front, -COLUMNS // 4, axis=1), turned, rtol=5e-3)


@pytest.mark.parametrize("toward", ["above", "-1,1,1", "right"])
def test_the_sun_shines_from_where_it_stands(toward):
    lighting = LightOptions(("sun", toward)).lighting(None, None)
    sky = sky_of("sun", np.array(lighting.directions[0]), np.eye(3))
    mean = (sky.radiance.mean(axis=2).ravel() > 2) @ directions()
    assert mean @ lighting.directions[0] > 0.995 * np.linalg.norm(mean)
    assert LightOptions(("sun",)).lighting(None, "RAS").directions == ((0, 0, 1),)


def test_an_opaque_shelf_throws_a_shadow():
    data = np.zeros((24, 24, 24), np.float32)
    data[16:19, :, :12] = 1.0  # over half of a block
    data[2:8] = 0.6
    scene = Scene.build(Volume(data), function([0, 0.4, 0.5, 1], [0, 0, 1, 1], [[0.5] * 3] * 4), 1.0)
    light = scene.lit(LightOptions(("sun",)).lighting(None, None)).light.shade[1, 7, 12] ** 2.2
    assert light[4:9].mean() < 0.35 * light[16:20].mean()
    assert light[4:9].mean() < light[12] < light[16:20].mean()  # soft


# The grid, and what is asked for.


def test_views_show_the_light_of_paths():
    """Ray-cast with the light on a grid, and path-traced from the eye; and both ray casters alike."""
    scene, lighting = blob(20), LightOptions(("studio",)).lighting(None, None)
    lit, view = scene.lit(lighting), camera(24)
    sky = sky_of("studio", np.array(lighting.directions[0]), scene.volume.axes)
    image = render_view(lit, view, RenderSettings(samples=3))
    traced = paths_twin.path_view(scene.scattering(), sky, scene.half, view, 200)
    error = (image - traced)[..., :3]
    assert -10 * math.log10((error**2).mean()) > 33
    twin = render_view_reference(lit, camera(12), step=1 / 16)
    assert np.abs(render_view(lit, camera(12), RenderSettings(step=0.125, samples=1)) - twin).max() < 5e-3
    again = scene.lit(lighting)
    np.testing.assert_array_equal(again.light.shade, lit.light.shade)


def test_views_lose_no_light_where_colors_vary_along_a_ray():
    """Views add up powers of colours, whose mean is below the power of the mean: cells make up for it."""
    values = np.random.default_rng(2).random((16, 16, 16)).astype(np.float32)
    layers = [[1, 0.1, 0.1], [1, 0.1, 0.1], [0.1, 1, 0.1], [0.1, 1, 0.1]]
    scene = Scene.build(Volume(values), function([0, 0.4, 0.5, 1], [0.02, 0.02, 0.1, 0.1], layers), 1.0)
    lighting, view = LightOptions(("overcast",)).lighting(None, None), camera(24)
    sky = sky_of("overcast", np.array(lighting.directions[0]), scene.volume.axes)
    traced = paths_twin.path_view(scene.scattering(), sky, scene.half, view, 400)[..., :3]
    image = render_view(scene.lit(lighting), view, RenderSettings(samples=3))[..., :3]
    inside = traced.min(axis=2) > 0.5 * traced.min(axis=2).max()
    ratio = (image[inside] / traced[inside]).mean(axis=0)
    assert ratio.min() > 0.85  # 0.60 without
    assert ratio.max() < 1.05


def test_cells_of_light_are_larger_where_a_volume_is():
    shapes = (128, 128, 128), (129, 128, 128), (600, 500, 400), (1, 1, 1 << 23)
    assert [shade_cell(shape) for shape in shapes] == [1, 2, 4, 4]


def test_what_cells_gather_is_handed_down_and_up_by_the_same_weights():
    fine, coarse = np.random.default_rng(0).random((3, 7, 6)), np.random.default_rng(1).random((3, 4, 6))
    down, up = _halved(fine, 1, 0.75, 0.25), _doubled(coarse, 1, 7)
    assert (down.shape, up.shape) == (coarse.shape, fine.shape)
    assert (down * coarse).sum() == pytest.approx((fine * up).sum())
    np.testing.assert_allclose(_doubled(np.ones((3, 4, 6)), 1, 8), 1)


@pytest.mark.parametrize("values", [np.zeros((5, 4, 6)), np.ones((5, 4, 6)), np.full((3, 3, 3), np.nan)])
def test_volumes_that_are_empty_or_opaque_everywhere_are_lit(values):
    scene = body(1.0, 0.7, values=values)
    lit = scene.lit(LightOptions(("overcast",)).lighting(None, None))
    image = render_view(lit, camera(8), RenderSettings(samples=1))
    assert np.isfinite(image).all()
    assert np.isfinite(lit.light.shade).all()
    assert bool(image.any()) == bool(np.nan_to_num(values).any())


def test_a_sky_is_asked_for_by_name():
    found = LightOptions(("studio",)).lighting(None, "RAS")
    assert (found.sky, found.directions, found.headlight) == ("studio", ((0, 1, 0),), False)
    assert LightOptions(("studio", "left")).lighting(None, None).directions == ((-1, 0, 0),)
    assert not found.depends_on_view
    named = replace(found, sky="a place/of light.hdr")
    assert parse_lighting(named.text()) == named


@pytest.mark.parametrize(
    ("lights", "options", "message"),
    [
        (("studio", "headlight"), {}, "--light studio: a sky lights alone"),
        (("studio", "window"), {}, "--light studio: a sky lights alone"),
        (("studio",), {"ambient": 0.1}, "--ambient: matter under --light studio"),
        (("studio", "none"), {}, "expected none, or other lights, not both"),
    ],
)
def test_what_does_not_go_with_a_sky_is_said_in_one_line(lights, options, message):
    with pytest.raises(UsageError) as error:
        LightOptions(lights, **options).lighting(None, None)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


# Commands: in blocks, of labels, and pictures of light.


def bodies(tmp_path, labels=False):
    """Path of a .npy with a ball in front of a wall, or of a label map of them."""
    z, y, x = np.indices((20, 24, 28))
    ball = np.clip(8 - np.sqrt((x - 12) ** 2 + (y - 8) ** 2 + (z - 10) ** 2), 0, 4) / 4
    values = np.round(255 * np.maximum(ball, 0.8 * (y > 20)))
    path = tmp_path / ("labels.npy" if labels else "values.npy")
    np.save(path, ((values > 120).astype(np.uint8) + (y > 20) * (values > 120)) if labels else values.astype(np.uint8))
    return path


@pytest.mark.parametrize("labels", [False, True])
def test_blocks_and_labels_are_lit_as_in_memory(vvgt, tmp_path, labels):
    path = bodies(tmp_path, labels)
    look = ("--labels", "auto") if labels else ("--tf", "bone", "--opacity-unit-distance", 2)
    vvgt.ok("render", path, *look, "--light", "studio", "--size", 40, "-qo", tmp_path / "whole.png")
    vvgt.ok("render", path, *look, "--light", "studio", "--size", 40, "--blocks", 16, "-qo", tmp_path / "blocks.png")
    vvgt.ok("render", path, *look, "--light", "none", "--size", 40, "-qo", tmp_path / "flat.png")
    whole, blocks, flat = (read_png(tmp_path / f"{name}.png") for name in ("whole", "blocks", "flat"))
    assert np.abs(whole - blocks).mean() < 2e-3
    assert np.abs(whole - flat).mean() > 2e-2
    fit = ("--light", "window", "--max-gaussians", 500, "--screen", 60, "-q")
    vvgt.ok("init", path, *look, *fit, "-o", tmp_path / "a.ply")
    vvgt.ok("init", path, *look, *fit, "--blocks", 16, "-o", tmp_path / "b.ply")
    (a, header), (b, _) = read_ply(tmp_path / "a.ply"), read_ply(tmp_path / "b.ply")
    assert header.light.sky == "window"
    assert a.harmonics is None or not a.harmonics.any()
    assert abs(a.colors.mean() - b.colors.mean()) < 0.01
    vvgt.ok("init", path, *look, *fit, "-o", tmp_path / "a.glb")
    glb, told = read_splats(tmp_path / "a.glb")
    assert (glb.degree, told.light) == (0, header.light)
    assert max(errors(in_unit_frame(a, header), in_unit_frame(glb, told))) < 2e-6


def write_light(path, pixels):
    import OpenImageIO as oiio

    out = oiio.ImageOutput.create(str(path))
    out.open(str(path), oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], oiio.FLOAT))
    out.write_image(pixels.astype(np.float32))
    out.close()
    return path


@pytest.mark.parametrize("ending", ["hdr", "exr"])
def test_a_picture_shines_from_where_it_is_bright(tmp_path, ending):
    """A spot an eighth of the width to the right of the middle, 45 degrees up: behind, at the viewer's right."""
    pixels = np.full((64, 128, 3), 0.01)
    pixels[15:17, 79:81] = [30, 20, 10]
    sky = sky_of(str(write_light(tmp_path / f"spot.{ending}", pixels)), FRONT, np.eye(3))
    brightest = directions()[sky.radiance.sum(axis=2).argmax()]
    np.testing.assert_allclose(brightest, [0.5, 0.5, math.sqrt(0.5)], atol=0.06)
    red, _, blue = sky.radiance.reshape(-1, 3)[sky.radiance.sum(axis=2).argmax()]
    assert red == pytest.approx(3 * blue, rel=0.02)
    one = sky_of(str(write_light(tmp_path / f"one.{ending}", np.ones((1, 1, 3)))), FRONT, np.eye(3))
    np.testing.assert_allclose(one.radiance, 1, rtol=0.05)


def test_another_picture_of_the_same_name_is_another_light(tmp_path):
    path = write_light(tmp_path / "light.exr", np.ones((4, 8, 3)))
    asked = SourceRequest(np.eye(3)[None], tf="bone", light=LightOptions((str(path),)))
    light, kept = asked.light.lighting(None, None), _settings(asked, FieldNeeds(1, 1))["skies"]
    before = light.key()
    assert before.startswith(light.text())
    write_light(path, np.full((5, 8, 3), 0.5))
    assert light.key() != before
    assert _settings(asked, FieldNeeds(1, 1))["skies"] != kept
    path.unlink()
    assert light.key() == light.text()  # whoever traces it says that it is missing


@pytest.mark.parametrize("wrong", ["negative", "infinite", "none", "half", "missing"])
def test_damaged_pictures_are_refused_in_one_line(vvgt, tmp_path, wrong):
    path, pixels = tmp_path / "light.exr", np.random.default_rng(0).random((16, 32, 3))
    pixels[3, 3] = {"negative": -1, "infinite": np.inf}.get(wrong, 1)
    if wrong != "missing":
        write_light(path, pixels * (wrong != "none"))
    if wrong == "half":
        path.write_bytes(path.read_bytes()[:1500])
    message = {"half": "damaged", "missing": "no such file", "none": "none"}.get(wrong, "negative or not finite")
    line = ("render", bodies(tmp_path), "--tf", "bone", "--light", path, "-qo", tmp_path / "a.png")
    assert message in vvgt.fails(1, *line)


def test_what_needs_the_volume_refuses_skies(vvgt, tmp_path):
    line = ("--tf", "bone", "--light", "studio", "--live", "-qo", tmp_path / "a.ply")
    assert "remove --light studio" in vvgt.fails(2, "convert", bodies(tmp_path), *line)


def test_a_page_says_what_its_rays_lack(vvgt, tmp_path):
    fit = ("--tf", "bone", "--light", "studio", "--max-gaussians", 300, "--screen", 40, "--steps", 4)
    with pytest.warns(UserWarning, match="lights other looks by a headlight: its own rays know no sky"):
        vvgt.ok("convert", bodies(tmp_path), *fit, "-o", tmp_path / "a.html")
    assert read_splats(tmp_path / "a.html")[1].light.sky == "studio"
