"""Devices that files are made for: what `--for` sets, and how a headset's eyes score it."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import vvgt_cli
from tests.refused import refused
from vvgt_cli.cameras import default_views
from vvgt_cli.commands.options import TARGETS as NAMES
from vvgt_cli.conversion.place import headset_axes
from vvgt_cli.conversion.request import ConvertRequest, FitOptions
from vvgt_cli.conversion.stages import ViewingConditions
from vvgt_cli.dvr import RenderSettings, render_view
from vvgt_cli.errors import UsageError
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import read_ply
from vvgt_cli.gaussians.formats import SUFFIXES
from vvgt_cli.gaussians.rules import RULES
from vvgt_cli.gaussians.targets import TARGETS
from vvgt_cli.images.metrics import psnr
from vvgt_cli.score.viewing import AWAY, eye_pictures
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume

BLOB = "example:blob:16"
FEW = ("--max-gaussians", 60, "--steps", 0)
BOTH = ("quest both eyes 1.5 m", "quest both eyes 2 m")


def test_the_table_is_consistent():
    assert tuple(TARGETS) == NAMES
    for name, target in TARGETS.items():
        assert target.name == name
        assert target.rule in RULES
        assert {target.best, *target.unread} <= set(SUFFIXES)
        assert target.best not in target.unread
        if target.focal is not None:  # a pixel of the nearest eye is one of the screen in the default views
            near = target.focal * 2 * 3 * math.tan(math.radians(20)) / min(AWAY)
            assert target.screen == pytest.approx(near, abs=0.5)


def test_what_is_given_wins_over_the_target():
    device = TARGETS["quest"]
    whole = FitOptions.of("quest")
    assert (whole.max_gaussians, whole.screen, whole.rule) == (device.max_gaussians, device.screen, device.rule)
    default = FitOptions.of(max_gaussians=None)
    assert (default.max_gaussians, default.screen, default.rule) == (100_000, 1080, "inria")
    given = FitOptions.of("quest", screen=1080, rule="inria")  # also where it equals the default
    assert (given.max_gaussians, given.screen, given.rule) == (device.max_gaussians, 1080, "inria")
    assert FitOptions.of("phone", max_gaussians=100_000).max_gaussians == 100_000
    refused(UsageError, r"--target-psnr 200", vvgt_cli.convert, BLOB, target="phone", target_psnr=200)
    refused(UsageError, r"target 'watch'; expected one of quest, visionos, phone, desktop", FitOptions.of, "watch")


@pytest.mark.parametrize(
    ("output", "given", "limit"),
    [
        ("a.ply", {}, 20), ("a.html", {}, 20), ("a.html", {"live": True}, 20), ("-", {}, 20), (None, {}, 20),
        ("a.sog", {}, None), ("a.ply", {"live": True}, None),
        ("a.ply", {"fit": FitOptions(10_000_000, target="phone", max_megabytes=5)}, 5),
    ],
)  # fmt: skip
def test_the_size_limit_is_of_files_that_have_one(output, given, limit):
    fit = FitOptions(10_000_000, target="phone")
    request = ConvertRequest(SourceRequest(BLOB), output, **{"fit": fit} | given)
    assert request.megabytes == limit
    assert replace(request, shares_output=True).megabytes == request.fit.max_megabytes
    if limit is None:
        assert request.budget() == 10_000_000
    elif output == "a.ply":
        assert request.budget() == int((limit * 1e6 - 3600) // 68)


def test_eyes_stand_where_the_page_puts_them():
    pictures = eye_pictures("quest", views=(4,))
    assert [place.where for place, *_ in pictures] == [BOTH[1]] * 2 + [BOTH[0]] * 2
    for (_, left, _), (_, right, _), away in zip(pictures[::2], pictures[1::2], AWAY, strict=True):
        assert left.rotation @ (right.position - left.position) == pytest.approx([0.063, 0, 0])
        x, y, z = (left.position + right.position) / 2
        assert (math.hypot(x, y), z) == pytest.approx((away, 0.3))
        tx, ty, _ = default_views("test")[4].position
        assert math.atan2(y, x) == pytest.approx(math.atan2(ty, tx))
        assert left.rotation @ -np.array([x, y, z]) == pytest.approx([0, 0, math.hypot(away, 0.3)])  # straight ahead
        assert left.fx == pytest.approx(1680 / (math.tan(math.radians(54)) + math.tan(math.radians(40))), rel=1e-3)
        assert np.degrees(2 * np.arctan(left.height / 2 / left.fy)) == pytest.approx(40)
    assert len(eye_pictures("visionos")) == 2 * 3 * 2
    assert eye_pictures("phone") == eye_pictures(None) == []
    fit = FitOptions(screen=64)
    assert len(ViewingConditions("quest").views(fit)) == len(ViewingConditions().views(fit)) + 4


@pytest.mark.parametrize(("up", "direction"), [("none", (0, -1, 0)), ("z", (0, 0, 1)), ("x", (1, 0, 0))])
def test_eyes_stand_above_the_middle_as_viewers_show_it(up, direction):
    volume = Volume(np.zeros((4, 4, 4), np.uint8), direction=(1, 0, 0, 0, -1, 0, 0, 0, 1))  # j points down in the world
    for place, eye, _ in eye_pictures("quest", headset_axes(volume, up), (4,)):
        away = float(place.where.split()[-2])
        assert volume.axes @ eye.position @ direction == pytest.approx(0.3)
        assert np.linalg.norm(eye.position) == pytest.approx(math.hypot(away, 0.3, 0.0315))


def test_a_headset_is_scored_by_both_eyes_and_the_file_says_so(vvgt, tmp_path):
    out, report = tmp_path / "a.ply", tmp_path / "a.json"
    command = ("convert", BLOB, *FEW, "--for", "quest", "--screen", 48, "-o", out)
    found = vvgt.ok(*command, "--report", report)
    assert "for quest: at most 20 MB, 60 Gaussians, 48 px, drawn as playcanvas" in found.err
    known = json.loads(report.read_text())
    assert {key: known["options"][key] for key in ("target", "max_gaussians", "screen", "rule", "max_megabytes")} == {
        "target": "quest", "max_gaussians": 60, "screen": 48, "rule": "playcanvas", "max_megabytes": 20,
    }  # fmt: skip
    scored = {one["where"]: one for one in known["conditions"] if one["where"]}
    assert set(scored) == set(BOTH)
    gaussians, header = read_ply(out)
    scene, recorded = load(SourceRequest(BLOB)).scene(), dict(header.certificate.conditions)
    for name, one in scored.items():
        assert one["rule"] == "playcanvas"
        assert recorded[name] == round(one["psnr"], 2)
        expected = []
        for place, camera, _ in eye_pictures("quest", views=(4,)):
            if place.where == name:
                whole = render_view(scene, camera, RenderSettings()), render(gaussians, camera, "playcanvas")
                expected.append(psnr(whole[0][..., :3], whole[1][..., :3]))
        assert one["psnr"] == pytest.approx(np.mean(expected), abs=0.3)  # blocks of the same pictures
    vvgt.ok(*command, "--overwrite", "--blocks", 16)
    again = dict(read_ply(out)[1].certificate.conditions)
    assert [again[name] for name in BOTH] == pytest.approx([recorded[name] for name in BOTH], abs=0.5)


def test_every_kind_of_conversion_has_the_score(vvgt, tmp_path):
    goal = {"target": "quest", "max_gaussians": 60, "screen": 48, "steps": 0}
    clouds = vvgt_cli.convert(BLOB, {"one": "viridis", "two": "magma"}, **goal)
    live = vvgt_cli.convert(BLOB, "viridis", target="quest", max_gaussians=60, screen=48, live=True)
    for one in (*clouds.values(), live):
        assert set(BOTH) <= {name for name, _ in one.ply.certificate.conditions}
    screen = vvgt_cli.convert(BLOB, "viridis", **goal | {"target": "phone"})
    assert not any("eyes" in name for name, _ in screen.ply.certificate.conditions)


def test_a_file_is_scored_on_a_device_later(vvgt, tmp_path):
    out = tmp_path / "a.ply"
    vvgt.ok("convert", BLOB, *FEW, "--screen", 48, "-o", out)
    found = vvgt.ok("evaluate", out, "--volume", BLOB, "--for", "quest", "--screen", 48, "--step", 1, "--json")
    told = json.loads(found.out)
    assert told["rule"] == "playcanvas"
    assert set(BOTH) <= {one["where"] for one in told["conditions"]}
    vvgt.ok("evaluate", out, "--volume", BLOB, "--for", "phone", "--screen", 48, "--step", 1, "--no-conditions")
    result = vvgt.fails(2, "evaluate", out, "--volume", BLOB, "--for", "quest", "--no-conditions")
    assert "--no-conditions with --for quest" in result


@pytest.mark.parametrize(
    ("output", "options", "why"),
    [
        ("a.usdz", (), "no program there opens it; expected .html"),
        ("a.glb", ("--tf", "viridis", "--tf", "magma"), "all nodes are drawn together"),
    ],
)
def test_what_a_device_cannot_show_is_refused(vvgt, tmp_path, monkeypatch, output, options, why):
    monkeypatch.chdir(tmp_path)
    assert why in vvgt.fails(2, "convert", BLOB, *options, "--for", "quest", "-o", output)
    assert not list(tmp_path.iterdir())
