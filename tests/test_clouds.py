"""Several clouds from Python: frames, looks and labels as one result, with the bytes of the command line."""

import html
import json
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli as vvgt
from tests.headers import uncertified
from tests.refused import refused
from tests.test_index import HOW, LINES, NAMES, SHOWN, TF, at  # noqa: F401 - a fixture
from tests.test_pages import clouds, same

GOAL = {"max_gaussians": 60, "screen": 32, "steps": 0}
CALLS = {
    "frames": ("four.nii", "bone.json", {}),
    "functions": ("ball.npy", ["bone.json", "skin.json"], {}),
    "labels": ("map.npy", vvgt.Look(labels="auto"), {"split_labels": True}),
}


@pytest.mark.parametrize(("kind", "blocks"), [*((kind, None) for kind in CALLS), ("labels", 16)])
def test_files_and_index_are_those_of_the_command(vvgt_run, at, kind, blocks):  # noqa: F811
    volume, look, how = CALLS[kind]
    result = vvgt.convert(volume, look, **GOAL, blocks=blocks, **how)
    names = [name for name, _ in NAMES[kind]]
    assert (result.kind, list(result), len(result)) == (kind, names, len(names))
    assert repr(result).endswith(f"{names[0]}, {names[1]}>")
    assert html.unescape(result._repr_html_()).count('<script type="application/octet-stream" id="splats-') == len(
        names
    )
    total = result.save("x.ply")
    more = () if blocks is None else ("--blocks", str(blocks))
    assert vvgt_run("convert", *LINES[kind], "-o", "c_{}.ply", *HOW, *more).code == 0
    for _, file in NAMES[kind]:
        assert uncertified(file) == uncertified(file.replace("x_", "c_"))
    assert total == sum(Path(file).stat().st_size for _, file in NAMES[kind])
    ours, theirs = (json.loads(Path(f"{x}_index.json").read_text()) for x in "xc")
    for row in (*ours["files"], *theirs["files"]):
        row["file"] = row["file"][2:]
        del row["bytes"]  # with the command's
        row["function"] = Path(row.get("function", "")).stem
    assert ours == theirs
    one = result[names[1]]
    assert one.scores["psnr"] == ours["files"][1]["psnr"]
    assert one.render(size=24).shape == (24, 24, 4)
    result.save("x.html")
    held = clouds(Path("x.html"))
    assert list(held) == SHOWN.get(kind, names)
    assert all(same(one, Path(file)) for one, (_, file) in zip(held.values(), NAMES[kind], strict=True))


@pytest.fixture
def vvgt_run(request):
    """The command line: `vvgt` is the library here."""
    return request.getfixturevalue("vvgt")


def test_lit_files_keep_their_normals(vvgt_run, at):  # noqa: F811
    look = vvgt.Look("bone.json", light="headlight")
    vvgt.convert("four.nii", look, **GOAL).save("f_{:03d}.ply", sh_degree=0)
    line = ("convert", *LINES["frames"], "--light", "headlight", "--sh-degree", "0", *HOW)
    assert vvgt_run(*line, "-o", "c_{:03d}.ply").code == 0
    normals = [
        np.frombuffer(Path(f"{x}_002.ply").read_bytes()[-68 * 10 :], "<f4").reshape(10, 17)[:, 3:6] for x in "fc"
    ]
    assert np.abs(normals[0]).max() > 0.1
    np.testing.assert_array_equal(*normals)


def test_looks_of_what_is_in_memory_have_their_names(at):  # noqa: F811
    ball, dask = np.load("ball.npy"), pytest.importorskip("dask.array")
    looks = {"red & so on": TF, "lit": vvgt.Look(TF, light="headlight"), "map": "viridis"}
    result = vvgt.convert(ball, looks, **GOAL, spacing=(1, 1, 2))
    assert list(result) == list(looks)
    alone = vvgt.convert(ball, looks["lit"], **GOAL, spacing=(1, 1, 2))
    np.testing.assert_array_equal(result["lit"].gaussians.means, alone.gaussians.means)
    lazy = vvgt.convert(dask.from_array(ball, chunks=10), looks, **GOAL, spacing=(1, 1, 2))
    assert list(lazy) == list(looks)
    again = vvgt.Session(ball, spacing=(1, 1, 2)).convert(looks, **GOAL)
    np.testing.assert_array_equal(again["map"].gaussians.means, result["map"].gaussians.means)
    result.save("out.ply")
    assert sorted(path.name for path in at.glob("out_*")) == [
        "out_index.json", "out_lit.ply", "out_map.ply", "out_red-so-on.ply"
    ]  # fmt: skip
    labels = vvgt.convert(np.load("map.npy"), vvgt.Look(labels="auto"), **GOAL, split_labels=True)
    assert list(labels) == ["label 1", "label 2"]
    lazy = dask.from_array(np.load("map.npy"), chunks=10)
    parts = [
        vvgt.convert(v, vvgt.Look(labels="auto"), **GOAL, split_labels=True, blocks=16) for v in (lazy, lazy.compute())
    ]
    for one, other in zip(*(part.values() for part in parts), strict=True):
        np.testing.assert_array_equal(one.gaussians.means, other.gaussians.means)
    assert list(vvgt.convert("ball*.npy", "bone.json", **GOAL)) == ["ball.npy"]
    np.save("ball_2.npy", ball / 2)
    assert list(vvgt.convert("ball*.npy", "bone.json", **GOAL)) == ["ball.npy", "ball_2.npy"]


def test_what_several_clouds_cannot_do_is_refused_before_anything_is_written(at):  # noqa: F811
    result = vvgt.convert("ball.npy", ["bone.json", "skin.json"], **GOAL)
    Path("x_skin.ply").write_text("mine")
    for path, how, words in (
        ("x.ply", {"overwrite": False}, "x_skin.ply"),
        ("{}{}.ply", {}, "expected one place"),
        ("x_{:03d}.ply", {}, "expected one place for the function's name"),
        ("x.html", {"frame": "world"}, "remove frame"),
        ("x.obj", {}, "expected a name ending in"),
        ("none/x.ply", {}, "does not exist"),
    ):
        refused(vvgt.UsageError, words, result.save, path, **how)
    assert sorted(path.name for path in at.glob("x*")) == ["x_skin.ply"]
    with pytest.raises(KeyError, match="expected one of bone, skin"):
        result["bones"]
    refused(vvgt.UsageError, "pass a mapping of names", vvgt.convert, "ball.npy", ["bone.json", "bone.json"])
    with pytest.raises(vvgt.UsageError, match="--split-labels with functions"):
        vvgt.convert("ball.npy", ["bone.json", "skin.json"], split_labels=True)
    refused(vvgt.UsageError, "3 time steps", vvgt.convert, "four.nii", ["bone.json", "skin.json"])
