"""Live files of several layers or channels: each Gaussian carries its layer's number, and its value or label."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli as vvgt_library
from tests.refused import refused
from tests.test_live import GRAIN, LO, RAMP, SMALL, WINDOW, cloud
from tests.test_live import facts as values
from tests.test_live_labels import LABELS
from tests.test_live_labels import facts as labels
from vvgt_cli.conversion.place import to_frame_of
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply, write_ply
from vvgt_cli.gaussians.live import LayerTables, Palette, Table, apply_look
from vvgt_cli.gaussians.live_facts import LABEL_ROW, LAYER_ID, LiveFacts
from vvgt_cli.volume import Volume

TF = {"points": [{"x": 0.2, "rgb": [1, 0, 0], "opacity": 0}, {"x": 0.9, "rgb": [0, 1, 0], "opacity": 0.8}]}


def several() -> LiveFacts:
    first = replace(values(), name="ct", distance=0.5)
    return replace(first, others=(replace(labels(), name="organs \u00e9", distance=0.25),))


def layered(count: int = 40) -> Gaussians:
    some = cloud(count)
    assert some.live is not None
    number = np.arange(count) % 2
    row = np.where(number == 1, np.arange(count) // 2 % len(LABELS), 0)
    return replace(some, live=np.column_stack([some.live, row, number]))


def test_each_layer_is_looked_up_in_its_own_table() -> None:
    some = layered()
    tables = (Table.of_function(WINDOW, LO, 80, 0.05, GRAIN), Palette.of_labels(LABELS, 0.02))
    together = apply_look(some, LayerTables(tables))
    for number, table in enumerate(tables):
        own = np.flatnonzero(some.live[:, LAYER_ID] == number)  # type: ignore[index]
        alone = apply_look(some.take(own), table)
        np.testing.assert_array_equal(alone.means, together.means[own])
        np.testing.assert_array_equal(alone.opacity_logits, together.opacity_logits[own])
        np.testing.assert_array_equal(alone.colors, together.colors[own])


def test_a_ply_keeps_the_layers(tmp_path: Path) -> None:
    some, options = layered(), PlyOptions(up="y", scale=0.1, centre=(1, 2, 3), unit_distance=0.5, live=several())
    write_ply(tmp_path / "a.ply", some, options)
    back, header = read_ply(tmp_path / "a.ply")
    assert header.live == several()
    assert [header.dtype[name] for name in ("label", "layer")] == [np.uint8, np.uint8]
    np.testing.assert_array_equal(
        back.live[:, [0, 1, 2, LABEL_ROW, LAYER_ID]], some.live[:, [0, 1, 2, LABEL_ROW, LAYER_ID]]
    )  # type: ignore[index]
    whole = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(whole[:-1] + b"\x07")
    refused(vvgt_library.DataError, "layer number 7", read_ply, tmp_path / "b.ply")
    (tmp_path / "c.ply").write_bytes(whole.replace(b"live layer 0.25", b"live layer zero", 1))
    refused(vvgt_library.DataError, "expected one that vvgt writes", read_ply, tmp_path / "c.ply")
    scalars = replace(several(), others=(replace(values(RAMP), name="pet", distance=1.0),))
    live = some.live.copy()  # type: ignore[union-attr]
    live[:, LABEL_ROW] = 0
    write_ply(tmp_path / "d.ply", replace(some, live=live), replace(options, live=scalars))
    back, header = read_ply(tmp_path / "d.ply")
    assert header.live == scalars
    assert "label" not in (header.dtype.names or ())
    np.testing.assert_array_equal(back.live[:, LAYER_ID], live[:, LAYER_ID])  # type: ignore[index]


def test_gaussians_of_one_grid_in_the_frame_of_another() -> None:
    """Places, sizes and the lengths that they carry are the same in the world."""
    empty = np.broadcast_to(np.uint8(0), (4, 8, 6))
    one = Volume(empty, (1.0, 2.0, 0.5), (3.0, 1.0, 0.0))
    other = Volume(empty, (2.0, 1.0, 1.5), (-4.0, 0.0, 2.0))
    some = cloud()
    moved = to_frame_of(some, one.unit_frame(), other.unit_frame())
    worlds = [
        (g.means / v.unit_frame().scale + np.array(v.unit_frame().centre), np.exp(g.log_scales) / v.unit_frame().scale,
         g.live[:, 2] / v.unit_frame().scale)  # type: ignore[index]
        for g, v in ((some, one), (moved, other))
    ]  # fmt: skip
    for before, after in zip(*worlds, strict=True):
        np.testing.assert_allclose(before, after, rtol=1e-5, atol=1e-5)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball left and one right, the right one on a grid of its own, smaller and shifted; and a label map."""
    import nibabel

    from vvgt_cli.commands.main import run

    folder = tmp_path_factory.mktemp("pair")
    z, y, x = np.mgrid[:20, :20, :20] - 9.5
    left = np.exp(-(((x + 4) / 4) ** 2 + (y / 4) ** 2 + (z / 4) ** 2))
    nibabel.save(nibabel.Nifti1Image(left.T.astype(np.float32), np.eye(4)), folder / "left.nii")
    z, y, x = np.mgrid[:16, :16, :16] - 7.5
    right = np.exp(-((x / 4) ** 2 + (y / 4) ** 2 + (z / 4) ** 2))
    place = np.eye(4)
    place[:3, 3] = (7, 2, 2)
    nibabel.save(nibabel.Nifti1Image(right.T.astype(np.float32), place), folder / "right.nii")
    map_ = np.zeros((20, 20, 20), np.uint8)
    map_[:, 14:, 8:12] = 3
    nibabel.save(nibabel.Nifti1Image(map_, np.eye(4)), folder / "top_label.nii")
    (folder / "tf.json").write_text(json.dumps(TF))
    (folder / "t.json").write_text(json.dumps({"3": {"name": "top", "color": [0, 0, 1], "opacity": 0.5}}))
    source = ["convert", str(folder / "left.nii"), "--tf", str(folder / "tf.json"), "--live", "-q"]
    source += ["--layer", f"{folder / 'right.nii'},tf={folder / 'tf.json'}"]
    source += ["--layer", f"{folder / 'top_label.nii'},labels={folder / 't.json'}"]
    assert run([*source, "-o", str(folder / "live.ply"), *map(str, SMALL)]) == 0
    assert run([*source, "--blocks", "16", "-o", str(folder / "blocked.ply"), *map(str, SMALL)]) == 0
    return folder


def test_layers_lie_where_they_are_in_the_world(pair: Path) -> None:
    """In memory and in blocks."""
    for name in ("live.ply", "blocked.ply"):
        some, header = read_ply(pair / name)
        assert [layer.name for layer in header.live.layers] == ["left", "right", "top_label"]
        assert [len(layer.labels) for layer in header.live.layers] == [0, 0, 1]
        live = some.live
        number = live[:, LAYER_ID].astype(int)
        assert (np.bincount(number) > 40).all()
        bright = [np.flatnonzero((number == k) & (live[:, 0] > 0.6)) for k in (0, 1)]
        voxels = [some.means[own].mean(axis=0) / header.scale for own in bright]  # type: ignore[operator]
        np.testing.assert_allclose(voxels[0], [-4, 0, 0], atol=0.5)
        np.testing.assert_allclose(voxels[1], [5, 0, 0], atol=0.5)


def test_recolor_shows_one_of_several(vvgt, pair, tmp_path) -> None:
    live = pair / "live.ply"
    vvgt.ok("recolor", live, "-o", tmp_path / "own.ply")
    nothing = {"points": [{"x": 0.9, "rgb": [1, 1, 1], "opacity": 0}, {"x": 1, "rgb": [1, 1, 1], "opacity": 0.01}]}
    (tmp_path / "n.json").write_text(json.dumps(nothing))
    vvgt.ok("recolor", live, "--layer", f"left,tf={tmp_path / 'n.json'}", "-o", tmp_path / "r.ply")
    own, less = read_ply(tmp_path / "own.ply")[0], read_ply(tmp_path / "r.ply")[0]
    assert 0.3 * len(own) < len(less) < 0.9 * len(own)
    assert len(vvgt_library.recolor(live, layers={0: str(tmp_path / "n.json")}).gaussians) == len(less)
    (tmp_path / "none.json").write_text(json.dumps({"3": {"color": [0, 0, 1], "opacity": 0}}))
    (tmp_path / "dark.json").write_text(json.dumps({"points": [{"x": 0, "rgb": [1, 1, 1], "opacity": 0}]}))
    hidden, dark = f"2,labels={tmp_path / 'none.json'}", f"tf={tmp_path / 'dark.json'}"
    vvgt.ok("recolor", live, "--layer", hidden, "-o", tmp_path / "h.ply")
    vvgt.ok("recolor", live, "--layer", f"0,{dark}", "-o", tmp_path / "d.ply")
    without = [len(read_ply(tmp_path / f"{name}.ply")[0]) for name in "hd"]
    seen = [int((read_ply(live)[0].live[:, LAYER_ID] == number).sum()) for number in (2, 0)]  # type: ignore[index]
    for left, gone in zip(without, seen, strict=True):
        assert len(own) - gone <= left < len(own)
    every = ("--layer", hidden, "--layer", f"0,{dark}", "--layer", f"1,{dark}")
    assert "not one of" in vvgt.fails(1, "recolor", live, *every, "-o", tmp_path / "x.ply")
    for more, said in (
        (("--tf", "viridis"), "3 layers, each with its own look"),
        (("--layer", "elsewhere,tf=viridis"), "no layers of that name; expected 0 (left)"),
        (("--layer", "lefft,tf=viridis"), "no layers of that name; did you mean left?"),
        (("--layer", "t,tf=viridis"), "3 layers of that name"),
        (("--layer", "2,tf=viridis"), "carry labels, not values"),
        (("--layer", "0"), "expected LAYER,tf=TF"),
        (("--layer", "0,tf=a=b.json"), "a=b.json"),
    ):
        assert said in vvgt.fails(2, "recolor", live, *more, "-o", tmp_path / "x.ply")
    told = json.loads(vvgt("info", live, "--json").out)["live_layers"]
    assert [row["name"] for row in told] == ["left", "right", "top_label"]
    under = json.loads(vvgt("info", live, "--json", "--layer", "1,tf=viridis").out)
    assert "viridis" in under["function"]
    vvgt.ok("render", live, "--layer", "2,labels=auto", "--orbit", 1, "--size", 32, "-o", tmp_path / "p")


def test_layers_are_near_their_volume(vvgt, pair) -> None:
    source = ("--volume", pair / "left.nii", "--tf", pair / "tf.json")
    source += ("--layer", f"{pair / 'right.nii'},tf={pair / 'tf.json'}")
    source += ("--layer", f"{pair / 'top_label.nii'},labels={pair / 't.json'}")
    for name in ("live.ply", "blocked.ply"):
        done = vvgt.ok("evaluate", pair / name, *source, "--json", "--no-conditions")
        assert json.loads(done.out)["scores"]["psnr"] > 21
    done = vvgt.fails(2, "evaluate", pair / "live.ply", *source[:4], "--json", "--no-conditions")
    assert "the Gaussians carry values, values, labels" in done


def test_a_layer_that_shows_nothing_is_scored_as_recolor_shows_it(vvgt, pair, tmp_path) -> None:
    """In memory and in blocks, and made so; only layers that show nothing at all are refused."""
    (tmp_path / "dark.json").write_text(json.dumps({"points": [{"x": 0, "rgb": [1, 1, 1], "opacity": 0}]}))
    (tmp_path / "none.json").write_text(json.dumps({"3": {"color": [0, 0, 1], "opacity": 0}}))
    dark, hidden = f"tf={tmp_path / 'dark.json'}", f"labels={tmp_path / 'none.json'}"
    source = (pair / "left.nii", "--tf", pair / "tf.json", "--layer", f"{pair / 'right.nii'},{dark}")
    one = (*source, "--layer", f"{pair / 'top_label.nii'},{hidden}")
    looks = ("--layer", f"1,{dark}", "--layer", f"2,{hidden}")
    vvgt.ok("recolor", pair / "live.ply", *looks, "-o", tmp_path / "r.ply")
    for blocks in ((), ("--blocks", "16")):
        scores = []
        for file in (pair / "live.ply", tmp_path / "r.ply"):
            done = vvgt.ok("evaluate", file, "--volume", *one, "--json", "--no-conditions", "--step", 1, *blocks)
            scores.append(json.loads(done.out)["scores"]["psnr"])
        assert scores[0] == pytest.approx(scores[1], abs=0.01)
        assert scores[0] > 22
        vvgt.ok("convert", *one, "--live", *blocks, *SMALL, "-o", tmp_path / "l.ply", "--overwrite")
        number = read_ply(tmp_path / "l.ply")[0].live[:, LAYER_ID]  # type: ignore[index]
        assert (np.bincount(number.astype(int)) > 40).all()
    every = (pair / "left.nii", "--tf", tmp_path / "dark.json", *one[3:])
    assert "nothing is visible" in vvgt.fails(1, "evaluate", pair / "live.ply", "--volume", *every)


def test_channels_in_python(tmp_path) -> None:
    """And in colours of their own, which are refused."""
    import tifffile

    data = np.random.default_rng(0).integers(0, 255, (8, 2, 12, 12)).astype(np.uint8)
    tifffile.imwrite(tmp_path / "c.ome.tif", data, metadata={"axes": "ZCYX"}, ome=True)
    with pytest.warns(UserWarning, match="2 channels"):
        result = vvgt_library.convert(str(tmp_path / "c.ome.tif"), None, max_gaussians=400, screen=48, live=True)
    assert len(result.ply.live.layers) == 2
    other = result.recolor(layers={1: "magma"})
    assert other.ply.function is not None
    assert "magma" in other.ply.function
    rgb = np.random.default_rng(0).integers(0, 255, (8, 9, 10, 3)).astype(np.uint8)
    tifffile.imwrite(tmp_path / "rgb.tif", rgb, photometric="rgb")
    with pytest.raises(vvgt_library.UsageError, match="has colours, which Gaussians cannot carry"):
        vvgt_library.convert(str(tmp_path / "rgb.tif"), None, max_gaussians=90, screen=48, live=True)
