"""Lines, sheets, single voxels and voxels of 1000:1 along every axis: they convert, and they show."""

import numpy as np
import pytest

from tests.closed_form_scenes import Ramp, scene_of
from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.dvr import RenderSettings, render_view
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume

SIZE = 200


def along(axis: int, there: float, elsewhere: float) -> tuple[float, float, float]:
    """A number a axis (x, y, z): ``there`` along one, ``elsewhere`` along the two others."""
    x, y, z = (there if each == axis else elsewhere for each in range(3))
    return x, y, z


CASES = {"a voxel": ((1, 1, 1), (1.0, 1.0, 1.0))}
for axis, name in enumerate("xyz"):
    CASES[f"a line along {name}"] = (along(axis, 500, 1), (1.0, 1.0, 1.0))
    CASES[f"a hair along {name}"] = (along(axis, 1000, 1), (1.0, 1.0, 1.0))
    CASES[f"a sheet across {name}"] = (along(axis, 1, 60), (1.0, 1.0, 1.0))
    CASES[f"long voxels along {name}"] = ((6, 6, 6), along(axis, 1000.0, 1.0))
    CASES[f"flat voxels along {name}"] = ((6, 6, 6), along(axis, 0.001, 1.0))


@pytest.mark.parametrize("case", CASES)
def test_what_is_thin_is_seen(case):
    dims, spacing = CASES[case]
    values = np.linspace(0.6, 1, int(np.prod(dims)), dtype=np.float32).reshape(dims[::-1])
    scene = scene_of(Volume(values, spacing=spacing), Ramp(k=4.0), min(spacing))
    gaussians = initialise(scene, VbmOptions(max_gaussians=500, size=SIZE)).gaussians
    assert len(gaussians)
    for axis in np.flatnonzero(scene.half > 0.1):  # from end to end
        assert np.ptp(gaussians.means[:, axis]) >= 2 * scene.half[axis] * (1 - 2 / dims[axis]) * 0.98
    camera = default_views("test", 3, size=SIZE)[1]
    volume, ours = (
        image[..., 3] for image in (render_view(scene, camera, RenderSettings()), render(gaussians, camera))
    )
    assert ours.max() > 0.02
    shown = np.argwhere(volume > 0.5 * volume.max())
    near = [ours[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].max() for y, x in shown]
    assert np.mean(np.array(near) > 0.01) > 0.9
