"""Writing files: beside the target and renamed, and never over an existing one unasked; reading small ones."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from vvgt_cli.errors import DataError, UsageError

MAX_TEXT = 64 << 20  # bytes; parsed JSON takes some ten times as many


def read_text(path: str | os.PathLike[str]) -> str:
    """The text of a small file (UTF-8).

    Raises:
        DataError: more than 64 MiB.
        OSError, UnicodeDecodeError: it cannot be read, or is not text.
    """
    with open(path, "rb") as file:
        content = file.read(MAX_TEXT + 1)
    if len(content) > MAX_TEXT:
        raise DataError(f"{path}: more than 64 MiB; expected a small text file")
    return content.decode("utf-8")


def check_target(path: str | os.PathLike[str], overwrite: bool = False) -> Path:
    """The path as a `Path`, if a file may be written there.

    Raises:
        UsageError: it exists and ``overwrite`` is not set, is a folder, or its folder does not exist.
    """
    target = Path(path)
    if target.is_dir():
        raise UsageError(f"{target} is a folder; expected the name of a file to write")
    if not target.parent.is_dir():
        raise UsageError(f"{target}: the folder {target.parent} does not exist; make it first")
    if target.exists() and not overwrite:
        raise UsageError(f"{target} exists; give --overwrite to replace it, or another name")
    return target


@contextmanager
def atomic_write(path: str | os.PathLike[str], overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary name beside ``path`` to write to; rename it to ``path`` when the block ends well.

    The temporary keeps the suffix (libraries choose the format by it) and is removed on any error,
    so that no partial file is left under either name.

    Raises:
        UsageError: as `check_target`.
        DataError: the operating system refuses (no permission, disk full).
    """
    target = check_target(path, overwrite)
    temporary = target.with_name(f".{target.stem[:80]}.{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        check_target(target, overwrite)  # it may have appeared meanwhile
        os.replace(temporary, target)
    except OSError as error:
        raise DataError(f"{target}: cannot be written ({error.strerror or error})") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
