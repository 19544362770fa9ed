"""The shipped model: what its card says, and that it helps on a volume that no training has seen."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form import VbmOptions, backproject, initialise
from vvgt_cli.dvr import RenderSettings, Scene, render_views
from vvgt_cli.images.metrics import psnr
from vvgt_cli.look import from_histogram
from vvgt_cli.network.card import SHIPPED, find_model
from vvgt_cli.network.runtime import Model
from vvgt_cli.splat import render
from vvgt_cli.volume import statistics
from vvgt_cli.volume.shapes import make_shape

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def model():
    return Model.open(find_model(SHIPPED), threads=1)


def test_the_card_says_what_it_was_trained_on_and_what_that_gave(model):
    card = model.card
    assert card.name == SHIPPED
    assert card.training["scenes"]["train"] > 10
    assert card.training["step"] == card.training["config"]["steps"]
    assert card.metrics["held volumes: gain 2"] > 1
    assert card.metrics["held functions: gain 2"] > 1
    assert card.difference <= 1e-4
    assert len(card.commit) == 40


def test_the_wheel_takes_every_file_of_it_and_none_is_large():
    files = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["data-files"]
    listed = {ROOT / name for name in files[f"share/vvgt/models/{SHIPPED}"]}
    assert listed == set((ROOT / "models" / SHIPPED).iterdir())
    assert sum(path.stat().st_size for path in listed) < 10e6


def test_it_helps_on_a_scene_it_has_never_seen(model):
    volume = make_shape("plates", 32, seed=1234)
    scene = Scene.build(volume, from_histogram(statistics(volume)), float(np.mean(volume.spacing)))
    train, test = default_views("train", size=64), default_views("test", 4, size=64)
    views, reference = (render_views(scene, cameras, RenderSettings(step=0.5, samples=2)) for cameras in (train, test))
    start, _ = backproject(initialise(scene, VbmOptions(max_gaussians=1500, size=64)), train, views)
    better = model.improve(start, train, views)
    before, after = (
        np.mean([psnr(v[..., :3], render(g, c)[..., :3]) for c, v in zip(test, reference, strict=True)])
        for g in (start, better)
    )
    assert after > before + 0.5
