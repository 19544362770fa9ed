"""Slices of TIFF files that stay there: unpacked page by page, when a block asks for them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.stored import Slices, Stored
from vvgt_cli.volume.tiff.decode import Pages


def lazy_pages(
    path: Path,
    number: int,
    lead: tuple[int, ...],
    inner: tuple[int, ...],
    index: tuple[int | slice, ...],
    dtype: np.dtype,
    turned: bool,
) -> Stored:
    """Wrap the slices of a series that are pages, as (z, y, x).

    Args:
        path: the file.
        number: of the series.
        lead: sizes of the axes that count pages.
        inner: sizes of the axes within a page.
        index: along all of them: slices along that of z in ``lead``, and x and y in ``inner``.
        dtype: of the values.
        turned: x comes before y in a page.
    """
    axis = next(k for k, i in enumerate(index) if isinstance(i, slice))
    rows, columns = [n for n, i in zip(inner, index[len(lead) :], strict=True) if isinstance(i, slice)][
        :: -1 if turned else 1
    ]

    turn = Lock()  # one file, one reader: workers may have threads

    @cache
    def opened() -> tuple[Any, Any, Pages]:
        import tifffile

        file = tifffile.TiffFile(path)
        return file, file.series[number], Pages(path)  # the file to keep it open

    def read(slices: Slices) -> np.ndarray:
        z, y, x = slices
        out = np.empty((z.stop - z.start, y.stop - y.start, x.stop - x.start), dtype)
        for k in range(z.start, z.stop):
            place = tuple(k if isinstance(i, slice) else int(i) for i in index[: len(lead)])
            with turn:
                _, series, pages = opened()
                page = pages.decoded(series[int(np.ravel_multi_index(place, lead))], series)
            page = page.reshape(inner)[index[len(lead) :]]
            out[k - z.start] = (page.T if turned else page)[y, x]
        return out

    return Stored(read, dtype, (lead[axis], rows, columns), (1, rows, columns), str(path))


def lazy_files(files: list[Path], plane: np.ndarray, of: Callable[[Path], np.ndarray], source: str) -> Stored:
    """Return slices that stay in their files; ``of`` reads one as (1, y, x), all as ``plane``, the first of them."""

    def read(slices: Slices) -> np.ndarray:
        z, y, x = slices
        out = np.empty((z.stop - z.start, y.stop - y.start, x.stop - x.start), plane.dtype)
        for k in range(z.start, z.stop):
            values = of(files[k])
            if values.shape != plane.shape or values.dtype != plane.dtype:
                raise DataError(
                    f"{files[k]}: {values.shape[2]} x {values.shape[1]} {values.dtype}; expected {plane.shape[2]} x "
                    f"{plane.shape[1]} {plane.dtype} as in {files[0].name}"
                )
            out[k - z.start] = values[0, y, x]
        return out

    return Stored(read, plane.dtype, (len(files), *plane.shape[1:]), (1, *plane.shape[1:]), source)
