"""What `vvgt view` converts before a page is there: volumes whose look cannot be changed."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vvgt_cli.commands.converter import ConsoleLine, Converted, Message, Scored
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.progress import Console
from vvgt_cli.volume import Volume


def test_too_many_labels_are_converted_first(monkeypatch: pytest.MonkeyPatch) -> None:
    from vvgt_cli.commands import converter_process

    labels = Volume(np.arange(512, dtype=np.uint16).reshape(8, 8, 8), name="labels")
    request = SourceRequest(labels, labels="auto")
    asked = []

    def conversion(request: ConvertRequest, console: Console, warm: Any, unscored: Any) -> Any:
        asked.append(request.live)
        unscored("conversion")
        return SimpleNamespace(scores={"psnr": 40.0})

    monkeypatch.setattr(converter_process, "convert_one", conversion)
    monkeypatch.setattr(converter_process, "_file", lambda found: b"scored")
    monkeypatch.setattr(converter_process.LoadedVolume, "_with_page", lambda volume, found: Converted(b"", {}))
    messages: list[Message] = []
    volume = converter_process.LoadedVolume.__new__(converter_process.LoadedVolume)
    volume.source, volume.last = request, None
    volume.send_page(converter_process.MessageConsole(messages.append))
    assert [one for one in messages if isinstance(one, Converted | Scored)] == [
        Converted(b"", {}),
        Scored(b"scored", 40.0),
    ]
    assert asked == [False]
    assert any(isinstance(one, ConsoleLine) and "converted first: its look" in one.line for one in messages)
