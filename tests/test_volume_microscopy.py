"""CZI, LIF, ND2, Imaris and N5: values, place, channels, and what is refused."""

import json
import tarfile
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile

from tests import microscopes
from tests.microscopes import COLORS, NAMES, SPACING, cells
from tests.refused import refused
from tests.test_labels import SMALL
from vvgt_cli.errors import DataError, SeveralArrays, SeveralComponents, SeveralSteps, UsageError
from vvgt_cli.field.layered import open_content
from vvgt_cli.gaussians import read_ply
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.registry import level_shapes
from vvgt_cli.volume.stored import Stored

FIXTURES = Path(__file__).parent / "fixtures"


def write_lif(path: Path, values: np.ndarray) -> None:
    pytest.importorskip("liffile")
    path.write_bytes(microscopes.lif([("only", values)]))


def write_nd2(path: Path, values: np.ndarray) -> None:
    pytest.importorskip("nd2")
    path.write_bytes(microscopes.nd2(values))


def write_czi(path: Path, values: np.ndarray) -> None:
    pytest.importorskip("pylibCZIrw")
    microscopes.write_czi(path, values)


WRITERS = [(write_lif, "a.lif"), (write_nd2, "a.nd2"), (write_czi, "a.czi"), (microscopes.write_ims, "a.ims")]
formats = pytest.mark.parametrize(("write", "name"), WRITERS, ids=[name for _, name in WRITERS])


@formats
def test_values_place_names_and_colours(tmp_path: Path, write: Callable, name: str) -> None:
    values = cells(times=2)
    write(tmp_path / name, values)
    path = str(tmp_path / name)
    content = open_content(path, ReadOptions(time=1))
    assert list(content.names) == list(NAMES)
    np.testing.assert_allclose(content.colors, COLORS)
    spacing = SPACING if name != "a.nd2" else (SPACING[0], SPACING[0], SPACING[2])  # which has one number for x and y
    for c, volume in enumerate(content.volumes):
        np.testing.assert_array_equal(volume.data, values[1, c])
        np.testing.assert_allclose(volume.affine, np.diag([*spacing, 1]), atol=1e-9)
    part = read_volume(path, ReadOptions(component="GFP", time=0, stored=True))
    np.testing.assert_array_equal(part.data[1:4, 2:5, 3:7], values[0, 1, 1:4, 2:5, 3:7])
    assert isinstance(part.data, Stored) or name == "a.lif"  # which is mapped
    whole = read_volume(path, ReadOptions(component="magnitude", time=0)).data
    np.testing.assert_allclose(whole, np.sqrt((values[0].astype(float) ** 2).sum(0)), rtol=1e-6)


@formats
def test_choices_that_are_missing_or_wrong(tmp_path: Path, write: Callable, name: str) -> None:
    write(tmp_path / name, cells(times=2))
    path = str(tmp_path / name)
    with pytest.raises(SeveralComponents, match=r"2 channels .0 'DAPI', 1 'GFP'. of type uint16") as error:
        read_volume(path)
    assert error.value.channels
    refused(SeveralSteps, r"2 time steps", read_volume, path, ReadOptions(component=0))
    for wrong in ({"component": 2}, {"component": "RFP"}, {"component": 0, "time": 2}, {"array": "other"}):
        with pytest.raises(UsageError, match=r"a\.(lif|nd2|czi|ims)"):
            read_volume(path, ReadOptions(**{"component": 0, "time": 0, **wrong}))


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    for name, module in (("a.lif", "liffile"), ("a.nd2", "nd2")):
        data = microscopes.lif([("a", cells())]) if name == "a.lif" else microscopes.nd2(cells())
        (tmp_path / name).write_bytes(data)
        monkeypatch.setitem(sys.modules, module, None)
        refused(DataError, rf"pip install .*'{module}>=", read_volume, str(tmp_path / name))


# ---- several images


def test_images_of_a_lif(vvgt, tmp_path: Path) -> None:
    pytest.importorskip("liffile")
    first, second = cells(channels=1), cells(channels=1)[:, :, :3] + np.uint16(7)
    (tmp_path / "a.lif").write_bytes(microscopes.lif([("big", first), ("small", second)]))
    path = str(tmp_path / "a.lif")
    refused(SeveralArrays, r"2 images: 0 'big' .5 Z x 6 Y x 8 X uint16.; 1 'small'.*--series NAME", read_volume, path)
    for wanted in ("1", "small"):
        np.testing.assert_array_equal(read_volume(path, ReadOptions(array=wanted)).data, second[0, 0])
    told = json.loads(vvgt("info", path, "--json").out)
    assert [(c["choice"], c["dims"], c["range"][1]) for c in told["choices"]] == [
        ("--series 0", [8, 6, 5], int(first.max())),
        ("--series 1", [8, 6, 3], int(second.max())),
    ]


def test_interleaved_channels_of_a_lif_are_red_green_and_blue(tmp_path: Path) -> None:
    pytest.importorskip("liffile")
    values = cells(channels=3)
    (tmp_path / "a.lif").write_bytes(microscopes.lif([("only", values)], interleaved=True))
    for channel in range(3):
        volume = read_volume(str(tmp_path / "a.lif"), ReadOptions(component=channel))
        np.testing.assert_array_equal(volume.data, values[0, channel])
    with pytest.raises(SeveralComponents) as caught:
        read_volume(str(tmp_path / "a.lif"))
    assert caught.value.color
    content = microscopes.lif([("only", values)], interleaved=True)  # UTF-16
    for channel, tag in enumerate("321"):
        at = -1
        for _ in range(channel + 1):
            at = content.index('ChannelTag="'.encode("utf-16-le"), at + 1)
        content = content[: at + 24] + tag.encode("utf-16-le") + content[at + 26 :]
    (tmp_path / "b.lif").write_bytes(content)
    for channel in range(3):  # blue is stored first
        volume = read_volume(str(tmp_path / "b.lif"), ReadOptions(component=channel))
        np.testing.assert_array_equal(volume.data, values[0, 2 - channel])


def test_scenes_and_mosaics_of_a_czi(tmp_path: Path) -> None:
    pytest.importorskip("pylibCZIrw")
    values = cells()
    for kind in ("zstd0:ExplicitLevel=3", "zstd1:ExplicitLevel=3;PreProcess=HiLoByteUnpack"):
        microscopes.write_czi(tmp_path / "a.czi", values, kind, tiles=True)
        np.testing.assert_array_equal(read_volume(str(tmp_path / "a.czi"), ReadOptions(component=1)).data, values[0, 1])
    microscopes.write_czi(tmp_path / "b.czi", values, scenes=2)
    refused(SeveralArrays, r"2 scenes: 0 'scene 0' .8 x 6 pixels", read_volume, str(tmp_path / "b.czi"))
    found = read_volume(str(tmp_path / "b.czi"), ReadOptions(array="1", component=0)).data
    np.testing.assert_array_equal(found, values[0, 0] + 1)


def test_a_missing_frame_of_an_nd2_is_no_zeros(tmp_path: Path) -> None:
    pytest.importorskip("nd2")
    data = microscopes.nd2(cells())
    (tmp_path / "a.nd2").write_bytes(data[:-2000] + data[-2000:].replace(b"ImageDataSeq|3!", b"ImageDataSeq|9!"))
    refused(DataError, "of 5 frames 4 are there", read_volume, str(tmp_path / "a.nd2"), ReadOptions(component=0))


def test_values_of_imaris_elsewhere_are_refused(tmp_path: Path) -> None:
    import h5py

    (tmp_path / "inside").mkdir()
    microscopes.write_ims(tmp_path / "b.ims", cells())
    microscopes.write_ims(tmp_path / "inside" / "a.ims", cells())
    with h5py.File(tmp_path / "inside" / "a.ims", "r+") as file:
        place = "DataSet/ResolutionLevel 0/TimePoint 0/Channel 1"
        del file[place]
        file[place] = h5py.ExternalLink("../b.ims", place)
    with pytest.raises(DataError, match=r"'\.\./b.ims'; expected a file in the header's own folder"):
        read_volume(str(tmp_path / "inside" / "a.ims"), ReadOptions(component=0))


def test_packed_frames_of_an_nd2(tmp_path: Path) -> None:
    pytest.importorskip("nd2")
    values = cells()
    (tmp_path / "a.nd2").write_bytes(microscopes.nd2(values, packed=True))
    for stored in (False, True):
        volume = read_volume(str(tmp_path / "a.nd2"), ReadOptions(component=1, stored=stored))
        np.testing.assert_array_equal(volume.data[1:5], values[0, 1, 1:5])


# ---- signs and sizes


def test_stacks_that_run_downwards(tmp_path: Path) -> None:
    pytest.importorskip("liffile")
    pytest.importorskip("nd2")
    h5py, values, down = pytest.importorskip("h5py"), cells(channels=1), (*SPACING[:2], -SPACING[2])
    (tmp_path / "a.lif").write_bytes(microscopes.lif([("only", values)], down, (0, 0, 9)))
    (tmp_path / "a.nd2").write_bytes(microscopes.nd2(values, spacing=down))
    microscopes.write_ims(tmp_path / "a.ims", values)
    with h5py.File(tmp_path / "a.ims", "r+") as file:
        image = file["DataSetInfo/Image"].attrs
        image["ExtMin2"], image["ExtMax2"] = image["ExtMax2"], image["ExtMin2"]
    for name, first in (("a.lif", 9.0), ("a.nd2", 0.0), ("a.ims", 6.0)):
        volume = read_volume(str(tmp_path / name))
        np.testing.assert_array_equal(volume.data, values[0, 0])
        np.testing.assert_allclose(volume.affine[:3, 2:], [[0, 0], [0, 0], [-SPACING[2], first]], atol=1e-6)


def test_sizes_that_are_assumed_are_said(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    pytest.importorskip("nd2")
    h5py, values = pytest.importorskip("h5py"), cells(channels=1)
    (tmp_path / "a.nd2").write_bytes(microscopes.nd2(values, spacing=(0.2, 0.2, 0.0)))
    for name, key, value in (("a.ims", "ExtMax2", b"-0.75"), ("b.ims", "Unit", b"px")):
        microscopes.write_ims(tmp_path / name, values)
        with h5py.File(tmp_path / name, "r+") as file:
            file["DataSetInfo/Image"].attrs[key] = np.frombuffer(value, "S1")
    for name, axes, size in (("a.nd2", "z", "0.2"), ("a.ims", "z", "0.2"), ("b.ims", "x, y, z", "1")):
        recwarn.clear()
        read_volume(str(tmp_path / name))
        assert f"{name}: no voxel size along {axes}; taken as {size} (--spacing" in " ".join(
            str(w.message) for w in recwarn
        )
        read_volume(str(tmp_path / name), ReadOptions(spacing=(1, 1, 1)))
        assert sum("no voxel size" in str(w.message) for w in recwarn) == 1


# ---- levels


def test_levels_of_imaris(vvgt, tmp_path: Path) -> None:
    values = cells(channels=1)
    microscopes.write_ims(tmp_path / "a.ims", values)
    path = str(tmp_path / "a.ims")
    assert level_shapes(path, ReadOptions()) == [(5, 6, 8), (5, 3, 4)]
    coarse = read_volume(path, ReadOptions(level=1))
    np.testing.assert_array_equal(coarse.data, values[0, 0, :, ::2, ::2])
    np.testing.assert_allclose(coarse.extent, read_volume(path).extent)
    np.testing.assert_allclose(coarse.origin, [SPACING[0] / 2, SPACING[1] / 2, 0], atol=1e-9)
    assert "4 x 3 x 5" in vvgt.ok("init", path, *SMALL[:4], "--level", 1, "-o", tmp_path / "a.ply").err
    assert "expected full, or 0 to 1" in vvgt("init", path, "--level", 2, "-o", tmp_path / "b.ply").error


# ---- N5


def linear() -> np.ndarray:
    z, y, x = np.mgrid[:7, :9, :11]
    return (1 + 2 * x * 0.5 + 30 * y * 1.0 + 500 * z * 2.0).astype(np.float32)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    with tarfile.open(FIXTURES / "n5" / "linear.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path / "linear.n5"


@pytest.mark.parametrize("kind", ["raw", "gzip", "zlib", "bzip2", "xz", "blosc", "zstd"])
def test_n5_that_tensorstore_wrote(store: Path, kind: str) -> None:
    volume = read_volume(f"{store}:/{kind}")
    assert volume.spacing == (0.5, 1.0, 2.0)
    np.testing.assert_array_equal(volume.data, linear())
    part = read_volume(f"{store}:/{kind}", ReadOptions(stored=True))
    np.testing.assert_array_equal(part.data[2:6, 3:8, 1:10], linear()[2:6, 3:8, 1:10])


def test_n5_levels_and_what_is_refused(vvgt, store: Path, tmp_path: Path) -> None:
    refused(SeveralArrays, r"several arrays: blosc \(.*; bzip2 \(.*; gzip \(.*--array", read_volume, str(store))
    (tmp_path / "p.n5").mkdir()
    for level, kind in enumerate(("gzip", "xz")):
        (store / kind).rename(tmp_path / "p.n5" / f"s{level}")
    facts = tmp_path / "p.n5" / "s1" / "attributes.json"
    told = json.loads(facts.read_text()) | {"downsamplingFactors": [2, 2, 1]}
    facts.write_text(json.dumps(told))
    assert level_shapes(str(tmp_path / "p.n5"), ReadOptions()) == [(7, 9, 11)] * 2
    coarse = read_volume(str(tmp_path / "p.n5"), ReadOptions(level=1))
    assert (coarse.spacing, coarse.origin) == ((1.0, 2.0, 2.0), (0.25, 0.5, 0.0))
    del told["downsamplingFactors"]
    for key in ("scales", "downsamplingFactors"):  # of all levels, by their group
        facts.write_text(json.dumps(told | {"offset": [10, 20, 30]}))
        (tmp_path / "p.n5" / "attributes.json").write_text(json.dumps({key: [[1, 1, 1], [2, 2, 1]]}))
        coarse = read_volume(str(tmp_path / "p.n5"), ReadOptions(level=1))
        assert (coarse.spacing, coarse.origin) == ((1.0, 2.0, 2.0), (10.25, 20.5, 30.0))
    facts.write_text(json.dumps(told | {"pixelResolution": {"unit": "um", "dimensions": [1, 2, 2]}}))  # its own
    coarse = read_volume(str(tmp_path / "p.n5"), ReadOptions(level=1))
    assert (coarse.spacing, coarse.unit) == ((1.0, 2.0, 2.0), "um")
    finest = tmp_path / "p.n5" / "s0" / "attributes.json"
    same = json.loads(finest.read_text()) | {"pixelResolution": [1, 2, 2]}  # as a list
    finest.write_text(json.dumps(same))
    assert read_volume(str(tmp_path / "p.n5"), ReadOptions(level=1)).spacing == (2.0, 4.0, 2.0)
    block = store / "raw" / "0" / "0" / "0"
    block.write_bytes(block.read_bytes()[:-4])
    refused(DataError, r"its .4, 4, 4. values need 256", read_volume, f"{store}:/raw")
    block.unlink()
    assert not read_volume(f"{store}:/raw").data[:4, :4, :4].any()
    facts.write_text(json.dumps(told | {"dataType": "object"}))
    refused(DataError, r"a type such as uint16", read_volume, f"{tmp_path / 'p.n5'}:/s1")


def test_lz4_of_java() -> None:
    """As LZ4BlockOutputStream has it: a block packed, a block as it is, an empty one at the end."""
    import struct

    import lz4.block

    from vvgt_cli.volume.arrays.n5 import unpack

    first, second = bytes(range(256)) * 4, b"abcd"
    packed = lz4.block.compress(first, store_size=False)
    data = struct.pack("<8sBiiI", b"LZ4Block", 0x26, len(packed), len(first), 0) + packed
    data += struct.pack("<8sBiiI", b"LZ4Block", 0x16, 4, 4, 0) + second
    assert unpack({"type": "lz4"}, data, len(first) + 4, "x") == first + second
    with pytest.raises(ValueError, match=r"does not fit"):
        unpack({"type": "lz4"}, data, 100, "x")


def test_the_only_stack_among_snapshots_is_taken(tmp_path: Path) -> None:
    pytest.importorskip("liffile")
    stack, snap = cells(channels=1), cells(channels=1)[:, :, :1]
    (tmp_path / "a.lif").write_bytes(microscopes.lif([("overview", snap), ("stack", stack), ("later", snap)]))
    with pytest.warns(UserWarning, match=r"'stack' taken, of 3 images the only one of several slices \(--series"):
        volume = read_volume(str(tmp_path / "a.lif"))
    np.testing.assert_array_equal(volume.data, stack[0, 0])
    tifffile.imwrite(tmp_path / "a.ome.tif", snap[0, 0, 0], ome=True)
    with tifffile.TiffWriter(tmp_path / "b.ome.tif", ome=True) as file:
        file.write(snap[0, 0, 0], metadata={"Name": "overview"})
        file.write(stack[0, 0], metadata={"axes": "ZYX", "Name": "stack"})
    with pytest.warns(UserWarning, match="'stack' taken"):
        assert read_volume(str(tmp_path / "b.ome.tif")).dims == (8, 6, 5)


# ---- several channels


def write_tiff(path: Path, values: np.ndarray) -> None:
    colors = {"Name": list(NAMES), "Color": [-16776961, 16777215]}  # RGBA as signed 32 bits
    tifffile.imwrite(path, values[0].transpose(1, 0, 2, 3), ome=True, metadata={"axes": "ZCYX", "Channel": colors})


def write_zarr(path: Path, values: np.ndarray) -> None:
    group = pytest.importorskip("zarr").open_group(str(path), mode="w", zarr_format=2)
    group.create_array("0", data=values[0], chunks=(1, 4, 4, 4))
    kinds = [{"name": "c", "type": "channel"}, *({"name": a, "type": "space", "unit": "micrometer"} for a in "zyx")]
    scale = {"type": "scale", "scale": [1, *SPACING[::-1]]}
    group.attrs["multiscales"] = [
        {"version": "0.4", "axes": kinds, "datasets": [{"path": "0", "coordinateTransformations": [scale]}]}
    ]
    shown = zip(NAMES, ("FF0000", "00FFFF"), strict=True)
    group.attrs["omero"] = {"channels": [{"label": label, "color": color} for label, color in shown]}


EVERY = [*WRITERS, (write_tiff, "a.ome.tif"), (write_zarr, "a.zarr")]


def two_cells() -> np.ndarray:
    """Two channels, bright in either half of x."""
    values = np.zeros((1, 2, 12, 14, 16), np.uint16)
    values[0, 0, 3:9, 3:10, 1:6], values[0, 1, 3:9, 3:10, 9:15] = 1000, 3000
    return values


@pytest.mark.parametrize(("write", "name"), EVERY, ids=[name for _, name in EVERY])
def test_all_channels_in_the_colours_of_the_file(vvgt, tmp_path: Path, write: Callable, name: str) -> None:
    write(tmp_path / name, two_cells())
    made = {}
    for blocks in ((), ("--blocks", 16)):
        out = tmp_path / f"{len(blocks)}.ply"
        with warnings.catch_warnings(record=True) as notes:
            warnings.simplefilter("always")
            extra = ("--level", "full") if blocks and name in ("a.ims", "a.zarr") else ()
            done = vvgt("init", tmp_path / name, *SMALL[:4], *blocks, *extra, "-o", out)
        assert done.code == 0, done.err
        told = {str(note.message) for note in notes if "all shown" in str(note.message)}
        assert told == {
            f"{(tmp_path / name)}: 2 channels, all shown: 0 'DAPI' #ff0000, 1 'GFP' #00ffff (try --channel N for one)"
        }
        made[blocks] = read_ply(str(out))[0]
    for gaussians in made.values():
        left = gaussians.means[:, 0] < 0
        assert 0 < left.sum() < len(left)
        assert (gaussians.colors[left, 0] > gaussians.colors[left, 1]).all()
        assert (gaussians.colors[~left, 1] > gaussians.colors[~left, 0]).all()
    first, second = made.values()
    np.testing.assert_allclose(len(first), len(second), rtol=0.05)


@pytest.mark.parametrize(("write", "name"), EVERY, ids=[name for _, name in EVERY])
@pytest.mark.parametrize("stored", [False, True])
def test_channels_by_names_and_numbers(tmp_path: Path, write: Callable, name: str, stored: bool) -> None:
    values = two_cells()
    write(tmp_path / name, values)
    content = open_content(str(tmp_path / name), ReadOptions(component="GFP,0", stored=stored))
    assert (list(content.names), list(content.numbers)) == (["GFP", "DAPI"], [1, 0])
    np.testing.assert_allclose(content.colors, COLORS[::-1])
    for volume, number in zip(content.volumes, (1, 0), strict=True):
        np.testing.assert_array_equal(volume.data[:, :, :], values[0, number])
    for wrong in ("GFP,XY", "XY"):
        said = "XY.*0 'DAPI', 1 'GFP'|0 'DAPI', 1 'GFP'.*XY"
        refused(UsageError, said, open_content, str(tmp_path / name), ReadOptions(component=wrong, stored=stored))


def test_by_every_command_and_in_python(vvgt, tmp_path: Path) -> None:
    import vvgt_cli as library

    path = tmp_path / "a.ome.tif"
    write_tiff(path, two_cells())
    out = tmp_path / "a.ply"
    for command in (
        ("convert", path, *SMALL, "-o", out),
        ("evaluate", out, "--volume", path, "--no-conditions", "--json"),
        ("render-views", path, "-o", tmp_path / "views", "--size", 32, "--views", 3, "--test-views", 1),
        ("info", path),
    ):
        vvgt.ok(*command)
    assert json.loads(vvgt("info", path, "--channel", "GFP", "--json").out)["range"] == [0, 3000]
    made = library.convert(path, max_gaussians=200, screen=32, steps=0)
    assert np.ptp(made.gaussians.colors, axis=0).max() > 0.5


def test_many_channels_and_vectors_stay_a_choice(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "many.ome.tif", np.zeros((3, 7, 8, 9), np.uint16), ome=True, metadata={"axes": "ZCYX"})
    np.save(tmp_path / "vector.npy", np.zeros((3, 8, 9, 2), np.float32))
    for name in ("many.ome.tif", "vector.npy"):
        refused(UsageError, r"component|channel", open_content, str(tmp_path / name), ReadOptions())
