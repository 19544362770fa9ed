"""`vvgt convert` with several transfer functions: one file each, the volume read once."""

import json
import re

import pytest

from tests.headers import uncertified
from tests.test_streamed import contents

HOW = ("--max-gaussians", "60", "--screen", "32", "--steps", "2")


@pytest.fixture
def functions(tmp_path):
    for name, color in (("bone", [1, 1, 0.8]), ("skin", [0.9, 0.6, 0.5])):
        points = [{"x": 0.2, "rgb": color, "opacity": 0}, {"x": 1, "rgb": color, "opacity": 0.4}]
        (tmp_path / f"{name}.json").write_text(json.dumps({"range": [0, 1], "points": points}))
    return [str(tmp_path / name) for name in ("bone.json", "skin.json")]


def test_each_function_gets_the_file_that_it_gets_alone(vvgt, tmp_path, functions):
    bone, skin = functions
    out = str(tmp_path / "blob_{}.ply")
    beside = ("--report", tmp_path / "{}.report.json", "--preview", tmp_path / "{}.png")
    done = vvgt.ok("convert", "example:blob:16", "--tf", bone, "--tf", skin, "-o", out, *HOW, *beside)
    assert done.err.count("volume ") == 1
    assert "function 2 of 2" in done.err
    for name, tf in (("bone", bone), ("skin", skin)):
        alone = tmp_path / f"alone-{name}.ply"
        vvgt.ok("convert", "example:blob:16", "--tf", tf, "-o", str(alone), *HOW)
        assert uncertified(tmp_path / f"blob_{name}.ply") == uncertified(alone)
        assert json.loads((tmp_path / f"{name}.report.json").read_text())["transfer_function"]["name"]
        assert (tmp_path / f"{name}.png").stat().st_size > 0
    assert "blob_bone.ply" in vvgt.fails(2, "convert", "example:blob:16", "--tf", bone, "--tf", skin, "-o", out, *HOW)


def test_each_function_gets_the_levels_that_it_gets_alone(vvgt, tmp_path, functions):
    bone, skin = functions
    out = ("-o", tmp_path / "heads" / "{}" / "lod-meta.json")
    line = ("convert", "example:blob:16", *HOW, "--no-comments", "--tf", bone)
    told = "--report .*expected one place"
    assert re.search(told, vvgt.fails(2, *line, "--tf", skin, *out, "--report", tmp_path / "r.json"))
    assert not (tmp_path / "heads").exists()
    told = vvgt.ok(*line, "--tf", skin, *out).err
    assert (told.count("; in blocks of "), "for 2 functions" in told) == (2, False)  # never in memory as a whole
    vvgt.ok(*line, "-o", tmp_path / "alone" / "lod-meta.json")
    assert contents(tmp_path / "heads" / "bone") == contents(tmp_path / "alone")
    rows = json.loads((tmp_path / "heads" / "index.json").read_text())["files"]
    assert [row["file"] for row in rows] == ["bone/lod-meta.json", "skin/lod-meta.json"]
    assert contents(tmp_path / "heads" / "skin") != contents(tmp_path / "alone")
    assert "bone/lod-meta.json exists" in vvgt.fails(2, *line, "--tf", skin, *out)


@pytest.mark.parametrize(
    ("extra", "told"),
    [
        (("-o", "one.ply"), "-o one.ply: expected one place for the function's name"),
        (("-o", "{:04d}.ply"), "expected one place for the function's name"),
        (("-o", "{}.ply", "--preview", "p.png"), "--preview p.png: expected one place"),
        (("-o", "{}.ply", "--dry-run"), "--dry-run with functions: a plan is for one function"),
        (("-o", "{}.ply", "--shard", "1/2"), "--shard with functions: shards are for series"),
        (("-o", "{}.ply", "--checkpoint", "c"), "--checkpoint with functions: it is for one conversion"),
    ],
)
def test_what_several_functions_ask_for(vvgt, tmp_path, functions, monkeypatch, extra, told):
    monkeypatch.chdir(tmp_path)
    done = vvgt("convert", "example:blob:16", "--tf", functions[0], "--tf", functions[1], *extra)
    assert (done.code, told in done.err) == (2, True), done.err
    assert len(done.err.strip().splitlines()) == 1


def test_functions_of_one_name_are_refused(vvgt, tmp_path, functions):
    (tmp_path / "other").mkdir()
    twin = tmp_path / "other" / "bone.json"
    twin.write_text((tmp_path / "bone.json").read_text())
    for output in ("{}.ply", "page.html"):
        twins = ("--tf", functions[0], "--tf", twin, "-o", tmp_path / output)
        done = vvgt.fails(2, "convert", "example:blob:16", *twins)
        assert "expected one name each" in done
