"""What files say of where they are, and what the page's program makes of it."""

import io
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest

from vvgt_cli.conversion.gaussian_files import layout_of
from vvgt_cli.conversion.place import with_place
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply, write_ply
from vvgt_cli.gaussians.formats.page_file import camera, outermost, upright
from vvgt_cli.gaussians.formats.page_look import html
from vvgt_cli.gaussians.formats.splats import Splats, splats_of
from vvgt_cli.gaussians.frames import UP_NAMES
from vvgt_cli.gaussians.header import Certificate, checked, legend_text
from vvgt_cli.look.labels import Label, LabelTable
from vvgt_cli.look.readers.minimal import read
from vvgt_cli.volume import ReadOptions, Volume, read_volume

PAGE = Path(__file__).parent.parent / "vvgt_cli" / "gaussians" / "formats" / "page"
POINT = np.array([0.3, -0.5, 0.7], np.float32)  # in the unit frame
SCALE, CENTRE = 0.04, (5.0, -6.0, 7.5)
AFFINE = (1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0)
NAME = 'a "b" <i>ü\nc'


def one() -> Gaussians:
    ones = np.ones((1, 3), np.float32)
    return Gaussians(POINT[None], -4 * ones, np.array([[1, 0, 0, 0]], np.float32), ones[:, 0], ones)


def test_a_page_states_the_extent_of_visible_gaussians() -> None:
    """Of all of its clouds, in the viewer's axes; not what is too faint to be seen."""
    means = np.random.default_rng(3).uniform(-1, 1, (500, 3)).astype(np.float32)
    some = replace(splats_of(one(), PlyOptions()), means=means, logits=np.full(500, -2.0, np.float32))
    far = replace(some, means=means[:2] + 5, logits=np.array([3.0, -6.0], np.float32))
    places = np.array(outermost([some, far]))
    shown = np.concatenate([means, far.means[:1]]) * (-1, -1, 1)
    np.testing.assert_allclose(
        [places.min(axis=0), places.max(axis=0)], [shown.min(axis=0), shown.max(axis=0)], atol=1e-3
    )
    assert outermost([replace(far, logits=far.logits - 9)]) == []
    fog = np.array(
        outermost([replace(some, logits=np.full(500, -4.0, np.float32)), replace(far, logits=far.logits - 5)])
    )
    assert np.ptp(fog, axis=0).min() > 1.9  # all faint, and seen together


def test_a_round_body_fits_from_every_side() -> None:
    means = np.random.default_rng(4).normal(size=(4000, 3))
    ball = (means / np.linalg.norm(means, axis=1)[:, None]).astype(np.float32)
    points = np.array(
        outermost([replace(splats_of(one(), PlyOptions()), means=ball, logits=np.zeros(4000, np.float32))])
    )
    assert (points @ ball[:500].T).max(axis=0).min() > 0.95


def node(text: str, folder: Path) -> Any:
    """What a program that imports from the page's modules prints, as JSON."""
    if not shutil.which("node"):
        pytest.skip("node is not on the path")
    (folder / "run.mjs").write_text(text.replace("page:", PAGE.as_uri() + "/"))
    done = subprocess.run(["node", "run.mjs"], cwd=folder, capture_output=True, text=True, check=True, timeout=120)
    return json.loads(done.stdout)


def world_of(splats: Splats, folder: Path) -> dict[str, Any]:
    """Facts and world of a cloud, and where its first Gaussian is, by the page's program."""
    x, y, z = splats.means[0].astype(float).tolist()
    return dict(
        node(
            "import { factsOf, worldOf } from 'page:facts.mjs';\n"
            f"const facts = factsOf({json.dumps(list(splats.comments))}), world = worldOf(facts);\n"
            f"console.log(JSON.stringify({{ ...world, facts, at: world.place([{-x}, {-y}, {z}]) }}));",
            folder,
        )
    )


def test_comments_hold_the_unit_and_the_function() -> None:
    for options in (PlyOptions(length_unit="um", function=NAME), PlyOptions()):
        stream = io.BytesIO()
        write_ply(stream, one(), options)
        stream.seek(0)
        header = read_ply(stream)[1]
        assert (header.length_unit, header.function) == (options.length_unit, options.function)


@pytest.mark.parametrize("up", UP_NAMES)
def test_the_page_knows_the_place_and_the_letters(up: str, tmp_path: Path) -> None:
    options = PlyOptions(up=up, scale=SCALE, centre=CENTRE, space="LPS", affine=AFFINE, function=NAME)
    found = world_of(splats_of(one(), upright(options)), tmp_path)
    np.testing.assert_allclose(found["at"], POINT / SCALE + CENTRE, atol=1e-4)
    assert found["length"] == pytest.approx(1 / SCALE)
    assert (found["unit"], found["letters"]) == ("mm", [["R", "L"], ["A", "P"], ["I", "S"]])
    assert found["facts"]["function"] == NAME
    axes = np.array(found["axes"])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)  # no mirror image
    if up != "none":
        sign = -1 if up[0] == "-" else 1
        np.testing.assert_allclose(sign * axes["xyz".index(up[-1])], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("frame", ["unit", "world"])
@pytest.mark.parametrize("up", UP_NAMES)
def test_a_page_opens_at_the_camera_of_the_file(up: str, frame: str) -> None:
    there, offset = POINT / SCALE + CENTRE, np.array([1.0, 2.0, -3.0])
    asked = (*(there + offset), *there, 25.0)
    options = PlyOptions(scale=SCALE, centre=CENTRE, up=up, frame=frame, camera=asked)
    stream = io.BytesIO()
    write_ply(stream, one(), options)
    stream.seek(0)
    assert layout_of(read_ply(stream)[1]).camera == pytest.approx(asked)
    splats = splats_of(one(), options)
    found = camera(splats)
    np.testing.assert_allclose(found["target"], splats.means[0] * (-1, -1, 1), rtol=1e-5)
    away = np.subtract(found["position"], found["target"])
    assert np.linalg.norm(away) == pytest.approx(np.linalg.norm(offset) * (SCALE if frame == "unit" else 1))
    if up in ("y", "z"):  # what is up is +y of the viewer
        assert away[1] * offset["xyz".index(up)] > 0
    assert found["fov"] == 25
    scene = json.loads(html(splats, "a").decode().partition('id="scene">')[2].partition("</script>")[0])
    assert (scene["camera"], scene["outermost"]) == (found, [])


@pytest.mark.parametrize("text", ["1,2,3,4,5,6", "1,2,3,1,2,3,40", "1,2,3,4,5,6,180", "1,2,3,4,5,x,40"])
def test_a_camera_that_is_none_is_refused(vvgt, text: str, tmp_path: Path) -> None:
    done = vvgt.fails(2, "convert", "example:blob:8", "-o", tmp_path / "a.html", "--camera", text)
    assert "expected eye, target" in done


def test_files_without_an_anatomical_space_use_the_volume_axes(tmp_path: Path) -> None:
    told = PlyOptions(scale=SCALE, centre=CENTRE, space="none", affine=AFFINE, length_unit="um")
    found = world_of(splats_of(one(), upright(told)), tmp_path)
    assert (found["unit"], found["letters"][0], found["anatomical"]) == ("µm", ["−x", "x"], False)
    bare = world_of(splats_of(one(), upright(PlyOptions(comments=False))), tmp_path)
    assert (bare["unit"], bare["length"]) == ("", 1)
    np.testing.assert_allclose(bare["at"], POINT, atol=1e-6)
    other = replace(splats_of(one(), told), comments=("by another program", "vvgt", "vvgt up wide"))
    assert world_of(other, tmp_path)["unit"] == ""


def test_round_lengths_and_values(tmp_path: Path) -> None:
    text = "import { round } from 'page:scale.mjs';\nimport { ticks } from 'page:legend.mjs';\n"
    text += "const lengths = [9.99, 10, 49, 50, 0.0021, 3e7].map(round);\n"
    text += "console.log(JSON.stringify([lengths, ticks(-1000, 3000), ticks(0, 0.29), ticks(5, 5)]));"
    rounded, wide, small, none = node(text, tmp_path)
    np.testing.assert_allclose(rounded, [5, 10, 20, 50, 0.002, 2e7])
    assert wide == [-1000, 0, 1000, 2000, 3000]
    np.testing.assert_allclose(small, [0, 0.05, 0.1, 0.15, 0.2, 0.25])
    assert none == [5]


def test_units_of_lengths_come_from_the_files(tmp_path: Path) -> None:
    nib, tifffile, xarray = (pytest.importorskip(name) for name in ("nibabel", "tifffile", "xarray"))
    values = np.zeros((4, 5, 6), np.float32)
    tifffile.imwrite(
        tmp_path / "a.tif",
        values,
        imagej=True,
        resolution=(2, 2),
        metadata={"unit": "micron", "spacing": 3, "axes": "ZYX"},
    )
    tifffile.imwrite(tmp_path / "plain.tif", values, photometric="minisblack")
    image = nib.Nifti1Image(values, None)
    image.header.set_xyzt_units("micron")
    image.header["qform_code"] = image.header["sform_code"] = 0
    nib.save(image, tmp_path / "a.nii")
    nib.save(nib.Nifti1Image(values, np.diag([1, 2, 3, 1])), tmp_path / "ras.nii")
    along = {name: (name, np.arange(n) * 0.5, {"units": "nm"}) for name, n in zip("zyx", values.shape, strict=True)}
    xarray.DataArray(values, coords=along, dims=("z", "y", "x"), name="v").to_netcdf(tmp_path / "a.nc")

    def unit(name: str, **given: Any) -> str | None:
        return with_place(PlyOptions(), read_volume(str(tmp_path / name), ReadOptions(**given))).length_unit

    assert (unit("a.tif"), unit("plain.tif"), unit("a.tif", spacing=(1.0, 1, 1))) == ("um", None, "um")
    assert (unit("a.nii"), unit("ras.nii"), unit("a.nc")) == ("mm", None, "nm")
    assert with_place(PlyOptions(), Volume(values, unit="um", space="RAS")).length_unit is None


def test_a_legend_is_read_back_and_drawn_by_its_nodes(tmp_path: Path) -> None:
    points = [{"x": 10, "rgb": [1, 0, 0], "opacity": 0}, {"x": 30, "rgb": [1, 0, 0], "opacity": 0.5}]
    points += [{"x": 30, "rgb": [0, 1, 0], "opacity": 1}, {"x": 90, "rgb": [0, 0, 1], "opacity": 1}]
    lo, hi = 1e5 + 0.2, 1e5 + 0.8
    near = [{"x": x, "rgb": [0, 0, 0], "opacity": 0.5} for x in (lo, 1e5 + 0.4, hi)]
    far = json.loads(legend_text(read({"name": "t", "points": near}, "t"), lo, hi, "") or "")["nodes"]
    np.testing.assert_allclose([node[0] for node in far], [lo, 1e5 + 0.4, hi], atol=1e-6)
    text = legend_text(read({"name": "t", "points": points}, "t"), 0.0, 60.0, "HU", "density")
    assert text is not None
    stream = io.BytesIO()
    write_ply(stream, one(), PlyOptions(legend=text))
    stream.seek(0)
    assert read_ply(stream)[1].legend == text
    found = world_of(splats_of(one(), PlyOptions(legend=text)), tmp_path)["facts"]["legend"]
    assert (found["values"], found["unit"], found["quantity"]) == ([0, 60], "HU", "density")
    assert [(n["x"], n["y"]) for n in found["nodes"]] == [(0, 0), (10, 0), (30, 0.5), (30, 1), (60, 1)]
    np.testing.assert_allclose(found["nodes"][-1]["rgb"], (0, 0.5, 0.5), atol=3e-3)
    for damaged in ("{", "[1]", "3"):
        with pytest.raises(ValueError, match=r"."):
            checked(damaged)
    long = json.dumps({"values": [0, 1], "nodes": 3})
    assert world_of(splats_of(one(), PlyOptions(legend=long)), tmp_path)["facts"]["legend"] is None


def test_a_legend_ends_with_the_colours_at_the_ends_of_the_values(tmp_path: Path) -> None:
    """Of nodes beyond the values, which no gradient has a place for, and of a step."""
    rows = [(-50, [0, 0, 0]), (50, [1, 0, 0]), (50, [0, 1, 0]), (150, [0, 0, 1])]
    nodes = [{"x": x, "y": 0.5, "rgb": rgb} for x, rgb in rows]
    text = (
        "const made = { setAttribute(key, x) { this.is[key] = x; }, append(...more) { this.inside.push(...more); } };\n"
        "globalThis.document = { createElementNS: () => ({ ...made, is: {}, inside: [] }) };\n"
        "const { drawLegend } = await import('page:legend.mjs'), group = document.createElementNS();\n"
        f"drawLegend(group, {{ nodes: {json.dumps(nodes)}, live: {{ values: [0, 100] }}, right: 90, bottom: 200 }});\n"
        "console.log(JSON.stringify(group.inside[1].inside.map(({ is }) => [is.offset, is['stop-color']])));"
    )
    assert node(text, tmp_path) == [[0, "#800000"], [0.5, "#ff0000"], [0.5, "#00ff00"], [1, "#008080"]]


def test_the_quality_is_that_of_the_certificate(tmp_path: Path) -> None:
    given = Certificate("v", None, "0", 400, "inria", 41.234, 3, 160000)

    def error(certificate: Certificate) -> Any:
        return world_of(splats_of(one(), PlyOptions(certificate=certificate)), tmp_path)["facts"]["quality"]

    assert error(given) == "41.2 dB PSNR on test views of 400 px (higher is better)"
    assert error(replace(given, live_psnr=33.33)) == (
        "33.3 dB PSNR on test views of 400 px (higher is better), under its own function and light"
    )
    splats = splats_of(one(), PlyOptions(certificate=given))
    broken = tuple(line.replace("41.234", '"41"') for line in splats.comments)
    assert world_of(replace(splats, comments=broken), tmp_path)["facts"]["quality"] == ""


def test_a_legend_of_labels_names_those_that_are_shown() -> None:
    labels = [Label(n, f"part {n}", (1.0, 0.0, 0.5), float(n != 2)) for n in range(1, 40)]
    found = json.loads(legend_text(LabelTable("t", tuple(labels)), 0.0, 0.0, "") or "")
    assert found["of"] == 38
    assert found["labels"][:2] == [["part 1", "ff0080"], ["part 3", "ff0080"]]
    assert len(found["labels"]) == 24


def test_what_leaves_with_a_file_is_listed(vvgt, tmp_path) -> None:
    def listed(name: str) -> dict[str, Any]:
        return json.loads(vvgt.ok("info", tmp_path / name, "--sharing", "--json").out)

    values = np.pad(np.ones((6, 6, 6), np.uint8), 2)
    nibabel.save(nibabel.Nifti1Image(values, np.diag([2, 2, 2, 1])), tmp_path / "Doe_John.nii")
    (tmp_path / "t.json").write_text(json.dumps({"1": {"name": "tumour", "color": [1, 0, 0]}}))
    given = ("--labels", tmp_path / "t.json", "--max-gaussians", 100, "--screen", 40)
    quick = ("--steps", 0)
    kinds = {"a.ply": quick, "live.ply": ("--live",), "n.ply": ("--no-comments", *quick), "a.html": ("--live",)}
    for name, more in kinds.items():
        vvgt.ok("convert", tmp_path / "Doe_John.nii", *given, *more, "-o", tmp_path / name)
        assert "Doe" not in json.dumps(listed(name))
    plain, live, bare, page = map(listed, ("a.ply", "live.ply", "n.ply", "a.html"))
    assert {"title", "function", "names", "command", "checksum", "place", "picture"} <= set(plain)
    assert plain["names"] == ["tumour"]
    assert "values" not in plain
    assert live["names"] == ["tumour"]
    assert {"values", "place"} <= set(live)
    assert "other functions" in live["picture"]
    assert "values" in page
    assert set(bare) == {"kind", "name", "picture", "remove"}
    assert "not Gaussians" in vvgt("info", tmp_path / "Doe_John.nii", "--sharing").error
    assert "--machine describes this machine, --sharing a file" in vvgt("info", "--machine", "--sharing").error
    for more in (("--tf", "viridis"), ("--crop", "0:4,:,:")):
        assert (
            "--sharing describes the file as it is; omit" in vvgt("info", tmp_path / "a.ply", "--sharing", *more).error
        )
    np.save(tmp_path / "v.npy", values)
    camera = ("--camera", "9,0,0,0,0,0,30")
    vvgt.ok("convert", tmp_path / "v.npy", *given, *quick, *camera, "-o", tmp_path / "w.ply")
    assert listed("w.ply")["camera"] == "eye and target in the world"
    assert "camera" not in plain
    assert plain["place"].endswith("in the scanner")
    assert listed("w.ply")["place"] == "position and directions in the world"
    assert plain["remove"].endswith("; positions of --frame world stay")
