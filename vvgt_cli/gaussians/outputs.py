"""Where results go: checked before the long work, written whole or not at all."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from vvgt_cli.errors import UsageError
from vvgt_cli.files import atomic_write, check_disk_space, check_target, claim, is_stream
from vvgt_cli.gaussians.formats import ready

STDOUT = "-"
SMALLEST = 4096  # bytes: a disk that has not got them takes no file


@dataclass(frozen=True)
class Output:
    """One result.

    Attributes:
        option: what the command line calls it, for errors.
        path: a path, or "-" for standard output.
        suffixes: names it may end in; none: any.
        binary: not for a terminal.
        splats: Gaussians, whose format may need a library.
    """

    option: str
    path: str
    suffixes: tuple[str, ...] = ()
    binary: bool = True
    splats: bool = False


def _check_one(output: Output, overwrite: bool) -> None:
    if output.path == STDOUT:
        if output.binary and sys.stdout.isatty():
            raise UsageError(f"{output.option} -: standard output is a terminal; redirect it to a file or a pipe")
        return
    path = Path(output.path)
    if is_stream(path):
        return
    if output.suffixes and not path.name.lower().endswith(output.suffixes):
        raise UsageError(f"{output.option} {path}: expected a name ending in {' or '.join(output.suffixes)}")
    try:
        check_target(path, overwrite)
    except UsageError as error:
        raise UsageError(f"{output.option}: {error}") from None
    if not os.access(path.parent, os.W_OK):
        raise UsageError(f"{output.option} {path}: directory {path.parent} is not writable")
    check_disk_space(path, SMALLEST)
    if output.splats:
        ready(path)


def check_outputs(outputs: Sequence[Output], inputs: Sequence[str | None], overwrite: bool) -> None:
    """Refuse what could not be written, or would replace something, before the work begins.

    Args:
        outputs: what will be written.
        inputs: what is read: no output may replace one.
        overwrite: existing files may be replaced.

    Raises:
        UsageError: exists, is an input, two outputs in one place, no such directory, wrong ending, a terminal.
        DataError: the disk is full, or a library that a format needs is not installed.
    """
    taken: dict[str, str] = {}
    sources = {os.path.realpath(path) for path in inputs if path and path != STDOUT}
    for output in outputs:
        _check_one(output, overwrite)
        place = output.path if output.path == STDOUT else os.path.realpath(output.path)
        if place in sources:
            raise UsageError(f"{output.option} {output.path}: is an input of this run; choose another name")
        if place in taken:
            raise UsageError(f"{output.option} and {taken[place]} both go to {output.path}; choose two names")
        taken[place] = output.option


@contextmanager
def claimed(outputs: Sequence[Output], inputs: Sequence[str | None], overwrite: bool) -> Iterator[None]:
    """`check_outputs`, and within the block nobody else may write them (`vvgt_cli.files.claim`).

    Raises:
        UsageError: as `check_outputs`, or another run is at work on one of them.
    """
    check_outputs(outputs, inputs, overwrite)
    with ExitStack() as claims:
        for output in outputs:
            if output.path != STDOUT:
                claims.enter_context(claim(output.path))
        check_outputs(outputs, inputs, overwrite)  # another run may have ended meanwhile
        yield


def write_text(path: str, text: str, overwrite: bool) -> None:
    """Write text to a file, whole or not at all, or to standard output."""
    if path == STDOUT:
        sys.stdout.write(text)
        return
    with atomic_write(path, overwrite) as temporary:
        temporary.write_text(text, "utf-8")
