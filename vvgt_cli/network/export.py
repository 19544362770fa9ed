"""Export to ONNX: two graphs and a card, compared with torch before an existing model is replaced."""

from __future__ import annotations

import contextlib
import copy
import io
import logging
import secrets
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from vvgt_cli.cameras import default_views
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.network.card import CARD, IMAGE_INPUTS, MAPS, OUTPUT, ModelCard, graph_record
from vvgt_cli.network.checkpoint import load_checkpoint, tensors_of
from vvgt_cli.network.config import NetworkConfig
from vvgt_cli.network.model import GeometrySide, ImageSide, Vvgt
from vvgt_cli.network.prepare import Prepared, prepare
from vvgt_cli.network.runtime import Model

OPSET = 20  # the first with Gelu
LIMITS = {"float32": 1e-4, "float16": 1e-2}  # of `difference`; float16's weights carry 11 bits
TRACED = (600, 2)  # Gaussians and views of the traced example: no axis that varies may have length 1
CHECKED = ((700, 3), (5, 1))  # of the scenes that onnxruntime and torch are compared on


class _Images(nn.Module):
    def __init__(self, side: ImageSide) -> None:
        super().__init__()
        self.side = side

    def forward(self, images: Tensor, poses: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.side(images, poses))


class _Geometry(nn.Module):
    """Geometry side with all tensors in one mapping, in the order of the graph's inputs."""

    def __init__(self, side: GeometrySide) -> None:
        super().__init__()
        self.side = side

    def forward(self, tensors: Mapping[str, Tensor]) -> Tensor:
        views = None
        if "matrices" in tensors:
            views = tensors["matrices"], tensors["eyes"], [tensors[name] for name in MAPS]
        return self.side(tensors["gaussians"], tensors, views, tensors.get("gradients"))


def random_scene(config: NetworkConfig, count: int, views: int, seed: int = 0) -> Prepared:
    """Return random input for tracing and comparing."""
    rng = np.random.default_rng(seed)
    gaussians = Gaussians(
        rng.uniform(-1, 1, (count, 3)), rng.normal(-4, 0.5, (count, 3)), rng.normal(size=(count, 4)),
        rng.normal(size=count), rng.random((count, 3)),
    )  # fmt: skip
    images = rng.random((views, 32, 32, 4), dtype=np.float32)
    return prepare(gaussians, default_views("train", views, size=32), images, config)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporter, which prints its steps and warns of its own internals; errors still raise."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        try:
            yield
        finally:
            logger.setLevel(level)


def trace(network: Vvgt) -> dict[str, Any]:
    """Return ONNX models by "image" and "geometry", with variable numbers of views, Gaussians and points."""
    assert network.geometry is not None
    config = network.config
    # small windows: at least two of them at every stage of so few points
    small = replace(config, geometry=replace(config.geometry, window=2))
    scene = random_scene(small, *TRACED)
    views, tensors = tensors_of(scene.views), tensors_of(scene.part())
    traced: dict[str, Any] = {}
    if network.image is not None:
        images = tuple(views.pop(name) for name in IMAGE_INPUTS)
        with torch.inference_mode():
            maps = network.image(*images)
        tensors |= views | {name: maps[i].clone() for i, name in enumerate(MAPS)}
        axes: Any = [{0: torch.export.Dim.DYNAMIC}] * len(images)
        traced["image"] = _exported(_Images(network.image), images, {}, tuple(axes), IMAGE_INPUTS, MAPS)
    tensors = dict(sorted(tensors.items()))
    # other axes are the network's own
    axes = {n: dict.fromkeys(range(1 + n.startswith("windows")), torch.export.Dim.DYNAMIC) for n in tensors}
    geometry = _Geometry(network.geometry)
    traced["geometry"] = _exported(geometry, (), {"tensors": tensors}, {"tensors": axes}, list(tensors), [OUTPUT])
    return traced


def _exported(
    module: nn.Module,
    args: tuple[Tensor, ...],
    kwargs: dict[str, Any],
    shapes: Any,
    inputs: list[str],
    outputs: list[str],
) -> Any:
    with _quiet(), torch.inference_mode():
        program = torch.onnx.export(
            module.eval(), args, kwargs=kwargs, dynamo=True, opset_version=OPSET, input_names=inputs,
            output_names=outputs, dynamic_shapes=shapes, verbose=False, optimize=False,
        )  # fmt: skip
    assert program is not None
    proto = program.model_proto
    del proto.graph.value_info[:]
    for node in proto.graph.node:  # the exporter notes the source line of each: as large as the weights
        del node.metadata_props[:]
        node.ClearField("doc_string")
    return proto


def with_float16_weights(proto: Any) -> Any:
    """Return a copy with float32 weights stored as float16, each with a Cast that loading folds away."""
    import onnx

    proto = copy.deepcopy(proto)
    casts = []
    for weight in proto.graph.initializer:
        if weight.data_type != onnx.TensorProto.FLOAT or len(weight.dims) < 2:
            continue  # biases and norms are few
        values = onnx.numpy_helper.to_array(weight).astype(np.float16)
        name = weight.name
        weight.CopyFrom(onnx.numpy_helper.from_array(values, f"{name}.half"))
        casts.append(onnx.helper.make_node("Cast", [f"{name}.half"], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *proto.graph.node]
    del proto.graph.node[:]
    proto.graph.node.extend(nodes)
    return proto


def randomised(network: Vvgt) -> Vvgt:
    """Return a copy in which nothing is zero: weights as large as trained ones everywhere."""
    network = copy.deepcopy(network)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=generator)
    return network


def difference(network: Vvgt, model: Model) -> float:
    """Return the largest deviation of onnxruntime from torch, relative to each field's largest value.

    Raises:
        DataError: the network returns its input, so nothing would be compared.
    """
    worst = 0.0
    for seed, (count, views) in enumerate(CHECKED, 1):
        scene = random_scene(network.config, count, views, seed)
        with torch.inference_mode():
            expected = network(tensors_of(scene.arrays())).numpy()
        if np.allclose(expected, scene.rows, atol=1e-5):
            raise DataError("the network's head is zero: it returns its input and cannot be compared")
        fields = model.run_rows(scene)
        largest = np.abs(expected).max(axis=0)  # (14,)
        worst = max(worst, float((np.abs(fields - expected).max(axis=0) / np.maximum(largest, 1e-6)).max()))
    return worst


def write_model(folder: Path, protos: Mapping[str, Any], card: ModelCard, storage: str) -> None:
    """Write graphs and card into a folder."""
    for name, proto in protos.items():
        path = folder / f"{name}.onnx"
        path.write_bytes((with_float16_weights(proto) if storage == "float16" else proto).SerializeToString())
        inputs, outputs = ([entry.name for entry in side] for side in (proto.graph.input, proto.graph.output))
        card.graphs[name] = graph_record(path, inputs, outputs)
    (folder / CARD).write_text(card.to_json(), "utf-8")


def check_folder(target: Path, overwrite: bool) -> None:
    """Raise UsageError for an existing folder that may not be replaced, or one whose parent does not exist."""
    if not target.parent.is_dir():
        raise UsageError(f"-o {target}: the folder {target.parent} does not exist; make it first")
    if not target.exists():
        return
    if not overwrite:
        raise UsageError(f"-o {target} exists; give --overwrite to replace the model, or another name")
    strange = sorted(path.name for path in target.iterdir()) if target.is_dir() else [target.name]
    if not target.is_dir() or not set(strange) <= {CARD, "image.onnx", "geometry.onnx"}:
        raise UsageError(f"-o {target}: is not a model that 'vvgt export' wrote; choose another name")


def replace_folder(place: Path, target: Path) -> None:
    """Move a finished folder to its place; an existing one is deleted after that."""
    old = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    if target.exists():
        target.rename(old)
    place.rename(target)
    shutil.rmtree(old, ignore_errors=True)


def export_model(
    checkpoint: str | Path, folder: str | Path, storage: str = "float32", overwrite: bool = False
) -> ModelCard:
    """Export a checkpoint to a folder of two ONNX graphs and a card.

    The comparison with torch means nothing for a head that is still zero; a copy with random weights is compared
    instead.

    Args:
        checkpoint: file that training wrote.
        folder: to create; its name is the model's.
        storage: of the weights, "float32" or "float16".
        overwrite: replace an existing model.

    Raises:
        UsageError: the folder exists.
        DataError: not a checkpoint, an ablation without a 3D side, or graphs that differ from torch by more than
            `LIMITS`.
    """
    target = Path(folder)
    check_folder(target, overwrite)
    loaded = load_checkpoint(checkpoint)
    network = loaded.network
    if network.geometry is None:
        variant = network.config.variant
        raise DataError(
            f"{checkpoint}: variant {variant} has no 3D side to refine Gaussians with; it runs in torch only"
        )
    card = ModelCard(
        target.name, asdict(network.config), sum(p.numel() for p in network.parameters()), loaded.training,
        loaded.commit, loaded.metrics, OPSET, storage, 0.0,
    )  # fmt: skip
    moves = any(parameter.any() for parameter in network.geometry.head.last.parameters())
    tried = network if moves else randomised(network)
    with tempfile.TemporaryDirectory(prefix=f".{target.name[:80]}.", dir=target.parent) as scratch:
        place = Path(scratch) / "model"
        place.mkdir()
        protos = trace(tried)
        for kind in dict.fromkeys(("float32", storage)):  # float16 is compared after what it is made of
            write_model(place, protos, card, kind)
            card.difference = difference(tried, Model.open(place))
            if not card.difference <= LIMITS[kind]:
                raise DataError(
                    f"{checkpoint}: onnxruntime differs from torch by {card.difference:.1e} of a field's largest value "
                    f"({kind} weights); expected at most {LIMITS[kind]:.0e}"
                )
        write_model(place, protos if moves else trace(network), card, storage)
        replace_folder(place, target)
    return card
