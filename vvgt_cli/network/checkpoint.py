"""Checkpoints: a network's configuration and weights in one file, loaded without running code from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vvgt_cli.errors import DataError
from vvgt_cli.network.config import NetworkConfig
from vvgt_cli.network.model import Vvgt

FORMAT, SCHEMA = "vvgt-checkpoint", 1


@dataclass
class NetworkCheckpoint:
    """A trained network.

    Attributes:
        network: with its weights.
        training: data and settings of the training, plain values.
        metrics: measured gain, plain values.
        commit: of the program that trained it.
    """

    network: Vvgt
    training: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    commit: str = "unknown"

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the file."""
        return {
            "format": FORMAT,
            "schema": SCHEMA,
            "config": asdict(self.network.config),
            "state": self.network.state_dict(),
            "training": self.training,
            "metrics": self.metrics,
            "commit": self.commit,
        }


def save_checkpoint(path: str | Path, checkpoint: NetworkCheckpoint, more: dict[str, Any] | None = None) -> None:
    """Write a checkpoint to ``path`` (`vvgt_cli.files.atomic_write` makes that atomic).

    ``more`` is the trainer's own state: tensors and plain values.
    """
    torch.save(checkpoint.to_dict() | (more or {}), path)


def load_checkpoint(path: str | Path) -> NetworkCheckpoint:
    """Read a checkpoint: tensors and plain values only; no pickled code is run.

    Raises:
        DataError: not a checkpoint, another schema, or weights that do not fit the configuration.
    """
    document = read_tensors(path)
    if document.get("format") != FORMAT:
        raise DataError(f"{path}: not a checkpoint of this program; expected one that training wrote")
    if document.get("schema") != SCHEMA:
        raise DataError(f"{path}: checkpoint of schema {document.get('schema')}; this version reads schema {SCHEMA}")
    try:
        network = Vvgt(NetworkConfig.from_dict(document["config"]))
        load_weights(network, document["state"], str(path))
        return NetworkCheckpoint(network.eval(), document["training"], document["metrics"], str(document["commit"]))
    except KeyError as error:
        raise DataError(f"{path}: checkpoint lacks {error}; it is incomplete") from None


def read_tensors(path: str | Path) -> dict[str, Any]:
    """Return the content of a torch file, tensors and plain values only; no code in it is run.

    Raises:
        DataError: no such file, not one of torch's, damaged, or not a mapping.
    """
    if not Path(path).is_file():
        raise DataError(f"{path}: no such file; expected a file that torch saved")
    try:
        document = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises its own, pickle's, zipfile's and more
        reason = str(error).splitlines()[0][:120]
        raise DataError(f"{path}: not a checkpoint of tensors, or damaged ({type(error).__name__}: {reason})") from None
    if not isinstance(document, dict):
        raise DataError(f"{path}: holds a {type(document).__name__}; expected a checkpoint")
    return document


def tensors_of(arrays: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    """Return arrays, as of `vvgt_cli.network.prepare.Prepared.arrays`, as tensors."""
    return {name: torch.from_numpy(np.array(array)) for name, array in arrays.items()}


def load_weights(module: torch.nn.Module, state: dict[str, Tensor], name: str) -> None:
    """Load weights; raise DataError for names or shapes other than the module's, or values that are not finite."""
    own = module.state_dict()
    missing, unknown = sorted(set(own) - set(state)), sorted(set(state) - set(own))
    if missing or unknown:
        shown = ", ".join([*(f"no {key}" for key in missing[:2]), *(f"unknown {key}" for key in unknown[:2])])
        raise DataError(
            f"{name}: {len(missing)} weights missing, {len(unknown)} unknown ({shown}); expected {len(own)} weights"
        )
    for key, value in state.items():
        if value.shape != own[key].shape:
            raise DataError(f"{name}: {key} is {tuple(value.shape)}; expected {tuple(own[key].shape)}")
        if not torch.isfinite(value).all():
            raise DataError(f"{name}: {key} is not finite; the training that wrote it had failed")
    module.load_state_dict(state)
