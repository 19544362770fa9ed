"""Transfer functions on data: ranges, unit distance, visibility, and the automatic one."""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.look import (
    ColorMap,
    PiecewiseOpacity,
    TransferFunction,
    check_visible,
    draw,
    from_histogram,
    read_transfer_function,
    resolve,
    unit_distance,
)
from vvgt_cli.volume.types import Volume


@dataclass
class Statistics:
    lo: float
    hi: float
    histogram: np.ndarray
    edges: np.ndarray


def statistics(values, bins=256):
    values = np.asarray(values, dtype=np.float64)
    lo, hi = float(values.min()), float(values.max())
    histogram, edges = np.histogram(values, bins, (lo, hi) if hi > lo else (lo - 0.5, hi + 0.5))
    return Statistics(lo, hi, histogram, edges)


def function(x=(0, 50, 100), y=(0, 0.2, 1), **kwargs):
    colors = np.linspace(0, 1, len(x))[:, None] * np.ones(3)
    return TransferFunction("test", PiecewiseOpacity(x, y), ColorMap(x, colors), **kwargs)


DATA = statistics(np.linspace(-100, 300, 10_001))


def test_data_range_takes_the_nodes_as_they_are():
    tf = function()
    assert resolve(tf, DATA) is tf


def test_rescale_stretches_all_nodes_linearly():
    tf = resolve(function(), DATA, "rescale")
    assert tf.breakpoints().tolist() == [-100, 100, 300]
    np.testing.assert_allclose(tf.opacity(np.array([-100, 100, 200, 300])), [0, 0.2, 0.6, 1])
    assert resolve(function(), DATA, "10, 20").node_range() == (10, 20)
    assert resolve(function(), DATA, (10, 20)).node_range() == (10, 20)


def test_rescale_moves_opacity_and_color_together():
    tf = TransferFunction("test", PiecewiseOpacity([10, 20], [0, 1]), ColorMap([0, 40], np.eye(3)[:2]))
    moved = tf.rescaled(0, 400)
    assert moved.opacity_nodes.x.tolist() == [100, 200]
    assert moved.color_map.x.tolist() == [0, 400]
    at = np.linspace(-5, 45, 30)
    np.testing.assert_allclose(moved.opacity(10 * at), tf.opacity(at), atol=1e-12)
    np.testing.assert_allclose(moved.color(10 * at), tf.color(at), atol=1e-12)


def test_rescale_keeps_duplicate_nodes():
    tf = function(x=(0, 5, 5, 10), y=(0, 0, 1, 1)).rescaled(0, 1)
    assert tf.opacity_nodes.x.tolist() == [0, 0.5, 0.5, 1]
    np.testing.assert_allclose(tf.opacity(np.array([0.499, 0.5])), [0, 1])


def test_unit_nodes_on_other_data_are_stretched_and_said():
    with pytest.warns(
        UserWarning, match=r"in \[0, 1\], the data in \[-100, 300\]; stretched .* \(--tf-range 0,1: data"
    ):
        assert resolve(function(x=(0, 0.5, 1)), DATA).node_range() == (-100, 300)
    with pytest.warns(UserWarning, match=r"the data in \[5, 6\]; stretched"):  # nothing of them in [0, 1]
        assert resolve(function(x=(0, 0.5, 1)), statistics([5.0, 6.0])).node_range() == (5, 6)


@pytest.mark.parametrize("values", [[0.0, 1.19], [-1.0, 1.0], [0.5, 2.4], [0.0, 2.0]])
def test_unit_nodes_on_data_that_reach_a_little_beyond_are_data_values(values):
    with pytest.warns(UserWarning, match=r"taken as data values \(--tf-range rescale"):
        assert resolve(function(x=(0, 0.5, 1)), statistics(values)).node_range() == (0, 1)


def test_unit_nodes_on_unit_data_are_data_values(recwarn):
    assert resolve(function(x=(0, 0.5, 1)), statistics([0.2, 0.9])).node_range() == (0, 1)
    assert resolve(function(x=(0, 0.5, 1)), DATA, "0,1").node_range() == (0, 1)
    assert not recwarn.list


@pytest.mark.parametrize("spec", ["all", "1", "1,2,3", "2,1", "1,1", "nan,1", "0,inf", "", (1,)])
def test_bad_ranges_are_usage_errors(spec):
    refused(UsageError, "--tf-range", resolve, function(), DATA, spec)


def test_fractions_follow_the_data_or_the_range():
    tf = read_transfer_function("viridis:0.25,0.75")
    assert resolve(tf, DATA).opacity_nodes.x.tolist() == [0, 200]
    assert resolve(tf, DATA).domain == "data"
    assert resolve(tf, DATA, "rescale").opacity_nodes.x.tolist() == [0, 200]
    assert resolve(tf, DATA, "0,8").opacity_nodes.x.tolist() == [2, 6]
    assert resolve(tf, statistics(np.full(10, 7.0))).opacity(np.array([7.0])).tolist() == [1]


def test_percentiles_follow_the_histogram():
    values = np.random.default_rng(0).exponential(10, 100_000)
    tf = function(x=(0, 0.5, 0.9), y=(0, 0.1, 1), domain="percentile")
    resolved = resolve(tf, statistics(values))
    expected = np.quantile(values, [0, 0.5, 0.9])
    np.testing.assert_allclose(resolved.breakpoints(), expected, atol=(values.max() - values.min()) / 256)
    refused(UsageError, "omit --tf-range", resolve, tf, statistics(values), "rescale")


def test_a_function_of_one_position_cannot_be_stretched():
    refused(DataError, "two positions", resolve, function(x=(5,), y=(1,)), DATA, "rescale")
    refused(DataError, "cannot stretch", resolve, function(), statistics([3.0, 3.0]), "rescale")


def test_unit_distance_by_paraview_and_by_spacing():
    cube = Volume(np.zeros((8, 8, 8), np.uint8), spacing=(2, 2, 2))
    assert unit_distance(None, cube) == (pytest.approx(2 * math.sqrt(3)), "paraview")
    box = Volume(np.zeros((5, 9, 17), np.uint8), spacing=(1, 2, 3))
    expected = math.sqrt(16**2 + 16**2 + 12**2) / (16 * 8 * 4) ** (1 / 3)
    assert unit_distance("paraview", box) == (pytest.approx(expected), "paraview")
    assert unit_distance("mean-spacing", box) == (2, "mean-spacing")
    assert unit_distance("0.5", box) == (0.5, "given")
    assert unit_distance(0.5, box, function(opacity_unit_distance=7)) == (0.5, "given")
    assert unit_distance(None, box, function(opacity_unit_distance=7)) == (7, "file")
    assert unit_distance("paraview", box, function(opacity_unit_distance=7))[1] == "paraview"


def test_unit_distance_of_flat_volumes():
    flat = Volume(np.zeros((1, 9, 9), np.uint8), spacing=(2, 2, 5))
    assert unit_distance("paraview", flat)[0] == pytest.approx(2 * math.sqrt(2))
    line = Volume(np.zeros((1, 1, 9), np.uint8), spacing=(2, 3, 5))
    assert unit_distance("paraview", line)[0] == pytest.approx(2)
    voxel = Volume(np.zeros((1, 1, 1), np.uint8), spacing=(1, 2, 3))
    assert unit_distance("paraview", voxel)[0] == pytest.approx(2)


@pytest.mark.parametrize("spec", ["0", "-1", "nan", "inf", "vtk", 0.0])
def test_bad_unit_distances_are_usage_errors(spec):
    refused(UsageError, "--opacity-unit-distance", unit_distance, spec, Volume(np.zeros((2, 2, 2), np.uint8)))


def test_support_is_where_opacity_is_above_zero():
    tf = function(x=(0, 10, 20, 30, 40, 50), y=(0, 0, 0.5, 0, 0, 0.1))
    assert tf.support(-100, 100) == [(10, 30), (40, 100)]
    assert tf.support(15, 16) == [(15, 16)]
    assert tf.support(30, 40) == []
    assert tf.support(-10, 10) == []
    assert tf.support(45, 45) == [(45, 45)]
    assert tf.support(35, 35) == []
    at = np.linspace(-20, 70, 5001)
    inside = np.zeros(at.shape, bool)
    for a, b in tf.support(-20, 70):
        inside |= (at > a) & (at < b)
    np.testing.assert_array_equal(tf.opacity(at) > 0, inside | ((at == 70) & (tf.opacity(at) > 0)))


def test_support_of_steps_and_bumps_beyond_the_ends():
    assert function(x=(0, 5, 5, 9), y=(0, 0, 1, 1)).support(-1, 10) == [(5, 10)]
    assert function(x=(3,), y=(0.5,)).support(-1, 10) == [(-1, 10)]
    assert function(x=(0, 1), y=(1, 0)).support(-5, 5) == [(-5, 1)]


def test_nothing_visible_is_an_error_with_both_ranges():
    with pytest.raises(DataError, match=r"the data lie in \[-100, 300\], opacity is above 0 in \[400, inf\]"):
        check_visible(function(x=(0, 400, 500), y=(0, 0, 1)), DATA)
    refused(DataError, "nowhere", check_visible, function(y=(0, 0, 0)), DATA)
    check_visible(function(), DATA)
    check_visible(function(x=(0, 299, 500), y=(0, 0, 1)), DATA)


def test_data_without_finite_voxels_are_an_error():
    empty = Statistics(math.nan, math.nan, np.zeros(256), np.linspace(0, 1, 257))
    for use in (
        lambda: resolve(function(), empty),
        lambda: check_visible(function(), empty),
        lambda: from_histogram(empty),
    ):
        refused(DataError, "no finite voxel", use)


def ct_values(air=60_000):
    """Hounsfield units of air, tissue and bone, (n,)."""
    rng = np.random.default_rng(0)
    return np.concatenate([rng.normal(-1000, 20, air), rng.normal(40, 60, 30_000), rng.normal(700, 200, 4000)])


def kinds():
    """Value distributions of typical volumes: name, values, transparent below, visible somewhere in."""
    rng = np.random.default_rng(0)
    stored = np.round(ct_values() + 1024)  # as the file has them, or a raw one
    padded = np.concatenate([np.full(50_000, -2000.0), stored])
    eight = np.round(255 * (stored - stored.min()) / np.ptp(stored))
    mr = np.concatenate([rng.exponential(8, 70_000), rng.normal(300, 60, 30_000)]).clip(0)
    fog = rng.exponential(10, 100_000)
    return [
        ("stored ct", stored, 24, (924, 2024)),
        ("padded ct", padded, 24, (924, 2024)),
        ("ct in 8 bits", eight, 12, (200, 250)),
        ("mr", mr, 2, (150, 400)),
        ("fog", fog, 0, (30, 60)),
    ]


@pytest.mark.parametrize(("name", "values", "background", "foreground"), kinds())
def test_automatic_function_hides_the_background_and_shows_the_rest(name, values, background, foreground):
    numbers = statistics(values)
    tf = from_histogram(numbers)
    assert tf.name == "automatic (histogram)"
    check_visible(tf, numbers)
    assert tf.opacity(np.array([background]))[0] <= 0.002
    assert tf.opacity(np.linspace(*foreground, 50)).max() > 0.02
    assert tf.opacity(np.array([numbers.hi]))[0] == pytest.approx(0.5)
    depth = 256 * -np.log1p(-tf.opacity(values)).mean()  # along the longest edge, on average
    assert 1 < depth < 4.5
    assert from_histogram(statistics(values)).opacity_nodes.x.tolist() == tf.opacity_nodes.x.tolist()


def test_automatic_function_shows_both_sides_of_an_ambient_value():
    rng = np.random.default_rng(1)
    values = np.concatenate([rng.normal(0, 0.01, 80_000), rng.normal(-0.6, 0.2, 10_000), rng.normal(0.6, 0.2, 10_000)])
    tf = from_histogram(statistics(values))
    assert tf.opacity(np.array([0.0]))[0] == 0
    assert tf.opacity(np.array([values.min(), values.max()])) == pytest.approx(0.5)
    high = from_histogram(statistics(np.concatenate([rng.normal(200, 2, 90_000), rng.uniform(0, 150, 10_000)])))
    assert high.opacity(np.array([200.0]))[0] == 0
    assert high.opacity(np.array([0.0]))[0] > 0.3


def test_automatic_function_of_hounsfield_units_shows_tissue_by_them():
    values = ct_values()
    for every in (values, np.concatenate([np.full(50_000, -2000.0), values])):
        tf = from_histogram(statistics(every))
        assert tf.name == "automatic (Hounsfield units)"
        air, fat, organ, bone = tf.opacity(np.array([-1000.0, -100, 40, 700]))
        assert air == 0
        assert 0 < fat < organ < 0.006 < 0.29 < bone
    crop = statistics(ct_values(air=0))
    assert from_histogram(crop).name == "automatic (histogram)"
    assert from_histogram(crop, hounsfield=True).opacity_nodes.x.tolist() == tf.opacity_nodes.x.tolist()
    dark = statistics(np.linspace(-2000, -900, 1000))
    assert from_histogram(dark, hounsfield=True).name == "automatic (histogram)"


@pytest.mark.parametrize("values", [np.linspace(-1100, 1100, 9999), np.random.default_rng(4).normal(0, 500, 9999)])
def test_a_field_of_such_values_is_not_taken_for_hounsfield_units(values):
    assert from_histogram(statistics(values)).name == "automatic (histogram)"


def test_automatic_function_shows_the_whole_of_a_crop_without_air():
    rng = np.random.default_rng(5)
    crop = np.concatenate(
        [rng.normal(10_500, 1200, 60_000), rng.normal(5000, 2500, 35_000), rng.uniform(0, 30_000, 300)]
    )
    tf = from_histogram(statistics(crop.clip(0)))
    dark, usual, bright = tf.opacity(np.array([2000.0, 10_500, 28_000]))
    assert dark < usual < bright == pytest.approx(0.5)


def test_automatic_function_of_labels_shows_no_others_between_them():
    tf = from_histogram(statistics(np.repeat([0.0, 1, 2, 3, 4], [90_000, 6000, 50, 3000, 950])))
    at = tf.opacity(np.arange(5.0))
    assert at[0] == 0
    assert at[[2, 4]] == pytest.approx(0.5, rel=0.02)  # rare ones are thick; within half a bin
    assert at[4] > at[3] > at[1] > 0
    between = tf.opacity(np.arange(1.5, 4))
    assert (between <= np.maximum(at[1:-1], at[2:]) * 1.02).all()
    assert (between >= np.minimum(at[1:-1], at[2:])).all()


@pytest.mark.parametrize(
    "values", [[5.0, 5.0], [0.0, 1.0], np.arange(256.0), np.r_[np.zeros(1000), 1.0], [-1e30, 1e30]]
)
def test_automatic_function_of_extreme_data_shows_something(values):
    numbers = statistics(values)
    tf = from_histogram(numbers)
    check_visible(tf, numbers)
    at = np.linspace(numbers.lo, numbers.hi, 100)
    assert np.isfinite(tf.opacity(at)).all()
    assert ((tf.color(at) >= 0) & (tf.color(at) <= 1)).all()


def test_drawing_shows_the_colors_and_is_written_whole(tmp_path):
    from vvgt_cli.images import read_png

    red = TransferFunction("all $red", PiecewiseOpacity([0, 100], [1, 1]), ColorMap([0], [[1, 0, 0]]))
    draw(red, DATA, tmp_path / "a.png")
    picture = read_png(tmp_path / "a.png")[..., :3]
    assert ((picture - (1, 0, 0)) ** 2).sum(-1).min() < 1e-6
    assert (np.abs(picture - (1, 0, 0)).max(-1) < 0.02).mean() > 0.4
    refused(UsageError, "--overwrite", draw, red, DATA, tmp_path / "a.png")
    before = (tmp_path / "a.png").read_bytes()
    draw(red, DATA, tmp_path / "a.png", overwrite=True)
    assert (tmp_path / "a.png").read_bytes() == before
    for name in ("viridis", "magma:0.5,0.5"):
        draw(read_transfer_function(name), None, tmp_path / f"{name[:3]}.png")
    draw(from_histogram(statistics([1.0, 1.0])), statistics([1.0, 1.0]), tmp_path / "c.png")
    assert len(list(tmp_path.iterdir())) == 4


def test_node_positions_of_other_domains_lie_in_the_unit_interval():
    refused(DataError, "for a fraction", function, domain="fraction")
    refused(DataError, "node domain 'log'", function, domain="log")
    refused(DataError, "unit distance -1", function, opacity_unit_distance=-1)
