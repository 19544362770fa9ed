"""Headers of NumPy's files that numpy itself stumbles over."""

import numpy as np

from tests.refused import refused
from vvgt_cli.errors import DataError
from vvgt_cli.volume import read_volume


def test_a_type_that_numpy_cannot_parse_is_a_damaged_header(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((3, 4, 5), "<i2"))
    path.write_bytes(path.read_bytes().replace(b"'<i2'", b"',i2'"))
    refused(DataError, r"damaged \.npy header", read_volume, str(path))


def test_a_field_named_by_bytes_is_a_damaged_header(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((3, 4, 5), "<i2"))
    path.write_bytes(path.read_bytes().replace(b"{'descr': '<i2'", b"{b'descr':'<i2'"))
    refused(DataError, r"damaged \.npy header", read_volume, str(path))
