"""The same bytes on any number of threads, and room for other runs beside."""

import os
import statistics
import time

import pytest

from tests.processes import VVGT, python, start
from vvgt_cli.commands.options import THREAD_VARIABLES


def test_a_conversion_has_the_same_bytes_on_any_number_of_threads(tmp_path):
    line = ["convert", "example:blob:24", "--max-gaussians", "400", "--screen", "64", "--steps", "4", "-q", "--threads"]
    for threads in ("1", "2", "3"):
        python(*VVGT, *line, threads, "-o", f"{threads}.ply", cwd=tmp_path)
    first = (tmp_path / "1.ply").read_bytes()
    assert all((tmp_path / f"{threads}.ply").read_bytes() == first for threads in (2, 3))


@pytest.mark.long
def test_two_at_once_take_at_most_2_3_times_as_long_as_one(tmp_path):
    """Medians of five, alternated: threads that wait leave the processors to the other run."""
    line = ["convert", "example:blob:64", "--max-gaussians", "20000", "--screen", "400", "-q", "--overwrite", "-o"]

    def seconds(runs: int) -> float:
        begin = time.monotonic()
        free = {k: v for k, v in os.environ.items() if k not in THREAD_VARIABLES}
        started = [start(*VVGT, *line, f"{i}.ply", cwd=tmp_path, env=free) for i in range(runs)]
        assert [run.wait() for run in started] == [0] * runs
        return time.monotonic() - begin

    seconds(1)  # kernels and files
    pairs = [(seconds(1), seconds(2)) for _ in range(5)]
    one, two = (statistics.median(column) for column in zip(*pairs, strict=True))
    assert two <= 2.3 * one, pairs
