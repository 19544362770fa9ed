"""Moments of base cells against a float64 twin in plain numpy, and against integrals with a closed form."""

import math

import numpy as np
import pytest

from tests.closed_form_scenes import Ramp, Tent, scene_of
from vvgt_cli.closed_form import moments as moments_module
from vvgt_cli.closed_form.moments import Cells, base_cells, exponents
from vvgt_cli.dvr import Scene
from vvgt_cli.dvr.bricks import ranges_of
from vvgt_cli.dvr.layout import BRICK, Voxels
from vvgt_cli.look.tables import Optics, extinction
from vvgt_cli.volume import Volume, shapes


def test_ranges_of_blocks_are_those_of_their_voxels_and_the_next() -> None:
    values = np.random.default_rng(0).permutation(7 * 9 * 21).reshape(7, 9, 21).astype(np.float32)
    values[3, 4, 5] = np.nan
    first, edge, shape = np.array([4, 0, 2]), np.array([4, 3, 2]), np.array([4, 2, 2])
    found = ranges_of(values, first, edge, shape, 1)
    for x, y, z in np.ndindex(*shape):
        lo = first + edge * (x, y, z)
        a, b = np.maximum(lo - 1, 0), lo + edge + 1
        part = values[a[2] : b[2], a[1] : b[1], a[0] : b[0]]
        assert tuple(found[z, y, x]) == (np.nanmin(part), np.nanmax(part))


def trilinear(values: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Values on the product grid of voxel coordinates x (a,), y (b,), z (c,), clamped to edge -> (c, b, a)."""
    out = values.astype(np.float64)
    for axis, p in enumerate((z, y, x)):
        p = np.clip(p, 0, values.shape[axis] - 1)
        i = np.floor(p).astype(int)
        f = (p - i).reshape([-1 if a == axis else 1 for a in range(3)])
        out = np.take(out, i, axis) * (1 - f) + np.take(out, np.minimum(i + 1, values.shape[axis] - 1), axis) * f
    return out


def twin(scene: Scene, tf, distance: float, exponent: np.ndarray, points_per_voxel: int = 2) -> np.ndarray:
    """The quadrature of `base_cells`, over all cells: dense (cz, cy, cx, 13).

    Midpoint rule in space; at each point tau(s) is averaged over [s - w, s + w] by 200 midpoints, with 2 w the root of
    the summed squared differences of s over the point's box.
    """
    volume, dims = scene.volume, np.array(scene.volume.dims)
    cell = 2.0**exponent
    points = np.maximum(np.round(cell * points_per_voxel), 2).astype(int)
    count = np.ceil(dims / cell).astype(int)
    d = cell / points
    axes = [(np.arange(count[a] * points[a]) + 0.5) * d[a] - 0.5 for a in range(3)]
    values = volume.slope * volume.data.astype(np.float64) + volume.intercept
    square = 0.0
    for a in range(3):
        ahead, behind = list(axes), list(axes)
        ahead[a], behind[a] = axes[a] + d[a] / 2, axes[a] - d[a] / 2
        square = square + (trilinear(values, *ahead) - trilinear(values, *behind)) ** 2
    s, w = trilinear(values, *axes), 0.5 * np.sqrt(square)
    lo, hi = values.min(), values.max()  # the tables end with the data
    mean = np.zeros((4, *s.shape))
    per_unit = 1 / volume.unit_frame().scale
    for k in range(200):
        x = np.clip(s + w * ((2 * k + 1) / 200 - 1), lo, hi).ravel()
        tau = extinction(tf.opacity(x), distance) * per_unit
        mean += np.concatenate([tau[None], tau * tf.color(x).T]).reshape(mean.shape) / 200
    inside = [a <= n - 0.5 for a, n in zip(axes, dims, strict=True)]
    mean *= inside[2][:, None, None] & inside[1][:, None] & inside[0]
    tau, box = mean[0] * (d * scene.step).prod(), (d * scene.step) ** 2 / 12
    x, y, z = ((a + 0.5) * scene.step[i] - scene.half[i] for i, a in enumerate(axes))
    x, y, z = x[None, None, :], y[None, :, None], z[:, None, None]
    second = [x * x + box[0], x * y, x * z, y * y + box[1], y * z, z * z + box[2]]
    rows = [tau * f for f in (1, x, y, z, *second)] + [c * (d * scene.step).prod() for c in mean[1:]]
    dense = np.stack(rows, axis=-1)  # (z, y, x, 13)
    blocks = dense.reshape(count[2], points[2], count[1], points[1], count[0], points[0], 13)
    return blocks.sum(axis=(1, 3, 5))


def dense(cells: Cells, like: np.ndarray) -> np.ndarray:
    out = np.zeros_like(like)
    x, y, z = cells.index.T
    out[z, y, x] = cells.moments
    return out


def rough(dims: tuple[int, int, int], spacing=(1.0, 1.0, 1.0), dtype=np.float32) -> Volume:
    data = shapes.random_field(dims, cycles=3, seed=4).data
    return Volume((data * 255).astype(dtype) if dtype is not np.float32 else data, spacing)


@pytest.mark.parametrize("exponent", [(0, 0, 0), (-1, -1, -1), (-2, -1, 0), (1, 1, 1), (2, 0, -1), (4, 3, 2)])
@pytest.mark.parametrize("tf", [Ramp(2.0), Tent()], ids=lambda tf: tf.name)
def test_twin(exponent: tuple[int, int, int], tf, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(rough((19, 9, 13), (1.0, 2.5, 0.7)), tf, 2.0)
    expected = twin(scene, tf, 2.0, np.array(exponent))
    scale = np.abs(expected).max(axis=(0, 1, 2))
    for bend in (moments_module.BEND, 0.0):
        monkeypatch.setattr(moments_module, "BEND", bend)
        cells = base_cells(scene, np.array(exponent))
        # the tables interpolate tau linearly between 2048 bins or more
        bound = 5e-3 if bend and min(exponent) >= moments_module.WIDE else 1e-4
        assert (np.abs(dense(cells, expected) - expected).max(axis=(0, 1, 2)) / scale).max() < bound
        np.testing.assert_allclose(cells.edge, 2.0 ** np.array(exponent) * scene.step)


class White(Ramp):
    """Of one colour: straight from end to end."""

    def color(self, x: np.ndarray) -> np.ndarray:
        return np.ones((*np.shape(x), 3))


@pytest.mark.parametrize("exponent", [(1, 1, 1), (3, 2, 1)])
def test_one_point_gives_what_eight_do_under_a_straight_function(exponent: tuple[int, int, int]) -> None:
    scene = scene_of(rough((19, 9, 13), (1.0, 2.5, 0.7)), White(2.0), 2.0)
    assert moments_module.linear_ranges(scene.optics)[0] == scene.optics.bins
    expected = twin(scene, White(2.0), 2.0, np.array(exponent))
    off = np.abs(dense(base_cells(scene, np.array(exponent)), expected) - expected).max(axis=(0, 1, 2))
    assert (off / np.abs(expected).max(axis=(0, 1, 2))).max() < 1e-4


def test_twin_of_integer_and_scaled_values() -> None:
    tf = Tent(0.5, 0.3)
    bytes_ = rough((10, 11, 9), dtype=np.uint8)
    scene = scene_of(Volume(bytes_.data, bytes_.spacing, slope=1 / 255), tf, 1.0)
    expected = twin(scene, tf, 1.0, np.zeros(3))
    got = dense(base_cells(scene, np.zeros(3, np.int64)), expected)
    np.testing.assert_allclose(got[..., 0], expected[..., 0], atol=1e-4 * expected[..., 0].max())


@pytest.mark.parametrize("corner", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 1, 1)])
def test_matter_that_ends_at_a_brick_reaches_into_the_next(corner: tuple[int, int, int]) -> None:
    """Voxels up to a brick's last one: the half voxel behind it lies in blocks whose own bricks are empty."""
    data = np.zeros([BRICK + 2 if along else 3 for along in corner], np.float32)
    data[tuple(slice(0, BRICK if along else None) for along in corner)] = 1
    scene, tf = scene_of(Volume(data), Ramp(2.0), 2.0), Ramp(2.0)
    assert (scene.empty > 0).any()
    expected = twin(scene, tf, 2.0, np.zeros(3))
    got = dense(base_cells(scene, np.zeros(3, np.int64)), expected)
    behind = tuple(slice(BRICK, None) if along else slice(None) for along in corner)
    assert expected[behind][..., 0].max() > 0.1 ** sum(corner) * expected[..., 0].max()
    rough = 0.25 if sum(corner) > 1 else 0  # where edges meet, the spread of a point's voxels is not that of its box
    np.testing.assert_allclose(got[..., 0], expected[..., 0], rtol=rough, atol=1e-4 * expected[..., 0].max())


def test_scratch_bound_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(rough((33, 17, 25)), Tent())
    whole = base_cells(scene, np.zeros(3, np.int64))
    monkeypatch.setattr(moments_module, "CHUNK_CELLS", 600)
    pieces = base_cells(scene, np.zeros(3, np.int64))
    np.testing.assert_array_equal(whole.index, pieces.index)
    np.testing.assert_array_equal(whole.moments, pieces.moments)


@pytest.mark.parametrize("level", [1, 2, 3, 4])
def test_mass_is_the_same_at_any_level(level: int) -> None:
    """At and above the voxel the quadrature points are the same ones, where none is spared."""
    scene = scene_of(rough((19, 9, 13), (1.0, 1.0, 3.0)), Tent())
    fine = base_cells(scene, np.zeros(3, np.int64))
    coarse = base_cells(scene, np.full(3, level), points_per_voxel=2)
    np.testing.assert_allclose(coarse.moments.sum(axis=0), fine.moments.sum(axis=0), rtol=1e-11, atol=1e-14)
    assert len(coarse.index) < len(fine.index)


def test_blob_moments() -> None:
    """Trilinear interpolation keeps the mass and adds h^2/6 to the variance; colours follow the extinction."""
    n, sigma, k = 40, 0.2, 3.0
    scene = scene_of(shapes.blob(n, sigma), Ramp(k), 1.0)
    total = base_cells(scene, np.zeros(3, np.int64)).moments.sum(axis=0)
    mass = k * (2 * math.pi * sigma**2) ** 1.5
    assert total[0] == pytest.approx(mass, rel=2e-4)
    np.testing.assert_allclose(total[1:4], 0, atol=1e-9)
    np.testing.assert_allclose(total[[4, 7, 9]] / total[0], sigma**2 + (2 / n) ** 2 / 6, rtol=3e-3)
    np.testing.assert_allclose(total[[5, 6, 8]], 0, atol=1e-9)
    assert total[11] == pytest.approx(0.25 * total[0], rel=1e-9)
    assert total[10] + total[12] == pytest.approx(total[0], rel=1e-9)


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.1, 7.0, 30.0)])
@pytest.mark.parametrize("value", [0.0, 0.3, 1.0, 5.0])
def test_constant(value: float, spacing: tuple[float, float, float]) -> None:
    """All of the box, the half-voxel rim included, at the function's value there (the end's beyond its nodes)."""
    volume = Volume(np.full((9, 11, 5), value, np.float32), spacing)
    scene = scene_of(volume, Ramp(2.0), 4.0)
    cells = base_cells(scene, np.zeros(3, np.int64))
    tau = 2.0 * min(value, 1.0) / 4.0 / volume.unit_frame().scale
    assert cells.moments[:, 0].sum() == pytest.approx(tau * (2 * scene.half).prod(), rel=1e-5)
    if value == 0:
        assert len(cells.index) == 0
        return
    assert len(cells.index) == 9 * 11 * 5
    np.testing.assert_allclose(cells.moments[:, 0], tau * scene.step.prod(), rtol=1e-5)
    centre = (cells.index + 0.5) * scene.step - scene.half
    np.testing.assert_allclose(cells.moments[:, 1:4] / cells.moments[:, :1], centre, atol=1e-9)
    second = cells.moments[:, [4, 7, 9]] / cells.moments[:, :1] - centre**2
    np.testing.assert_allclose(second, np.broadcast_to(scene.step**2 / 12, second.shape), rtol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_not_finite_voxels_are_transparent(bad: float) -> None:
    data = np.ones((12, 12, 12), np.float32)
    data[4, 5, 6] = bad
    cells = base_cells(scene_of(Volume(data), Ramp(1.0), 1.0), np.zeros(3, np.int64))
    assert np.isfinite(cells.moments).all()
    assert len(cells.index) == 12**3 - 1
    # neighbours across a face, an edge, a corner lose the half, quarter, eighth that interpolates with it
    away = np.abs(cells.index - [6, 5, 4])
    near = away.max(axis=1) <= 1
    kept = np.where(near, 1 - 0.5 ** away.sum(axis=1), 1)
    np.testing.assert_allclose(cells.moments[:, 0] / cells.moments[~near, 0][0], kept, rtol=1e-6)


def test_exponents_make_cells_near_cubic() -> None:
    for step in np.array([(1, 1, 1), (1, 1, 10), (0.3, 1, 1000), (1, 1.4, 1.5)]):
        for level in (-2, 0, 3):
            exponent = exponents(step, level)
            edge = step * 2.0**exponent
            assert edge[step.argmin()] == pytest.approx(step.min() * 2.0**level)
            cut = exponent == moments_module.FINEST_CUT  # of a voxel far longer than the others no more pieces are made
            assert edge[~cut].max() / edge[~cut].min() <= 2
            assert (edge[cut] >= edge.min()).all()


def test_windows_of_bins_are_straight_up_to_a_bend() -> None:
    tau = np.concatenate([np.zeros(5), np.arange(11.0), 10 + 3 * np.arange(1, 7.0), np.full(4, 28.0)])
    nodes = np.stack([tau, 0.5 * tau, 0 * tau, tau], axis=1)
    optics = Optics.of(0.0, 1.0, nodes, np.cumsum(nodes, axis=0))
    found = moments_module.linear_ranges(optics)
    assert set(found[:5]) == {5}
    assert set(found[5:15]) == {15}
    assert set(found[15:21]) == {21}
    assert set(found[21:25]) == {25}
    bent = optics._replace(nodes=nodes + [[0, 0, 1, 0]] * (np.arange(26) == 9)[:, None])  # a colour's bend, too
    assert moments_module.linear_ranges(bent)[5] < 10


@pytest.mark.parametrize("level", [1, 2])
def test_wide_cells_have_the_same_bytes_whatever_part_of_the_volume_is_there(level: int) -> None:
    """And hold what cells of one voxel do, also where they reach over the volume's end."""
    scene = scene_of(Volume(rough((35, 29, 27), dtype=np.uint8).data, slope=1 / 255), Tent(0.5, 0.3))
    exponent, dims = np.full(3, level), np.array(scene.volume.dims)
    whole, fine = base_cells(scene, exponent), base_cells(scene, np.zeros(3, np.int64)).moments.sum(axis=0)
    assert fine[0] > 0
    np.testing.assert_allclose(whole.moments.sum(axis=0), fine, rtol=2e-3, atol=2e-3 * fine[0])
    rows = {}
    for lo in np.argwhere(np.ones(-(-dims // 16))) * 16:
        a, b = np.maximum(lo - 1, 0), np.minimum(lo + 17, dims)
        part = np.ascontiguousarray(scene.values[a[2] : b[2], a[1] : b[1], a[0] : b[0]])
        part.flags.writeable = False
        region = moments_module.Region(Voxels(part), scene.optics, scene.half, scene.step, a.astype(float))
        origins = np.argwhere(np.ones(-(-(np.minimum(lo + 16, dims) - lo) // 8))) * 8 + lo
        index, found = moments_module.region_cells(region, origins, exponent)
        rows |= {tuple(place): row for place, row in zip(index.tolist(), found, strict=True)}
    assert len(rows) == len(whole.index)
    for place, row in zip(whole.index.tolist(), whole.moments, strict=True):
        np.testing.assert_array_equal(rows[tuple(place)], row)
