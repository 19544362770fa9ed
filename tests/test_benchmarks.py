"""Every program of benchmarks/, run on one tiny scene with tiny pictures."""

import base64
import csv
import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from report_runs import document

from vvgt_cli.cameras import default_views
from vvgt_cli.commands.main import run
from vvgt_cli.dvr import RenderSettings
from vvgt_cli.gaussians.formats import read_splats
from vvgt_cli.images import read_png, write_png
from vvgt_cli.volume import Volume, read_volume
from vvgt_cli.volume.medical.nrrd import write_nrrd

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "benchmarks"
SIZE, MODEL = 24, "vvgt-small"


def test_none_is_left_out():
    source = "".join(Path(__file__).with_name(f"test_{name}.py").read_text() for name in ("benchmarks", "training"))
    programs = [path.stem for path in FOLDER.glob("*.py") if "__main__" in path.read_text()]
    assert len(programs) > 20
    assert [name for name in programs if f'bench("{name}"' not in source] == []


@pytest.fixture
def bench(monkeypatch):
    """Import a benchmark, with pictures of `SIZE` px and what else is given in place of its constants."""
    monkeypatch.syspath_prepend(str(FOLDER))

    def small_views(name, count=None, size=None, **options):
        return default_views(name, count, size=SIZE, **options)

    def load(name, **constants):
        module = importlib.import_module(name)
        assert Path(module.__file__).parent == FOLDER
        if hasattr(module, "default_views"):
            constants = {"default_views": small_views} | constants
        if hasattr(module, "flops") and name != "network":
            constants = {"flops": lambda dtype: 1e9} | constants
        for constant, value in constants.items():
            assert hasattr(module, constant), f"{name} has no {constant}"
            monkeypatch.setattr(module, constant, value)
        return module

    return load


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A list with a comment, the names of its columns and one scene; the folders of its volume and its function."""
    folder = tmp_path_factory.mktemp("scenes")
    write_nrrd(folder / "blob.nrrd", read_volume("example:blob:10"))
    points = [{"x": x, "rgb": [x, 0.5, 1 - x], "opacity": o} for x, o in ((0, 0), (0.2, 0), (0.4, 0.5), (1, 0.8))]
    (folder / "shells.json").write_text(json.dumps({"range": [0, 1], "points": points}))
    listing = folder / "scenes.tsv"
    listing.write_text(
        "# made by hand\nscene\tvolume\toptions\tfunction\nblob\tblob.nrrd\t--spacing 1 1 1\tshells.json\n"
    )
    return str(listing), str(folder), str(folder)


def call(command, *args):
    done = CliRunner().invoke(command, [str(arg) for arg in args], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def rows_of(path):
    return list(csv.DictReader(Path(path).read_text().splitlines()))


def test_the_names_of_columns_are_no_scene(bench, scenes, tmp_path):
    rows = bench("closed_form").scene_rows(scenes[0])
    assert rows == [["blob", "blob.nrrd", "--spacing 1 1 1", "shells.json"]]
    (tmp_path / "list.tsv").write_text("# scene\tvolume\nblob\tblob.nrrd\t\tshells.json\n")
    assert bench("closed_form").scene_rows(tmp_path / "list.tsv") == [["blob", "blob.nrrd", "", "shells.json"]]
    assert [name for name, _ in bench("dvr_scenes").read_scenes(*scenes)] == ["blob"]


def test_closed_form(bench, scenes, tmp_path):
    module = bench("closed_form")
    call(module.main, *scenes, "-o", tmp_path / "a.csv", "--max-gaussians", 60, "--step", 1)
    (row,) = rows_of(tmp_path / "a.csv")
    assert float(row["psnr"]) > 15
    assert "Mean PSNR, vbm" in call(module.main, "--table", tmp_path / "a.csv")


def test_readers(bench, tmp_path, capsys):
    """A small file of every row of docs/readers.csv, read whole, in blocks, and where it was written."""
    module = bench("readers", TIMES=1)
    module.main(["--edge", "12", "-o", str(tmp_path / "a.csv")])
    rows = rows_of(tmp_path / "a.csv")
    documented = rows_of(ROOT / "docs" / "readers.csv")
    assert [row["format"] for row in rows] == [row["format"] for row in documented]
    for row, told in zip(rows, documented, strict=True):
        assert [row[key] for key in ("whole", "blocks", "series")] == [
            told[key] for key in ("whole", "blocks", "series")
        ]
        assert row["whole"] in ("yes", "resampled"), row
        assert not row["place"] or float(row["place"]) < 0.01, row
    assert "| NIfTI `.nii` | nibabel |" in capsys.readouterr().out


def test_dvr(bench, capsys):
    settings = {"one": RenderSettings(samples=1)}
    bench("dvr", SIZE=SIZE, REPEATS=1, SETTINGS=settings, bandwidth=lambda: 1e9).main(["example:blob:10"])
    assert "ns/sample" in capsys.readouterr().out


def test_dvr_pixels(bench, scenes, tmp_path):
    module = bench("dvr_pixels")
    call(module.main, *scenes, "-o", tmp_path / "a.csv")
    (row,) = rows_of(tmp_path / "a.csv")
    assert float(row["reference_db"]) > float(row["one_ray_db"])
    assert "| blob |" in call(module.main, "--table", tmp_path / "a.csv").replace("scene blob", "| blob |")


def test_dvr_steps(bench, tmp_path, monkeypatch):
    module = bench("dvr_steps", STEPS={"pre-integrated": (1,), "plain": (1,)})
    monkeypatch.setattr(module, "read_volume", lambda name: read_volume(f"{name}:12"))
    call(module.main, "-o", tmp_path / "a.csv", "--repeats", 1)
    ours, plain = rows_of(tmp_path / "a.csv")
    assert float(ours["db"]) > float(plain["db"])  # through a thin shell


def test_dvr_vtk(bench, scenes, tmp_path):
    from vvgt_cli.dvr.vtk import require_opengl

    require_opengl()
    few = {"NAMES": ("blob",), "VIEWS": (0,), "REPEATS": 1, "OURS": (0.5, 1.0)}
    module = bench("dvr_vtk", default_views=default_views, **few)
    call(module.main, *scenes, "-o", tmp_path / "a.csv", "--sizes", 50)
    rows = rows_of(tmp_path / "a.csv")
    assert {row["scene"] for row in rows} == {"blob"}
    assert min(float(row["vtk_db"]) for row in rows) > 15


def test_grids(bench, scenes, tmp_path):
    module = bench("grids", K=60, SIZE=SIZE)
    call(module.main, *scenes, "-o", tmp_path / "a.csv", "--repeats", 1)
    scalars, grid = rows_of(tmp_path / "a.csv")
    assert (scalars["kind"], grid["kind"]) == ("scalars", "grid")
    assert all(float(row[column]) > 0 for row in (scalars, grid) for column in ("mb", "view_s", "closed_form_s"))
    assert "| grid |" in call(module.main, "--table", tmp_path / "a.csv")


def test_light_vtk(bench, scenes, tmp_path):
    from vvgt_cli.dvr.vtk import require_opengl

    require_opengl()
    module = bench("light_vtk", default_views=default_views, NAMES=("blob",), VIEWS=(0,))
    call(module.main, *scenes, "-o", tmp_path / "a.csv", "--size", 50)
    rows = {row["light"]: row for row in rows_of(tmp_path / "a.csv")}
    assert set(rows) == {"unlit", "headlight", "fixed"}
    assert min(float(row["gpu_db"]) for row in rows.values()) > 15
    assert "headlight" in call(module.main, "--table", tmp_path / "a.csv")


def test_live(bench, scenes, tmp_path):
    module = bench("live", SIZE=SIZE)
    call(module.main, *scenes, "-o", tmp_path / "a.csv", "--gaussians", 200, "--direct")
    rows = rows_of(tmp_path / "a.csv")
    assert [row["function"] for row in rows] == ["band", "step", "ramp"]
    assert min(float(row[look]) for row in rows for look in ("live", "converted for it")) > 15
    assert "| band |" in call(module.main, "--table", tmp_path / "a.csv")
    call(module.main, *scenes, "-o", tmp_path / "b.csv", "--gaussians", 200, "--lit")
    rows = rows_of(tmp_path / "b.csv")
    assert [row["light"] for row in rows] == ["none", "headlight", "0.3,-0.8,0.5"]
    assert min(float(row[look]) for row in rows for look in ("live", "closed form")) > 15


def test_grey(bench, scenes, tmp_path, monkeypatch):
    """A page that draws as the command does, by as many presses of k."""
    module = bench("grey")

    def page_picture(url, folder, size, actions):
        rule = module.RULES[len(actions) - 1]
        return read_png(folder / f"blob-{rule}-{size}.command.png")[..., :3], {}

    monkeypatch.setattr(module, "page_picture", page_picture)
    given = "-o", tmp_path / "a.csv", "--pictures", tmp_path / "pictures", "--gaussians", 500, "--size", SIZE
    call(module.main, *scenes, *given)
    rows = rows_of(tmp_path / "a.csv")
    assert [row["rule"] for row in rows] == ["mip", "xray"]
    assert all(20 < float(row["command"]) == float(row["page"]) < float(row["agreement"]) for row in rows)
    assert "| mip |" in call(module.main, "--table", tmp_path / "a.csv")


def test_network(bench, tmp_path):
    from vvgt_cli.network.card import find_model

    module = bench("network", default_views=default_views, CASES=[("lines", 64, 2, 1)])
    model = find_model(MODEL)
    call(module.main, "measure", model, "-o", tmp_path / "a.csv", "--repeats", 1)
    (row,) = rows_of(tmp_path / "a.csv")
    assert float(row["wall"]) > 0
    assert float(row["peak_gib"]) > 0.05
    assert row["points"].count("/") == 3


def test_optimize(bench):
    text = call(bench("optimize", REPEATS=1).main, "example:blob:10", "--gaussians", 40)
    assert "40 Gaussians" in text
    assert "forward" in text


def test_parts(bench, scenes, tmp_path, monkeypatch):
    monkeypatch.setattr("vvgt_cli.refine.shared.LEAST", 100)
    module = bench("parts")
    call(module.main, *scenes, "-o", tmp_path / "a.csv", "--", "--max-gaussians", 300, "--size", SIZE, "--steps", 24)
    rows = {row["part"]: row for row in rows_of(tmp_path / "a.csv")}
    assert list(rows) == list(module.PARTS)
    assert float(rows["all"]["start"]) > 10
    for part in ("colours not sharpened", "no floor of slopes", "no steps in common"):
        assert rows[part]["psnr"] != rows["all"]["psnr"]
    assert "| no cells by error |" in call(module.main, "--table", tmp_path / "a.csv")


def test_curve(bench, scenes, tmp_path):
    module, found = bench("curve", SIZE=SIZE), tmp_path / "a.csv"
    steps, few = ("--steps", 1, "--steps", 24), ("--", "--max-gaussians", 300, "--size", SIZE)
    call(module.main, "measure", *scenes, tmp_path / "files", "--state", f"before={ROOT}", *steps, *few)
    call(module.main, "score", *scenes, tmp_path / "files", "-o", found)
    rows = rows_of(found)
    assert [row["label"] + row["steps"] for row in rows] == ["after1", "after24", "before1", "before24"]
    assert float(rows[1]["psnr"]) > float(rows[0]["psnr"]) > 10
    assert rows[1]["psnr"] == rows[3]["psnr"]
    call(module.main, "plot", found, "-o", tmp_path / "a.png")
    assert read_png(tmp_path / "a.png").shape[2] in (3, 4)


def test_whole(bench, scenes, tmp_path, monkeypatch):
    from vvgt_cli.dvr.vtk import require_opengl

    require_opengl()
    module, found = bench("whole", STEP={"blob": 1.0}, VIEWS=2, SIZE=SIZE), tmp_path / "a.csv"
    commands, few = module.commands, ["--max-gaussians", "60", "--size", str(SIZE), "--steps", "2"]

    def small(*args):
        return [(what, at, [*words, *few] if "convert" in words else words) for what, at, words in commands(*args)]

    monkeypatch.setattr(module, "commands", small)
    call(module.main, "measure", *scenes, "-o", found, "--rounds", 1, "--threads", 1, "--lit", "--other", ROOT)
    rows = rows_of(found)
    assert len({row["what"] for row in rows if float(row["wall"]) > 0}) == len(rows) == 6
    assert "1.00" in call(module.main, "table", found).splitlines()[-1]


def test_plan(bench, scenes, tmp_path):
    few = ("--max-gaussians", "40", "--size", str(SIZE), "--steps", "1")
    module = bench("plan", KINDS={"default": few})
    call(module.main, *scenes, "-o", tmp_path / "a.csv")
    assert [float(row["predicted_s"]) > 0 for row in rows_of(tmp_path / "a.csv") if row["steps"] == "1"] == [True]


def test_refinement(bench, scenes, tmp_path):
    steps = {"ours": (0, 2), "adam": (2,), "3dgs": (2,), "ivr-gs": (2,)}
    module = bench("refinement", K=40, SIZE=SIZE, ADAM_STEPS=2, BASE_VIEWS=2, MAX_VIEWS=2, STEPS=steps)
    call(module.main, "equal", *scenes, "-o", tmp_path / "a.csv")
    assert float(rows_of(tmp_path / "a.csv")[0]["closed_form"]) > 10
    call(module.main, "curve", *scenes, "-o", tmp_path / "b.csv")
    assert [row["method"] for row in rows_of(tmp_path / "b.csv")] == ["ours", "ours", "adam", "3dgs", "ivr-gs"]
    assert "| ivr-gs |" in call(module.main, "table", tmp_path / "b.csv")


def test_reports(bench, scenes, tmp_path, monkeypatch):
    """What it calls is tested elsewhere: here it leaves the numbers of a report at once."""
    called = []

    def report(command, check):
        called.append(command)
        folder = Path(command[command.index("-o") + 1])
        folder.mkdir()
        runs = [run | {"cost": run["seconds"]} for run in document()["runs"]]
        front = [run["name"] for run in runs[:9]]
        (folder / "report.json").write_text(json.dumps(document(runs=runs, front=front, knee=front[4])))
        write_png(folder / "psnr-seconds.png", np.zeros((8, 8, 3), np.uint8))
        picture = base64.b64encode((folder / "psnr-seconds.png").read_bytes()).decode()
        page = f'<code>vvgt report /some/where/a.nrrd -o b/c</code><img src="data:image/png;base64,{picture}"></a>'
        (folder / "report.html").write_text(page)
        (folder / "report.csv").write_text("run\n")

    module = bench("reports")
    monkeypatch.setattr(module.subprocess, "run", report)
    for _ in range(2):  # the second finds all there
        call(module.main, *scenes, "-o", tmp_path / "out", "--", "--picture-size", 160)
    (command,) = called
    assert command[:4] == [sys.executable, "-m", "vvgt_cli.commands.main", "report"]
    assert command[-2:] == ["--picture-size", "160"]
    assert "[blob](blob/report.html)" in (tmp_path / "out" / "index.md").read_text()
    call(module.main, *scenes, "-o", tmp_path / "out", "--publish", tmp_path / "docs")
    page = (tmp_path / "docs" / "blob.html").read_text()
    assert page.startswith('<code>vvgt report a.nrrd -o b/c</code><img src="data:image/jpeg;base64,/9j/')
    assert page.endswith('"></a>')
    assert (tmp_path / "docs" / "blob.csv").read_text() == "run\n"
    assert "[blob](blob.html)" in (tmp_path / "docs" / "index.md").read_text()


def test_automatic(bench, tmp_path, capsys):
    module = bench("automatic", SIZE=SIZE)
    module.main(str(tmp_path), "blob=example:blob:10")
    assert capsys.readouterr().out.startswith("blob: automatic")
    assert read_png(tmp_path / "blob.png").shape == (SIZE, SIZE, 3)
    assert all(min(make().dims) > 50 for name, make in module.MADE.items() if name in ("mr-t1", "ct-abdomen"))


def test_splat(bench, capsys):
    bench("splat", COUNT=40, REPEATS=1, SIZES=(SIZE,), bandwidth=lambda: 1e9).main(["example:blob:10"])
    assert "40 Gaussians" in capsys.readouterr().out


def test_training(bench, scenes, tmp_path, monkeypatch):
    module = bench("training")
    monkeypatch.setattr(module.numba, "set_num_threads", lambda count: None)
    few = ("--gaussians", 40, "--ways", "closed form", "--ways", "network", "--model", MODEL)
    for _ in range(2):  # from its cache the second time
        call(module.main, "gain", *scenes, "-o", tmp_path / "a.csv", *few, "--cache", tmp_path / "cache")
    assert [row["way"] for row in rows_of(tmp_path / "a.csv")] == ["closed form", "network"]
    assert len(list((tmp_path / "cache").iterdir())) == 2
    small = {
        "SIZES": (8,), "KINDS": ("shells",), "TRAINED": range(1), "HELD": range(100, 101), "GRID": 8, "SNAPSHOTS": 1,
    }  # fmt: skip
    call(bench("training", **small, FIRST=0.01, EVERY=0.01).main, "data", tmp_path / "data")
    assert len(list((tmp_path / "data" / "train").glob("shells_*.nrrd"))) == 1
    assert len(list((tmp_path / "data" / "held").glob("*_speed.nrrd"))) == 2


def test_what_the_machine_does_at_best(bench):
    floors = bench("floors")
    assert floors.bandwidth() > 1e7
    assert floors.seconds(lambda: None) < 1
    assert set(floors.alternate({"a": lambda: None, "b": lambda: np.zeros(3)}, 3)) == {"a", "b"}
    assert "threads" in floors.machine()


def test_levels(bench, scenes, tmp_path):
    module = bench("levels")
    look = ["--tf", f"{scenes[1]}/shells.json", "--opacity-unit-distance", "mean-spacing"]
    some = ["--max-gaussians", "2000", "--size", "64", "-q", "-o", str(tmp_path / "out" / "lod-meta.json")]
    assert run(["init", f"{scenes[1]}/blob.nrrd", *look, *some]) == 0
    options = ["--size", "64", "-o", tmp_path / "a.csv", "--plot", tmp_path / "a.png"]
    told = call(module.main, tmp_path / "out", f"{scenes[1]}/blob.nrrd", *look, *options)
    rows = rows_of(tmp_path / "a.csv")
    assert len({row["level"] for row in rows}) + 1 == told.count("levels of 255")
    shown = [float(line.split()[2]) for line in told.splitlines() if line.startswith("distance")]
    assert len(shown) == len(module.DISTANCES)
    assert min(shown) > 15
    assert all(float(row["rms"]) > 0 and float(row["spread"]) > 0 for row in rows)
    assert (tmp_path / "a.png").stat().st_size > 5000
    shown = np.zeros((30, 30), bool)
    shown[10, 20] = True
    assert np.argwhere(module.near(shown, 2)).min(axis=0).tolist() == [8, 18]
    assert module.near(shown, 2).sum() == 25


def test_share(bench, scenes, tmp_path):
    module = bench("share", EDGE=SIZE)
    options = ["--tf", f"{scenes[1]}/shells.json", "--opacity-unit-distance", "mean-spacing", "--max-gaussians", "60"]
    target = ["--size", str(SIZE), "-q", "-o", str(tmp_path / "blob.ply")]
    done = run(["init", f"{scenes[1]}/blob.nrrd", *options, *target])
    assert done == 0
    call(module.main, *scenes, tmp_path, "-o", tmp_path / "a.csv", "--pictures", tmp_path / "pictures")
    rows = {row["format"]: row for row in rows_of(tmp_path / "a.csv")}
    assert {".ply", ".spz", ".glb", ".html"} <= set(rows)
    assert abs(float(rows[".glb"]["cost"])) < 0.01
    assert float(rows[".spz"]["psnr"]) > 10
    assert (tmp_path / "pictures" / "blob.jpg").stat().st_size > 500
    assert "| .spz |" in call(module.main, "--table", tmp_path / "a.csv")


def test_damaged(bench, scenes, tmp_path):
    module = bench("damaged", ROWS=5)
    look = ["--tf", f"{scenes[1]}/shells.json", "--opacity-unit-distance", "mean-spacing"]
    target = ["--max-gaussians", "60", "--size", str(SIZE), "-q", "-o", str(tmp_path / "blob.ply")]
    assert run(["init", f"{scenes[1]}/blob.nrrd", *look, *target]) == 0
    call(module.main, tmp_path / "blob.ply", "--volume", f"{scenes[1]}/blob.nrrd", *look, "-o", tmp_path / "d.csv")
    rows = [row for row in rows_of(tmp_path / "d.csv") if row["copy"] == "broken rows"]
    assert {"file: centres that are not finite", "values: largest sigma"} <= {row["case"] for row in rows}
    assert "| vvgt | broken rows | file: centres that are not finite: 5 rows of" in call(
        module.main, "--table", tmp_path / "d.csv"
    )


def test_kept(bench, tmp_path, monkeypatch):
    module = bench("kept")
    monkeypatch.setattr(module.shutil, "which", lambda name: None)
    call(module.main, "-o", tmp_path / "kept.csv")
    rows = {(row["format"], row["fact"]): row for row in rows_of(tmp_path / "kept.csv")}
    assert all(rows[ending, fact]["read back by us"] == "yes" for ending in module.ENDINGS for fact in module.FACTS)
    assert all(
        rows[ending, "antialiased"]["read back by us"] == "yes" for ending in (".ply", ".spz", ".v4.spz", ".sog")
    )
    assert {row["splat-transform"] for row in rows.values()} == {"not run"}
    assert rows[".usdc", "certificate"]["usd-core"] == "yes"
    assert rows[".spz", "certificate"]["gsply"] == "no"
    assert "| `.glb` | certificate; place" in call(module.main, "--table", tmp_path / "kept.csv")


def test_viewers(bench, scenes, tmp_path, monkeypatch):
    """A viewer that draws as its rule says, of an anatomical file, which is turned: our drawing, like the volume."""
    module = bench("viewers", SIZE=SIZE)
    drawn = []

    def shoot(viewer, file, cameras, size, folder, options):
        drawn.append((viewer, file.name, options))
        return [module.render(read_splats(file)[0], one, rule=module.VIEWERS[viewer][0])[..., :3] for one in cameras]

    monkeypatch.setattr(module, "shoot", shoot)
    block = np.zeros((12, 12, 12), np.float32)
    block[7:11, 2:9, 1:5] = 1  # at one corner, with three different edges
    write_nrrd(tmp_path / "block.nrrd", Volume(block, (1, 1, 1), space="RAS"))
    look = [
        "--tf", f"{scenes[1]}/shells.json", "--max-gaussians", 300, "--steps", 0, "--pictures",
        tmp_path / "pictures",
    ]  # fmt: skip
    only = ["--viewer", "three", "--viewer", "gsplatjs", "--format", ".ply", "--format", ".glb"]
    said = call(module.main, tmp_path / "block.nrrd", *look, *only)
    rows = [line.split(",") for line in said.splitlines()[:3]]
    assert drawn == [
        ("three", "splats.ply", "stored"),
        ("gsplatjs", "splats.ply", ""),
        ("three", "splats.glb", "stored"),
    ]
    assert all(float(row[2]) > 20 for row in rows)
    assert all(float(row[4]) > 50 for row in rows)
    assert "| three | " in said
    assert read_png(tmp_path / "pictures" / "sheet.png").shape == (SIZE // 4, SIZE // 4 * 6, 3)
