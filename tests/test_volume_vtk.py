"""VTK's image formats, written by VTK (or by hand where VTK cannot write them), SLC and TIFF."""

import struct
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkImageData, vtkStructuredPoints
from vtkmodules.vtkIOImage import vtkSLCReader
from vtkmodules.vtkIOLegacy import vtkStructuredPointsReader, vtkStructuredPointsWriter
from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError, VvgtError
from vvgt_cli.volume import ReadOptions, read_volume

RNG = np.random.default_rng(3)
VALUES = RNG.integers(0, 100, (3, 4, 5))
VECTORS = RNG.standard_normal((3, 4, 5, 3)).astype("f4")
CELLS = RNG.integers(0, 100, (2, 3, 4)).astype("u1")
CODES = ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"]


def image(kind=vtkImageData, **arrays: np.ndarray) -> vtkImageData:
    """A 5 x 4 x 3 image; arrays by name, ``c_`` for cell data, vectors with a fourth axis."""
    out = kind()
    out.SetDimensions(5, 4, 3)
    out.SetSpacing(0.5, 1, 2)
    out.SetOrigin(1, 2, 3)
    for name, values in arrays.items():
        components = values.shape[3] if values.ndim == 4 else 1
        array = numpy_to_vtk(np.ascontiguousarray(values).reshape(-1, components), deep=True)
        array.SetName(name.removeprefix("c_").replace("_", " "))
        (out.GetCellData() if name.startswith("c_") else out.GetPointData()).AddArray(array)
    return out


def write_vti(path: Path, data: vtkImageData, mode: str = "appended-raw", compressor: str = "none", big=False) -> str:
    writer = vtkXMLImageDataWriter()
    writer.SetInputData(data)
    writer.SetFileName(str(path))
    {"ascii": writer.SetDataModeToAscii, "binary": writer.SetDataModeToBinary}.get(mode, writer.SetDataModeToAppended)()
    writer.SetEncodeAppendedData(mode == "appended-base64")
    if compressor == "none":
        writer.SetCompressorTypeToNone()
    else:
        getattr(writer, f"SetCompressorTypeTo{compressor}")()
    (writer.SetByteOrderToBigEndian if big else writer.SetByteOrderToLittleEndian)()
    writer.SetHeaderTypeToUInt64() if big else writer.SetHeaderTypeToUInt32()
    assert writer.Write() == 1
    return str(path)


def write_vtk(path: Path, data: vtkImageData, binary: bool = True) -> str:
    writer = vtkStructuredPointsWriter()
    writer.SetInputData(data)
    writer.SetFileName(str(path))
    (writer.SetFileTypeToBinary if binary else writer.SetFileTypeToASCII)()
    assert writer.Write() == 1
    return str(path)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(
    ("mode", "code"),
    [("ascii", "i8"), ("binary", "f8"), ("appended-base64", "u2"), *(("appended-raw", code) for code in CODES)],
)
def test_vti_types(tmp_path: Path, code: str, big: bool, mode: str) -> None:
    values = VALUES.astype(code)
    volume = read_volume(write_vti(tmp_path / "v.vti", image(a=values), mode, big=big))
    np.testing.assert_array_equal(volume.data, values)
    assert volume.data.dtype.newbyteorder("=") == values.dtype
    assert isinstance(volume.data, np.memmap) == (mode == "appended-raw")
    assert (volume.spacing, volume.origin) == ((0.5, 1, 2), (1, 2, 3))


@pytest.mark.parametrize("compressor", ["ZLib", "LZ4", "LZMA"])
@pytest.mark.parametrize("mode", ["binary", "appended-raw", "appended-base64"])
def test_vti_compressors(tmp_path: Path, compressor: str, mode: str) -> None:
    source = write_vti(tmp_path / "v.vti", image(a=VALUES.astype("u2"), b=VECTORS), mode, compressor)
    volume = read_volume(source, ReadOptions(array="a"))
    np.testing.assert_array_equal(volume.data, VALUES)


def test_vti_in_pieces(tmp_path: Path) -> None:
    """Two pieces that share the plane z = 1, as parallel writers make them."""

    def piece(first: int, last: int) -> str:
        text = " ".join(map(str, VALUES[first : last + 1].ravel()))
        return (
            f'<Piece Extent="0 4 0 3 {first} {last}"><PointData Scalars="a"><DataArray type="Int32" Name="a" '
            f'format="ascii">{text}</DataArray></PointData></Piece>'
        )

    path = tmp_path / "v.vti"
    path.write_text(
        '<VTKFile type="ImageData" byte_order="LittleEndian"><ImageData WholeExtent="0 4 0 3 0 2" Origin="0 0 0" '
        f'Spacing="1 1 1">{piece(0, 1)}{piece(1, 2)}</ImageData></VTKFile>'
    )
    np.testing.assert_array_equal(read_volume(str(path)).data, VALUES)


def test_vti_extent_and_direction(tmp_path: Path) -> None:
    data = image(a=VALUES.astype("u1"))
    data.SetExtent(2, 6, -1, 2, 0, 2)
    data.SetDirectionMatrix(0, -1, 0, 1, 0, 0, 0, 0, 1)
    volume = read_volume(write_vti(tmp_path / "v.vti", data))
    point = [0.0] * 3
    data.TransformIndexToPhysicalPoint(2, -1, 0, point)
    assert volume.origin == tuple(point)
    assert volume.direction == (0, -1, 0, 1, 0, 0, 0, 0, 1)


@pytest.fixture(params=["vti", "vti-z", "vtk", "vtk-ascii"])
def save(request: pytest.FixtureRequest, tmp_path: Path):
    def write(data: vtkImageData) -> str:
        if request.param.startswith("vti"):
            packed = "ZLib" if request.param == "vti-z" else "none"
            return write_vti(tmp_path / "v.vti", data, compressor=packed)
        return write_vtk(tmp_path / "v.vtk", data, binary=request.param == "vtk")

    return write


def test_cell_data(save) -> None:
    volume = read_volume(save(image(c_facies=CELLS)))
    np.testing.assert_array_equal(volume.data, CELLS)
    assert volume.dims == (4, 3, 2)
    assert volume.origin == (1.25, 2.5, 4)
    assert volume.spacing == (0.5, 1, 2)


def test_arrays_by_name(save) -> None:
    source = save(image(first_one=VALUES.astype("u1"), second=VALUES[::-1].astype("f4"), c_facies=CELLS))
    for name, expected in (("first one", VALUES), ("second", VALUES[::-1]), ("facies", CELLS)):
        np.testing.assert_array_equal(read_volume(source, ReadOptions(array=name)).data, expected)
    with pytest.raises(UsageError, match=r"first one \(point data, uint8, 1 component\); second .*facies \(cell data"):
        read_volume(source, ReadOptions(array="third"))
    refused(UsageError, "choose one with --array NAME", read_volume, source)


def test_active_scalars_are_the_default(save) -> None:
    data = image(a=VALUES.astype("u1"), b=VALUES[::-1].astype("f4"))
    data.GetPointData().SetActiveScalars("b")
    with pytest.warns(UserWarning, match=r"array b, its scalars; --array takes another: a"):
        volume = read_volume(save(data))
    np.testing.assert_array_equal(volume.data, VALUES[::-1])
    assert volume.quantity == "b"


def test_components(save) -> None:
    data = image(velocity=VECTORS)
    data.GetPointData().SetActiveVectors("velocity")
    source = save(data)
    refused(UsageError, r"velocity.* 3 components of type float32.*--component 0 to 2.*magnitude", read_volume, source)
    for c in range(3):
        component = read_volume(source, ReadOptions(component=c)).data
        np.testing.assert_allclose(component, VECTORS[..., c], rtol=1e-5)
        assert component.flags.c_contiguous
    norm = read_volume(source, ReadOptions(component="magnitude")).data
    assert norm.dtype == np.float32
    np.testing.assert_allclose(norm, np.linalg.norm(VECTORS.astype("f8"), axis=-1), rtol=1e-5)


@pytest.mark.parametrize(("binary", "code"), [(False, "u1"), (False, "f8"), *((True, code) for code in CODES)])
def test_legacy_types(tmp_path: Path, code: str, binary: bool) -> None:
    data = image(vtkStructuredPoints, a=VALUES.astype(code), b=VECTORS, c_facies=CELLS)
    data.GetPointData().SetActiveScalars("a")
    source = write_vtk(tmp_path / "v.vtk", data, binary)
    volume = read_volume(source)
    np.testing.assert_array_equal(volume.data, VALUES)
    assert isinstance(volume.data, np.memmap) == binary
    reader = vtkStructuredPointsReader()
    reader.SetFileName(source)
    reader.Update()
    theirs = vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars())
    assert theirs.dtype == volume.data.dtype.newbyteorder("=")
    assert reader.GetOutput().GetOrigin() == volume.origin
    np.testing.assert_array_equal(read_volume(source, ReadOptions(array="facies")).data, CELLS)


def legacy(body: bytes, coding: str = "BINARY", kind: str = "STRUCTURED_POINTS", dims: str = "5 4 3") -> bytes:
    head = (
        f"# vtk DataFile Version 3.0\ntitle\n{coding}\nDATASET {kind}\nDIMENSIONS {dims}\nSPACING 1 1 1\nORIGIN 0 0 0\n"
    )
    return head.encode() + body


def test_legacy_sections_written_by_hand(tmp_path: Path) -> None:
    bits, colours = RNG.integers(0, 2, 60).astype("u1"), RNG.integers(0, 255, (60, 4)).astype("u1")
    body = b"FIELD FieldData 2\nempty 1 0 float\n\nnote 1 2 string\n" + b"\xc5hello\xc2by\n"
    body += b"POINT_DATA 60\nSCALARS mask bit 1\nLOOKUP_TABLE table\n" + np.packbits(bits).tobytes() + b"\n"
    body += b"LOOKUP_TABLE table 2\n" + bytes(8) + b"\nCOLOR_SCALARS rgba 4\n" + colours.tobytes() + b"\n"
    body += b"METADATA\nINFORMATION 0\n\nTENSORS t float\n" + np.arange(540, dtype=">f4").tobytes() + b"\n"
    path = tmp_path / "v.vtk"
    path.write_bytes(legacy(body))
    np.testing.assert_array_equal(read_volume(str(path)).data.ravel(), bits)
    rgba = read_volume(str(path), ReadOptions(array="rgba", component=3))
    np.testing.assert_array_equal(rgba.data.ravel(), colours[:, 3])
    tensor = read_volume(str(path), ReadOptions(array="t", component=8))
    np.testing.assert_array_equal(tensor.data.ravel(), np.arange(60) * 9 + 8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (legacy(b"POINT_DATA 60\nSCALARS a float\nLOOKUP_TABLE default\n" + bytes(239)), "240 bytes of values"),
        (legacy(b"POINT_DATA 999999999999\nSCALARS a double\nLOOKUP_TABLE default\n" + bytes(64)), "are declared"),
        (legacy(b"POINT_DATA 60\nNONSENSE\n"), "unknown section"),
        (legacy(b""), "no array of numbers"),
        (legacy(b"POINT_DATA 60\nSCALARS a int\n" + b"one " * 60, "ASCII"), "no array of numbers|VTK cannot read it"),
        (legacy(b"", kind="POLYDATA"), "of a polydata.*Resample To Image"),
    ],
)
def test_legacy_lies(tmp_path: Path, text: bytes, message: str) -> None:
    path = tmp_path / "v.vtk"
    path.write_bytes(text)
    refused(DataError, message, read_volume, str(path))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'WholeExtent="0 4 0 3 0 2"', b'WholeExtent="0 4000000 0 300000 0 200000"', "no table of .* bytes"),
        (b"vtkZLibDataCompressor", b"vtkMagicCompressor", "Error creating vtkMagicCompressor"),
        (b'type="UInt8"', b'type="UInt64"', "no table of 480 bytes"),
    ],
)
def test_vti_lies(tmp_path: Path, capfd: pytest.CaptureFixture[str], old: bytes, new: bytes, message: str) -> None:
    path = tmp_path / "v.vti"
    write_vti(path, image(a=VALUES.astype("u1")), compressor="ZLib")
    body = path.read_bytes()
    assert old in body
    path.write_bytes(body.replace(old, new))
    refused(DataError, message, read_volume, str(path))
    assert capfd.readouterr() == ("", ""), "VTK must not print"


@pytest.mark.parametrize("compressor", ["ZLib", "LZ4"])
def test_a_block_is_unpacked_no_further_than_its_values_reach(tmp_path: Path, compressor: str) -> None:
    path = Path(write_vti(tmp_path / "v.vti", image(a=VALUES.astype("u1")), compressor=compressor))
    body = path.read_bytes()
    begin = body.index(b"_", body.index(b"<AppendedData")) + 1
    count, _, last, _ = struct.unpack_from("<4I", body, begin)
    assert (count, last) == (1, VALUES.size)
    path.write_bytes(body[: begin + 4] + struct.pack("<I", (1 << 31) - 1) + body[begin + 8 :])
    np.testing.assert_array_equal(read_volume(str(path)).data, VALUES.astype("u1"))


def test_vti_of_fewer_voxels_than_it_stores(tmp_path: Path) -> None:
    path = Path(write_vti(tmp_path / "v.vti", image(a=VALUES.astype("f8"))))
    path.write_bytes(path.read_bytes().replace(b"0 4 0 3 0 2", b"0 4 0 3 0 1"))
    refused(DataError, "stores 480 bytes, its header declares 320", read_volume, str(path))


def slc(planes: list[bytes], dims: str = "5 4 3", bits: int = 8, coding: int = 1, unit: int = 1) -> bytes:
    return f"11111\n{dims} {bits}\n0.5 1 2\n{unit} 6 0 {coding}\n2 2 X".encode() + bytes(12) + b"".join(planes)


def runs(plane: np.ndarray) -> bytes:
    """A plane as a literal run, a repeated run and the end mark."""
    flat = plane.ravel()
    packed = bytes([128 | (flat.size - 7)]) + flat[:-7].tobytes() + bytes([7, flat[-1]]) + b"\0"
    return f"{len(packed)} X".encode() + packed


@pytest.mark.parametrize("coding", [0, 1])
def test_slc_as_vtk_reads_it(tmp_path: Path, coding: int) -> None:
    values = VALUES.astype("u1")
    values.reshape(3, -1)[:, -7:] = 42
    path = tmp_path / "v.slc"
    path.write_bytes(slc([runs(p) if coding else p.tobytes() for p in values], coding=coding))
    volume = read_volume(str(path))
    np.testing.assert_array_equal(volume.data, values)
    reader = vtkSLCReader()
    reader.SetFileName(str(path))
    reader.Update()
    theirs = vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars())
    np.testing.assert_array_equal(volume.data.ravel(), theirs)
    assert volume.spacing == reader.GetOutput().GetSpacing() == (0.5, 1, 2)
    assert isinstance(volume.data, np.memmap) == (coding == 0)


@pytest.mark.parametrize(("code", "unit"), [(0, "m"), (1, "mm"), (2, "um"), (3, ""), (9, "")])
def test_slc_states_its_unit_of_length(tmp_path: Path, code: int, unit: str) -> None:
    (tmp_path / "v.slc").write_bytes(slc([VALUES.astype("u1").tobytes()], coding=0, unit=code))
    with nullcontext() if unit else pytest.warns(UserWarning, match="is not a known unit of length"):
        assert read_volume(str(tmp_path / "v.slc")).unit == unit


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (slc([b"3 X\x7f\x01\0"] * 3), "plane 0 of 3 is damaged"),  # a run past the plane's end
        (slc([b"3 X\xff\x01\x02"] * 3), "plane 0 of 3 is damaged"),  # literals past the data's end
        (slc([b"3 X\x05\x01\0"] * 3), "plane 0 of 3 is damaged"),  # too few voxels
        (slc([b"3 X\x14\x01\0"] * 2), "plane 2 of 3 has no size"),
        (slc([], dims="99999 99999 99999"), "cannot hold"),
        (slc([bytes(59)], coding=0), "the file has"),
    ],
)
def test_slc_lies(tmp_path: Path, body: bytes, message: str) -> None:
    path = tmp_path / "v.slc"
    path.write_bytes(body)
    refused(DataError, message, read_volume, str(path))


def write_tiff(path: Path, values: np.ndarray, samples: int = 1) -> str:
    """A plain little-endian TIFF stack (z, y, x[, c]) of any type."""
    kind = {"u": 1, "i": 2, "f": 3}[values.dtype.kind]
    blob, pages = b"II*\0" + bytes(4), []
    for page in values:
        pages.append(len(blob))
        blob += page.astype(values.dtype.newbyteorder("<")).tobytes()
        blob += bytes(len(blob) % 2)
    link = 4
    for page, strip in zip(values, pages, strict=True):
        blob = blob[:link] + struct.pack("<I", len(blob)) + blob[link + 4 :]
        extra = len(blob) + 2 + 10 * 12 + 4
        bits = values.dtype.itemsize * 8
        tags = [
            *((256, 4, 1, page.shape[1]), (257, 4, 1, page.shape[0])),
            (258, 3, samples, bits if samples == 1 else extra),
            *((259, 3, 1, 1), (262, 3, 1, 1 if samples == 1 else 2), (273, 4, 1, strip), (277, 3, 1, samples)),
            *((278, 4, 1, page.shape[0]), (279, 4, 1, page.nbytes)),
            (339, 3, samples, kind if samples == 1 else extra + 2 * samples),
        ]
        blob += struct.pack("<H", 10) + b"".join(struct.pack("<HHII", *t) for t in tags)
        link = len(blob)
        blob += (
            bytes(4) + struct.pack(f"<{samples}H", *[bits] * samples) + struct.pack(f"<{samples}H", *[kind] * samples)
        )
    path.write_bytes(blob)
    return str(path)


def test_tiff_lies(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "v.tif"
    good = Path(write_tiff(path, VALUES.astype("u2"))).read_bytes()
    width = struct.pack("<HHII", 256, 4, 1, 5)
    assert good.count(width) == 3
    cases = {
        good.replace(width, struct.pack("<HHII", 256, 4, 1, 6), 1): "2 series: 0 .*axes YX.*; 1 ",
        good.replace(width, struct.pack("<HHII", 256, 4, 1, 2_000_000_000)): "cannot hold",
        good[:-30]: "cut short",
        good[:6]: "cut short",
        b"II*\0" + bytes(4): "without pages",
    }
    for body, message in cases.items():
        path.write_bytes(body)
        refused(VvgtError, message, read_volume, str(path))
    assert capfd.readouterr() == ("", "")
