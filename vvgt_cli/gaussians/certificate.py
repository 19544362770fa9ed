"""What a file says of its own error: the volume it was made of, how near it is to that, and how long it took."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from typing import Any

WORD = "certificate"  # of the comment
REPRODUCIBLE = "SOURCE_DATE_EPOCH"  # set: files that can be made again, byte by byte (reproducible-builds.org)
_LAST = 253_402_300_799  # second of the year 9999


def epoch() -> int | None:
    """Seconds since 1970 at which files are to say they were made; None where nothing, or no such number, is given."""
    text = os.environ.get(REPRODUCIBLE, "")
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 16 and int(text) <= _LAST else None


@dataclass(frozen=True)
class Certificate:
    """What was measured when Gaussians were made; it holds for these Gaussians alone.

    Attributes:
        volume: the volume's name, without its folder.
        sha256: digest of its values, hexadecimal; None of a volume too large to read once more.
        look: digest of functions, label tables, opacity distances and light.
        size, rule: pixels of the screen, and name of the rule of `vvgt_cli.gaussians.rules`, that they are scored by.
        psnr: dB, mean of the first scored views against the volume.
        views: number of these views.
        live_psnr: dB of a live file as `vvgt recolor` shows it under its own function; None of others.
        conditions: name of a viewing condition and dB of each that was scored, worst first.
        texture: on smooth areas from near, of the Gaussians and of the volume, levels of 255; None where nothing is
            opaque and smooth.
        position_error: greatest distance of a centre in the file from where it was computed, in units of the world.
        seconds: wall time until the scores; None where `SOURCE_DATE_EPOCH` asks for files that can be made again.
        command: as it was given, without folders, outputs and what changes nothing; None from Python.
    """

    volume: str
    sha256: str | None
    look: str
    size: int
    rule: str
    psnr: float
    views: int
    live_psnr: float | None = None
    conditions: tuple[tuple[str, float], ...] = ()
    texture: tuple[float, float] | None = None
    position_error: float = 0.0
    seconds: float | None = None
    command: str | None = None

    def facts(self) -> dict[str, Any]:
        """By name, without what is not known."""
        found = vars(self) | {"conditions": dict(self.conditions)}
        return {key: value for key, value in found.items() if value not in (None, {})}

    def line(self) -> str:
        """The comment, without the word before it: ASCII on one line."""
        return f"vvgt {WORD} {json.dumps(self.facts())}"

    @classmethod
    def of(cls, text: str) -> Certificate:
        """What `line` wrote behind its word.

        Raises:
            ValueError: anything else.
        """
        found = json.loads(text)
        if not isinstance(found, dict) or not isinstance(found.get("conditions", {}), dict):
            raise ValueError(text)
        conditions = tuple((str(name), _number(value)) for name, value in found.pop("conditions", {}).items())
        woven = found.pop("texture", None)
        if woven is not None and (not isinstance(woven, list) or len(woven) != 2):
            raise ValueError(text)
        texture = None if woven is None else (_number(woven[0]), _number(woven[1]))
        kinds = {
            "volume": str, "sha256": str, "look": str, "size": int, "rule": str, "psnr": float, "views": int,
            "live_psnr": float, "position_error": float, "seconds": float, "command": str,
        }  # fmt: skip
        if not {"volume", "look", "size", "rule", "psnr", "views"} <= set(found) <= set(kinds):
            raise ValueError(text)
        known: dict[str, Any] = {"sha256": None, "texture": texture}
        for key, value in found.items():
            kind = kinds[key]
            found[key] = _number(value) if kind is float else value
            if not isinstance(found[key], kind) or isinstance(value, bool):
                raise ValueError(text)
        return cls(**(known | found), conditions=conditions)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(value)
    return float(value)
