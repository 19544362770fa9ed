"""GRIB written by ecCodes: a linear field on levels, times, scanned either way; read in a process of its own."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from grib_files import field, message, write

from tests.refused import refused
from vvgt_cli.errors import DataError, SeveralArrays, SeveralSteps, UsageError
from vvgt_cli.volume import ReadOptions, read_volume

pytestmark = pytest.mark.skipif(find_spec("eccodes") is None, reason="ecCodes is not installed")
SPACING = (1.0, 1.0, 1.0)


def put(folder: Path, *messages: dict[str, Any]) -> str:
    write(folder / "v.grib2", *messages)
    return str(folder / "v.grib2")


@pytest.mark.parametrize(("edition", "north_first"), [(1, True), (2, True), (2, False)])
def test_levels_are_z_upwards(tmp_path: Path, edition: int, north_first: bool) -> None:
    levels = (850, 1000, 500)
    source = put(tmp_path, *(message(field(p), edition, north_first, shortName="t", level=p) for p in levels))
    refused(UsageError, r"degrees.*level in hpa.*--spacing", read_volume, source)
    volume = read_volume(source, ReadOptions(spacing=SPACING))
    np.testing.assert_allclose(volume.data, [field(1000), field(850), field(500)], rtol=1e-5)
    messages = (message(field(p), edition, north_first, shortName="t", level=p) for p in (1000, 850, 500))
    np.testing.assert_allclose(volume.data[:, 0, 0], write(tmp_path / "w.grib", *messages), rtol=1e-5)


def test_heights_ascend_and_what_is_missing_is_nan(tmp_path: Path) -> None:
    values = field(2)
    values[0, 1] = 9999
    kind = {"typeOfLevel": "heightAboveGround", "parameterCategory": 4, "parameterNumber": 0, "discipline": 0}
    source = put(tmp_path, *(message(values, bitmapPresent=1, **kind, level=h) for h in (80, 50)))
    assert np.isnan(read_volume(source, ReadOptions(spacing=SPACING)).data).sum() == 2
    source = put(tmp_path, *(message(field(h), **kind, level=h) for h in (80, 50)))
    np.testing.assert_allclose(
        read_volume(source, ReadOptions(spacing=SPACING)).data, [field(50), field(80)], rtol=1e-5
    )


def test_a_single_level_lies_on_degrees(tmp_path: Path) -> None:
    volume = read_volume(put(tmp_path, message(field(500), shortName="t", level=500)))
    assert (volume.spacing[:2], volume.origin[0] % 360, volume.origin[1]) == ((10, 10), 350, 30)
    assert (volume.quantity, volume.value_unit) == ("Temperature", "K")
    one = {"Ni": 1, "longitudeOfLastGridPointInDegrees": 350, "shortName": "t"}  # a section along a meridian
    source = put(tmp_path, *(message(field(p)[:, :1], **one, level=p) for p in (1000, 850)))
    found = read_volume(source, ReadOptions(spacing=SPACING)).data
    np.testing.assert_allclose(found[..., 0], [field(p)[:, 0] for p in (1000, 850)], rtol=1e-5)


def test_times_and_variables_are_chosen(tmp_path: Path) -> None:
    steps = [message(field(p, h), shortName="t", level=p, stepRange=h) for h in (6, 0) for p in (900, 1000)]
    source = put(tmp_path, *steps)
    with pytest.raises(SeveralSteps) as caught:
        read_volume(source)
    assert caught.value.times == [0, 6]
    volume = read_volume(source, ReadOptions(time=1, spacing=SPACING))
    np.testing.assert_allclose(volume.data, [field(1000, 6), field(900, 6)], rtol=1e-5)
    source = put(tmp_path, *steps[:2], *(message(field(p) + 9, shortName="u", level=p) for p in (900, 1000)))
    with pytest.raises(SeveralArrays) as several:
        read_volume(source)
    assert several.value.choices == ["t/isobaricInhPa", "u/isobaricInhPa"]
    volume = read_volume(source, ReadOptions(array="u/isobaricInhPa", spacing=SPACING))
    np.testing.assert_allclose(volume.data, [field(1000) + 9, field(900) + 9], rtol=1e-5)


def test_what_is_on_no_grid_or_twice_is_an_error(tmp_path: Path) -> None:
    source = put(tmp_path, {"sample": "reduced_gg_pl_32_grib2", "keys": {}, "values": []})
    refused(DataError, r"grid of type reduced_gg.*cdo", read_volume, source)
    one = message(field(500), shortName="t", level=500)
    refused(DataError, "two messages of t/isobaricInhPa have level 500", read_volume, put(tmp_path, one, one))
