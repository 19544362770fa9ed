"""Statistics against numpy, for every type, with scaling, NaN and memory."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from vvgt_cli.errors import DataError
from vvgt_cli.volume import ReadOptions, Statistics, Volume, read_volume, slabs, statistics
from vvgt_cli.volume import stats as stats_module
from vvgt_cli.volume.headers import DTYPES


def values_of(dtype: np.dtype, seed: int = 5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    if dtype.kind == "f":
        return rng.standard_normal((7, 6, 5)).astype(dtype)
    info = np.iinfo(dtype)
    return rng.integers(info.min // 2, info.max // 3, (7, 6, 5), dtype=dtype.newbyteorder("=")).astype(dtype)


def check(found: Statistics, values: np.ndarray) -> None:
    """Compare with numpy on float64 values; a count may move one bin where a value lies on an edge."""
    finite = values[np.isfinite(values)]
    assert (found.lo, found.hi) == (finite.min(), finite.max())
    assert found.nan_count == np.isnan(values).sum()
    assert found.inf_count == np.isinf(values).sum()
    assert found.histogram.shape == (256,)
    assert found.histogram.sum() == finite.size
    assert (found.edges[0], found.edges[-1]) == (found.lo, found.hi)
    counts, edges = np.histogram(finite, 256, (finite.min(), finite.max()))
    np.testing.assert_allclose(found.edges, edges, rtol=1e-12, atol=1e-12 * np.abs(edges).max())
    assert np.abs(np.cumsum(found.histogram) - np.cumsum(counts)).max() <= 1


@pytest.mark.parametrize("name", DTYPES)
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("scaling", [(1.0, 0.0), (-0.37, 12.5)])
def test_all_types(monkeypatch: pytest.MonkeyPatch, name: str, order: str, scaling: tuple[float, float]) -> None:
    monkeypatch.setattr(stats_module, "SLAB_VOXELS", 61)
    data = values_of(np.dtype(name).newbyteorder(order))
    slope, intercept = scaling
    found = statistics(Volume(data, slope=slope, intercept=intercept))
    check(found, data.astype(np.float64) * slope + intercept)


@pytest.mark.parametrize("name", ["float16", "float32", "float64"])
def test_nan_and_inf_are_counted_not_used(name: str) -> None:
    data = values_of(np.dtype(name))
    data[0, 0, :2], data[3, 3, 3], data[6] = np.nan, np.inf, -np.inf
    found = statistics(Volume(data))
    assert (found.nan_count, found.inf_count) == (2, 31)
    check(found, data.astype(np.float64))


@pytest.mark.parametrize(("fill", "counts"), [(np.nan, "8 NaN, 0 infinite"), (np.inf, "0 NaN, 8 infinite")])
def test_nothing_finite_is_an_error(fill: float, counts: str) -> None:
    with pytest.raises(DataError, match=rf"none of its 8 voxels is finite \({counts}\).*--byte-order"):
        statistics(Volume(np.full((2, 2, 2), fill, np.float32)))


@pytest.mark.parametrize("value", [np.uint8(7), np.float32(-2.5), np.float64(0), np.float64(1e300), np.bool_(True)])
def test_constant(value: np.generic) -> None:
    found = statistics(Volume(np.full((2, 3, 4), value)))
    assert found.lo == found.hi == float(value)
    assert found.edges[0] < found.lo < found.edges[-1]
    assert found.histogram[128] == found.histogram.sum() == 24
    assert np.all(np.diff(found.edges) > 0)


def test_values_at_the_limits_of_float64() -> None:
    found = statistics(Volume(np.array([-1.7e308, 0, 1.7e308]).reshape(1, 1, 3)))
    assert (found.lo, found.hi) == (-1.7e308, 1.7e308)
    np.testing.assert_array_equal(np.nonzero(found.histogram)[0], [0, 128, 255])
    assert np.isfinite(found.edges).all()


@pytest.mark.parametrize(
    "data",
    [
        np.array([[[3.0]]]), np.arange(12.0).reshape(1, 3, 4), np.linspace(0, 1e-30, 60).reshape(3, 4, 5),
        np.linspace(-1e30, 1e30, 60).reshape(3, 4, 5), np.arange(65536, dtype=np.uint16).reshape(16, 64, 64),
    ],
    ids=["one voxel", "one slice", "range 1e-30", "range 1e30", "all 16-bit values"],
)  # fmt: skip
def test_odd_grids_and_ranges(data: np.ndarray) -> None:
    found = statistics(Volume(data))
    assert (found.lo, found.hi, found.histogram.sum()) == (data.min(), data.max(), data.size)
    assert (np.diff(found.edges) > 0).all()


@pytest.mark.parametrize("spacing", [(1.0, 1000.0, 1.0), (1e-30, 1e-30, 1e-27), (1e30, 1.0, 1.0)])
def test_the_longest_edge_of_the_unit_frame_is_2(spacing: tuple[float, float, float]) -> None:
    assert max(Volume(np.zeros((3, 4, 5), np.uint8), spacing).unit_frame().half) == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize("dtype", ["uint8", "int32"])
def test_scaling_beyond_float64_is_an_error(dtype: str) -> None:
    with pytest.raises(DataError, match="check the scaling"):
        statistics(Volume(np.arange(8, dtype=dtype).reshape(2, 2, 2), slope=1e308))


def test_slabs_are_views_where_they_can_be() -> None:
    data = np.arange(60, dtype="<i4").reshape(3, 4, 5)
    parts = list(slabs(Volume(data), 40))
    assert [(z, part.shape) for z, part in parts] == [(0, (2, 4, 5)), (2, (1, 4, 5))]
    assert all(np.shares_memory(part, data) for _, part in parts)
    swapped = list(slabs(Volume(data.astype(">i4")), 1))
    assert len(swapped) == 3
    assert all(part.dtype == np.dtype("=i4") and part.flags.aligned for _, part in swapped)
    np.testing.assert_array_equal(np.concatenate([part for _, part in swapped]), data)


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_memory_stays_within_slabs(tmp_path: Path, dtype: str) -> None:
    """256 MiB or 1 GiB of voxels (a sparse file), a few slabs of memory."""
    path = tmp_path / f"v_1024x1024x96_{dtype}.raw"
    with open(path, "wb") as file:
        file.truncate(1024 * 1024 * 96 * np.dtype(dtype).itemsize)
    volume = read_volume(str(path), ReadOptions())
    tracemalloc.start()
    found = statistics(volume)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found.histogram.sum() == volume.data.size
    assert peak < 16 * 8 * stats_module.SLAB_VOXELS < volume.data.nbytes * 4
    assert peak < 100 * 2**20
