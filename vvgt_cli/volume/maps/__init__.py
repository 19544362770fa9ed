"""Density maps and fields on the grids of molecules and crystals: MRC and CCP4, Gaussian's cube, OpenDX, VASP."""

from __future__ import annotations

import re

from vvgt_cli.volume.readers import Reader, lazy

MRC_HEADER = 1024  # bytes
MRC_STAMPS = {0x44: "<", 0x11: ">"}  # byte order by the machine stamp
_DX = re.compile(rb"(?:\s*#[^\n]*\n)*\s*object\s+\S+\s+class\s+gridpositions\s+counts\s", re.I)
_NUMBER = rb"[-+.\d][-+.\deE]*"
_ROW = rb"[ \t]*" + _NUMBER + rb"(?:[ \t]+" + _NUMBER + rb"){2}[ \t]*\r?\n"
_VASP = re.compile(  # comment, scale, lattice, elements, their counts, kind of coordinates
    rb"[^\n]*\n[ \t]*" + _NUMBER + rb"(?:[ \t]+" + _NUMBER + rb"){0,2}[ \t]*\r?\n" + _ROW * 3
    + rb"(?:[ \t]*[A-Z][^\n]*\n)?[ \t]*\d[\d \t]*\r?\n[ \t]*[SsDdCcKk]"
)  # fmt: skip


def is_mrc(head: bytes) -> bool:
    """Tell whether a file begins as an MRC2014 or CCP4 map does."""
    return len(head) >= MRC_HEADER and head[208:211] == b"MAP" and head[211] in b" \0" and head[212] in (0, *MRC_STAMPS)


FORMATS = (
    Reader(
        "MRC", (".mrc", ".map", ".ccp4", ".rec", ".st", ".mrc.gz", ".map.gz", ".mrc.bz2", ".map.bz2"),
        lazy("maps.mrc.read_mrc"), is_mrc, ("time",), by_name=True,
    ),
    Reader("Gaussian cube", (".cube", ".cub"), lazy("maps.text.read_cube")),
    Reader("OpenDX", (".dx",), lazy("maps.text.read_dx"), lambda head: _DX.match(head) is not None, by_name=True),
    Reader("VASP", (".vasp",), lazy("maps.text.read_vasp"), lambda head: _VASP.match(head) is not None),
)  # fmt: skip
