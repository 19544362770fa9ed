"""Colour maps of ParaView beside VTK, and those of niivue, MRIcroGL and ImageJ, with their opacity."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vtkmodules.vtkRenderingCore import vtkColorTransferFunction

from tests.refused import refused
from vvgt_cli.errors import DataError
from vvgt_cli.look import read_transfer_function, unit_distance
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.volume import Volume

NODES = [0, 0, 0, 1, 0.4, 0.9, 0.1, 0.7, 0.6, 0.3, 0.3, 0.3, 1, 1, 0.2, 0]
AT = np.linspace(-0.1, 1.1, 121)
CLUT = """[FLT]\r\nmin={lo}\r\nmax={hi}\r\n[INT]\r\nnumnodes=3\r\n[BYT]\r\nnodeintensity0=0\r\nnodeintensity1=64
nodeintensity2=255\r\n[RGBA255]\r\nnodergba0=0|0|0|0\r\nnodergba1=255|51|102|102\r\nnodergba2=256|255|255|204\r\n"""
NIIVUE = {"R": [0, 255, 255], "G": [0, 51, 255], "B": [0, 102, 255], "A": [0, 102, 204], "I": [0, 64, 255]}
COLORS = np.random.default_rng(7).integers(0, 256, (256, 3), dtype=np.uint8)


def vtk_colors(number: int, wrap: bool, nodes: list[float], at: np.ndarray = AT, log: bool = False) -> np.ndarray:
    function = vtkColorTransferFunction()
    function.SetColorSpace(number)
    function.SetHSVWrap(wrap)
    function.SetScale(int(log))
    for node in np.reshape(nodes, (-1, 4)):
        function.AddRGBPoint(*node)
    return np.array([function.GetColor(x) for x in at])


def written(path: Path, content: Any, encoding: str = "utf-8") -> str:
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding=encoding)
    return str(path)


@pytest.mark.parametrize(
    ("fields", "number", "wrap"),
    [
        ({"ColorSpace": "HSV"}, 1, False),
        ({"ColorSpace": "HSV", "HSVWrap": 0}, 1, False),
        ({"ColorSpace": "HSV", "HSVWrap": 1}, 1, True),
        ({"ColorSpace": "Wrapped HSV"}, 1, True),
        ({"ColorSpace": "CIELAB"}, 2, False),
        ({"ColorSpace": "cielab"}, 2, False),
        ({"ColorSpace": "Lab/CIEDE2000"}, 4, False),
        ({"ColorSpace": "Diverging", "Creator": "x", "NumberOfTableValues": 256, "DefaultMap": True}, 3, False),
        ({"ColorSpace": "Step", "ShortName": "s", "Groups": ["a"]}, 5, False),
        ({}, 0, False),
    ],
)
def test_presets_are_those_of_vtk(tmp_path: Path, fields: dict[str, Any], number: int, wrap: bool) -> None:
    preset = {"Name": "map", "RGBPoints": NODES, **fields}
    tf = read_transfer_function(written(tmp_path / "p.json", [preset], "utf-8-sig"))
    tolerance = 1 / 255 + 1e-9 if number == 4 else 1e-6
    np.testing.assert_allclose(tf.color(AT), vtk_colors(number, wrap, NODES), atol=tolerance)


def test_the_rainbow_runs_from_blue_over_green_to_red(vvgt, tmp_path: Path) -> None:
    """Without HSVWrap, which ParaView writes where it is not 0; converted too."""
    preset = {"ColorSpace": "HSV", "Name": "Blue to Red Rainbow", "RGBPoints": [0, 0, 0, 1, 1, 1, 0, 0]}
    source, out = written(tmp_path / "p.json", [preset]), tmp_path / "own.json"
    vvgt.ok("tf", "convert", source, out)
    for file in (source, str(out)):
        middle = read_transfer_function(file).color(np.array([0.25, 0.5, 0.75]))
        np.testing.assert_allclose(middle, [[0, 1, 1], [0, 1, 0], [1, 1, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("space", "number", "wrap"),
    [("HSV", 1, False), ("Wrapped HSV", 1, True), ("Wrapped", 1, True), ("Lab", 2, False), ("CIELAB", 2, False)],
)
def test_xml_with_attributes_in_another_case(tmp_path: Path, space: str, number: int, wrap: bool) -> None:
    points = "".join(
        f'<Point X="{x}" O="1" R="{r}" G="{g}" B="{b}"/>' for x, r, g, b in np.reshape(NODES, (-1, 4)).tolist()
    )
    text = f'<ColorMaps><ColorMap Name="m" Space="{space}">{points}<NaN R="1" G="0" B="0.5"/></ColorMap></ColorMaps>'
    tf = read_transfer_function(written(tmp_path / "m.xml", text, "utf-8-sig"))
    np.testing.assert_allclose(tf.color(AT), vtk_colors(number, wrap, NODES), atol=1e-6)
    assert tf.color_map.nan_color == (1, 0, 0.5)
    assert "linear ramp" in tf.name
    solid = text.replace("<Point ", "<Point IGNORED='1' ").replace(f'Space="{space}"', 'IndexedLookup="1"')
    with pytest.raises(DataError, match="indexed colour map"):
        read_transfer_function(written(tmp_path / "n.xml", solid.replace(' X="', ' Y="')))


def test_what_is_stated_and_not_used_is_said(tmp_path: Path) -> None:
    preset = {"Name": "m", "RGBPoints": NODES, "AboveRangeColor": [1, 0, 0]}
    read_transfer_function(written(tmp_path / "p.json", preset))  # not in use: no warning
    with pytest.warns(UserWarning, match="UseAboveRangeColor, UseBelowRangeColor not used"):
        read_transfer_function(
            written(tmp_path / "p.json", preset | {"UseAboveRangeColor": 1, "UseBelowRangeColor": True})
        )
    with pytest.warns(UserWarning, match="IndexedColors not used"):
        read_transfer_function(written(tmp_path / "p.json", preset | {"IndexedColors": [0, 0, 1]}))
    xml = '<ColorMap name="m"><Point x="0" r="0" g="0" b="0"/><Above r="1" g="0" b="0"/></ColorMap>'
    with pytest.warns(UserWarning, match="UseAboveRangeColor not used"):
        read_transfer_function(written(tmp_path / "m.xml", xml))


def test_colours_on_a_logarithmic_scale_and_opacity(tmp_path: Path) -> None:
    nodes = [1, 0, 0, 1, 10, 0, 1, 0, 1000, 1, 0, 0]
    preset = {
        "Name": "m",
        "RGBPoints": nodes,
        "UseLogScale": 1,
        "ColorSpace": "Lab",
        "Points": [1, 0, 0.5, 0, 9, 1, 0.5, 0],
    }
    tf, at = read_transfer_function(written(tmp_path / "p.json", [preset])), np.geomspace(1.1, 990, 30)
    np.testing.assert_allclose(tf.color(at), vtk_colors(2, False, nodes, at, True), atol=1e-6)
    np.testing.assert_allclose(tf.opacity(np.array([1, 5, 9])), [0, 0.5, 1])


# ---- niivue, MRIcroGL, ImageJ


def check_niivue(tf: TransferFunction, lo: float, hi: float) -> None:
    """Straight lines between the nodes in every channel, as makeLut of niivue has them."""
    x = lo + (hi - lo) * np.linspace(0, 1, 256)
    for channel, values in zip("RGB", tf.color(x).T, strict=True):
        np.testing.assert_allclose(values * 255, np.interp(range(256), NIIVUE["I"], NIIVUE[channel]), atol=1e-9)
    np.testing.assert_allclose(tf.opacity(x) * 255, np.interp(range(256), NIIVUE["I"], NIIVUE["A"]), atol=1e-9)


@pytest.mark.parametrize("limits", [(0, 0), (-20, 110), (5, 5)])
def test_niivue_and_mricrogl(tmp_path: Path, limits: tuple[float, float]) -> None:
    lo, hi = limits
    files = (
        written(tmp_path / "a.json", NIIVUE | {"min": lo, "max": hi}),
        written(tmp_path / "b.clut", CLUT.format(lo=lo, hi=hi), "utf-8-sig"),
    )
    for file in files:
        tf = read_transfer_function(file)
        assert tf.domain == ("data" if hi > lo else "fraction")
        check_niivue(tf, *(limits if hi > lo else (0, 1)))
        volume = Volume(np.zeros((4, 5, 6), np.float32), spacing=(1, 2, 6))
        assert unit_distance(None, volume, tf) == (3, "mean-spacing")  # per voxel, as their shaders' sliceSize
        assert unit_distance(2.0, volume, tf) == (2, "given")


def test_what_niivue_takes_where_a_list_is_missing(tmp_path: Path) -> None:
    tf = read_transfer_function({"R": [0, 100, 200], "G": [0, 0, 0], "B": [9, 9, 9]})
    np.testing.assert_allclose(tf.opacity(np.array([0, 0.25, 0.5, 1])) * 255, [0, 32, 64, 64])
    np.testing.assert_allclose(tf.color(np.array([0.25]))[0, 0] * 255, 50)
    short = read_transfer_function({"R": [0, 200], "G": [0, 0], "B": [0, 0], "A": [0, 255], "I": [0, 128]})
    np.testing.assert_allclose(short.opacity(np.array([0.5])), 0.5)  # makeLut stretches the last segment to 255


def test_per_voxel_survives_conversion_and_is_said(vvgt, tmp_path: Path) -> None:
    source = written(tmp_path / "b.clut", CLUT.format(lo=0, hi=9))
    vvgt.ok("tf", "convert", source, tmp_path / "own.json")
    again = read_transfer_function(str(tmp_path / "own.json"))
    assert unit_distance(None, Volume(np.zeros((2, 2, 2)), spacing=(1, 2, 3)), again) == (2, "mean-spacing")
    check_niivue(again, 0, 9)
    done = vvgt("tf", "convert", source, tmp_path / "p.json", "--format", "paraview")
    assert "--opacity-unit-distance mean-spacing" in done.err
    assert b"mean edge of a voxel" in vvgt("info", source).out


def nih(colors: np.ndarray) -> bytes:
    return b"ICOL" + struct.pack(">hhhhqqi", 2, len(colors), 0, 255, 0, 0, 0) + colors.T.tobytes()


@pytest.mark.parametrize("form", ["bytes", "fork", "nih", "text of three", "text of four"])
def test_imagej(vvgt, tmp_path: Path, form: str) -> None:
    path = tmp_path / "fire.LUT"
    plain = COLORS.T.tobytes()
    rows = [" ".join(map(str, row)) for row in COLORS.tolist()]
    path.write_bytes(
        {
            "bytes": plain,
            "fork": plain + bytes(202),
            "nih": nih(COLORS),
            "text of three": ("\r\n".join(row.replace(" ", ",") for row in rows) + "\r\n").encode(),
            "text of four": "\n".join(
                ["Index\tRed\tGreen\tBlue", *(f"{k}\t{row}" for k, row in enumerate(rows))]
            ).encode(),
        }[form]
    )
    tf = read_transfer_function(str(path))
    assert (tf.domain, tf.name) == ("fraction", "fire (opacity not in the file: linear ramp)")
    np.testing.assert_allclose(tf.color(np.arange(256) / 255) * 255, COLORS, atol=1e-9)
    np.testing.assert_allclose(tf.opacity(np.array([0, 0.3, 1])), [0, 0.3, 1])
    assert b"transfer function" in vvgt("info", path).out
    vvgt.ok("tf", "convert", path, "-", "--tf-range", "0,255")


def test_a_short_table_of_nih_image_is_spread_as_imagej_does(tmp_path: Path) -> None:
    (tmp_path / "a.lut").write_bytes(nih(COLORS[:32]))
    tf = read_transfer_function(str(tmp_path / "a.lut"))
    place = np.arange(256) * 32 / 256  # LutLoader.interpolate: i * nColors / 256, the last colour to the end
    expected = [np.interp(place, range(32), COLORS[:32, channel]) for channel in range(3)]
    np.testing.assert_allclose(tf.color(np.arange(256) / 255).T * 255, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.json", {**NIIVUE, "A": [0, 1]}, "of one length"),
        ("a.json", {**NIIVUE, "R": [0, 300, 1]}, "from 0 to 255"),
        ("a.json", {**NIIVUE, "I": [9, 64, 255]}, "ascending from 0"),
        ("a.json", {**NIIVUE, "labels": ["a", "b", "c"]}, "without labels"),
        ("a.clut", CLUT.replace("|51|", "|"), "expected numnodes"),
        ("a.lut", "1 2 3\n4 5 6\n", "expected 256 colours"),
        ("a.lut", "\0" * 767, "numbers"),
    ],
)
def test_faulty_colour_maps(tmp_path: Path, name: str, content: Any, said: str) -> None:
    refused(DataError, said, read_transfer_function, written(tmp_path / name, content))


def test_a_header_that_promises_more_colours_than_there_are(tmp_path: Path) -> None:
    for count, data in ((300, bytes(900)), (256, bytes(700)), (0, b""), (1, b"123")):
        (tmp_path / "a.lut").write_bytes(b"ICOL" + struct.pack(">hh", 2, count) + bytes(24) + data)
        with pytest.raises(DataError, match="not a lookup table of ImageJ's"):
            read_transfer_function(str(tmp_path / "a.lut"))
    with pytest.raises(DataError, match="without #x"):
        read_transfer_function(written(tmp_path / "a.json", NIIVUE) + "#x")
