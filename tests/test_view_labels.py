# ruff: noqa: F811
"""Labels of `vvgt view`: saved as the page shows them, and converted so."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.test_view_volume import controller, send  # noqa: F401
from vvgt_cli.commands.converter import Converted, Message, Scored
from vvgt_cli.commands.converter_process import LoadedVolume, MessageConsole
from vvgt_cli.commands.live_site import PageController, ServedCloud, parse_labels
from vvgt_cli.commands.main import run
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.gaussians.formats.page_file import read_html
from vvgt_cli.gaussians.live_facts import LABEL_ROW
from vvgt_cli.look.labels import distinct
from vvgt_cli.look.lighting import LightOptions

Z, Y, X = np.mgrid[:12, :12, :12] // 6
CUBES = (1 + X + 2 * Y + 4 * Z).astype(np.uint8)


@pytest.fixture(scope="module")
def eight(tmp_path_factory: pytest.TempPathFactory) -> ServedCloud:
    """Eight cubes, each a label, live."""
    path = tmp_path_factory.mktemp("eight") / "eight.npy"
    np.save(path, CUBES)
    how = ["--labels", "auto", "--light", "none", "--live", "--max-gaussians", "200", "--size", "100", "--quiet"]
    assert run(["convert", str(path), *how, "-o", str(path.with_suffix(".ply"))]) == 0
    return ServedCloud.of(path.with_suffix(".ply").read_bytes(), "eight")


def rows(shown: dict[int, float]) -> list[dict[str, Any]]:
    return [{"number": n, "color": [n / 8, 0, 1], "opacity": shown.get(n, 0.0)} for n in range(1, 9)]


def test_saved_labels_have_the_colours_of_the_page(controller: tuple[str, PageController], eight: ServedCloud) -> None:
    url, of = controller
    of.first = lambda: eight
    assert eight.options.live is not None
    saved = ServedCloud.of(send(url, "save", {"file": "ply", "labels": rows({2: 0.9, 7: 0.5})})[1], "x")
    labels = saved.options.live.labels
    assert [label.opacity for label in labels] == [0, 0.9, 0, 0, 0, 0, 0.5, 0]
    assert [label.name for label in labels] == [label.name for label in eight.options.live.labels]
    live = saved.gaussians.live
    row = live[:, LABEL_ROW].astype(int)
    assert set(row) == set(range(8))  # hidden ones can be shown again
    assert saved.gaussians.opacity_logits[row == 0].max() < -5
    assert saved.gaussians.opacity_logits[row == 1].max() > -3
    np.testing.assert_allclose(saved.gaussians.colors[row == 6], np.tile((7 / 8, 0, 1), (sum(row == 6), 1)), atol=1e-2)
    assert read_html(send(url, "save", {"file": "html", "labels": rows({2: 0.9})})[1], "x").means.shape[1] == 3
    assert send(url, "function", {"labels": rows({3: 1})})[0] == 200
    for damaged in ([], rows({})[:7], rows({}), [{"number": 1}], "x", [1], [{**rows({})[0], "opacity": 2}] * 8):
        status, text = send(url, "save", {"file": "ply", "labels": damaged})
        assert status == 400, damaged
        assert b"label" in text


def test_a_volume_is_converted_for_the_labels_of_the_page(tmp_path: Path) -> None:
    np.save(tmp_path / "eight.npy", CUBES)
    source = SourceRequest(str(tmp_path / "eight.npy"), labels="auto", light=LightOptions(("none",)))
    told: list[Message] = []
    console = MessageConsole(told.append)
    volume = LoadedVolume(source, "eight", console)
    volume.send_live(console)
    known = distinct(range(1, 9)).labels
    named = [replace(label, name=f"cube {label.number}") for label in known]
    volume.convert((parse_labels(rows({2: 1.0}), named), None), console)
    _, made, scored = [one for one in told if isinstance(one, Converted | Scored)]
    assert isinstance(made, Converted)
    gaussians = ServedCloud.of(made.ply, "x").gaussians
    assert (gaussians.means[:, 0] > -0.2).all()  # one of the eight, to the right
    assert isinstance(scored, Scored)
    assert ServedCloud.of(made.ply, "x").options.certificate is None
    assert ServedCloud.of(scored.ply, "x").options.certificate is not None
    assert json.loads(ServedCloud.of(made.ply, "x").options.legend or "") == {"labels": [["cube 2", "4000ff"]], "of": 1}
    np.testing.assert_allclose(np.median(gaussians.colors, axis=0), (0.25, 0, 1), atol=0.05)
