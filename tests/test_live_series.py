"""Live files of a time series: one function and one range for all frames, in files, in Python, and in one page."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli as vvgt_library
from tests.test_live_labels import LABELS
from tests.test_live_layers import TF, several
from vvgt_cli.gaussians import read_ply
from vvgt_cli.gaussians.live_facts import LAYER_ID

SMALL = ("--max-gaussians", 90, "--screen", 48)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames, each of another range."""
    folder = tmp_path_factory.mktemp("frames")
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 12)] * 3, indexing="ij")
    for k in range(3):
        ball = np.exp(-4 * ((x - 0.2 * k) ** 2 + y**2 + z**2)) * (k + 1)
        np.save(folder / f"f{k}.npy", ball.astype(np.float32))
    return folder


def scene_of(page: bytes) -> dict:
    return json.loads(re.search(rb'id="scene">(.*?)</script>', page, re.S)[1])  # type: ignore[index]


def test_a_series_in_python_is_live(frames, tmp_path) -> None:
    goal = {"max_gaussians": 90, "screen": 48}
    clouds = vvgt_library.convert(str(frames / "f?.npy"), "viridis", **goal, live=True)
    assert isinstance(clouds, vvgt_library.Clouds)
    assert len(clouds["f1.npy"].recolor("magma").gaussians)
    clouds.save(tmp_path / "p.html")
    assert len(scene_of((tmp_path / "p.html").read_bytes())["frames"]) == 3
    blocked = vvgt_library.convert(str(frames / "f?.npy"), "viridis", **goal, live=True, blocks=16)
    assert isinstance(blocked, vvgt_library.Clouds)
    assert [cloud.ply.live for cloud in blocked.values()] == [cloud.ply.live for cloud in clouds.values()]
    other = clouds.recolor("magma")
    other.save(tmp_path / "m.html")
    scene = scene_of((tmp_path / "m.html").read_bytes())
    assert len(scene["frames"]) == 3
    assert "look" not in scene  # of the conversion, which is another one


@pytest.mark.parametrize("labelled", [False, True])
def test_a_layer_that_is_empty_in_a_frame_is_skipped(vvgt, tmp_path, labelled: bool) -> None:
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 12)] * 3, indexing="ij")
    ball = np.exp(-4 * (x**2 + y**2 + z**2)).astype(np.float32)
    for k in range(3):
        values = (ball > 0.5).astype(np.uint8) if labelled else ball
        np.save(tmp_path / f"f{k}.npy", values * (k != 1))
    np.save(tmp_path / "low.npy", (z < -0.5).astype(np.uint8))
    (tmp_path / "tf.json").write_text(json.dumps(TF))
    low = f"{tmp_path / 'low.npy'},labels=auto"
    look = ("--labels", "auto") if labelled else ("--tf", tmp_path / "tf.json")
    source = ("convert", tmp_path / "f?.npy", *look, "--layer", low)
    done = vvgt(*source, "--live", *SMALL, "-o", tmp_path / "f_{}.ply")
    assert (done.code, "skipped: f1 (only background)" in done.err) == (0, True), done.err
    for k, numbers in enumerate(([0, 1], [1], [0, 1])):
        live = read_ply(tmp_path / f"f_{k}.ply")[0].live
        assert np.unique(live[:, LAYER_ID]).tolist() == numbers  # type: ignore[index]


def test_files_are_shown_alike_whose_layers_are() -> None:
    value, named = several().layers
    first, second = (replace(value, others=(replace(named, labels=some),)) for some in (LABELS[:2], LABELS[1:]))
    assert first.shown_like(second)
    for other in (replace(second, lo=-1e9), value, replace(second, others=(value,))):
        assert not first.shown_like(other)
