"""The folders that hold compiled kernels: which they are, whose files are trusted, and how files come and go."""

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
_warned: set[str] = set()


def warn_once(message: str) -> None:
    """Give a `RuntimeWarning` once per process."""
    if message not in _warned:
        _warned.add(message)
        warnings.warn(message, RuntimeWarning, stacklevel=2)


def folders() -> list[Path]:
    """Return the folders in which kernels are looked for; they are written to the first that allows it.

    ``NUMBA_CACHE_DIR`` if it is set; else beside the package's byte code, then in the user's cache.
    """
    mine = f"vvgt-{hashlib.sha256(str(PACKAGE).encode()).hexdigest()[:12]}"
    if os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(os.environ["NUMBA_CACHE_DIR"]) / mine]
    places = [PACKAGE / "__pycache__" / "kernels"]
    home = os.environ.get("XDG_CACHE_HOME")
    with contextlib.suppress(RuntimeError, KeyError):  # a user without a home
        places.append((Path(home) if home and os.path.isabs(home) else Path.home() / ".cache") / "vvgt" / mine)
    return places


@cache
def temporary_folder() -> Path:
    """Make a folder for this process alone, removed at its end.

    Raises:
        OSError: nothing can be written there either.
    """
    import atexit
    import shutil

    folder = tempfile.mkdtemp(prefix="vvgt-kernels-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def writable(folder: Path) -> bool:
    """Return whether a file can be made in ``folder``, which is made if it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


@cache
def folder_for_writing() -> Path | None:
    """Return the first of `folders` that can be written to, else a temporary one, with a warning; None without any."""
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
    """Return `folders`, and the temporary one of this process if it has one."""
    return [*folders(), *([temporary_folder()] if temporary_folder.cache_info().currsize else [])]


def trusted_users() -> set[int]:
    """Return the ids of the users whose files are trusted: this user, root, the owner of the package."""
    if not hasattr(os, "geteuid"):
        return {0}  # what os.stat gives where there are no user ids
    return {os.geteuid(), 0, PACKAGE.stat().st_uid}


def read(path: Path) -> bytes | None:
    """Return the contents of a file that is intact and of a trusted user, else None; warn once of what is wrong."""
    try:
        with path.open("rb") as stream:
            owner = os.fstat(stream.fileno()).st_uid
            text = stream.read()
    except OSError:
        return None
    if owner not in trusted_users():
        warn_once(f"{path.parent}: kernels of another user (id {owner}) are not read")
        return None
    body = text[len(MAGIC) + 32 :]
    if text[: len(MAGIC)] != MAGIC or hashlib.sha256(body).digest() != text[len(MAGIC) : len(MAGIC) + 32]:
        warn_once(f"{path.parent}: damaged kernels are compiled again")
        return None
    return body


def write(path: Path, payload: bytes) -> None:
    """Put a file in its place at once, and remove those of the same kernel under other keys."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(MAGIC + hashlib.sha256(payload).digest() + payload)
        part.replace(path)
    except PermissionError:  # Windows, while another process reads the file that is there, which has the same code
        if not path.exists():
            raise
    finally:
        part.unlink(missing_ok=True)
    name, key = path.name.split("-")[:2]
    for other in path.parent.glob(f"{name}-*"):
        if other.name.split("-")[1] != key:
            with contextlib.suppress(PermissionError):  # Windows, as above
                other.unlink(missing_ok=True)
