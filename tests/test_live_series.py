"""Live files of a time series: one function and one range for all frames, in files, in Python, and in one page."""

from __future__ import annotations

import base64
import gzip
import json
import re
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli as vvgt_library
from tests.test_page_live import PLANES
from vvgt_cli.conversion import pages
from vvgt_cli.gaussians import read_ply
from vvgt_cli.gaussians.formats.live import from_bytes

SMALL = ("--max-gaussians", 90, "--size", 48)


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


def test_all_frames_of_a_page_carry_values_of_one_range(vvgt, frames, tmp_path) -> None:
    """And so do the files of the frames; each frame's bytes are those of its file."""
    source = ("convert", frames / "f?.npy", "--tf", "viridis", "--live", *SMALL)
    assert vvgt(*source, "-o", tmp_path / "p.html").code == 0
    assert vvgt(*source, "-o", tmp_path / "f_{}.ply").code == 0
    content = (tmp_path / "p.html").read_bytes()
    scene = scene_of(content)
    live = scene["live"]
    assert [frame["name"] for frame in scene["frames"]] == ["f0.npy", "f1.npy", "f2.npy"]
    assert live["held"] == ["values-0", "values-1", "values-2"]
    largest = []
    for k in range(3):
        some, header = read_ply(tmp_path / f"f_{k}.ply")
        assert header.live is not None
        assert [header.live.lo, header.live.hi] == live["layers"][0]["values"]
        assert list(header.live.histogram) == live["layers"][0]["histogram"]
        held = re.search(rb'id="values-%d">([^<]+)<' % k, content)
        assert held is not None
        planes = np.frombuffer(gzip.decompress(base64.b64decode(held[1])), np.uint8).reshape(len(PLANES), -1)
        stream = np.zeros((len(some), 8), np.uint8)
        stream[:, PLANES] = planes.T
        back = from_bytes(stream, live)
        assert some.live is not None
        span = live["layers"][0]["values"][1] - live["layers"][0]["values"][0]
        np.testing.assert_allclose(np.sort(back[:, 0]), np.sort(some.live[:, 0]), atol=span / 500)
        np.testing.assert_allclose(np.sort(back[:, 2]), np.sort(some.live[:, 2]), rtol=0.03)
        largest.append(some.live[:, 0].max())
    assert largest[0] < 0.5 * largest[2]
    assert live["layers"][0]["values"][1] == pytest.approx(max(np.load(path).max() for path in frames.glob("*.npy")))


def test_a_page_of_many_frames_is_bounded(vvgt, frames, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(pages, "MOST", 100)
    done = vvgt("convert", frames / "f?.npy", "--live", "-o", tmp_path / "p.html", *SMALL)
    assert (done.code, "33 Gaussians each in the place of 90" in done.err) == (0, True)
    assert len(scene_of((tmp_path / "p.html").read_bytes())["live"]["held"]) == 3


def test_a_series_in_python_is_live(frames, tmp_path) -> None:
    goal = {"max_gaussians": 90, "size": 48}
    clouds = vvgt_library.convert(str(frames / "f?.npy"), "viridis", goal, live=True)
    assert isinstance(clouds, vvgt_library.Clouds)
    assert len(clouds["f1.npy"].recolor("magma").gaussians)
    clouds.save(tmp_path / "p.html")
    assert len(scene_of((tmp_path / "p.html").read_bytes())["live"]["held"]) == 3
    blocked = vvgt_library.convert(str(frames / "f?.npy"), "viridis", goal, live=True, blocks=16)
    assert isinstance(blocked, vvgt_library.Clouds)
    assert [cloud.ply.live for cloud in blocked.values()] == [cloud.ply.live for cloud in clouds.values()]
    other = clouds.recolor("magma")
    other.save(tmp_path / "m.html")
    assert "live" not in scene_of((tmp_path / "m.html").read_bytes())


def test_a_page_of_label_frames_has_each_label_once(vvgt, tmp_path) -> None:
    """Label 7 is in one frame alone; rows of both are those of the page."""
    for k, numbers in enumerate(((1, 7), (1, 9))):
        data = np.full((10, 10, 10), numbers[0], np.uint8)
        data[:, :, 5:] = numbers[1]
        np.save(tmp_path / f"map_label_{k}.npy", data)
    source = ("convert", tmp_path / "map_label_?.npy", "--labels", "auto", "--live", *SMALL)
    assert vvgt(*source, "-o", tmp_path / "p.html").code == 0
    content = (tmp_path / "p.html").read_bytes()
    live = scene_of(content)["live"]
    assert [label["number"] for label in live["layers"][0]["labels"]] == [1, 7, 9]
    for k, rows in enumerate(({0, 1}, {0, 2})):
        held = re.search(rb'id="values-%d">([^<]+)<' % k, content)
        assert held is not None
        planes = np.frombuffer(gzip.decompress(base64.b64decode(held[1])), np.uint8).reshape(8, -1)
        assert set(planes[6].tolist()) == rows
