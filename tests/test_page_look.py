"""The look of a page: what it holds, and its program's arithmetic against ours."""

import base64
import io
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.test_live import COLORS, HI, LO, RAMP, WINDOW, cloud, facts
from vvgt_cli.gaussians import PlyOptions
from vvgt_cli.gaussians.formats.page_file import upright
from vvgt_cli.gaussians.formats.page_look import html, look_entry, nodes_of
from vvgt_cli.gaussians.formats.page_presets import Sketch, kind_of, presets_of
from vvgt_cli.gaussians.formats.page_values import PageLayer, values_of
from vvgt_cli.gaussians.formats.splats import splats_of
from vvgt_cli.gaussians.frames import up_matrix
from vvgt_cli.gaussians.live_facts import LiveFacts, function_text
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.readers.names import named_function
from vvgt_cli.look.tables import exposed_distance, extinction
from vvgt_cli.volume import Volume

STEP = TransferFunction("step", PiecewiseOpacity(np.array([0.0, 20, 20, 60]), np.array([0.0, 0.1, 0.8, 0.3])), COLORS)
LAB = TransferFunction("lab", RAMP.opacity_nodes, ColorMap(COLORS.x, COLORS.rgb, space="Lab"))


def page_of(known: LiveFacts | None, options: PlyOptions, name: str = "a.html") -> tuple[bytes, dict[str, Any]]:
    """The page of a volume under a look, and the scene that it holds."""
    held = values_of([PageLayer(Volume(np.zeros((2, 3, 4), np.uint8)), RAMP, 0.5)])
    assert held is not None
    values = None if known is None else held._replace(look=known)
    content = html(splats_of(replace(cloud(), live=None), upright(options)), name, values, options)
    found = re.search(rb'id="scene">(.*?)</script>', content, re.S)
    return content, json.loads(found[1])


def options(**given: Any) -> PlyOptions:
    affine = (1.0, 0, 0, 0, 0, 2.0, 0, 0, 0, 0, 1.0, 0)
    return replace(PlyOptions(up="y", scale=0.1, unit_distance=0.5, affine=affine), **given)


SHARES = ["soft surface", "hard surface", "one layer"]
CT = ["ct-bone", "ct-soft-tissue", "ct-vessels", "ct-lung", "ct-skin"]


def presets(
    function: TransferFunction, name: str, unit: str = "HU", longer: float = 1.0, **more: Any
) -> list[dict[str, Any]]:
    """Presets of a scan of a function, per a distance so many times as long as theirs."""
    known = replace(facts(), lo=-1000.0, hi=400.0, unit=unit, function=function_text(function, -1000.0, 400.0), **more)
    return presets_of(known, longer * 2 / 256, 2.0, kind_of(known, Volume(np.zeros((2, 2, 2)))), name)


def test_presets_suit_the_values_and_are_those_that_the_file_does_not_have() -> None:
    """None where Hounsfield units would be a guess; one of the file's own name, where its function is another one."""
    skin, bone = named_function("ct-skin"), named_function("ct-bone")
    one = presets(skin, "ct-skin")
    assert [found["name"] for found in one] == CT[:-1]
    assert [bool(found["light"]) for found in one] == [True, False, True, False]
    nodes = {node["x"]: node["y"] for node in one[0]["nodes"]}
    assert (nodes[250], nodes[450]) == (0.06, 0.25)
    assert [found["name"] for found in presets(bone, "ct-skin")] == CT[1:]
    assert [found["name"] for found in presets(skin, "ct-skin", longer=2)] == CT
    for name in ("ct-bone", "bone"):
        assert [found["title"] for found in presets(bone, name, unit="")] == SHARES
    scan = tuple(np.histogram(np.repeat([-995, 40.0], [300, 200]), 256, (-1000, 400))[0].tolist())
    assert [found["name"] for found in presets(bone, "bone", unit="", histogram=scan)] == CT[1:]
    assert [found["title"] for found in presets(bone, "bone", unit="K", histogram=scan)] == SHARES
    found = presets_of(replace(facts(), function=function_text(RAMP, LO, HI), histogram=scan), 1, 2, "mr")
    assert [one["name"] for one in found] == [*SHARES[:1], "mr-head", "mr-angio"]
    assert found[0]["light"] == {"ambient": 0.2, "diffuse": 1.0, "specular": 0.0}


@pytest.mark.parametrize("longer", [0.2, 8, 16])
def test_presets_keep_their_extinction_per_the_files_distance(longer: float) -> None:
    values = np.linspace(-1000, 3000, 9973)
    for found in presets(RAMP, "", longer=longer):
        x, y = (np.array([node[key] for node in found["nodes"]]) for key in "xy")
        wanted = longer * extinction(named_function(found["name"]).opacity(values), 1)
        np.testing.assert_allclose(extinction(PiecewiseOpacity(x, y)(values), 1), wanted, rtol=0.01, atol=1e-5)


def test_the_page_says_where_the_volume_lies_and_how_it_looks() -> None:
    look = page_of(replace(facts(), distance=0.5), options())[1]["look"]
    [layer] = look["layers"]
    assert (layer["unit_distance"], layer["opacity_unit_distance"]) == (pytest.approx(0.05), 0.5)
    assert (layer["values"], layer["unit"], layer["labels"]) == ([LO, HI], "HU", [])
    np.testing.assert_allclose(look["box"], [[-0.2, -0.15, -0.1], [0.2, 0.15, 0.1]], atol=1e-9)
    turned = Volume(np.zeros((2, 3, 4), np.uint8), direction=(0, 0, 1, 1, 0, 0, 0, 1, 0))  # i to y, j to z, k to x
    held = values_of([PageLayer(turned, RAMP, 0.5)])
    assert held is not None
    box = look_entry(held._replace(look=facts()), options())["box"]
    np.testing.assert_allclose(box, [[-0.1, -0.2, -0.15], [0.1, 0.2, 0.15]], atol=1e-9)  # of the world's axes
    for axis in range(3):  # a plane across an axis of the volume, where the viewer has it
        there = (up_matrix("y") @ np.eye(3)[axis]) * (-1, -1, 1)
        np.testing.assert_allclose(look["axes"][axis], there, atol=1e-12)


def test_a_page_without_values_has_a_fixed_look() -> None:
    assert not {"look", "values"} & set(page_of(None, options())[1])


def test_no_name_is_markup_and_no_folder_is_in_the_page() -> None:
    known = facts(replace(RAMP, name="</script><b>x"))
    content, scene = page_of(known, options(), "/home/someone/</title><script>alert(1)<\\script>.html")
    assert b"<script>alert" not in content
    assert b"</script><b>" not in content
    assert b"someone" not in content
    assert scene["look"]["layers"][0]["name"] == "</script><b>x"


@pytest.mark.parametrize("tf", [RAMP, WINDOW, STEP, LAB])
def test_nodes_are_those_of_the_function(tf: TransferFunction) -> None:
    nodes = nodes_of(facts(tf))
    x = np.linspace(LO, HI, 997)
    at = np.array([node["x"] for node in nodes])
    assert (np.diff(at) >= 0).all()
    np.testing.assert_allclose(
        PiecewiseOpacity(at, np.array([node["y"] for node in nodes]))(x), tf.opacity(x), atol=1e-5
    )
    colors = ColorMap(at, np.array([node["rgb"] for node in nodes]))(x)
    np.testing.assert_allclose(colors, tf.color(x), atol=5e-2 if tf is LAB else 2e-4)


def by_the_page(tf: TransferFunction, folder: Path, code: str) -> str:
    """Run code with functions of the page's table in node; return what it prints."""
    if not shutil.which("node"):
        pytest.skip("node is not on the path")
    [layer] = page_of(replace(facts(tf), distance=0.5), options())[1]["look"]["layers"]
    program = Path(__file__).parent.parent / "vvgt_cli" / "gaussians" / "formats" / "page" / "table.mjs"
    (folder / "run.mjs").write_text(
        f"import {{ exposed, tableOf }} from {json.dumps(program.as_uri())};\nimport fs from 'node:fs';\n"
        f"const layer = {json.dumps(layer)};\n{code}\n"
    )
    return subprocess.check_output(["node", "run.mjs"], cwd=folder, timeout=120, text=True)


@pytest.mark.parametrize("tf", [RAMP, WINDOW, STEP])
def test_the_pages_program_looks_values_up_as_the_ray_caster_does(tf: TransferFunction, tmp_path: Path) -> None:
    """Extinction and colour at each entry, and their sums, of which differences are means over ranges of values."""
    write = "fs.writeFileSync('texels', texels);\nfs.writeFileSync('seen', seen);"
    by_the_page(tf, tmp_path, f"const {{ texels, seen }} = tableOf(layer.nodes, layer, layer.unit_distance);\n{write}")
    at, sums = np.fromfile(tmp_path / "texels", np.float32).reshape(2, -1, 4)
    x = np.linspace(LO, HI, len(at))
    tau = extinction(tf.opacity(x), 0.05)
    np.testing.assert_allclose(at[:, 3], tau, rtol=2e-3, atol=1e-4)
    np.testing.assert_allclose(at[:, :3], tau[:, None] * tf.color(x), rtol=1e-2, atol=1e-3 * tau.max())
    np.testing.assert_allclose(sums[-1, 3], tau.mean(), rtol=2e-3)
    seen = np.fromfile(tmp_path / "seen", np.uint16).astype(int)
    np.testing.assert_array_equal(np.diff(seen), at[:, 3] > 0)


@pytest.mark.parametrize("tf", [RAMP, WINDOW, STEP])
def test_the_pages_program_exposes_an_x_ray_as_we_do(tf: TransferFunction, tmp_path: Path) -> None:
    found = by_the_page(tf, tmp_path, "console.log(exposed(layer.nodes, layer));")
    assert float(found) == pytest.approx(exposed_distance(tf, facts(tf).statistics(), 2.0), rel=1e-6)


def test_small_pictures_show_what_their_functions_do() -> None:
    """A ball in a block of which one function shows the ball, one the block; the eye is before and left of the body."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, n) for n in (20, 24, 28)], indexing="ij")
    values = np.where(np.hypot(x - 0.5, np.hypot(y, z)) < 0.35, 100.0, np.where(np.abs(z) < 0.5, 40.0, 0.0))
    volume = Volume(values.astype(np.float32), spacing=(24 / 28, 1.0, 1.2), space="LPS")
    colors = ColorMap(np.array([60.0, 80.0]), np.array([[0, 0, 1.0], [1.0, 0, 0]]))
    both = TransferFunction("both", PiecewiseOpacity(np.array([10.0, 30]), np.array([0.0, 0.9])), colors)
    ball = replace(both, opacity_nodes=PiecewiseOpacity(np.array([70.0, 80]), np.array([0.0, 0.9])))
    sketch = Sketch(values, volume.affine[:3], volume.extent, volume.space)
    red, blue = {}, {}
    for name, tf in (("both", both), ("ball", ball)):
        address = sketch.picture(tf, 1.0, max(volume.extent), None)
        assert len(address) < 4000
        content = base64.b64decode(address.removeprefix("data:image/webp;base64,"))
        pixels = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), np.float32) / 255
        red[name], blue[name] = (np.argwhere(pixels[..., c] > pixels[..., 2 - c] + 0.3) for c in (0, 2))
    assert len(red["both"]) < 60 < len(red["ball"])
    assert len(blue["both"]) > 1000 > 0 == len(blue["ball"])
    row, column = red["ball"].mean(axis=0)  # the left of the body is on the right
    assert column > 50
    assert row == pytest.approx(41.5, abs=8)
    lit = sketch.picture(ball, 1.0, max(volume.extent), {"ambient": 0.0, "diffuse": 1.0})
    shades = np.asarray(Image.open(io.BytesIO(base64.b64decode(lit.split(",")[1]))).convert("RGB"), np.float32)[..., 0]
    rows, columns = red["ball"].T
    edge, middle = shades[rows, columns].min(), shades[round(row), round(column)]
    assert middle > 180 > 140 > edge
