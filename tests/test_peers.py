"""Other trainers in a report: commands of outside programs, here ones that stand for them."""

import json
import sys
from pathlib import Path

import pytest

from tests.report_runs import document, run, runs
from vvgt_cli.commands import report_runs as report
from vvgt_cli.commands.peers import Peer
from vvgt_cli.errors import UsageError
from vvgt_cli.score.charts import draw
from vvgt_cli.score.curves import ReportRuns, psnr

SMALL = ("--tf", "viridis", "--screen", 24, "--max-gaussians", 60, "--steps", 2)
MAKE = """
import json, pathlib, shutil, sys
start, views, out = map(pathlib.Path, sys.argv[1:])
frames = json.loads((views / "transforms_train.json").read_text())["frames"]
assert len(frames) > 10 and all((views / (frame["file_path"] + ".png")).is_file() for frame in frames)
assert (views / "sparse/0/points3D.bin").is_file()
shutil.copy(start, out)
"""


@pytest.fixture(autouse=True)
def cold(monkeypatch):
    """Load kernels while clocks run."""
    monkeypatch.setattr(report, "warm_up", lambda *_: None)


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """What the trainer that stands for others leaves: our closed form."""
    from vvgt_cli.commands.main import run as vvgt

    made = tmp_path_factory.mktemp("peers")
    args = ["init", "example:blob:10", "--tf", "viridis", "--screen", "24", "--max-gaussians", "60"]
    assert vvgt([*args, "-o", str(made / "start.ply"), "--quiet"]) == 0
    (made / "make.py").write_text(MAKE)
    return made


def test_a_peer_is_run_timed_and_scored_beside_ours(vvgt, start, tmp_path, monkeypatch) -> None:
    planned = report.plan_runs
    monkeypatch.setattr(report, "plan_runs", lambda *of: planned(*of)[:5])  # it, and the closed forms
    command = f"{sys.executable} {start / 'make.py'} {start / 'start.ply'} {{views}} {{out}}"
    vvgt.ok("report", "example:blob:10", *SMALL, "--peer", f"Other one={command}", "-o", tmp_path / "out")
    found = json.loads((tmp_path / "out" / "report.json").read_text())
    peer, closed = found["runs"][0], found["runs"][4]
    assert (peer["name"], peer["kind"], closed["name"]) == ("Other one", "peer", "closed form, K = 60")
    alone = vvgt("evaluate", start / "start.ply", "--volume example:blob:10 --tf viridis --no-conditions --json")
    assert peer["scores"]["psnr"] == pytest.approx(json.loads(alone.out)["scores"]["psnr"], abs=1e-3)
    assert peer["gaussians"] == closed["gaussians"]
    assert [stage["name"] for stage in peer["stages"]] == ["views", "training"]
    assert all(stage["seconds"] > 0 for stage in peer["stages"])
    assert peer["cost"] == pytest.approx(sum(stage["seconds"] for stage in peer["stages"]))
    assert found["command_line"].count("--peer") == 1
    assert "Other one" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("command", "code", "what"),
    [
        ("{views} {out}", 2, "expected NAME=COMMAND"),
        ("x=train {views}", 2, "expected NAME=COMMAND with {views}"),
        ("x=train '{views} {out}", 2, "No closing quotation"),
        ("x=no-such-program {views} {out}", 2, "no-such-program: No such file"),
        (f"x={sys.executable} -c 'raise SystemExit(\"no room\")' {{views}} {{out}}", 1, "exit status 1: no room"),
        (f"x={sys.executable} -c pass {{views}} {{out}}", 1, "left no {out}"),
        ("x=cp {views}/transforms_train.json {out}", 1, "not with 'ply'"),
    ],
)  # fmt: skip
def test_peers_that_fail_are_one_line_and_leave_no_report(vvgt, tmp_path, command, code, what) -> None:
    few = ("--tf", "viridis", "--screen", 16, "--max-gaussians", 4, "--steps", 1)
    assert what in vvgt.fails(code, "report", "example:blob:6", *few, "--peer", command, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_places_are_filled_in_within_words() -> None:
    peer = Peer.of("a b=train --data={views} --out '{out}/x y'")
    assert peer.words(Path("/v w"), Path("/o")) == ["train", "--data=/v w", "--out", "/o/x y"]
    with pytest.raises(UsageError, match="expected NAME=COMMAND"):
        Peer.of("=train {views} {out}")


def test_a_page_marks_peers_and_vtks_own_picture() -> None:
    every = [*runs(), run("Brush", "Brush", "peer", 90_000, 300.0, 35.0, 0), run("live", "live", "live", 9, 4, 30.0, 0)]
    one = ReportRuns("x", every, document(runs=every, vtk_psnr=48.0))
    other = ReportRuns("y", runs(), document())
    for series, there in (([one], {"peer", "live", "VTK"}), ([other], {"steps"}), ([one, other], {"x", "y", "peer"})):
        for chart in draw(series)[:3]:
            legend = {text.get_text() for text in chart.figure.axes[0].get_legend().get_texts()}
            assert there <= legend
            assert ("VTK" in legend) == ("VTK" in there)
    assert psnr(every[-2]) == 35.0
