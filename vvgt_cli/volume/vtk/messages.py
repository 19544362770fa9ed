"""VTK's messages, which go to the terminal otherwise, as text."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from vvgt_cli.errors import DataError


@contextmanager
def quiet_vtk() -> Iterator[Any]:
    """Keep VTK's messages from the terminal; yields a function that returns the first, or every one."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow

    window, before = vtkStringOutputWindow(), vtkOutputWindow.GetInstance()
    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkOutputWindow.SetInstance(window)
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)

    def message(errors: bool = False, every: bool = False) -> str:
        # "ERROR: In file, line n\nclass (0x..): text"
        output = window.GetOutput() or ""
        if isinstance(output, bytes):  # with something in it that is no text
            output = output.decode("utf-8", "replace")
        # of binary legacy files VTK leaves what is missing as it is in memory, and calls that a warning
        output = re.sub(
            r"Generic Warning: (In [^\n]*\n)(?=Error reading binary)", r"ERROR: \1vtkDataReader (0x0): ", output
        )
        head = r"ERROR: In [^\n]*\n[^\n]*" if errors else ""
        texts = re.findall(head + r"\((?:0x[0-9a-f]+|nullptr)\): ([^\n]+)", output)
        return re.sub(r" \(0x[0-9a-f]+\)", "", "\n".join(texts if every else texts[:1])).strip()

    try:
        yield message
    finally:
        vtkOutputWindow.SetInstance(before)
        vtkLogger.SetStderrVerbosity(verbosity)


def checked(output: Any, reader: Any, message: Any, path: object, what: str) -> Any:
    """Return what a reader found; warn of its warnings, and raise DataError that it cannot read ``what`` for errors."""
    error, note = message(errors=True), message()
    if error or reader.GetErrorCode() or output is None:
        raise DataError(f"{path}: VTK cannot read {what} ({error or note or 'no message'}); is the file whole?")
    if note:
        warnings.warn(f"{path}: VTK says: {note}", stacklevel=3)
    return output
