"""Dask arrays: converted block by block with the bytes of the same array in numpy, and never computed as a whole."""

import threading
import weakref
from pathlib import Path

import numpy as np
import pytest
import xarray

import vvgt_cli as vvgt
from tests.refused import refused
from vvgt_cli.volume import dask_arrays
from vvgt_cli.volume.stored import Stored, read_block

da = pytest.importorskip("dask.array")

TF = {"points": [{"x": 0.3, "opacity": 0, "rgb": [0.2, 0.3, 0.9]}, {"x": 1, "opacity": 0.5, "rgb": [1, 0.7, 0.1]}]}
HOW = {"max_gaussians": 200, "screen": 48, "steps": 4}


@pytest.fixture(scope="module")
def values() -> np.ndarray:
    """(40, 36, 44) float32: two bodies."""
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in (40, 36, 44)), indexing="ij")
    lump = np.exp(-4 * (x**2 + (y - 0.2) ** 2 + 2 * z**2))
    return np.maximum(lump, 0.8 * np.exp(-9 * ((x - 0.5) ** 2 + (y + 0.4) ** 2 + (z - 0.3) ** 2))).astype("f4")


def saved(result: vvgt.Result, path: Path) -> bytes:
    result.save(path)
    return path.read_bytes()


LOOKS = {
    "no function": vvgt.Look(),
    "lit": vvgt.Look(TF, light="headlight"),
    "labels": vvgt.Look(labels="auto"),
}


@pytest.mark.parametrize("name", LOOKS)
def test_bytes_are_those_of_the_array_in_blocks(values, tmp_path, name):
    values = np.digitize(values, [0.3, 0.6]).astype(np.uint8) if name == "labels" else values
    array = da.from_array(values, chunks=(13, 16, 20))  # aligned with no block
    lazy = vvgt.convert(array, LOOKS[name], **HOW, spacing=(1, 1, 1.5), blocks=16)
    whole = vvgt.convert(values, LOOKS[name], **HOW, spacing=(1, 1, 1.5), blocks=32)
    assert saved(lazy, tmp_path / "lazy.ply") == saved(whole, tmp_path / "whole.ply")
    assert lazy.scores == whole.scores


def test_labelled_arrays_are_lazy_too(values, tmp_path):
    at = {"x": 0.5 * np.arange(44), "y": -0.5 * np.arange(36), "z": np.arange(40.0)}  # y descends
    turned = xarray.DataArray(values, dims=("z", "y", "x"), coords=at).transpose("x", "z", "y").astype("f8")
    marked = turned.assign_attrs(valid_min=0.01, scale_factor=2.0)
    lazy, held = vvgt.read_volume(marked.chunk({"x": 20, "y": 16, "z": 13})), vvgt.read_volume(marked)
    assert isinstance(lazy.data, Stored)
    np.testing.assert_array_equal(lazy.data[:], held.data)
    assert (lazy.spacing, lazy.origin, lazy.slope) == (held.spacing, held.origin, held.slope)
    files = [
        saved(vvgt.convert(volume, TF, **HOW, blocks=16), tmp_path / f"{k}.ply")
        for k, volume in enumerate((lazy, held))
    ]
    assert files[0] == files[1]
    steps = xarray.concat([turned, 2 * turned], "time").chunk({"time": 1, "x": 20})
    second = vvgt.read_volume(steps, time=1)
    assert isinstance(second.data, Stored)
    np.testing.assert_array_equal(second.data[:], 2 * vvgt.read_volume(turned).data)


@pytest.fixture
def counted(monkeypatch):
    """An array of 64 chunks, made where they are computed, with how many were made, and were there at once."""
    counts = {"made": 0, "alive": 0, "most": 0}
    lock = threading.RLock()  # a collection within may end chunks

    def gone() -> None:
        with lock:
            counts["alive"] -= 1

    def chunk(block_info=None):
        (z0, z1), (y0, y1), (x0, x1) = block_info[None]["array-location"]
        z, y, x = np.meshgrid(*(np.arange(*ends) / 64 - 1 for ends in ((z0, z1), (y0, y1), (x0, x1))), indexing="ij")
        out = np.exp(-3 * (x**2 + 2 * y**2 + z**2)).astype("f4")
        with lock:
            counts["made"] += 1
            counts["alive"] += 1
            counts["most"] = max(counts["most"], counts["alive"])
        weakref.finalize(out, gone)
        return out

    monkeypatch.setattr(dask_arrays, "AT_ONCE", 3 * 32**3 * 4)
    monkeypatch.setattr(dask_arrays, "KEPT", 0)
    return da.map_blocks(chunk, chunks=((32,) * 4,) * 3, dtype="f4", meta=np.empty((0, 0, 0), "f4")), counts


@pytest.mark.parametrize("light", [None, "headlight"])
def test_few_chunks_are_there_at_once(counted, light):
    array, counts = counted
    assert len(vvgt.convert(array, vvgt.Look(TF, light=light), **HOW, blocks=32).gaussians) > 100
    assert counts["made"] >= 2 * 64  # counted, integrated: every chunk was needed
    assert 3 <= counts["most"] <= 3 + 3 + 1  # kept, computed at once, and one that is let go of


def test_chunks_that_memory_holds_are_made_once(counted, monkeypatch):
    array, counts = counted
    monkeypatch.setattr(dask_arrays, "KEPT", 0.125)
    monkeypatch.setattr(dask_arrays, "free_memory", lambda: 8 * array.nbytes)
    vvgt.convert(array, TF, **HOW, blocks=32)
    assert counts["made"] == 64


def test_parts_and_what_needs_the_whole(values, tmp_path):
    array = da.from_array(values, chunks=(13, 16, 20))
    crop, mask = "4:40,:30,6:", values > 0.1
    lazy = vvgt.read_volume(array, crop=crop, mask=da.from_array(mask, chunks=16))
    held = vvgt.read_volume(values, crop=crop, mask=mask)
    assert isinstance(lazy.data, Stored)
    np.testing.assert_array_equal(lazy.data[:], held.data)
    assert lazy.origin == held.origin
    lo, hi = np.array([3, 1, 5]), np.array([23, 20, 30])
    np.testing.assert_array_equal(read_block(lazy, lo, hi), held.data[5:30, 1:20, 3:23])
    pictures = [vvgt.render_views(volume, TF, views=1, size=32)[1] for volume in (array, values)]
    np.testing.assert_allclose(*pictures, atol=1e-6)  # the first in blocks
    with pytest.raises(vvgt.UsageError, match="convert it without a session"):
        vvgt.Session(array)


def failing(values: np.ndarray) -> np.ndarray:
    raise ValueError("no such sensor")


def test_what_a_chunk_gets_wrong_is_a_line(values):
    array = da.from_array(values, chunks=20)
    wrong = {
        "chunk .*cannot be computed .*no such sensor": array.map_blocks(failing, dtype="f4", meta=values[:0]),
        "is of shape .*float64; the Dask array says .*float32": array.map_blocks(np.float64, dtype="f4"),
        "call its compute_chunk_sizes": array[array[:, 0, 0] > 0.01],
        "expected three axes": array[0],
        "expected integers or floats": array.astype(complex),
    }
    for words, one in wrong.items():
        refused(vvgt.DataError, words, vvgt.convert, one, TF, **HOW)
