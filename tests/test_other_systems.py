"""What Windows and macOS lack is done without: run here with these parts of the system taken away."""

import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests import vtk_files
from tests.refused import refused
from vvgt_cli.errors import DataError
from vvgt_cli.jit import store
from vvgt_cli.jit.compile import usual_jobs
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.vtk import child

KERNELS = ("vvgt_cli.refine.steps:adam", "vvgt_cli.refine.steps:adam_sizes")


def kernels_of(folder: Path, before: str = "") -> dict[str, bytes]:
    """Compile two kernels by a worker, after the code ``before``; what it leaves."""
    folder.mkdir()
    code = f"import os, pickle, sys; {before}from vvgt_cli.jit.worker import run; sys.exit(run(*pickle.load(sys.stdin.buffer)))"  # noqa: E501
    (folder.parent / "worker.py").write_text(f"if __name__ == '__main__':\n    {code}\n")
    order = pickle.dumps((folder, usual_jobs(KERNELS, ("float32",))))
    done = subprocess.run(
        [sys.executable, folder.parent / "worker.py"],
        input=order,
        capture_output=True,
        check=True,
        env=os.environ | {"PYTHONHASHSEED": "0"},
    )
    assert done.stdout.count(b"done") == len(usual_jobs(KERNELS, ("float32",)))
    return {path.name: path.read_bytes() for path in folder.glob("*.kernel")}


def test_without_fork_kernels_are_compiled_to_the_same_code(tmp_path):
    """All but a digest and the random identifiers of a compilation, about 60 bytes, is the same."""
    forked, spawned = kernels_of(tmp_path / "forked"), kernels_of(tmp_path / "spawned", "del os.fork; ")
    assert {name: len(code) for name, code in spawned.items()} == {name: len(code) for name, code in forked.items()}
    assert len(forked) == len(KERNELS)
    for name, code in forked.items():
        assert sum(a != b for a, b in zip(code, spawned[name], strict=True)) < 200


def test_a_kernel_that_another_process_reads_stays(tmp_path, monkeypatch):
    def held(*_):
        raise PermissionError

    path = tmp_path / "a-key-cpu-0.kernel"
    store.write(path, b"code")
    (old := tmp_path / "a-older-cpu-0.kernel").write_bytes(b"")
    monkeypatch.setattr(Path, "replace", held)
    with monkeypatch.context() as within:
        unlink = Path.unlink
        within.setattr(Path, "unlink", lambda p, **options: held() if p == old else unlink(p, **options))
        store.write(path, b"code")
    assert store.read(path) == b"code"
    assert sorted(p.name for p in tmp_path.iterdir()) == [path.name, old.name]
    with pytest.raises(PermissionError):
        store.write(tmp_path / "b-key-cpu-0.kernel", b"code")


def test_without_limits_of_processes_vtk_still_reads(tmp_path, monkeypatch):
    path = vtk_files.exodus(tmp_path)
    expected = read_volume(str(path), ReadOptions(array="ramp"))
    monkeypatch.setattr(child, "START", "import sys; sys.modules['resource'] = None; " + child.START)
    np.testing.assert_array_equal(read_volume(str(path), ReadOptions(array="ramp")).data, expected.data)


def test_without_posix_signals_a_reader_that_breaks_down_is_one_line(tmp_path, monkeypatch):
    """Windows has neither SIGKILL nor SIGXCPU; a reader that is ended there has a positive status."""
    code = "import signal; del signal.SIGKILL, signal.SIGXCPU; import vvgt_cli.volume.vtk.child as c; print(*c.STOPPED)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == str(1 << 30)
    monkeypatch.setattr(child, "START", "raise SystemExit(1)")
    refused(DataError, r"broke down \(status 1\)", read_volume, str(vtk_files.exodus(tmp_path)))


def test_text_in_a_pipe_is_utf_8_on_windows_too():
    code = "import os; import vvgt_cli.commands.process as p; os.name = 'nt'; p.open_streams(); print('20° ⤢')"
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONIOENCODING": "cp1252"}, capture_output=True
    )
    assert done.stdout == "20° ⤢\n".encode(), done.stderr


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not there")
def test_files_of_the_page_have_the_same_bytes_in_every_checkout():
    """`vvgt info` prints hashes of the page's scripts, which git must not give other line ends."""
    names = "vvgt_cli/gaussians/formats/page/page.html", "vvgt_cli/gaussians/formats/page/viewer.js.gz"
    root = Path(__file__).parent.parent
    found = subprocess.run(["git", "check-attr", "eol", "--", *names], cwd=root, capture_output=True, text=True)
    if found.returncode:
        pytest.skip("not a clone")
    assert [line.split(": ")[-1] for line in found.stdout.splitlines()] == ["lf", "lf"]
