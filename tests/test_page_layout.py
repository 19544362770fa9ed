"""Where things are on a page, in a real browser: a phone's sheet, the title, the first view, texts over the picture."""

import json
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_page_where import DESK, LYING, PHONE, Person, uncovered

from tests.test_formats_server import shown
from vvgt_cli.commands.main import run

pytestmark = pytest.mark.long
QUICK = ["--max-gaussians", "2000", "--steps", "0", "--quiet"]
TABS = ["look", "cut", "slices", "measure", "share"]
BOX = "(({ left, top, right, bottom }) => [left, top, right, bottom])"
DRAWN = f"[...document.querySelectorAll('#where g > *')].map((one) => {BOX}(one.getBoundingClientRect()))"
PANELS = (  # what may lie over letters and scale
    "[...document.querySelectorAll('#live, #live > header, #slices, #marks, #share, #tabs, #tools button, #series')]"
    f".filter((one) => one.checkVisibility()).map((one) => {BOX}(one.getBoundingClientRect()))"
)
OPEN = (
    "[...document.querySelectorAll('#live .function, #live .cut, #slices, #marks, #share')]"
    ".filter((one) => one.checkVisibility()).map((one) => one.id || one.className)"
)
POSE = "window.vvgt.where.lens.pose()"
NUMBERS = f"Object.values({POSE}).flat()"


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Addresses: a head whose nose is its front, a plate that is seen best from the front, a series with times."""
    nib = pytest.importorskip("nibabel")
    folder = tmp_path_factory.mktemp("layout")
    x, y, z = np.meshgrid(*map(np.arange, (24, 30, 32)), indexing="ij")
    head = np.where(np.hypot(np.hypot((x - 12) / 9, (y - 14) / 11), (z - 16) / 14) < 1, 40, -1000).astype(np.float32)
    head[(abs(x - 12) < 2) & (y > 23) & (y < 28) & (abs(z - 15) < 2)] = 900
    nib.save(nib.Nifti1Image(head, np.diag([4, 4, 4, 1])), folder / "head.nii.gz")
    plate = np.zeros((20, 8, 30), np.float32)  # z, y, x
    plate[2:18, 2:6, 2:28] = 1
    np.save(folder / "plate.npy", plate)
    image = nib.Nifti1Image(np.stack([head, np.roll(head, 2, 0)], -1), np.eye(4))
    image.header.set_xyzt_units("mm", "sec")
    image.header["pixdim"][4] = 1.5
    nib.save(image, folder / "series.nii.gz")
    for name, file in (("head", "head.nii.gz"), ("plate", "plate.npy"), ("series", "series.nii.gz")):
        tf = [] if name == "plate" else ["--tf", "ct-skin"]
        assert run(["convert", str(folder / file), *tf, *QUICK, "-o", str(folder / f"{name}.html")]) == 0
    return {name: (folder / f"{name}.html").as_uri() for name in ("head", "plate", "series")}


def someone(size: tuple[int, int], **how: Any) -> Iterator[Person]:
    """A person for one test, who leaves."""
    person = Person(size, **how)
    yield person
    person.process.communicate(timeout=60)


@pytest.fixture(params=[pytest.param(PHONE, id="upright"), pytest.param(LYING, id="lying")])
def phone(request: pytest.FixtureRequest) -> Iterator[Person]:
    yield from someone(request.param)


@pytest.fixture
def desk() -> Iterator[Person]:
    yield from someone(DESK)


@pytest.fixture
def watcher() -> Iterator[Person]:
    yield from someone(PHONE, motion=True)


def overlaps(boxes: list[list[float]], others: list[list[float]]) -> list[tuple[list[float], list[float]]]:
    """Boxes [left, top, right, bottom] that lie over one of others."""
    return [(a, b) for a in boxes for b in others if a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]]


def test_a_phone_has_a_sheet_with_five_tabs(phone: Person, pages: dict[str, str], tmp_path: Path) -> None:
    """Nothing lies over letters, scale and legend; one tab is open at a time, by touch and by keys."""
    phone("open", pages["head"])
    assert phone("eval", "[...document.querySelectorAll('#tabs button')].map((one) => one.textContent)") == TABS
    assert phone("eval", OPEN) == []
    for k, (name, shows) in enumerate(
        [("", []), *zip(TABS, ["function", "cut", "slices", "marks", "share"], strict=True)]
    ):
        if name:
            phone("click", f"#tabs button:nth-child({k})")
            phone("settled")
            assert phone("eval", OPEN) == [shows]
            expanded = "[...document.querySelectorAll('#tabs [aria-expanded=true]')].map((one) => one.textContent)"
            assert phone("eval", expanded) == [name]
        drawn, panels = phone("eval", f"[{DRAWN}, {PANELS}]")
        assert not overlaps(drawn, panels), name
        assert all(
            left >= 0 and right <= phone.size[0] and bottom <= phone.size[1] for left, _, right, bottom in panels
        )
        uncovered(phone, phone.picture(tmp_path, f"{name}.png"))
        assert phone("axe") == [], name
        assert phone("tabs") == {"unseen": [], "missed": []}, name
    phone("press", "Escape")
    assert phone("eval", OPEN) == []
    phone("press", "s")
    phone("until", "document.body.dataset.tab === 'slices'")
    phone("press", "m")
    phone("until", "document.body.dataset.tab === 'measure'")
    phone("click", "#tabs button:nth-child(3)")  # to measure in slices
    phone("settled")
    assert phone("eval", f"[...{OPEN}, window.vvgt.where.marks.open]") == ["slices", True]
    phone("click", "#tabs button:nth-child(3)")
    assert phone("eval", f"[...{OPEN}, window.vvgt.where.marks.open]") == [False]
    phone("resize", 1200, 800)
    phone("until", "document.querySelector('#live .function').checkVisibility()")
    assert phone("eval", f"[{OPEN}, document.querySelector('#tabs').checkVisibility()]") == [["function", "cut"], False]


def test_a_readers_page_has_a_title_and_no_words_for_its_author(desk: Person, tmp_path: Path) -> None:
    np.save(tmp_path / "ball.npy", np.ones((8, 8, 8), np.float32))
    how = ["--tf", "gray", *QUICK, "--title", "A <b>ball</b>", "-o", str(tmp_path / "ball.html")]
    assert run(["convert", str(tmp_path / "ball.npy"), *how]) == 0
    desk("open", (tmp_path / "ball.html").as_uri())
    assert desk("eval", "[...document.querySelectorAll('h1')].map((one) => one.textContent)") == ["A <b>ball</b>"]
    text = desk("eval", "document.body.innerText")
    assert not [word for word in ("dB", "preview", "Gaussians", "--") if word in text], text
    desk("press", "i")
    assert "dB PSNR" in desk("eval", "document.querySelector('#about').innerText")


def test_a_series_has_a_title_and_times(desk: Person, pages: dict[str, str]) -> None:
    desk("open", pages["series"])
    assert desk("eval", "[...document.querySelectorAll('#series option')].map((one) => one.text)") == [
        "t = 0 s",
        "t = 1.5 s",
    ]
    title, series = desk(
        "eval", f"['h1', '#series'].map((one) => {BOX}(document.querySelector(one).getBoundingClientRect()))"
    )
    assert title[1] > 0
    assert not overlaps([title], [series])


def test_the_first_view_shows_a_face_or_the_largest_side(desk: Person, pages: dict[str, str], tmp_path: Path) -> None:
    nearest = "window.vvgt.where.letters.toSorted((a, b) => Math.hypot(a.x, a.y) - Math.hypot(b.x, b.y))[0].letter"
    for name, letter in (("head", "A"), ("plate", "−y")):
        desk("open", pages[name])
        assert desk("eval", nearest) == letter
        assert uncovered(desk, desk.picture(tmp_path, f"{name}.png")) > 0.6
        first = desk("eval", NUMBERS)
        desk("press", "ArrowLeft")
        desk("press", "r")
        assert desk("eval", NUMBERS) == pytest.approx(first)


def test_a_link_is_whole_in_another_window(desk: Person, pages: dict[str, str], tmp_path: Path) -> None:
    desk("open", pages["head"])
    desk("press", "x")
    link = desk("eval", "window.vvgt.where.link()")
    shares = []
    for size in (DESK, (700, 540), PHONE):
        desk("resize", *size)
        desk("open", link)
        shares.append(uncovered(desk, desk.picture(tmp_path, f"{size[0]}.png")))
    print(f"shares of the shorter side: {shares}")
    assert min(shares) > 0.5


def test_a_view_turns_slowly_until_somebody_comes(watcher: Person, desk: Person, pages: dict[str, str]) -> None:
    """The yaw comes first, and is all that changes."""
    now = f"(({{ yaw, target, pitch, distance }}) => [yaw, ...target, pitch, distance])({POSE})"
    turned = f"new Promise((done) => {{ const a = {now}; setTimeout(() => done([a, {now}]), 3000); }})"
    watcher("open", pages["head"])
    before, after = watcher("eval", turned)
    assert after[0] - before[0] > 1
    assert after[1:] == pytest.approx(before[1:], abs=1e-4)
    watcher("resize", *LYING)
    for place, least in (("translateY(300vh)", 0), ("none", 1)):  # out of sight it stands
        watcher("eval", f"document.querySelector('canvas').style.transform = '{place}'")
        watcher("eval", turned)
        before, after = watcher("eval", turned)
        assert (after[0] - before[0] > 1) == bool(least), place
    link = watcher("eval", "window.vvgt.where.link()")
    watcher("click", 200, 200)
    before, after = watcher("eval", turned)
    assert after == before
    for where, page in ((watcher, link), (desk, pages["head"])):  # a link says where to be; less motion is asked for
        where("open", page)
        before, after = where("eval", turned)
        assert after == before


def test_streamed_levels_fit_at_first_sight(desk: Person, tmp_path: Path) -> None:
    cube = np.zeros((40, 40, 40), np.float32)  # its corners are nearer than its middle
    cube[2:38, 2:38, 2:38] = 1
    np.save(tmp_path / "cube.npy", cube)
    how = ["--tf", "gray", "--max-gaussians", "3000", "--screen", "100", "--quiet"]
    assert run(["init", str(tmp_path / "cube.npy"), *how, "-o", str(tmp_path / "cube" / "lod-meta.json")]) == 0
    with shown("cube/lod-meta.json", folder=tmp_path) as (_, url):
        desk("served", url)
        for name, step in (("first", "f"), ("side", "x"), ("fit", "f")):
            if name != "first":
                desk("press", step)
            assert uncovered(desk, desk.picture(tmp_path, f"{name}.png")) > 0.6, name


def test_what_a_frame_forbids_to_save_is_offered_otherwise(desk: Person, pages: dict[str, str], tmp_path: Path) -> None:
    content = escape(Path(pages["head"].removeprefix("file://")).read_text("utf-8"))
    frame = (
        f'<iframe title="head" sandbox="allow-scripts" style="width: 900px; height: 540px" srcdoc="{content}"></iframe>'
    )
    (tmp_path / "site.html").write_text(f"<!doctype html><body>{frame}", "utf-8")
    desk("frame", (tmp_path / "site.html").as_uri())
    saved = "document.querySelector('#saved')"
    desk("within", "window.vvgt.where.picture && document.querySelector('#tools .picture').click()")
    desk("within", "document.querySelector('#sizes button').click()")
    desk("within", f"new Promise((done) => setInterval(() => {{ if ({saved}) done(); }}, 50))")
    picture = f"{saved}.querySelector('img')"
    assert desk("within", f"{picture}.decode().then(() => [{picture}.naturalWidth, {picture}.naturalHeight])") == [
        900,
        540,
    ]
    assert "this frame forbids downloads" in desk("within", f"{saved}.innerText")
    desk("within", f"{saved}.querySelector('button:nth-of-type(2)').click()")
    desk(
        "within",
        f"new Promise((done) => setInterval(() => {{ if ({saved}.innerText.includes('forbids to')) done(); }}, 50))",
    )
    desk("within", f"{saved}.querySelector('button:nth-of-type(3)').click()")
    assert desk("within", f"{saved}.hidden") is True


def test_texts_over_the_picture_lie_apart(desk: Person, pages: dict[str, str]) -> None:
    desk("open", pages["head"])
    at = [48, 60, 64]
    marks = [["ruler", [at, [60, 60, 64]]], ["ruler", [at, [60, 60, 65]]], ["angle", [[40, 60, 64], at, [48, 60, 90]]]]
    marks += [["note", [at], "here"], ["note", [[48, 60, 63]], "and nearly here"]]
    desk("eval", f"window.vvgt.where.marks.part.set({json.dumps(json.dumps(marks))})")
    desk("settled")
    drawn = "[...document.querySelectorAll('#where text')].filter((one) => one.textContent.includes(':'))"
    texts = desk("eval", f"{drawn}.map((one) => {BOX}(one.getBoundingClientRect()))")
    boxes = [[left + 1, top + 1, right - 1, bottom - 1] for left, top, right, bottom in texts]
    assert len(boxes) == 5
    assert not [pair for k, box in enumerate(boxes) for pair in overlaps([box], boxes[:k])]


def test_what_is_undone_is_done_again(desk: Person, pages: dict[str, str]) -> None:
    desk("open", pages["head"])
    nodes = "window.vvgt.live.nodes().map(({ y }) => y)"
    states = [desk("eval", nodes)]
    for y in (0.2, 0.4):
        desk("eval", f"window.vvgt.live.set(window.vvgt.live.nodes().map((node) => ({{ ...node, y: {y} }})))")
        states.append(desk("eval", nodes))
    button = "#live .function .{}"
    for press, k in (
        ("Control+z", 1),
        ("Control+z", 0),
        ("Control+y", 1),
        ("Control+Shift+Z", 2),
        ("undo", 1),
        ("redo", 2),
    ):
        desk("click", button.format(press)) if press.endswith("do") else desk("press", press)
        assert desk("eval", nodes) == states[k], press
    assert desk(
        "eval", "['undo', 'redo'].map((one) => document.querySelector(`#live .function .${one}`).disabled)"
    ) == [False, True]
    desk("press", "Control+z")
    desk("eval", "window.vvgt.live.set(window.vvgt.live.nodes().map((node) => ({ ...node, y: 0.6 })))")
    assert desk("eval", "document.querySelector('#live .function .redo').disabled") is True
