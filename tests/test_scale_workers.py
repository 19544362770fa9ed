"""Blocks by shards, processes and Dask's workers: the same bytes, whoever is killed."""

import os
import re
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests import processes
from tests.headers import uncertified
from tests.test_scale import FIT, bodies
from vvgt_cli.commands.main import run as command
from vvgt_cli.errors import DataError
from vvgt_cli.files import atomic_write

SIZE = ("--blocks", "32")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A raw uint8 file of 64 x 48 x 60, and the bytes of the file that one process makes of it."""
    folder = tmp_path_factory.mktemp("made")
    path = folder / "v_64x48x60_uint8.raw"
    path.write_bytes(np.round(bodies((64, 48, 60)) * 255).astype(np.uint8).tobytes())
    assert command([str(arg) for arg in ("init", path, "-o", folder / "alone.ply", *FIT, *SIZE)]) == 0
    return path, (folder / "alone.ply").read_bytes()


@pytest.fixture
def raw(made, tmp_path):
    """The raw file, in a folder of the test's own."""
    return shutil.copy2(made[0], tmp_path / made[0].name)


@pytest.fixture
def alone(made):
    """Bytes of the file that one process makes."""
    return made[1]


def start(*args, **variables):
    """The command line in a process of its own."""
    how = {"OMP_NUM_THREADS": "1"} | variables
    return processes.start(*processes.VVGT, *args, variables=how, stdout=subprocess.DEVNULL)


def test_shards_in_any_order_and_a_merge_leave_the_same_bytes(vvgt, raw, alone, tmp_path):
    folder, out = tmp_path / "v.blocks", tmp_path / "merged.ply"
    for shard in ("2/3", "3/3"):
        assert "run the same array again" in vvgt.ok("init", raw, "-o", folder, *FIT[:-1], *SIZE, "--shard", shard).err
    assert "run the same array again" in vvgt.fails(1, "merge", folder, "-o", out)
    for shard in ("1/3", "3/3"):
        vvgt.ok("init", raw, "-o", folder, *FIT[:-1], *SIZE, "--shard", shard)
    assert "is missing; remove its other files" in vvgt.fails(1, "merge", folder, "-o", out)
    assert "all blocks are complete" in vvgt("init", raw, "-o", folder, *FIT[:-1], *SIZE, "--shard", "2/3").err
    raw.unlink()  # is not needed any more
    vvgt.ok("merge", folder, "-o", out)
    assert out.read_bytes() == alone
    assert vvgt("merge", folder, "-o", out).code == 2  # exists
    assert vvgt("merge", folder, "-o", "-").out == alone
    assert "encodes it" in vvgt.fails(2, "merge", folder, "-o", tmp_path / "a.compressed.ply")


def test_another_run_is_not_mixed_in(vvgt, raw, tmp_path):
    folder = tmp_path / "v.blocks"
    vvgt.ok("init", raw, "-o", folder, *FIT, *SIZE, "--shard", "1/2")
    other = vvgt.fails(2, "init", raw, "-o", folder, *FIT, "--tf", "viridis", *SIZE, "--shard", "1/2")
    assert "another run (other files, function)" in other
    other = vvgt.fails(2, "init", raw, "-o", folder, *FIT, "--blocks", "64", "--shard", "1/2")
    assert "another run (other blocks)" in other
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("x")
    other = vvgt.fails(2, "init", raw, "-o", tmp_path / "mine", *FIT, *SIZE, "--shard", "1/2")
    assert "holds no blocks of vvgt" in other


def test_shards_may_start_together(tmp_path, monkeypatch):
    """One looks at the folder while another writes its first file there, and goes on when it has come."""
    from vvgt_cli.field import block_store

    store, met = block_store.BlockStore(tmp_path / "v.blocks"), []

    @contextmanager
    def slowly(path, overwrite):
        with atomic_write(path, overwrite) as temporary:
            temporary.write_text("not yet whole")
            if not met:
                met.append(True)
                assert not store.open({"edge": 16}, ours=False)
            yield temporary

    monkeypatch.setattr(block_store, "atomic_write", slowly)
    assert not store.open({"edge": 16}, ours=False)
    assert store.open({"edge": 16}, ours=False)


def test_a_damaged_part_is_a_line(vvgt, raw, tmp_path):
    folder = tmp_path / "v.blocks"
    vvgt.ok("init", raw, "-o", folder, *FIT, *SIZE, "--shard", "1/1")
    rows = sorted((folder / "cells").glob("*.rows"), key=lambda path: path.stat().st_size)[-1]
    rows.write_bytes(rows.read_bytes()[:-1000])
    assert "damaged (truncated); remove" in vvgt.fails(1, "merge", folder, "-o", tmp_path / "a.ply")
    rows.with_suffix(".npz").write_bytes(b"PK nonsense")
    assert "damaged" in vvgt.fails(1, "merge", folder, "-o", tmp_path / "a.ply")
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.long
def test_dasks_workers_convert_labels_under_light(vvgt, tmp_path):
    pytest.importorskip("distributed")
    np.save(tmp_path / "v.npy", np.digitize(bodies((70, 30, 25)), [0.2, 0.6]).astype(np.uint8))
    how = ("--labels", "auto", "--light", "sun", "--max-gaussians", 300, "--screen", 48, "--steps", 6)
    line = ("convert", tmp_path / "v.npy", *how, "--blocks", 32, "-o")
    vvgt.ok(*line, tmp_path / "one.ply", "-q")
    run = start(*line, tmp_path / "two.ply", "--workers", 2, "--scheduler", "local")
    said = run.communicate(timeout=900)[1]
    assert run.returncode == 0, said
    assert "2 workers" in said
    assert uncertified(tmp_path / "two.ply") == uncertified(tmp_path / "one.ply")


def test_a_scheduler_that_is_not_there_is_a_line(vvgt, raw, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("vvgt_cli.field.runners.WAIT", "1s")
    for scheduler, code, word in (
        ("tcp://127.0.0.1:9", 1, "no Dask scheduler answers"),
        ("nonsense://x", 1, "no Dask scheduler answers"),
    ):
        run = vvgt("init", raw, "-o", tmp_path / "a.ply", *FIT, *SIZE, "--scheduler", scheduler)
        assert run.code == code, run.err
        assert word in run.err
        assert run.err.count("\n") == 1
    assert vvgt("init", raw, "-o", tmp_path / "a", *FIT, "--shard", "1/2", "--scheduler", "local").code == 2


def everyone(parent=None):
    """Command lines of all processes, or of those that one has started, by their number."""
    found = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            stat, line = (path / "stat").read_text(), (path / "cmdline").read_bytes()
        except OSError:
            continue
        if parent in (None, int(stat.rpartition(")")[2].split()[1])):
            found[int(path.name)] = line
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize("scheduler", [(), pytest.param(("--scheduler", "local"), marks=pytest.mark.long)])
def test_a_killed_worker_costs_nothing_but_time(raw, alone, tmp_path, scheduler):
    if scheduler:
        pytest.importorskip("distributed")
    run = start("init", raw, "-o", tmp_path / "two.ply", *FIT, "--blocks", 16, "--workers", 2, *scheduler)
    killed, until = 0, time.monotonic() + 900
    while run.poll() is None and time.monotonic() < until:
        workers = [pid for pid, line in everyone(run.pid).items() if b"spawn_main" in line]
        if len(workers) > bool(scheduler) and not killed and list(tmp_path.glob(".two.ply.blocks/counts/*.npz")):
            os.kill(workers[-1], signal.SIGKILL)
            killed += 1
        time.sleep(0.05)
    said = run.communicate(timeout=60)[1]
    assert run.returncode == 0, said
    assert killed == 1
    assert said == "" or not scheduler
    assert (tmp_path / "two.ply").read_bytes() == alone


def test_a_killed_run_goes_on_where_it_was(raw, alone, vvgt, tmp_path):
    run = start("init", raw, "-o", tmp_path / "a.ply", *FIT, "--blocks", 16)
    while run.poll() is None and not list(tmp_path.glob(".a.ply.blocks/cells/[0-9]*.npz")):
        time.sleep(0.005)
    run.kill()
    run.wait()
    assert not (tmp_path / "a.ply").exists()
    again = vvgt.ok("init", raw, "-o", tmp_path / "a.ply", *FIT[:-1], "--blocks", "auto")
    assert "resuming with the blocks" in again.err
    done, total = map(int, re.search(r"integrate .* (\d+) of (\d+) blocks", again.err).groups())
    assert done < total
    assert (tmp_path / "a.ply").read_bytes() == alone
    assert not (tmp_path / ".a.ply.blocks").exists()


def test_two_runs_to_one_file_do_not_meet(raw, alone, vvgt, tmp_path):
    first = start("init", raw, "-o", tmp_path / "a.ply", *FIT, *SIZE)
    while first.poll() is None and not list(tmp_path.glob(".a.ply.blocks/*/*.npz")):
        time.sleep(0.005)
    assert first.poll() is None, "it ended too early to be met"
    first.send_signal(signal.SIGSTOP)
    try:
        second = vvgt("init", raw, "-o", tmp_path / "a.ply", *FIT, *SIZE)
        assert second.code == 2
        assert "another run" in second.err
        assert second.err.count("\n") == 1
    finally:
        first.send_signal(signal.SIGCONT)
    assert first.wait(900) == 0
    assert (tmp_path / "a.ply").read_bytes() == alone


@pytest.mark.parametrize("kilobytes", [4, 30])
def test_a_disk_that_takes_no_more_is_a_line_and_the_run_goes_on_when_it_does(raw, alone, vvgt, tmp_path, kilobytes):
    """Files that may not grow any further stand for it: parts of counts, rows of cells."""
    resource = pytest.importorskip("resource")
    line = ("init", raw, "-o", tmp_path / "a.ply", *FIT, *SIZE)
    how = {"OMP_NUM_THREADS": "1"}
    grow = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (kilobytes << 10,) * 2)  # noqa: E731
    _, told = processes.python(*processes.VVGT, *line, code=1, variables=how, preexec_fn=grow)
    assert told.count("\n") == 1
    assert "File too large" in told
    assert not (tmp_path / "a.ply").exists()
    assert list((tmp_path / ".a.ply.blocks").rglob(".*")) == []  # temporary files
    vvgt.ok("init", raw, "-o", tmp_path / "a.ply", *FIT, *SIZE)
    assert (tmp_path / "a.ply").read_bytes() == alone


SBATCH = """#!/bin/sh
eval script=\\${$#}
[ -z "$SBATCH_REFUSES" ] || { echo "sbatch: error: invalid partition" >&2; exit 1; }
[ "$1" != --test-only ] || exit 0
cp "$script" "$SLURM_FAKE/job-$$.sh"
setsid bash -c "${SLURM_FIRST:-true}; bash '$SLURM_FAKE/job-$$.sh'" >"$SLURM_FAKE/job-$$.log" 2>&1 &
echo "Submitted batch job $!"
"""
SQUEUE = """#!/bin/sh
jobs=$(eval echo \\${$#} | tr '=,' '  ')
for job in ${jobs#* }; do kill -0 "$job" 2>/dev/null && { echo "$job"; known=1; }; done
[ -n "$known" ] || { echo "slurm_load_jobs error: Invalid job id specified" >&2; exit 1; }
"""
SCANCEL = """#!/bin/sh
for job; do kill -TERM -"$job" 2>/dev/null; done
true
"""


@pytest.fixture
def slurm(tmp_path):
    """A folder with an sbatch that runs jobs on this machine, and the variables under which it is found."""
    pytest.importorskip("dask_jobqueue")
    folder = tmp_path / "slurm"
    folder.mkdir()
    for name, text in (("sbatch", SBATCH), ("scancel", SCANCEL), ("squeue", SQUEUE)):
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    settings = {"DASK_JOBQUEUE__SLURM__INTERFACE": "lo", "DASK_JOBQUEUE__SLURM__ACCOUNT": "geology"}
    return folder, {"PATH": f"{folder}:{os.environ['PATH']}", "SLURM_FAKE": str(folder), **settings}


@pytest.mark.long
def test_jobs_under_slurm_leave_the_same_bytes(raw, alone, tmp_path, slurm):
    folder, variables = slurm
    options = ("--workers", 2, "--scheduler", "slurm", "--memory", "3G", "--threads", 1)
    run = start("init", raw, "-o", tmp_path / "two.ply", *FIT[:-1], *SIZE, *options, **variables)
    said = run.communicate(timeout=900)[1]
    assert run.returncode == 0, said
    assert "2 workers" in said
    assert (tmp_path / "two.ply").read_bytes() == alone
    scripts = [path.read_text() for path in folder.glob("job-*.sh")]
    assert len(scripts) == 2  # for all passes
    for line in ("#SBATCH -J vvgt-blocks", "#SBATCH -A geology", "#SBATCH --cpus-per-task=1", "#SBATCH --mem=3G"):
        assert all(line in script for script in scripts)
    assert all("export NUMBA_NUM_THREADS=1" in script for script in scripts)


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_a_slurm_job_that_ends_is_followed_by_another(raw, alone, tmp_path, slurm):
    folder, variables = slurm
    options = ("--blocks", 16, "--scheduler", "slurm", "--memory", "3G", "--threads", 1)
    run = start("init", raw, "-o", tmp_path / "a.ply", *FIT, *options, **variables)
    until = time.monotonic() + 900
    while run.poll() is None and time.monotonic() < until:
        if list(tmp_path.glob(".a.ply.blocks/counts/*.npz")):
            jobs = [path.name[4:-3] for path in folder.glob("job-*.sh")]
            for pid, line in everyone().items():
                if f"{folder}/job-{jobs[0]}.sh".encode() in line:
                    os.killpg(pid, signal.SIGKILL)
            break
        time.sleep(0.01)
    said = run.communicate(timeout=900)[1]
    assert run.returncode == 0, said
    assert len(list(folder.glob("job-*.sh"))) == 2
    assert (tmp_path / "a.ply").read_bytes() == alone


def test_slurm_that_is_not_there_or_refuses_is_a_line(vvgt, raw, tmp_path, slurm, monkeypatch):
    _, variables = slurm
    call = ("init", raw, "-o", tmp_path / "a.ply", *FIT, *SIZE, "--scheduler", "slurm")
    with monkeypatch.context() as patch:
        patch.setenv("PATH", "")
        run = vvgt(*call, "--memory", "3G")
    assert (run.code, run.err.count("\n")) == (1, 1)
    assert "sbatch not found" in run.err
    for name, value in {**variables, "SBATCH_REFUSES": "1"}.items():
        monkeypatch.setenv(name, value)
    assert "expected --memory" in vvgt.fails(2, *call)
    run = start(*call, "--memory", "3G", **variables, SBATCH_REFUSES="1")
    said = run.communicate(timeout=300)[1]
    assert (run.returncode, said.count("\n")) == (1, 1), said
    assert "sbatch refuses the job (sbatch: error: invalid partition)" in said


@pytest.fixture
def jobs(slurm, monkeypatch):
    """Jobs in this process, looked at twice a second; the variables of SLURM's stand-in as given."""
    from vvgt_cli.field import runners

    monkeypatch.setattr(runners, "AGAIN", 0.5)
    monkeypatch.setattr(runners, "memory_limit", lambda: 1e9)
    for name, value in slurm[1].items():
        monkeypatch.setenv(name, value)
    return lambda: runners.DaskRunner("slurm", 2, 1)


def test_slurm_jobs_that_all_end_early_are_reported(slurm, jobs, monkeypatch):
    monkeypatch.setenv("SLURM_FIRST", "echo no python here; exit 3")
    with (
        jobs() as runner,
        pytest.raises(DataError, match=r"all jobs ended before all blocks were done.*slurm-\d+\.out"),
    ):
        runner.run(print, range(3), None)
    assert 2 <= len(list(slurm[0].glob("job-*.sh"))) <= 8  # one that ends first on a busy machine is followed by others


@pytest.mark.long
def test_slurm_jobs_that_are_long_in_coming_are_waited_for(jobs, monkeypatch):
    monkeypatch.setenv("SLURM_FIRST", "sleep 4")
    told = []
    with jobs() as runner:
        runner.run(print, range(3), lambda done, total: told.append((done, total)))
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_a_full_disk_is_reported_before_blocks_are_written(vvgt, raw, tmp_path, monkeypatch):
    disk = SimpleNamespace(f_frsize=512, f_blocks=100000, f_bavail=200)
    monkeypatch.setattr(os, "statvfs", lambda folder: disk)
    run = vvgt("init", raw, "-o", tmp_path / "a.ply", *FIT, *SIZE)
    assert run.code == 1
    assert run.err.count("\n") == 1
    assert "No space left on device: needs" in run.err
    assert "102400 are free in" in run.err
    assert not (tmp_path / ".a.ply.blocks" / "cells").exists()
    disk.f_bavail = 400000
    run = vvgt.ok("init", raw, "-o", tmp_path / "a.ply", *FIT[:-1], *SIZE)
    need = float(re.search(r"on disk meanwhile: about (\d+) MB in .*\.a\.ply\.blocks", run.err)[1])
    folder = tmp_path / "v.blocks"
    vvgt.ok("init", raw, "-o", folder, *FIT, *SIZE, "--shard", "1/1")
    taken = sum(path.stat().st_size for path in (folder / "cells").iterdir()) + (tmp_path / "a.ply").stat().st_size
    assert 0.8 * taken < need * 1e6 < 1.5 * taken
