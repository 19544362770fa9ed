"""Memory and processors that this process may use, within the limits of its job, cgroups and options."""

from __future__ import annotations

import ctypes
import math
import os
import re
import signal
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vvgt_cli.errors import UsageError

PROC = Path("/proc")
UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
TOP_PAD = 64 << 20  # bytes by which the heap grows beyond what is asked for
UNLIMITED = 1 << 60  # cgroup v1 writes a number near 2^63 where there is no limit
_heap: Any = None  # function that tells how much freed memory is kept, if any is
_asked: int | None = None  # bytes that the whole process may take (`--memory`)


def parse_size(text: str) -> int:
    """Parse ``4G``, ``500M``, ``4GiB`` or a number to bytes; units are powers of 1024, as in job schedulers.

    Raises:
        UsageError: the text is not a size.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]?)(?:I?B)?\s*", text.upper())
    if match is None or float(match[1]) <= 0:
        raise UsageError(f"{text!r} is not a size of memory; expected a number with K, M, G or T, as 4G")
    return int(float(match[1]) * UNITS[match[2]])


class _Heap(ctypes.Structure):
    """What `mallinfo2` returns (malloc.h)."""

    _fields_ = [
        *((name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks")),
        *((name, ctypes.c_size_t) for name in ("uordblks", "fordblks", "keepcost")),
    ]


def keep_freed_memory() -> None:
    """Make the C library keep freed memory for later arrays (glibc 2.33 and later), not return it to the system.

    The system clears every page that it hands out, which takes a tenth of a conversion's time on a virtual machine
    (docs/log/conversion.md).
    """
    global _heap
    trim_threshold, top_pad, mmap_max = -1, -2, -4  # of malloc.h
    with suppress(AttributeError, OSError, TypeError):  # another C library
        library = ctypes.CDLL(None)
        _heap = library.mallinfo2
        _heap.restype = _Heap
        for option, value in ((trim_threshold, -1), (top_pad, TOP_PAD), (mmap_max, 0)):
            library.mallopt(option, value)


def return_freed_memory() -> None:
    """Return to the system what `keep_freed_memory` keeps."""
    if _heap is not None:
        ctypes.CDLL(None).malloc_trim(0)


def set_memory(limit: int | None) -> None:
    """Limit the memory of the whole process to ``limit`` bytes; None removes the limit."""
    global _asked
    _asked = limit


def memory_limit() -> int | None:
    """Return the limit of `set_memory`, bytes."""
    return _asked


def free_memory() -> int | None:
    """Return the bytes of memory that this process can still allocate, None where the system does not report it.

    This is the minimum of the free memory of the machine, of every cgroup (v1 and v2) above the process, of the limits
    of the process (RLIMIT_AS, RLIMIT_DATA), and of `set_memory` less what the process and its workers hold.
    Freed memory that the C library keeps counts as free.
    """
    limits = [
        *_machine(),
        *(room for room in map(_free_in_group, _groups("memory")) if room is not None),
        *_own_limits(),
    ]
    if _asked is not None:
        from multiprocessing import active_children

        others = (_table(PROC / str(child.pid) / "status") for child in active_children())  # idle workers
        limits.append(_asked - _status().get("VmRSS", 0) - sum(other.get("RssAnon", 0) for other in others))
    kept = 0 if _heap is None else max(_heap().fordblks - TOP_PAD, 0)  # the end of the heap may be untouched
    return max(min(limits) + kept, 0) if limits else None


def processors() -> int:
    """Return the number of CPUs that affinity and cgroup quotas leave to this process."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for group in _groups("cpu"):
        quota = group.words("cpu.max") or [*group.words("cpu.cfs_quota_us"), *group.words("cpu.cfs_period_us")]
        if len(quota) == 2 and all(word.isdecimal() and int(word) > 0 for word in quota):  # not "max", not -1
            count = min(count, math.ceil(int(quota[0]) / int(quota[1])))
    return max(count, 1)


def _machine() -> list[int]:
    """Return the free memory of the machine, bytes, in a list that is empty where it is unknown."""
    free = _table(PROC / "meminfo").get("MemAvailable")
    if free is not None:
        return [free]
    try:
        return [os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    except (OSError, ValueError, AttributeError):
        return []


def _own_limits() -> Iterator[int]:
    try:
        import resource
    except ImportError:
        return
    for limit, held in ((resource.RLIMIT_AS, "VmSize"), (resource.RLIMIT_DATA, "VmData")):
        soft = resource.getrlimit(limit)[0]
        if soft != resource.RLIM_INFINITY:
            yield soft - _status().get(held, 0)


def _status() -> dict[str, int]:
    return _table(PROC / "self" / "status")


def _table(path: Path) -> dict[str, int]:
    """Return the lines ``Name: N kB`` of a file, in bytes; empty without the file."""
    try:
        text = path.read_text("ascii", "replace")
    except OSError:
        return {}
    return {name: int(number) * 1024 for name, number in re.findall(r"^(\w+):\s+(\d+) kB$", text, re.M)}


@dataclass(frozen=True)
class Group:
    """A cgroup of the process, or an ancestor of it, by its folder."""

    folder: Path

    def words(self, name: str) -> list[str]:
        """Return the words of a file of the group; none without the file."""
        try:
            return (self.folder / name).read_text("ascii", "replace").split()
        except OSError:
            return []

    def number(self, *names: str) -> int | None:
        """Return the number in the first existing file of ``names``; None where it is not a number."""
        words = next(filter(None, map(self.words, names)), [""])
        return int(words[0]) if words[0].isdecimal() else None

    def counter(self, name: str) -> int:
        """Return an entry of memory.stat, 0 without one."""
        words = self.words("memory.stat")
        return next((int(value) for key, value in zip(words[::2], words[1::2], strict=False) if key == name), 0)


def _free_in_group(group: Group) -> int | None:
    """Return the bytes that a cgroup leaves, None without a limit; cached files count as free."""
    limits = [group.number(name) for name in ("memory.max", "memory.high", "memory.limit_in_bytes")]
    known = [limit for limit in limits if limit is not None and limit < UNLIMITED]
    used = group.number("memory.current", "memory.usage_in_bytes")
    if not known or used is None:
        return None
    total = "" if group.words("memory.current") else "total_"  # in v1, with descendant groups
    files = sum(group.counter(f"{total}{kind}_file") for kind in ("active", "inactive"))
    return min(known) - max(used - files, 0)


def _groups(controller: str) -> Iterator[Group]:
    """Yield the cgroups (v1 and v2) of the process, from its own up to the mount point.

    Source: cgroups(7), proc_pid_cgroup(5), proc_pid_mountinfo(5). A container may see only a subtree, whose root the
    mount names.
    """
    try:
        own = (PROC / "self" / "cgroup").read_text("utf-8", "replace").splitlines()
        mounts = (PROC / "self" / "mountinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        return
    paths: dict[str, str] = {}  # by controller; "" is v2
    for line in own:
        _, names, path = line.split(":", 2)
        paths |= dict.fromkeys(names.split(","), path)
    for line in mounts:
        before, _, after = line.partition(" - ")
        fields, kind = before.split(), after.split()
        if len(fields) < 5 or len(kind) < 3 or kind[0] not in ("cgroup", "cgroup2"):
            continue
        name = "" if kind[0] == "cgroup2" else controller
        if name not in paths or (name and name not in kind[2].split(",")):
            continue
        own_path, root, place = Path(paths[name]), Path(fields[3]), Path(fields[4].replace("\\040", " "))
        inside = own_path.relative_to(root) if own_path.is_relative_to(root) else Path()
        folder = place / inside
        yield from (Group(each) for each in (folder, *folder.parents) if each.is_relative_to(place))


def kill_group(process: Any) -> None:
    """Kill a `subprocess.Popen` that began a session, with all that it started; on Windows it alone."""
    with suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
