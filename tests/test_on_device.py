"""Views and steps on a CUDA device: what of them runs on the CPU against its twins there; all of it where a GPU is."""

import pickle
from dataclasses import replace

import numba as nb
import numpy as np
import pytest

from tests import simulated_gpu
from tests.processes import python
from tests.test_dvr_renderer_vtk import scene, view
from vvgt_cli import device
from vvgt_cli.cameras import default_views
from vvgt_cli.device import on_device
from vvgt_cli.dvr import RenderSettings, Scene, cuda, render_view, render_views
from vvgt_cli.dvr.render import camera_arrays
from vvgt_cli.errors import DeviceFailed
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import RULES
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.refine import OptimizeOptions, shared
from vvgt_cli.refine import on_device as on_gpu
from vvgt_cli.refine.loop import begin
from vvgt_cli.refine.on_device import unfit
from vvgt_cli.refine.states import OwnAxes
from vvgt_cli.splat import render
from vvgt_cli.splat.reference import render_reference

OPTIONS = OptimizeOptions.of("axes")


@nb.njit
def plain_pixels(data, camera, step, width, places, offsets, out):
    for n in range(len(out)):
        cuda._store(data, None, camera, step, width, places, offsets, out, n)


@nb.njit
def lit_pixels(data, camera, step, width, places, offsets, out):
    for n in range(len(out)):
        cuda._store(data, data[3], camera, step, width, places, offsets, out, n)


@pytest.mark.parametrize(("lit", "unit"), [(False, 1.0), (False, 0.02), (True, 1.0)])  # 0.02: steep, sampled finer
def test_the_devices_rays_are_the_kernels(lit, unit):
    made, camera = Scene.build(scene().volume, scene().tf, unit, lighting=Lighting() if lit else None), view()
    packed, out = np.zeros((5, 4)), np.zeros((camera.height * camera.width, 4))
    packed[0, :3], packed[1:4, :3], packed[4] = camera_arrays(made, camera)
    every = np.arange(len(out), dtype=np.int32)
    (lit_pixels if lit else plain_pixels)(
        cuda.scene_arrays(made), packed, 0.5, camera.width, every, np.zeros((1, 2)), out
    )
    kernel = render_views(made, [camera], RenderSettings(0.5, 1))[0]
    np.testing.assert_allclose(out.reshape(kernel.shape), kernel, atol=1e-5)


def test_a_device_that_fails_is_said_once_and_the_cpu_draws(monkeypatch):
    def fail(*_):
        raise OSError("out of memory\nsomewhere")

    monkeypatch.setattr(cuda.DeviceRays, "_cast", fail)
    said, made = [], scene()
    drawn = on_device(made, "cuda", said.append)
    for _ in range(2):
        image = render_view(drawn, view())
    assert said == ["the GPU failed (out of memory somewhere); views are drawn on the CPU"]
    np.testing.assert_array_equal(image, render_view(made, view()))


def gaussians(count=600, seed=0):
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-0.6, 0.6, (count, 3)), rng.uniform(-3.5, -2, (count, 3)), rng.normal(size=(count, 4)),
        rng.uniform(-2, 3, count), rng.uniform(0, 1, (count, 3)),
    )  # fmt: skip


def test_simulated_steps_are_those_of_the_cpu(monkeypatch, tmp_path):
    """Pictures before, and all that is kept after steps: by rules, of all or some Gaussians, with weights of views."""
    rng = np.random.default_rng(2)
    targets = [render(simulated_gpu.gaussians(seed=1), camera) for camera in simulated_gpu.CAMERAS]
    weights = [rng.random(target.shape[:2], np.float32) for target in targets]
    monkeypatch.setattr(shared, "LEAST", simulated_gpu.LEAST)
    cases, hosts = simulated_gpu.cases(), {}
    for case, (start, options, free, _) in cases.items():
        hosts[case] = OwnAxes(start, simulated_gpu.CAMERAS, options, free)
    given, out = tmp_path / "given", tmp_path / "out"
    given.write_bytes(pickle.dumps((targets, weights, hosts)))
    python("-m", "tests.simulated_gpu", given, out, variables=simulated_gpu.SIMULATED)
    ends = pickle.loads(out.read_bytes())
    exact = render_reference(cases["inria"][0], simulated_gpu.CAMERAS[0])
    np.testing.assert_allclose(ends["inria"]["picture"], exact, atol=1e-5)
    for case, (_, _, _, weighted) in cases.items():
        state = hosts[case]
        begun = [array.copy() for array in state.arrays]
        host = simulated_gpu.take(state, case, targets, weights if weighted else None)
        assert (state.shared is None) == (case != "inria")
        for name, array in host.items():
            size = np.abs(array - begun[int(name[-1])] if name.startswith("array") else array).mean()
            assert np.abs(ends[case][name] - array).mean() <= 1e-3 * size, (case, name)


def test_what_a_device_does_not_do_is_named():
    assert unfit(gaussians(), replace(OPTIONS, rule=RULES["viser"])) is None
    assert unfit(gaussians(), OptimizeOptions.of("3dgs")) == "the method 3dgs"
    assert unfit(gaussians(), replace(OPTIONS, ssim=0.1)) == "SSIM in the loss"
    lit = replace(gaussians(), harmonics=np.zeros((600, 3, 3), np.float32))
    assert unfit(lit, OPTIONS) == "colours that depend on the view"


def test_a_device_that_fails_in_a_step_says_so(monkeypatch):
    def fail(*_):
        raise RuntimeError("CUDA error:\nlost")

    monkeypatch.setattr(on_gpu, "free_bytes", fail)
    with pytest.raises(DeviceFailed, match="RuntimeError: CUDA error: lost"):
        begin(gaussians(), default_views("train", 2, size=40), replace(OPTIONS, device="cuda"))
    monkeypatch.setattr(on_gpu, "free_bytes", lambda: 0.0)
    with pytest.raises(DeviceFailed, match=r"steps need 0\.0 GB, of which 0\.0 are free"):
        begin(gaussians(), default_views("train", 2, size=40), replace(OPTIONS, device="cuda"))


def test_a_machine_without_a_gpu_is_told_what_is_missing(vvgt, monkeypatch, tmp_path):
    monkeypatch.setattr(device, "missing", lambda: ["numba-cuda"])
    convert = "convert", "example:frog", "-o", tmp_path / "f.ply", "--device"
    assert "--device cuda needs numba-cuda: pip install 'numba-cuda[cu13]>=" in vvgt(*convert, "cuda").error
    assert device.chosen("auto") == "cpu"
    assert "none that could be used: numba-cuda not installed" in vvgt("info", "--machine").out.decode()
    assert "expected a file, or --machine" in vvgt("info").error
    monkeypatch.setattr(device, "missing", list)
    monkeypatch.setattr(device, "first_gpu", lambda: None)
    assert "no CUDA device found; check the driver" in vvgt(*convert, "cuda").error
    monkeypatch.setattr(device, "first_gpu", lambda: device.Gpu("GPU", 4 * 10**9, 10**10))
    assert [device.chosen(name) for name in ("auto", "cuda")] == ["cpu", "cuda"]
    assert "GPU, 4.0 of 10.0 GB free" in vvgt("info", "--machine").out.decode()


def test_labels_and_layers_stay_on_the_cpu():
    said, made = [], replace(scene(), grid=np.zeros((2, 2, 2, 4), np.float32))
    assert on_device(made, "cuda", said.append) is made
    assert len(said) == 1


@pytest.fixture
def gpu():
    if device.missing() or device.first_gpu() is None:
        pytest.skip("no CUDA device")


@pytest.mark.parametrize("lit", [False, True])
def test_a_gpu_draws_the_kernels_views(gpu, lit):
    made, said = scene().lit(Lighting()) if lit else scene(), []
    drawn = on_device(made, "cuda", said.append)
    for settings in (RenderSettings(), RenderSettings(1.0, 1)):
        np.testing.assert_allclose(render_view(drawn, view(), settings), render_view(made, view(), settings), atol=1e-3)
    assert not said


@pytest.mark.parametrize(("rule", "count"), [("inria", 2000), ("compensated", 300), ("three", 30_000)])
def test_a_gpu_steps_as_the_kernels_do_and_repeats_to_the_byte(gpu, rule, count):
    start, cameras, rule = gaussians(count), default_views("train", 4, size=120), RULES[rule]
    images, ends = [render(gaussians(count, 1), camera, rule) for camera in cameras], []
    for where in ("cpu", "cuda", "cuda"):
        state = begin(start, cameras, replace(OPTIONS, rule=rule, device=where))
        first = state.picture(cameras[0], rule)
        for n in range(12):
            state.step(cameras[n % 4], images[n % 4], n / 12, 1.0)
        ends.append(state.saved() | {"first": first})
    np.testing.assert_allclose(ends[1]["first"], ends[0]["first"], atol=1e-4)
    np.testing.assert_allclose(ends[1]["error"], ends[0]["error"], rtol=0.005)
    assert all(np.array_equal(ends[1][name], ends[2][name]) for name in ends[1])
