"""Checkpoints of conversions: a folder with the result of each stage, in files written atomically.

Each file has a key, the digest of everything that the stages depend on. A resumed run writes the same bytes as one that
was never interrupted.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.digests import digest
from vvgt_cli.files import claim, read_text
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.network.card import CARD, find_model
from vvgt_cli.refine.checkpoint import FAULTS, load_archive, save_archive
from vvgt_cli.version import VERSION

if TYPE_CHECKING:
    from vvgt_cli.conversion.request import FitOptions
    from vvgt_cli.field.field import Field

CLOSED_FORM, CELLS, FITTED = "closed-form.npz", "cells.npz", "fitted.npz"
DESCENT = "refinement.npz"  # written by `vvgt_cli.refine.checkpoint`


@dataclass(frozen=True)
class Checkpoint:
    """The results of the stages of one conversion; without a folder, nothing is saved.

    Attributes:
        folder: folder of the files.
        key: digest of everything that they depend on.
    """

    folder: Path | None = None
    key: str = ""

    @property
    def descent(self) -> str | None:
        """Return the path of the state of gradient descent."""
        return None if self.folder is None else str(self.folder / DESCENT)

    def load(self, name: str) -> tuple[Gaussians, dict[str, Any]] | None:
        """Return the Gaussians of a stage and the plain values saved with them; None without a file.

        Raises:
            DataError: the file is damaged.
            UsageError: the file is of another conversion.
        """
        if self.folder is None or not (path := self.folder / name).exists():
            return None
        try:
            about, arrays = load_archive(str(path))
            key, beside = str(about["key"]), dict(about["beside"])
            gaussians = Gaussians(**arrays)
        except (DataError, *FAULTS) as error:
            text = " ".join(str(error).split())[:200]
            raise DataError(f"{path}: not a checkpoint of 'vvgt convert' ({text}); remove it") from None
        if key != self.key:
            raise UsageError(f"{path}: belongs to another volume or other options; give --checkpoint another folder")
        return gaussians, beside

    def save(self, name: str, gaussians: Gaussians, **beside: Any) -> None:
        """Save the result of a stage, or raise DataError."""
        if self.folder is None:
            return
        save_archive(self.folder / name, {"key": self.key, "beside": beside}, gaussians.arrays())

    def finish(self) -> None:
        """Remove all files, once the output is written."""
        if self.folder is not None:
            for name in (CLOSED_FORM, CELLS, DESCENT, FITTED):
                (self.folder / name).unlink(missing_ok=True)


@contextmanager
def checkpoint_folder(folder: str | None) -> Iterator[None]:
    """Make and lock the folder of checkpoints within the block; remove it afterwards if it is empty.

    Raises:
        UsageError: the folder cannot be made, or another run uses it.
    """
    if folder is None:
        yield
        return
    try:
        Path(folder).mkdir(exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"--checkpoint {folder}: cannot be made ({error.strerror or error}); expected a folder within one "
            "that exists"
        ) from error
    try:
        with claim(Path(folder) / "stages"):
            yield
    finally:
        with suppress(OSError):
            Path(folder).rmdir()  # fails where it is not empty


def checkpoint_of(folder: str | None, field: Field, fit: FitOptions, degree: int) -> Checkpoint:
    """Return a conversion's checkpoint, keyed by all that it depends on; raise DataError if its model is unreadable."""
    if folder is None:
        return Checkpoint()
    source = field.source
    depends = {
        "version": VERSION,
        "volume": digest(field.digest, source.volume.name, source.volume.dims, source.volume.affine),
        "function": source.look(),
        "opacity_unit_distance": source.unit_distance,
        "light": None if source.lighting is None else source.lighting.key(),
        **asdict(fit),
        "degree": degree,
        "model": read_text(find_model(fit.model) / CARD) if fit.model else None,
    }
    return Checkpoint(Path(folder), digest(json.dumps(depends, sort_keys=True)))
