"""napari: layers saved through its own File > Save, by the manifest of the package."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli
from tests.refused import refused
from tests.test_integrations_slicer import heaviest
from tests.vtk_scenes import camera_at, psnr
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.gaussians import read_ply
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.splat import render

ROOT = Path(__file__).parents[1]
MANIFEST = ROOT / "vvgt_cli" / "integrations" / "napari.yaml"
POINT = (9, 7, 5)  # index z, y, x
PLACE = {"scale": (2, 1, 0.5), "rotate": (10, 20, 30), "translate": (100, -20, 7), "units": ("um", "um", "um")}


def test_the_package_names_the_manifest() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    package, _, file = project["entry-points"]["napari.manifest"]["vvgt"].partition(":")
    assert ROOT.joinpath(*package.split("."), file) == MANIFEST


@pytest.fixture(scope="module")
def viewer():
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    pytest.importorskip("napari", reason="no napari: pip install napari PySide6 beside vvgt")
    from napari.components import ViewerModel  # all of the viewer but its window, which needs OpenGL

    npe2 = pytest.importorskip("npe2")
    npe2.PluginManager.instance().register(npe2.PluginManifest.from_file(MANIFEST))
    return ViewerModel()


def point(*shift: int) -> np.ndarray:
    values = np.zeros((20, 18, 16), np.float32)
    values[tuple(np.add(POINT, shift or 0))] = 90
    return values


def saved(viewer, path: Path) -> Path:
    viewer.layers.selection.clear()
    try:
        assert viewer.layers.save(str(path), plugin="vvgt")
    finally:
        viewer.layers.clear()
    return path


def at(layer, *shift: int) -> np.ndarray:
    """Where napari has the point, in the order x, y, z."""
    return np.array(layer.data_to_world(np.add(POINT, shift or 0)))[::-1]


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:Non-orthogonal slicing")
def test_an_image_keeps_its_place_unit_and_colours(viewer, tmp_path) -> None:
    layer = viewer.add_image(point(), name="GFP", contrast_limits=(10, 90), gamma=0.7, colormap="magma", **PLACE)
    world, middle = at(layer), layer.colormap.map(np.array([0.5**0.7]))[0]
    header = read_ply(saved(viewer, tmp_path / "a.splats.ply"))[1]
    assert heaviest(tmp_path / "a.splats.ply") == pytest.approx(world, abs=0.01)
    assert header.length_unit == "um"
    assert header.function == "GFP"
    x, opacity, colour = min(json.loads(header.legend)["nodes"], key=lambda node: abs(node[0] - 50))
    assert x == pytest.approx(50, abs=2.6)
    assert opacity == pytest.approx(((x - 10) / 80) ** 0.7, abs=0.02)
    assert [int(colour[k : k + 2], 16) for k in (0, 2, 4)] == pytest.approx(255 * middle[:3], abs=16)


@pytest.mark.long
def test_axes_of_different_units_are_one(viewer, tmp_path) -> None:
    viewer.add_image(point(), contrast_limits=(0, 90), scale=(2, 1, 500), units=("um", "um", "nm"))
    header = read_ply(saved(viewer, tmp_path / "a.splats.ply"))[1]
    assert header.length_unit == "nm"
    assert np.reshape(header.affine, (3, 4))[:, :3] == pytest.approx(np.diag([500, 1000, 2000]))


@pytest.mark.long
def test_channels_and_labels_are_drawn_together(viewer, tmp_path) -> None:
    labels = np.zeros((20, 18, 16), np.uint8)
    labels[2:5, 3:8, 4:9], labels[12:15, 3:8, 4:9] = 1, 2
    names = {"index": [0, 1, 2], "name": ["background", "nucleus, upper", "vacuole"]}
    only = viewer.add_labels(labels, features=names, opacity=1)
    colors = [only.get_color(k)[:3] for k in (1, 2)]
    legend = json.loads(read_ply(saved(viewer, tmp_path / "l.splats.ply"))[1].legend)
    assert [name for name, _ in legend["labels"]] == ["nucleus, upper", "vacuole"]
    found = [[int(text[k : k + 2], 16) / 255 for k in (0, 2, 4)] for _, text in legend["labels"]]
    assert np.array(found) == pytest.approx(np.array(colors), abs=0.01)
    viewer.add_image(point(), name="red", contrast_limits=(0, 90), colormap="red")
    viewer.add_image(point(0, 8, 0), name="green", contrast_limits=(0, 90), colormap="green")
    viewer.add_image(np.full((20, 18, 16), 90.0), name="hidden", visible=False)
    viewer.add_labels(labels, features=names)
    header = read_ply(saved(viewer, tmp_path / "c.splats.ply"))[1]
    assert [word in header.function for word in ("red", "green", "labels", "hidden")] == [True, True, True, False]
    assert json.loads(header.legend)["labels"][:2] == legend["labels"]


@pytest.mark.long
def test_a_first_axis_is_time(viewer, tmp_path) -> None:
    pytest.importorskip("dask.array")
    import dask.array

    steps = dask.array.from_array(np.stack([point(), point(3, 0, 2)]), chunks=(1, 20, 18, 16))
    layer = viewer.add_image(steps, contrast_limits=(0, 90), scale=(1, 2, 1, 0.5), translate=(0, 5, 6, 7))
    places = [np.array(layer.data_to_world((k, *np.add(POINT, shift))))[:0:-1] for k, shift in ((0, 0), (1, (3, 0, 2)))]
    saved(viewer, tmp_path / "t.splats.ply")
    longer = viewer.add_image(np.zeros((3, 4, 4, 4), np.float32))
    refused(vvgt_cli.UsageError, "time axes differ", saved, viewer, tmp_path / "u.ply")
    viewer.layers.remove(longer)
    for k, place in enumerate(places):
        assert heaviest(tmp_path / f"t.splats_{k:04d}.ply") == pytest.approx(place, abs=0.01)
    viewer.add_image(steps, contrast_limits=(0, 90))
    page = saved(viewer, tmp_path / "t.html").read_text("utf-8")
    assert page.count('id="live-') + page.count('id="splats-') >= 2


@pytest.mark.long
def test_what_napari_draws_otherwise_is_named_once(viewer, tmp_path, recwarn) -> None:
    from napari.utils import Colormap

    plane = {"position": (5, 5, 5), "normal": (1, 0, 0), "enabled": True}
    look = {"rendering": "attenuated_mip", "interpolation3d": "nearest", "depiction": "plane"}
    viewer.add_image(point(), name="a", contrast_limits=(0, 90), experimental_clipping_planes=[plane], **look)
    viewer.add_image(point(), name="b", contrast_limits=(0, 90), rendering="translucent", gamma=0.5)
    clear = {
        "colormap": Colormap([[0, 0, 0, 0], [1, 1, 1, 0.5]]),
        "rendering": "translucent",
        "opacity": 0.5,
        "scale": (2, 1, 1),
    }
    viewer.add_image(point(), name="c", contrast_limits=(0, 90), blending="additive", **clear)
    saved(viewer, tmp_path / "a.splats.ply")
    said = [str(one.message) for one in recwarn if "not taken" in str(one.message)]
    assert said == [
        "not taken from the layers: a: rendering attenuated_mip (translucent instead), nearest-neighbour interpolation "
        "(linear instead), one plane (all instead), clipping planes; c: blending additive (mixed by depth instead), "
        "the layer's opacity of a whole pixel (of each sample instead), opacity by voxels, which are uneven (by length "
        "instead)"
    ]


@pytest.mark.long
def test_what_cannot_be_saved_says_why(viewer, tmp_path) -> None:
    viewer.add_image(np.zeros((8, 8, 3), np.uint8), rgb=True, name="photo")
    refused(vvgt_cli.UsageError, "photo: an RGB image; expected z, y, x", saved, viewer, tmp_path / "a.html")
    viewer.add_image(point(), visible=False)
    refused(vvgt_cli.UsageError, "no visible layer", saved, viewer, tmp_path / "a.html")


@pytest.mark.long
def test_layers_apart_are_whole_and_unlit(viewer, tmp_path) -> None:
    """Whichever is first: a label map, whose look alone would be lit."""
    labels = np.zeros((20, 18, 16), np.uint8)
    labels[2:5, 3:8, 4:9] = 1
    viewer.add_labels(labels, opacity=1)
    world = at(viewer.add_image(point(), name="far", contrast_limits=(0, 90), translate=(0, 0, 40)))
    gaussians, header = read_ply(saved(viewer, tmp_path / "a.splats.ply"))
    assert (np.linalg.norm(gaussians.means / header.scale + header.centre - world, axis=1) < 2).any()
    assert header.light is None


@pytest.mark.long
def test_the_picture_is_naparis_own(viewer, display, tmp_path) -> None:
    """Of a colour map with opacity of its own; napari shows depth the other way round, and its window says so."""
    words = [sys.executable, ROOT / "tests" / "napari_scene.py", tmp_path]
    more = {"DISPLAY": display, "QT_QPA_PLATFORM": "xcb", "PYTHONPATH": str(ROOT), "HOME": str(tmp_path)}
    done = subprocess.run(words, env=os.environ | more, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    facts, theirs = json.loads((tmp_path / "facts.json").read_text()), np.load(tmp_path / "napari.npy")
    gaussians, header = open_gaussians(str(tmp_path / "a.splats.ply"))
    camera = camera_at(facts["eye"], facts["at"], facts["up"], facts["angle"], header, len(theirs))
    found = psnr(render(gaussians, camera, INRIA)[:, ::-1], theirs)
    print(f"napari's translucent rendering against our Gaussians: {found:.1f} dB")
    assert found > 40
    assert header.affine is not None
    assert np.reshape(header.affine, (3, 4)) @ (14, 22, 17, 1) == pytest.approx(facts["at"], abs=0.01)
    (said,) = facts["said"]
    assert said.startswith("napari's 3D view is a mirror image of x, y, z")
