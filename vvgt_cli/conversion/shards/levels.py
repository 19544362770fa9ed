"""Levels of detail: cuts of one pyramid for ever smaller budgets, a `.ply` each, and an index of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.outputs import STDOUT, Output, write_text
from vvgt_cli.score.record import plain

PART = 4  # of the Gaussians of a level that the next one has: half as many along each way of a surface


def level_name(output: str, level: int) -> str:
    """Of the file of a level: OUT.ply, OUT-1.ply, ..."""
    path = Path(output)
    return output if not level else str(path.with_name(f"{path.stem}-{level}{path.suffix}"))


def index_name(output: str) -> str:
    """Of the index: OUT-levels.json."""
    path = Path(output)
    return str(path.with_name(f"{path.stem}-levels.json"))


def level_outputs(output: str | None, levels: int) -> list[Output]:
    """What is written beside the finest level.

    Raises:
        UsageError: levels on standard output.
    """
    if levels == 1:
        return []
    if output is None or output == STDOUT:
        raise UsageError("--levels: several files; expected -o OUT.ply, beside which they are written")
    files = [Output("--levels", level_name(output, level), (".ply",)) for level in range(1, levels)]
    return [*files, Output("--levels", index_name(output), (".json",), binary=False)]


def write_index(output: str, size: int, written: list[dict[str, Any]], overwrite: bool) -> None:
    """Write the index: the screen, and of each level, finest first, file, Gaussians, bytes and PSNR."""
    found = {"format": "vvgt-levels", "schema": 1, "size": size, "levels": written}
    write_text(index_name(output), json.dumps(plain(found), indent=1) + "\n", overwrite)
