"""Pictures of a volume in blocks: rays cut at pieces of it compose to those of the renderer, whatever the blocks."""

import json
import re
from contextlib import contextmanager

import numpy as np
import pytest

from tests.test_scale import FIT, bodies
from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.blocks import spread_blocks
from vvgt_cli.closed_form import VbmOptions
from vvgt_cli.conversion.stages.parts import cast_views
from vvgt_cli.dvr import RenderSettings, render_view
from vvgt_cli.dvr.render import FIT_VIEWS, BoxFrame, camera_arrays
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.field import Picture
from vvgt_cli.field.grid import Boxes, piece_edge
from vvgt_cli.field.layered import OpenedFile
from vvgt_cli.field.open import FieldNeeds, blocked
from vvgt_cli.field.rays import Bundle, front_to_back, meeting, pieces_of
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import read_ply
from vvgt_cli.images.metrics import score_views
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume

ENDS = np.array([0.0, 120.0, 121.0, 255.0])
STEEP = TransferFunction("step", PiecewiseOpacity(ENDS, np.array([0.0, 0, 1, 1])), ColorMap(ENDS, np.ones((4, 3))))
LIT = LightOptions(lights=("1,1,2", "headlight"), diffuse=0.5)


def volume_of(dims, spacing=(1.0, 1.0, 1.0)):
    return Volume(np.round(bodies(dims) * 255).astype(np.uint8), spacing, name="bodies")


def labels_of(dims):
    body = bodies(dims)
    return Volume(((body > 0.2).astype(np.uint8) + (body > 0.6)).astype(np.uint8), name="labels")


@contextmanager
def in_blocks(request, edge, folder, workers=1):
    """The field of a request in blocks of ``edge`` voxels."""
    run = Run(Console(quiet=True), ConversionReport("convert"))
    with blocked(run, request, BlockOptions(edge, workers), BlockStore(folder), FieldNeeds(500, 64)) as field:
        yield field


def views():
    """One as judged by, one to fit to, one of blocks of pixels."""
    judged, fitted = default_views("test", size=96), default_views("train", 4, size=40)
    wide = default_views("check", size=640)[1]
    return [
        Picture(judged[0], RenderSettings()), Picture(fitted[2], FIT_VIEWS),
        Picture(judged[4], RenderSettings(samples=2)),
        Picture(wide, RenderSettings(), spread_blocks(640, 640, 1, 40)),
    ]  # fmt: skip


KINDS = {
    "scalars": (SourceRequest(volume_of((70, 61, 50))), 3e-3),
    "anisotropic": (SourceRequest(volume_of((70, 61, 50), (0.6, 1.0, 2.1))), 3e-3),
    "steep": (SourceRequest(volume_of((70, 61, 50)), tf=STEEP), 3e-3),
    "lit": (SourceRequest(volume_of((50, 61, 40)), light=LIT), 3e-3),
    "steep, lit": (SourceRequest(volume_of((50, 61, 40)), tf=STEEP, light=LIT), 3e-3),
    "labels": (SourceRequest(labels_of((50, 61, 40)), labels="auto"), 3e-3),
    "labels, lit": (SourceRequest(labels_of((50, 61, 40)), labels="auto", light=LIT), 3e-3),
    "layers": (
        SourceRequest(
            volume_of((50, 61, 40)), tf=STEEP, light=LIT,
            layers=(SourceRequest(volume_of((25, 30, 20), (2.0, 2.0, 2.0))), SourceRequest(labels_of((50, 61, 40)))),
        ),
        3e-3,
    ),
    "colours": (SourceRequest(OpenedFile(tuple(volume_of((40, 31, 36)) for _ in range(3)), color=True)), 3e-3),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_pictures_of_blocks_are_those_of_the_renderer_and_the_same_for_any_blocks(tmp_path, kind):
    request, tolerance = KINDS[kind]
    scene, found = load(request).scene(), []
    for edge in (16, 32, 128):
        with in_blocks(request, edge, tmp_path / str(edge)) as field:
            field.expect(views())
            found.append([field.view(*view) for view in views()])
    for view, *ours in zip(views(), *found, strict=True):
        theirs = render_view(scene, *view)
        assert (theirs[..., 3] > 0.5).any()
        assert np.array_equal(ours[0], ours[1])
        assert np.array_equal(ours[0], ours[2])
        off, coarse = np.abs(ours[0] - theirs), 4 if view.settings is FIT_VIEWS else 1
        assert off.max() < tolerance * coarse or np.sort(off.ravel())[-40] < tolerance
        assert off.mean() < 1e-4 * coarse  # a coarse ray that grazes a step meets it or not


def test_pictures_that_were_not_expected_are_made_when_they_are_asked_for(tmp_path):
    request = SourceRequest(volume_of((40, 36, 44)))
    camera, settings = default_views("test", size=48)[3], RenderSettings()
    with in_blocks(request, 16, tmp_path / "a") as field:
        field.pyramid(VbmOptions(400, 64))
        late = field.view(camera, settings)
    with in_blocks(request, 16, tmp_path / "b") as field:
        field.expect([Picture(camera, settings), Picture(camera, FIT_VIEWS)])
        field.pyramid(VbmOptions(400, 64))
        assert np.array_equal(field.view(camera, settings), late)
    assert late[..., 3].max() > 0.5


@pytest.mark.parametrize("light", [LightOptions(), LIT], ids=["unlit", "lit"])
@pytest.mark.parametrize("method", ["moments", "wavelet", "uniform"])
def test_the_closed_form_of_blocks_is_that_of_memory(tmp_path, light, method):
    request = SourceRequest(volume_of((40, 36, 44)), light=light)
    source = load(request)
    options = VbmOptions(300, 64, method, degree=2 if source.lighting else 0)
    from vvgt_cli.field.field import Resident

    memory = Resident(source)
    ours = memory.pyramid(options).gaussians
    with in_blocks(request, 16, tmp_path / "parts") as field:
        theirs = field.pyramid(options).gaussians
        assert len(ours) == len(theirs)
        for name, array in ours.arrays().items():
            np.testing.assert_allclose(theirs.arrays()[name], array, atol=1e-5, err_msg=name)
        normals, others = memory.normals(ours), field.normals(ours)
    if source.lighting is None:
        assert normals is None
        assert others is None
    else:
        np.testing.assert_allclose(normals, others, atol=1e-9)
        assert (np.linalg.norm(normals, axis=1) > 0.9).mean() > 0.9


def cast_of(camera, half=1.0, step=0.02):
    eye, basis, lens = camera_arrays(BoxFrame(np.full(3, half), np.full(3, step)), camera)
    rows, columns = np.indices((camera.height, camera.width))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    return Bundle(eye, basis, lens, 0.5, pixels, np.zeros((1, 2)))


def test_a_piece_casts_the_rays_that_may_meet_it_and_no_others(tmp_path, monkeypatch):
    request, counts = SourceRequest(volume_of((70, 61, 50), (0.6, 1.0, 2.1))), []

    def counted(cast, *box):
        found = meeting(cast, *box)
        counts.append(len(found) / len(cast.pixels))
        return found

    pictures = []
    for name, which in (("few", counted), ("every", lambda cast, *_: np.arange(len(cast.pixels)))):
        monkeypatch.setattr("vvgt_cli.field.rays.meeting", which)
        with in_blocks(request, 16, tmp_path / name) as field:
            pictures.append([field.view(*view) for view in views()[:2]])
    assert all(np.array_equal(one, other) for one, other in zip(*pictures, strict=True))
    assert np.mean(counts) < 0.2


def test_a_camera_within_a_piece_casts_all_its_rays():
    cast = cast_of(default_views("test", size=60)[0])
    assert len(meeting(cast, cast.eye - 5, cast.eye + 5)) == len(cast.pixels)
    assert 0 < len(meeting(cast, np.zeros(3), np.full(3, 9.0))) < len(cast.pixels) / 4


def test_pieces_follow_from_the_volume_and_come_front_to_back():
    assert [piece_edge((n, 9, 20)) for n in (40, 128, 129, 256, 257, 1024, 4096)] == [16, 16, 32, 32, 64, 128, 128]
    pieces = pieces_of((64, 48, 40))
    assert pieces == Boxes((64, 48, 40), (16, 16, 16))
    eye = np.array([70.0, 20.0, -9.0])
    order = front_to_back(pieces, eye, range(len(pieces)))
    assert sorted(order) == list(range(len(pieces)))
    ranks = np.empty(len(pieces))
    ranks[order] = np.arange(len(pieces))
    points = eye + np.arange(0, 120, 0.5)[:, None] * np.array([-0.9, 0.1, 0.5])
    inside = points[((points >= -0.5) & (points < np.array(pieces.dims) - 0.5)).all(axis=1)]
    index = np.floor((inside + 0.5) / 16).astype(int)
    met = [ranks[(k * pieces.shape[1] + j) * pieces.shape[0] + i] for i, j, k in index]
    assert met == sorted(met)
    assert len(set(met)) > 3


def test_init_in_blocks_reports_its_error_against_the_volume(vvgt, tmp_path):
    path = tmp_path / "v_100x90x80_uint8.raw"
    path.write_bytes(np.round(bodies() * 255).astype(np.uint8).tobytes())
    notes = []
    for blocks in ("32", "128"):
        run = vvgt.ok("init", path, "-o", tmp_path / f"{blocks}.ply", *FIT[:-1], "--blocks", blocks, "--report", "-")
        notes.append(re.search(r"PSNR ([\d.]+) dB .* 3 views of 150 px, through all voxels", run.err))
        report = json.loads(run.out)
        scores = report["scores"]
        assert f"{scores['psnr']:.2f}" == notes[-1][1]
        assert report["bytes"] == (tmp_path / f"{blocks}.ply").stat().st_size
    assert notes[0][1] == notes[1][1]
    scene, gaussians = load(SourceRequest(str(path))).scene(), read_ply(tmp_path / "32.ply")[0]
    seen = cast_views(150)
    theirs = score_views(
        [render_view(scene, *view) for view in seen],
        [render(gaussians, view.camera) for view in seen],
        perceptual=False,
    )
    assert theirs.psnr == pytest.approx(scores["psnr"], abs=0.02)


def test_a_file_that_no_memory_draws_is_written_without_a_score(vvgt, tmp_path, monkeypatch):
    path = tmp_path / "v_100x90x80_uint8.raw"
    path.write_bytes(np.round(bodies() * 255).astype(np.uint8).tobytes())
    vvgt.ok("init", path, "-o", tmp_path / "a.ply", *FIT, "--blocks", "64")
    monkeypatch.setattr("vvgt_cli.conversion.stages.parts.A_GAUSSIAN", 1 << 40)
    assert "skipped: test views" in vvgt.ok("init", path, "-o", tmp_path / "b.ply", *FIT[:-1], "--blocks", "64").err
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_what_blocks_cannot_do_is_a_line(vvgt, tmp_path):
    path = tmp_path / "v_100x90x80_uint8.raw"
    path.write_bytes(bytes(720000))
    for command, options, word in (
        ("init", ("--shard", "1/2", "--init", "wavelet", "-o", tmp_path / "a"), "folder of blocks"),
        ("render-views", ("--blocks", "32", "--renderer", "vtk", "-o", tmp_path / "v"), "needs the whole volume"),
    ):
        assert word in vvgt.fails(2, command, path, *options)
