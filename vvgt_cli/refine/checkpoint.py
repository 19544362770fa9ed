"""`Checks` scores a run and keeps its best state; `save` and `resume` store the run in an .npz.

A run that is resumed gives the bytes of one that was never interrupted, on as many threads.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import zipfile
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.cameras.blocks import picked
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import write_arrays
from vvgt_cli.gaussians import INRIA, Gaussians, Rule
from vvgt_cli.images.metrics import mean_psnr, visible_difference
from vvgt_cli.refine.options import Check, OptimizeOptions, OptimizeRecord

if TYPE_CHECKING:
    from vvgt_cli.refine.states import State

GAIN = 0.01  # dB: less is none
FALLEN = 3.0  # dB below the best: rates were too large

FAULTS = (  # that reading a damaged archive raises
    *(OSError, KeyError, ValueError, TypeError, AttributeError, OverflowError, EOFError, MemoryError, RuntimeError),
    *(zipfile.BadZipFile, struct.error),
)

STEPPED = 6  # raised when the same start and options step otherwise, or what is kept has other names


class Checks:
    """Checks of a run by its check views, which keeps the best state that they have seen."""

    def __init__(self, state: State, check: Check | None, record: OptimizeRecord, rule: Rule = INRIA) -> None:
        """Compare ``state`` with the views of ``check``, drawn by ``rule``, and put scores into ``record``."""
        self.state, self.check, self.record, self.rule = state, check, record, rule
        self.best: float | None = None
        self.kept: dict[str, np.ndarray] | None = None  # of what the state has saved, its arrays
        self.idle = 0
        self.difference = math.inf  # of the state last scored (`visible_difference`)

    def measure(self, seconds: float, settling: bool = False) -> bool:
        """Score the state, unless that has been done; True if it has fallen, and was put back to the best.

        Rates are kept up in the first half of a run, and pictures may get worse on the way: scores without gain count
        only when it is ``settling``, and after a fall.
        """
        record = self.record
        if self.check is None or (record.checks and record.checks[-1][0] == record.steps):
            return False
        images = []
        cameras, views, blocks, weights = (*self.check, None, None)[:4]
        for i, camera in enumerate(cameras):
            part = None if blocks is None else blocks[i]
            images.append(picked(self.state.picture(camera, self.rule, part), part))
        now, self.difference = mean_psnr(views, images, weights), visible_difference(views, images, weights)
        record.checks.append((record.steps, seconds, now))
        fallen = self.best is not None and now < self.best - FALLEN and self.state.STEADY
        gained = self.best is None or now > self.best + GAIN
        self.idle = 0 if gained else self.idle + ((settling and self.state.STEADY) or fallen)
        if self.best is None or now > self.best:
            self.best, record.kept = now, record.steps
            self.kept = {k: array.copy() for k, array in self.state.saved().items() if k.startswith("array_")}
        if fallen:
            self._put_back()
        return fallen

    def _put_back(self) -> None:
        assert self.kept is not None
        self.state.restore(self.state.saved() | {name: array.copy() for name, array in self.kept.items()})

    def result(self, start: Gaussians) -> Gaussians:
        """Return the best state as Gaussians; the input itself where nothing was better."""
        self.record.psnr_after = self.best
        if self.check is None:
            self.record.kept = self.record.steps
        else:
            self._put_back()
        return self.state.gaussians() if self.record.kept else start


def fingerprint(gaussians: Gaussians, options: OptimizeOptions, *views: Any, others: Iterable[np.ndarray] = ()) -> str:
    """Hash all that a run depends on; ``views``: `Train`, `Check` or None, ``others``: weights and which are free."""
    digest = hashlib.sha256(f"{STEPPED} {replace(options, checkpoint=None, device='cpu')!r}".encode())
    for array in (*gaussians.arrays().values(), *others):
        digest.update(array.tobytes())
    for part in filter(None, views):
        digest.update(repr(part[2:3]).encode())
        for camera, image in zip(part[0], part[1], strict=True):
            digest.update(repr(camera).encode())
            digest.update(image.tobytes())
        for weight in (*part, None, None)[3] or ():
            digest.update(weight.tobytes())
    return digest.hexdigest()


def save(path: str, key: str, state: State, checks: Checks, record: OptimizeRecord, walk: dict[str, Any]) -> None:
    """Replace the file at ``path``, or raise DataError; ``walk`` is plain values."""
    arrays: dict[str, Any] = {f"state_{name}": array for name, array in state.saved().items()}
    arrays |= {f"best_{name}": array for name, array in (checks.kept or {}).items()}
    about = {"key": key, "walk": walk, "best": checks.best, "idle": checks.idle, "record": asdict(record)}
    save_archive(path, about, arrays)


def resume(path: str, key: str, state: State, checks: Checks, record: OptimizeRecord) -> dict[str, Any] | None:
    """Fill ``state``, ``checks`` and ``record`` from the file at ``path``; returns the walk, None without a file.

    Raises:
        DataError: not a checkpoint.
        UsageError: of another run.
    """
    if not Path(path).exists():
        return None
    try:
        about, arrays = load_archive(path)
        if about["key"] != key:
            raise UsageError(f"{path}: checkpoint of a run with other Gaussians, views or options; name another file")
        own = state.saved()
        saved = {name.removeprefix("state_"): array for name, array in arrays.items() if name.startswith("state_")}
        _check_like(saved, own)
        kept = {name.removeprefix("best_"): array for name, array in arrays.items() if name.startswith("best_")}
        if kept:
            _check_like(kept, {name: array for name, array in own.items() if name.startswith("array_")})
        state.restore(saved)
        best, idle, walk = about["best"], int(about["idle"]), dict(about["walk"])
        described = {field: about["record"][field] for field in asdict(record)}
        described["checks"] = [tuple(score) for score in described["checks"]]
    except FAULTS as error:
        text = " ".join(str(error).split())[:200]
        raise DataError(f"{path}: not a checkpoint of gradient descent ({text}); remove it to start afresh") from None
    checks.best, checks.idle, checks.kept = best, idle, kept or None
    for field, value in described.items():
        setattr(record, field, value)
    return walk


def save_archive(path: str | Path, about: dict[str, Any], arrays: dict[str, Any]) -> None:
    """Write arrays and a description of plain values to an .npz, in place of one at ``path``, or raise DataError."""
    write_arrays(path, {"about": np.array(json.dumps(about)), **arrays})


def load_archive(path: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the run's description and the arrays, all as it lies in the file, so that nothing grows in memory."""
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError("compressed entries")
        if sum(entry.file_size for entry in entries) > Path(path).stat().st_size:
            raise ValueError("entries that are larger than the file")
    with np.load(path, allow_pickle=False) as file:
        about = json.loads(str(file["about"]))
        return about, {name: file[name] for name in file.files if name != "about"}


def _check_like(saved: dict[str, np.ndarray], own: dict[str, np.ndarray]) -> None:
    """Raise ValueError unless arrays are those of a state of any number of Gaussians: kernels do not check."""
    if set(saved) != set(own):
        raise ValueError("other arrays")
    for name, array in own.items():
        there = saved[name]
        rows = (len(saved["array_0"]),) if array.ndim and name != "last" else array.shape[:1]
        same = there.dtype == array.dtype or there.dtype.kind == array.dtype.kind == "U"
        if not same or there.shape != (*rows, *array.shape[1:]):
            raise ValueError(f"{name} is {there.dtype} of shape {there.shape}")
