"""Model cards: description of an exported model, with the digests of its files."""

from __future__ import annotations

import hashlib
import json
import sysconfig
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import read_text
from vvgt_cli.network.config import SCALES, NetworkConfig
from vvgt_cli.version import VERSION

FORMAT, SCHEMA = "vvgt-model", 1  # the schema is raised when a graph's input or output changes its meaning
CARD = "card.json"
SHIPPED = "vvgt-small"  # the model that comes with the program
MODELS = Path(__file__).parents[2] / "models"  # of a checkout
INSTALLED = "share/vvgt/models"  # below where pip puts a wheel's data
MAPS = [f"maps_{scale}" for scale in range(SCALES)]
IMAGE_INPUTS = ["images", "poses"]
OUTPUT = "gaussians_out"


@dataclass
class ModelCard:
    """A model's card, `card.json` in its folder.

    Attributes:
        name: of the folder.
        config: of the network, `NetworkConfig` as a dictionary.
        parameters: number of learned values.
        training: data and settings of the training; from the checkpoint.
        commit: of the program that trained it.
        metrics: its measured gain; from the checkpoint.
        opset: of ONNX.
        storage: "float32" or "float16", of the weights; arithmetic is float32.
        difference: largest deviation of onnxruntime from torch, from `vvgt_cli.network.export.difference`.
        graphs: by "image" and "geometry": file, bytes, sha256, inputs, outputs.
        version: of the program that exported it.
    """

    name: str
    config: dict[str, Any]
    parameters: int
    training: dict[str, Any]
    commit: str
    metrics: dict[str, Any]
    opset: int
    storage: str
    difference: float
    graphs: dict[str, dict[str, Any]] = field(default_factory=dict)
    version: str = VERSION

    def to_json(self) -> str:
        """Return the card's text."""
        return json.dumps({"format": FORMAT, "schema": SCHEMA, **asdict(self)}, indent=2, allow_nan=False) + "\n"

    @property
    def network(self) -> NetworkConfig:
        """Return the checked configuration."""
        return NetworkConfig.from_dict(self.config)


def graph_record(path: Path, inputs: list[str], outputs: list[str]) -> dict[str, Any]:
    """Return a graph's entry in the card."""
    content = path.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    return {"file": path.name, "bytes": len(content), "sha256": digest, "inputs": inputs, "outputs": outputs}


def find_model(name: str) -> Path:
    """Return the folder of a model, a path or the name of a shipped one, or raise UsageError."""
    places = [MODELS, Path(sysconfig.get_path("data")) / INSTALLED]
    for folder in (Path(name), *(place / name for place in places)):
        if (folder / CARD).is_file():
            return folder
    if Path(name).is_dir():
        raise UsageError(f"model {name}: the folder has no {CARD}; expected one that 'vvgt export' wrote")
    shipped = sorted({path.parent.name for place in places for path in place.glob(f"*/{CARD}")})
    known = f"; shipped are {', '.join(shipped)}" if shipped else "; none is shipped with this version"
    raise UsageError(f"model {name}: no such folder{known}; expected a folder that 'vvgt export' wrote")


def read_card(folder: Path) -> ModelCard:
    """Read a card and check the graphs beside it; raise DataError for another schema, or a graph that differs."""
    path = folder / CARD
    try:
        document = json.loads(read_text(path))
        kind, schema = document.pop("format"), document.pop("schema")
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise DataError(f"{path}: not a model card ({error}); expected one that 'vvgt export' wrote") from None
    if kind != FORMAT or schema != SCHEMA:
        raise DataError(
            f"{path}: {kind} of schema {schema}, written by version {document.get('version')}; this is version "
            f"{VERSION} and reads {FORMAT} of schema {SCHEMA}: export the checkpoint again"
        )
    try:
        card = ModelCard(**document)
        wanted = {"geometry", "image"} if card.network.has_images else {"geometry"}
        if set(card.graphs) != wanted:
            raise ValueError(f"graphs {sorted(card.graphs)}, expected {sorted(wanted)}")
        for record in card.graphs.values():
            for side in ("inputs", "outputs"):
                if not isinstance(record[side], list) or not all(isinstance(name, str) for name in record[side]):
                    raise ValueError(f"{side} {record[side]!r}, expected names")
            check_graph(folder, record)
    except (TypeError, KeyError, ValueError) as error:
        raise DataError(f"{path}: {error}; export the checkpoint again") from None
    return card


def check_graph(folder: Path, record: dict[str, Any]) -> None:
    """Check that a graph's file exists, complete and as exported; raise DataError otherwise."""
    path = folder / str(record["file"])
    if path.parent != folder or not path.is_file():
        raise DataError(f"{path}: no such file, but the model's card names it; fetch or export the model again")
    size = path.stat().st_size
    if size != record["bytes"]:
        raise DataError(f"{path}: {size} bytes, its card says {record['bytes']}: truncated or replaced; fetch it again")
    with path.open("rb") as file:
        if hashlib.file_digest(file, "sha256").hexdigest() != record["sha256"]:
            raise DataError(f"{path}: its content is not what its card says (sha256); fetch or export the model again")
