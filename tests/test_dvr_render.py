"""The ray caster against its float64 twin, closed forms, and hostile volumes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from vvgt_cli.cameras.sets import look_at
from vvgt_cli.dvr import RenderSettings, Scene, render_view, render_view_reference, render_views
from vvgt_cli.dvr.layout import BRICK
from vvgt_cli.dvr.render import ray_offsets
from vvgt_cli.dvr.runs import NEAR
from vvgt_cli.errors import UsageError
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.look.tables import extinction
from vvgt_cli.volume import Volume

ONE_RAY = RenderSettings(samples=1)
FINE = RenderSettings(step=0.125, samples=1)


class Function:
    """Linear opacity and colour between nodes; has what the renderers use of a `TransferFunction`."""

    name = "test"

    def __init__(self, x, opacity, rgb=None):
        self.x = np.asarray(x, float)
        self.y = np.asarray(opacity, float)
        self.rgb = np.ones((len(self.x), 3)) * (1.0, 0.5, 0.25) if rgb is None else np.asarray(rgb, float)

    def opacity(self, x):
        return np.interp(x, self.x, self.y)

    def color(self, x):
        return np.stack([np.interp(x, self.x, self.rgb[:, k]) for k in range(3)], -1)

    def node_range(self):
        return self.x[0], self.x[-1]

    def breakpoints(self):
        return self.x


class LinearExtinction(Function):
    """Extinction, not opacity, linear in the scalar on [0, 1]: ``tau = peak x`` per unit distance 1."""

    def __init__(self, peak):
        super().__init__([0, 1], [0, 1])
        self.peak = peak

    def opacity(self, x):
        return -np.expm1(-self.peak * np.clip(x, 0, 1))


RAINBOW = Function([0, 0.3, 0.5, 1], [0, 0, 0.6, 0.2], [[0, 0, 1], [0, 1, 0], [1, 1, 0], [1, 0, 0]])


def camera(width=24, height=24, eye=(2.2, -1.6, 1.1), fov=40.0, **options):
    return look_at(eye, width=width, height=height, fov=fov, **options)


def field(shape=(9, 8, 10), seed=0):
    return np.random.default_rng(seed).uniform(0, 1, shape)


def smooth(n=24):
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    return np.exp(-2 * (x * x + 1.5 * y * y + 0.7 * z * z) + 0.4 * np.sin(3 * x + y))


def assert_sane(image):
    assert np.isfinite(image).all()
    assert image.min() >= 0
    assert image[..., 3].max() <= 1
    assert (image[..., :3] <= image[..., 3:] + 1e-6).all()  # colours here are at most 1


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("spacing", [(1, 1, 1), (0.5, 1, 3)])
def test_random_fields_match_the_twin(seed, spacing):
    scene = Scene.build(Volume(field(seed=seed), spacing), RAINBOW, 1.0)
    reference = render_view_reference(scene, camera(), step=1 / 64)
    errors = [np.abs(render_view(scene, camera(), RenderSettings(s, samples=1)) - reference) for s in (1 / 8, 1 / 32)]
    assert errors[1].max() < 1e-3
    assert errors[1].mean() < 5e-5
    assert errors[0].mean() > 4 * errors[1].mean()  # towards the twin; longer steps are taken in more parts


@pytest.mark.parametrize("size", [(1, 1), (31, 7)])
def test_any_image_size_matches_the_twin(size):
    scene = Scene.build(Volume(smooth(10)), RAINBOW, 1.0)
    image = render_view(scene, camera(*size), FINE)
    np.testing.assert_allclose(image, render_view_reference(scene, camera(*size), step=1 / 32), atol=3e-3)


@pytest.mark.parametrize("depth", [1e-6, 1e-3, 1.0, 5.0])
@pytest.mark.parametrize("step", [0.25, 1.0, 4.0])
def test_a_homogeneous_slab_is_exact_at_any_step(depth, step):
    tau = depth / 2  # per unit-frame length, along a box of 2
    volume = Volume(np.full((4, 4, 8), 3.0))
    opacity = -math.expm1(-tau * 0.25)  # per voxel of edge 2 / 8
    scene = Scene.build(volume, Function([0, 1], [opacity, opacity]), 1.0)
    image = render_view(scene, camera(1, 1, (5, 0, 0)), RenderSettings(step=step, samples=1))
    alpha = -math.expm1(-depth)
    np.testing.assert_allclose(image[0, 0], np.array([1, 0.5, 0.25, 1]) * alpha, rtol=2e-7)


def test_opacity_one_is_capped_so_that_it_has_a_limit():
    scene = Scene.build(Volume(np.ones((6, 6, 6))), Function([0, 1], [1, 1], np.ones((2, 3))), 1.0)
    image = render_view(scene, camera(9, 9), ONE_RAY)
    assert_sane(image)
    np.testing.assert_allclose(image[4, 4], 1, atol=2e-5)
    assert scene.optics.largest_extinction() == pytest.approx(extinction(np.array([1.0]), 1.0)[0] * 3)


@pytest.mark.parametrize("factor", [1e-30, 1.0, 1e30, 1e300])
@pytest.mark.parametrize("offset", [0.0, 5.0])
def test_the_scale_of_the_values_does_not_matter(factor, offset):
    data = field((6, 7, 8), 4)
    plain = Scene.build(Volume(data), RAINBOW, 1.0)
    function = Function((RAINBOW.x + offset) * factor, RAINBOW.y, RAINBOW.rgb)
    scaled = Scene.build(Volume((data + offset) * factor), function, 1.0)
    np.testing.assert_allclose(render_view(scaled, camera(), FINE), render_view(plain, camera(), FINE), atol=2e-4)


@pytest.mark.parametrize("eye", [(0.1, 0.2, -0.3), (0.999, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_an_eye_inside_the_volume_matches_the_twin(eye):
    scene = Scene.build(Volume(field((8, 8, 8), 5)), Function([0, 1], [0, 0.3]), 1.0)
    c = look_at(eye, target=(0.2, -0.9, 0.4), width=16, height=16, fov=80)
    np.testing.assert_allclose(render_view(scene, c, FINE), render_view_reference(scene, c, step=1 / 32), atol=2e-3)


@pytest.mark.parametrize("eye", [(4, 0, 0), (0, -4, 0), (0, 0, 4), (0, 0, -4)])
def test_rays_along_the_axes_match_the_twin(eye):
    scene = Scene.build(Volume(field((8, 8, 8), 6)), RAINBOW, 1.0)
    c = camera(5, 5, eye)  # the middle pixel's ray has two components of 0
    np.testing.assert_allclose(render_view(scene, c, FINE), render_view_reference(scene, c, step=1 / 32), atol=5e-3)


def test_a_view_from_far_away_that_misses_or_is_very_wide():
    scene = Scene.build(Volume(field((8, 8, 8), 5)), RAINBOW, 1.0)
    far = camera(16, 16, (1800.0, -1300.0, 900.0), 0.06)
    assert np.abs(render_view(scene, far, FINE) - render_view_reference(scene, far, step=1 / 32)).mean() < 2e-3
    assert not render_view(scene, look_at((3.0, 0, 0), target=(9.0, 0, 0), width=8, height=8), FINE).any()
    wide, narrow = (render_view(scene, camera(width, 16), FINE) for width in (4096, 16))
    assert_sane(wide)
    np.testing.assert_allclose(wide[:, 2040:2056], narrow, atol=1e-6)


def test_nothing_but_nan_is_nothing():
    scene = Scene.build(Volume(np.full((5, 5, 5), np.nan)), Function([0, 1], [0.5, 0.5]), 1.0, value_range=(0, 1))
    assert not render_view(scene, camera(), ONE_RAY).any()


def test_leaping_over_empty_space_changes_nothing():
    data = np.zeros((40, 33, 50))
    data[10:14, 20:30, 33:36] = field((4, 10, 3), 8)
    data[36:, :3, :5] = 0.8
    scene = Scene.build(Volume(data), RAINBOW, 1.0)
    assert scene.empty.max() > 1
    full = Scene(**{**vars(scene), "empty": np.zeros_like(scene.empty)})
    for eye in ((2.2, -1.6, 1.1), (3, 0, 0), (0, 0, -3), (0.1, 0.1, 0.1)):
        c = camera(32, 32, eye)
        leaping = render_view(scene, c, ONE_RAY)
        np.testing.assert_allclose(leaping, render_view(full, c, ONE_RAY), atol=1e-6)


@pytest.mark.parametrize("light", [None, Lighting()])
def test_the_segment_before_a_leap_is_seen(light):
    """Also where a run of samples ends as the ray leaves the last visible brick."""
    data = np.zeros((40, 40, 40))
    data[8:32, 8:32, 8:32] = field((24, 24, 24), 3)
    scene = Scene.build(Volume(data), Function([0, 0.01, 0.02, 1], [0, 0, 0.03, 0.03]), 1.0)
    scene = scene if light is None else scene.lit(light)
    full = replace(scene, empty=np.zeros_like(scene.empty))
    assert scene.empty.max() > 0
    settings = RenderSettings(step=1.0, samples=1)
    for eye in ((2.2, -1.6, 1.1), (3, 0.2, 0.1), (0.3, -0.4, 3)):
        c = camera(96, 96, eye)
        leaping = render_view(scene, c, settings)
        np.testing.assert_allclose(leaping, render_view(full, c, settings), atol=1e-5)


def corner_of_bricks():
    """Four bricks around a column of NaN: 0 and 1, transparent, across the corner, and 0.5 beside them."""
    data = np.zeros((2 * BRICK, 2 * BRICK, 2 * BRICK), np.float32)
    data[:, :BRICK, BRICK + 1 :] = data[:, BRICK + 1 :, :BRICK] = 0.5
    data[:, BRICK:, BRICK:] = 1.0
    data[:, BRICK, BRICK] = np.nan
    return Scene.build(Volume(data), Function([0, 0.2, 0.5, 0.8, 1], [0, 0, 0.9, 0, 0]), 1.0)


@pytest.mark.parametrize("step", [0.5, 1.0, 4.0])
def test_leaping_across_the_corner_of_a_visible_brick_keeps_the_segment_between(step):
    """A step from 0 to 1 passes what is visible between them, though both ends lie in empty bricks."""
    scene = corner_of_bricks()
    assert scene.empty[0].tolist() == [[1, 0], [0, 1]]
    full = Scene(**{**vars(scene), "empty": np.zeros_like(scene.empty)})
    settings = RenderSettings(step=step, samples=1)
    for eye in ((-3, -3, 0.2), (-2.4, -3, 0.3), (3, 2.5, -0.5)):
        c = camera(64, 64, eye)
        image, expected = render_view(scene, c, settings), render_view(full, c, settings)
        assert expected[..., 3].max() > 0.5
        off = (np.abs(image - expected) > 1e-5).any(axis=2)
        assert off.sum() <= 2  # finer samples on the very edge of what is not finite


@pytest.mark.parametrize("samples", [2, 3])
def test_grids_of_rays_average(samples):
    scene = Scene.build(Volume(smooth(10)), Function([0, 0.5, 0.51, 1], [0, 0, 0.5, 0.5]), 1.0)
    every = render_view(scene, camera(48, 48), RenderSettings(step=0.25, samples=samples))
    reference = render_view_reference(scene, camera(48, 48), step=1 / 16, samples=samples)
    assert np.abs(every - reference).mean() < 1e-3


def test_pixels_get_as_many_rays_as_they_differ_from_their_neighbours():
    scene = Scene.build(Volume(smooth(10)), Function([0, 0.5, 0.51, 1], [0, 0, 0.5, 0.5]), 1.0)
    c = camera(48, 48)
    fine, single = (render_view(scene, c, RenderSettings(step=0.25, samples=n)) for n in (8, 1))
    adaptive = render_view(scene, c, RenderSettings(step=0.25))
    padded = np.pad(single, ((1, 1), (1, 1), (0, 0)), mode="edge")
    around = [padded[i : i + 48, j : j + 48] for i in range(3) for j in range(3)]
    mask = np.max([np.abs(single - other).max(axis=-1) for other in around], axis=0) > 0.08
    assert 0.01 < mask.mean() < 0.5
    kept = (adaptive == single).all(axis=-1)
    assert kept[~mask].all()
    assert kept[mask].mean() < 0.25  # rays that all miss, or all end in the same opaque matter
    errors = [np.sqrt(np.mean((image - fine) ** 2)) for image in (single, adaptive)]
    assert errors[1] < 0.3 * errors[0]
    grids = render_view(scene, c, RenderSettings(step=0.25, tiers=((0.08, 9),)))
    every = render_view(scene, c, RenderSettings(step=0.25, samples=3))
    np.testing.assert_allclose(grids, np.where(mask[..., None], every, single), atol=2e-7)


@pytest.mark.parametrize("count", [5, 13])
def test_rays_of_a_lattice_share_no_row_or_column_and_have_a_pixels_moments(count):
    offsets = ray_offsets(count)
    assert (offsets == 0).all(axis=1).any()
    assert np.abs(offsets).max() < 0.5
    for axis in offsets.T:
        np.testing.assert_allclose(np.sort(axis), (np.arange(count) - count // 2) / count)
    np.testing.assert_allclose((offsets**2).mean(axis=0), 1 / 12, rtol=1.1 / count**2)
    assert abs(offsets.prod(axis=1).mean()) < 0.01


def test_other_numbers_of_rays_are_refused():
    with pytest.raises(ValueError, match="6 rays a pixel"):
        ray_offsets(6)


@pytest.mark.parametrize("shape", [(1, 1, 4), (1, 2, 2), (2, 1, 2), (1, 1, 3), (2, 2, 2), (1, 3, 5)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_few_integer_voxels_are_read_as_many_are(shape, dtype):
    values = np.random.default_rng(3).integers(60, 255, shape).astype(dtype)
    scene = Scene.build(Volume(values), Function([0, 255], [0, 0.9]), 1.0)
    image = render_view(scene, camera(), FINE)
    np.testing.assert_allclose(image, render_view_reference(scene, camera(), step=1 / 32), atol=2e-3)


def test_slabs_beyond_32_bit_offsets_are_read_as_others():
    values = np.zeros((3, 4100, 4100), np.uint8)
    values[:, 2000:2100, 2000:2100] = np.random.default_rng(5).integers(0, 255, (3, 100, 100))
    assert values[0].size > NEAR
    scene = Scene.build(Volume(values), Function([0, 255], [0, 0.9]), 1.0)
    close = camera(8, 8, eye=(0.004, -0.002, 0.02), fov=60.0)
    image = render_view(scene, close, FINE)
    assert image[..., 3].max() > 0.1
    np.testing.assert_allclose(image, render_view_reference(scene, close, step=1 / 32), atol=2e-3)


def test_views_are_the_same_bytes_every_time_and_report_progress():
    scene = Scene.build(Volume(smooth(10)), RAINBOW, 1.0)
    seen = []
    first = render_views(scene, [camera(), camera()], progress=lambda *state: seen.append(state))
    assert first.shape == (2, 24, 24, 4)
    assert first[0].tobytes() == first[1].tobytes() == render_view(scene, camera()).tobytes()
    assert seen == [(1, 2), (2, 2)]


def test_a_step_of_1_is_a_step_of_one_point_zero_to_the_compiler():
    from vvgt_cli.dvr.march import render_tiles

    scene = Scene.build(Volume(smooth(10)), RAINBOW, 1.0)
    first = render_view(scene, camera(), RenderSettings(step=1.0, samples=1))
    compiled = len(render_tiles.signatures)
    assert render_view(scene, camera(), RenderSettings(step=1, samples=1)).tobytes() == first.tobytes()
    assert len(render_tiles.signatures) == compiled


@pytest.mark.parametrize("options", [{"step": 0}, {"step": 5}, {"step": math.nan}, {"samples": 0}, {"samples": 17}])
def test_settings_are_checked(options):
    with pytest.raises(UsageError, match="expected"):
        RenderSettings(**options)
