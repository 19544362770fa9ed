"""DICOM: a folder or a zip archive of one or more series, or one file; segmentations among them."""

from __future__ import annotations

import re

from vvgt_cli.volume.readers import Reader, lazy

_EXPLICIT = re.compile(rb"(?:[\2\x08]\0[\0-\x18]\0|\0[\2\x08]\0[\0-\x18])(?:UL|OB|UI|CS|SH|DA|TM|LO)")
_IMPLICIT = re.compile(rb"\x08\0[\0-\x18]\0([\0-\x7f])\0\0\0")
_TAKES = ("array", "time", "dims")


def is_dicom(head: bytes) -> bool:
    """Tell whether a file begins as DICOM does.

    It has a preamble and ``DICM`` (PS3.10, 7.1) or, as older programs wrote it, is the data set itself: elements of
    group 2 or 8 (PS3.5, 7.1).
    """
    if head[128:132] == b"DICM" or _EXPLICIT.match(head):
        return True
    first = _IMPLICIT.match(head)
    after = 8 + first[1][0] if first else 0
    return after % 2 == 0 < after and head[after : after + 2] == b"\x08\0"


FORMATS = (
    Reader(
        "DICOM", (".dcm", ".ima"), lazy("dicom.reader.read_dicom"), is_dicom, _TAKES,
        holds=lazy("dicom.series.holds_dicom"),
    ),
    Reader("DICOM archive", (".zip",), lazy("dicom.reader.read_dicom"), takes=_TAKES),
)  # fmt: skip
