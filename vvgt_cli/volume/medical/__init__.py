"""Formats of medical images in files of their own: NIfTI, Analyze, FreeSurfer, MINC, AFNI, Philips, NRRD, MetaImage."""

from __future__ import annotations

import re
import struct

from vvgt_cli.volume.readers import HDF5, Reader, lazy

NIFTI_MAGIC = {b"n+1\0": True, b"ni1\0": False, b"n+2\0": True, b"ni2\0": False}  # whether it is one file
ANALYZE_OFFSET = 352  # least offset of values in NIfTI's single files, which those of an Analyze file never reach
MGH_HEADER, MGH_TYPES = 90, {0: "u1", 1: "i4", 3: "f4", 4: "i2", 10: "u2"}  # bytes that say something; types of values
_META = re.compile(rb"\s*(?:Comment|ObjectType|ObjectSubType|NDims|DimSize|BinaryData)\s*=", re.IGNORECASE)


def byte_order(head: bytes) -> tuple[str, int] | None:
    """Return the byte order and the version of a NIfTI or Analyze header, by its size; None of other files."""
    for order in "<>":
        for size, version in ((348, 1), (540, 2)):
            if len(head) >= size and struct.unpack_from(order + "i", head)[0] == size:
                return order, version
    return None


def is_nifti(head: bytes) -> bool:
    """Tell whether a file begins as NIfTI-1 or NIfTI-2 does."""
    form = byte_order(head)
    return form is not None and head[(344 if form[1] == 1 else 4) :][:4] in NIFTI_MAGIC


def is_analyze(head: bytes) -> bool:
    """Tell whether a file begins as the header of an Analyze 7.5 pair does."""
    form = byte_order(head)
    if form is None or form[1] != 1 or head[344:348] in NIFTI_MAGIC:
        return False
    axes, offset = struct.unpack_from(form[0] + "h", head, 40)[0], struct.unpack_from(form[0] + "f", head, 108)[0]
    return 1 <= int(axes) <= 7 and abs(offset) < ANALYZE_OFFSET


def is_mgh(head: bytes) -> bool:
    """Tell whether a file begins as FreeSurfer's MGH does."""
    if len(head) < MGH_HEADER:
        return False
    version, *sizes, kind = struct.unpack_from(">6i", head)
    return version == 1 and min(sizes) >= 1 and kind in MGH_TYPES and head[28:30] in (b"\0\0", b"\0\1")


def is_minc(head: bytes) -> bool:
    """Tell whether a file begins as MINC does; a file of VTK's writer is known by its variables alone."""
    classic = head.startswith(b"CDF") and (b"MINC standard" in head or (b"rootvariable" in head and b"zspace" in head))
    return classic or (head.startswith(HDF5) and b"minc-2.0" in head)


MASKS = Reader("masks", (), lazy("medical.masks.read_masks"), holds=lazy("medical.masks.mask_files"), whole=True)
FORMATS = (
    Reader("NIfTI", (".nii", ".nii.gz", ".hdr", ".hdr.gz"), lazy("medical.nifti.read_nifti"), is_nifti, ("time",)),
    Reader("Analyze", (".img", ".img.gz"), lazy("medical.nifti.read_analyze"), is_analyze, ("time",), by_name=True),
    Reader("MGH", (".mgh", ".mgz", ".mgh.gz"), lazy("medical.mgh.read_mgh"), is_mgh, ("time",)),
    Reader("MINC", (".mnc",), lazy("medical.minc.read_minc"), is_minc, ("time",)),
    Reader(
        "AFNI", (".head", ".brik", ".brik.gz"), lazy("medical.pairs.read_pair"),
        lambda head: head.lstrip().startswith((b"type  = ", b"type = ")), ("time",), by_name=True,
    ),
    Reader(
        "Philips PAR/REC", (".par",), lazy("medical.pairs.read_pair"),
        lambda head: b"DATA DESCRIPTION FILE" in head[:200], ("time",),
    ),
    Reader(
        "NRRD", (".nrrd", ".nhdr"), lazy("medical.nrrd.read_nrrd"), lambda head: head.startswith(b"NRRD000"), ("time",)
    ),
    Reader(
        "MetaImage", (".mha", ".mhd"), lazy("medical.metaimage.read_metaimage"),
        lambda head: _META.match(head) is not None, by_name=True,
    ),
    MASKS,
)  # fmt: skip
