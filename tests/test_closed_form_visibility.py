"""The march through cells against rays that are followed in small steps, in float64; cells of any edges."""

import numpy as np
import pytest

from tests.closed_form_scenes import Tent, scene_of
from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form.visibility import DEPTH, WORKERS, march, summed
from vvgt_cli.dvr.render import camera_arrays
from vvgt_cli.volume import Volume

STEPS = 4000
DIMS = np.array([12, 20, 16])  # x, y, z
EDGE = np.array([4.0, 5.0, 2.0])  # voxels of a cell


def lengths(scene, camera):
    """(nz, ny, nx) length of all pixels' rays in each cell, unit-frame lengths, by points along them."""
    half, cells = np.asarray(scene.half, float), (DIMS / EDGE).astype(int)
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    ways = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    ways = (ways @ camera.rotation).reshape(-1, 3)  # R^T d
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    near, far = np.linalg.norm(camera.position) - 1.8, np.linalg.norm(camera.position) + 1.8
    step = (far - near) / STEPS
    found = np.zeros(cells[::-1])
    for t in near + (np.arange(STEPS) + 0.5) * step:
        at = np.floor((camera.position + t * ways + half) / (2 * half) * cells).astype(int)
        i, j, k = at[((at >= 0) & (at < cells)).all(axis=1)].T
        np.add.at(found, (k, j, i), step)
    return found


def test_rays_go_through_the_cells_that_they_meet():
    scene = scene_of(Volume(np.zeros(DIMS[::-1], np.float32), spacing=(1.0, 0.7, 1.3)), Tent())
    faint = np.full((DIMS / EDGE).astype(int)[::-1], 1e-3, np.float32)
    for camera in default_views("test", size=24)[2:9:3]:
        sums = np.zeros((WORKERS, *faint.shape, 3), np.float32)
        eye, basis, lens = camera_arrays(scene, camera)
        march(faint, eye[None], basis[None], lens[None], camera.width, EDGE, sums)
        expected = lengths(scene, camera)
        assert expected.max() > 2 * expected[expected > 0].min()  # no two cells are alike
        np.testing.assert_allclose(sums[..., DEPTH].sum(axis=0) / 1e-3, expected, atol=0.004 * expected.max())


@pytest.mark.parametrize("wider", [0, 1, 3])
def test_sums_by_wider_cells_are_those_of_numpy(wider):
    rng, shape = np.random.default_rng(0), np.array([9, 5, 12])
    index, values = rng.integers(0, shape << wider, (4000, 3)), rng.random((4000, 2))[:, 1]
    exact = np.zeros(shape[::-1])
    np.add.at(exact, tuple((index >> wider).T[::-1]), values)
    np.testing.assert_array_equal(summed(index, values, wider, shape), exact)
