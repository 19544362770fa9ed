"""Byte order marks before headers, names in another case than files have, and what unread formats are told."""

import gzip
import itertools
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from vtkmodules.vtkIOXML import vtkXMLImageDataReader, vtkXMLImageDataWriter

from tests import vtk_files as files
from tests.refused import refused
from vvgt_cli.errors import DataError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.registry import ROWS, way_out

MARK = b"\xef\xbb\xbf"
VALUES = np.arange(60, dtype=np.int16).reshape(3, 4, 5)


def mark(path: Path) -> None:
    path.write_bytes(MARK + path.read_bytes())


@pytest.mark.parametrize(("mode", "packed", "coded"), [*itertools.product(range(3), (False, True), (False, True))])
def test_marked_images_of_vtk_are_as_vtk_reads_them(tmp_path: Path, mode: int, packed: bool, coded: bool) -> None:
    path, image = tmp_path / "v.vti", files.image()
    writer = vtkXMLImageDataWriter()
    writer.SetDataMode(mode)
    if not packed:
        writer.SetCompressorTypeToNone()
    writer.SetEncodeAppendedData(coded)
    files.write(writer, image, path)
    mark(path)
    reader = vtkXMLImageDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    want = [reader.GetOutput().GetPointData().GetArray("ramp").GetValue(k) for k in (0, 59)]
    for stored in (False, True):
        data = read_volume(str(path), ReadOptions(array="ramp", stored=stored)).data[0:]
        assert [data[0, 0, 0], data[-1, -1, -1]] == want


@pytest.mark.parametrize(("old", "new"), [(b"\n   _", b"\n ol_"), (b"_\1\0\0\0", b"_\0\0\0\0")])
def test_appended_data_that_vtk_would_break_down_at(tmp_path: Path, old: bytes, new: bytes) -> None:
    path = tmp_path / "v.vti"
    writer = vtkXMLImageDataWriter()
    writer.EncodeAppendedDataOff()
    writer.SetHeaderTypeToUInt32()
    data = files.write(writer, files.image(), path).read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new))
    refused(DataError, r"do not begin with _|no table of", read_volume, str(path), ReadOptions(array="ramp"))


@pytest.mark.parametrize(
    ("make", "marked", "options"),
    [
        (files.collection, ("v.pvd", "s0_0.vti"), {"array": "ramp", "time": 0}),
        (lambda f: files.collection(f, "vtu"), ("v.pvd", "s1_0.vtu"), {"array": "cells", "time": 1}),
        (lambda f: files.series(f, "vtk"), ("v.vtk.series",), {"array": "ramp", "time": 1}),
        (files.multiblock, ("v.vtm", "v/v_0.vtu"), {"array": "ramp"}),
        (lambda f: files.pieces(f, "pvtr"), ("v.pvtr", "part0.vtr"), {"array": "ramp"}),
        (lambda f: files.parallel_image(f, files.wavelet(6), 4), ("v.pvti", "v_1.vti"), {}),
        (files.xdmf3, ("v.xdmf",), {"time": 1}),
        (files.plot3d, ("v.p3d",), {}),
    ],
)
def test_marked_indexes_and_grids(tmp_path: Path, make, marked, options) -> None:
    path = make(tmp_path)
    before = np.array(read_volume(str(path), ReadOptions(**options)).data[0:])
    for name in marked:
        mark(tmp_path / name)
    np.testing.assert_array_equal(read_volume(str(path), ReadOptions(**options)).data[0:], before)


@pytest.mark.parametrize("name", ["v.nrrd", "v.nhdr", "v.mha", "v.mhd", "v.dat"])
def test_marked_headers_as_text(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "v.dat":
        (tmp_path / "v.raw").write_bytes(VALUES.tobytes())
        path.write_text("RawFile: v.raw\nResolution: 5 4 3\nFormat: INT16\n")
    else:
        sitk.WriteImage(sitk.GetImageFromArray(VALUES), str(path))
        if ".mh" in name:  # the first field is one that is needed
            path.write_bytes(b"DimSize = 5 4 3\n" + path.read_bytes().replace(b"DimSize = 5 4 3\n", b""))
    mark(path)
    np.testing.assert_array_equal(read_volume(str(path)).data, VALUES)


def test_ensight_is_refused_with_a_mark(tmp_path: Path) -> None:
    path = files.ensight(tmp_path)
    mark(path)  # VTK's reader loses the time steps
    refused(DataError, "byte order mark", read_volume, str(path), ReadOptions(time=0))


@pytest.mark.parametrize("kind", [nibabel.Nifti1Pair, nibabel.AnalyzeImage])
@pytest.mark.parametrize(
    ("header", "image", "opened"),
    [
        ("P.HDR", "P.IMG", "P.HDR"), ("P.HDR", "P.IMG", "P.IMG"), ("P.hdr", "P.img.gz", "P.img.gz"),
        ("P.hdr.gz", "P.img.gz", "P.hdr.gz"), ("Pair.Hdr", "pair.img", "Pair.Hdr"), ("P.HDR", "P.IMG.GZ", "P.IMG.GZ"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:.*which side is left")
def test_pairs_in_any_case(tmp_path: Path, kind, header: str, image: str, opened: str) -> None:
    nibabel.save(kind(VALUES.T, np.diag([1.0, 2, 3, 1])), tmp_path / "t.img")
    for old, new in (("t.hdr", header), ("t.img", image)):
        data = (tmp_path / old).read_bytes()
        (tmp_path / new).write_bytes(gzip.compress(data, mtime=0) if new.lower().endswith("gz") else data)
        (tmp_path / old).unlink()
    volume = read_volume(str(tmp_path / opened))
    np.testing.assert_array_equal(volume.data, VALUES)
    assert volume.spacing == (1, 2, 3)


def test_data_files_in_another_case(tmp_path: Path) -> None:
    path = tmp_path / "V.MHD"
    path.write_text("NDims = 3\nDimSize = 5 4 3\nElementType = MET_SHORT\nElementDataFile = V.RAW\n")
    (tmp_path / "v.raw").write_bytes(VALUES.tobytes())
    with pytest.warns(UserWarning, match=r"'V\.RAW' does not exist, v\.raw is read"):
        np.testing.assert_array_equal(read_volume(str(path)).data, VALUES)
    (tmp_path / "v.Raw").write_bytes(VALUES.tobytes())  # which one?
    refused(DataError, "does not exist beside it", read_volume, str(path))
    (tmp_path / "V.RAW").write_bytes(VALUES.tobytes())
    np.testing.assert_array_equal(read_volume(str(path)).data, VALUES)


def test_files_that_vtk_opens_itself_need_their_own_case(tmp_path: Path) -> None:
    path = files.ensight(tmp_path)
    (tmp_path / "v.geo").rename(tmp_path / "V.GEO")
    with pytest.raises(DataError, match=r"'v\.geo' does not exist.*rename V\.GEO"):
        read_volume(str(path), ReadOptions(time=0, array="ramp"))


@pytest.mark.parametrize(
    ("name", "head", "texts"),
    [
        ("v.nvdb", b"NanoVDB2", ("NanoVDB", "nanovdb_convert v.nvdb v.vdb")),
        ("v.fits", b"SIMPLE  =  T", ("FITS", "astropy.io.fits.getdata('v.fits')")),
        ("v.mat", b"MATLAB 5.0 MAT-file", ("MATLAB", "save -v7.3")),
        ("v.img", b"EHFA_HEADER_TAG\0", ("ERDAS", "gdal_translate")),
        ("v.hdf", b"\x0e\x03\x13\x01", ("HDF4", "h4toh5convert")),
        ("v.dat", b'(0 "GAMBIT to Fluent")', ("Fluent", "ParaView")),
        ("v.cas.gz", b"\x1f\x8b", ("simulation", "ParaView")),
        ("v.oib", b"\xd0\xcf\x11\xe0", ("microscope", "bfconvert 'v.oib' 'v.ome.tiff'")),
        ("2dseq", b"\0\1", ("Bruker", "brkraw")),
        ("v.7z", b"7z\xbc\xaf", ("archive", "unpack")),
        ("v.vol", b"\0\1", ("raw values", "--dims X Y Z --dtype TYPE")),
        ("v.nii.gz", b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n", ("Git LFS", "git lfs pull")),
        ("v.raw", b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n", ("Git LFS", "'v.raw'")),
        ("v.nii", b"/annex/objects/MD5E-s123--abc.nii\n", ("git-annex", "git annex get 'v.nii'")),
        ("v.nrrd", b"\n<!DOCTYPE html><html><title>404</title>", ("web server", "load the file again")),
        ("v.mrc", b'<?xml version="1.0"?><Error><Code>NoSuchKey</Code></Error>', ("web server",)),
        ("v.mih", b"mrtrix image\ndim: 4,4,4\n", ("MRtrix", "mrconvert 'v.mih' 'v.nii.gz'")),
        ("v.mif.gz", gzip.compress(b"mrtrix image\ndim: 4,4,4\n", mtime=0), ("MRtrix", "mrconvert 'v.mif.gz'")),
        ("v.sgy", "C 1 CLIENT".ljust(3200).encode("cp500"), ("SEG-Y", "segyio.tools.cube('v.sgy')")),
        ("v0.f00001", b"#std 4  8  8  8", ("Nek5000", "ParaView")),
        ("v.nii", b"PK\3\4", ("archive", "unpack")),
        ("v.tar.gz", gzip.compress(b"v.nii".ljust(257, b"\0") + b"ustar", mtime=0), ("archive", "unpack")),
    ],
)
def test_formats_that_are_not_read_say_the_way_out(tmp_path: Path, name: str, head: bytes, texts) -> None:
    (tmp_path / name).write_bytes(head + bytes(100))
    with pytest.raises(DataError) as caught:
        read_volume(str(tmp_path / name))
    assert all(text in str(caught.value) for text in texts), caught.value
    assert len(str(caught.value)) < 300
    assert "{" not in str(caught.value)


def test_every_way_out_is_one_line_that_can_be_filled_in() -> None:
    for begins, ends, what, way in ROWS:
        assert begins or ends, what
        assert "\n" not in way.format(name="v.x", stem="v")
    assert way_out(Path("v.abc"), b"nothing known", True) is None
    assert way_out(Path("v.oib"), b"nothing known", False) is None
