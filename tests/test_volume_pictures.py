"""Slices as pictures, the numbers in the names of slices, and voxel sizes in the logs of scanners."""

import json
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageOps

from tests.refused import refused
from vvgt_cli.errors import DataError, SeveralComponents, UsageError
from vvgt_cli.volume import ReadOptions, Volume, read_volume
from vvgt_cli.volume.stored import read_block
from vvgt_cli.volume.tiff.slices import by_number, in_order

RNG = np.random.default_rng(11)
GREY = RNG.integers(0, 256, (4, 5, 7)).astype("u1")
DEEP = RNG.integers(0, 65536, (4, 5, 7)).astype("u2")
COLOR = RNG.integers(0, 256, (4, 5, 7, 3)).astype("u1")
ALPHA = RNG.integers(0, 255, (4, 5, 7, 1)).astype("u1")


def values(volume: Volume) -> np.ndarray:
    return read_block(volume, np.zeros(3, int), np.array(volume.dims))


def palette(plane: np.ndarray, colors: Callable[[int], tuple[int, int, int]]) -> Image.Image:
    image = Image.fromarray(plane).convert("P")
    image.putdata(plane.ravel())
    image.putpalette([v for k in range(256) for v in colors(k)])
    return image


def write(folder: Path, planes: list, suffix: str = ".png", name: str = "rec_{:04d}", **how) -> Path:
    """Pictures of planes or images, numbered from 8 on: not the order of their names."""
    folder.mkdir(exist_ok=True)
    for k, plane in enumerate(planes):
        image = plane if isinstance(plane, Image.Image) else Image.fromarray(plane)
        image.save(folder / (name.format(k + 8) + suffix), **how)
    return folder


def threefold(planes: np.ndarray) -> np.ndarray:
    return np.repeat(planes[..., None], 3, axis=3)


@pytest.mark.parametrize(
    ("planes", "suffix", "expected"),
    [
        (GREY, ".png", GREY),
        (DEEP, ".png", DEEP),
        (threefold(GREY), ".png", GREY),
        ([palette(p, lambda k: (255 - k,) * 3) for p in GREY], ".png", 255 - GREY),
        (GREY > 99, ".png", (GREY > 99) * np.uint8(255)),
    ],
)
def test_grey_pictures_are_slices(tmp_path: Path, planes: list, suffix: str, expected: np.ndarray) -> None:
    folder = write(tmp_path / "scan", planes, suffix, "s{}")
    for source in (folder, folder / f"s*{suffix}"):
        for stored in (False, True):
            volume = read_volume(str(source), ReadOptions(stored=stored))
            assert (volume.name, volume.data.dtype) == ("scan" if source == folder else "s", expected.dtype)
            np.testing.assert_array_equal(values(volume), expected)


@pytest.mark.parametrize("planes", [GREY, threefold(GREY)])
def test_jpeg_as_pillow_decodes_it(tmp_path: Path, planes: np.ndarray) -> None:
    folder = write(tmp_path / "scan", list(planes), ".jpg", quality=90)
    expected = [np.asarray(Image.open(path).convert("L")) for path in sorted(folder.iterdir())]
    np.testing.assert_array_equal(read_volume(str(folder)).data, expected)


def test_colours_and_opacity_are_components(tmp_path: Path, vvgt) -> None:
    rgba = np.concatenate([COLOR, ALPHA], 3)
    for planes, count in ((COLOR, 3), (rgba, 4), ([palette(p, lambda k: (k, 255 - k, 7)) for p in GREY], 3)):
        folder = write(tmp_path / f"c{count}", planes)
        with pytest.raises(SeveralComponents, match=rf"{count} components.*--component 0 to {count - 1}") as caught:
            read_volume(str(folder))
        assert (caught.value.count, caught.value.color) == (count, True)
    write(tmp_path / "c3", COLOR)
    Image.fromarray(GREY[1]).save(tmp_path / "c3" / "rec_0009.png")  # a slice without colours in a colour stack
    for k in range(4):
        for stored in (False, True):
            volume = read_volume(str(tmp_path / "c4"), ReadOptions(component=k, stored=stored))
            np.testing.assert_array_equal(values(volume), rgba[..., k])
    mixed = COLOR[..., 2].copy()
    mixed[1] = GREY[1]
    np.testing.assert_array_equal(read_volume(str(tmp_path / "c3"), ReadOptions(component=2)).data, mixed)
    refused(UsageError, "not component 3", read_volume, str(tmp_path / "c3"), ReadOptions(component=3))
    assert json.loads(vvgt("info", tmp_path / "c3", "--json").out)["dims"] == [7, 5, 4]
    grey_alpha = np.concatenate([GREY[..., None], ALPHA], 3)
    refused(SeveralComponents, "2 components", read_volume, str(write(tmp_path / "la", grey_alpha)))


def test_orientation_as_pillow_turns_it(tmp_path: Path) -> None:
    exif = Image.Exif()
    for turn, suffix in [(turn, suffix) for turn in range(1, 9) for suffix in (".png", ".jpg")]:
        exif[274] = turn
        path = tmp_path / f"a{suffix}"
        Image.fromarray(GREY[0]).save(path, exif=exif)
        np.testing.assert_array_equal(
            read_volume(str(path)).data[0], np.asarray(ImageOps.exif_transpose(Image.open(path)))
        )


def test_other_files_in_a_folder_are_skipped_with_a_warning(tmp_path: Path) -> None:
    folder = write(tmp_path / "scan", GREY, ".bmp")
    Image.fromarray(GREY[0, :3]).save(folder / "rec__spr.bmp")
    Image.fromarray(GREY[0, :2]).save(folder / "thumb_8.jpg")
    (folder / "rec.log").write_text("no sizes\n")
    with pytest.warns(UserWarning, match="skipped") as told:
        volume = read_volume(str(folder))
    np.testing.assert_array_equal(volume.data, GREY)
    assert [str(w.message).partition(": ")[2] for w in told] == [
        "skipped thumb_8.jpg: not of the format of most slices",
        "skipped rec__spr.bmp: not numbered as the other slices",
    ]


def test_pictures_that_do_not_fit(tmp_path: Path) -> None:
    for change, message in (
        (lambda path: Image.fromarray(GREY[0, :4]).save(path), "rec_0010.png: 7 x 4 uint8; expected 7 x 5 uint8 as in"),
        (lambda path: Image.fromarray(DEEP[0]).save(path), "rec_0010.png: 7 x 5 uint16; expected 7 x 5 uint8 as in"),
        (
            lambda path: path.write_bytes(path.read_bytes()[:60]),
            r"rec_0010.png: cannot be read \(.*expected a whole PNG",
        ),
        (
            lambda path: path.write_bytes(b"GIF89a" + bytes(50)),
            r"rec_0010.png: cannot be read \(.*expected a whole PNG",
        ),
    ):
        folder = write(tmp_path / "scan", GREY)
        change(folder / "rec_0010.png")
        refused(DataError, message, read_volume, str(folder))
    folder = write(tmp_path / "jpeg", GREY, ".jpg")
    (folder / "rec_0010.jpg").write_bytes((folder / "rec_0010.jpg").read_bytes()[:-20])
    with pytest.raises(DataError, match="Premature end of JPEG"):  # which would otherwise be grey from there on
        read_volume(str(folder))
    folder = write(tmp_path / "grey", threefold(np.repeat(GREY, 8, axis=0)))
    Image.fromarray(COLOR[0]).save(folder / "rec_0009.png")  # not one of those that are looked at first
    refused(DataError, r"rec_0009.png: 3 components .*; expected 1 as in other pictures", read_volume, str(folder))


def test_previews_do_not_make_a_folder_one_of_slices(tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", GREY)
    write(tmp_path, np.repeat(GREY, 2, axis=0))
    with pytest.raises(DataError, match=r"found 8 picture \(rec_0008.png.*1 NumPy \(v.npy\): give one of the files"):
        read_volume(str(tmp_path))
    write(tmp_path, np.repeat(GREY, 3, axis=0))
    assert read_volume(str(tmp_path)).dims == (7, 5, 12)
    (tmp_path / "one").mkdir()
    Image.fromarray(GREY[0]).save(tmp_path / "one" / "a.png")
    refused(DataError, r"found 1 picture \(a.png\): give one of the files", read_volume, str(tmp_path / "one"))
    for name in ("a.png", "A", "a.dat"):
        (tmp_path / "one" / "a.png").rename(tmp_path / "one" / name)
        assert read_volume(str(tmp_path / "one" / name)).dims == (7, 5, 1)
        (tmp_path / "one" / name).rename(tmp_path / "one" / "a.png")


def ordered(names: list[str]) -> tuple[list[str], int, list[str]]:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        files, step = in_order(sorted(map(Path, names), key=by_number), "S")
    return [path.name for path in files], step, [str(w.message) for w in told]


@pytest.mark.parametrize(
    ("names", "step"),
    [
        ([f"scan2_{k:04d}.tif" for k in range(3, 9)], 1),
        ([f"a{k}.tif" for k in range(0, 100, 10)], 10),
        ([f"C1-img_{k:04d}.tif" for k in range(6)], 1),
        ([f"{odd}_{k:03d}.png" for k, odd in enumerate((993, 12, 554, 31))], 1),
        ([f"z_{k / 4:.2f}.tif" for k in range(9)], 1),
        (["a1.png", "a2.png", "b.png", "c.png"], 1),
        (["a.png"], 1),
    ],
)
def test_names_of_one_series(names: list[str], step: int) -> None:
    assert ordered(names) == (names, step, [])


@pytest.mark.parametrize(
    ("names", "ranges", "pattern"),
    [
        ([f"img_z{z}_c{c}.tif" for z in range(4) for c in (0, 1)], "z 0 to 3, c 0 to 1", "img_z*_c0.tif"),
        ([f"t{t:03d}_z{z:03d}.png" for t in range(5) for z in range(3)], "t 0 to 4, z 0 to 2", "t000_z*.png"),
        ([f"C{c}-[a] {z:04d}.tif" for c in (1, 2) for z in range(6)], "C 1 to 2, number 0 to 5", "C1-[[]a] *.tif"),
        ([f"i{k:03d}_{dye}.tif" for k in range(5) for dye in ("DAPI", "GFP")], "i 0 to 4", "i*_DAPI.tif"),
    ],
)
def test_names_of_several_stacks(tmp_path: Path, names: list[str], ranges: str, pattern: str) -> None:
    """The error says which numbers vary, and its glob reads one stack."""
    with pytest.raises(DataError) as caught:
        ordered([str(tmp_path / name) for name in names])
    assert f"names of its {len(names)} files ({ranges})" in str(caught.value)
    assert str(caught.value).endswith(f"give one, as '{tmp_path / pattern}'")
    for k, name in enumerate(names):
        Image.fromarray(np.full((2, 3), k, "u1")).save(tmp_path / name)
    refused(DataError, "no one number counts the slices", read_volume, str(tmp_path))
    chosen = [k for k, name in enumerate(names) if Path(name).match(pattern)]
    assert read_volume(str(tmp_path / pattern)).data[:, 0, 0].tolist() == chosen
    assert 1 < len(chosen) < len(names)


def test_gaps_and_clock_times_are_said(tmp_path: Path) -> None:
    for numbers, missing in (((1, 2, 3, 5), "4"), ((0, 10, 20, 40, 50), "30"), ((1, 2, 9), "3, 4, 5, ...")):
        told = ordered([f"a{n}.tif" for n in numbers])[2]
        assert told == [f"S: no slices numbered {missing}; read as if evenly spaced"]
    times = [f"2024_12-{m:02d}-{s:02d}.png" for m, s in ((0, 1), (0, 31), (1, 2), (1, 33), (2, 1))]
    names, _, told = ordered(times)
    assert names == times
    assert "number 0 to 2, number 1 to 33); they are in the order of the first" in told[0]
    write(tmp_path / "scan", GREY)
    (tmp_path / "scan" / "rec_0009.png").unlink()
    with pytest.warns(UserWarning, match="no slices numbered 9"):
        assert read_volume(str(tmp_path / "scan")).dims == (7, 5, 3)


SKYSCAN = """[System]
Camera Pixel Size (um)=    8.80
[Acquisition]
Number of Columns= 4000
Image Pixel Size (um)=    1.66
[Reconstruction]
First Section=122
Section to Section Step={step}
Result Image Width (pixels)={width}
Result Image Height (pixels)=5
Pixel Size (um)={size}
"""
NIKON = """[XTekCT]
VoxelsX=7
VoxelsY=5
VoxelSizeX=0.025
VoxelSizeY=0.025
VoxelSizeZ=0.03
Units=mm
"""


def skyscan(step: int = 1, width: int = 7, size: str = "1.65905") -> str:
    return SKYSCAN.format(step=step, width=width, size=size)


@pytest.mark.parametrize(
    ("logs", "name", "spacing", "unit"),
    [
        ({"x_rec.log": skyscan()}, "x_rec{:08d}", (1.65905,) * 3, "um"),
        ({"x.log": "[Acquisition]\nImage Pixel Size (um)= 1.66\n"}, "x{:04d}", (1.66,) * 3, "um"),
        ({"x.log": skyscan()}, "x{:03d}0", (1.65905, 1.65905, 16.5905), "um"),
        ({"x.xtekct": NIKON}, "x_{:04d}", (0.025, 0.025, 0.03), "mm"),
        ({"notes.log": "Pixel Size = large\n[\n="}, "x{:04d}", (1.0,) * 3, ""),
    ],
)
def test_voxel_sizes_of_logs(tmp_path: Path, logs: dict, name: str, spacing: tuple, unit: str) -> None:
    folder = write(tmp_path / "scan", GREY, name=name)
    for k in range(8, 12):
        tifffile.imwrite(tmp_path / f"{name.format(k)}.tif", GREY[k - 8])
    for place in (folder, tmp_path):
        for log, text in logs.items():
            (place / log).write_text(text)
        for stored in (False, True):
            volume = read_volume(str(place), ReadOptions(stored=stored))
            assert volume.spacing == pytest.approx(spacing, rel=1e-12)
            assert volume.unit == unit
        given = read_volume(str(place), ReadOptions(spacing=(1, 2, 3)))
        assert (given.spacing, given.unit) == ((1, 2, 3), unit)


def test_logs_that_do_not_fit(tmp_path: Path) -> None:
    folder = write(tmp_path / "scan", GREY, name="x{:04d}")
    for logs, message in (
        ({"x.log": skyscan(width=14)}, "1.65905 1.65905 1.65905 um not used: for 14 x 5 pixels, not for 7 x 5"),
        ({"a.log": skyscan(), "b.log": skyscan(size="9")}, "not used: one of 2 logs, none named as the slices"),
    ):
        for log, text in logs.items():
            (folder / log).write_text(text)
        with pytest.warns(UserWarning, match=message):
            assert read_volume(str(folder)).spacing == (1, 1, 1)
        for log in logs:
            (folder / log).unlink()
    (folder / "x.log").write_text(skyscan(size="1,65905"))
    refused(DataError, r"x.log: .*pixel size \(um\) is '1,65905'; expected 1 finite numbers", read_volume, str(folder))
    (folder / "x.log").write_text(skyscan(size="0"))
    refused(DataError, "expected three positive numbers", read_volume, str(folder))


def test_sizes_that_slices_state_themselves(tmp_path: Path) -> None:
    """TIFF slices keep their unit; a distance that they do not state is said once; the log does not replace them."""

    def read(stated: dict, **options) -> tuple[tuple, str, list[str]]:
        shutil.rmtree(tmp_path / "scan", ignore_errors=True)
        (tmp_path / "scan").mkdir()
        for k in range(4):
            tifffile.imwrite(tmp_path / "scan" / f"x{k}.tif", GREY[k], **stated)
        (tmp_path / "scan" / "x.log").write_text(skyscan())
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            volume = read_volume(str(tmp_path / "scan"), ReadOptions(**options))
        np.testing.assert_array_equal(values(volume), GREY)
        return (
            volume.spacing,
            volume.unit,
            [str(w.message).partition(": ")[2] for w in told if w.category is UserWarning],
        )

    imagej = {"imagej": True, "resolution": (2, 2), "metadata": {"unit": "um"}}
    guess = "no distance between its slices; taken as wide as its pixels (--spacing X Y Z sets it)"
    for stored in (False, True):
        assert read(imagej, stored=stored) == ((0.5, 0.5, 0.5), "um", [guess])
        assert read(imagej, stored=stored, spacing=(1.0, 1.0, 2.0)) == ((1, 1, 2), "um", [])
        sizes = {"axes": "YX", "PhysicalSizeX": 0.5, "PhysicalSizeY": 0.5, "PhysicalSizeZ": 3}
        assert read({"ome": True, "metadata": sizes}, stored=stored) == ((0.5, 0.5, 3), "um", [])
        assert read({}, stored=stored) == ((1.65905,) * 3, "um", [])
