"""The folders that hold compiled kernels: which they are, who is believed, how files come and go."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import warnings
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parent.parent
MAGIC = b"vvgt kernel 1\n"
WORKING: Path | None = None  # file that this process compiles for; None in processes that load
_said: set[str] = set()


def warn_once(message: str) -> None:
    """A `RuntimeWarning` that is given once a process."""
    if message not in _said:
        _said.add(message)
        warnings.warn(message, RuntimeWarning, stacklevel=2)


def folders() -> list[Path]:
    """Where kernels are looked for, and written to in the first place that allows it.

    ``NUMBA_CACHE_DIR`` where it is set; else beside the package's byte code, then in the user's cache.
    """
    mine = f"vvgt-{hashlib.sha256(str(PACKAGE).encode()).hexdigest()[:12]}"
    if os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(os.environ["NUMBA_CACHE_DIR"]) / mine]
    found = [PACKAGE / "__pycache__" / "kernels"]
    home = os.environ.get("XDG_CACHE_HOME")
    with contextlib.suppress(RuntimeError, KeyError):  # a user without a home
        found.append((Path(home) if home and os.path.isabs(home) else Path.home() / ".cache") / "vvgt" / mine)
    return found


@cache
def temporary_folder() -> Path:
    """A folder for this process alone, removed at its end.

    Raises:
        OSError: nothing can be written there either.
    """
    import atexit
    import shutil

    folder = tempfile.mkdtemp(prefix="vvgt-kernels-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def writable(folder: Path) -> bool:
    """Whether a file can be made in ``folder``, which is made where it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


@cache
def folder_for_writing() -> Path | None:
    """The first of `folders` that can be written to, else a temporary one, which is said; None where there is none."""
    tried = folders()
    for folder in tried:
        if writable(folder):
            return folder
    try:
        folder = temporary_folder()
    except OSError:
        return None
    warn_once(f"compiled kernels cannot be kept in {tried[0]}: compiled for this run alone (try NUMBA_CACHE_DIR)")
    return folder


def folders_for_reading() -> list[Path]:
    """`folders`, and the one of this process alone where there is one."""
    return [*folders(), *([temporary_folder()] if temporary_folder.cache_info().currsize else [])]


def owners() -> set[int]:
    """User ids whose files are believed: this user, root, the owner of the package."""
    if not hasattr(os, "geteuid"):
        return {0}  # what os.stat gives where there are no user ids
    return {os.geteuid(), 0, PACKAGE.stat().st_uid}


def read(path: Path) -> bytes | None:
    """Contents of a file that is whole and of an owner who is believed, else None; what is wrong is said once."""
    try:
        with path.open("rb") as stream:
            owner = os.fstat(stream.fileno()).st_uid
            text = stream.read()
    except OSError:
        return None
    if owner not in owners():
        warn_once(f"{path.parent}: kernels of another user (id {owner}) are not read")
        return None
    body = text[len(MAGIC) + 32 :]
    if text[: len(MAGIC)] != MAGIC or hashlib.sha256(body).digest() != text[len(MAGIC) : len(MAGIC) + 32]:
        warn_once(f"{path.parent}: damaged kernels are compiled anew")
        return None
    return body


def write(path: Path, payload: bytes) -> None:
    """Put a file in its place at once, and remove those of the same kernel under other keys."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(MAGIC + hashlib.sha256(payload).digest() + payload)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    name, key = path.name.split("-")[:2]
    for other in path.parent.glob(f"{name}-*"):
        if other.name.split("-")[1] != key:
            other.unlink(missing_ok=True)
