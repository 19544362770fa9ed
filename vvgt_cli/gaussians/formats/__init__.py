"""File formats of other programs for Gaussians, and the page that shows them: by a file's name, writer and reader."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.files import seekable
from vvgt_cli.gaussians import Gaussians, PlyHeader, PlyOptions, read_ply
from vvgt_cli.gaussians.formats import gltf, gsply_files, page_file, page_look, sog, splat, usd
from vvgt_cli.gaussians.formats.nodes import Node
from vvgt_cli.gaussians.formats.page_values import Values
from vvgt_cli.gaussians.formats.splats import Splats, columns_of, gaussians_of, splats_of
from vvgt_cli.gaussians.formats.streamed import StreamedLevels, split_name
from vvgt_cli.gaussians.header import parse_header
from vvgt_cli.gaussians.ply import check_size
from vvgt_cli.volume.blocks import check_memory

_HEAD = 1024  # bytes that identify a compressed .ply
_LARGEST = 1 << 32  # bytes of a file that is read whole


@dataclass(frozen=True)
class Format:
    """A format other than the standard `.ply`.

    Attributes:
        suffix: file ending.
        write: maps columns and the file's name, for errors and titles, to the file's bytes.
        read: maps bytes and the file's name, for errors, to columns.
        needs: given a name for errors, raises DataError if a library is not installed.
        layout: maps the options for a `.ply` to those for this format.
        write_nodes: like ``write`` for several clouds as nodes of one file; None if the format has no nodes.
    """

    suffix: str
    write: Callable[[Splats, str], bytes]
    read: Callable[[bytes, str], Splats]
    needs: Callable[[str], object]
    layout: Callable[[PlyOptions], PlyOptions] = lambda options: options
    write_nodes: Callable[[Sequence[Node], str], bytes] | None = None

    def lacks(self, name: str) -> str | None:
        """Return why a file of this name cannot be written: the library that is missing; None if it can."""
        try:
            self.needs(name)
        except DataError as error:
            return str(error)
        return None


def _one_of(write_nodes: Callable[[Sequence[Node], str], bytes]) -> Callable[[Splats, str], bytes]:
    """Return a writer of one cloud, as the root node, from a writer of nodes."""
    return lambda splats, name: write_nodes([Node("", splats)], name)


FORMATS = (  # the first whose ending fits is taken: a longer ending stands before a shorter one
    Format(".compressed.ply", gsply_files.compressed_ply, gsply_files.read_compressed_ply, gsply_files.gsply),
    Format(".v4.spz", gsply_files.spz_4, gsply_files.read_spz, gsply_files.zstandard),
    Format(".spz", gsply_files.spz, gsply_files.read_spz, gsply_files.gsply),
    Format(".sog", sog.sog, sog.read_sog, lambda name: None),
    Format(".glb", _one_of(gltf.glb), gltf.read_glb, lambda name: None, write_nodes=gltf.glb),
    Format(".usdc", _one_of(usd.usdc), usd.read_usd, usd.library, write_nodes=usd.usdc),
    Format(".usdz", _one_of(usd.usdz), usd.read_usd, usd.library, write_nodes=usd.usdz),
    Format(".html", page_look.html, page_file.read_html, gsply_files.gsply, page_file.upright),
)
PAGE = FORMATS[-1]
SUFFIXES = (".ply", *(known.suffix for known in FORMATS))
_ENDINGS = dict.fromkeys("." + suffix.rpartition(".")[2] for suffix in SUFFIXES)
ENDINGS = sorted(_ENDINGS, key=".html".__ne__)  # as dialogs for files take them; the page first
READ_ONLY = (
    Format(".splat", splat.refuse, splat.read_splat, lambda name: None),
    Format(".ksplat", splat.refuse, splat.refuse, lambda name: None),
)


def format_of(path: str | os.PathLike[str]) -> Format | None:
    """Return the format of a file name; None for the standard `.ply` and for unknown endings."""
    name = Path(path).name.lower()
    return next((known for known in (*FORMATS, *READ_ONLY) if name.endswith(known.suffix)), None)


def is_page(output: str | os.PathLike[str] | None) -> bool:
    """Return whether an output is a page, which can hold several clouds."""
    return format_of(output or "") is PAGE


def ready(path: str | Path) -> None:
    """Check that the format of a file name can be written; raise DataError, which names a missing library."""
    known = format_of(path)
    if known is not None:
        known.needs(str(path))


def encoded(
    known: Format, gaussians: Gaussians, options: PlyOptions, name: str,
    values: Values | None = None,
) -> bytes:  # fmt: skip
    """Encode Gaussians (unit frame) in another format, with the layout of `PlyOptions`.

    Args:
        known: the format.
        gaussians: Gaussians, unit frame.
        options: layout.
        name: of the file, for errors and titles.
        values: of the volume, for a page.

    Raises:
        DataError: the format cannot hold the values, or a library is not installed or fails.
    """
    if gaussians.live is not None:
        why = f"{known.suffix} cannot store values for other functions"
        if values is None:
            warnings.warn(f"{name}: {why}; only the current look was written", stacklevel=2)
        gaussians, options = replace(gaussians, live=None), replace(options, live=None)
    splats = splats_of(gaussians, known.layout(options))
    if known.write is page_look.html:
        return page_look.html(splats, name, values, options)
    return known.write(splats, name)


def is_splats(path: str | Path) -> bool:
    """Return whether a path is a file of Gaussians, by its name or by its first bytes, `ply`."""
    if format_of(path) or Path(path).name.lower().endswith(".ply") or split_name(path):
        return True
    try:
        with open(seekable(path), "rb") as stream:
            return stream.read(4) in (b"ply\n", b"ply\r")
    except OSError:
        return False


def read_splats(path: str | Path) -> tuple[Gaussians, PlyHeader]:
    """Read a file of Gaussians of any format, in the frame of the file, with a header that has its comments.

    For streamed levels, the name selects a level (`vvgt_cli.gaussians.formats.streamed`).

    Raises:
        UsageError: there is no such level.
        DataError: the file is not valid, or a library is not installed.
    """
    if split_name(path) is None and (format_of(path) or _compressed(path)) is None:
        return read_ply(path)
    return gaussians_of(read_columns(path), str(path))


def read_columns(path: str | Path) -> Splats:
    """Read the columns of a file of any format unchecked; values may not be finite, and rotations of length 0 are NaN.

    Raises:
        DataError: see `read_splats`, except for invalid values.
    """
    streamed = split_name(path)
    if streamed is not None:
        return StreamedLevels(streamed[0]).level(streamed[1])
    known = format_of(path) or _compressed(path)
    place, name = _there(path), str(path)
    if known is not None:
        if place.stat().st_size > _LARGEST:
            raise DataError(f"{path}: more than 4 GiB; expected a smaller file in this format, or a standard .ply")
        return known.read(place.read_bytes(), name)
    check_memory(2 * place.stat().st_size, name, "check a part of its Gaussians")
    content = place.read_bytes()
    check_size(parse_header(content, name), len(content), name)
    with np.errstate(invalid="ignore"):
        return columns_of(content, name)


def _there(path: str | Path) -> Path:
    """Return the path to read from, or raise DataError where no file is."""
    place = seekable(path)
    if not place.exists() or place.is_dir():
        raise DataError(f"{path}: {'a folder' if place.is_dir() else 'no such file'}; expected a file of Gaussians")
    return place


def _compressed(path: str | Path) -> Format | None:
    """Return the format of a `.compressed.ply` that has another name, else None."""
    with open(_there(path), "rb") as stream:
        return format_of(".compressed.ply") if b"\nelement chunk " in stream.read(_HEAD) else None
