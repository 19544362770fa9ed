"""A field that tells every axis and every spacing apart: 1 + 2 x + 30 y + 500 z at world positions."""

import numpy as np

from vvgt_cli.volume import Volume

X = 0.5 + 0.25 * np.arange(5)
Y = -3.0 + 0.5 * np.arange(4)
Z = 10.0 + 2.0 * np.arange(3)


def ramp(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Values on the grid of three axes, (nz, ny, nx) float64."""
    return 1 + 2 * x[None, None, :] + 30 * y[None, :, None] + 500 * z[:, None, None]


def axes_of(volume: Volume) -> list[np.ndarray]:
    """Positions of the voxel centres along x, y and z."""
    return [o + s * np.arange(n) for o, s, n in zip(volume.origin, volume.spacing, volume.dims, strict=True)]


def check_ramp(volume: Volume, atol: float = 1e-6) -> None:
    """The volume's data values are the ramp at its own voxel centres (NaN is let pass)."""
    values = volume.data * volume.slope + volume.intercept
    inside = np.isfinite(values)
    assert inside.any()
    np.testing.assert_allclose(values[inside], ramp(*axes_of(volume))[inside], rtol=1e-5, atol=atol)


def check_grid(volume: Volume, atol: float = 1e-6) -> None:
    """The volume is the ramp on X, Y and Z."""
    for got, expected in zip(axes_of(volume), (X, Y, Z), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-6)
    check_ramp(volume, atol)
