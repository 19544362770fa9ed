"""Parsing of JSON, XML and lines with checked access to their fields: every error names file and field."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.files import seekable

MAX_BYTES = 16 * 2**20


@dataclass(frozen=True)
class Elements:
    """Elements of an XML file in the order of their start tags: names in lower case, attributes."""

    root: str
    items: list[tuple[str, dict[str, str]]]


@dataclass(frozen=True)
class Lines:
    """Lines of a text file, stripped, without blank ones."""

    items: list[str]


def load(path: Path) -> Any:
    """Parse a UTF-8 file of at most 16 MiB: `Elements` if it starts as XML, `Lines` if with numbers, or JSON.

    Raises:
        DataError: too large, not readable, not UTF-8, or none of the three.
    """
    text = text_of(path)
    if text.lstrip()[:1] == "<":
        return _elements(text, path)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if len(lines) > 1 and re.fullmatch(r"[-+.\d\s]+", lines[0]):
        return Lines(lines)
    return json_of(text, path)


def _elements(text: str, path: Path) -> Elements:
    items: list[tuple[str, dict[str, str]]] = []
    parser = expat.ParserCreate("utf-8")  # whatever the text calls itself

    def refuse(*_: Any) -> None:
        raise DataError(f"{path}: XML that declares entities; expected a transfer function without them")

    parser.StartElementHandler = lambda tag, attributes: items.append((tag.lower(), attributes))
    parser.EntityDeclHandler = refuse
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        raise DataError(f"{path}: damaged XML ({error}); expected a transfer function") from error
    return Elements(items[0][0], items)


def text_of(path: Path, what: str = "a transfer function") -> str:
    """Return the text of a UTF-8 file of at most 16 MiB, else raise DataError; ``what`` is expected there."""
    try:
        kept = seekable(path)
        size = kept.stat().st_size
        if size > MAX_BYTES:
            raise DataError(f"{path}: {size} bytes; expected {what} of at most 16 MiB")
        with kept.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from error
    if len(raw) > MAX_BYTES:
        raise DataError(f"{path}: more than 16 MiB; expected {what}")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not text (byte {error.start} is not UTF-8); expected {what}") from error


def json_of(text: str, path: Path, what: str = "a ParaView preset or a minimal transfer function") -> Any:
    """Return the content of a JSON text, else raise DataError; ``what`` is expected there."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = sorted(key for key, _ in pairs)
        for key in (a for a, b in pairwise(keys) if a == b):
            raise DataError(f"{path}: {key[:40]!r} twice in one object; expected {what}, each key once")
        return dict(pairs)

    try:
        return json.loads(text, object_pairs_hook=once)
    except json.JSONDecodeError as error:
        raise DataError(
            f"{path}: not JSON (line {error.lineno}, column {error.colno}: {error.msg}); expected {what}"
        ) from error
    except (RecursionError, ValueError) as error:  # nested too deep; an integer of thousands of digits
        raise DataError(f"{path}: JSON that is too deep, or with too long a number; expected {what}") from error


def number(what: str, value: Any) -> float:
    """Return a finite float, or raise DataError."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DataError(f"{what}: {_shown(value)}; expected a number")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise DataError(f"{what}: {_shown(value)}; expected a finite number")
    return result


def floats(what: str, text: str) -> list[float]:
    """Return the finite numbers of a text, separated by white space, or raise DataError."""
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if not values or not all(map(math.isfinite, values)):
        raise DataError(f"{what}: {_shown(text)}; expected finite numbers")
    return values


def attribute(what: str, attributes: dict[str, str], key: str) -> float:
    """Return the number in an XML attribute, or raise DataError."""
    values = floats(f"{what} {key}", attributes.get(key, ""))
    if len(values) != 1:
        raise DataError(f"{what} {key}: {_shown(attributes[key])}; expected one number")
    return values[0]


def table(what: str, value: Any, width: int, columns: str) -> np.ndarray:
    """Return a flat list of finite numbers as rows of ``width``, (n, width) float64, n >= 1, or raise DataError."""
    if not isinstance(value, list) or not value or len(value) % width:
        given = f"a list of {len(value)}" if isinstance(value, list) else _shown(value)
        raise DataError(f"{what}: {given}; expected a flat list of {columns}, {width} numbers a node")
    return np.array([number(f"{what}[{i}]", v) for i, v in enumerate(value)]).reshape(-1, width)


def rgb(what: str, value: Any) -> tuple[float, float, float]:
    """Return three numbers in [0, 1], or raise DataError."""
    if not isinstance(value, list) or len(value) != 3:
        raise DataError(f"{what}: {_shown(value)}; expected three numbers in [0, 1]")
    red, green, blue = (number(what, v) for v in value)
    if not (0 <= red <= 1 and 0 <= green <= 1 and 0 <= blue <= 1):
        raise DataError(f"{what}: {_shown(value)}; expected three numbers in [0, 1]")
    return red, green, blue


def _shown(value: Any) -> str:
    text = repr(value) if not isinstance(value, (list, dict)) else json.dumps(value, default=str)
    return text if len(text) <= 40 else text[:37] + "..."
