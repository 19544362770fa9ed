"""Shared fixtures: the command line in-process, the `long` marker, hypothesis profiles."""

import contextlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import hypothesis
import pytest

from tests.spared import SCREEN, defaults, spare
from vvgt_cli.commands.main import run
from vvgt_cli.resources import set_memory

SLOWEST = (
    *("on_device", "view_volume", "streamed", "regions"),
    *("jit", "volume_vtk_family", "scale_workers", "matrix", "stiff", "certificate", "report", "previous_frame"),
    *("cli_streams", "page_values", "field_rays", "splat_backward", "fuzz"),
    *("nodes", "conversion_plan", "dask", "layers", "previous_look", "cli_convert", "volume_grib", "closed_form"),
)  # files' names, two minutes to ten seconds of processor

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
KERNELS = Path(os.environ.get("VVGT_TEST_KERNELS") or CACHE / "vvgt" / "kernels-of-tests")

places = [str(Path(__file__).parent.parent), os.environ.get("PYTHONPATH")]
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, places))  # of processes that tests start
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # each of them would compile every module again, for 0.3 s
sys.dont_write_bytecode = False

hypothesis.settings.register_profile("default", max_examples=40, deadline=None)
hypothesis.settings.register_profile("long", max_examples=10_000, deadline=None)
hypothesis.settings.register_profile("quick", max_examples=10, deadline=None)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="run the tests marked long too")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "long: takes too long for every change (make long)")
    config.option.loadscopereorder = False  # of pytest-xdist, which would begin with the files of most tests


def pytest_collection_finish(session: pytest.Session) -> None:
    """Compile kernels on all cores, before the tests ask for them one by one."""
    parallel = hasattr(session.config, "workerinput")  # of pytest-xdist, whose first process has compiled them
    wanted = os.environ.get("KERNELS_AHEAD") != "0"  # tests/mutants.py: a mutant's are compiled as they are asked for
    if wanted and len(session.items) > 20 and not session.config.getoption("collectonly") and not parallel:
        compile_kernels()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes() -> None:
    """Compile kernels before tests run in several processes (-n)."""
    compile_kernels()


def compile_kernels() -> None:
    """Compile all that neither this clone's earlier runs have left nor those of other clones in `KERNELS`.

    Names of their files hold digests of all that they are compiled from; what no run has used for a month goes.
    """
    from vvgt_cli.jit import store
    from vvgt_cli.jit.ahead import ALL
    from vvgt_cli.jit.compile import compile_ahead, missing, usual_jobs

    jobs, folder = usual_jobs(ALL), store.folder_for_writing()
    for job in missing(jobs):
        if folder and (kept := store.read(KERNELS / job.file)):
            store.write(folder / job.file, kept)
    assert compile_ahead(ALL)[1] == 0, "some kernels do not compile for their usual types"
    if not folder or not store.writable(KERNELS):
        return
    for job in jobs:
        if (folder / job.file).is_file():
            part = KERNELS / f"{job.file}.{os.getpid()}.part"
            shutil.copyfile(folder / job.file, part)  # with the time of this use
            part.replace(KERNELS / job.file)
    for path in KERNELS.iterdir():
        with contextlib.suppress(FileNotFoundError):  # of another run at once
            if path.stat().st_mtime < time.time() - 30 * 86400:
                path.unlink()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with the files that take longest, so that no process waits for another at the end; skip long tests."""
    order = {f"test_{name}.py": place for place, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))
    if not config.getoption("--long"):
        for item in items:
            if "long" in item.keywords:
                item.add_marker(pytest.mark.skip(reason="long: pass --long"))


@pytest.fixture(scope="session", autouse=True)
def small_conversions() -> None:
    """Spare commands in this process what takes most of a small one's time."""
    spare()


@pytest.fixture
def small_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Convert for 64 px, with few Gaussians, where nothing is stated, in this process and in those that it starts."""
    from vvgt_cli.conversion.request import FitOptions

    monkeypatch.setenv(SCREEN, "64")
    monkeypatch.setattr(FitOptions.__init__, "__defaults__", defaults(64))


@pytest.fixture(scope="session")
def display() -> Iterator[str]:
    """Start an X server without a screen, for programs that want a window; yield its name."""
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not on the path (Debian: xvfb)")
    words = ["Xvfb", "-noreset", "-displayfd", "1", "-screen", "0", "1280x1024x24"]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as server:
        yield f":{server.stdout.readline().decode().strip()}"
        server.terminate()


@dataclass
class Result:
    """What a command line did."""

    code: int
    out: bytes
    err: str

    @property
    def error(self) -> str:
        """The error's one line, checked to be one."""
        lines = [line for line in self.err.splitlines() if line.startswith("vvgt: error: ")]
        assert len(lines) == 1, self.err
        assert "Traceback" not in self.err
        assert self.err.splitlines()[-1] == lines[0], self.err
        assert lines[0].count("vvgt: error: ") == 1, self.err
        return lines[0]


class CommandLine:
    """Run command lines in this process; output is captured at the file descriptors, so VTK's is seen too.

    An argument that begins with ``--`` is split at blanks: vvgt("info", path, "--time 1 --json").
    """

    def __init__(self, captured: pytest.CaptureFixture[bytes]) -> None:
        self.captured = captured

    def __call__(self, *args: object) -> Result:
        self.captured.readouterr()
        words = [text.split() if text.startswith("--") else [text] for text in map(str, args)]
        code = run([word for group in words for word in group])
        out, err = self.captured.readouterr()
        return Result(code, out, err.decode())

    def ok(self, *args: object) -> Result:
        """Run a command line that must succeed."""
        result = self(*args)
        assert result.code == 0, result.err
        return result

    def fails(self, code: int, *args: object) -> str:
        """Run a command line that must end with an exit status, and return the one line that says why."""
        result = self(*args)
        assert result.code == code, result.err
        return result.error


@pytest.fixture
def vvgt(capfdbinary: pytest.CaptureFixture[bytes]) -> Iterator[CommandLine]:
    yield CommandLine(capfdbinary)
    set_memory(None)  # `--memory` is of the whole process
