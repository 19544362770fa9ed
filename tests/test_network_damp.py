"""Steps are halved as long as that lowers the error of views."""

from dataclasses import replace

import numpy as np
import pytest
from network_models import as_rows, scene

from vvgt_cli.network.prepare import damped, interpolate, pack, unpack
from vvgt_cli.splat import render


@pytest.fixture(scope="module")
def case():
    """Gaussians, cameras, their own pictures, and the Gaussians with colours that are 0.2 too dark."""
    gaussians, cameras, _ = scene(count=60, views=4, size=32)
    gaussians = unpack(pack(gaussians))
    views = np.stack([render(gaussians, camera) for camera in cameras])
    return gaussians, cameras, views, replace(gaussians, colors=np.maximum(gaussians.colors - 0.2, 0))


@pytest.mark.parametrize(("far", "share"), [(1.0, 1.0), (2.0, 0.5), (4.2, 0.25), (1e4, 0.0), (-1.0, 0.0)])
def test_the_share_is_the_power_of_two_that_fits(case, far, share):
    gaussians, cameras, views, dark = case
    end = replace(dark, colors=dark.colors + np.float32(far) * (gaussians.colors - dark.colors))
    found, taken = damped(dark, end, cameras, views)
    assert taken == share
    if share:
        assert np.allclose(found.colors, gaussians.colors, atol=0.02)
    else:
        assert found is dark


def test_between_is_the_start_the_end_and_a_rotation_on_the_way():
    start, _, _ = scene(count=20)
    start = unpack(pack(start))
    end, _, _ = scene(count=20, seed=1)
    end = unpack(pack(end))
    assert np.allclose(as_rows(interpolate(start, end, 0.0)), as_rows(start), atol=1e-6)
    assert np.allclose(as_rows(interpolate(start, end, 1.0)), as_rows(end), atol=1e-6)
    half = interpolate(start, end, 0.5)
    assert np.allclose(np.linalg.norm(half.quaternions, axis=1), 1, atol=1e-6)
    assert np.allclose(half.means, (start.means + end.means) / 2, atol=1e-6)
