"""Transfer functions of other programs: ParaView XML, 3D Slicer, Inviwo, vtk.js; and `vvgt tf convert`."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from vtkmodules.vtkCommonDataModel import vtkPiecewiseFunction
from vtkmodules.vtkRenderingCore import vtkColorTransferFunction

from tests.refused import refused
from vvgt_cli.errors import DataError
from vvgt_cli.look import read_transfer_function, unit_distance
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.volume import Volume

OPACITY = [(-3024.0, 0.0, 0.5, 0.0), (-86.9, 0.1, 0.3, 0.4), (45.4, 0.169, 0.5, 0.9), (348.0, 0.6, 0.5, 0.0)]
COLORS = [(-3024.0, 0.0, 0.0, 0.0), (-87.0, 0.0, 0.25, 1.0), (45.0, 1.0, 0.0, 0.0), (348.0, 1.0, 1.0, 0.25)]
AT = np.linspace(-3100, 400, 701)
XML = """<ColorMaps>
  <ColorMap name="fire" space="{space}" indexedLookup="false">
    <Point x="0" o="0" r="0" g="0" b="0"/> <Point x="0.5" o="0.25" r="1" g="0.2" b="0"/>
    <Point x="1" o="1" r="1" g="1" b="0.5"/> <NaN r="0.1" g="0.2" b="0.3"/>
  </ColorMap>
</ColorMaps>"""
ITF = """<?xml version="1.0" encoding="UTF-8" ?>
<InviwoWorkspace version="3">
    <maskMin content="{lo}" /> <maskMax content="{hi}" /> <type content="{type}" />
    <Points>
        <Point> <pos content="0.25" /> <rgba x="1" y="0" z="0" w="0" /> </Point>
        <Point> <pos content="0.75" /> <rgba x="0" y="1" z="0" w="0.5" /> </Point>
    </Points>
</InviwoWorkspace>
"""


def numbers(rows) -> str:
    flat = [value for row in rows for value in row]
    return " ".join(map(str, [len(flat), *flat]))


def vp(gradient: str = "4 0 1 255 1") -> str:
    """A .vp file: no midpoints or sharpness."""
    return "\n".join(["1", "1", "0.9", "0.1", "0.2", "10", numbers(o[:2] for o in OPACITY), gradient, numbers(COLORS)])


def vp_json(**changes) -> dict:
    """As Slicer writes it: midpoint and sharpness in each point, four components of which one is in use."""
    component = {
        "componentWeight": 1.0,
        "scalarOpacityUnitDistance": 0.75,
        "rgbTransferFunction": {
            "type": "colorTransferFunction",
            "points": [{"x": x, "color": rgb, "midpoint": 0.5, "sharpness": 0.3} for x, *rgb in COLORS],
        },
        "scalarOpacity": {
            "type": "piecewiseLinearFunction",
            "points": [dict(zip(("x", "y", "midpoint", "sharpness"), point, strict=True)) for point in OPACITY],
        },
        "gradientOpacity": {"points": [{"x": 0, "y": 1.0}, {"x": 255, "y": 1.0}]},
    }
    return {
        "@schema": "volume-property-schema-v1.0.0.json#",
        "volumeProperties": [{"components": [component | changes, {}]}],
    }


@pytest.fixture
def file(tmp_path: Path):
    def write(content, name: str) -> str:
        path = tmp_path / name
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return str(path)

    return write


def check_vtk(tf, opacity, colors, space: int = 0, sharpness: float = 0.0, at=AT) -> None:
    """The function is what VTK computes of the same nodes."""
    function, color = vtkPiecewiseFunction(), vtkColorTransferFunction()
    color.SetColorSpace(space)
    for node in opacity:
        function.AddPoint(*node)
    for x, *rgb in colors:
        color.AddRGBPoint(x, *rgb, 0.5, sharpness)
    np.testing.assert_allclose(tf.opacity(at), [function.GetValue(x) for x in at], atol=1e-12)
    np.testing.assert_allclose(tf.color(at), [color.GetColor(x) for x in at], atol=1e-6)


def test_slicer_vp(file) -> None:
    tf = read_transfer_function(file(vp(), "bone.vp"))
    assert (tf.domain, tf.opacity_unit_distance, tf.name) == ("data", 1, "volume property")
    check_vtk(tf, [node[:2] for node in OPACITY], COLORS)
    assert tf.opacity_unit_label == "VTK's default"
    with pytest.warns(UserWarning, match=r"bone.vp: gradient opacity not used"):
        shaded = read_transfer_function(file(vp("4 0 0 255 1"), "bone.vp"))
    assert shaded.lighting == Lighting(ambient=0.1, diffuse=0.9, specular=0.2, specular_power=10)


def test_slicer_vp_json(file) -> None:
    tf = read_transfer_function(file(vp_json(), "bone.vp.json"))
    assert (tf.domain, tf.opacity_unit_distance) == ("data", 0.75)
    check_vtk(tf, OPACITY, COLORS, sharpness=0.3)
    assert tf.color_map.nan_color == vtkColorTransferFunction().GetNanColor()
    slopes = {"points": [{"x": 0, "y": 0.0}, {"x": 255, "y": 1.0}]}
    assert tf.opacity_unit_label == "file"
    with pytest.warns(UserWarning, match=r"a.json: gradient opacity not used"):
        read_transfer_function(file(vp_json(gradientOpacity=slopes), "a.json"))
    lit = read_transfer_function(file(vp_json(shade=True, lighting={"ambient": 0.3}), "b.json"))
    assert lit.lighting == Lighting(ambient=0.3)
    with pytest.raises(DataError, match=r"b.json: shading with diffuse -1: expected 0 to 1000"):
        read_transfer_function(file(vp_json(shade=True, lighting={"diffuse": -1}), "b.json"))
    assert tf.lighting is None
    off = vp_json(gradientOpacity=slopes, disableGradientOpacity=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_transfer_function(file(off, "a.json"))


def test_slicer_presets_of_viewers_on_vtkjs(file) -> None:
    preset = {"name": "CT-Bone", "scalarOpacity": vp().splitlines()[6], "colorTransfer": numbers(COLORS), "shade": "1"}
    tf = read_transfer_function(file([preset, preset | {"name": "other"}], "presets.json") + "#CT-Bone")
    assert (tf.name, tf.opacity_unit_distance) == ("CT-Bone", 1)
    check_vtk(tf, [node[:2] for node in OPACITY], COLORS)


def mrml(**changes: str) -> str:
    """Two presets as the volume rendering module of Slicer keeps them."""
    fields = {
        "interpolation": "1", "shade": "1", "diffuse": "0.66", "ambient": "0.1", "specular": "0.62",
        "specularPower": "14", "scalarOpacity": numbers(o[:2] for o in OPACITY), "gradientOpacity": "4 0 1 255 1",
        "colorTransfer": numbers(COLORS), "effectiveRange": "-3024 348", "selected": "false",
    } | changes  # fmt: skip
    text = " ".join(f'{key}="{value}"' for key, value in fields.items())
    flat = text.replace('shade="1"', 'shade="0"').replace("0.6 ", "0.5 ")
    return (
        '<MRML version="Slicer4.4.0" userTags="">\n'
        f'<VolumeProperty id="vtkMRMLVolumePropertyNode1" name="CT-AAA" {text}></VolumeProperty>\n'
        f'<VolumeProperty id="vtkMRMLVolumePropertyNode2" name="MR-Default" {flat}></VolumeProperty>\n</MRML>\n'
    )


def test_slicer_presets_xml(vvgt, file, tmp_path: Path) -> None:
    source = file(mrml(), "presets.xml")
    with pytest.raises(DataError, match="2 presets, 'CT-AAA', 'MR-Default'; pick one as FILE#NAME"):
        read_transfer_function(source)
    with pytest.raises(DataError, match="no preset 'CT'; it has 'CT-AAA', 'MR-Default'"):
        read_transfer_function(source + "#CT")
    tf = read_transfer_function(source + "#CT-AAA")
    assert tf.lighting == Lighting(True, (), 0.1, 0.66, 0.62, 14)
    assert (tf.name, tf.domain, tf.opacity_unit_distance, tf.opacity_unit_label) == (
        "CT-AAA",
        "data",
        1,
        "VTK's default",
    )
    check_vtk(tf, [node[:2] for node in OPACITY], COLORS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        flat = read_transfer_function(source + "#MR-Default")
        assert (flat.name, flat.lighting) == ("MR-Default", None)
        told = file(mrml(scalarOpacityUnitDistance="0.5"), "own.xml")
        own = read_transfer_function(told + "#MR-Default")
        assert (own.opacity_unit_distance, own.opacity_unit_label) == (0.5, "file")
    info = vvgt.ok("info", source + "#MR-Default")
    assert b"1 (VTK's default)" in info.out
    assert b"0.1 0.66 0.62 14" in vvgt("info", source + "#CT-AAA").out
    steep = file(mrml(gradientOpacity="4 0 0 255 1"), "steep.xml")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert vvgt("info", steep + "#CT-AAA").code == 1
        vvgt.ok("info", steep + "#CT-AAA", "-q")
    assert "2 presets, 'CT-AAA', 'MR-Default'" in vvgt("info", source).error
    out = tmp_path / "mr.json"
    vvgt.ok("tf", "convert", source + "#MR-Default", out)
    np.testing.assert_allclose(read_transfer_function(str(out)).opacity(AT), tf.opacity(AT), atol=0.2)
    vvgt.ok("tf", "convert", source + "#CT-AAA", tmp_path / "ct.json")
    assert read_transfer_function(str(tmp_path / "ct.json")).lighting == tf.lighting
    assert (
        "stores no shading"
        in vvgt("tf", "convert", source + "#CT-AAA", tmp_path / "p.json", "--format", "paraview").err
    )
    vvgt.ok("tf", "show", source + "#MR-Default", "-o", tmp_path / "mr.png")


def test_vtkjs_preset(file) -> None:
    flat = [value for row in COLORS for value in row]
    points = [value for x, y, *_ in OPACITY for value in (x, y)]
    preset = {"Name": "CT-AAA", "ColorSpace": "RGB", "RGBPoints": flat, "OpacityPoints": points}
    tf = read_transfer_function(file([preset], "maps.json"))
    assert (tf.name, tf.opacity_unit_distance) == ("CT-AAA", None)
    check_vtk(tf, [node[:2] for node in OPACITY], COLORS)
    with pytest.raises(DataError, match="OpacityPoints: a list of 3"):
        read_transfer_function(file([preset | {"OpacityPoints": [1, 2, 3]}], "maps.json"))


@pytest.mark.parametrize(("space", "number"), [("RGB", 0), ("Lab", 2), ("CIELAB", 2), ("Diverging", 3)])
def test_paraview_xml(file, space: str, number: int) -> None:
    tf = read_transfer_function(file(XML.format(space=space), "fire.xml"))
    assert (tf.name, tf.color_map.nan_color) == ("fire", (0.1, 0.2, 0.3))
    colors = [(0, 0, 0, 0), (0.5, 1, 0.2, 0), (1, 1, 1, 0.5)]
    check_vtk(tf, [(0, 0), (0.5, 0.25), (1, 1)], colors, number, at=np.linspace(-0.1, 1.1, 49))


def test_paraview_xml_of_several_maps_and_without_opacity(file) -> None:
    solid = XML.format(space="HSV").replace('o="0"', 'o="1"').replace('o="0.25"', "").replace("fire", "solid")
    both = solid.replace("</ColorMaps>", XML.format(space="RGB").replace("<ColorMaps>", ""))
    with pytest.raises(DataError, match="2 presets, 'solid', 'fire'; pick one as FILE#NAME"):
        read_transfer_function(file(both, "maps.xml"))
    tf = read_transfer_function(file(both, "maps.xml") + "#solid")
    assert "linear ramp" in tf.name
    assert not tf.color_map.hsv_wrap
    np.testing.assert_allclose(tf.opacity(np.array([0, 0.3, 1])), [0, 0.3, 1])


def test_inviwo(file) -> None:
    tf = read_transfer_function(file(ITF.format(lo=0, hi=1, type=0), "a.itf"))
    assert tf.domain == "fraction"
    np.testing.assert_allclose(tf.opacity(np.array([0, 0.25, 0.5, 0.75, 1])), [0, 0, 0.25, 0.5, 0.5])
    np.testing.assert_allclose(tf.color(np.array([0.5])), [[0.5, 0.5, 0]])
    volume = Volume(np.zeros((10, 20, 40), np.float32), spacing=(2, 1, 1))
    assert unit_distance(None, volume, tf) == (80 / 150, "file")
    assert unit_distance("mean-spacing", volume, tf)[0] == pytest.approx(4 / 3)


def test_inviwo_mask_and_data_values(file) -> None:
    tf = read_transfer_function(file(ITF.format(lo=0.5, hi=0.9, type=0), "a.itf"))
    np.testing.assert_allclose(
        tf.opacity(np.array([0.4, 0.499, 0.501, 0.75, 0.899, 0.901, 1])), [0, 0, 0.251, 0.5, 0.5, 0, 0]
    )
    tf = read_transfer_function(file(ITF.format(lo=0.5, hi=1, type=0), "a.itf"))
    assert tf.opacity(np.array([1.0])) == 0.5
    tf = read_transfer_function(file(ITF.format(lo=0, hi=1, type=1), "a.itf"))
    assert tf.domain == "data"
    assert tf.opacity(np.array([5.0])) == 0.5
    old = """<InviwoTreeData version="1.0"><maskMin content="0" /><maskMax content="1" /><dataPoints>
    <point><pos x="0" y="0.5" /><rgba x="1" y="0" z="0" w="0.5" /></point></dataPoints></InviwoTreeData>"""
    assert read_transfer_function(file(old, "b.itf")).opacity(np.array([0.3])) == 0.5


@pytest.mark.parametrize(
    ("content", "name", "message"),
    [
        ("1\n1\n0.9\n", "a.vp", r"3 lines of numbers; expected the nine"),
        (vp().replace("-86.9", "x"), "a.vp", "scalar opacity: .*expected finite numbers"),
        (vp().replace("0.6", "1.6"), "a.vp", r"opacity 1\.6; expected a number in"),
        ({"volumeProperties": []}, "a.vp.json", "expected a list of objects with components"),
        (vp_json(scalarOpacity=3), "a.vp.json", "scalarOpacity; expected an object with points"),
        (vp_json(scalarOpacityUnitDistance=0), "a.vp.json", "unit distance 0"),
        (XML.format(space="RGB").replace('"false"', '"true"'), "a.xml", "indexed colour map"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "a.xml", "declares entities"),
        ("<svg/>", "a.xml", "not a transfer function"),
        (ITF.format(lo=0.9, hi=0.1, type=0), "a.itf", "mask from 0.9 to 0.1"),
    ],
)  # fmt: skip
def test_faulty_files_are_one_clear_line(file, content, name: str, message: str) -> None:
    path = file(content, name)
    assert path in refused(DataError, message, read_transfer_function, path)


@pytest.mark.parametrize("form", ["minimal", "paraview"])
def test_convert_round_trip(vvgt, file, tmp_path: Path, form: str) -> None:
    out = str(tmp_path / "out.json")
    for content, name in ((vp(), "a.vp"), (XML.format(space="Diverging"), "b.xml")):
        source = file(content, name)
        done = vvgt.ok("tf", "convert", source, out, "--format", form, "--overwrite")
        before, after = read_transfer_function(source), read_transfer_function(out)
        at = np.linspace(*before.node_range(), 301)
        np.testing.assert_allclose(after.opacity(at), before.opacity(at), atol=1e-15)
        np.testing.assert_allclose(after.color(at), before.color(at), atol=1e-15)
        kept = form == "minimal"
        assert after.opacity_unit_distance == (before.opacity_unit_distance if kept else None)
        assert ("stores no unit distance: set it to 1 there" in done.err) == (not kept and name == "a.vp")
    assert vvgt("tf", "convert", file(vp(), "a.vp"), "-").out.startswith(b'{\n "name": "volume property"')


def test_convert_keeps_midpoints_in_a_preset(vvgt, file, tmp_path: Path) -> None:
    points = vp_json()["volumeProperties"][0]["components"][0]["rgbTransferFunction"]["points"]
    straight = {"points": [{"x": p["x"], "color": p["color"]} for p in points]}
    source, out = file(vp_json(rgbTransferFunction=straight), "a.json"), str(tmp_path / "out.json")
    vvgt.ok("tf", "convert", source, out, "--format", "paraview")
    check_vtk(read_transfer_function(out), OPACITY, COLORS)
    assert "try --format paraview" in vvgt("tf", "convert", source, str(tmp_path / "no.json")).error


def test_convert_of_fractions_and_percentiles(vvgt, file, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    assert "--tf-range LO,HI" in vvgt("tf", "convert", "viridis:0.2,0.8", out).error
    vvgt.ok("tf", "convert", "viridis:0.2,0.8", out, "--tf-range", "100,200")
    tf = read_transfer_function(str(out))
    assert tf.node_range() == (100, 200)
    np.testing.assert_allclose(tf.opacity(np.array([120, 150, 180])), [0, 0.5, 1], atol=1e-12)
    points = [{"x": 0.5, "rgb": [1, 0, 0], "opacity": 0}, {"x": 1, "rgb": [1, 0, 0], "opacity": 0.5}]
    source = file({"range": "percentile", "points": points}, "p.json")
    vvgt.ok("tf", "convert", source, out, "--overwrite")
    assert read_transfer_function(str(out)).domain == "percentile"


def test_convert_refusals(vvgt, file, tmp_path: Path) -> None:
    bent = file(vp_json(), "bent.json")
    itf = file(ITF.format(lo=0, hi=1, type=1), "a.itf")
    points = [{"x": 0.5, "rgb": [1, 0, 0], "opacity": 0}]
    share = file({"range": "percentile", "points": points}, "p.json")
    out = tmp_path / "out.json"
    for args, message in (
        ((bent, out, "--format", "paraview"), "midpoints or sharpness of colours; a ParaView preset cannot store that"),
        ((bent, out), "midpoints, sharpness or a logarithmic scale; the minimal format cannot store that"),
        ((itf, out, "--format", "paraview"), "a share of the volume's edge"),
        ((share, out, "--format", "paraview"), "percentiles; a ParaView preset cannot store that"),
        ((share, out, "--tf-range", "0,1"), "omit --tf-range"),
        ((itf, out, "--tf-range", "rescale"), "needs the data"),
        ((bent, tmp_path / "out.vp"), r"expected a name ending in .json"),
        ((bent, bent, "--overwrite"), "is an input of this run"),
        ((bent, bent), "exists"),
    ):
        done = vvgt("tf", "convert", *args)
        assert done.code in (1, 2)
        assert message in done.error
        assert not out.exists()


def test_info_tells_functions_from_volumes(vvgt, file) -> None:
    for content, name in (
        (vp(), "a.vp"),
        (XML.format(space="RGB"), "b.xml"),
        (ITF.format(lo=0, hi=1, type=0), "c.itf"),
    ):
        assert b"transfer function" in vvgt("info", file(content, name)).out
    for content, name in (
        ('{"a": 1.5}', "a.json"),
        ("<a/>", "a.xml"),
        ("{ text }", "a"),
        ("[1]", "b"),
        ("[", "b.json"),
    ):
        assert "of no known format; expected NIfTI" in vvgt.fails(1, "info", file(content, name))
    for content, name in (('{"points": 3}', "a.json"), ('{"RGBPoints": [1,', "b.json"), ("<ColorMap", "a.xml")):
        assert "of no known format" not in vvgt.fails(1, "info", file(content, name))


def test_presets_that_do_not_exist(file) -> None:
    for content, name in ((vp(), "a.vp"), (vp_json(), "b.json"), (ITF.format(lo=0, hi=1, type=0), "c.itf")):
        with pytest.raises(DataError, match="no presets; omit #x"):
            read_transfer_function(file(content, name) + "#x")
