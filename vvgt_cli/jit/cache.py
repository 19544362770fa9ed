"""Where the machine code of kernels lies on disk, and what it is kept under.

One file a kernel and signature, ``NAME-KEY-TARGET-SIGNATURE.kernel``. KEY is a digest of the sources of every function
that the kernel reaches, of the constants it reads and of the versions of numba, llvmlite, Python and this package, so
that old code is never read; files of other keys go when a new one is written. TARGET is the processor.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import os
import pickle
import platform
import sys
import tempfile
import warnings
from collections.abc import Iterator
from functools import cache, cached_property
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite
import numba
from numba.core import caching, compiler, config
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps

from vvgt_cli import __version__

PACKAGE = Path(__file__).parent.parent
MAGIC = b"vvgt kernel 1\n"
VERSIONS = numba.__version__, llvmlite.__version__, platform.python_version(), sys.implementation.name, __version__
SETTINGS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DISABLE_INTEL_SVML", "USING_SVML", "CPU_FEATURES")
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


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _plain(value: Any) -> Any:
    """The Python function behind a compiled one or an intrinsic."""
    if isinstance(value, Dispatcher):
        return value.py_func
    return getattr(value, "_defn", value) if type(value).__name__ == "_Intrinsic" else value


def reached(function: FunctionType) -> tuple[set[str], set[str]]:
    """What ``function`` is compiled from.

    Returns:
        Modules of this package whose functions or classes it reaches, its own among them, and the constants it reads.
    """
    modules: set[str] = set()
    constants: set[str] = set()
    seen: set[int] = set()
    waiting: list[Any] = [function]
    while waiting:
        value = waiting.pop()
        modules.add(value.__module__)
        if not isinstance(value, FunctionType) or id(value) in seen:
            continue
        seen.add(id(value))
        reads = {name: value.__globals__[name] for name in _names(value.__code__) if name in value.__globals__}
        reads |= {k: v for k, v in inspect.getclosurevars(value).nonlocals.items()} if value.__closure__ else {}
        for name, read in reads.items():
            read = _plain(read)
            if isinstance(read, ModuleType):
                if read.__name__.startswith("vvgt_cli"):
                    modules.add(read.__name__)
            elif isinstance(read, FunctionType | type):
                if read.__module__.startswith("vvgt_cli"):
                    waiting.append(read)
            elif isinstance(read, bool | int | float | str | tuple) or type(read).__module__ == "numpy":
                constants.add(f"{name} = {read!r}")
            elif isinstance(read, set | frozenset):
                constants.add(f"{name} = {sorted(read)!r}")
    return modules, constants


@cache
def _source(module: str) -> bytes:
    """Digest of a module's source; of nothing where there is none (the version stands for it)."""
    file = getattr(sys.modules[module], "__file__", None)
    try:
        return hashlib.sha256(Path(file or "").read_bytes()).digest()
    except OSError:
        return b""


def _digest(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


class KernelCache(caching._Cache):
    """What a numba dispatcher asks for the compiled form of a signature.

    On a miss it has the kernel compiled by another process and loads what that has left on disk: no process runs what
    it has compiled itself, so that a first run computes what later ones do. (Code compiled here and the same code
    loaded are linked with other copies of the bodies of parallel loops, whose sums may be rounded differently.)
    """

    def __init__(self, dispatcher: Any) -> None:
        self.dispatcher = dispatcher
        self.function = dispatcher.py_func
        self.enabled = True

    @property
    def name(self) -> str:
        """Module and function."""
        return f"{self.function.__module__}.{self.function.__qualname__}".replace("<locals>.", "")

    @cached_property
    def key(self) -> str:
        """Digest of everything that is compiled, and of what compiles it."""
        modules, constants = reached(self.function)
        sources = [(module, _source(module)) for module in sorted(modules)]
        options = sorted(
            (k, repr(sorted(v) if isinstance(v, set) else v)) for k, v in self.dispatcher.targetoptions.items()
        )
        return _digest(VERSIONS, sources, sorted(constants), options)

    def file(self, types: tuple[Any, ...], codegen: Any) -> str:
        """Name of the file of a signature on a target."""
        target = _digest(codegen.magic_tuple(), [getattr(config, name, None) for name in SETTINGS])
        return f"{self.name}-{self.key}-{target}-{_digest(*(repr(t) for t in types))}.kernel"

    @property
    def cache_path(self) -> str:
        """Folder that is written to."""
        return str(folder_for_writing())

    def enable(self) -> None:
        """Read and write from here on."""
        self.enabled = True

    def disable(self) -> None:
        """Neither read nor write from here on."""
        self.enabled = False

    def flush(self) -> None:
        """Nothing is held back."""

    def find(self, file: str) -> bytes | None:
        """Contents of the first good file of that name."""
        return next(filter(None, (read(folder / file) for folder in folders_for_reading())), None)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled form of a signature, compiled by another process if need be; None: compile it here."""
        from vvgt_cli.jit import worker
        from vvgt_cli.jit.compile import Job, compile_aside

        if not self.enabled or worker.WORKING:
            return None
        target_context.refresh()
        types = tuple(getattr(sig, "args", sig))
        file = self.file(types, target_context.codegen())
        payload = self.find(file)
        if payload is None:
            compile_aside([Job(self.function.__module__, self.function.__qualname__, types, file)])
            payload = self.find(file)
        if payload is None:
            return None
        return compiler.CompileResult._rebuild(target_context, *pickle.loads(payload))

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write what a worker has compiled; what has been compiled for want of one stays in this process."""
        from vvgt_cli.jit import worker

        if worker.WORKING:
            write(worker.WORKING, dumps(data._reduce()))
        elif self.enabled:
            warn_once("kernels compiled in this process, for want of another: last digits may differ from other runs'")


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
