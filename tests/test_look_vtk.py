"""Opacity and colour at any values, beside vtkPiecewiseFunction and vtkColorTransferFunction asked one by one."""

import numpy as np
import pytest
from vtkmodules.vtkCommonDataModel import vtkPiecewiseFunction
from vtkmodules.vtkRenderingCore import vtkColorTransferFunction

from tests.refused import refused
from vvgt_cli.errors import DataError
from vvgt_cli.look.function import SPACES, ColorMap, PiecewiseOpacity

VTK_SPACE = {"RGB": 0, "HSV": 1, "Lab": 2, "Diverging": 3, "Lab/CIEDE2000": 4, "Step": 5, "Prolab": 6}
X = np.array([-2.0, 0.5, 0.5, 1.0, 3.0, 3.0])
AT = np.concatenate([np.linspace(-3, 4, 61), X, X - 1e-9, X + 1e-9, [-np.inf, np.inf]])
MIDPOINT, SHARPNESS = np.array([0.2, 0.5, 0.8, 0.0, 0.5, 0.5]), np.array([0.0, 0.6, 0.005, 0.98, 0.995, 0.2])
RGB = np.array([[0, 0, 1], [0.4, 0.9, 0.1], [0.7, 0.7, 0.7], [1, 0, 0], [0.2, 0.1, 0.9], [1, 1, 1]])


def vtk_colors(f: ColorMap) -> vtkColorTransferFunction:
    function = vtkColorTransferFunction()
    function.AllowDuplicateScalarsOn()
    function.SetColorSpace(VTK_SPACE[f.space])
    function.SetHSVWrap(f.hsv_wrap)
    function.SetScale(int(f.log_scale))
    for node, rgb, m, h in zip(f.x, f.rgb, f.midpoint, f.sharpness, strict=True):
        function.AddRGBPoint(node, *rgb, m, h)
    return function


def test_opacity_is_vtks():
    f = PiecewiseOpacity(X, RGB[:, 1], MIDPOINT, SHARPNESS)
    function = vtkPiecewiseFunction()
    function.AllowDuplicateScalarsOn()
    for node in zip(f.x, f.y, f.midpoint, f.sharpness, strict=True):
        function.AddPoint(*node)
    np.testing.assert_array_equal(f(AT), [function.GetValue(x) for x in AT])
    assert f(AT.reshape(3, -1)[:, :5]).shape == (3, 5)
    assert f(np.array([np.nan, 0.5, 9.0])).tolist() == [0.0, 0.7, 1.0]  # of several values the last one's


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("wrap", [False, True])
def test_colours_are_vtks(space, wrap):
    f = ColorMap(X, RGB, MIDPOINT, SHARPNESS, space, hsv_wrap=wrap, nan_color=(0.1, 0.2, 0.3))
    expected, near = [vtk_colors(f).GetColor(x) for x in AT], np.full(len(AT), False)
    if space == "Lab/CIEDE2000":  # between 8-bit colours; a step is spread over a thousandth of its segment
        near = np.abs(AT - 1) < 3e-3
    np.testing.assert_allclose(f(AT)[~near], np.array(expected)[~near], rtol=0, atol=1 / 255 if near.any() else 0)
    assert f(AT.reshape(3, -1)[:, :5]).shape == (3, 5, 3)
    found = f(np.array([np.nan, 0.5]))
    np.testing.assert_allclose(found, [(0.1, 0.2, 0.3), RGB[1]], atol=1 / 32)  # of several colours the first one's
    np.testing.assert_allclose(ColorMap([1], [RGB[1]], space=space)(AT), RGB[[1] * len(AT)], atol=1 / 255)


def test_a_logarithmic_scale_is_vtks_but_at_nodes():
    x = np.array([0.5, 0.5, 3.0, 7.0, 7.0, 100.0])
    f = ColorMap(x, RGB, MIDPOINT, SHARPNESS, "Lab", log_scale=True)
    at = np.geomspace(0.51, 99, 50)
    np.testing.assert_allclose(f(at), [vtk_colors(f).GetColor(v) for v in at], atol=1e-9)
    np.testing.assert_allclose(f(np.array([-1.0, 0.0, 0.5, 7.0, 1e9])), RGB[[0, 0, 0, 3, 5]], atol=1e-3)
    linear = ColorMap(X, RGB, log_scale=True)  # a node is not above 0
    np.testing.assert_array_equal(linear(AT), ColorMap(X, RGB)(AT))


def test_nodes_are_sorted_and_equal_ones_keep_their_order():
    f = PiecewiseOpacity([2, 0, 1, 1], [0.4, 0.1, 0.2, 0.3])
    assert f.x.tolist() == [0, 1, 1, 2]
    assert f.y.tolist() == [0.1, 0.2, 0.3, 0.4]


@pytest.mark.parametrize(
    ("x", "y", "message"),
    [
        ([], [], "no nodes"),
        ([0, 1], [0.5], "2 node positions but 1"),
        ([0, np.nan], [0, 1], "not finite"),
        ([0, 1], [0, 1.5], r"opacity 1\.5"),
        ([0, 1], [0, np.inf], "not finite"),
    ],
)
def test_bad_nodes_are_named(x, y, message):
    refused(DataError, message, PiecewiseOpacity, x, y)


def test_bad_colors_are_named():
    refused(DataError, "colour space 'XYZ'; expected one of RGB", ColorMap, [0], [[0, 0, 0]], space="XYZ")
    refused(DataError, "colour 2", ColorMap, [0], [[0, 2, 0]])
    refused(DataError, "shape", ColorMap, [0, 1], [[0, 0, 0]])
