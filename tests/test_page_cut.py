# ruff: noqa: F811
"""Planes and boxes that cut live pages, dragged in the picture by mouse and by touch, in a real browser."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_page_where import AXIS, MIDDLE, Person, marked, person  # noqa: F401

pytestmark = pytest.mark.long
HANDLES = (
    "Object.fromEntries([...document.querySelectorAll('#cut .handle')].filter((h) => h.style.display !== 'none')"
    ".map((h) => [h.getAttribute('aria-label'), h.getAttribute('transform').match(/[-.0-9]+/g).map(Number)]))"
)
STATE = "window.vvgt.live.cut.state()"
ACROSS_Y, FREE, BOX = 2, 4, 5


def choose(person: Person, kind: int) -> None:
    person("eval", f"(() => {{ {AXIS}.selectedIndex = {kind}; {AXIS}.dispatchEvent(new Event('change')) }})()")
    person("settled")


def back(person: Person) -> None:
    """Step back from the first view, which shows what is visible as large as it fits, to see all of the box."""
    person("wheel", 400)
    person("settled")


def drag(person: Person, handle: str, by: tuple[float, float]) -> dict[str, Any]:
    """Drag a handle by some pixels; the cut's state."""
    x, y = person("eval", HANDLES)[handle]
    person("drag", x, y, x + by[0], y + by[1])
    person("settled")
    return dict(person("eval", STATE))


def test_a_face_of_the_box_is_dragged_and_nothing_shows_beyond_it(
    marked: str, person: Person, tmp_path: Path
) -> None:  # fmt: skip
    person("open", marked)
    person("press", "y")
    person("press", "o")
    back(person)
    whole = person.picture(tmp_path, "whole.png")
    choose(person, BOX)
    faces = person("eval", HANDLES)
    assert sorted(faces) == sorted(f"face {letter}" for letter in "RLAPSI")
    assert np.abs(person.picture(tmp_path, "box.png") - whole).mean() < 1e-3  # all of it is within
    unit = person.size[0] / 8
    middle = np.mean(np.flatnonzero(whole.max(axis=(1, 2)) > 0.1))  # row of the balls
    assert drag(person, "face S", (0, middle - faces["face S"][1]))["kind"] == "box"
    place = person("eval", HANDLES)["face S"][1]
    np.testing.assert_allclose(place, middle, atol=4)
    person.picture(tmp_path, "face.png", bare=False)
    rows = person.picture(tmp_path, "cut.png").max(axis=-1).mean(axis=1)
    beyond, within = rows[: int(place) - 8].max(), rows[int(place) + 8 : int(place) + 16].mean()
    print(f"{person.size}: light of a row beyond the face {beyond:.4f}, within {within:.3f}")
    assert within > 0.02
    assert beyond < 0.03 * within  # a clean face: 8 px from it there is nothing
    drag(person, "face R", (0.7 * unit, 0))
    both = person.picture(tmp_path, "both.png")
    link = person("eval", "window.vvgt.where.link()")
    assert "cut=box," in link
    person("open", link)
    assert np.abs(person.picture(tmp_path, "linked.png") - both).mean() < 1e-3
    drag(person, "face I", (0, -0.5 * unit))
    person("press", "Control+z")
    assert np.abs(person.picture(tmp_path, "undone.png") - both).mean() < 1e-3


def test_a_face_is_lit_as_a_face(marked: str, person: Person, tmp_path: Path) -> None:
    """Within the ball all values are the same: there no gradient says where the light comes from."""
    person("open", marked)
    person("press", "y")
    choose(person, ACROSS_Y)
    person("eval", "window.vvgt.live.cut.change({ at: 0.5, flipped: true })")
    bare = person.picture(tmp_path, "unlit.png")
    light = "window.vvgt.live.parts.find(({ key }) => key === 'light')"
    person("eval", f"(({{ state, set }}) => set({{ ...state(), kind: 'headlight' }}))({light})")
    lit, (x, y) = person.picture(tmp_path, "lit.png"), map(round, person("eval", MIDDLE))
    middle = np.s_[y - 20 : y + 20, x - 20 : x + 20]
    print(f"{person.size}: light of a face {lit[middle].mean():.3f}, unlit {bare[middle].mean():.3f}")
    assert lit[middle].mean() > 0.5 * bare[middle].mean() > 0.1


def test_a_plane_is_moved_and_turned(marked: str, person: Person, tmp_path: Path) -> None:
    person("open", marked)
    person("press", "y")
    back(person)
    choose(person, FREE)
    begun = person("eval", STATE)
    (x, y), tip = (person("eval", HANDLES)[name] for name in ("the plane", "direction of the plane"))
    assert np.hypot(tip[0] - x, tip[1] - y) > 20  # can be told apart
    moved = drag(person, "the plane", (tip[0] - x, tip[1] - y))
    assert moved["normal"] == begun["normal"]
    assert moved["at"] > begun["at"] + 0.05  # the way that it was dragged
    turned = drag(person, "direction of the plane", (40, 0))
    assert 0.3 < np.dot(turned["normal"], moved["normal"]) < 0.999
    assert np.linalg.norm(turned["normal"]) == pytest.approx(1)
    picture = person.picture(tmp_path, "turned.png")
    person.picture(tmp_path, "plane.png", bare=False)
    person("open", person("eval", "window.vvgt.where.link()"))
    assert np.abs(person.picture(tmp_path, "linked.png") - picture).mean() < 1e-3
    for key in ("ArrowRight", "ArrowRight"):
        person("eval", "document.querySelector('#cut [aria-label=\"the plane\"]').focus()")
        person("press", key)
    assert person("eval", STATE)["at"] == pytest.approx(turned["at"] + 0.02, abs=1e-3)


def test_a_link_within_the_open_page_takes_back_what_it_lacks(
    marked: str, person: Person, tmp_path: Path
) -> None:  # fmt: skip
    person("open", marked)
    first, begin = person("eval", "window.vvgt.where.link()"), person.picture(tmp_path, "begin.png")
    person("press", "o")
    choose(person, BOX)
    drag(person, "face S", (0, 80))
    person("eval", "window.vvgt.live.set([{ x: 0, y: 0, rgb: [1, 1, 1] }, { x: 90, y: 0.9, rgb: [0, 1, 1] }])")
    changed = person("eval", "window.vvgt.where.link()")
    other = person.picture(tmp_path, "changed.png")
    for link, wanted in ((first, begin), (changed, other), (first, begin)):
        person("eval", f"location.hash = {link.split('#')[1]!r}")
        assert np.abs(person.picture(tmp_path, "now.png") - wanted).mean() < 2e-3, link
    assert person("eval", "window.vvgt.where.link()") == first
