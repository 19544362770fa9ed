"""Gaussians that carry values, and their look under any function."""

import json
from dataclasses import replace
from pathlib import Path
from statistics import NormalDist

import numpy as np
import pytest

import vvgt_cli as vvgt_library
from tests.closed_form_scenes import scene_of
from tests.refused import refused
from vvgt_cli.cameras import default_views
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.closed_form.gaussian_samples import (
    NORMAL_SUMS,
    POINTS,
    in_voxels,
    offsets,
    samples_of,
    values_of,
)
from vvgt_cli.conversion.live import fog
from vvgt_cli.conversion.recolored import resolve_look
from vvgt_cli.dvr import RenderSettings
from vvgt_cli.dvr.layout import Voxels
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply, write_ply
from vvgt_cli.gaussians.frames import rotations, transform, turn
from vvgt_cli.gaussians.live import (
    AMOUNT,
    AROUND,
    Table,
    apply_look,
    baked,
    opacities,
    without_tails,
)
from vvgt_cli.gaussians.live_facts import AXIS, COLUMNS, LiveFacts, function_text
from vvgt_cli.gaussians.opacity import peak_opacity
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.volume import Volume
from vvgt_cli.volume.stats import Statistics, edges_of

LO, HI, GRAIN = -20.0, 80.0, 2 / 9
COLORS = ColorMap(np.array([LO, 20, HI]), np.array([[1, 0.2, 0], [0, 1, 0.3], [0.1, 0, 1]]))
RAMP = TransferFunction("ramp", PiecewiseOpacity(np.array([0.0, HI]), np.array([0.0, 0.6])), COLORS)
WINDOW = TransferFunction("window", PiecewiseOpacity(np.array([10.0, 20, 30]), np.array([0.0, 0.5, 0.0])), COLORS)
SMALL = ("--max-gaussians", 600, "--screen", 64)
TF = {"name": "w", "points": [{"x": 0.3, "rgb": [1, 0, 0], "opacity": 0}, {"x": 0.6, "rgb": [0, 1, 0], "opacity": 0.8}]}


def cloud(count: int = 40, seed: int = 1) -> Gaussians:
    rng = np.random.default_rng(seed)
    gradient = rng.normal(size=(count, 3))
    gradient *= rng.uniform(0, 1, (count, 1)) / np.linalg.norm(gradient, axis=1, keepdims=True)
    axis = rng.uniform(-0.5, 0.5, (count, 3))
    values = [rng.uniform(LO, HI, count), rng.uniform(0, 20, count), np.exp(rng.uniform(-4, 0, count))]
    return Gaussians(
        rng.uniform(-0.6, 0.6, (count, 3)), np.log(rng.uniform(0.02, 0.2, (count, 3))), rng.normal(size=(count, 4)),
        rng.normal(size=count), rng.uniform(0, 1, (count, 3)), live=np.column_stack([*values, axis, gradient]),
    )  # fmt: skip


def statistics(counts: np.ndarray) -> Statistics:
    return Statistics(LO, HI, 0, 0, np.asarray(counts, np.int64), edges_of(LO, HI))


def facts(tf: TransferFunction = RAMP) -> LiveFacts:
    return LiveFacts(LO, HI, (9, 8, 7), tuple(range(256)), "HU", function_text(tf, LO, HI), quantity="density")


@pytest.mark.parametrize("tf", [RAMP, WINDOW])
@pytest.mark.parametrize("spread", [0.5, 4.0, 15.0])
def test_a_table_holds_means_over_normal_laws(tf: TransferFunction, spread: float) -> None:
    """Against quadrature in float64: what values cover together, and colours before their neighbours are mixed in."""
    distance, values = 0.05, np.array([-5.0, 12.3, 21.0, 55.0])
    sums = Table.of_function(tf, LO, HI, distance, GRAIN).at(values, np.full(4, spread))
    z = np.array([NormalDist().inv_cdf((k + 0.5) / 20001) for k in range(20001)])

    def under(width: float) -> tuple[np.ndarray, np.ndarray]:
        at = np.clip(values[:, None] + width * z, LO, HI)
        covers = 1 - (1 - tf.opacity(at)) ** (GRAIN / distance)
        color = tf.color(at.ravel()).reshape(4, -1, 3)
        return covers, (covers[..., None] * color).mean(axis=1) / np.maximum(covers.mean(axis=1), 1e-12)[:, None]

    covers, own = under(spread)
    tau = -np.log1p(-covers.mean(axis=1)) / GRAIN
    some, most = covers.mean(axis=1) > 0.1, -np.log1p(-tf.opacity(np.linspace(LO, HI, 999)).max()) / distance
    assert np.abs(sums[:, 3] - tau).max() < 0.035 * most  # of 33 nodes
    moments = np.stack([(covers * z**p).mean(axis=1) / np.maximum(covers.mean(axis=1), 1e-12) for p in (1, 2)], axis=1)
    np.testing.assert_allclose((sums[:, 4:] / sums[:, [3]])[some], moments[some], atol=0.1)
    wanted = np.clip(own + AMOUNT * (own - under(AROUND * spread)[1]), 0, 1)
    np.testing.assert_allclose((sums[:, :3] / sums[:, [3]])[some], wanted[some], atol=0.02)


def test_without_spread_a_gaussian_has_the_functions_color_and_extinction() -> None:
    some = replace(cloud(), log_scales=np.repeat(np.linspace(-4, -1.6, 40), 3).reshape(40, 3))
    live = some.live.copy()
    live[:, 1] = 0
    shown = baked(replace(some, live=live), Table.of_function(RAMP, LO, HI, 0.05, GRAIN))
    tau = -np.log1p(-RAMP.opacity(live[:, 0].astype(float))) / 0.05
    opacity = 1 / (1 + np.exp(-shown.opacity_logits.astype(float)))
    wanted = peak_opacity(tau * live[:, 2] ** 3, np.exp(2 * some.log_scales.astype(float)), 0.0)
    np.testing.assert_allclose(opacity[tau > 0.1], wanted[tau > 0.1], atol=6e-3)
    assert opacity[tau == 0].max() < 1e-5
    seen = tau > 0.1
    np.testing.assert_allclose(shown.colors[seen], RAMP.color(live[seen, 0].astype(float)), atol=2e-2)


def test_a_flat_gaussian_is_about_as_opaque_as_face_on() -> None:
    """It is more opaque by less than half of what the mean over three views would add."""
    flat, mass = np.array([[0.01, 0.01, 1e-4]]), np.array([0.02])
    face_on = opacities(mass, np.full((1, 3), 0.01), 0.0)[0]
    assert 0 < opacities(mass, flat, 0.0)[0] - face_on < 0.5 * (peak_opacity(mass, flat, 0.0)[0] - face_on)


def test_a_gaussian_moves_to_where_the_values_are_seen_and_is_thinner_there() -> None:
    """One whose values rise along x from LO to HI: a window around 20 lies where 20 is."""
    live = np.array([[10.0, 20.0, 1e-5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    one = Gaussians(np.zeros((1, 3)), np.full((1, 3), np.log(0.1)), [[1, 0, 0, 0]], [0.0], [[1, 1, 1]], live=live)
    shown = apply_look(one, Table.of_function(WINDOW, LO, HI, 0.05, GRAIN))
    np.testing.assert_allclose(shown.means, [[0.1 * (20 - 10) / 20, 0, 0]], atol=5e-3)
    axes = rotations(shown.quaternions.astype(float))[0] * np.exp(shown.log_scales.astype(float))
    covariance = axes @ axes.T
    within = np.array([NormalDist(10, 20).pdf(x) for x in np.linspace(10, 30, 401)])
    x = (np.linspace(10, 30, 401) - 10) / 20
    covers = (1 - (1 - WINDOW.opacity(np.linspace(10, 30, 401))) ** (GRAIN / 0.05)) * within
    variance = (covers * x**2).sum() / covers.sum() - ((covers * x).sum() / covers.sum()) ** 2
    assert covariance[0, 0] == pytest.approx(0.01 * variance, rel=0.05)
    assert covariance[1, 1] == pytest.approx(0.01, rel=1e-4)
    assert shown.live is None


def test_what_shows_only_a_tail_of_the_values_is_not_seen() -> None:
    """A body of values above 20 beside Gaussians of spread 1, ever farther from it: the law's tail would be a halo."""
    nodes = PiecewiseOpacity(np.array([0.0, 20, 20, 100]), np.array([0.0, 0, 0.9, 0.9]))
    step = TransferFunction("step", nodes, COLORS)
    table, means = Table.of_function(step, LO, HI, 0.05, GRAIN), np.array([20.0, 19.6, 18.8, 17.5])
    sums = table.at(means, np.ones(4))
    z = sums[:, 4] / sums[:, 3]
    assert 0 < z[0] < z[1] < 1.4 < z[2] < 2 < z[3]
    found = without_tails(sums) / sums[:, 3]
    np.testing.assert_allclose(found, [1, 1, (2 - z[2]) / 0.6, 0], atol=1e-12)
    live = np.column_stack([means, np.ones(4), np.full(4, 0.1), np.zeros((4, 6))])
    some = Gaussians(np.zeros((4, 3)), np.full((4, 3), -3), [[1, 0, 0, 0]] * 4, [0.0] * 4, [[1, 1, 1]] * 4, live=live)
    for shown in (apply_look(some, table), baked(some, table)):
        assert shown.opacity_logits[3] < -10
        assert shown.opacity_logits[2] > -4


def test_a_look_turns_with_its_gaussians() -> None:
    """Of maps that stretch too, where nothing is opaque: gradients are covectors."""
    some, table = cloud(), Table.of_function(WINDOW, LO, HI, 0.05, GRAIN)
    assert some.live is not None
    fine = replace(some, live=np.where(np.arange(9) == 2, 1e-5, some.live))
    shear = np.array([[1.0, 0.3, 0.0], [0.0, 0.8, 0.1], [0.0, 0.0, 1.2]])
    mirrored = -np.eye(3)
    for of, change in (
        (some, lambda g: turn(g, "x")), (fine, lambda g: transform(g, shear)), (some, lambda g: transform(g, mirrored))
    ):  # fmt: skip
        before, after = change(apply_look(of, table)), apply_look(change(of), table)
        np.testing.assert_allclose(after.means, before.means, atol=2e-5)
        axes = [
            rotations(g.quaternions.astype(float)) * np.exp(g.log_scales.astype(float))[:, None]
            for g in (before, after)
        ]
        np.testing.assert_allclose(*[m @ m.transpose(0, 2, 1) for m in axes], atol=1e-6)


def test_values_under_gaussians_of_a_linear_field() -> None:
    """Mean, spread, axis and direction of v = 3 i - k + 7 in voxels, of which negative halves are stored."""
    z, _, x = np.mgrid[:20, :21, :22]
    stored = (-(3 * x - z + 7) / 2).astype(np.float32)
    stored.flags.writeable = False
    half, step = np.array([1.1, 1.05, 1.0]), np.full(3, 0.1)
    some = replace(cloud(), log_scales=np.full((40, 3), np.log(0.05)), means=cloud().means * 0.8)
    nothing = np.zeros(3, np.int64)
    where = in_voxels(some, half, step)
    everywhere = nothing, nothing, np.array([22, 21, 20])
    found = values_of(*samples_of(Voxels(stored), *where, *everywhere, step), some, -2.0, 0.0)
    at = where[0]
    np.testing.assert_allclose(found[:, 0], 3 * at[:, 0] - at[:, 2] + 7, atol=1e-3)
    spread = np.sqrt(((offsets() @ np.array([[3, 0, -1]]).T * 0.5) ** 2).mean())
    np.testing.assert_allclose(found[:, 1], spread, rtol=1e-3)
    direction = np.tile(np.array([3, 0, -1]) / 10**0.5, (40, 1))
    np.testing.assert_allclose(found[:, 5:], direction, atol=1e-3)
    np.testing.assert_allclose(found[:, 2:5] * np.sign(found[:, [2]]), direction, atol=1e-3)


def test_samples_that_are_not_finite_do_not_count() -> None:
    samples = np.full((2, POINTS), 5, np.float32)
    samples[0, ::3] = np.nan
    samples[1] = np.inf
    found = values_of(samples, np.zeros((2, NORMAL_SUMS)), cloud(2), 2.0, 1.0)
    np.testing.assert_allclose(found[0], [11, *[0] * 7], atol=1e-6)
    assert np.isnan(found[1, 0])


def test_a_ply_keeps_values_in_columns_that_others_ignore(tmp_path: Path) -> None:
    some = baked(cloud(), Table.of_function(RAMP, LO, HI, 0.05, GRAIN))
    options = PlyOptions(up="y", scale=0.1, centre=(1, 2, 3), frame="world", affine=tuple(range(12)), live=facts())
    options = replace(options, affine=(1.0, 0, 0, 0, 0, 2.0, 0, 0, 0, 0, 1.0, 0))
    write_ply(tmp_path / "a.ply", some, options)
    back, header = read_ply(tmp_path / "a.ply")
    assert header.live == facts()
    assert [name for name in header.dtype.names or ()][-6:] == list(COLUMNS)
    np.testing.assert_array_equal(back.live[:, :3], some.live[:, :3])  # type: ignore[index]
    axes = [np.sort(np.abs(g.live[:, AXIS])) for g in (back, some)]  # type: ignore[index]
    np.testing.assert_allclose(*axes, atol=1e-6)
    write_ply(tmp_path / "b.ply", replace(some, live=None), options)
    assert b"vvgt live" not in (tmp_path / "b.ply").read_bytes()
    whole = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "c.ply").write_bytes(whole.replace(b"live values", b"live valuez", 1))
    refused(vvgt_library.DataError, "expected one that vvgt writes", read_ply, tmp_path / "c.ply")


def test_units_of_any_letters_come_back(tmp_path: Path) -> None:
    for unit, quantity in (("°C", "température"), ('"', '"Density" field')):
        known = replace(facts(), unit=unit, quantity=quantity)
        write_ply(tmp_path / "a.ply", cloud(), PlyOptions(live=known))
        again = read_ply(tmp_path / "a.ply")[1].live
        assert (again.unit, again.quantity) == (unit, quantity)


def test_a_function_that_json_cannot_hold_is_sampled() -> None:
    bent = replace(RAMP, opacity_nodes=PiecewiseOpacity(np.array([0.0, HI]), np.array([0.0, 1.0]), np.full(2, 0.3)))
    body = json.loads(function_text(bent, LO, HI))
    at = np.array([point["x"] for point in body["points"]])
    assert len(at) == 64
    np.testing.assert_allclose([point["opacity"] for point in body["points"]], bent.opacity(at), atol=1e-4)


def test_fog_is_transparent_where_the_background_is_and_only_there() -> None:
    counts = np.full(256, 10)
    counts[:20] = 10_000
    tf = fog(statistics(counts))
    assert tf.opacity(np.array([LO, LO + 5]))[0] == 0
    shown = tf.opacity(np.linspace(LO + 12, HI, 100))
    assert (shown > 0).all()
    assert shown[-1] > shown[0]
    seen = replace(RAMP, opacity_nodes=PiecewiseOpacity(np.array([LO, LO + 2, LO + 4]), np.array([0.0, 0.5, 0.0])))
    assert fog(statistics(counts), seen).opacity(np.array([LO + 2.0]))[0] > 0


def test_cells_are_split_where_values_differ() -> None:
    """Half of a volume is one value, the other half noise: of a small budget most goes there."""
    rng = np.random.default_rng(0)
    data = np.full((16, 16, 16), 128, np.uint8)
    data[:, :, 8:] = rng.integers(60, 250, (16, 16, 8))
    data[0, 0, 0] = 0
    result = vvgt_library.convert(data, "viridis", max_gaussians=400, screen=64, live=True)
    assert (result.gaussians.means[:, 0] > 0).mean() > 0.7


def test_what_the_fog_hides_is_there() -> None:
    """A core in a thick body that lets no light through: another function may make the body transparent."""
    z, y, x = np.indices((48, 48, 48)) - 23.5
    radius = np.sqrt(x**2 + y**2 + z**2)
    opaque = TransferFunction("opaque", PiecewiseOpacity(np.array([0.0, 100]), np.array([0, 0.9])), COLORS)
    scene = scene_of(Volume(np.where(radius < 20, np.where(radius < 6, 250, 200), 0).astype(np.uint8)), opaque)
    hidden, there = (
        initialise(scene, VbmOptions(max_gaussians=4000, size=128, values=values)).gaussians.means
        for values in (False, True)
    )
    nearest, found = (np.linalg.norm(means, axis=1).min() for means in (hidden, there))
    assert found < 10 / 24 < nearest


@pytest.fixture(scope="module")
def live_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from vvgt_cli.commands.main import run

    folder = tmp_path_factory.mktemp("live")
    (folder / "tf.json").write_text(json.dumps(TF))
    arguments = ["convert", "example:marschner-lobb:20", "--live", "--tf", str(folder / "tf.json"), "-q"]
    assert run([*arguments, "-o", str(folder / "live.ply"), *map(str, SMALL)]) == 0
    return folder / "live.ply"


def test_recolor_shows_other_functions_without_the_volume(vvgt, live_file, tmp_path) -> None:
    vvgt.ok("recolor", live_file, "--tf", "viridis", "-o", tmp_path / "v.ply")
    ordinary, header = read_ply(tmp_path / "v.ply")
    assert header.live is None
    assert ordinary.live is None
    assert header.unit_distance_label == "paraview"
    scores = []
    for file in (live_file, tmp_path / "v.ply"):
        done = vvgt("evaluate", file, "--volume example:marschner-lobb:20 --tf viridis --json --no-conditions --step 1")
        scores.append(json.loads(done.out)["scores"]["psnr"])
    assert scores[0] == pytest.approx(scores[1], abs=1e-6)
    assert scores[0] > 20
    done = vvgt.fails(1, "recolor", tmp_path / "v.ply", "--tf", "viridis", "-o", tmp_path / "w.ply")
    assert "carry no values" in done
    assert not (tmp_path / "w.ply").exists()
    nothing = {"points": [{"x": 7, "rgb": [1, 0, 0], "opacity": 0}, {"x": 8, "rgb": [0, 1, 0], "opacity": 0.8}]}
    (tmp_path / "tf.json").write_text(json.dumps(nothing))
    done = vvgt.fails(1, "recolor", live_file, "--tf", tmp_path / "tf.json", "-o", tmp_path / "w.ply")
    assert "nothing is visible" in done


def test_render_info_and_other_formats(vvgt, live_file, tmp_path) -> None:
    plain = json.loads(vvgt("info", live_file, "--json").out)
    assert plain["live_function"] == "w"
    assert plain["live_values"][0] < plain["live_value"][1] < plain["live_values"][1]
    under = json.loads(vvgt("info", live_file, "--json", "--tf", "viridis").out)
    assert under["function"].startswith("viridis")
    assert under["hidden"] + under["gaussians"] == plain["gaussians"]
    for name, more in (("a", ()), ("b", ("--tf", "viridis"))):
        vvgt.ok("render", live_file, *more, "--orbit", 1, "--size", 32, "-o", tmp_path / name)
    pictures = [next((tmp_path / name).glob("*.png")).read_bytes() for name in "ab"]
    assert pictures[0] != pictures[1]
    vvgt.ok("render", live_file, "--tf-range", "0.1,0.3", "--orbit", 1, "--size", 32, "-o", tmp_path / "c")
    assert next((tmp_path / "c").glob("*.png")).read_bytes() not in pictures  # of its own function
    with pytest.warns(UserWarning, match="cannot store values for other functions"):
        vvgt.ok("view", live_file, "-o", tmp_path / "one.spz")


def test_what_a_live_file_does_not_go_with(vvgt, tmp_path) -> None:
    for option in (
        ("--sh-degree", 1),
        ("--steps", 9),
        ("--target-psnr", 30),
        ("--no-comments",),
    ):
        done = vvgt.fails(2, "convert", "example:blob:12", "--live", "-o", tmp_path / "a.ply", *SMALL, *option)
        assert option[0] in done
    vvgt.ok("convert", "example:blob:12", "--live", "-o", tmp_path / "none.ply", *SMALL, "--steps", 0)
    for other, line in ((("--dry-run",), "--dry-run with --live"), (("--tf", "viridis", "--tf", "magma"), "one --tf")):
        assert line in vvgt.fails(2, "convert", "example:blob:12", "--live", "-o", tmp_path / "a.ply", *SMALL, *other)
    np.save(tmp_path / "four.npy", np.random.default_rng(0).random((2, 6, 7, 8)))
    for source in (tmp_path / "four.npy", tmp_path / "*.npy"):
        vvgt.fails(2, "convert", source, "--live", "-o", tmp_path / "a.html", *SMALL)
    assert not (tmp_path / "a.html").exists()
    assert not (tmp_path / "a.ply").exists()


def test_a_series_makes_a_live_file_a_frame(vvgt, tmp_path) -> None:
    """And an ordinary conversion to the same names does not take them for its own."""
    for k in range(2):
        np.save(tmp_path / f"f{k}.npy", np.random.default_rng(k).random((6, 7, 8)).astype(np.float32))
    source = ("convert", tmp_path / "f?.npy", "--tf", "viridis", "-o", tmp_path / "o_{}.ply", "--max-gaussians", 90)
    vvgt.ok(*source, "--screen", 48, "--live")
    for k in range(2):
        gaussians, header = read_ply(tmp_path / f"o_{k}.ply")
        assert header.live is not None
        assert gaussians.live is not None
        vvgt.ok("recolor", tmp_path / f"o_{k}.ply", "--tf", "magma", "-o", tmp_path / f"r_{k}.ply")
    assert json.loads((tmp_path / "o_index.json").read_text())["files"][1]["file"] == "o_1.ply"
    assert "live" in vvgt.fails(2, *source, "--screen", 48)


def test_blocks_have_the_same_values_to_the_byte(tmp_path) -> None:
    """Of Gaussians that lie across blocks, and beyond the volume; and a conversion in blocks is as near the volume."""
    from vvgt_cli.conversion.opened import open_field
    from vvgt_cli.conversion.request import ConvertRequest, FitOptions
    from vvgt_cli.field.settings import BlockOptions
    from vvgt_cli.field.source import SourceRequest
    from vvgt_cli.progress import Console
    from vvgt_cli.score.record import ConversionReport, Run

    found = []
    for blocks in (None, BlockOptions(16)):
        request = ConvertRequest(SourceRequest("example:marschner-lobb:40"), str(tmp_path / "a.ply"), blocks=blocks)
        request = replace(request, fit=FitOptions(max_gaussians=300, screen=64), live=True)
        with open_field(Run(Console(quiet=True), ConversionReport("convert")), request) as field:
            wide = replace(cloud(200), log_scales=cloud(200).log_scales + 1)
            foggy = field.with_look(field.source.with_function(fog(field.source.statistics)))
            found.append((field.sample(wide), foggy.view(default_views("test", size=32)[0], RenderSettings())))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    assert np.isfinite(found[0][0]).all(axis=1).mean() > 0.9
    np.testing.assert_allclose(found[0][1], found[1][1], atol=2e-3)


@pytest.mark.parametrize(("tf", "unit"), [("ct-bone", "HU"), ("viridis", "")])
def test_the_legend_of_another_look_has_the_unit_that_a_conversion_would_state(tf: str, unit: str) -> None:
    values = np.repeat([-1000.0, 40.0, 900.0], [600, 500, 40])
    counts = np.histogram(values, 256, (-1024, 1500))[0]
    known = replace(facts(), lo=-1024.0, hi=1500.0, histogram=tuple(counts.tolist()), unit="")
    affine = (1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0)
    header = PlyOptions(scale=0.1, unit_distance=1.0, affine=affine, live=known)
    from vvgt_cli.field.source import SourceRequest

    legend = resolve_look("a.ply", header, SourceRequest("", tf=tf))[1].legend
    assert legend is not None
    assert json.loads(legend)["unit"] == unit


def test_the_library_recolors_results_and_files(live_file, tmp_path, vvgt) -> None:
    result = vvgt_library.convert("example:blob:12", max_gaussians=100, screen=48, live=True)
    assert result.gaussians.live is not None
    other = result.recolor("viridis")
    assert other.gaussians.live is None
    assert len(other.gaussians) <= 100
    assert result.ply.legend != other.ply.legend
    assert json.loads(other.ply.legend)["nodes"][0][2] == "440154"  # viridis begins with it
    magma = vvgt_library.recolor(live_file, "magma", tmp_path / "magma.ply")
    vvgt.ok("recolor", live_file, "--tf", "magma", "-o", tmp_path / "command.ply")
    assert (tmp_path / "magma.ply").read_bytes() == (tmp_path / "command.ply").read_bytes()
    assert len(magma.gaussians) > 100
    assert json.loads(magma.ply.legend)["nodes"][-1][2] == "fcfdbf"
    refused(vvgt_library.DataError, "carry no values", other.recolor, "magma")
