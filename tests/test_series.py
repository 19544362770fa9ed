"""`vvgt convert` of a time series: one range for all, resumed by its manifest, in parts."""

import json
import re
import warnings
from pathlib import Path
from types import SimpleNamespace

import nibabel as nib
import numpy as np
import pytest
import pyvista
import tifffile
import xarray
from PIL import Image

import vvgt_cli as library
from tests.headers import uncertified
from tests.processes import replaced
from tests.test_streamed import contents as files_in
from vvgt_cli.commands import main
from vvgt_cli.conversion.convert import convert_one
from vvgt_cli.conversion.frames import merge_statistics
from vvgt_cli.conversion.index import FRAMES, FUNCTIONS, LABELS, frame_facts, is_pattern, put_name
from vvgt_cli.errors import UsageError
from vvgt_cli.field.source import load
from vvgt_cli.gaussians.formats.sog import images_of
from vvgt_cli.gaussians.formats.streamed import read_manifest
from vvgt_cli.score.record import ConversionReport
from vvgt_cli.volume import Volume, statistics
from vvgt_cli.volume.shapes import blob

SMALL = ("--screen", "32", "--max-gaussians", "60", "-q")
TF = {"points": [{"x": 0, "rgb": [0, 0, 1], "opacity": 0}, {"x": 10, "rgb": [1, 0, 0], "opacity": 0.5}]}


@pytest.fixture
def series(tmp_path: Path) -> Path:
    """Four frames of a blob that grows from nothing to ten, named so that text does not sort them."""
    for k, height in enumerate((0.0, 4.0, 7.0, 10.0)):
        field = blob((12, 10, 8))
        np.save(tmp_path / f"run_{k + 8}.npy", (field.data / field.data.max() * height).astype(np.float32))
    (tmp_path / "tf.json").write_text(json.dumps(TF))
    (tmp_path / "out").mkdir()
    return tmp_path


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> list:
    """Write what a frame's function and values come to in place of converting it; returns the calls."""
    calls: list = []

    def write(request, console, finished=None, warm=None) -> SimpleNamespace:
        if request.output is None:
            return convert_one(request, console, warm=warm, finished=finished)
        calls.append(request)
        source = load(request.source)
        text = f"{source.tf.node_range()} {source.statistics.hi:g} {request.fit}"
        for name in filter(None, (request.output, request.report)):
            Path(name).write_text(text)
        return SimpleNamespace(report=ConversionReport("convert"))

    monkeypatch.setattr("vvgt_cli.conversion.convert_batch.convert_one", write)
    return calls


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.ply"))}


def test_frames_are_those_of_single_conversions_and_dark_ones_are_skipped(vvgt, series: Path) -> None:
    out, tf = series / "out" / "f_{:03d}.ply", series / "tf.json"
    done = vvgt.ok("convert", series / "run_*.npy", "--tf", tf, "-o", out, *[a for a in SMALL if a != "-q"])
    assert "values 0 to 10" in done.err
    assert "skipped: run_8.npy (nothing of it is visible)" in done.err
    made = contents(series / "out")
    assert list(made) == ["f_001.ply", "f_002.ply", "f_003.ply"]
    alone = series / "alone.ply"
    vvgt.ok("convert", series / "run_9.npy", "--tf", tf, "-o", alone, *SMALL)
    assert uncertified(alone) == uncertified(made["f_001.ply"])
    vvgt.ok("render", series / "out" / "f_index.json", "--size", 24, "-o", series / "f_{}.png")
    seen = [np.asarray(Image.open(series / f"f_{k}.png"))[..., 3].any() for k in range(4)]
    assert seen == [False, True, True, True]
    (series / "live").mkdir()
    vvgt.ok("convert", series / "run_*.npy", "--tf", tf, "-o", series / "live" / "l_{}.ply", *SMALL, "--live")
    vvgt.ok("render", series / "live" / "l_index.json", "--rule", "mip", "--size", 24, "-o", series / "l.gif")
    with Image.open(series / "l.gif") as movie:
        assert movie.n_frames == 4
        assert np.asarray(movie.convert("L")).max() < 8


@pytest.mark.parametrize("how", [("--tf", "viridis"), ("--tf", "TF", "--tf-range", "rescale"), ()])
def test_one_range_for_all(vvgt, series: Path, stand_in: list, how: tuple) -> None:
    how = tuple(series / "tf.json" if part == "TF" else part for part in how)
    run = ("convert", series / "run_*.npy", "-o", series / "out" / "{:d}.ply", *how, *SMALL)
    vvgt.ok(*run, "--report", series / "out" / "r{:d}.json")
    nodes = [load(request.source).tf.node_range() for request in stand_in]
    assert len(nodes) >= 3
    assert set(nodes) == {nodes[0]}
    assert nodes[0][1] == pytest.approx(10, abs=0.05)
    assert (series / "out" / "r3.json").is_file()


def test_resumed_and_in_parts_it_leaves_the_same_bytes(vvgt, series: Path, stand_in: list) -> None:
    (series / "parts").mkdir()
    common = ("convert", series / "run_*.npy", "--tf", series / "tf.json", *SMALL)
    whole = (*common, "-o", series / "out" / "{:02d}.ply")
    vvgt.ok(*whole)
    made = contents(series / "out")
    for part in ("2/2", "1/2"):
        vvgt.ok(*common, "-o", series / "parts" / "{:02d}.ply", "--shard", part)
    assert contents(series / "parts") == made
    (series / "out" / "02.ply").write_bytes(b"damaged")
    before = (series / "out" / "03.ply").stat().st_mtime_ns
    assert "1 frames converted, 2 were complete before" in vvgt.ok(*[part for part in whole if part != "-q"]).err
    assert contents(series / "out") == made
    assert (series / "out" / "03.ply").stat().st_mtime_ns == before


def test_time_steps_of_one_file(vvgt, series: Path, stand_in: list) -> None:
    frames = np.stack([np.load(series / f"run_{k}.npy") for k in range(8, 12)])
    tifffile.imwrite(series / "cells.ome.tif", frames, ome=True, metadata={"axes": "TZYX"}, photometric="minisblack")
    nib.save(nib.Nifti1Image(frames.transpose(3, 2, 1, 0), np.eye(4)), series / "bold.nii.gz")
    run = ("--tf", series / "tf.json", "--tf-range", "rescale", *[part for part in SMALL if part != "-q"])
    made = {}
    for source in ("run_*.npy", "cells.ome.tif", "bold.nii.gz"):
        folder = series / source.partition(".")[0].strip("_*")
        folder.mkdir()
        done = vvgt.ok("convert", series / source, "-o", folder / "p_{:02d}.ply", *run)
        made[source] = contents(folder)
    assert list(made["cells.ome.tif"]) == ["p_01.ply", "p_02.ply", "p_03.ply"]
    assert made["cells.ome.tif"] == made["bold.nii.gz"] == made["run_*.npy"]
    assert "skipped: bold.nii.gz time 0 (nothing of it is visible)" in done.err
    assert [request.source.read.time for request in stand_in] == [None] * 3 + [1, 2, 3] * 2
    error = vvgt("convert", series / "bold.nii.gz", "-o", series / "p.ply", *run).error
    assert "4 time steps; expected one: try --time N (0 to 3), or a number in the output" in error


def test_frames_as_folders_of_levels(vvgt, series: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(series)
    line = ("convert", "run_*.npy", "--tf", "tf.json", *SMALL[:-1], "--steps", "2")
    out = ("-o", "steps/{:02d}/lod-meta.json", "--report", "steps/{:02d}.json")
    whole = [f"{k:02d}/{name}" for k in (1, 2, 3) for name in ("0_0/sh0.webp", "1_0/meta.json", "lod-meta.json")]
    calls = [0]

    def stopped(splats):
        calls[0] += 1
        if calls[0] == 4:  # the first file of the second frame that shows something
            raise KeyboardInterrupt
        return images_of(splats)

    with monkeypatch.context() as patch:
        patch.setattr("vvgt_cli.conversion.levels.images_of", stopped)
        assert vvgt(*line, *out).code == 130
    first = (series / "steps" / "01" / "lod-meta.json").stat().st_mtime_ns
    told = vvgt.ok(*line, *out).err
    assert "resuming with the blocks in steps/02/" in told.replace(f"{series}/", "")
    assert "skipped: run_8.npy (nothing of it is visible)" in told
    assert "2 frames converted, 1 were complete before" in told
    assert (series / "steps" / "01" / "lod-meta.json").stat().st_mtime_ns == first
    made = levels(series / "steps")
    assert set(whole) < set(made)
    files = [read_manifest(series / "steps" / f"{k:02d}" / "lod-meta.json")["vvgt"] for k in (1, 2, 3)]
    assert len({(file["scale"], *[c for c in file["comments"] if "frame unit" in c]) for file in files}) == 1
    index = json.loads((series / "steps" / "index.json").read_text())
    assert index["empty"] == [0]
    assert [(row["frame"], row["file"]) for row in index["files"]] == [(k, f"{k:02d}/lod-meta.json") for k in (1, 2, 3)]
    assert all({"gaussians", "bytes", "psnr"} < set(row) for row in index["files"])
    vvgt.ok("convert", "run_9.npy", *line[2:], "-o", "alone/lod-meta.json")
    assert files_in(series / "alone") == {k[3:]: v for k, v in made.items() if k.startswith("01/")}
    for name in ("steps/index.json", "steps/*/lod-meta.json"):
        assert "open one, as 'vvgt view steps/01'" in vvgt.fails(2, "view", name, "--no-browser")
    vvgt.ok("render", "steps/index.json", "--size", 24, "-o", "f_{}.png")
    seen = [np.asarray(Image.open(f"f_{k}.png"))[..., 3].any() for k in range(4)]
    assert seen == [False, True, True, True]

    (series / "steps" / "03" / "0_0" / "sh0.webp").unlink()
    assert "1 frames converted, 2 were complete before" in vvgt.ok(*line, *out).err
    for part in ("2/2", "1/2"):
        vvgt.ok(*line, "-o", "parts/{:02d}/lod-meta.json", "--shard", part)
    assert levels(series / "parts") == levels(series / "steps") == made
    told = vvgt.fails(2, *line, "-o", "steps/{}/lod-meta.json")
    assert "outputs {:02d}/lod-meta.json {:02d}.json there, {}/lod-meta.json here" in told
    (series / "run_11.npy").unlink()
    assert "another volume, frames 4 there, 3 here" in vvgt.fails(2, *line, *out)
    vvgt.ok(*line, *out, "--overwrite")
    assert sorted(path.name for path in (series / "steps").iterdir()) == [
        "01", "01.json", "02", "02.json", "index.json", "manifest.json",
    ]  # fmt: skip


def levels(folder: Path) -> dict[str, bytes]:
    """Return the files of the folders below a folder."""
    return {name: content for name, content in files_in(folder).items() if "/" in name}


def test_an_interrupted_frame_is_not_recorded(vvgt, series: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(request, console, finished=None, warm=None) -> SimpleNamespace:
        Path(request.output).write_text("short")
        return SimpleNamespace(report=ConversionReport("convert", refinement={"reason": "interrupted"}))

    monkeypatch.setattr("vvgt_cli.conversion.convert_batch.convert_one", interrupted)
    run = ("convert", series / "run_*.npy", "--tf", series / "tf.json", "-o", series / "out" / "{:02d}.ply", *SMALL)
    assert vvgt(*run).code == 130
    assert "01.ply" not in (series / "out" / "manifest.json").read_text().split('"files"')[1]


def test_another_series_is_refused_and_overwritten_on_request(vvgt, series: Path, stand_in: list) -> None:
    run = ("convert", series / "run_*.npy", "--tf", series / "tf.json", "-o", series / "out" / "{:02d}.ply", *SMALL)
    vvgt.ok(*run)
    other = vvgt(*replaced(run, "--max-gaussians", "50")).error
    assert "holds frames of another run: max gaussians 60 there, 50 here" in other
    np.save(series / "run_12.npy", np.zeros((8, 10, 12), np.float32))
    assert "another volume, frames 4 there, 5 here" in vvgt(*run).error
    vvgt.ok(*run, "--overwrite")
    (series / "out" / "manifest.json").unlink()
    assert "01.ply exists, and no manifest" in vvgt(*run).error
    (series / "out" / "manifest.json").write_text("{}")
    assert "not a manifest of 'vvgt convert'" in vvgt(*run).error
    (series / "pages").mkdir()
    pages = replaced(run, "-o", series / "pages" / "{:02d}.html")
    vvgt.ok(*pages, "--title", "before")
    assert "title before there, after here" in vvgt(*pages, "--title", "after").error


def test_calls_that_are_wrong(vvgt, series: Path) -> None:
    frames, tf = series / "run_*.npy", series / "tf.json"
    for args, message in (
        ((series / "none_*.npy", "-o", "{}.ply"), "no file matches"),
        ((frames, "-o", series / "{}{}.ply"), "expected one place for the frame's number"),
        ((frames, "-o", series / "{:02d}.ply", "--report", series / "r.json"), "--report .*expected one place"),
        ((frames, "-o", series / "{}" / "a.ply"), "expected one folder; got .*0, .*1, .*2$"),
        ((frames, "-o", series / "none/a/{}/lod-meta.json"), "none/a/0 does not exist"),
        ((frames, "-o", series / "out" / "{}" / "b" / "lod-meta.json"), "place in the last folder's name"),
        ((frames, "-o", series / "{:02d}.ply", "--shard", "3/2"), "--shard 3/2"),
        ((frames, "-o", series / "{:02d}.ply", "--dry-run"), "--dry-run with frames: a plan is for one volume"),
        ((frames, "-o", series / "{}.ply", "--shard", "1/2", "--overwrite"), "would remove each other's files"),
        ((frames, "-o", series / "a.ply"), "run_8.npy is no slice.*out_{:04d}.ply"),
        ((frames, "-o", series / "{:02d}.ply", "--tf", tf, "--tf-range", "50,60"), "shows nothing in any of 4 frames"),
    ):
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(series)
            done = vvgt("convert", *args, *SMALL)
        assert done.code in (1, 2)
        assert re.search(message, done.error), done.error
    np.save(series / "run_7.npy", np.zeros((3, 4, 5), np.float32))
    done = vvgt("convert", frames, "-o", series / "{:02d}.ply", *SMALL)
    assert "expected the grid of run_7.npy, 5 x 4 x 3 voxels of 1 1 1 from 0 0 0" in done.error
    assert not list(series.glob("*.ply"))


def test_names_of_frames() -> None:
    assert put_name("-o", "a_{:04d}.ply", FRAMES, "7") == "a_0007.ply"
    assert put_name("-o", "a_{}.ply", FUNCTIONS, "7") == "a_7.ply"
    assert [is_pattern(name) for name in ("a.ply", "{}.ply", "{:3d}.ply", "{x}.ply", "{0.__class__}.ply")] == [
        False, True, True, True, True
    ]  # fmt: skip
    facts = {"step": "0100", "time": 0.05, "stem": "run_0100"}
    for pattern, name in (
        *(("{step}.ply", "0100.ply"), ("{step:d}_{}.ply", "100_7.ply"), ("{stem}.ply", "run_0100.ply")),
        *(("{time}/{:03d}.ply", "0.05/007.ply"), ("{time:.3f}.ply", "0.050.ply")),
    ):
        assert put_name("-o", pattern, FRAMES, "7", facts) == name
    with pytest.raises(UsageError, match="the input of frame 7 states no time; expected another place"):
        put_name("-o", "{time}.ply", FRAMES, "7", {"step": "1"})
    wrong = ("{x}_{}.ply", "{0.__class__}.ply", "{stem:d}.ply", "{step}{step}.ply", "{{}.ply")
    for pattern, kind in (
        *(
            *((name, FRAMES) for name in wrong),
            ("{}/{:d}.ply", FRAMES),
            ("a{x}_{}.ply", FUNCTIONS),
            ("{:d}.ply", FUNCTIONS),
        ),
        *(("{step}.ply", FUNCTIONS), ("{stem}.ply", LABELS)),
    ):
        with pytest.raises(UsageError, match="expected one place for the"):
            put_name("-o", pattern, kind, "1")


@pytest.mark.parametrize(
    ("names", "steps"),
    [
        (["run_0050.vti", "run_0100.vti"], ["0050", "0100"]),
        (["a/t1_c2.nii.gz", "a/t5_c2.nii.gz"], ["1", "5"]),  # the number that differs
        (["v2/0010/f3.npy", "v2/0020/f3.npy"], ["0010", "0020"]),
        (["x_9.h5", "x_10_b.h5"], ["9", "10"]),
        (["a_1.compressed.ply", None], ["1", None]),
        (["one_7.vti"], ["7"]),
        (["a.vti", "b.vti"], [None, None]),
    ],
)
def test_the_step_is_the_number_in_a_name(names: list, steps: list) -> None:
    assert [row.get("step") for row in frame_facts(names)] == steps


def test_outputs_keep_step_time_and_stem_of_their_inputs(vvgt, series: Path, stand_in: list, monkeypatch) -> None:
    monkeypatch.chdir(series)
    for k, time in ((50, 0.05), (100, 0.1), (200, 0.2)):
        image = pyvista.ImageData(dimensions=(9, 8, 7))
        image["v"], image.field_data["TimeValue"] = np.random.default_rng(k).random(504), [time]
        image.save(f"vtk_{k:04d}.vti")
    axes = {"time": ("time", [0.0, 1.5], {"units": "seconds since 2000-01-01"})}
    xarray.Dataset({"v": (("time", "z", "y", "x"), np.ones((2, 3, 4, 5), "f4"))}, coords=axes).to_netcdf("t.nc")
    for volume, pattern, names in (
        ("vtk_*.vti", "a/{step}.ply", ("0050", "0100", "0200")),
        ("vtk_*.vti", "b/{time}.ply", ("0.05", "0.1", "0.2")),
        ("vtk_*.vti", "c/{stem}.ply", ("vtk_0050", "vtk_0100", "vtk_0200")),
        ("t.nc", "d/{time}.ply", ("0", "1.5")),
        ("t.nc", "e/{step}.ply", ("0", "1")),
    ):
        folder = Path(pattern).parent
        folder.mkdir()
        run = ("convert", volume, "--tf", "gray", "-o", pattern, "--report", folder / "r_{stem}_{}.json", *SMALL[:-1])
        vvgt.ok(*run)
        assert {path.stem for path in folder.glob("*.ply")} == set(names)
        rows = json.loads((folder / "index.json").read_text())["files"]
        assert [row["file"] for row in rows] == [f"{name}.ply" for name in names]
        assert f"0 frames converted, {len(names)} were complete before" in vvgt.ok(*run).err
        if volume != "t.nc":
            vvgt.ok("render", volume, "--size", 16, "-o", pattern.replace(".ply", ".png"))
            assert {path.stem for path in folder.glob("*.png")} == set(names)
    before = len(stand_in)
    assert "f/t.ply would hold several frames" in vvgt("convert", "t.nc", "-o", "f/{stem}.ply").error
    assert "frame 0 states no time" in vvgt("convert", "run_*.npy", "-o", "{time}.ply").error
    assert "{step} or {time} that its input states" in vvgt("convert", "t.nc", "-o", "{when}.ply").error
    assert len(stand_in) == before
    clouds = library.convert("vtk_*.vti", "gray", max_gaussians=50, screen=32, steps=0)
    assert isinstance(clouds, library.Clouds)
    clouds.save("lib_{step}_{time}.ply")
    assert sorted(path.name for path in series.glob("lib*.ply"))[0] == "lib_0050_0.05.ply"


def test_a_note_of_all_frames_is_printed_once(vvgt, series: Path, monkeypatch) -> None:
    """Whether it is a warning of a reader or a message of a conversion, and of functions and layers too."""
    monkeypatch.chdir(series)
    monkeypatch.setattr(warnings, "showwarning", main._note)  # as `main.main` does
    sheared, loud = np.eye(4), SMALL[:-1]
    sheared[0, 1] = 0.3
    for k in (1, 2, 3):
        image = pyvista.ImageData(dimensions=(9, 8, 7))
        image["v"], image["w"] = np.random.default_rng(k).random((2, 504))
        image.set_active_scalars("v")
        image.save(f"two_{k}.vti")
        nib.save(nib.Nifti1Image(np.random.default_rng(k).random((9, 8, 7)).astype("f4"), sheared), f"s_{k}.nii")
    how = ("--tf", "gray", "--steps", 0, *loud)
    for call, text, first in (
        (("two_*.vti", "-o", "out/{}.ply"), "--array takes another: w", "two_1.vti"),
        (("two_*.vti", "-o", "a.html"), "--array takes another: w", "two_1.vti"),
        (("two_1.vti", "--layer", "two_2.vti", "--layer", "two_3.vti", "-o", "b.ply"), "--array takes", "two_1.vti"),
        (("s_*.nii", "-o", "out/s{}.ply", "--overwrite"), "index axes 73.3 degrees apart", "s_1"),
        (("s_1.nii", "--tf", "hot", "--tf", "bone", "-o", "f_{}.ply"), "index axes 73.3 degrees apart", "s_1"),
    ):
        told = vvgt.ok("convert", *call, *how).err
        again = [line for line in told.splitlines() if f"{first}: " in line and line.endswith(": 3 times in all")]
        assert (sum(text in line for line in told.splitlines() if line not in again), len(again)) == (1, 1), told
        for k in (1, 2, 3) if "{}.ply" in call[-1] and call[0] == "two_*.vti" else ():
            assert f"frame {k} of 3" in told
    assert "times in all" not in vvgt.ok("convert", "s_1.nii", "-o", "c.ply", *how).err


def test_a_function_that_fits_is_named_where_none_is_given(vvgt, series: Path, monkeypatch) -> None:
    monkeypatch.chdir(series)
    values = np.full((30, 30, 30), -1000, np.int16)
    values[3:27, 3:27, 3:27], values[8:16, 8:16, 8:16] = 40, 900
    for k in (1, 2):
        noise = np.random.default_rng(k).integers(-9, 9, values.shape)
        nib.save(nib.Nifti1Image((values + noise).astype(np.int16), np.diag([4, 4, 4, 1])), f"ct_{k}.nii")
    small = ("--max-gaussians", 50, "--screen", 24, "--steps", 0, "--overwrite")
    said = "no look is given; --tf ct-bone is made for such data"
    for call, count in (
        *((("ct_1.nii",), 1), (("ct_1.nii", "--blocks", 16), 1), (("ct_*.nii",), 1)),
        *((("ct_1.nii", "--tf", "gray"), 0), (("ct_1.nii", "--labels", "auto"), 0), (("ct_1.nii", "-q"), 0)),
    ):
        output = "out/{}.ply" if call[0] == "ct_*.nii" else "a.ply"
        assert vvgt.ok("convert", *call, *small, "-o", output).err.count(said) == count, call
    assert "tf             ct-bone" in vvgt("info", "ct_1.nii").out.decode()


def test_statistics_together() -> None:
    rng = np.random.default_rng(0)
    parts = [rng.normal(k, 1 + k, (4, 5, 6)).astype(np.float32) for k in range(3)]
    parts[1][0, 0, 0] = np.nan
    parts.append(np.full((4, 5, 6), 20.0, np.float32))
    whole = statistics(Volume(np.concatenate(parts)))
    joined = merge_statistics([statistics(Volume(part)) for part in parts])
    assert (joined.lo, joined.hi, joined.nan_count) == (whole.lo, whole.hi, 1)
    np.testing.assert_allclose(joined.edges, whole.edges)
    assert joined.histogram.sum() == whole.histogram.sum() == 479
    assert np.abs(np.cumsum(joined.histogram) - np.cumsum(whole.histogram)).max() <= 0.02 * 479
    constant = merge_statistics([statistics(Volume(np.full((2, 2, 2), 3.0)))] * 2)
    assert (constant.lo, constant.hi, constant.histogram.sum()) == (3, 3, 16)


def write_colors(path: Path, k: int, samples: int = 3) -> None:
    """A frame of RGB voxels that grows brighter; the first is black."""
    z, y, x = np.mgrid[:6, :8, :10]
    values = np.stack([x, y, z, x + y], axis=-1)[..., :samples] * (10 * k)
    tifffile.imwrite(path, values.astype(np.uint8), photometric="rgb")


def test_frames_of_colours(vvgt, series: Path) -> None:
    for k in range(3):
        write_colors(series / f"rgb_{k}.tif", k)
    out = series / "out" / "c_{}.ply"
    done = vvgt.ok("convert", series / "rgb_*.tif", "-o", out, *[a for a in SMALL if a != "-q"])
    assert "opacity by luminance" in done.err
    assert "skipped: rgb_0.tif (nothing of it is visible)" in done.err
    made = contents(series / "out")
    assert list(made) == ["c_1.ply", "c_2.ply"]
    vvgt.ok("convert", series / "rgb_1.tif", "-o", series / "alone.ply", *SMALL)
    assert uncertified(series / "alone.ply") == uncertified(made["c_1.ply"])
    write_colors(series / "rgb_3.tif", 1, 4)
    assert "components 4; expected the 3 of rgb_0.tif" in vvgt("convert", series / "rgb_*.tif", "-o", out, *SMALL).error


@pytest.mark.parametrize("channels", ["all", "1,A"])
def test_channels_of_time_steps_have_one_function_each(vvgt, series: Path, stand_in: list, channels: str) -> None:
    """The ramp of a channel follows from all frames: the brightest one is not as bright in the first."""
    rng = np.random.default_rng(0)
    values = rng.random((3, 6, 2, 8, 10)) * np.array([1, 2, 4])[:, None, None, None, None] * 1000
    meta = {"axes": "TZCYX", "Channel": {"Name": ["A", "B"]}}
    tifffile.imwrite(series / "t.ome.tif", values.astype(np.uint16), ome=True, metadata=meta)
    run = ("convert", series / "t.ome.tif", "--channel", channels, "-o", series / "out" / "{}.ply", *SMALL[:-1])
    assert "3 of 10 x 8 x 6" in vvgt.ok(*run).err
    layers = [load(request.source).layers for request in stand_in]
    nodes = [[layer.tf.node_range() for layer in frame] for frame in layers]
    assert [len(frame) for frame in layers] == [2, 2, 2]
    assert nodes[0] == nodes[1] == nodes[2]
    assert nodes[0][0][1] == pytest.approx(4000, rel=0.02)
    assert all((a.volume.data != b.volume.data).any() for a, b in zip(layers[0], layers[1], strict=True))


def test_layers_over_frames_have_one_function_and_dark_frames_are_shown(vvgt, series: Path, stand_in: list) -> None:
    """Frame 8 is nothing under the function; what is laid over it is seen all the same."""
    np.save(series / "other.npy", np.ones((8, 10, 12), np.float32))
    run = ("convert", series / "run_*.npy", "--layer", f"{series / 'other.npy'},tf={series / 'tf.json'}")
    vvgt.ok(*run, "--tf", series / "tf.json", "-o", series / "out" / "{:d}.ply", *SMALL)
    assert len(contents(series / "out")) == 4
    stand_in.clear()
    vvgt.ok(*run, "-o", series / "out" / "b{:d}.ply", *SMALL, "--overwrite")
    made = [load(request.source).layers[0].tf for request in stand_in]
    assert len({tf.node_range() for tf in made}) == 1
