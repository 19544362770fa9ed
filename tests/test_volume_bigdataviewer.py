"""BigDataViewer's XML with HDF5, N5 or OME-Zarr beside it."""

import json
import re
import shutil
import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
import zarr

from tests.refused import refused
from vvgt_cli.errors import DataError, SeveralArrays, SeveralComponents, SeveralSteps, UsageError
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.registry import level_shapes
from vvgt_cli.volume.stored import loaded

VALUES = (40000 + np.arange(6 * 5 * 4)).reshape(6, 5, 4).astype("u2")  # above what int16 holds
SPACING = (0.5, 0.5, 2.0)


def values(setup: int, time: int) -> np.ndarray:
    return VALUES + np.uint16(100 * setup + 1000 * time)


def write_xml(path: Path, kind: str, named: str, affine: str = "1 0 0 3 0 1 0 4 0 0 4 5", tiles: bool = False) -> str:
    """Two setups (channels, or tiles) at two time points; registrations count in the smallest voxel size."""
    setups = "".join(
        f"<ViewSetup><id>{s}</id><name>{name}</name><size>4 5 6</size><voxelSize><unit>um</unit>"
        "<size>0.5 0.5 2.0</size></voxelSize>"
        f"<attributes><channel>{0 if tiles else s}</channel><tile>{s if tiles else 0}</tile></attributes>"
        "</ViewSetup>"
        for s, name in enumerate(("DAPI", "GFP"))
    )
    views = "".join(
        f'<ViewRegistration timepoint="{t}" setup="{s}"><ViewTransform type="affine"><affine>1 0 0 {t} 0 1 0 0 0 0 1 0'
        f'</affine></ViewTransform><ViewTransform type="affine"><affine>{affine}</affine></ViewTransform>'
        "</ViewRegistration>"
        for s in (0, 1)
        for t in (0, 1)
    )
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<SpimData version="0.2"><BasePath type="relative">.</BasePath>'
        f'<SequenceDescription><ImageLoader format="bdv.{kind}"><{kind} type="relative">{named}</{kind}></ImageLoader>'
        f'<ViewSetups>{setups}</ViewSetups><Timepoints type="range"><first>0</first><last>1</last></Timepoints>'
        f"</SequenceDescription><ViewRegistrations>{views}</ViewRegistrations></SpimData>"
    )
    return str(path)


def write(folder: Path, kind: str, **how) -> str:
    """A data set of two levels."""
    path = folder / f"data.{kind}"
    for view in range(4):
        setup, time = divmod(view, 2)
        for level in (0, 1):
            part = np.ascontiguousarray(values(setup, time)[:: 1 + level, :: 1 + level, :: 1 + level])
            if kind == "hdf5":
                with h5py.File(path, "a") as file:
                    file[f"t{time:05d}/s{setup:02d}/{level}/cells"] = part.view("i2")
                    if f"s{setup:02d}" not in file:
                        file[f"s{setup:02d}/resolutions"] = np.array([[1, 1, 1], [2, 2, 2.0]])
            elif kind == "n5":
                place = path / f"setup{setup}/timepoint{time}/s{level}"
                (place / "0/0").mkdir(parents=True)
                sizes = part.shape[::-1]
                facts = {"dimensions": sizes, "blockSize": sizes, "dataType": "uint16", "compression": {"type": "raw"}}
                factors = {"downsamplingFactors": [1 + level] * 3}
                (place / "attributes.json").write_text(json.dumps(facts | factors))
                (place / "0/0/0").write_bytes(struct.pack(">HH3I", 0, 3, *sizes) + part.astype(">u2").tobytes())
            else:
                group = zarr.open_group(path / f"s{setup}-t{time}.zarr", mode="a", zarr_format=2)
                group.create_array(str(level), data=part[None, None])
                steps = [{"type": "scale", "scale": [1, 1] + [1 + k] * 3} for k in (0, 1)]
                shifts = [{"type": "translation", "translation": [0, 0] + [k / 2] * 3} for k in (0, 1)]
                sets = [{"path": str(k), "coordinateTransformations": [steps[k], shifts[k]]} for k in (0, 1)]
                group.attrs["multiscales"] = [{"version": "0.4", "axes": list("tczyx"), "datasets": sets}]
    return write_xml(folder / "data.xml", kind, path.name, **how)


@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize("kind", ["hdf5", "n5", "zarr"])
def test_views_are_channels_and_time_steps(tmp_path: Path, kind: str, stored: bool) -> None:
    path = write(tmp_path, kind)
    given = [path] if kind == "zarr" else [path, str(tmp_path / f"data.{kind}")]
    for source in given:
        refused(SeveralSteps, "2 time steps", read_volume, source)
        refused(SeveralComponents, r"2 channels \(0 'DAPI', 1 'GFP'\)", read_volume, source, ReadOptions(time=0))
        for setup, name in enumerate(("DAPI", "GFP")):
            volume = loaded(read_volume(source, ReadOptions(component=name, time=1, stored=stored)))
            np.testing.assert_array_equal(volume.data, values(setup, 1))
            assert (volume.spacing, volume.origin, volume.unit) == (SPACING, (2, 2, 2.5), "um")
        coarse = loaded(read_volume(source, ReadOptions(component=0, time=0, level=1, stored=stored)))
        np.testing.assert_array_equal(coarse.data, VALUES[::2, ::2, ::2])
        assert (coarse.spacing, coarse.origin) == ((1, 1, 4), (1.75, 2.25, 3.5))
        assert level_shapes(source, ReadOptions()) == [(6, 5, 4), (3, 3, 2)]
        refused(
            UsageError,
            "--level 2: expected full, or 0 to 1",
            read_volume,
            source,
            ReadOptions(time=0, component=0, level=2),
        )
    whole = read_volume(path, ReadOptions(component="magnitude", time=0))
    np.testing.assert_allclose(whole.data, np.hypot(values(0, 0), values(1, 0).astype(float)), rtol=1e-6)


def test_one_array_and_no_xml(tmp_path: Path) -> None:
    path, data = write(tmp_path, "hdf5"), str(tmp_path / "data.hdf5")
    volume = read_volume(data, ReadOptions(array="/t00001/s01/1/cells"))
    np.testing.assert_array_equal(volume.data, values(1, 1)[::2, ::2, ::2])
    assert volume.spacing == (1, 1, 4)
    refused(UsageError, "no /t00002/s00/0/cells", read_volume, data, ReadOptions(array="/t00002/s00/0/cells"))
    Path(path).unlink()
    with pytest.warns(UserWarning, match="without the XML file of BigDataViewer .* voxel sizes are taken as 1"):
        volume = read_volume(data, ReadOptions(component=1, time=0))
    np.testing.assert_array_equal(volume.data, values(1, 0))
    with h5py.File(data, "a") as file:
        file["s00"].attrs["dataType"] = "int16"
    assert read_volume(data, ReadOptions(component=0, time=0, spacing=(1, 1, 1))).data.dtype == np.int16


@pytest.mark.parametrize(
    ("affine", "spacing", "origin", "message"),
    [
        ("0.5 0 0 3 0 0.5 0 4 0 0 2 5", SPACING, (4, 4, 5), ""),
        ("1 0 0 3 0 1 0 4 0 0 1 5", SPACING, (2, 2, 10), ""),  # counts voxels
        (
            "0.5 0 0 3 0 0.5 0 4 0 0 3 5",
            (0.5, 0.5, 3),
            (4, 4, 5),
            "registered with voxels of 0.5 0.5 3, which are taken",
        ),
        ("0 -2 0 3 2 0 0 4 0 0 8 5", SPACING, (1, 1, 1.25), ""),
    ],
)
def test_registrations(tmp_path: Path, recwarn, affine: str, spacing: tuple, origin: tuple, message: str) -> None:
    volume = read_volume(write(tmp_path, "hdf5", affine=affine), ReadOptions(component=0, time=1))
    np.testing.assert_allclose((*volume.spacing, *volume.origin), (*spacing, *origin))
    told = [str(one.message) for one in recwarn if "registered" in str(one.message)]
    assert (len(told), message in "".join(told)) == (bool(message), True)
    turned = affine.startswith("0 -2")
    np.testing.assert_allclose(volume.axes, [[0, -1, 0], [1, 0, 0], [0, 0, 1]] if turned else np.eye(3))


def test_an_unknown_unit_is_said(tmp_path: Path) -> None:
    source = write(tmp_path, "hdf5")
    xml = Path(source).with_suffix(".xml")
    xml.write_text(re.sub("<unit>.*?</unit>", "<unit>furlong</unit>", xml.read_text()))
    with pytest.warns(UserWarning, match="'furlong' is not a known unit of length; numbers are kept"):
        assert read_volume(str(xml), ReadOptions(component=0, time=1)).unit == ""


def test_tiles_are_images(tmp_path: Path) -> None:
    path = write(tmp_path, "hdf5", tiles=True)
    refused(SeveralArrays, r"2 images: 0 'tile 0' \(DAPI\); 1 'tile 1'.*--series", read_volume, path)
    np.testing.assert_array_equal(read_volume(path, ReadOptions(array="tile 1", time=0)).data, values(1, 0))


def test_missing_views_are_empty_frames(tmp_path: Path) -> None:
    path = Path(write(tmp_path, "hdf5"))
    missing = '<MissingViews><MissingView timepoint="1" setup="0"/></MissingViews></SequenceDescription>'
    path.write_text(path.read_text().replace("</SequenceDescription>", missing))
    with pytest.warns(UserWarning, match="setup 0 is missing at time point 1: all 0"):
        assert not read_volume(str(path), ReadOptions(component=0, time=1)).data.any()
    assert read_volume(str(path), ReadOptions(component=1, time=1)).data.all()


@pytest.mark.parametrize("kind", ["hdf5", "n5", "zarr"])
def test_views_that_are_not_there_are_named(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path, kind)
    if kind == "hdf5":
        with h5py.File(tmp_path / "data.hdf5", "a") as file:
            del file["t00001/s01"]
    else:
        shutil.rmtree(tmp_path / f"data.{kind}" / ("setup1/timepoint1" if kind == "n5" else "s1-t1.zarr"))
    refused(
        DataError,
        rf"setup 1 at time point 1 is not in data\.{kind} .*, nor listed as missing",
        read_volume,
        path,
        ReadOptions(component=1, time=1),
    )


def test_a_magnitude_needs_one_grid(tmp_path: Path) -> None:
    path = Path(write(tmp_path, "hdf5"))
    setup = '(timepoint="0" setup="1">.*?)<affine>1 0 0 0'
    path.write_text(re.sub(setup, r"\1<affine>1 0 0 9", path.read_text()))
    together = ReadOptions(component="magnitude", time=0)
    refused(DataError, "expected the grid of data:DAPI.*choose one channel", read_volume, str(path), together)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (r"<size>4 5 6", "<size>4 5 7", "setup 0 has 4 x 5 x 6 voxels; expected 4 x 5 x 7, as its XML file says"),
        (r"data\.hdf5", "none.h5", "its data 'none.h5' are not beside it; expected .*none.h5"),
        (r"<hdf5.*</hdf5>", "<files/>", "image loader 'bdv.hdf5'; expected HDF5, N5 or OME-Zarr"),
        (r"<ViewSetups>.*</ViewSetups>", "", "0 setups at 2 time points"),
        (r"<SpimData", '<!DOCTYPE a [<!ENTITY b "c">]><SpimData', "entities"),
    ],
)
def test_faulty_descriptions_are_one_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = Path(write(tmp_path, "hdf5"))
    path.write_text(re.sub(old, new, path.read_text(), flags=re.S))
    refused(DataError, message, read_volume, str(path), ReadOptions(component=0, time=0))


@pytest.mark.parametrize(
    ("points", "steps"),
    [
        ('type="pattern"><integerpattern>0, 1</integerpattern>', 2),
        ('type="pattern"><integerpattern>0-1:2</integerpattern>', 1),
        ('type="list"><timepoint><id>1</id></timepoint>', 1),
    ],
)
def test_lists_of_time_points(tmp_path: Path, points: str, steps: int) -> None:
    path = Path(write(tmp_path, "hdf5"))
    path.write_text(re.sub("<Timepoints.*</Timepoints>", f"<Timepoints {points}</Timepoints>", path.read_text()))
    time = ReadOptions(component=0, time=steps - 1)
    np.testing.assert_array_equal(read_volume(str(path), time).data, values(0, int("1</" in points.split(":")[0])))
    refused(UsageError, f"--time {steps}: ", read_volume, str(path), ReadOptions(component=0, time=steps))


def test_by_command(vvgt, tmp_path: Path) -> None:
    path = write(tmp_path, "hdf5")
    facts = json.loads(vvgt.ok("info", path, "--channel", "GFP", "--time", "1", "--json").out)
    assert (facts["range"], facts["spacing"]) == ([41100, 41219], list(SPACING))
    few = ("--max-gaussians", "50", "--steps", "1", "--screen", "32", "--time", "0")
    for how in ((), ("--blocks", "16", "--level", "full")):
        vvgt.ok("convert", path, "--channel", "DAPI", *few, *how, "-o", str(tmp_path / "v.ply"), "--overwrite")
