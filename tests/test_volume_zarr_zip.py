"""Zarr in zip files, written by zarr's ZipStore and by zipping folders: the same as the folder."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
import zarr

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, read_volume

VALUES = np.arange(120, dtype="u2").reshape(2, 3, 4, 5)


def write(store, version: int) -> None:
    """An OME-Zarr image of two time steps and two levels."""
    group = zarr.open_group(store, mode="w", zarr_format=version)
    levels = []
    for k in range(2):
        group.create_array(str(k), data=VALUES[:, :, :: 1 + k, :: 1 + k], chunks=(1, 2, 2, 3))
        scale = {"type": "scale", "scale": [1, 3, 2 * (1 + k), 1 + k]}
        levels.append({"path": str(k), "coordinateTransformations": [scale]})
    axes = [{"name": "t", "type": "time"}] + [{"name": n, "type": "space", "unit": "micrometer"} for n in "zyx"]
    image = {"version": "0.4", "axes": axes, "datasets": levels}
    group.attrs.update(
        {"multiscales": [image]} if version == 2 else {"ome": {"version": "0.5", "multiscales": [image]}}
    )


def zipped(folder: Path, version: int, name: str, inside: str, packed: bool = False) -> str:
    folder.mkdir(exist_ok=True)
    write(folder / "v.ome.zarr", version)
    with zipfile.ZipFile(folder / name, "w", zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED) as file:
        for path in sorted((folder / "v.ome.zarr").rglob("*")):
            file.write(path, inside + str(path.relative_to(folder / "v.ome.zarr")))
    return str(folder / name)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("stored", [False, True])
def test_a_store_of_zarrs_own(tmp_path: Path, version: int, stored: bool) -> None:
    store = zarr.storage.ZipStore(tmp_path / "v.ome.zarr.zip", mode="w")
    write(store, version)
    store.close()
    volume = read_volume(str(tmp_path / "v.ome.zarr.zip"), ReadOptions(time=1, stored=stored))
    np.testing.assert_array_equal(volume.data[0:], VALUES[1])
    assert (volume.spacing, volume.unit, volume.name) == ((1, 2, 3), "um", "v:0")


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(
    ("name", "inside", "packed"), [("v.ozx", "", False), ("v.zip", "", True), ("v.zarr.zip", "v.ome.zarr/", False)]
)
def test_zipped_folders(tmp_path: Path, version: int, name: str, inside: str, packed: bool) -> None:
    source = zipped(tmp_path, version, name, inside, packed)
    np.testing.assert_array_equal(read_volume(source, ReadOptions(time=0)).data, VALUES[0])
    for other in (read_volume(source + ":/1", ReadOptions(time=0)), read_volume(source, ReadOptions(time=0, level=1))):
        np.testing.assert_array_equal(other.data, VALUES[0, :, ::2, ::2])
        assert other.spacing == (2, 4, 3)
    refused(UsageError, "no array '/nothing'", read_volume, source + ":/nothing", ReadOptions(time=0))


def test_what_is_no_store(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "v.zarr.zip", "w") as file:
        file.writestr("a.txt", "hello")
    refused(DataError, "no Zarr store in this zip", read_volume, str(tmp_path / "v.zarr.zip"))
    (tmp_path / "v.ozx").write_bytes(b"PK\3\4 zarr.json")
    refused(DataError, "no zip file; expected", read_volume, str(tmp_path / "v.ozx"))
