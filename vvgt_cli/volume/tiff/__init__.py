"""TIFF files, and volumes as many files: folders and globs of slices (TIFF, PNG, BMP, JPEG)."""

from __future__ import annotations

from vvgt_cli.volume.readers import Reader, lazy

TIFF = (".tif", ".tiff")
KINDS = {"png": (".png",), "bmp": (".bmp",), "jpeg": (".jpg", ".jpeg")}
PICTURES = tuple(suffix for suffixes in KINDS.values() for suffix in suffixes)
SUFFIXES = (*TIFF, *PICTURES)  # endings of slices

SLICES = Reader(
    "slices", (), lazy("tiff.slices.read_folder"), holds=lazy("tiff.slices.slices_of"), within=("TIFF", "picture")
)
FORMATS = (
    Reader(
        "TIFF", (".ome.tif", ".ome.tiff", *TIFF), lazy("tiff.reader.read_tiff"),
        lambda head: head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), ("array", "time"),
    ),
    Reader(
        "picture", PICTURES, lazy("tiff.slices.read_picture"),
        lambda head: head.startswith((b"\x89PNG\r\n", b"\xff\xd8\xff")), by_name=True,
    ),
    SLICES,
)  # fmt: skip
