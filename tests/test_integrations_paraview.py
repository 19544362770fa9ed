"""ParaView's plugin and the Catalyst script, in ParaView itself."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.vtk_scenes import LUMP, camera_at, lump, places, psnr
from vvgt_cli.cli.main import run as vvgt
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.gaussians.rules import rule_of
from vvgt_cli.splat import render

ROOT = Path(__file__).parent.parent
ROOM = ROOT / "vvgt_cli" / "integrations"
STARTS = f"env PYTHONPATH={ROOT} NUMBA_NUM_THREADS=1 {sys.executable} -m vvgt_cli.cli.main"
SYSTEM = "/usr/bin/python3"
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


@pytest.fixture(scope="module")
def display() -> Iterator[str]:
    """Start an X server without a screen; ParaView of Debian wants one."""
    found("pvpython", "Xvfb")
    with subprocess.Popen(
        ["Xvfb", "-noreset", "-displayfd", "1", "-screen", "0", "640x480x24"], stdout=subprocess.PIPE
    ) as server:
        assert server.stdout is not None
        yield f":{server.stdout.readline().decode().strip()}"
        server.terminate()


def paraview(display: str, volume: Path, name: Path, *given: str) -> tuple[np.ndarray, str]:
    """Show a volume in ParaView and save it; return ParaView's picture and what it printed."""
    from PIL import Image

    picture, script = name.with_name("view.png"), ROOT / "tests" / "paraview_script.py"
    words = ("pvpython", script, ROOM / "paraview_plugin.py", volume, picture, name, *given)
    said = run(*words, DISPLAY=display)
    return np.asarray(Image.open(picture).convert("RGB")), said


def volume_file(path: Path, width: float = 4.0) -> Path:
    """Write the lump as a .vti."""
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    writer = vtkXMLImageDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(lump(width))
    assert writer.Write()
    return path


def ours(path: Path, said: str) -> np.ndarray:
    """Draw a file at the camera that it states, with ParaView's up."""
    gaussians, facts = open_gaussians(str(path))
    assert facts.camera is not None
    up = [float(v) for v in re.search(r"^up (.*)$", said, re.M)[1].split()]  # type: ignore[index]
    camera = camera_at(facts.camera[:3], facts.camera[3:6], up, facts.camera[6], facts, 300)
    return render(gaussians, camera, rule_of("inria"))


@pytest.mark.long
@pytest.mark.parametrize(
    ("case", "given", "least"),
    [
        ("plain", (), 42),
        ("turned", ("Representation.Orientation=[10,20,30]", "Representation.Position=[3,-2,1]"), 40),
        ("scaled", ("Representation.Scale=[1.5,1.5,1.5]",), 42),
    ],
)
def test_beside_paraviews_own_picture(
    case: str, given: tuple[str, ...], least: float, display: str, tmp_path: Path
) -> None:
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
    files = [volume_file(tmp_path / f"lump_{k}.vti", 2.0 + k) for k in range(3)]
    sets = "".join(f'<DataSet timestep="{2.5 * k}" file="{file.name}"/>' for k, file in enumerate(files))
    index = tmp_path / "lump.pvd"
    index.write_text(f'<VTKFile type="Collection" version="0.1"><Collection>{sets}</Collection></VTKFile>')
    page = tmp_path / "a.splat.html"
    _, said = paraview(display, index, page, "MaximumGaussians=2000", "Steps=0", "WriteTimeSteps=1", "Light=2")
    text = page.read_text()
    assert len(re.findall('id="splats-[0-9]+"', text)) == 3, said
    assert re.search('"name": "[^"]*2.5[^"]*"', text)
    assert not list(tmp_path.glob("*.parts"))


@pytest.mark.long
def test_an_error_is_one_line(display: str, tmp_path: Path) -> None:
    _, said = paraview(display, volume_file(tmp_path / "lump.vti"), tmp_path / "a.spz", *FEW, "Function='nothing.json'")
    assert re.search("Gaussian splats: nothing.json: .*", said), said
    assert not (tmp_path / "a.spz").exists()


@pytest.mark.long
def test_two_ranks_leave_one_file_a_time_step(tmp_path: Path) -> None:
    """Each hands over its slab; the file is that of the whole volume, wherever the slabs meet."""
    found("mpirun")
    if subprocess.run([SYSTEM, "-c", "import mpi4py, paraview.catalyst"], capture_output=True).returncode:
        pytest.skip(f"{SYSTEM} has no paraview or no mpi4py (Debian: python3-paraview, python3-mpi4py)")
    script = ROOT / "tests" / "catalyst_simulation.py"
    settings = {"VVGT_OUTPUT": str(tmp_path / "dye_{:02d}.ply"), "VVGT_TF": "viridis", "VVGT_GAUSSIANS": "3000"}
    mpi = ("mpirun", "--allow-run-as-root", "--oversubscribe", "--mca", "mpi_yield_when_idle", "1", "-n", "2")
    said = run(*mpi, SYSTEM, script, ROOM / "catalyst.py", 2, 40, tmp_path / "whole.vti", **settings)
    print(re.search("simulation .*", said))
    assert sorted(path.name for path in tmp_path.glob("*")) == ["dye_00.ply", "dye_01.ply", "whole.vti"]
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
