"""Runs that go on where they ended: one .npz with the state, what is best so far, and how far the run is.

A run that is resumed gives the bytes of one that was never interrupted, on as many threads.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.optimize import OptimizeOptions, OptimizeRecord

if TYPE_CHECKING:
    from vvgt_cli.optimize.loop import Judge, State


def fingerprint(
    gaussians: Gaussians, options: OptimizeOptions, *views: tuple[Sequence[Camera], np.ndarray] | None
) -> str:
    """Hash of all that a run depends on."""
    found = hashlib.sha256(repr(replace(options, checkpoint=None)).encode())
    g = gaussians
    for array in (g.means, g.log_scales, g.quaternions, g.opacity_logits, g.colors):
        found.update(array.tobytes())
    for cameras, images in filter(None, views):
        for camera in cameras:
            found.update(repr(camera).encode())
        for image in images:
            found.update(image.tobytes())
    return found.hexdigest()


def save(path: str, key: str, state: State, judge: Judge, record: OptimizeRecord, walk: dict[str, Any]) -> None:
    """Replace the file at ``path``; ``walk`` is plain values.

    Raises:
        DataError: the operating system refuses.
    """
    arrays: dict[str, Any] = {f"state_{name}": array for name, array in state.saved().items()}
    arrays |= {f"best_{i}": array for i, array in enumerate(judge.kept or ())}
    about = {"key": key, "walk": walk, "best": judge.best, "idle": judge.idle, "record": asdict(record)}
    with atomic_write(path, overwrite=True) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, about=np.array(json.dumps(about)), **arrays)


def resume(path: str, key: str, state: State, judge: Judge, record: OptimizeRecord) -> dict[str, Any] | None:
    """Fill ``state``, ``judge`` and ``record`` from the file at ``path``; returns the walk, None without a file.

    Raises:
        DataError: not a checkpoint.
        UsageError: of another run.
    """
    if not Path(path).exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            about = json.loads(str(file["about"]))
            arrays = {name: file[name] for name in file.files if name != "about"}
    except (OSError, KeyError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise DataError(f"{path}: not a checkpoint of 'vvgt optimize' ({error}); remove it to start afresh") from None
    if about["key"] != key:
        raise UsageError(f"{path}: checkpoint of a run with other Gaussians, views or options; name another file")
    state.restore({name.removeprefix("state_"): array for name, array in arrays.items() if name.startswith("state_")})
    kept = [arrays[name] for name in sorted(arrays) if name.startswith("best_")]
    judge.best, judge.idle, judge.kept = about["best"], about["idle"], tuple(kept) or None
    for field, value in about["record"].items():
        setattr(record, field, [tuple(look) for look in value] if field == "checks" else value)
    walk: dict[str, Any] = about["walk"]
    return walk
