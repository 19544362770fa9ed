"""The accessor of xarray: what `vvgt_cli.convert` does, on the array; registered by an import alone."""

import numpy as np
import pytest

import vvgt_cli
import vvgt_cli.integrations.xarray
from tests.processes import python

xarray = pytest.importorskip("xarray")

GOAL = {"max_gaussians": 100, "screen": 32, "steps": 0}


def array():
    t, z, y, x = np.indices((2, 12, 10, 8)).astype(np.float32)
    at = {"time": [0, 1], "z": 2.0 * np.arange(12), "y": np.arange(10) - 3.0, "x": 0.5 * np.arange(8)}
    return xarray.DataArray(x + y * (1 + t) + z, dims=("time", "z", "y", "x"), coords=at, name="rho")


def test_it_converts_as_the_library_does() -> None:
    step = array().isel(time=1)
    ours, same = step.vvgt.convert("viridis", **GOAL), vvgt_cli.convert(step, "viridis", **GOAL)
    np.testing.assert_array_equal(ours.gaussians.means, same.gaussians.means)
    assert ours.ply.centre == (1.75, 1.5, 11.0)  # by the coordinates
    later = array().vvgt.convert("viridis", **GOAL, time=1)
    np.testing.assert_array_equal(later.gaussians.means, same.gaussians.means)
    with pytest.raises(vvgt_cli.UsageError, match="rho: 2 time steps"):
        array().vvgt.convert("viridis", **GOAL)
    assert array().vvgt.session(time=0).volume.dims == (8, 10, 12)


def test_the_library_alone_registers_nothing() -> None:
    code = "import numpy, xarray, vvgt_cli; vvgt_cli.convert; print(hasattr(xarray.DataArray(numpy.zeros(3)), 'vvgt'))"
    assert python("-c", code)[0].strip() == "False"
