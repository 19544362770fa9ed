"""Opacity and colour against vtkPiecewiseFunction and vtkColorTransferFunction themselves."""

import numpy as np
import pytest

from vvgt_cli.errors import DataError
from vvgt_cli.look.ciede2000 import delta_e
from vvgt_cli.look.colormap import SPACES, ColorMap
from vvgt_cli.look.opacity import PiecewiseOpacity

VTK_SPACE = {"RGB": 0, "HSV": 1, "Lab": 2, "Diverging": 3, "Lab/CIEDE2000": 4, "Step": 5, "Prolab": 6}
SHARPNESS = np.array([0.0, 0.005, 0.01, 0.2, 0.6, 0.98, 0.995, 1.0])
MIDPOINT = np.array([0.0, 1e-6, 0.2, 0.5, 0.5, 0.8, 1.0])


def vtk_opacity(f: PiecewiseOpacity, x):
    from vtkmodules.vtkCommonDataModel import vtkPiecewiseFunction

    function = vtkPiecewiseFunction()
    function.AllowDuplicateScalarsOn()
    function.SetUseLogScale(f.log_scale)
    for node in zip(f.x, f.y, f.midpoint, f.sharpness, strict=True):
        function.AddPoint(*node)
    return np.array([function.GetValue(v) for v in x])


def vtk_color_function(f: ColorMap):
    from vtkmodules.vtkRenderingCore import vtkColorTransferFunction

    function = vtkColorTransferFunction()
    function.AllowDuplicateScalarsOn()
    function.SetColorSpace(VTK_SPACE[f.space])
    function.SetHSVWrap(f.hsv_wrap)
    function.SetScale(int(f.log_scale))
    function.SetNanColor(*f.nan_color)
    for node, rgb, m, h in zip(f.x, f.rgb, f.midpoint, f.sharpness, strict=True):
        function.AddRGBPoint(node, *rgb, m, h)
    return function


def vtk_color(f: ColorMap, x):
    function = vtk_color_function(f)
    return np.array([function.GetColor(v) for v in x])


def vtk_color_table(f: ColorMap, lo, hi, count):
    """One call for all samples: VTK searches a CIEDE2000 path anew for every call."""
    table = [0.0] * (3 * count)
    vtk_color_function(f).GetTable(lo, hi, count, table)
    return lo + np.arange(count) / (count - 1) * (hi - lo), np.reshape(table, (count, 3))


def random_nodes(rng, count, positive=False):
    """Node positions with duplicates, midpoints and sharpness that include every special case."""
    x = np.sort(np.round(rng.uniform(0.5 if positive else -3, 5, count), 1))
    return x, rng.choice(MIDPOINT, count), rng.choice(SHARPNESS, count)


def samples(rng, x, count):
    inside = rng.uniform(x[0] - 0.5, x[-1] + 0.5, count)
    return np.concatenate([inside, x, x - 1e-9, x + 1e-9, [x[0] - 10, x[-1] + 10, -np.inf, np.inf]])


def random_rgb(rng, count):
    rgb = rng.random((count, 3))
    extremes = rng.random(count)
    rgb[extremes < 0.2] = np.round(rgb[extremes < 0.2])  # corners of the cube: black, white, pure hues
    rgb[extremes > 0.85] = rgb[extremes > 0.85, :1]  # greys
    return rgb


@pytest.mark.parametrize("log_scale", [False, True])
def test_opacity_is_vtk_piecewise_function(log_scale):
    rng = np.random.default_rng(7)
    for trial in range(60):
        count = 1 + trial % 9
        x, midpoint, sharpness = random_nodes(rng, count, positive=log_scale)
        f = PiecewiseOpacity(x, rng.random(count), midpoint, sharpness, log_scale)
        at = samples(rng, x, 150)
        np.testing.assert_allclose(f(at), vtk_opacity(f, at), rtol=0, atol=1e-9)


@pytest.mark.parametrize("space", [s for s in SPACES if s != "Lab/CIEDE2000"])
@pytest.mark.parametrize("log_scale", [False, True])
def test_color_is_vtk_color_transfer_function(space, log_scale):
    rng = np.random.default_rng(11)
    for trial in range(30):
        count = 1 + trial % 7
        x, midpoint, sharpness = random_nodes(rng, count, positive=log_scale)
        f = ColorMap(
            x, random_rgb(rng, count), midpoint, sharpness, space, hsv_wrap=bool(trial % 2), log_scale=log_scale
        )
        at = samples(rng, x, 100)
        if log_scale:  # VTK rounds x through 10**log10(x), which may cross a node; below 0 it gives NaN
            at = at[(at > 0) & np.isfinite(at) & (np.abs(at[:, None] - x).min(axis=1) > 1e-7)]
        np.testing.assert_allclose(f(at), vtk_color(f, at), rtol=0, atol=1e-7)


def test_ciede2000_is_vtk_within_rounding():
    rng = np.random.default_rng(5)
    exact = total = 0
    for trial in range(8):
        count = 2 + trial % 4
        x, midpoint, sharpness = random_nodes(rng, count)
        f = ColorMap(x, random_rgb(rng, count), midpoint, sharpness, "Lab/CIEDE2000")
        at, expected = vtk_color_table(f, x[0] - 0.5, x[-1] + 0.5, 1000)
        error = np.abs(f(at) - expected)
        assert error.max() <= 1 / 255 + 1e-9  # 8-bit values: a tie may round either way
        exact, total = exact + np.count_nonzero(error < 1e-9), total + error.size
    assert exact / total > 0.999


def test_delta_e_of_published_pairs():
    # Sharma, Wu, Dalal (2005), table 1, pairs 1, 7, 13, 17, 25, 33
    lab1 = np.array(
        [
            [50, 2.6772, -79.7751],
            [50, 0, 0],
            [50, -0.001, 2.49],
            [50, 2.5, 0],
            [60.2574, -34.0099, 36.2677],
            [6.7747, -0.2908, -2.4247],
        ]
    )
    lab2 = np.array(
        [
            [50, 0, -82.7485],
            [50, -1, 2],
            [50, 0.0011, -2.49],
            [73, 25, -18],
            [60.4626, -34.1751, 39.4387],
            [5.8714, -0.0985, -2.2286],
        ]
    )
    expected = [2.0425, 2.3669, 4.7461, 27.1492, 1.2644, 0.6377]
    np.testing.assert_allclose(delta_e(lab1, lab2), expected, atol=5e-5)


def test_color_of_nan_is_the_nan_color():
    f = ColorMap([0, 1], [[0, 0, 0], [1, 1, 1]], nan_color=(0.1, 0.2, 0.3))
    at = np.array([-1.0, 0.0, 0.25, 1.0, 2.0, np.nan])
    np.testing.assert_allclose(f(at), vtk_color(f, at), atol=1e-12)
    np.testing.assert_allclose(f(at)[-1], (0.1, 0.2, 0.3))


def test_opacity_of_nan_is_zero():
    assert PiecewiseOpacity([0, 1], [0.5, 1])(np.array([np.nan, 2.0])).tolist() == [0.0, 1.0]
    assert PiecewiseOpacity([0], [0.5])(np.array([np.nan, 2.0])).tolist() == [0.0, 0.5]


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
    with pytest.raises(DataError, match=message):
        PiecewiseOpacity(x, y)


def test_bad_colors_are_named():
    with pytest.raises(DataError, match="colour space 'XYZ'; expected one of RGB"):
        ColorMap([0], [[0, 0, 0]], space="XYZ")
    with pytest.raises(DataError, match="colour 2"):
        ColorMap([0], [[0, 2, 0]])
    with pytest.raises(DataError, match="shape"):
        ColorMap([0, 1], [[0, 0, 0]])
