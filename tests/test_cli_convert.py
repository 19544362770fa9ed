"""The commands end to end on small volumes."""

import io
import json
from pathlib import Path

import numpy as np
import pytest

from tests.processes import VVGT, python
from vvgt_cli.cameras.files import read_cameras
from vvgt_cli.gaussians import in_unit_frame, read_ply
from vvgt_cli.images import read_png
from vvgt_cli.images.metrics import psnr
from vvgt_cli.score.viewing import viewing_conditions

ROOT = Path(__file__).parent.parent
SMALL = ("--max-gaussians", 300, "--screen", 48)
SOURCE = "example:marschner-lobb:24"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    points = [
        {"x": 0, "rgb": [0.1, 0.2, 0.9], "opacity": 0},
        {"x": 0.5, "rgb": [0.9, 0.8, 0.2], "opacity": 0.2},
        {"x": 1, "rgb": [0.9, 0.1, 0.1], "opacity": 0.6},
    ]
    Path("tf.json").write_text(json.dumps({"range": [0, 1], "points": points}))
    return tmp_path


@pytest.fixture(scope="module")
def converted(tmp_path_factory):
    """One conversion with every output, and its standard error."""
    folder = tmp_path_factory.mktemp("converted")
    args = ["convert", SOURCE, *SMALL, "-o", "a.ply", "--report", "a.json", "--preview", "a.png"]
    out, talk = python(*VVGT, *args, cwd=folder)
    assert out == ""
    return folder, talk


def test_convert_leaves_file_report_and_preview(converted):
    folder, talk = converted
    gaussians, header = read_ply(folder / "a.ply")
    assert 0 < len(gaussians) <= 300
    assert (header.frame, header.up, header.unit_distance_label) == ("unit", "none", "automatic")
    assert (header.screen_size, header.rule) == (48, "inria")
    assert np.abs(gaussians.means).max() < 1.2
    report = json.loads((folder / "a.json").read_text())
    assert (report["format"], report["schema"], report["command"]) == ("vvgt-conversion", 1, "convert")
    assert report["gaussians"] == len(gaussians)
    assert report["bytes"] == (folder / "a.ply").stat().st_size
    assert report["scores"]["psnr"] > 15
    assert report["volume"]["dims"] == [24, 24, 24]
    assert report["transfer_function"]["given"] is False
    assert report["seconds"] >= sum(stage["seconds"] for stage in report["stages"]) * 0.99
    assert report["versions"]["vvgt"] == header.version
    assert read_png(folder / "a.png").shape == (3 * (18 + 48), 3 * 48, 3)
    lines = [line for line in talk.splitlines() if not line.startswith("skipped") and not line.endswith(" %")]
    assert [line[:16].strip() for line in lines] == [stage["name"] for stage in report["stages"]]
    assert f"PSNR {report['scores']['psnr']:.2f} dB" in talk
    assert "\r" not in talk  # no bars where nobody watches


def test_the_report_page_names_every_field(converted):
    page = (ROOT / "docs" / "report.md").read_text()

    def names(value):
        if isinstance(value, dict):
            for key, item in value.items():
                yield key
                yield from names(item)
        elif isinstance(value, list):
            for item in value:
                yield from names(item)

    report = json.loads((converted[0] / "a.json").read_text())
    report.pop("versions")  # a package a key
    missing = {name for name in names(report) if f"`{name}`" not in page}
    assert not missing


def test_the_same_command_gives_the_same_bytes_on_standard_output_too(converted):
    again = python(*VVGT, "convert", SOURCE, *SMALL, "-o", "-", "-q", cwd=converted[0], text=False)
    assert again == ((converted[0] / "a.ply").read_bytes(), b"")


def test_report_to_standard_output(folder, vvgt):
    report = json.loads(vvgt("init", SOURCE, *SMALL, "-o", "a.ply", "--report", "-").out)
    assert (report["command"], report["scores"]) == ("init", None)
    assert report["gaussians"] == len(read_ply("a.ply")[0])


@pytest.mark.parametrize("method", ["moments", "wavelet", "uniform"])
def test_init_has_three_methods(method, folder, vvgt):
    said = vvgt.ok("init", SOURCE, *SMALL, "--tf", "tf.json", "--init", method, "-o", "a.ply").err
    assert (f"Gaussians ({method})" in said) == (method != "moments")  # the default is not named
    assert 0 < len(read_ply("a.ply")[0]) <= 300


def test_the_seed_draws_other_samples(folder, vvgt):
    outputs = [
        vvgt("init", SOURCE, *SMALL, "--init", "uniform", "--seed", seed, "-o", "-", "-q").out for seed in (0, 0, 1)
    ]
    assert outputs[0] == outputs[1] != outputs[2]


def test_frames_agree(folder, vvgt):
    options = ("init", SOURCE, *SMALL, "--spacing", 2, 1, 0.5, "--tf", "tf.json", "-q", "-o")
    vvgt.ok(*options, "unit.ply")
    vvgt.ok(*options, "world.ply", "--frame", "world", "--up", "z", "--sh-degree", 3)
    unit, _ = read_ply("unit.ply")
    world, header = read_ply("world.ply")
    assert (header.frame, header.up, header.sh_degree) == ("world", "z", 3)
    np.testing.assert_allclose(in_unit_frame(world, header).means, unit.means, atol=1e-5)
    vvgt.ok(*options, "bare.ply", "--no-comments")
    assert b"comment" not in Path("bare.ply").read_bytes().split(b"end_header")[0]


def test_render_writes_views_that_render_again(converted, folder, vvgt):
    ply = converted[0] / "a.ply"
    vvgt.ok("render", ply, "--orbit", 3, "--size", 40, "--background", 1, 1, 1, "-o", "turn")
    assert sorted(path.name for path in Path("turn").iterdir()) == [
        *(f"orbit_{i:03d}.png" for i in range(3)),
        "transforms.json",
    ]
    assert read_png("turn/orbit_000.png").shape == (40, 40, 3)
    assert len(read_cameras("turn/transforms.json")) == 3
    assert "exists" in vvgt.fails(2, "render", ply, "--orbit", 3, "--size", 40, "-o", "turn")
    vvgt.ok("render", ply, "--camera", "turn/transforms.json", "--size", 20, "-o", "again")
    assert read_png("again/orbit_002.png").shape == (20, 20, 4)


def test_pipes(folder, vvgt):
    values = (np.indices((12, 12, 12)).sum(axis=0) * 7).astype(np.uint8)
    options = ["--dims", 12, 12, 12, "--dtype", "uint8", *SMALL, "-o", "-", "-q"]
    made, _ = python(*VVGT, "init", "-", *options, given=values.tobytes(), text=False)
    count = len(read_ply(io.BytesIO(made))[0])
    facts, _ = python(*VVGT, "info", "-", "--json", given=made, text=False)
    assert json.loads(facts)["gaussians"] == count
    python(*VVGT, "render", "-", "--orbit", 1, "--size", 20, "-o", "d", given=made, text=False)
    assert Path("d/orbit_000.png").exists()


def test_evaluate_scores_every_condition(converted, vvgt, monkeypatch):
    monkeypatch.setattr("vvgt_cli.commands.evaluation.viewing_conditions", viewing_conditions)
    ply = converted[0] / "a.ply"
    options = ("evaluate", ply, "--volume", SOURCE, "--step", 0.5)
    document = json.loads(vvgt(*options, "--json").out)
    assert (document["format"], document["size"], document["rule"]) == ("vvgt-evaluation", 48, "inria")  # the file's
    assert document["reference_psnr"] > 30
    report = json.loads((converted[0] / "a.json").read_text())
    assert document["scores"]["psnr"] == pytest.approx(report["scores"]["psnr"], abs=0.5)
    assert document["transfer_function"]["unit_distance"] == report["transfer_function"]["unit_distance"]
    conditions = document["conditions"]
    assert len(conditions) == 8 * 5  # rules; 48, 400, 800, 2160 px and close up
    assert [condition["psnr"] for condition in conditions] == sorted(condition["psnr"] for condition in conditions)
    assert {condition["field_of_view"] for condition in conditions} == {10, 40}
    page = (ROOT / "docs" / "report.md").read_text()
    assert all(f"`{name}`" in page for name in (*document, *document["scores"], *conditions[0]))
    table = vvgt(*options, "--no-conditions", "--quiet", "--rule", "playcanvas")
    assert table.err == ""
    assert "drawn as playcanvas" in table.out.decode()
    assert "close up" not in table.out.decode()
    assert f"{document['scores']['psnr']:.4f}" not in table.out.decode()


def test_evaluate_draws_what_it_scores_from_afar_and_close_up(converted, vvgt, tmp_path):
    picture = tmp_path / "seen.png"
    options = ("evaluate", converted[0] / "a.ply", "--volume", SOURCE, "--no-conditions", "--step", 0.5)
    options += ("--preview", picture)
    document = json.loads(vvgt(*options, "--json").out)
    sheet = read_png(picture)[..., :3]
    assert sheet.shape[:2] == (2 * (18 + 48), 3 * 48)  # a line above each row
    far, near = sheet[18:66], sheet[84:]
    assert psnr(far[:, :48], far[:, 48:96]) == pytest.approx(document["scores"]["per_view"][4]["psnr"], abs=0.3)
    np.testing.assert_allclose(far[:, 96:], np.clip(8 * abs(far[:, :48] - far[:, 48:96]), 0, 1), atol=10 / 255)
    middle = far[18:30, 18:30]  # what 10 degrees of 40 show
    assert near[:, :48].mean((0, 1)) == pytest.approx(middle.mean((0, 1)), rel=0.1)
    assert far[:, :48].mean((0, 1)) != pytest.approx(middle.mean((0, 1)), rel=0.1)
    assert psnr(near[:, :48], near[:, 48:96]) > 20
    assert "exists" in vvgt.fails(2, *options)


def test_rules_are_the_tables():
    from vvgt_cli.commands.options import RULES as NAMES
    from vvgt_cli.gaussians.rules import RULES

    assert tuple(RULES) == NAMES


def test_a_scene_without_anything_to_see_is_an_error(folder, vvgt):
    values = np.zeros((9, 9, 9), np.float32)
    values[2:7, 2:7, 2:7] = np.nan  # transparent, and so is all that is interpolated with it
    values[4, 4, 4] = 1
    values.tofile("v.raw")
    points = [{"x": x, "rgb": [1, 1, 1], "opacity": float(x > 0.5)} for x in (0, 0.5, 0.51, 1)]
    Path("high.json").write_text(json.dumps({"range": [0, 1], "points": points}))
    raw = ("v.raw", "--dims", 9, 9, 9, "--dtype", "float32")
    assert "nothing visible" in vvgt.fails(1, "convert", *raw, "--tf", "high.json", *SMALL, "-o", "a.ply")
    assert not Path("a.ply").exists()


def test_info_on_every_kind(converted, folder, vvgt):
    kinds = {
        SOURCE: "volume",
        "tf.json": "transfer function",
        str(converted[0] / "a.ply"): "gaussians",
    }
    for file, kind in kinds.items():
        assert vvgt.ok("info", file).out.decode().splitlines()[0].split(None, 1) == ["kind", kind]
        assert json.loads(vvgt("info", file, "--json").out)["kind"] == kind
    vvgt("render", converted[0] / "a.ply", "--orbit", 2, "--size", 16, "-o", "d")
    assert json.loads(vvgt("info", "d/transforms.json", "--json").out)["views"] == 2


def test_tf_show_draws(folder, vvgt):
    vvgt.ok("tf", "show", "tf.json", "-o", "a.png")
    vvgt.ok("tf", "show", "tf.json", "-o", "b.png", "--volume", SOURCE)
    a, b = read_png("a.png"), read_png("b.png")
    assert a.shape == b.shape
    assert np.abs(a - b).max() > 0.1  # the histogram behind


def test_an_interrupted_run_leaves_nothing(folder, vvgt, monkeypatch):
    import vvgt_cli.conversion.gaussian_files as files

    def stop(stream, *args):
        Path(stream).write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(files, "write_ply", stop)
    result = vvgt("init", SOURCE, *SMALL, "-o", "a.ply")
    assert (result.code, "interrupted" in result.err) == (130, True)
    assert [path.name for path in folder.iterdir()] == ["tf.json"]
