"""`Cursor`: a position in a mapped file; nothing is taken that is not there."""

from __future__ import annotations

import struct
from typing import Any

from vvgt_cli.errors import DataError


class Cursor:
    """A position in ``data`` that moves as things are taken.

    Attributes:
        at: bytes from the start.
        name: the file, for messages.
    """

    def __init__(self, data: memoryview, name: str) -> None:
        """Begin at the start of ``data``."""
        self.data, self.name, self.at = data, name, 0

    def bad(self, what: str) -> DataError:
        """Make the error for what was found here."""
        return DataError(f"{self.name}: {what} (near byte {self.at}); check that the file is whole")

    def take(self, n: int) -> memoryview:
        """Take the next ``n`` bytes.

        Raises:
            DataError: there are fewer.
        """
        if not 0 <= n <= len(self.data) - self.at:
            raise self.bad(f"{n} bytes are expected, {len(self.data) - self.at} are left")
        self.at += n
        return self.data[self.at - n : self.at]

    def unpack(self, form: str) -> tuple[Any, ...]:
        """Take the next little-endian numbers, by a format of `struct`."""
        return struct.unpack("<" + form, self.take(struct.calcsize("<" + form)))

    def text(self) -> str:
        """Take a string behind its length."""
        (n,) = self.unpack("I")
        return str(self.take(n), "utf-8", "replace")

    def seek(self, at: int) -> None:
        """Move to ``at``.

        Raises:
            DataError: outside the file.
        """
        if not 0 <= at <= len(self.data):
            raise self.bad(f"an offset of {at} in a file of {len(self.data)} bytes")
        self.at = at
