"""Refinement region by region: pictures of parts, levels and large clouds, and what their bytes depend on."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli
from tests.processes import replaced
from tests.test_scale import bodies
from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.commands.main import run
from vvgt_cli.conversion.parts import PartTask, Refiner, refine_part
from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.dvr import RenderSettings, render_view
from vvgt_cli.dvr.render import BoxFrame
from vvgt_cli.dvr.scene import Scene, kernel_rule
from vvgt_cli.field.part import VolumePart
from vvgt_cli.field.reader import Scalars, VolumeOrigin
from vvgt_cli.field.settings import BlockOptions, worker_count
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.formats import read_splats
from vvgt_cli.images.metrics import psnr
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.refine import OptimizeOptions, OptimizeRecord, optimize
from vvgt_cli.splat import render
from vvgt_cli.volume import ReadOptions

FIT = ("--max-gaussians", "2400", "--screen", "100", "--up", "z", "-q")
STEPS = ("--steps", "24")
SINGLE = RenderSettings(step=1.0, samples=1)


@pytest.fixture(scope="module")
def volume(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("regions") / "v_100x90x80_uint8.raw"
    path.write_bytes(np.round(bodies() * 255).astype(np.uint8).tobytes())
    return path


@pytest.fixture(scope="module")
def folder(volume: Path) -> Path:
    out = volume.parent / "out"
    assert run(["convert", str(volume), *FIT, *STEPS, "--blocks", "64", "-o", str(out / "lod-meta.json")]) == 0
    return out


@pytest.fixture(scope="module")
def closed(volume: Path) -> Path:
    """Levels of the closed form."""
    out = volume.parent / "closed"
    assert run(["init", str(volume), *FIT, "-o", str(out / "lod-meta.json")]) == 0
    return out


def files_in(folder: Path) -> dict[Path, bytes]:
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def moved(camera: Camera, part: VolumePart) -> Camera:
    """The same camera in the frame of a part."""
    eye = (camera.position - part.centre) * part.scale
    return replace(camera, translation=-camera.rotation @ eye)


def parts_of(path: Path, light: str | None, *edges: tuple[int, int]) -> tuple[list[VolumePart], Scene]:
    """Parts between ``edges`` along x, and the scene of the volume."""
    source = load(SourceRequest(str(path), light=LightOptions(lights=() if light is None else (light,))))
    scene, dims = source.scene(), source.volume.dims
    reader = Scalars(VolumeOrigin(str(path), ReadOptions()), kernel_rule(source.volume, lambda: (0, 255)), scene.optics)
    frame = BoxFrame(scene.half, scene.step)
    made = [
        VolumePart(reader, frame, dims, np.array([a, 0, 0]), np.array([b, *dims[1:]]), scene.light) for a, b in edges
    ]
    return made, scene


@pytest.mark.parametrize("light", [None, "headlight"])
def test_pictures_of_parts_compose_to_that_of_the_volume(volume: Path, light: str | None) -> None:
    (left, right), scene = parts_of(volume, light, (0, 43), (43, 100))
    settings = RenderSettings(samples=1)  # one ray: means of products are not products of means
    for camera in default_views("test", size=90)[:3]:
        front, back = (left, right) if camera.position[0] < left.centre[0] else (right, left)
        first, second = (part.view(moved(camera, part), settings) for part in (front, back))
        if not left.centre[0] < camera.position[0] < right.centre[0]:
            whole = render_view(scene, camera, settings)
            assert whole[..., 3].max() > 0.5
            np.testing.assert_allclose(first + (1 - first[..., 3:]) * second, whole, atol=3e-4)


def test_a_part_is_shown_through_what_lies_before_it(volume: Path) -> None:
    (near, far), _ = parts_of(volume, None, (30, 46), (46, 100))
    camera = next(c for c in default_views("train", size=60) if c.position[0] < -2)
    before = near.view(moved(camera, near), SINGLE)[..., 3]
    shown = far.shown(moved(camera, far))
    behind = far.view(moved(camera, far), SINGLE)[..., 3] > 0.01
    assert behind.any()
    assert before[behind].max() > 0.5
    apart = np.abs(shown[behind] - (1 - before[behind]))  # bricks of the two begin elsewhere
    assert apart.max() < 0.1  # a pixel; which one depends on the processor
    assert apart.mean() < 1e-3


def test_a_box_that_nothing_hides_is_shown_whole(volume: Path) -> None:
    (whole,), _ = parts_of(volume, None, (0, 100))
    assert (whole.shown(default_views("train", size=64)[0]) == 1).all()


def test_errors_count_less_where_the_place_of_a_cut_face_decides(volume: Path) -> None:
    (whole, part), _ = parts_of(volume, None, (0, 100), (30, 60))
    camera = next(c for c in default_views("train", size=90) if abs(c.position[0]) < 0.5)  # along the faces
    assert (whole.weights(camera, 0.1) == 1).all()
    weights, shown = part.weights(camera, 0.05), part.shown(camera)
    assert (weights <= shown).all()
    decided = np.abs(part.view(camera, SINGLE, grown=1.0) - part.view(camera, SINGLE, grown=-1.0)).max(axis=2)
    assert (weights[decided > 0.9] < 0.2).all()
    assert (decided > 0.9).any()
    assert (weights[decided == 0] == shown[decided == 0]).mean() > 0.9


@pytest.mark.parametrize("way", ["train", "check"])
def test_descent_on_a_part_weighs_both_kinds_of_views(volume: Path, monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    (part,), _ = parts_of(volume, None, (30, 60))
    monkeypatch.setattr(VolumePart, "weights", lambda self, camera, width: np.full((camera.height,) * 2, 0.25, "f4"))
    seen = dict[str, object]()

    def spied(*args: object, check: tuple, weights: list, **_: object) -> tuple:
        seen.update(train=weights, check=check[3])
        return args[0], OptimizeRecord(psnr_before=1.0)

    monkeypatch.setattr("vvgt_cli.conversion.stages.refinement.optimize", spied)
    refine_part(part, part.moved_out(ball()), Refiner(None, None, FitOptions(screen=150, steps=4)))
    assert all((weight == 0.25).all() for weight in seen[way])


def ball(count: int = 200) -> Gaussians:
    rng = np.random.default_rng(3)
    turned = np.tile([1.0, 0, 0, 0], (count, 1))
    return Gaussians(
        rng.uniform(-0.6, 0.6, (count, 3)), np.full((count, 3), -2.5), turned, np.zeros(count), rng.random((count, 3))
    )


def test_errors_without_weight_change_neither_rates_nor_scores() -> None:
    start, cameras = ball(), default_views("train", size=64)
    images = np.stack([0.9 * render(start, camera) for camera in cameras])  # near, so that rates are not at their limit
    wrong, half = images.copy(), np.zeros((64, 64), np.float32)
    half[:32], wrong[:, 32:] = 1, 1
    weights, options = [half] * len(cameras), OptimizeOptions(steps=6)
    found = [optimize(start, cameras, views, options, (cameras, views, None, weights), weights=weights)
             for views in (images, wrong)]  # fmt: skip
    assert found[0][1].checks[-1][2] > found[0][1].psnr_before + 0.1
    assert [look[2] for look in found[0][1].checks] == [look[2] for look in found[1][1].checks]
    assert (found[0][0].opacity_logits == found[1][0].opacity_logits).all()


def scores(path: Path, *files: Path | str) -> list[float]:
    """Mean PSNR (dB) of files of one volume in three views that nothing is fitted to."""
    scene, cameras = load(SourceRequest(str(path))).scene(), default_views("test", size=150)[:3]
    views = [render_view(scene, camera)[..., :3] for camera in cameras]
    return [
        float(np.mean([
            psnr(view, render(vvgt_cli.read_ply(str(file))[0], camera)[..., :3])
            for view, camera in zip(views, cameras, strict=True)
        ]))
        for file in files
    ]  # fmt: skip


def test_every_level_is_nearer_to_the_volume_than_the_closed_form(volume: Path, folder: Path, closed: Path) -> None:
    before, after = (json.loads((place / "lod-meta.json").read_text()) for place in (closed, folder))
    assert after["counts"] == before["counts"]
    assert len(after["counts"]) >= 2
    for level in range(2):
        old, new = scores(volume, f"{closed}#{level}", f"{folder}#{level}")
        assert new > old + 1, level
    for node in after["tree"]["children"]:
        assert node["errors"][0] == 0 <= node["errors"][1]
    errors = [node["errors"] for node in after["tree"]["children"]]
    assert errors != [node["errors"] for node in before["tree"]["children"]]


@pytest.mark.parametrize("how", [("--steps", "0"), ("--target-psnr", "5")])
def test_levels_without_steps_or_at_their_target_are_the_closed_form(vvgt, volume, closed, tmp_path, how) -> None:
    vvgt.ok("convert", volume, *FIT, *how, "-o", tmp_path / "lod-meta.json")
    first, second = files_in(tmp_path), files_in(closed)
    assert len(first) == len(second) > 4
    changed = {path for path in first if first[path] != second.get(path)}
    assert changed == {Path("lod-meta.json")}  # one has a certificate


@pytest.mark.parametrize("scheduler", [(), pytest.param(("--scheduler", "local"), marks=pytest.mark.long)])
def test_bytes_depend_on_neither_blocks_nor_workers(vvgt, volume, folder, tmp_path, scheduler) -> None:
    if scheduler:
        pytest.importorskip("distributed")
    line = ("convert", volume, *FIT, *STEPS, "-o", tmp_path / "out" / "lod-meta.json", "--blocks", "32")
    vvgt.ok(*line, "--workers", "2", *scheduler)
    assert files_in(tmp_path / "out") == files_in(folder)


def test_an_interrupted_refinement_goes_on_where_it_ended(vvgt, volume, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("vvgt_cli.conversion.cut.ENOUGH", 1)  # the tiles are regions
    fit = replaced(FIT, "--max-gaussians", "1000")
    line = ("convert", volume, *fit, "--steps", "2", "--blocks", "64", "-o", tmp_path / "out" / "lod-meta.json")
    vvgt.ok(*line[:-1], tmp_path / "whole" / "lod-meta.json")
    call, seen = PartTask.__call__, list[int]()

    def stopped(task: PartTask, number: int) -> None:
        if task.refiner is not None:
            seen.append(number)
            if len(seen) == 2:
                raise KeyboardInterrupt
        call(task, number)

    monkeypatch.setattr(PartTask, "__call__", stopped)
    assert vvgt(*line).code == 130
    assert not (tmp_path / "out" / "lod-meta.json").exists()
    vvgt.ok(*line)
    assert seen.count(seen[0]) == 1  # what was complete is not computed again
    assert files_in(tmp_path / "out") == files_in(tmp_path / "whole")
    assert not list(tmp_path.glob(".*"))


def test_large_clouds_are_refined_by_regions_lit_in_other_formats(vvgt, volume, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("vvgt_cli.conversion.request.MANY", 2000)
    vvgt.ok("init", volume, *FIT, "-o", tmp_path / "closed.ply")
    for name, options in (("a.ply", STEPS), ("b.spz", ("--steps", "2", "--light", "headlight"))):
        found = vvgt.ok("convert", volume, *FIT[:-1], "--blocks", "64", *options, "-o", tmp_path / name)
        assert "refined part by part" in found.err
        made, closed = (read_splats(str(tmp_path / file))[0] for file in (name, "closed.ply"))
        assert len(made) == pytest.approx(len(closed), rel=0.03)  # those that no viewer draws are left out
        assert read_splats(str(tmp_path / name))[1].certificate is not None
    old, new = scores(volume, tmp_path / "closed.ply", tmp_path / "a.ply")
    assert new > old + 1
    planned = vvgt.ok("convert", volume, *FIT, *STEPS, "--blocks 64 --dry-run -o", tmp_path / "c.ply").out.decode()
    assert "parts, " in planned
    assert not list(tmp_path.glob(".*"))


def test_workers_are_as_many_as_threads_memory_and_work_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    small, large = 720_000, 1024**3
    monkeypatch.setattr("vvgt_cli.field.settings.free_memory", lambda: 5 << 30)
    assert worker_count(BlockOptions(), small, 100_000, 8) == 1
    assert worker_count(BlockOptions(), small, 4_000_000, 8) == 5
    assert worker_count(BlockOptions(), small, 4_000_000, 2) == 2
    assert worker_count(BlockOptions(workers=3), small, 100, 1) == 3
    assert worker_count(BlockOptions(shard=(1, 2)), small, 4_000_000, 8) == 1
    assert worker_count(BlockOptions(), large, 100, 4) == 4


def test_results_of_another_number_of_steps_are_not_taken(vvgt, volume: Path, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(folder, out)
    line = ("convert", volume, *FIT, "--steps", "2", "-o", out / "lod-meta.json", "--overwrite")
    vvgt.ok(*line)
    assert files_in(out) != files_in(folder)


def test_regions_without_gaussians_are_written_lit_and_not(vvgt, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("vvgt_cli.conversion.cut.LARGEST", 1)
    z, y, x = np.mgrid[:160, :60, :60]
    balls = sum((np.hypot(np.hypot(x - 30, y - 30), z - at) < 14) * 200 for at in (24, 80, 136))
    np.save(tmp_path / "v.npy", balls.astype(np.uint8))
    fit = ("--tf", "viridis", "--screen", "100", "--max-gaussians", "1", "--blocks", "64", "-q")
    for light in ("none", "headlight"):
        vvgt.ok("init", tmp_path / "v.npy", *fit, "--light", light, "-o", tmp_path / f"{light}.ply")
        assert len(read_splats(str(tmp_path / f"{light}.ply"))[0]) == 1


def test_a_part_whose_faces_move_is_seen_as_a_part_of_that_size(volume: Path) -> None:
    (part, larger, smaller), _ = parts_of(volume, None, (30, 60), (26, 64), (33, 57))
    for camera in default_views("test", size=60)[:3]:
        for other, grown in ((larger, 4.0), (smaller, -3.0)):
            ours, theirs = (
                made.view(moved(camera, made), SINGLE, grown=by) for made, by in ((part, grown), (other, 0.0))
            )
            assert theirs[..., 3].max() > 0.5
            assert np.abs(ours - theirs).mean() < 1e-4  # bricks of the two begin elsewhere
        assert not part.view(moved(camera, part), SINGLE, grown=-15.0).any()
