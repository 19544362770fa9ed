"""Training loop: AdamW along a cosine; checkpoints that resume with the same bits; processes; records of a run."""

from __future__ import annotations

import csv
import json
import math
import os
import signal
import subprocess
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, distributed, nn

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians.outputs import check_folder, write_text
from vvgt_cli.network.checkpoint import NetworkCheckpoint, load_weights, read_tensors, save_checkpoint
from vvgt_cli.network.model import Vvgt
from vvgt_cli.network.training.config import TrainConfig, config_text, read_config
from vvgt_cli.network.training.lpips import Lpips, load_lpips
from vvgt_cli.network.training.sample import Feeder, accumulate_gradients, score_scene
from vvgt_cli.network.training.scenes import TrainingScene, make_scenes, prepare_scenes
from vvgt_cli.progress import Console

LAST, BEST, CONFIG = "last.pt", "best.pt", "config.yaml"
Scenes = dict[str, list[TrainingScene]]


@dataclass
class TrainingProgress:
    """State of a run beside weights and optimiser, saved with them.

    Attributes:
        step: steps done.
        skipped: steps without an update because something was not finite.
        best: largest mean gain on held-out scenes so far, dB.
        seconds: of training, over all resumptions.
        scores: latest scores of the held-out scenes.
    """

    step: int = 0
    skipped: int = 0
    best: float = -math.inf
    seconds: float = 0.0
    scores: dict[str, float] = field(default_factory=dict)


def train(config: TrainConfig, data: str, output: str, console: Console, ended: Sequence[int] = ()) -> int:
    """Train the run in folder ``output`` to its end, from its last checkpoint if there is one.

    The exit status is 0, or 128 + a signal's number if one ended the run; the checkpoint is written first. ``ended``
    receives numbers of signals while it runs: the current step is completed and saved.

    Raises:
        UsageError: invalid folders, or a run with another configuration.
        DataError: volumes or a checkpoint that cannot be read.
    """
    folder, lpips = Path(output), load_lpips(config.loss)  # fails before the work, not after
    with world() as here:
        messages = console if here.first else Console(quiet=True)
        if here.first:
            _open_run(folder, config)
        here.wait()
        make_scenes(Path(data), config.scenes, messages, (here.rank, here.size))
        here.wait()
        scenes = prepare_scenes(Path(data), config.scenes, messages)
        torch.manual_seed(config.seed)
        run = _Run(config, data, folder, here, scenes, messages, lpips)
        return run.to_the_end(ended)


def _open_run(folder: Path, config: TrainConfig) -> None:
    """Create the folder and its configuration, or check that the existing run has the same one."""
    check_folder(folder, "run")
    folder.mkdir(exist_ok=True)
    place = folder / CONFIG
    if place.exists():
        if read_config(place) != config:
            raise UsageError(f"-o {folder}: a run with another configuration ({place}); give another folder")
        return
    if any(folder.iterdir()):
        raise UsageError(f"-o {folder}: is not empty and holds no run; give another folder")
    write_text(place, config_text(config), overwrite=False)


def rate(step: int, config: TrainConfig) -> float:
    """Return the rate of step ``step``, from 0: a linear rise, then a cosine from ``rate`` to ``last_rate``."""
    if step < config.warmup:
        return config.rate * (step + 1) / config.warmup
    share = (step - config.warmup) / max(config.steps - 1 - config.warmup, 1)
    return config.last_rate + (config.rate - config.last_rate) * 0.5 * (1 + math.cos(math.pi * min(share, 1.0)))


class _Run:
    """A run in one process."""

    def __init__(
        self,
        config: TrainConfig,
        data: str,
        folder: Path,
        here: World,
        scenes: Scenes,
        console: Console,
        lpips: Lpips | None,
    ) -> None:
        self.config, self.data, self.folder, self.here, self.scenes = config, data, folder, here, scenes
        self.network = Vvgt(config.network).to(here.device)
        self.optimizer = torch.optim.AdamW(self.network.parameters(), lr=config.rate, weight_decay=config.weight_decay)
        self.commit = commit()  # now: the checkout may move on while this runs
        self.feeder = Feeder(scenes["train"], config)
        self.lpips = lpips.to(here.device) if lpips else None
        self.progress = TrainingProgress()
        if (folder / LAST).exists():
            self._resume()
            console.message(f"resuming at step {self.progress.step} of {config.steps}")
        self.recorder = Recorder(folder, self.progress.step, config.steps, console) if here.first else None
        self.console = console

    def to_the_end(self, ended: Sequence[int]) -> int:
        """Do the remaining steps; return the exit status."""
        config, state = self.config, self.progress
        stop = 0
        while state.step < config.steps and not stop:
            began = time.monotonic()
            stop = self._step(ended)
            state.seconds += time.monotonic() - began
            if state.step % config.check_every == 0 or state.step == config.steps:
                self._validate()
            if stop or state.step % config.save_every == 0 or state.step == config.steps:
                self._save()
        if self.recorder is not None:
            self.recorder.close()
        if stop:
            self.console.message(f"stopped by signal {stop} after step {state.step}; run the same command to resume")
        return 128 + stop if stop else 0

    def _step(self, ended: Sequence[int]) -> int:
        """Do one step; return a signal that any process received, else 0, so that all end after the same step."""
        config, state, here = self.config, self.progress, self.here
        self.optimizer.zero_grad(set_to_none=True)
        pace = rate(state.step, config)
        tally = np.zeros(3)
        for index in range(here.rank, config.batch, here.size):
            rng = np.random.default_rng([config.seed, state.step, index])
            tally += accumulate_gradients(self.network, self.feeder, rng, here.device, self.lpips)
        here.add_gradients(self.network)
        loss, gain, bad, stop = here.total([*tally, bool(ended)])
        norm = float(torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.clip))
        if bad or not math.isfinite(norm):
            state.skipped += 1
            self.console.message(f"step {state.step + 1} skipped: {int(bad)} scenes or the gradient not finite")
        else:
            for group in self.optimizer.param_groups:
                group["lr"] = pace
            self.optimizer.step()
        state.step += 1
        if self.recorder is not None:
            share = max(config.batch - bad, 1)
            self.recorder.step({
                "step": state.step, "loss": loss / share, "gain": gain / share, "rate": pace, "norm": norm,
                "skipped": state.skipped, "seconds": round(state.seconds, 3),
            })  # fmt: skip
        if not stop:
            return 0
        return int(max(ended, default=signal.SIGTERM))

    def _validate(self) -> None:
        """Score the held-out scenes; keep the best network."""
        parts = [part for part in self.scenes if part != "train"]
        row: dict[str, Any] = {"step": self.progress.step}
        gains = []
        for part in parts:
            mine = self.scenes[part][self.here.rank :: self.here.size]
            scores = np.array([score_scene(self.network, scene, self.config, self.here.device) for scene in mine])
            rounds = self.config.network.rounds
            sums = scores.sum(axis=0) if len(scores) else np.zeros(rounds + 1)
            means = np.array(self.here.total(sums)) / len(self.scenes[part])
            row[f"{part}: psnr before"] = float(means[0])
            row |= {f"{part}: gain {number}": float(means[number] - means[0]) for number in range(1, rounds + 1)}
            gains.append(row[f"{part}: gain {rounds}"])
        self.progress.scores = {key: value for key, value in row.items() if key != "step"}
        if float(np.mean(gains)) > self.progress.best:
            self.progress.best = float(np.mean(gains))
            self._write(BEST, {})
        if self.recorder is not None:
            self.recorder.validation(row)

    def _save(self) -> None:
        self._write(LAST, {"optimizer": self.optimizer.state_dict(), "progress": asdict(self.progress)})

    def _write(self, name: str, more: dict[str, Any]) -> None:
        """Write a checkpoint that `vvgt export` reads, with ``more`` for the loop itself."""
        if not self.here.first:
            return
        state = self.progress
        training = {
            "config": {key: value for key, value in asdict(self.config).items() if key != "network"},
            "data": Path(self.data).name, "scenes": {part: len(scenes) for part, scenes in self.scenes.items()},
            "step": state.step, "skipped": state.skipped, "seconds": round(state.seconds, 1),
            "processes": self.here.size, "device": self.here.device.type, "torch": str(torch.__version__),
        }  # fmt: skip
        training = json.loads(json.dumps(training))  # as model cards hold it, without tuples
        checkpoint = NetworkCheckpoint(self.network, training, state.scores, self.commit)
        with atomic_write(self.folder / name, overwrite=True) as temporary:
            save_checkpoint(temporary, checkpoint, more)

    def _resume(self) -> None:
        path = self.folder / LAST
        document = read_tensors(path)
        try:
            load_weights(self.network, document["state"], str(path))
            self.optimizer.load_state_dict(document["optimizer"])
            self.progress = TrainingProgress(**document["progress"])
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: not a checkpoint of a run ({error}); remove the folder to start over") from None


def commit() -> str:
    """Return the commit of the checkout that this runs from; "unknown" outside of one."""
    here = Path(__file__).parent
    try:
        git = subprocess.run(["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return git.stdout.strip() or "unknown"


@dataclass(frozen=True)
class World:
    """A process of a group.

    Attributes:
        rank: its number, from 0.
        size: number of processes.
        device: of its network.
    """

    rank: int
    size: int
    device: torch.device

    @property
    def first(self) -> bool:
        """Return whether this process writes and prints."""
        return self.rank == 0

    def total(self, values: Iterable[float]) -> list[float]:
        """Return the sums over all processes."""
        tensor = torch.tensor(list(values), dtype=torch.float64, device=self.device)
        if self.size > 1:
            distributed.all_reduce(tensor)
        return [float(value) for value in tensor.cpu()]

    def add_gradients(self, network: nn.Module) -> None:
        """Replace every parameter's gradient by the sum over all processes; a missing one counts as zero.

        One sum per step replaces torch's DistributedDataParallel: scenes come one at a time, several per step, and a
        skipped scene must not leave the others waiting.
        """
        grads: list[Tensor] = []
        for parameter in network.parameters():
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            grads.append(parameter.grad)
        if self.size == 1:
            return
        flat = torch.cat([grad.reshape(-1) for grad in grads])
        distributed.all_reduce(flat)
        for grad, part in zip(grads, flat.split([grad.numel() for grad in grads]), strict=True):
            grad.copy_(part.view_as(grad))

    def wait(self) -> None:
        """Wait until all processes arrive."""
        if self.size > 1:
            distributed.barrier()


@contextmanager
def world() -> Iterator[World]:
    """Yield the group of torchrun's environment, one process without it; gloo on CPUs, NCCL on GPUs."""
    size, rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
    cuda = torch.cuda.is_available()
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0"))) if cuda else torch.device("cpu")
    if size == 1:
        yield World(0, 1, device)
        return
    distributed.init_process_group("nccl" if cuda else "gloo")
    try:
        yield World(rank, size, device)
    finally:
        distributed.destroy_process_group()


MESSAGE_SECONDS = 20.0  # seconds


class CsvTable:
    """A CSV file that grows; a resumed run removes the rows after its checkpoint."""

    def __init__(self, path: Path, step: int) -> None:
        """Remove rows after ``step``."""
        self.path = path
        if not path.exists():
            return
        with path.open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        kept = [row for row in rows if int(row["step"]) <= step]
        with atomic_write(path, overwrite=True) as temporary, temporary.open("w", newline="") as stream:
            if rows:
                writer = csv.DictWriter(stream, list(rows[0]))
                writer.writeheader()
                writer.writerows(kept)

    def add(self, row: dict[str, Any]) -> None:
        """Append a row; all rows have the same columns."""
        empty = not self.path.exists() or not self.path.stat().st_size
        with self.path.open("a", newline="") as stream:
            writer = csv.DictWriter(stream, list(row))
            if empty:
                writer.writeheader()
            writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})


class Recorder:
    """Records of a run: ``metrics.csv`` (row per step), ``held.csv`` (row per validation), TensorBoard, messages."""

    def __init__(self, folder: Path, step: int, steps: int, console: Console) -> None:
        """Open the tables and TensorBoard for a run that continues after ``step``."""
        self.metrics, self.held = CsvTable(folder / "metrics.csv", step), CsvTable(folder / "held.csv", step)
        self.board = _board(folder, step, console)
        self.console, self.first, self.steps = console, step, steps
        self.began = self.reported = time.monotonic()

    def step(self, row: dict[str, Any]) -> None:
        """Record a step; print a line with the remaining time every `MESSAGE_SECONDS` seconds."""
        self.metrics.add(row)
        self._plot("train", row)
        now, done = time.monotonic(), row["step"]
        if now - self.reported >= MESSAGE_SECONDS or done == self.steps:
            self.reported = now
            left = (now - self.began) / max(done - self.first, 1) * (self.steps - done)
            self.console.message(
                f"step {done} of {self.steps}: loss {row['loss']:.4f}, gain {row['gain']:+.3f} dB, "
                f"{row['skipped']} skipped, {left / 60:.1f} minutes left"
            )

    def validation(self, row: dict[str, Any]) -> None:
        """Record the scores of the held-out scenes."""
        self.held.add(row)
        self._plot("held", row)
        gains = ", ".join(f"{key} {value:+.3f} dB" for key, value in row.items() if "gain" in key)
        self.console.message(f"step {row['step']}, held out: {gains}")

    def _plot(self, group: str, row: dict[str, Any]) -> None:
        if self.board is not None:
            for key, value in row.items():
                if key != "step":
                    self.board.add_scalar(f"{group}/{key}", value, row["step"])

    def close(self) -> None:
        """Flush TensorBoard."""
        if self.board is not None:
            self.board.close()


def _board(folder: Path, step: int, console: Console) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        console.message("tensorboard is not installed: metrics go to CSV only")
        return None
    return SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)
