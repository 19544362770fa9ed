"""Stories and sharing of pages in a real browser: by keys, buttons and swipes, written, linked, saved, copied."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_page_where import PHONE, Person

from vvgt_cli.commands.main import run

pytestmark = pytest.mark.long
SMALL = (620, 440)
SAID = "[document.querySelector('#story span').textContent, document.querySelector('#story p').textContent]"
AT = "(({ target, pitch, yaw, distance }) => [...target, pitch, yaw, distance])(window.vvgt.where.lens.pose())"
LOOK = (
    "(({ cut, lamp, nodes }) => [cut.state().kind, lamp.state().kind, nodes().length, nodes().at(-1).rgb])"
    "(window.vvgt.live)"
)
STEPS = "[...document.querySelectorAll('#steps textarea')].map((one) => one.value)"
COUNT = """(() => {
  const { lens } = window.vvgt.where, { set } = lens;
  window.turned = [];
  lens.set = (to) => { window.turned.push(to.yaw); set(to); };
})()"""
MIDDLE = (
    "(({ x, y, width, height }) => [x + width / 2, y + height / 2])"
    "(document.querySelector('#story').getBoundingClientRect())"
)
PLACES = "document.querySelector('#places').textContent"
POINTS = [
    {"x": 0, "opacity": 0, "rgb": [0, 0, 0]}, {"x": 150, "opacity": 0, "rgb": [1, 0, 0]},
    {"x": 250, "opacity": 0.9, "rgb": [1, 0, 0]},
]  # fmt: skip
TOLD = [
    {"text": "From the front.", "camera": "front"},
    {"text": "The left half, <b>cut</b>.", "camera": "left", "cut": {"kind": "plane", "normal": [1, 0, 0], "at": 0.5}},
    {"text": "Red.", "cut": None, "function": {"points": POINTS}, "camera": {"yaw": 40, "pitch": -20, "distance": 4}},
    {"text": "A slice.", "slices": {"at": [12, 0, 0], "window": 300, "level": 100}, "function": None},
    {"text": "Bone.", "slices": None, "function": "ct-bone"},
]


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Addresses of pages of a story: of a volume, without values, of labels, of a series; and of files of two kinds."""
    nib = pytest.importorskip("nibabel")
    folder = tmp_path_factory.mktemp("stories")
    radius = np.linalg.norm(np.stack(np.meshgrid(*3 * [np.arange(20) - 9.5], indexing="ij")), axis=0)
    values, affine = np.select([radius < 4, radius < 8], [250, 100], 0).astype(np.int16), np.diag([2.0, 2, 2, 1])
    affine[:3, 3] = -19
    nib.save(nib.Nifti1Image(values, affine), folder / "ball.nii")
    nib.save(nib.Nifti1Image((values // 100).astype(np.uint8), affine), folder / "labels.nii")
    for k in (1, 2):
        np.save(folder / f"run_{k}.npy", values.astype(np.float32) / k)
    table = {"1": {"name": "shell", "color": [1, 0.5, 0]}, "2": {"name": "core", "color": [0, 0.5, 1]}}
    ramp = [{"x": 0, "rgb": [0, 0, 0], "opacity": 0}, {"x": 250, "rgb": [1, 1, 1], "opacity": 0.6}]
    stories = {
        "volume": TOLD, "bare": [TOLD[0], {"text": "From above.", "camera": "top"}],
        "labels": [TOLD[0], {"text": "The core.", "labels": [{"name": "shell", "opacity": 0}]}],
        "series": [TOLD[0], {"text": "Later.", "frame": 1}],
    }  # fmt: skip
    for name, content in {"table": table, "tf": {"points": ramp}}.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    tf, found = ["--tf", str(folder / "tf.json")], {}
    sources = {
        "volume": ["ball.nii", *tf], "bare": ["ball.nii", *tf, "--no-values"], "series": ["run_*.npy", *tf],
        "labels": ["labels.nii", "--labels", str(folder / "table.json")], "plain": ["run_1.npy", *tf],
    }  # fmt: skip
    for name, (source, *how) in sources.items():
        if name in stories:
            (folder / "story.json").write_text(json.dumps({"steps": stories[name]}))
            how += ["--story", str(folder / "story.json")]
        how += [
            "--max-gaussians",
            "500",
            "--screen",
            "64",
            "--steps",
            "0",
            "--quiet",
            "-o",
            str(folder / f"{name}.html"),
        ]
        assert run(["convert", str(folder / source), *how]) == 0
        found[name] = (folder / f"{name}.html").as_uri()
    return found


@pytest.fixture(scope="module", params=[pytest.param(SMALL, id="desk"), pytest.param(PHONE, id="phone")])
def person(request: pytest.FixtureRequest) -> Iterator[Person]:
    someone = Person(request.param, motion=True)
    yield someone
    someone.process.communicate(timeout=60)


def rests(person: Person) -> list[float]:
    """Where the camera is when it has come to rest."""
    found: list[float] = person("eval", f"window.vvgt.where.story.shown.then(() => {AT})")
    return found


def swipe(person: Person, far: int) -> None:
    """On, or back where ``far`` is negative, by a finger over the text; with a mouse, which selects text, by a key."""
    x, y = person("eval", MIDDLE)
    if person.touch:
        person("drag", x + far, y, x - far, y)
    else:
        person("press", "PageDown" if far > 0 else "PageUp")


def test_a_story_is_told_by_keys_buttons_and_swipes(pages: dict[str, str], person: Person) -> None:
    person("open", pages["volume"])
    assert person("eval", SAID) == ["1 / 5", "From the front."]
    front = rests(person)
    assert person("eval", LOOK)[:3] == ["none", "none", 2]
    person("eval", COUNT)
    person("press", "PageDown")
    left = rests(person)
    assert abs(front[4] - left[4]) % 360 == pytest.approx(90, abs=0.1)
    low, high = sorted((front[4], left[4]))
    assert any(low < yaw < high for yaw in person("eval", "window.turned"))  # it glides
    assert person("eval", SAID) == ["2 / 5", "The left half, <b>cut</b>."]  # a text, no markup
    assert person("eval", LOOK)[0] == "plane"
    person("click", "#story .next")
    third = rests(person)
    assert third[3:5] == pytest.approx([-20, 40], abs=1e-3)
    kind, _, count, color = person("eval", LOOK)
    assert (kind, count, color) == ("none", 3, [1, 0, 0])
    swipe(person, 60)
    person("until", "window.vvgt.where.slices.open")
    rests(person)
    assert person("eval", SAID)[0] == "4 / 5"
    now = "(({ window, level, at }) => [window, level, ...at])(window.vvgt.where.slices.state)"
    assert person("eval", now) == pytest.approx([300, 100, 12, 0, 0], abs=0.01)
    assert person("eval", LOOK)[2] == 2  # as the page begins
    person("press", "PageDown")
    rests(person)
    assert not person("eval", "window.vvgt.where.slices.open")
    assert person("eval", LOOK)[1] == "headlight"  # the light of ct-bone
    assert person("eval", "document.querySelector('#story .next').disabled")
    person("press", "PageDown")
    assert person("eval", SAID) == ["5 / 5", "Bone."]
    swipe(person, -60)
    person("until", "window.vvgt.where.slices.open")
    for _ in range(3):
        person("click", "#story .back")
    assert rests(person) == pytest.approx(front, abs=1e-3)
    live = "(({ ariaLive, ariaAtomic }) => [ariaLive, ariaAtomic])(document.querySelector('#story > div'))"
    assert person("eval", live) == ["polite", "true"]
    assert person("axe") == []


def test_the_caption_lies_below_the_picture(pages: dict[str, str], person: Person) -> None:
    """Nothing of the picture is behind it, however long its text, and all of that can be scrolled to."""
    person("open", pages["volume"])
    person("eval", f"window.vvgt.where.story.parts[0].set(JSON.stringify([{{ text: {json.dumps('word ' * 300)} }}]))")
    person("settled")
    tops = "['#view', '#tools', '#tabs', '#story'].map((one) => document.querySelector(one).getBoundingClientRect())"
    view, tools, tabs, story = person("eval", f"{tops}.map(({{ top, bottom }}) => [top, bottom])")
    assert view[1] == pytest.approx(tabs[0], abs=1)
    assert tabs[1] == pytest.approx(story[0], abs=1)
    assert tools[1] <= tabs[0]
    assert story[1] == pytest.approx(person.size[1], abs=1)
    assert story[0] > 0.6 * person.size[1]
    assert person("eval", "document.querySelector('#story > div').scrollHeight") > story[1] - story[0]
    assert person("eval", "window.vvgt.where.lens.canvas.clientHeight") == pytest.approx(tabs[0], abs=1)


def test_pages_without_values_of_labels_and_of_a_series_tell_theirs(pages: dict[str, str], person: Person) -> None:
    for name, what in (
        ("bare", "window.vvgt.where.lens.pose().pitch < -85"),
        ("labels", "window.vvgt.live.layers[0].rows().map(({ opacity }) => opacity > 0).join() === 'false,true'"),
        ("series", "document.querySelector('#series select').selectedIndex === 1"),
    ):
        person("open", pages[name])
        assert person("eval", SAID)[0] == "1 / 2"
        assert not person("eval", what)
        person("press", "PageDown")
        person("until", what)
        person("press", "PageUp")
        person("until", f"!({what})")


def test_a_reader_writes_one(pages: dict[str, str], person: Person, tmp_path: Path) -> None:
    """From views and a note; ordered, changed, removed, linked, saved as a page and as the file of --story."""
    person("open", pages["plain"])
    assert person("eval", "document.querySelector('#story').hidden")
    person("press", "PageDown")  # nothing happens
    person("press", "y")
    rests(person)
    person("eval", 'window.vvgt.where.marks.part.set(\'[["note", [[9, 9, 2]], "a note"]]\')')
    person("press", "t")
    person("click", "#steps .add")
    assert person("eval", STEPS) == ["a note"]  # becomes a step
    assert person("eval", "document.activeElement.tagName") == "TEXTAREA"
    front = rests(person)
    person("eval", "window.vvgt.where.marks.part.set('')")
    person("press", "Escape")
    person("press", "x")
    person("eval", "window.vvgt.live.cut.change({ kind: 'plane', normal: [1, 0, 0], at: 0.3 })")
    left = rests(person)
    assert abs(left[4] - front[4]) % 180 == pytest.approx(90, abs=0.1)  # the key was no letter of the step
    person("press", "t")
    person("click", "#steps .add")
    for letter in "yx!":
        person("press", letter)  # letters are no keys of the page there
    assert person("eval", STEPS) == ["a note", "yx!"]
    assert person("eval", SAID) == ["2 / 2", "yx!"]
    person("click", "#steps li:first-child button")
    assert rests(person) == pytest.approx(front, abs=1e-3)
    marks = "window.vvgt.where.marks.list.map(({ text }) => text)"
    assert person("eval", f"[window.vvgt.live.cut.state().kind, {marks}]") == ["none", ["a note"]]
    person("click", "#steps li:first-child .down")
    assert person("eval", STEPS) == ["yx!", "a note"]
    assert person("eval", SAID) == ["2 / 2", "a note"]
    assert person("axe") == []
    link, saved, story = person("eval", "window.vvgt.where.link()"), tmp_path / "again.html", tmp_path / "story.json"
    assert person("save", "#steps .save", str(saved)).endswith(".html")
    assert person("save", "#steps .json", str(story)) == "story.json"
    for address in (link, saved.as_uri()):
        person("open", address)
        assert person("eval", f"[{SAID}, {STEPS}]") == [["2 / 2", "a note"], ["yx!", "a note"]]
        person("press", "PageUp")
        assert rests(person) == pytest.approx(left, abs=2e-3)
        assert person("eval", f"[window.vvgt.live.cut.state().at, {marks}]") == [pytest.approx(0.3), []]
        person("eval", 'window.vvgt.where.marks.part.set(\'[["note", [[1, 1, 1]], "mine"]]\')')
        person("press", "PageDown")
        rests(person)
        assert person("eval", marks) == ["a note", "mine"]  # what no step has brought stays
    person("press", "t")
    person("click", "#steps li:first-child button:last-child")
    assert person("eval", STEPS) == ["a note"]
    volume, page = str(tmp_path / "v.npy"), tmp_path / "told.html"
    np.save(volume, np.random.default_rng(1).uniform(size=(8, 8, 8)).astype(np.float32))
    how = ["--max-gaussians", "50", "--screen", "32", "--steps", "0", "--quiet", "--story", str(story), "-o", str(page)]
    assert run(["convert", volume, *how]) == 0
    assert '"text": "yx!"' in page.read_text("utf-8")


def test_nothing_glides_where_less_motion_is_asked_for(pages: dict[str, str]) -> None:
    someone = Person(SMALL)
    someone("calm")
    someone("open", pages["bare"])
    someone("eval", COUNT)
    assert len(someone("eval", "window.vvgt.where.story.show(1).then(() => window.turned)")) == 1
    assert rests(someone)[3] == pytest.approx(-90, abs=0.1)
    someone.process.communicate(timeout=60)


COPY = """(() => { window.copied = [];
  const { execCommand } = document;
  document.execCommand = () => window.copied.push(document.activeElement.value);
  const write = async ([item]) => window.copied.push((await item.getType('image/png')).size);
  Object.defineProperty(navigator, 'clipboard', { configurable: true, value: { write } });
  navigator.share = async ({ files, url }) => window.copied.push([files?.map(({ type }) => type), url]);
  navigator.canShare = () => true; })()"""


def test_what_is_shared(pages: dict[str, str], person: Person) -> None:
    person("open", pages["volume"])
    person("eval", COPY)
    person("press", "e")
    assert person("axe") == []
    person("click", "#share .picture")
    person("until", "window.copied.length === 1")
    person("click", "#share .address")
    person("click", "#share .frame")
    size, link, code = person("eval", "window.copied")
    assert size > 1000
    assert "#" in link
    assert "view=" in link
    assert code.startswith('<iframe src="volume.html#')
    assert 'sandbox="allow-scripts allow-downloads"' in code
    person("until", f"{PLACES}.includes('beside its page')")
    person("click", "#share .sheet")
    person("until", "window.copied.length === 4")
    assert person("eval", "window.copied[3]") == [["image/png"], None]  # no address of a file


def test_what_is_forbidden_says_what_works(pages: dict[str, str], person: Person) -> None:
    person("open", pages["volume"])
    person("eval", "document.execCommand = () => false")
    person("eval", "Object.defineProperty(navigator, 'clipboard', { value: undefined })")
    person("press", "e")
    for button, line in (
        ("picture", "save one (p) instead"),
        ("address", "address bar"),
        ("frame", "copy the link (l)"),
    ):
        person("click", f"#share .{button}")
        person("until", f"{PLACES}.includes({json.dumps(line)})")


def test_medical_files_are_not_for_diagnosis(pages: dict[str, str], person: Person) -> None:
    """It stands in (i), and below a saved picture, once: letters where the picture of another file is black."""
    rows = "[...document.querySelectorAll('#about dd')].filter((one) => one.textContent === 'not for diagnosis').length"
    strip = """window.vvgt.where.picture().then(createImageBitmap).then((image) => {
      const canvas = new OffscreenCanvas(image.width, 14), to = canvas.getContext('2d');
      to.drawImage(image, 0, 14 - image.height);
      const { data } = to.getImageData(image.width / 2 - 40, 0, 80, 14);
      return data.reduce((sum, x, k) => sum + (k % 4 < 3 && x > 100 ? 1 : 0), 0);
    })"""
    found = {}
    for name in ("bare", "plain"):
        person("open", pages[name])
        found[name] = person("eval", f"{strip}.then((light) => [{rows}, light])")
    assert found["bare"][0] == 1
    assert found["bare"][1] > 60
    assert found["plain"] == [0, 0]


def test_a_sandboxed_frame_tells_its_story(pages: dict[str, str], person: Person, tmp_path: Path) -> None:
    """Without an origin; a picture that the frame may not save says so."""
    source = f'<iframe src="{pages["bare"]}" sandbox="allow-scripts" style="width:100%;height:90vh"></iframe>'
    (tmp_path / "site.html").write_text(f"<!doctype html><meta name=viewport content=width=device-width>{source}")
    forbidden, offered = "not allowed to copy pictures", "document.querySelector('#saved')?.innerText"
    frame: Any = person("framed", (tmp_path / "site.html").as_uri(), [
        ["eval", "window.vvgt.where.story.show(1)"], ["eval", SAID], ["click", "#tools .picture"],
        ["click", "#sizes button"], ["until", f"{offered}.includes('forbids downloads')"],
        ["click", "#saved button:nth-of-type(3)"], ["click", "#tabs button:last-child"],
        ["click", "#share .picture"], ["until", f"{PLACES}.includes('{forbidden}')"],
    ])  # fmt: skip
    assert frame[1] == ["2 / 2", "From above."]
