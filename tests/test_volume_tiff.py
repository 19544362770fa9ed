"""TIFF as microscopes write it: axes, channels, time steps and sizes of OME-TIFF and ImageJ, several series."""

from __future__ import annotations

import itertools
import json
import struct
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import tifffile

from vvgt_cli.errors import DataError, UsageError, VvgtError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.stored import is_file_backed

T, C, Z, Y, X = 3, 2, 4, 6, 5
VALUES = np.random.default_rng(3).integers(0, 200, (T, C, Z, Y, X)).astype("u2")
SIZES = {
    "PhysicalSizeX": 0.2, "PhysicalSizeY": 0.3, "PhysicalSizeZ": 2000, "PhysicalSizeZUnit": "nm",
    "Channel": {"Name": ["DAPI", "GFP"]},
}  # fmt: skip


def write_ome(path: Path, values: np.ndarray = VALUES, axes: str = "TCZYX", sizes: dict = SIZES, **how) -> str:
    tifffile.imwrite(path, values, ome=True, metadata={"axes": axes, **sizes}, **how)
    return str(path)


def xml_of(path: Path, old: str, new: str) -> None:
    """Change the OME-XML of a file, to text of the same length."""
    body = path.read_bytes()
    assert body.count(old.encode()) >= 1
    path.write_bytes(body.replace(old.encode(), new.ljust(len(old)).encode()))


@pytest.mark.parametrize("how", [{}, {"bigtiff": True, "byteorder": ">"}, {"compression": "zlib"}, {"tile": (16, 16)}])
def test_ome_channels_time_steps_and_sizes(tmp_path: Path, how: dict) -> None:
    source = write_ome(tmp_path / "cells.ome.tif", **how)
    for t, c in itertools.product(range(T), range(C)):
        volume = read_volume(source, ReadOptions(time=t, component=c))
        np.testing.assert_array_equal(volume.data, VALUES[t, c])
    assert (volume.name, volume.data.dtype.name) == ("cells", "uint16")
    assert volume.spacing == pytest.approx((0.2, 0.3, 2), rel=1e-12)
    assert isinstance(volume.data, np.memmap) == (not set(how) & {"compression", "tile"})
    named = read_volume(source, ReadOptions(time=1, component="GFP", spacing=(1, 2, 3)))
    np.testing.assert_array_equal(named.data, VALUES[1, 1])
    assert named.spacing == (1, 2, 3)
    norm = read_volume(source, ReadOptions(time=2, component="magnitude"))
    np.testing.assert_allclose(norm.data, np.linalg.norm(VALUES[2].astype(float), axis=0), rtol=1e-6)


@pytest.mark.parametrize("axes", ["TZCYX", "CTZYX", "ZCTYX"])
def test_ome_orders_of_planes(tmp_path: Path, axes: str) -> None:
    order = ["TCZYX".index(a) for a in axes]
    source = write_ome(tmp_path / "a.ome.tif", VALUES.transpose(order), axes)
    for t, c in itertools.product(range(T), range(C)):
        np.testing.assert_array_equal(read_volume(source, ReadOptions(time=t, component=c)).data, VALUES[t, c])


def test_a_choice_is_obeyed_or_an_error_that_lists(tmp_path: Path) -> None:
    source = write_ome(tmp_path / "a.ome.tif")
    still = write_ome(tmp_path / "b.ome.tif", VALUES[0, 0], "ZYX", {})
    for path, options, message in (
        (source, {}, r"2 channels \(0 'DAPI', 1 'GFP'\) of type uint16; expected one: try --channel 0 to 1"),
        (source, {"component": 2, "time": 0}, r"2 channels .*, not 2; expected one"),
        (source, {"component": "RFP", "time": 0}, r"'GFP'\) of type uint16, not 'RFP'"),
        (source, {"component": 1}, r"3 time steps; expected one: try --time N \(0 to 2\).*-o 'p_{:02d}.ply'"),
        (source, {"component": 1, "time": 3}, r"--time 3: expected a time step from 0 to 2"),
        (still, {"time": 1}, r"--time 1: it has 1 time step; leave out --time"),
        (still, {"component": 1}, r"1 channel of type uint16; leave out --channel 1"),
        (still, {"component": "magnitude"}, r"1 channel of type uint16; leave out --channel magnitude"),
        (still, {"array": "7"}, r"0 series '7'; it has 0"),
    ):
        with pytest.raises(UsageError, match=message):
            read_volume(path, ReadOptions(**options))
    np.testing.assert_array_equal(read_volume(still, ReadOptions(time=0, component=0)).data, VALUES[0, 0])


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_imagej(tmp_path: Path, compression: str | None) -> None:
    path = tmp_path / "a.tif"
    order = VALUES.transpose(0, 2, 1, 3, 4)
    for unit, factor in (("um", 1), ("\\u00B5m", 1), ("nm", 1e-3), ("mm", 1000), ("pixel", 1)):
        told = {"axes": "TZCYX", "spacing": 2.5, "unit": unit}
        tifffile.imwrite(path, order, imagej=True, metadata=told, resolution=(5, 4), compression=compression)
        for t, c in itertools.product(range(T), range(C)):
            volume = read_volume(str(path), ReadOptions(time=t, component=c))
            np.testing.assert_array_equal(volume.data, VALUES[t, c])
        assert volume.spacing == pytest.approx((0.2 * factor, 0.25 * factor, 2.5 * factor), rel=1e-12)
    tifffile.imwrite(path, VALUES[0, 0], imagej=True, metadata={"axes": "ZYX"})
    assert read_volume(str(path)).spacing == (1, 1, 1)


def described(path: Path, text: str, tags: tuple | None, dtype: str = "u2") -> str:
    """Four slices with a description of their own; ``tags``: pixels per unit along x and y, and the unit's number."""
    resolution = {} if tags is None else {"resolution": tags[:2], "resolutionunit": tags[2]}
    values = VALUES[0, 0].astype(dtype)
    tifffile.imwrite(
        path, values, photometric="minisblack", metadata=None, description=f"ImageJ=1.53c\n{text}", **resolution
    )
    if tags is None:
        body = path.read_bytes()  # tifffile writes 1 and 1 where nothing is given
        for tag in (282, 283, 296):
            assert body.count(struct.pack("<HH", tag, 3 if tag == 296 else 5)) == Z
            body = body.replace(struct.pack("<HH", tag, 3 if tag == 296 else 5), struct.pack("<HH", tag + 40000, 1))
        path.write_bytes(body)
    return str(path)


NO_SIZE, NO_DEPTH = "no size of its pixels; taken as 1", "no distance between its slices; taken as 1, as ImageJ"


@pytest.mark.parametrize(
    ("text", "tags", "spacing", "unit", "told"),
    [
        # neither a unit nor a resolution
        ("", None, (1, 1, 1), "", ()),
        ("spacing=2.0\n", None, (1, 1, 2), "", (NO_SIZE,)),
        ("spacing=2.0\nfinterval=0.5\n", (1, 1, 1), (1, 1, 2), "", ()),
        ("spacing=-2.0\n", (1, 1, 1), (1, 1, 2), "", ()),
        ("spacing=0\n", (1, 1, 1), (1, 1, 1), "", ()),
        # dots of printers, without a unit
        ("spacing=2.0\n", (72, 72, 2), (1, 1, 2), "", (NO_SIZE,)),
        ("spacing=2.0\n", (300, 300, 2), (1, 1, 2), "", (NO_SIZE,)),
        ("spacing=2.0\n", (118, 118, 3), (1, 1, 2), "", (NO_SIZE,)),
        ("", (300, 300, 2), (1, 1, 1), "", ()),
        ("unit=pixel\nspacing=2.0\n", (96, 96, 2), (1, 1, 2), "", (NO_SIZE,)),
        # a resolution in a unit that is not named
        ("spacing=2.0\n", (4, 5, 1), (0.25, 0.2, 2), "", ()),
        ("", (4, 5, 1), (0.25, 0.2, 1), "", (NO_DEPTH,)),
        ("unit=pixel\n", (1, 1, 1), (1, 1, 1), "", ()),
        # a unit
        ("unit=um\nspacing=2.0\n", (4, 5, 1), (0.25, 0.2, 2), "um", ()),
        ("unit=micron\nspacing=2.0\n", (4, 5, 1), (0.25, 0.2, 2), "um", ()),
        ("unit=\\u00B5m\nspacing=2.0\n", (4, 5, 1), (0.25, 0.2, 2), "um", ()),
        ("unit=\\u00C5\nspacing=2.0\n", (4, 5, 1), (0.25e-4, 0.2e-4, 2e-4), "um", ()),
        ("unit=microns\nspacing=2.0\n", (4, 5, 1), (0.25, 0.2, 2), "um", ()),
        ("unit=cm\nspacing=2.0\n", (4, 5, 3), (2500, 2000, 2e4), "um", ()),
        ("unit=inch\nspacing=2.0\n", (100, 50, 2), (254, 508, 50800), "um", ()),
        ("unit=inch\nspacing=2.0\n", (72, 72, 2), (25400 / 72, 25400 / 72, 50800), "um", ()),
        ("unit=mm\nspacing=2.0\nzunit=um\n", (4, 5, 1), (250, 200, 2), "um", ()),
        ("unit=um\n", (4, 5, 1), (0.25, 0.2, 1), "um", (NO_DEPTH,)),
        ("unit=um\nspacing=2.0\n", None, (1, 1, 2), "um", (NO_SIZE,)),
        ("unit=um\n", None, (1, 1, 1), "um", (NO_SIZE, NO_DEPTH)),
        ("unit=um\nspacing=2.0\n", (72, 72, 2), (1, 1, 2), "um", (NO_SIZE,)),
        # a unit and a tag of another
        ("unit=um\nspacing=2.0\n", (20000, 10000, 3), (0.5, 1, 2), "um", ()),
        ("unit=\\u00B5m\nspacing=2.0\n", (20000, 10000, 3), (0.5, 1, 2), "um", ("taken per cm",)),
        ("unit=mm\nspacing=2.0\n", (4, 5, 3), (250, 200, 2000), "um", ("taken per mm",)),
        ("unit=um\nspacing=2.0\n", (4, 5, 2), (0.25, 0.2, 2), "um", ("taken per um",)),
    ],
)
def test_imagej_sizes_that_are_half_known(
    tmp_path: Path, text: str, tags: tuple | None, spacing: tuple, unit: str, told: tuple
) -> None:
    """Expected as ij.io.TiffDecoder and ij.io.FileOpener take them, except of dots per inch or cm without a unit."""
    source = described(tmp_path / "a.tif", f"images=4\nslices=4\n{text}", tags)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        volume = read_volume(source)
        assert read_volume(source, ReadOptions(spacing=(1, 2, 3))).spacing == (1, 2, 3)
    messages = [str(w.message) for w in caught if w.category is UserWarning]
    assert volume.spacing == pytest.approx(spacing, rel=1e-9)
    assert volume.unit == unit
    assert len(messages) == bool(told)
    assert all(part in messages[0] for part in told)


def test_sizes_that_are_no_numbers(tmp_path: Path) -> None:
    comma = described(tmp_path / "a.tif", "images=4\nslices=4\nunit=um\nspacing=2,5\n", (4, 4, 1))
    with pytest.raises(UsageError, match=r"spacing is '2,5'; expected a number; try --spacing X Y Z"):
        read_volume(comma)
    assert read_volume(comma, ReadOptions(spacing=(1, 1, 2.5))).spacing == (1, 1, 2.5)
    sizes = {"PhysicalSizeX": "0,5", "PhysicalSizeY": 0.5, "PhysicalSizeZ": 2}
    with pytest.raises(UsageError, match=r"PhysicalSizeX is '0,5'; expected a number"):
        read_volume(write_ome(tmp_path / "a.ome.tif", VALUES[0, 0], "ZYX", sizes))
    source = write_ome(tmp_path / "b.ome.tif", VALUES[0, 0], "ZYX", {"PhysicalSizeZ": 2})
    with pytest.warns(UserWarning, match="no width or no height of its pixels; taken as 2 "):
        assert read_volume(source).spacing == (2, 2, 2)


def test_sizes_of_scifio(tmp_path: Path) -> None:
    """SCIFIO's description has ImageJ's fields and lists of its own."""
    text = "axes=X,Y,Z\nlengths=5,6,4\nscales=0.5,0.25,2.0\nunits=um,um,um\nimages=4\nslices=4\nunit=um\n"
    path = Path(described(tmp_path / "a.tif", text, (1, 1, 1)))
    path.write_bytes(path.read_bytes().replace(b"ImageJ=1.53c", b"SCIFIO=0.3.4"))
    volume = read_volume(str(path))
    assert (volume.spacing, volume.unit) == ((0.5, 0.25, 2), "um")


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("dtype", "shift"), [("u1", 0), ("u2", 1), ("f4", 2)])
def test_one_directory_for_all_planes(tmp_path: Path, order: str, dtype: str, shift: int) -> None:
    """ImageJ and tifffile write stacks beyond 4 GB so; data may begin at any byte."""
    path, order_of = tmp_path / "a.tif", VALUES.transpose(0, 2, 1, 3, 4).astype(dtype)
    for how, axes, values, options in (
        ({"imagej": True}, "ZYX", order_of[0, :, 0], [{}]),
        ({"imagej": True}, "TZCYX", order_of, [{"time": t, "component": c} for t in range(T) for c in range(C)]),
        ({"imagej": True}, "TZYX", order_of[:, :, 0], [{"time": t} for t in range(T)]),
        ({"photometric": "minisblack"}, "TCZYX", VALUES.astype(dtype), [{"time": 1, "component": 1}]),
        ({"photometric": "minisblack"}, "ZYX", order_of[0, :, 0], [{}]),
    ):
        tifffile.imwrite(path, values, truncate=True, byteorder=order, metadata={"axes": axes}, **how)
        with tifffile.TiffFile(path) as file:
            assert len(file.pages) == 1
            tag, begin = file.pages[0].tags[273], int(file.pages[0].dataoffsets[0])
        body = bytearray(path.read_bytes())
        struct.pack_into(order + "I", body, tag.valueoffset, begin + shift)
        path.write_bytes(body[:begin] + bytes(shift) + body[begin:])
        expected = tifffile.imread(path)
        np.testing.assert_array_equal(expected, values)
        for chosen in options:
            for stored in (False, True):
                volume = read_volume(str(path), ReadOptions(stored=stored, **chosen))
                assert not stored or is_file_backed(volume)
                index = [chosen["time" if a == "T" else "component"] if a in "TC" else slice(None) for a in axes]
                np.testing.assert_array_equal(volume.data[:, :, :], expected[tuple(index)])
        path.write_bytes(path.read_bytes()[:-7])
        for stored in (False, True):
            with pytest.raises(DataError, match=r"7 bytes.*missing.*is it whole"):
                read_volume(str(path), ReadOptions(stored=stored, **options[0]))


def test_one_directory_beyond_four_gigabytes(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    with pytest.warns(UserWarning, match="truncating ImageJ file"):
        tifffile.imwrite(
            path, shape=(560, 2048, 2048), dtype="u2", byteorder=">", imagej=True, metadata={"axes": "ZYX"}
        )
    if path.stat().st_blocks > 1000:
        pytest.skip("the disk has no sparse files")
    with open(path, "r+b") as file:
        file.seek(-6, 2)
        file.write(np.arange(7, 10, dtype=">u2").tobytes())
    for stored in (False, True):
        volume = read_volume(str(path), ReadOptions(stored=stored))
        assert volume.dims == (2048, 2048, 560)
        assert volume.data[559:, 2047:, 2044:].ravel().tolist() == [0, 7, 8, 9]


def test_planes_that_only_images_counts(tmp_path: Path) -> None:
    """Old versions of ImageJ write images= alone."""
    path, values = tmp_path / "a.tif", VALUES[0, 0]
    tifffile.imwrite(path, values, imagej=True, truncate=True, metadata={"axes": "ZYX"})
    body = path.read_bytes()
    assert body.count(b"slices=4") == 1
    path.write_bytes(body.replace(b"slices=4", b"sliced=4"))
    np.testing.assert_array_equal(read_volume(str(path)).data, values)
    path.write_bytes(body.replace(b"slices=4", b"sliced=4").replace(b"images=4", b"images=6"))
    with pytest.raises(DataError, match=r"6 images that are not there \(120 bytes are missing\)"):
        read_volume(str(path))


def test_slices_without_a_distance_are_as_far_apart_as_pixels_and_that_is_said(tmp_path: Path) -> None:
    source = write_ome(tmp_path / "a.ome.tif", VALUES[0, 0], "ZYX", {"PhysicalSizeX": 0.5, "PhysicalSizeY": 0.5})
    with pytest.warns(UserWarning, match=r"no distance between its slices; taken as wide as its pixels"):
        assert read_volume(source).spacing == (0.5, 0.5, 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_volume(source, ReadOptions(spacing=(1, 1, 2))).spacing == (1, 1, 2)


def test_several_series(tmp_path: Path) -> None:
    path = tmp_path / "a.ome.tif"
    with tifffile.TiffWriter(path, ome=True) as writer:
        for name, values, size in (("overview", VALUES[0, 0], 5.0), ("detail", VALUES[0, 1, :, :, :3], 0.5)):
            told = {"axes": "ZYX", "Name": name, "PhysicalSizeX": size}
            writer.write(values, metadata=told, photometric="minisblack")
    with pytest.raises(
        UsageError, match=r"2 series: 0 'overview' \(4 x 6 x 5, axes ZYX, uint16\); 1 'detail'.*--series"
    ):
        read_volume(str(path))
    for wanted in ("1", "detail"):
        with pytest.warns(UserWarning, match="no distance"):
            volume = read_volume(str(path), ReadOptions(array=wanted))
        np.testing.assert_array_equal(volume.data, VALUES[0, 1, :, :, :3])
        assert volume.spacing[0] == 0.5


@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_samples_of_a_pixel_are_channels(tmp_path: Path, planar: str, compression: str | None) -> None:
    values = np.random.default_rng(0).integers(0, 255, (Z, Y, X, 3)).astype("u1")
    stored = values if planar == "contig" else np.moveaxis(values, -1, 1)
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", planarconfig=planar, compression=compression)
    for c in range(3):
        volume = read_volume(str(tmp_path / "a.tif"), ReadOptions(component=c))
        np.testing.assert_array_equal(volume.data, values[..., c])


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_samples_count_faster_than_channels(tmp_path: Path, compression: str | None) -> None:
    values = np.random.default_rng(0).integers(0, 255, (2, Z, Y, X, 3)).astype("u1")
    axes = {"axes": "CZYXS"}
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb", metadata=axes, compression=compression)
    for number in range(6):
        volume = read_volume(str(tmp_path / "a.tif"), ReadOptions(component=number))
        np.testing.assert_array_equal(volume.data, values[number // 3, ..., number % 3])


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_numbers_are_as_stored(tmp_path: Path, compression: str | None) -> None:
    path = tmp_path / "a.tif"
    for dtype in ("u1", "u2", "i2", "f4"):  # where 0 is white too
        values = VALUES[0, 0].astype(dtype)
        tifffile.imwrite(path, values, photometric="miniswhite", compression=compression)
        np.testing.assert_array_equal(read_volume(str(path)).data, values)
    for dtype in ("f2", "u8", "f8"):
        values = VALUES[0, 0].astype(dtype)
        tifffile.imwrite(path, values, photometric="minisblack", compression=compression)
        volume = read_volume(str(path))
        np.testing.assert_array_equal(volume.data, values)
        assert volume.data.dtype == dtype
    tifffile.imwrite(path, VALUES[0, 0] > 100, photometric="minisblack", compression=compression)
    np.testing.assert_array_equal(read_volume(str(path)).data, VALUES[0, 0] > 100)


def test_twelve_bits_and_lzma_without_imagecodecs(tmp_path: Path) -> None:
    values = np.arange(24, dtype=np.uint16).reshape(4, 6) * 170
    bits = "".join(f"{v:012b}" for v in values.ravel())
    packed = int(bits, 2).to_bytes(len(bits) // 8, "big")
    tags = [
        *((256, 3, 1, 6), (257, 3, 1, 4), (258, 3, 1, 12), (259, 3, 1, 1), (262, 3, 1, 1)),
        *((273, 4, 1, 8 + 2 + 9 * 12 + 4), (277, 3, 1, 1), (278, 3, 1, 4), (279, 4, 1, len(packed))),
    ]
    head = b"MM\0*" + struct.pack(">IH", 8, 9)
    for tag, kind, n, value in tags:
        head += struct.pack(">HHI", tag, kind, n) + struct.pack(">HH" if kind == 3 else ">I", *([value, 0][: 5 - kind]))
    (tmp_path / "a.tif").write_bytes(head + bytes(4) + packed)
    np.testing.assert_array_equal(read_volume(str(tmp_path / "a.tif")).data[0], values)
    tifffile.imwrite(tmp_path / "b.tif", VALUES[0, 0], compression="lzma", photometric="minisblack")
    np.testing.assert_array_equal(read_volume(str(tmp_path / "b.tif")).data, VALUES[0, 0])


@pytest.mark.parametrize(
    ("tag", "value", "told"),
    [
        ((279, 4), 1 << 31, "has a part of 2147483648 bytes at"),
        ((257, 3), 9000 * Y, "has 1 parts; expected 9000"),
    ],
)
def test_parts_that_are_not_there(tmp_path: Path, tag: tuple[int, int], value: int, told: str) -> None:
    """Sizes of gigabytes and thousands of strips are refused before they are made room for, or looped over."""
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, VALUES[0, 0, 0], compression="lzma", photometric="minisblack", rowsperstrip=Y)
    with tifffile.TiffFile(path) as file:
        found = file.pages[0].tags[tag[0]]
        place, kind = found.offset, found.dtype
    data = bytearray(path.read_bytes())
    data[place : place + 12] = struct.pack("<HHI", tag[0], kind, 1) + struct.pack("<I", value)
    path.write_bytes(data)
    with pytest.raises(DataError, match=told):
        read_volume(str(path))


def test_a_coding_without_a_decoder_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, VALUES[0, 0], photometric="minisblack", compression="zlib")
    zlib, jpeg2000 = struct.pack("<HHII", 259, 3, 1, 8), struct.pack("<HHII", 259, 3, 1, 34712)
    assert path.read_bytes().count(zlib) == Z
    path.write_bytes(path.read_bytes().replace(zlib, jpeg2000))
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    with pytest.raises(DataError, match=r"coded as JPEG2000 need imagecodecs .*try: pip install imagecodecs"):
        read_volume(str(path))


def test_sets_of_files(tmp_path: Path) -> None:
    """One OME-TIFF over two files: each names the other."""
    names = ["a.ome.tif", "b.ome.tif"]
    planes = "".join(
        f'<TiffData IFD="{z % 2}" FirstZ="{z}" PlaneCount="1"><UUID FileName="{names[z // 2]}">urn:uuid:{z // 2}</UUID>'
        "</TiffData>" for z in range(Z)
    )  # fmt: skip
    for k, name in enumerate(names):
        xml = (
            f'<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="urn:uuid:{k}"><Image ID="Image:0">'
            f'<Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="uint16" SizeX="{X}" SizeY="{Y}" SizeZ="{Z}" SizeC="1" '
            f'SizeT="1" PhysicalSizeX="2" PhysicalSizeY="2" PhysicalSizeZ="3">{planes}</Pixels></Image></OME>'
        )
        tifffile.imwrite(
            tmp_path / name, VALUES[0, 0, 2 * k : 2 * k + 2], description=xml, metadata=None, photometric="minisblack"
        )
    for name in names:
        volume = read_volume(str(tmp_path / name))
        np.testing.assert_array_equal(volume.data, VALUES[0, 0])
        assert volume.spacing == (2, 2, 3)
    (tmp_path / names[1]).unlink()
    with pytest.raises(DataError, match=r"OME-XML names the file b.ome.tif, which is not beside it"):
        read_volume(str(tmp_path / names[0]))
    xml_of(tmp_path / names[0], 'FileName="b.ome.tif"', 'FileName="/etc/pass"')
    with pytest.raises(DataError, match=r"names the file '/etc/pass'; expected names in its own folder"):
        read_volume(str(tmp_path / names[0]))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('SizeZ="4"', 'SizeZ="9"', "30 of 54 planes are missing, the first is number 24"),
        ('SizeZ="4"', 'SizeZ="0"', "OME-XML of sizes"),
        ('SizeT="3"', 'SizeT="99999999"', "OME-XML of sizes"),
        ('PlaneCount="24"', 'PlaneCount="-1"', "TiffData of .*-1"),
        ('PlaneCount="24"', 'PlaneCount="99999999999"', "TiffData of"),
        ('DimensionOrder="XYZCT"', 'DimensionOrder="XXZCT"', "DimensionOrder 'XXZCT'"),
        ('PhysicalSizeX="0.2"', 'PhysicalSizeX="1" PhysicalSizeXUnit="pixel"', "pixel, µm, nm; expected one unit"),
        ("</Pixels>", "</Pixel>", "damaged OME-XML"),
        ("<Pixels", "<!DOCTYPE a [<!ENTITY b 'c'>]><Pixels", "declares entities"),
        ("<TiffData", '<x><AlongZ Start="0" End="1e9" Step="1e-9"/></x><TiffData', "AlongZ from 0"),
        ("<Pixels", '<BinaryOnly MetadataFile="all.companion.ome"/><Pixels', "OME-XML is in all.companion.ome"),
    ],
)
def test_xml_that_lies(tmp_path: Path, old: str, new: str, message: str) -> None:
    write_ome(tmp_path / "a.ome.tif")
    with tifffile.TiffFile(tmp_path / "a.ome.tif") as file:
        xml = file.ome_metadata
    assert xml is not None
    assert old in xml
    changed = xml.replace(old, new).encode()
    flat = VALUES.reshape(-1, Y, X)
    tifffile.imwrite(tmp_path / "a.ome.tif", flat, description=changed, metadata=None, photometric="minisblack")
    with pytest.raises(VvgtError, match=message) as caught:
        read_volume(str(tmp_path / "a.ome.tif"), ReadOptions(time=0, component=0))
    assert "\n" not in str(caught.value)


def test_other_axes_and_palettes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, VALUES[0], metadata={"axes": "RZYX"}, photometric="minisblack")
    with pytest.raises(DataError, match="axes 2 R, 4 slices, 6 rows, 5 columns; expected"):
        read_volume(str(path))
    table = np.zeros((3, 256), "u2")
    tifffile.imwrite(path, VALUES[0, 0].astype("u1"), photometric="palette", colormap=table)
    with pytest.raises(DataError, match="numbers of a palette's colours"):
        read_volume(str(path))


def test_a_page_that_unpacks_to_more_than_itself(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((2, 64, 64), "u8"), compression="zlib", photometric="minisblack", rowsperstrip=64)
    body = path.read_bytes()
    for tag in (256, 257):
        wide = struct.pack("<HHII", tag, 4, 1, 64)
        assert wide in body
        body = body.replace(wide, struct.pack("<HHII", tag, 4, 1, 8))
    path.write_bytes(body)
    with pytest.raises(DataError, match="unpacks to more than its 512 bytes"):
        read_volume(str(path))


def test_info_and_a_series_of_one_file(vvgt, tmp_path: Path) -> None:
    source = write_ome(tmp_path / "a.ome.tif")
    done = vvgt("info", source, "--channel", "GFP", "--time", "2", "--json")
    assert done.code == 0, done.err
    facts = json.loads(done.out)
    assert facts["dims"] == [X, Y, Z]
    assert facts["range"] == [VALUES[2, 1].min(), VALUES[2, 1].max()]
    told = json.loads(vvgt("info", source, "--json").out)
    assert (told["time_steps"], told["channels"]) == (3, 2)
    assert [row["choice"] for row in told["choices"]] == ["--channel 0", "--channel 1"]
    assert told["choices"][1]["range"] == [VALUES[0, 1].min(), VALUES[0, 1].max()]
    assert "2 channels (0 'DAPI', 1 'GFP')" in vvgt("init", source, "--time", 0, "--tf", "hot", "-o", "a.ply").error
    assert json.loads(vvgt("info", source, "--channel", "1", "--json").out)["time_steps"] == 3
