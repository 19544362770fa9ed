"""Outputs of a run: checked before the work begins, and written atomically."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vvgt_cli.errors import UsageError
from vvgt_cli.files import atomic_write, check_disk_space, check_target, claim, is_stream, linked
from vvgt_cli.gaussians.formats import ready

STDOUT = "-"
SMALLEST = 4096  # bytes that must be free on the disk


@dataclass(frozen=True)
class Output:
    """One output.

    Attributes:
        option: its option on the command line, for errors.
        path: a path, or "-" for standard output.
        suffixes: allowed file endings; empty allows any.
        binary: binary data, which must not go to a terminal.
        splats: the output is a file of Gaussians, whose format may need a library.
    """

    option: str
    path: str
    suffixes: tuple[str, ...] = ()
    binary: bool = True
    splats: bool = False

    @classmethod
    def of(cls, option: str, path: str | os.PathLike[str] | None, *how: Any, **more: Any) -> list[Output]:
        """Return a list of the output, empty without a path; the arguments are the attributes."""
        return [] if path is None else [cls(option, os.fspath(path), *how, **more)]


def _check_one(output: Output, overwrite: bool) -> None:
    endings = " or ".join(output.suffixes)
    if output.path == STDOUT:
        if endings and not {".ply", ".json"} & set(output.suffixes):
            raise UsageError(f"{output.option} -: standard output takes a .ply or JSON; expected a name in {endings}")
        if output.binary and sys.stdout.isatty():
            raise UsageError(f"{output.option} -: standard output is a terminal; redirect it to a file or a pipe")
        return
    path = Path(output.path)
    if is_stream(path):
        return
    if output.suffixes and not path.name.lower().endswith(output.suffixes):
        raise UsageError(f"{output.option} {path}: expected a name ending in {endings}")
    try:
        check_target(path, overwrite)
    except UsageError as error:
        raise UsageError(f"{output.option}: {error}") from None
    if not os.access(linked(path).parent, os.W_OK):
        raise UsageError(f"{output.option} {path}: directory {linked(path).parent} is not writable; choose another")
    check_disk_space(path, SMALLEST)
    if output.splats:
        ready(path)


def check_outputs(outputs: Sequence[Output], inputs: Sequence[str | None], overwrite: bool) -> None:
    """Check before the work begins that all outputs can be written and replace nothing.

    Args:
        outputs: the outputs.
        inputs: the input files, which no output may replace.
        overwrite: whether existing files may be replaced.

    Raises:
        UsageError: an output exists, is an input or a terminal, has the wrong ending, no directory, or the same path
            as another.
        DataError: the disk is full, or a library that a format needs is not installed.
    """
    taken: dict[str, str] = {}
    sources = {os.path.realpath(path) for path in inputs if path and path != STDOUT}
    for output in outputs:
        _check_one(output, overwrite)
        place = output.path if output.path == STDOUT else os.path.realpath(output.path)
        if place in sources:
            raise UsageError(f"{output.option} {output.path}: is an input of this run; choose another name")
        if place in taken and place != os.devnull:
            raise UsageError(f"{output.option} and {taken[place]}: both write to {output.path}; choose two names")
        taken[place] = output.option


@contextmanager
def claimed(outputs: Sequence[Output], inputs: Sequence[str | None], overwrite: bool) -> Iterator[None]:
    """Check outputs by `check_outputs`, and lock them within the context (`vvgt_cli.files.claim`).

    Raises:
        UsageError: see `check_outputs`; also if another run is writing one of them.
    """
    check_outputs(outputs, inputs, overwrite)
    with ExitStack() as claims:
        for output in outputs:
            if output.path != STDOUT:
                claims.enter_context(claim(output.path))
        check_outputs(outputs, inputs, overwrite)  # another run may have ended meanwhile
        yield


def check_folder(folder: Path, content: str) -> None:
    """Raise UsageError unless a folder for ``content`` is there or can be made."""
    if str(folder) == STDOUT:
        raise UsageError(f"-o -: standard output takes no folder; expected a folder's name for the {content}")
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"-o {folder}: is a file; expected a directory for the {content}")
    if not folder.parent.is_dir():
        raise UsageError(f"-o {folder}: no directory {folder.parent}; make it first")


def write_text(path: str | os.PathLike[str], text: str, overwrite: bool) -> None:
    """Write text to a file, atomically, or to standard output."""
    if path == STDOUT:
        sys.stdout.write(text)
        return
    with atomic_write(path, overwrite) as temporary:
        temporary.write_text(text, "utf-8")
