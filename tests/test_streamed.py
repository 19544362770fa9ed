"""Streamed SOG: what the engine would take from the manifest and its files, errors drawn again, what is refused."""

import json
import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vvgt_cli
from tests.processes import replaced
from tests.test_formats_server import ask
from tests.test_scale import bodies
from vvgt_cli.commands.server import Site, served
from vvgt_cli.commands.viewer import streamed_resources
from vvgt_cli.conversion.cut import StoredGaussians, TileGaussians, save
from vvgt_cli.conversion.index import named_files
from vvgt_cli.conversion.level_selection import SEEN_FROM, VIEW_PIXELS, CutErrors, level_errors
from vvgt_cli.conversion.levels import WrittenFiles, divide
from vvgt_cli.conversion.parts import Refiner
from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.defaults import STEPS
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.blocked import Pass
from vvgt_cli.field.runners import Runner
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply
from vvgt_cli.gaussians.formats.sog import images_of, splats_in
from vvgt_cli.gaussians.formats.splats import Splats, gaussians_of
from vvgt_cli.gaussians.formats.streamed import StreamedLevels, nodes_of, read_manifest
from vvgt_cli.gaussians.frames import transform, up_matrix
from vvgt_cli.images import read_png

FIT = ("--max-gaussians", "9000", "--screen", "150", "-q")


@pytest.fixture(scope="module")
def volume(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("streamed") / "v_100x90x80_uint8.raw"
    path.write_bytes(np.round(bodies() * 255).astype(np.uint8).tobytes())
    return path


@pytest.fixture(scope="module")
def folder(volume: Path) -> Path:
    from vvgt_cli.commands.main import run

    out = volume.parent / "out"
    assert run(["init", str(volume), *FIT, "--blocks", "32", "-o", str(out / "lod-meta.json")]) == 0
    return out


def contents(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder and its folders by their paths."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def decoded(folder: Path, manifest: dict[str, Any]) -> list[Splats]:
    found = []
    for name in manifest["filenames"]:
        place = (folder / name).parent
        meta = json.loads((folder / name).read_bytes())
        found.append(splats_in(meta, lambda image, place=place: (place / image).read_bytes(), name))
    return found


def test_nodes_share_out_every_file(folder: Path) -> None:
    manifest = json.loads((folder / "lod-meta.json").read_text())
    assert (manifest["version"], manifest["lodLevels"]) == (1, len(manifest["counts"]))
    assert manifest["lodLevels"] >= 2
    files, taken = decoded(folder, manifest), [[] for _ in manifest["filenames"]]
    counts = [0] * manifest["lodLevels"]
    for node in manifest["tree"]["children"]:
        assert sorted(node["lods"]) == [str(level) for level in range(manifest["lodLevels"])]
        for level, place in node["lods"].items():
            taken[place["file"]].append((place["offset"], place["count"]))
            counts[int(level)] += place["count"]
            part = files[place["file"]].means[place["offset"] : place["offset"] + place["count"]]
            assert (part > np.array(node["bound"]["min"])).all()
            assert (part < np.array(node["bound"]["max"])).all()
            assert manifest["filenames"][place["file"]].startswith(f"{level}_")
    assert counts == manifest["counts"]
    assert sum(counts) == manifest["count"]
    for splats, places in zip(files, taken, strict=True):
        ends = np.cumsum([count for _, count in sorted(places)])
        assert [offset for offset, _ in sorted(places)] == [0, *ends[:-1]]
        assert ends[-1] == len(splats)
    assert {path.name for path in folder.iterdir()} == {
        "lod-meta.json", *(name.split("/")[0] for name in manifest["filenames"])
    }  # fmt: skip


def test_the_finest_level_is_the_closed_form_four_times_as_large(vvgt, volume: Path, folder: Path) -> None:
    line = ("init", volume, *FIT, "--up", "z", "--blocks", "32")  # as pages turn what has no way up
    vvgt.ok(*line, "-o", volume.parent / "a.ply")
    expected = read_ply(volume.parent / "a.ply")[0]
    manifest = read_manifest(folder / "lod-meta.json")
    files = decoded(folder, manifest)
    finest = [s for s, name in zip(files, manifest["filenames"], strict=True) if name.startswith("0_")]
    means = np.concatenate([s.means for s in finest]) / 4
    assert len(means) == pytest.approx(len(expected), rel=0.02)  # a node has one at least
    apart = [float(np.linalg.norm(means - mean, axis=1).min()) for mean in expected.means[::50]]
    assert np.median(apart) < 1e-4
    assert np.mean(np.array(apart) < 2e-3) > 0.97


def test_levels_whose_replacement_ends_early_have_no_manifest(vvgt, volume, folder, tmp_path, monkeypatch) -> None:
    """It would name files of both."""
    shutil.copytree(folder, tmp_path / "out")

    def end(self, number):
        raise KeyboardInterrupt

    monkeypatch.setattr(WrittenFiles, "__call__", end)
    command = replaced(("init", volume, *FIT, "-o", tmp_path / "out" / "lod-meta.json"), "--screen", "200")
    assert vvgt(*command, "--overwrite").code == 130
    assert not (tmp_path / "out" / "lod-meta.json").exists()


@pytest.mark.parametrize(("rule", "steps"), [("inria", "0"), ("playcanvas", "8")])
def test_errors_are_those_of_what_is_in_the_files(vvgt, volume, folder: Path, tmp_path: Path, rule, steps) -> None:
    if rule != "inria":
        folder = tmp_path / "out"
        vvgt.ok("convert", volume, *FIT, "--steps", steps, "--rule", rule, "-o", folder / "lod-meta.json")
    manifest = read_manifest(folder / "lod-meta.json")
    assert any(line.endswith(f"rule {rule}") for line in manifest["vvgt"]["comments"])
    files = decoded(folder, manifest)
    nodes = nodes_of(manifest, "a")
    for node in sorted(nodes, key=lambda node: -node["lods"]["0"]["count"])[:3]:
        cuts = []
        for level in range(manifest["lodLevels"]):
            place = node["lods"][str(level)]
            rows = np.arange(place["offset"], place["offset"] + place["count"])
            turned = gaussians_of(files[place["file"]].take(rows), "a")[0]
            cuts.append(transform(turned, up_matrix("z").T))  # they are measured before what shows is turned upright
        squares, energy, pixels = level_errors(cuts, rule)
        assert pixels > 0.1 * len(SEEN_FROM) * VIEW_PIXELS**2  # the node fills its views
        np.testing.assert_allclose(squares / energy, node["errors"], rtol=0.1, atol=2e-4)
        np.testing.assert_allclose(np.sqrt(squares / pixels) / 2, node["rms"], rtol=0.1, atol=2e-3)
        assert node["errors"] == sorted(node["errors"])
        assert node["spreads"] == sorted(node["spreads"])
        assert node["errors"][0] == 0 < node["errors"][-1]


def cut_errors(nodes: int, cuts: int) -> CutErrors:
    """Return cuts with half the Gaussians of the one before each, and a larger error."""
    rng = np.random.default_rng(6)
    counts = 1000 * rng.integers(1, 9, (nodes, 1)) // 2 ** np.arange(cuts)
    squares = np.cumsum(rng.uniform(0, 1, (nodes, cuts)) * 3.0 ** np.arange(cuts), axis=1)
    squares[:, 0] = 0
    return CutErrors(np.arange(float(cuts)), counts, squares, np.full(nodes, 1e4), np.full(nodes, 100))


def test_no_other_choice_of_as_many_gaussians_has_a_smaller_error() -> None:
    small = cut_errors(4, 5)
    counts = small.counts
    every = np.stack(np.meshgrid(*[np.arange(5)] * 4), axis=-1).reshape(-1, 4)
    totals = np.array([small.total(cuts) for cuts in every])
    errors = np.array([small.rms(cuts) for cuts in every])
    assert (small.for_count(counts[:, 0].sum()) == 0).all()
    assert (small.for_count(0) == 4).all()  # nothing less can be had
    for count in totals.max() * np.array([0.7, 0.4, 0.2, 0.1]):
        cuts = small.for_count(count)
        assert small.total(cuts) <= count
        assert small.rms(cuts) <= errors[totals <= small.total(cuts)].min() * (1 + 1e-12)


def test_levels_have_a_ninth_of_the_gaussians_each_and_are_never_finer_than_the_one_before() -> None:
    errors = cut_errors(30, 10)
    levels = errors.levels()
    assert (levels[0] == 0).all()
    assert all((a <= b).all() for a, b in pairwise(levels))
    assert all(9 * errors.total(b) <= errors.total(a) or (b == 9).all() for a, b in pairwise(levels))
    assert errors.rms(levels[0]) == 0 < errors.rms(levels[1]) < errors.rms(levels[2])


def test_levels_of_a_fog_begin_where_viewers_draw_it(vvgt, tmp_path: Path) -> None:
    volume, tf = tmp_path / "v_48x48x48_uint8.raw", tmp_path / "fog.json"
    z, y, x = np.mgrid[:48, :48, :48]
    volume.write_bytes((100 + 99 * np.sin(x / 9) * np.sin(y / 8) * np.sin(z / 7)).astype(np.uint8).tobytes())
    points = [{"x": 0, "rgb": [0, 0, 0], "opacity": 0}, {"x": 1, "rgb": [1, 1, 1], "opacity": 0.01}]
    tf.write_text(json.dumps({"range": [0, 255], "points": points}))
    line = ("init", volume, "--tf", tf, "--max-gaussians", "20000", "--screen", "150", "--blocks", "32")
    vvgt.ok(*line, "-q", "-o", tmp_path / "fog.ply")
    notes = vvgt.ok(*line, "-o", tmp_path / "fog" / "lod-meta.json").err
    counts = read_manifest(tmp_path / "fog" / "lod-meta.json")["counts"]
    assert "so faint that viewers differ" in notes
    assert counts[0] == pytest.approx(len(read_ply(tmp_path / "fog.ply")[0]), rel=0.05)
    assert counts[0] < 11000
    assert counts[0] > counts[1] > counts[0] / 4  # a ninth of what was asked for, not of what is left


def test_the_bytes_do_not_depend_on_how(vvgt, volume: Path, folder: Path, tmp_path: Path) -> None:
    whole = contents(folder)
    vvgt.ok("init", volume, *FIT, "-o", tmp_path / "whole" / "lod-meta.json")
    vvgt.ok("init", volume, *FIT, "--shard", "1/1", "--blocks", "64", "-o", tmp_path / "parts")
    vvgt.ok("merge", tmp_path / "parts", "-q", "-o", tmp_path / "merged" / "lod-meta.json")
    for other in (tmp_path / "whole", tmp_path / "merged"):
        assert contents(other) == whole


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--init", "wavelet"), "cuts of moments"),
        (("--frame", "world"), "choose levels by distances"),
        (("--max-megabytes", "5"), "--max-megabytes needs .ply or .html output"),
        (("--live",), "no place for values"),
        (("--labels", "auto", "--split-labels"), "share the Gaussians of one finished cloud"),
        (("--shard", "1/2"), "'vvgt init --shard' and 'vvgt merge'"),
        (("--tf", "a.json", "--tf", "b.json"), "one place for the function's name, as out_{}/lod-meta.json"),
    ],
)
def test_what_has_no_levels_is_refused_in_a_line(vvgt, volume: Path, tmp_path: Path, options, text) -> None:
    told = vvgt.fails(2, "convert", volume, *FIT, *options, "-o", tmp_path / "out" / "lod-meta.json")
    assert text in told
    assert len(told.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_levels_have_a_certificate_of_what_viewers_show(vvgt, volume: Path, tmp_path: Path) -> None:
    out, picture = tmp_path / "out", tmp_path / "p.png"
    small = replaced(FIT, "--max-gaussians", "2000", "--screen", "100")
    line = ("convert", volume, *small, "--steps", "4", "--preview", picture, "--checkpoint", tmp_path / "c")
    vvgt.ok(*line, "--device", "cpu", "-o", out / "lod-meta.json")
    assert {path.name for path in tmp_path.iterdir()} == {"out", "p.png"}
    assert read_png(picture).shape[:2] == (3 * (18 + 100), 300)
    made = json.loads(vvgt.ok("info", out, "--json").out)["certificate"]
    assert {"from 6", "from 1.2", "from 0.6"} < set(made["conditions"])
    shown = json.loads(vvgt.ok("evaluate", out, "--volume", volume, "-q", "--json").out)
    assert shown["certificate"]["holds"]
    assert shown["certificate"]["psnr"] == pytest.approx(made["psnr"], abs=0.1)
    assert {"from 6", "from 1.2", "from 0.6"} < {one["where"] for one in shown["conditions"]}
    line = ("evaluate", f"{out}#1", "--volume", volume, "--no-conditions", "--json")
    assert json.loads(vvgt.ok(*line).out)["certificate"] is None  # of a level alone
    vvgt.ok("view", f"{out}#0", "-o", tmp_path / "a.ply")
    assert read_ply(tmp_path / "a.ply")[1].certificate is None


def test_a_dry_run_of_levels_prints_their_plan_and_writes_nothing(vvgt, volume: Path, tmp_path: Path) -> None:
    line = ("convert", volume, *FIT, "--dry-run", "--for", "phone", "-o", tmp_path / "out" / "lod-meta.json")
    plan = vvgt.ok(*line).out.decode()
    assert f"levels, {STEPS} steps" in plan
    assert "with 9000 Gaussians" in plan
    assert not list(tmp_path.iterdir())


def test_a_network_runs_on_the_parts_of_levels(vvgt, volume: Path, folder: Path, tmp_path: Path) -> None:
    line = ("convert", volume, *FIT, "--steps", "0", "--model", "vvgt-small", "-o", tmp_path / "out" / "lod-meta.json")
    vvgt.ok(*line)
    assert (
        read_manifest(tmp_path / "out" / "lod-meta.json")["counts"] == read_manifest(folder / "lod-meta.json")["counts"]
    )
    assert contents(tmp_path / "out")["0_0/means_l.webp"] != contents(folder)["0_0/means_l.webp"]


def test_the_message_of_parts_says_what_happens_in_each() -> None:
    told = [
        Refiner(None, None, FitOptions(steps=steps, model=model, target_psnr=target)).text()
        for steps, model, target in ((12, None, None), (400, None, 30.0), (0, "a", None), (9, "a", None))
    ]
    assert told == ["12 steps", "at most 400 steps", "the network", "the network and 9 steps"]
    assert Refiner(None, None, FitOptions(steps=152), early=56).text() == "at most 152 steps"


def test_an_interrupted_run_resumes_with_the_same_bytes(vvgt, volume, folder, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("vvgt_cli.conversion.cut.ENOUGH", 1000)
    monkeypatch.setattr("vvgt_cli.conversion.levels.A_FILE", 2500)
    monkeypatch.setattr(
        "vvgt_cli.closed_form.closed_form.most_cells", lambda budget, **_: 256 * budget
    )  # for many nodes
    whole, out = tmp_path / "whole", tmp_path / "out"
    line = ("init", volume, *FIT, "--blocks", "32", "-o")
    vvgt.ok(*line, whole / "lod-meta.json")
    calls = {"level_errors": 0, "images_of": 0}
    real = {"level_selection.level_errors": level_errors, "levels.images_of": images_of}
    stop = {"level_errors": 20, "images_of": 0}

    def counted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            calls[name] += 1
            if calls[name] == stop[name]:
                raise KeyboardInterrupt
            return function(*args)

        return call

    for place, function in real.items():
        monkeypatch.setattr(f"vvgt_cli.conversion.{place}", counted(place.partition(".")[2], function))
    assert vvgt(*line, out / "lod-meta.json").code == 130
    nodes, files = len(nodes_of(read_manifest(whole / "lod-meta.json"), "")), len(list(whole.glob("*/meta.json")))
    assert nodes > 20
    assert files > 3
    stop = {"level_errors": 0, "images_of": 3}
    assert vvgt(*line, out / "lod-meta.json").code == 130
    assert calls["level_errors"] < nodes + 20  # those of the regions that were whole are not drawn again
    assert not (out / "lod-meta.json").exists()
    calls, stop["images_of"] = {"level_errors": 0, "images_of": 0}, 0
    vvgt.ok(*line, out / "lod-meta.json")
    assert calls == {"level_errors": 0, "images_of": files - 2}
    found = [{p.relative_to(f): p.read_bytes() for p in f.rglob("*.*")} for f in (whole, out)]
    assert found[0] == found[1]
    assert not list(tmp_path.glob(".*"))


def test_what_another_run_has_put_in_the_folder_is_written_again(tmp_path: Path) -> None:
    def written(seed: int, name: str) -> bytes:
        random, store = np.random.default_rng(seed), BlockStore(tmp_path / name)
        columns = [random.normal(size=(50, n)).astype(np.float32) for n in (3, 3, 4, 1, 3)]
        gaussians = Gaussians(*columns[:3], columns[3][:, 0], columns[4])
        store.prepare("closed")
        save(store, "closed", 0, [TileGaussians([gaussians], [np.ones(2)], None)], {})
        parts, places = divide(np.array([[50]]))
        assert places == [[{"file": 0, "offset": 0, "count": 50}]]
        task = WrittenFiles(StoredGaussians(store, "closed", (1,)), parts, tmp_path, np.eye(3), 1.0, PlyOptions())
        task.forget_changed()
        Pass(Runner(), store, lambda _: None)(task, "write")
        assert task.size(0) == sum(path.stat().st_size for path in (tmp_path / "0_0").iterdir())
        return (tmp_path / "0_0" / "means_l.webp").read_bytes()

    first, other = written(1, "a"), written(2, "b")
    assert first != other
    assert written(1, "a") == first
    before = (tmp_path / "0_0" / "meta.json").stat().st_mtime_ns
    assert written(1, "a") == first
    assert (tmp_path / "0_0" / "meta.json").stat().st_mtime_ns == before


def test_an_existing_folder_is_replaced_only_with_overwrite(vvgt, volume: Path, folder: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(folder, tmp_path / "out")
    manifest = json.loads((folder / "lod-meta.json").read_text())
    manifest["filenames"].append("3_7/meta.json")
    (folder / "lod-meta.json").write_text(json.dumps(manifest))
    stale, other = folder / "3_7", folder / "2024_11"
    for path in (stale / "meta.json", stale / "sh0.webp", other / "notes.txt"):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"x")
    (folder / "0_0" / "shN_labels.webp").write_bytes(b"x")  # of levels with harmonics
    assert vvgt("init", volume, *FIT, "-o", folder / "lod-meta.json").code == 2
    vvgt.ok("init", volume, *FIT, "--overwrite", "-o", folder / "lod-meta.json")
    assert not stale.exists()
    assert not list(folder.glob("*/shN*"))
    assert (other / "notes.txt").is_file()  # not of the manifest


def test_info_lists_levels_with_their_errors(vvgt, folder: Path) -> None:
    facts = json.loads(vvgt("info", folder / "lod-meta.json", "--json").out)
    manifest = json.loads((folder / "lod-meta.json").read_text())
    assert facts["kind"] == "streamed gaussians"
    assert [level["gaussians"] for level in facts["levels"]] == manifest["counts"]
    rms = [level["rms"] for level in facts["levels"]]
    assert rms[0] == 0
    assert rms == sorted(rms)
    assert json.loads(vvgt("info", folder, "--json").out) == facts
    assert json.loads(vvgt("info", f"{folder}#1", "--json").out)["gaussians"] == manifest["counts"][1]
    assert "cannot be read" in vvgt("info", folder / "none" / "lod-meta.json").error


def test_the_page_and_its_files_are_served(folder: Path, tmp_path: Path) -> None:
    assert [file for _, file in named_files([str(folder)])] == [str(folder / "lod-meta.json")]
    with served(Site(streamed_resources(str(folder / "lod-meta.json")), print)) as url:
        path = url[url.index("/", 8) :]
        status, text, _ = ask(url)
        assert (status, b'"streamed": true' in text) == (200, True)
        for name in ("lod-meta.json", "0_0/meta.json", "1_0/means_u.webp"):
            assert ask(url, path + name)[:2] == (200, (folder / name).read_bytes())
        assert ask(url, f"{path}../secret")[0] == 404


def test_a_missing_file_of_a_folder_is_reported(vvgt, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "lod-meta.json").write_bytes((folder / "lod-meta.json").read_bytes())
    assert "is missing; expected the whole folder" in vvgt.fails(1, "view", tmp_path, "--no-browser")
    told = vvgt.fails(2, "view", tmp_path, folder, "-o", tmp_path / "a.html")
    assert f"are shown alone; open one, as 'vvgt view {tmp_path}'" in told


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda m: m.update(lodLevels=0), "no lodLevels"),
        (lambda m: m.update(filenames=["../../etc/passwd"]), "expected files FOLDER/meta.json"),
        (lambda m: m.update(filenames=["/0_0/meta.json"]), "expected files FOLDER/meta.json"),
        (lambda m: m["tree"]["children"].append({"children": [7]}), "expected nodes with children or lods"),
        (lambda m: m["tree"]["children"][0]["lods"].update({"0": {"file": 99, "offset": 0, "count": 1}}), "a node has"),
    ],
)
def test_manifests_that_cannot_be_are_one_line(folder, tmp_path, change, text) -> None:
    manifest = json.loads((folder / "lod-meta.json").read_text())
    change(manifest)
    (tmp_path / "lod-meta.json").write_text(json.dumps(manifest))
    with pytest.raises(DataError) as error:
        read_manifest(tmp_path / "lod-meta.json")
    assert text in str(error.value)
    assert "\n" not in str(error.value)


def test_a_level_is_one_cloud_for_every_command(vvgt, volume: Path, folder: Path, tmp_path: Path) -> None:
    found = []
    for name in (f"{folder}#0", f"{folder / 'lod-meta.json'}#1", f"{folder}"):
        line = ("evaluate", name, "--volume", volume, "--no-conditions", "--step", 2, "--json")
        found.append(json.loads(vvgt(*line).out))
    counts = json.loads((folder / "lod-meta.json").read_text())["counts"]
    assert [scores["gaussians"] for scores in found] == [*counts[:2], counts[0]]
    assert [scores["size"] for scores in found] == [150] * 3  # as the comments say
    assert found[0]["scores"]["psnr"] > found[1]["scores"]["psnr"] > 15
    assert found[0]["scores"]["psnr"] > found[2]["scores"]["psnr"]  # viewers show other levels from afar
    vvgt.ok("view", f"{folder}#1", "-o", tmp_path / "b.ply")
    assert len(read_ply(tmp_path / "b.ply")[0]) == counts[1]
    assert "expected a level from 0 to" in vvgt.fails(2, "evaluate", f"{folder}#9", "--volume", volume)


def test_what_a_camera_is_shown_goes_by_distance(vvgt, folder: Path, tmp_path: Path) -> None:
    levels = StreamedLevels(folder / "lod-meta.json")
    counts, nodes = (
        [len(levels.level(str(level))) for level in range(levels.count)],
        nodes_of(read_manifest(levels.path), ""),
    )
    bounds = np.array([[node["bound"]["min"], node["bound"]["max"]] for node in nodes])
    for distance in (0.9, 3.0, 4.5, 40.0):
        eye = np.array([0, -distance, 0.4])
        expected = 0
        for node, (low, high) in zip(nodes, bounds, strict=True):
            apart = float(np.linalg.norm(np.maximum(np.maximum(low - 4 * eye, 4 * eye - high), 0)))
            level = sum(apart >= edge for edge in (5, 15, 45)[: levels.count - 1])  # of 45 degrees
            expected += node["lods"][str(level)]["count"]
        assert len(levels.seen_from(eye, 45.0)) == expected
    assert len(levels.seen_from(np.zeros(3), 45.0)) == counts[0]
    assert len(levels.seen_from(np.array([0, -2.6, 0]), 10.0)) == counts[0]  # narrow: as if it were near
    assert len(levels.seen_from(np.array([0, -1e6, 0]), 45.0)) == counts[-1]
    for name, where in (("view", f"{folder}#view"), ("one", f"{folder}#1")):
        line = ("render", where, "--orbit", 2, "--size", 60, "-q", "-o", tmp_path / name)
        vvgt.ok(*line)
    seen, one = (read_png(min((tmp_path / name).glob("*.png"))) for name in ("view", "one"))
    np.testing.assert_array_equal(seen, one)  # at 3 in the unit frame


def test_only_what_a_camera_is_shown_is_read_and_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    levels, read = StreamedLevels(folder / "lod-meta.json"), []
    counted = lambda meta, image, name: read.append(name) or splats_in(meta, image, name)  # noqa: E731
    monkeypatch.setattr("vvgt_cli.gaussians.formats.streamed.splats_in", counted)
    for distance, shown in ((1e6, {levels.count - 1}), (1e6, set()), (0.0, {0})):
        read.clear()
        seen = levels.seen_from(np.array([0, -distance, 0]), 45.0)
        assert ({int(Path(name).parent.name.split("_")[0]) for name in read}, len(read)) == (shown, len(set(read)))
        assert sum(map(len, levels._cached.values())) == len(seen)


def test_unreadable_levels_are_reported_in_a_line(vvgt, folder: Path, tmp_path: Path) -> None:
    broken = tmp_path / "b"
    shutil.copytree(folder, broken)
    (broken / "1_0" / "sh0.webp").unlink()
    line = ("render", f"{broken}#1", "--orbit", 1, "-o", tmp_path / "p")
    assert "sh0.webp is missing; expected the whole folder" in vvgt.fails(1, *line)
    (broken / "1_0" / "meta.json").write_text("{")
    assert "damaged" in vvgt(*line).error
    manifest = json.loads((broken / "lod-meta.json").read_text())
    manifest["tree"]["children"][0]["lods"]["0"]["count"] += 1_000_000
    (broken / "lod-meta.json").write_text(json.dumps(manifest))
    assert "a node has rows to" in vvgt("render", broken, "--orbit", 1, "-o", tmp_path / "p").error
    assert vvgt("render", broken, "--orbit", 1, "--memory", "1M", "-o", tmp_path / "p").code == 1
    assert not (tmp_path / "p").exists()


def test_finished_gaussians_are_not_saved_as_levels(tmp_path: Path) -> None:
    result = vvgt_cli.convert(np.arange(512, dtype=np.float32).reshape(8, 8, 8), max_gaussians=20, screen=32, steps=0)
    with pytest.raises(UsageError, match="streamed levels need the volume"):
        result.save(tmp_path / "lod-meta.json")
    assert not list(tmp_path.iterdir())
