"""Memory and processors are the job's: machine, cgroups at every level, limits of the process, and what was asked."""

import ctypes
import gzip
import multiprocessing
import os
import resource
import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.processes import python
from vvgt_cli import resources
from vvgt_cli.errors import UsageError
from vvgt_cli.resources import free_memory, parse_size, processors, set_memory

ROOT = Path(__file__).parent.parent
V1 = Path("/sys/fs/cgroup/memory")
GIB = 1 << 30


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine made of files, with 64 GiB free; returns a function that writes one of them."""
    monkeypatch.setattr(resources, "PROC", tmp_path / "proc")
    monkeypatch.setattr(resource, "getrlimit", lambda limit: (resource.RLIM_INFINITY,) * 2)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(16)))

    def write(name: str, text: str) -> None:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.replace("ROOT", str(tmp_path)))

    write("proc/meminfo", f"MemTotal: 99 kB\nMemAvailable:   {64 << 20} kB\n")
    write("proc/self/status", f"Name: vvgt\nVmSize: {4 << 20} kB\nVmData: {2 << 20} kB\nVmRSS: {1 << 20} kB\n")
    write("proc/self/cgroup", "")
    write("proc/self/mountinfo", "")
    yield write
    set_memory(None)


def test_the_machine_alone(machine):
    assert (free_memory(), processors()) == (64 * GIB, 16)


def v2(machine, own: str = "/job/step", root: str = "/") -> None:
    machine("proc/self/cgroup", f"0::{own}\n")
    machine("proc/self/mountinfo", f"30 20 0:26 {root} ROOT/cg rw - cgroup2 cgroup2 rw\n")


@pytest.mark.parametrize("level", ["job/step", "job", "."])
def test_every_level_of_v2_counts(level, machine):
    v2(machine)
    for each in ("job/step", "job"):
        machine(f"cg/{each}/memory.max", "max\n")
        machine(f"cg/{each}/cpu.max", "max 100000\n")
    machine(f"cg/{level}/memory.max", f"{8 * GIB}\n")
    machine(f"cg/{level}/memory.current", f"{5 * GIB}\n")
    machine(f"cg/{level}/memory.stat", f"anon 1\nactive_file {GIB}\ninactive_file {GIB}\n")
    machine(f"cg/{level}/cpu.max", "250000 100000\n")
    assert (free_memory(), processors()) == (5 * GIB, 3)


def test_memory_high_holds_as_max_does(machine):
    v2(machine)
    for name, value in (("max", 9 * GIB), ("high", 4 * GIB), ("current", GIB)):
        machine(f"cg/job/memory.{name}", f"{value}\n")
    assert free_memory() == 3 * GIB


def test_a_container_sees_its_part_of_the_tree(machine):
    v2(machine, "/docker/abc/step", "/docker/abc")
    machine("cg/step/memory.max", f"{2 * GIB}\n")
    machine("cg/step/memory.current", "0\n")
    assert free_memory() == 2 * GIB


def test_v1_with_its_unlimited_groups(machine):
    machine("proc/self/cgroup", "4:memory:/slurm/job\n3:cpu,cpuacct:/slurm/job\n1:name=systemd:/\n0::/\n")
    mounts = (("memory", "memory"), ("cpu", "cpu,cpuacct"))
    machine("proc/self/mountinfo", "".join(f"3 2 0:9 / ROOT/{d} rw - cgroup cgroup rw,{o}\n" for d, o in mounts))
    machine("memory/slurm/job/memory.limit_in_bytes", "9223372036854771712\n")
    machine("memory/slurm/job/memory.usage_in_bytes", "4096\n")
    machine("memory/slurm/memory.limit_in_bytes", f"{6 * GIB}\n")
    machine("memory/slurm/memory.usage_in_bytes", f"{4 * GIB}\n")
    machine("memory/slurm/memory.stat", f"active_file 7\ntotal_active_file {GIB}\ntotal_inactive_file 0\n")
    machine("cpu/slurm/job/cpu.cfs_quota_us", "-1\n")
    machine("cpu/slurm/job/cpu.cfs_period_us", "100000\n")
    machine("cpu/slurm/cpu.cfs_quota_us", "50000\n")
    machine("cpu/slurm/cpu.cfs_period_us", "100000\n")
    assert (free_memory(), processors()) == (3 * GIB, 1)


@pytest.mark.parametrize(("limit", "left"), [("RLIMIT_AS", 6), ("RLIMIT_DATA", 8)])
def test_limits_of_the_process(limit, left, machine, monkeypatch):
    number = getattr(resource, limit)
    soft = {number: (10 * GIB, 20 * GIB)}
    monkeypatch.setattr(resource, "getrlimit", lambda of: soft.get(of, (resource.RLIM_INFINITY,) * 2))
    assert free_memory() == left * GIB


def test_what_was_asked_for_less_what_is_held(machine, monkeypatch):
    set_memory(parse_size("4G"))
    assert free_memory() == 3 * GIB
    machine("proc/7/status", f"VmRSS: {2 << 20} kB\nRssAnon: {1 << 20} kB\n")
    monkeypatch.setattr(multiprocessing, "active_children", lambda: [SimpleNamespace(pid=7)])
    assert free_memory() == 2 * GIB  # what the worker shares with the process is counted once
    set_memory(1)
    assert free_memory() == 0


def test_sizes():
    assert [parse_size(text) for text in ("4096", "1.5k", "2 MiB", "4G", "1tb")] == [
        4096, 1536, 2 << 20, 4 * GIB, 1 << 40,
    ]  # fmt: skip
    for text in ("", "4X", "-1", "0", "G", "1e9", "nan"):
        with pytest.raises(UsageError, match="is not a size of memory; expected a number with K, M, G or T, as 4G"):
            parse_size(text)


def big(folder: Path, mib: int = 3400) -> Path:
    """A small .nii.gz that unpacks to ``mib`` MiB of float32 zeros."""
    head = bytearray(352)
    struct.pack_into("<i", head, 0, 348)
    struct.pack_into("<8h", head, 40, 3, 1024, 1024, mib // 4, 1, 1, 1, 1)
    struct.pack_into("<h", head, 70, 16)
    struct.pack_into("<8f", head, 76, 1, 1, 1, 1, 0, 0, 0, 0)
    struct.pack_into("<3f", head, 108, 352, 1, 0)
    head[344:348] = b"n+1\0"
    path = folder / "big.nii.gz"
    with gzip.open(path, "wb", compresslevel=1) as out:
        out.write(head)
        for k in range(mib):
            out.write(np.full(1 << 18, k, "<f4").tobytes())
    return path


def test_a_volume_that_does_not_fit_is_refused(tmp_path, vvgt):
    path = big(tmp_path, 64)
    little = resources._status()["VmRSS"] + (48 << 20)
    refused = vvgt.fails(1, "convert", path, "-o", tmp_path / "a.ply", "--memory", little)
    assert refused.startswith("vvgt: error: big.nii.gz: needs 67108864 bytes (0.0625 GiB) of memory, ")
    assert " more, or store it uncompressed" in refused


def test_info_reads_what_the_memory_does_not_hold(tmp_path, vvgt):
    path = big(tmp_path, 64)
    values = np.arange(64, dtype=np.float32).repeat(1 << 18)
    (tmp_path / "big_1024x1024x16_float32.raw.gz").write_bytes(gzip.compress(values.tobytes(), 1))
    head = "NRRD0004\ntype: float\ndimension: 3\nsizes: 1024 1024 16\nendian: little\nencoding: gzip\n\n"
    (tmp_path / "big.nrrd").write_bytes(head.encode() + gzip.compress(values.tobytes(), 1))
    for name in (path.name, "big.nrrd", "big_1024x1024x16_float32.raw.gz"):
        whole = vvgt("info", tmp_path / name, "--json")
        little = resources._status()["VmRSS"] + (48 << 20)
        slabs = vvgt("info", tmp_path / name, "--json", "--memory", little)
        assert (whole.code, slabs.code) == (0, 0), slabs.err
        assert slabs.out == whole.out
    damaged = path.read_bytes()
    path.write_bytes(damaged[: len(damaged) // 2])
    assert "big.nii.gz: damaged gzip data" in vvgt.fails(1, "info", path, "--memory", little)


@pytest.mark.long
@pytest.mark.skipif(not os.access(V1, os.W_OK), reason="no cgroup can be made here")
def test_in_a_group_of_2_gib_a_file_that_unpacks_to_more_is_refused_or_read_not_killed(tmp_path):
    group = V1 / f"vvgt-test-{os.getpid()}"
    group.mkdir()
    try:
        (group / "memory.limit_in_bytes").write_text(str(2 * GIB))
        path = big(tmp_path)
        join = f"open({str(group / 'cgroup.procs')!r}, 'w').write('0')"
        code = f"{join}\nfrom vvgt_cli.commands.main import main\nmain()\n"
        python("-c", code, "info", path)
        _, told = python("-c", code, "convert", path, "-o", tmp_path / "a.ply", code=1)
        assert "big.nii.gz: needs 3565158400 bytes (3.32 GiB) of memory, " in told
    finally:
        group.rmdir()


def test_freed_memory_is_kept_for_later_arrays_and_counts_as_free():
    code = """
import numpy as np
from vvgt_cli.resources import _status, free_memory, keep_freed_memory, set_memory
keep_freed_memory()
before = _status()["VmRSS"]
held = [np.ones(8 << 20) for _ in range(4)]
end = np.ones(1 << 17)  # above them: they are not at the end of the heap
del held
kept = _status()["VmRSS"] - before
set_memory(2 << 30)
print(kept >> 20, (free_memory() - ((2 << 30) - before)) >> 20)
"""
    kept, lost = map(int, python("-c", code)[0].split())
    assert kept > 200 or not hasattr(ctypes.CDLL(None), "mallinfo2")
    assert lost > -60


@pytest.mark.parametrize("threads", [0, 1])
def test_a_process_ends_after_its_exit_functions_and_threads(threads):
    text = f"""
import atexit, threading, time
from vvgt_cli.commands.process import leave
atexit.register(print, "end", flush=True)
for _ in range({threads}):
    threading.Thread(target=lambda: (time.sleep(0.2), print("thread", flush=True))).start()
print("begin", end=" ")
leave(3)
"""
    assert python("-c", text, code=3)[0].split() == ["begin", *threads * ["thread"], "end"]
