"""Text headers beside or before raw data: NRRD, MetaImage, Inviwo."""

import bz2
import gzip
import zlib
from pathlib import Path

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, read_volume

VALUES = np.random.default_rng(1).integers(-30000, 30000, (3, 4, 5), np.int16)
NRRD_TYPES = {
    "int8": "i1", "uchar": "u1", "short": "i2", "unsigned short": "u2", "int": "i4", "uint32": "u4",
    "long long int": "i8", "uint64": "u8", "float": "f4", "double": "f8",
}  # fmt: skip


def nrrd(fields: dict[str, object], data: bytes = b"") -> bytes:
    base: dict[str, object] = {"type": "short", "dimension": 3, "sizes": "5 4 3", "endian": "little", "encoding": "raw"}
    lines = ["NRRD0005", "# a comment", "key:=a value"]
    lines += [f"{k}: {v}" for k, v in (base | fields).items() if v is not None]
    return ("\n".join(lines) + "\n\n").encode() + data


def write(path: Path, data: bytes) -> str:
    path.write_bytes(data)
    return str(path)


@pytest.mark.parametrize(("name", "code"), NRRD_TYPES.items())
@pytest.mark.parametrize("endian", ["little", "big"])
def test_nrrd_types(tmp_path: Path, name: str, code: str, endian: str) -> None:
    values = np.arange(60).reshape(3, 4, 5).astype((">" if endian == "big" else "<") + code)
    volume = read_volume(write(tmp_path / "v.nrrd", nrrd({"type": name, "endian": endian}, values.tobytes())))
    assert volume.data.dtype == values.dtype
    assert isinstance(volume.data, np.memmap)
    np.testing.assert_array_equal(volume.data, values)


@pytest.mark.parametrize("detached", [False, True])
@pytest.mark.parametrize(
    ("encoding", "pack"),
    [
        ("raw", bytes),
        ("gzip", gzip.compress),
        ("bz2", bz2.compress),
        ("ascii", lambda b: " ".join(map(str, np.frombuffer(b, "<i2"))).encode()),
    ],
)
def test_nrrd_encodings(tmp_path: Path, detached: bool, encoding: str, pack) -> None:
    data = pack(VALUES.astype("<i2").tobytes())
    if detached:
        (tmp_path / "v.bin").write_bytes(data)
        source = write(tmp_path / "v.nhdr", nrrd({"encoding": encoding, "data file": "v.bin"}))
    else:
        source = write(tmp_path / "v.nrrd", nrrd({"encoding": encoding}, data))
    volume = read_volume(source)
    np.testing.assert_array_equal(volume.data, VALUES)
    assert isinstance(volume.data, np.memmap) == (encoding == "raw")


def test_nrrd_skips(tmp_path: Path) -> None:
    body = VALUES.astype("<i2").tobytes()
    (tmp_path / "v.raw").write_bytes(b"one\ntwo\n" + b"abc" + body)
    for fields in ({"line skip": 2, "byte skip": 3}, {"byte skip": 11}, {"byte skip": -1}):
        source = write(tmp_path / "v.nhdr", nrrd({"data file": "v.raw"} | fields))
        np.testing.assert_array_equal(read_volume(source).data, VALUES)
    packed = nrrd({"encoding": "gzip", "byte skip": 3}, gzip.compress(b"abc" + body))
    np.testing.assert_array_equal(read_volume(write(tmp_path / "z.nrrd", packed)).data, VALUES)


def test_nrrd_geometry(tmp_path: Path) -> None:
    body = VALUES.astype("<i2").tobytes()
    volume = read_volume(write(tmp_path / "a.nrrd", nrrd({"spacings": "0.5 -2 nan"}, body)))
    assert volume.spacing == (0.5, 2.0, 1.0)
    fields = {"space": "RAS", "space directions": "(0,2,0) (-3, 0, 0) (0,0,4)", "space origin": "(1,2,3)"}
    volume = read_volume(write(tmp_path / "b.nrrd", nrrd(fields, body)))
    assert volume.spacing == (2.0, 3.0, 4.0)
    assert volume.origin == (1.0, 2.0, 3.0)
    assert volume.direction == (0, -1, 0, 1, 0, 0, 0, 0, 1)
    assert read_volume(str(tmp_path / "b.nrrd"), ReadOptions(spacing=(7, 8, 9))).spacing == (7, 8, 9)
    zero = write(tmp_path / "c.nrrd", nrrd({"spacings": "0 1 1"}, body))
    refused(DataError, "try --spacing X Y Z", read_volume, zero)
    assert read_volume(zero, ReadOptions(spacing=(1, 1, 1))).spacing == (1, 1, 1)


@pytest.mark.parametrize(
    ("fields", "axis"),
    [
        ({"sizes": "2 5 4 3", "kinds": "vector domain domain domain"}, 0),
        ({"sizes": "5 4 3 2", "kinds": "domain domain domain list"}, 3),
        ({"sizes": "2 5 4 3", "space directions": "none (1,0,0) (0,1,0) (0,0,1)"}, 0),
        ({"sizes": "2 5 4 3"}, 0),
    ],
)
def test_nrrd_components(tmp_path: Path, fields: dict, axis: int) -> None:
    both = np.stack([VALUES, VALUES // 3])  # (c, z, y, x)
    stored = np.moveaxis(both, 0, 3 - axis).astype("<i2")
    source = write(tmp_path / "v.nrrd", nrrd(fields | {"dimension": 4}, stored.tobytes()))
    with pytest.raises(UsageError, match=r"2 components of type int16.*--component 0 to 1, or --component magnitude"):
        read_volume(source)
    for c in (0, 1):
        np.testing.assert_array_equal(read_volume(source, ReadOptions(component=c)).data, both[c])
    norm = read_volume(source, ReadOptions(component="magnitude")).data
    assert norm.dtype == np.float32
    np.testing.assert_allclose(norm, np.hypot(both[0].astype(float), both[1]), rtol=1e-6)
    refused(UsageError, "not component 2", read_volume, source, ReadOptions(component=2))


@pytest.mark.parametrize("space", ["left-anterior-superior-time", "LAST"])
@pytest.mark.parametrize("kinds", [{}, {"kinds": "space space space space"}])
def test_nrrd_spaces_with_time(tmp_path: Path, space: str, kinds: dict) -> None:
    """More steps than voxels along x."""
    steps = np.stack([VALUES + k for k in range(6)]).astype("<i2")
    place = {"space": space, "space directions": "(2,0,0,0) (0,3,0,0) (0,0,4,0) (0,0,0,7)", "space origin": "(1,2,3,0)"}
    source = write(tmp_path / "v.nrrd", nrrd(place | kinds | {"dimension": 4, "sizes": "5 4 3 6"}, steps.tobytes()))
    volume = read_volume(source, ReadOptions(time=4))
    np.testing.assert_array_equal(volume.data, steps[4])
    np.testing.assert_allclose(volume.affine, [[-2, 0, 0, -1], [0, 3, 0, 2], [0, 0, 4, 3], [0, 0, 0, 1]])
    refused(UsageError, "6 time steps; expected one: try --time N", read_volume, source)
    place["space directions"] = "none (2,0,0,0) (0,3,0,0) (0,0,4,0)"
    parts = np.stack([VALUES + k for k in range(6)], -1).astype("<i2")
    source = write(tmp_path / "p.nrrd", nrrd(place | {"dimension": 4, "sizes": "6 5 4 3"}, parts.tobytes()))
    np.testing.assert_array_equal(read_volume(source, ReadOptions(component=2)).data, parts[..., 2])
    refused(UsageError, "no axis of time", read_volume, source, ReadOptions(time=2))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"sizes": "5 4 999999999999"}, "the file has"),
        ({"sizes": "5 4 4", "encoding": "gzip"}, "damaged gzip data"),
        ({"sizes": "5 4 many"}, "whole numbers of at least 1"),
        ({"dimension": 5, "sizes": "1 2 2 3 5"}, "spatial axes"),
        ({"endian": None}, "no field 'endian'"),
        ({"space directions": "(1,0,0) (0,1,0)"}, "expected 3 vectors"),
        ({"data file": "/etc/passwd"}, "header's own folder"),
        ({"data file": "none.raw"}, "does not exist beside it"),
        ({"data file": "v%02d.raw 0 9 1"}, "10 data files of 5 x 4 values"),
    ],
)
def test_nrrd_lies(tmp_path: Path, fields: dict, message: str) -> None:
    source = write(tmp_path / "v.nrrd", nrrd(fields, VALUES.astype("<i2").tobytes()))
    refused(DataError, message, read_volume, source)


def test_gzip_bomb_is_refused_before_unpacking(tmp_path: Path) -> None:
    source = write(
        tmp_path / "v.nrrd", nrrd({"encoding": "gzip", "sizes": "100000 100000 100000"}, gzip.compress(b"0"))
    )
    refused(DataError, "cannot hold", read_volume, source)


def test_data_file_may_not_leave_through_a_link(tmp_path: Path) -> None:
    outside, home = tmp_path / "outside.raw", tmp_path / "home"
    outside.write_bytes(VALUES.astype("<i2").tobytes())
    home.mkdir()
    (home / "v.raw").symlink_to(outside)
    source = write(home / "v.nhdr", nrrd({"data file": "v.raw"}))
    refused(DataError, "header's own folder", read_volume, source)
    (tmp_path / "v.nhdr").symlink_to(home / "w.nhdr")  # a link to both is fine
    write(home / "w.nhdr", nrrd({"data file": "w.raw"}))
    (home / "w.raw").write_bytes(outside.read_bytes())
    (tmp_path / "w.raw").symlink_to(home / "w.raw")
    np.testing.assert_array_equal(read_volume(str(tmp_path / "v.nhdr")).data, VALUES)


def meta(fields: dict[str, object]) -> bytes:
    base: dict[str, object] = {
        "ObjectType": "Image", "NDims": 3, "DimSize": "5 4 3", "ElementType": "MET_SHORT",
        "ElementDataFile": "v.raw",
    }  # fmt: skip
    merged = {k: v for k, v in (base | fields).items() if v is not None}
    last = merged.pop("ElementDataFile", None)
    lines = [f"{k} = {v}\n" for k, v in merged.items()]
    return "".join(lines + ([f"ElementDataFile = {last}\n"] if last else [])).encode()


@pytest.mark.parametrize("key", ["BinaryDataByteOrderMSB", "ElementByteOrderMSB"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("header", [0, 7, -1])
def test_metaimage(tmp_path: Path, key: str, big: bool, header: int) -> None:
    stored = VALUES.astype(">i2" if big else "<i2")
    (tmp_path / "v.raw").write_bytes(b"\0" * (7 if header else 0) + stored.tobytes())
    fields = {key: big, "HeaderSize": header, "ElementSpacing": "1 2 3.5", "Offset": "4 5 6"}
    volume = read_volume(write(tmp_path / "v.mhd", meta(fields)))
    assert isinstance(volume.data, np.memmap)
    assert (volume.spacing, volume.origin) == ((1, 2, 3.5), (4, 5, 6))
    np.testing.assert_array_equal(volume.data, VALUES)


def test_metaimage_with_a_negative_spacing_runs_the_other_way(tmp_path: Path) -> None:
    source = write(
        tmp_path / "v.mha",
        meta({"ElementSpacing": "1 -2 3", "ElementDataFile": "LOCAL"}) + VALUES.astype("<i2").tobytes(),
    )
    volume = read_volume(source)
    assert volume.spacing == (1, 2, 3)
    np.testing.assert_array_equal(volume.affine[:3, 1], [0, -2, 0])


@pytest.mark.parametrize(("stated", "modality"), [("MET_MOD_CT", "CT"), ("MET_MOD_MR", "MR"), ("MET_MOD_OTHER", "")])
def test_metaimage_states_its_modality_but_no_hounsfield_units(tmp_path: Path, stated: str, modality: str) -> None:
    body = meta({"Modality": stated, "ElementDataFile": "LOCAL"}) + VALUES.astype("<i2").tobytes()
    volume = read_volume(write(tmp_path / "v.mha", body))
    assert (volume.modality, volume.hounsfield) == (modality, False)


def test_metaimage_local_compressed_and_text(tmp_path: Path) -> None:
    body = VALUES.astype("<i2").tobytes()
    local = meta({"ElementDataFile": "LOCAL"}) + body
    volume = read_volume(write(tmp_path / "a.mha", local))
    assert isinstance(volume.data, np.memmap)
    assert (volume.spacing, volume.origin) == ((1, 1, 1), (0, 0, 0))
    np.testing.assert_array_equal(volume.data, VALUES)
    packed = meta({"ElementDataFile": "LOCAL", "CompressedData": True}) + zlib.compress(body)
    np.testing.assert_array_equal(read_volume(write(tmp_path / "b.mha", packed)).data, VALUES)
    refused(DataError, "damaged zlib", read_volume, write(tmp_path / "c.mha", packed[:-20]))
    text = meta({"ElementDataFile": "LOCAL", "BinaryData": False}) + b" ".join(b"%d" % v for v in VALUES.ravel())
    np.testing.assert_array_equal(read_volume(write(tmp_path / "d.mha", text)).data, VALUES)


def test_metaimage_components_and_steps(tmp_path: Path) -> None:
    channels = np.stack([VALUES, VALUES // 2, VALUES // 5], -1).astype("<i2")
    (tmp_path / "v.raw").write_bytes(channels.tobytes())
    source = write(tmp_path / "v.mhd", meta({"ElementNumberOfChannels": 3}))
    refused(UsageError, "3 components", read_volume, source)
    np.testing.assert_array_equal(read_volume(source, ReadOptions(component=2)).data, channels[..., 2])
    steps = np.moveaxis(channels, -1, 0).copy()
    (tmp_path / "v.raw").write_bytes(steps.tobytes())
    source = write(tmp_path / "t.mhd", meta({"NDims": 4, "DimSize": "5 4 3 3", "ElementSpacing": "1 2 3 9"}))
    volume = read_volume(source, ReadOptions(component=1))
    np.testing.assert_array_equal(volume.data, steps[1])
    assert volume.spacing == (1, 2, 3)
    both = np.stack([channels, 2 * channels])
    (tmp_path / "v.raw").write_bytes(both.tobytes())
    source = write(tmp_path / "b.mhd", meta({"NDims": 4, "DimSize": "5 4 3 2", "ElementNumberOfChannels": 3}))
    for number in range(6):
        volume = read_volume(source, ReadOptions(component=number))
        np.testing.assert_array_equal(volume.data, both[number // 3, ..., number % 3])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"DimSize": "5 4 99999999999"}, "the file has"),
        ({"ElementDataFile": "../v.raw"}, "header's own folder"),
        ({"ElementDataFile": None}, "no ElementDataFile"),
        ({"ElementSpacing": "1 one 1"}, "3 finite numbers"),
    ],
)
def test_metaimage_lies(tmp_path: Path, fields: dict, message: str) -> None:
    (tmp_path / "v.raw").write_bytes(VALUES.tobytes())
    refused(DataError, message, read_volume, write(tmp_path / "v.mhd", meta(fields)))


def dat(fields: dict[str, object]) -> bytes:
    base: dict[str, object] = {"RawFile": "v.raw", "Resolution": "5 4 3", "Format": "INT16"}
    return "".join(f"{k}: {v}\n" for k, v in (base | fields).items() if v is not None).encode()


def test_inviwo(tmp_path: Path) -> None:
    (tmp_path / "v.raw").write_bytes(b"abc" + VALUES.astype(">i2").tobytes())
    fields = {
        "ByteOffset": 3,
        "ByteOrder": "BigEndian",
        "BasisVector1": "10 0 0",
        "BasisVector2": "0 -2 0",
        "BasisVector3": "0 0 9 # edges of the box",
        "Offset": "1 2 3",
    }
    volume = read_volume(write(tmp_path / "v.dat", dat(fields)))
    assert isinstance(volume.data, np.memmap)
    np.testing.assert_array_equal(volume.data, VALUES)
    assert (volume.spacing, volume.origin) == ((2, 0.5, 3), (2, 1.75, 4.5))  # the offset is the corner of the box
    assert volume.direction == (1, 0, 0, 0, -1, 0, 0, 0, 1)
    rows = {"BasisVector1": "0 -4 0", "BasisVector2": "5 0 0", "BasisVector3": "0 0 3", "Offset": None}
    turned = read_volume(write(tmp_path / "t.dat", dat(fields | rows)))  # i along y, j along -x
    np.testing.assert_allclose(turned.affine[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(turned.affine @ (2, 1.5, 1, 1), (0, 0, 0, 1), atol=1e-12)  # centred without an offset


def test_inviwo_old_names_scaling_and_sequences(tmp_path: Path) -> None:
    (tmp_path / "v.raw").write_bytes(VALUES.tobytes())
    fields = {"RawFile": None, "ObjectFileName": "v.raw", "Format": "SHORT", "SliceThickness": "1 1 2.5"}
    volume = read_volume(write(tmp_path / "a.dat", dat(fields | {"DataRange": "0 1000", "ValueRange": "-1 1"})))
    assert volume.spacing == (1, 1, 2.5)
    assert volume.slope * 500 + volume.intercept == pytest.approx(0)
    assert volume.slope * 1000 + volume.intercept == pytest.approx(1)
    source = write(tmp_path / "b.dat", dat({"Resolution": "5 4 1", "Sequences": 3}))
    refused(UsageError, "3 components", read_volume, source)
    np.testing.assert_array_equal(read_volume(source, ReadOptions(component=2)).data, VALUES[2:])
    source = write(tmp_path / "c.dat", dat({"Resolution": "5 2 3", "Format": "Vec2INT16"}))
    np.testing.assert_array_equal(
        read_volume(source, ReadOptions(component=1)).data, VALUES.reshape(3, 2, 5, 2)[..., 1]
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"Resolution": None}, "no field 'resolution'"),
        ({"Resolution": "5 4 400"}, "the file has"),
        ({"RawFile": "/etc/passwd"}, "header's own folder"),
    ],
)
def test_inviwo_lies(tmp_path: Path, fields: dict, message: str) -> None:
    (tmp_path / "v.raw").write_bytes(VALUES.tobytes())
    refused(DataError, message, read_volume, write(tmp_path / "v.dat", dat(fields)))


def test_inviwo_of_voreen_and_units(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    (tmp_path / "v.raw").write_bytes(VALUES.astype(">i2").tobytes())
    fields = {"Resolution": "5 4 1", "ObjectModel": "RGB", "ByteOrder": "big-endian"}
    volume = read_volume(write(tmp_path / "a.dat", dat(fields)), ReadOptions(component=1))
    np.testing.assert_array_equal(volume.data, VALUES.reshape(1, 4, 5, 3)[..., 1])
    source = write(tmp_path / "b.dat", dat({"Resolution": "5 4 1", "NumFrames": 3, "ByteOrder": "bigEndian"}))
    np.testing.assert_array_equal(read_volume(source, ReadOptions(component=2)).data, VALUES[2:])
    assert not recwarn
    said = {"ValueName": "Density", "ValueUnit": "HU", "Axis1Unit": "mm", "Axis2Unit": "mm", "Axis3Unit": "um"}
    volume = read_volume(write(tmp_path / "c.dat", dat({"Spacing": "1 2 3000", **said})))
    assert (volume.quantity, volume.value_unit, volume.unit, volume.spacing) == ("Density", "HU", "mm", (1, 2, 3))
    read_volume(write(tmp_path / "d.dat", dat({"TransformMatrix": "row0 2 0 0 0"})))
    assert "TransformMatrix is not read" in str(recwarn.pop().message)


@pytest.mark.parametrize("name", ["v.mhd", "v.nhdr", "v.dat"])
def test_data_longer_than_declared_are_said(tmp_path: Path, recwarn: pytest.WarningsRecorder, name: str) -> None:
    (tmp_path / "v.raw").write_bytes(VALUES.tobytes() + bytes(60))
    header = {"v.mhd": meta({}), "v.nhdr": nrrd({"data file": "v.raw"}), "v.dat": dat({})}[name]
    np.testing.assert_array_equal(read_volume(write(tmp_path / name, header)).data, VALUES)
    assert "v.raw: 60 bytes behind the values that its header declares are not read" in str(recwarn.pop().message)


VGI = (
    "{volume1}\n[representation]\nsize = 5 4 3\nmirror = 0 0 0 0\ndatatype = unsigned integer\nbitsperelement = 8\n"
    "[file1]\nRegionOfInterestStart = 0 0 0\nRegionOfInterestEnd = 4 3 2\nSkipHeader = 2\nFileFormat = raw\n"
    "Size = 5 4 3\nName = C:\\CT\\v.vol\nDatatype = signed integer\ndatarange = -1 -1\nBitsPerElement = 16\n"
    "{volumeprimitive1}\n[geometry]\nresolution = 9 9 9\nunit = m\n[volume]\nvolume = volume7\n"
    "{volumeprimitive2}\n[geometry]\nposition = 1 2 3\nresolution = 0.05 0.1 0.2\nunit = mm\n"
    "[volume]\nvolume = volume1\n"
)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_vgi(tmp_path: Path, newline: str) -> None:
    """The files' own type counts: that of the representation is VGStudio's in memory."""
    source = write(tmp_path / "v.vgi", VGI.replace("\n", newline).encode())
    (tmp_path / "v.vol").write_bytes(b"xx" + VALUES.tobytes())
    volume = read_volume(source)
    np.testing.assert_array_equal(volume.data, VALUES)
    assert isinstance(volume.data, np.memmap)
    assert (volume.spacing, volume.unit, volume.name) == ((0.05, 0.1, 0.2), "mm", "v")
    second = b"{volume2}\n[file1]\nSize = 5 4 1\nName = w.vol\nDatatype = float\nBitsPerElement = 16\n"
    two = write(tmp_path / "v.vgi", VGI.encode().replace(b"{volumeprimitive1}", second + b"{volumeprimitive1}"))
    refused(UsageError, "volume1; volume2; choose one with --array", read_volume, two)
    np.testing.assert_array_equal(read_volume(two, ReadOptions(array="volume1")).data, VALUES)
    refused(DataError, "'float' of 16 bits; expected raw", read_volume, two, ReadOptions(array="volume2"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("{volumeprimitive1}", "[file2]\nName = w.vol\n{volumeprimitive1}", "expected all of it in one file"),
        ("BitsPerElement = 16", "BitsPerElement = 32", "has 122 bytes; expected 242"),
        ("v.vol", "x.vol", "does not exist beside it"),
        ("[file1]", "[file2]", "no volume of numbers"),
        ("resolution = 0.05 0.1", "resolution = 0,05 0,1", "decimal points"),
    ],
)
def test_vgi_lies(tmp_path: Path, old: str, new: str, message: str) -> None:
    (tmp_path / "v.vol").write_bytes(b"xx" + VALUES.tobytes())
    assert old in VGI
    refused(DataError, message, read_volume, write(tmp_path / "v.vgi", VGI.replace(old, new).encode()))


def test_nrrd_quantized_values_are_said_and_their_unit_is_read(tmp_path: Path) -> None:
    fields = {"old min": -1000, "old max": 3000, "sample units": '"HU"'}
    with pytest.warns(UserWarning, match="old min and old max are not applied to its quantized values"):
        volume = read_volume(write(tmp_path / "v.nrrd", nrrd(fields, VALUES.tobytes())))
    assert volume.value_unit == "HU"
