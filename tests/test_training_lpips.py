"""LPIPS: against a second writing of the formula with torchvision's numbering, and files that are not its weights."""

from dataclasses import replace

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.network.training.config import LossConfig, SceneConfig, TrainConfig

torch = pytest.importorskip("torch")

from test_training import CONFIG, rows_of  # noqa: E402
from torch.nn import functional  # noqa: E402

from vvgt_cli.network.training import loop  # noqa: E402
from vvgt_cli.network.training.lpips import load_lpips  # noqa: E402
from vvgt_cli.network.training.sample import view_loss  # noqa: E402
from vvgt_cli.progress import Console  # noqa: E402
from vvgt_cli.volume.shapes import make_shape  # noqa: E402
from vvgt_cli.volume.writers import write_nrrd  # noqa: E402

CONVOLUTIONS = {0: 64, 2: 64, 5: 128, 7: 128, 10: 256, 12: 256, 14: 256, 17: 512, 19: 512, 21: 512, 24: 512, 26: 512,
                28: 512}  # fmt: skip
POOLINGS, TAPS = (4, 9, 16, 23), (3, 8, 15, 22, 29)  # numbers of layers in torchvision's vgg16().features


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Random weights under the names of the two published files."""
    folder, generator = tmp_path_factory.mktemp("lpips"), torch.Generator().manual_seed(0)
    backbone, before = {}, 3
    for number, width in CONVOLUTIONS.items():
        spread = (2 / (9 * before)) ** 0.5
        backbone[f"features.{number}.weight"] = spread * torch.randn(width, before, 3, 3, generator=generator)
        backbone[f"features.{number}.bias"] = 0.1 * torch.randn(width, generator=generator)
        before = width
    backbone["classifier.0.weight"] = torch.zeros(2, 2)
    linear = {
        f"lin{i}.model.1.weight": torch.rand(1, width, 1, 1, generator=generator)
        for i, width in enumerate((64, 128, 256, 512, 512))
    }
    torch.save(backbone, folder / "vgg16.pth")
    torch.save(linear, folder / "vgg.pth")
    return LossConfig(0, 0, 0, 0.5, str(folder / "vgg16.pth"), str(folder / "vgg.pth")), backbone, linear


def twin(backbone, linear, a, b):
    """LPIPS, layer by layer as torchvision numbers them, float64."""
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]).double(), torch.tensor([0.458, 0.448, 0.450]).double()
    pictures = [((x.double() * 2 - 1 - shift) / scale).permute(2, 0, 1)[None] for x in (a, b)]
    total, tap = 0.0, 0
    for layer in range(30):
        if layer in CONVOLUTIONS:
            weight, bias = (backbone[f"features.{layer}.{part}"].double() for part in ("weight", "bias"))
            pictures = [functional.conv2d(x, weight, bias, padding=1) for x in pictures]
        elif layer in POOLINGS:
            pictures = [functional.max_pool2d(x, 2, 2) for x in pictures]
        else:
            pictures = [x.clamp(min=0) for x in pictures]
        if layer in TAPS:
            x, y = (functional.normalize(x, dim=1) for x in pictures)
            total += float(((x - y) ** 2 * linear[f"lin{tap}.model.1.weight"].double()).sum(1).mean())
            tap += 1
    return total


def test_it_is_the_published_formula(files):
    config, backbone, linear = files
    generator = torch.Generator().manual_seed(1)
    a, b = (torch.rand(37, 48, 4, generator=generator) for _ in range(2))
    lpips = load_lpips(config)
    assert float(lpips(a[..., :3], a[..., :3])) == 0
    assert float(lpips(a[..., :3], b[..., :3])) == pytest.approx(
        twin(backbone, linear, a[..., :3], b[..., :3]), rel=1e-4
    )
    whole = view_loss(a, b, None, config, lpips)
    assert float(whole) == pytest.approx(0.5 * float(lpips(a[..., :3], b[..., :3])), rel=1e-6)


def test_its_gradient_points_to_the_target_and_its_weights_stay(files):
    config = files[0]
    lpips = load_lpips(config)
    target = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(2))
    picture = (0.7 * target + 0.1).requires_grad_()
    before = lpips(picture, target)
    before.backward()
    assert torch.isfinite(picture.grad).all()
    with torch.no_grad():
        nearer = picture - 0.01 * picture.grad / picture.grad.norm()
        assert float(lpips(nearer, target)) < float(before)
    assert all(not weight.requires_grad for weight in lpips.parameters())


def test_a_run_takes_it_into_its_loss(files, tmp_path):
    for part in ("train", "held"):
        (tmp_path / part).mkdir()
        write_nrrd(tmp_path / part / "shells.nrrd", make_shape("shells", 24, 1))
    config = replace(CONFIG, steps=1, batch=1, loss=files[0])
    assert loop.train(config, str(tmp_path), str(tmp_path / "run"), Console(quiet=True)) == 0
    (row,) = rows_of(tmp_path / "run")
    assert float(row["loss"]) > 0
    assert float(row["norm"]) > 0
    assert row["skipped"] == "0"


def test_other_files_are_refused_in_one_line(files, tmp_path):
    config, backbone, linear = files
    refused(DataError, "no such file", load_lpips, replace(config, lpips_backbone="nowhere.pth"))
    with pytest.raises(DataError, match=r"no features.0.weight; expected VGG-16"):
        load_lpips(replace(config, lpips_backbone=config.lpips_linear))
    with pytest.raises(DataError, match=r"no lin0.model.1.weight; expected LPIPS"):
        load_lpips(replace(config, lpips_linear=config.lpips_backbone))
    torch.save(linear | {"lin4.model.1.weight": torch.ones(1, 9, 1, 1)}, tmp_path / "other.pth")
    refused(DataError, r"linear.4", load_lpips, replace(config, lpips_linear=str(tmp_path / "other.pth")))
    torch.save(backbone | {"features.0.bias": torch.full((64,), np.nan)}, tmp_path / "nan.pth")
    refused(DataError, "finite", load_lpips, replace(config, lpips_backbone=str(tmp_path / "nan.pth")))


def test_it_is_asked_for_with_both_files_or_not_at_all(files):
    assert load_lpips(LossConfig()) is None
    refused(UsageError, "lpips_backbone", LossConfig, lpips=0.05)
    refused(UsageError, "they need lpips", LossConfig, lpips_linear="a.pth", lpips_backbone="b.pth")
    refused(UsageError, "8 px", TrainConfig, loss=files[0], scenes=SceneConfig(size=8))
