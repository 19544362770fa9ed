"""Pages at their limits, in a real browser: many labels and frames, one value, no WebGL 2, damaged data."""

import base64
import gzip
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.test_page_where import DESK, Person
from vvgt_cli.commands.main import run

pytestmark = pytest.mark.long
SMALL = ["--max-gaussians", "300", "--screen", "100", "--quiet"]


@pytest.fixture(scope="module")
def someone() -> Iterator[Person]:
    found = Person(DESK)
    yield found
    found.process.communicate(timeout=60)


@pytest.fixture(scope="module")
def blob(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small live page."""
    page = tmp_path_factory.mktemp("blob") / "blob.html"
    assert run(["convert", "example:blob:16", "--live", *SMALL, "-o", str(page)]) == 0
    return page


def test_without_webgl_2_there_is_one_line(blob: Path) -> None:
    person = Person(DESK, "--disable-3d-apis")
    try:
        assert person("refused", blob.as_uri()) == (
            "This browser cannot show the 3D view: WebGL 2 is missing or turned off."
        )
    finally:
        person.process.communicate(timeout=60)


DAMAGED = {
    "splats-0": lambda held: held[: len(held) // 2],
    "splats-0 header": lambda held: b"ply\nformat ascii 1.0\nend_header\n",
    "values": lambda held: held[: len(held) // 2],
    "values short": lambda held: gzip.compress(gzip.decompress(held)[:-7]),
    "values text": lambda held: b"not packed",
    "program": lambda held: held[: len(held) // 2],
}


@pytest.mark.parametrize("what", DAMAGED)
def test_a_damaged_page_shows_one_line(someone: Person, blob: Path, what: str, tmp_path: Path) -> None:
    def damage(found: re.Match[str]) -> str:
        return f"{found[1]}{base64.b64encode(DAMAGED[what](base64.b64decode(found[2]))).decode()}"

    part = what.split()[0]
    text, count = re.subn(rf'(id="{part}(?:-0)?">)([^<]+)', damage, blob.read_text(encoding="utf-8"))
    assert count == 1
    (tmp_path / "damaged.html").write_text(text, encoding="utf-8")
    url = (tmp_path / "damaged.html").as_uri()
    if part == "values":  # which are read when they are needed
        someone("open", url)
        someone("eval", "window.vvgt.live.look.show(true)")
        someone("until", "document.querySelector('#live p').textContent")
        said = someone("eval", "document.querySelector('#live p').textContent")
        assert "its values are incomplete" in said
    else:
        said = someone("refused", url)
    print(f"{what}: {said}")
    assert "damaged" in said or "cannot show" in said
    assert "\n" not in said


def test_a_volume_of_one_value(someone: Person, tmp_path: Path) -> None:
    np.save(tmp_path / "flat.npy", np.full((8, 8, 8), 7, np.float32))
    nodes = [{"x": 0, "rgb": [1, 0, 0], "opacity": 0.2}, {"x": 10, "rgb": [1, 1, 0], "opacity": 0.2}]
    (tmp_path / "tf.json").write_text(json.dumps({"points": nodes}))
    for kind in ([], ["--live"]):
        page = tmp_path / f"flat{len(kind)}.html"
        how = ["--tf", str(tmp_path / "tf.json"), *SMALL, "-o", str(page), *kind]
        if run(["convert", str(tmp_path / "flat.npy"), *how]) == 0:
            someone("open", page.as_uri())
            assert someone("eval", "window.vvgt.where.state ?? document.querySelector('#said').textContent") == ""
            assert "NaN" not in someone(
                "eval", "[...document.querySelectorAll('#where, #live')].map((e) => e.outerHTML).join()"
            )


def test_three_hundred_labels(someone: Person, tmp_path: Path) -> None:
    z, y, x = np.mgrid[:21, :21, :21] // 3
    np.save(tmp_path / "many.npy", (1 + x + 7 * y + 49 * z).clip(0, 300).astype(np.uint16))
    names = {n: {"name": f"<b>part</b> & {n}", "color": (n % 7 / 6, n % 5 / 4, 1)} for n in range(1, 301)}
    (tmp_path / "names.json").write_text(json.dumps(names))
    how = ["--labels", str(tmp_path / "names.json"), "--live", "--max-gaussians", "3000", "--screen", "100", "--quiet"]
    assert run(["convert", str(tmp_path / "many.npy"), *how, "-o", str(tmp_path / "many.html")]) == 0
    someone("open", (tmp_path / "many.html").as_uri())
    assert someone("eval", "document.querySelectorAll('#live li').length") == 300
    assert someone("eval", "document.querySelectorAll('#live b b, #live li b').length") == 0
    before = someone.picture(tmp_path, "before.png")
    someone("click", "#live .organs .none")
    assert someone.picture(tmp_path, "none.png").max() < 0.05
    search = "document.querySelector('#live [type=search]')"
    someone("eval", f"{search}.value = '& 300', {search}.dispatchEvent(new Event('input'))")
    assert someone("eval", "document.querySelectorAll('#live li:not([hidden])').length") == 1
    someone("click", "#live li:not([hidden]) .solo")
    assert someone.picture(tmp_path, "one.png").max() > 0.05
    someone("click", "#live .organs .all")
    someone.picture(tmp_path, "look.png", bare=False)
    assert np.abs(someone.picture(tmp_path, "all.png") - before).mean() < 1e-3


def test_five_hundred_frames(someone: Person, blob: Path, tmp_path: Path) -> None:
    assert run(["convert", "example:blob:12", *SMALL, "--steps", "0", "-o", str(tmp_path / "frame_000.ply")]) == 0
    for k in range(1, 500):
        (tmp_path / f"frame_{k:03}.ply").hardlink_to(tmp_path / "frame_000.ply")
    assert run(["view", str(tmp_path / "frame_*.ply"), "-o", str(tmp_path / "run.html"), "--quiet"]) == 0
    print(f"{(tmp_path / 'run.html').stat().st_size / 1e6:.1f} MB")
    someone("open", (tmp_path / "run.html").as_uri())
    for k in (499, 250, *range(10, 60)):
        someone("eval", f"window.vvgt.show({k})")
    assert someone("eval", "document.querySelector('#series select').selectedIndex") == 59
    assert someone("eval", "window.vvgt.viewer.app.assets.list().filter((a) => a.type === 'gsplat').length") <= 17
    someone("click", "#series button")
    someone("eval", "new Promise((done) => setTimeout(done, 3000))")
    someone("click", "#series button")
    assert someone("eval", "document.querySelector('#series select').selectedIndex") > 60
    someone.picture(tmp_path, "frames.png", bare=False)
