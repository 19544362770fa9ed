"""A file's record of its own error: the source volume and how closely it was matched."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

WORD = "certificate"  # keyword of the comment


@dataclass(frozen=True)
class Certificate:
    """Measurements made during a conversion, valid only for the Gaussians of that file.

    Attributes:
        volume: title of the volume, which names no file unless it was chosen.
        sha256: hexadecimal digest of its values; None for a volume too large to be read twice.
        look: digest of functions, label tables, unit distances and light.
        size: edge of the target screen in pixels.
        rule: name of the rule of `vvgt_cli.gaussians.rules` that the scores used.
        psnr: mean PSNR in dB of the first scored views against the volume.
        views: number of these views.
        pixels: number of pixels that were scored of each.
        live_psnr: PSNR in dB of a live file recoloured with its own function; None for other files.
        conditions: name and PSNR in dB of each viewing condition that was scored, worst first.
        texture: texture of smooth areas close up, of the Gaussians and of the volume, in levels of 255; None if
            nothing is opaque and smooth.
        position_error: largest distance of a stored centre from the computed one, in world units.
        command: the command line without folders, outputs, names of volumes and options that do not affect the
            result; None from Python.
    """

    volume: str
    sha256: str | None
    look: str
    size: int
    rule: str
    psnr: float
    views: int
    pixels: int
    live_psnr: float | None = None
    conditions: tuple[tuple[str, float], ...] = ()
    texture: tuple[float, float] | None = None
    position_error: float = 0.0
    command: str | None = None

    def facts(self) -> dict[str, Any]:
        """Return the known values by name."""
        found = vars(self) | {"conditions": dict(self.conditions)}
        return {key: value for key, value in found.items() if value not in (None, {})}

    def line(self) -> str:
        """Return the header comment, one line of ASCII without the word "comment"."""
        return f"vvgt {WORD} {json.dumps(self.facts())}"

    @classmethod
    def of(cls, text: str) -> Certificate:
        """Parse the JSON that `line` writes after its keyword.

        Raises:
            ValueError: the text is something else.
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
            "pixels": int, "live_psnr": float, "position_error": float, "command": str,
        }  # fmt: skip
        if not {"volume", "look", "size", "rule", "psnr", "views", "pixels"} <= set(found) <= set(kinds):
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
