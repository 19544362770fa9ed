"""`.sog`: SOG's images and metadata (`sog_images`) in an uncompressed zip."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.sog_images import META, MOST, images_of, splats_in, webp
from vvgt_cli.gaussians.formats.splats import Splats, morton_order
from vvgt_cli.gaussians.header import MIP
from vvgt_cli.volume.libraries import library_errors

COMMENTS = "vvgt.json"  # a member of the archive that other programs ignore
_LARGEST = 1 << 30  # bytes of a member
_LARGEST_TEXT = 1 << 20


def sog(splats: Splats, name: str) -> bytes:
    """Encode columns as a `.sog`, along the Morton curve.

    Raises:
        DataError: there are more Gaussians than a file can hold.
    """
    if len(splats) > MOST:
        raise DataError(f"{name}: {len(splats):,} Gaussians; expected at most {MOST:,} in a .sog; try a .ply")
    images, meta = images_of(splats.take(morton_order(splats.means)))
    meta |= {"model": "antialiased"} if MIP in splats.comments else {}
    members = {META: json.dumps(meta, separators=(",", ":")).encode()}
    members |= {file: webp(image) for file, image in images.items()}
    members[COMMENTS] = json.dumps(list(splats.comments)).encode()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for file, content in members.items():
            archive.writestr(zipfile.ZipInfo(file), content)
    return stream.getvalue()


def read_sog(content: bytes, name: str) -> Splats:
    """Read the columns of a `.sog` of version 2.

    Raises:
        DataError: the file is not valid.
    """
    with library_errors(name, "a .sog"), zipfile.ZipFile(io.BytesIO(content)) as archive:

        def read(file: str, largest: int = _LARGEST) -> bytes:
            try:
                size = archive.getinfo(file).file_size
            except KeyError:
                raise DataError(f"{name}: no {file[:80]!r} in the archive; expected a .sog, with {META}") from None
            if size > largest:
                raise DataError(f"{name}: {file[:80]!r} has {size:,} bytes; expected at most {largest:,}")
            return archive.read(file)

        splats = splats_in(json.loads(read(META, _LARGEST_TEXT)), read, name)
        if COMMENTS not in archive.namelist():
            return splats
        found = json.loads(read(COMMENTS, _LARGEST_TEXT))
        lines = found if isinstance(found, list) else []
        return replace(splats, comments=tuple(str(line).replace("\n", " ") for line in lines))
