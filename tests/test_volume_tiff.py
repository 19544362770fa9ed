"""TIFF as microscopes write it: axes, channels, time steps and sizes of OME-TIFF and ImageJ, several series."""

import itertools
import json
import struct
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import tifffile

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError, VvgtError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.label_maps import recognised

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
        (source, {"component": 2, "time": 0}, r"2 channels .*, not channel 2; expected one"),
        (source, {"component": "RFP", "time": 0}, r"'GFP'\) of type uint16, not channel 'RFP'"),
        (source, {"component": 1}, r"3 time steps; expected one: try --time N \(0 to 2\).*-o 'p_{:02d}.ply'"),
        (source, {"component": 1, "time": 3}, r"--time 3: expected a time step from 0 to 2"),
        (still, {"time": 1}, r"--time 1: it has 1 time step; leave out --time"),
        (still, {"component": 1}, r"1 channel of type uint16; leave out --channel 1"),
        (still, {"component": "magnitude"}, r"1 channel of type uint16; leave out --channel magnitude"),
        (still, {"array": "7"}, r"0 series '7'; it has 0"),
    ):
        refused(UsageError, message, read_volume, path, ReadOptions(**options))
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
    axes = {"axes": "ZYXS" if planar == "contig" else "ZSYX"}
    tifffile.imwrite(tmp_path / "a.ome.tif", stored, photometric="rgb", planarconfig=planar, metadata=axes)
    refused(UsageError, ": 3 components of type uint8;", read_volume, str(tmp_path / "a.ome.tif"))
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
    refused(DataError, told, read_volume, str(path))


def test_a_coding_without_a_decoder_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, VALUES[0, 0], photometric="minisblack", compression="zlib")
    zlib, jpeg2000 = struct.pack("<HHII", 259, 3, 1, 8), struct.pack("<HHII", 259, 3, 1, 34712)
    assert path.read_bytes().count(zlib) == Z
    path.write_bytes(path.read_bytes().replace(zlib, jpeg2000))
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    refused(DataError, r"coded as JPEG2000 need imagecodecs .*try: pip install imagecodecs", read_volume, str(path))


def write_set(folder: Path, names: list[str], now: list[str], root: bool = True, companion: bool = False) -> None:
    """Write the slices of one image over files that are called ``now``, in whose XML they have ``names``."""
    planes = "".join(
        f'<TiffData IFD="{z * len(names) % Z // len(names)}" FirstZ="{z}" PlaneCount="1"><UUID FileName="{name}">'
        f"urn:uuid:{names.index(name)}</UUID></TiffData>" for z, name in enumerate(np.repeat(names, Z // len(names)))
    )  # fmt: skip
    image = (
        f'<Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="uint16" SizeX="{X}" SizeY="{Y}" '
        f'SizeZ="{Z}" SizeC="1" SizeT="1" PhysicalSizeX="2" PhysicalSizeY="2" PhysicalSizeZ="3">{planes}</Pixels>'
        "</Image>"
    )
    deep = Z // len(names)
    for k, name in enumerate(now):
        uuid = f' UUID="urn:uuid:{k}"' if root else ""
        inner = '<BinaryOnly MetadataFile="all.companion.ome" UUID="urn:uuid:9"/>' if companion else image
        xml = f"<OME{uuid}>{inner}</OME>"
        pages = VALUES[0, 0, deep * k : deep * (k + 1)]
        tifffile.imwrite(folder / name, pages, description=xml, metadata=None, photometric="minisblack")
    if companion:
        (folder / "all.companion.ome").write_text(f'<OME UUID="urn:uuid:9">{image}</OME>')


def test_sets_of_files(tmp_path: Path) -> None:
    """One OME-TIFF over two files: each names the other."""
    names = ["a.ome.tif", "b.ome.tif"]
    write_set(tmp_path, names, names)
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


@pytest.mark.parametrize(("files", "root", "companion"), [
    (1, True, False), (1, False, False), (2, True, False), (1, True, True), (2, True, True), (1, False, True),
])  # fmt: skip
def test_renamed_files_are_known_by_their_uuid(tmp_path: Path, files: int, root: bool, companion: bool) -> None:
    names, now = [f"old{k}.ome.tif" for k in range(files)], [f"new{k}.ome.tif" for k in range(files)]
    write_set(tmp_path, names, now, root, companion)
    for name in now:
        volume = read_volume(str(tmp_path / name))
        np.testing.assert_array_equal(volume.data, VALUES[0, 0])
        assert volume.spacing == (2, 2, 3)
        stored = read_volume(str(tmp_path / name), ReadOptions(stored=True))
        np.testing.assert_array_equal(stored.data[:], VALUES[0, 0])
    if files == 2:
        (tmp_path / now[1]).unlink()
        refused(
            DataError, r"names the file old1\.ome\.tif, which is not beside it", read_volume, str(tmp_path / now[0])
        )
    if companion:
        (tmp_path / "all.companion.ome").unlink()
        refused(DataError, "is in all.companion.ome, which is not beside it", read_volume, str(tmp_path / now[0]))


def test_a_copy_is_read_itself_and_a_foreign_name_is_said(tmp_path: Path) -> None:
    """The original of a renamed copy may lie beside it, with other values."""
    write_set(tmp_path, ["old.ome.tif"], ["new.ome.tif"])
    tifffile.imwrite(tmp_path / "old.ome.tif", 0 * VALUES[0, 0])
    np.testing.assert_array_equal(read_volume(str(tmp_path / "new.ome.tif")).data, VALUES[0, 0])
    (tmp_path / "old.ome.tif").unlink()
    xml_of(tmp_path / "new.ome.tif", '<OME UUID="urn:uuid:0"', '<OME UUID="urn:uuid:8"')
    with pytest.warns(UserWarning, match="names old.ome.tif, which is not here; its own pages are read"):
        np.testing.assert_array_equal(read_volume(str(tmp_path / "new.ome.tif")).data, VALUES[0, 0])


def test_images_of_the_xml_without_pages_leave_the_others_their_sizes(tmp_path: Path) -> None:
    pixels = f'<Pixels DimensionOrder="XYZCT" Type="uint16" SizeX="{X}" SizeY="{Y}" SizeZ="{Z}" SizeC="1" SizeT="1" '
    images = [
        f'<Image Name="{name}">{pixels}PhysicalSizeX="{size}" PhysicalSizeY="2" PhysicalSizeZ="3"><TiffData IFD="{at}" '
        f'PlaneCount="{Z}"/></Pixels></Image>' for name, size, at in (("far", 9, 100), ("near", 1, 0))
    ]  # fmt: skip
    for name, read in (("near", True), ("far", False)):
        xml = f"<OME>{images[0]}{images[1].replace('near', name)}</OME>"
        tifffile.imwrite(tmp_path / "a.ome.tif", VALUES[0, 0], description=xml, metadata=None)
        if read:
            assert read_volume(str(tmp_path / "a.ome.tif")).spacing == (1, 2, 3)
        else:
            refused(DataError, "OME-XML of 2 images, pages of 1", read_volume, str(tmp_path / "a.ome.tif"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('SizeZ="4"', 'SizeZ="9"', "30 of 54 planes are missing, the first is number 24"),
        ('SizeT="3"', 'SizeT="99999999"', "OME-XML of sizes"),
        ('PlaneCount="24"', 'PlaneCount="99999999999"', "TiffData of"),
        ('PhysicalSizeX="0.2"', 'PhysicalSizeX="1" PhysicalSizeXUnit="pixel"', "pixel, µm, nm; expected one unit"),
        ("<Pixels", "<!DOCTYPE a [<!ENTITY b 'c'>]><Pixels", "with entities"),
        ("<TiffData", '<x><AlongZ Start="0" End="1e9" Step="1e-9"/></x><TiffData', "AlongZ from 0"),
    ],
)
def test_xml_that_lies(tmp_path: Path, old: str, new: str, message: str) -> None:
    write_ome(tmp_path / "a.ome.tif")
    with tifffile.TiffFile(tmp_path / "a.ome.tif") as file:
        xml = file.ome_metadata
    assert old in xml
    changed = xml.replace(old, new).encode()
    flat = VALUES.reshape(-1, Y, X)
    tifffile.imwrite(tmp_path / "a.ome.tif", flat, description=changed, metadata=None, photometric="minisblack")
    refused(VvgtError, message, read_volume, str(tmp_path / "a.ome.tif"), ReadOptions(time=0, component=0))


def test_other_axes_and_palettes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, VALUES[0], metadata={"axes": "RZYX"}, photometric="minisblack")
    refused(DataError, "axes 2 R, 4 slices, 6 rows, 5 columns; expected", read_volume, str(path))
    tifffile.imwrite(path, VALUES[0, :, :1], metadata={"axes": "IZYX"}, photometric="minisblack")
    np.testing.assert_array_equal(read_volume(str(path)).data, VALUES[0, :, 0])
    table = np.zeros((3, 256), "u2")
    tifffile.imwrite(path, VALUES[0, 0].astype("u1"), photometric="palette", colormap=table)
    refused(DataError, "numbers of a palette's colours", read_volume, str(path))


def test_a_page_that_unpacks_to_more_than_itself(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((2, 64, 64), "u8"), compression="zlib", photometric="minisblack", rowsperstrip=64)
    body = path.read_bytes()
    for tag in (256, 257):
        wide = struct.pack("<HHII", tag, 4, 1, 64)
        assert wide in body
        body = body.replace(wide, struct.pack("<HHII", tag, 4, 1, 8))
    path.write_bytes(body)
    refused(DataError, "unpacks to more than its 512 bytes", read_volume, str(path))


def test_info_and_a_series_of_one_file(vvgt, tmp_path: Path) -> None:
    source = write_ome(tmp_path / "a.ome.tif")
    facts = json.loads(vvgt.ok("info", source, "--channel", "GFP", "--time", "2", "--json").out)
    assert facts["dims"] == [X, Y, Z]
    assert facts["range"] == [VALUES[2, 1].min(), VALUES[2, 1].max()]
    told = json.loads(vvgt("info", source, "--json").out)
    assert (told["time_steps"], told["channels"]) == (3, 2)
    assert [row["choice"] for row in told["choices"]] == ["--channel 0", "--channel 1"]
    assert told["choices"][1]["range"] == [VALUES[0, 1].min(), VALUES[0, 1].max()]
    assert "2 channels (0 'DAPI', 1 'GFP')" in vvgt("init", source, "--time", 0, "--tf", "hot", "-o", "a.ply").error
    assert json.loads(vvgt("info", source, "--channel", "1", "--json").out)["time_steps"] == 3


@pytest.mark.parametrize("spacing", [None, (1, 2, 3)])
@pytest.mark.parametrize(
    ("missing", "color"), [("none", False), ("0", True), ("-9999", False), ("-nan", False), ("nan", True)]
)
def test_what_is_not_read_of_other_tags_is_said(
    tmp_path: Path, missing: str, color: bool, spacing: tuple | None
) -> None:
    tags = [(42113, "s", 0, missing, True), (33550, "d", 3, (30.0, 30.0, 0.0), True)]
    how = {"photometric": "rgb" if color else "minisblack", "extratags": tags}
    tifffile.imwrite(tmp_path / "v.tif", np.ones((4, 5, 3) if color else (3, 4, 5), "u1"), **how)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        read_volume(str(tmp_path / "v.tif"), ReadOptions(spacing=spacing, component=0 if color else None))
    text = " ".join(str(one.message) for one in told)
    assert ("sizes in ModelPixelScale are not read; --spacing X Y Z sets them" in text) == (spacing is None)
    unread = missing in ("none", "0")
    assert (f"voxels of {missing} (GDAL_NODATA) are read as values, not as missing" in text) == unread
    assert len(told) == (spacing is None) + unread


def test_missing_values_of_some_slices_and_of_label_maps(tmp_path: Path) -> None:
    tags, label = {"extratags": [(42113, "s", 0, "-3.e0", True)]}, {"extratags": [(42113, "s", 0, "0", True)]}
    for k, how in enumerate((tags, {})):
        tifffile.imwrite(tmp_path / f"s{k}.tif", np.full((4, 5), -3, "i2"), photometric="minisblack", **how)
    volume = read_volume(str(tmp_path / "s*.tif"))
    assert np.isnan(volume.data[0]).all()
    assert (volume.data[1] == -3).all()
    labels = np.arange(60, dtype="u1").reshape(3, 4, 5) // 20
    tifffile.imwrite(tmp_path / "labels.tif", labels, photometric="minisblack", **label)
    assert recognised(read_volume(str(tmp_path / "labels.tif")))


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize(("kind", "missing"), [("u2", "7"), ("i2", "-9999"), ("f4", "-3.4028234663852886e+38")])
def test_missing_values_of_gdal_are_unknown(tmp_path: Path, kind: str, missing: str, compression: str | None) -> None:
    values = VALUES[0].astype(kind) + np.array(20, kind)  # channels, slices, rows, columns
    how = {"photometric": "minisblack", "compression": compression, "extratags": [(42113, "s", 0, missing, True)]}
    for name in ("whole", "holed"):
        tifffile.imwrite(tmp_path / f"{name}.tif", values[1], **how)
        values[1, 1, 2, 3] = float(missing)
    tifffile.imwrite(tmp_path / "both.tif", values, ome=True, metadata={"axes": "CZYX"}, **how)
    expected = values.astype("f8")
    expected[1, 1, 2, 3] = np.nan
    assert read_volume(str(tmp_path / "whole.tif")).data.dtype == kind
    for stored in (False, True):
        data = read_volume(str(tmp_path / "holed.tif"), ReadOptions(stored=stored)).data
        np.testing.assert_array_equal(data[:], expected[1])
        assert data.dtype == np.float32 == data[:1].dtype
    norm = read_volume(str(tmp_path / "both.tif"), ReadOptions(component="magnitude"))
    np.testing.assert_allclose(norm.data, np.linalg.norm(expected, axis=0), rtol=1e-6)
    for k, plane in enumerate(values[1]):
        tifffile.imwrite(tmp_path / f"z{k}.tif", plane, **how)
    np.testing.assert_array_equal(read_volume(str(tmp_path / "z*.tif")).data, expected[1])
