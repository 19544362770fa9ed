"""Label maps: tables of five programs, recognised volumes, one file a label; RGB and channels are in test_layers."""

import json
import time
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli as library
from tests.refused import refused
from vvgt_cli.conversion.gaussian_files import layout_of
from vvgt_cli.dvr.layers import grid_of
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import read_ply
from vvgt_cli.look.label_files import read_labels
from vvgt_cli.look.labels import LabelTable, distinct
from vvgt_cli.volume import Volume
from vvgt_cli.volume.label_maps import labels_in, recognised

SMALL = ("--max-gaussians", 300, "--screen", 64, "--steps", 0)
SLICER = "# Color table file\n1 skin 255 51 0 128\n3 inner_core 0 0 255 255\n"
FREESURFER = "#No. Label Name: R G B A\n0 Unknown 0 0 0 0\n1 skin 255 51 0 127\n\n3 inner_core 0 0 255 0\n"
SNAP = '# ITK-SnAP\n0 0 0 0 0 0 0 "Clear Label"\n1 255 51 0 0.5 1 1 "skin"\n3 0 0 255 1 1 1 "inner_core"\n'
JSON = json.dumps(
    {"1": {"name": "skin", "color": "#ff3300", "opacity": 0.5}, "3": {"name": "inner_core", "color": [0, 0, 1]}}
)
SEGMENTS = (
    "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n"
    "Segment0_LabelValue:=1\nSegment0_Name:=skin\nSegment0_Color:=1 0.2 0\nSegment1_LabelValue:=3\n"
    "Segment1_ID:=inner_core\nSegment1_Color:=0 0 1\n\n"
)


def balls(n: int = 24) -> np.ndarray:
    """A ball of label 3 in one of label 1, (n, n, n) uint8."""
    z, y, x = np.mgrid[:n, :n, :n] - (n - 1) / 2
    radius = np.sqrt(x * x + y * y + z * z)
    return np.where(radius < n / 5, 3, np.where(radius < n / 2.2, 1, 0)).astype(np.uint8)


def table(tmp_path: Path, text: str, name: str) -> str:
    path = tmp_path / name
    path.write_bytes(text.encode() + (b"\0" * 8 if text.startswith("NRRD") else b""))
    return str(path)


@pytest.fixture
def seg(tmp_path: Path) -> Path:
    np.save(tmp_path / "balls_seg.npy", balls())
    return tmp_path / "balls_seg.npy"


@pytest.mark.parametrize(
    ("text", "name"),
    [(SLICER, "a.ctbl"), (FREESURFER, "LUT.txt"), (SNAP, "a.label"), (JSON, "a.json"), (SEGMENTS, "a.seg.nrrd")],
)
def test_tables_of_every_program(tmp_path: Path, text: str, name: str) -> None:
    skin, core = (e for e in read_labels(table(tmp_path, text, name)).labels if e.number)
    assert (skin.number, skin.name, core.number, core.name) == (1, "skin", 3, "inner_core")
    np.testing.assert_allclose([skin.color, core.color], [(1, 0.2, 0), (0, 0, 1)])
    assert (skin.opacity, core.opacity) == (1.0 if "nrrd" in name else pytest.approx(0.5, abs=0.01), 1.0)


def test_a_name_of_null_is_none(tmp_path: Path) -> None:
    stated = [
        read_labels(table(tmp_path, json.dumps({"7": entry}), "a.json")).labels[-1].name
        for entry in ({"name": None, "color": [1, 0, 0]}, {"color": [1, 0, 0]})
    ]
    assert stated[0] == stated[1] != "None"


def test_a_function_of_whole_numbers() -> None:
    found = distinct(range(65_536))
    x = np.array([0, 1, 3, 1.5, -1, np.nan, 65_535, 70_000])
    np.testing.assert_array_equal(found.opacity(x), [0, 1, 1, 0, 0, 0, 1, 0])
    assert found.color(x).shape == (8, 3)
    assert len({e.color for e in found.labels[1:61]}) >= 55
    assert found.labels[7].color == distinct([7]).labels[0].color  # by the number, whatever else there is


@pytest.mark.parametrize(
    ("text", "name", "said"),
    [
        ("1 skin red 0 255\n", "a.ctbl", "line 1"),
        ("", "a.ctbl", "no label"),
        ("1 a 1 2 3 4\n1 b 1 2 3 4\n", "a.ctbl", "label 1 twice"),
        ("1 a 300 2 3 4\n", "a.ctbl", r"in \[0, 1\]"),
        ('{"1": {"color": [0, 0, 1], "opacity": 2}}', "a.json", "opacity 2"),
        ("{", "a.json", "not JSON .*expected a table of labels"),
        ("9" * 5000 + " a 1 2 3 4\n", "a.ctbl", "line 1"),
        ("1" + " " * 100_000 + "x\n", "a.ctbl", "line 1"),  # an expression took the third power of this
        (SEGMENTS.replace("Segment", "Other"), "a.seg.nrrd", "no label"),
    ],
)
def test_faulty_tables(tmp_path: Path, text: str, name: str, said: str) -> None:
    refused(DataError, said, read_labels, table(tmp_path, text, name))


def test_names_of_several_words_and_long_tables(tmp_path: Path) -> None:
    text = '1 left  kidney 10 20 30 255\n2 "part 7" 10 20 30\n3 lobe 7 10 20 30 255\n4 5 6 7 8 9\n'
    found = read_labels(table(tmp_path, text, "a.ctbl")).labels
    assert [e.name for e in found] == ["left  kidney", "part 7", "lobe 7", "5"]
    assert {tuple(np.round(255 * np.array(e.color)).astype(int)) for e in found[:3]} == {(10, 20, 30)}
    begin = time.process_time()
    with pytest.raises(DataError, match="label 39999 twice"):
        read_labels(table(tmp_path, "".join(f"{k} a 1 2 3 255\n" for k in [*range(40_000), 39_999]), "b.ctbl"))
    assert time.process_time() - begin < 10  # 35 s by counting each


def test_recognised_by_type_name_and_number() -> None:
    for volume, expected in (
        (Volume(balls(), name="brain_labels"), True),
        (Volume(balls(), name="x.aseg"), True),
        (Volume(balls(), name="segment"), True),
        (Volume(balls(), name="sega"), False),
        (Volume(balls(), name="frog_tissues"), False),
        (Volume(balls().astype(np.float32), name="labels"), True),
        (Volume(balls() + np.float32(0.5), name="labels"), False),
        (Volume(np.where(balls(), 7, 0), name="liver_mask"), True),
        (Volume(balls().astype(np.float32), name="lungmask"), True),
        (Volume(np.arange(27).reshape(3, 3, 3), name="brainmask"), False),  # FreeSurfer's holds grey values
        (Volume(np.arange(27).reshape(3, 3, 3), name="organ_mask_labels"), True),
        (Volume(balls().astype(np.float64), name="t1_masked"), False),
        (Volume(np.arange(1000, dtype=np.int16).reshape(10, 10, 10), name="labels"), False),
    ):
        assert recognised(volume) is expected, volume.name


def test_labels_are_data_values_and_whole() -> None:
    assert labels_in(Volume(balls(), slope=2.0, intercept=1.0)) == [1, 3, 7]
    assert labels_in(Volume(np.where(balls() == 3, np.nan, balls()))) == [0, 1]
    refused(DataError, r"such as 0\.5; expected a label map", labels_in, Volume(balls() / 2))
    for first in (2**53, 2**59):
        ids = np.array([[[0, first, first + 1]]], np.uint64)  # one in float64
        refused(DataError, r"2\^53 or more, which would be merged", labels_in, Volume(ids))
    assert len(labels_in(Volume(np.arange(65_536, dtype=np.uint16).reshape(16, 64, 64)))) == 65_536


# ---- the command line


def test_convert_evaluate_and_views(vvgt, tmp_path: Path, seg: Path) -> None:
    labels = table(tmp_path, JSON, "a.json")
    ply = tmp_path / "a.ply"
    done = vvgt.ok("convert", seg, "--labels", labels, *SMALL, "-o", ply, "--report", tmp_path / "a-r.json")
    assert "a.json" in done.err
    gaussians, _ = read_ply(str(ply))
    report = json.loads((tmp_path / "a-r.json").read_text())
    assert report["scores"]["psnr"] > 25
    assert np.abs(gaussians.colors[:, 1] - 0.2 * gaussians.colors[:, 0]).max() < 0.1  # no colour that is no mix of both
    own = vvgt("evaluate", ply, "--volume", seg, "--labels", labels, "--no-conditions", "--step", 0.5, "--json", "-q")
    assert json.loads(own.out)["scores"]["psnr"] == pytest.approx(report["scores"]["psnr"], abs=1)
    views = ("--views", 2, "--test-views", 1, "--size", 32, "-q", "-o", tmp_path / "views")
    vvgt.ok("render-views", seg, "--labels", labels, *views)
    again = vvgt("render-views", seg, "--labels", "auto", *views)
    assert "another run" in again.error or "function" in again.error
    vvgt.ok("init", seg, "--labels", labels, "--light", "headlight", *SMALL[:4], "-o", tmp_path / "lit.ply")


def test_of_several_layers_one_may_be_hidden(vvgt, tmp_path: Path, seg: Path) -> None:
    """But not all of them, nor one that is alone."""
    from vvgt_cli.field.source import SourceRequest, load

    hidden = json.dumps({number: entry | {"opacity": 0} for number, entry in json.loads(JSON).items()})
    none = str(table(tmp_path, hidden, "none.json"))
    other = SourceRequest(str(seg), labels=str(table(tmp_path, JSON, "a.json")))
    shown = load(SourceRequest(str(seg), labels=none, layers=(other,)))
    grid = grid_of(shown.layers, shown.volume)
    np.testing.assert_allclose(grid, grid_of(load(other).layers, shown.volume))
    both = ("--layer", f"{seg},labels={none}", "-o", tmp_path / "x.ply")
    for more in (("-o", tmp_path / "x.ply"), both, ("--split-labels", "-o", tmp_path / "x_{}.ply")):
        assert "none of its labels is visible" in vvgt.fails(1, "convert", seg, "--labels", none, *SMALL, *more)


@pytest.mark.parametrize("blocks", [(), ("--blocks", 16)], ids=["memory", "blocks"])
def test_a_recognised_label_map_is_reported_and_none_reads_scalars(vvgt, tmp_path: Path, seg: Path, blocks) -> None:
    with pytest.warns(UserWarning, match="balls_seg: read as a label map by its name"):
        done = vvgt.ok("init", seg, *SMALL[:4], *blocks, "-o", tmp_path / "a.ply")
    assert "distinct colours" in done.err
    plain = vvgt.ok("init", seg, "--labels", "none", *SMALL[:4], *blocks, "-o", tmp_path / "b.ply")
    assert "label map" not in plain.err
    assert "automatic" in plain.err
    assert (tmp_path / "a.ply").read_bytes() != (tmp_path / "b.ply").read_bytes()
    assert '"label_map": true' in vvgt("info", seg, "--json").out.decode()


def test_a_segmentation_is_its_own_table(tmp_path: Path) -> None:
    from vvgt_cli.field.source import SourceRequest, load

    values = np.array([0, 1, 3, 1, 0, 3, 1, 0], np.uint8)
    (tmp_path / "x.seg.nrrd").write_bytes(SEGMENTS.encode() + values.tobytes())
    with pytest.warns(UserWarning, match="read as a label map"):
        table = load(SourceRequest(str(tmp_path / "x.seg.nrrd"))).tf
    assert isinstance(table, LabelTable)
    assert [(e.number, e.name) for e in table.labels] == [(1, "skin"), (3, "inner_core")]


@pytest.mark.filterwarnings("ignore:.*read as a label map")
def test_a_session_of_a_file_keeps_its_segments(tmp_path: Path) -> None:
    path = tmp_path / "x.seg.nrrd"
    path.write_bytes(SEGMENTS.replace("sizes: 2 2 2", "sizes: 24 24 24").encode() + balls().tobytes())
    how = {"max_gaussians": 100, "screen": 48, "steps": 0}
    session = library.Session(path)
    found, wanted = session.convert(**how).gaussians, library.convert(path, **how).gaussians
    np.testing.assert_array_equal(found.colors, wanted.colors)
    assert not np.array_equal(session.convert("gray", **how).gaussians.colors, found.colors)


def test_one_file_a_label_and_they_add_up(vvgt, tmp_path: Path, seg: Path) -> None:
    labels = table(tmp_path, JSON, "a.json")
    vvgt.ok("convert", seg, "--labels", labels, "--split-labels", *SMALL, "-o", tmp_path / "p_{}.ply")
    index = json.loads((tmp_path / "p_index.json").read_text())
    assert [(row["label"], row["file"]) for row in index["files"]] == [(1, "p_1-skin.ply"), (3, "p_3-inner-core.ply")]
    assert sum(row["gaussians"] for row in index["files"]) <= 300
    headers = [read_ply(str(tmp_path / row["file"]))[1] for row in index["files"]]
    assert headers[0].affine == headers[1].affine
    assert (
        "exists"
        in vvgt("convert", seg, "--labels", labels, "--split-labels", *SMALL, "-o", tmp_path / "p_{}.ply").error
    )


def test_extinctions_of_labels_add_up_to_the_whole() -> None:
    from vvgt_cli.dvr.layers import Layer

    volume, whole = Volume(balls()), distinct([0, 1, 3])
    grids = [grid_of([Layer(volume, t, 1.0)], volume) for t in (whole, whole.only(1), whole.only(3))]
    np.testing.assert_array_equal(grids[0], grids[1] + grids[2])
    assert (grids[1].any(axis=-1) == (balls() == 1)).all()


@pytest.mark.parametrize(
    ("values", "text", "said"),
    [
        (balls(), SLICER.replace("3 inner_core", "4 other"), "in t.ctbl: 3; it has 1 (skin), 4 (other); add them"),
        (balls(), "9 other 1 2 3 255\n", "none of its labels (1, 3) is in t.ctbl, which has 9"),
        (balls() * 0, SLICER, "no label other than 0"),
    ],
)
def test_labels_that_do_not_fit_are_one_line(vvgt, tmp_path: Path, values, text: str, said: str) -> None:
    np.save(tmp_path / "v.npy", values)
    given = ("--labels", table(tmp_path, text, "t.ctbl"), "-o", tmp_path / "a.ply")
    done = vvgt.fails(1, "init", tmp_path / "v.npy", *given)
    assert said in done


def test_calls_that_contradict(vvgt, tmp_path: Path, seg: Path) -> None:
    out = ("-o", tmp_path / "a_{}.ply")
    for options, said in (
        (("--labels", "auto", "--tf", "gray"), "expected one of --tf and --labels"),
        (("--labels", tmp_path / "no.ctbl"), "no such file"),
        (("--split-labels", "--tf", "gray"), "remove it"),
        (("--split-labels", "--dry-run"), "--dry-run"),
        (("--split-labels", "-o", tmp_path / "a.ply"), "label's name"),
    ):
        assert said in vvgt.fails(2, "convert", seg, *([] if "-o" in options else out), *options)
    np.save(tmp_path / "empty_seg.npy", balls() * 0)
    assert (
        "no label other than 0"
        in vvgt("init", tmp_path / "empty_seg.npy", "--labels", "auto", "-o", tmp_path / "a.ply").error
    )


def test_a_series_without_labels_is_one_line(vvgt, tmp_path: Path) -> None:
    for k in range(2):
        np.save(tmp_path / f"v{k}.npy", balls() * 0)
    given = ("--labels", table(tmp_path, SLICER, "t.ctbl"), "-o", tmp_path / "a_{}.ply")
    done = vvgt.fails(1, "convert", tmp_path / "v?.npy", *given)
    assert "the series: none of its labels (only 0) is in t.ctbl" in done


def test_a_series_of_label_maps_has_the_same_colours(vvgt, tmp_path: Path) -> None:
    for k in range(2):
        np.save(tmp_path / f"run_seg_{k}.npy", np.where(balls() == 3, 3 if k else 1, balls()).astype(np.uint8))
    look = ("--labels", "auto", "--light", "none")
    vvgt.ok("convert", tmp_path / "run_seg_*.npy", *look, *SMALL, "-o", tmp_path / "o_{}.ply")
    first, second = (read_ply(str(tmp_path / f"o_{k}.ply"))[0].colors for k in range(2))
    wanted = distinct([1]).labels[0].color
    np.testing.assert_allclose(np.median(first, axis=0), wanted, atol=0.05)
    np.testing.assert_allclose(np.median(second, axis=0), wanted, atol=0.05)


def test_in_python() -> None:
    entries = {1: {"color": [1, 0, 0], "opacity": 0.1}, 3: {"color": "#0000ff"}}
    result = library.convert(balls(), library.Look(labels=entries), max_gaussians=300, screen=64, steps=0)
    assert result.gaussians.colors[:, 1].max() < 0.05
    _, images = library.render_views(balls(), library.Look(labels=entries), views=2, size=32)
    assert images[..., 0].max() > 0.1 < images[..., 2].max()
    assert images[..., 1].max() == 0
    refused(DataError, "no entry", library.convert, balls(), library.Look(labels={1: {"color": [1, 0, 0]}}))
    refused(UsageError, "no such file", library.convert, balls(), library.Look(labels="nowhere.ctbl"))
    assert isinstance(distinct([1]), LabelTable)


def overlapping(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """A .seg.nrrd of two layers, as 3D Slicer writes segments that overlap: label 1 in both, and 2 in the second."""
    a, b = np.zeros((2, 10, 12, 14), np.uint8)
    a[2:8, 2:10, 2:8] = 1
    b[2:8, 2:10, 6:12] = 1
    b[4:6, 2:10, 6:8] = 2
    header = (
        "NRRD0004\ntype: uchar\ndimension: 4\nspace: left-posterior-superior\nsizes: 2 14 12 10\n"
        "space directions: none (1,0,0) (0,1,0) (0,0,1)\nkinds: list domain domain domain\nencoding: raw\n"
        "space origin: (0,0,0)\nSegment0_LabelValue:=1\nSegment0_Layer:=0\nSegment0_Name:=liver\n"
        "Segment0_Color:=1 0 0\nSegment1_LabelValue:=1\nSegment1_Layer:=1\nSegment1_Name:=lesion\n"
        "Segment1_Color:=0 0 1\nSegment2_LabelValue:=2\nSegment2_Layer:=1\nSegment2_Name:=vein\n"
        "Segment2_Color:=0 1 0\n\n"
    )
    path.write_bytes(header.encode() + np.stack([a, b], axis=-1).tobytes())
    return a, b


def test_segments_that_overlap_add_up(vvgt, tmp_path: Path) -> None:
    path = tmp_path / "x.seg.nrrd"
    a, b = overlapping(path)
    source = load(SourceRequest(str(path)))
    grid = grid_of(source.layers, source.volume)
    solid = grid[2, 2, 2, 3]
    np.testing.assert_allclose(grid[..., 3], solid * ((a > 0).astype(int) + (b > 0)), rtol=1e-6)
    np.testing.assert_allclose(grid[..., :3], solid * np.stack([a == 1, b == 2, b == 1], axis=-1), rtol=1e-6)
    vvgt.ok("convert", path, "--split-labels", "--light", "none", *SMALL, "-o", tmp_path / "p_{}.ply")
    index = json.loads((tmp_path / "p_index.json").read_text())
    assert [(row["name"], row["file"]) for row in index["files"]] == [
        ("liver", "p_0-1-liver.ply"), ("lesion", "p_1-1-lesion.ply"), ("vein", "p_2-vein.ply")
    ]  # fmt: skip
    wanted = ((1, 0, 0), (0, 0, 1), (0, 1, 0))
    for row, color in zip(index["files"], wanted, strict=True):
        colors = read_ply(str(tmp_path / row["file"]))[0].colors
        assert np.median(colors @ color) > 0.7
        assert np.abs(colors[:, np.array(color) == 0]).max() < 1e-6
    facts = json.loads(vvgt("info", path, "--json").out)
    assert facts["segment_layers"] == 2
    assert [row["name"] for row in facts["segments"]] == ["liver", "lesion", "vein"]
    vvgt.ok("init", "example:blob:8", "--layer", path, *SMALL[:4], "-o", tmp_path / "l.ply")
    for options in (("--tf", "gray"), ("--labels", "none")):
        assert "2 layers of segments that overlap" in vvgt.fails(2, "init", path, *options, "-o", tmp_path / "n.ply")
    vvgt.ok("init", path, "--component", 1, *SMALL[:4], "-o", tmp_path / "c.ply")
    series = vvgt("convert", tmp_path / "*.seg.nrrd", *SMALL, "-o", tmp_path / "s_{}.ply")
    assert "convert such frames one by one" in series.error
    path.write_bytes(path.read_bytes().replace(b"Segment0_Layer:=0", b"Segment0_Layer:=7"))
    vvgt.ok("init", path, *SMALL[:4], "-o", tmp_path / "n.ply")
    assert json.loads(read_ply(str(tmp_path / "n.ply"))[1].legend)["labels"][0][0] == "x.seg 0"


def test_labels_of_a_series_are_those_that_there_are(vvgt, tmp_path: Path) -> None:
    """Two labels of numbers that are far apart make a table of two, not of all between."""
    far = np.where(balls() == 3, 2_000_000_000, balls()).astype(np.int32)
    for k in range(2):
        np.save(tmp_path / f"run_seg_{k}.npy", far)
    vvgt.ok("convert", tmp_path / "run_seg_*.npy", "--light", "none", *SMALL, "-o", tmp_path / "o_{}.ply")
    colors = read_ply(str(tmp_path / "o_1.ply"))[0].colors
    near = np.abs(colors[:, None] - [e.color for e in distinct([1, 2_000_000_000]).labels]).max(axis=2).min(axis=1)
    assert np.median(near) < 0.1


def test_tables_are_listed_and_distinguished_from_functions(vvgt, tmp_path: Path) -> None:
    for text, name in ((SLICER, "a.ctbl"), (FREESURFER, "LUT.txt"), (SNAP, "a.label"), (JSON, "a.json")):
        path = table(tmp_path, text, name)
        facts = json.loads(vvgt("info", path, "--json").out)
        shown = [(e["label"], e["name"]) for e in facts["entries"] if e["label"]]
        assert (facts["kind"], shown) == ("table of labels", [(1, "skin"), (3, "inner_core")]), name
        lines = vvgt("info", path).out.decode().splitlines()
        assert lines[-1].strip().startswith("label 3, name inner_core, color 0 0 1, opacity 1")
        for call in (
            ("tf", "show", path, "-o", tmp_path / "a.png"),
            ("init", "example:blob:8", "--tf", path, "-o", "b.ply"),
        ):
            assert "a table of labels; expected a transfer function: give the table to --labels" in vvgt(*call).error
    refused(DataError, "not a transfer function", library.convert, balls(), table(tmp_path, '{"range": 0.5}', "b.json"))
    (tmp_path / "notes.txt").write_text("nothing of the kind")
    assert "notes.txt" in vvgt("info", tmp_path / "notes.txt").error


def test_evaluate_reports_different_labels(vvgt, tmp_path: Path, seg: Path) -> None:
    ply, labels = tmp_path / "a.ply", table(tmp_path, JSON, "a.json")
    vvgt.ok("init", seg, "--labels", labels, *SMALL[:4], "-o", ply)
    again = table(
        tmp_path, JSON.replace("inner_core", "heart").replace("}}", '}, "7": {"color": [1, 1, 1]}}'), "b.json"
    )
    asked = ("evaluate", ply, "--volume", seg, "--no-conditions", "--step", 2, "--screen", 24, "-q")
    for options, others in (
        (("--labels", labels), False),
        (("--labels", again), False),  # other names, and a label that the volume has not got
        (("--labels", "auto"), True),
        (("--labels", "none"), True),
        (("--labels", labels, "--layer", "example:blob:8,tf=gray"), True),
    ):
        assert ("made with other labels, functions or layers" in vvgt.ok(*asked[:-1], *options).err) is others, options
    vvgt.ok("init", seg, "--labels", "none", *SMALL[:4], "-o", tmp_path / "s.ply")
    assert read_ply(str(tmp_path / "s.ply"))[1].optics is None  # of scalars the header is what it was
    header = read_ply(str(ply))[1]
    assert layout_of(header).optics == header.optics


NNUNET = {"channel_names": {"0": "CT"}, "labels": {"background": 0, "skin": 1, "core": 3}}
DECATHLON = {"modality": {"0": "CT"}, "labels": {"0": "background", "1": "skin", "3": "core"}}
CATEGORICAL = [{"Name": "organs", "IndexedColors": [1, 0.2, 0, 0, 0, 1], "Annotations": ["1", "skin", "3", "core"]}]
NAMES = {"1": "skin", "3": "core"}


def test_what_may_be_anything_is_no_table(vvgt, tmp_path: Path) -> None:
    for name, text in (("a.json", '{"a": 1}'), ("b.csv", "x,y\n1,2\n"), ("c.csv", "1,2\n3,4\n")):
        (tmp_path / name).write_text(text)
        assert "of no known format" in vvgt.fails(1, "info", tmp_path / name)


@pytest.mark.parametrize(
    ("table_json", "pick"),
    [
        (NNUNET, ""), (DECATHLON, ""), (NAMES, ""), ({"skin": 1, "core": 3}, ""), ({"total": NAMES}, ""),
        ({"total": NAMES, "lung": {"1": "lung"}}, "#total"), (CATEGORICAL, ""), (CATEGORICAL[0], ""),
        ([*CATEGORICAL, {"Name": "other", "IndexedColors": [0, 0, 0]}], "#organs"),
    ],
)  # fmt: skip
def test_names_in_json(vvgt, tmp_path: Path, seg: Path, table_json, pick: str) -> None:
    path = table(tmp_path, json.dumps(table_json), "names.json")
    found = read_labels(path + pick).structures
    assert [(e.number, e.name) for e in found] == [(1, "skin"), (3, "core")]
    if "IndexedColors" in str(table_json):
        assert [e.color for e in found] == [(1, 0.2, 0), (0, 0, 1)]
    else:
        assert [e.color for e in found] == [e.color for e in distinct([1, 3]).labels]
    vvgt.ok("init", seg, "--labels", path + pick, *SMALL[:4], "-o", tmp_path / "x.ply")
    assert [name for name, _ in json.loads(read_ply(str(tmp_path / "x.ply"))[1].legend)["labels"]] == ["skin", "core"]
    if not pick:
        assert json.loads(vvgt("info", path, "--json").out)["kind"] == "table of labels"
        said = vvgt.fails(1, "init", seg, "--tf", path, "-o", tmp_path / "y.ply")
        assert "a table of labels; expected a transfer function: give the table to --labels" in said


@pytest.mark.parametrize(
    "table_json",
    [
        [{"id": 1, "name": "skin", "color": [255, 0, 0]}, {"id": 3, "name": "core", "color": [0, 0, 128]}],
        {"labels": [{"value": 1, "label": "skin", "color": "#ff0000"},
                    {"value": 3, "label": "core", "color": "#000080"}]},
        {"info": {}, "categories": [{"id": 1, "name": "skin", "rgb": [255, 0, 0]},
                                    {"id": 3, "name": "core", "rgb": [0, 0, 128]}]},
        [{"acronym": "s", "id": 1, "name": "skin", "rgb_triplet": [255, 0, 0]},
         {"acronym": "c", "id": 3, "name": "core", "rgb_triplet": [0, 0, 128]}],
        {"1": {"name": "skin", "color": [255, 0, 0, 255]}, "3": {"name": "core", "color": [0, 0, 128]}},
        {"1": "#ff0000", "3": "#000080"},
        {"1": [255, 0, 0], "3": [0, 0, 128]},
    ],
)  # fmt: skip
def test_lists_and_colors_to_255_in_json(tmp_path: Path, table_json) -> None:
    found = read_labels(table(tmp_path, json.dumps(table_json), "names.json")).structures
    names = ["skin", "core"] if "skin" in str(table_json) else ["label 1", "label 3"]
    assert [(e.number, e.name, e.opacity) for e in found] == [(1, names[0], 1), (3, names[1], 1)]
    np.testing.assert_allclose([e.color for e in found], [(1, 0, 0), (0, 0, 128 / 255)])


def test_a_fourth_channel_in_json_is_opacity(tmp_path: Path) -> None:
    found = read_labels(
        table(tmp_path, '{"1": [255, 0, 0, 51], "2": {"color": [0, 0, 1, 1], "opacity": 0.5}}', "a.json")
    )
    assert [e.opacity for e in found.labels] == [0.2, 0.5]
    listed = '[{"id": 1, "r": 255, "g": 0, "b": 0, "a": 51}, {"id": 2, "color": [0, 255, 0], "alpha": 102}]'
    found = read_labels(table(tmp_path, listed, "b.json"))
    assert [(e.color, e.opacity) for e in found.labels] == [((1, 0, 0), 0.2), ((0, 1, 0), 0.4)]
    for alphas, wanted in (((1, 0.5), [1, 0.5]), ((0, 0), [1, 1]), ((255, 1), [1, 1 / 255])):
        listed = [{"id": k + 1, "r": 255.0, "g": 0.0, "b": 0, "a": a} for k, a in enumerate(alphas)]
        assert [e.opacity for e in read_labels(table(tmp_path, json.dumps(listed), "c.json")).labels] == wanted


def test_regions_are_groups_and_dataset_json_is_offered(vvgt, tmp_path: Path) -> None:
    regions = {"labels": {"background": 0, "whole": [1, 2, 3], "core": [2, 3], "enhancing": [3]}}
    path = table(tmp_path, json.dumps(regions), "dataset.json")
    found = [(e.number, e.name, e.parents) for e in read_labels(path).structures]
    assert found == [(1, "whole", ()), (2, "core", ("whole",)), (3, "enhancing", ("whole", "core"))]
    (tmp_path / "labelsTr").mkdir()
    np.save(case := tmp_path / "labelsTr" / "case_1.npy", balls())
    with pytest.warns(UserWarning, match=r"dataset\.json may name its labels \(try --labels"):
        vvgt.ok("init", case, "--labels", "auto", *SMALL[:4], "-o", tmp_path / "x.ply")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"skin": 1, "core": 1}', "label 1 is 'core' and 'skin'|label 1 is 'skin' and 'core'"),
        ('{"1": "skin", "1": "core"}', "'1' twice"),
        ('{"labels": {}}', "no labels"),
        ('{"skin": 1.5}', "'skin'"),
        ('{"a": {"1": "x"}, "b": {"1": "y"}}', "one of a, b"),
        ('[{"IndexedColors": [0, 0, 0]}]', "no Annotations"),
        ('[{"name": "skin"}]', "without a number"),
        ('{"1": [256, 0, 0]}', "label 1: colour: .*three numbers"),
    ],
)
def test_faulty_names_in_json(tmp_path: Path, text: str, said: str) -> None:
    refused(DataError, said, read_labels, table(tmp_path, text, "a.json"))
