"""Compiled kernels: the same bytes cold and warm, what their code is kept under, damaged and read-only folders."""

import json
import math
import os
import shutil
import subprocess
import sys
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest

from vvgt_cli.jit import ahead
from vvgt_cli.jit.compile import compile_ahead
from vvgt_cli.jit.store import folders

ROOT = Path(__file__).parent.parent
SOURCE = "example:marschner-lobb:24"
SMALL = ("--max-gaussians", "200", "--screen", "40")
STEP = (
    "from vvgt_cli.refine.steps import adam; import numpy as np; a = np.ones(3, np.float32); "
    "adam(a, a.copy(), 0.1, 0.9, 0.99, 1, a * 0, a * 0); print(a)"
)


def environment(folder, **more):
    own = {"NUMBA_CACHE_DIR": str(folder)} if folder else {}
    return {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | own | more


def python(*args, cwd=ROOT, code=0, **variables):
    done = subprocess.run(
        [sys.executable, *args], cwd=cwd, env=environment(**variables), capture_output=True, text=True
    )
    assert done.returncode == code, done.stderr
    return done


def command(*args, cwd, **variables):
    return python("-m", "tests.spared", *map(str, args), cwd=cwd, **variables)


def commands_leave(place: Path, cache: Path, **target: str) -> dict[str, bytes]:
    """Run the commands that draw, each in a process of its own; what they leave."""
    place.mkdir()
    for line in (
        f"convert {SOURCE} --max-gaussians 200 --screen 40 --steps 12 -o a.ply",
        f"render-views {SOURCE} --views 6 --test-views 2 --size 40 -o views",
        "optimize a.ply --views views --steps 6 -o b.ply",
        "infer a.ply --views views --model vvgt-small -o c.ply",
        "render a.ply --orbit 2 --size 40 --exr -o d",
    ):
        command(*line.split(), "-q", cwd=place, folder=cache, **target)
    files = sorted(path for path in place.rglob("*") if path.suffix in (".ply", ".png", ".exr"))
    return {str(path.relative_to(place)): path.read_bytes() for path in files}


@pytest.mark.long
@pytest.mark.parametrize(
    "target",
    [
        {},
        {"NUMBA_CPU_NAME": "generic"},
        {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma"},
        {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
        {"NUMBA_CPU_FEATURES": "+sse4.2"},
    ],
    ids=lambda target: "-".join(target.values()) or "host",
)
def test_cold_and_warm_runs_leave_the_same_bytes(tmp_path, target):
    """Cold: command by command. Warm: where all was compiled beforehand, in another order, the package's folder."""
    if target:
        command("warmup", cwd=tmp_path, folder=tmp_path / "ahead", **target)
    cold = commands_leave(tmp_path / "cold", tmp_path / "cache", **target)
    warm = commands_leave(tmp_path / "warm", tmp_path / "ahead" if target else None, **target)
    assert len(cold) > 15
    assert cold == warm


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A copy of the package's folder, where NUMBA_CACHE_DIR = ``tmp_path / "cache"`` has it."""
    compile_ahead(ahead.ALL)
    whole = next(folder for folder in folders() if folder.is_dir())
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    (folder,) = folders()
    shutil.copytree(whole, folder)
    return folder


def test_a_run_that_compiles_leaves_the_bytes_of_one_that_loads(tmp_path, cache):
    """Two kernels of loops over threads and one without are compiled by the first run."""
    names = ("splat.kernel.count_pairs", "splat.kernel.sum_pairs", "closed_form.cell_kernels.take_base")
    some = tuple(f"vvgt_cli.{name}-" for name in names)
    for name in kernels(cache):
        if name.startswith(some):
            (cache / name).unlink()
    kept = len(kernels(cache))
    runs = {}
    for run in ("cold", "warm"):
        command("convert", SOURCE, *SMALL, "--steps", 12, "-qo", f"{run}.ply", cwd=tmp_path, folder=tmp_path / "cache")
        runs[run] = (tmp_path / f"{run}.ply").read_bytes()
        assert len(kernels(cache)) == kept + len(some)
    assert runs["cold"] == runs["warm"]


def test_warmup_says_where_and_compiles_what_is_missing(tmp_path, cache):
    some = ("vvgt_cli.closed_form.surface_offset._blur", "vvgt_cli.splat.kernel.sum_pairs-")
    gone = {name for name in kernels(cache) if name.startswith(some)}
    for name in gone:
        (cache / name).unlink()
    kept = len(kernels(cache))
    assert kept > 20
    first = command("warmup", cwd=tmp_path, folder=tmp_path / "cache")
    assert first.stdout.strip() == str(cache)
    found = gone & set(kernels(cache))
    assert len({name.split("-")[0] for name in found}) == len(some)
    assert len(kernels(cache)) == kept + len(found)
    assert f"{len(found)} kernels were missing" in first.stderr
    assert "nothing was missing" in command("warmup", cwd=tmp_path, folder=tmp_path / "cache").stderr


def test_warmup_without_a_place_is_an_error(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    few = "from vvgt_cli.jit import ahead; ahead.ALL = ahead.BACK_PROJECT[1:]"
    quick = f"{few}; from vvgt_cli.commands.main import main; main()"
    done = python("-c", quick, "warmup", cwd=tmp_path, code=1, folder=tmp_path / "file")
    assert "no folder can keep" in done.stderr


SPY = """
import importlib, json, os, sys
from tests.spared import spare
from vvgt_cli.commands.main import run
from vvgt_cli.jit import ahead, compile
from vvgt_cli.jit.cache import KernelCache
inner, asked, odd = KernelCache.load_overload, set(), set()
def spy(self, sig, context):
    name = f"{self.function.__module__}:{self.function.__qualname__}"
    usual = [compile.usual_types(self.dispatcher, kind) for kind in compile.VOLUMES]
    (asked if tuple(getattr(sig, "args", sig)) in usual else odd).add(name)
    return inner(self, sig, context)
KernelCache.load_overload = spy
spare()
for name in ahead.ALL:
    importlib.import_module(name.split(":")[0])
for line in sys.stdin:
    if os.fork() == 0:
        answers, sys.stdout = sys.stdout, open(os.devnull, "w")
        code = run(json.loads(line))
        print(json.dumps([code, sorted(asked), sorted(odd)]), file=answers, flush=True)
        os._exit(0)
    os.wait()
"""


@pytest.fixture
def spied(tmp_path):
    """Run a command in ``tmp_path`` in a fork that has no kernels yet; returns those that it asks for.

    They are two sets: with the types that are compiled ahead, and with others.
    """
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", SPY], cwd=tmp_path, env=environment(None), **pipes) as process:

        def run(*args):
            print(json.dumps([str(arg) for arg in args]), file=process.stdin, flush=True)
            code, asked, odd = json.loads(process.stdout.readline())
            assert code == 0, args
            return set(asked), set(odd)

        yield run
        process.stdin.close()


def test_commands_need_what_is_compiled_ahead_and_nothing_else(tmp_path, spied):
    def wanted(*args):
        asked, others = spied(*args)
        assert not others, args
        return asked

    rare = {
        f"vvgt_cli.closed_form.surface_offset:{name}" for name in ("_shift", "_blur", "_flatten")
    }  # of opaque scenes
    fit = ("--max-gaussians", 200, "--screen", 64, "-q")
    rare |= set(ahead.REGRESS)  # and of more than a few Gaussians
    assert wanted("convert", SOURCE, *fit, "--steps", 24, "-o", "a.ply") == set(ahead.CONVERT) - rare
    many = ("--max-gaussians", 1500, "--screen", 650, "-q", "--steps", 24)  # and scored on blocks
    assert set(ahead.REGRESS) <= wanted("convert", SOURCE, *many, "-o", "o.ply")
    assert wanted("init", SOURCE, *fit, "-o", "i.ply") == set(ahead.INIT) - rare
    (tmp_path / "v_24x24x24_uint8.raw").write_bytes(bytes(range(216)) * 64)
    blocks = wanted("init", "v_24x24x24_uint8.raw", *fit, "--blocks", 16, "-o", "k.ply")
    started = ahead.for_blocks((ahead.RENDER, *ahead.INIT, *ahead.DRAW))
    assert blocks == {*started, *ahead.COUNT_WHOLE} - rare
    np.linspace(0, 1, 24**3, dtype=np.float32).tofile(tmp_path / "f_24x24x24_float32.raw")
    reals = ("init", "f_24x24x24_float32.raw", *fit, "--blocks", 16)
    assert wanted(*reals, "-o", "n.ply") == {*started, *ahead.COUNT_REAL} - rare
    fitted = wanted("convert", "v_24x24x24_uint8.raw", *fit, "--steps", 24, "--blocks", 16, "-o", "m.ply")
    assert fitted == {*ahead.for_blocks(ahead.CONVERT), *ahead.COUNT_WHOLE} - rare
    few = wanted("convert", SOURCE, *fit, "--steps", 0, "-o", "b.ply")
    assert set(ahead.BACK_PROJECT) <= few <= set(ahead.CONVERT)
    views = ("--views", 6, "--test-views", 2, "--size", 40, "-q", "-o", "views")
    assert wanted("render-views", SOURCE, *views) == set(ahead.VIEWS) - {ahead.BLOCK_MOMENTS}
    assert wanted("render-views", SOURCE, *views[:-1], "bare", "--no-points") == set(ahead.RAYCAST)
    seen = ("a.ply", "--views", "views")
    alone = set(ahead.OPTIMIZE) - set(ahead.SHARED)
    assert wanted("optimize", *seen, "--steps", 3, "-qo", "c.ply") == alone
    seen_by_many = ("o.ply", *seen[1:], "--steps", 3, "-qo", "p.ply")
    assert set(ahead.SHARED) <= wanted("optimize", *seen_by_many) <= set(ahead.OPTIMIZE)
    assert wanted("infer", *seen, "--model", "vvgt-small", "-qo", "d.ply") == set(ahead.INFER)
    assert wanted("evaluate", "a.ply", "--volume", SOURCE, "--screen", 24, "-q") == set(ahead.EVALUATE)
    assert wanted("render", "a.ply", "--orbit", 1, "--size", 24, "-qo", "r") == set(ahead.DRAW)
    lit = wanted("convert", SOURCE, *fit, "--steps", 24, "--light", "headlight", "-o", "e.ply")
    assert lit == set(ahead.for_degree(ahead.for_light(ahead.CONVERT, False), 2)) - rare
    np.save(tmp_path / "seg.npy", (np.indices((9, 9, 9)).sum(axis=0) // 9).astype(np.uint8))
    labels = wanted("convert", "seg.npy", *fit, "--steps", 24, "-o", "g.ply")
    grid = ahead.for_grid(ahead.for_light(ahead.CONVERT, False), mixed=False)
    assert labels == set(ahead.for_degree(grid, 2)) - {*ahead.REGRESS, ahead.MIX}  # of other grids, and of more
    mixed = wanted("render", SOURCE, "--layer", "seg.npy,labels=none", "--light", "none", "--size", 24, "-qo", "m.png")
    assert mixed == {*ahead.for_grid(ahead.RAYCAST, mixed=True), "vvgt_cli.dvr.place:place"}
    wanted("convert", "seg.npy", *fit, "--steps", 24, "--light", "sun", "--blocks", 16, "-o", "h.ply")
    live = wanted("convert", SOURCE, *fit, "--live", "-o", "l.ply")
    assert {*ahead.LIVE, *ahead.VOXELIZE} <= live
    assert wanted("voxelize", "l.ply", "-qo", "l.nrrd") == set(ahead.VOXELIZE)
    flat = wanted("convert", SOURCE, *fit, "--steps", 24, "--light", "sun", "-o", "f.ply")
    assert flat == set(ahead.for_light(ahead.CONVERT, True)) - rare


def test_lists_name_kernels():
    from vvgt_cli.jit.compile import usual_jobs

    jobs = usual_jobs(ahead.ALL)
    assert len({job.file for job in jobs}) == len(jobs) > 20


def kernels(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*.kernel"))


PROBE = """
from vvgt_cli.dvr.kernel import absorbed
from vvgt_cli.jit.decorators import kernel
from vvgt_cli.gaussians.constants import NEAR

@kernel()
def probe(value):
    return absorbed(value) + NEAR
"""


def test_an_edit_of_what_a_kernel_calls_or_reads_is_noticed_and_the_old_code_goes(tmp_path):
    package = tmp_path / "vvgt_cli"
    shutil.copytree(ROOT / "vvgt_cli", package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "probe.py").write_text(PROBE)

    def probe():
        code = "from vvgt_cli.probe import probe; print(probe(3.0))"
        out = python("-c", code, cwd=tmp_path, folder=tmp_path / "cache", PYTHONPATH=str(tmp_path)).stdout
        (name,) = kernels(tmp_path / "cache")  # no old ones
        return float(out), name

    def edit(file, old, new):
        text = (package / file).read_text()
        assert old in text
        (package / file).write_text(text.replace(old, new))

    value, name = probe()
    assert value == pytest.approx((1 - math.exp(-3)) / 3 + 0.01)
    edit("refine/loss.py", '"""The loss:', '"""A loss:')  # of no use to it
    assert probe() == (value, name)
    edit("dvr/kernel.py", "return (1.0 - math.exp(-depth)) / depth", "return (4.0 - math.exp(-depth)) / depth")
    assert probe()[0] == pytest.approx((4 - math.exp(-3)) / 3 + 0.01)
    edit("gaussians/constants.py", "NEAR = 0.01", "NEAR = 0.5")
    assert probe()[0] == pytest.approx((4 - math.exp(-3)) / 3 + 0.5)


@pytest.fixture(scope="module")
def stepped(tmp_path_factory):
    """What `STEP` prints, and the folder that it leaves; to be copied."""
    folder = tmp_path_factory.mktemp("stepped")
    return python("-c", STEP, folder=folder).stdout, folder


def test_files_hold_machine_code_and_the_names_of_symbols():
    import llvmlite.binding as llvm

    from vvgt_cli.jit.numba_internals import symbols_of

    text = """
    declare double @outside(double)
    @"env.<1>" = global [3 x i8] c"abc"
    define double @"f$2"(double %x) {
      %y = call double @outside(double %x)
      %z = fadd double %y, %x
      ret double %z
    }"""
    left = llvm.parse_bitcode(symbols_of(llvm.parse_assembly(text).as_bitcode()))
    assert [f.name for f in left.functions if not f.is_declaration] == ["f$2"]
    assert [v.name for v in left.global_variables if not v.is_declaration] == ["env.<1>"]
    assert "fadd" not in str(left)
    assert "abc" not in str(left)


def test_no_kernel_calls_another():
    """Their files hold nothing that one could link."""
    import inspect
    from importlib import import_module

    from numba.core.dispatcher import Dispatcher

    from vvgt_cli.jit.cache import KernelCache

    waiting = [getattr(import_module(module), name).py_func for module, name in (n.split(":") for n in ahead.ALL)]
    seen = set()
    while waiting:
        variables = inspect.getclosurevars(waiting.pop())
        called = {v for v in (variables.globals | variables.nonlocals).values() if isinstance(v, Dispatcher)}
        assert not [v for v in called if isinstance(v._cache, KernelCache)]
        waiting += [v.py_func for v in called - seen]
        seen |= called
    assert len(seen) > 50


def test_the_order_of_fields_is_part_of_what_a_kernel_is_kept_under():
    from numba import types

    from vvgt_cli.splat.tiles import reduce_pairs

    pairs = [types.BaseTuple.from_types((types.f8, types.f8), namedtuple("Pair", fields)) for fields in ("a b", "b a")]
    assert len({repr(pair) for pair in pairs}) == 1
    assert len({reduce_pairs.kernel_cache.file((pair,)) for pair in pairs}) == 2


@pytest.mark.parametrize(
    "damage", [lambda text: text[:-100], lambda text: b"", lambda text: text[:60] + b"x" + text[61:]]
)
def test_damaged_files_are_compiled_anew(tmp_path, stepped, damage):
    whole, folder = stepped
    shutil.copytree(folder, tmp_path / "cache")
    (file,) = (tmp_path / "cache").rglob("*.kernel")
    good = file.read_bytes()
    file.write_bytes(damage(good))
    done = python("-c", STEP, folder=tmp_path / "cache")
    assert done.stdout == whole
    assert done.stderr.count("RuntimeWarning") == done.stderr.count("again\n") == 1
    assert len(file.read_bytes()) == len(good)
    assert python("-c", STEP, folder=tmp_path / "cache").stderr == ""


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives files away")
def test_files_of_other_users_are_not_read(tmp_path, stepped):
    shutil.copytree(stepped[1], tmp_path / "cache")
    (file,) = (tmp_path / "cache").rglob("*.kernel")
    os.chown(file, 12345, -1)
    assert "another user" in python("-c", STEP, folder=tmp_path / "cache").stderr
    assert file.stat().st_uid == 0  # in its place is one of our own


def test_nowhere_to_write_is_one_line_and_the_same_numbers(tmp_path, stepped):
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "tmp").mkdir()
    done = python("-c", STEP, folder=tmp_path / "file", TMPDIR=str(tmp_path / "tmp"))
    assert done.stdout == stepped[0]
    assert done.stderr.count("RuntimeWarning: compiled kernels cannot be kept in ") == 1
    assert not list((tmp_path / "tmp").iterdir())  # removed at the end


def test_without_another_process_it_still_works(tmp_path, stepped):
    code = f"import sys; sys.executable = ''; {STEP}"
    done = python("-c", code, folder=tmp_path)
    assert done.stdout == stepped[0]
    assert done.stderr.count("RuntimeWarning: kernels compiled in this process") == 1


def test_without_a_home(tmp_path):
    package = tmp_path / "vvgt_cli"
    shutil.copytree(ROOT / "vvgt_cli", package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "__pycache__").write_bytes(b"")  # cannot be a folder
    own = {"HOME": "/nonexistent/at/all", "XDG_CACHE_HOME": str(tmp_path / "user"), "PYTHONPATH": str(tmp_path)}
    assert python("-c", STEP, cwd=tmp_path, folder=None, PYTHONDONTWRITEBYTECODE="1", **own).stderr == ""
    assert len(kernels(tmp_path / "user")) == 1


def test_two_first_runs_at_once(tmp_path, stepped):
    """For a processor without extensions, whatever this one has: code of another kind, and a folder of its own."""
    variables = environment(tmp_path, NUMBA_CPU_NAME="generic")
    pipe = {"env": variables, "stdout": subprocess.PIPE, "text": True}
    runs = [subprocess.Popen([sys.executable, "-c", STEP], **pipe) for _ in range(2)]
    assert [run.communicate()[0] for run in runs] == [stepped[0]] * 2
    assert python("-c", STEP, folder=tmp_path, NUMBA_CPU_NAME="generic").stdout == stepped[0]
    assert len(kernels(tmp_path)) == 1
    assert not list(tmp_path.rglob("*.part"))
