"""The folder that blocks are kept in: one file a block and pass, whole or not there."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.closed_form.columns import MOMENTS
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import atomic_write

RUN = "run.json"
COUNTS, HISTOGRAM, LABELS, CELLS = "counts", "histogram", "labels", "cells"
ROW = MOMENTS * 8 + 3  # bytes a cell: moments float64, place in its tile uint8


@dataclass(frozen=True)
class BlockStore:
    """A folder of parts.

    Attributes:
        folder: it.
    """

    folder: Path

    def open(self, settings: dict[str, Any], ours: bool) -> bool:
        """Make the folder, or take up what an earlier run of the same settings left; whether there was one.

        Args:
            settings: all that the parts depend on, plain values.
            ours: the folder is this program's own: what another run left is removed.

        Raises:
            UsageError: the folder holds another run's parts, or something else.
            DataError: it cannot be written.
        """
        text = json.dumps(settings, sort_keys=True, indent=1)
        place = self.folder / RUN
        if self.folder.exists() and not (place.is_file() and place.read_text("utf-8") == text):
            if not ours and any(self.folder.iterdir()) and not place.is_file():
                raise UsageError(f"{self.folder}: a folder of something else; choose another name")
            if not ours and place.is_file():
                raise UsageError(
                    f"{self.folder}: holds the blocks of another run ({differences(place, settings)}); choose another "
                    "name, or remove it"
                )
            if ours:
                shutil.rmtree(self.folder, ignore_errors=True)
        there = place.is_file()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DataError(f"{self.folder}: cannot be made ({error.strerror or error})") from error
        if not there:
            with atomic_write(place, overwrite=True) as temporary:
                temporary.write_text(text, "utf-8")
        return there

    def kept_edge(self, settings: dict[str, Any]) -> int | None:
        """Size of the blocks that an earlier run of the same settings has left, None where there was none."""
        try:
            found = dict(self.settings())
        except UsageError:
            return None
        edge = found.pop("blocks", None)
        return edge if found == json.loads(json.dumps(settings)) else None

    def settings(self) -> dict[str, Any]:
        """As `open` was given them.

        Raises:
            UsageError: not a folder of parts.
        """
        try:
            found = json.loads((self.folder / RUN).read_text("utf-8"))
        except (OSError, ValueError):
            raise UsageError(
                f"{self.folder}: not a folder of blocks; expected what 'vvgt init --shard' wrote"
            ) from None
        return dict(found)

    def path(self, kind: str, number: int, suffix: str = ".npz") -> Path:
        """Of a part."""
        return self.folder / kind / f"{number:06d}{suffix}"

    def prepare(self, kind: str) -> None:
        """Make the folder of a pass.

        Raises:
            DataError: the system refuses.
        """
        try:
            (self.folder / kind).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DataError(f"{self.folder}: cannot be written ({error.strerror or error})") from error

    def missing(self, kind: str, numbers: Iterable[int]) -> list[int]:
        """Those of ``numbers`` that are not there."""
        return [number for number in numbers if not self.path(kind, number).is_file()]

    def save(self, kind: str, number: int, suffix: str = ".npz", **arrays: np.ndarray) -> None:
        """Write a part, whole or not at all; that without a suffix of its own last: the block is done with it.

        Raises:
            DataError: the system refuses (a full disk).
        """
        with (
            atomic_write(self.path(kind, number, suffix), overwrite=True) as temporary,
            open(temporary, "wb") as stream,
        ):
            np.savez(stream, allow_pickle=False, **arrays)

    def load(
        self, kind: str, number: int, suffix: str = ".npz", names: Collection[str] | None = None
    ) -> dict[str, np.ndarray]:
        """The arrays of a part, or those of ``names``.

        Raises:
            DataError: it is not there, or damaged.
        """
        path = self.path(kind, number, suffix)
        try:
            with np.load(path) as found:
                return {name: found[name] for name in (found.files if names is None else names)}
        except Exception as error:
            raise _unreadable(path, number, error) from error

    def names(self, kind: str, number: int, suffix: str = ".npz") -> frozenset[str]:
        """Of the arrays of a part.

        Raises:
            DataError: it is not there, or damaged.
        """
        path = self.path(kind, number, suffix)
        try:
            with np.load(path) as found:
                return frozenset(found.files)
        except Exception as error:
            raise _unreadable(path, number, error) from error

    def bytes(self, kind: str) -> int:
        """Of all that lies there of a pass and is whole."""
        folder = self.folder / kind
        whole = (path for path in (folder.iterdir() if folder.is_dir() else ()) if not path.name.startswith("."))
        return sum(path.stat().st_size for path in whole)

    def remove(self) -> None:
        """The whole folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _unreadable(path: Path, number: int, error: Exception) -> DataError:
    """What is wrong with a part: zipfile, zlib and numpy raise what they like."""
    if isinstance(error, FileNotFoundError):
        return DataError(
            f"{path}: block {number} is missing; run the shard that makes it (remove first what else there is of it)"
        )
    return DataError(f"{path}: damaged ({error}); remove the block's files and run the same command again")


def differences(place: Path, settings: dict[str, Any]) -> str:
    """Names of the settings in which the run of a file differs."""
    try:
        other = json.loads(place.read_text("utf-8"))
    except ValueError:
        return "damaged"
    names = sorted(key for key in {*other, *settings} if other.get(key) != settings.get(key))
    return "other " + ", ".join(names)
