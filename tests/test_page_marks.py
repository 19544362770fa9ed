# ruff: noqa: F811
"""Rulers, angles and notes in a real browser: measured, listed, removed, in the link and the saved page."""

import math
from pathlib import Path

import numpy as np
import pytest
from test_page_where import CENTRE, DOTS, SCALE, Person, dots, found, marked, person  # noqa: F401

from vvgt_cli.commands.main import run
from vvgt_cli.gaussians import Gaussians, PlyOptions, write_ply

pytestmark = pytest.mark.long
LIST = (
    "[...document.querySelectorAll('#marks li')]"
    ".map((row) => row.querySelector('input')?.value ?? row.querySelector('span').textContent)"
)
TEXTS = (
    "[...document.querySelectorAll('#where text')].filter((t) => t.getAttribute('fill') === '#fc3')"
    ".map((t) => [t.textContent, Number(t.getAttribute('x')), Number(t.getAttribute('y'))])"
)
NOTE = 'a "note" & more = <b>; 100 %'
ACTIVE = "[document.activeElement.tagName, document.activeElement.getAttribute('aria-label')]"


def placed(person: Person, page: str, folder: Path) -> list[list[float]]:
    """The page of two dots, from a side, with the list open; where they are seen, px."""
    person("open", page)
    person("press", "m")
    away = 3 * max(person.size) / min(person.size)
    pose = f"{{ ...window.vvgt.where.lens.pose(), yaw: 37, pitch: -22, distance: {away} }}"
    person("eval", f"window.vvgt.where.lens.set({pose})")
    picture = person.picture(folder, "turned.png")
    places = [found(picture, channel)[0] for channel in (0, 2)]
    assert places[0] is not None
    assert places[1] is not None
    return [place.tolist() for place in places]


def test_several_are_drawn_listed_linked_saved_and_removed(dots: str, person: Person, tmp_path: Path) -> None:
    red, blue = placed(person, dots, tmp_path)
    for place in (red, blue):
        person("click", *place)
    person("click", "#marks [data-kind=angle]")
    for place in (red, blue, red):
        person("click", *place)
    person("click", "#marks [data-kind=note]")
    person("click", *blue)
    assert person("eval", ACTIVE) == ["INPUT", "text of note 3"]
    for letter in NOTE:
        person("press", letter)  # a letter in the field is no key of the page
    person("press", "Escape")
    person("settled")
    told = person("eval", LIST)
    assert told[0].startswith("ruler ")
    assert float(told[0].split()[1]) == pytest.approx(np.linalg.norm(DOTS[1] - DOTS[0]) / SCALE, rel=0.005)
    assert float(told[1].split()[1].removesuffix("°")) == pytest.approx(0, abs=0.5)
    assert told[2] == NOTE
    before = person("eval", TEXTS)
    assert [text for text, *_ in before if text] == [
        f"1: {told[0].removeprefix('ruler ')}", f"2: {told[1].removeprefix('angle ')}", f"3: {NOTE}"
    ]  # fmt: skip
    for text, x, y in before:
        if text.startswith("3: ") and not person.touch:  # beside its place, above or below the angle's text
            assert (np.abs(np.subtract([x - 8, y + 6], blue)) <= (2, 40)).all()
    link = person("eval", "window.vvgt.where.link()")
    saved = tmp_path / "again.html"
    person("press", "m")
    assert person("save", "#marks .save", str(saved)).endswith(".html")
    for address in (link, saved.as_uri()):
        person("open", address)
        assert person("eval", LIST) == told
        again = person("eval", TEXTS)
        assert [text for text, *_ in again] == [text for text, *_ in before]
        if address == link or not person.touch:  # a phone's page is saved beside the list, in a smaller picture
            np.testing.assert_allclose([at for _, *at in again], [at for _, *at in before], atol=0.6)
    person("shot", str(tmp_path / "marks.png"))
    person("press", "x")  # they turn with what they are of
    person("settled")
    assert np.abs(np.subtract([at for _, *at in person("eval", TEXTS)], [at for _, *at in again])).max() > 20
    person("press", "m")
    person("click", "#marks li:first-child button")
    person("settled")
    assert person("eval", LIST) == told[1:]
    assert person("eval", ACTIVE) == ["BUTTON", f"remove angle 1, {told[1].removeprefix('angle ')}"]
    assert "ruler" not in person("eval", "window.vvgt.where.link()")


def test_an_angle_is_that_of_the_world(marked: str, person: Person) -> None:
    """Of three places that a link has: 60 degrees, in a plane along no axis."""
    at = CENTRE + 10 * np.array([[0, 0, 0], [1, 2, 2], [2, 1, -2]]) / 3  # the arms are perpendicular
    third = at[0] + math.cos(math.pi / 3) * (at[1] - at[0]) + math.sin(math.pi / 3) * (at[2] - at[0])
    points = [at[1].tolist(), at[0].tolist(), third.tolist()]
    person("open", marked)
    person("eval", f"window.vvgt.where.marks.part.set(JSON.stringify([['angle', {points}]]))")
    assert person("eval", LIST) == ["angle 60°"]
    person("eval", "window.vvgt.where.marks.part.set('[[\"angle\", [[1, 1, 1], [1, 1, 1], [5, 2, 1]]]]')")
    assert person("eval", LIST) == ["angle –°"]
    person("eval", f"window.vvgt.where.marks.part.set(JSON.stringify([['angle', {points}]]))")
    link = person("eval", "window.vvgt.where.link()")
    for wrong in (
        "nothing",
        "%5B%5B%22angle%22,%5B%5B1,2,3%5D%5D%5D%5D",
        "%5B%5B%22toString%22,%5B%5D%5D%5D",
        "%5B%5B%5B%22ruler%22%5D,%5B%5B0,0,0%5D,%5B1,1,1%5D%5D%5D%5D",
    ):
        person("open", link.split("marks=")[0] + f"marks={wrong}&" + link.split("&", 1)[1])
        assert person("eval", LIST) == []
        assert person("eval", "window.vvgt.where.lens.pose().pitch") < 0  # the rest of the link holds


def test_keys_alone_measure(marked: str, person: Person) -> None:
    person("open", marked)
    person("press", "y")
    person("press", "Tab")
    person("press", "m")
    person("press", "Enter")
    person("until", "window.vvgt.where.clicked")
    begin = person("eval", "window.vvgt.where.clicked.world")
    for _ in range(2):
        person("press", "Shift+ArrowRight")
    person("settled")
    person("press", "Enter")
    person("until", f"window.vvgt.where.clicked.world.join() !== '{','.join(map(repr, begin))}'")
    end = person("eval", "window.vvgt.where.clicked.world")
    assert begin != end
    [told] = person("eval", LIST)
    assert float(told.split()[1]) == pytest.approx(np.linalg.norm(np.subtract(end, begin)), rel=1e-3)
    small = "[...document.querySelectorAll('#marks button')].map((e) => Math.min(e.offsetWidth, e.offsetHeight))"
    least = [size for size in person("eval", small) if size]
    assert len(least) == 5
    assert min(least) >= 24


def test_pictures_of_two_sizes_that_are_asked_for_at_once_are_both_drawn(marked: str, person: Person) -> None:
    person("open", marked)
    asked = "Promise.all([[300, 200], [150, 100]].map((size) => window.vvgt.where.picture(size)))"
    sizes = f"{asked}.then((all) => Promise.all(all.map((one) => createImageBitmap(one))))"
    assert person("eval", f"{sizes}.then((all) => all.map(({{ width, height }}) => [width, height]))") == [
        [300, 200], [150, 100]
    ]  # fmt: skip


def test_lengths_are_in_the_unit_of_the_frame_that_is_shown(person: Person, tmp_path: Path) -> None:
    columns = (np.full((2, 3), -3, np.float32), np.eye(4, dtype=np.float32)[[0, 0]], np.full(2, 4, np.float32))
    for k, space in enumerate(("RAS", None)):
        affine = (1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0)
        options = PlyOptions(scale=SCALE, centre=(0.0, 0.0, 0.0), space=space, affine=affine, up="z")
        write_ply(
            tmp_path / f"f{k}.ply", Gaussians(DOTS.astype(np.float32), *columns, np.ones((2, 3), np.float32)), options
        )
    assert run(["view", str(tmp_path / "f?.ply"), "-o", str(tmp_path / "f.html"), "--quiet"]) == 0
    person("open", (tmp_path / "f.html").as_uri())
    person("eval", "window.vvgt.where.marks.part.set('[[\"ruler\", [[0, 0, 0], [3, 4, 0]]]]')")
    assert person("eval", LIST) == ["ruler 5 mm"]
    person("eval", "window.vvgt.show(1)")
    person("settled")
    assert person("eval", LIST) == ["ruler 5"]
