"""What `vvgt view` converts before a page is there: volumes that have no live form."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vvgt_cli.commands.converter import ConsoleLine, Converted, Message, Scored
from vvgt_cli.conversion.live import live_refusal
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.progress import Console
from vvgt_cli.volume import Volume


def test_what_is_never_live_is_converted(monkeypatch: pytest.MonkeyPatch) -> None:
    from vvgt_cli.commands import converter_process

    labels = Volume(np.arange(8, dtype=np.uint8).reshape(2, 2, 2), name="labels")
    request = SourceRequest(labels, tf="viridis", light=LightOptions(lights=("0,0,1",), shadows=True))
    why = live_refusal(ConvertRequest(request, live=True), load(request))
    assert why is not None
    for other in (SourceRequest(labels, tf="viridis"), SourceRequest(labels, labels="auto")):
        assert live_refusal(ConvertRequest(other, live=True), load(other)) is None
    asked = []

    def conversion(request: ConvertRequest, console: Console, start: Any, unscored: Any) -> Any:
        asked.append(request.live)
        unscored("conversion")
        return SimpleNamespace(scores={"psnr": 40.0})

    monkeypatch.setattr(converter_process, "convert", conversion)
    monkeypatch.setattr(converter_process, "_file", lambda found: b"scored")
    monkeypatch.setattr(converter_process.LoadedVolume, "_with_page", lambda volume, found: Converted(b"", {}))
    messages: list[Message] = []
    volume = converter_process.LoadedVolume.__new__(converter_process.LoadedVolume)
    volume.source, volume.last = request, None
    volume.send_live(converter_process.MessageConsole(messages.append))
    assert [one for one in messages if isinstance(one, Converted | Scored)] == [
        Converted(b"", {}),
        Scored(b"scored", 40.0),
    ]
    assert asked == [False]
    assert ConsoleLine(f"converted without a live form: {why}") in messages
