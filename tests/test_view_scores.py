"""`vvgt view` of volumes while what is shown is scored: what the page and the console hear."""

import os
import signal
from urllib.parse import urlsplit

import pytest

from tests.test_formats_server import ask
from tests.test_view_volume import AT_ONCE, FUNCTION, controller, send, state_of, until  # noqa: F401
from vvgt_cli.commands.converter import Converted, Converter, Failed, Message, Progress, Scored
from vvgt_cli.commands.live_site import PageController, parse_function
from vvgt_cli.commands.server import Site
from vvgt_cli.errors import DataError
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.progress import Console

DONE = {"number": 1, "state": "done", "said": "converted", "file": "1.ply", "scored": False}


def test_a_page_shows_what_is_converted_before_its_scores(controller: tuple[str, PageController]) -> None:  # noqa: F811
    url, of = controller
    send(url, "function", FUNCTION)
    of.on_message(1, Progress("refining 33 %"))
    assert state_of(url) == {"number": 1, "state": "working", "said": "refining 33 %"}
    of.on_message(1, Converted(b"unscored", {"ply": b"shown"}))
    of.on_message(1, Progress("test views 33 %"))
    assert state_of(url) == DONE
    assert ask(url, urlsplit(url).path + "1.ply")[1] == b"shown"
    of.on_message(1, Scored(b"certified", 41.23))
    assert state_of(url) == {**DONE, "said": "converted, 41.2 dB", "scored": True}
    assert ask(url, urlsplit(url).path + "1.ply")[1] == b"shown"
    assert of.better == b"certified"


def test_what_is_converted_stays_without_scores(
    controller: tuple[str, PageController],  # noqa: F811
    capsys: pytest.CaptureFixture[str],
) -> None:
    url, of = controller
    of.console = Console()
    send(url, "function", FUNCTION)
    of.on_message(1, Converted(b"unscored", {"ply": b"shown"}))
    of.on_message(1, Failed(DataError("no memory")))
    assert state_of(url) == {**DONE, "said": "converted, not scored: no memory", "scored": True}
    assert of.better == b"unscored"
    assert "not scored: no memory" in capsys.readouterr().err


def test_the_console_hears_that_a_first_conversion_is_not_scored(capsys: pytest.CaptureFixture[str]) -> None:
    site = Site({}, print)
    of = PageController(site.resources, site.posts, "x", Console())
    of.on_message(1, Converted(b"unscored", {"": b"page"}))
    of.on_message(1, Failed(DataError("no memory")))
    assert of.error is None
    assert of.state["state"] == "none"  # a page that waits loads what there is
    assert "not scored: no memory" in capsys.readouterr().err


def test_the_end_of_a_scoring_process_is_reported(small_screen: None) -> None:
    messages: list[Message] = []

    def hear(number: int, message: Message) -> None:
        messages.append(message)
        if isinstance(message, Converted):
            assert converter.process is not None
            os.kill(converter.process, signal.SIGKILL)

    with Converter(SourceRequest("example:blob:12", tf="viridis"), "x", hear) as converter:
        converter.submit((parse_function(FUNCTION), None))
        until(lambda: any(isinstance(one, Converted | Failed) for one in messages))
        until(lambda: isinstance(messages[-1], Failed), AT_ONCE)
        assert any(isinstance(one, Converted) for one in messages)
        assert not any(isinstance(one, Scored) for one in messages)
