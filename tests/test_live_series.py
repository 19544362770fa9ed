"""Live files of a time series: one function and one range for all frames, in files, in Python, and in one page."""

import base64
import gzip
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli as vvgt_library
from tests.live_stream import from_bytes
from tests.test_live_labels import LABELS
from tests.test_live_layers import TF, layered, several
from vvgt_cli.conversion import frames as series
from vvgt_cli.gaussians import read_ply
from vvgt_cli.gaussians.formats.live import BYTES, ROW
from vvgt_cli.gaussians.formats.page_live import shared_facts, with_shared_labels
from vvgt_cli.gaussians.live_facts import LABEL_ROW, LAYER_ID

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
    vvgt.ok(*source, "-o", tmp_path / "p.html")
    vvgt.ok(*source, "-o", tmp_path / "f_{}.ply")
    content = (tmp_path / "p.html").read_bytes()
    scene = scene_of(content)
    live = scene["live"]
    assert [frame["name"] for frame in scene["frames"]] == ["frame 0", "frame 1", "frame 2"]
    assert live["elements"] == ["values-0", "values-1", "values-2"]
    largest = []
    for k in range(3):
        some, header = read_ply(tmp_path / f"f_{k}.ply")
        assert [header.live.lo, header.live.hi] == live["layers"][0]["values"]
        assert list(header.live.histogram) == live["layers"][0]["histogram"]
        held = re.search(rb'id="values-%d">([^<]+)<' % k, content)
        planes = np.frombuffer(gzip.decompress(base64.b64decode(held[1])), np.uint8).reshape(ROW, -1)
        stream = np.zeros((len(some), BYTES), np.uint8)
        stream[:, :ROW] = planes.T
        back = from_bytes(stream, live)
        span = live["layers"][0]["values"][1] - live["layers"][0]["values"][0]
        np.testing.assert_allclose(np.sort(back[:, 0]), np.sort(some.live[:, 0]), atol=span / 500)
        np.testing.assert_allclose(np.sort(back[:, 2]), np.sort(some.live[:, 2]), rtol=0.03)
        largest.append(some.live[:, 0].max())
    assert largest[0] < 0.5 * largest[2]
    assert live["layers"][0]["values"][1] == pytest.approx(max(np.load(path).max() for path in frames.glob("*.npy")))


def test_a_page_of_many_frames_is_bounded(vvgt, frames, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(series, "MAX_LIVE", 100)
    done = vvgt("convert", frames / "f?.npy", "--live", "-o", tmp_path / "p.html", *SMALL)
    assert (done.code, "3 frames on one page: 33 Gaussians each, fewer than --max-gaussians" in done.err) == (0, True)
    assert len(scene_of((tmp_path / "p.html").read_bytes())["live"]["elements"]) == 3


def test_a_series_in_python_is_live(frames, tmp_path) -> None:
    goal = {"max_gaussians": 90, "size": 48}
    clouds = vvgt_library.convert(str(frames / "f?.npy"), "viridis", goal, live=True)
    assert isinstance(clouds, vvgt_library.Clouds)
    assert len(clouds["f1.npy"].recolor("magma").gaussians)
    clouds.save(tmp_path / "p.html")
    assert len(scene_of((tmp_path / "p.html").read_bytes())["live"]["elements"]) == 3
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
    vvgt.ok(*source, "-o", tmp_path / "p.html")
    content = (tmp_path / "p.html").read_bytes()
    live = scene_of(content)["live"]
    assert [label["number"] for label in live["layers"][0]["labels"]] == [1, 7, 9]
    for k, rows in enumerate(({0, 1}, {0, 2})):
        held = re.search(rb'id="values-%d">([^<]+)<' % k, content)
        planes = np.frombuffer(gzip.decompress(base64.b64decode(held[1])), np.uint8).reshape(BYTES, -1)
        assert set(planes[ROW].tolist()) == rows


def test_a_page_of_frames_of_several_layers_is_live(vvgt, frames, tmp_path) -> None:
    """A label map that stands still over frames that do not."""
    map_ = np.zeros((12, 12, 12), np.uint8)
    map_[2:5] = 4
    map_[7:10] = 9
    np.save(tmp_path / "map.npy", map_)
    layer = ("--layer", f"{tmp_path / 'map.npy'},labels=auto")
    source = ("convert", frames / "f?.npy", "--tf", "viridis", *layer, "--live", *SMALL)
    vvgt.ok(*source, "-o", tmp_path / "p.html")
    vvgt.ok(*source, "-o", tmp_path / "f_{}.ply")
    content = (tmp_path / "p.html").read_bytes()
    live = scene_of(content)["live"]
    assert [(one["row"], [label["number"] for label in one["labels"]]) for one in live["layers"]] == [
        (0, []),
        (1, [4, 9]),
    ]
    for k, held in enumerate(re.findall(rb'id="values-\d">([^<]+)<', content)):
        some, header = read_ply(tmp_path / f"f_{k}.ply")
        assert (some.live is not None, header.live is not None) == (True, True)
        planes = np.frombuffer(gzip.decompress(base64.b64decode(held)), np.uint8).reshape(BYTES, -1)
        stream = planes.T
        back = from_bytes(stream, live)
        for column in (LABEL_ROW, LAYER_ID):
            counted = np.unique(some.live[:, column], return_counts=True)  # type: ignore[index]
            np.testing.assert_array_equal(np.unique(back[:, column], return_counts=True), counted)


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


def test_layers_have_in_common_what_each_has_of_all() -> None:
    """Labels of each frame are renumbered in their own layer alone."""
    value, named = several().layers
    first, second = (replace(value, others=(replace(named, labels=some),)) for some in (LABELS[:2], LABELS[1:]))
    both = shared_facts([first, second])
    assert both.layers == (value, replace(named, labels=LABELS))
    for other in (replace(second, lo=-1e9), value, replace(second, others=(value,)), None):
        assert shared_facts([first, other]) is None
    assert with_shared_labels(layered(4), first, both).live[:, LABEL_ROW].tolist() == [0, 0, 0, 1]  # type: ignore[index]
    assert with_shared_labels(layered(4), second, both).live[:, LABEL_ROW].tolist() == [0, 1, 0, 2]  # type: ignore[index]
    other = replace(named, labels=(replace(LABELS[0], name="left  liver"), LABELS[1]))
    both = shared_facts([first, replace(value, others=(other,))])
    assert [(label.number, label.name) for label in both.others[0].labels] == [
        (3, "left  liver"), (3, "liver"), (7, LABELS[1].name),
    ]  # fmt: skip
    assert with_shared_labels(layered(4), first, both).live[:, LABEL_ROW].tolist() == [0, 1, 0, 2]  # type: ignore[index]
