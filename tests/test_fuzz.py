"""Every reader of ours against damaged files (tests/fuzz.py), in a process of their own; 100,000 each with --long."""

import json
import os
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from fuzz import Seed, mutate, run

from vvgt_cli.errors import DataError

ROOT = Path(__file__).parent.parent


def test_damaged_files_end_in_one_of_our_errors(request: pytest.FixtureRequest) -> None:
    inputs = 100_000 if request.config.getoption("--long") else 100
    command = [sys.executable, "tests/fuzz.py", "--inputs", str(inputs)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.stdout, done.stderr
    for line in done.stdout.splitlines():
        counts = json.loads(line)
        assert not counts["found"], line
        assert counts["read"] + counts["refused"] == inputs
        assert counts["read"] >= inputs // 100, f"{line}: the changes leave nothing to read"
        assert counts["refused"] >= inputs // 10, f"{line}: the changes damage nothing"
    assert done.returncode == 0, done.stderr


def _raise(error: BaseException, cause: BaseException | None = None) -> None:
    raise error from cause


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        (lambda: _raise(KeyError("a")), "KeyError: 'a'"),
        (lambda: _raise(DataError("two\nlines")), "message of 9 characters"),
        (lambda: _raise(DataError("none left"), MemoryError()), "memory: none left"),
        (lambda: os.kill(os.getpid(), 9), "the process died (-9)"),
    ],
)
def test_the_fuzzer_finds_what_is_wrong(tmp_path: Path, fault: Callable[[], None], text: str) -> None:
    seeds = [Seed("v", b"whole", lambda path: None if path.read_bytes() == b"whole" else fault())]
    counts = run("bad", seeds, range(5), tmp_path)
    assert [found.startswith(text) for found in counts["found"]] == [True], counts
    assert (tmp_path / f"bad-{next(iter(counts['found'].values()))}-v").read_bytes() != b"whole"


def test_a_number_is_always_the_same_input() -> None:
    data = bytes(range(256)) * 4
    assert mutate(data, random.Random("NRRD:5")) == mutate(data, random.Random("NRRD:5"))
    assert len({mutate(data, random.Random(f"NRRD:{i}")) for i in range(50)}) > 40
