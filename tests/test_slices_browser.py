# ruff: noqa: F811
"""Slices of the volume beside the picture, in a real browser, against what nibabel reads from the same file."""

import re
from pathlib import Path

import numpy as np
import pytest
from test_page_where import CENTRE, MARK, MIDDLE, Person, found, marked, person  # noqa: F401

from vvgt_cli.commands.main import run
from vvgt_cli.gaussians.formats import page_values

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
    "[...document.querySelectorAll('#slices :is(input, select, button, canvas)')].filter((e) => e.checkVisibility())"
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


def measure(person: Person) -> None:
    person("press", "m")
    if person.touch:  # measuring goes on where another tab shows slices
        person("click", "#tabs button:text-is('slices')")


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
            _, top, _, high = rects[view]
            if np.ptp(around) == 0 and top + 45 < place[1] < top + high - 25:  # between the letters and the scale bar
                x, y = np.round(place).astype(int)
                grey = np.clip((wanted - (level - window / 2)) / window, 0, 1)
                assert picture[y, x] == pytest.approx(np.full(3, grey), abs=0.02), (name, index)
                checked += 1
    assert checked > (10 if person.touch else 25)


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
    assert re.search(": 100, labels$", person("eval", SAID))
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
    (tmp_path / "cut.html").write_text(re.sub(r'(id="values-0">[^<]{400})[^<]+', r"\1", text), "utf-8")
    opened(person, (tmp_path / "cut.html").as_uri())
    assert person("eval", SAID).startswith("The slices cannot be shown")
    assert person("eval", "window.vvgt.where.link()").count("slices=") == 0


STATE = "(({ zoom, large, tilt }) => [zoom, large, tilt])(window.vvgt.where.slices.state)"
BOX = (
    "[...document.querySelectorAll('#slices figure')].filter((one) => one.checkVisibility())"
    ".map((one) => one.firstChild.getBoundingClientRect())"
    ".map(({ left, top, width, height }) => [left, top, width, height])"
)


def under(view: int, x: float, y: float) -> str:
    """World place that a view shows at a pixel of its canvas."""
    place = f"way.toWorld(frameOf(views[{view}]).index({x}, {y}))"
    return f"(({{ frameOf, views, way }}) => {place})(window.vvgt.where.slices.state)"


def test_a_slice_is_enlarged_by_clicks_button_and_key(marked: str, person: Person) -> None:
    rects = opened(person, marked)
    left, top, wide, high = rects[1]
    person("twice", left + wide / 2 + 9, top + high / 2 + 9)
    [(_, _, w, h)] = person("eval", BOX)
    print(f"{person.size}: {w:.0f} x {h:.0f} px, {wide:.0f} x {high:.0f} before")
    assert w * h > 1.8 * wide * high
    assert person("eval", STATE)[1] == "coronal"
    link = person("eval", "window.vvgt.where.link()")
    person("press", "Escape")
    assert len(person("eval", BOX)) == 3
    person("press", "Enter")  # the focus is still in the slice
    assert person("eval", STATE)[1] == "coronal"
    person("click", "#slices figure:not([hidden]) .large")
    assert person("eval", f"[...{STATE}, document.querySelector('#slices').hidden]") == [1, "", 25, False]
    person("open", link)
    assert len(person("eval", BOX)) == 1
    measure(person)  # two clicks are two points then
    left, top, wide, high = person("eval", BOX)[0]
    person("twice", left + wide / 2, top + high / 2)
    assert person("eval", "[window.vvgt.where.slices.state.large, window.vvgt.where.marks.list.length]") == [
        "coronal",
        1,
    ]


def test_slices_are_zoomed_about_a_place_and_moved(marked: str, person: Person, tmp_path: Path) -> None:
    left, top, wide, high = opened(person, marked)[0]
    x, y = round(0.6 * wide), round(0.55 * high)
    before = person("eval", under(0, x, y))
    if person.touch:
        person("pinch", left + x, top + y, 40, 120)
    else:
        person("hover", left + x, top + y)
        person("wheel", -330, "Control")
    zoom = person("eval", STATE)[0]
    assert zoom == pytest.approx(3, abs=0.05)
    np.testing.assert_allclose(person("eval", under(0, x, y)), before, atol=0.2)
    if not person.touch:
        person("drag", left + x, top + y, left + x - 30, top + y - 20, "right")
        np.testing.assert_allclose(person("eval", under(0, x - 30, y - 20)), before, atol=0.2)
    person("eval", "document.querySelector('#slices canvas').focus()")
    at = person("eval", under(0, x, y))
    person("press", "Shift+ArrowRight")
    np.testing.assert_allclose(person("eval", under(0, x - 24, y)), at, atol=0.01)
    link = person("eval", "window.vvgt.where.link()")
    person("press", "+")
    assert person("eval", STATE)[0] == pytest.approx(1.25 * zoom)
    person("press", "0")
    assert person("eval", STATE)[0] == 1
    person("open", link)
    np.testing.assert_allclose(person("eval", under(0, x - 24, y)), at, atol=0.2)
    for times in (1, 4):  # the bar of a slice, against voxels whose places are known
        person("eval", f"window.vvgt.where.slices.part.set('100,25,30,-20,12,0,0,0,{times},30,-20,12')")
        [length, across], row = (
            person("eval", f"(({{ views }}) => {what})(window.vvgt.where.slices.state)")
            for what in ("[views[0].scale.length, views[0].scale.across]", "views[0].canvas.clientHeight - 10")
        )
        apart = np.subtract(person("eval", under(0, 50, 50)), person("eval", under(0, 50 + across, 50)))
        assert length == pytest.approx(np.linalg.norm(apart), rel=1e-3)
        picture = person.picture(tmp_path, f"bar-{times}.png", bare=False)
        rows = picture[round(top + row) - 2 : round(top + row) + 2, round(left) : round(left + wide / 2)]
        line = rows.min(axis=-1).max(axis=0) > 0.7  # 1.5 px high
        assert line.sum() == pytest.approx(across, abs=3)


def test_a_ruler_of_a_slice_is_drawn_in_its_plane_alone(marked: str, person: Person, tmp_path: Path) -> None:
    left, top, wide, high = opened(person, marked)[0]

    def yellow() -> int:
        picture = person.picture(tmp_path, "ruler.png", bare=False)[
            round(top) : round(top + high), round(left) : round(left + wide)
        ]
        return int(((picture[..., 0] > 0.9) & (picture[..., 2] < 0.4)).sum())

    measure(person)
    ends = [(left + share * wide, top + 0.45 * high) for share in (0.35, 0.62)]
    assert yellow() == 0
    person("click", *ends[0])
    begun = yellow()
    person("click", *ends[1])
    ruler = yellow()
    print(f"{person.size}: {begun} px of a point, {ruler} of the ruler")
    assert 5 < begun < ruler
    assert ruler > 0.27 * wide
    told = float(person("eval", "document.querySelector('#marks li span').textContent").split()[1])
    scale = person("eval", "(({ frameOf, views }) => frameOf(views[0]).scale)(window.vvgt.where.slices.state)")
    assert told == pytest.approx(0.27 * wide / scale, rel=0.01)  # not only from voxel to voxel
    person("eval", "document.querySelector('#slices canvas').focus()")
    person("press", "PageUp")
    assert yellow() == 0
    person("press", "PageDown")
    assert yellow() == pytest.approx(ruler, rel=0.1)


def test_slices_open_at_the_place_that_was_clicked(marked: str, person: Person, tmp_path: Path) -> None:
    person("open", marked)
    person("press", "y")
    place, _ = found(person.picture(tmp_path, "front.png"), 0)
    person("click", *(float(x) for x in np.round(place)))
    person("until", "window.vvgt.where.clicked")
    person("press", "s")
    person("until", "window.vvgt.where.slices.open")
    assert np.linalg.norm(np.array(person("eval", CROSS)) - CENTRE - MARK) < 8


def test_a_tilted_volume_says_so_and_slices_follow_the_body(marked: str, person: Person, tmp_path: Path) -> None:
    nib = pytest.importorskip("nibabel")
    scan, rects = scan_of(marked), opened(person, marked)
    tilt = round(float(np.degrees(nib.affines.obliquity(scan.affine)).max()))
    labels = "[...document.querySelectorAll('#slices canvas')].map((one) => one.getAttribute('aria-label'))"
    assert person("eval", "document.querySelector('#slices .axes').selectedOptions[0].text").endswith(
        f"oblique {tilt}°"
    )
    assert all(f"oblique {tilt}°" in text for text in person("eval", labels))
    assert "oblique" in person("eval", "document.querySelector('#about').textContent")
    across = [
        np.subtract(person("eval", under(view, 90, 60)), person("eval", under(view, 50, 60))) for view in range(3)
    ]
    assert min(np.abs(one).max() / np.linalg.norm(one) for one in across) < 0.98
    choose = (
        "(() => {{ const one = document.querySelector('#slices .axes'); one.selectedIndex = {}; "
        "one.dispatchEvent(new Event('change')); }})()"
    )
    person("eval", choose.format(1))
    assert not any("oblique" in text for text in person("eval", labels))
    for view, axis in enumerate((0, 0, 1)):
        there = np.subtract(person("eval", under(view, 90, 60)), person("eval", under(view, 50, 60)))
        np.testing.assert_allclose(
            there / np.linalg.norm(there), -np.eye(3)[axis], atol=1e-6
        )  # L, L and P to the right
    picture, inverse = person.picture(tmp_path, "body.png", bare=False), np.linalg.inv(scan.affine)
    for x, y in np.random.default_rng(2).uniform((60, 40), (rects[0][2] - 60, rects[0][3] - 40), (30, 2)).tolist():
        world = person("eval", under(0, x, y))
        index = np.round(inverse[:3, :3] @ world + inverse[:3, 3]).astype(int)
        value = person("eval", f"window.vvgt.where.slices.found({world})?.value ?? null")
        inside = ((index >= 0) & (index < scan.data.shape)).all()
        assert value == (pytest.approx(scan.data[tuple(index)], abs=0.03) if inside else None)
    assert picture.max() > 0.5
    link = person("eval", "window.vvgt.where.link()")
    person("open", link)
    assert not any("oblique" in text for text in person("eval", labels))
    person("eval", choose.format(0))
    assert all("oblique" in text for text in person("eval", labels))


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, np.ndarray, np.ndarray]:
    """Page of a CT whose index axes are z, -x and y of the body, its values (i, j, k) and its affine."""
    nib = pytest.importorskip("nibabel")
    folder = tmp_path_factory.mktemp("turned")
    data = np.random.default_rng(3).integers(-1000, 2000, (20, 24, 28)).astype(np.int16)
    affine = np.array([[0, -1.0, 0, 20], [0, 0, 1.25, -30], [1.5, 0, 0, 40], [0, 0, 0, 1]])
    nib.save(nib.Nifti1Image(data, affine), folder / "turned.nii")
    how = ["--tf", "ct-bone", "--max-gaussians", "300", "--steps", "0", "--quiet"]
    assert run(["convert", str(folder / "turned.nii"), *how, "-o", str(folder / "turned.html")]) == 0
    return (folder / "turned.html").as_uri(), data, affine


def test_the_value_under_the_pointer_is_the_nearest_voxels(
    turned: tuple[str, np.ndarray, np.ndarray], person: Person
) -> None:
    """At 240 places: exactly, where the page holds all voxels."""
    page, data, affine = turned
    opened(person, page)
    index = np.random.default_rng(4).uniform(-0.49, np.array(data.shape) - 0.51, (240, 3))
    world = index @ affine[:3, :3].T + affine[:3, 3]
    values = person("eval", f"{world.tolist()}.map((place) => window.vvgt.where.slices.found(place)?.value)")
    np.testing.assert_array_equal(values, data[tuple(np.round(index).astype(int).T)])
    middle = np.round(index) @ affine[:3, :3].T + affine[:3, 3]
    person(
        "eval", "(({ lens }) => window.vvgt.live.look.pick(lens.ray(...lens.middle)))(window.vvgt.where)"
    )  # reads grids
    at = "(place) => window.vvgt.live.look.at(window.vvgt.where.world.at(place)).value"
    np.testing.assert_allclose(person("eval", f"{middle.tolist()}.map({at})"), values, atol=1e-6)


def test_cross_and_letters_have_the_colours_of_the_bodys_axes(
    turned: tuple[str, np.ndarray, np.ndarray], person: Person, tmp_path: Path
) -> None:
    """Of a volume whose index axes are not in the body's order; the letter I has serifs."""
    rects = opened(person, turned[0])
    person("eval", "window.vvgt.where.slices.part.set('1,5000,2,-14,54,0')")  # black
    picture = person.picture(tmp_path, "colours.png", bare=False)
    colors = np.array([[255, 157, 138], [155, 224, 138], [154, 196, 255]]) / 255
    for view, (along, up) in enumerate(AXES):
        left, top, wide, high = map(round, rects[view])
        part = picture[top : top + high, left : left + wide]
        for axis, profile in ((up, part.mean(axis=0)), (along, part.mean(axis=1))):
            line = profile[np.argmax(profile[8:-30].sum(axis=1)) + 8]
            assert np.argmax(line) == np.argmax(colors[axis]), (view, axis, line)
    left, top, wide, high = map(round, rects[1])
    letter = picture[top + high - 20 : top + high, left + wide // 2 - 8 : left + wide // 2 + 8]
    rows = (np.abs(letter - colors[2]).max(axis=-1) < 0.3).sum(axis=1)
    rows = rows[rows > 0]
    print(f"{person.size}: rows of the letter I are {rows} px wide")
    assert min(rows[0], rows[-1]) >= 2 * rows[len(rows) // 2]


def test_the_frogs_tissues_have_names_and_natural_colours(person: Person, tmp_path: Path) -> None:
    page = tmp_path / "frog.html"
    how = ["--labels", "auto", "--crop", "220:296,190:262,52:88", "--max-gaussians", "500", "--steps", "0", "--quiet"]
    assert run(["convert", "example:frog", *how, "-o", str(page)]) == 0
    person("open", page.as_uri())
    names = person("eval", "[...document.querySelectorAll('#live .organs span')].map((one) => one.textContent)")
    assert {"heart", "liver", "skeleton", "stomach", "label 16"} <= set(names)
    skeleton = person(
        "eval", f"document.querySelectorAll('#live .organs li')[{names.index('skeleton')}].children[1].value"
    )
    red, green, blue = bytes.fromhex(skeleton[1:])
    assert red > green > blue > 180  # of bone
    person("press", "s")
    person("until", "window.vvgt.where.slices.open")
    assert person("eval", "window.vvgt.where.slices.found([265, 230, 68 * 1.5]).names") == ["heart"]


def test_a_mean_of_voxels_says_so_beside_its_value(
    person: Person, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_values, "MAX_CELLS", 2000)
    radius = np.linalg.norm(np.stack(np.meshgrid(*3 * [np.linspace(-1, 1, 24)], indexing="ij")), axis=0)
    np.save(tmp_path / "ball.npy", np.where(radius < 0.8, 100, 0).astype(np.float32))
    how = ["--tf", "gray", "--max-gaussians", "500", "--steps", "0", "--quiet"]
    assert run(["convert", str(tmp_path / "ball.npy"), *how, "-o", str(tmp_path / "ball.html")]) == 0
    opened(person, (tmp_path / "ball.html").as_uri())
    assert re.search(r": 100 \(mean of 2 × 2 × 2 voxels\)$", person("eval", SAID))
    person("eval", "window.vvgt.where.lens.canvas.focus()")
    person("press", "Enter")
    person("until", "window.vvgt.where.clicked")
    person("settled")
    for place in ("document.querySelector('#places')", "document.querySelector('#where')"):
        assert "(mean of 2 × 2 × 2 voxels)" in person("eval", f"{place}.textContent")
