"""What web viewers draw, in a real browser, against our pictures by their rules (docs/viewers.md)."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from browser import shoot

from vvgt_cli.cameras import Camera, default_views, look_at
from vvgt_cli.commands.main import run
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply, write_ply
from vvgt_cli.gaussians.formats import encoded, format_of
from vvgt_cli.images.metrics import psnr
from vvgt_cli.splat import render
from vvgt_cli.splat.reference import project

RULES = pytest.importorskip("vvgt_cli.gaussians.rules").RULES
PLAIN = {"supersplat": "playcanvas", "spark": "spark", "three": "three", "babylon": "babylon"}  # page: rule
RULE = {**PLAIN, "cesium": "cesium"}
ENDING = {"cesium": ".spz"}  # it reads no .ply
OPTIONS = {"three": "stored"}  # of the page
STEPS = {"supersplat": 255, "spark": 254}  # both keep a scale as one of so many over 21 e-folds from exp(-12)
SIZE = 540
BLOCK = 24  # px, where splats are blended one by one
LARGE = ((6, 6), (14, 5), (4, 12), (16, 16), (3, 3))  # sigmas in px, across and down
SMALL = (0.1, 0.15, 0.2, 0.24, 0.3, 0.4, 0.6, 1.0)

pytestmark = pytest.mark.long


def front(size: int = SIZE) -> Camera:
    """From -y: x to the right, z up."""
    return look_at((0, -3, 0), width=size, height=size)


def saved(gaussians: Gaussians, folder: Path, ending: str = ".ply") -> Path:
    """Write ``gaussians`` to a file that no viewer turns, and return its path."""
    path = folder / f"saved{ending}"
    if known := format_of(path):
        path.write_bytes(encoded(known, gaussians, PlyOptions(), path.name))
    else:
        write_ply(path, gaussians)
    return path


def lone_splats(camera: Camera, steps: int) -> Gaussians:
    """Splats that overlap nowhere, facing ``camera``, from 0.1 to 16 px; none of their values is rounded by viewers."""
    rows: list[tuple[float, float, float, float, int, tuple[int, int, int]]] = []
    for i, (across, down) in enumerate(LARGE):
        for j, opacity in enumerate((60, 160, 252)):
            rows.append((60 + 105 * i, 80 + 110 * j, across, down, opacity, (255 - 50 * i, 60 + 90 * j, 30 * (i + j))))
    for i, sigma in enumerate(SMALL):
        for j, opacity in enumerate((120, 252)):
            rows.append((40.5 + 60 * i, 400.5 + 60 * j, sigma, sigma, opacity, (255, 255, 255)))
    u, v, across, down, opacity, color = (np.array(column, np.float64) for column in zip(*rows, strict=True))
    x, z = (np.round(512 * 3 * side / camera.fx) / 512 for side in (u - SIZE / 2, SIZE / 2 - v))  # exact in half floats
    scales = 3 * np.stack([across, np.minimum(across, down), down], axis=1) / camera.fx
    step = 21 / steps
    log_scales = step * np.round((np.log(scales) + 12) / step) - 12
    quaternions = np.tile((1.0, 0, 0, 0), (len(rows), 1))
    opacity = opacity / 255
    return Gaussians(
        np.stack([x, 0 * x, z], axis=1), log_scales, quaternions, np.log(opacity / (1 - opacity)), color / 255
    )


def lone_picture(gaussians: Gaussians, camera: Camera, rule_name: str) -> np.ndarray:
    """(height, width, 3) of axis-aligned splats seen by `front`, each alone: the rule's formula, pixel by pixel."""
    rule = RULES[rule_name]
    out = np.zeros((camera.height, camera.width, 3))
    px, py = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    opacities = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    rows = zip(gaussians.means, scales, opacities, gaussians.colors, strict=True)
    for (x, y, z), (sx, sy, sz), opacity, color in rows:
        right, down, depth = float(x), -float(z), float(y) + 3
        across = np.array([sx, -right * sy / depth]) * camera.fx / depth
        along = np.array([sz, -down * sy / depth]) * camera.fy / depth
        flat = np.diag([across @ across, along @ along])
        flat[0, 1] = flat[1, 0] = across[1] * along[1]
        wide = flat + rule.dilation * np.eye(2)
        if np.linalg.eigvalsh(wide)[1] < rule.min_variance:
            continue
        if rule.compensate:
            opacity *= np.sqrt(np.linalg.det(flat) / np.linalg.det(wide))
        inverse = np.linalg.inv(wide)
        dx, dy = px - camera.fx * right / depth - camera.cx, py - camera.fy * down / depth - camera.cy
        p = 0.5 * (inverse[0, 0] * dx * dx + inverse[1, 1] * dy * dy) + inverse[0, 1] * dx * dy
        rest = np.exp(-rule.reach) if rule.shifted else 0.0
        alpha = np.minimum(opacity * (np.exp(-p) - rest) / (1 - rest), rule.max_alpha)
        alpha[(p > rule.reach) | (alpha < rule.min_alpha)] = 0
        out += alpha[..., None] * color
    return out


@pytest.mark.parametrize("viewer", PLAIN)
def test_lone_splats_are_drawn_by_the_rule(viewer: str, tmp_path: Path) -> None:
    camera = front()
    gaussians = lone_splats(camera, STEPS.get(viewer, 255))
    shot = shoot(viewer, saved(gaussians, tmp_path), [camera], SIZE, tmp_path, OPTIONS.get(viewer, ""))[0]
    formula = lone_picture(gaussians, camera, RULE[viewer])
    ours = render(gaussians, camera, rule=RULE[viewer])[..., :3]
    scores = {name: psnr(lone_picture(gaussians, camera, name), shot) for name in RULES}
    away = abs(formula - shot).max(axis=2)
    print(f"{viewer}: {scores}, ours {psnr(ours, shot):.2f}, largest difference {away.max() * 255:.2f}/255")
    reach = RULES[RULE[viewer]].reach  # a pixel there may be met from the other side
    assert away.max() < np.exp(-reach) + 1 / 255
    most = 1e-3 if viewer in ("three", "babylon") else 1e-4  # of half floats, and of 8 bits a channel
    assert (away > 2 / 255).mean() < most
    assert psnr(ours, shot) > 55
    assert psnr(ours, formula) > 65
    assert all(score < scores[RULE[viewer]] - 6 for name, score in scores.items() if name != RULE[viewer])
    for mirrored in (shot[:, ::-1], shot[::-1], shot.transpose(1, 0, 2)):
        assert psnr(ours, mirrored) < 30


def test_up_and_hand_in_supersplat(tmp_path: Path) -> None:
    """`--up z` puts z on top before a camera placed as SuperSplat's; nothing is mirrored (conventions: The .ply)."""
    means = 0.6 * np.eye(3)  # red, green and blue at the ends of x, y and z
    gaussians = Gaussians(means, np.full((3, 3), np.log(0.05)), np.tile((1, 0, 0, 0), (3, 1)), np.full(3, 4), np.eye(3))
    write_ply(tmp_path / "axes.ply", gaussians, PlyOptions(up="z"))
    stored, _ = read_ply(tmp_path / "axes.ply")
    places = np.argwhere(shoot("supersplat", tmp_path / "axes.ply", [None], 400, tmp_path)[0] > 0.5)
    found = np.stack([places[places[:, 2] == k, :2].mean(axis=0) for k in range(3)])  # row, column of each colour
    shown = stored.means * (-1, -1, 1)  # how SuperSplat shows PLY coordinates; its camera is at z = 3, with y up
    focal = 200 / np.tan(np.radians(20))
    expected = 200 + focal * np.stack([-shown[:, 1], shown[:, 0]], axis=1) / (3 - shown[:, 2:])
    assert abs(found - expected).max() < 2
    assert found[2, 0] < found[:2, 0].min() - 50  # z on top
    assert np.linalg.det(shown) == pytest.approx(np.linalg.det(means), rel=1e-5)


UPRIGHT = {"supersplat": (-1, -1), "gsplatjs": (1, -1)}
UPRIGHT |= dict.fromkeys(("playcanvas", "spark", "splats3d", "cesium"), (1, 1))


@pytest.mark.parametrize("viewer", UPRIGHT)
def test_which_way_up_a_file_is_shown(viewer: str, tmp_path: Path) -> None:
    """Red, green and blue at +x, +y and +z of a file: each where the viewer's own camera sees it, none mirrored."""
    means = np.array([(0.5, 0.1, 0.05), (0.07, 0.5, 0), (-0.3, -0.35, 0.4)])  # on no axis: see docs/viewers.md
    rest = (
        np.full((60, 3), np.log(0.05)),
        np.tile((1.0, 0, 0, 0), (60, 1)),
        np.full(60, 4.0),
        np.repeat(np.eye(3), 20, axis=0),
    )
    file = saved(Gaussians(np.repeat(means, 20, axis=0), *rest), tmp_path, ENDING.get(viewer, ".ply"))
    shot = shoot(viewer, file, [None], 400, tmp_path)[0]
    places = np.argwhere(shot > 0.5)
    found = np.stack([places[places[:, 2] == k, :2].mean(axis=0) for k in range(3)])
    right, up = UPRIGHT[viewer]
    depth = 3 - right * up * means[:, 2]  # a camera at z = 3, or one that is turned by 180 degrees with y
    across = np.stack([-up * means[:, 1], right * means[:, 0]], axis=1)
    expected = 200 + 200 / np.tan(np.radians(20)) * across / depth[:, None]
    assert abs(found - expected).max() < 2


@pytest.mark.parametrize("viewer", RULE)
def test_harmonics_are_seen_from_their_side(viewer: str, tmp_path: Path) -> None:
    """Strong harmonics of degree 3: what a viewer shows is our picture, and not that from the other side."""
    rng = np.random.default_rng(0)
    gaussians = Gaussians(
        rng.uniform(-0.7, 0.7, (150, 3)),
        np.log(0.09) + rng.normal(0, 0.2, (150, 3)),
        rng.normal(size=(150, 4)),
        np.full(150, 3.0),
        np.full((150, 3), 0.5),
        rng.normal(0, 0.3, (150, 15, 3)),
    )
    odd = np.repeat([-1, 1, -1], [3, 5, 7])[:, None].astype(np.float32)
    behind, plain = replace(gaussians, harmonics=gaussians.harmonics * odd), replace(gaussians, harmonics=None)
    cameras = [default_views("test", size=SIZE)[i] for i in (0, 4, 9)]
    file = saved(gaussians, tmp_path, ENDING.get(viewer, ".ply"))
    shots = shoot(viewer, file, cameras, SIZE, tmp_path, OPTIONS.get(viewer, ""))
    for camera, shot in zip(cameras, shots, strict=True):
        ours, other, flat = (
            psnr(np.clip(render(g, camera, rule=RULE[viewer])[..., :3], 0, 1), shot) for g in (gaussians, behind, plain)
        )
        print(f"{viewer}, {camera.name}: {ours:.2f} dB, {other:.2f} from the other side, {flat:.2f} without")
        assert ours > 30
        assert ours > max(other, flat) + 12


@dataclass(frozen=True)
class Shown:
    """A converted volume, a test view of 1080 px, and the volume there."""

    file: Path
    camera: Camera
    volume: np.ndarray


def shown(volume: str, folder: Path) -> Shown:
    from vvgt_cli.dvr import render_view
    from vvgt_cli.field.source import SourceRequest, load

    path = folder / "converted.ply"
    options = ("--max-gaussians", "20000", "--screen", "1080", "--steps", "0", "--quiet")
    assert run(["convert", volume, *options, "-o", str(path)]) == 0
    camera = default_views("test", size=1080)[3]
    return Shown(path, camera, render_view(load(SourceRequest(volume)).scene(), camera)[..., :3])


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    return shown("example:frog", tmp_path_factory.mktemp("body"))


@pytest.fixture(scope="module")
def fog(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    return shown("example:marschner-lobb:64", tmp_path_factory.mktemp("fog"))


@pytest.mark.parametrize("viewer", RULE)
def test_converted_volume_looks_as_scored(viewer: str, body: Shown, tmp_path: Path) -> None:
    gaussians = read_ply(body.file)[0]
    file = saved(gaussians, tmp_path, ENDING[viewer]) if viewer in ENDING else body.file
    shot = shoot(viewer, file, [body.camera], 1080, tmp_path, OPTIONS.get(viewer, ""))[0]
    ours = render(gaussians, body.camera, rule=RULE[viewer])[..., :3]
    seen, said, same = psnr(body.volume, shot), psnr(body.volume, ours), psnr(ours, shot)
    print(f"{viewer}: {seen:.2f} dB against the volume, {said:.2f} by our drawing; {same:.2f} between the two")
    assert abs(seen - said) < 1
    assert same > 45


def test_three_encodes_what_it_has_blended(body: Shown, tmp_path: Path) -> None:
    """Its default: colours are taken for linear light, and are too bright once they are encoded for the screen."""
    shot = shoot("three", body.file, [body.camera], 1080, tmp_path)[0]
    blended = np.clip(render(read_ply(body.file)[0], body.camera, rule="three")[..., :3], 0, 1)
    encoded = np.where(blended > 0.0031308, 1.055 * np.maximum(blended, 1e-9) ** (1 / 2.4) - 0.055, 12.92 * blended)
    print(f"{psnr(encoded, shot):.2f} dB, {psnr(body.volume, shot):.2f} against the volume")
    assert psnr(encoded, shot) > 45
    assert psnr(body.volume, shot) < 25


@pytest.mark.parametrize("viewer", STEPS)
def test_fog_differs_by_eight_bits_a_blend(viewer: str, fog: Shown, tmp_path: Path) -> None:
    """Hundreds of faint layers: browsers round after each. The rule with that rounding is what they show."""
    shot = shoot(viewer, fog.file, [fog.camera], 1080, tmp_path)[0]
    gaussians = rounded(read_ply(fog.file)[0], viewer)
    for row, column in ((300, 500), (400, 200), (520, 520), (800, 500)):
        smooth, coarse = (blended(gaussians, fog.camera, viewer, row, column, levels) for levels in (None, 255))
        block = shot[row : row + BLOCK, column : column + BLOCK]
        smooth_psnr, coarse_psnr = psnr(smooth, block), psnr(coarse, block)
        print(f"{viewer} at {row}, {column}: {coarse_psnr:.2f} dB with 8 bits a blend, {smooth_psnr:.2f} without")
        assert coarse_psnr > 43
        assert coarse_psnr > smooth_psnr + 6


def rounded(gaussians: Gaussians, viewer: str) -> Gaussians:
    """Scales and opacities as the viewer keeps them (docs/log/viewers.md: How viewers round)."""
    step = 21 / STEPS[viewer]
    opacity = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    opacity = np.clip(np.round(255 * opacity) / 255, 1e-6, 1 - 1e-4)
    log_scales = step * np.round((gaussians.log_scales + 12) / step) - 12
    return replace(gaussians, log_scales=log_scales, opacity_logits=np.log(opacity / (1 - opacity)))


def blended(gaussians: Gaussians, camera: Camera, viewer: str, row: int, column: int, levels: int | None) -> np.ndarray:
    """(BLOCK, BLOCK, 3) of the picture from there on, back to front by distance; rounded after each splat."""
    rule = RULES[RULE[viewer]]
    centres, wide, depths = project(gaussians, camera, rule)
    opacities = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    if rule.compensate:
        opacities *= np.sqrt(np.linalg.det(wide - rule.dilation * np.eye(2)) / np.linalg.det(wide))
    px, py = np.meshgrid(column + np.arange(BLOCK) + 0.5, row + np.arange(BLOCK) + 0.5)
    inverses, rest = np.linalg.inv(wide), np.exp(-rule.reach) if rule.shifted else 0.0
    out = np.zeros((BLOCK, BLOCK, 3))
    eye = -camera.rotation.T @ camera.translation
    for k in np.argsort(-np.linalg.norm(gaussians.means - eye, axis=1)):
        dx, dy = px - centres[k, 0], py - centres[k, 1]
        p = 0.5 * (inverses[k, 0, 0] * dx * dx + inverses[k, 1, 1] * dy * dy) + inverses[k, 0, 1] * dx * dy
        if depths[k] < 0.05 or p.min() > rule.reach:
            continue
        alpha = opacities[k] * (np.exp(-p) - rest) / (1 - rest)
        alpha[(p > rule.reach) | (alpha < rule.min_alpha)] = 0
        out = out * (1 - alpha[..., None]) + alpha[..., None] * np.clip(gaussians.colors[k], 0, 1)
        out = np.round(out * levels) / levels if levels else out
    return out


@pytest.mark.parametrize(
    ("ending", "viewer"),
    [
        *((ending, viewer) for ending in (".spz", ".sog") for viewer in ("spark", "babylon")),
        *((ending, "three") for ending in (".spz", ".v4.spz", ".glb")),
        (".sog", "supersplat"),
        (".glb", "babylon"),
    ],
)
def test_viewers_read_what_is_packed(ending: str, viewer: str, body: Shown, tmp_path: Path) -> None:
    """They decode by themselves: without gsply, which writes .spz for us."""
    path = saved(read_ply(body.file)[0], tmp_path, ending)
    plain, packed = (shoot(viewer, file, [body.camera], SIZE, tmp_path)[0] for file in (body.file, path))
    print(f"{ending}: {psnr(plain, packed):.2f} dB from the .ply in {viewer}")
    assert psnr(plain, packed) > 40
