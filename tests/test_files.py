"""Writing: one run at a time to a name, disks that are full, and what is left where a run is killed."""

import os
import resource
import signal
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.processes import start
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import atomic_write, check_disk_space, claim
from vvgt_cli.gaussians import read_ply

INIT = ("init", "example:blob:8", "--max-gaussians", "20", "--screen", "32")


def process(code: str, folder: Path, *args: object) -> subprocess.Popen[str]:
    """Python in a process of its own; it says a line once it is where it should be."""
    return start("-c", code, *args, cwd=folder, stdin=subprocess.PIPE)


HOLD = "from vvgt_cli.files import claim\nwith claim('a.ply'):\n    print('held', flush=True)\n    input()\n"


def test_the_second_of_two_runs_to_one_name_fails_at_once(tmp_path, vvgt, monkeypatch):
    monkeypatch.chdir(tmp_path)
    holder = process(HOLD, tmp_path)
    assert holder.stdout.readline() == "held\n"
    result = vvgt(*INIT, "-o", "a.ply")
    assert (result.code, result.error) == (
        2, "vvgt: error: a.ply: another run is at work on it; wait until that has ended, or give another name",
    )  # fmt: skip
    vvgt.ok(*INIT, "-o", "b.ply")
    holder.communicate("\n")
    vvgt.ok(*INIT, "-o", "a.ply")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "b.ply"]


def test_a_run_that_is_killed_leaves_no_lock(tmp_path):
    holder = process(HOLD, tmp_path)
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(UsageError, match="another run"), claim(tmp_path / "a.ply"):
        pass
    holder.send_signal(signal.SIGKILL)
    holder.communicate()
    with claim(tmp_path / "a.ply"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_two_equal_series_in_one_folder(tmp_path, vvgt, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("f0", "f1"):
        (tmp_path / f"{name}_8x8x8_uint8.raw").write_bytes(bytes(range(256)) * 2)
    holder = process(HOLD.replace("a.ply", "manifest.json"), tmp_path)
    assert holder.stdout.readline() == "held\n"
    line = ("convert", "f*.raw", *INIT[2:], "--steps", "0", "-o", "p_{}.ply")
    assert "manifest.json: another run is at work on it" in vvgt.fails(2, *line)
    holder.communicate("\n")
    vvgt.ok(*line)


def test_where_there_are_no_locks_everyone_may_write(tmp_path, monkeypatch):
    import fcntl

    def refuse(*args):
        raise OSError(37, "No locks available")

    monkeypatch.setattr(fcntl, "lockf", refuse)
    with claim(tmp_path / "a"):
        assert list(tmp_path.iterdir()) == []


def test_a_link_stays_and_its_file_is_written(tmp_path):
    (tmp_path / "scratch").mkdir()
    link, place = tmp_path / "a.ply", tmp_path / "scratch" / "b.ply"
    link.symlink_to(place)
    for content, overwrite in ((b"1", False), (b"2", True)):
        with atomic_write(link, overwrite) as temporary:
            temporary.write_bytes(content)
        assert (link.is_symlink(), place.read_bytes()) == (True, content)
    assert [path.name for path in place.parent.iterdir()] == ["b.ply"]
    (tmp_path / "c.ply").symlink_to(tmp_path / "none" / "c.ply")
    with pytest.raises(UsageError, match="none does not exist"), atomic_write(tmp_path / "c.ply"):
        pass


def test_a_full_disk_is_reported_before_the_work(tmp_path, vvgt, monkeypatch):
    monkeypatch.chdir(tmp_path)
    disk = {"f_frsize": 512, "f_blocks": 1000, "f_bavail": 4}
    monkeypatch.setattr(os, "statvfs", lambda folder: SimpleNamespace(**disk))
    result = vvgt.fails(1, "convert", *INIT[1:], "-o", "a.ply")
    assert "No space left on device: needs 4096 bytes, 2048 are free" in result
    disk["f_bavail"] = 8  # enough to begin with; not for the Gaussians that are found
    result = vvgt("convert", "example:blob:8", "--max-gaussians", "200", "--screen", "32", "-o", "a.ply")
    assert (result.code, "No space left on device" in result.error) == (1, True)
    assert "closed form" in result.err
    assert "test views" not in result.err
    disk["f_blocks"] = 0  # a file system that does not tell
    check_disk_space(tmp_path / "a", 1 << 40)


def test_what_the_disk_does_not_take_is_put_elsewhere(tmp_path, vvgt, monkeypatch):
    """A limit of file sizes stands for the disk: the name it fails under is the one with the limit."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    code = "\n".join(
        [
            "import resource, sys, tempfile",
            "import vvgt_cli.conversion.gaussian_files as render",
            "from vvgt_cli.commands.main import run",
            f"tempfile.tempdir = {str(elsewhere)!r}",
            "find = tempfile.gettempdir",
            "def lifted():",
            "    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)",
            "    return find()",
            "render.tempfile.gettempdir = lifted",
            "make = render.atomic_write",
            "def limited(path, overwrite=False):",
            "    if str(path) == 'a.ply':",
            "        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))",
            "    return make(path, overwrite)",
            "render.atomic_write = limited",
            f"sys.exit(run([*{INIT!r}, '-o', 'a.ply']))",
        ]
    )
    done = process(code, tmp_path)
    _, told = done.communicate()
    assert done.returncode == 1
    line = told.splitlines()[-1]
    assert line.startswith("vvgt: error: a.ply: cannot be written (File too large); the Gaussians were saved to ")
    place = Path(line.rpartition(" saved to ")[2])
    assert place.parent == elsewhere
    assert 0 < len(read_ply(place)[0]) <= 20
    assert [path.name for path in tmp_path.iterdir()] == ["elsewhere"]


def test_a_full_disk_while_writing_is_in_the_systems_words(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        said = pytest.raises(DataError, match=r"a\.bin: cannot be written \(File too large\)")
        with said, atomic_write(tmp_path / "a.bin") as temporary:
            temporary.write_bytes(bytes(1000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []
