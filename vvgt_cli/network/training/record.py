"""Records of a run: rows of CSV, TensorBoard if installed, lines with the remaining time."""

from __future__ import annotations

import csv
import time
from pathlib import Path
from typing import Any

from vvgt_cli.files import atomic_write
from vvgt_cli.progress import Console

MESSAGE_SECONDS = 20.0  # seconds


class Table:
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
        self.metrics, self.held = Table(folder / "metrics.csv", step), Table(folder / "held.csv", step)
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
        found = ", ".join(f"{key} {value:+.3f} dB" for key, value in row.items() if "gain" in key)
        self.console.message(f"step {row['step']}, held out: {found}")

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
