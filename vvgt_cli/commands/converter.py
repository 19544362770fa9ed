"""Background conversions for an open viewer page, in a separate process.

The process reads the volume once and keeps it for every function that the page sends. Jobs reach its standard input as
pickles, and messages leave its standard output the same way. It exits when the input closes. A new job replaces the
running one: the process is killed unless only scores are missing.
"""

from __future__ import annotations

import atexit
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

from vvgt_cli.errors import DataError, VvgtError
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians.formats.page_values import Values
from vvgt_cli.look import LabelTable, LightOptions, TransferFunction
from vvgt_cli.resources import kill_group, memory_limit

START = ("-c", f"from {__package__}.converter_process import main; main()")  # of Python, for the process


@dataclass(frozen=True)
class ConsoleLine:
    """A line for the console."""

    line: str


@dataclass(frozen=True)
class Progress:
    """Progress of a job, in words."""

    text: str


@dataclass(frozen=True)
class Converted:
    """Gaussians that a job produced; `Scored` follows if they were converted.

    Attributes:
        ply: the file that `vvgt convert` would write, without a certificate.
        files: of the first job the page's text, named "", and the file it loads; of later jobs the `.ply` to swap in.
        values: of the volume, with its look if the page can change that.
    """

    ply: bytes
    files: dict[str, bytes]
    values: Values | None = None


@dataclass(frozen=True)
class Scored:
    """Scores of the Gaussians that were produced last.

    Attributes:
        ply: the file with its certificate.
        psnr: dB on the test views.
    """

    ply: bytes
    psnr: float


@dataclass(frozen=True)
class Failed:
    """Error that ended a job."""

    error: VvgtError


Message = ConsoleLine | Progress | Converted | Scored | Failed

# the look to convert for and its light, by default the first ones; None: the page
Job = tuple[TransferFunction | LabelTable | None, LightOptions | None] | None


class Converter:
    """Context that converts a volume in the background: one job at a time, the latest.

    Args:
        source: volume and look to convert.
        name: of what is shown, without ending.
        on_message: called with a job's number and a message about it, on another thread, which holds ``lock``.
    """

    def __init__(self, source: SourceRequest, name: str, on_message: Callable[[int, Message], None]) -> None:
        """Create the converter; no process is started yet."""
        self._source, self._name, self._on_message = source, name, on_message
        self.lock = threading.RLock()
        self._process: subprocess.Popen[bytes] | None = None
        self._number, self._busy, self._scoring = 0, False, False
        self._folder: str | None = None

    def __enter__(self) -> Converter:
        """Make the folder for temporary files."""
        self._folder = tempfile.mkdtemp(prefix="vvgt-view-")
        atexit.register(self._close)  # where interrupts come so fast that the context is not left in order
        return self

    def __exit__(self, *error: object) -> None:
        """End the process and remove the folder."""
        closing = threading.Thread(target=self._close)  # which a second interrupt does not reach
        closing.start()
        closing.join()

    def _close(self) -> None:
        with self.lock:
            if self._folder is None:
                return
            self._number += 1
            self._end()
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None
            atexit.unregister(self._close)

    def submit(self, job: Job) -> int:
        """Start a job in place of the running one, if any, and return its number.

        A process that only lacks scores is kept: the next job may continue from its result.
        """
        with self.lock:
            if self._folder is None:
                return self._number  # it is over
            if self._busy:
                self._end()
            self._number += 1
            process = self._process or self._begin()
            with suppress(OSError):  # it has ended: `_listen` says so
                pickle.dump((self._number, job), cast(IO[bytes], process.stdin))
                cast(IO[bytes], process.stdin).flush()
            self._busy, self._scoring = True, False
            return self._number

    def cancel(self) -> None:
        """End the running job, if any; no further message about it arrives."""
        with self.lock:
            self._number += 1
            self._scoring = False
            if self._busy:
                self._end()

    @property
    def process(self) -> int | None:
        """Return the process id, None if no process runs."""
        return self._process.pid if self._process else None

    def _begin(self) -> subprocess.Popen[bytes]:
        folder = cast(str, self._folder)
        paths = os.pathsep.join(filter(None, [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]))
        self._process = subprocess.Popen(
            [sys.executable, *START, folder],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
            env={**os.environ, "PYTHONPATH": paths, "TMPDIR": folder, "TEMP": folder, "TMP": folder},
        )  # fmt: skip
        with suppress(OSError):
            pickle.dump((self._source, self._name, memory_limit()), cast(IO[bytes], self._process.stdin))
        threading.Thread(target=self._listen, args=(self._process,), daemon=True).start()
        return self._process

    def _end(self) -> None:
        """Kill the process with all that it started, and remove its temporary files."""
        process, self._process, self._busy, self._scoring = self._process, None, False, False
        if process is None:
            return
        kill_group(process)
        process.wait()
        for name in os.listdir(cast(str, self._folder)):
            shutil.rmtree(os.path.join(cast(str, self._folder), name), ignore_errors=True)

    def _listen(self, process: subprocess.Popen[bytes]) -> None:
        """Pass on the messages of a process as long as they are about the latest job."""
        stream = cast(IO[bytes], process.stdout)
        while True:
            try:
                number, message = cast(tuple[int, Any], pickle.load(stream))
            except (EOFError, OSError, pickle.UnpicklingError, ValueError):
                number, message = self._number, None
            with self.lock:
                if self._process is not process:
                    return
                if message is None:  # it has ended by itself
                    awaited = self._busy or self._scoring
                    self._end()
                    message = Failed(DataError("out of memory? The system ended the conversion; try --crop"))
                    if awaited:
                        self._on_message(number, message)
                    return
                if number != self._number:
                    continue
                if isinstance(message, Converted | Scored | Failed):
                    self._busy, self._scoring = False, isinstance(message, Converted) and not message.values
                self._on_message(number, message)
