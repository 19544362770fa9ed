"""ParaView's plugin and the Catalyst script, in ParaView itself."""

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from tests.vtk_scenes import LUMP, camera_at, lump, places, psnr
from vvgt_cli.commands.main import run as vvgt
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.gaussians.rules import rule_of
from vvgt_cli.integrations import command, paraview_job, paraview_view
from vvgt_cli.splat import render

ROOT = Path(__file__).parent.parent
ADAPTERS = ROOT / "vvgt_cli" / "integrations"
STARTS = f"env PYTHONPATH={ROOT} NUMBA_NUM_THREADS=1 {sys.executable} -m vvgt_cli.commands.main"
SYSTEM = "/usr/bin/python3"
MPI = ("mpirun", "--allow-run-as-root", "--oversubscribe", "--mca", "mpi_yield_when_idle", "1", "-n", "2")
FEW = ("MaximumGaussians=10000", "Steps=40")


def found(*programs: str) -> None:
    """Skip where a program is missing."""
    for program in programs:
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not on the path (Debian: paraview, python3-paraview, xvfb, python3-mpi4py)")


def run(*words: Any, **more: str) -> str:
    """Run a program of ParaView's Python; return what it printed."""
    environment = {**os.environ, "VVGT": STARTS, **more}
    done = subprocess.run(
        list(map(str, words)), env=environment, capture_output=True, text=True, timeout=900, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def paraview(
    display: str, volume: Path, name: Path, *given: str, by: tuple[str, ...] = ("pvpython",), **more: str
) -> tuple[np.ndarray, str]:
    """Show a volume in ParaView and save it; return ParaView's picture and what it printed."""
    from PIL import Image

    found("pvpython")
    picture, script = name.with_name("view.png"), ROOT / "tests" / "paraview_script.py"
    said = run(*by, script, ADAPTERS / "paraview_plugin.py", volume, picture, name, *given, DISPLAY=display, **more)
    return np.asarray(Image.open(picture).convert("RGB")), said


def volume_file(path: Path, width: float = 4.0) -> Path:
    """Write the lump as a .vti."""
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    writer = vtkXMLImageDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(lump(width))
    assert writer.Write()
    return path


def series_file(folder: Path) -> Path:
    """Write lumps of three time steps and their .pvd."""
    files = [volume_file(folder / f"lump_{k}.vti", 2.0 + k) for k in range(3)]
    sets = "".join(f'<DataSet timestep="{2.5 * k}" file="{file.name}"/>' for k, file in enumerate(files))
    index = folder / "lump.pvd"
    index.write_text(f'<VTKFile type="Collection" version="0.1"><Collection>{sets}</Collection></VTKFile>')
    return index


def ours(path: Path, said: str) -> np.ndarray:
    """Draw a file at the camera that it states, with ParaView's up."""
    gaussians, facts = open_gaussians(str(path))
    up = [float(v) for v in re.search(r"^up (.*)$", said, re.M)[1].split()]  # type: ignore[index]
    camera = camera_at(facts.camera[:3], facts.camera[3:6], up, facts.camera[6], facts, 300)
    return render(gaussians, camera, rule_of("inria"))


OPTIONS = {"Gaussians": 100, "Steps": 0, "Live": 0, "Light": 0, "Function": ""}


def test_the_folder_of_a_job_is_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is not is left, and nothing stays behind a failure."""
    monkeypatch.setattr(paraview_job, "look", lambda *_: ([], None, []))
    folder, mine = tmp_path / ".a.ply.vvgt-parts", tmp_path / "a.ply.parts"
    for path in (folder, mine):
        path.mkdir()
        (path / "mine.txt").write_text("mine")
    with pytest.raises(RuntimeError, match="is not of vvgt"):
        paraview_job.Job(str(tmp_path / "a.ply"), OPTIONS, None, command.Kept())
    assert (folder / "mine.txt").exists()
    (folder / "mine.txt").rename(folder / "look.json")  # of a job that was killed
    job = paraview_job.Job(str(tmp_path / "a.ply"), OPTIONS, None, command.Kept())
    assert job.words == []
    job.end()
    with pytest.raises(RuntimeError, match="No such file or directory"):
        paraview_job.Job(str(tmp_path / "none" / "a.ply"), OPTIONS, None, command.Kept())
    monkeypatch.setattr(paraview_job, "look", lambda *_: 1 / 0)
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        paraview_job.Job(str(tmp_path / "a.ply"), OPTIONS, None, command.Kept())
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply.parts"]


def test_a_simulation_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is wrong with the settings, or the place of the files."""
    heard: list[str] = []
    step = SimpleNamespace(timestep=0, time=0.0)
    modules = {"paraview": ModuleType("paraview"), "paraview.simple": MagicMock()}
    monkeypatch.setattr(command, "tell", lambda text, failed=False: heard.append(text) if failed else None)
    monkeypatch.setattr(paraview_job, "look", lambda *_: ([], None, []))
    for name in (str(tmp_path / "a.ply"), "a_{step}.ply", str(tmp_path / "none" / "a_{:02d}.ply")):
        monkeypatch.setenv("VVGT_OUTPUT", name)
        with monkeypatch.context() as stubs:
            for key, module in modules.items():
                stubs.setitem(sys.modules, key, module)
            runpy.run_path(str(ADAPTERS / "catalyst.py"))["catalyst_execute"](step)
    assert ["a place for the step" in heard[0], "'step'" in heard[1], "No such file" in heard[2]] == [True] * 3
    assert len(heard) == 3


def test_the_nearest_source_that_is_shown_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    def algorithm(above: Any) -> Any:
        return SimpleNamespace(GetInputAlgorithm=lambda *_: above, GetNumberOfInputPorts=lambda: above is not None)

    def representation(made: Any, visible: int) -> Any:
        return SimpleNamespace(
            Input=SimpleNamespace(SMProxy=SimpleNamespace(GetClientSideObject=lambda: made)), Visibility=visible
        )

    reader = algorithm(None)
    near = algorithm(reader)
    saved = algorithm(near)
    shown = [
        representation(reader, 1),
        SimpleNamespace(Visibility=1),
        representation(near, 1),
        representation(saved, 0),
    ]
    view = SimpleNamespace(SMProxy=SimpleNamespace(GetRenderer=None), Representations=shown)
    connection = SimpleNamespace(IsRemote=lambda: False)
    paraview: Any = ModuleType("paraview")
    paraview.servermanager = SimpleNamespace(ActiveConnection=connection)
    paraview.simple = SimpleNamespace(GetActiveView=lambda: view)
    monkeypatch.setitem(sys.modules, "paraview", paraview)
    assert paraview_view.representation_of(saved) == (shown[2], view)


@pytest.mark.long
@pytest.mark.parametrize(
    ("case", "given", "least"),
    [
        ("plain", (), 42),
        ("turned", ("Representation.Orientation=[10,20,30]", "Representation.Position=[3,-2,1]"), 40),
        ("scaled", ("Representation.Scale=[1.5,1.5,1.5]",), 42),
    ],
)
def test_beside_paraviews_own_picture(case, given, least, display, tmp_path) -> None:
    """The same camera; colours in Lab, opacity with midpoints, a unit distance, the representation's place."""
    name = tmp_path / "a.splats.ply"
    theirs, said = paraview(display, volume_file(tmp_path / "lump.vti"), name, *FEW, *given)
    assert theirs.max() > 60
    measured = psnr(ours(name, said), theirs)
    print(f"{case}: {measured:.1f} dB")
    assert measured >= least
    assert "not taken" not in said
    voxel, middle = places(name)
    if case == "plain":
        assert voxel == pytest.approx(LUMP, abs=0.001)
        assert middle == pytest.approx(LUMP, abs=0.15)


@pytest.mark.long
def test_all_time_steps_are_frames_of_one_page(display: str, tmp_path: Path) -> None:
    """Shown at their times; under one function."""
    page = tmp_path / "a.splat.html"
    _, said = paraview(
        display, series_file(tmp_path), page, "MaximumGaussians=2000", "Steps=0", "WriteTimeSteps=1", "Light=2"
    )
    text = page.read_text()
    assert len(re.findall('id="splats-[0-9]+"', text)) == 3, said
    assert re.search('"name": "[^"]*2.5[^"]*"', text)
    assert not list(tmp_path.glob(".*"))


@pytest.mark.long
def test_an_error_is_one_line(display: str, tmp_path: Path) -> None:
    _, said = paraview(display, volume_file(tmp_path / "lump.vti"), tmp_path / "a.spz", *FEW, "Function='nothing.json'")
    assert re.search("Gaussian splats: nothing.json: .*", said), said
    assert not (tmp_path / "a.spz").exists()


@pytest.mark.long
def test_two_ranks_of_pvbatch_save_a_file_a_time_step(display: str, tmp_path: Path) -> None:
    """Each its own block, by `SaveData`; beside ParaView's picture of the first step."""
    found("mpirun", "pvbatch")
    starts, heard = tmp_path / "vvgt", tmp_path / "commands"
    starts.write_text(f'#!/bin/sh\ntee -a {heard} | {STARTS} "$@"\n')
    starts.chmod(0o755)
    given = ("MaximumGaussians=10000", "WriteTimeSteps=1")
    ranks, index = (*MPI, "pvbatch", "--symmetric"), series_file(tmp_path)
    theirs, said = paraview(display, index, tmp_path / "a.splats.ply", *given, by=ranks, VVGT=str(starts))
    assert sorted(path.name for path in tmp_path.glob("*.ply")) == [f"a_{k:04d}.splats.ply" for k in range(3)], said
    commands = [json.loads(line) for line in heard.read_text().splitlines()]
    shares = [words[words.index("--shard") + 1] for words in commands if words[0] == "init"]
    assert sorted(shares) == ["1/2"] * 6 + ["2/2"] * 6  # two passes a step
    measured = psnr(ours(tmp_path / "a_0000.splats.ply", said), theirs)
    print(f"two ranks: {measured:.1f} dB")
    assert measured > 40


@pytest.mark.long
@pytest.mark.parametrize("program", [(SYSTEM,), ("pvbatch", "--symmetric")], ids=["python", "pvbatch"])
def test_two_ranks_leave_one_file_a_time_step(program: tuple[str, ...], tmp_path: Path) -> None:
    """Each hands over its slab; the file is that of the whole volume, wherever the slabs meet."""
    found("mpirun", program[0])
    if subprocess.run([SYSTEM, "-c", "import mpi4py, paraview.catalyst"], capture_output=True).returncode:
        pytest.skip(f"{SYSTEM} has no paraview or no mpi4py (Debian: python3-paraview, python3-mpi4py)")
    script = ROOT / "tests" / "catalyst_simulation.py"
    settings = {"VVGT_OUTPUT": str(tmp_path / "dye_{:02d}.ply"), "VVGT_TF": "viridis", "VVGT_GAUSSIANS": "3000"}
    said = run(*MPI, *program, script, ADAPTERS / "catalyst.py", 2, 40, tmp_path / "whole.vti", **settings)
    print(re.search("simulation .*", said))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dye_00.ply", "dye_01.ply", "whole.vti"]
    words = ["init", str(tmp_path / "whole.vti"), "-o", str(tmp_path / "one.ply"), "--tf", "viridis", "--quiet"]
    assert vvgt([*words, "--max-gaussians", "3000"]) == 0
    drawn = []
    for name in ("one.ply", "dye_01.ply"):
        gaussians, facts = open_gaussians(str(tmp_path / name))
        middle = np.array(facts.centre)
        camera = camera_at(middle + np.array([2.5, -3.0, 2.0]), middle, (0, 0, 1), 40.0, facts, 200)
        drawn.append(render(gaussians, camera, rule_of("inria")))
    assert drawn[0].max() > 0.3
    assert psnr(drawn[1], 255 * drawn[0]) > 40
