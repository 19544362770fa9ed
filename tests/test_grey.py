"""MIP and X-ray of Gaussians and of volumes, against float64 twins and closed forms."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from test_live import HI, LO, RAMP, cloud, statistics

import vvgt_cli as vvgt_library
from vvgt_cli.cameras import Camera, default_views, orbit_views
from vvgt_cli.commands import pictures as render
from vvgt_cli.commands.main import run
from vvgt_cli.dvr import reference
from vvgt_cli.field.field import Resident
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.live import LENGTH, SPREAD, TAU, VALUE, Table, apply_look, directions
from vvgt_cli.images import read_png
from vvgt_cli.images.metrics import psnr
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.tables import exposed_distance
from vvgt_cli.splat import grey
from vvgt_cli.splat import reference as twin

SIZE = 48
HALF = TransferFunction(
    "half", PiecewiseOpacity(np.array([0.0, 1.0]), np.array([0.5, 0.5])), ColorMap(np.zeros(1), np.ones((1, 3)))
)


def camera() -> Camera:
    return default_views("test", size=SIZE)[3]


def falloffs(some: Gaussians) -> tuple[np.ndarray, ...]:
    """p (K, h, w), offsets from the centres (K, h, w, 2), covariances (K, 2, 2) in px^2, and places in the camera."""
    eye = camera()
    centres, flat, _ = twin.project(some, eye, grey.GREY)
    x, y = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    offsets = np.stack([x, y], axis=-1) - centres[:, None, None]
    p = 0.5 * np.einsum("kyxi,kij,kyxj->kyx", offsets, np.linalg.inv(flat), offsets)
    return p, offsets, flat, some.means.astype(np.float64) @ eye.rotation.T + eye.translation


def test_a_mip_is_its_twins() -> None:
    """Value and place are jointly normal: their covariance on the screen gives mean and deviation along a ray."""
    some, eye = cloud(60), camera()
    p, offsets, flat, place = falloffs(some)
    along, explained = directions(some)
    spread = some.live[:, SPREAD].astype(np.float64) / (HI - LO) * explained
    axes = twin.rotations(some.quaternions.astype(np.float64)) * np.exp(some.log_scales.astype(np.float64))[:, None]
    wanted = np.zeros((SIZE, SIZE))
    for k in range(len(some)):
        x, y, z = place[k]
        jacobian = np.array([[eye.fx / z, 0, -eye.fx * x / z**2], [0, eye.fy / z, -eye.fy * y / z**2]])
        joint = jacobian @ eye.rotation @ axes[k] @ along[k] * spread[k]
        solved = np.linalg.solve(flat[k], joint)
        value = (some.live[k, VALUE] - LO) / (HI - LO) + offsets[k] @ solved
        value += grey.AHEAD * math.sqrt(max(spread[k] ** 2 - joint @ solved, 0))
        t = np.clip((grey.END - p[k]) / (grey.END - grey.PLATEAU), 0, 1)
        wanted = np.maximum(wanted, value * t**2 * (3 - 2 * t))
    found = grey.mip(some, eye, LO, HI)
    assert 0.2 < wanted.clip(0, 1).mean() < 0.9
    np.testing.assert_allclose(found, wanted.clip(0, 1), atol=2e-4)
    order = np.random.default_rng(0).permutation(len(some))
    np.testing.assert_array_equal(grey.mip(some.take(order), eye, LO, HI), found)


def test_an_x_ray_is_its_twins() -> None:
    some, eye = cloud(60), camera()
    table = Table.of_function(RAMP, LO, HI, 2.0, 1e-8)
    mass = table.of(some.live)[:, TAU] * some.live[:, LENGTH].astype(np.float64) ** 3
    p, _, flat, place = falloffs(apply_look(some, table))
    area = 2 * np.pi * np.sqrt(np.linalg.det(flat)) * place[:, 2] ** 2 / (eye.fx * eye.fy)
    peak = mass / area * np.linalg.norm(place, axis=1) / place[:, 2] / (1 - math.exp(-4))
    depth = (peak[:, None, None] * np.where(p < 4, np.exp(-p), 0)).sum(axis=0)
    found = grey.xray(some, table, eye)
    assert 0.05 < found.mean() < 0.9
    np.testing.assert_allclose(found, 1 - np.exp(-depth), atol=3e-4)
    order = np.random.default_rng(0).permutation(len(some))
    np.testing.assert_allclose(grey.xray(some.take(order), table, eye), found, atol=1e-6)


def test_the_x_ray_of_one_gaussian_is_that_of_its_density() -> None:
    """The line integral of a round Gaussian of mass M and deviation s is M / (2 pi s^2) exp(-b^2 / (2 s^2))."""
    sigma, length, value = 0.2, 0.3, 50.0
    one = Gaussians(
        np.zeros((1, 3)), np.full((1, 3), math.log(sigma)), np.array([[1.0, 0, 0, 0]]), np.zeros(1), np.zeros((1, 3)),
        live=np.array([[value, 0, length, 0, 0, 0, 0, 0, 0.0]]),
    )  # fmt: skip
    size = 301
    eye = orbit_views(1, size=size)[0]
    table = Table.of_function(RAMP, LO, HI, 0.1, 1e-9)
    tau = -math.log(1 - float(RAMP.opacity(np.array([value]))[0])) / 0.1
    found = grey.xray(one, table, eye)
    depth = tau * length**3 / (2 * math.pi * sigma**2)
    row = found[size // 2]
    distance = np.abs(np.arange(size) + 0.5 - eye.cx) / eye.fx * 3  # the ray's place at the centre's depth
    b = 3 * np.sin(np.arctan(distance / 3))
    near = b < 1.5 * sigma
    wanted = -np.expm1(-depth * np.exp(-(b**2) / (2 * sigma**2)) / -math.expm1(-4))
    np.testing.assert_allclose(row[near], wanted[near], rtol=0.03)
    assert row[b > 3 * sigma].max() == 0


def test_a_volumes_mip_is_its_twins(tmp_path: Path) -> None:
    values = np.random.default_rng(2).normal(size=(9, 11, 13)).astype(np.float32)
    np.save(tmp_path / "a.npy", values)
    source = load(SourceRequest(str(tmp_path / "a.npy"), tf="viridis"))
    scene, eye = source.scene(), camera()
    origin, rays = reference.rays(eye, render.MIP_RAYS)
    flat = rays.reshape(-1, 3)
    with np.errstate(divide="ignore"):
        near, far = (-scene.half - origin) / flat, (scene.half - origin) / flat
    first, last = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
    inside = last > np.maximum(first, 0)
    length = (last - first) * np.linalg.norm(flat / scene.step, axis=1)
    count = np.where(inside, np.ceil(length / render.MIP_STEP), 0)
    best = np.zeros(len(flat))
    for k in range(int(count.max())):
        t = first + (last - first) * (k + 0.5) / np.maximum(count, 1)
        at = (origin + t[:, None] * flat + scene.half) / scene.step - 0.5
        value = (reference.trilinear(source.volume, at) - values.min()) / (values.max() - values.min())
        best = np.maximum(best, np.where(k < count, value, 0))
    wanted = best.reshape(SIZE, SIZE, -1).mean(axis=2)
    assert 0.2 < wanted.mean() < 0.9
    np.testing.assert_allclose(render.mip_of(Resident(source))(eye)[..., 0], wanted, atol=1e-4)


def test_the_x_ray_of_a_uniform_volume_keeps_1_over_e_along_its_edge(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.linspace(0, 1, 16, dtype=np.float32).repeat(256).reshape(16, 16, 16))
    (tmp_path / "tf.json").write_text(
        json.dumps({"points": [{"x": x, "rgb": [1, 0, 0], "opacity": 0.5} for x in (0, 1)]})
    )
    for distance in ("paraview", "3"):
        out = tmp_path / f"{distance}.png"
        look = ["--tf", str(tmp_path / "tf.json"), "--opacity-unit-distance", distance]
        views = ["--camera", str(along_x(tmp_path)), "--rule", "xray", "--quiet", "-o", str(out)]
        assert run(["render", str(tmp_path / "a.npy"), *look, *views]) == 0
        picture = read_png(out)
        assert picture.shape == (33, 33, 4)
        np.testing.assert_allclose(picture[..., 3], 1)
        np.testing.assert_allclose(picture[16, 16, :3], 1 - math.exp(-1), atol=0.006)
        assert picture[0, 0, :3].max() == 0


def along_x(folder: Path) -> Path:
    """A view set of one view from far away, of the middle of a face."""
    pose = [[0.0, 0, 1, 20], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
    frame = {"file_path": "a", "transform_matrix": pose}
    intrinsics = {"fl_x": 165, "fl_y": 165, "cx": 16.5, "cy": 16.5, "w": 33, "h": 33}
    (folder / "views.json").write_text(json.dumps({**intrinsics, "frames": [frame]}))
    return folder / "views.json"


def test_exposure_depends_on_neither_the_unit_distance_nor_the_histograms_size() -> None:
    found = exposed_distance(HALF, statistics(np.arange(256)), 2.0)
    assert found == pytest.approx(2 * math.log(2), rel=1e-9)
    assert exposed_distance(RAMP, statistics(np.arange(256) * 7), 2.0) == pytest.approx(
        exposed_distance(RAMP, statistics(np.arange(256)), 2.0)
    )


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("grey") / "live.ply"
    source = ["convert", "example:marschner-lobb:32", "--live", "--tf", "viridis", "--max-gaussians", "20000"]
    assert run([*source, "--screen", "200", "--quiet", "-o", str(path)]) == 0
    return path


@pytest.mark.parametrize(("rule", "least"), [("mip", 30), ("xray", 30)])
def test_a_live_file_is_near_the_volume_in_memory_and_in_blocks(rule: str, least: float, live: Path) -> None:
    volume = ["example:marschner-lobb:32", "--tf", "viridis"]
    pictures = []
    for name, source in (("live", [str(live)]), ("volume", volume), ("blocks", [*volume, "--blocks", "16"])):
        out = live.with_name(f"{rule}-{name}.png")
        assert run(["render", *source, "--rule", rule, "--size", "200", "--quiet", "--exr", "-o", str(out)]) == 0
        assert out.with_suffix(".exr").exists()
        pictures.append(read_png(out))
    near = psnr(pictures[1][..., :3], pictures[0][..., :3])
    print(f"{rule}: {near:.2f} dB")
    assert near > least
    assert np.abs(pictures[1] - pictures[2]).max() < (0.005 if rule == "mip" else 0.02)
    assert (pictures[0][..., 3] == 1).all()
    assert pictures[1].std() > 0.05


def test_what_mip_and_x_ray_do_not_go_with(vvgt, live: Path, tmp_path: Path) -> None:
    vvgt.ok("recolor", live, "--tf", "viridis", "-o", tmp_path / "fixed.ply")
    labels = tmp_path / "labels.ply"
    np.save(tmp_path / "map.npy", np.arange(512).reshape(8, 8, 8).astype(np.uint8) // 128)
    vvgt.ok("convert", tmp_path / "map.npy", "--labels auto --live --max-gaussians 200 --screen 64 -o", labels)
    out = tmp_path / "a.png"
    for rule in ("mip", "xray"):
        for arguments, code, text in (
            ((tmp_path / "fixed.ply",), 1, "carry no values"),
            ((labels,), 1, "carry labels"),
            ((tmp_path / "map.npy", "--labels", "auto"), 2, "no single value"),
            ((live, "--background", 1, 1, 1), 2, "opaque"),
            *([((live, "--tf", "viridis"), 2, "omit function")] if rule == "mip" else []),
        ):
            done = vvgt("render", *arguments, "--rule", rule, "--size", 32, "-o", out)
            assert (done.code, text in done.error, len(done.error.splitlines())) == (code, True, 1), done.err
    assert "mip or xray" in vvgt.fails(2, "render", "example:blob:12", "--rule", "spark", "--size", 32, "-o", out)
    assert not out.exists()
    vvgt.ok("render", live, "--rule", "mip", "--orbit", 3, "--size", 32, "-o", tmp_path / "a.gif")


def test_a_live_result_draws_them() -> None:
    result = vvgt_library.convert("example:blob:16", max_gaussians=300, screen=48, live=True)
    mip, xray = (result.render(size=SIZE, rule=rule) for rule in ("mip", "xray"))
    assert mip.shape == xray.shape == (SIZE, SIZE, 4)
    assert mip[SIZE // 2, SIZE // 2, 0] > 0.7 > xray[0, 0, 0]
    with pytest.raises(vvgt_library.DataError, match="carry no values"):
        result.recolor("magma").render(size=SIZE, rule="mip")
