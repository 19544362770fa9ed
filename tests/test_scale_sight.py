"""What a file of blocks is scored against: rays through the volume itself, put together block after block."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from vvgt_cli.scale.sight import CHECK, SUFFIX, TEST, TRAIN, Box, Sight, looks, marched, meeting, segments

from tests.test_scale import FIT, bodies
from vvgt_cli.dvr import RenderSettings, render_view
from vvgt_cli.dvr.render import FIT_VIEWS, camera_arrays
from vvgt_cli.field.grid import Boxes, CellGrid
from vvgt_cli.field.parts import CELLS, Parts
from vvgt_cli.gaussians import read_ply
from vvgt_cli.metrics import score_views
from vvgt_cli.runs.source import SourceRequest, load
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume

EVERY_RAY = RenderSettings(tiers=((-1.0, 5),))
SETTINGS = {TEST: EVERY_RAY, CHECK: EVERY_RAY, TRAIN: FIT_VIEWS}
NAMES, TWO = ("blocks", "start", "memory"), ("128", "memory")
EARLY = 2.6e-4  # a ray in memory ends at this transmittance; in blocks each part of it does


def through_blocks(tmp_path, scene, edge, sight):
    """Every look of a scene with its pixels, from blocks of ``edge`` voxels."""
    parts = Parts(tmp_path / f"parts{edge}")
    (parts.folder / CELLS).mkdir(parents=True)
    grid = CellGrid(Boxes(scene.volume.dims, (edge,) * 3), (0, 0, 0), tuple(scene.half), tuple(scene.step), 2, 0, 0)
    for number in range(len(grid.blocks)):
        lo, hi = grid.blocks.at(number)
        begin, end = np.maximum(lo - 1, 0), np.minimum(hi + 1, grid.dims)
        block = tuple(slice(a, b) for a, b in zip(begin[::-1], end[::-1], strict=True))
        values = np.ascontiguousarray(scene.values[block])
        values.flags.writeable = False
        parts.save(CELLS, number, SUFFIX, **segments(values, begin, number, grid, scene.tables, sight))
    return [found for kind in (TEST, CHECK, TRAIN) for found in marched(parts, grid, sight, kind)]


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.6, 1.0, 2.1)])
def test_parts_of_rays_compose_to_the_rays_of_the_renderer(tmp_path, spacing):
    values = np.round(bodies((70, 61, 50)) * 255).astype(np.uint8)
    scene = load(SourceRequest(Volume(values, spacing))).scene()
    sight = Sight(620, check=True, train=2, edge=40)
    assert looks(sight)[0].blocks is not None
    assert [look.kind for look in looks(sight)] == [TEST] * 3 + [CHECK] * 4 + [TRAIN] * 2
    whole = [look.of(render_view(scene, look.camera, SETTINGS[look.kind], look.blocks)) for look in looks(sight)]
    assert all((image[..., 3] > 0.5).mean() > 0.1 for image in whole)
    for edge, tolerance in ((128, 2e-6), (32, EARLY), (17, EARLY)):
        found = through_blocks(tmp_path, scene, edge, sight)
        assert len(found) == len(whole)
        for (look, ours), theirs in zip(found, whole, strict=True):
            assert ours.shape == theirs.shape
            assert np.abs(ours - theirs).max() <= tolerance * (4 if look.kind == TRAIN else 1)  # by step squared


def test_a_block_casts_the_rays_that_may_meet_it_and_no_others(tmp_path, monkeypatch):
    values = np.round(bodies((70, 61, 50)) * 255).astype(np.uint8)
    scene = load(SourceRequest(Volume(values, (0.6, 1.0, 2.1)))).scene()
    sight, counts = Sight(150, check=True, train=12, edge=40), []

    def counted(*args):
        counts.append(len(meeting(*args)))
        return meeting(*args)

    monkeypatch.setattr("vvgt_cli.scale.sight.meeting", counted)
    few = through_blocks(tmp_path / "few", scene, 16, sight)
    monkeypatch.setattr("vvgt_cli.scale.sight.meeting", lambda look, *rest: np.arange(len(look.pixels)))
    every = through_blocks(tmp_path / "every", scene, 16, sight)
    assert all(np.array_equal(one, other) for (_, one), (_, other) in zip(few, every, strict=True))
    assert any((image[..., 3] > 0.5).any() for _, image in every)
    pixels = sum(len(look.pixels) for look in looks(sight))
    assert sum(counts) < 0.1 * pixels * len(counts) / len(looks(sight))


def test_a_camera_within_a_block_casts_all_its_rays():
    look = looks(Sight(150))[0]
    eye, basis, lens = camera_arrays(Box(np.ones(3), np.full(3, 0.02)), look.camera)
    assert len(meeting(look, eye, basis, lens, eye - 5, eye + 5)) == len(look.pixels)
    assert 0 < len(meeting(look, eye, basis, lens, np.zeros(3), np.full(3, 9.0))) < len(look.pixels) / 4


def test_init_in_blocks_says_its_error_against_the_volume(vvgt, tmp_path):
    path = tmp_path / "v_100x90x80_uint8.raw"
    path.write_bytes(np.round(bodies() * 255).astype(np.uint8).tobytes())
    notes = []
    for blocks in ("32", "128"):
        run = vvgt("init", path, "-o", tmp_path / f"{blocks}.ply", *FIT[:-1], "--blocks", blocks, "--report", "-")
        assert run.code == 0
        notes.append(re.search(r"PSNR ([\d.]+) dB .* pixels of 3 views of 150 px", run.err))
        scores = json.loads(run.out)["scores"]
        assert f"{scores['psnr']:.2f}" == notes[-1][1]
    assert notes[0][1] == notes[1][1]
    scene = load(SourceRequest(str(path))).scene()
    seen = looks(Sight(150))
    whole = [look.of(render_view(scene, look.camera, EVERY_RAY)) for look in seen]
    gaussians = read_ply(tmp_path / "32.ply")[0]
    theirs = score_views(whole, [look.of(render(gaussians, look.camera)) for look in seen], perceptual=False)
    assert theirs.psnr == pytest.approx(scores["psnr"], abs=0.01)


def test_a_file_that_no_memory_draws_is_written_without_a_score(vvgt, tmp_path, monkeypatch):
    path = tmp_path / "v_100x90x80_uint8.raw"
    path.write_bytes(np.round(bodies() * 255).astype(np.uint8).tobytes())
    assert vvgt("init", path, "-o", tmp_path / "a.ply", *FIT, "--blocks", "64").code == 0
    monkeypatch.setattr("vvgt_cli.scale.sight.A_GAUSSIAN", 1 << 40)
    run = vvgt("init", path, "-o", tmp_path / "b.ply", *FIT[:-1], "--blocks", "64")
    assert run.code == 0
    assert "left out: test views" in run.err
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_convert_in_blocks_fits_to_views_of_the_volume_itself(vvgt, tmp_path, monkeypatch):
    path = tmp_path / "v_100x90x80_uint8.raw"
    path.write_bytes(np.round(bodies() * 255).astype(np.uint8).tobytes())
    fit = (*FIT[:-1], "--steps", "48", "--report")
    with monkeypatch.context() as patch:  # in blocks the cells are those of the moments
        patch.setattr("vvgt_cli.vbm.cut_by_error", lambda start, *_: start.gaussians)
        memory = vvgt("convert", path, "-o", tmp_path / "memory.ply", *fit, tmp_path / "memory.json")
    assert memory.code == 0
    start = vvgt(
        "init", path, "-o", tmp_path / "start.ply", *FIT, "--blocks", "32", "--report", tmp_path / "start.json"
    )
    assert start.code == 0
    files = []
    for size, more in (("32", ()), ("32", ("--workers", "2")), ("128", ())):
        out, report = tmp_path / f"{size}.ply", tmp_path / "blocks.json"
        run = vvgt("convert", path, "-o", out, *fit, report, "--blocks", size, *more, "--overwrite")
        assert run.code == 0, run.err
        assert "left out: seats" in run.err
        files.append(out.read_bytes())
    assert files[0] == files[1]
    psnr = {name: json.loads((tmp_path / f"{name}.json").read_text())["scores"]["psnr"] for name in NAMES}
    assert psnr["blocks"] > psnr["start"] + 1
    assert psnr["blocks"] == pytest.approx(psnr["memory"], abs=0.5)
    assert list(tmp_path.glob(".*blocks")) == []
    ours, theirs = (vvgt("evaluate", tmp_path / f"{name}.ply", "--volume", path, "--json", "-q") for name in TWO)
    ours, theirs = (json.loads(run.out)["scores"]["psnr"] for run in (ours, theirs))
    assert ours == pytest.approx(theirs, abs=0.8)  # one ray a pixel here, adaptive rays in memory


def test_what_a_conversion_in_blocks_cannot_do_is_a_line(vvgt, tmp_path):
    path = tmp_path / "v_100x90x80_uint8.raw"
    path.write_bytes(bytes(720000))
    for options, word in (
        (("--time-budget", "5"), "--time-budget"),
        (("--checkpoint", tmp_path / "c"), "kept as it is"),
        (("--preview", tmp_path / "p.png"), "--preview"),
        (("--dry-run",), "leave out --dry-run"),
        (("--light", "headlight"), "lit by nothing"),
    ):
        run = vvgt("convert", path, "-o", tmp_path / "a.ply", *FIT, "--blocks", "32", *options)
        assert run.code == 2, options
        assert word in run.err


@pytest.mark.parametrize(
    ("mib", "advice"), [(800, r"--max-gaussians [1-9]\d* would fit"), (300, "give the job more memory")]
)
def test_more_gaussians_than_fit_are_refused_before_anything_is_read(vvgt, tmp_path, monkeypatch, mib, advice):
    path = tmp_path / "v_100x90x80_uint8.raw"
    path.write_bytes(bytes(720000))
    monkeypatch.setattr("vvgt_cli.scale.convert.free_memory", lambda: mib << 20)
    run = vvgt(
        "convert", path, "-o", tmp_path / "a.ply", "--max-gaussians", "1000000", "--size", "150", "--blocks", "32"
    )
    assert run.code == 2
    assert re.search(rf"1000000 Gaussians need about 1\.2 GiB.*{advice}.*vvgt init", run.error)
    assert not list(tmp_path.glob(".*blocks"))


def test_levels_are_cuts_of_one_pyramid_with_an_index(vvgt, tmp_path):
    path = tmp_path / "v_100x90x80_uint8.raw"
    path.write_bytes(np.round(bodies() * 255).astype(np.uint8).tobytes())
    out = tmp_path / "a.ply"
    assert vvgt("init", path, "-o", out, *FIT, "--levels", "3").code == 0
    index = json.loads((tmp_path / "a-levels.json").read_text())
    assert (index["format"], index["size"]) == ("vvgt-levels", 150)
    assert [level["file"] for level in index["levels"]] == ["a.ply", "a-1.ply", "a-2.ply"]
    counts = [len(read_ply(tmp_path / level["file"])[0]) for level in index["levels"]]
    assert counts == [level["gaussians"] for level in index["levels"]]
    assert counts[0] / 4 * 0.9 < counts[1] <= counts[0] / 4
    assert [(tmp_path / level["file"]).stat().st_size for level in index["levels"]] == [
        level["bytes"] for level in index["levels"]
    ]
    psnr = [level["psnr"] for level in index["levels"]]
    assert psnr[0] > psnr[1] > psnr[2] > psnr[0] - 20
    alone = ("--max-gaussians", str(counts[0] // 4), "--size", "150", "-q", "--blocks", "32")
    folder = tmp_path / "v.blocks"
    assert vvgt("init", path, "-o", folder, *FIT, "--shard", "1/1", "--blocks", "32").code == 0
    assert vvgt("merge", folder, "-o", tmp_path / "m.ply", "--levels", "3", "-q").code == 0
    for level in ("", "-1", "-2"):
        assert (tmp_path / f"m{level}.ply").read_bytes() == (tmp_path / f"a{level}.ply").read_bytes()
    again = vvgt("init", path, "-o", tmp_path / "b.ply", *alone)
    assert again.code == 0
    assert len(read_ply(tmp_path / "b.ply")[0]) == pytest.approx(counts[1], rel=0.1)
    assert vvgt("init", path, "-o", out, *FIT, "--levels", "3").code == 2  # they exist
    assert vvgt("init", path, "-o", "-", *FIT, "--levels", "3").code == 2
    assert vvgt("init", path, "-o", folder, *FIT, "--levels", "3", "--shard", "1/2").code == 2
