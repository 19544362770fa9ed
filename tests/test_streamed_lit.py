"""Light on what is written batch by batch: streamed levels and merged shards, against the closed form in memory."""

from pathlib import Path

import numpy as np
import pytest

from tests.test_scale import bodies
from vvgt_cli.closed_form.columns import COLUMNS, MASS, SEEN
from vvgt_cli.closed_form.lit import base_rows
from vvgt_cli.conversion.cut import cut_of
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.blocked import Pass
from vvgt_cli.field.runners import Runner
from vvgt_cli.gaussians import Gaussians, read_ply
from vvgt_cli.gaussians.formats import read_splats
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run

FIT = ("--max-gaussians", "9000", "--screen", "150", "--up", "z", "-q")
LIGHTS = {
    "head": ("--light", "headlight"),
    "fixed": ("--light", "1,0.3,2"),
}


@pytest.fixture(scope="module")
def volume(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lit") / "v_100x90x80_uint8.raw"
    path.write_bytes(np.round(bodies() * 255).astype(np.uint8).tobytes())
    return path


def nearest(found: Gaussians, expected: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Rows of ``found`` for every 20th that is expected, and those; of pairs that are at one place."""
    rows = np.arange(0, len(expected), 20)
    apart = [np.linalg.norm(found.means - expected.means[k], axis=1) for k in rows]
    near = np.array([distance.argmin() for distance in apart])
    same = np.array([distance.min() for distance in apart]) < 1e-3
    assert same.mean() > 0.9
    return near[same], rows[same]


@pytest.mark.parametrize("light", [pytest.param("head", marks=pytest.mark.long), "fixed"])
def test_levels_are_lit_as_the_closed_form_in_memory(vvgt, volume: Path, tmp_path: Path, light: str) -> None:
    out = tmp_path / "out" / "lod-meta.json"
    vvgt.ok("init", volume, *FIT, *LIGHTS[light], "--blocks", "32", "-o", out)
    vvgt.ok("init", volume, *FIT, *LIGHTS[light], "-o", tmp_path / "a.ply")
    (found, header), (expected, told) = read_splats(out), read_ply(tmp_path / "a.ply")
    assert header.light == told.light
    assert found.degree == expected.degree == 2
    ours, theirs = nearest(found, expected)
    colors = np.abs(found.colors[ours] - expected.colors[theirs])
    assert np.median(colors) < 0.01
    assert np.quantile(colors, 0.95) < 0.06
    assert np.abs(expected.harmonics).mean() > 0.01
    assert np.median(np.abs(found.harmonics[ours] - expected.harmonics[theirs])) < 0.01


def test_merged_shards_have_the_bytes_of_one_run(vvgt, tmp_path: Path) -> None:
    volume, lit = tmp_path / "v_64x48x60_uint8.raw", LIGHTS["fixed"]
    volume.write_bytes(np.round(bodies((64, 48, 60)) * 255).astype(np.uint8).tobytes())
    for blocks in ("32", "64"):
        vvgt.ok("init", volume, *FIT, *lit, "--blocks", blocks, "-o", tmp_path / f"{blocks}.ply")
    for _ in range(2):
        for shard in ("1/2", "2/2"):
            line = ("init", volume, *FIT, *lit, "--blocks", "32", "--shard", shard, "-o", tmp_path / "parts")
            vvgt.ok(*line)
    before = sorted(path.name for path in (tmp_path / "parts").iterdir())
    vvgt.ok("merge", tmp_path / "parts", "-q", "-o", tmp_path / "merged.ply")
    vvgt.ok("merge", tmp_path / "parts", "-q", "-o", tmp_path / "m" / "lod-meta.json")
    vvgt.ok("init", volume, *FIT, *lit, "-o", tmp_path / "c" / "lod-meta.json")
    one, *others = ((tmp_path / name).read_bytes() for name in ("32.ply", "64.ply", "merged.ply"))
    assert all(other == one for other in others)
    files = [{p.relative_to(f): p.read_bytes() for p in f.rglob("*.*")} for f in (tmp_path / "m", tmp_path / "c")]
    assert files[0] == files[1]
    assert sorted(path.name for path in (tmp_path / "parts").iterdir()) == before
    run_pass = Pass(Runner(), BlockStore(tmp_path / "parts"), lambda _: None)
    pyramid = cut_of(Run(Console(quiet=True), ConversionReport("merge")), run_pass).pyramid
    top, root = pyramid.top, pyramid.leaves_over_tiles(np.finfo(float).max)
    assert root is not None
    first, last = base_rows(top, np.array([len(top) - 1]))
    count = len(pyramid)
    assert (first[0], last[0]) == (0, count)
    tiles = [cuts[0].moments[0] for cuts in pyramid.cuts(0, count, np.full((count, 1), np.finfo(float).max))]
    seen = np.array([row[SEEN] for row in tiles])
    np.testing.assert_allclose(root.moments[0, : MASS + 1], np.sum([row[: MASS + 1] for row in tiles], axis=0))
    np.testing.assert_allclose(
        root.moments[0, COLUMNS:], np.average([row[COLUMNS:] for row in tiles], axis=0, weights=seen)
    )


def test_normals_of_a_merged_file_point_along_the_gradient(vvgt, volume: Path, tmp_path: Path) -> None:
    vvgt.ok("init", volume, *FIT, *LIGHTS["head"], "-o", tmp_path / "a.ply")
    vvgt.ok("init", volume, *FIT, *LIGHTS["head"], "--blocks", "32", "-o", tmp_path / "b.ply")
    normals, clouds = [], []
    for name in ("a.ply", "b.ply"):
        content = (tmp_path / name).read_bytes()
        clouds.append(read_ply(tmp_path / name)[0])
        rows = np.frombuffer(content[-len(clouds[-1]) * (17 + 24) * 4 :], "<f4").reshape(len(clouds[-1]), -1)
        normals.append(rows[:, 3:6])
    ours, theirs = nearest(clouds[1], clouds[0])
    assert np.median((normals[1][ours] * normals[0][theirs]).sum(axis=1)) > 0.97


def test_a_damaged_light_is_reported(vvgt, volume: Path, tmp_path: Path) -> None:
    line = ("init", volume, *FIT, *LIGHTS["head"], "--blocks", "64", "--shard", "1/1", "-o", tmp_path / "parts")
    vvgt.ok(*line)
    (tmp_path / "parts" / "light.npz").write_bytes(b"PK")
    assert "light.npz: damaged" in vvgt.fails(1, "merge", tmp_path / "parts", "-o", tmp_path / "a.ply")
