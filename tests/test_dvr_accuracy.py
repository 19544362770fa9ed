"""What the float64 twin rests on: closed forms, order of convergence; and what the kernel gains over plain stepping."""

import math

import numba as nb
import numpy as np
import pytest

from tests.test_dvr_render import LinearExtinction, smooth
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.dvr import RenderSettings, Scene, render_view, render_view_reference
from vvgt_cli.dvr.kernel import sample
from vvgt_cli.dvr.layout import Optics, Voxels
from vvgt_cli.dvr.reference import march, trilinear
from vvgt_cli.dvr.runs import RUN, sample_run, stack_run
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.volume import Volume

WHITE = np.ones((2, 3))


def function(x, opacity, rgb=None):
    """Opacity and colour linear between nodes."""
    colors = np.ones((len(x), 3)) if rgb is None else np.asarray(rgb, float)
    return TransferFunction(
        "t", PiecewiseOpacity(np.asarray(x, float), np.asarray(opacity, float)), ColorMap(x, colors)
    )


def along_x(scene, step):
    """The twin's (r, g, b, alpha) of the ray along x through the box's centre."""
    return march(scene, np.array([-5.0, 0, 0]), np.array([[1.0, 0, 0]]), step)[0]


@pytest.mark.parametrize("depth", [1e-6, 1e-3, 1.0, 10.0])
@pytest.mark.parametrize("step", [0.3, 4.0])
def test_the_twin_is_exact_in_a_homogeneous_slab(depth, step):
    opacity = -math.expm1(-depth / 8)  # per voxel
    scene = Scene.build(Volume(np.ones((3, 5, 8))), function([0.0, 1.0], [opacity, opacity], 0.5 * WHITE), 1.0)
    np.testing.assert_allclose(along_x(scene, step), -math.expm1(-depth) * np.array([0.5, 0.5, 0.5, 1]), rtol=1e-9)


def test_a_gaussian_blob_is_met_to_1e6_by_the_twin_and_by_the_kernel():
    # Through voxel centres the trilinear field is the trapezoid rule, which converges exponentially for a Gaussian.
    n, sigma, peak = 65, 0.15, 4.0
    at = (np.arange(n) + 0.5) * 2 / n - 1
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    volume = Volume(np.exp(-(x * x + y * y + z * z) / (2 * sigma**2)), (2 / n, 2 / n, 2 / n))
    scene = Scene.build(volume, LinearExtinction(peak), 1.0, bins=65536)
    exact = -math.expm1(-peak * sigma * math.sqrt(2 * math.pi) * math.erf(1 / (sigma * math.sqrt(2))))
    assert along_x(scene, 0.5)[3] == pytest.approx(exact, abs=1e-6)
    image = render_view(scene, look_at((-5, 0, 0), width=1, height=1), RenderSettings(step=0.5, samples=1))
    assert image[0, 0, 3] == pytest.approx(exact, abs=2e-6)  # values and pixels are float32


def test_the_order_of_convergence_of_the_twin_is_two():
    scene = Scene.build(Volume(smooth(12)), function([0.0, 1.0], [0, 0.5], [[0, 0, 1], [1, 0, 0]]), 1.0)
    camera = look_at((2.2, -1.6, 1.1), width=6, height=6)
    exact = render_view_reference(scene, camera, step=1 / 128)
    steps = np.array([1 / 2, 1 / 4, 1 / 8, 1 / 16])
    errors = [np.sqrt(np.mean((render_view_reference(scene, camera, step=s) - exact) ** 2)) for s in steps]
    assert abs(np.polyfit(np.log(steps), np.log(errors), 1)[0] - 2) < 0.2


@pytest.mark.parametrize("opacity", [0.3, 1.0])
def test_through_thin_shells_the_kernel_needs_a_quarter_of_the_samples(opacity):
    tf = function(np.array([0.0, 0.49, 0.5, 0.51, 1]), [0, 0, opacity, 0, 0])
    scene = Scene.build(Volume(smooth(10)), tf, 1.0, bins=65536)
    camera = look_at((2.2, -1.6, 1.1), width=16, height=16)
    exact = render_view(scene, camera, RenderSettings(step=1 / 256, samples=1))

    def rms(image):
        return np.sqrt(np.mean((image - exact) ** 2))

    kernel = rms(render_view(scene, camera, RenderSettings(step=0.5, samples=1)))
    assert kernel < 0.6 * rms(render_view_reference(scene, camera, step=0.5 / 4))  # classifies after sampling


@pytest.mark.parametrize("per_voxel", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("edge", [1.0, 1000.0])
@pytest.mark.parametrize("factor", [1e-30, 1e30])
@pytest.mark.parametrize("eye", [(0.05, 0.01, 0.02), (4, 0, 0), (2.2, -1.6, 1.1)])
def test_stiff_functions_stay_bounded_whatever_comes_together(per_voxel, edge, factor, eye):
    opacity = -math.expm1(-per_voxel)
    tf = function(np.array([0, 0.5, 0.5001, 1]) * factor, [0, 0, opacity, opacity])
    data = np.random.default_rng(1).uniform(0, 1, (5, 6, 7)) * factor
    scene = Scene.build(Volume(data, (1.0, edge, 1.0)), tf, 1.0, bins=65536)
    camera = look_at(eye, target=(0, 0, 0), width=9, height=9)
    image = render_view(scene, camera, RenderSettings(step=0.125, samples=1))
    assert np.isfinite(image).all()
    assert image.min() >= 0
    assert image.max() <= 1
    fine = render_view(scene, camera, RenderSettings(step=1 / 64, samples=1))
    # Noise between neighbouring voxels under a step function: surfaces shift by up to step^2 / 8 of the curvature.
    assert np.abs(image - fine).mean() < 0.01 * max(fine.max(), 1e-12)


@pytest.mark.parametrize("light", [None, Lighting()], ids=["unlit", "lit"])
@pytest.mark.parametrize("name", ["surface", "shell"])
def test_surfaces_between_samples_are_found(name, light):
    """Those of a step, which rays graze, and of a shell that is thinner than a step."""
    x, opacity = {
        "surface": ([0, 0.4, 0.401, 1], [0, 0, 1, 1]),
        "shell": ([0, 0.4, 0.405, 0.41, 1], [0, 0, 0.9, 0, 0]),
    }[name]
    scene = Scene.build(Volume(smooth(24)), function(x, opacity), 0.3)
    scene = scene if light is None else scene.lit(light)
    camera = look_at((2.2, -1.4, 1.3), target=(0, 0, 0), width=160, height=160)
    fine = render_view(scene, camera, RenderSettings(step=1 / 64, samples=1))
    image = render_view(scene, camera, RenderSettings(samples=1))
    assert -10 * math.log10(((image - fine) ** 2).mean()) > 55  # 39 to 50 by what lies at the ends of a step alone


def test_thin_sheets_and_noise_need_no_finer_steps_under_a_gentle_ramp():
    """Two samples half a voxel apart miss the crest of a sheet one voxel thick, and how normals turn in noise."""
    data = np.random.default_rng(1).uniform(0, 0.1, (24, 24, 24))
    data[:, :, 12] = 1.0
    data[6:18, 6:18, 4:9] += 0.6
    tf = function([0.0, 0.4, 1.2], [0, 0, 0.35])
    camera = look_at((2.2, -1.4, 1.3), target=(0, 0, 0), width=120, height=120)
    decibels = []
    for scene in (Scene.build(Volume(data), tf, 1.0), Scene.build(Volume(data), tf, 1.0).lit(Lighting())):
        fine = render_view(scene, camera, RenderSettings(step=1 / 64, samples=1))
        image = render_view(scene, camera, RenderSettings(samples=1))
        decibels.append(-10 * math.log10(((image - fine) ** 2).mean()))
    assert decibels[0] > 50  # by the ends of steps alone: 38
    assert decibels[1] > 50  # with one normal a segment: 49


# u is the stored value
IDENTITY = Optics(0.0, 1.0, np.zeros((65537, 4)), np.zeros((65537, 4)), *np.zeros((3, 65537)))


@nb.njit
def _runs(voxels, optics, starts, speeds, out):
    run = stack_run()
    for i in range(len(starts)):
        p, v = starts[i], speeds[i]
        sample_run(voxels, p[0], p[1], p[2], v[0], v[1], v[2], optics, run)
        for n in range(RUN):
            out[i, n] = run[n]
        out[i, RUN] = sample(voxels.values, p[0], p[1], p[2])


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("shape", [(9, 8, 10), (1, 1, 1), (1, 30, 2), (3, 4, 3000)])
def test_runs_of_samples_match_the_twin(kind, shape):
    rng = np.random.default_rng(2)
    data = rng.uniform(0, 200, shape).astype(kind)
    size = np.array(shape[::-1], float)
    starts = rng.uniform(-1, 1, (200, 3)) + rng.uniform(0, 1, (200, 3)) * size  # some leave the volume
    speeds = rng.uniform(-1, 1, (200, 3)) * rng.choice([0.0, 0.1, 4.0], (200, 3))
    out = np.empty((200, RUN + 1))
    stored = data if shape[2] > 1 else data.astype(np.float32)  # as `kernel_values` does
    _runs(Voxels(stored), IDENTITY, starts, speeds, out)
    points = starts[:, None] + np.arange(RUN)[:, None] * speeds[:, None]
    exact = trilinear(Volume(data), points.reshape(-1, 3)).reshape(200, RUN)
    np.testing.assert_allclose(out[:, RUN], exact[:, 0], rtol=1e-5)
    np.testing.assert_allclose(out[:, :RUN], exact, atol=200 * 2e-5)  # positions in a run to 1e-5 voxels


def test_samples_beside_a_voxel_that_is_not_finite_are_marked():
    data = np.ones((4, 4, 8), np.float32)
    data[1, 1, 4] = np.nan
    data[3, 3, 0] = np.inf
    starts = np.array([[0.0, 1.0, 1.0], [0.0, 3.0, 3.0]])
    out = np.empty((2, RUN + 1))
    _runs(Voxels(data), IDENTITY, starts, np.array([[0.5, 0, 0], [0.5, 0, 0]]), out)
    np.testing.assert_array_equal(out[0, :RUN] == -1, [3 <= 0.5 * n < 5 for n in range(RUN)])
    np.testing.assert_array_equal(out[1, :RUN] == -1, [0.5 * n < 1 for n in range(RUN)])
