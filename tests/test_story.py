"""Stories of pages: what a story.json may say, one line for what it may not, and where it goes."""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.test_live import RAMP
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.page_values import PageLayer
from vvgt_cli.gaussians.story import KEYS, LONG, MOST, read_story
from vvgt_cli.look.labels import Label, LabelTable
from vvgt_cli.volume import Volume

HOW = ("--max-gaussians", "60", "--screen", "32", "--steps", "0")
VALUES = PageLayer(Volume(np.zeros((4, 4, 4), np.uint8), spacing=(2.0, 2.0, 2.0), origin=(10.0, 0.0, 0.0)), RAMP, 0.5)
TABLE = LabelTable("t", (Label(1, "liver", (1.0, 0.0, 0.0), 1.0), Label(7, "spleen", (0.0, 0.0, 1.0), 1.0)))
LABELS = VALUES._replace(look=TABLE)
POINTS = [{"x": 0, "opacity": 0, "rgb": [0, 0, 0]}, {"x": 1, "opacity": 1, "rgb": [1, 1, 1]}]
PLANE = {"kind": "plane", "normal": [1, 0, 0], "at": 0.5}


def steps(*given: dict[str, Any]) -> tuple[dict[str, Any], ...]:
    """What the page gets of steps, which all have a text."""
    return read_story({"steps": [{"text": "Look.", **one} for one in given]}).steps


def test_a_step_keeps_what_the_one_before_it_states() -> None:
    found = steps({"camera": "front", "cut": PLANE}, {}, {"cut": None}, {"link": "view=1"}, {}, {"camera": "left"})
    assert [set(one) - {"text"} for one in found] == [
        {"camera", "cut"}, {"camera", "cut"}, {"camera"}, {"link"}, {"link"}, {"camera"}
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ({"text": None}, ("no text", "expected words")),
        ({"text": " "}, ("text ' '", "expected words")),
        ({"text": 5}, ("text 5",)),
        ({"text": "a" * (LONG + 1)}, (f"at most {LONG}", "try two steps")),
        ({"titel": "x"}, ("unknown key 'titel'", ", ".join(KEYS))),
        ({"camera": "above"}, ("camera: got 'above'", "front, back")),
        ({"camera": {"pitch": math.nan}}, ("camera.pitch", "got nan", "finite")),
        ({"camera": {"pitch": 91}}, ("camera.pitch: 91", "-90 to 90")),
        ({"camera": {"distance": 0}}, ("camera.distance: 0", "or more")),
        ({"camera": {"target": [0, 0]}}, ("camera.target", "3 numbers")),
        ({"camera": {"eye": [0, 0, 0]}}, ("unknown key 'eye'", "target, pitch")),
        ({"camera": 4}, ("camera: got 4", "an object")),
        ({"cut": {"kind": "plane"}}, ("cut: no normal",)),
        ({"cut": PLANE | {"at": 1.5}}, ("cut.at: 1.5, outside the volume", "0 to 1")),
        ({"cut": PLANE | {"normal": [0, 0, 0]}}, ("cut.normal: is 0",)),
        ({"cut": {"kind": "box", "box": [0, 1, 0, 2, 0, 1]}}, ("cut.box: 2, outside the volume",)),
        ({"cut": {"kind": "box", "box": [0, 1, 1, 0, 0, 1]}}, ("from below to",)),
        ({"cut": {"kind": "sphere"}}, ("cut.kind: got 'sphere'", "none, plane, box")),
        ({"function": {"points": POINTS[:1]}}, ("points as in the tf.json",)),
        ({"function": {"points": [POINTS[0], {"x": math.inf, "opacity": 1, "rgb": [1, 1, 1]}]}}, ("x: got inf",)),
        ({"function": {"points": [POINTS[0], {"x": 1}]}}, ("x, opacity and rgb",)),
        ({"function": {"points": POINTS, "range": [0, 1]}}, ("unknown key 'range'",)),
        ({"labels": []}, ("a list of labels",)),
        ({"labels": [{"opacity": 0}]}, ("a name or a number",)),
        ({"labels": [{"name": "liver", "opacity": 2}]}, ("labels.opacity: 2", "0 to 1")),
        ({"light": {"kind": "sun"}}, ("light.kind: got 'sun'", "headlight")),
        ({"light": {"ambient": True}}, ("light.ambient: got True",)),
        ({"slices": {"window": -1}}, ("slices.window: -1",)),
        ({"slices": {"on_cut": 1}}, ("slices.on_cut: got 1", "true or false")),
        ({"frame": 1.5}, ("frame: got 1.5", "whole number")),
        ({"link": "https://example.org"}, ("link", "follows #")),
        ({"link": "view=1", "cut": PLANE}, ("link and cut",)),
    ],
)
def test_an_error_is_one_line_that_says_where_and_what(step: dict[str, Any], said: tuple[str, ...]) -> None:
    with pytest.raises(DataError) as error:
        steps({}, step)
    line = str(error.value)
    assert line.startswith("story, step 2: ")
    assert "\n" not in line
    for words in said:
        assert words in line, line


@pytest.mark.parametrize(
    ("step", "layers", "said"),
    [
        ({"cut": PLANE}, (), ("'cut' needs a page with values", "text, camera, frame, link")),
        ({"cut": PLANE}, (VALUES, None), ("'cut' needs a page with values",)),
        ({"frame": 1}, (VALUES,), ("frame 1", "0 to 0")),
        ({"function": "ct-bones"}, (VALUES,), ("function 'ct-bones'", "did you mean ct-bone")),
        ({"function": "ct-bone"}, (LABELS,), ("expected labels",)),
        ({"function": {"points": POINTS, "opacity_unit_distance": 2}}, (VALUES,), ("opacity per 2", "per 0.5")),
        ({"labels": [{"name": "heart"}]}, (LABELS,), ("no label 'heart'", "liver, spleen")),
        ({"labels": [{"name": "Liver"}]}, (LABELS,), ("no label 'Liver'; did you mean liver?",)),
        ({"labels": [{"number": 2}]}, (LABELS,), ("no label 2", "1, 7")),
        ({"labels": [{"number": 1}]}, (VALUES,), ("expected function",)),
        ({"layer": 1, "function": "ct-bone"}, (VALUES,), ("layer 1", "0 to 0")),
        ({"slices": {"at": [8.9, 0, 0]}}, (VALUES,), ("slices.at", "outside the volume")),
    ],
)
def test_what_the_page_does_not_have_is_refused(step: dict[str, Any], layers: Any, said: tuple[str, ...]) -> None:
    story = read_story({"steps": [{"text": "Look.", **step}]})
    with pytest.raises(DataError) as error:
        story.checked(layers)
    for words in said:
        assert words in str(error.value), error.value


def test_labels_get_their_numbers_and_places_within_the_volume_stay() -> None:
    story = read_story({"steps": [{"text": "a", "labels": [{"name": "spleen", "opacity": 0.5}]}]})
    assert story.checked((LABELS,)).steps[0]["labels"] == [{"number": 7, "opacity": 0.5}]
    read_story({"steps": [{"text": "a", "slices": {"at": [9, 0, 7]}, "function": "ct-bone"}]}).checked((VALUES,))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "not JSON"),
        ('{"steps": []}', f"1 to {MOST} steps"),
        ('[{"text": "a"}]', "an object with steps"),
        ('{"steps": [{"text": "a", "frame": NaN}]}', "step 1: frame: got nan"),
        ('{"steps": [3]}', "step 1: got 3"),
    ],
)
def test_a_file_that_is_no_story_is_named(tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "story.json").write_text(content)
    with pytest.raises(DataError, match=rf"^\S*/story\.json.*{said}"):
        read_story(tmp_path / "story.json")
    with pytest.raises(DataError, match="No such file"):
        read_story(tmp_path / "none.json")


def scene(page: Path) -> dict[str, Any]:
    found = re.search(r'id="scene">(.*?)</script>', page.read_text("utf-8"), re.S)
    assert found
    return dict(json.loads(found[1]))


def test_pages_hold_it_and_other_files_refuse_it(vvgt: Any, tmp_path: Path) -> None:
    """By every way that makes pages; errors come before the conversion, and what leaves with a page is said."""
    x, y, z = np.mgrid[-1:1:12j, -1:1:12j, -1:1:12j]
    for k in (1, 2):
        np.save(tmp_path / f"v_{k}.npy", np.exp(-k * (x**2 + y**2 + z**2)).astype(np.float32))
    story, page, volume = tmp_path / "story.json", tmp_path / "a.html", tmp_path / "v_1.npy"
    told = [{"text": "</script> first", "function": "ct-bone"}, {"text": "second", "cut": PLANE}]
    story.write_text(json.dumps({"steps": told}))
    done = vvgt("convert", volume, "--story", story, "-o", page, *HOW)
    assert "a story of 2 steps" in done.err
    held = scene(page)
    assert held["story"] == [told[0], told[0] | told[1]]
    assert "ct-bone" in [one["name"] for one in held["look"]["layers"][0]["presets"]]
    sharing = json.loads(vvgt.ok("info", page, "--sharing", "--json").out)
    assert sharing["story"] == ["</script> first", "second"]
    assert "--story with a file that is no page" in vvgt.fails(2, "convert", volume, "--story", story, "-o", "a.ply")
    assert "--story is for a page" in vvgt.fails(2, "view", volume, "--story", story, "-o", tmp_path / "a.spz")
    assert "--story is for a page" in vvgt.fails(2, "view", volume, "--story", story)
    bare = vvgt.fails(1, "convert", volume, "--story", story, "--no-values", "-o", tmp_path / "b.html", *HOW)
    assert "step 1: 'function' needs a page with values" in bare
    assert not (tmp_path / "b.html").exists()
    story.write_text(json.dumps({"steps": [{"text": "first"}, {"text": "second", "frame": 1}]}))
    vvgt.ok("convert", tmp_path / "v_*.npy", "--story", story, "-o", tmp_path / "c.html", *HOW)
    assert scene(tmp_path / "c.html")["story"][1]["frame"] == 1
    assert "expected 0 to 0" in vvgt.fails(1, "convert", volume, "--story", story, "-o", tmp_path / "b.html", *HOW)
    for k in (1, 2):
        vvgt.ok("convert", tmp_path / f"v_{k}.npy", "-o", tmp_path / f"v_{k}.ply", *HOW)
    vvgt.ok("view", tmp_path / "v_1.ply", tmp_path / "v_2.ply", "--story", story, "-o", tmp_path / "d.html")
    assert len(scene(tmp_path / "d.html")["story"]) == 2
    story.write_text(json.dumps({"steps": [{"text": "first"}]}))
    vvgt.ok("view", tmp_path / "v_1.ply", "--story", story, "-o", tmp_path / "e.html")
    assert scene(tmp_path / "e.html")["story"] == [{"text": "first"}]


def test_python_takes_it_too(tmp_path: Path) -> None:
    import vvgt_cli

    x, y, z = np.mgrid[-1:1:10j, -1:1:10j, -1:1:10j]
    result = vvgt_cli.convert(np.exp(-(x**2 + y**2 + z**2)), max_gaussians=40, screen=32, steps=0)
    result.save(tmp_path / "a.html", story={"steps": [{"text": "first", "cut": PLANE}]})
    assert scene(tmp_path / "a.html")["story"] == [{"text": "first", "cut": PLANE}]
    with pytest.raises(DataError, match="needs a page with values"):
        result.save(tmp_path / "b.html", values=False, story={"steps": [{"text": "first", "cut": PLANE}]})
    with pytest.raises(vvgt_cli.UsageError, match="only pages show stories"):
        result.save(tmp_path / "b.ply", story={"steps": [{"text": "first"}]})
