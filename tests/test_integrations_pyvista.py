"""`export_plotter`: what a pyvista.Plotter shows, beside PyVista's own picture."""

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vvgt_cli as vvgt
from tests.vtk_scenes import FIELD, INDEX, LUMP, ORIGIN, SIZE, SPACING, lump, places, psnr, seen_by

pyvista = pytest.importorskip("pyvista")
RAMP = [0, 0.1, 0.5, 0.9]
FEW = {"screen": 64, "max_gaussians": 300, "steps": 0}
FINE = {"screen": SIZE, "max_gaussians": 20_000, "steps": 60}


def plotter(*grids: Any, opacity: Any = RAMP, **options: Any) -> Any:
    """An off-screen plotter that looks at the lump of every grid; linear, and with VTK's finest steps."""
    shown = pyvista.Plotter(window_size=(SIZE, SIZE), off_screen=True, lighting="none")
    shown.background_color = "black"
    shown.add_light(pyvista.Light(light_type="headlight"))
    for grid in grids or [pyvista.wrap(lump())]:
        volume = shown.add_volume(grid, cmap="viridis", opacity=opacity, show_scalar_bar=False, mapper="gpu", **options)
        volume.prop.interpolation_type = "linear"
        shown.mapper.SetAutoAdjustSampleDistances(False)
        shown.mapper.SetSampleDistance(0.1)
    middle = np.array(shown.center)
    shown.camera_position = [tuple(middle + np.array([50, -45, 35])), tuple(middle), (0, 0, 1)]
    shown.camera.view_angle = FIELD
    return shown


def test_function_light_and_camera_are_the_plotters(tmp_path: Path) -> None:
    shown = plotter(shade=True, ambient=0.3, specular=0.4, specular_power=5.0)
    result = vvgt.export_plotter(shown, tmp_path / "a.html", **FEW)
    assert result.ply.camera == pytest.approx((*shown.camera.position, *shown.camera.focal_point, FIELD))
    assert result.ply.up == "z"
    assert (result.ply.light.headlight, result.ply.light.ambient, result.ply.light.specular_power) == (True, 0.3, 20)
    assert result.ply.unit_distance == pytest.approx(shown.volume.prop.GetScalarOpacityUnitDistance())
    page = (tmp_path / "a.html").read_text()
    assert json.loads(page.partition('id="scene">')[2].partition("</script>")[0])["outermost"] == []


def test_what_is_not_taken_is_one_warning(tmp_path: Path) -> None:
    shown = plotter()
    shown.add_mesh(pyvista.Sphere())
    shown.volume.prop.interpolation_type = "nearest"
    with pytest.warns(UserWarning, match=r"not taken from the plotter: 1 surface; nearest-neighbour") as heard:
        vvgt.export_plotter(shown, tmp_path / "a.spz", **FEW)
    assert len(heard) == 1
    assert (tmp_path / "a.spz").exists()


def test_a_plotter_without_a_volume_is_refused(tmp_path: Path) -> None:
    empty = pyvista.Plotter(off_screen=True)
    with pytest.raises(vvgt.UsageError, match=r"shows no volume; call plotter.add_volume"):
        vvgt.export_plotter(empty, tmp_path / "a.html")
    unnamed = plotter()
    unnamed.mapper.SetScalarModeToUseCellFieldData()
    unnamed.mapper.SelectScalarArray("other")
    with pytest.raises(vvgt.UsageError, match="ImageData without an array that its mapper draws; expected"):
        vvgt.export_plotter(unnamed, tmp_path / "a.html")
    two = pyvista.wrap(lump())
    two["pair"] = np.ones((two.n_points, 2), np.float32)
    shown = plotter()
    shown.volume.prop.independent_components = False
    two.set_active_scalars("pair")
    shown.mapper.SetInputData(two)
    with pytest.raises(vvgt.UsageError, match="pair: two dependent components"):
        vvgt.export_plotter(shown, tmp_path / "a.html", **FEW)


def test_shading_of_further_volumes_is_named(tmp_path: Path) -> None:
    shown = plotter(pyvista.wrap(lump()), pyvista.wrap(lump()), shade=True, ambient=0.3)
    shown.volume.prop.ambient = 0.6  # of the second
    with pytest.warns(UserWarning, match="plotter: ambient, diffuse, specular and power of other volumes than the"):
        vvgt.export_plotter(shown, tmp_path / "a.ply", **FEW)


def test_volumes_beside_each_other_are_lit_as_the_plotters(tmp_path: Path) -> None:
    """Where none of their boxes holds the others."""
    grid = pyvista.wrap(lump())
    shown = plotter(grid, moved(grid), shade=True, ambient=0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = vvgt.export_plotter(shown, tmp_path / "a.ply", **FEW)
    assert result.ply.light.ambient == 0.3
    assert np.ptp(result.gaussians.means, axis=0).max() > 0.8  # both of them


@pytest.mark.long
def test_a_point_is_where_the_plotter_has_it(tmp_path: Path) -> None:
    """Through origin, spacing, direction and the actor's own place; the Gaussians lie about it."""
    shown = plotter(pyvista.wrap(lump(2.5)), opacity=[0, 0.01, 0.02])
    shown.volume.SetOrientation(10, 20, 30)
    shown.volume.SetPosition(3, -2, 1)
    shown.volume.SetScale(1.5)
    vvgt.export_plotter(shown, tmp_path / "a.ply", **{**FINE, "steps": 0})
    there = shown.volume.GetMatrix().MultiplyPoint((*LUMP, 1))[:3]
    voxel, middle = places(tmp_path / "a.ply")
    assert voxel == pytest.approx(np.array(there), abs=0.001)
    assert middle == pytest.approx(np.array(there), abs=0.05)  # mm, a tenth of a voxel


def moved(grid: Any) -> Any:
    grid = grid.copy()
    grid.origin = np.add(grid.origin, (18, -12, 9))
    return grid


@pytest.mark.long
@pytest.mark.parametrize(
    ("case", "least"),
    [("unlit", 45), ("lit", 44), ("scaled", 44), ("cropped", 34), ("two", 42), ("colours", 45)],
)
def test_beside_pyvistas_own_picture(case: str, least: float, tmp_path: Path) -> None:
    """The same camera; 8 bits a channel are VTK's, and its step of a fifth of a voxel."""
    grid = pyvista.wrap(lump())
    if case == "two":
        shown = plotter(grid, moved(grid))
    elif case == "lit":
        grid.direction_matrix = np.eye(3)  # VTK turns no normals with an oblique image: 34 dB
        shown = plotter(grid, shade=True, specular=0.4, specular_power=10.0)
    elif case == "colours":
        values = np.asarray(grid.active_scalars)
        columns = (255 * values, 80 + 60 * values, 0 * values + 120, 250 * values)
        grid["colours"] = np.stack(columns, axis=1).astype("u1")
        shown = plotter(grid, opacity="linear")
    elif case == "cropped":
        grid.direction_matrix = np.eye(3)
        shown = plotter(grid)
    else:
        shown = plotter(grid)
    if case == "scaled":
        shown.volume.SetScale(1.5)
        shown.volume.SetOrientation(0, 0, 30)
        middle = np.array(shown.volume.GetCenter())
        shown.camera_position = [tuple(middle + np.array([90, -60, 50])), tuple(middle), (0, 0, 1)]
    if case == "cropped":
        middle = np.array(ORIGIN) + np.array(SPACING) * INDEX
        low, high = middle - np.array([2, 8, 8]), middle + np.array([8, 8, 1])
        shown.mapper.SetCropping(True)
        shown.mapper.SetCroppingRegionPlanes(*np.stack([low, high], axis=1).ravel())
        shown.mapper.SetCroppingRegionFlagsToSubVolume()
    theirs = shown.screenshot(return_img=True)
    result = vvgt.export_plotter(shown, tmp_path / "a.ply", **FINE)
    ours = result.render(seen_by(shown.renderer, result.ply, SIZE))
    assert theirs.max() > 60
    found = psnr(ours, theirs)
    print(f"{case}: {found:.1f} dB")
    assert found >= least
