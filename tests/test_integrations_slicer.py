"""3D Slicer: the command as its CLI module, and the scene's nodes through the adapter in Slicer's own Python."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import numpy as np
import pytest

from vvgt_cli.cameras import Camera
from vvgt_cli.commands.slicer import FIELDS
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.gaussians import read_ply
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.images.metrics import psnr
from vvgt_cli.splat import render

ROOT = Path(__file__).parents[1]


def test_xml_describes_the_command_by_its_own_options(vvgt) -> None:
    found = ElementTree.fromstring(vvgt.ok("--xml").out)
    assert found.tag == "executable"
    parameters = [node for group in found.findall("parameters") for node in group if node.find("name") is not None]
    named = {node.findtext("name"): node for node in parameters}
    assert list(named) == ["slicer", "volume", "output", *FIELDS]
    for name, node in named.items():
        assert name.isidentifier()  # Slicer refuses hyphens in names and flags
        assert node.findtext("longflag", name) == name
        assert node.findtext("description")
    assert [named[name].findtext("index") for name in ("volume", "output")] == ["0", "1"]
    assert named["slicer"].get("hidden") == "true"
    assert named["max_gaussians"].findtext("default") == "100000"


def test_arguments_are_taken_as_slicer_gives_them(vvgt, tmp_path) -> None:
    z, y, x = np.indices((16, 18, 20))
    np.save(tmp_path / "a.npy", np.clip(90 - 10 * np.hypot(np.hypot(x - 9, y - 8), z - 8), 0, 90).astype(np.float32))
    np.save(tmp_path / "b.npy", ((x > 12) * 3).astype(np.uint8))
    (tmp_path / "tf.json").write_text(
        '{"points": [{"x": 0, "opacity": 0, "rgb": [1, 0, 0]}, {"x": 90, "opacity": 0.5, "rgb": [1, 1, 0]}]}'
    )
    words = ("--tf", tmp_path / "tf.json", "--layer", tmp_path / "b.npy", "--max_gaussians", 300, "--screen", 64)
    result = vvgt.ok("--slicer", *words, tmp_path / "a.npy", tmp_path / "out_1.ply")
    header = read_ply(tmp_path / "out_1.ply")[1]
    assert header.screen_size == 64
    assert 100 < header.count <= 300
    assert "distinct colours" in result.err
    lines = result.out.decode().splitlines()
    assert all(line.startswith("<filter-") for line in lines)
    shares = [float(line[17:-18]) for line in lines if line.startswith("<filter-progress>")]
    assert 0 < len(shares) < 1500
    assert max(shares) == 1
    assert any("<filter-name>refinement</filter-name>" in line for line in lines)
    assert vvgt("--slicer", tmp_path / "a.npy").error.endswith("as 3D Slicer gives them")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """What `slicer_scene.py` leaves."""
    python = os.environ.get("SLICER_PYTHON")
    if python is None:
        pytest.skip("no 3D Slicer: set SLICER_PYTHON to a Python with slicer-core (pip install slicer-core)")
    folder = tmp_path_factory.mktemp("slicer")
    words = f"env PYTHONPATH={ROOT} {sys.executable} -m vvgt_cli.commands.main"
    done = subprocess.run(
        [python, ROOT / "tests" / "slicer_scene.py", folder], env=os.environ | {"VVGT": words}, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return folder, json.loads((folder / "facts.json").read_text())


def heaviest(path: Path) -> np.ndarray:
    """The mean place of the Gaussians in the world (mm), by opacity times volume."""
    gaussians, header = open_gaussians(str(path))
    mass = np.exp(gaussians.log_scales.sum(axis=1).astype(float)) / (
        1 + np.exp(-gaussians.opacity_logits.astype(float))
    )
    return (mass @ gaussians.means) / mass.sum() / header.scale + header.centre


@pytest.mark.long
def test_a_point_is_where_slicer_has_it_under_a_transform(scene) -> None:
    folder, facts = scene
    header = read_ply(folder / "volume.ply")[1]
    assert (header.space, header.affine) == ("RAS", pytest.approx(facts["affine"], abs=1e-9))
    moved = np.reshape(facts["affine"], (3, 4))[:, 0] * 6  # the second step of the sequence
    assert heaviest(folder / "series_0.ply") == pytest.approx(facts["at"][:3], abs=0.01)
    assert heaviest(folder / "series_1.ply") == pytest.approx(facts["at"][:3] + moved, abs=0.01)
    assert facts["refused"].startswith("ct: its transform bent is not linear; harden it")


@pytest.mark.long
def test_the_picture_is_slicers_own(scene) -> None:
    folder, facts = scene
    assert facts["volumes"] == 1
    assert read_ply(folder / "volume.ply")[1].camera == pytest.approx((*facts["eye"], *facts["at"][:3], facts["angle"]))
    gaussians, header = open_gaussians(str(folder / "volume.ply"))
    eye, target = (header.scale * (np.array(facts[key][:3]) - header.centre) for key in ("eye", "at"))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0, 0, 1)) / np.linalg.norm(np.cross(forward, (0, 0, 1)))
    turn = np.stack([right, np.cross(forward, right), forward])
    theirs = np.load(folder / "slicer.npy").astype(np.float32) / 255
    size = len(theirs)
    focal = size / 2 / np.tan(np.radians(facts["angle"]) / 2)
    camera = Camera(turn, -turn @ eye, focal, focal, size / 2, size / 2, size, size)
    found = psnr(theirs, render(gaussians, camera, INRIA)[..., :3])
    print(f"Slicer's volume rendering against our Gaussians: {found:.1f} dB")
    assert found > 35  # 37.9 dB; its rays take steps of 0.25 mm, and pixels have 256 levels


@pytest.mark.long
def test_segments_keep_names_and_colours_and_hidden_ones_are_left(scene) -> None:
    folder, facts = scene
    legend = json.loads(read_ply(folder / "segments.ply")[1].legend)
    assert [name for name, _ in legend["labels"]] == ["left kidney, upper", "cyst"]
    assert legend["labels"][0][1].lower() == "336699"
    assert heaviest(folder / "segments.ply") == pytest.approx(facts["at"][:3], abs=0.2)  # mm; refined
    both = read_ply(folder / "both.ply")[1]
    assert both.count > 1000
    assert json.loads(both.legend) == legend


@pytest.mark.long
def test_the_modules_logic_takes_nodes_and_the_first_view(scene) -> None:
    folder, facts = scene
    assert facts["logic"] == []
    header = read_ply(folder / "logic.ply")[1]
    assert header.camera == pytest.approx((*facts["eye"], *facts["at"][:3], facts["angle"]))
    assert header.count > 1000


@pytest.mark.long
def test_a_region_of_interest_hides_what_is_outside(scene) -> None:
    folder, facts = scene
    gaussians, header = open_gaussians(str(folder / "cropped.ply"))
    heights = gaussians.means[:, 2] / header.scale + header.centre[2]
    assert heights.min() > facts["at"][2] - 1.5  # mm: a voxel
    whole = open_gaussians(str(folder / "volume.ply"))[0].means[:, 2] / header.scale + header.centre[2]
    assert whole.min() < facts["at"][2] - 8


def test_the_camera_and_its_up_are_taken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from vtkmodules.vtkRenderingCore import vtkRenderer

    monkeypatch.setitem(sys.modules, "slicer", ModuleType("slicer"))
    words = runpy.run_path(str(ROOT / "vvgt_cli" / "integrations" / "mrml.py"))["words"]
    renderer = vtkRenderer()
    renderer.GetActiveCamera().SetPosition(0, 0, 5)
    assert words(tmp_path, renderer=renderer) == (["--camera", "0.0,0.0,5.0,0.0,0.0,0.0,30.0", "--up", "y"], [])
