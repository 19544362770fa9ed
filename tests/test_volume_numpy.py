"""Headers of NumPy's files that numpy itself stumbles over."""

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError
from vvgt_cli.volume import read_volume


@pytest.mark.parametrize(
    ("old", "new"), [(b"'<i2'", b"',i2'"), (b"{'descr': '<i2'", b"{b'descr':'<i2'")], ids=["type", "name as bytes"]
)
def test_what_numpy_cannot_parse_is_a_damaged_header(tmp_path, old, new):
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((3, 4, 5), "<i2"))
    path.write_bytes(path.read_bytes().replace(old, new))
    refused(DataError, r"damaged \.npy header", read_volume, str(path))
