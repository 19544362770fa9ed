"""Named functions, ours: ``ct-bone`` and others. ``named.json`` has a list of them, each in the minimal form.

Those for CT are over Hounsfield units, and otherwise over percentiles of the voxels in front of the background.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.readers import minimal

FILE = Path(__file__).with_name("named.json")


@cache
def _entries() -> dict[str, dict[str, Any]]:
    return {entry["function"]["name"]: entry for entry in json.loads(FILE.read_text("utf-8"))}


def names() -> dict[str, str]:
    """What each named function shows, by name."""
    return {name: str(entry["shows"]) for name, entry in _entries().items()}


def named_function(name: str) -> TransferFunction:
    """The function of a name; its opacity is per a share of the box's longest edge.

    Raises:
        KeyError: there is none.
    """
    return minimal.read(_entries()[name]["function"], name)
