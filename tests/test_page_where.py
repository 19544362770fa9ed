"""Letters, scale bar, ruler, legend, link and picture of pages, in a real browser, as a person uses it."""

import json
import math
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import PAGES, browser, packages
from PIL import Image

from vvgt_cli.commands.main import run
from vvgt_cli.gaussians import Gaussians, PlyOptions, write_ply
from vvgt_cli.images import read_png

pytestmark = pytest.mark.long
DESK, PHONE, LYING = (1280, 800), (390, 844), (844, 390)
SIZES = [pytest.param(DESK, id="desk"), pytest.param(PHONE, id="phone")]
CENTRE = np.array([30.0, -20.0, 12.0])  # of the marked volume in the world, mm
MARK = np.array([20.0, 13.0, 9.0])  # of the mark from there: right, front, up
SCALE = 0.04  # unit-frame lengths per mm of the two dots
DOTS = np.array([[-0.7, 0.0, 0.2], [0.6, 0.0, -0.35]])  # red, blue
TEXT = "[t.textContent, +t.getAttribute('x'), +t.getAttribute('y')]"
LETTERS = f"[...document.querySelectorAll('#where text')].map((t) => {TEXT})"
SEEN = "(({ canvas: { clientWidth, clientHeight } }) => [clientWidth, clientHeight])(window.vvgt.where.lens)"
MIDDLE = "window.vvgt.where.lens.middle"  # pixel that the view turns about
OVER = (  # what lies over the picture
    "[...document.querySelectorAll('#live, #live > header, #named, #series, #tools, #where .over')]"
    ".map((element) => element.getBoundingClientRect())"
    ".map(({ left, top, right, bottom }) => [left, top, right, bottom].map(Math.round))"
)
FOLD = "document.querySelector('#live .fold').click()"
BAR = "(({ scale, lens }) => [scale.length, scale.across, scale.text, lens.flat])(window.vvgt.where)"


class Person:
    """Someone at a browser of a size: its steps are those of `tests/viewers/where.mjs`."""

    def __init__(self, size: tuple[int, int], *args: str, motion: bool = False) -> None:
        self.size, self.touch = size, size in (PHONE, LYING)
        job = json.dumps({"browser": browser(), "size": size, "touch": self.touch, "motion": motion, "args": args})
        command = ["node", str(PAGES / "where.mjs"), job, str(packages())]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __call__(self, what: str, *rest: Any) -> Any:
        """One step; its answer. Nothing may be asked for, nothing break."""
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps([what, *rest]) + "\n")
        self.process.stdin.flush()
        noted = json.loads(self.process.stdout.readline())
        assert "error" not in noted, noted["error"]
        assert noted["asked"] == []
        assert noted["broken"] == []
        return noted["answer"]

    def picture(self, folder: Path, name: str, *, bare: bool = True) -> np.ndarray:
        """(height, width, 3) of the page, without what lies over the picture if `bare`."""
        self("settled")
        self("bare" if bare else "shot", str(folder / name))
        return read_png(folder / name)[..., :3]


@pytest.fixture(scope="module", params=SIZES)
def person(request: pytest.FixtureRequest) -> Iterator[Person]:
    someone = Person(request.param)
    yield someone
    someone.process.communicate(timeout=60)


def marked_volume(folder: Path) -> Path:
    """A grey ball of 40 with a mark of 100 to its right; index axes oblique, the first one mirrored."""
    nib = pytest.importorskip("nibabel")
    dims, (a, b) = (60, 50, 40), np.radians((20, -15))
    about_z = [[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]]
    about_x = [[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]]
    affine = np.eye(4)
    affine[:3, :3] = np.array(about_z) @ about_x @ np.diag([-1.0, 1.2, 1.5])
    affine[:3, 3] = CENTRE - affine[:3, :3] @ ((np.array(dims) - 1) / 2)
    places = np.stack(np.meshgrid(*map(np.arange, dims), indexing="ij"), -1) @ affine[:3, :3].T + affine[:3, 3] - CENTRE
    values = np.where(np.linalg.norm(places, axis=-1) < 16.5, 40, 0).astype(np.float32)
    values[np.linalg.norm(places - MARK, axis=-1) < 5] = 100
    nib.save(nib.Nifti1Image(values, affine), folder / "marked.nii.gz")
    return folder / "marked.nii.gz"


@pytest.fixture(scope="module")
def marked(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Address of the live page of the marked volume."""
    folder = tmp_path_factory.mktemp("marked")
    grey, red = (0.6, 0.6, 0.6), (1, 0, 0)
    nodes = ((0, grey, 0), (10, grey, 0), (25, grey, 0.95), (50, grey, 0.95), (58, red, 0.95), (100, red, 0.95))
    points = [{"x": x, "rgb": rgb, "opacity": opacity} for x, rgb, opacity in nodes]
    (folder / "marks.json").write_text(json.dumps({"name": "marks", "points": points}))
    command = ["convert", str(marked_volume(folder)), "--live", "--tf", str(folder / "marks.json"), "--quiet"]
    assert run([*command, "--max-gaussians", "8000", "-o", str(folder / "marked.html")]) == 0
    return (folder / "marked.html").as_uri()


@pytest.fixture(scope="module")
def dots(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Address of the page of two dots, at places in mm that are known."""
    folder = tmp_path_factory.mktemp("dots")
    rgb = np.array([[1, 0, 0], [0, 0, 1]], np.float32)
    quaternions = np.tile(np.array([1, 0, 0, 0], np.float32), (2, 1))
    gaussians = Gaussians(
        DOTS.astype(np.float32),
        np.full((2, 3), math.log(0.02), np.float32),
        quaternions,
        np.full(2, 4, np.float32),
        rgb,
    )
    affine = (1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0)
    options = PlyOptions(scale=SCALE, centre=(5.0, 6.0, 7.0), space="RAS", affine=affine, up="z")
    write_ply(folder / "dots.ply", gaussians, options)
    name = "<img src=x onerror=alert(1)>.html"
    assert run(["view", str(folder / "dots.ply"), "-o", str(folder / name), "--quiet"]) == 0
    return (folder / name).as_uri()


def found(picture: np.ndarray, channel: int) -> tuple[np.ndarray | None, int]:
    """Where a colour is, (x, y) px, None where it is not, and how many pixels have it."""
    rest = np.delete(picture, channel, axis=-1).max(axis=-1)
    mask = picture[..., channel] > rest + 0.25
    if mask.sum() < 5:
        return None, int(mask.sum())
    weights = np.where(mask, picture[..., channel] - rest, 0).astype(np.float64)
    y, x = np.indices(mask.shape)
    return np.array([(weights * (x + 0.5)).sum(), (weights * (y + 0.5)).sum()]) / weights.sum(), int(mask.sum())


VIEWS = {"A": "y", "P": "Shift+Y", "L": "x", "R": "Shift+X", "S": "z", "I": "Shift+Z"}


def test_the_mark_is_where_the_letters_say(marked: str, person: Person, tmp_path: Path) -> None:
    """From six sides, and after a drag, of a volume whose index axes are mirrored and oblique."""
    person("open", marked)
    distance, (_, high) = person("eval", f"[window.vvgt.where.lens.pose().distance, {SEEN}]")
    gizmo = np.array([54, high - 58])
    away: dict[str, np.ndarray] = {}
    for seen_from in [*VIEWS, *([] if person.touch else ["drag"])]:
        if seen_from == "drag":
            person("drag", 600, 600, 700, 560)
        else:
            person("press", VIEWS[seen_from])
            pose = f"{{ ...window.vvgt.where.lens.pose(), target: [0, 0, 0], distance: {distance} }}"
            person("eval", f"window.vvgt.where.lens.set({pose})")
        middle = np.array(person("eval", MIDDLE))
        place, _ = found(person.picture(tmp_path, f"{seen_from}.png"), 0)
        letters = {text: np.array([x, y - 5]) - gizmo for text, x, y in person("eval", LETTERS) if text in "RLAPSI"}
        told = np.zeros(2)
        for (near, far), length in zip(("RL", "AP", "SI"), MARK, strict=True):
            told += length * (letters[near] if near in letters else -letters[far])
        assert place is not None, seen_from
        away[seen_from] = place - middle
        cosine = away[seen_from] @ told / np.linalg.norm(away[seen_from]) / np.linalg.norm(told)
        print(f"{person.size} from {seen_from}: cosine {cosine:.4f} between mark and letters")
        assert cosine > 0.995, (seen_from, away[seen_from], told)
        if seen_from in VIEWS:
            assert np.linalg.norm(letters[seen_from]) < 2  # the side that is nearest
    for near, far in ("AP", "SI"):  # what is nearer looks larger; from the left, the ball hides a part
        assert np.linalg.norm(away[near]) > 1.05 * np.linalg.norm(away[far])


def uncovered(person: Person, picture: np.ndarray) -> float:
    """What is seen is whole, in the middle, and uncovered; its longer side as a share of the window's shorter."""
    light, middle = picture.max(axis=-1) > 0.05, person("eval", MIDDLE)
    for left, top, right, bottom in person("eval", OVER):
        assert not light[max(top, 0) : bottom, max(left, 0) : right].any(), (left, top, right, bottom)
    spans = []
    for place, edge, along in zip(middle, light.shape[::-1], (light.any(axis=0), light.any(axis=1)), strict=True):
        first, *_, last = np.flatnonzero(along)
        assert 0 < first < last < edge - 1
        assert abs((first + last) / 2 - place) < 0.12 * (last - first)
        spans.append(last - first)
    return float(max(spans) / min(light.shape))


def test_what_is_seen_is_whole_and_uncovered_at_first_sight(marked: str, person: Person, tmp_path: Path) -> None:
    """And again when the panel is folded and the window turned, until the view is moved; then it keeps its size."""
    person("open", marked)
    shares = [uncovered(person, person.picture(tmp_path, "first.png"))]
    turned, back = ("resize", *person.size[::-1]), ("resize", *person.size)
    for name, step in (("once", ("eval", FOLD)), ("twice", ("eval", FOLD)), ("turned", turned), ("back", back)):
        person(*step)
        shares.append(uncovered(person, person.picture(tmp_path, f"{name}.png")))
    print(f"{person.size}: {', '.join(f'{share:.2f}' for share in shares)} of the shorter side")
    assert shares[0] > 0.6
    assert shares[2] == pytest.approx(shares[0], abs=0.01)
    assert shares[3] > 0.6
    assert shares[4] == pytest.approx(shares[0], abs=0.01)
    person("press", "ArrowLeft")
    away = "window.vvgt.where.lens.pose().distance"
    far, before = person("eval", away), person("eval", MIDDLE)
    person("eval", FOLD)
    assert person("eval", away) == pytest.approx(far)
    assert np.abs(np.subtract(person("eval", MIDDLE), before)).max() > 20


def test_a_baked_page_is_uncovered_too(person: Person, tmp_path: Path) -> None:
    z, y, x = np.mgrid[:24, :24, :24] - 11.5
    for k in (0, 1):
        np.save(tmp_path / f"ball{k}.npy", (np.hypot(x, np.hypot(y, z)) < 8 + k).astype(np.float32) * 100)
    how = ["--tf", "viridis", "--max-gaussians", "3000", "--screen", "100", "--steps", "0", "--quiet"]
    for name, source in (("one", "ball0.npy"), ("two", "ball*.npy")):
        assert run(["convert", str(tmp_path / source), *how, "-o", str(tmp_path / f"{name}.html")]) == 0
        person("open", (tmp_path / f"{name}.html").as_uri())
        uncovered(person, person.picture(tmp_path, f"{name}.png"))


def test_the_scale_bar_has_the_length_of_its_label(dots: str, person: Person, tmp_path: Path) -> None:
    person("open", dots)
    apart = float(np.linalg.norm(DOTS[1] - DOTS[0])) / SCALE  # mm
    away = 3 * max(person.size) / min(person.size)  # both are in the window, whichever way
    person("press", "y")
    person("eval", f"window.vvgt.where.lens.set({{ ...window.vvgt.where.lens.pose(), distance: {away} }})")
    for flat in (False, True):
        if flat:
            person("press", "o")
        picture = person.picture(tmp_path, "front.png")
        red, blue = (found(picture, channel)[0] for channel in (0, 2))
        assert red is not None
        assert blue is not None
        length, across, text, now_flat = person("eval", BAR)
        assert (text, now_flat) == (f"{length:g} mm", flat)
        told = length * np.linalg.norm(red - blue) / across
        print(f"{person.size}, orthographic {flat}: {told:.3f} mm by the scale bar, {apart:.3f} mm known")
        assert told == pytest.approx(apart, rel=0.005)


def test_the_ruler_measures_what_is_known(dots: str, person: Person, tmp_path: Path) -> None:
    apart = float(np.linalg.norm(DOTS[1] - DOTS[0])) / SCALE  # mm
    person("open", dots)
    away = 3 * max(person.size) / min(person.size)
    pose = f"{{ ...window.vvgt.where.lens.pose(), yaw: 37, pitch: -22, distance: {away} }}"
    person("eval", f"window.vvgt.where.lens.set({pose})")
    for flat in (False, True):
        if flat:
            person("press", "o")
        person("press", "m")
        picture = person.picture(tmp_path, "turned.png")
        for channel in (0, 2):
            place, _ = found(picture, channel)
            person("click", *place.tolist())
        person.picture(tmp_path, f"ruler-{flat}.png", bare=False)
        text, drawn = person(
            "eval",
            "[document.querySelector('#marks li:last-child span').textContent, "
            "document.querySelector('#where text[font-weight=\"600\"]').textContent]",
        )
        print(f"{person.size}, orthographic {flat}: {text!r} by the ruler, {apart:.3f} mm known")
        assert drawn == text.removeprefix("ruler ")
        assert float(drawn.removesuffix(" mm")) == pytest.approx(apart, rel=0.005)
        line = person("eval", "document.querySelector('#places').textContent").splitlines()[0]
        words = [part.split()[:2] for part in line.split(",")]
        told = [float(number) * (-1 if letter in "LPI" else 1) for letter, number in words]
        np.testing.assert_allclose(told, DOTS[1] / SCALE + (5, 6, 7), atol=0.25)
        person("click", "#marks li button")
        person("press", "Escape")
        person("settled")
        assert person("eval", "document.querySelector('#places').hidden")


def test_a_place_has_the_value_of_the_volume(marked: str, person: Person, tmp_path: Path) -> None:
    person("open", marked)
    away = 3 * max(person.size) / min(person.size)  # so far that rays are nearly parallel
    pose = f"{{ ...window.vvgt.where.lens.pose(), target: [0, 0, 0], distance: {away} }}"
    person("press", "y")
    person("eval", f"window.vvgt.where.lens.set({pose})")
    mark, _ = found(person.picture(tmp_path, "front.png"), 0)
    person("click", *mark.tolist())
    person("until", "window.vvgt.where.clicked")
    on_mark = person("eval", "window.before = window.vvgt.where.clicked")
    across, down = person("eval", MIDDLE)
    person("click", across + 0.1 * person.size[0], down + 0.12 * person.size[0])
    person("until", "window.vvgt.where.clicked !== window.before")
    on_ball = person("eval", "window.vvgt.where.clicked")
    print(f"{person.size}: {on_mark}, {on_ball}")
    person.picture(tmp_path, "places.png", bare=False)
    assert 50 < on_mark["value"] <= 100  # at a surface it lies between inside and outside: where the function is red
    assert 10 < on_ball["value"] < 50  # and grey
    offset = np.array(on_mark["world"]) - CENTRE
    np.testing.assert_allclose(offset[[0, 2]], MARK[[0, 2]], atol=1.5)
    assert 1 < offset[1] - MARK[1] < 6.5  # its face
    assert np.linalg.norm(np.array(on_ball["world"]) - CENTRE) == pytest.approx(16.5, abs=1.5)


def test_every_view_fits(marked: str, person: Person, tmp_path: Path) -> None:
    person("open", marked)
    near = "{ ...window.vvgt.where.lens.pose(), target: [9, 0, 0], distance: 2 }"
    for key in ("x", "Shift+Z", "f", "r"):
        person("eval", f"window.vvgt.where.lens.set({near})")
        person("press", key)
        assert uncovered(person, person.picture(tmp_path, f"{key}.png")) > 0.5


def test_a_click_marks_the_label(person: Person, tmp_path: Path) -> None:
    z, y, x = np.mgrid[:12, :12, :12] // 6
    np.save(tmp_path / "map.npy", (1 + x + 2 * y + 4 * z).astype(np.uint8))
    source = ["convert", str(tmp_path / "map.npy"), "--live", "--labels", "auto", "--max-gaussians", "400"]
    assert run([*source, "--screen", "100", "--quiet", "-o", str(tmp_path / "map.html")]) == 0
    person("open", (tmp_path / "map.html").as_uri())
    across, down = person("eval", MIDDLE)
    person("click", across + 20, down + 20)
    person("settled")
    text = person("eval", "document.querySelector('#places').textContent")
    chosen = person("eval", "[...document.querySelectorAll('#live li.chosen span')].map((row) => row.textContent)")
    print(f"{person.size}: {text}; {chosen}")
    assert len(chosen) == 1
    assert text.endswith(f": {chosen[0]}")
    assert person("eval", "window.vvgt.where.lens.pose().target") == pytest.approx([0, 0, 0], abs=0.1)  # not moved


def test_keys_alone_turn_the_view_and_change_the_function(marked: str, person: Person) -> None:
    person("open", marked)
    active = "[document.activeElement.tagName, document.activeElement.getAttribute('class')]"
    person("press", "Tab")
    assert person("eval", active)[0] == "CANVAS"
    yaw = person("eval", "window.vvgt.where.lens.pose().yaw")
    person("press", "ArrowRight")
    assert person("eval", "window.vvgt.where.lens.pose().yaw") == pytest.approx(yaw + 5)
    if person.touch:
        person("eval", FOLD)
    reached = []
    for _ in range(40):
        person("press", "Tab")
        reached.append(person("eval", active))
        if reached[-1][1] == "node chosen":
            break
    before = person("eval", "window.vvgt.live.nodes()[0].y")
    person("press", "ArrowUp")
    assert person("eval", "window.vvgt.live.nodes()[0].y") > before
    for _ in range(40):
        person("press", "Tab")
        reached.append(person("eval", active))
    assert ["BUTTON", "help"] in reached
    person("press", "h")
    assert "Delete" in person("eval", "document.querySelector('#help').innerText")
    small = "[...document.querySelectorAll('button, .node, canvas, select, input')]"
    small += ".map((e) => [e, e.getBoundingClientRect()])"
    small += ".filter(([, r]) => r.width && Math.min(r.width, r.height) < 24).map(([e]) => e.outerHTML)"
    assert person("eval", small) == []


AXIS = "document.querySelector('#live .axis')"
NODES = [
    {"x": 0, "y": 0, "rgb": [1, 1, 1]},
    {"x": 30, "y": 0.4, "rgb": [1, 0.5, 0]},
    {"x": 140, "y": 0.9, "rgb": [0, 1, 1]},
]
CHANGES = (
    "document.querySelector('#live.folded .fold')?.click()",
    f"(() => {{ {AXIS}.selectedIndex = 2; {AXIS}.dispatchEvent(new Event('change')) }})()",
    f"window.vvgt.live.set({json.dumps(NODES)})",
)


def test_a_link_restores_the_picture(marked: str, person: Person, tmp_path: Path) -> None:
    person("open", marked)
    begin = person.picture(tmp_path, "begin.png")
    for change in CHANGES:
        person("eval", change)
    person("press", "x")
    person("press", "o")
    if person.touch:
        person("eval", FOLD)  # as the page opens there
    else:
        person("drag", 600, 600, 700, 560)
    before = person.picture(tmp_path, "before.png")
    person("press", "l")
    person("until", "document.querySelector('#places').textContent === 'link to this view copied'")
    link = person("eval", "location.href")
    assert link.startswith(marked + "#projection=orthographic&view=")
    person("open", link)
    after = person.picture(tmp_path, "after.png")
    person.picture(tmp_path, "linked.png", bare=False)
    print(f"{person.size}: {link.split('#')[1]}; mean difference {np.abs(before - after).mean():.2g}")
    assert np.abs(before - after).mean() < 1e-3
    assert np.abs(before - begin).mean() > 1e-2


def test_a_larger_picture_is_the_same_and_sharper(marked: str, person: Person, tmp_path: Path) -> None:
    person("open", marked)
    person("press", "y")
    page = person.picture(tmp_path, "page.png", bare=False)
    saved, (wide, high) = {}, person("eval", SEEN)
    for times, label in (1, "first-child"), (4, "nth-child(3)"):
        person("press", "p")
        person("save", f"#sizes button:{label}", str(tmp_path / f"{times}.png"))
        saved[times] = read_png(tmp_path / f"{times}.png")[..., :3].astype(np.float64)
        assert saved[times].shape == (times * high, times * wide, 3)
    small = saved[1]
    large = saved[4].reshape(high, 4, wide, 4, 3).mean(axis=(1, 3))
    assert -10 * math.log10(((large - small) ** 2).mean()) > 35
    blown = [
        Image.fromarray(small[..., c].astype(np.float32)).resize((4 * wide, 4 * high), Image.Resampling.BILINEAR)
        for c in range(3)
    ]
    drawn = np.s_[: 4 * (high - 170), : 4 * (wide - 60)]  # without legend, bar and letters
    assert np.abs(np.stack(blown, axis=-1) - saved[4])[drawn].max() > 0.02
    letters = saved[4][-4 * 112 :, : 4 * 100].reshape(112, 4, 400, 3)
    assert np.abs(np.diff(letters, axis=1)).max() > 0.5  # within a pixel of the window: no blown up letters
    assert np.abs(person.picture(tmp_path, "after.png", bare=False) - page).mean() < 1e-3


def test_a_saved_picture_has_legend_scale_and_letters(marked: str, person: Person, tmp_path: Path) -> None:
    person("open", marked)
    person("press", "y")
    page = person.picture(tmp_path, "page.png", bare=False)
    person("press", "p")
    assert person("save", "#sizes button", str(tmp_path / "saved.png")) == "volume-60-x-50-x-40.png"
    picture, (wide, high) = read_png(tmp_path / "saved.png")[..., :3], person("eval", SEEN)
    assert picture.shape == (high, wide, 3)
    legend = picture[high - 154 : high - 24, wide - 30 : wide - 12]
    assert found(legend, 0)[1] > 300  # red, and grey below
    assert ((abs(legend - 0.6) < 0.02).all(axis=-1)).sum() > 200
    assert (picture[high - 30 : high - 18, 108:].min(axis=-1) > 0.9).sum() > 60  # the bar
    assert (picture[high - 112 : high - 12, :100, 2] > 0.6).sum() > 10  # letters
    over = np.s_[high - 162 :, : wide - 60]  # where the page has nothing but the drawing over the picture
    assert np.abs(picture[over] - page[:high][over]).mean() < 5e-3
    person("click", "#tools .about")
    person.picture(tmp_path, "about.png", bare=False)
    text = person("eval", "document.querySelector('#about').innerText")
    for word in ("volume, 60 x 50 x 40", "function and light can be changed", "marks", "RAS, in mm", "vvgt"):
        assert word in text


def test_names_are_text(dots: str, person: Person) -> None:
    person("open", dots)
    person("click", "#tools .about")
    text = person("eval", "document.querySelector('#about').innerText")
    assert "<img src=x onerror=alert(1)>" in text
    assert "fixed" in text
    assert person("eval", "document.querySelectorAll('img').length") == 0


def test_a_link_restores_labels_light_and_cut(person: Person, tmp_path: Path) -> None:
    z, y, x = np.mgrid[:12, :12, :12] // 6
    np.save(tmp_path / "map.npy", (1 + x + 2 * y + 4 * z).astype(np.uint8))
    source = ["convert", str(tmp_path / "map.npy"), "--live", "--labels", "auto", "--max-gaussians", "400"]
    assert run([*source, "--screen", "100", "--quiet", "-o", str(tmp_path / "map.html")]) == 0
    page = (tmp_path / "map.html").as_uri()
    person("open", page)
    for change in (
        f"(() => {{ {AXIS}.selectedIndex = 1; {AXIS}.dispatchEvent(new Event('change')) }})()",
        f"(() => {{ const s = {AXIS}.nextElementSibling; s.value = 300; s.dispatchEvent(new Event('input')) }})()",
        "document.querySelector('#live li:nth-child(2) .eye').click()",
        "(({ state, set }) => set({ ...state(), kind: 'headlight', from: [0, 0, 1] }))"
        "(window.vvgt.live.parts.find((part) => part.key === 'light'))",
    ):
        person("eval", change)
    states = "JSON.stringify(window.vvgt.live.parts.map((part) => part.state()), (key, x) => (x.toFixed?.(4) ?? x))"
    told = f"[{AXIS}.nextElementSibling.value, {states}]"
    before, link = person("eval", told), person("eval", "window.vvgt.where.link()")
    assert "cut=x,300" in link
    person("open", link)
    assert person("eval", told) == before


def test_an_address_that_is_no_link_is_let_be(dots: str, person: Person) -> None:
    person("open", dots + "#100%")
    assert person("eval", "window.vvgt.where.link()").startswith(dots + "#view=")


def test_a_baked_page_has_legend_error_and_date(person: Person, tmp_path: Path) -> None:
    """One in a file, and the frames of a series, each its own."""
    ramp = np.broadcast_to(np.linspace(0, 80, 16, dtype=np.float32)[:, None, None], (16, 16, 16))
    how = ["--tf", "viridis", "--max-gaussians", "300", "--screen", "100", "--steps", "0", "--quiet"]
    for k in (0, 1):
        np.save(tmp_path / f"ramp{k}.npy", ramp + k)
    assert run(["convert", str(tmp_path / "ramp0.npy"), *how, "-o", str(tmp_path / "one.html")]) == 0
    assert run(["convert", str(tmp_path / "ramp*.npy"), *how, "-o", str(tmp_path / "two.html")]) == 0
    person("open", (tmp_path / "one.html").as_uri())
    assert person("eval", "window.vvgt.where.legend") == [0, 20, 40, 60, 80]
    person("click", "#tools .about")
    text = person("eval", "document.querySelector('#about').innerText")
    assert re.search(r"\d\d\.\d dB PSNR on test views of 100 px", text)
    person("open", (tmp_path / "two.html").as_uri())
    assert person("eval", "window.vvgt.where.legend") == [0, 20, 40, 60, 80]
    person.picture(tmp_path, "series.png", bare=False)
