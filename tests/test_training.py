"""Training: gradients through the splatter, losses, scenes, the loop, and runs that end and go on."""

import csv
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from network_models import TINY, as_rows, scene

from tests.refused import refused
from tests.splat_twin import render_backward_reference
from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.constants import DILATION, NEAR
from vvgt_cli.images.metrics import psnr
from vvgt_cli.images.metrics import ssim as ssim_metric
from vvgt_cli.network.prepare import pack, unpack
from vvgt_cli.network.training import LossConfig, SceneConfig, TrainConfig
from vvgt_cli.network.training import scenes as training_scenes
from vvgt_cli.network.training.scenes import make_scenes, prepare_scenes, recipes
from vvgt_cli.progress import Console
from vvgt_cli.splat import project, render, render_reference
from vvgt_cli.volume.shapes import make_shape
from vvgt_cli.volume.writers import write_nrrd

torch = pytest.importorskip("torch")
pytest.importorskip("yaml")

from vvgt_cli.network.checkpoint import load_checkpoint, tensors_of  # noqa: E402
from vvgt_cli.network.training import loop, sample  # noqa: E402
from vvgt_cli.network.training.config import config_text, read_config  # noqa: E402
from vvgt_cli.network.training.sample import gsplat_picture, splat  # noqa: E402

STEPPER = replace(
    TINY, variant="wo_vgf", rounds=2, image=replace(TINY.image, views=2),
    geometry=replace(TINY.geometry, head="step", gradients=True, depths=(0, 1, 1, 1, 1), decoder_depths=(0, 1, 1, 1)),
)  # fmt: skip
CONFIG = TrainConfig(
    network=STEPPER,
    scenes=SceneConfig(size=32, gaussians=(300, 500), functions=4, held_functions=(1,), per_volume=1,
                       densities=(4.0, 4.0), inputs=4, targets=2, held=2),
    loss=LossConfig(l1=0.5, ssim=0.2, decibel=1.0),
    steps=4, batch=2, views=2, rate=1e-3, last_rate=1e-5, warmup=1, check_every=2, save_every=1,
)  # fmt: skip
FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "colors")
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Three small volumes; scenes are made by the first test that needs them."""
    folder = tmp_path_factory.mktemp("data")
    for part, seeds in (("train", (0, 1)), ("held", (5,))):
        (folder / part).mkdir()
        for seed in seeds:
            write_nrrd(folder / part / f"shells_{seed}.nrrd", make_shape("shells", 24, seed))
    return folder


def rows_of(folder, name="metrics.csv"):
    with (folder / name).open(newline="") as stream:
        return list(csv.DictReader(stream))


def weights(path):
    return load_checkpoint(path).network.state_dict()


def test_gradients_of_the_splatter_against_its_twin_and_against_differences():
    gaussians, cameras, _ = scene(count=20, views=1)
    rows = torch.from_numpy(pack(gaussians)).requires_grad_()
    slope = np.random.default_rng(0).normal(size=(32, 32, 4)).astype(np.float32)
    (splat(rows, cameras[0]) * torch.from_numpy(slope)).sum().backward()
    unit = unpack(rows.detach().numpy())
    twin = render_backward_reference(unit, cameras[0], slope.astype(np.float64))
    expected = np.column_stack([twin[name] for name in FIELDS])
    assert np.allclose(rows.grad.numpy(), expected, rtol=2e-3, atol=2e-3 * np.abs(expected).max(axis=0))
    # colours and opacities move no edge of the cut, so that central differences are smooth
    step = np.zeros((20, 14), np.float32)
    step[:, 11:] = np.random.default_rng(1).normal(size=(20, 3))
    ends = [render_reference(unpack(pack(unit) + e * step), cameras[0]) for e in (1e-3, -1e-3)]
    difference = ((ends[0] - ends[1]) * slope).sum() / 2e-3
    assert difference == pytest.approx(float((rows.grad.numpy() * step).sum()), rel=1e-3)


class LikeGsplat:
    """Stands for gsplat's functions: draws by our kernels, from world-to-camera matrices and pinholes."""

    def fully_fused_projection(self, means, covars, quats, scales, viewmats, Ks, width, height, **options):
        assert covars is None
        assert (means.shape[1], viewmats.shape, Ks.shape) == (3, (1, 4, 4), (1, 3, 3))
        assert (options["near_plane"], options["eps2d"]) == (NEAR, DILATION)
        view, lens = viewmats[0].numpy().astype(float), Ks[0].numpy().astype(float)
        assert view[3].tolist() == [0, 0, 0, 1]
        assert lens[2].tolist() == [0, 0, 1]
        self.camera = Camera(view[:3, :3], view[:3, 3], lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2], width, height)
        self.fields = [field.numpy() for field in (means, scales.log(), quats)]
        return (None,) * 5

    def isect_tiles(self, *given):
        return (None,) * 3

    def isect_offset_encode(self, *given):
        return None

    def rasterize_to_pixels(self, centres, conics, colors, opacities, *given):
        logits = torch.log(opacities[0] / (1 - opacities[0]))
        picture = torch.from_numpy(render(Gaussians(*self.fields, logits.numpy(), colors[0].numpy()), self.camera))
        return picture[None, ..., :3], picture[None, ..., 3:]


def test_gsplat_is_handed_the_camera(monkeypatch):
    """A camera that is turned, off its axis, of unequal focal lengths and not square: no two numbers alike."""
    cuda = SimpleNamespace(_wrapper=LikeGsplat())
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(cuda=cuda))
    monkeypatch.setitem(sys.modules, "gsplat.cuda", cuda)
    gaussians, _, _ = scene(count=200, views=1)
    camera = replace(look_at((2.0, -1.7, 0.9), width=40, height=28), fx=52.0, fy=44.0, cx=17.0, cy=16.5)
    rows = torch.from_numpy(pack(gaussians))
    ours = splat(rows, camera).numpy()
    assert ours[..., 3].max() > 0.5
    np.testing.assert_allclose(gsplat_picture(rows, camera).numpy(), ours, atol=1e-5)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_gsplat_draws_and_differentiates_as_the_kernels_do():
    pytest.importorskip("gsplat")
    gaussians, cameras, _ = scene(count=20, views=1)
    slope = torch.from_numpy(np.random.default_rng(0).normal(size=(32, 32, 4)).astype(np.float32))
    found = []
    for device in ("cpu", "cuda"):
        rows = torch.from_numpy(pack(gaussians)).to(device).requires_grad_()
        picture = splat(rows, cameras[0])
        (picture * slope.to(device)).sum().backward()
        found.append((picture.detach().cpu().numpy(), rows.grad.cpu().numpy()))
    assert np.abs(found[0][0] - found[1][0]).max() < 5e-3
    assert np.allclose(found[0][1], found[1][1], rtol=2e-2, atol=2e-2 * np.abs(found[0][1]).max(axis=0))


def test_losses_against_the_metrics():
    rng = np.random.default_rng(0)
    a, b, c = (rng.random((24, 20, 4)).astype(np.float32) for _ in range(3))
    ta, tb, tc = map(torch.from_numpy, (a, b, c))
    assert float(sample.ssim(ta[..., :3], tb[..., :3])) == pytest.approx(ssim_metric(a[..., :3], b[..., :3]), abs=1e-5)
    gain = psnr(b[..., :3], a[..., :3]) - psnr(b[..., :3], c[..., :3])
    assert float(sample.decibels(ta, tb, tc)) == pytest.approx(gain, abs=1e-4)
    whole = sample.view_loss(ta, tb, tc, LossConfig(l1=0.8, ssim=0.2, decibel=0.5))
    expected = 0.8 * np.abs(a - b).mean() + 0.2 * (1 - ssim_metric(a[..., :3], b[..., :3])) - 0.05 * gain
    assert float(whole) == pytest.approx(expected, abs=1e-5)


def test_configurations_survive_yaml_and_faults_are_named(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text(config_text(CONFIG))
    assert read_config(path) == CONFIG
    path.write_text("network: lean\nscenes: {size: 64}\n")
    assert read_config(path).network.rounds == 2
    for text, message in (
        ("steps: [", "not YAML"), ("- 1\n", "list"), ("stepz: 3\n", "stepz"), ("network: huge\n", "huge"),
        ("steps: 0\n", "at least 1"), ("scenes: {start: uniform}\n", "wo_vbm"), ("views: 9\n", "targets"),
    ):  # fmt: skip
        path.write_text(text)
        refused(DataError, message, read_config, path)
    refused(UsageError, "no such file", read_config, tmp_path / "no.yaml")


def test_held_out_functions_and_volumes_are_not_trained_on(data):
    found = recipes(data, CONFIG.scenes)
    assert {f for r in found["train"] for f in r.functions} <= {0, 2, 3}
    assert {r.functions for r in found["held functions"]} == {(1,)}
    assert {r.volume for r in found["train"]}.isdisjoint({r.volume for r in found["held volumes"]})
    assert found == recipes(data, CONFIG.scenes)


def test_recipes_keep_to_the_ranges_of_the_configuration(data):
    several = replace(CONFIG.scenes, size=[32, 64], bands=[1, 3], densities=[0.5, 8.0], per_volume=40)
    found = recipes(data, several)["train"]
    assert len(found) == 80
    assert {r.size for r in found} == {32, 64}
    assert {len(r.functions) for r in found} == {1, 2, 3}
    assert all(len(set(r.functions)) == len(r.functions) == len(r.densities) for r in found)
    assert all(0.5 <= factor <= 8 for r in found for factor in r.densities)
    small, large = ([r.gaussians for r in found if r.size == size] for size in (32, 64))
    assert 300 <= min(small) < max(small) <= 500 < 2**1.3 * 300 <= min(large) <= max(large) <= 2**1.3 * 500
    with pytest.raises(UsageError, match="bands"):
        replace(several, bands=(2, 4))  # three functions are trained on
    refused(UsageError, "densities", replace, several, densities=(0.0, 1.0))


def test_processes_make_shares_of_the_scenes(data):
    scenes = replace(CONFIG.scenes, seed=5)
    count = lambda: len(list((data / "scenes").iterdir()))  # noqa: E731
    (data / "scenes").mkdir(exist_ok=True)
    before = count()
    for rank in (0, 1):
        make_scenes(data, scenes, Console(quiet=True), (rank, 2))
        assert before < count()
    made = count()
    assert len(prepare_scenes(data, scenes, Console(quiet=True))["train"]) == 2
    assert count() == made


def test_a_scene_that_shows_next_to_nothing_is_left_out(data, monkeypatch):
    scenes = replace(CONFIG.scenes, seed=6)
    whole, empty = training_scenes._render, recipes(data, scenes)["train"][0]

    def render_or_nothing(recipe, config):
        name, gaussians, images = whole(recipe, config)
        return (name, gaussians.take(np.arange(9)), images[:0]) if recipe == empty else (name, gaussians, images)

    monkeypatch.setattr(training_scenes, "_render", render_or_nothing)
    found = prepare_scenes(data, scenes, Console(quiet=True))
    assert [len(scenes) for scenes in found.values()] == [1, 2, 2]


def test_scenes_hold_what_the_closed_form_and_the_ray_caster_give(data):
    found = prepare_scenes(data, CONFIG.scenes, Console(quiet=True))["train"][0]
    views = np.stack([render(found.gaussians, camera) for camera in found.targets])
    assert psnr(found.target_images[..., :3] / 65535, views[..., :3]) > 20
    assert found.images.shape == (4, 32, 32, 4)
    eyes = {tuple(camera.position) for camera in found.cameras}
    assert eyes.isdisjoint({tuple(camera.position) for camera in found.targets})


@pytest.fixture(scope="module")
def straight(data, tmp_path_factory):
    """A run from its beginning to its end; to be read only."""
    folder = tmp_path_factory.mktemp("runs") / "straight"
    assert loop.train(CONFIG, str(data), str(folder), Console(quiet=True)) == 0
    return folder


def test_a_run_learns_and_keeps_its_record(straight):
    rows = rows_of(straight)
    assert [int(row["step"]) for row in rows] == [1, 2, 3, 4]
    assert all(np.isfinite(float(value)) for row in rows for value in row.values())
    assert rows[-1]["skipped"] == "0"
    looks = rows_of(straight, "held.csv")
    assert [int(row["step"]) for row in looks] == [2, 4]
    assert {"held volumes: gain 2", "held functions: gain 1"} <= set(looks[0])
    torch.manual_seed(CONFIG.seed)
    fresh = sample.Vvgt(CONFIG.network).state_dict()
    assert any((fresh[name] != value).any() for name, value in weights(straight / "last.pt").items())
    assert load_checkpoint(straight / "best.pt").training["config"]["steps"] == 4
    assert read_config(straight / "config.yaml") == CONFIG


@pytest.mark.parametrize("variant", ["full", "wo_3dt", "wo_vgf", "wo_vbm"])
def test_the_papers_network_and_its_ablations_learn(variant, data):
    start = "uniform" if variant == "wo_vbm" else "moments"
    config = replace(
        CONFIG, network=replace(TINY, variant=variant), loss=LossConfig(), scenes=replace(CONFIG.scenes, start=start)
    )
    scenes = prepare_scenes(data, config.scenes, Console(quiet=True))
    network, device = sample.Vvgt(config.network), torch.device("cpu")
    loss, _, bad = sample.accumulate_gradients(
        network, sample.Feeder(scenes["train"], config), np.random.default_rng(0), device
    )
    assert loss > 0
    assert not bad
    slopes = [parameter.grad for parameter in network.parameters() if parameter.grad is not None]
    assert slopes
    assert all(torch.isfinite(slope).all() for slope in slopes)
    assert any(slope.abs().max() > 0 for slope in slopes)
    assert np.isfinite(sample.score_scene(network, scenes["held volumes"][0], config, device)).all()


def test_a_run_elsewhere_or_otherwise_is_refused(data, straight, tmp_path):
    with pytest.raises(UsageError, match="another configuration"):
        loop.train(replace(CONFIG, rate=2e-3), str(data), str(straight), Console(quiet=True))
    (tmp_path / "thesis.txt").write_text("years")
    refused(UsageError, "not empty", loop.train, CONFIG, str(data), str(tmp_path), Console(quiet=True))
    with pytest.raises(UsageError, match="no folder train"):
        loop.train(CONFIG, str(tmp_path), str(tmp_path / "run"), Console(quiet=True))


def test_what_is_not_finite_skips_the_step_and_is_counted(data, tmp_path, monkeypatch, capsys):
    whole = sample.view_loss

    def broken(*args):
        broken.calls += 1
        return whole(*args) * (float("nan") if broken.calls == 1 else 1)

    broken.calls = 0
    monkeypatch.setattr(sample, "view_loss", broken)
    config = replace(CONFIG, steps=2, check_every=9)
    assert loop.train(config, str(data), str(tmp_path / "run"), Console()) == 0
    assert [row["skipped"] for row in rows_of(tmp_path / "run")] == ["1", "1"]
    assert "step 1 skipped" in capsys.readouterr().err
    assert all(torch.isfinite(value).all() for value in weights(tmp_path / "run" / "last.pt").values())


def command(folder, data, *before):
    main = before or (sys.executable, "-m", "tests.spared")
    return [*main, "train", "--data", str(data), "--config", str(folder / "given.yaml"), "-o", str(folder / "run")]


def test_a_run_that_was_terminated_goes_on_to_the_same_weights(data, straight, tmp_path):
    (tmp_path / "given.yaml").write_text(config_text(CONFIG))
    process = subprocess.Popen(command(tmp_path, data), env=ENVIRONMENT, stderr=subprocess.PIPE)
    while process.poll() is None and not (tmp_path / "run" / "metrics.csv").exists():
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 143, process.stderr.read()
    assert 1 <= len(rows_of(tmp_path / "run")) < CONFIG.steps
    assert loop.train(CONFIG, str(data), str(tmp_path / "run"), Console(quiet=True)) == 0
    ended = weights(tmp_path / "run" / "last.pt")
    assert all(torch.equal(value, ended[name]) for name, value in weights(straight / "last.pt").items())
    left = [[row[key] for key in ("step", "loss", "gain", "norm")] for row in rows_of(tmp_path / "run")]
    assert left == [[row[key] for key in ("step", "loss", "gain", "norm")] for row in rows_of(straight)]


def test_two_processes_have_the_loss_of_one(data, straight, tmp_path):
    (tmp_path / "given.yaml").write_text(config_text(CONFIG))
    torchrun = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2",
                "-m", "tests.spared")  # fmt: skip
    ran = subprocess.run(
        command(tmp_path, data, *torchrun), env=ENVIRONMENT, capture_output=True, text=True, timeout=300
    )
    assert ran.returncode == 0, ran.stderr
    for key in ("loss", "gain", "norm"):
        one, two = ([float(row[key]) for row in rows_of(folder)] for folder in (straight, tmp_path / "run"))
        assert np.allclose(one, two, rtol=1e-4, atol=1e-5), key


def test_a_step_follows_the_gradient_before_any_training():
    gaussians, cameras, _ = scene(count=40, views=4, size=32)
    views = np.stack([render(gaussians, camera) for camera in cameras])
    other = Gaussians(gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.opacity_logits - 0.2,
                      gaussians.colors * 0.95)  # fmt: skip
    torch.manual_seed(0)
    network = sample.Vvgt(STEPPER)
    prepared = sample.prepare(other, cameras, views, STEPPER)
    with torch.no_grad():
        rows = sample.run_network(network, tensors_of(prepared.arrays()), torch.device("cpu"))
        better = prepared.restore(rows.numpy())
    errors = [np.mean([(render(g, c) - v) ** 2 for c, v in zip(cameras, views, strict=True)]) for g in (other, better)]
    assert errors[1] < 0.9 * errors[0]
    assert np.abs(as_rows(better) - pack(other)).max() > 1e-3
    assert len(project(better, cameras[0]).flat) == 40


def test_a_group_of_processes_says_once_why_it_ended(tmp_path):
    torchrun = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2",
                "-m", "tests.spared")  # fmt: skip
    (tmp_path / "given.yaml").write_text(config_text(CONFIG))
    told = subprocess.run(
        command(tmp_path, tmp_path / "nowhere", *torchrun), env=ENVIRONMENT, capture_output=True, text=True, timeout=300
    ).stderr
    assert told.count("vvgt: error: ") == 1
    assert "nowhere" in next(line for line in told.splitlines() if line.startswith("vvgt: error: "))
