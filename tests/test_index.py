"""The index beside several files of Gaussians: one form for frames, functions and labels, read by view and info."""

import json
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import xarray

from tests.test_pages import clouds
from vvgt_cli.conversion.frames import list_steps
from vvgt_cli.conversion.index import function_name, index_path
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians import read_ply

HOW = ("--max-gaussians", 60, "--screen", 32, "--steps", 0)
TF = {"points": [{"x": 0.1, "opacity": 0, "rgb": [1, 0, 0]}, {"x": 1, "opacity": 0.6, "rgb": [1, 1, 0]}]}


@pytest.fixture
def at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of three steps of 2.5 s of which the second is dark, two functions and a label map."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 16)] * 3, indexing="ij")
    ball = np.exp(-4 * (x * x + y * y + z * z)).astype(np.float32)
    image = nib.Nifti1Image(np.stack([ball, 0 * ball, ball**2], axis=-1), np.eye(4))
    image.header.set_xyzt_units("mm", "sec")
    image.header["pixdim"][4], image.header["toffset"] = 2.5, 1
    nib.save(image, tmp_path / "four.nii")
    np.save(tmp_path / "ball.npy", ball)
    np.save(tmp_path / "map.npy", np.digitize(ball, [0.2, 0.6]).astype(np.uint8))
    (tmp_path / "bone.json").write_text(json.dumps(TF))
    (tmp_path / "skin.json").write_text(json.dumps(TF).replace("0.6", "0.2"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


LINES = {
    "frames": ("four.nii", "--tf", "bone.json"),
    "functions": ("ball.npy", "--tf", "bone.json", "--tf", "skin.json"),
    "labels": ("map.npy", "--labels", "auto", "--split-labels"),
}
NAMES = {
    "frames": [("four.nii time 0", "x_0.ply"), ("four.nii time 2", "x_2.ply")],
    "functions": [("bone", "x_bone.ply"), ("skin", "x_skin.ply")],
    "labels": [("label 1", "x_1-label-1.ply"), ("label 2", "x_2-label-2.ply")],
}
SHOWN = {"frames": ["t = 1 s", "t = 6 s"]}  # on a page: not the names of files
FACTS = {
    "frames": {"frame": 2, "time": 6.0, "time_unit": "s"},
    "functions": {"function": "skin.json"},
    "labels": {"label": 2, "opacity": 1.0},
}


@pytest.mark.parametrize(("kind", "blocks"), [*((kind, ()) for kind in LINES), ("functions", ("--blocks", "16"))])
def test_what_an_index_says(vvgt, at, kind, blocks):
    out = ("-o", "x_{}.ply", *HOW, *blocks)
    vvgt.ok("convert", *LINES[kind], *out)
    index = json.loads(Path("x_index.json").read_text())
    assert (index["format"], index["schema"], index["kind"]) == ("vvgt-clouds", 1, kind)
    assert index["volume"] == LINES[kind][0].removesuffix(".npy" if kind == "labels" else "-")
    assert [(row["name"], row["file"]) for row in index["files"]] == NAMES[kind]
    for row in index["files"]:
        assert row["bytes"] == Path(row["file"]).stat().st_size
        assert row["gaussians"] == len(read_ply(row["file"])[0])
        assert 15 < row["psnr"] < 80
    last = index["files"][-1]
    assert {key: last[key] for key in FACTS[kind]} == FACTS[kind]
    vvgt.ok("view", "x_index.json", "-o", "page.html")
    assert list(clouds(Path("page.html"))) == SHOWN.get(kind, [name for name, _ in NAMES[kind]])
    told = vvgt.ok("info", "x_index.json")
    assert f"index of {kind}" in told.out.decode()
    assert all(name in told.out.decode() for name, _ in NAMES[kind])


@pytest.mark.parametrize("kind", LINES)
def test_an_existing_index_is_reported_before_the_work(vvgt, at, kind):
    Path("x_index.json").write_text("mine")
    done = vvgt("convert", *LINES[kind], "-o", "x_{}.ply", *HOW)
    assert (done.code, "x_index.json" in done.error) == (2, True), done.err
    assert "closed form" not in done.err
    assert Path("x_index.json").read_text() == "mine"
    assert not list(at.glob("*.ply"))
    vvgt.ok("convert", *LINES[kind], "-o", "x_{}.ply", *HOW, "--overwrite")
    assert json.loads(Path("x_index.json").read_text())["kind"] == kind


def test_parts_of_a_series_leave_the_index_of_all(vvgt, at):
    line = ("convert", *LINES["frames"], "-o", "x_{}.ply", *HOW)
    vvgt.ok(*line, "--shard", "1/2")  # frames 0 and 2; the other part has the dark one
    first = Path("x_index.json").read_bytes()
    assert [row["frame"] for row in json.loads(first)["files"]] == [0, 2]
    vvgt.ok(*line, "--shard", "2/2")
    assert Path("x_index.json").read_bytes() == first
    Path("x_index.json").unlink()
    vvgt.ok(*line, "--shard", "1/2")  # all is done: it says so again
    assert Path("x_index.json").read_bytes() == first


def test_times_are_those_of_the_file(at):
    values = np.zeros((3, 4, 5, 6), np.float32)
    time = ("time", [0.0, 10.0, 25.0], {"units": "hours since 2020-01-01", "axis": "T"})
    xarray.DataArray(values, dims=("time", "z", "y", "x"), coords={"time": time}, name="t").to_netcdf("t.nc")
    assert [step.time for step in list_steps(SourceRequest("t.nc"))] == [
        (at, "hours since 2020-01-01") for at in (0.0, 10.0, 25.0)
    ]
    assert [step.time for step in list_steps(SourceRequest("four.nii"))] == [(1.0, "s"), (3.5, "s"), (6.0, "s")]
    nib.save(nib.Nifti1Image(np.zeros((4, 4, 4, 2), np.float32), np.eye(4)), "none.nii")
    assert [step.time for step in list_steps(SourceRequest("none.nii"))] == [None, None]


def test_an_index_that_is_none_is_a_line(vvgt, at):
    row = '"schema": 1, "kind": "frames", "files": [{"name": "a", "frame": 0, "file": "a.ply"}]'
    for text in ("{", '"files": []}', row.replace("a.ply", "../a.ply") + "}", row + ', "empty": ["1"]}'):
        Path("bad.json").write_text('{"format": "vvgt-clouds", ' + text)
        for command in (("info", "bad.json"), ("view", "bad.json", "-o", "p.html")):
            assert "not an index of 'vvgt convert'" in vvgt.fails(1, *command)
    good = '"schema": 1, "kind": "frames", "files": [{"name": "a", "file": "a.ply"}]}'
    Path("bad.json").write_text('{"format": "vvgt-clouds", ' + good)
    assert "a.ply is missing" in vvgt("view", "bad.json", "-o", "p.html").error


def test_where_an_index_lies():
    assert index_path("out_{:04d}.ply") == "out_index.json"
    assert index_path("a/{}.compressed.ply") == "a/index.json"
    assert index_path("a/{}/v1.0.ply") == "a/index.json"
    assert index_path("a.b_{}.v2.ply") == "a.b_index.v2.json"


def test_what_a_function_is_called(at):
    Path("a:b").mkdir()
    Path("a:b/soft.json").write_text("{}")
    named = {"a:b/soft.json": "soft", "a:b/soft.json#x: y": "x: y", "p.json#Cool to Warm": "Cool to Warm"}
    named |= {text: text for text in ("gray:0.2,1", "iso:3,#88aaff:5")}
    assert {text: function_name(text) for text in named} == named
