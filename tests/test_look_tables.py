"""Tables of labels: whether A is opacity or transparency, CSV and TSV of several programs, what a table hides."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError
from vvgt_cli.look.label_files import is_table, read_labels

ROWS = "0 background 0 0 0 0\n1 tissue 128 174 128 {a}\n2 bone 241 214 145 {b}\n3 fat 230 220 70 {c}\n"
SLICER_CSV = (
    "LabelValue,Name,Color_R,Color_G,Color_B,Color_A,Category_CodingScheme,Category_CodeValue,Category_CodeMeaning\n"
    '1,"left  lung, upper",255,51,0,128,SCT,123,"Tissue, any"\n3,heart,0,0,255,255,SCT,1,\n'
)
BIDS = "index\tname\tabbreviation\tcolor\tmapping\n1\tGray Matter\tGM\t#ff3300\t1\n3\tWhite\tWM\t#0000FF\t2\n"
FASTSURFER = (
    "ID\tLabelName\tR\tG\tB\tA\n0\tBackground\t0\t0\t0\t0\n1\tLeft-Thalamus\t255\t51\t0\t0\n3\tCSF\t0\t0\t255\t0\n"
)


def saved(tmp_path: Path, name: str, text: str, encoding: str = "utf-8") -> str:
    (tmp_path / name).write_bytes(text.encode(encoding))
    return str(tmp_path / name)


def opacities(tmp_path: Path, name: str, text: str) -> list[float]:
    return [round(label.opacity, 3) for label in read_labels(saved(tmp_path, name, text)).labels]


@pytest.mark.parametrize(
    ("name", "comment", "given", "expected"),
    [
        ("t.txt", "# Filename: any", (255, 255, 255), (1, 1, 1)),  # 3D Slicer's ColorFiles/*.txt
        ("t.txt", "", (0, 0, 0), (1, 1, 1)),  # FreeSurfer's
        ("t.txt", "#$Id: FreeSurferColorLUT.txt", (255, 255, 255), (1, 1, 1)),  # as 3D Slicer ships it
        ("t.txt", "#No. Label Name: R G B A", (0, 255, 51), (1, 0, 0.8)),
        ("t.txt", "# Color table file x\n# 4 values", (0, 255, 51), (0, 1, 0.2)),
        ("t.ctbl", "", (0, 255, 51), (0, 1, 0.2)),
        ("t.ctbl", "", (0, 0, 0), (0, 0, 0)),
    ],
)
def test_what_a_is(tmp_path: Path, name: str, comment: str, given: tuple, expected: tuple) -> None:
    text = f"{comment}\n" + ROWS.format(**dict(zip("abc", given, strict=True)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert opacities(tmp_path, name, text) == [0, *expected]


@pytest.mark.parametrize(
    ("given", "expected", "said"),
    [
        ((255, 0, 200), (1, 0, 0.784), "read as opacity, as in 3D Slicer; for transparency begin the table"),
        ((0, 0, 128), (1, 1, 0.498), r"read as transparency, as in FreeSurfer; for opacity let its name end in .ctbl"),
    ],
)
def test_a_reading_that_is_a_guess_is_said(tmp_path: Path, given: tuple, expected: tuple, said: str) -> None:
    text = ROWS.format(**dict(zip("abc", given, strict=True)))
    with pytest.warns(UserWarning, match=said):
        assert opacities(tmp_path, "t.txt", text) == [0, *expected]


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize(
    ("name", "text", "names", "opacity"),
    [
        ("s.csv", SLICER_CSV, ("left  lung, upper", "heart"), 0.502),
        (
            "s.csv",
            SLICER_CSV.replace('lung, upper"', 'lung; upper"').replace(",", ";"),
            ("left  lung; upper", "heart"),
            0.502,
        ),
        (
            "s.tsv",
            SLICER_CSV.replace('"left  lung, upper"', "left  lung").replace(",", "\t"),
            ("left  lung", "heart"),
            0.502,
        ),
        ("dseg.tsv", BIDS, ("Gray Matter", "White"), 1),
        ("f.tsv", FASTSURFER, ("Left-Thalamus", "CSF"), 1),
        ("f.csv", "# made by hand\n" + FASTSURFER.replace("\t", ","), ("Left-Thalamus", "CSF"), 1),
        ("n.csv", "1,liver,255,51,0,255\n3,x,0,0,255,255\n", ("liver", "x"), 1),
        ("d.csv", "id,name,red,green,blue\n1.0,a,255,51,0\n3.0,b,0,0,255.0\n", ("a", "b"), 1),
    ],
)
def test_separated_tables(tmp_path, name, text, names, opacity, encoding, newline) -> None:
    path = saved(tmp_path, name, text.replace("\n", newline), encoding)
    first, second = (label for label in read_labels(path).labels if label.number)
    assert (first.number, second.number, first.name, second.name) == (1, 3, *names)
    np.testing.assert_allclose([first.color, second.color], [(1, 0.2, 0), (0, 0, 1)])
    assert (round(first.opacity, 3), second.opacity) == (opacity, 1)
    assert is_table(Path(path))


def test_labels_without_a_colour_get_distinct_ones(tmp_path: Path) -> None:
    text = BIDS.replace("#0000FF", "n/a").replace("White", "")
    with pytest.warns(UserWarning, match=r"dseg.tsv: 1 labels have no colour; given distinct ones"):
        first, second = read_labels(saved(tmp_path, "dseg.tsv", text)).labels
    assert first.color == (1, 0.2, 0)
    assert second.name == "label 3"
    assert second.color not in ((0, 0, 1), first.color)


def test_decimals_of_3d_slicer_and_colours_up_to_1(tmp_path: Path) -> None:
    (label,) = read_labels(saved(tmp_path, "t.ctbl", "4 left  kidney 127.5 0 51.0 255\n")).labels
    assert (label.name, label.color) == ("left  kidney", (0.5, 0, 0.2))
    for name, text in (("t.ctbl", "4 kidney 0.5 0.1 1 1\n"), ("t.csv", "index,name,r,g,b\n4,kidney,0.5,0.1,1\n")):
        with pytest.raises(DataError, match="no colour above 1"):
            read_labels(saved(tmp_path, name, text))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no label"),
        ("index,name,r,g,b\nx,liver,1,2,3\n", "row 1: label 'x'"),
        ("index,name,r,g,b\n1,liver,1,2,red\n", "row 1: .*colour 1, 2, red"),
        ("index,name,r,g,b\n1,liver,1,2,300\n", r"row 1: colour.*in \[0, 1\]"),
        ("index,name,r,g,b\n1,a,1,2,3\n1,b,1,2,3\n", "label 1 twice"),
        ('index,name,r,g,b\n1,"' + "a" * 200_000 + '",1,2,3\n', "field larger"),
    ],
)
def test_faulty_separated_tables(tmp_path: Path, text: str, said: str) -> None:
    refused(DataError, said, read_labels, saved(tmp_path, "t.csv", text))


def test_hidden_labels_are_named(vvgt, tmp_path: Path) -> None:
    np.save(tmp_path / "labels.npy", np.repeat(np.arange(4, dtype=np.uint8), 128).reshape(8, 8, 8))
    small = ("--max-gaussians", 60, "--screen", 64, "--overwrite", "-o", tmp_path / "o.ply")
    table = saved(tmp_path, "t.ctbl", ROWS.format(a=255, b=0, c=0))
    with pytest.warns(UserWarning, match=r"labels: t.ctbl hides 2 of its labels \(opacity 0\): 2 \(bone\), 3 \(fat\)"):
        vvgt.ok("init", tmp_path / "labels.npy", "--labels", table, *small)
    solid = saved(tmp_path, "s.txt", ROWS.format(a=255, b=255, c=255))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*hides")
        vvgt.ok("init", tmp_path / "labels.npy", "--labels", solid, *small)
    none = saved(tmp_path, "n.ctbl", ROWS.format(a=0, b=0, c=0))
    with pytest.warns(UserWarning, match="hides 3 of its labels"):
        assert "try --labels auto" in vvgt("init", tmp_path / "labels.npy", "--labels", none, *small).error


def test_info_lists_a_separated_table(vvgt, tmp_path: Path) -> None:
    found = json.loads(vvgt("info", saved(tmp_path, "s.csv", SLICER_CSV), "--json").out)
    assert (found["kind"], found["labels"]) == ("table of labels", 2)
    assert found["entries"][0]["name"] == "left  lung, upper"
