"""Raw volumes: layouts from names and options, sizes, standard input."""

import gzip
import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.blocks import Packed
from vvgt_cli.volume.headers import DTYPES
from vvgt_cli.volume.options import parse_dtype
from vvgt_cli.volume.plain import raw as raw_module


def sample(shape: tuple[int, int, int], dtype: np.dtype, seed: int = 0) -> np.ndarray:
    """Random values over the type's whole range."""
    rng = np.random.default_rng(seed)
    if dtype.kind == "f":
        return rng.standard_normal(shape).astype(dtype)
    info = np.iinfo(dtype)
    return rng.integers(info.min, info.max, shape, dtype=dtype.newbyteorder("="), endpoint=True).astype(dtype)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.sampled_from(DTYPES),
    order=st.sampled_from([None, "little", "big"]),
    header=st.integers(0, 9),
    dims=st.tuples(*[st.integers(1, 6)] * 3),
)
def test_round_trip(tmp_path: Path, name: str, order: str | None, header: int, dims: tuple[int, int, int]) -> None:
    values = sample(dims[::-1], parse_dtype(name, order))
    path = tmp_path / "v.bin"
    path.write_bytes(b"\xaa" * header + values.tobytes())
    volume = read_volume(str(path), ReadOptions(dims=dims, dtype=name, byte_order=order, header_bytes=header))
    assert isinstance(volume.data, np.memmap)
    assert not volume.data.flags.writeable
    assert volume.dims == dims
    assert volume.data.dtype == values.dtype
    np.testing.assert_array_equal(volume.data, values)


@pytest.mark.parametrize("dtype", DTYPES)
def test_name_states_the_layout(tmp_path: Path, dtype: str) -> None:
    values = sample((2, 3, 4), np.dtype(dtype))
    path = tmp_path / f"my_ct_4x3x2_{dtype}.raw"
    values.tofile(path)
    volume = read_volume(str(path))
    assert volume.name == "my_ct"
    np.testing.assert_array_equal(volume.data, values)


def test_options_override_the_name(tmp_path: Path) -> None:
    values = sample((3, 4, 2), np.dtype(">i2"))
    path = tmp_path / "v_4x3x2_uint16.raw"
    path.write_bytes(b"\0" * 5 + values.tobytes())
    options = ReadOptions(dims=(2, 4, 3), dtype="short", byte_order="big", header_bytes=5, spacing=(1, 2, 3))
    volume = read_volume(str(path), options)
    np.testing.assert_array_equal(volume.data, values)
    assert volume.spacing == (1, 2, 3)


@pytest.mark.parametrize("first", [b"\x1f\x8b\x08\0", b"NRRD0004", b"11111 2 ", b"II*\0\0\0\0\0"])
def test_a_stated_layout_beats_a_chance_magic(tmp_path: Path, first: bytes) -> None:
    body = first.ljust(24, b"\7")
    for name, options in (
        ("v_4x3x2_uint8.raw", ReadOptions()),
        ("v.bin", ReadOptions(dims=(4, 3, 2), dtype="uint8")),
    ):
        (tmp_path / name).write_bytes(body)
        assert read_volume(str(tmp_path / name), options).data.tobytes() == body


def test_gzipped_raw(tmp_path: Path) -> None:
    values = sample((2, 3, 4), np.dtype("<u2"))
    path = tmp_path / "v_4x3x2_uint16.raw.gz"
    path.write_bytes(gzip.compress(values.tobytes()))
    np.testing.assert_array_equal(read_volume(str(path)).data, values)
    path.write_bytes(gzip.compress(values.tobytes()[:-1]))
    refused(DataError, "hold 47 bytes, its header declares 48 bytes", read_volume, str(path))
    path.write_bytes(gzip.compress(values.tobytes() + b"x"))
    refused(DataError, "hold more than 48 bytes; check --dims and --dtype", read_volume, str(path))
    slabs = Packed(path, np.dtype("<u2"), (2, 3, 4), "gzip", (0, 0), True)
    refused(DataError, "hold more than 48 bytes", lambda: slabs[0:2])


@pytest.mark.parametrize("size", [47, 49, 1])
def test_size_must_fit_exactly(tmp_path: Path, size: int) -> None:
    path = tmp_path / "v_4x3x2_uint16.raw"
    path.write_bytes(b"\0" * size)
    with pytest.raises(DataError, match=rf"{size} bytes, but 4 x 3 x 2 voxels of uint16 .* 48 bytes; check --dims"):
        read_volume(str(path))


def test_absurd_dims_do_not_allocate(tmp_path: Path) -> None:
    path = tmp_path / "v_999999999x999999999x999999999_float64.raw"
    path.write_bytes(b"\0" * 64)
    refused(DataError, "999999999 x 999999999 x 999999999", read_volume, str(path))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ReadOptions(), "--dims X Y Z and --dtype TYPE"),
        (ReadOptions(dims=(2, 2, 2)), "give --dtype TYPE"),
        (ReadOptions(dtype="uint8"), "give --dims X Y Z"),
    ],
)
def test_unknown_layout_asks_for_it(tmp_path: Path, options: ReadOptions, message: str) -> None:
    path = tmp_path / "v.raw"
    path.write_bytes(b"\0" * 8)
    refused(UsageError, message, read_volume, str(path), options)
    refused(UsageError, message, raw_module.read_stdin, options, io.BytesIO(b"\0" * 8))


class Feed:
    """Stands for sys.stdin."""

    def __init__(self, data: bytes) -> None:
        self.buffer = io.BytesIO(data)


@pytest.mark.parametrize("header", [0, 3])
def test_stdin(monkeypatch: pytest.MonkeyPatch, header: int) -> None:
    values = sample((2, 3, 4), np.dtype(">f4"))
    options = ReadOptions(dims=(4, 3, 2), dtype="float32", byte_order="big", header_bytes=header)
    body = b"h" * header + values.tobytes()
    monkeypatch.setattr("sys.stdin", Feed(body))
    volume = read_volume("-", options)
    np.testing.assert_array_equal(volume.data, values)
    assert volume.name == "stdin"
    monkeypatch.setattr("sys.stdin", Feed(body[:-1]))
    refused(DataError, rf"standard input: {len(body) - 1} bytes came", read_volume, "-", options)
    monkeypatch.setattr("sys.stdin", Feed(body + b"x"))
    refused(DataError, rf"more than {len(body)} bytes came", read_volume, "-", options)


@pytest.mark.parametrize(
    "bad",
    [
        {"dims": (0, 1, 1)},
        {"dtype": "complex64"},
        {"byte_order": "middle"},
        {"header_bytes": -1},
        {"spacing": (1.0, 0.0, 1.0)},
        {"spacing": (1.0, float("nan"), 1.0)},
        {"component": -1},
    ],
)
def test_options_check_themselves(bad: dict) -> None:
    refused(UsageError, "expected", ReadOptions, **bad)


def test_flags_that_raw_does_not_take(tmp_path: Path) -> None:
    path = tmp_path / "v_1x1x1_uint8.raw"
    path.write_bytes(b"\1")
    refused(UsageError, "leave out --array", read_volume, str(path), ReadOptions(array="a"))
    refused(UsageError, "leave out --component", read_volume, str(path), ReadOptions(component=1))
