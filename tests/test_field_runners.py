"""Processes that do blocks: the same ones in all passes, and none that is left."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.processes import start
from vvgt_cli.errors import DataError
from vvgt_cli.field.runners import IDLE, Processes

MINUTE = 60.0
posix = pytest.mark.skipif(sys.platform == "win32", reason="needs signals of POSIX")


@dataclass(frozen=True)
class Sign:
    """Leaves the number of the process that did a block."""

    folder: Path
    wrong: bool = False
    kind: str = "signs"
    deadly: bool = False
    seconds: float = 0.0

    def __len__(self) -> int:
        return 6

    def __call__(self, number: int) -> None:
        if self.wrong:
            raise ValueError("as asked for")
        (self.folder / f"{os.getpid()}_{number}").touch()
        time.sleep(self.seconds)
        if self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)


def signed(folder: Path) -> set[int]:
    return {int(path.name.split("_")[0]) for path in folder.iterdir()}


def ended(pid: int) -> bool:
    """Whether a process ends within a minute; on Linux also if nobody asks for its status, so that it stays as Z."""
    until, stat = time.monotonic() + MINUTE, Path(f"/proc/{pid}/stat")
    while time.monotonic() < until:
        try:
            os.kill(pid, 0)
            if sys.platform == "linux" and stat.read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except (ProcessLookupError, FileNotFoundError):
            return True
        time.sleep(0.05)
    return False


def test_the_same_processes_do_all_passes_and_end_with_the_context(tmp_path):
    with Processes(2, 2) as runner:
        for _ in range(3):
            runner.run(Sign(tmp_path), range(6), None)
    pids = signed(tmp_path)
    assert 1 <= len(pids) <= 2
    assert os.getpid() not in pids
    assert all(map(ended, pids))


def test_others_follow_those_that_an_error_has_ended(tmp_path):
    with Processes(2, 2) as runner:
        with pytest.raises(ValueError, match="as asked for"):
            runner.run(Sign(tmp_path, wrong=True), range(6), None)
        runner.run(Sign(tmp_path), range(6), None)
    assert len(list(tmp_path.iterdir())) == 6


@posix
def test_one_that_is_killed_between_two_passes_is_none_of_those_that_do_no_block(tmp_path):
    with Processes(1, 1) as runner:
        runner.run(Sign(tmp_path), range(6), None)
        (idle,) = signed(tmp_path)
        os.kill(idle, signal.SIGKILL)
        assert ended(idle)
        with pytest.raises(DataError, match=f"killed {IDLE} times before finishing a block"):
            runner.run(Sign(tmp_path, deadly=True), range(6), None)
    assert len(signed(tmp_path) - {idle}) == IDLE


def started(folder: Path, within: str) -> subprocess.Popen[str]:
    """A program, first of its group, that does ``within`` with a ``runner`` and a ``folder``."""
    lines = "import signal\nimport time\nfrom pathlib import Path\nfrom tests.test_field_runners import Sign, signed\n"
    lines += "from vvgt_cli.field.runners import Processes\n"
    lines += "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a test in the background ignores it
    lines += f"if __name__ == '__main__':\n    folder = Path({str(folder)!r})\n    with Processes(2, 2) as runner:\n"
    file = folder.with_suffix(".py")
    file.write_text(lines + "".join(f"        {line}\n" for line in within.splitlines()))
    return start(file, start_new_session=True)


def there(file: Path) -> None:
    """Wait until a file is, a minute at most."""
    until = time.monotonic() + MINUTE
    while not file.exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert file.exists()


@posix
def test_processes_end_with_one_that_is_killed(tmp_path):
    run = started(
        tmp_path, "runner.run(Sign(folder), range(6), None)\nfolder.with_suffix('.done').touch()\ntime.sleep(600)"
    )
    there(tmp_path.with_suffix(".done"))
    run.kill()
    run.wait()
    pids = signed(tmp_path)
    assert pids
    assert all(map(ended, pids))


@posix
def test_an_interrupt_of_all_between_two_passes_leaves_the_processes_silent_and_there(tmp_path):
    run = started(
        tmp_path,
        "runner.run(Sign(folder), range(6), None)\nbefore = signed(folder)\n"
        "try:\n    folder.with_suffix('.done').touch()\n    time.sleep(600)\n"
        "except KeyboardInterrupt:\n    time.sleep(1)\n"
        "runner.run(Sign(folder), range(6), None)\nassert before & signed(folder) == before\n"
        "alive = [Path(f'/proc/{pid}').exists() for pid in before]\nassert all(alive) or not Path('/proc').exists()",
    )
    there(tmp_path.with_suffix(".done"))
    os.killpg(run.pid, signal.SIGINT)
    assert run.communicate(timeout=MINUTE)[1] == ""
    assert run.returncode == 0


@posix
def test_an_interrupt_within_a_pass_does_not_wait_for_its_blocks(tmp_path):
    run = started(tmp_path, "runner.run(Sign(folder, seconds=600.0), range(6), None)")
    until = time.monotonic() + MINUTE
    while not signed(tmp_path) and time.monotonic() < until:
        time.sleep(0.05)
    os.killpg(run.pid, signal.SIGINT)
    said = run.communicate(timeout=MINUTE)[1]
    assert said.count("Traceback") == 1  # of the program itself
    assert all(map(ended, signed(tmp_path)))
