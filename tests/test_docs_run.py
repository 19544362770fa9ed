"""What the pages show runs: Python of docs/python.md, commands of the tutorial and of the how-to, the notebook."""

import gzip
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import mrcfile
import nibabel
import numpy as np
import pytest
import tifffile

from tests import anatomy, vtk_files
from tests.docs_commands import blocks, small
from tests.headers import uncertified
from tests.test_look_formats import mrml
from tests.vdb_files import plume, vdb
from vvgt_cli.commands.main import cli
from vvgt_cli.commands.words import expand

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("page", ["how-to.md", "tutorial.md"])
def test_every_command_of_a_page_has_options_that_there_are(folder, page):
    found = [line for _, block in blocks(ROOT / "docs" / page, "") for line in block.splitlines()]
    assert len(found) > 6
    for line in found:
        with cli.make_context("vvgt", expand(shlex.split(line)[1:])) as context:
            name, command, words = cli.resolve_command(context, [*context.protected_args, *context.args])
            command.make_context(name, words, parent=context)


@pytest.mark.long
def test_the_python_page_runs_from_top_to_bottom(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "page"}
    code = blocks(ROOT / "docs" / "python.md", "python")
    assert len(code) > 15
    for number, (_, block) in enumerate(code):
        exec(compile(block, f"docs/python.md, block {number}", "exec"), names)
    out = capsys.readouterr().out
    assert "expected three axes" in out
    assert "no such file" in out
    assert (tmp_path / "better.ply").stat().st_size > 68


@pytest.mark.long
def test_the_notebook_runs_and_is_kept_without_outputs(tmp_path):
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(ROOT / "examples" / "library.ipynb", as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in code)
    NotebookClient(notebook, timeout=None, startup_timeout=600, kernel_name="python3").execute(
        cwd=str(tmp_path), env=os.environ | {"PYTHONPATH": str(ROOT), "PYVISTA_OFF_SCREEN": "true"}
    )
    pictures = [output for cell in code for output in cell.outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 3
    assert any("dB" in output.get("text", "") for cell in code for output in cell.outputs)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder of a reader of the how-to: small files of the names that it has, and `vvgt` on the path."""
    affine = anatomy.place(anatomy.AXIAL)
    data = anatomy.balls(affine)  # (15, 18, 22) int16, 0 to 900
    nibabel.save(nibabel.Nifti1Image(data.T, affine), tmp_path / "head.nii.gz")
    anatomy.dicom(tmp_path / "scan", data, affine)
    for name, head, values in (
        ("dump", b"", data),
        ("dump_22x18x15_int16", b"", data),
        ("old", bytes(512), data.astype(">i2")),
    ):
        (tmp_path / f"{name}.raw").write_bytes(head + values.tobytes())
    (tmp_path / "dump.raw.gz").write_bytes(gzip.compress(data.tobytes()))
    (tmp_path / "segmentations").mkdir()
    nibabel.save(nibabel.Nifti1Image((data.T // 400).astype(np.uint8), affine), tmp_path / "atlas.nii.gz")
    for number, organ in enumerate(("spleen", "liver"), start=1):
        mask = nibabel.Nifti1Image(np.equal(data.T // 400, number).astype(np.uint8), affine)
        nibabel.save(mask, tmp_path / "segmentations" / f"{organ}.nii.gz")
    for frame in range(3):
        anatomy.vti(tmp_path / f"run_{frame}.vti", (data // (frame + 1)).astype("<i2"), affine)
    vdb(tmp_path / "fire.vdb", plume(16))
    with mrcfile.new(tmp_path / "emd_1234.map", (data / 9000).astype(np.float32)) as file:
        file.voxel_size = 1.5
    cells = np.stack([[data, data[::-1]], [data, data // 2]]).astype("<u2")  # T C Z Y X
    sizes = {"PhysicalSizeX": 0.2, "PhysicalSizeY": 0.2, "PhysicalSizeZ": 0.5, "Channel": {"Name": ["DAPI", "GFP"]}}
    tifffile.imwrite(tmp_path / "cells.ome.tif", cells, ome=True, metadata={"axes": "TCZYX", **sizes})
    for name in ("flow", "cavity"):
        (tmp_path / name).mkdir()
    case = vtk_files.ensight(tmp_path / "flow").rename(tmp_path / "flow" / "flow.case")
    case.write_text(case.read_text().replace("1 ramp", "1 p"))
    vtk_files.openfoam(tmp_path / "cavity").rename(tmp_path / "cavity" / "cavity.foam")
    for cells in (tmp_path / "cavity").glob("*/cells"):
        cells.with_name("p").write_text(cells.read_text().replace("object cells", "object p"))
    (tmp_path / "bone.json").write_text(anatomy.TF)
    (tmp_path / "story.json").write_text(blocks(ROOT / "docs" / "how-to.md", "json")[0][1])
    preset = {"RGBPoints": [0, 0.9, 0.8, 0.7, 900, 1, 1, 1], "Points": [0, 0, 0.5, 0, 900, 0.5, 0.5, 0]}
    (tmp_path / "presets.json").write_text(json.dumps([preset | {"Name": name} for name in ("bone", "skin")]))
    (tmp_path / "presets.xml").write_text(mrml())
    (tmp_path / "bin").mkdir()
    shim = tmp_path / "bin" / "vvgt"
    shim.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m tests.docs_commands "$@"\n')
    shim.chmod(0o755)
    for name, value in {"PATH": f"{shim.parent}:{os.environ['PATH']}", "SLURM_ARRAY_TASK_ID": "1"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_blocks(page: str, vvgt) -> list[str]:
    """Run a page's commands in order: plain ones in this process, those marked as bash by bash; returns them."""
    done = []
    for language, block in blocks(ROOT / "docs" / page, "", "bash"):
        if language:
            run = subprocess.run(["bash", "-euo", "pipefail", "-c", block], capture_output=True, text=True)
            assert run.returncode == 0, f"{block}\n{run.stderr}"
            done.append(block)
            continue
        for line in block.splitlines():
            words = shlex.split(line)
            assert words[0] == "vvgt", f"{page}: {line}: expected a vvgt command"
            result = vvgt(*small(words[1:]))
            assert result.code == 0, f"{page}: {line}\n{result.err}"
            done.append(line)
    return done


@pytest.mark.long
def test_every_command_of_the_how_to_runs(folder, vvgt):
    done = run_blocks("how-to.md", vvgt)
    assert len(done) > 30
    plys = {path.relative_to(folder).as_posix() for path in folder.rglob("*.ply")}
    named = set(re.findall(r"-o (\w+\.ply)", "\n".join(line for line in done if "--dry-run" not in line)))
    assert named <= plys
    assert {"run/02.ply", "cells/01.ply", "part/00.ply", "piped.ply"} <= plys
    assert uncertified(folder / "piped.ply") == uncertified(folder / "dump.ply")


@pytest.mark.long
def test_every_command_of_the_tutorial_runs(folder, vvgt):
    assert len(run_blocks("tutorial.md", vvgt)) > 6
