"""Bad calls and bad input: the exit status, one line, and nothing left behind."""

import importlib.metadata
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest

from tests.processes import python
from vvgt_cli import __version__
from vvgt_cli.commands import main
from vvgt_cli.commands.options import THREAD_VARIABLES, default_threads
from vvgt_cli.errors import DataError, pip_install

RAW = ("--dims", 8, 8, 8, "--dtype", "uint8")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working directory with a raw volume and two transfer functions."""
    monkeypatch.chdir(tmp_path)
    np.arange(512, dtype=np.uint16).astype(np.uint8).tofile("v.raw")
    points = [{"x": 0, "rgb": [1, 0, 0], "opacity": 0.1}, {"x": 1, "rgb": [0, 0, 1], "opacity": 0.9}]
    Path("good.json").write_text(json.dumps({"range": [0, 255], "points": points}))
    clear = [{**point, "opacity": 0} for point in points]
    Path("clear.json").write_text(json.dumps({"range": [0, 255], "points": clear}))
    Path("broken.json").write_text('{"range": [0, 255], "points": [')
    Path("gaussians.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\n")
    np.save("none.npy", np.zeros((4, 0, 4)))
    Path("not.ply").write_bytes(b"solid cube\n")
    return tmp_path


CONVERT = ("convert", "v.raw", *RAW, "-o", "out.ply")
# (command line, exit status, what the line must say)
CASES = {
    "missing volume": (("convert", "no.raw", *RAW, "-o", "out.ply"), 1, "no.raw"),
    "size": (("convert", "v.raw", "--dims", 9, 8, 8, "--dtype", "uint8", "-o", "out.ply"), 1, "512"),
    "no dims": (("convert", "v.raw", "-o", "out.ply"), None, "--dims"),
    "dtype": (("convert", "v.raw", "--dims", 8, 8, 8, "--dtype", "uint9", "-o", "out.ply"), 2, "uint9"),
    "example": (("convert", "example:unicorn", "-o", "out.ply"), 2, "unicorn"),
    "component": ((*CONVERT, "--component", "all"), 2, "component"),
    "broken tf": ((*CONVERT, "--tf", "broken.json"), 1, "broken.json"),
    "unknown map": ((*CONVERT, "--tf", "octarine"), None, "octarine"),
    "clear tf": ((*CONVERT, "--tf", "clear.json"), 1, "opacity is above 0 nowhere"),
    "tf range": ((*CONVERT, "--tf", "good.json", "--tf-range", "5,1"), 2, "--tf-range"),
    "unknown command": (("transmogrify",), 2, "no command 'transmogrify'; expected one of convert, init"),
    "nearly a command": (("convrt", "v.raw"), 2, "no command 'convrt'; did you mean convert?"),
    "nearly a command of tf": (("tf", "sugest", "v.raw"), 2, "suggest"),
    "two dims": (
        ("convert", "v.raw", "--dims", "8,8", "--dtype", "uint8", "-o", "out.ply"),
        2,
        "as --dims 256 256 128",
    ),
    "ply for a volume": (
        ("init", "gaussians.ply", "-o", "out.ply"),
        1,
        "a .ply (Gaussians, points or a mesh); expected",
    ),
    "no output": (("convert", "v.raw", *RAW), 2, "--output"),
    "empty output": ((*CONVERT[:-1], ""), 2, "'-o' / '--output': '' is empty; expected a value"),
    "empty report": ((*CONVERT, "--report", ""), 2, "'--report': '' is empty"),
    "empty function": ((*CONVERT, "--tf", "good.json", "--tf", ""), 2, "'--tf': '' is empty"),
    "empty volume": (("info", ""), 2, "'' is empty; expected"),
    "no voxel": (("info", "none.npy"), 1, "none.npy: 0 values; expected at least one along each axis"),
    "budget": ((*CONVERT, "--max-gaussians", 0), 2, "--max-gaussians"),
    "degree": ((*CONVERT, "--sh-degree", 4), 2, "--sh-degree"),
    "max-megabytes unit": (
        (*CONVERT, "--max-megabytes", "5MX"),
        2,
        "'5MX' is not a file size; expected a number above 0, with b, kb",
    ),
    "max-megabytes": ((*CONVERT, "--max-megabytes", "100B"), 2, "no Gaussian fits"),
    "time budget": ((*CONVERT, "--time-budget", "0m"), 2, "is not a time"),
    "an expanded glob": (
        ("convert", "good.json", "v.raw", "broken.json", "-o", "out.ply"),
        2,
        "3 files, good.json to broken.json; expected",
    ),
    "same place": ((*CONVERT[:-1], "-", "--report", "-"), 2, "both"),
    "over an input": (("convert", "v.ply", *RAW, "-o", "v.ply", "--overwrite"), 2, "input"),
    "ply": (("info", "not.ply"), None, "not.ply"),
    "render no ply": (("render", "not.ply", "--orbit", 2, "-o", "d"), 1, "not.ply"),
    "render no views": (("render", "not.ply", "-o", "d"), 2, "--orbit"),
    **{
        f"{name} to a stream": ((*words, "-o", "-"), 2, "-o -: standard output takes no folder; expected a folder's")
        for name, words in {
            "render": ("render", "v.raw", *RAW, "--orbit", 2),
            "views": ("render-views", "v.raw", *RAW),
            "bands": ("tf", "suggest", "v.raw", *RAW),
            "report": ("report", "v.raw", *RAW),
        }.items()
    },
    **{
        f"{words[0]} to a stream": ((*words, "-"), 2, f"{words[-1]} -: standard output takes a .ply or JSON")
        for words in (
            ("synth", "tubes", "-o"),
            ("tf", "show", "good.json", "-o"),
            (*CONVERT, "--preview"),
        )
    },
    "view title": (("view", "gaussians.ply", "--title", "a"), 2, "--title is for a page that is saved"),
    "render both": (("render", "not.ply", "-o", "d", "--orbit", 1, "--camera", "c.json"), 2, "either"),
    "render background": (("render", "not.ply", "-o", "d", "--orbit", 1, "--background", 0, 0, 255), 2, "[0, 1]"),
    "render cameras": (("render", "not.ply", "-o", "d", "--camera", "good.json"), 1, "frames"),
    "evaluate both": (("evaluate", "-", "--volume", "-", *RAW), 2, "standard input"),
    "info directory": (("info", "."), 1, "a folder; expected"),
    "show no volume": (("tf", "show", "good.json", "-o", "a.png", "--tf-range", "0,1"), 2, "--volume"),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_gets_one_line_and_leaves_nothing(case, folder, vvgt):
    args, code, message = CASES[case]
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    result = vvgt(*args)
    assert result.code in ((1, 2) if code is None else (code,)), result.err
    assert message in result.error
    assert "internal" not in result.error
    assert result.out == b""
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before


@pytest.mark.parametrize("option", ["-o", "--report", "--preview"])
def test_nothing_is_overwritten_unasked(option, folder, vvgt):
    outputs = {"-o": "a.ply", "--report": "a.json", "--preview": "a.png"}
    taken = Path(outputs[option])
    taken.write_bytes(b"mine")
    result = vvgt.fails(2, "convert", "v.raw", *RAW, *(word for pair in outputs.items() for word in pair))
    assert taken.name in result
    assert "--overwrite" in result
    assert taken.read_bytes() == b"mine"
    assert {path.name for path in folder.glob("a.*")} == {taken.name}


@pytest.mark.parametrize("command", ["convert", "init"])
def test_what_is_there_is_noticed_before_anything_is_read(command, folder, vvgt, monkeypatch):
    monkeypatch.setattr("vvgt_cli.field.open.load", lambda *_: pytest.fail("read before the check"))
    Path("a.ply").write_bytes(b"mine")
    result = vvgt(command, "v.raw", *RAW, "-o", "a.ply")
    assert (result.code, Path("a.ply").read_bytes()) == (2, b"mine")
    assert "-o: a.ply exists; give --overwrite" in result.error


@pytest.mark.parametrize("late", ["a.ply", "a.json", "a.png"])
def test_what_appears_during_the_work_is_not_replaced(late, folder, vvgt, monkeypatch):
    """Outputs are checked twice: before the work, and when they are written."""
    from vvgt_cli.field import open as opening

    def load_and_be_late(*args):
        Path(late).write_bytes(b"theirs")
        return load(*args)

    load = opening.load
    monkeypatch.setattr(opening, "load", load_and_be_late)
    outputs = ("-o", "a.ply", "--report", "a.json", "--preview", "a.png")
    few = ("--max-gaussians", 50, "--screen", 24, "--steps", 0, "--tf", "good.json")
    assert f"{late} exists; give --overwrite" in vvgt.fails(2, "convert", "v.raw", *RAW, *few, *outputs)
    assert Path(late).read_bytes() == b"theirs"
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]  # no temporary file


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_directory_that_is_not_writable(folder, vvgt):
    locked = folder / "locked"
    locked.mkdir(mode=0o500)
    assert "not writable" in vvgt("convert", "v.raw", *RAW, "-o", locked / "a.ply").error


def test_a_size_that_does_not_fit_in_memory(folder, vvgt, monkeypatch):
    monkeypatch.setattr("vvgt_cli.conversion.plan.free_memory", lambda: 2**27)
    assert "--screen 2000" in vvgt.fails(2, "convert", "v.raw", *RAW, "-o", "a.ply", "--screen", 2000)


def test_version_and_help(vvgt):
    assert vvgt("--version").out.decode() == f"vvgt {__version__}\n"
    text = vvgt("--help").out.decode()
    for command in main.COMMANDS:
        assert f"\n  {command} " in text
    vvgt.ok("convert", "-h")
    for nothing_said in ((), ("tf",)):
        result = vvgt(*nothing_said)
        assert (result.code, result.out) == (2, b"")
        assert "Commands:" in result.err


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (DataError("a\nb"), 1, "a b"),
        (FileNotFoundError(2, "No such file", "x.raw"), 1, "x.raw: No such file"),
        (MemoryError(), 1, "out of memory"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (ZeroDivisionError("oops"), 1, "internal: ZeroDivisionError: oops"),
    ],
)
def test_every_exception_becomes_a_line(error, code, message, vvgt, monkeypatch):
    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr(main.cli, "invoke", fail)
    assert message in vvgt.fails(code, "info", "x")


def test_traceback_on_request(vvgt, monkeypatch):
    monkeypatch.setenv("VVGT_TRACEBACK", "1")
    assert "Traceback" in vvgt("info", "no.raw").err


def test_a_closed_pipe_is_quiet(folder):
    Path("many.json").write_text("[" + "0," * 10 + "0]")
    code = "import sys; from vvgt_cli.commands.main import run; sys.exit(run(['info', 'example:blob:8']))"
    reader, writer = os.pipe()
    os.close(reader)
    _, told = python("-c", code, stdout=writer, code=141)
    os.close(writer)
    assert told == ""


def test_threads_come_from_the_environment(monkeypatch):
    for variable in THREAD_VARIABLES:
        monkeypatch.delenv(variable, raising=False)
    assert default_threads() == len(os.sched_getaffinity(0))
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "7")
    assert default_threads() == 7
    monkeypatch.setenv("OMP_NUM_THREADS", "3,1")
    assert default_threads() == 3
    monkeypatch.setenv("OMP_NUM_THREADS", "many")
    assert default_threads() == 7


def test_threads_reach_numba_before_it_is_imported():
    code = "; ".join(
        [
            "from vvgt_cli.commands.main import run",
            "run(['info', 'example:blob:8', '--threads', '1'])",
            "import numba",
            "print('threads', numba.get_num_threads())",
        ]
    )
    assert python("-c", code)[0].splitlines()[-1] == "threads 1"


def test_termination_removes_the_temporary_file(folder):
    code = "\n".join(
        [
            "import os, signal, sys",
            "import vvgt_cli.gaussians.outputs as outputs",
            "from vvgt_cli.commands import main",
            "def work(args=None):",
            "    with outputs.atomic_write('a.txt') as temporary:",
            "        temporary.write_text('half')",
            "        os.kill(os.getpid(), signal.SIGTERM)",
            "main.cli.invoke = work",
            "sys.argv[1:] = ['info', 'x']",
            "main.main()",
        ]
    )
    before = sorted(folder.iterdir())
    python("-c", code, code=143)
    assert sorted(folder.iterdir()) == before


def test_extras_are_installed_by_the_names_of_their_packages(monkeypatch):
    """What pip is told works where no index has vvgt."""
    assert re.fullmatch(r"pip install 'dask\[distributed\]>=[\d.]+' 'dask-jobqueue>=[\d.]+'", pip_install("cluster"))

    def none(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "requires", none)
    assert pip_install("share") == "pip install '.[share]' in the clone"
