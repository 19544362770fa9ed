"""Files of microscopes: Leica, Nikon, Zeiss, BigDataViewer; Imaris' are HDF5 files, which `arrays.hdf5` hands over."""

from __future__ import annotations

from vvgt_cli.volume.readers import Reader, lazy

ND2_MAGIC = b"\xda\xce\xbe\x0a"
_TAKES = ("array", "time")

FORMATS = (
    Reader(
        "LIF", (".lif",), lazy("microscopy.leica.read_lif"),
        lambda head: head[:4] == b"\x70\0\0\0" and head[8:9] == b"\x2a", _TAKES,
    ),
    Reader("ND2", (".nd2",), lazy("microscopy.nikon.read_nd2"), lambda head: head.startswith(ND2_MAGIC), _TAKES),
    Reader(
        "BigDataViewer", (), lazy("microscopy.bigdataviewer.read_bdv"), lambda head: b"<SpimData" in head, _TAKES,
        levels=True,
    ),
    Reader("CZI", (".czi",), lazy("microscopy.zeiss.read_czi"), lambda head: head.startswith(b"ZISRAWFILE"), _TAKES),
)  # fmt: skip
