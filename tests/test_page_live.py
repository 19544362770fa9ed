"""The page of Gaussians that carry values: what it holds, and its program's arithmetic against ours."""

from __future__ import annotations

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

from tests.test_live import COLORS, HI, LO, RAMP, WINDOW, cloud, facts
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.formats import encoded, format_of
from vvgt_cli.gaussians.formats.live import from_bytes
from vvgt_cli.gaussians.formats.page_file import read_html
from vvgt_cli.gaussians.formats.page_live import PLANES, nodes_of
from vvgt_cli.gaussians.frames import turn, up_matrix
from vvgt_cli.gaussians.live import Table, baked
from vvgt_cli.look.colormap import ColorMap
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.opacity import PiecewiseOpacity

STEP = TransferFunction("step", PiecewiseOpacity(np.array([0.0, 20, 20, 60]), np.array([0.0, 0.1, 0.8, 0.3])), COLORS)
LAB = TransferFunction("lab", RAMP.opacity_nodes, ColorMap(COLORS.x, COLORS.rgb, space="Lab"))


def page_of(gaussians: Gaussians, options: PlyOptions, name: str = "a.html") -> tuple[bytes, dict[str, Any]]:
    """The page, and the scene that it holds."""
    known = format_of(name)
    assert known is not None
    content = encoded(known, gaussians, options, name)
    found = re.search(rb'id="scene">(.*?)</script>', content, re.S)
    assert found is not None
    return content, json.loads(found[1])


def options(**given: Any) -> PlyOptions:
    affine = (1.0, 0, 0, 0, 0, 2.0, 0, 0, 0, 0, 1.0, 0)
    return replace(PlyOptions(up="y", scale=0.1, unit_distance=0.5, affine=affine, live=facts()), **given)


def test_the_page_holds_what_the_gaussians_carry_in_the_order_of_its_file() -> None:
    some = baked(cloud(600), Table.of_function(RAMP, LO, HI, 0.05))
    content, scene = page_of(some, options())
    live = scene["live"]
    held = re.search(rb'id="values-0">([^<]+)<', content)
    assert held is not None
    planes = np.frombuffer(gzip.decompress(base64.b64decode(held[1])), np.uint8).reshape(len(PLANES), -1)
    stream = np.zeros((600, 8), np.uint8)
    stream[:, PLANES] = planes.T
    wanted, splats = turn(some, "y"), read_html(content, "a.html")
    away = np.linalg.norm(wanted.means[:, None] - splats.means, axis=2)
    order = away.argmin(axis=0)
    assert sorted(order.tolist()) == list(range(600))
    assert away.min(axis=0).max() < 2e-3
    carried = wanted.take(order).live
    assert carried is not None
    found = from_bytes(stream, live)
    np.testing.assert_allclose(found[:, 0], carried[:, 0], atol=0.51 * (HI - LO) / 255)
    np.testing.assert_allclose(np.log(found[:, 2]), np.log(carried[:, 2]), atol=0.01)
    np.testing.assert_allclose(found[:, 3:], carried[:, 3:], atol=0.51 / 127)
    assert live["unit_distance"] == pytest.approx(0.05)
    assert (live["values"], live["unit"]) == ([LO, HI], "HU")
    np.testing.assert_allclose(live["box"], [some.means.min(axis=0), some.means.max(axis=0)], atol=1e-6)
    for axis in range(3):  # a plane across an axis of the volume, where the viewer has it
        there = (up_matrix("y") @ np.eye(3)[axis]) * (-1, -1, 1)
        np.testing.assert_allclose(live["axes"][axis], there, atol=1e-12)


def test_a_page_without_values_has_none() -> None:
    _, scene = page_of(replace(cloud(), live=None), replace(options(), live=None))
    assert "live" not in scene


def test_no_name_is_markup() -> None:
    some = baked(cloud(), Table.of_function(RAMP, LO, HI, 0.05))
    known = facts(replace(RAMP, name="</script><b>x"))
    content, scene = page_of(some, options(live=known), "</title><script>alert(1)</script>.html")
    assert b"<script>alert" not in content
    assert b"</script><b>" not in content
    assert scene["live"]["name"] == "</script><b>x"


def test_no_folder_is_in_the_page() -> None:
    some = baked(cloud(), Table.of_function(RAMP, LO, HI, 0.05))
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


@pytest.mark.parametrize("tf", [RAMP, WINDOW, STEP])
def test_the_pages_program_makes_our_table(tf: TransferFunction, tmp_path: Path) -> None:
    if not shutil.which("node"):
        pytest.skip("node is not on the path")
    _, scene = page_of(baked(cloud(), Table.of_function(tf, LO, HI, 0.05)), options(live=facts(tf)))
    program = Path(__file__).parent.parent / "vvgt_cli" / "gaussians" / "formats" / "page" / "live_table.mjs"
    (tmp_path / "live.json").write_text(json.dumps(scene["live"]))
    (tmp_path / "run.mjs").write_text(
        f"import {{ sumsOf, texelsOf }} from {json.dumps(program.as_uri())};\nimport fs from 'node:fs';\n"
        "const live = JSON.parse(fs.readFileSync('live.json')), sums = sumsOf(live.nodes, live);\n"
        "fs.writeFileSync('sums', sums);\nfs.writeFileSync('texels', texelsOf(sums, live.table));\n"
    )
    subprocess.run(["node", "run.mjs"], cwd=tmp_path, check=True, timeout=120)
    wanted = Table.of_function(tf, LO, HI, 0.05).sums
    sums = np.fromfile(tmp_path / "sums").reshape(wanted.shape)
    np.testing.assert_allclose(sums, wanted, atol=2e-4 * wanted[..., 3].max())
    texels = np.fromfile(tmp_path / "texels", np.float32).reshape(2, *wanted.shape[1::-1], 4)
    np.testing.assert_allclose(texels[0], wanted[..., :4].transpose(1, 0, 2), atol=2e-4 * wanted[..., 3].max())
    np.testing.assert_allclose(texels[1, ..., :2], wanted[..., 4:].transpose(1, 0, 2), atol=2e-3 * wanted[..., 3].max())
