"""`vvgt export`: one real export of a tiny network, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from network_models import FED, TINY, as_rows, scene

from tests.refused import refused
from vvgt_cli.commands.main import run
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.network.prepare import prepare
from vvgt_cli.network.runtime import Model

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")

from vvgt_cli.network import export as ex  # noqa: E402
from vvgt_cli.network.checkpoint import NetworkCheckpoint, load_checkpoint, save_checkpoint  # noqa: E402
from vvgt_cli.network.model import Vvgt  # noqa: E402


def fresh(config=FED):
    torch.manual_seed(0)
    return Vvgt(config).eval()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A checkpoint with weights everywhere, and its model, exported by the command; to be read only."""
    folder = tmp_path_factory.mktemp("export")
    trained = NetworkCheckpoint(ex.randomised(fresh()), {"volumes": 3}, {"gain": 1.5}, "abc123")
    save_checkpoint(folder / "tiny.pt", trained)
    assert run(["export", str(folder / "tiny.pt"), "-o", str(folder / "tiny"), "--quiet"]) == 0
    return folder


@pytest.fixture
def traced(made, monkeypatch):
    """Exports of the made network without tracing it again; the networks that were asked for."""
    asked = []
    protos = {name: onnx.load(made / "tiny" / f"{name}.onnx") for name in ("image", "geometry")}
    monkeypatch.setattr(ex, "trace", lambda network: asked.append(network) or protos)
    return asked


@pytest.mark.parametrize(("count", "views"), [(1, 1), (2, 1), (9, 2), (333, 3)])
def test_onnxruntime_agrees_with_torch_at_any_size(made, count, views):
    gaussians, cameras, images = scene(count, views, seed=count)
    network = load_checkpoint(made / "tiny.pt").network
    prepared = prepare(gaussians, cameras, images, FED)
    with torch.inference_mode():
        tensors = {name: torch.from_numpy(np.array(array)) for name, array in prepared.arrays().items()}
        expected = network(tensors).numpy()
    found = Model.open(made / "tiny").run_rows(prepared)
    assert np.allclose(found, expected, rtol=1e-4, atol=2e-6)
    assert np.abs(expected - prepared.rows).max() > 0.01
    improved = Model.open(made / "tiny").improve(gaussians, cameras, images)
    assert np.array_equal(as_rows(improved), as_rows(prepared.restore(found)))


def test_the_card_says_what_the_model_is(made):
    card = Model.open(made / "tiny").card
    assert (card.name, card.opset, card.storage) == ("tiny", 20, "float32")
    assert (card.training, card.metrics, card.commit) == ({"volumes": 3}, {"gain": 1.5}, "abc123")
    assert card.network == FED
    assert card.parameters == sum(parameter.numel() for parameter in fresh().parameters())
    assert 0 < card.difference <= 1e-4
    assert {"gaussians", "gradients", "maps_2", "positions"} <= set(card.graphs["geometry"]["inputs"])
    assert sorted(path.name for path in made.iterdir()) == ["tiny", "tiny.pt"]
    text = (made / "tiny" / "geometry.onnx").read_bytes()
    assert b".py" not in text  # no source lines of the machine that exported


def test_float16_storage_halves_the_weights(made, traced):
    card = ex.export_model(made / "tiny.pt", made.parent / "half", "float16", overwrite=True)
    assert 1e-7 < card.difference <= 1e-2
    types = [w.data_type for w in onnx.load(made.parent / "half" / "image.onnx").graph.initializer if len(w.dims) > 1]
    assert types.count(onnx.TensorProto.FLOAT16) > 10
    assert onnx.TensorProto.FLOAT not in types


def test_a_head_that_is_zero_is_not_compared_as_it_is(made, traced, tmp_path):
    save_checkpoint(tmp_path / "zero.pt", NetworkCheckpoint(fresh()))
    card = ex.export_model(tmp_path / "zero.pt", tmp_path / "zero")
    heads = [network.geometry.head.last.weight.abs().max() > 0 for network in traced]
    assert heads == [True, False]
    assert card.difference > 0
    refused(DataError, "returns its input", ex.difference, fresh(), Model.open(made / "tiny"))


def test_a_model_is_replaced_only_when_told_and_nothing_else_ever(made, traced, tmp_path):
    ex.export_model(made / "tiny.pt", tmp_path / "a")
    refused(UsageError, "--overwrite", ex.export_model, made / "tiny.pt", tmp_path / "a")
    ex.export_model(made / "tiny.pt", tmp_path / "a", overwrite=True)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years")
    refused(UsageError, "not a model", ex.export_model, made / "tiny.pt", tmp_path / "mine", overwrite=True)
    refused(UsageError, "make it first", ex.export_model, made / "tiny.pt", tmp_path / "no" / "b")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "mine"]


class _Pickled:
    def __reduce__(self):
        return print, ("code ran",)


def _document():
    return NetworkCheckpoint(fresh(TINY)).to_dict()


def _changed(document, **changes):
    return {**document, **changes}


def _other_state(change):
    document = _document()
    change(document["state"])
    return document


BROKEN = {
    "code": (lambda: {"format": "vvgt-checkpoint", "state": _Pickled()}, "not a checkpoint"),
    "schema": (lambda: _changed(_document(), schema=9), "schema 9"),
    "lost key": (lambda: {k: v for k, v in _document().items() if k != "state"}, "lacks 'state'"),
    "missing": (lambda: _other_state(lambda s: s.pop("geometry.head.norm.weight")), "1 weights missing"),
    "no 3D side": (lambda: NetworkCheckpoint(fresh(replace(TINY, variant="wo_3dt"))).to_dict(), "wo_3dt"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_checkpoint_that_is_not_one_gets_one_line(case, tmp_path, vvgt):
    make, message = BROKEN[case]
    torch.save(make(), tmp_path / "c.pt")
    result = vvgt("export", tmp_path / "c.pt", "-o", tmp_path / "m")
    assert result.code == 1, result.err
    assert message in result.error
    assert "internal" not in result.error
    assert b"code ran" not in result.out
    assert [path.name for path in tmp_path.iterdir()] == ["c.pt"]


def test_a_file_that_is_missing_or_truncated(made, tmp_path, vvgt):
    assert "no such file" in vvgt("export", tmp_path / "no.pt", "-o", tmp_path / "m").error
    (tmp_path / "cut.pt").write_bytes((made / "tiny.pt").read_bytes()[:2000])
    assert "damaged" in vvgt("export", tmp_path / "cut.pt", "-o", tmp_path / "m").error
