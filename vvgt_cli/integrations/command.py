"""The ``vvgt`` command, for programs whose Python cannot import it; needs no package, but VTK for messages."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Callable, Sequence

FOREIGN = ("PYTHONHOME", "PYTHONPATH", "LD_LIBRARY_PATH")  # of a program's own Python: ours does not start with them
ERROR = "vvgt: error: "


def command() -> list[str]:
    """Return the words that start ``vvgt``: those of the environment variable VVGT, else its place in PATH.

    Raises:
        RuntimeError: there is none.
    """
    given = os.environ.get("VVGT")
    whole = shutil.which(given or "vvgt")  # a path may hold spaces and backslashes
    found = [whole] if whole else shlex.split(given or "")
    if not found or shutil.which(found[0]) is None:
        what = f"VVGT={given}: no such program" if given else "vvgt: not in PATH"
        raise RuntimeError(f"{what}; install it (pip install vvgt) or set VVGT to its path, as /opt/venv/bin/vvgt")
    return found


def run(arguments: Sequence[str], say: Callable[[str], object] = print) -> None:
    """Run a command of ``vvgt``, such as ``["convert", "a.vti", "-o", "a.html"]``.

    Args:
        arguments: words behind ``vvgt``.
        say: takes each line of its messages as it comes.

    Raises:
        RuntimeError: it is not found, or it failed: its error.
    """
    kept = {key: value for key, value in os.environ.items() if key not in FOREIGN}
    with subprocess.Popen(
        [*command(), *arguments], env=kept, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, encoding="utf-8", errors="replace",
    ) as process:  # fmt: skip
        last = ""
        for line in process.stdout or ():
            last = line.strip()
            if not last.startswith(ERROR):
                say(last)
    if process.returncode:
        raise RuntimeError(last.removeprefix(ERROR) or f"vvgt ended with status {process.returncode}")


def tell(text: str, failed: bool = False) -> None:
    """Show a line among the messages of a program on VTK."""
    from vtkmodules.vtkCommonCore import vtkOutputWindow

    window = vtkOutputWindow.GetInstance()
    (window.DisplayErrorText if failed else window.DisplayWarningText)(f"Gaussian splats: {text}\n")
