"""Options of layout with files that state their own: ``--spacing`` is taken by all formats, the others by none."""

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from vvgt_cli.errors import UsageError
from vvgt_cli.volume import ReadOptions, read_volume

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
from readers import values_of
from readers_rows import ROWS

GIVEN = (2.0, 3.0, 5.0)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_spacing_is_taken_and_other_layouts_are_not(row, tmp_path):
    """The first voxel, directions, unit and values stay; where values stand at points, it is refused in a line."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        source = str(row.write(tmp_path, values_of(6)))
        with pytest.raises(UsageError, match=r"states its own layout; leave out --dtype --header-bytes \(--spacing is"):
            read_volume(source, ReadOptions(dtype="uint8", header_bytes=3, **row.options))
        stated = read_volume(source, ReadOptions(**row.options))
        if "resampled" in stated.name:
            with pytest.raises(UsageError, match=r"say where values are; leave out --spacing \(--dims says how many"):
                read_volume(source, ReadOptions(spacing=GIVEN, **row.options))
            return
        for stored in (False, True):
            given = read_volume(source, ReadOptions(spacing=GIVEN, stored=stored, **row.options))
            assert given.spacing == GIVEN
            np.testing.assert_allclose(given.origin, stated.origin, rtol=1e-12)
            assert (given.direction, given.space, given.unit) == (stated.direction, stated.space, stated.unit)
        np.testing.assert_array_equal(given.data[:, :, :], stated.data[:, :, :])
