"""Streams that are closed, full or pipes: talk that cannot be heard costs nothing, data that cannot go is one line."""

import errno
import gzip
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from tests.headers import uncertified
from vvgt_cli.files import seekable
from vvgt_cli.gaussians import read_ply
from vvgt_cli.gaussians.formats import read_splats

INIT = "init example:blob:8 --max-gaussians 20 --screen 32"
FULL = os.strerror(errno.ENOSPC)


def shell(line: str, folder: Path, **more: str) -> subprocess.CompletedProcess[str]:
    """A line for bash, in which ``vvgt`` is this program, and ``small`` as well, for small conversions."""
    define = "".join(
        f'{name}() {{ "{sys.executable}" -m {module} "$@"; }}\n'
        for name, module in (("vvgt", "vvgt_cli.commands.main"), ("small", "tests.spared"))
    )
    run = ["bash", "-c", define + line]
    return subprocess.run(run, cwd=folder, env=os.environ | more, capture_output=True, text=True, timeout=900)


@pytest.mark.parametrize("closed", ["<&- >&- 2>&-", "2>/dev/full"])
def test_streams_that_are_not_needed_do_not_matter(closed, tmp_path):
    done = shell(f"{INIT.replace('init', 'vvgt init', 1)} -o a.ply {closed}", tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(read_ply(tmp_path / "a.ply")[0])  # and no talk has got into it
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("vvgt info example:blob:8 >&-", "standard output: it is closed"),
        (f"vvgt {INIT} -q -o - >/dev/full", f"standard output: {FULL}"),
        ("vvgt --help >/dev/full", f"standard output: {FULL}"),
    ],
)
def test_data_that_cannot_be_written_is_one_line(line, told, tmp_path):
    done = shell(line, tmp_path)
    assert (done.returncode, done.stderr) == (1, f"vvgt: error: {told}\n")


@pytest.fixture
def head(tmp_path: Path) -> Path:
    """A compressed volume and a function, in a folder of their own."""
    np.save(tmp_path / "head.npy", np.arange(512, dtype=np.float32).reshape(8, 8, 8))
    (tmp_path / "head.npy.gz").write_bytes(gzip.compress((tmp_path / "head.npy").read_bytes()))
    points = [{"x": x, "rgb": [1, 1, 0], "opacity": 0.8 * x} for x in (0, 1)]
    (tmp_path / "tf.json").write_text(json.dumps({"range": [0, 511], "points": points}))
    return tmp_path


MAKE = "--max-gaussians 50 --screen 32 --steps 2 -q"


def test_volumes_functions_and_outputs_through_pipes(head):
    plain = shell(f"small convert head.npy --tf tf.json {MAKE} -o a.ply", head)
    assert plain.returncode == 0, plain.stderr
    for i, line in enumerate(
        (
            f"small convert <(gunzip -c head.npy.gz) --tf <(cat tf.json) {MAKE} -o >(cat > b0.ply) && sleep 0.3",
            f"gunzip -c head.npy.gz | small convert /dev/stdin --tf tf.json {MAKE} -o /dev/stdout > b1.ply",
            f"mkfifo out.ply; cat out.ply > b2.ply & small convert head.npy --tf tf.json {MAKE} -o out.ply && wait",
        )
    ):
        done = shell(line, head)
        assert done.returncode == 0, (line, done.stderr)
        assert uncertified(head / f"b{i}.ply") == uncertified(head / "a.ply"), line  # which names the volume


def test_info_of_pipes(head):
    assert shell(f"vvgt {INIT} -o g.ply -q", head).returncode == 0
    for kind, name in {"volume": "head.npy", "transfer function": "tf.json", "gaussians": "g.ply"}.items():
        done = shell(f"vvgt info <(cat {name}) --json", head)
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["kind"] == kind


def test_an_error_in_a_pipe_names_the_pipe(head):
    done = shell("mkfifo v.npy; head -c 200 head.npy > v.npy & vvgt info v.npy", head)
    assert done.returncode == 1
    assert done.stderr.startswith("vvgt: error: v.npy: ")
    assert "/proc/self" not in done.stderr


def test_a_pipe_is_read_once_and_not_beyond_the_memory(tmp_path, monkeypatch):
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    writer = threading.Thread(target=lambda: fifo.write_bytes(b"x" * 3000))
    writer.start()
    kept = seekable(fifo)
    writer.join()
    assert kept.read_bytes() == seekable(fifo).read_bytes() == b"x" * 3000
    assert seekable(tmp_path) == tmp_path
    monkeypatch.setattr("vvgt_cli.files.free_memory", lambda: 1 << 20)
    second = tmp_path / "second"
    os.mkfifo(second)
    threading.Thread(target=lambda: second.write_bytes(b"x" * 3000)).start()
    with pytest.raises(Exception, match=r"the free memory is used up after .* write them to a file first"):
        seekable(second)


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a folder that nobody can write to")
def test_nothing_but_the_output_need_be_writable(tmp_path):
    """The working folder, the home and the temporary folder are none that could be written to."""
    line = f"vvgt convert example:blob:8 --max-gaussians 20 --screen 32 --steps 2 -q -o {tmp_path}/a.ply"
    done = shell(line, Path("/proc"), HOME="/proc", TMPDIR="/proc", XDG_CACHE_HOME="/proc")
    assert (done.returncode, done.stderr) == (0, "")
    assert len(read_ply(tmp_path / "a.ply")[0])


def test_a_format_goes_to_a_fifo_as_it_is(head):
    line = f"mkfifo out.spz; cat out.spz > b.spz & small convert head.npy --tf tf.json {MAKE} -o out.spz"
    done = shell(f"small convert head.npy --tf tf.json {MAKE} -o a.spz; {line} && wait", head)
    assert done.returncode == 0, done.stderr
    assert len(read_splats(head / "b.spz")[0]) == len(read_splats(head / "a.spz")[0])
