"""The runtime without torch: what it feeds, parts, threads, and models that are not what they must be."""

import json
from pathlib import Path

import numpy as np
import pytest
from network_models import TINY, as_rows, scene
from onnx_models import geometry_graph, write_card, write_model

from tests.processes import python
from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.network import runtime
from vvgt_cli.network.card import CARD, find_model, read_card
from vvgt_cli.network.prepare import pack

STEP = np.arange(14) * 0.01


@pytest.fixture
def folder(tmp_path):
    return write_model(tmp_path / "adds", STEP)


def test_every_gaussian_goes_through_in_its_place(folder):
    gaussians, cameras, images = scene(count=101, views=5)
    out = runtime.Model.open(folder).improve(gaussians, cameras, images)
    assert np.allclose(as_rows(out), pack(gaussians) + STEP, atol=1e-6)


@pytest.mark.parametrize("points", [1, 7, 50, 101, 1000])
def test_parts_cover_all_gaussians_and_none_is_too_large(folder, points):
    gaussians, cameras, images = scene(count=101)
    model, sizes, ticks = runtime.Model.open(folder), [], []
    run = model._run

    def watched(graph, feed):
        if graph == "geometry":
            sizes.append(len(feed["gaussians"]))
        return run(graph, feed)

    model._run = watched
    out = model.improve(gaussians, cameras, images, points=points, progress=lambda *done: ticks.append(done))
    assert np.allclose(as_rows(out), pack(gaussians) + STEP, atol=1e-6)
    assert sum(sizes) == 101
    assert max(sizes) <= points
    assert max(sizes) - min(sizes) <= 1
    assert ticks[-1] == (len(sizes), len(sizes))


def test_no_more_views_go_in_than_the_model_is_made_for(folder):
    gaussians, cameras, images = scene(views=9)
    model, shapes = runtime.Model.open(folder), []
    run = model._run
    model._run = lambda graph, feed: shapes.append(feed.get("images", images).shape) or run(graph, feed)
    model.improve(gaussians, cameras, images)
    assert shapes[0] == (TINY.image.views, 4, TINY.image.size, TINY.image.size)


def test_the_number_of_threads_reaches_onnxruntime(folder):
    for threads in (1, 2):
        sessions = runtime.Model.open(folder, threads).sessions
        assert {s.get_session_options().intra_op_num_threads for s in sessions.values()} == {threads}


def test_output_that_is_not_finite_is_an_error(tmp_path):
    gaussians, cameras, images = scene()
    model = runtime.Model.open(write_model(tmp_path / "nan", [np.nan] * 14))
    refused(DataError, "not finite", model.improve, gaussians, cameras, images)


def _edit_card(folder: Path, **changes):
    (folder / CARD).write_text(json.dumps({**json.loads((folder / CARD).read_text()), **changes}))


def _truncate(folder):
    path = folder / "geometry.onnx"
    path.write_bytes(path.read_bytes()[:-10])


def _damage(folder):
    content = bytearray((folder / "image.onnx").read_bytes())
    content[len(content) // 2] ^= 255
    (folder / "image.onnx").write_bytes(content)


def _other_input(folder):
    geometry_graph(folder / "geometry.onnx", STEP, extra="normals")
    write_card(folder)


def _config(folder, side, **changes):
    card = json.loads((folder / CARD).read_text())
    card["config"][side] |= changes
    (folder / CARD).write_text(json.dumps(card))


def _outside(folder):
    card = json.loads((folder / CARD).read_text())
    card["graphs"]["image"]["file"] = "../image.onnx"
    (folder / CARD).write_text(json.dumps(card))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "image.onnx").unlink(), "image.onnx: no such file"),
        (_truncate, "truncated"),
        (_damage, "sha256"),
        (_other_input, "needs normals"),
        (_outside, "no such file"),
        (lambda f: _config(f, "image", heads=0), "heads"),
        (lambda f: _config(f, "geometry", window=10**9), "window 1000000000"),
        (lambda f: (f / CARD).write_text("{"), "not a model card"),
        (lambda f: _edit_card(f, schema=99), "schema 99"),
        (lambda f: _edit_card(f, colour="red"), "colour"),
    ],
)
def test_a_model_that_is_not_one_gets_one_clear_line(folder, spoil, message):
    spoil(folder)
    refused(DataError, message, runtime.Model.open, folder)


def test_models_are_found_by_folder_or_name(folder, monkeypatch):
    assert find_model(str(folder)) == folder
    monkeypatch.setattr("vvgt_cli.network.card.MODELS", folder.parent)
    assert find_model("adds") == folder
    assert read_card(find_model("adds")).network == TINY
    refused(UsageError, "shipped are adds", find_model, "subtracts")
    refused(UsageError, r"no card.json", find_model, str(folder.parent))


def test_a_provider_that_is_not_there_is_named(folder, monkeypatch):
    import onnxruntime

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    refused(UsageError, "--provider cuda", runtime.Model.open, folder, provider="cuda")


def test_running_a_model_imports_no_torch(folder):
    code = f"""
import sys
sys.modules["torch"] = None  # importing it would raise
from pathlib import Path
from tests.network_models import scene
from vvgt_cli.network.runtime import Model
print(len(Model.open(Path({str(folder)!r})).improve(*scene())))
assert not any(name.split(".")[0] in ("torch", "onnx", "onnxscript") for name in sys.modules if sys.modules[name])
"""
    assert python("-c", code)[0].strip() == "60"
