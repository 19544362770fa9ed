"""Where the machine code of kernels lies on disk, and what it is kept under.

One file a kernel and signature, ``NAME-KEY-TARGET-SIGNATURE.kernel``. KEY is a digest of the sources of every function
that the kernel reaches, of the constants it reads and of the versions of numba, llvmlite, Python and this package, so
that old code is never read; files of other keys go when a new one is written. TARGET is the processor.
"""

from __future__ import annotations

import hashlib
import inspect
import pickle
import platform
import sys
from collections.abc import Iterator
from functools import cache, cached_property
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite.binding
import numba
from numba.core import caching, compiler, config
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps

from vvgt_cli.jit import store
from vvgt_cli.jit.compile import Job, compile_in_subprocess
from vvgt_cli.jit.target import features
from vvgt_cli.version import VERSION

VERSIONS = numba.__version__, llvmlite.__version__, platform.python_version(), sys.implementation.name, VERSION
SETTINGS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DISABLE_INTEL_SVML", "USING_SVML", "CPU_FEATURES")


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _unwrapped(value: Any) -> Any:
    """The Python function behind a compiled one or an intrinsic."""
    if isinstance(value, Dispatcher):
        return value.py_func
    return getattr(value, "_defn", value) if type(value).__name__ == "_Intrinsic" else value


def _options(dispatcher: Any) -> list[tuple[str, str]]:
    """What a function is compiled with."""
    return sorted((k, repr(sorted(v) if isinstance(v, set) else v)) for k, v in dispatcher.targetoptions.items())


def reached(function: FunctionType) -> tuple[set[str], set[str]]:
    """What ``function`` is compiled from.

    Returns:
        Modules of this package whose functions or classes it reaches, its own among them; the constants it reads, with
        what the functions are compiled with.
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
            if isinstance(read, Dispatcher):
                constants.add(f"{name} with {_options(read)!r}")
            read = _unwrapped(read)
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


def _unlinked(library: tuple[str, str, tuple[bytes, bytes]]) -> tuple[str, str, tuple[bytes, bytes]]:
    """What numba keeps of a library, with bitcode of its symbols alone in place of all that others would link.

    No kernel calls another, and reading all of it would take longer than reading the machine code.
    """
    name, kind, (code, bitcode) = library
    whole = llvmlite.binding.parse_bitcode(bitcode)
    symbols = [f'define void @"{f.name}"() {{ unreachable }}' for f in whole.functions if not f.is_declaration]
    symbols += [f'@"{v.name}" = global i8 0' for v in whole.global_variables if not v.is_declaration]
    return name, kind, (code, llvmlite.binding.parse_assembly("\n".join(symbols)).as_bitcode())


def _digest(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def source_digest(function: Any, *more: Any) -> str:
    """Return the digest, 16 hexadecimal digits, of what a function is compiled from, of ``more`` and versions."""
    modules, constants = reached(_unwrapped(function))
    sources = [(module, _source(module)) for module in sorted(modules)]
    return _digest(VERSIONS, sources, sorted(constants), *more)


class KernelCache(caching._Cache):
    """What a numba dispatcher asks for the compiled form of a signature.

    On a miss it has the kernel compiled by another process and loads what that has left on disk: no process runs what
    it has compiled itself, so that a first run computes what later ones do. (Code compiled here and the same code
    loaded are linked with other copies of what kernels call, whose sums may be rounded differently.)
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
        return source_digest(self.function, _options(self.dispatcher))

    def file(self, types: tuple[Any, ...], codegen: Any) -> str:
        """Name of the file of a signature on a target."""
        triple, processor, found = codegen.magic_tuple()
        target = _digest(triple, processor, features(found), [getattr(config, name, None) for name in SETTINGS])
        described = [f"{t!r}{getattr(t, 'fields', '')}" for t in types]  # named tuples with their fields' order
        return f"{self.name}-{self.key}-{target}-{_digest(*described)}.kernel"

    @property
    def cache_path(self) -> str:
        """Folder that is written to."""
        return str(store.folder_for_writing())

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
        return next(filter(None, (store.read(folder / file) for folder in store.folders_for_reading())), None)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled form of a signature, compiled by another process if need be; None: compile it here."""
        if not self.enabled or store.WORKING:
            return None
        target_context.refresh()
        types = tuple(getattr(sig, "args", sig))
        file = self.file(types, target_context.codegen())
        payload = self.find(file)
        if payload is None:
            compile_in_subprocess([Job(self.function.__module__, self.function.__qualname__, types, file)])
            payload = self.find(file)
        if payload is None:
            return None
        return compiler.CompileResult._rebuild(target_context, *pickle.loads(payload))

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write what a worker has compiled; what has been compiled for want of one stays in this process."""
        if store.WORKING:
            library, *rest = data._reduce()
            store.write(store.WORKING, dumps((_unlinked(library), *rest)))
        elif self.enabled:
            store.warn_once(
                "kernels compiled in this process, for want of another: last digits may differ from other runs'"
            )
