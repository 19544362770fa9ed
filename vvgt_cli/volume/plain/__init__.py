"""Formats of plain values: raw files, and what Inviwo, Amira, VGStudio and VolVis put before or beside them."""

from __future__ import annotations

import re

from vvgt_cli.volume.readers import Reader, lazy

_INVIWO = re.compile(rb"^\s*(?:RawFile|ObjectFileName)\s*:", re.IGNORECASE | re.MULTILINE)

RAW = Reader(
    "raw", (".raw", ".raw.gz"), lazy("plain.raw.read_raw"), takes=("dims", "dtype", "byte_order", "header_bytes")
)
FORMATS = (
    RAW,
    Reader(
        "AmiraMesh", (".am",), lazy("plain.amira.read_amira"),
        lambda head: head.startswith((b"# AmiraMesh", b"# Avizo")), takes=("array",),
    ),
    Reader(
        "Inviwo .dat", (".dat",), lazy("plain.inviwo.read_inviwo"),
        lambda head: _INVIWO.search(head) is not None, by_name=True,
    ),
    Reader(
        "VGStudio", (".vgi",), lazy("plain.vgi.read_vgi"),
        lambda head: re.match(rb"\s*\{\w+\}\s*\[", head) is not None, takes=("array",),
    ),
    Reader("SLC", (".slc",), lazy("plain.slc.read_slc"), lambda head: re.match(rb"11111\s+\d", head) is not None),
)  # fmt: skip
