"""The ``vvgt`` command, for programs whose Python cannot import it; needs no package, but VTK for messages."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
from collections.abc import Callable, Sequence
from contextlib import suppress

FOREIGN = ("PYTHONHOME", "PYTHONPATH", "LD_LIBRARY_PATH")  # of a program's own Python: ours does not start with them
ERROR = "vvgt: error: "
ENDED = "vvgt: ended: "  # a status, as vvgt_cli/commands/main.py says of each of several commands


def command() -> list[str]:
    """Return the words that start ``vvgt``, of the variable VVGT or its place in PATH, or raise RuntimeError."""
    given = os.environ.get("VVGT")
    whole = shutil.which(given or "vvgt")  # a path may hold spaces and backslashes
    words = [whole] if whole else shlex.split(given or "")
    if not words or shutil.which(words[0]) is None:
        what = f"VVGT={given}: no such program" if given else "vvgt: not in PATH"
        raise RuntimeError(f"{what}; install it, or set VVGT to its path, as /opt/venv/bin/vvgt")
    return words


def run(arguments: Sequence[str], say: Callable[[str], object] = print) -> None:
    """Run a command of ``vvgt``, such as ``["convert", "a.vti", "-o", "a.html"]``.

    ``say`` takes each line of its messages as it comes. Raise RuntimeError with its error if it fails, or is not found.
    """
    with _start(arguments, subprocess.DEVNULL) as process:
        _listen(process, say)


class Kept:
    """A process of ``vvgt`` that runs commands one after another, and so starts once; it ends with this one."""

    def __init__(self) -> None:
        """Start nothing yet."""
        self.process: subprocess.Popen[str] | None = None

    def run(self, arguments: Sequence[str]) -> None:
        """Run a command as `run` does, in a new process where the last one has ended."""
        if self.process is None or self.process.poll() is not None:
            self.process = _start(["--commands"], subprocess.PIPE)
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # it has just ended: what it said follows
            self.process.stdin.write(json.dumps(arguments) + "\n")
            self.process.stdin.flush()
        try:
            _listen(self.process, print)
        except BaseException as error:
            if not isinstance(error, RuntimeError):  # what is not read would be taken for the next command's
                self.process.kill()
                self.process.wait()
            raise

    def close(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.communicate()


def _start(arguments: Sequence[str], source: int) -> subprocess.Popen[str]:
    kept = {key: value for key, value in os.environ.items() if key not in FOREIGN}
    return subprocess.Popen(
        [*command(), *arguments], env=kept, stdin=source, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, encoding="utf-8", errors="replace",
    )  # fmt: skip


def _listen(process: subprocess.Popen[str], say: Callable[[str], object]) -> None:
    """Pass messages on until the process ends, or its command, by a line `ENDED`; raise the error of either."""
    last = ""
    for line in process.stdout or ():
        said, ended, number = line.rpartition(ENDED)
        last = (said if ended else line).strip() or last
        if ended:
            status = int(number)
            break
        if not last.startswith(ERROR):
            say(last)
    else:
        status = process.wait() or int(process.stdin is not None)  # a kept one ends by itself when something is wrong
    if status:
        raise RuntimeError(last.removeprefix(ERROR) or f"vvgt ended with status {status}")


def tell(text: str, failed: bool = False) -> None:
    """Show a line among the messages of a program on VTK."""
    from vtkmodules.vtkCommonCore import vtkOutputWindow

    window = vtkOutputWindow.GetInstance()
    (window.DisplayErrorText if failed else window.DisplayWarningText)(f"Gaussian splats: {text}\n")
