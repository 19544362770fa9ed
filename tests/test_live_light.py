"""Light on Gaussians that carry values, without the volume."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli as vvgt_library
from tests.test_live import GRAIN, HI, LO, RAMP, SMALL, cloud, facts
from tests.test_page_look import options, page_of
from vvgt_cli.closed_form.lit import relight
from vvgt_cli.dvr.light import sphere
from vvgt_cli.field.field import Resident
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import Gaussians, read_ply
from vvgt_cli.gaussians.frames import basis, rotations, turn, up_matrix, view_colors
from vvgt_cli.gaussians.live import MEANS, SHARP, SPREADS, WIDEST, Table, apply_look, directions, spreads
from vvgt_cli.gaussians.live_facts import AXIS
from vvgt_cli.look.lighting import Lighting, LightOptions
from vvgt_cli.volume import Volume

SIDE = Lighting(False, ((0.6, 0.0, 0.8),), 0.2, 0.6, 0.3, 4.0)
HEAD = Lighting(True, (), 0.1, 0.7, 0.2, 3.0)


def grey(gradient: np.ndarray) -> Gaussians:
    count = len(gradient)
    return Gaussians(
        np.zeros((count, 3)), np.zeros((count, 3)), np.tile([1, 0, 0, 0], (count, 1)), np.zeros(count),
        np.full((count, 3), [0.5, 0.3, 0.1]),
    )  # fmt: skip


def exact(color: np.ndarray, n: np.ndarray, d: np.ndarray, light: Lighting) -> np.ndarray:
    """The formula of docs/light.md in float64, one normal and one direction at a time."""
    toward = -d if light.headlight else np.array(light.directions[0])
    half = toward - d
    facing = min(abs(float(n @ half)) / max(float(np.linalg.norm(half)), 1e-9), 1.0)
    diffuse = light.ambient + light.diffuse * abs(float(n @ toward))
    return color * diffuse + light.specular * facing**light.specular_power


@pytest.mark.parametrize("light", [HEAD, SIDE, replace(HEAD, specular=0.0), replace(SIDE, specular=0.0)])
def test_lit_colors_are_those_of_the_formula_in_harmonics_of_degree_2(light: Lighting) -> None:
    """Of a share of the matter that faces along the axis; the rest faces all directions."""
    axis, share = np.random.default_rng(2).normal(size=(5, 3)), np.array([1.0, 0.8, 0.5, 0.2, 0.01])
    axis *= (share / np.linalg.norm(axis, axis=1))[:, None]
    shaded, everywhere = relight(grey(axis), axis, light), sphere(2000)
    assert shaded.degree == (2 if light.depends_on_view else 0)
    eyes, color = sphere(400), np.array([0.5, 0.3, 0.1])
    for k in range(5):
        one = np.array([exact(color, axis[k] / share[k], d, light) for d in eyes])
        rest = np.mean([exact(color, n, eyes[0], light) for n in everywhere], axis=0)
        wanted = share[k] * one + (1 - share[k]) * rest
        found = np.tile(shaded.colors[k].astype(float), (400, 1))
        if shaded.harmonics is not None:
            found += basis(eyes, 2) @ shaded.harmonics[k].astype(float)
        np.testing.assert_allclose(found.mean(axis=0), wanted.mean(axis=0), atol=0.02)
        assert np.sqrt(((found - wanted) ** 2).mean()) < 0.05


def test_where_there_is_no_gradient_there_is_ambient_light_alone() -> None:
    for light in (HEAD, SIDE):
        shaded = relight(grey(np.zeros((2, 3))), np.zeros((2, 3)), light)
        np.testing.assert_allclose(
            view_colors(shaded, np.array([3.0, 1, 0])), np.tile([0.5, 0.3, 0.1], (2, 1)) * light.ambient, atol=1e-6
        )


def test_a_light_turns_with_its_gaussians() -> None:
    some, table, eye = cloud(), Table.of_function(RAMP, LO, HI, 0.05, GRAIN), np.array([2.0, -1.0, 0.7])

    def shade(gaussians: Gaussians, light: Lighting) -> Gaussians:
        return relight(apply_look(gaussians, table), gaussians.live[:, AXIS], light)

    turned = replace(SIDE, directions=(tuple((up_matrix("x") @ np.array(SIDE.directions[0])).tolist()),))
    for light, other in ((SIDE, turned), (HEAD, HEAD)):
        before, after = shade(some, light), shade(turn(some, "x"), other)
        np.testing.assert_allclose(view_colors(before, eye), view_colors(after, up_matrix("x") @ eye), atol=5e-3)


@pytest.fixture(scope="module")
def lit_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from vvgt_cli.commands.main import run

    path = tmp_path_factory.mktemp("lit") / "live.ply"
    tail = ["-q", "-o", str(path), *map(str, SMALL)]
    assert (
        run(["convert", "example:marschner-lobb:20", "--live", "--tf", "viridis", "--light", "headlight", *tail]) == 0
    )
    return path


def test_recolor_uses_the_given_light_or_that_of_the_function_or_the_file(vvgt, lit_file, tmp_path) -> None:
    _, header = read_ply(lit_file)
    assert (header.light, header.sh_degree) == (Lighting(), 2)
    points = [{"x": 0, "rgb": [1, 0, 0], "opacity": 0.1}, {"x": 1, "rgb": [0, 1, 0], "opacity": 0.9}]
    function = {"range": [0, 1], "points": points, "lighting": {"ambient": 0.3}}
    (tmp_path / "f.json").write_text(json.dumps(function))
    found = {}
    lights = {"as": (), "f": ("--tf", tmp_path / "f.json"), "none": ("--light", "none")}
    for name, more in (lights | {"x": ("--light", "x", "--specular", 0)}).items():
        vvgt.ok("recolor", lit_file, *more, "-o", tmp_path / f"{name}.ply")
        found[name] = read_ply(tmp_path / f"{name}.ply")
    assert found["as"][1].light == header.light
    assert found["f"][1].light == Lighting(ambient=0.3)
    assert found["none"][1].light is None
    assert found["none"][0].harmonics is None
    assert found["x"][1].light == Lighting(False, ((1.0, 0.0, 0.0),), specular=0.0)
    assert found["x"][0].harmonics is None
    assert found["x"][0].colors.mean() < found["none"][0].colors.mean()
    again = vvgt_library.recolor(lit_file, light=LightOptions(("x",), specular=0.0))
    np.testing.assert_allclose(again.gaussians.colors, found["x"][0].colors, atol=1e-6)
    scores = {}
    for light in ("headlight", "none"):
        shown = ("evaluate", lit_file, "--volume", "example:marschner-lobb:20", "--tf", "viridis", "--light", light)
        scores[light] = json.loads(vvgt(*shown, "--json", "--no-conditions", "--step", 1, "--screen", 48).out)[
            "scores"
        ]["psnr"]
    assert scores["headlight"] > scores["none"] - 2
    bare = ("evaluate", lit_file, "--volume", "example:marschner-lobb:20", "--json", "--no-conditions", "--step", 1)
    own, dark = (json.loads(vvgt(*bare, "--screen", 48, *how).out)["scores"] for how in ((), ("--light", "none")))
    assert dark["psnr"] > own["psnr"] + 3  # under the function that the volume gets without --tf, the file has another
    vvgt.ok("render", lit_file, "--light", "x", "--orbit", 1, "--size", 32, "-o", tmp_path / "a")
    vvgt.ok("render", lit_file, "--orbit", 1, "--size", 32, "-o", tmp_path / "b")
    assert next((tmp_path / "a").glob("*.png")).read_bytes() != next((tmp_path / "b").glob("*.png")).read_bytes()


def test_light_that_needs_the_volume_is_refused(vvgt, lit_file, tmp_path) -> None:
    with pytest.raises(vvgt_library.UsageError, match="--light sun: skies need the volume"):
        vvgt_library.recolor(lit_file, light=LightOptions(("sun",)))
    done = vvgt.fails(2, "recolor", lit_file, "--ambient", "0.5", "--light", "none", "-o", tmp_path / "a.ply")
    assert "there is no light" in done
    assert not list(tmp_path.iterdir())


def test_a_page_begins_with_the_files_light() -> None:
    for light, kind in ((None, "none"), (HEAD, "headlight"), (SIDE, "direction")):
        _, scene = page_of(facts(), options(light=light))
        assert scene["look"]["light"]["kind"] == kind
    there = (up_matrix("y") @ np.array(SIDE.directions[0])) * (-1, -1, 1)
    np.testing.assert_allclose(scene["look"]["light"]["from"], there, atol=1e-12)
    assert scene["look"]["light"]["power"] == 4.0
    with pytest.warns(UserWarning, match="one light at a time"):
        page_of(facts(), options(light=replace(SIDE, headlight=True)))


def test_what_is_opaque_lies_flat_in_its_surface() -> None:
    """A round one: the direction in which values rise becomes its shortest axis, without one that of the normals."""
    rises, normals = np.array([[0.48, 0.6, 0.64], [0.6, -0.8, 0.0]])
    live = np.array([[70.0, 1.0, 1.0, *normals, *rises], [70.0, 1.0, 1.0, *(0.2 * normals), 0, 0, 0]])
    some = Gaussians(
        np.zeros((2, 3)), np.full((2, 3), np.log(0.1)), [[1, 0, 0, 0]] * 2, [0.0] * 2, [[1, 1, 1]] * 2, live=live
    )
    shown = apply_look(some, Table.of_function(RAMP, LO, HI, 0.05, GRAIN))
    axes = rotations(shown.quaternions.astype(float)) * np.exp(shown.log_scales.astype(float))[:, None, :]
    for own, across in zip(axes, (rises, normals), strict=True):
        variances, turned = np.linalg.eigh(own @ own.T)
        np.testing.assert_allclose(variances, 0.01 * np.array([SHARP, 1, 1]), rtol=1e-3)
        assert abs(turned[:, 0] @ across) == pytest.approx(1, abs=1e-5)


def test_directions_are_unit_vectors_of_own_axes() -> None:
    along, share = directions(cloud())
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1, atol=1e-6)
    assert (share <= 1).all()
    assert spreads()[-1] == WIDEST
    assert Table.of_function(RAMP, LO, HI, 1, GRAIN).sums.shape == (MEANS, SPREADS, 6)


def test_the_axis_of_normals_is_that_of_a_surface_and_shorter_the_noisier_it_is() -> None:
    """Of a plate that both sides of lie under one Gaussian, where the mean gradient is zero; in a ramp; in noise."""
    rng, (z, _, _) = np.random.default_rng(4), np.mgrid[:24, :24, :24]
    noise, plate = rng.normal(size=z.shape), np.exp(-(((z - 11.5) / 3) ** 2))
    some = Gaussians(np.zeros((1, 3)), np.full((1, 3), np.log(0.2)), [[1, 0, 0, 0]], [0.0], [[1, 1, 1]])
    found = {}
    for name, values in {"plate": plate, "ramp": z, "rough": z + 2 * noise, "noise": noise, "flat": 0 * noise}.items():
        volume = Volume(values.astype(np.float32), (1, 1, 1), name=name)
        live = Resident(load(SourceRequest(volume, tf="viridis"))).sample(some)[0]
        found[name] = live[2:5], live[5:8]
    share = {name: float(np.linalg.norm(axis)) for name, (axis, _) in found.items()}
    assert share["ramp"] == pytest.approx(1, abs=1e-6)
    assert share["plate"] > 0.9
    assert 0.9 > share["rough"] > share["noise"]
    assert share["noise"] < 0.5
    assert share["flat"] == 0
    for name in ("plate", "ramp"):
        assert abs(found[name][0][2]) == pytest.approx(share[name], abs=1e-3)
    assert np.linalg.norm(found["plate"][1]) < 0.1
