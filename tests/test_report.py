"""`vvgt report`: all runs end to end; fronts, tables, charts, the page, comparisons."""

import csv
import io
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from tests.onnx_models import write_model
from tests.refused import refused
from tests.report_runs import document, run, runs
from vvgt_cli.commands.report_runs import plan_runs, random_points
from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.errors import DataError
from vvgt_cli.images import read_png
from vvgt_cli.score.charts import FILES, draw
from vvgt_cli.score.curves import (
    OTHER,
    STAGES,
    ReportRuns,
    cost,
    knee,
    pareto,
    psnr,
    read_series,
    unit_costs,
)
from vvgt_cli.score.page import Pictures, page

SMALL = ("--tf", "viridis", "--screen", 24, "--max-gaussians", 60, "--steps", 2)
VOID = {"meta", "img", "input", "br"}


class Reader(HTMLParser):
    """Checks that elements close in order, and collects what a page would load."""

    def __init__(self, text):
        super().__init__()
        self.open, self.loads, self.tags = [], [], []
        self.feed(text)
        assert not self.open, self.open

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.loads += [value for name, value in attributes if name in ("src", "href", "srcset", "data")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def scene_report(tmp_path_factory):
    """A whole report of a small scene with a model that shrinks every Gaussian: (folder, JSON)."""
    from vvgt_cli.commands.main import run as vvgt

    folder = tmp_path_factory.mktemp("report")
    step = np.zeros(14)
    step[3:6] = -3
    model = write_model(folder / "worse", step)
    args = ["report", "example:blob:10", *SMALL, "--model", model, "-o", folder / "out", "--quiet", "--threads", 1]
    assert vvgt([str(arg) for arg in args]) == 0
    return folder / "out", json.loads((folder / "out" / "report.json").read_text())


def test_a_report_writes_every_file_and_scores_every_run(scene_report):
    folder, found = scene_report
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        ["report.json", "report.csv", "report.html", *FILES]
    )
    names = [run["name"] for run in found["runs"]]
    assert names == [
        "closed form, K = 1", "closed form, K = 3", "closed form, K = 15", "closed form, K = 60", "live form, K = 60",
        "network worse", "2 steps", "3DGS, 2 steps", "iVR-GS setting, 2 steps",
    ]  # fmt: skip
    scores = {run["name"]: run["scores"]["psnr"] for run in found["runs"]}
    assert scores["closed form, K = 1"] < scores["closed form, K = 15"]
    assert scores["network worse"] == pytest.approx(scores["closed form, K = 60"], abs=0.5)  # what is worse is not kept
    network = next(s for s in found["runs"][5]["stages"] if s["name"] == "network")
    assert not network["kept"]
    assert network["psnr"] < network["psnr_before"]
    assert scores["3DGS, 2 steps"] < scores["iVR-GS setting, 2 steps"]
    for one in found["runs"]:
        assert one["scores"]["views"] == 10
        assert one["bytes"] > 68 * one["gaussians"] > 0
        assert one["cost"] == pytest.approx(cost(one))
        assert one["cost"] > 0
        assert {"read", "write"} <= {stage["name"] for stage in one["stages"]}
    assert found["format"] == "vvgt-report"
    assert found["reference"] == {"views": 10, "size": 24, "step": 0.125, "rays": 9}
    assert found["knee"] in found["front"]
    assert found["command_line"].startswith("vvgt report example:blob:10 --output ")
    assert "--steps 2" in found["command_line"]
    assert "--threads" not in found["command_line"]
    assert found["machine"]["cpu"]
    assert found["machine"]["threads"] == 1


def test_the_page_opens_offline_and_shows_its_pictures(scene_report):
    folder, found = scene_report
    text = (folder / "report.html").read_text("utf-8")
    reader = Reader(text)
    assert all(value.startswith("data:image/png;base64,") for value in reader.loads)
    assert not re.search(r"@import|url\((?!#)|https?://", text)
    assert reader.tags.count("svg") == len(FILES)
    assert found["machine"]["cpu"] in text
    assert f"vvgt {found['versions']['vvgt']}" in text
    assert set(re.findall('<tr class="best"><td>(.*?)</td>', text)) == set(found["front"])
    held = json.loads(re.search(r'id="images">(.*?)</script>', text, re.S)[1])
    assert len(held["reference"]) == 2
    assert [own["name"] for own in held["runs"]] == [run["name"] for run in found["runs"]]
    import base64

    def pixels(uri):
        (folder.parent / "view.png").write_bytes(base64.b64decode(uri.partition(",")[2]))
        return read_png(folder.parent / "view.png")

    best = max(range(len(found["runs"])), key=lambda n: found["runs"][n]["scores"]["psnr"])
    reference, ours = pixels(held["reference"][0]), pixels(held["runs"][best]["images"][0])
    assert reference.max() > 0.2
    off = -10 * np.log10(np.mean((reference - ours) ** 2))
    assert off == pytest.approx(found["runs"][best]["scores"]["per_view"][0]["psnr"], abs=0.3)  # 8 bits


def test_csv_and_plots_of_a_report(scene_report):
    folder, found = scene_report
    rows = list(csv.DictReader(io.StringIO((folder / "report.csv").read_text())))
    assert [row["name"] for row in rows] == [run["name"] for run in found["runs"]]
    assert float(rows[3]["psnr"]) == pytest.approx(found["runs"][3]["scores"]["psnr"], abs=1e-4)
    assert {row["name"] for row in rows if row["pareto"] == "1"} == set(found["front"])
    for name in FILES:
        image = read_png(folder / name)
        assert min(image.shape[:2]) > 300
        assert len(np.unique(image[::8, ::8].reshape(-1, image.shape[2]), axis=0)) > 20


def test_nothing_is_overwritten_unasked(scene_report, vvgt):
    folder, _ = scene_report
    assert "exists; give --overwrite" in vvgt.fails(2, "report", "example:blob:10", *SMALL, "-o", folder)


def test_compare_reads_reports_and_conversions_and_gives_them_different_names(scene_report, vvgt, tmp_path):
    folder, found = scene_report
    vvgt.ok("convert", "example:blob:10", "--tf", "viridis", "--screen", 24, "--max-gaussians", 60,
                "-o", tmp_path / "c.ply", "--report", tmp_path / "c.json")  # fmt: skip
    (tmp_path / "a").mkdir()
    twin = tmp_path / "a" / "report.json"
    twin.write_text(json.dumps(document()))
    reports = (twin, folder / "report.json", twin, tmp_path / "c.json")
    result = vvgt.ok("report", "--compare", *reports, "-o", tmp_path / "all")
    assert {p.name for p in (tmp_path / "all").iterdir()} == {"report.csv", "report.html", *FILES}
    text = (tmp_path / "all" / "report.html").read_text("utf-8")
    Reader(text)
    for name in ("a (1): 25 steps: ", "out: closed form, K = 60", "a (3): 25 steps: ", "c: convert, K 60"):
        assert name in text
    assert "c: 1 runs" in result.err
    rows = list(csv.DictReader(io.StringIO((tmp_path / "all" / "report.csv").read_text())))
    assert len(rows) == 2 * len(runs()) + len(found["runs"]) + 1


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("report", "-", "-o", "x"), "every run reads it again"),
        (("report", "example:blob", "-o", "-"), "takes no folder"),
        (("report", "example:blob", "-o", "no/where"), "no directory no"),
        (("report", "example:blob", "-o", "file"), "is a file"),
        (("report", "example:blob", "example:slab", "-o", "x"), "2 volumes; expected one"),
        (("report", "--compare", "file", "-o", "x"), "expected two or more"),
        (("report", "--compare", "file", "-o", "x", "--threads", 1), "expected two or more"),
        (("report", "--compare", "file", "file", "-o", "x", "--tf", "viridis"), "--tf: not with --compare"),
        (("report", "example:blob", "--model", "none", "-o", "x"), "no such folder"),
    ],
)
def test_calls_that_are_wrong(args, message, vvgt, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("{}")
    assert message in vvgt.fails(2, *args)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


OF_ANOTHER_KIND = document(runs=[runs()[0] | {"kind": "other"}])
UNNAMED = document(runs=[runs()[0] | {"name": 3}])


@pytest.mark.parametrize(
    "content",
    ["", "[]", "{}", '{"format": "vvgt-check"}', '{"format": "vvgt-report", "runs": [{}]}',
     '{"format": "vvgt-report", "runs": []}', json.dumps(OF_ANOTHER_KIND), json.dumps(UNNAMED), "\xff"],
)  # fmt: skip
def test_files_that_are_no_reports(content, tmp_path):
    path = tmp_path / "r.json"
    path.write_bytes(content.encode("latin-1"))
    refused(DataError, r"r\.json", read_series, str(path))
    refused(DataError, "not a report", read_series, str(tmp_path / "none.json"))


def test_the_front_is_what_nothing_beats():
    found = runs()
    best = pareto(found)
    assert [r["name"] for r in best] == [r["name"] for r in found if r["kind"] in ("closed form", "steps")]
    for r in found:
        beaten = any(cost(o) <= cost(r) and psnr(o) >= psnr(r) and o is not r for o in found)
        assert beaten == (r not in best)
    assert pareto([]) == []
    assert knee(found)["name"] == "closed form, K = 25k"
    assert knee(found[:1]) is found[0]
    twins = [run("a", "a", "steps", 10, 1.0, 30.0, 5), run("b", "b", "steps", 10, 1.0, 30.0, 5)]
    assert [r["name"] for r in pareto(twins)] == ["a"]


def test_the_scoring_costs_nothing_and_units_are_medians():
    assert cost(run("a", "a", "steps", 1000, 10.0, 30.0, 100)) == pytest.approx(10.0)
    found = unit_costs(runs())
    steps = sorted(
        s["seconds"] / r["refinement"]["steps"]
        for r in runs() if r["kind"] == "steps" for s in r["stages"] if s["name"] == "refinement"
    )  # fmt: skip
    assert found["refinement, a step"] == pytest.approx((steps[1] + steps[2]) / 2)
    assert "test views, a run" not in found
    assert unit_costs([]) == {}


def test_charts_name_every_run_and_follow_the_page():
    charts = draw([ReportRuns("s", runs(), document(vtk_psnr=41.0))])
    for chart, file in zip(charts, FILES, strict=True):
        drawn = chart.svg()
        assert chart.file == file
        titles = re.findall("<title>(.*?)</title>", drawn)
        texts = re.findall("<text [^>]*>(.*?)</text>", drawn)
        if file == "stages.png":
            assert len(titles) == sum(len({s["name"] for r in runs() for s in r["stages"]}) for _ in runs())
            assert {r["name"] for r in runs()} | {"test views (not counted)", "46.00 s"} <= {t.strip() for t in texts}
        else:
            assert [title.partition(":")[0] for title in titles] == [r["name"] for r in runs()]
            assert "VTK" in texts
            assert len({r["label"] for r in runs()} & set(texts)) >= 7
        colors = set(re.findall("#[0-9a-f]{6}", re.sub("<title>.*?</title>", "", drawn)))
        assert colors <= {*STAGES.values(), OTHER}  # others are the page's, light or dark
    assert draw([ReportRuns("s", runs()[:1])])[0].svg().count("<title>") == 1
    again = draw([ReportRuns("s", runs(), document(vtk_psnr=41.0))])
    assert [chart.svg() for chart in charts] == [chart.svg() for chart in again]


def test_labels_in_charts_are_separate_and_inside():
    for chart in draw([ReportRuns("s", runs())])[:3]:
        axes = chart.figure.axes[0]
        boxes = [note.get_window_extent() for note in axes.texts]
        assert len(boxes) >= 7
        assert all(box.count_overlaps([b for b in boxes if b is not box]) == 0 for box in boxes)
        assert all((box.min > axes.bbox.min).all() and (box.max < axes.bbox.max).all() for box in boxes)
        lines = [
            line.get_transform().transform_path(line.get_path()) for line in axes.lines if len(line.get_xdata()) > 1
        ]
        assert not any(line.intersects_bbox(box, filled=False) for line in lines for box in boxes)
    bars = draw([ReportRuns("s", runs())])[3].figure
    bars.draw_without_rendering()
    assert max(text.get_window_extent().x1 for text in bars.axes[0].texts) < bars.axes[0].bbox.x1


def test_names_cannot_break_out_of_the_page():
    bad = document(volume={"name": "</script><b>", "dims": [1, 1, 1], "dtype": "u1"})
    for one in bad["runs"]:
        one["name"] = "</script><img src=x onerror=alert(1)>"
    pictures = Pictures([0], [b"png"], [[b"png"]] * len(bad["runs"]))
    one = [ReportRuns("<i>", bad["runs"], bad)]
    reader = Reader(page(one, draw(one), "<u>", pictures))
    assert reader.tags.count("img") == 4
    assert reader.tags.count("script") == 2
    assert "u" not in reader.tags


def test_rungs_follow_the_options_and_random_points_fill_the_box():
    names = [r.name for r in plan_runs(FitOptions(64_000, 100, model="m/net", seed=3), (100, 25, 25))]
    assert names[:5] == ["closed form, K = 1k", "closed form, K = 4k", "closed form, K = 16k", "closed form, K = 64k",
                         "network net"]  # fmt: skip
    assert names[5:] == ["25 steps", "100 steps", "3DGS, 100 steps", "iVR-GS setting, 100 steps"]
    assert len(plan_runs(FitOptions(1))) == 1 + 4 + 2
    half = np.array([1.0, 0.5, 0.1])
    points = random_points(half, 2000, 0)
    assert (np.abs(points.means) <= half).all()
    assert np.abs(points.means).max(axis=0) == pytest.approx(half, rel=0.01)
    gaps = np.linalg.norm(points.means[:, None] - points.means[None], axis=-1)
    nearest = np.sort(gaps, axis=1)[:, 1:4].mean()
    assert np.exp(points.log_scales[0, 0]) == pytest.approx(nearest, rel=0.3)  # a thin box has more rim
