# ruff: noqa: F811
"""Pages by keyboard and for screen readers: axe-core and the Tab key in a real browser."""

import base64
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_page_where import DESK, PHONE, Person, marked  # noqa: F401

from vvgt_cli.commands.main import run
from vvgt_cli.images.metrics import psnr

pytestmark = pytest.mark.long
TABS = {"slices": 3, "marks": 4}
PAGES = ("slices", "series", "labels", "fixed")


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory, marked: str) -> dict[str, str]:
    """Addresses of a live page with slices, of a series, of labels, and of Gaussians alone."""
    nib = pytest.importorskip("nibabel")
    folder = tmp_path_factory.mktemp("pages")
    grid = np.stack(np.meshgrid(*3 * [np.linspace(-1, 1, 16)], indexing="ij"))
    frames = [1e-6 + np.exp(-6 * ((grid - shift) ** 2).sum(axis=0)) for shift in (-0.2, 0.2)]
    nib.save(nib.Nifti1Image(np.stack(frames, -1).astype(np.float32), np.eye(4)), folder / "series.nii")
    nib.save(nib.Nifti1Image((frames[0] > 0.5).astype(np.uint8), np.eye(4)), folder / "labels.nii")
    quick = ["--max-gaussians", "1000", "--quiet"]
    given = {
        "series": ["series.nii", "--live"], "labels": ["labels.nii", "--labels", "auto", "--live"],
        "fixed": ["labels.nii", "--no-values", "--steps", "0"],
    }  # fmt: skip
    for name, (file, *options) in given.items():
        assert run(["convert", str(folder / file), *options, *quick, "-o", str(folder / f"{name}.html")]) == 0
    return {"slices": marked} | {name: (folder / f"{name}.html").as_uri() for name in given}


@pytest.fixture(scope="module", params=[pytest.param(DESK, id="desk"), pytest.param(PHONE, id="phone")])
def person(request: pytest.FixtureRequest) -> Iterator[Person]:
    someone = Person(request.param)
    yield someone
    someone.process.communicate(timeout=60)


READ = """(async () => {
  const { canvas } = window.vvgt.where.lens, wait = () => new Promise((done) => setTimeout(done, 50));
  for (let k = 0; k < 100 && !window.vvgt.where.clicked; k++) {
    canvas.dispatchEvent(new KeyboardEvent('keydown', { key: 'Enter', bubbles: true }));
    await wait();
  }
  return window.vvgt.where.clicked?.world;
})()"""
STOP = "document.querySelector('#live linearGradient').lastElementChild.getAttribute"
DRAWN = "[...document.querySelectorAll('#live .presets img')].every((one) => one.complete && one.naturalWidth === 84)"
NAMES = "[...document.querySelectorAll('#live .presets button')].map((one) => one.textContent)"
CHOSEN = "[document.activeElement.textContent, document.activeElement.getAttribute('aria-pressed')]"
PICTURE = """(() => {
  const made = Object.assign(document.createElement('canvas'), { width: 84, height: 84 });
  made.getContext('2d').drawImage(document.activeElement.querySelector('img'), 0, 0);
  return made.toDataURL().split(',')[1];
})()"""


def of_size(picture: Image.Image) -> Image.Image:
    """What is lit of a picture, 84 px wide and high."""
    lit = picture.convert("L").point(lambda grey: 255 * (grey > 16)).getbbox()
    return picture.resize((84, 84), Image.Resampling.BOX, lit)


def test_presets_have_pictures_and_are_chosen_by_keys(person: Person, tmp_path: Path) -> None:
    """A scan of the file's function over soft tissue: pictures, there at once, are near what is then seen."""
    nib = pytest.importorskip("nibabel")
    radius = np.linalg.norm(np.stack(np.meshgrid(*3 * [np.linspace(-1, 1, 24)], indexing="ij")), axis=0)
    values = np.select([radius < 0.4, radius < 0.55, radius < 0.8], [40.0, 900.0, 60.0], -1000.0)
    nib.save(nib.Nifti1Image(values.astype(np.int16), np.eye(4)), tmp_path / "ct.nii")
    command = ["convert", str(tmp_path / "ct.nii"), "--tf", "ct-skin", "--live", "--max-gaussians", "2000", "--quiet"]
    assert run([*command, "-o", str(tmp_path / "ct.html")]) == 0
    person("open", (tmp_path / "ct.html").as_uri())
    person("eval", "document.querySelector('#live.folded .fold')?.click()")
    before = person.picture(tmp_path, "before.png")
    place = person("eval", READ)
    assert place is not None
    person("eval", "document.querySelector('#live .preset').focus()")
    person("press", "Enter")
    assert person("eval", DRAWN)
    assert np.abs(person.picture(tmp_path, "drawn.png") - before).max() < 0.02  # as it was
    assert person("eval", READ) == place  # still under the function that is chosen
    named = ["as in the file", "bone", "soft tissue", "vessels", "lungs"]
    assert person("eval", NAMES) == named
    assert person("axe") == []
    pictures = []
    for name in named[1:3]:
        while person("eval", CHOSEN)[0] != name:
            person("press", "Tab")
        person("press", "Enter")
        seen = Image.fromarray((255 * person.picture(tmp_path, f"{name}.png")).round().astype(np.uint8))
        assert person("eval", CHOSEN) == [name, "true"]
        small = Image.open(io.BytesIO(base64.b64decode(person("eval", PICTURE)))).convert("RGB")
        pictures.append([np.asarray(of_size(one), np.float32) / 255 for one in (seen, small)])
    for k, (wanted, small) in enumerate(pictures):
        own, other = psnr(wanted, small), psnr(pictures[1 - k][0], small)
        print(f"{person.size} {named[k + 1]}: {own:.1f} dB from what the page shows then, {other:.1f} from the other")
        assert own > max(16, other + 3)  # from another side, of a ball
    assert person("eval", "[window.vvgt.live.lamp.state().kind, window.vvgt.live.nodes()[0].x]") == ["none", -30]
    right = "document.querySelector('#live .function svg').getBoundingClientRect().right"
    dots = "[...document.querySelectorAll('#live .node .dot')].map((dot) => dot.getBoundingClientRect().right)"
    assert person("eval", f"Math.max(...{dots}) < {right}")  # of 3000 HU, too, beyond all values
    assert person("eval", "window.vvgt.live.at().named().name") == "ct-soft-tissue"  # as what is saved is named
    offset, color = person("eval", f"[{STOP}('offset'), {STOP}('stop-color')]")
    assert offset == "1"  # of 900 HU, the greatest value
    np.testing.assert_allclose(list(bytes.fromhex(color[1:])), (245, 217, 173), atol=8)
    last = person("eval", "window.vvgt.live.nodes().at(-1).x")
    person("eval", "[...document.querySelectorAll('#live .node')].at(-1).focus()")
    person("press", "ArrowUp")
    assert person("eval", "window.vvgt.live.nodes().at(-1).x") == last > 900
    person("press", "Control+z")
    person("eval", "document.querySelector('#live .preset').focus()")
    person("press", "Escape")
    closed = "[document.activeElement.className, document.querySelector('.presets').hidden]"
    assert person("eval", closed) == ["preset", True]
    person("press", "Control+z")
    person("press", "Control+z")
    assert np.abs(person.picture(tmp_path, "undone.png") - before).max() < 0.02


WINDOWS = (
    "(({ selectedOptions: [chosen] }, group) => [chosen.text, group.label, [...group.children].map((one) => one.text)])"
    "(...document.querySelectorAll('#slices .preset, #slices optgroup'))"
)
DOT = "['cx', 'cy'].map((name) => Number(document.querySelector('#live .light .dot').getAttribute(name)))"


def test_windows_are_offered_where_hounsfield_units_are_a_guess(person: Person, tmp_path: Path) -> None:
    nib = pytest.importorskip("nibabel")
    values = np.repeat(np.array([-1000, 40, 900], np.int16), [12, 10, 2])[:, None, None] + np.zeros((1, 8, 8), np.int16)
    nib.save(nib.Nifti1Image(values, np.eye(4)), tmp_path / "ct.nii")
    command = ["convert", str(tmp_path / "ct.nii"), "--tf", "gray", "--live", "--max-gaussians", "500", "--quiet"]
    assert run([*command, "-o", str(tmp_path / "ct.html")]) == 0
    person("open", (tmp_path / "ct.html").as_uri())
    person("press", "s")
    person("until", "window.vvgt.where.slices.open")
    assert person("eval", WINDOWS) == ["all values", "if in HU", ["soft tissue", "lung", "bone", "brain"]]


def test_a_light_is_from_the_upper_left_until_it_is_aimed(person: Person, pages: dict[str, str]) -> None:
    def choose(kind: str) -> None:
        chosen = f"Object.assign(document.querySelector('.light select'), {{ value: '{kind}' }})"
        person("eval", f"{chosen}.dispatchEvent(new Event('change'))")
        person("settled")

    person("open", pages["slices"])
    person("press", "x")
    choose("direction")
    assert person("eval", DOT) == [-13, -13]
    aimed = person("eval", "window.vvgt.live.lamp.state().from")
    person("press", "y")
    choose("headlight")
    choose("direction")
    assert person("eval", "window.vvgt.live.lamp.state().from") == aimed


@pytest.mark.parametrize("name", PAGES)
def test_no_serious_finding_and_no_trap(name: str, person: Person, pages: dict[str, str]) -> None:
    person("open", pages[name])
    if name == "slices":
        person("press", "s")
        person(
            "eval",
            'window.vvgt.where.marks.part.set(\'[["ruler", [[0, 0, 0], [9, 0, 0]]], ["note", [[0, 0, 0]], "here"]]\')',
        )
        person("press", "m")
    if person.touch:
        person("eval", "document.querySelector('#live.folded .fold')?.click()")
    person("eval", "document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    person("press", "i")
    person("settled")
    assert person("axe") == []
    assert person("tabs") == {"unseen": [], "missed": []}


def test_facts_say_what_a_page_holds_and_its_light(person: Person, pages: dict[str, str]) -> None:
    rows = "[...document.querySelectorAll('#about dt')].map((one) => [one.textContent, one.nextSibling.textContent])"
    person("open", pages["labels"])
    assert dict(person("eval", rows))["contains"].startswith("Gaussians, values of the volume, names of labels")
    person("open", pages["fixed"])
    assert dict(person("eval", rows))["light"] == "headlight; ambient 0.4, diffuse 0.6, gloss 0.0"


def test_a_drag_beside_the_nodes_shifts_and_widens_the_function(person: Person, pages: dict[str, str]) -> None:
    person("open", pages["slices"])
    if person.touch:
        person("eval", "document.querySelector('#live .fold').click()")
    nodes = "window.vvgt.live.nodes().map(({ x }) => x)"
    box = "document.querySelector('#live .function svg').getBoundingClientRect()"
    before = np.array(person("eval", nodes))
    left, top, wide = person("eval", f"(({{ left, top, width }}) => [left, top, width])({box})")
    x, y = left + 6 + 0.75 * (wide - 12), top + 60
    person("drag", x, y, x + (wide - 12) / 10, y)
    shifted = np.array(person("eval", nodes))
    np.testing.assert_allclose(shifted, before + np.ptp(before) / 10, atol=0.5)
    person("drag", x, y, x, y - 40)
    wider = np.array(person("eval", nodes))
    middle = (shifted[0] + shifted[-1]) / 2
    np.testing.assert_allclose(
        wider - middle, (shifted - middle) * np.exp(40 / 60 * 276 / wide), atol=1.5
    )  # of a drawing 276 px wide
    person("press", "Control+z")
    np.testing.assert_allclose(person("eval", nodes), shifted)
    person("eval", "document.querySelector('#live .node').focus()")
    person("press", "PageDown")
    np.testing.assert_allclose(person("eval", nodes), shifted - np.ptp(before) / 50)


def test_escape_closes_what_is_open_and_the_focus_goes_back(person: Person, pages: dict[str, str]) -> None:
    person("open", pages["slices"])
    person("eval", "window.vvgt.where.lens.canvas.focus()")
    for key, name in (("h", "help"), ("i", "about"), ("p", "sizes"), ("m", "marks"), ("s", "slices")):
        person("press", key)
        if name in ("marks", "slices"):
            person("eval", f"document.querySelector('#{name} button').focus()")
        assert person("eval", f"document.getElementById('{name}').contains(document.activeElement)"), name
        person("press", "Escape")
        back = {"marks": "#tools .measure", "slices": "#tools .slices"}.get(name, "#view canvas")
        if person.touch and name in TABS:
            back = f"#tabs button:nth-child({TABS[name]})"
        closed = f"[document.getElementById('{name}').hidden, document.activeElement.matches('{back}')]"
        assert person("eval", closed) == [True, True], name
