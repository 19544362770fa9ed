"""Process of `converter`: reads a volume once, makes its page, and converts it for one look after the other."""

from __future__ import annotations

import os
import pickle
import shutil
import sys
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import IO, NoReturn

import numpy as np

from vvgt_cli.commands.converter import ConsoleLine, Converted, Failed, Job, Message, Progress, Scored
from vvgt_cli.commands.live_site import cloud_of, page_files, stored
from vvgt_cli.conversion.convert import convert_one
from vvgt_cli.conversion.opened import open_field, ply_options
from vvgt_cli.conversion.previous_look import PreviousLook
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.conversion.result import Conversion
from vvgt_cli.errors import DataError, VvgtError
from vvgt_cli.field.layered import open_content
from vvgt_cli.field.open import automatic
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import Gaussians, as_ply
from vvgt_cli.gaussians.formats import PAGE
from vvgt_cli.look import LabelTable, Lighting
from vvgt_cli.progress import Console, ProgressCallback
from vvgt_cli.resources import set_memory
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.volume import ReadOptions

INTERVAL = 0.2  # seconds between two words of progress


class MessageConsole(Console):
    """A console that sends its lines and bars as messages."""

    def __init__(self, send: Callable[[Message], None]) -> None:
        """Send messages by ``send``."""
        super().__init__()
        self.send = send

    def progress(self, line: str) -> None:
        """Send a line."""
        self.send(ConsoleLine(line))

    def bar(self, label: str) -> ProgressCallback | None:
        """Return a callback that sends progress in words, at most every `INTERVAL` seconds."""
        last = 0.0
        self.send(Progress(label))

        def draw(done: int, total: int) -> None:
            nonlocal last
            if time.monotonic() - last >= INTERVAL:
                last = time.monotonic()
                self.send(Progress(f"{label} {100 * done // max(total, 1)} %"))

        return draw


class LoadedVolume:
    """Volume of a request, read once if it fits in memory."""

    def __init__(self, source: SourceRequest, name: str, console: Console) -> None:
        """Read the volume, unless it is better processed in blocks."""
        self.source, self.name = source, name
        self.lighting: Lighting | None = None  # of the function to begin with
        self.last: PreviousLook | None = None  # what the next conversion goes on from
        if automatic(source, Console(quiet=True)) is None:  # `open_field` reports it
            console.bar("reading")
            content = open_content(source.path, source.read)
            self.source = replace(source, volume=content, read=ReadOptions())

    def send_page(self, console: MessageConsole) -> None:
        """Send the page of the volume without Gaussians, or with a conversion if its look cannot be changed."""
        request = ConvertRequest(self.source)
        why = PAGE.lacks("the page.html")
        with open_field(Run(console, ConversionReport("view")), request, ()) as field:
            values, self.lighting = field.source.values(), field.source.tf.lighting
            if values is not None and values.look is not None and why is None:
                corners = field.source.volume.unit_frame().half
                ply = as_ply(hidden(corners), ply_options(request, field.source))
                console.send(Converted(ply, page_files(*cloud_of(ply), self.name, values), values))
                return
        console.message(f"converted first: {why or 'its look cannot be changed: colours, or too many labels'}")
        self._converted(request, console, self._with_page)

    def convert(self, job: Job, console: MessageConsole) -> None:
        """Send a conversion for labels, a function on data values with an opacity unit distance, or the first look."""
        assert job is not None
        look, light = job
        source = replace(self.source, light=light or self.source.light)
        if look is None:
            pass
        elif isinstance(look, LabelTable):
            source = replace(source, labels=look)
        else:
            lit = replace(look, lighting=self.lighting)
            source = replace(source, tf=lit, tf_range="data", unit_distance=None)
        self.last = PreviousLook(self._converted(ConvertRequest(source), console, _plain_file))

    def _converted(
        self, request: ConvertRequest, console: MessageConsole, message: Callable[[Conversion], Converted]
    ) -> Conversion:
        """Convert; send ``message(conversion)`` before the scores are known, then the scores."""
        conversion = convert_one(
            request, console, warm=self.last, unscored=lambda unscored: console.send(message(unscored))
        )
        assert conversion.scores is not None
        console.send(Scored(_file(conversion), conversion.scores["psnr"]))
        return conversion

    def _with_page(self, conversion: Conversion) -> Converted:
        """Return a conversion with its page: the libraries that a page needs are loaded here already."""
        ply = _file(conversion)
        return Converted(ply, page_files(*cloud_of(ply), self.name, None))


def hidden(half: Sequence[float]) -> Gaussians:
    """Return two invisible Gaussians (unit frame) at the ends of a box, for a page that has no others yet."""
    ends = np.array([half, half], np.float32) * [[-1], [1]]
    turned = np.tile(np.array([1, 0, 0, 0], np.float32), (2, 1))
    return Gaussians(
        ends.astype(np.float32), np.full((2, 3), -9, np.float32), turned, np.full(2, -20, np.float32),
        np.zeros((2, 3), np.float32),
    )  # fmt: skip


def _plain_file(conversion: Conversion) -> Converted:
    """Return a conversion with the `.ply` that an open page swaps in."""
    return Converted(_file(conversion), {"ply": stored(conversion.gaussians, conversion.ply)})


def _file(conversion: Conversion) -> bytes:
    return as_ply(conversion.gaussians, conversion.ply, conversion.normals())


def main() -> None:
    """Run jobs until the input ends; the first argument is the folder of temporary files, removed at the end."""
    folder = sys.argv[1]
    orders, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print
    try:
        source, name, memory = pickle.load(orders)
    except Exception:
        _exit(folder)
    set_memory(memory)
    jobs: list[tuple[int, Job]] = []
    waiting = threading.Semaphore(0)
    threading.Thread(target=_receive, args=(orders, folder, jobs, waiting), daemon=True).start()
    volume: LoadedVolume | None = None
    while True:
        waiting.acquire()
        number, job = jobs.pop(0)

        def send(message: Message, number: int = number) -> None:
            _send(answers, folder, (number, message))

        warnings.showwarning = partial(_note, send)
        console = MessageConsole(send)
        try:
            volume = volume or LoadedVolume(source, name, console)
            if job is None:
                volume.send_page(console)
            else:
                volume.convert(job, console)
        except VvgtError as error:
            send(Failed(_plain(error)))
        except MemoryError:
            send(Failed(DataError("out of memory: try a smaller volume (--crop)")))
        except OSError as error:
            send(Failed(DataError(f"{error.filename}: {error.strerror}" if error.filename else str(error))))
        except Exception as error:
            send(Failed(DataError(f"internal: {type(error).__name__}: {error} (a bug)")))


def _note(send: Callable[[Message], None], message: object, *rest: object) -> None:
    """Send a warning as a line, in place of `warnings.showwarning`."""
    send(ConsoleLine(f"vvgt: note: {message}"))


def _plain(error: VvgtError) -> VvgtError:
    """Return an error with its line and exit status alone, which can be pickled."""
    plain = VvgtError(str(error))
    plain.exit_code = error.exit_code
    return plain


def _send(stream: IO[bytes], folder: str, message: tuple[int, Message]) -> None:
    try:
        pickle.dump(message, stream)
        stream.flush()
    except OSError:
        _exit(folder)


def _receive(stream: IO[bytes], folder: str, jobs: list[tuple[int, Job]], waiting: threading.Semaphore) -> None:
    """Append jobs to ``jobs`` as they arrive, and signal each."""
    while True:
        try:
            jobs.append(pickle.load(stream))
        except Exception:  # the end of the input, in the middle of a job too
            _exit(folder)
        waiting.release()


def _exit(folder: str) -> NoReturn:
    """Exit because the other side has ended; remove the temporary folder."""
    for _ in range(10):  # for a job still writes into it
        shutil.rmtree(folder, ignore_errors=True)
        if not os.path.exists(folder):
            break
    os._exit(0)
