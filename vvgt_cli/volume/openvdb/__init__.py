"""OpenVDB files, format versions 222 to 225, as OpenVDB reads them bit for bit.

Read here because no wheel of OpenVDB exists; its own Python module, where a system has it, reads fewer types.
"""

from __future__ import annotations

from vvgt_cli.volume.readers import Reader, lazy

MAGIC = b" BDV\0\0\0\0"

FORMATS = (
    Reader("OpenVDB", (".vdb",), lazy("openvdb.reader.read_vdb"), lambda head: head.startswith(MAGIC), ("array",)),
)
