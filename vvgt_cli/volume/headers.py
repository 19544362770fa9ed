"""Text headers: ``key: value`` and ``key = value`` lines, numbers checked as they are taken."""

from __future__ import annotations

import math
from collections.abc import Sequence

from vvgt_cli.errors import DataError

MAX_HEADER = 1 << 20
MARK = b"\xef\xbb\xbf"  # byte order mark that programs of Windows put before text


class Fields(dict[str, str]):
    """The fields of a header, keys in lower case; ``name`` is the file, for messages."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name

    def need(self, *keys: str) -> str:
        """The first of these fields that is there.

        Raises:
            DataError: none is.
        """
        for key in keys:
            if self.get(key):
                return self[key]
        raise DataError(f"{self.name}: its header has no field {keys[0]!r}; check that the file is whole")

    def floats(self, key: str, text: str, n: int) -> list[float]:
        """Return the first ``n`` numbers of a field.

        White space separates them, a comma before it may; commas alone separate exactly ``n``. Any other comma is a
        decimal comma, which must not pass for two numbers.

        Raises:
            DataError: not numbers, not finite, too few, or decimal commas.
        """
        words = text.split()
        alone = len(words) == 1
        try:
            values = [float(w) for w in (text.split(",") if alone else [word.removesuffix(",") for word in words])]
        except ValueError:
            values = []
        if len(values) < n or (alone and len(values) != n) or not all(math.isfinite(v) for v in values):
            comma = " with decimal points" if "," in text else ""
            raise DataError(f"{self.name}: {key} is {text.strip()!r}; expected {n} finite numbers{comma}")
        return values[:n]

    def sizes(self, key: str, text: str) -> list[int]:
        """Positive whole numbers of a field.

        Raises:
            DataError: anything else.
        """
        try:
            values = [int(t) for t in text.split()]
        except ValueError:
            values = []
        if not values or min(values) < 1:
            raise DataError(f"{self.name}: {key} is {text.strip()!r}; expected whole numbers of at least 1")
        return values

    def integer(self, key: str, default: int) -> int:
        """A whole number, or the default if the field is missing."""
        text = self.get(key)
        if text is None:
            return default
        try:
            return int(text)
        except ValueError:
            raise DataError(f"{self.name}: {key} is {text!r}; expected a whole number") from None


def printable(text: str) -> str:
    """``text`` as a message can hold it: what cannot be printed (a line break, say) is a question mark."""
    return "".join(c if c.isprintable() else "?" for c in text)


def unit_rows(vectors: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Lengths of three axis vectors, and the row-major direction matrix whose columns are their unit vectors."""
    lengths = tuple(math.hypot(*v) for v in vectors)
    unit = [
        [c / n if n > 0 else float(i == k) for k, c in enumerate(v)]
        for i, (v, n) in enumerate(zip(vectors, lengths, strict=True))
    ]
    return lengths, tuple(unit[column][row] for row in range(3) for column in range(3))
