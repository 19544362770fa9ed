"""Signals that end: within seconds from any stage, one line, nothing partial; a hangup counts unless it is ignored."""

import os
import resource
import signal
from pathlib import Path

import pytest

from tests.processes import start
from vvgt_cli.commands.process import ending

# A march of so many rays that it takes minutes, in one kernel, while a file is being written.
LONG = """
import signal, sys, threading
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run under nohup
from vvgt_cli.conversion.stages import ClosedFormStage
from vvgt_cli.commands import main
from vvgt_cli.files import atomic_write
from vvgt_cli.closed_form.moments import base_cells
from vvgt_cli.closed_form.visibility import visibility
import numpy as np

def closed_form(self, work):
    from vvgt_cli.cameras import default_views
    with atomic_write("b.ply") as temporary:
        temporary.write_bytes(b"half")
        cells = base_cells(work.field.scene, np.zeros(3, np.int64))
        visibility(work.field.scene, cells, default_views("train", 1, size=8))  # loads the kernel
        threading.Timer(1.0, print, ["in the kernel"], {"flush": True}).start()
        visibility(work.field.scene, cells, default_views("train", 1, size=50_000))

ClosedFormStage.run = closed_form
main.main()
"""
# The handler alone, where nobody else listens.
ALONE = """
import os, signal, sys, time
from vvgt_cli.commands.process import end_on_signals
signal.signal(signal.SIGHUP, signal.SIG_IGN)
end_on_signals()
os.kill(os.getpid(), signal.SIGHUP)
print("alive", flush=True)
os.kill(os.getpid(), signal.SIGTERM)
time.sleep(60)
"""
# Signals at many moments of a command that does nothing but draw one Gaussian; a run after the other in one process.
OFTEN = """
import os, random, signal, sys, threading, time, types
import click, numpy as np
from vvgt_cli.cameras import default_views
from vvgt_cli.commands import main, process
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.splat import render

@click.command()
def command():
    ready.set()
    latest = time.monotonic() + process.GRACE
    while time.monotonic() < latest:
        render(gaussian, camera)
    sys.exit(128 + number)  # nothing that is raised gets through in __del__: the other thread ends the process then

def send():
    ready.wait()
    ready.clear()
    time.sleep(rng.uniform(0, 5e-3))
    os.kill(os.getpid(), number)

gaussian = Gaussians(np.zeros((1, 3)), np.full((1, 3), -3.0), np.eye(1, 4), np.zeros(1), np.full((1, 3), 0.5))
camera = default_views("test", 1, size=16)[0]
render(gaussian, camera)  # loads the kernels
ready, rng, number = threading.Event(), random.Random(0), getattr(signal, sys.argv[1])
main.COMMANDS.append("often")
sys.modules["vvgt_cli.commands.often"] = types.SimpleNamespace(command=command)
process._listen = lambda reader: None  # nothing but what is raised ends a run
signal.signal(signal.SIGINT, signal.default_int_handler)
process.end_on_signals()
for _ in range(200):
    thread = threading.Thread(target=send)
    thread.start()
    print(main.run(["often"]), flush=True)
    thread.join()
os._exit(0)
"""


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="processor time of a child is in /proc")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_kernel_that_runs_for_minutes_is_ended_within_seconds(name, tmp_path):
    number = getattr(signal, name)
    child = start("-c", LONG, "init", "example:blob:16", "--max-gaussians", "20", "-q", "-o", "a.ply", cwd=tmp_path)
    assert child.stdout.readline() == "in the kernel\n", child.communicate()
    before = sum(map(int, Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()[11:15]))
    ended = sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])
    child.send_signal(number)
    _, told = child.communicate()
    spent = sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2]) - ended - before / os.sysconf("SC_CLK_TCK")
    assert spent < 2  # of processor time, which other people's load leaves as it is
    assert (child.returncode, told) == (128 + number, f"vvgt: error: ended by {name}\n")
    assert list(tmp_path.iterdir()) == []


def test_a_hangup_that_is_ignored_stays_so(tmp_path):
    child = start("-c", ALONE, cwd=tmp_path)
    out, told = child.communicate()
    assert (child.returncode, out, told) == (128 + signal.SIGTERM, "alive\n", "")


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT"])
def test_no_kernel_that_is_being_called_swallows_a_signal(name, tmp_path):
    number = getattr(signal, name)
    out, told = start("-c", OFTEN, name, cwd=tmp_path).communicate(timeout=120)
    status, line = (130, "interrupted") if name == "SIGINT" else (128 + number, f"ended by {name}")
    assert out.split() == 200 * [str(status)], told[-2000:]
    assert told.splitlines() == 200 * [f"vvgt: error: {line}"]


def test_a_step_that_ends_is_told_of_signals_that_are_not_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN), signal.getsignal(signal.SIGTERM)
    try:
        with ending() as caught:
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            assert signal.getsignal(signal.SIGTERM) is not before[1]
            signal.raise_signal(signal.SIGTERM)
        assert caught == [signal.SIGTERM]
        assert signal.getsignal(signal.SIGTERM) is before[1]
    finally:
        signal.signal(signal.SIGHUP, before[0])
