"""Zarr behind an address: an OME-Zarr on a server of this machine, whole, in blocks, and lazily by xarray and Dask."""

import contextlib
import functools
import io
import json
import sys
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

import vvgt_cli
from tests.refused import refused
from tests.test_scale import bodies
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.arrays.remote import Remote
from vvgt_cli.volume.registry import level_shapes

zarr = pytest.importorskip("zarr")
FIT = ("--max-gaussians", "2000", "--screen", "100", "-q")


class Handler(SimpleHTTPRequestHandler):
    """Files of a folder; ``asked``: the paths; ``endless``: how paths end behind which zeros never do."""

    asked: list[str]
    endless = ""

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        self.asked.append(self.path)
        if self.endless and self.path.endswith(self.endless):
            self.send_response(200)
            self.end_headers()
            with contextlib.suppress(OSError):  # no longer asked for
                for _ in range(1 << 12):  # 256 MiB, no length
                    self.wfile.write(bytes(1 << 16))
        else:
            super().do_GET()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An OME-Zarr of two levels, 2 um voxels, and a plain array with steps."""
    folder = tmp_path_factory.mktemp("remote")
    values = np.round(bodies() * 255).astype(np.uint8)
    group = zarr.open_group(store=str(folder / "x.ome.zarr"), mode="w", zarr_format=3)
    levels = []
    for number, some in enumerate((values, values[::2, ::2, ::2])):
        group.create_array(str(number), shape=some.shape, chunks=(32, 32, 32), dtype="uint8")[:] = some
        scale = {"type": "scale", "scale": [2.0 * 2**number] * 3}
        levels.append({"path": str(number), "coordinateTransformations": [scale]})
    axes = [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"]
    group.attrs["ome"] = {"version": "0.5", "multiscales": [{"axes": axes, "datasets": levels}]}
    steps = zarr.open_array(store=str(folder / "t.zarr"), mode="w", zarr_format=2, shape=(2, 8, 9, 10), dtype="uint8")
    steps[1] = 7
    steps.attrs["_ARRAY_DIMENSIONS"] = ["time", "z", "y", "x"]
    return folder


@pytest.fixture
def address(folder: Path) -> Iterator[str]:
    pytest.importorskip("aiohttp")
    Handler.asked = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    server.server_close()


def test_an_address_is_read_as_the_folder(address: str, folder: Path) -> None:
    here, there = (read_volume(f"{place}/x.ome.zarr") for place in (folder, address))
    np.testing.assert_array_equal(np.asarray(there.data), np.asarray(here.data))
    assert (there.spacing, there.origin, there.name) == (here.spacing, here.origin, here.name)
    assert there.unit == here.unit
    assert read_volume(f"{address}/x.ome.zarr:/1").dims == (50, 45, 40)
    assert level_shapes(f"{address}/x.ome.zarr", ReadOptions()) == [(80, 90, 100), (40, 45, 50)]
    assert int(np.asarray(read_volume(f"{address}/t.zarr", ReadOptions(time=1)).data).min()) == 7


@pytest.mark.parametrize("end", [".zattrs", ".zarray", "/0.0.0.0", "g.zarr/"])
def test_answers_without_an_end_are_a_line(vvgt, address, folder, monkeypatch, end) -> None:
    """Metadata, chunks, a folder's list: no more is read than can be needed."""
    zarr.open_group(store=str(folder / "g.zarr"), mode="w", zarr_format=2)
    monkeypatch.setattr(Handler, "endless", end)
    place = ("g.zarr",) if end == "g.zarr/" else ("t.zarr", "--time", "0")
    done = vvgt("info", f"{address}/{place[0]}", *place[1:])
    assert (done.code, "\n" in done.error.strip()) == (1, False), done.error
    assert f"{end}: more than the " in done.error


def test_options_of_raw_files_are_refused(address: str) -> None:
    options = ReadOptions(dtype="float32", byte_order="big")
    refused(UsageError, "leave out --dtype", read_volume, f"{address}/x.ome.zarr", options)


def test_two_colons_are_part_of_a_name(address: str, folder: Path) -> None:
    """fsspec takes what is before them alone."""
    array = zarr.open_array(store=folder / "a::b.zarr", mode="w", shape=(8, 9, 10), dtype="uint8", chunks=(8, 9, 5))
    array[:] = 3
    assert int(np.asarray(read_volume(f"{address}/a::b.zarr").data).min()) == 3


def test_only_the_chunks_that_are_needed_are_asked_for(address: str) -> None:
    volume = read_volume(f"{address}/x.ome.zarr", ReadOptions(stored=True))
    assert not [path for path in Handler.asked if "/c/" in path]
    assert np.asarray(volume.data[:20, :20, :20]).shape == (20, 20, 20)
    assert len({path for path in Handler.asked if "/c/" in path}) == 1


def test_converted_in_blocks_it_has_the_bytes_of_the_folder(vvgt, address: str, folder: Path, tmp_path: Path) -> None:
    for name, place, workers in (("a", folder, 1), ("b", address, 2)):
        line = ("init", f"{place}/x.ome.zarr:/1", *FIT, "--blocks", "32", "--workers", workers, "--no-comments")
        vvgt.ok(*line, "-o", tmp_path / f"{name}.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert json.loads(vvgt("info", f"{address}/x.ome.zarr", "--json").out)["dims"] == [100, 90, 80]


def test_what_xarray_and_dask_have_of_an_address_stays_lazy(address: str) -> None:
    dask, xarray = pytest.importorskip("dask.array"), pytest.importorskip("xarray")
    array = dask.from_zarr(f"{address}/x.ome.zarr/0")
    named = xarray.DataArray(array, dims=("z", "y", "x"), name="bodies")
    assert not [path for path in Handler.asked if "/c/" in path]
    goal = {"max_gaussians": 500, "screen": 60, "steps": 0}
    assert len(vvgt_cli.convert(named, None, **goal, blocks=32).gaussians) > 100
    assert [path for path in Handler.asked if "/c/" in path]


def test_what_cannot_be_is_a_line(vvgt, address: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for place, text in (
        (f"{address}/none.zarr", "no Zarr there"),
        (f"{address}/x.ome.zarr:/7", "no array '7'"),
        ("http://127.0.0.1:9/x.zarr", "or no answer"),
    ):
        done = vvgt("convert", place, "-o", tmp_path / "a.ply")
        assert (done.code in (1, 2), text in done.error, "\n" in done.error.strip()) == (True, True, False), done.error
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    assert "pip install 'zarr>=3' 'fsspec>=" in vvgt.fails(1, "info", f"{address}/x.ome.zarr")


def test_other_codecs_than_were_checked_are_refused(address, folder, monkeypatch) -> None:
    told = json.loads((folder / "t.zarr" / ".zarray").read_text()) | {"compressor": {"id": "zlib", "level": 1}}
    real = Remote.open
    false = json.dumps(told).encode()
    told_of = lambda self, mode: io.BytesIO(false) if self.name == ".zarray" else real(self, mode)  # noqa: E731
    monkeypatch.setattr(Remote, "open", told_of)
    monkeypatch.setattr("vvgt_cli.volume.arrays.zarr._CODECS", {"zlib"})  # the array itself has another one
    refused(DataError, "codec", read_volume, f"{address}/t.zarr", ReadOptions(time=0))


def test_other_codecs_of_coordinates_are_refused(address: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    group = zarr.open_group(store=str(folder / "c.zarr"), mode="w", zarr_format=2)
    values = group.create_array("v", shape=(8, 9, 10), dtype="uint8", compressors=None)
    values.attrs["_ARRAY_DIMENSIONS"] = ["z", "y", "x"]
    group.create_array("x", shape=(10,), dtype="float32")[:] = np.arange(10)
    plain, real = (folder / "c.zarr" / "v" / ".zarray").read_text(), Remote.open
    told = json.dumps(json.loads(plain) | {"shape": [10]})
    told_of = lambda self, mode: io.BytesIO(told.encode()) if str(self).endswith("x/.zarray") else real(self, mode)  # noqa: E731
    assert read_volume(f"{address}/c.zarr:/v").dims == (10, 9, 8)
    monkeypatch.setattr(Remote, "open", told_of)
    monkeypatch.setattr("vvgt_cli.volume.arrays.zarr._CODECS", set[str]())  # the array itself has one
    refused(DataError, "codec", read_volume, f"{address}/c.zarr:/v")


def test_paths_stay_inside_the_store() -> None:
    store = Remote(None, "http://h/x.zarr")
    for name, inside in (("a/b", True), ("a/../b", True), ("../y.zarr", False), ("/etc", True), ("a/../../y", False)):
        assert (store / name).resolve().is_relative_to(store.resolve()) == inside
    assert str(store / "/etc") == "http://h/x.zarr/etc"
    assert str(store.parent) == "http://h"
    assert (store / "a").relative_to(store).as_posix() == "a"
