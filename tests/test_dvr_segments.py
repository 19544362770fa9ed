"""Kernels beside the renderer's: parts of rays within blocks, and layers on another grid."""

import numpy as np

from tests.test_dvr_render import Function
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.dvr import Scene
from vvgt_cli.dvr.layout import BRICK
from vvgt_cli.dvr.march import cast_segments
from vvgt_cli.dvr.place import place
from vvgt_cli.dvr.render import camera_arrays
from vvgt_cli.volume import Volume


def test_rays_along_an_axis_belong_to_one_block():
    """Of blocks side by side, one casts the whole ray that runs along an axis, whichever side its face is on."""
    scene = Scene.build(
        Volume(np.random.default_rng(0).random((8, 8, 8), np.float32)), Function([0, 1], [0.1, 0.4]), 0.2
    )
    optics, pixels, middle = scene.optics, np.array([[2, 2]]), np.zeros((1, 2))
    empty = np.zeros(tuple(-(-n // BRICK) for n in scene.values.shape), np.uint8)
    for axis in range(3):
        eye = np.array([0.03, -0.05, 0.04])
        target = eye.copy()
        eye[axis], target[axis] = 3.0, 0.0
        up = np.roll([0.0, 0.0, 1.0], axis + 1)
        camera = camera_arrays(scene, look_at(eye, target=target, up=up, width=5, height=5))

        def cast(lower, upper, camera=camera):
            faces, seen = np.array([lower, upper, [8.0, 8.0, 8.0]]), np.zeros((1, 1, 4), np.float32)
            cast_segments(
                scene.voxels, optics, None, empty, None, faces, np.zeros(3), *camera, 0.5, pixels, middle, seen
            )
            return seen[0, 0]

        whole = cast([-np.inf] * 3, [np.inf] * 3)
        assert 0.1 < whole[3] < 1
        for across in {0, 1, 2} - {axis}:
            place = camera[0][across]
            for face, sides in ((place - 0.5, (0, 1)), (place + 0.5, (1, 0)), (place, (0, 1))):
                lower, upper = np.full((2, 3), -np.inf), np.full((2, 3), np.inf)
                upper[0, across] = lower[1, across] = face
                for side, share in enumerate(sides):
                    np.testing.assert_array_equal(cast(lower[side], upper[side]), share * whole)


def test_a_linear_field_is_placed_exactly_and_added() -> None:
    z, y, x = np.indices((5, 6, 7), float)
    values = np.stack([1 + 2 * x + 3 * y + 5 * z, 7 - x], axis=-1)
    matrix = np.array([[0.0, 0.5, 0.2, 5.0], [0.7, 0.0, 0.1, 3.0], [0.1, 0.3, 0.0, 0.5]])
    dims, none = np.array([7, 6, 5]), np.zeros(3, np.int64)
    out = np.full((3, 4, 4, 2), 10.0)
    place(values, matrix, none, none, dims, np.zeros(3), 100.0, out)
    lo, first = np.array([1, 2, 1]), np.array([4, 0, 0])  # a part of the target from a part of the layer
    part = np.full((2, 2, 3, 2), 10.0)
    place(np.ascontiguousarray(values[:, :, 4:]), matrix, lo, first, dims, np.zeros(3), 100.0, part)
    np.testing.assert_array_equal(part, out[1:3, 2:4, 1:4])
    k, j, i = np.indices(out.shape[:3])
    x, y, z = np.einsum("rc,ckji->rkji", matrix, np.stack([i, j, k, np.ones_like(i)]))
    inside = (y <= 5.5) & (x <= 6.5) & (z <= 4.5)
    assert 0 < inside.sum() < inside.size
    x, y = np.minimum(x, 6), np.minimum(y, 5)  # in the rim of half a voxel the edge's
    expected = np.stack([1 + 2 * x + 3 * y + 5 * z, 7 - x], axis=-1)
    np.testing.assert_allclose(out, 10 + np.where(inside[..., None], expected, 100), rtol=1e-6)
