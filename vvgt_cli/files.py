"""Atomic writing, locks against a second run, and reading from pipes as from files."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.resources import free_memory

if TYPE_CHECKING:
    import numpy as np

MAX_TEXT = 64 << 20  # bytes; parsed JSON takes some ten times as many
_CHUNK = 1 << 20
_SPARE = 64 << 20  # bytes of memory that the content of a pipe must leave free
_OPEN = ("/dev", "/dev/fd", "/proc/self/fd")  # folders that name open files, such as /dev/stdout
_leftovers: set[Path] = set()  # temporary names and locks of this process
_spooled: dict[tuple[int, int], IO[bytes]] = {}  # content of pipes, by device and inode


def read_text(path: str | os.PathLike[str]) -> str:
    """Return the text of a small UTF-8 file.

    Raises:
        DataError: the file has more than 64 MiB.
        OSError, UnicodeDecodeError: the file cannot be read, or is not text.
    """
    with open(seekable(path), "rb") as file:
        content = file.read(MAX_TEXT + 1)
    if len(content) > MAX_TEXT:
        raise DataError(f"{path}: more than 64 MiB; expected a small text file")
    return content.decode("utf-8")


def is_stream(path: str | os.PathLike[str]) -> bool:
    """Return whether an output path is a pipe, a socket, a device or an open file, which a rename must not replace."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return False
    if stat.S_ISREG(mode):
        return os.path.dirname(path) in _OPEN
    return not (stat.S_ISDIR(mode) or stat.S_ISBLK(mode))


def seekable(path: str | os.PathLike[str]) -> Path:
    """Return the path itself, or for a pipe (``<(gunzip -c a.nii.gz)``, a FIFO) that of its content in memory.

    A pipe is read once, to its end, however often this is called.

    Raises:
        DataError: the pipe cannot be read, has more than fits in memory, or the system has no files in memory.
    """
    try:
        about = os.stat(path)
    except (OSError, ValueError):
        return Path(path)
    if not (stat.S_ISFIFO(about.st_mode) or stat.S_ISSOCK(about.st_mode)):
        return Path(path)
    try:
        key = about.st_dev, about.st_ino
        if key not in _spooled:
            _spooled[key] = _spool(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from error
    return Path(f"/proc/self/fd/{_spooled[key].fileno()}")


def _spool(path: str | os.PathLike[str]) -> IO[bytes]:
    """Copy the content of a pipe to a file in memory."""
    if not hasattr(os, "memfd_create") or not os.path.isdir("/proc/self/fd"):
        raise DataError(f"{path}: is a pipe; expected a file: write its content to one first")
    kept = os.fdopen(os.memfd_create("pipe"), "w+b")
    with open(path, "rb", buffering=0) as stream:
        count = 0
        while chunk := stream.read(_CHUNK):
            free = free_memory()
            if free is not None and free < _SPARE:
                kept.close()
                raise DataError(
                    f"{path}: the free memory is used up after {count} bytes of this pipe; write them to a file "
                    "first: large files are read in blocks"
                )
            kept.write(chunk)
            count += len(chunk)
    kept.flush()
    return kept


def linked(path: str | os.PathLike[str]) -> Path:
    """Return the file that is written by a path's name, that of a link elsewhere: links stay, as with the shell's >."""
    return Path(os.path.realpath(path) if os.path.islink(path) else path)


def check_target(path: str | os.PathLike[str], overwrite: bool = False) -> Path:
    """Return the path as a `Path` if it can be written, a new file, a pipe or a device, or raise UsageError."""
    target = Path(path)
    if is_stream(target):
        return target
    if target.is_dir():
        raise UsageError(f"{target} is a folder; expected the name of a file to write")
    folder = linked(target).parent
    if not folder.is_dir():
        raise UsageError(f"{target}: the folder {folder} does not exist; make it first")
    if target.exists() and not overwrite:
        raise UsageError(f"{target} exists; give --overwrite to replace it, or another name")
    return target


def check_disk_space(path: str | os.PathLike[str], need: int) -> None:
    """Raise DataError, in the system's own words for a full disk, unless that of ``path`` has ``need`` bytes free."""
    folder = linked(path).parent
    if is_stream(path) or not hasattr(os, "statvfs"):
        return
    with suppress(OSError):
        disk = os.statvfs(folder)
        free = disk.f_bavail * disk.f_frsize
        if disk.f_blocks and free < need:  # some file systems report no blocks
            raise DataError(
                f"{path}: {os.strerror(errno.ENOSPC)}: needs {need} bytes, {free} are free in {folder}; make room, or "
                "give a name on another disk"
            )


@contextmanager
def atomic_write(path: str | os.PathLike[str], overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` to write to, and rename it to ``path`` when the block succeeds.

    The temporary file keeps the suffix (libraries choose the format by it) and is removed on any error,
    so that no partial file remains under either name. Its content is copied to pipes and devices.

    Raises:
        UsageError: see `check_target`.
        DataError: the operating system refuses (no permission, disk full).
    """
    target = check_target(path, overwrite)
    stream = is_stream(target)
    name = f".{target.stem[:80]}.{secrets.token_hex(4)}{target.suffix}"
    place = linked(target)
    temporary = Path(tempfile.gettempdir(), name) if stream else place.with_name(name)
    _leftovers.add(temporary)
    try:
        yield temporary
        if stream:
            with open(temporary, "rb") as source, open(target, "ab") as sink:
                shutil.copyfileobj(source, sink)
        else:
            check_target(target, overwrite)  # it may have appeared meanwhile
            os.replace(temporary, place)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise DataError(f"{target}: cannot be written ({error.strerror or error})") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        _leftovers.discard(temporary)


def write_bytes(path: str | os.PathLike[str], content: bytes, overwrite: bool) -> int:
    """Write a file and return its number of bytes; errors: `atomic_write`."""
    with atomic_write(path, overwrite) as temporary:
        return temporary.write_bytes(content)


def write_arrays(path: str | os.PathLike[str], arrays: np.ndarray | dict[str, Any]) -> None:
    """Write an array as .npy, or several by name as .npz, in place of a file at ``path``; errors: `atomic_write`."""
    import numpy as np

    with atomic_write(path, overwrite=True) as temporary, open(temporary, "wb") as stream:
        if isinstance(arrays, dict):
            np.savez(stream, **arrays)
        else:
            np.save(stream, arrays, allow_pickle=False)


@contextmanager
def claim(path: str | os.PathLike[str]) -> Iterator[None]:
    """Lock ``path`` for this run within the block, so that a second run with the same output fails at once.

    The lock is on ``.NAME.lock`` beside it; the system releases it however the run ends. File systems without locks,
    and systems without `fcntl`, grant it to every run.

    Raises:
        UsageError: another process holds the lock.
    """
    target = linked(path)
    lock = target.with_name(f".{target.name[:200]}.lock")
    held = None if is_stream(path) else _lock(lock, target)
    try:
        yield
    finally:
        if held is not None:
            with suppress(OSError):
                lock.unlink(missing_ok=True)  # before the release: a waiting run then finds another file
            _leftovers.discard(lock)
            held.close()


def _lock(lock: Path, target: Path) -> IO[bytes] | None:
    """Return the open, locked lock file; None where locks are not supported."""
    try:
        import fcntl
    except ImportError:
        return None
    while True:
        try:
            held = open(lock, "ab")  # noqa: SIM115 - the caller closes it
        except OSError:
            return None  # errors of the folder are reported where the file is written
        try:
            fcntl.lockf(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            held.close()
            raise UsageError(
                f"{target}: another run is at work on it; wait until that has ended, or give another name"
            ) from None
        except OSError as error:
            if error.errno == errno.EACCES:  # on some systems: another process holds it
                held.close()
                raise UsageError(f"{target}: another run is at work on it; give another name") from None
            held.close()
            with suppress(OSError):
                lock.unlink(missing_ok=True)
            return None
        with suppress(OSError):
            if os.stat(lock).st_ino == os.fstat(held.fileno()).st_ino:
                _leftovers.add(lock)
                return held
        held.close()  # the run that held it has ended and removed the file


def discard_leftovers() -> None:
    """Remove temporary files and locks of this process, for exits that do not unwind the stack."""
    for path in list(_leftovers):
        with suppress(OSError):
            path.unlink(missing_ok=True)
