"""Binary masks, a file a structure, as one label map; tables of labels in the headers of label maps."""

import gzip
import json
import struct
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest
import SimpleITK
import tifffile
import zarr

from tests.test_volume_amira import amira
from vvgt_cli.conversion.frames import is_glob_of_volumes
from vvgt_cli.field.source import SourceRequest, load, parse_layer
from vvgt_cli.gaussians import read_ply
from vvgt_cli.look.label_files import table_for
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.types import Volume

SMALL = ("--max-gaussians", 300, "--screen", 64, "--steps", 0)
PLACES = {"liver": np.s_[2:9, 2:9, 2:9], "spleen": np.s_[7:12, 7:12, 7:12], "rib_1": np.s_[0:0], "rib_2": np.s_[0, 0]}
EXPECTED = np.zeros((13, 14, 15), np.uint8)
for number, name in ((1, "liver"), (3, "rib_2"), (4, "spleen")):  # the smaller one last
    EXPECTED[PLACES[name]] = number


def write(path: Path, values: np.ndarray, step: float = 1.0) -> None:
    """Write (z, y, x) values by another program."""
    if path.suffix in (".tif", ".npy"):
        write_plain = tifffile.imwrite if path.suffix == ".tif" else np.save
        write_plain(path, values)
        return
    if path.name.endswith(".nii.gz"):
        nibabel.save(nibabel.Nifti1Image(values.T, np.diag([step, 1, 1, 1])), path)
        return
    image = SimpleITK.GetImageFromArray(values)
    image.SetSpacing((step, 1, 1))
    SimpleITK.WriteImage(image, str(path))


def masks(folder: Path, ending: str = ".nii.gz", kind: Any = np.uint8, value: float = 1) -> Path:
    """Write a set of masks, one of them empty, and what TotalSegmentator leaves beside them."""
    folder.mkdir()
    for name, place in PLACES.items():
        values = np.zeros(EXPECTED.shape, kind)
        values[place] = value
        write(folder / f"{name}{ending}", values)
    (folder / "statistics.json").write_text("{}")
    return folder


@pytest.mark.parametrize("glob", [False, True])
@pytest.mark.parametrize(
    ("ending", "kind", "value"),
    [
        (".nii.gz", np.uint8, 1), (".nii.gz", np.float32, 1), (".nrrd", np.uint8, 255), (".mha", np.int16, 1),
        (".tif", np.uint8, 255), (".npy", np.bool_, True),
    ],
)  # fmt: skip
def test_a_set_of_masks_is_one_label_map(tmp_path: Path, ending: str, kind: Any, value: float, glob: bool) -> None:
    folder = masks(tmp_path / "segmentations", ending, kind, value)
    source = str(folder / f"*{ending}") if glob else str(folder)
    said = "4 binary masks are read as one label map.*; rib_1: empty, .*; liver, spleen: in several: voxels go to"
    with pytest.warns(UserWarning, match=said):
        found = read_volume(source)
    np.testing.assert_array_equal(found.data, EXPECTED)
    assert found.segments is not None
    assert (found.data.dtype, found.name) == (np.uint8, "segmentations")
    assert [(one.number, one.name) for one in found.segments] == [(1, "liver"), (3, "rib_2"), (4, "spleen")]
    assert not is_glob_of_volumes(SourceRequest(source))
    assert is_glob_of_volumes(SourceRequest(source, labels="none")) is glob
    cropped = read_volume(source, ReadOptions(crop="2:9,:,:", stored=True, packed=True))
    np.testing.assert_array_equal(cropped.data, EXPECTED[..., 2:9])


def test_a_segment_of_a_file_keeps_its_name_and_color(tmp_path: Path) -> None:
    for k, name in enumerate(("liver", "spleen")):
        fields = {"Name": f"{name} of a child", "LabelValue": "1", "Layer": "0", "Color": "1 0 0.5"}
        image = SimpleITK.GetImageFromArray(((1, 4)[k] == EXPECTED).astype(np.uint8))
        for key, value in fields.items() if k else ():
            image.SetMetaData(f"Segment0_{key}", value)
        SimpleITK.WriteImage(image, str(tmp_path / f"{name}.nrrd"))
    with pytest.warns(UserWarning, match="2 binary masks"):
        found = read_volume(str(tmp_path)).segments or ()
    assert [(one.number, one.name, one.color) for one in found] == [
        (1, "liver", None), (2, "spleen of a child", (1, 0, 0.5))
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("names", "values"),
    [
        (("frame_1", "frame_2", "frame_10"), (0, 1, 1)),  # numbered
        (("rest", "stress", "after"), (0, 1, 300)),  # named, and no masks
        (("rest", "stress", "after"), (0.0, 0.5, 1.0)),
    ],
)
def test_a_series_stays_one(tmp_path: Path, names: tuple[str, ...], values: tuple[float, ...]) -> None:
    for k, name in enumerate(names):
        write(tmp_path / f"{name}.nrrd", np.roll(np.resize(values, (4, 5, 6)), k).astype(np.float32))
    assert is_glob_of_volumes(SourceRequest(str(tmp_path / "*.nrrd")))


def test_sets_that_are_none_are_one_line(vvgt, tmp_path: Path) -> None:
    folder, out = masks(tmp_path / "s"), tmp_path / "x.ply"
    whole = (folder / "liver.nii.gz").read_bytes()
    (folder / "liver.nii.gz").write_bytes(whole[: len(whole) // 2])
    assert "liver.nii.gz" in vvgt.fails(1, "convert", folder, "-o", out)
    write(folder / "liver.nii.gz", np.ones(EXPECTED.shape, np.uint8), step=2)
    said = vvgt.fails(1, "convert", folder / "*.nii.gz", "-o", out)
    assert "rib_1.nii.gz: 15 x 14 x 13 voxels of 1 1 1" in said
    assert "expected the grid of" in said and "liver.nii.gz, 15 x 14 x 13 voxels of 2 1 1" in said  # noqa: PT018
    write(folder / "liver.nii.gz", EXPECTED)
    assert "liver.nii.gz: values such as 1; expected a mask" in vvgt.fails(1, "convert", folder, "-o", out)
    nibabel.save(
        nibabel.Nifti1Image(np.stack([EXPECTED > 0] * 2, -1).astype(np.uint8), np.eye(4)), folder / "liver.nii.gz"
    )
    assert "liver.nii.gz: 2 time steps; expected one mask (" in vvgt.fails(1, "convert", folder, "-o", out)
    for path in folder.glob("*.nii.gz"):
        write(path, EXPECTED * 0)
    assert "4 masks, all empty" in vvgt.fails(1, "convert", folder, "-o", out)
    assert not out.exists()


@pytest.mark.filterwarnings("ignore:.*label map")
def test_masks_go_everywhere(vvgt, tmp_path: Path) -> None:
    folder = masks(tmp_path / "s")
    facts = json.loads(vvgt.ok("info", folder, "--json").out)
    assert facts["label_map"] is True
    assert [row["name"] for row in facts["segments"]] == ["liver", "rib_2", "spleen"]
    vvgt.ok("convert", folder / "*.nii.gz", *SMALL, "-o", tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text()
    assert all(name in page for name in ("liver", "rib_2", "spleen")) and "rib_1" not in page  # noqa: PT018
    for more in ((), ("--blocks", 16)):
        vvgt.ok("convert", folder, "--split-labels", *more, *SMALL, "--overwrite", "-o", tmp_path / "p_{}.ply")
        rows = json.loads((tmp_path / "p_index.json").read_text())["files"]
        assert [row["name"] for row in rows if row["name"] != "rib_2"] == ["liver", "spleen"]
    np.save(tmp_path / "map_seg.npy", EXPECTED)
    for source, name in ((folder, "masks"), (tmp_path / "map_seg.npy", "map")):
        vvgt.ok("init", source, "--blocks", 16, *SMALL[:4], "--frame", "world", "-o", tmp_path / f"{name}.ply")
    colors = [read_ply(str(tmp_path / f"{name}.ply"))[0].colors for name in ("masks", "map")]
    assert colors[0].shape == colors[1].shape
    vvgt.ok("init", "example:blob:8", "--layer", folder, *SMALL[:4], "-o", tmp_path / "l.ply")


def test_layers_have_colours_of_their_own(tmp_path: Path) -> None:
    """As long as the palette lasts; a series keeps its colours, whatever labels a frame has."""
    one = tuple(Volume((k == EXPECTED).astype(np.uint8), name=name) for k, name in ((1, "liver"), (4, "spleen")))
    many = Volume(EXPECTED, name="others")
    look = [SourceRequest(volume, labels="auto") for volume in (*one, many)]
    layers = load(SourceRequest(many, labels="auto", layers=tuple(look))).layers
    shown = [label for layer in layers for label in layer.tf.structures]
    assert len({label.color for label in shown}) == len(shown) == 8
    assert [label.name for label in shown[3:5]] == ["liver", "spleen"]
    stats = load(SourceRequest(many, labels="auto")).statistics
    frame = SourceRequest(one[0], labels="auto", layers=(look[1],), statistics=(stats,))
    first, second = (layer.tf.structures[0] for layer in load(frame).layers)
    far = replace(frame, statistics=(replace(stats, hi=2e9),))  # Allen's atlas has such numbers
    assert [layer.tf.structures[0].name for layer in load(far).layers] == ["label 1", "spleen"]
    assert first.color == shown[0].color
    assert second.color not in {label.color for label in shown[:3]}


# ---- tables in headers


CARET = (
    '<CaretExtension><VolumeInformation Index="0"><LabelTable><Label Key="0" Red="0" Green="0" Blue="0" Alpha="0">'
    '<![CDATA[???]]></Label><Label Key="1" Red="1" Green="0.2" Blue="0" Alpha="0.5"><![CDATA[skin]]></Label>'
    '<Label Key="3" Red="0" Green="0" Blue="1" Alpha="1"><![CDATA[core]]></Label></LabelTable></VolumeInformation>'
    "</CaretExtension>"
)
VALUES = np.resize(np.array([0, 1, 3, 5], np.uint8), (3, 4, 5))


SHORT = '<LabelTable><Label Key="1" Red="1" Green="0" Blue="0" Alpha="1">skin</Label></LabelTable>'


def nifti(path: Path, text: str = CARET) -> str:
    image = nibabel.Nifti1Image(VALUES.T, np.eye(4))
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, text.encode()))
    nibabel.save(image, path / "x.nii.gz")
    return str(path / "x.nii.gz")


def color_table() -> bytes:
    """A table of version 2 behind its tag, as FreeSurfer's colortab.cpp writes it."""
    text = lambda word: struct.pack(">i", len(word) + 1) + word + b"\0"  # noqa: E731
    entries = ((0, b"Unknown", 0, 0, 0), (1, b"skin", 255, 51, 0), (3, b"core", 0, 0, 255))
    rows = [struct.pack(">i", n) + text(name) + struct.pack(">4i", *rgb, 127 * (n == 1)) for n, name, *rgb in entries]
    return struct.pack(">iii", 1, -2, 4) + text(b"LUT.txt") + struct.pack(">i", len(rows)) + b"".join(rows)


TABLE = color_table()


def mgz(path: Path, cut: int = 10_000) -> str:
    """A table behind the values and a tag with a length."""
    nibabel.save(nibabel.MGHImage(VALUES.T, np.eye(4)), path / "x.mgz")
    whole = gzip.decompress((path / "x.mgz").read_bytes()) + struct.pack(">iq", 3, 4) + b"cmd\0" + TABLE[:cut]
    (path / "x.mgz").write_bytes(gzip.compress(whole))
    return str(path / "x.mgz")


PACKED = {"x.nii.gz": nifti, "x.mgz": mgz}


def ome(path: Path, colors: Any = ([255, 51, 0, 128], [0, 0, 255, 255]), place: str = "labels/cells") -> str:
    group = zarr.open_group(path / "x.zarr", mode="w", zarr_format=2).create_group(place)
    group.create_array("0", data=VALUES)
    group.attrs["multiscales"] = [{"version": "0.4", "axes": list("zyx"), "datasets": [{"path": "0"}]}]
    named = [{"label-value": 1, "area": 7, "class": "skin"}, {"label-value": 3, "class": "core"}]
    shown = [{"label-value": n, "rgba": rgba} for n, rgba in zip((1, 3), colors, strict=True)]
    group.attrs["image-label"] = {"version": "0.4", "colors": shown, "properties": named}
    return str(path / f"x.zarr:/{place}")


def am(path: Path, color: str = "0 0 1") -> str:
    parts = '{ Id 9 } skin { Color 1 0.2 0, Id 1 } "none" { Color 0 1 0 } core { Color ' + color + ", Id 7 }"
    streams = [("byte Labels", "", VALUES.tobytes())]
    parameters = f"Materials {{ Exterior {parts} }},\n BoundingBox 0 4 0 3 0 2"
    (path / "x.am").write_bytes(amira("AmiraMesh 3D BINARY 2.0", streams, parameters))
    return str(path / "x.am")


@pytest.mark.parametrize(("make", "opacity"), [(nifti, 0.5), (mgz, 0.5), (ome, 0.5), (am, 1)])
@pytest.mark.parametrize("options", [ReadOptions(), ReadOptions(stored=True, packed=True)])
def test_a_header_names_labels(tmp_path: Path, make: Any, opacity: float, options: ReadOptions) -> None:
    volume = read_volume(make(tmp_path), options)
    np.testing.assert_array_equal(np.asarray(volume.data[:]), VALUES)
    with pytest.warns(UserWarning, match="does not name labels 5; they get distinct colours"):
        found = table_for("auto", [0, 1, 3, 5], volume.name, volume.segments)
    assert [(e.number, e.name) for e in found.structures] == [(1, "skin"), (3, "core"), (5, "label 5")]
    np.testing.assert_allclose([e.color for e in found.structures[:2]], [(1, 0.2, 0), (0, 0, 1)])
    assert [e.opacity for e in found.structures] == [pytest.approx(opacity, abs=0.01), 1, 1]


def test_a_short_table_is_read(tmp_path: Path) -> None:
    named = read_volume(nifti(tmp_path, SHORT)).segments
    assert named is not None
    assert [(one.number, one.name, one.color) for one in named] == [(1, "skin", (1, 0, 0))]


@pytest.mark.parametrize(
    ("make", "bad"),
    [
        (nifti, CARET.replace("0.2", "x")), (nifti, CARET.replace('Key="3"', 'Key="1"')),
        (nifti, CARET.replace("</Label>", "")),
        (mgz, 60), (ome, ([1, 2], [3, 4])), (ome, ([1, 2, 3, 4], [0, 0, 999, 1])), (am, "0 red 1"),
    ],
)  # fmt: skip
def test_a_damaged_table_hides_no_volume(tmp_path: Path, make: Any, bad: Any) -> None:
    with pytest.warns(UserWarning, match="its own table of labels is damaged and not used") as caught:
        volume = read_volume(make(tmp_path, bad))
    assert "\n" not in str(caught[0].message)
    assert volume.segments == ()


def test_a_header_without_a_table_says_nothing(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_volume(nifti(tmp_path, "a comment" * 99)).segments is None


def test_a_layer_goes_into_the_space_and_unit_of_the_first(tmp_path: Path) -> None:
    values = np.random.default_rng(1).random((10, 12, 14)).astype(np.float32)
    first = Volume(values, spacing=(1.0, 2.0, 0.5), origin=(5.0, -3.0, 2.0), space="LPS")
    image = nibabel.Nifti1Image(first.data.T, np.diag([-1.0, -1.0, 1.0, 1.0]) @ first.affine)
    nibabel.save(image, tmp_path / "same.nii")  # RAS, the same place
    source = load(SourceRequest(first, tf="gray", layers=(parse_layer(f"{tmp_path / 'same.nii'},tf=gray"),)))
    np.testing.assert_allclose(source.layers[1].volume.affine, first.affine)
    assert source.volume.on_grid(first)
    large = Volume(values, spacing=(1.0, 2.0, 0.5), origin=(5.0, -3.0, 2.0), unit="mm")
    small = Volume(values, spacing=(1000.0, 2000.0, 500.0), origin=(5000.0, -3000.0, 2000.0), unit="um")
    source = load(SourceRequest(large, tf="gray", layers=(SourceRequest(small, tf="gray"),)))
    np.testing.assert_allclose(source.layers[1].volume.affine, large.affine)
