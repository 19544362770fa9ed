"""Libraries that single formats need: imported when such a file comes, and their errors made one of ours."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, VvgtError, pip_install


def need(module: str, extra: str, source: str, what: str) -> Any:
    """Import a module that an extra installs; raise DataError, with the command that installs it, if it is missing."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise DataError(f"{source}: {what} needs {module} ({error}); try: {pip_install(extra)}") from error


@contextmanager
def library_errors(source: str, what: str) -> Iterator[None]:
    """Make whatever is raised on a file, by libraries too, one `DataError`."""
    try:
        yield
    except VvgtError:
        raise
    except MemoryError as error:
        raise DataError(f"{source}: not enough memory to read it; try a machine with more") from error
    except Exception as error:  # libraries raise what they like on damaged files
        text = " ".join(str(error).split())[:300] or type(error).__name__
        raise DataError(f"{source}: cannot be read as {what} ({text}); check that it is whole") from error


def read_part(path: Path, name: str, index: tuple[Any, ...]) -> np.ndarray:
    """Read a part of a dataset of HDF5 from a file that is open no longer than that."""
    import h5py

    with h5py.File(path, "r") as file:
        return np.asarray(file[name][index])
