"""The folder that holds the results of blocks: one file per block and pass, complete or absent."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.closed_form.columns import MOMENTS
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import atomic_write, write_arrays

RUN = "run.json"
COUNTS, HISTOGRAM, LABELS, CELLS = "counts", "histogram", "labels", "cells"
COARSE, TREES = "coarse", "trees"
ROW = MOMENTS * 8 + 3  # bytes per cell: moments float64, position in its tile uint8


@dataclass(frozen=True)
class BlockStore:
    """A folder of block results, each of a kind (the pass) and a block number.

    Attributes:
        folder: path of the folder.
    """

    folder: Path

    def open(self, settings: dict[str, Any], ours: bool) -> bool:
        """Create the folder, or reuse it after a run with the same (plain) settings; return whether it existed.

        A folder that is ``ours`` loses another run's results; else raise UsageError for these, DataError if it is
        unwritable.
        """
        text = json.dumps(settings, sort_keys=True, indent=1)
        place = self.folder / RUN
        # shards start together: `place`, the first file, may come at any moment, and until then has a hidden name
        content = list(self.folder.iterdir()) if self.folder.is_dir() else []
        there = place.is_file()
        same = there and place.read_text("utf-8") == text
        if there and not same and not ours:
            raise UsageError(
                f"{self.folder}: holds the blocks of another run ({differences(place, settings)}); choose another "
                "name, or remove the folder"
            )
        if not there and not ours and any(not path.name.startswith(".run.") for path in content):
            raise UsageError(f"{self.folder}: exists and holds no blocks of vvgt; choose another name")
        if not same and ours:
            shutil.rmtree(self.folder, ignore_errors=True)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DataError(f"{self.folder}: cannot be created ({error.strerror or error})") from error
        if not same:
            with atomic_write(place, overwrite=True) as temporary:
                temporary.write_text(text, "utf-8")
            if not ours and place.read_text("utf-8") != text:
                raise UsageError(f"{self.folder}: another run started there at the same time; choose another name")
        return same

    def kept_edge(self, settings: dict[str, Any]) -> int | None:
        """Return the block edge of an earlier run with the same settings, None if there was none."""
        try:
            stored = dict(self.settings())
        except UsageError:
            return None
        edge = stored.pop("blocks", None)
        return edge if stored == json.loads(json.dumps(settings)) else None

    def settings(self) -> dict[str, Any]:
        """Return the settings given to `open`; raise UsageError if this is not a folder of blocks."""
        try:
            stored = json.loads((self.folder / RUN).read_text("utf-8"))
        except (OSError, ValueError):
            raise UsageError(
                f"{self.folder}: not a folder of blocks; expected what 'vvgt init --shard' wrote"
            ) from None
        return dict(stored)

    def path(self, kind: str, number: int, suffix: str = ".npz") -> Path:
        """Return the path of a block's result."""
        return self.folder / kind / f"{number:06d}{suffix}"

    def prepare(self, kind: str) -> None:
        """Create the folder of a pass, or raise DataError."""
        try:
            (self.folder / kind).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DataError(f"{self.folder}: cannot be written ({error.strerror or error})") from error

    def missing(self, kind: str, numbers: Iterable[int]) -> list[int]:
        """Return those of ``numbers`` that have no result yet."""
        return [number for number in numbers if not self.path(kind, number).is_file()]

    def save(self, kind: str, number: int, **arrays: np.ndarray) -> None:
        """Write a result atomically, after the files beside it: it marks the block as done.

        Raises:
            DataError: the file cannot be written (a full disk).
        """
        write_arrays(self.path(kind, number), arrays)

    def load(self, kind: str, number: int, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
        """Return the arrays of a result, by default all; raise DataError if the file is missing or damaged."""
        with self.reading(kind, number) as path, np.load(path) as arrays:
            return {name: arrays[name] for name in (arrays.files if names is None else names)}

    def names(self, kind: str, number: int) -> frozenset[str]:
        """Return the names of a result's arrays; raise DataError if the file is missing or damaged."""
        with self.reading(kind, number) as path, np.load(path) as arrays:
            return frozenset(arrays.files)

    @contextmanager
    def reading(self, kind: str, number: int, suffix: str = ".npz") -> Iterator[Path]:
        """Yield the path of a file; what the block raises, of many types by zipfile, zlib and numpy, is a DataError."""
        path = self.path(kind, number, suffix)
        try:
            yield path
        except FileNotFoundError as error:
            text = f"{path}: block {number} is missing; remove its other files and run its shard again"
            raise DataError(text) from error
        except MemoryError:
            raise
        except Exception as error:
            text = f"{path}: damaged ({error}); remove the block's files and run the same command again"
            raise DataError(text) from error

    def bytes(self, kind: str) -> int:
        """Return the size of all complete files of a pass."""
        folder = self.folder / kind
        whole = (path for path in (folder.iterdir() if folder.is_dir() else ()) if not path.name.startswith("."))
        return sum(path.stat().st_size for path in whole)

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def differences(place: Path, settings: dict[str, Any]) -> str:
    """Return the names of the settings in which another run differs."""
    try:
        other = json.loads(place.read_text("utf-8"))
    except ValueError:
        return "damaged"
    names = sorted(key for key in {*other, *settings} if other.get(key) != settings.get(key))
    return "other " + ", ".join(names)
