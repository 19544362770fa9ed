"""TIFF of ImageJ: voxel sizes that are half known, and stacks with one directory for all planes."""

import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.stored import is_file_backed

T, C, Z, Y, X = 3, 2, 4, 6, 5
VALUES = np.random.default_rng(3).integers(0, 200, (T, C, Z, Y, X)).astype("u2")


def described(path: Path, text: str, tags: tuple | None, dtype: str = "u2") -> str:
    """Four slices with a description of their own; ``tags``: pixels per unit along x and y, and the unit's number."""
    resolution = {} if tags is None else {"resolution": tags[:2], "resolutionunit": tags[2]}
    values = VALUES[0, 0].astype(dtype)
    tifffile.imwrite(
        path, values, photometric="minisblack", metadata=None, description=f"ImageJ=1.53c\n{text}", **resolution
    )
    if tags is None:
        body = path.read_bytes()  # tifffile writes 1 and 1 where nothing is given
        for tag in (282, 283, 296):
            assert body.count(struct.pack("<HH", tag, 3 if tag == 296 else 5)) == Z
            body = body.replace(struct.pack("<HH", tag, 3 if tag == 296 else 5), struct.pack("<HH", tag + 40000, 1))
        path.write_bytes(body)
    return str(path)


NO_SIZE, NO_DEPTH = "no size of its pixels; taken as 1", "no distance between its slices; taken as 1, as ImageJ"


@pytest.mark.parametrize(
    ("text", "tags", "spacing", "unit", "told"),
    [
        # neither a unit nor a resolution
        ("", None, (1, 1, 1), "", ()),
        ("spacing=2.0\n", None, (1, 1, 2), "", (NO_SIZE,)),
        ("spacing=-2.0\n", (1, 1, 1), (1, 1, 2), "", ()),
        # dots of printers, without a unit
        ("spacing=2.0\n", (72, 72, 2), (1, 1, 2), "", (NO_SIZE,)),
        ("spacing=2.0\n", (300, 300, 2), (1, 1, 2), "", (NO_SIZE,)),
        # a resolution in a unit that is not named
        ("spacing=2.0\n", (4, 5, 1), (0.25, 0.2, 2), "", ()),
        ("", (4, 5, 1), (0.25, 0.2, 1), "", (NO_DEPTH,)),
        # a unit
        ("unit=um\nspacing=2.0\n", (4, 5, 1), (0.25, 0.2, 2), "um", ()),
        ("unit=\\u00B5m\nspacing=2.0\n", (4, 5, 1), (0.25, 0.2, 2), "um", ()),
        ("unit=\\u00C5\nspacing=2.0\n", (4, 5, 1), (0.25e-4, 0.2e-4, 2e-4), "um", ()),
        ("unit=inch\nspacing=2.0\n", (100, 50, 2), (254, 508, 50800), "um", ()),
        ("unit=mm\nspacing=2.0\nzunit=um\n", (4, 5, 1), (250, 200, 2), "um", ()),
        ("unit=um\n", (4, 5, 1), (0.25, 0.2, 1), "um", (NO_DEPTH,)),
        ("unit=um\n", None, (1, 1, 1), "um", (NO_SIZE, NO_DEPTH)),
        # a unit and a tag of another
        ("unit=um\nspacing=2.0\n", (20000, 10000, 3), (0.5, 1, 2), "um", ()),
        ("unit=mm\nspacing=2.0\n", (4, 5, 3), (250, 200, 2000), "um", ("taken per mm",)),
    ],
)
def test_imagej_sizes_that_are_half_known(tmp_path, text, tags, spacing, unit, told) -> None:
    """Expected as ij.io.TiffDecoder and ij.io.FileOpener take them, except of dots per inch or cm without a unit."""
    source = described(tmp_path / "a.tif", f"images=4\nslices=4\n{text}", tags)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        volume = read_volume(source)
        assert read_volume(source, ReadOptions(spacing=(1, 2, 3))).spacing == (1, 2, 3)
    messages = [str(w.message) for w in caught if w.category is UserWarning]
    assert volume.spacing == pytest.approx(spacing, rel=1e-9)
    assert volume.unit == unit
    assert len(messages) == bool(told)
    assert all(part in messages[0] for part in told)


@pytest.mark.parametrize("text", ["unit=um\nspacing=2.0\n", "unit=pixel\n"])
def test_the_origin_counts_in_pixels(tmp_path: Path, text: str) -> None:
    """Of ij.measure.Calibration: getX(x) is (x - xOrigin) * pixelWidth."""
    source = described(tmp_path / "a.tif", f"images=4\nslices=4\n{text}xorigin=3\nyorigin=-4\nzorigin=5\n", (4, 5, 1))
    volume = read_volume(source)
    np.testing.assert_allclose(volume.affine @ [3, -4, 5, 1], (0, 0, 0, 1), atol=1e-12)
    (tmp_path / "slices").mkdir()
    for k in range(2):
        words = f"ImageJ=1.53c\n{text}xorigin=3\nyorigin=-4\nzorigin=5\n"
        how: Any = {"photometric": "minisblack", "metadata": None, "resolution": (4, 5), "resolutionunit": 1}
        tifffile.imwrite(tmp_path / "slices" / f"{k}.tif", VALUES[0, 0, 0].astype("u2"), description=words, **how)
    volume = read_volume(str(tmp_path / "slices"))
    np.testing.assert_allclose(volume.affine @ [3, -4, 5, 1], (0, 0, 0, 1), atol=1e-12)


def test_sizes_that_are_no_numbers(tmp_path: Path) -> None:
    comma = described(tmp_path / "a.tif", "images=4\nslices=4\nunit=um\nspacing=2,5\n", (4, 4, 1))
    refused(UsageError, r"spacing is '2,5'; expected a number; try --spacing X Y Z", read_volume, comma)
    assert read_volume(comma, ReadOptions(spacing=(1, 1, 2.5))).spacing == (1, 1, 2.5)
    sizes = {"PhysicalSizeX": "0,5", "PhysicalSizeY": 0.5, "PhysicalSizeZ": 2}
    path = tmp_path / "a.ome.tif"
    tifffile.imwrite(path, VALUES[0, 0], ome=True, metadata={"axes": "ZYX", **sizes})
    refused(UsageError, r"PhysicalSizeX is '0,5'; expected a number", read_volume, str(path))
    tifffile.imwrite(path, VALUES[0, 0], ome=True, metadata={"axes": "ZYX", "PhysicalSizeZ": 2})
    with pytest.warns(UserWarning, match="no width or no height of its pixels; taken as 2 "):
        assert read_volume(str(path)).spacing == (2, 2, 2)


def test_sizes_of_scifio(tmp_path: Path) -> None:
    """SCIFIO's description has ImageJ's fields and lists of its own."""
    text = "axes=X,Y,Z\nlengths=5,6,4\nscales=0.5,0.25,2.0\nunits=um,um,um\nimages=4\nslices=4\nunit=um\n"
    path = Path(described(tmp_path / "a.tif", text, (1, 1, 1)))
    path.write_bytes(path.read_bytes().replace(b"ImageJ=1.53c", b"SCIFIO=0.3.4"))
    volume = read_volume(str(path))
    assert (volume.spacing, volume.unit) == ((0.5, 0.25, 2), "um")


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("dtype", "shift"), [("u1", 0), ("u2", 1), ("f4", 2)])
def test_one_directory_for_all_planes(tmp_path: Path, order: str, dtype: str, shift: int) -> None:
    """ImageJ and tifffile write stacks beyond 4 GB so; data may begin at any byte."""
    path, order_of = tmp_path / "a.tif", VALUES.transpose(0, 2, 1, 3, 4).astype(dtype)
    for how, axes, values, options in (
        ({"imagej": True}, "ZYX", order_of[0, :, 0], [{}]),
        ({"imagej": True}, "TZCYX", order_of, [{"time": t, "component": c} for t in range(T) for c in range(C)]),
        ({"imagej": True}, "TZYX", order_of[:, :, 0], [{"time": t} for t in range(T)]),
        ({"photometric": "minisblack"}, "TCZYX", VALUES.astype(dtype), [{"time": 1, "component": 1}]),
        ({"photometric": "minisblack"}, "ZYX", order_of[0, :, 0], [{}]),
    ):
        tifffile.imwrite(path, values, truncate=True, byteorder=order, metadata={"axes": axes}, **how)
        with tifffile.TiffFile(path) as file:
            assert len(file.pages) == 1
            tag, begin = file.pages[0].tags[273], int(file.pages[0].dataoffsets[0])
        body = bytearray(path.read_bytes())
        struct.pack_into(order + "I", body, tag.valueoffset, begin + shift)
        path.write_bytes(body[:begin] + bytes(shift) + body[begin:])
        expected = tifffile.imread(path)
        np.testing.assert_array_equal(expected, values)
        for chosen in options:
            for stored in (False, True):
                volume = read_volume(str(path), ReadOptions(stored=stored, **chosen))
                assert not stored or is_file_backed(volume)
                index = [chosen["time" if a == "T" else "component"] if a in "TC" else slice(None) for a in axes]
                np.testing.assert_array_equal(volume.data[:, :, :], expected[tuple(index)])
        path.write_bytes(path.read_bytes()[:-7])
        for stored in (False, True):
            with pytest.raises(DataError, match=r"7 bytes are missing|has .* need .*check that the file is whole"):
                read_volume(str(path), ReadOptions(stored=stored, **options[0]))


def test_one_directory_beyond_four_gigabytes(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    with pytest.warns(UserWarning, match="truncating ImageJ file"):
        tifffile.imwrite(
            path, shape=(560, 2048, 2048), dtype="u2", byteorder=">", imagej=True, metadata={"axes": "ZYX"}
        )
    if path.stat().st_blocks > 1000:
        pytest.skip("the disk has no sparse files")
    with open(path, "r+b") as file:
        file.seek(-6, 2)
        file.write(np.arange(7, 10, dtype=">u2").tobytes())
    for stored in (False, True):
        volume = read_volume(str(path), ReadOptions(stored=stored))
        assert volume.dims == (2048, 2048, 560)
        assert volume.data[559:, 2047:, 2044:].ravel().tolist() == [0, 7, 8, 9]


def test_planes_that_only_images_counts(tmp_path: Path) -> None:
    """Old versions of ImageJ write images= alone."""
    path, values = tmp_path / "a.tif", VALUES[0, 0]
    tifffile.imwrite(path, values, imagej=True, truncate=True, metadata={"axes": "ZYX"})
    body = path.read_bytes()
    assert body.count(b"slices=4") == 1
    path.write_bytes(body.replace(b"slices=4", b"sliced=4"))
    np.testing.assert_array_equal(read_volume(str(path)).data, values)
    path.write_bytes(body.replace(b"slices=4", b"sliced=4").replace(b"images=4", b"images=6"))
    refused(DataError, r"6 images that are not there \(120 bytes are missing\)", read_volume, str(path))


SIGNED = {"axes": "ZYX", "cf": 0, "c0": -32768.0, "c1": 1.0, "vunit": "Gray Value"}


@pytest.mark.parametrize("sliced", [False, True])
def test_calibrated_values(tmp_path: Path, sliced: bool) -> None:
    signed = VALUES[0, 0].astype("i4") - 100
    facts = [SIGNED, {**SIGNED, "c0": -16484.0, "c1": 0.5, "vunit": "HU"}]
    for how, unit in zip(facts, ("", "HU"), strict=True):
        stored = ((signed - how["c0"]) / how["c1"]).astype("u2")
        for k, part in enumerate(stored if sliced else [stored]):
            form = {**how, "axes": "YX"} if sliced else how
            tifffile.imwrite(tmp_path / f"v{k}.tif", part, imagej=True, metadata=form)
        volume = read_volume(str(tmp_path if sliced else tmp_path / "v0.tif"))
        np.testing.assert_array_equal(volume.data * volume.slope + volume.intercept, signed)
        assert volume.value_unit == unit
    if sliced:
        tifffile.imwrite(tmp_path / "v2.tif", stored[2], imagej=True, metadata={**SIGNED, "axes": "YX"})
        refused(DataError, r"v2\.tif: calibrated values of another scale than those of v0", read_volume, str(tmp_path))


@pytest.mark.parametrize(("function", "said"), [(1, 1), (20, 0), (21, 1)])
def test_other_calibrations_are_said_once(tmp_path: Path, function: int, said: int) -> None:
    for k, plane in enumerate(VALUES[0, 0]):
        facts = {**SIGNED, "axes": "YX", "cf": function, "c2": 3.0}
        tifffile.imwrite(tmp_path / f"v{k}.tif", plane, imagej=True, metadata=facts)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        np.testing.assert_array_equal(read_volume(str(tmp_path)).data, VALUES[0, 0])
    assert sum(f"not calibrated as ImageJ's function {function} says" in str(one.message) for one in told) == said


@pytest.mark.parametrize("kind", ["float32", "int16", "colours"])
def test_calibrations_are_of_unsigned_values(tmp_path: Path, kind: str) -> None:
    """ImageJ adds 32768 to signed values as it reads them, and calibrates neither floats nor colours."""
    text = "images=1\ncf=0\nc0=-32668.0\nc1=1.0\nvunit=HU\n"
    values = VALUES[0, 0, :3].astype("u1" if kind == "colours" else kind)
    values, how = (values.transpose(1, 2, 0), "rgb") if kind == "colours" else (values[0], "minisblack")
    path = tmp_path / "v.tif"
    tifffile.imwrite(path, values, photometric=how, metadata=None, description=f"ImageJ=1.53c\n{text}")
    volume = read_volume(str(path), ReadOptions(component=0) if kind == "colours" else ReadOptions())
    expected = values[..., 0] if kind == "colours" else values + (100 if kind == "int16" else 0)
    np.testing.assert_array_equal(volume.data[0] * volume.slope + volume.intercept, expected)
    assert volume.value_unit == ("" if kind == "colours" else "HU")
