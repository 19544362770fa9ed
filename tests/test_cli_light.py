"""Light on the command line and in the library: files that say what fell on them, degrees, normals, refusals."""

import json

import numpy as np
import pytest

import vvgt_cli
from tests.processes import replaced
from vvgt_cli import Look
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import read_ply
from vvgt_cli.gaussians.ply import _rows
from vvgt_cli.look.labels import LabelTable
from vvgt_cli.look.lighting import MATTE, Lighting, LightOptions
from vvgt_cli.volume import Volume

SOURCE = "example:marschner-lobb:24"
SMALL = ("--max-gaussians", "300", "--screen", "48", "--steps", "24")
FUNCTION = {
    "points": [{"x": 0.0, "rgb": [1, 0.5, 0.2], "opacity": 0}, {"x": 0.5, "opacity": 0.6}, {"x": 1, "opacity": 0.6}],
    "lighting": {"diffuse": 0.9},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("light")
    (place / "lit.json").write_text(json.dumps(FUNCTION))
    (place / "dark.json").write_text(json.dumps({"points": FUNCTION["points"]}))
    return place


def tf(folder, name="dark"):
    return ("--tf", str(folder / f"{name}.json"))


def psnr(vvgt, ply, *more):
    result = vvgt.ok("evaluate", ply, "--volume", SOURCE, "--no-conditions", "--step", "0.5", "--json", *more)
    return json.loads(result.out)["scores"]["psnr"]


def test_a_lit_file_says_its_light_and_is_judged_under_it(folder, vvgt):
    out = folder / "head.ply"
    report = folder / "head.json"
    vvgt.ok("convert", SOURCE, *tf(folder), *SMALL, "--light", "headlight", "--report", report, "-o", out)
    gaussians, header = read_ply(out)
    assert header.light == Lighting()
    assert gaussians.degree == header.sh_degree == 2
    told = json.loads(report.read_text())
    assert told["transfer_function"]["light"] == Lighting().text()
    own = psnr(vvgt, out, *tf(folder))
    assert abs(own - told["scores"]["psnr"]) < 1.5
    assert psnr(vvgt, out, *tf(folder), "--light", "none") < own - 3
    rows = _rows(out, "head")[1]
    normals = np.stack([rows[n] for n in ("nx", "ny", "nz")], axis=1)
    assert (np.abs(np.linalg.norm(normals, axis=1) - 1) < 1e-5).mean() > 0.9
    assert json.loads(vvgt("info", out, "--json").out)["light"] == Lighting().text()


def test_light_that_does_not_depend_on_the_view_needs_no_harmonics(folder, vvgt):
    out = folder / "fixed.ply"
    vvgt.ok("convert", SOURCE, *tf(folder), *SMALL, "--light 1,0,2 --specular 0", "-o", out)
    gaussians, header = read_ply(out)
    assert (gaussians.harmonics, header.sh_degree) == (None, 0)
    dark = folder / "dark.ply"
    vvgt.ok("convert", SOURCE, *tf(folder), *SMALL, "-o", dark)
    assert read_ply(dark)[1].light is None
    assert gaussians.colors.mean() < 0.8 * read_ply(dark)[0].colors.mean()
    assert not np.any(_rows(dark, "dark")[1]["nz"])


def test_a_degree_that_cannot_hold_it_is_said(folder, vvgt):
    out = folder / "flat.ply"
    made = vvgt.ok("init", SOURCE, *tf(folder, "lit"), "--max-gaussians", "300", "--sh-degree", "0", "-o", out)
    assert "--sh-degree 0: headlight and highlights change with the view" in made.err
    gaussians, header = read_ply(out)
    assert (gaussians.degree, header.light) == (0, Lighting(diffuse=0.9))
    for degree in (1, 3):
        few = ("--max-gaussians 300 --overwrite --sh-degree", degree, "-o", out)
        again = vvgt("init", SOURCE, *tf(folder, "lit"), *few)
        assert read_ply(out)[1].sh_degree == degree
        assert ("change with the view" in again.err) == (degree == 1)


def test_a_preset_decides_unless_it_is_overruled(folder, vvgt):
    shown = {}
    for name, more in (("preset", ()), ("none", ("--light", "none")), ("left", ("--light", "left"))):
        views = "--views 1 --test-views 0 --size 32 --format exr --no-points"
        vvgt.ok("render-views", SOURCE, *tf(folder, "lit"), views, *more, "-o", folder / name)
        shown[name] = next((folder / name).rglob("*.exr")).read_bytes()
    assert len(set(shown.values())) == 3


def test_what_cannot_be_is_refused_before_the_work(folder, vvgt):
    for options, message in (
        (("--light", "0,0,0"), "--light 0,0,0: its length is 0"),
        (("--specular", "0.5"), "--specular: there is no light"),
        (("--light", "headlight", "--ambient", "nan"), "--ambient nan"),
    ):
        assert message in vvgt.fails(2, "convert", SOURCE, *tf(folder), *options, "-o", folder / "no.ply")
        assert not (folder / "no.ply").exists()


def test_the_library_takes_names_directions_and_options():
    function = {"points": FUNCTION["points"]}
    few = {"max_gaussians": 100, "screen": 40, "steps": 0}
    by_name = vvgt_cli.convert(SOURCE, Look(function, light="headlight"), **few)
    assert by_name.field.source.lighting == Lighting()
    assert by_name.gaussians.degree == 2
    assert by_name.normals().shape == by_name.gaussians.means.shape
    by_direction = vvgt_cli.convert(SOURCE, Look(function, light=(0, 0, 1)), **few)
    assert by_direction.field.source.lighting == Lighting(False, ((0, 0, 1),))
    options = LightOptions(("above", "headlight"), specular=0)
    _, images = vvgt_cli.render_views(SOURCE, Look(function, light=options), views=1, size=32)
    _, dark = vvgt_cli.render_views(SOURCE, function, views=1, size=32)
    assert np.abs(images - dark).max() > 0.05
    np.testing.assert_allclose(images[..., 3], dark[..., 3], atol=0.02)  # other pixels get more rays


def test_presets_with_surfaces_and_label_maps_are_lit_unless_told_otherwise() -> None:
    values = np.zeros((8, 8, 8), np.int16) - 1000
    values[2:6, 2:6, 2:6], values[:, :1] = 1200, 40
    scan, labels = Volume(values), Volume((values == 1200).astype(np.uint8))
    names = ("ct-bone", "ct-vessels", "ct-skin", "mr-head", "mr-angio", "ct-soft-tissue", "ct-lung", "viridis", None)
    found = {name: load(SourceRequest(scan, tf=name)).lighting for name in names}
    assert [name for name, light in found.items() if light == MATTE] == list(names[:5])
    assert [name for name, light in found.items() if light is None] == list(names[5:])
    table = load(SourceRequest(labels, labels="auto")).lighting
    assert table.ambient + table.diffuse == 1
    unlit, layer = LightOptions(("none",)), SourceRequest(labels, labels="auto")
    assert load(SourceRequest(scan, tf="ct-bone", light=unlit)).lighting is None
    assert load(SourceRequest(labels, labels="auto", light=unlit)).lighting is None
    assert load(SourceRequest(scan, tf="viridis", layers=(layer,))).lighting is None  # the first layer decides
    assert load(SourceRequest(scan, tf="ct-bone", layers=(layer,))).lighting == MATTE
    above = load(SourceRequest(scan, tf="ct-bone", light=LightOptions(("above",)))).lighting
    assert above == Lighting(False, ((0.0, 0.0, 1.0),), 0.2, 1.0, 0.0)


def test_files_are_lit_by_default_in_memory_in_blocks_and_live(vvgt, tmp_path) -> None:
    np.save(tmp_path / "v.npy", np.pad(np.arange(1, 9, dtype=np.uint8).reshape(2, 2, 2).repeat(4, 0).repeat(4, 1), 2))
    look, headers = ("--labels", "auto", *SMALL[:4]), {}
    ways = {
        "a": ("--steps", 0),
        "b": ("--steps", 0, "--blocks", 16),
        "live": ("--live",),
        "flat": ("--live", "--light", "none"),
    }
    for name, more in ways.items():
        done = vvgt.ok("convert", tmp_path / "v.npy", *look, *more, "-o", tmp_path / f"{name}.ply")
        assert ("--light none omits it" in done.err) == (name != "flat")
        headers[name] = read_ply(tmp_path / f"{name}.ply")[1].light
    assert headers == dict.fromkeys(("a", "b", "live"), LabelTable.lighting) | {"flat": None}
    again = {"as": (), "new": ("--labels", "auto")}
    for name, more in again.items():  # a new table brings its light, the file's own look does not
        where = tmp_path / f"{name}.ply"
        vvgt.ok("recolor", tmp_path / "flat.ply", *more, "--opacity-unit-distance", 2, "-o", where)
        assert read_ply(where)[1].light == (LabelTable.lighting if more else None)


def test_a_network_leaves_harmonics_as_they_are(folder, vvgt):
    call = ("convert", SOURCE, *tf(folder), *replaced(SMALL, "--light", "headlight", "--steps", "8"))
    vvgt.ok(*call, "-o", folder / "plain.ply")
    vvgt.ok(*call, "--model", "vvgt-small", "-o", folder / "m.ply", "--report", folder / "m.json")
    stages = {stage["name"]: stage for stage in json.loads((folder / "m.json").read_text())["stages"]}
    assert stages["network"]["psnr"] > 15
    assert read_ply(folder / "m.ply")[0].degree == 2
