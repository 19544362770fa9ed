"""Isosurfaces: levels of a function, on the command line, in files, layers and the library."""

import json
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli as library
from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.source import parse_layer
from vvgt_cli.gaussians import read_ply
from vvgt_cli.look import read_transfer_function, resolve
from vvgt_cli.volume import statistics
from vvgt_cli.volume.types import Volume

SMALL = ("--max-gaussians", 100, "--screen", 32)
Z, Y, X = np.mgrid[-1:1:20j, -1:1:20j, -1:1:20j]
R = np.sqrt(X**2 + Y**2 + Z**2)
BALL = np.clip(1 - R, 0, None).astype(np.float32)  # 0 around it, 1 in the middle
DISTANCE = (R - 1.1).astype(np.float32)  # most of the box is inside
CHARGE = (np.exp(-8 * ((X - 0.4) ** 2 + Y**2 + Z**2)) - np.exp(-8 * ((X + 0.4) ** 2 + Y**2 + Z**2))).astype(np.float32)


def placed(values: np.ndarray, text: str, **known: bool):
    return resolve(read_transfer_function(f"iso:{text}"), statistics(Volume(values)), **known)


@pytest.mark.parametrize(
    ("values", "text", "solid", "clear"),
    [
        (BALL, "0.3", [0.32, 0.9], [0, 0.28]),
        (BALL, "0.3,below", [0, 0.28], [0.32, 0.9]),
        (1 - BALL, "0.7", [0.1, 0.68], [0.72, 1]),  # away from the background of 1
        (-DISTANCE, "0,above", [0.02, 0.5], [-0.02, -0.5]),
        (DISTANCE, "0", [-0.5, -0.02], [0.02, 0.5]),
        (CHARGE, "0.5:-0.5", [-0.8, -0.52, 0.52, 0.8], [-0.48, 0, 0.48]),
        (CHARGE, "2sigma", [0.8], [-0.8, 0, 0.1]),
        (BALL, "0.2:0.6", [0.62, 0.9], [0, 0.18, 0.4, 0.58]),
    ],
)
def test_a_level_is_the_face_of_a_solid_body(values, text, solid, clear) -> None:
    shown = placed(values, text)
    assert shown.opacity(np.array(solid)).min() == 1
    assert shown.opacity(np.array(clear)).max() == 0
    assert shown.lighting is not None


def test_outer_surfaces_are_translucent_and_of_other_colours() -> None:
    shown = placed(BALL, "0.2:0.6,#ff0000")
    assert 0.7 < shown.opacity(np.array([0.2]))[0] < 0.9  # at 0.5 a steep skin is hardly seen
    np.testing.assert_array_equal(shown.color(np.array([0.9])), [[1, 0, 0]])
    assert np.abs(shown.color(np.array([0.2])) - shown.color(np.array([0.9]))).max() > 0.3


def test_hounsfield_units_and_sigma() -> None:
    body = np.where(R < 1.2, 40.0, -1000.0)  # tissue is the largest peak
    assert placed(body, "-600", hounsfield=True).opacity(np.array([-1000.0, 40])).tolist() == [0, 1]
    found = placed(BALL, "1.5sigma").breakpoints().mean()
    assert found == pytest.approx(BALL.mean() + 1.5 * BALL.std(), rel=0.01)


@pytest.mark.parametrize("scale", [1e-310, 1e-30, 1.0, 1e30, 1e307])
@pytest.mark.parametrize("level", [1e-9, 0.5, 1 - 1e-9])
def test_extreme_levels_are_finite_and_leave_the_background_clear(scale: float, level: float) -> None:
    values = BALL.astype(np.float64) / BALL.max() * scale
    shown = placed(values, f"{level * scale!r}:{0.3 * scale!r}")
    assert np.isfinite(shown.breakpoints()).all()
    x = np.linspace(0, scale, 101)
    assert np.isfinite(shown.opacity(x)).all()
    assert shown.opacity(x)[0] == 0


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("2", DataError, r"isosurface 2: the data lie in \[0, 0\.9.*\]; expected a level between, not 2"),
        ("x", UsageError, "isosurface x: expected LEVEL"),
        ("0.3,above,below", UsageError, "expected LEVEL"),
        ("0.3:0.3", UsageError, "each once"),
        ("0.6,below:0.3,above", UsageError, "every value is inside"),
    ],
)
def test_levels_that_show_nothing_are_refused(text: str, error: type[Exception], message: str) -> None:
    refused(error, message, placed, BALL, text)


def test_levels_go_to_json_and_back(tmp_path: Path, vvgt) -> None:
    vvgt.ok("tf", "convert", "iso:3sigma:0.03,#88aaff,above", tmp_path / "own.json")
    assert json.loads((tmp_path / "own.json").read_text())["iso"] == ["3sigma", "0.03,#88aaff,above"]
    again = read_transfer_function(str(tmp_path / "own.json"))
    assert again.levels == ((3, "sigma", None, ""), (0.03, "", (0x88 / 255, 0xAA / 255, 1), "above"))
    for wrong in ({"iso": []}, {"iso": 3}, {"iso": ["x"]}, {"iso": [1], "points": []}):
        refused(DataError, "iso", read_transfer_function, wrong)


def test_layers_take_levels(tmp_path: Path) -> None:
    assert parse_layer("a.mrc,iso=0.03:1sigma,distance=2").tf == "iso:0.03:1sigma"
    named = tmp_path / "v,iso=3.mrc"
    named.touch()
    assert (one := parse_layer(f"{named},iso=5")).volume == str(named)
    assert one.tf == "iso:5"
    refused(UsageError, "expected FILE and any of iso=", parse_layer, "a.mrc,iso=1,tf=hot")


def test_commands_take_levels_in_memory_in_blocks_and_live(tmp_path: Path, vvgt) -> None:
    np.save(tmp_path / "v.npy", BALL)
    given = (tmp_path / "v.npy", "--iso", "0.2", "--iso", "0.5,#ff0000", *SMALL)
    made = vvgt("convert", *given, "--steps", 0, "-o", tmp_path / "a.ply")
    assert made.code == 0, made.err
    assert "headlight" in made.err
    vvgt.ok("convert", *given, "--steps", 0, "--blocks", 16, "-o", tmp_path / "b.ply")
    vvgt.ok("convert", *given, "--live", "-o", tmp_path / "live.ply")
    vvgt.ok("recolor", tmp_path / "live.ply", "--iso", "0.5", "-o", tmp_path / "c.ply")
    vvgt.ok("render", tmp_path / "v.npy", "--iso", "0.5", "--size", 32, "-o", tmp_path / "r.png")
    for name in "abc":
        assert np.isfinite(read_ply(str(tmp_path / f"{name}.ply"))[0].means).all()
    for wrong in (("--tf", "hot"), ("--labels", "auto")):
        refusal = vvgt("convert", *given, *wrong, "-o", tmp_path / "d.ply")
        assert refusal.code == 2
        assert "isosurfaces and a" in refusal.err
    assert "omit --tf-range" in vvgt("convert", *given, "--tf-range", "rescale", "-o", tmp_path / "d.ply").err


def test_the_library_takes_levels() -> None:
    goal = {"max_gaussians": 100, "screen": 32, "steps": 0}
    lit = library.convert(BALL, library.Look(iso="2sigma"), **goal)
    assert lit.ply.light is not None
    assert library.convert(BALL, library.Look(iso=[0.2, 0.5], light="none"), **goal).ply.light is None
    refused(UsageError, "isosurfaces and a function", library.convert, BALL, library.Look("hot", iso=0.5), **goal)
