"""How a format is found, what an option may do to it, and how errors read."""

import gzip
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from tests.processes import python
from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError, VvgtError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.blocks import parse_numbers
from vvgt_cli.volume.readers import READERS, Reader, known_suffixes, volume_name

NRRD = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n\n" + bytes(range(8))


@pytest.mark.parametrize("name", ["v.nrrd", "v.dat", "v.vti", "v", "v.unknown"])
def test_content_before_name(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(NRRD)
    assert read_volume(str(tmp_path / name)).data.ravel().tolist() == list(range(8))


@pytest.mark.parametrize("suffix", sorted(set(known_suffixes())))
def test_a_name_with_the_wrong_content_is_one_clear_line(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"v{suffix}"
    path.write_bytes(b"nothing that any format begins with")
    refused(VvgtError, r"expected|no field|has no ElementDataFile|unknown layout", read_volume, str(path))


def test_what_cannot_be_opened(tmp_path: Path) -> None:
    for source, message in (
        (tmp_path / "none.raw", "no such file"),
        (tmp_path, "a folder; expected a volume file"),
        ("examples:frog", "schemes: example:"),
        ("x" * 5000, "cannot be read"),
        ("a\0b", "cannot be read"),
    ):
        refused(DataError, message, read_volume, str(source))
    (tmp_path / "empty.nii").touch()
    refused(DataError, "the file is empty", read_volume, str(tmp_path / "empty.nii"))
    (tmp_path / "v.abc").write_bytes(b"what is this")
    with pytest.raises(
        DataError, match=r"of no known format; expected .*NRRD.* of docs/formats.md, .*--dims X Y Z --dtype TYPE"
    ):
        read_volume(str(tmp_path / "v.abc"))
    (tmp_path / "v.nrrd.gz").write_bytes(gzip.compress(NRRD))
    refused(DataError, "gzip-compressed NRRD file; unpack it first", read_volume, str(tmp_path / "v.nrrd.gz"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ReadOptions(dims=(2, 2, 2), dtype="uint8"), "states its own layout; leave out --dims --dtype"),
        (ReadOptions(byte_order="big"), "leave out --byte-order"),
        (ReadOptions(header_bytes=4), "leave out --header-bytes"),
        (ReadOptions(array="a"), "leave out --array a"),
        (ReadOptions(component="magnitude"), "1 component of type uint8; leave out --component"),
    ],
)
def test_options_that_would_do_nothing_are_refused(tmp_path: Path, options: ReadOptions, message: str) -> None:
    (tmp_path / "v.nrrd").write_bytes(NRRD)
    refused(UsageError, message, read_volume, str(tmp_path / "v.nrrd"), options)


def test_names() -> None:
    for name, expected in (
        ("bonsai.nii.gz", "bonsai"),
        ("head_64x64x93_uint16.raw", "head"),
        ("V.NRRD", "V"),
        ("4x4x4_uint8.raw", "4x4x4_uint8"),
        ("plain", "plain"),
    ):
        assert volume_name(Path(name)) == expected


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_the_functions_of_a_reader_are_there(reader: Reader) -> None:
    for made in (reader.read, reader.holds, reader.levels, reader.contents):
        if isinstance(made, partial):
            module, _, function = made.args[0].rpartition(".")
            assert callable(getattr(import_module(f"vvgt_cli.volume.{module}"), function))


def test_numbers_across_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vvgt_cli.volume.blocks._CHUNK", 7)
    text = b" ".join(b"%d" % v for v in range(100)) + b"\n"
    np.testing.assert_array_equal(parse_numbers(text, 0, 100, np.dtype("u1"), "t"), np.arange(100))
    refused(DataError, "holds 100 values, expected 101", parse_numbers, text, 0, 101, np.dtype("u1"), "t")


@pytest.mark.parametrize(
    ("name", "dims", "dtype"), [("frog", (500, 470, 136), "uint8"), ("channels", (250, 250, 100), "int64")]
)
def test_bundled_examples(name: str, dims: tuple[int, int, int], dtype: str) -> None:
    volume = read_volume(f"example:{name}")
    assert volume.dims == dims
    assert volume.data.dtype == dtype
    assert volume.data.max() > volume.data.min()


def test_reading_loads_nothing_heavy(tmp_path: Path) -> None:
    (tmp_path / "v.nrrd").write_bytes(NRRD)
    code = (
        "import sys\nfrom vvgt_cli.volume import read_volume\nread_volume(sys.argv[1])\nread_volume('example:blob:8')\n"
        "heavy = {'numba', 'vtkmodules', 'vtk', 'pyvista', 'OpenImageIO', 'matplotlib', 'scipy'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    python("-c", code, tmp_path / "v.nrrd")
