"""How VTK shades, beside us."""

import numpy as np
import pytest

from tests.vtk_views import drawn_by_vtk
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.volume import Volume

SLANTED = (0.6, -0.48, 0.64)
BY_VTK = """
import sys
import numpy as np
from tests.test_light_vtk import both, long_box, STEP, distant
from vvgt_cli.dvr.vtk import view_renderer
found = {}
for name in ("stretched", "mended"):
    found[name] = view_renderer(long_box(), STEP, mended=name == "mended")(distant())
for name, scene in both().items():
    found[name] = view_renderer(scene, STEP)(distant())
np.savez(sys.argv[1], **found)
"""
STEP = RenderSettings(step=0.25, samples=1)
NODES = np.array([0.3, 0.5, 1.2])
SHELL = TransferFunction(
    "t", PiecewiseOpacity(NODES, np.array([0, 0.9, 0.9])), ColorMap(NODES, np.array([[1, 0.5, 0.2]] * 3))
)


def distant():
    return look_at((22.0, -16.0, 11.0), width=384, height=384, fov=4)


def smooth_ball(long=1):
    """A ball with a soft edge: values far from zero gradients where it is seen; the box is ``long`` times as high."""
    z, y, x = np.meshgrid(np.linspace(-long, long, 32 * long), *[np.linspace(-1, 1, 32)] * 2, indexing="ij")
    return Scene.build(Volume((1.2 - np.sqrt(x * x + y * y + z * z)).astype(np.float32)), SHELL, 1.0)


def both():
    ball = smooth_ball()
    fixed = Lighting(False, (SLANTED,), 0, 0.9, 0)
    return {"headlight": ball.lit(Lighting()), "fixed": ball.lit(fixed)}


def long_box():
    return smooth_ball(2).lit(Lighting(False, (SLANTED,), 0, 0.9, 0))


@pytest.fixture(scope="module")
def from_vtk(tmp_path_factory):
    return drawn_by_vtk(BY_VTK, tmp_path_factory.mktemp("vtk"))


@pytest.mark.parametrize("name", ["headlight", "fixed"])
def test_vtk_shades_alike(from_vtk, name):
    ours = render_view(both()[name], distant(), STEP)
    seen = ours[..., 3] > 0.01
    assert seen.mean() > 0.2
    assert decibels(from_vtk[name], ours, seen) > 39.5


def decibels(theirs, ours, seen):
    a, b = (np.round(255 * np.clip(i[..., :3], 0, 1)) / 255 for i in (theirs, ours))
    return -10 * np.log10(np.mean((a - b)[seen] ** 2))


def test_vtk_stretches_normals_along_the_screen_where_the_box_is_no_cube(from_vtk):
    ours = render_view(long_box(), distant(), STEP)
    seen = ours[..., 3] > 0.01
    assert decibels(from_vtk["stretched"], ours, seen) < 25
    assert decibels(from_vtk["mended"], ours, seen) > 40
