"""The cache of compiled kernels: what machine code is kept under, and how it is loaded.

One file per kernel and signature, ``NAME-KEY-TARGET-SIGNATURE.kernel``. KEY is a digest of the sources of all functions
that the kernel reaches, of the constants it reads and of the versions of numba, llvmlite, Python and this package, so
that old code is never read; files of other keys are removed when a new one is written. TARGET is the processor.
"""

from __future__ import annotations

import hashlib
import inspect
import platform
import sys
from collections.abc import Iterator
from functools import cache, cached_property
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite
import numba

from vvgt_cli.jit import store
from vvgt_cli.jit.compile import CompileJob, compile_in_subprocess
from vvgt_cli.jit.numba_internals import dump_result, load_result, options_of, processor, python_function
from vvgt_cli.version import VERSION

VERSIONS = numba.__version__, llvmlite.__version__, platform.python_version(), sys.implementation.name, VERSION


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def reached(function: FunctionType) -> tuple[set[str], set[str]]:
    """Find what ``function`` is compiled from.

    Returns:
        The modules of this package whose functions or classes it reaches, its own among them; the constants it reads,
        with what the functions are compiled with.
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
        reads |= inspect.getclosurevars(value).nonlocals if value.__closure__ else {}
        for name, read in reads.items():
            if options := options_of(read):
                constants.add(f"{name} with {options!r}")
            read = python_function(read)
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
    """Return the digest of a module's source; of nothing where it has none (the version stands for it)."""
    file = getattr(sys.modules[module], "__file__", None)
    try:
        return hashlib.sha256(Path(file or "").read_bytes()).digest()
    except OSError:
        return b""


def _digest(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def source_digest(function: Any, *more: Any) -> str:
    """Return the digest, 16 hexadecimal digits, of what a function is compiled from, of ``more`` and versions."""
    modules, constants = reached(function)
    sources = [(module, _source(module)) for module in sorted(modules)]
    return _digest(VERSIONS, sources, sorted(constants), *more)


class KernelCache:
    """Cache of a numba dispatcher: the compiled forms of its signatures.

    On a miss, another process compiles the kernel, and this one loads what that has left on disk: no process runs code
    that it has compiled itself, so that a first run computes what later ones do. (Code compiled here and the same code
    loaded are linked with other copies of what kernels call, whose sums may be rounded differently.)
    """

    def __init__(self, dispatcher: Any) -> None:
        """Serve the kernel of ``dispatcher``."""
        self.dispatcher = dispatcher
        self.function = dispatcher.py_func

    @cached_property
    def key(self) -> str:
        """Digest of everything that is compiled, and of what compiles it."""
        return source_digest(self.function, options_of(self.dispatcher))

    def file(self, types: tuple[Any, ...]) -> str:
        """Return the name of the file of a signature."""
        name = f"{self.function.__module__}.{self.function.__qualname__}".replace("<locals>.", "")
        described = [f"{t!r}{getattr(t, 'fields', '')}" for t in types]  # named tuples with their fields' order
        return f"{name}-{self.key}-{_digest(*processor())}-{_digest(*described)}.kernel"

    def find(self, file: str) -> bytes | None:
        """Return the contents of the first good file of that name, None without one."""
        return next(filter(None, (store.read(folder / file) for folder in store.folders_for_reading())), None)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled form of a signature, or None, which has numba compile it in this process."""
        if store.WORKING:
            return None
        types = tuple(getattr(sig, "args", sig))
        file = self.file(types)
        payload = self.find(file)
        if payload is None:
            compile_in_subprocess([CompileJob(self.function.__module__, self.function.__qualname__, types, file)])
            payload = self.find(file)
        return None if payload is None else load_result(target_context, payload)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write what a worker has compiled; any other process keeps what it had to compile, and warns."""
        if store.WORKING:
            store.write(store.WORKING, dump_result(data))
        else:
            store.warn_once(
                "kernels compiled in this process, for want of another: last digits may differ from other runs'"
            )
