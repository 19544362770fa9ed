"""Zarr and OME-Zarr in a ``.zip`` or ``.ozx``: ``x.ome.zarr.zip``, ``x.ome.zarr.zip:/array``, read where it lies."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, cast
from zipfile import ZipFile, is_zipfile

from vvgt_cli.errors import DataError
from vvgt_cli.volume.arrays import MAX_CHUNK
from vvgt_cli.volume.arrays.remote import Remote
from vvgt_cli.volume.arrays.zarr import MAX_METADATA, holds_zarr, read_zarr
from vvgt_cli.volume.reading import ReadOptions, Volume, library_errors, need


class _Zipped(Remote):
    """A place in a zip file, with the methods that `zarr` calls on a path."""

    def _at(self, inner: PurePosixPath) -> Remote:
        return _Zipped(self._server, self._root, str(inner), self._kept)

    @property
    def parent(self) -> Remote:
        return self._at(self._inner.parent)

    @cached_property
    def _content(self) -> bytes | None:
        file, name = cast(ZipFile, self._server), str(self._inner)
        return file.open(name).read(MAX_METADATA + 1) if name in file.NameToInfo else None

    def iterdir(self) -> list[Remote]:
        names = [PurePosixPath(name) for name in cast(ZipFile, self._server).namelist()]
        depth = len(self._inner.parts)
        return [self._at(p) for p in {PurePosixPath(*n.parts[: depth + 1]) for n in names if self._inner in n.parents}]

    def store(self) -> dict[str, Any]:
        """Return the same for zarr."""
        storage = need("zarr.storage", "zarr", self._root, "Zarr")
        return {"store": storage.ZipStore(self._root, mode="r"), "path": str(self._inner)}

    def allow(self, size: int) -> None:
        """Allow anything: entries are bounded as the file is opened."""


def read_zipped(path: Path, options: ReadOptions) -> Volume:
    """Read one array of a zipped Zarr store, which may be a folder in the zip file."""
    if not is_zipfile(path):
        raise DataError(f"{path}: no zip file; expected a Zarr store in one")
    with library_errors(str(path), "Zarr"), ZipFile(path) as file:
        if any(entry.file_size > MAX_CHUNK for entry in file.infolist()):
            raise DataError(f"{path}: entries of more than 2 GiB; expected the chunks of a Zarr store")
        top = _Zipped(cast(Any, file), str(path))
        place = next((p for p in (top, *top.iterdir()) if holds_zarr(cast(Path, p))), None)
        if place is None:
            raise DataError(f"{path}: no Zarr store in this zip file; unpack it, if what it holds is another volume")
        return read_zarr(cast(Path, place), options)
