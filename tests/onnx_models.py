"""Models in the form of `vvgt export`, built by hand: what they compute is known, and no torch is needed."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnx
from network_models import TINY
from onnx import TensorProto, helper, numpy_helper

from vvgt_cli.network.card import CARD, MAPS, OUTPUT, ModelCard, graph_record

FLOAT = TensorProto.FLOAT


def _value(name, shape):
    return helper.make_tensor_value_info(name, FLOAT, shape)


def _save(path: Path, nodes, inputs, outputs, weights):
    graph = helper.make_graph(
        nodes, path.stem, inputs, outputs, [numpy_helper.from_array(np.array(v), k) for k, v in weights.items()]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())


def image_graph(path: Path):
    """Every map is the mean of its view's image and of its pose, in one pixel."""
    nodes = [
        helper.make_node("ReduceMean", ["images", "image_axes"], ["brightness"], keepdims=1),  # (n, 1, 1, 1)
        helper.make_node("ReduceMean", ["poses", "pose_axes"], ["pose"], keepdims=1),  # (n, 1)
        helper.make_node("Reshape", ["pose", "shape"], ["pose4"]),
        helper.make_node("Add", ["brightness", "pose4"], [MAPS[0]]),
        *(helper.make_node("Identity", [MAPS[0]], [name]) for name in MAPS[1:]),
    ]
    weights = {
        "image_axes": np.array([1, 2, 3]), "pose_axes": np.array([1]), "shape": np.array([-1, 1, 1, 1])
    }  # fmt: skip
    inputs = [_value("images", ["n", 4, 28, 28]), _value("poses", ["n", 9])]
    _save(path, nodes, inputs, [_value(name, ["n", 1, 1, 1]) for name in MAPS], weights)


def geometry_graph(path: Path, step, *, output=OUTPUT, extra: str | None = None):
    """Gaussians plus ``step`` (14,), plus nought times the maps, so that these are asked for."""
    nodes = [
        helper.make_node("ReduceSum", [MAPS[0]], ["total"], keepdims=0),
        helper.make_node("Mul", ["total", "zero"], ["nothing"]),
        helper.make_node("Add", ["gaussians", "step"], ["moved"]),
        helper.make_node("Add", ["moved", "nothing"], [output if extra is None else "sum"]),
    ]
    inputs = [_value("gaussians", ["k", 14]), _value(MAPS[0], ["n", 1, 1, 1])]
    if extra is not None:
        nodes.append(helper.make_node("Add", ["sum", extra], [output]))
        inputs.append(_value(extra, [1]))
    weights = {"step": np.asarray(step, np.float32), "zero": np.float32(0)}
    _save(path, nodes, inputs, [_value(output, ["k", 14])], weights)


def names(path: Path):
    graph = onnx.load(path).graph
    return [entry.name for entry in graph.input], [entry.name for entry in graph.output]


def write_card(folder: Path, config=TINY):
    graphs = {
        name: graph_record(folder / f"{name}.onnx", *names(folder / f"{name}.onnx")) for name in ("image", "geometry")
    }
    card = ModelCard(folder.name, asdict(config), 0, {}, "unknown", {}, 20, "float32", 0.0, graphs)
    (folder / CARD).write_text(card.to_json(), "utf-8")


def write_model(folder: Path, step=(0.0,) * 14, **options) -> Path:
    """A model that adds ``step`` to every Gaussian."""
    folder.mkdir(exist_ok=True)
    image_graph(folder / "image.onnx")
    geometry_graph(folder / "geometry.onnx", step, **options)
    write_card(folder)
    return folder
