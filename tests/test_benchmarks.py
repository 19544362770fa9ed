"""Programs of benchmarks/, run on one tiny scene with tiny pictures."""

import csv
import importlib
import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from vvgt_cli.cameras import default_views
from vvgt_cli.commands.main import run
from vvgt_cli.dvr import RenderSettings
from vvgt_cli.network.card import find_model
from vvgt_cli.volume import read_volume
from vvgt_cli.volume.writers import write_nrrd

pytestmark = pytest.mark.long
ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "benchmarks"
SIZE = 24
FEW = f"--max-gaussians 60 --screen {SIZE}"
PARTS = f"{FEW} --steps 24".replace("60", "300")
LOOK = ("--tf", "shells.json", "--opacity-unit-distance", "mean-spacing")
REFINED = {
    "K": 40, "SIZE": SIZE, "ADAM_STEPS": 2, "BASE_VIEWS": 2, "MAX_VIEWS": 2,
    "STEPS": {"ours": (0, 2), "adam": (2,), "3dgs": (2,), "ivr-gs": (2,)},
}  # fmt: skip
MODEL = find_model("vvgt-small")
VTK = {"default_views": default_views, "NAMES": ("blob",), "VIEWS": (0,)}
SMALL = {
    "SIZES": (8,), "KINDS": ("shells",), "TRAINED": range(1), "HELD": range(100, 101), "GRID": 8, "SNAPSHOTS": 1,
    "FIRST": 0.01, "EVERY": 0.01,
}  # fmt: skip

# (program, in place of its constants, words, column of a.csv, its least value); SCENES are a list and two folders
TABLES = [
    ("closed_form", {}, "SCENES -o a.csv --max-gaussians 60 --step 1", "psnr", 15),
    ("dvr_pixels", {}, "SCENES -o a.csv", "reference_db", 20),
    ("dvr_vtk", VTK | {"REPEATS": 1, "OURS": (0.5, 1.0)}, "SCENES -o a.csv --sizes 50", "vtk_db", 15),
    ("grids", {"K": 60, "SIZE": SIZE}, "SCENES -o a.csv --repeats 1", "view_s", 0),
    ("light_paths", {}, "SCENES -o a.csv --size 8 --paths 8", "grid_db", 8),
    ("light_vtk", VTK, "SCENES -o a.csv --size 50", "gpu_db", 15),
    ("live", {"SIZE": SIZE}, "SCENES -o a.csv --gaussians 200 --direct", "live", 15),
    ("live", {"SIZE": SIZE}, "SCENES -o a.csv --gaussians 200 --lit", "closed form", 15),
    ("network", {"default_views": default_views, "CASES": [("lines", 64, 2, 1)]}, "measure MODEL -o a.csv --repeats 1",
     "peak_gib", 0.05),
    ("page", {"KINDS": {"lit": (0, "headlight", None), "mip": (1, "none", "mip")}},
     "SCENES -o a.csv --size 64 --kind lit --kind mip --pictures pictures", "rest", 30),
    ("parts", {}, f"SCENES -o a.csv -- {PARTS}", "psnr", 10),
    ("plan", {"KINDS": {"default": tuple(f"{FEW} --steps 1".split())}}, "SCENES -o a.csv", "predicted_s", 0),
    ("refinement", REFINED, "equal SCENES -o a.csv", "closed_form", 10),
    ("refinement", REFINED, "curve SCENES -o a.csv", "steps", -1),
    ("curve", {"SIZE": SIZE}, f"measure SCENES files --state before={ROOT} --steps 1 -- {FEW};"
     " score SCENES files -o a.csv; plot a.csv -o a.png", "psnr", 10),
    ("levels", {}, f"LEVELS SCENES/blob.nrrd {' '.join(LOOK)} --size 64 -o a.csv --plot a.png", "rms", 0),
    ("share", {"EDGE": SIZE}, "SCENES . -o a.csv --pictures pictures", "psnr", 10),
    ("damaged", {"ROWS": 5}, f"blob.ply --volume blob.nrrd {' '.join(LOOK)} -o a.csv", None, None),
    ("training", {}, "gain SCENES -o a.csv --gaussians 40 --ways network --model vvgt-small --cache cache", "psnr", 10),
    ("training", SMALL, "data data", None, None),
    ("values_back", {"CODECS": {}}, "SCENES -o a.csv --gaussians 200", "psnr", 15),
]  # fmt: skip
PRINTED = [  # (program, constants, words, what it prints)
    ("dvr", {"SIZE": SIZE, "REPEATS": 1, "SETTINGS": {"one": RenderSettings(samples=1)}}, "ns/sample"),
    ("optimize", {"REPEATS": 1}, "40 Gaussians"),
    ("splat", {"COUNT": 40, "REPEATS": 1, "SIZES": (SIZE,)}, "40 Gaussians"),
]


@pytest.fixture
def bench(monkeypatch):
    """Import a benchmark, with pictures of `SIZE` px and what else is given in place of its constants."""
    monkeypatch.syspath_prepend(str(FOLDER))

    def load(name, **constants):
        module = importlib.import_module(name)
        usual = {
            "default_views": lambda name, count=None, size=None, **options: default_views(
                name, count, size=SIZE, **options
            ),
            "flops": lambda dtype: 1e9,
            "bandwidth": lambda: 1e9,
        }
        kept = {
            key: value for key, value in usual.items() if hasattr(module, key) and name not in ("network", "floors")
        }
        for constant, value in (kept | constants).items():
            assert hasattr(module, constant), f"{name} has no {constant}"
            monkeypatch.setattr(module, constant, value)
        return module

    return load


@pytest.fixture
def scenes(tmp_path, monkeypatch):
    """A working folder with a list of one scene, its volume, function and file of Gaussians; what names the three."""
    monkeypatch.chdir(tmp_path)
    write_nrrd(tmp_path / "blob.nrrd", read_volume("example:blob:10"))
    points = [{"x": x, "rgb": [x, 0.5, 1 - x], "opacity": o} for x, o in ((0, 0), (0.2, 0), (0.4, 0.5), (1, 0.8))]
    (tmp_path / "shells.json").write_text(json.dumps({"range": [0, 1], "points": points}))
    columns = "# made by hand\nscene\tvolume\toptions\tfunction\n"
    (tmp_path / "scenes.tsv").write_text(f"{columns}blob\tblob.nrrd\t--spacing 1 1 1\tshells.json\n")
    assert run(["init", "blob.nrrd", *LOOK, *FEW.split(), "-q", "-o", "blob.ply"]) == 0
    return [str(tmp_path / "scenes.tsv"), str(tmp_path), str(tmp_path)]


def call(command, words, scenes):
    given = {"SCENES": scenes, "MODEL": [str(MODEL)], "SCENES/blob.nrrd": ["blob.nrrd"], "LEVELS": ["levels"]}
    args = [arg for word in words.split() for arg in given.get(word, [word])]
    done = CliRunner().invoke(command, args, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize(("name", "constants", "words", "column", "least"), TABLES, ids=[row[0] for row in TABLES])
def test_tables(bench, scenes, name, constants, words, column, least):
    if name.endswith("vtk"):
        from vvgt_cli.dvr.vtk import require_opengl

        require_opengl()
    if name == "levels":
        many = ("--max-gaussians", "2000", "--screen", "64", "-q", "-o", "levels/lod-meta.json")
        assert run(["init", "blob.nrrd", *LOOK, *many]) == 0
    module = bench(name, **constants)
    for line in words.split("; "):
        call(module.main, line, scenes)
    if column:
        found = [row[column] for row in csv.DictReader(Path("a.csv").read_text().splitlines())]
        assert any(found)
        assert all(float(value) > least for value in found if value)
    if any("--table" in option.opts for option in getattr(module.main, "params", [])):
        assert len(call(module.main, "--table a.csv", scenes).split()) > 8


@pytest.mark.parametrize(("name", "constants", "text"), PRINTED, ids=[row[0] for row in PRINTED])
def test_printed(bench, capsys, name, constants, text):
    main = bench(name, **constants).main
    if name == "optimize":
        assert text in call(main, "example:blob:10 --gaussians 40", [])
    else:
        main(["example:blob:10"])
        assert text in capsys.readouterr().out


def test_readers(bench, tmp_path):
    """A small file of every row of docs/readers.csv, read whole, in blocks, and where it was written."""
    bench("readers", TIMES=1).main(["--edge", "12", "-o", str(tmp_path / "a.csv")])
    documented, rows = (
        list(csv.DictReader(path.read_text().splitlines()))
        for path in (ROOT / "docs" / "readers.csv", tmp_path / "a.csv")
    )
    same = ("format", "whole", "blocks", "series")
    assert [[row[key] for key in same] for row in rows] == [[told[key] for key in same] for told in documented]
    assert all(row["whole"] in ("yes", "resampled") for row in rows)
    assert all(float(row["place"] or 0) < 0.01 for row in rows)
