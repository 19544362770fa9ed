"""What the package refuses: an exception of ours, in one line."""

from collections.abc import Callable
from typing import Any

import pytest

from vvgt_cli.errors import VvgtError


def refused(error: type[VvgtError], match: str, function: Callable[..., Any], *args: Any, **options: Any) -> str:
    """Require that a call raises an error whose message, one line, holds a pattern; return the message."""
    with pytest.raises(error, match=match) as caught:
        function(*args, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)
