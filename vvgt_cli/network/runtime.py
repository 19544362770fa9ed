"""Running an exported model with onnxruntime: no torch, bounded memory (docs/network.md, "Running it")."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.cameras import Camera, farthest_cameras
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import INRIA, Gaussians, Rule
from vvgt_cli.network import tables
from vvgt_cli.network.card import IMAGE_INPUTS, MAPS, OUTPUT, ModelCard, read_card
from vvgt_cli.network.config import NetworkConfig
from vvgt_cli.network.prepare import Prepared, prepare
from vvgt_cli.progress import ProgressCallback, counted

PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}
_AGAIN = "export the checkpoint again"
POINTS = 160_000  # Gaussians of one run of the second graph: the paper's 150,000 go at once


def views_of_round(views: Sequence[int], number: int, rounds: int) -> list[int]:
    """Return the views of round ``number``: every ``rounds``-th, or all if there are fewer than rounds."""
    return list(views[number::rounds]) if len(views) >= rounds else list(views)


@dataclass
class Model:
    """An exported model, ready to run.

    Attributes:
        card: its description.
        sessions: onnxruntime's, by "image" and "geometry".
    """

    card: ModelCard
    sessions: dict[str, Any]

    @classmethod
    def open(cls, folder: Path, threads: int = 0, provider: str = "cpu") -> Model:
        """Load a model and check its files, names and axes.

        Args:
            folder: with card and graphs, from `vvgt_cli.network.card.find_model`.
            threads: of the CPU provider; 0 for onnxruntime's own choice.
            provider: one of `PROVIDERS`.

        Raises:
            UsageError: a provider that this onnxruntime does not have.
            DataError: files that are missing, damaged, of another version, or graphs with other inputs.
        """
        import onnxruntime

        have = onnxruntime.get_available_providers()
        if PROVIDERS[provider] not in have:
            raise UsageError(
                f"--provider {provider}: this onnxruntime has {', '.join(have)}; install onnxruntime-gpu, or use cpu"
            )
        card = read_card(folder)
        sessions = {}
        for name, record in card.graphs.items():
            sessions[name] = _session(folder / record["file"], threads, provider)
            _check_names(folder / record["file"], sessions[name], record, card.network)
        return cls(card, sessions)

    def improve(
        self,
        gaussians: Gaussians,
        cameras: Sequence[Camera],
        images: np.ndarray,
        points: int = POINTS,
        progress: ProgressCallback | None = None,
        rule: Rule = INRIA,
    ) -> Gaussians:
        """Return the network's Gaussians, in the given order.

        If there are more views than the model is made for, each round reads another subset (`farthest_cameras`). More
        Gaussians than ``points`` are divided along the Z-order into equal parts, each treated as a scene of its own.

        Args:
            gaussians: start, unit frame.
            cameras: of the views.
            images: (n, h, w, 4) float32 premultiplied.
            points: largest number in one part.
            progress: called after each part.
            rule: by which the views are drawn.

        Raises:
            DataError: no Gaussians, no views, or output that is not finite.
        """
        config = self.card.network
        few = farthest_cameras(cameras, config.total_views)
        for number in range(config.rounds):
            shown = views_of_round(few, number, config.rounds)
            scene = prepare(gaussians, [cameras[i] for i in shown], images[shown], config, rule)
            rows = self.run_rows(scene, points, progress)
            if not np.isfinite(rows).all():
                raise DataError(f"model {self.card.name}: its output for these Gaussians is not finite")
            gaussians = scene.accept(rows, [cameras[i] for i in shown], images[shown], rule)
        return gaussians

    def run_rows(self, scene: Prepared, points: int = POINTS, progress: ProgressCallback | None = None) -> np.ndarray:
        """Run both graphs on a prepared scene; return rows (K, 14) in its order."""
        views = dict(scene.views)
        if "image" in self.sessions:
            maps = self._run("image", {name: views.pop(name) for name in ("images", "poses")})
            views |= dict(zip(MAPS, maps, strict=True))
        count = len(scene.rows)
        parts = math.ceil(count / points)
        edges = [count * i // parts for i in range(parts + 1)]
        out = np.empty_like(scene.rows)
        for start, stop in counted(list(pairwise(edges)), progress):
            out[start:stop] = self._run("geometry", views | scene.part(start, stop))[0]
        return out

    def _run(self, graph: str, feed: dict[str, np.ndarray]) -> list[np.ndarray]:
        session = self.sessions[graph]
        try:
            return session.run(None, {entry.name: feed[entry.name] for entry in session.get_inputs()})
        except Exception as error:  # onnxruntime raises classes of its own C++ module
            reason = " ".join(str(error).split())[:200]
            raise DataError(f"model {self.card.name}: the {graph} graph failed ({reason})") from None


def _session(path: Path, threads: int, provider: str) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.enable_cpu_mem_arena = False  # the arena doubles as it grows and keeps what it has: twice the peak
    options.log_severity_level = 4  # errors come as exceptions
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # waiting threads would burn a core each
    try:
        session = onnxruntime.InferenceSession(str(path), options, [PROVIDERS[provider]])
    except Exception as error:  # onnxruntime raises classes of its own C++ module
        reason = " ".join(str(error).split())[:200]
        raise DataError(f"{path}: onnxruntime cannot load it ({reason}); fetch or export the model again") from None
    if session.get_providers()[0] != PROVIDERS[provider]:
        raise DataError(f"--provider {provider}: onnxruntime fell back to the CPU; check the driver, or use cpu")
    return session


def _check_names(path: Path, session: Any, record: dict[str, Any], config: NetworkConfig) -> None:
    """Raise DataError unless a graph's names match the card, and this version knows its inputs and outputs."""
    image = path.stem == "image"
    made = {*IMAGE_INPUTS} if image else {"gaussians", "gradients", "matrices", "eyes", *MAPS}
    if not image:
        made |= set(tables.build(np.zeros((1, 3), np.float32), config.geometry))
    names = [entry.name for entry in session.get_inputs()], [entry.name for entry in session.get_outputs()]
    for side, has, expected in zip(("inputs", "outputs"), names, (record["inputs"], record["outputs"]), strict=True):
        if has != expected:
            raise DataError(f"{path}: {side} {', '.join(has)}; its card says {', '.join(expected)}: {_AGAIN}")
    if unknown := set(names[0]) - made:
        raise DataError(f"{path}: needs {', '.join(sorted(unknown))}, which this version does not provide: {_AGAIN}")
    if names[1] != (MAPS if image else [OUTPUT]):
        raise DataError(
            f"{path}: gives {', '.join(names[1])}; expected {', '.join(MAPS if image else [OUTPUT])}: {_AGAIN}"
        )
