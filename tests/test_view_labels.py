"""Labels of `vvgt view`: read as the page sends them, and converted so."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vvgt_cli.commands.converter import Converted, Message, Scored
from vvgt_cli.commands.converter_process import LoadedVolume, MessageConsole
from vvgt_cli.commands.live_site import cloud_of, parse_labels
from vvgt_cli.errors import VvgtError
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.look.labels import distinct
from vvgt_cli.look.lighting import LightOptions

Z, Y, X = np.mgrid[:12, :12, :12] // 6
CUBES = (1 + X + 2 * Y + 4 * Z).astype(np.uint8)


def rows(shown: dict[int, float]) -> list[dict[str, Any]]:
    return [{"number": n, "color": [n / 8, 0, 1], "opacity": shown.get(n, 0.0)} for n in range(1, 9)]


def test_labels_of_another_volume_are_refused() -> None:
    known = distinct(range(1, 9)).labels
    assert [one.opacity for one in parse_labels(rows({2: 0.9}), known).labels] == [0, 0.9, 0, 0, 0, 0, 0, 0]
    for damaged in ([], rows({})[:7], [{"number": 1}], "x", [1], [{**rows({})[0], "opacity": 2}] * 8):
        with pytest.raises(VvgtError, match="label"):
            parse_labels(damaged, known)


def test_a_volume_is_converted_for_the_labels_of_the_page(tmp_path: Path, small_screen: None) -> None:
    np.save(tmp_path / "eight.npy", CUBES)
    source = SourceRequest(str(tmp_path / "eight.npy"), labels="auto", light=LightOptions(("none",)))
    told: list[Message] = []
    console = MessageConsole(told.append)
    volume = LoadedVolume(source, "eight", console)
    volume.send_page(console)
    known = distinct(range(1, 9)).labels
    named = [replace(label, name=f"cube {label.number}") for label in known]
    volume.convert((parse_labels(rows({2: 1.0}), named), None), console)
    _, made, scored = [one for one in told if isinstance(one, Converted | Scored)]
    assert isinstance(made, Converted)
    gaussians, layout = cloud_of(made.ply)
    assert (gaussians.means[:, 0] > -0.2).all()  # one of the eight, to the right
    assert isinstance(scored, Scored)
    assert layout.certificate is None
    assert cloud_of(scored.ply)[1].certificate is not None
    assert json.loads(layout.legend or "") == {"labels": [["cube 2", "4000ff"]], "of": 1}
    np.testing.assert_allclose(np.median(gaussians.colors, axis=0), (0.25, 0, 1), atol=0.05)
