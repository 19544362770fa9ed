"""Conversions that go on where they ended: a folder with what each stage made, each file whole or not there.

What lies there has a key, the digest of everything that the stages depend on; a run that goes on ends with the bytes
of one that was never interrupted.
"""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.digests import digest
from vvgt_cli.files import atomic_write, claim, read_text
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.network.card import CARD, find_model
from vvgt_cli.refine.checkpoint import load_archive
from vvgt_cli.version import VERSION

if TYPE_CHECKING:
    from vvgt_cli.conversion.request import FitOptions, Limits
    from vvgt_cli.field.field import Field

CLOSED_FORM, CELLS, FITTED = "closed-form.npz", "cells.npz", "fitted.npz"
DESCENT = "refinement.npz"  # of `vvgt_cli.refine.checkpoint`
_FAULTS = (
    *(OSError, KeyError, ValueError, TypeError, AttributeError, EOFError, MemoryError, RuntimeError, DataError),
    *(zipfile.BadZipFile, struct.error),
)


@dataclass(frozen=True)
class Checkpoint:
    """What the stages of one conversion made; nothing is kept where there is no folder.

    Attributes:
        folder: of the files.
        key: digest of all that they depend on.
    """

    folder: Path | None = None
    key: str = ""

    @property
    def descent(self) -> str | None:
        """Where gradient descent keeps its state."""
        return None if self.folder is None else str(self.folder / DESCENT)

    def load(self, name: str) -> tuple[Gaussians, dict[str, Any]] | None:
        """What a stage made, and the plain values beside it; None where it has not come so far.

        Raises:
            DataError: damaged.
            UsageError: of another conversion.
        """
        if self.folder is None or not (path := self.folder / name).exists():
            return None
        try:
            about, arrays = load_archive(str(path))
            key, beside = str(about["key"]), dict(about["beside"])
            gaussians = Gaussians(**arrays)
        except _FAULTS as error:
            text = " ".join(str(error).split())[:200]
            raise DataError(f"{path}: not what a stage of 'vvgt convert' keeps ({text}); remove it") from None
        if key != self.key:
            raise UsageError(
                f"{path}: of a conversion of another volume, or with other options; give --checkpoint another folder"
            )
        return gaussians, beside

    def save(self, name: str, gaussians: Gaussians, **beside: Any) -> None:
        """Keep what a stage made.

        Raises:
            DataError: the operating system refuses.
        """
        if self.folder is None:
            return
        arrays: dict[str, Any] = gaussians.arrays()
        about = np.array(json.dumps({"key": self.key, "beside": beside}))
        with atomic_write(self.folder / name, overwrite=True) as temporary, open(temporary, "wb") as stream:
            np.savez(stream, about=about, **arrays)

    def finish(self) -> None:
        """Remove what is of no use once the output is written."""
        if self.folder is not None:
            for name in (CLOSED_FORM, CELLS, DESCENT, FITTED):
                (self.folder / name).unlink(missing_ok=True)


@contextmanager
def checkpoint_folder(folder: str | None) -> Iterator[None]:
    """Within the block the folder is there, and this run's alone; an empty one is removed at the end.

    Raises:
        UsageError: it is a file, cannot be made, or another run is at work in it.
    """
    if folder is None:
        yield
        return
    try:
        Path(folder).mkdir(exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"--checkpoint {folder}: cannot be made ({error.strerror or error}); expected the name of a folder, in one "
            "that exists"
        ) from error
    try:
        with claim(Path(folder) / "stages"):
            yield
    finally:
        with suppress(OSError):
            Path(folder).rmdir()  # refused where something lies in it


def checkpoint_of(folder: str | None, field: Field, fit: FitOptions, limits: Limits) -> Checkpoint:
    """The stages of a conversion, under the key of what they depend on.

    Raises:
        DataError: the model of ``fit`` cannot be read.
    """
    if folder is None:
        return Checkpoint()
    source = field.source
    depends = {
        "version": VERSION,
        "volume": digest(field.digest(), source.volume.name, source.volume.dims, source.volume.affine),
        "function": source.look(),
        "opacity_unit_distance": source.unit_distance,
        "light": None if source.lighting is None else source.lighting.text(),
        **asdict(fit),
        **asdict(limits),
        "model": read_text(find_model(fit.model) / CARD) if fit.model else None,
    }
    return Checkpoint(Path(folder), digest(json.dumps(depends, sort_keys=True)))
