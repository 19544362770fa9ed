"""Files of several resolutions: OME-Zarr, N5 and Imaris."""

from __future__ import annotations

from pathlib import Path

from vvgt_cli.volume import imaris, n5, remote, zarr_store
from vvgt_cli.volume.hdf5 import MAGIC
from vvgt_cli.volume.options import ReadOptions


def level_shapes(source: str, options: ReadOptions) -> list[tuple[int, ...]]:
    """Shapes of the levels of a source, slowest axis first, finest level first; none where it has none."""
    if source.partition(":")[0] in remote.SCHEMES:
        return remote.level_shapes(source, options)
    path = Path(source)
    if path.is_dir():
        return zarr_store.level_shapes(source, options) or n5.level_shapes(path, options)
    if path.is_file():
        with open(path, "rb") as file:
            if file.read(len(MAGIC)) == MAGIC:
                return imaris.level_shapes(path)
    return []
