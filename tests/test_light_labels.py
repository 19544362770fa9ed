"""Normals of label maps under light: without the steps of voxels, in memory and in blocks."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.test_field_rays import in_blocks, labels_of
from tests.test_grid import Named, camera
from vvgt_cli.closed_form.lit import at_points
from vvgt_cli.dvr import RenderSettings, Scene, render_view, render_view_reference
from vvgt_cli.dvr.reference import normals
from vvgt_cli.dvr.relief import smoothed
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.look.lighting import Lighting, LightOptions
from vvgt_cli.volume import Volume

FINE, EVEN = RenderSettings(step=0.0625, samples=1), RenderSettings(samples=2)


def lit(extinction: np.ndarray, spacing: tuple[float, float, float] = (1.0, 1.0, 1.0), labels: bool = True) -> Scene:
    """A white scene under a headlight, of extinction (nz, ny, nx) per world length."""
    grid = np.repeat(extinction[..., None].astype(np.float32), 4, axis=-1)
    return Scene.of_grid(Volume(grid[..., 3], spacing), Named(), 1.0, grid, Lighting(), labels)


def ball(radius: float, spacing: tuple[float, float, float], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Voxels of a ball (1) in a box, and its middle in voxels (x, y, z)."""
    dims = [int(2 * (radius / edge + 5)) + 1 for edge in spacing]
    middle = (np.array(dims) - 1) / 2 + np.random.default_rng(seed).uniform(-0.5, 0.5, 3)
    z, y, x = np.indices(dims[::-1])
    away = [(n - c) * edge for n, c, edge in zip((x, y, z), middle, spacing, strict=True)]
    return np.linalg.norm(away, axis=0) < radius, middle


def degrees_off(scene: Scene, radius: float, middle: np.ndarray, spacing: tuple[float, float, float]) -> np.ndarray:
    """Angles between normals and the radius, where a ball's surface is."""
    rng = np.random.default_rng(1)
    out = rng.normal(size=(3000, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    points = middle + out * (radius + rng.uniform(-0.7, 0.3, (3000, 1))) / spacing
    return np.degrees(np.arccos(np.clip(-(normals(scene, points) * out).sum(axis=1), -1, 1)))


@pytest.mark.parametrize(
    ("radius", "spacing", "mean", "most"),
    [(3, (1, 1, 1), 4.7, 12), (10, (1, 1, 1), 3.3, 15), (30, (1, 1, 1), 3.2, 19), (14, (1, 1, 2), 4.5, 28)],
)
def test_normals_of_a_ball_point_along_its_radius(radius, spacing, mean, most) -> None:
    for seed in range(3):
        inside, middle = ball(radius, spacing, seed)
        ours = degrees_off(lit(inside, spacing), radius, middle, spacing)
        steps = degrees_off(lit(inside, spacing, labels=False), radius, middle, spacing)
        assert ours.mean() < min(mean, steps.mean() / 2.5)
        assert ours.max() < min(most, steps.max())


def test_sums_are_over_the_voxels_around() -> None:
    values = np.random.default_rng(0).random((11, 5, 3)).astype(np.float32)
    wide, expected = np.pad(values.astype(np.float64), 1, mode="edge"), np.zeros(values.shape)
    for k, j, i in itertools.product(range(3), repeat=3):
        expected += wide[k : k + 11, j : j + 5, i : i + 3]
    np.testing.assert_allclose(smoothed(values), expected, rtol=1e-6)
    assert np.unique(smoothed(np.full((3, 20, 4), 0.1, np.float32))).size == 1


def test_pictures_are_the_twins() -> None:
    rng = np.random.default_rng(3)
    labels = rng.choice([0.0, 0.3, 2.0], (4, 5, 6)).repeat(2, 0).repeat(2, 1).repeat(2, 2)
    scene = lit(labels, (1.0, 1.3, 0.7))
    ours, twin = render_view(scene, camera(12, 12), FINE), render_view_reference(scene, camera(12, 12), step=1 / 32)
    rough = render_view(lit(labels, (1.0, 1.3, 0.7), labels=False), camera(12, 12), FINE)
    assert np.abs(ours - twin).mean() < 2e-3 < 5e-3 < np.abs(ours - rough)[..., :3].mean()
    points = rng.uniform(-0.4, [11.4, 9.4, 7.4], (200, 3))
    found = at_points(scene, (points + 0.5) * scene.step - scene.half)
    np.testing.assert_allclose(found[:, :3], normals(scene, points), atol=2e-5)
    rough = at_points(replace(scene, relief=None), (points + 0.5) * scene.step - scene.half)
    np.testing.assert_array_equal(found[:, 3], rough[:, 3])


@pytest.mark.parametrize("shape", ["plate", "rod", "voxel"])
def test_what_is_one_voxel_thick_keeps_its_light(shape: str) -> None:
    z, y, x = np.indices((20, 20, 20))
    there = {"plate": z == 10, "rod": (z == 10) & (y == 10), "voxel": (z == 10) & (y == 10) & (x == 10)}[shape]
    ours, rough = (render_view(lit(20.0 * there, labels=labels), camera(32, 32), EVEN) for labels in (True, False))
    assert np.isfinite(ours).all()
    np.testing.assert_allclose(ours[..., 3], rough[..., 3], atol=1e-6)
    assert ours[..., :3].sum() > 0.97 * rough[..., :3].sum() > 0


def test_a_slanted_plate_has_the_light_of_its_slant() -> None:
    """A voxel thick, seen at a grazing angle: its steps are a sixth brighter."""
    z, y, x = np.indices((20, 20, 20))
    plate, view = 20.0 * (np.abs(x + 2 * y + 3 * z - 60) < 2), camera(32, 32)
    red, *_, alpha = render_view(lit(plate), view, EVEN).sum(axis=(0, 1))
    facing = abs(float(view.rotation[2] @ [1, 2, 3])) / 14**0.5
    assert abs(red / alpha - (0.1 + 0.7 * facing)) < 0.015


def test_boxes_and_points_of_blocks_have_the_normals_of_memory(tmp_path: Path) -> None:
    request = SourceRequest(labels_of((30, 21, 26)), labels="auto")
    scene, rng = load(request).scene(), np.random.default_rng(0)
    points = rng.uniform(-1, 1, (300, 3)) * scene.half
    with in_blocks(request, 16, tmp_path) as field:
        for _ in range(20):
            lo = rng.integers(0, [29, 20, 25])
            hi = np.minimum(lo + rng.integers(1, 20, 3), [30, 21, 26])
            box = field.reader.box(lo, hi)
            here = tuple(slice(a, b) for a, b in zip(lo[::-1], hi[::-1], strict=True))
            np.testing.assert_array_equal(box.relief, scene.relief[here])
            np.testing.assert_array_equal(box.values, scene.values[here])
        np.testing.assert_allclose(field._normals_and_extinction(points), at_points(scene, points), rtol=1e-12)


def test_only_labels_under_light_are_smoothed(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.arange(120, dtype=np.uint8).reshape(4, 5, 6))
    lights = LightOptions(lights=("headlight",)), LightOptions(lights=("none",))
    for labels, light in itertools.product(("auto", "none"), lights):
        scene = load(SourceRequest(str(tmp_path / "a.npy"), labels=labels, light=light)).scene()
        assert (scene.relief is not None) == (labels == "auto" and light == lights[0])
