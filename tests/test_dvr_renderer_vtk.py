"""VTK's renderer against the ray caster, and errors of one line."""

from dataclasses import replace

import numpy as np
import pytest

import vvgt_cli as vvgt
from tests.vtk_views import drawn_by_vtk
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.dvr import RenderSettings, Scene, render_views
from vvgt_cli.dvr import vtk as vtk_renderer
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.volume import Volume

FINE = RenderSettings(step=0.25, samples=1)
NODES = np.array([0.0, 0.3, 0.5, 1.0])
COLORS = np.array([[0, 0, 1], [0, 1, 0], [1, 1, 0], [1, 0, 0]], float)


def scene(spacing=(1.0, 1.0, 1.5), bad=False):
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, n) for n in (16, 20, 24)], indexing="ij")
    data = np.exp(-2 * (x * x + 1.5 * y * y + 0.7 * z * z) + 0.4 * np.sin(3 * x + y)).astype(np.float32)
    if bad:
        data[4:6, 8:10, 12] = np.nan
    opacity = PiecewiseOpacity(NODES, np.array([0, 0, 0.6, 0.2]))
    return Scene.build(Volume(data, spacing), TransferFunction("t", opacity, ColorMap(NODES, COLORS)), 1.0)


def view(width=40, height=32, eye=(2.2, -1.6, 1.1)):
    return look_at(eye, width=width, height=height, fov=40)


def test_an_unknown_renderer_is_refused():
    with pytest.raises(UsageError, match="--renderer gpu: expected vvgt or vtk"):
        vvgt.render_views("example:blob:8", renderer="gpu")


def test_a_machine_without_opengl_is_told_so(monkeypatch):
    monkeypatch.setattr(vtk_renderer, "PROBE", "raise SystemExit(3)")
    with pytest.raises(DataError, match="no off-screen OpenGL; install EGL or OSMesa"):
        vtk_renderer.view_renderer(scene())


def test_the_padding_of_vtks_image_lies_around_it():
    padded, image = (np.array(vtk_renderer.image_data(scene(), padded).GetBounds()) for padded in (True, False))
    np.testing.assert_allclose((padded - image)[::2], -scene().step)
    np.testing.assert_allclose((padded - image)[1::2], scene().step)


VTK_VIEWS = """
import sys
import numpy as np
from tests.test_dvr_renderer_vtk import FINE, decentred, scene, view
from vvgt_cli.dvr.vtk import view_renderer
from vvgt_cli.look.lighting import Lighting
draw, lit = (view_renderer(made, FINE) for made in (scene(), scene().lit(Lighting())))
np.savez(sys.argv[1], plain=draw(view()), decentred=draw(decentred()), lit=lit(view()))
"""


def decentred():
    camera = view()
    return replace(camera, cx=camera.cx - 5, cy=camera.cy + 3, fy=camera.fy * 1.2)


@pytest.fixture(scope="module")
def from_vtk(tmp_path_factory):
    return drawn_by_vtk(VTK_VIEWS, tmp_path_factory.mktemp("vtk"))


def decibels(a, b):
    """PSNR of two images in 8 bits."""
    a, b = (np.round(255 * np.clip(i, 0, 1)) / 255 for i in (a, b))
    return -10 * np.log10(np.mean((a - b) ** 2))


@pytest.mark.parametrize(("name", "camera"), [("plain", view()), ("decentred", decentred())])
def test_vtk_agrees_with_the_kernel(from_vtk, name, camera):
    ours = render_views(scene(), [camera], FINE)[0]
    assert from_vtk[name].dtype == np.float32
    assert decibels(from_vtk[name][..., :3], ours[..., :3]) > 45
    assert decibels(from_vtk[name][..., 3], ours[..., 3]) > 45


def test_vtk_lights_only_where_asked(from_vtk):
    assert np.abs(from_vtk["lit"][..., :3] - from_vtk["plain"][..., :3]).max() > 0.1
    np.testing.assert_allclose(from_vtk["lit"][..., 3], from_vtk["plain"][..., 3], atol=0.02)
