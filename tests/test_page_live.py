"""The page of Gaussians that carry values: what it holds, and its program's arithmetic against ours."""

import base64
import gzip
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.live_stream import from_bytes
from tests.test_live import COLORS, GRAIN, HI, LO, RAMP, WINDOW, cloud, facts
from vvgt_cli.cameras.sets import pixel_width
from vvgt_cli.conversion.grey import NO_GRAIN
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.formats import encoded, format_of
from vvgt_cli.gaussians.formats.live import BYTES, ROW
from vvgt_cli.gaussians.formats.page_file import read_html
from vvgt_cli.gaussians.formats.page_live import nodes_of, planes_of, presets_of
from vvgt_cli.gaussians.formats.splats import morton_order
from vvgt_cli.gaussians.frames import rotations, turn, up_matrix
from vvgt_cli.gaussians.live import Looks, Table, apply_look, baked
from vvgt_cli.gaussians.live_facts import LABEL_ROW, function_text
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.readers.names import named_function
from vvgt_cli.look.tables import exposed_distance, extinction

STEP = TransferFunction("step", PiecewiseOpacity(np.array([0.0, 20, 20, 60]), np.array([0.0, 0.1, 0.8, 0.3])), COLORS)
LAB = TransferFunction("lab", RAMP.opacity_nodes, ColorMap(COLORS.x, COLORS.rgb, space="Lab"))


def page_of(gaussians: Gaussians, options: PlyOptions, name: str = "a.html") -> tuple[bytes, dict[str, Any]]:
    """The page, and the scene that it holds."""
    known = format_of(name)
    assert known is not None
    content = encoded(known, gaussians, options, name)
    found = re.search(rb'id="scene">(.*?)</script>', content, re.S)
    return content, json.loads(found[1])


def options(**given: Any) -> PlyOptions:
    affine = (1.0, 0, 0, 0, 0, 2.0, 0, 0, 0, 0, 1.0, 0)
    return replace(PlyOptions(up="y", scale=0.1, unit_distance=0.5, affine=affine, live=facts()), **given)


CT = ["ct-bone", "ct-soft-tissue", "ct-vessels", "ct-lung", "ct-skin"]


def presets(
    function: TransferFunction, name: str, unit: str = "HU", longer: float = 1.0, **more: Any
) -> list[dict[str, Any]]:
    """Presets of a scan of a function, per a distance so many times as long as theirs."""
    known = replace(facts(), lo=-1000.0, hi=400.0, unit=unit, function=function_text(function, -1000.0, 400.0), **more)
    return presets_of(known, {"name": name, "unit_distance": longer * 2 / 256})


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
    assert [presets(bone, name, unit="") for name in ("ct-bone", "bone")] == [[], []]
    scan = tuple(np.histogram(np.repeat([-995, 40.0], [300, 200]), 256, (-1000, 400))[0].tolist())
    assert [found["name"] for found in presets(bone, "bone", unit="", histogram=scan)] == CT[1:]
    assert presets(bone, "bone", unit="K", histogram=scan) == []


@pytest.mark.parametrize("longer", [0.2, 8, 16])
def test_presets_keep_their_extinction_per_the_files_distance(longer: float) -> None:
    values = np.linspace(-1000, 3000, 9973)
    for found in presets(RAMP, "", longer=longer):
        x, y = (np.array([node[key] for node in found["nodes"]]) for key in "xy")
        wanted = longer * extinction(named_function(found["name"]).opacity(values), 1)
        np.testing.assert_allclose(extinction(PiecewiseOpacity(x, y)(values), 1), wanted, rtol=0.01, atol=1e-5)


def test_the_page_holds_what_the_gaussians_carry_in_the_order_of_its_file() -> None:
    some = baked(cloud(600), Table.of_function(RAMP, LO, HI, 0.05, GRAIN))
    content, scene = page_of(some, options())
    live = scene["live"]
    [layer] = live["layers"]
    held = re.search(rb'id="values-0">([^<]+)<', content)
    planes = np.frombuffer(gzip.decompress(base64.b64decode(held[1])), np.uint8).reshape(ROW, -1)
    stream = np.zeros((600, BYTES), np.uint8)
    stream[:, :ROW] = planes.T
    wanted, splats = turn(some, "y"), read_html(content, "a.html")
    away = np.linalg.norm(wanted.means[:, None] - splats.means, axis=2)
    order = away.argmin(axis=0)
    assert sorted(order.tolist()) == list(range(600))
    assert away.min(axis=0).max() < 2e-3
    carried = wanted.take(order).live
    found = from_bytes(stream, live)
    np.testing.assert_allclose(found[:, 0], carried[:, 0], atol=0.51 * (HI - LO) / 255)
    np.testing.assert_allclose(np.log(found[:, 2]), np.log(carried[:, 2]), atol=0.01)
    np.testing.assert_allclose(found[:, 3:], carried[:, 3:], atol=0.51 / 127)
    assert layer["unit_distance"] == pytest.approx(0.05)
    assert (layer["values"], layer["unit"]) == ([LO, HI], "HU")
    np.testing.assert_allclose(live["box"], [some.means.min(axis=0), some.means.max(axis=0)], atol=1e-6)
    for axis in range(3):  # a plane across an axis of the volume, where the viewer has it
        there = (up_matrix("y") @ np.eye(3)[axis]) * (-1, -1, 1)
        np.testing.assert_allclose(live["axes"][axis], there, atol=1e-12)


def test_a_page_without_values_has_none() -> None:
    _, scene = page_of(replace(cloud(), live=None), replace(options(), live=None))
    assert "live" not in scene


def test_no_name_is_markup() -> None:
    some = baked(cloud(), Table.of_function(RAMP, LO, HI, 0.05, GRAIN))
    known = facts(replace(RAMP, name="</script><b>x"))
    content, scene = page_of(some, options(live=known), "</title><script>alert(1)</script>.html")
    assert b"<script>alert" not in content
    assert b"</script><b>" not in content
    assert scene["live"]["layers"][0]["name"] == "</script><b>x"


def test_no_folder_is_in_the_page() -> None:
    some = baked(cloud(), Table.of_function(RAMP, LO, HI, 0.05, GRAIN))
    content, scene = page_of(some, options(), "/home/someone/a.html")
    assert scene["frames"][0]["name"] == "a"
    assert b"someone" not in content


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


def by_the_page(tf: TransferFunction, folder: Path, names: str, code: str) -> str:
    """Run code with functions of the page's table in node; return what it prints."""
    if not shutil.which("node"):
        pytest.skip("node is not on the path")
    _, scene = page_of(baked(cloud(), Table.of_function(tf, LO, HI, 0.05, GRAIN)), options(live=facts(tf)))
    program = Path(__file__).parent.parent / "vvgt_cli" / "gaussians" / "formats" / "page" / "live_table.mjs"
    (folder / "run.mjs").write_text(
        f"import {{ {names} }} from {json.dumps(program.as_uri())};\nimport fs from 'node:fs';\n"
        f"const all = {json.dumps(scene['live'])}, live = {{ ...all, ...all.layers[0] }};\n{code}\n"
    )
    return subprocess.check_output(["node", "run.mjs"], cwd=folder, timeout=120, text=True)


@pytest.mark.parametrize("tf", [RAMP, WINDOW, STEP])
def test_the_pages_program_makes_our_table(tf: TransferFunction, tmp_path: Path) -> None:
    write = "fs.writeFileSync('sums', sums);\nfs.writeFileSync('texels', texelsOf(sums, live.table));"
    by_the_page(tf, tmp_path, "sumsOf, texelsOf", f"const sums = sumsOf(live.nodes, live);\n{write}")
    wanted = Table.of_function(tf, LO, HI, 0.05, GRAIN).sums
    sums = np.fromfile(tmp_path / "sums").reshape(wanted.shape)
    np.testing.assert_allclose(sums, wanted, atol=2e-4 * wanted[..., 3].max())
    texels = np.fromfile(tmp_path / "texels", np.float32).reshape(2, *wanted.shape[1::-1], 4)
    np.testing.assert_allclose(texels[0], wanted[..., :4].transpose(1, 0, 2), atol=2e-4 * wanted[..., 3].max())
    np.testing.assert_allclose(texels[1, ..., :2], wanted[..., 4:].transpose(1, 0, 2), atol=2e-3 * wanted[..., 3].max())


@pytest.mark.parametrize("tf", [RAMP, WINDOW, STEP])
def test_the_pages_program_exposes_an_x_ray_as_we_do(tf: TransferFunction, tmp_path: Path) -> None:
    told = "const found = exposed(live.nodes, live);\nconsole.log(found.unit_distance);"
    write = "fs.writeFileSync('sums', sumsOf(live.nodes, found));"
    found = by_the_page(tf, tmp_path, "exposed, sumsOf", f"{told}\n{write}")
    distance = exposed_distance(tf, facts(tf).statistics(), 2.0)
    assert float(found) == pytest.approx(distance, rel=1e-6)
    wanted = Table.of_function(tf, LO, HI, distance, NO_GRAIN * facts(tf).grain).sums
    sums = np.fromfile(tmp_path / "sums").reshape(wanted.shape)
    np.testing.assert_allclose(sums[..., 3:], wanted[..., 3:], atol=2e-3 * wanted[..., 3].max())


@pytest.mark.parametrize("tf", [RAMP, WINDOW, STEP])
def test_the_pages_program_shows_gaussians_as_we_do(tf: TransferFunction, tmp_path: Path) -> None:
    table = Table.of_function(tf, LO, HI, 0.05, GRAIN)
    compare(baked(cloud(), table), options(live=facts(tf), up="none", screen_size=300), table, tmp_path)


def compare(some: Gaussians, laid: PlyOptions, table: Looks, folder: Path) -> None:
    """Place, shape and opacity of each, as live_at.mjs has them for what is picked; live.glsl has the same formulas."""
    if not shutil.which("node"):
        pytest.skip("node is not on the path")
    content, scene = page_of(some, laid)
    held = re.search(rb'id="values-0">([^<]+)<', content)
    assert laid.live is not None
    planes, own = gzip.decompress(base64.b64decode(held[1])), planes_of(laid.live)
    wanted = turn(some, "z").take(morton_order(turn(some, "z").means))
    stream = np.zeros((len(some), BYTES), np.uint8)
    stream[:, :own] = np.frombuffer(planes, np.uint8).reshape(own, -1).T
    carried = wanted.live
    wanted = replace(wanted, live=from_bytes(stream, scene["live"]))
    np.testing.assert_array_equal(wanted.live[:, LABEL_ROW:], carried[:, LABEL_ROW:])
    axes = rotations(wanted.quaternions.astype(float)) * np.exp(wanted.log_scales.astype(float))[:, None, :]
    flip = np.array([-1.0, -1, 1])  # the viewer has PLY (x, y, z) at (-x, -y, z)
    given = {"live": scene["live"], "bytes": list(planes), "centers": (wanted.means * flip).tolist()}
    given["arms"] = (axes * flip[:, None]).transpose(0, 2, 1).tolist()
    page = Path(__file__).parent.parent / "vvgt_cli" / "gaussians" / "formats" / "page"
    (folder / "given.json").write_text(json.dumps(given))
    for name in ("live_table.mjs", "live_at.mjs"):
        shutil.copy(page / name, folder / name)
    (folder / "cloud.mjs").write_text("export const around = () => [];\n")  # without the engine, which it is of
    (folder / "run.mjs").write_text(
        "import { sumsOf } from './live_table.mjs';\nimport { layersOf, looksOf } from './live_at.mjs';\n"
        "import fs from 'node:fs';\n"
        "const { live, bytes, centers, arms } = JSON.parse(fs.readFileSync('given.json'));\n"
        "const layers = layersOf(live), count = centers.length;\n"
        "const sums = layers.map((layer) => layer.nodes.length && sumsOf(layer.nodes, layer));\n"
        "const rows = layers.flatMap(({ labels }) => (labels.length ? labels : [null]));\n"
        "const look = looksOf({ live, layers, bytes, count, sums, rows });\n"
        "const found = centers.map((center, i) => look(i, { center, arms: arms[i] }));\n"
        "fs.writeFileSync('found.json', JSON.stringify(found));\n"
    )
    subprocess.run(["node", "run.mjs"], cwd=folder, check=True, timeout=120)
    found = json.loads((folder / "found.json").read_text())
    ours = apply_look(wanted, table, pixel_width(300))
    alpha = 1 / (1 + np.exp(-ours.opacity_logits.astype(float)))
    axes = rotations(ours.quaternions.astype(float)) * np.exp(ours.log_scales.astype(float))[:, None, :]
    for k, one in enumerate(found):
        if one is None:
            assert alpha[k] < 1e-3
            continue
        np.testing.assert_allclose(np.array(one["center"]) * flip, ours.means[k], atol=2e-3)
        assert one["opacity"] == pytest.approx(alpha[k], abs=2e-3)
        own = np.array(one["arms"]) * flip
        np.testing.assert_allclose(own.T @ own, axes[k] @ axes[k].T, atol=2e-5)
