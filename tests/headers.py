"""Files of Gaussians without the line of their header that says how they were made."""

import re
from pathlib import Path


def uncertified(file: Path | str | bytes) -> bytes:
    """The bytes of a `.ply` without its certificate, whose command depends on how the same was asked for."""
    content = file if isinstance(file, bytes) else Path(file).read_bytes()
    assert content.count(b"comment vvgt certificate ") <= 1
    return re.sub(rb"comment vvgt certificate [^\n]*\n", b"", content)
