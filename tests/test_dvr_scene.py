"""Scenes: stored values of every type, the empty-space map, the optical tables."""

from typing import NamedTuple

import numba as nb
import numpy as np
import pytest

from vvgt_cli.cameras.sets import look_at
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.dvr.layout import BRICK, Voxels
from vvgt_cli.dvr.runs import sample_run, stack_run
from vvgt_cli.dvr.scene import kernel_type, kernel_values
from vvgt_cli.look.tables import EVEN, FLAT, MAX_OPACITY, build_tables, extinction
from vvgt_cli.volume import Volume

TYPES = ["b1", "u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8"]


class Unchecked(NamedTuple):
    """What looks like `Voxels`."""

    values: np.ndarray


class Ramp:
    """Opacity 0 up to ``first``, then linear to 0.5 at ``last``; red to blue."""

    name = "ramp"

    def __init__(self, first, last):
        self.first, self.last = first, last

    def opacity(self, x):
        return np.interp(x, [self.first, self.last], [0, 0.5])

    def color(self, x):
        f = np.interp(x, [self.first, self.last], [0, 1])
        return np.stack([1 - f, 0 * f, f], -1)

    def node_range(self):
        return self.first, self.last


def view(volume, tf):
    camera = look_at((2, -1.5, 1), width=16, height=16)
    return render_view(Scene.build(volume, tf, 1.0), camera, RenderSettings(samples=1))


@pytest.mark.parametrize("kind", TYPES)
def test_every_type_and_byte_order_gives_the_same_picture(kind):
    top = 1 if kind == "b1" else 100
    data = np.random.default_rng(0).integers(0, top + 1, (6, 5, 7))
    tf = Ramp(0.2 * top, 0.9 * top)
    expected = view(Volume(data.astype(np.float32)), tf)
    assert expected.max() > 0.1
    for order in "<>":
        np.testing.assert_allclose(view(Volume(data.astype(order + kind)), tf), expected, atol=2e-6)


@pytest.mark.parametrize(("slope", "intercept"), [(0.5, -3.0), (-2.0, 7.0), (1e-20, 0.0)])
@pytest.mark.parametrize("kind", ["u1", "i4", "f8"])
def test_stored_value_scaling_is_applied(kind, slope, intercept):
    data = np.random.default_rng(1).integers(0, 100, (6, 5, 7)).astype(kind)
    ends = sorted((slope * 20 + intercept, slope * 90 + intercept))
    scaled = view(Volume(data, slope=slope, intercept=intercept), Ramp(*ends))
    plain = view(Volume(slope * data.astype(np.float64) + intercept), Ramp(*ends))
    assert plain.max() > 0.1
    np.testing.assert_allclose(scaled, plain, atol=1e-5)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (np.zeros((5, 4, 1), np.uint8), "two or more along x"),
        (np.zeros((5, 4, 1), np.uint16), "two or more along x"),
        (np.zeros((1, 1, 3), np.uint8), "four in all"),
        (np.zeros((4, 4, 4), np.float32)[..., ::2], "C-contiguous"),
        (np.zeros((4, 4, 4), np.uint8).T[:, 1:], "C-contiguous"),
        (np.zeros(257, np.uint8)[1:].view(np.float32).reshape(4, 4, 4), "aligned"),
        (np.zeros((4, 4, 4), ">f4"), "native"),
        (np.zeros((4, 4, 4), np.int16), "uint16"),
        (np.zeros((4, 4), np.float32), "nz, ny, nx"),
        (np.zeros((4, 0, 4), np.float32), "not empty"),
    ],
)  # fmt: skip
def test_layouts_that_loads_would_leave_are_refused(values, reason):
    with pytest.raises(ValueError, match=reason):
        Voxels(values)


@pytest.mark.parametrize("shape", [(1, 1, 2), (1, 1, 3), (1, 1, 4), (2, 1, 2), (9, 9, 1), (1, 1, 1)])
@pytest.mark.parametrize("kind", TYPES)
def test_scenes_have_layouts_that_pass(kind, shape):
    scene = Scene.build(Volume(np.ones(shape, kind)), Ramp(0, 1), 1.0)
    assert scene.voxels.values is scene.values
    assert scene.values.dtype.name == kernel_type(scene.volume)


def test_runs_are_read_from_checked_voxels_alone():
    values = np.linspace(0, 1, 64, dtype=np.float32).reshape(4, 4, 4)
    scene = Scene.build(Volume(values), Ramp(0, 1), 1.0)

    @nb.njit
    def read(voxels, optics):
        run = stack_run()
        sample_run(voxels, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, optics, run)
        return run[0]

    assert read(scene.voxels, scene.optics) == 0
    with pytest.raises(nb.errors.TypingError):
        read(values, scene.optics)
    with pytest.raises(nb.errors.TypingError, match="read from Voxels"):
        read(Unchecked(values), scene.optics)


def test_kernel_values_are_native_contiguous_read_only_and_shared_where_they_can_be(tmp_path):
    base = np.random.default_rng(2).integers(0, 100, (4, 5, 6))
    for kind in ("u1", "u2", "f4"):
        data = base.astype(kind)
        values, *_ = kernel_values(Volume(data))
        assert np.shares_memory(values, data)
        assert data.flags.writeable
        path = tmp_path / kind
        path.write_bytes(b"x" + data.tobytes())  # at an odd offset
        mapped = np.memmap(path, kind, "r", 1, data.shape)
        variants = [mapped, data[::-1, :, ::-1][::-1, :, ::-1], np.asfortranarray(data), data.astype(">" + kind)]
        for variant in variants:
            values, *_ = kernel_values(Volume(variant))
            np.testing.assert_array_equal(values, data)
            assert values.dtype.isnative
            assert values.flags.c_contiguous
            assert values.flags.aligned
            assert not values.flags.writeable


@pytest.mark.parametrize("kind", ["i4", "f8"])
def test_kernel_values_of_wide_types_are_from_0_to_1(kind):
    data = np.random.default_rng(2).integers(10**9, 10**9 + 100, (4, 5, 6)).astype(kind)
    values, slope, intercept = kernel_values(Volume(data))
    assert (values.min(), values.max()) == (0, 1)
    np.testing.assert_allclose(slope * values.astype(np.float64) + intercept, data, atol=1e-3, rtol=0)


@pytest.mark.parametrize("shape", [(1, 1, 1), (8, 9, 17), (30, 16, 25)])
def test_the_empty_map_is_the_distance_to_the_nearest_visible_brick(shape):
    rng = np.random.default_rng(4)
    data = np.where(rng.uniform(size=shape) < 0.002, 200, rng.integers(0, 50, shape)).astype(np.uint8)
    data[0, 0, 0] = 200
    scene = Scene.build(Volume(data), Ramp(100, 150), 1.0)
    assert scene.empty.shape == tuple(-(-n // BRICK) for n in shape)
    visible = np.zeros(scene.empty.shape, bool)
    for brick in np.ndindex(visible.shape):
        visible[brick] = (data[tuple(slice(b * BRICK, b * BRICK + BRICK + 1) for b in brick)] > 100).any()
    places = np.argwhere(visible)
    for brick in np.ndindex(visible.shape):
        assert scene.empty[brick] == np.abs(places - brick).max(axis=1).min()


def test_bricks_without_a_finite_voxel_are_empty():
    data = np.full((8, 8, 24), np.nan, np.float32)
    data[:, :, 20:] = 1
    np.testing.assert_array_equal(Scene.build(Volume(data), Ramp(0, 0.5), 1.0).empty, [[[2, 1, 0]]])


@pytest.mark.parametrize("slope", [1.0, -0.25])
def test_tables_hold_the_function_and_its_integral(slope):
    tf = Ramp(2.0, 5.0)
    tables = build_tables(tf, (0, 9), slope=slope, intercept=1.0, unit_distance=0.5, world_per_unit=3.0)
    x = np.linspace(0, 9, tables.bins + 1)
    tau = extinction(tf.opacity(x), 0.5) * 3
    np.testing.assert_allclose(tables.nodes, np.column_stack([tf.color(x) * tau[:, None], tau]), atol=1e-12)
    np.testing.assert_allclose(tables.coordinate((x - 1) / slope), np.arange(tables.bins + 1), atol=1e-8)
    assert tables.cumulative[-1, 3] == pytest.approx(np.trapezoid(tau))
    assert tables.largest_extinction() == pytest.approx(-np.log(0.5) / 0.5 * 3)


def test_dark_spans_are_where_extinction_vanishes():
    class Bumps(Ramp):
        def opacity(self, x):
            return np.interp(x, [0, 2, 3, 4, 6, 6.5, 7, 10], [0, 0, 0.5, 0, 0, 0.2, 0, 0])

    tables = build_tables(Bumps(0, 10), (0, 10), unit_distance=1, world_per_unit=1, bins=80)
    tau = tables.nodes[:, 3]
    for first in range(80):
        for last in range(first + 1, 81):
            assert (tau[first : last + 1] > 0).any() == (last > tables.dark[first])


def test_spans_are_flat_up_to_a_difference_of_extinction_or_colour():
    class Bumps(Ramp):
        def opacity(self, x):
            return np.interp(x, [0, 2, 2.1, 3, 4, 6, 8, 10], [0, 0, 0.3, 0.34, 0.9, 0.9, 0.6, 0.6])

    for voxel in (2.0, 8.0, 32.0):
        tables = build_tables(Bumps(0, 10), (0, 10), unit_distance=1, world_per_unit=1, bins=80, voxel=voxel)
        for most, until in ((FLAT, tables.flat), (EVEN, tables.even)):
            ends = []
            for first in range(81):
                spans = [np.ptp(tables.nodes[first : last + 1], axis=0).max() for last in range(first, 81)]
                end = first + sum(span * voxel <= most for span in spans) - 1
                ends.append(end if end < 80 else np.inf)  # beyond the table, extinction is what it is at its end
            assert until.tolist() == ends
        assert len(set(ends)) > 3


def test_extinction_is_capped_where_opacity_is_one():
    largest = -np.log(1 - MAX_OPACITY) / 2
    assert extinction(np.array([0.0, 1.0, 2.0]), 2.0) == pytest.approx([0, largest, largest])


def test_a_segment_that_enters_the_nodes_range_is_weighed_by_the_part_within_it():
    z, y, x = np.indices((20, 20, 20)) / 19
    volume = Volume((x + 0.1 * np.sin(6 * y) * np.cos(5 * z)).astype(np.float32))

    class Band(Ramp):
        """Opaque from 0.45 to 0.5, between zeros at 0.43 and 0.52."""

        def opacity(self, x):
            return np.interp(x, [0.43, 0.45, 0.5, 0.52], [0, 0.6, 0.6, 0])

        def color(self, x):
            return np.broadcast_to([0.8, 0.5, 0.2], (len(x), 3))

    within, beyond = (view(volume, Band(*ends)) for ends in ((0.43, 0.52), (-1.0, 2.0)))
    assert beyond.max() > 0.3
    assert np.abs(within - beyond).max() < 0.01  # 0.1 where the table ends with the nodes


@pytest.mark.parametrize("kind", ["u1", "f4", "f8"])
def test_a_volume_of_zeros_is_as_visible_as_one_of_ones(kind):
    zeros, ones = (view(Volume(np.full((9, 9, 9), value, kind)), Ramp(value - 1, value)) for value in (0, 1))
    assert ones.max() > 0.3
    assert np.array_equal(zeros, ones)
