# ruff: noqa: F811
"""Slices of the volume beside the picture, in a real browser, against what nibabel reads from the same file."""

import re
from pathlib import Path

import numpy as np
import pytest
from test_page_where import CENTRE, MARK, MIDDLE, Person, found, marked, person  # noqa: F401

from vvgt_cli.commands.main import run

pytestmark = pytest.mark.long
SAID = "document.querySelector('#slices output').textContent"
RECTS = (
    "[...document.querySelectorAll('#slices canvas')].map((c) => c.getBoundingClientRect())"
    ".map(({ left, top, width, height }) => [left, top, width, height])"
)
WINDOW = "[...document.querySelectorAll('#slices header input')].map(({ value }) => Number(value))"
CROSS = "(({ at }) => at)(window.vvgt.where.slices.state)"
LINES = (
    "[...document.querySelectorAll('#where line[stroke=\"#fff\"]')]"
    ".map((line) => ['x1', 'y1', 'x2', 'y2'].map((name) => Number(line.getAttribute(name))))"
)
CONTROLS = (
    "[...document.querySelectorAll('#slices :is(input, select, button, canvas)')].filter((e) => !e.closest('[hidden]'))"
)
AXES = ((0, 1), (0, 2), (1, 2))  # of RAS: to the left of the body and up, of axial, coronal, sagittal
NAMES = "axial", "coronal", "sagittal"


class Scan:
    """The marked volume with its axes reversed and exchanged to be nearest to RAS, as nibabel does it."""

    def __init__(self, file: Path) -> None:
        nib = pytest.importorskip("nibabel")
        image = nib.as_closest_canonical(nib.load(file))
        self.data, self.affine, self.zooms = np.asarray(image.dataobj), image.affine, image.header.get_zooms()

    def pixel(self, view: int, index: np.ndarray, rect: list[float]) -> np.ndarray:
        """Where a voxel of a slice is seen in a canvas: as large as fits, in the middle; R or A to the left."""
        (across, up), (left, top, wide, high) = AXES[view], rect
        n, m = (self.data.shape[k] * self.zooms[k] for k in (across, up))
        scale = min(wide / n, high / m)
        # to the right: L where R increases, P where A increases; up: increasing
        right = (self.data.shape[across] - 0.5 - index[across]) * self.zooms[across] * scale
        down = (self.data.shape[up] - 0.5 - index[up]) * self.zooms[up] * scale
        return np.array([left + (wide - scale * n) / 2 + right, top + (high - scale * m) / 2 + down])


def scan_of(page: str) -> Scan:
    return Scan(Path(page.removeprefix("file://")).with_suffix(".nii.gz"))


def value_said(person: Person) -> float:
    return float(str(person("eval", SAID)).rsplit(": ", 1)[1].replace("−", "-"))


def opened(person: Person, page: str) -> list[list[float]]:
    person("open", page)
    person("press", "s")
    person("settled")
    return list(person("eval", RECTS))


def test_values_and_greys_are_those_of_the_file(marked: str, person: Person, tmp_path: Path) -> None:
    """At 20 places of each slice, of a volume that is mirrored and oblique."""
    scan, rng = scan_of(marked), np.random.default_rng(1)
    rects = opened(person, marked)
    assert "values of the volume" in person("eval", "document.querySelector('#about').textContent")
    middle = np.array(scan.data.shape) // 2
    person("click", *scan.pixel(0, middle, rects[0]))
    person("click", *scan.pixel(1, middle, rects[1]))
    window, level = person("eval", WINDOW)
    step = person("eval", "window.vvgt.where.slices.state.base.step")
    assert step < 0.03
    picture = person.picture(tmp_path, "slices.png", bare=False)
    checked = 0
    for view, name in enumerate(NAMES):
        for _ in range(20):
            index = middle.copy()
            for k in AXES[view]:
                index[k] = rng.integers(3, scan.data.shape[k] - 3)
            if (np.abs(index - middle) < 2).any() and (np.abs(index - middle)[list(AXES[view])] < 2).any():
                continue  # under the cross
            wanted, place = scan.data[tuple(index)], scan.pixel(view, index, rects[view])
            if person.touch:
                value = person("eval", _found(scan, index))
            else:
                person("hover", *place)
                value = value_said(person)
            assert value == pytest.approx(wanted, abs=step), (name, index)
            around = scan.data[tuple(slice(k - 1, k + 2) for k in index)]
            if np.ptp(around) == 0:
                x, y = np.round(place).astype(int)
                grey = np.clip((wanted - (level - window / 2)) / window, 0, 1)
                assert picture[y, x] == pytest.approx(np.full(3, grey), abs=0.02), (name, index)
                checked += 1
    assert checked > 25


def _found(scan: Scan, index: np.ndarray) -> str:
    place = (scan.affine[:3, :3] @ index + scan.affine[:3, 3]).tolist()
    return f"window.vvgt.where.slices.found({place}).value"


def test_a_click_moves_the_cross_in_slices_and_picture(marked: str, person: Person, tmp_path: Path) -> None:
    scan, rects = scan_of(marked), opened(person, marked)
    mark = np.linalg.solve(scan.affine[:3, :3], CENTRE + MARK - scan.affine[:3, 3])
    for view in (0, 1):  # the first shows where the second is
        person("click", *scan.pixel(view, mark, rects[view]))
    at = np.array(person("eval", CROSS))
    print(f"{person.size}: cross {np.round(at - CENTRE - MARK, 2)} mm from the mark")
    assert np.abs(at - CENTRE - MARK).max() < 1.5
    assert value_said(person) == pytest.approx(100, abs=0.03)
    picture = person.picture(tmp_path, "cross.png")
    x1, y1, x2, y2 = np.array(person("eval", LINES)).T
    place, _ = found(picture[:, : int(person("eval", "window.vvgt.where.lens.canvas.clientWidth"))], 0)
    far = np.abs((y2 - y1) * place[0] - (x2 - x1) * place[1] + x2 * y1 - y2 * x1) / np.hypot(x2 - x1, y2 - y1)
    far *= person("eval", "window.vvgt.where.lens.perPixel() * window.vvgt.where.world.length")
    print(f"{person.size}: lines {np.round(far, 1)} mm from the mark")
    assert far.max() < 4  # the red of the mark, of radius 5, is in front of its middle
    person("open", person("eval", "window.vvgt.where.link()"))
    assert np.array(person("eval", CROSS)) == pytest.approx(at, abs=0.1)
    person("eval", "document.querySelector('#slices .close').click()")
    person("settled")
    assert "slices=" not in person("eval", "window.vvgt.where.link()")
    person("press", "s")
    person("eval", "window.vvgt.where.slices.to([30, -20, 12])")
    person("settled")
    person("click", *(float(x) for x in np.round(place)))  # picked in the picture
    assert np.linalg.norm(np.array(person("eval", CROSS)) - CENTRE - MARK) < 8


def test_window_and_slice_are_changed_by_drag_wheel_and_keys(marked: str, person: Person, tmp_path: Path) -> None:
    scan, rects = scan_of(marked), opened(person, marked)
    left, top, wide, high = rects[0]
    (window, level), at = person("eval", WINDOW), person("eval", CROSS)
    x, y = left + wide / 2 + 5, top + high / 2 + 5
    person("drag", x, y, x - wide / 10, y - high / 40)
    narrow, raised = person("eval", WINDOW)
    assert narrow == pytest.approx(0.6 * window, rel=0.02)
    assert raised == pytest.approx(level + 0.05 * window * high / wide, rel=0.05)
    assert person("eval", CROSS) == at  # a drag is not a click
    person("settled")
    picture, ball = person.picture(tmp_path, "window.png", bare=False), np.array(scan.data.shape) // 2 + (4, 4, 0)
    px, py = np.round(scan.pixel(0, ball, rects[0])).astype(int)
    assert picture[py, px] == pytest.approx(np.full(3, (40 - (raised - narrow / 2)) / narrow), abs=0.02)
    slider = "document.querySelector('#slices figure input')"
    before = int(person("eval", f"Number({slider}.value)"))
    person("eval", "document.querySelector('#slices canvas').focus()")
    person("press", "ArrowUp")
    person("press", "PageUp")
    assert int(person("eval", f"Number({slider}.value)")) == before + 11
    if not person.touch:
        person("hover", x, y)
        person("wheel", 100)
        person("settled")
        assert int(person("eval", f"Number({slider}.value)")) == before + 10
    assert person("eval", "document.activeElement.getAttribute('aria-label')").startswith("axial slice")
    names = person(
        "eval",
        f"{CONTROLS}.map((e) => e.getAttribute('aria-label') ?? e.closest('label')?.textContent ?? e.textContent)",
    )
    assert all(names), names
    assert "coronal slice" in names
    small = person("eval", f"{CONTROLS}.map((e) => e.getBoundingClientRect().height)")
    assert min(small) >= (44 if person.touch else 24)
    person("eval", "document.querySelector('#slices .window').focus()")
    person("press", "s")  # in a field, letters are text
    assert person("eval", "!document.querySelector('#slices').hidden")


def test_labels_are_drawn_over_the_values_as_their_list_shows_them(person: Person, tmp_path: Path) -> None:
    nib = pytest.importorskip("nibabel")
    data, labels = np.full((24, 24, 24), 100, np.int16), np.zeros((12, 12, 12), np.uint8)  # of twice the spacing
    data[:12] = 0
    labels[2:10, 2:10, 2:10] = 3
    nib.save(nib.Nifti1Image(data, np.eye(4)), tmp_path / "scan.nii")
    coarse = np.diag([2.0, 2, 2, 1])
    coarse[:3, 3] = 0.5
    nib.save(nib.Nifti1Image(labels, coarse), tmp_path / "labels.nii")
    (tmp_path / "labels.json").write_text('{"labels": [{"value": 3, "name": "lobe", "color": [0, 1, 0]}]}')
    layer = f"{tmp_path / 'labels.nii'},labels=auto"
    how = ["--tf", "gray", "--layer", layer, "--live", "--max-gaussians", "2000", "--quiet"]
    assert run(["convert", str(tmp_path / "scan.nii"), *how, "-o", str(tmp_path / "two.html")]) == 0
    left, top, wide, high = opened(person, (tmp_path / "two.html").as_uri())[0]
    scale = min(wide, high) / 24

    def color(i: float, j: float) -> np.ndarray:
        picture = person.picture(tmp_path, "labels.png", bare=False)
        x, y = left + wide / 2 + (11.5 - i) * scale, top + high / 2 + (11.5 - j) * scale
        return picture[int(y), int(x)]

    window, level = person("eval", WINDOW)
    grey = (100 - (level - window / 2)) / window
    assert color(22, 22) == pytest.approx(np.full(3, np.clip(grey, 0, 1)), abs=0.02)  # no label
    assert np.ptp(color(16, 6)) > 0.1
    look = "window.vvgt.live.layers.find(({ rows }) => rows)"
    person("eval", f"{look}.set([{{ number: 3, color: [0, 0, 1], opacity: 0.5 }}])")
    np.testing.assert_allclose(color(16, 6), (grey / 2, grey / 2, grey / 2 + 0.5), atol=0.02)
    person("click", left + wide / 2 - 4 * scale, top + high / 2 + 5 * scale)
    assert re.search(r": 100, (3|lobe|label 3)$", person("eval", SAID))
    person("eval", f"{look}.set([{{ number: 3, opacity: 0 }}])")
    np.testing.assert_allclose(color(16, 6), np.full(3, np.clip(grey, 0, 1)), atol=0.02)


def test_the_face_of_a_cut_shows_the_slice_and_hides_what_is_behind(
    marked: str, person: Person, tmp_path: Path
) -> None:  # fmt: skip
    opened(person, marked)
    person("press", "y")
    cut = "window.vvgt.live.cut.change({{ kind: 'plane', normal: window.vvgt.live.cut.axes[1], at: {}, flipped: {} }})"
    person("eval", cut.format(0.5, "false"))
    person("eval", "window.vvgt.where.slices.part.set('100,25,30,-20,12,0')")
    middle = tuple(np.round(person("eval", MIDDLE)).astype(int)[::-1])
    assert person.picture(tmp_path, "bare.png")[middle] == pytest.approx(np.full(3, 0.6), abs=0.05)
    person("eval", "document.querySelector('#slices .face').click()")
    picture = person.picture(tmp_path, "face.png")
    assert picture[middle] == pytest.approx(np.full(3, 0.65), abs=0.02)  # 40 in the window from -25 to 75
    row = picture[middle[0], : int(person("eval", "window.vvgt.where.lens.canvas.clientWidth"))].max(axis=-1)
    beside = np.abs(row - 0.25) < 0.02  # 0 in it: within the box, beside the ball
    ball = np.abs(row - 0.65) < 0.02
    print(f"{person.size}: {ball.sum()} px of the ball, {beside.sum()} beside it, {(row < 0.02).sum()} black")
    assert ball.sum() == pytest.approx(beside.sum() * 33 / (60 - 33), rel=0.3)
    link = person("eval", "window.vvgt.where.link()")
    person("press", "Shift+Y")  # from behind it is covered
    assert person.picture(tmp_path, "behind.png")[middle] == pytest.approx(np.full(3, 0.6), abs=0.05)
    person("open", link)
    assert person("eval", "window.vvgt.where.link()") == link
    middle = tuple(np.round(person("eval", MIDDLE)).astype(int)[::-1])
    assert person.picture(tmp_path, "linked.png")[middle] == pytest.approx(np.full(3, 0.65), abs=0.02)
    person("eval", "window.vvgt.live.cut.change({ kind: 'none' })")
    assert person.picture(tmp_path, "none.png")[middle] == pytest.approx(np.full(3, 0.6), abs=0.05)


COVERED = """[...document.querySelectorAll('#tools button, #slices :is(button, input, select)')].filter((one) => {
  const { left, right, top, bottom, width } = one.getBoundingClientRect();
  const over = [[left + 2, top + 8], [right - 3, bottom - 8]].map((at) => document.elementFromPoint(...at));
  return width && !over.every((seen) => one === seen || one.contains(seen));
}).map((one) => (one.closest('#tools') ? one.title : 'slices'))"""


def test_panels_lie_beside_the_buttons(marked: str, person: Person, tmp_path: Path) -> None:
    """Of a window upright and across, with slices, which lists of facts may cover, and without."""
    person("open", marked)
    for size in (person.size, person.size[::-1]):
        person("resize", *size)
        for keys in ("", "m", "p", "s", "sm", "si"):
            person("eval", "document.querySelector('#live.folded .fold')?.click()")
            for key in keys:
                person("press", key)
            person.picture(tmp_path, f"{size[0]}-{keys}.png", bare=False)
            covered = set(person("eval", COVERED))
            assert covered - ({"slices"} if keys == "si" else set()) == set(), (size, keys)
            for key in reversed(keys):
                person("press", key)


def test_damaged_slices_are_said_to_be(marked: str, person: Person, tmp_path: Path) -> None:
    text = Path(marked.removeprefix("file://")).read_text("utf-8")
    (tmp_path / "cut.html").write_text(re.sub(r'(id="slices-0">[^<]{400})[^<]+', r"\1", text), "utf-8")
    opened(person, (tmp_path / "cut.html").as_uri())
    assert person("eval", SAID).startswith("The slices cannot be shown")
    assert person("eval", "window.vvgt.where.link()").count("slices=") == 0
