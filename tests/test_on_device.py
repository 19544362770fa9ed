"""Views and steps on a CUDA device: what of them runs on the CPU against its twins there; all of it where a GPU is."""

from dataclasses import replace

import numba as nb
import numpy as np
import pytest

from tests.test_dvr_backends import scene, view
from vvgt_cli import device
from vvgt_cli.cameras import default_views
from vvgt_cli.device import on_device
from vvgt_cli.dvr import RenderSettings, Scene, cuda, render_view, render_views
from vvgt_cli.dvr.render import camera_arrays
from vvgt_cli.errors import DeviceFailed
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.constants import DILATION, MAX_ALPHA, MIN_ALPHA
from vvgt_cli.gaussians.rules import INRIA, RULES
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.refine import OptimizeOptions
from vvgt_cli.refine.loop import begin, step
from vvgt_cli.splat import render

OPTIONS = OptimizeOptions.of("frame")


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


def dense(means, opacities, colors, camera, rule, covars):
    """A picture as gsplat makes it, every Gaussian in every pixel."""
    torch = pytest.importorskip("torch")
    turn, shift = (torch.as_tensor(a, dtype=torch.float32) for a in (camera.rotation, camera.translation))
    x, y, z = (means @ turn.T + shift).unbind(1)
    zero = torch.zeros_like(z)
    slope = torch.stack([camera.fx / z, zero, -camera.fx * x / z**2, zero, camera.fy / z, -camera.fy * y / z**2], 1)
    slope = slope.reshape(-1, 2, 3) @ turn
    spread = slope @ covars[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3) @ slope.transpose(
        1, 2
    ) + rule.dilation * torch.eye(2)
    order = z.argsort()
    place = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], 1)[order]
    rows, cols = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    off = torch.stack([cols, rows], -1)[:, :, None] - place
    power = 0.5 * torch.einsum("hwki,kij,hwkj->hwk", off, torch.linalg.inv(spread[order]), off)
    alpha = (opacities[order] * torch.exp(-power)).clamp(max=MAX_ALPHA)
    alpha = torch.where((alpha >= MIN_ALPHA) & (power <= 6), alpha, 0)
    behind = torch.cumprod(1 - alpha, dim=2)
    weight = alpha * torch.cat([torch.ones_like(alpha[..., :1]), behind[..., :-1]], 2)
    return weight @ colors[order], 1 - behind[..., -1:]


@pytest.fixture
def descent(monkeypatch):
    pytest.importorskip("torch")
    from vvgt_cli.refine import on_device as module

    def made(start, cameras, options, free=None, device="cpu"):
        return frame(start, cameras, options, free, "cpu", dense)

    frame = module.OwnAxesOnDevice
    monkeypatch.setattr(module, "OwnAxesOnDevice", made)
    return module


@pytest.mark.parametrize(("count", "some"), [(600, False), (300, False), (600, True)])
def test_steps_are_those_of_the_cpu(descent, count, some):
    start, cameras = gaussians(count), default_views("train", 4, size=40)
    images = [render(gaussians(count, 1), camera) for camera in cameras]
    free = np.arange(count) % 3 > 0 if some else None
    there, here = replace(OPTIONS, device="torch"), OPTIONS
    pair = [(options, begin(start, cameras, options, free)) for options in (here, there)]
    errors = [None, None]
    for n in range(8):
        for i, (options, state) in enumerate(pair):
            errors[i] = step(state, cameras[n % 4], images[n % 4], options, errors[i], n / 8, 1.0)
    np.testing.assert_allclose(errors[1], errors[0], rtol=2e-3)
    first = begin(start, cameras, here, free)
    for begun, a, b in zip(first.arrays, *(state.arrays for _, state in pair), strict=True):
        moved = np.abs(a - begun).mean()
        assert np.abs(a - b).mean() < 0.03 * moved  # opacities above 0.99 end elsewhere, order of sums
    kept = pair[1][1].saved()
    assert {k: v.shape for k, v in kept.items()} == {k: v.shape for k, v in pair[0][1].saved().items()}
    again = begin(start, cameras, there, free)
    again.restore(kept)
    np.testing.assert_array_equal(again.arrays[0], pair[1][1].arrays[0])


def test_the_loss_is_that_of_the_cpu(descent):
    import torch

    from vvgt_cli.refine.loss import loss_gradient
    from vvgt_cli.refine.texture import add_texture_gradient

    options = replace(OPTIONS, l1=0.3)
    image, target = np.random.default_rng(3).random((2, 30, 44, 4), np.float32)
    grad, squares = np.empty_like(image), np.empty(30)
    loss_gradient(image, target, *map(np.float32, (options.l1, options.l2, options.alpha)), grad, squares)
    add_texture_gradient(image, target, options.texture, grad)
    found, error = descent.loss_slope(torch.from_numpy(image), torch.from_numpy(target), options)
    np.testing.assert_allclose(found.numpy(), grad, atol=2e-4)
    np.testing.assert_allclose(float(error), np.sqrt(squares.sum() / (3.5 * 30 * 44)), rtol=1e-5)


def test_what_a_device_does_not_do_is_named(descent):
    assert descent.unfit(gaussians(), OPTIONS) is None
    assert descent.unfit(gaussians(), replace(OPTIONS, rule=RULES["compensated"].at(0.37))) is None
    assert descent.unfit(gaussians(), OptimizeOptions.of("3dgs")) == "the method 3dgs"
    assert descent.unfit(gaussians(), replace(OPTIONS, ssim=0.1)) == "SSIM in the loss"
    assert (
        descent.unfit(gaussians(), replace(OPTIONS, rule=RULES["viser"]))
        == "the rule viser, by which gsplat does not draw"
    )


def test_a_device_that_fails_in_a_step_says_so(descent, monkeypatch):
    state = begin(gaussians(), default_views("train", 2, size=40), replace(OPTIONS, device="torch"))
    monkeypatch.setattr(state, "draw", lambda *_, **__: (_ for _ in ()).throw(RuntimeError("CUDA error:\nlost")))
    with pytest.raises(DeviceFailed, match="CUDA error: lost"):
        step(state, state.cameras[0], np.zeros((40, 40, 4), np.float32), replace(OPTIONS, device="torch"), None, 0, 1)


def test_a_machine_without_a_gpu_is_told_what_is_missing(vvgt, monkeypatch, tmp_path):
    monkeypatch.setattr(device, "missing", lambda: ["numba-cuda"])
    convert = "convert", "example:frog", "-o", tmp_path / "f.ply", "--device"
    assert "--device cuda needs numba-cuda: pip install 'vvgt[cuda]'" in vvgt(*convert, "cuda").error
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
    torch = pytest.importorskip("torch")
    pytest.importorskip("gsplat")
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")


@pytest.mark.parametrize("lit", [False, True])
def test_a_gpu_draws_the_kernels_views(gpu, lit):
    made, said = scene().lit(Lighting()) if lit else scene(), []
    drawn = on_device(made, "cuda", said.append)
    for settings in (RenderSettings(), RenderSettings(1.0, 1)):
        np.testing.assert_allclose(render_view(drawn, view(), settings), render_view(made, view(), settings), atol=1e-3)
    assert not said


@pytest.mark.parametrize("rule", [INRIA, RULES["compensated"]])
def test_gsplat_draws_and_steps_as_the_kernels_do(gpu, rule):
    start, cameras = gaussians(2000), default_views("train", 4, size=120)
    images = [render(gaussians(2000, 1), camera, rule) for camera in cameras]
    found = []
    for where in ("cpu", "cuda"):
        options = replace(OPTIONS, rule=rule, device=where)
        state, error = begin(start, cameras, options), None
        for n in range(12):
            error = step(state, cameras[n % 4], images[n % 4], options, error, n / 12, 1.0)
        found.append(error)
    np.testing.assert_allclose(found[1], found[0], rtol=0.01)
    assert rule.dilation == DILATION
