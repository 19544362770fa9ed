"""Compressed arrays in VTK XML files: are the sizes that stand before their blocks possible?

VTK allocates what they say, and a process that runs out of memory inside VTK ends. Layout: vtkXMLDataParser::
ReadCompressionHeader: number of blocks, bytes of a block, bytes of the last one (0: as the others), then the packed
bytes of each; in base64 these words are a string of their own.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.blocks import check_memory, size_text

_SLACK = 1 << 24  # a block may be larger than what is in it
_CHUNK = 1 << 16


@dataclass
class _Array:
    """A DataArray: its attributes, and as much of its text as holds the words before the blocks."""

    attributes: dict[str, str]
    text: bytes = b""
    wanted: int = 0  # characters

    def add(self, data: str, word: np.dtype) -> None:
        if len(self.text) < self.wanted:
            self.text = (self.text + data.encode("ascii", "replace")).lstrip()
            head = _decode(self.text[: 4 * word.itemsize], word)
            if len(head) == 3:
                self.wanted = _characters(head, word)


def check_blocks(path: Path, root: dict[str, str], encoding: str, data_start: int, ratio: int) -> None:
    """Raise DataError if an array's block sizes, or number of tuples, ask for more than the file can hold.

    ``encoding`` is that of the appended data (``raw`` or ``base64``) at byte ``data_start`` (-1 without); a byte of the
    file stands for at most ``ratio``.
    """
    order = ">" if root.get("byte_order") == "BigEndian" else "<"
    word = np.dtype(order + ("u8" if root.get("header_type") == "UInt64" else "u4"))
    room = path.stat().st_size * ratio + _SLACK
    for array in _arrays(path, word, bool(root.get("compressor"))):
        name = array.attributes.get("Name", "")
        if int(array.attributes.get("NumberOfTuples", "0")) > room:
            raise DataError(f"{path}: array {name!r} declares more tuples than the file can hold; is the file whole?")
        if not root.get("compressor") or array.attributes.get("format") == "ascii":
            continue
        if array.attributes.get("format") == "appended":
            start = data_start + int(array.attributes.get("offset", "0"))
            words = (
                block_table(path, start, word, encoding == "base64") if 0 <= data_start <= start else np.zeros(0, word)
            )
        else:
            words = _decode(array.text[: array.wanted], word)
        _check(path, name, [int(w) for w in words], room)


def _characters(head: np.ndarray, word: np.dtype) -> int:
    """Count the characters of base64 that hold the words before the blocks, by the first three of them."""
    return 4 * -(-(3 + int(head[0])) * word.itemsize // 3)


def walk_xml(
    path: Path, start: Callable[[str, dict[str, str], int], bool | None], end: Callable[[str], None],
    text: Callable[[str], None] | None = None,
) -> None:  # fmt: skip
    """Call ``start``, ``end`` and ``text`` for the elements of an XML file.

    ``start`` is told the byte at which an element begins; where it returns True, nothing is read from there on.

    Raises:
        DataError: damaged, or it declares entities.
    """
    parser, ended = expat.ParserCreate(), False

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal ended
        ended = ended or bool(start(tag, attributes, parser.CurrentByteIndex))

    def entity(*_: object) -> None:
        raise DataError(f"{path}: its XML declares entities; expected none")

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = begin, end, text
    parser.EntityDeclHandler = entity
    with open(path, "rb") as file:
        try:
            while not ended and (chunk := file.read(_CHUNK)):
                parser.Parse(chunk)
            if not ended:
                parser.Parse(b"", True)
        except expat.ExpatError as error:
            if not ended:
                raise DataError(f"{path}: its XML is damaged ({error}); check that the file is whole") from error


def _arrays(path: Path, word: np.dtype, compressed: bool) -> list[_Array]:
    arrays: list[_Array] = []
    inside = False

    def start(tag: str, attributes: dict[str, str], _: int) -> bool:
        nonlocal inside
        inside = tag in ("DataArray", "Array")
        if inside:
            inline = compressed and attributes.get("format") == "binary"
            arrays.append(_Array(attributes, wanted=4 * word.itemsize if inline else 0))
        return tag == "AppendedData"

    def text(data: str) -> None:
        if inside:
            arrays[-1].add(data, word)

    def end(tag: str) -> None:
        nonlocal inside
        inside = False

    walk_xml(path, start, end, text)
    return arrays


def _decode(text: bytes, word: np.dtype) -> np.ndarray:
    """Decode words from base64; none where it is damaged."""
    try:
        return _words(base64.b64decode(text, validate=True), word)
    except (binascii.Error, ValueError):
        return np.zeros(0, word)


def _words(data: bytes, word: np.dtype) -> np.ndarray:
    return np.frombuffer(data[: len(data) // word.itemsize * word.itemsize], word)


def block_table(path: Path, start: int, word: np.dtype, coded: bool) -> np.ndarray:
    """Read the words before the blocks of an array in the appended data, those that are there."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        file.seek(start)
        if coded:
            head = _decode(file.read(4 * word.itemsize), word)
            n = _characters(head, word) if len(head) == 3 else 0
            file.seek(start)
            return _decode(file.read(n), word) if 0 < n <= size else head
        head = _words(file.read(3 * word.itemsize), word)
        n = int(head[0]) * word.itemsize if len(head) == 3 else 0
        return np.concatenate([head, _words(file.read(n), word)]) if 0 < n <= size else head


def _check(path: Path, name: str, words: list[int], room: int) -> None:
    """Check the sizes of an array's blocks: count, bytes, bytes of the last, packed bytes of each."""
    if words[:1] == [0] and not any(words[2:3]):
        return  # no block, nothing to read
    packed = words[3:]
    if len(words) < 3 or len(packed) != words[0] or not words[0]:
        raise DataError(f"{path}: array {name!r} has no whole table of its compressed blocks; check that it is whole")
    count, block, last = words[:3]
    if max(count * block, last) > room or sum(packed) > path.stat().st_size:
        raise DataError(
            f"{path}: array {name!r} has {count} blocks of {size_text(block)} (packed {size_text(sum(packed))}), more "
            "than the file can hold; check that it is whole"
        )
    check_memory(block + last, str(path))
