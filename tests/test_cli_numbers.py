"""Options of several numbers as people write them, and words that are nearly right."""

import json
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from vvgt_cli.commands.words import expand
from vvgt_cli.errors import UsageError
from vvgt_cli.volume.plain.raw import guess_dims
from vvgt_cli.volume.shapes import blob

FORMS = (
    "64 64 93", "64,64,93", "64x64x93", "64X64X93", "64, 64, 93", "64 x 64 x 93", "64,64 93", "64×64×93", "64 ,64 ,93",
)  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_three_numbers_in_any_form(form: str) -> None:
    expected = ["convert", "a", "--dims", "64", "64", "93", "--dtype", "uint8"]
    assert expand(["convert", "a", "--dims", *form.split(" "), "--dtype", "uint8"]) == expected
    first, *rest = form.split(" ")
    assert expand(["convert", "a", f"--dims={first}", *rest, "--dtype", "uint8"]) == expected


def test_numbers_of_other_options_and_other_words_are_left_alone() -> None:
    for line in (
        "convert 1,2,3 -o 4,5", "x --tf-range data 5", "x --tf-range rescale", "x --tf-range 5", "x -- --dims 1,2,3",
        "x --spacing 0.5 1e-3 -2.", "x --tf-range 100,200 3", "",
    ):  # fmt: skip
        assert expand(line.split()) == line.split()
    for line, expected in (
        ("x --tf-range -1000 400 v.nii", "x --tf-range -1000,400 v.nii"),
        ("x --tf-range=-1e3, 400 v", "x --tf-range -1e3,400 v"),
        ("x --spacing .5,1e-3,2 5", "x --spacing .5 1e-3 2 5"),
    ):
        assert expand(line.split()) == expected.split()


@pytest.mark.parametrize("line", ["--dims 64 64 --dtype uint8", "--dims 64,64", "--dims", "--dims 1,2,3,4"])
def test_what_is_not_three_numbers_is_said_with_the_syntax(line: str) -> None:
    with pytest.raises(UsageError, match=r"expected three numbers, as --dims 256 256 128 or --dims 256,256,128"):
        expand(line.split())


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_the_command_line_takes_both_forms(vvgt) -> None:
    np.arange(4 * 5 * 6, dtype=np.uint8).tofile("v.raw")
    for dims in (["4,5,6"], ["4", "5", "6"]):
        result = vvgt("info", "v.raw", "--dims", *dims, "--dtype", "uint8", "--json")
        assert (result.code, json.loads(result.out)["dims"]) == (0, [4, 5, 6])
    options = ("--volume", "v.raw", "--dims", "4,5,6", "--dtype", "uint8", "--overwrite")
    pictures = []
    for limits in (["20,90"], ["20", "90"]):
        vvgt.ok("tf", "show", "viridis", "-o", "a.png", *options, "--tf-range", *limits)
        pictures.append(Path("a.png").read_bytes())
    assert pictures[0] == pictures[1]


def test_a_name_with_line_breaks_stays_on_a_line(vvgt) -> None:
    np.save("a\nb\x85c.npy", blob((12, 12, 12)).data)
    assert "name           a b c" in vvgt.ok("info", "a\nb\x85c.npy").out.decode().split("\n")
    lines = vvgt.ok("init", "a\nb\x85c.npy", "-o", "d\ne.ply", "--max-gaussians", 50, "--screen", 32).err.splitlines()
    assert sum(line.startswith("read ") and "a b c: 12 x 12 x 12" in line for line in lines) == 1
    assert sum(line.startswith("write ") and "d e.ply: " in line for line in lines) == 1
    assert "a b" in vvgt("init", "no\nsuch\nfile.nrrd", "-o", "a b.ply").error.replace("no such file.nrrd", "a b")


def test_raw_values_read_in_another_order_than_they_lie_in_are_told(vvgt, recwarn) -> None:
    dims = (40, 28, 20)
    blob(dims).data.tofile("v.raw")
    for order in permutations(dims):
        data = np.fromfile("v.raw", np.float32).reshape(order[::-1])
        assert guess_dims(data) == (None if order == dims else dims)
        recwarn.clear()
        vvgt.ok("info", "v.raw", "--dims", *order, "--dtype", "float32")
        assert ["did you mean --dims 40 28 20?" in str(w.message) for w in recwarn] == [True] * (order != dims)


def test_of_noise_cubes_and_tiny_volumes_no_order_is_told() -> None:
    assert guess_dims(np.random.default_rng(0).random((20, 30, 40))) is None
    assert guess_dims(blob((24, 24, 24)).data) is None
    assert guess_dims(np.arange(24.0).reshape(2, 3, 4)) is None
    assert guess_dims(np.full((20, 30, 40), np.nan)) is None
