"""What a run writes of itself: rows of CSV, TensorBoard where it is installed, lines with the time left."""

from __future__ import annotations

import csv
import time
from pathlib import Path
from typing import Any

from vvgt_cli.files import atomic_write
from vvgt_cli.progress import Console

SAY_EVERY = 20.0  # seconds


class Table:
    """A CSV file that grows; a run that goes on cuts what lies behind its checkpoint."""

    def __init__(self, path: Path, step: int) -> None:
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
    """Tables ``metrics.csv`` (a row a step) and ``held.csv`` (a row a validation), TensorBoard, and messages."""

    def __init__(self, folder: Path, step: int, steps: int, console: Console) -> None:
        self.metrics, self.held = Table(folder / "metrics.csv", step), Table(folder / "held.csv", step)
        self.board = _board(folder, step, console)
        self.console, self.first, self.steps = console, step, steps
        self.began = self.said = time.monotonic()

    def step(self, row: dict[str, Any]) -> None:
        """A step is done; now and then a line with the time left."""
        self.metrics.add(row)
        self._plot("train", row)
        now, done = time.monotonic(), row["step"]
        if now - self.said >= SAY_EVERY or done == self.steps:
            self.said = now
            left = (now - self.began) / max(done - self.first, 1) * (self.steps - done)
            self.console.message(
                f"step {done} of {self.steps}: loss {row['loss']:.4f}, gain {row['gain']:+.3f} dB, "
                f"{row['skipped']} skipped, {left / 60:.1f} minutes left"
            )

    def validation(self, row: dict[str, Any]) -> None:
        """The held-out scenes have been scored."""
        self.held.add(row)
        self._plot("held", row)
        found = ", ".join(f"{key} {value:+.3f} dB" for key, value in row.items() if "gain" in key)
        self.console.message(f"step {row['step']}, held out: {found}")

    def _plot(self, group: str, row: dict[str, Any]) -> None:
        if self.board is not None:
            for key, value in row.items():
                if key != "step":
                    self.board.add_scalar(f"{group}/{key}", value, row["step"])

    def close(self) -> None:
        """Write what TensorBoard holds back."""
        if self.board is not None:
            self.board.close()


def _board(folder: Path, step: int, console: Console) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        console.message("tensorboard is not installed: metrics go to CSV alone")
        return None
    return SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)
