"""Damaged files for every reader: ``python tests/fuzz.py [--inputs N] [--start N] [--reader NAME] [--save FOLDER]``.

Input ``i`` of a reader is one of its seeds (tests/fuzz_seeds.py), changed in a few places by a generator that is seeded
with the reader's name and ``i``: the same number is always the same file. A reader may only return, or raise one of our
errors with one line of text, within `SECONDS` of processor time and `MEMORY` bytes. Prints one line of JSON a reader.
"""

import argparse
import json
import mmap
import os
import random
import re
import resource
import signal
import struct
import sys
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

SECONDS = 5.0  # processor time of one input; the first one of a reader also compiles and imports
FREE = 256 << 20  # what the readers are told is free
MEMORY = 1 << 30  # address space that they may add
NUMBERS = (0, 1, -1, 2, 7, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**48, 2**63 - 1, -(2**63))
WORDS = (
    *(b"0", b"-1", b"1", b"3", b"17", b"1000", b"65536", b"2147483648", b"4294967295", b"99999999999999999999", b""),
    *(b"1e308", b"-1e400", b"nan", b"inf", b"0.5", b"1e-320", b"../v.raw", b"/etc/passwd", b"\0", b"\xff\xfe", b"{}"),
    *(b"[]", b"null", b"true", b'"', b"(", b")", b"\n", b"<", b">", b"%d", b"LIST", b"none"),
)
HEAD = 400  # bytes that are changed more often than others


@dataclass
class Seed:
    """A file to change.

    Attributes:
        name: of the file, with folders.
        data: its content.
        read: takes the path; returns whatever, having looked at some of the values.
        beside: other files of the folder, which stay as they are.
        pack: applied to the changed content (compression).
    """

    name: str
    data: bytes
    read: Callable[[Path], Any]
    beside: dict[str, bytes] = field(default_factory=dict)
    pack: Callable[[bytes], bytes] = bytes


class TooSlow(BaseException):
    """An input took more than `SECONDS`; no reader catches this by mistake."""


def mutate(data: bytes, rng: random.Random) -> bytes:
    """``data`` with one to five changes, most of them near its start."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 5))):
        if not out:
            break
        at = rng.randrange(min(len(out), HEAD) if rng.random() < 0.7 else len(out))
        rng.choice(CHANGES)(out, at, rng)
    return bytes(out)


def _flip(out: bytearray, at: int, rng: random.Random) -> None:
    out[at] ^= 1 << rng.randrange(8)


def _byte(out: bytearray, at: int, rng: random.Random) -> None:
    out[at] = rng.choice((0, 255, 127, 128, rng.randrange(256)))


def _number(out: bytearray, at: int, rng: random.Random) -> None:
    size = rng.choice((1, 2, 4, 8))
    value = rng.choice((*NUMBERS, len(out))) & (256**size - 1)
    out[at : at + size] = value.to_bytes(size, rng.choice(("little", "big")))


def _float(out: bytearray, at: int, rng: random.Random) -> None:
    value = rng.choice((float("nan"), float("inf"), 0.0, -1.0, 1e-320, 1e300, 2.5))
    form = rng.choice("<>") + ("d" if abs(value) > 1e38 or rng.random() < 0.5 else "f")
    piece = struct.pack(form, value)
    out[at : at + len(piece)] = piece


def _word(out: bytearray, at: int, rng: random.Random) -> None:
    """Put another number or word where a number or word is."""
    found = re.compile(rb"[+-]?[\d.]+(?:[eE][+-]?\d+)?" if rng.random() < 0.7 else rb"[\w.]+").search(out, at)
    if found:
        words = re.findall(rb"[\w.]+", bytes(out[:4096]))
        out[found.start() : found.end()] = rng.choice(WORDS if rng.random() < 0.7 or not words else words)


def _delete(out: bytearray, at: int, rng: random.Random) -> None:
    del out[at : at + rng.choice((1, 2, 4, 8, 30, 200))]


def _double(out: bytearray, at: int, rng: random.Random) -> None:
    out[at:at] = out[at : at + rng.choice((1, 4, 8, 30, 200))]


def _insert(out: bytearray, at: int, rng: random.Random) -> None:
    out[at:at] = rng.choice((rng.choice(WORDS), rng.randbytes(rng.choice((1, 4, 8)))))


def _cut(out: bytearray, at: int, rng: random.Random) -> None:
    del out[max(at, rng.randrange(len(out))) :]


def _move(out: bytearray, at: int, rng: random.Random) -> None:
    n = rng.choice((2, 4, 8, 40))
    piece, other = out[at : at + n], rng.randrange(len(out))
    out[other : other + len(piece)] = piece


CHANGES = (_flip, _byte, _number, _number, _float, _word, _word, _word, _delete, _double, _insert, _cut, _move)


def limits() -> None:
    """Bound this process: memory that may be added, and a signal for inputs that take too long."""
    from vvgt_cli.volume import blocks
    from vvgt_cli.volume.openvdb import tree
    from vvgt_cli.volume.vtk import child as vtk_child

    blocks.free_memory = tree.free_memory = vtk_child.free_memory = lambda: FREE  # type: ignore[assignment]
    pages = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (pages + MEMORY, pages + MEMORY))

    def slow(*_: object) -> None:
        raise TooSlow

    signal.signal(signal.SIGPROF, slow)


def judge(seed: Seed, path: Path, seconds: float) -> tuple[str, str]:
    """``read``, ``refused`` or ``found``, and what was found."""
    from vvgt_cli.errors import VvgtError

    try:
        signal.setitimer(signal.ITIMER_PROF, seconds)
        seed.read(path)
        return "read", ""
    except VvgtError as error:
        text = str(error)
        if isinstance(error.__cause__, MemoryError):
            return "found", f"memory: {text[:200]}"
        if "\n" in text or not text or len(text) > 1500:
            return "found", f"message of {len(text)} characters: {text[:200]!r}"
        return "refused", ""
    except TooSlow:
        return "found", "too slow: " + _where(sys.exc_info()[2])
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return "found", f"{type(error).__name__}: {' '.join(str(error).split())[:200]} at {_where(error.__traceback__)}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _where(trace: Any) -> str:
    ours = [f for f in traceback.extract_tb(trace) if "vvgt_cli" in f.filename] or traceback.extract_tb(trace)
    return f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"


def run(name: str, seeds: list[Seed], inputs: range, save: Path | None) -> dict[str, Any]:
    """Counts of a reader's inputs, and each kind of finding with the first input that shows it."""
    counts: dict[str, Any] = {"reader": name, "inputs": len(inputs), "read": 0, "refused": 0, "found": {}}
    with tempfile.TemporaryDirectory() as folder, mmap.mmap(-1, 8) as place:
        _check_seeds(name, seeds, Path(folder))
        start = inputs.start
        while start < inputs.stop:  # a new process after one that died
            output, writer = os.pipe()
            child = os.fork()
            if not child:
                os.close(output)
                with os.fdopen(writer, "w") as lines:
                    _inputs(name, seeds, range(start, inputs.stop), Path(folder), place, lines)
                os._exit(0)
            os.close(writer)
            with os.fdopen(output) as lines:
                told = [json.loads(line) for line in lines]
            status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            start = inputs.stop
            if status:
                at = struct.unpack("<q", place[:8])[0]
                told.append([at, "found", f"the process died ({status})"])
                start = at + 1
            for i, outcome, text in told:
                if outcome == "found":
                    counts["found"].setdefault(text, i)
                    _keep(name, seeds, i, save)
                else:
                    counts[outcome] += 1
    return counts


def _check_seeds(name: str, seeds: list[Seed], folder: Path) -> None:
    """Read the seeds as they are: one that is not read shows nothing when changed."""
    for number, seed in enumerate(seeds):
        seed.read(_lay(folder / str(number), seed, seed.data))


def changed(name: str, seeds: list[Seed], i: int) -> tuple[int, bytes]:
    """Number of the seed of input ``i``, and its content before packing."""
    rng = random.Random(f"{name}:{i}")
    number = rng.randrange(len(seeds))
    return number, mutate(seeds[number].data, rng)


def _inputs(name: str, seeds: list[Seed], inputs: range, folder: Path, place: mmap.mmap, lines: TextIO) -> None:
    """Judge inputs; a line of JSON each, and the number of the present one in ``place``."""
    limits()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libraries talk
    for i in inputs:
        place[:8] = struct.pack("<q", i)
        number, data = changed(name, seeds, i)
        path = _lay(folder / str(number), seeds[number], data)
        lines.write(json.dumps([i, *judge(seeds[number], path, SECONDS)]) + "\n")
        lines.flush()


def _keep(name: str, seeds: list[Seed], i: int, save: Path | None) -> None:
    if save is not None:
        save.mkdir(parents=True, exist_ok=True)
        number, data = changed(name, seeds, i)
        (save / f"{name.replace(' ', '_')}-{i}-{Path(seeds[number].name).name}").write_bytes(seeds[number].pack(data))


def _lay(folder: Path, seed: Seed, data: bytes) -> Path:
    if not folder.exists():
        folder.mkdir()
        for name, content in seed.beside.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
    path = folder / seed.name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(seed.pack(data))
    return path


def main(arguments: list[str] | None = None) -> int:
    """Run the readers that are asked for; 1 if anything was found."""
    import fuzz_vtk
    from fuzz_microscopes import microscopes
    from fuzz_seeds import readers

    parser = argparse.ArgumentParser()
    parser.add_argument("--inputs", type=int, default=1000, help="of each reader")
    parser.add_argument("--start", type=int, default=0, help="number of the first")
    parser.add_argument("--reader", action="append", help="by name; all without")
    parser.add_argument("--save", type=Path, help="folder for inputs that show something")
    options = parser.parse_args(arguments)
    table = readers() | fuzz_vtk.readers() | microscopes()
    names = options.reader or list(table)
    status = 0
    for name in names:
        counts = run(name, table[name], range(options.start, options.start + options.inputs), options.save)
        print(json.dumps(counts), flush=True)
        status |= bool(counts["found"])
    return status


if __name__ == "__main__":
    sys.exit(main())
