"""Analytic volumes against their formulas, and as ``example:`` sources."""

import math

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, Volume, read_volume, shapes

ALL = [shapes.marschner_lobb, shapes.blob, shapes.slab, shapes.sphere, shapes.checkerboard, shapes.random_field]


def centres(volume: Volume) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World x, y, z of every voxel centre, each (nz, ny, nx)."""
    axes = [o + s * np.arange(n) for o, s, n in zip(volume.origin, volume.spacing, volume.dims, strict=True)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return x, y, z


@pytest.mark.parametrize("make", ALL)
def test_frame(make) -> None:
    volume = make((12, 8, 10))
    assert volume.dims == (12, 8, 10)
    assert volume.data.dtype == np.float32
    assert volume.data.flags.c_contiguous
    assert max(volume.extent) == pytest.approx(2)
    np.testing.assert_allclose(volume.unit_frame().centre, 0, atol=1e-12)
    assert volume.unit_frame().scale == pytest.approx(1)
    np.testing.assert_array_equal(volume.data, make((12, 8, 10)).data)


def test_marschner_lobb() -> None:
    volume = shapes.marschner_lobb(40)
    x, y, z = centres(volume)
    rho = np.cos(2 * math.pi * 6 * np.cos(math.pi * np.sqrt(x**2 + y**2) / 2))
    np.testing.assert_allclose(volume.data, (1 - np.sin(math.pi * z / 2) + 0.25 * (1 + rho)) / (2 * 1.25), atol=1e-6)
    assert volume.data.min() >= 0
    assert volume.data.max() <= 1


def test_blob_integral() -> None:
    volume = shapes.blob(48, sigma=0.2)
    x, y, z = centres(volume)
    np.testing.assert_allclose(volume.data, np.exp(-(x**2 + y**2 + z**2) / (2 * 0.2**2)), rtol=1e-5)
    total = volume.data.sum(dtype=np.float64) * math.prod(volume.spacing)
    assert total == pytest.approx((2 * math.pi * 0.2**2) ** 1.5, rel=1e-4)


@pytest.mark.parametrize("thickness", [0.01, 0.3, 1.0, 1.97])
def test_slab_has_its_thickness(thickness: float) -> None:
    volume = shapes.slab((6, 6, 31), thickness, value=3.0)
    columns = volume.data.sum(axis=0, dtype=np.float64) * volume.spacing[2]
    np.testing.assert_allclose(columns, 3.0 * thickness, rtol=1e-5)


@pytest.mark.parametrize(("hard", "tolerance"), [(False, 1e-3), (True, 2e-2)])
def test_sphere_has_its_volume(hard: bool, tolerance: float) -> None:
    volume = shapes.sphere(48, 0.7, hard=hard)
    total = volume.data.sum(dtype=np.float64) * math.prod(volume.spacing)
    assert total == pytest.approx(4 / 3 * math.pi * 0.7**3, rel=tolerance)
    assert set(np.unique(volume.data)) == {0, 1} or not hard
    assert volume.data[24, 24, 24] == 1
    assert volume.data[0, 0, 0] == 0


def test_checkerboard() -> None:
    data = shapes.checkerboard(8, cells=8).data
    assert data.sum() == 256
    for axis in range(3):
        assert np.all(np.diff(data, axis=axis) != 0)
    coarse = shapes.checkerboard(8, cells=2).data
    np.testing.assert_array_equal(coarse, np.kron(data[:2, :2, :2], np.ones((4, 4, 4))))


def test_random_field_is_band_limited_and_seeded() -> None:
    volume = shapes.random_field(32, cycles=5, seed=1)
    assert (volume.data.min(), volume.data.max()) == (0, 1)
    power = np.abs(np.fft.fftn(volume.data.astype(np.float64)))
    k = np.fft.fftfreq(32) * 32
    radius = np.sqrt(k[:, None, None] ** 2 + k[None, :, None] ** 2 + k[None, None, :] ** 2)
    assert power[radius > 5.01].max() < 1e-5 * power[(radius > 0) & (radius < 5)].max()
    assert np.abs(volume.data - shapes.random_field(32, cycles=5, seed=2).data).max() > 0.1


@pytest.mark.parametrize("name", ["marschner-lobb", "blob", "slab", "sphere", "checkerboard", "random"])
def test_example_sources(name: str) -> None:
    assert read_volume(f"example:{name}").name == name
    assert read_volume(f"example:{name}:12").dims == (12, 12, 12)
    volume = read_volume(f"example:{name}:12x8x10", ReadOptions(spacing=(1, 2, 3)))
    assert (volume.dims, volume.spacing) == ((12, 8, 10), (1, 2, 3))


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        ("example:bolb", ReadOptions(), "no such example; expected one of blob, channels, checkerboard, frog"),
        ("example:blob:big", ReadOptions(), "expected a size"),
        ("example:blob", ReadOptions(dims=(2, 2, 2)), "leave out --dims"),
        ("example:blob", ReadOptions(array="a"), "omit --array"),
        ("example:frog", ReadOptions(array="a"), "no array 'a'; it has MetaImage"),
    ],
)
def test_example_errors(source: str, options: ReadOptions, message: str) -> None:
    refused(UsageError, message, read_volume, source, options)


def test_a_size_beyond_memory_is_refused() -> None:
    refused(DataError, "of memory", read_volume, "example:blob:999999")
