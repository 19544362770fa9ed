"""Zarr and OME-Zarr that are no folder: on a server, by fsspec, or in a ``.zip`` or ``.ozx``, read where they lie.

``http://HOST/x.ome.zarr``, ``https://HOST/x.zarr:/array``, ``x.ome.zarr.zip:/array``. Chunks are read as they are
needed; every other format has to be a file of this machine. No answer of a server is read beyond `MAX_METADATA`, or a
chunk's size once an array is open.
"""

from __future__ import annotations

import asyncio
import weakref
from dataclasses import replace
from functools import cached_property
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any, cast
from zipfile import ZipFile, is_zipfile

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.arrays import MAX_CHUNK
from vvgt_cli.volume.arrays.zarr import MAX_METADATA, holds_zarr, read_zarr
from vvgt_cli.volume.reading import ReadOptions, Volume, need

SCHEMES = ("http", "https")


class _Server:
    """Answers of bounded size, for us and (asynchronous) for zarr."""

    def __init__(self, url: str) -> None:
        aiohttp, http = (need(name, "remote", url, "an address") for name in ("aiohttp", "fsspec.implementations.http"))
        self.failures = OSError, aiohttp.ClientError
        self.most = most = [MAX_METADATA]  # bytes of an answer

        class Bounded(aiohttp.ClientResponse):  # type: ignore[misc,name-defined]
            _body: bytes | None

            async def read(self) -> bytes:
                if self._body is None:
                    parts: list[bytes] = []
                    left = most[0]
                    async for part in self.content.iter_any():
                        left -= len(part)
                        if left < 0:
                            self.close()
                            raise DataError(
                                f"{self.url}: more than the {most[0]} bytes expected; try a copy of the store"
                            )
                        parts.append(part)
                    self._body = b"".join(parts)
                return cast(bytes, await super().read())

        class System(http.HTTPFileSystem):  # type: ignore[misc,name-defined]
            async def set_session(self) -> Any:
                opened, session = self._session is None, await super().set_session()
                if opened and self.asynchronous:  # fsspec closes others only
                    weakref.finalize(self, self.close_session, asyncio.get_running_loop(), session)
                return session

        how = {"client_kwargs": {"response_class": Bounded}, "skip_instance_cache": True}
        self.ours, self.zarrs = (System(asynchronous=other, **how) for other in (False, True))


class Remote:
    """A place, with the methods that `zarr` calls on a path; it keeps what has been read."""

    def __init__(
        self, server: _Server, root: str, inner: str = "", kept: dict[str, bytes | None] | None = None
    ) -> None:
        """Take the server, the address of the store, the path in it, and what has been read so far."""
        self._server, self._root, self._inner = server, root, PurePosixPath(inner)
        self._kept: dict[str, bytes | None] = {} if kept is None else kept

    def __str__(self) -> str:
        """Return the address."""
        return self._root if self._inner == PurePosixPath() else f"{self._root}/{self._inner}"

    def __truediv__(self, name: str) -> Remote:
        """Return the place ``name`` below this one."""
        return self._at(self._inner / name.lstrip("/"))

    def _at(self, inner: PurePosixPath) -> Remote:
        return type(self)(self._server, self._root, str(inner), self._kept)

    @property
    def name(self) -> str:
        """Return the last part of the address."""
        return str(self).rpartition("/")[2]

    @property
    def parent(self) -> Remote:
        """Return the place above, which may lie above the store."""
        if self._inner == PurePosixPath():
            return Remote(self._server, self._root.rpartition("/")[0], "", self._kept)
        return self._at(self._inner.parent)

    def resolve(self) -> PurePosixPath:
        """Resolve "..", as if the store were "/store"."""
        parts = ["store"]
        for part in self._inner.parts:
            parts = parts[:-1] if part == ".." else [*parts, part]
        return PurePosixPath("/", *parts)

    def relative_to(self, other: Remote) -> PurePosixPath:
        """Return the path from ``other`` to this place."""
        return self._inner.relative_to(other._inner)

    @cached_property
    def _content(self) -> bytes | None:
        url = str(self)
        if url not in self._kept:
            try:
                self._kept[url] = self._server.ours.cat_file(url)
            except self._server.failures as error:
                if getattr(error, "status", 404) >= 500:  # it may be there
                    raise
                self._kept[url] = None
        return self._kept[url]

    def is_file(self) -> bool:
        """Tell whether the server has a file here."""
        return self._content is not None

    def is_symlink(self) -> bool:
        """Return False: a server has no links."""
        return False

    def iterdir(self) -> list[Remote]:
        """List the places that the server lists below this one."""
        return [self / Path(entry["name"].rstrip("/")).name for entry in self._server.ours.ls(str(self))]

    def store(self) -> dict[str, Any]:
        """Return the arguments by which zarr opens the same place."""
        storage = need("zarr.storage", "zarr", str(self), "Zarr")
        return {"store": storage.FsspecStore(self._server.zarrs, True, str(self))}

    def allow(self, size: int) -> None:
        """Allow answers as long as a packed chunk of so many bytes."""
        self._server.most[0] = max(self._server.most[0], MAX_METADATA + size + size // 8)

    def open(self, mode: str) -> BytesIO:
        """Open the file here to read bytes; empty where there is none."""
        return BytesIO(self._content or b"")


def read_scheme(scheme: str, rest: str, options: ReadOptions) -> Volume:
    """Read one array at the address ``scheme:rest``, chunk by chunk where the options leave it stored."""
    url = f"{scheme}:{rest}"
    head, _, inner = url.rpartition(":/")
    if head in SCHEMES:
        head, inner = url, ""
    if inner and options.array is not None:
        raise UsageError(f"{url}: --array {options.array} and :/{inner} choose both; leave out one")
    if flags := [flag for flag in options.raw_flags if flag != "--dims"]:
        raise UsageError(f"{url}: Zarr, which states its own layout; leave out {' '.join(flags)}")
    place = cast(Path, Remote(_Server(url), head.rstrip("/")))
    if not holds_zarr(place):
        raise DataError(
            f"{url}: no Zarr there, or no answer (of another format download the file); expected .../x.ome.zarr"
        )
    return read_zarr(place, replace(options, array=inner or options.array))


class _Zipped(Remote):
    """A place in a zip file, with the methods that `zarr` calls on a path."""

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
    with ZipFile(path) as file:
        if any(entry.file_size > MAX_CHUNK for entry in file.infolist()):
            raise DataError(f"{path}: entries of more than 2 GiB; expected the chunks of a Zarr store")
        top = _Zipped(cast(Any, file), str(path))
        place = next((p for p in (top, *top.iterdir()) if holds_zarr(cast(Path, p))), None)
        if place is None:
            raise DataError(f"{path}: no Zarr store in this zip file; unpack it, if what it holds is another volume")
        return read_zarr(cast(Path, place), options)
