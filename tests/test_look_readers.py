"""Transfer-function files and names: what they become, and one clear line for what they are not."""

import json

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.look import read_transfer_function

PRESET = {
    "Name": "shells",
    "ColorSpace": "HSV",
    "HSVWrap": 0,
    "NanColor": [0.1, 0.2, 0.3],
    "RGBPoints": [0, 0, 0, 1, 50, 0, 1, 0, 100, 1, 0, 0],
    "Points": [0, 0, 0.5, 0, 40, 0.2, 0.25, 0.5, 100, 1, 0.5, 0],
}
MINIMAL = {
    "name": "bone",
    "points": [{"x": 10, "rgb": [1, 0, 0], "opacity": 0}, {"x": 20, "rgb": [0, 0, 1], "opacity": 0.5}],
    "opacity_unit_distance": 2.5,
}


@pytest.fixture
def file(tmp_path):
    def write(content, name="tf.json"):
        path = tmp_path / name
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return str(path)

    return write


def changed(base, **fields):
    """A copy with fields replaced; None removes one."""
    return {k: v for k, v in {**base, **fields}.items() if v is not None}


@pytest.mark.parametrize("wrap", [list, lambda p: p[0]])
def test_paraview_preset(file, wrap):
    tf = read_transfer_function(file(wrap([PRESET])))
    assert tf.name == "shells"
    assert tf.color_map.space == "HSV"
    assert not tf.color_map.hsv_wrap
    assert tf.color_map.nan_color == (0.1, 0.2, 0.3)
    assert tf.opacity_nodes.midpoint.tolist() == [0.5, 0.25, 0.5]
    assert tf.opacity_nodes.sharpness.tolist() == [0, 0.5, 0]
    assert tf.breakpoints().tolist() == [0, 40, 50, 100]
    assert tf.node_range() == (0, 100)
    assert tf.opacity_unit_distance is None
    np.testing.assert_allclose(tf.opacity(np.array([-1, 0, 20, 100, 200, np.nan])), [0, 0, 0.1, 1, 1, 0])
    np.testing.assert_allclose(tf.color(np.array([-1, 200, np.nan])), [[0, 0, 1], [1, 0, 0], [0.1, 0.2, 0.3]])


def test_paraview_preset_without_opacity_gets_a_ramp_and_says_so(file):
    tf = read_transfer_function(file([changed(PRESET, Points=None)]))
    assert "linear ramp" in tf.name
    np.testing.assert_allclose(tf.opacity(np.array([-5, 0, 25, 100, 101])), [0, 0, 0.25, 1, 1])


def test_paraview_preset_of_several_is_picked_by_name(file):
    path = file([PRESET, changed(PRESET, Name="other", RGBPoints=[0, 1, 1, 1])])
    with pytest.raises(DataError, match=r"2 presets, 'shells', 'other'; pick one as FILE#NAME"):
        read_transfer_function(path)
    assert read_transfer_function(path + "#other").name == "other"
    with pytest.raises(DataError, match="no preset 'third'; it has 'shells'"):
        read_transfer_function(path + "#third")


def test_a_name_with_a_hash_is_read_as_a_path_first(file):
    assert read_transfer_function(file([PRESET], "a#b.json")).name == "shells"


@pytest.mark.parametrize("space", ["RGB", "Lab", "Diverging", "Lab/CIEDE2000", "Step", "hsv"])
def test_paraview_color_spaces(file, space):
    tf = read_transfer_function(file([changed(PRESET, ColorSpace=space)]))
    assert tf.color_map.space.lower() == space.lower()
    assert np.isfinite(tf.color(np.linspace(-10, 110, 50))).all()


def test_log_scale_is_kept(file):
    points = [1, 0, 0, 0, 100, 1, 1, 1]
    tf = read_transfer_function(file([changed(PRESET, ColorSpace="RGB", RGBPoints=points, UseLogScale=1)]))
    np.testing.assert_allclose(tf.color(np.array([10.0])), [[0.5, 0.5, 0.5]])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"RGBPoints": None}, "categorical preset"),
        ({"RGBPoints": [0, 1, 1]}, r"RGBPoints: a list of 3; expected a flat list of x, r, g, b"),
        ({"RGBPoints": [0, 1, 2, 0]}, "colour 2; expected a number in"),
        ({"RGBPoints": [0, 1, "1", 0]}, r"RGBPoints\[2\]: '1'; expected a number"),
        ({"Points": [0, float("nan"), 0.5, 0]}, r"Points\[1\]: nan; expected a finite"),
        ({"Points": [0, 1.5, 0.5, 0]}, r"opacity 1\.5"),
        ({"Points": [10**400, 1, 0.5, 0]}, "finite"),
        ({"ColorSpace": "XYZ"}, "ColorSpace 'XYZ'; expected one of RGB"),
        ({"NanColor": [1, 2, 3]}, "NanColor"),
    ],
)
def test_faulty_presets_are_one_clear_line(file, fields, message):
    path = file([changed(PRESET, **fields)])
    assert path in refused(DataError, message, read_transfer_function, path)


def test_minimal_json_on_data_values(file):
    tf = read_transfer_function(file(MINIMAL))
    assert (tf.name, tf.opacity_unit_distance, tf.domain) == ("bone", 2.5, "data")
    np.testing.assert_allclose(tf.opacity(np.array([0, 15, 30])), [0, 0.25, 0.5])
    np.testing.assert_allclose(tf.color(np.array([15.0])), [[0.5, 0, 0.5]])


def test_minimal_json_on_a_range(file):
    points = [{"x": 0, "opacity": 0}, {"x": 0.25, "rgb": [1, 1, 1]}, {"x": 1, "opacity": 1}]
    tf = read_transfer_function(file({"range": [-100, 300], "points": points}))
    assert tf.breakpoints().tolist() == [-100, 0, 300]
    assert tf.domain == "data"


def test_minimal_json_on_percentiles(file):
    points = [{"x": 0.5, "opacity": 0, "rgb": [0, 0, 0]}, {"x": 1, "opacity": 1}]
    assert read_transfer_function(file({"range": "percentile", "points": points})).domain == "percentile"


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"points": []}, "expected a list of objects"),
        ({"points": [{"x": 1}]}, r"points\[0\]: has x; expected x with rgb or opacity"),
        ({"points": [{"x": 1, "opacity": 1}]}, "no point has rgb"),
        ({"points": [{"x": 1, "rgb": [1, 1, 1]}]}, "no point has opacity"),
        ({"points": [{"x": 1, "rgb": [1, 1, 1], "alpha": 1}]}, "unknown key 'alpha'"),
        ({"range": [1, 1]}, "expected lo below hi"),
        ({"range": [0, 1]}, "with a range expected x in"),
        ({"range": "percentile"}, "expected x in"),
        ({"opacity_unit_distance": 0}, "unit distance 0"),
        ({"hsv_wrap": "false"}, "hsv_wrap 'false'; expected true or false"),
        ({"rnage": [0, 1]}, "unknown key 'rnage'; expected color_space"),
        ({"lighting": {"shine": 1}}, "lighting; expected an object of"),
        ({"otherwise": {"points": []}}, "otherwise: points; expected a list of objects"),
    ],
)
def test_faulty_minimal_files_are_one_clear_line_that_names_the_file_once(file, fields, message):
    path = file(changed(MINIMAL, **fields))
    assert refused(DataError, message, read_transfer_function, path).count(path) == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not JSON"),
        ("{'a': 1}", "not JSON .line 1, column 2"),
        ("[]", "not a transfer function"),
        ("[" * 100_000, "not JSON|too deep"),
        ("1" * 10_000, "too long"),
    ],
)
def test_other_files_are_data_errors(file, content, message):
    refused(DataError, message, read_transfer_function, file(content))


def test_binary_and_huge_files_are_data_errors(tmp_path):
    (tmp_path / "a.json").write_bytes(b"\xff\xd8\xff\xe0")
    refused(DataError, "not text", read_transfer_function, str(tmp_path / "a.json"))
    with (tmp_path / "b.json").open("wb") as huge:
        huge.truncate(2**24 + 1)
    refused(DataError, "at most 16 MiB", read_transfer_function, str(tmp_path / "b.json"))
    refused(UsageError, "is a folder", read_transfer_function, str(tmp_path))
    refused(UsageError, "no such file", read_transfer_function, str(tmp_path / "none.json"))


def test_byte_order_mark_is_accepted(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(MINIMAL), encoding="utf-8-sig")
    assert read_transfer_function(str(tmp_path / "a.json")).name == "bone"


def test_colormap_names():
    from matplotlib import colormaps

    tf = read_transfer_function("viridis:0.2,0.8:0.5")
    assert tf.domain == "fraction"
    np.testing.assert_allclose(tf.opacity(np.array([0, 0.2, 0.5, 0.8, 1])), [0, 0, 0.25, 0.5, 0.5])
    at = np.linspace(0, 1, 256)
    np.testing.assert_allclose(tf.color(at), colormaps["viridis"](at)[:, :3], atol=1e-12)
    np.testing.assert_allclose(read_transfer_function("magma").opacity(at), at)
    step = read_transfer_function("bone:0.3,0.3")
    np.testing.assert_allclose(step.opacity(np.array([0.2999, 0.3, 0.31])), [0, 1, 1])
    assert read_transfer_function("tab10").color_map.x.size == 10


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("virids", "neither a file, a name of 'vvgt tf list' nor a matplotlib colour map; did you mean viridis"),
        ("", "an empty name"),
        ("viridis:a,b", "expected NAME"),
        ("viridis:0.8,0.2", r"ramp 0\.8 to 0\.2"),
        ("preset.json#x", "no such file"),
    ],
)
def test_bad_names_are_usage_errors(source, message):
    refused(UsageError, message, read_transfer_function, source)
