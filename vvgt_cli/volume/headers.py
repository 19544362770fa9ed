"""Text headers: ``key: value`` and ``key = value`` lines, numbers and types checked as they are taken."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError

MAX_HEADER = 1 << 20
MARK = b"\xef\xbb\xbf"  # byte order mark that programs of Windows put before text
DTYPES = (
    *("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"),
    *("float16", "float32", "float64"),
)
_TYPES = {
    "char": "i1", "byte": "u1", "short": "i2", "int": "i4", "longlong": "i8",
    "half": "f2", "float": "f4", "double": "f8",
}  # fmt: skip


class HeaderFields(dict[str, str]):
    """The fields of a header, keys in lower case; ``name`` is the file, for messages."""

    def __init__(self, name: str) -> None:
        """Start without fields."""
        super().__init__()
        self.name = name

    def need(self, *keys: str) -> str:
        """Return the first of these fields that is there, or raise DataError."""
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
        """Return the positive whole numbers of a field, or raise DataError."""
        try:
            values = [int(t) for t in text.split()]
        except ValueError:
            values = []
        if not values or min(values) < 1:
            raise DataError(f"{self.name}: {key} is {text.strip()!r}; expected whole numbers of at least 1")
        return values

    def integer(self, key: str, default: int) -> int:
        """Return a whole number, or the default if the field is missing."""
        text = self.get(key)
        if text is None:
            return default
        try:
            return int(text)
        except ValueError:
            raise DataError(f"{self.name}: {key} is {text!r}; expected a whole number") from None

    def dtype(self, key: str, text: str, aliases: Mapping[str, str] | None = None) -> np.dtype:
        """Return the type of values that a field names, as C or numpy does (see `type_of`), or raise DataError."""
        kind = type_of(text, aliases)
        if kind is None:
            raise DataError(
                f"{self.name}: {key} is {text[:40]!r}; expected a type of numbers such as uchar, short, uint16 or float"
            )
        return kind


def fields_of_sections(path: Path) -> HeaderFields:
    """Return the fields ``section/key`` of a text file, ``block/section/key`` behind a line ``{block}``."""
    fields, block, section = HeaderFields(str(path)), "", ""
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for line in map(str.strip, file.read(MAX_HEADER).splitlines()):
            key, equals, value = line.partition("=")
            block, section = (line.strip("{}") + "/", "") if line.startswith("{") else (block, section)
            section = line.strip("[]").lower() if line.startswith("[") else section
            fields.update({f"{block}{section}/{key.strip().lower()}": value.strip()} if equals else {})
    return fields


def type_of(text: str, aliases: Mapping[str, str] | None = None) -> np.dtype | None:
    """Return the type of numbers that a name such as ``unsigned short int``, ``uchar`` or ``uint16_t`` stands for.

    Words of the name are separated by blanks or underscores, in any case. ``aliases`` are numpy's codes of names that a
    format has for itself, without blanks, in lower case; they come first.

    Returns:
        The type in native byte order; None for an unknown name. A ``char`` is signed, a ``byte`` is not.
    """
    words = text.lower().replace("_", " ").split()
    words = words[:-1] if words[-1:] == ["t"] else words
    unsigned = words[:1] == ["unsigned"]
    word = "".join(words[1:] if words[:1] in (["unsigned"], ["signed"]) else words)
    word = word.removesuffix("int") if word not in ("int", "uint") else word
    codes = {**_TYPES, **(aliases or {})}
    if word.startswith("u") and word[1:] in codes and word not in codes:
        unsigned, word = True, word[1:]
    if word in codes:
        return np.dtype(codes[word].replace("i", "u") if unsigned else codes[word])
    return np.dtype(word) if word in DTYPES and not unsigned else None


def printable(text: str) -> str:
    """Return ``text`` as a message can hold it: what cannot be printed (a line break, say) is a question mark."""
    return "".join(c if c.isprintable() else "?" for c in text)


def text_of(value: Any) -> str:
    """Return an attribute as text, the first of several; none for one of HDF5 that is empty."""
    if getattr(value, "shape", ()) is None:  # h5py.Empty
        return ""
    value = value if isinstance(value, str | bytes) else (np.asarray(value).reshape(-1).tolist() or [""])[0]
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
