"""What goes to standard error: stage lines always, bars only for someone who watches, nothing when quiet."""

import io
import sys

from vvgt_cli.progress import Console


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_stage_is_one_line_with_its_time():
    stream = io.StringIO()
    Console(stream=stream).stage("read", 1.234, "64 x 64")
    assert stream.getvalue() == "read                1.23 s  64 x 64\n"


def test_bars_are_drawn_on_a_terminal_and_cleared(monkeypatch):
    clock = iter([0.0, 1.0, 1.01, 2.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    stream = Terminal()
    bar = Console(stream=stream).bar("views")
    assert bar is not None
    bar(1, 4)
    drawn = stream.getvalue()
    assert "views" in drawn
    assert "######" in drawn
    assert "1/4" in drawn
    bar(2, 4)  # 10 ms later: not drawn again
    assert stream.getvalue() == drawn
    bar(4, 4)
    assert stream.getvalue().endswith("\r\x1b[K")
    assert "\n" not in stream.getvalue()


def test_without_a_terminal_a_line_is_printed_every_half_minute(monkeypatch):
    clock = iter([0.0, 29.0, 31.0, 45.0, 62.0, 70.0, 100.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    stream = io.StringIO()
    bar = Console(stream=stream).bar("closed form")
    for done in (1, 2, 3, 4, 5, 6):
        bar(done, 6)
    assert stream.getvalue() == "closed form        31.00 s  33 %\nclosed form        62.00 s  67 %\n"


def test_quiet_runs_draw_no_bars():
    assert Console(quiet=True, stream=Terminal()).bar("views") is None


def test_quiet_says_nothing():
    stream = Terminal()
    console = Console(quiet=True, stream=stream)
    console.message("a")
    console.stage("b", 1.0)
    assert stream.getvalue() == ""


def test_a_ply_is_not_written_to_a_terminal(vvgt, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    result = vvgt("init", "example:blob:8", "-o", "-")
    assert (result.code, result.out) == (2, b"")
    assert "terminal" in result.error
