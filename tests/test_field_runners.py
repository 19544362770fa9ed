"""Processes that do blocks: the same ones in all passes, and none that is left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from vvgt_cli.field.runners import Processes

ROOT = Path(__file__).parent.parent
MINUTE = 60.0


@dataclass(frozen=True)
class Sign:
    """Leaves the number of the process that did a block."""

    folder: Path
    wrong: bool = False
    kind: str = "signs"

    def __len__(self) -> int:
        return 6

    def __call__(self, number: int) -> None:
        if self.wrong:
            raise ValueError("as asked for")
        (self.folder / f"{os.getpid()}_{number}").touch()


def signed(folder: Path) -> set[int]:
    return {int(path.name.split("_")[0]) for path in folder.iterdir()}


def ended(pid: int) -> bool:
    """Whether a process ends within a minute."""
    until = time.monotonic() + MINUTE
    while time.monotonic() < until:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
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


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_processes_end_with_one_that_is_killed(tmp_path):
    program = (
        "import time\nfrom pathlib import Path\nfrom tests.test_field_runners import Sign\n"
        "from vvgt_cli.field.runners import Processes\n"
        "if __name__ == '__main__':\n"
        "    with Processes(2, 2) as runner:\n"
        f"        runner.run(Sign(Path({str(tmp_path)!r})), range(6), None)\n"
        f"        Path({str(tmp_path.with_suffix('.done'))!r}).touch()\n"
        "        time.sleep(600)\n"
    )
    file = tmp_path.with_suffix(".py")
    file.write_text(program)
    run = subprocess.Popen([sys.executable, str(file)], env={**os.environ, "PYTHONPATH": str(ROOT)})
    until = time.monotonic() + MINUTE
    while not tmp_path.with_suffix(".done").exists() and time.monotonic() < until:
        time.sleep(0.05)
    run.send_signal(signal.SIGKILL)
    run.wait()
    pids = signed(tmp_path)
    assert pids
    assert all(map(ended, pids))
