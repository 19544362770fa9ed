"""Crops, masks, colours, channels and layers: what adds up, where it lies, and what is refused."""

import json
import re
from dataclasses import replace
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
import tifffile

import vvgt_cli as library
from tests.refused import refused
from tests.test_labels import SMALL, balls
from vvgt_cli.cameras import default_views
from vvgt_cli.dvr import RenderSettings, render_view, render_view_reference
from vvgt_cli.dvr.layers import Layer, common_grid, grid_of
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.layered import ALL, open_content
from vvgt_cli.field.source import SourceRequest, load, parse_layer
from vvgt_cli.gaussians import read_ply
from vvgt_cli.images.metrics import psnr
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.labels import distinct
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.volume import ReadOptions, Volume, read_volume
from vvgt_cli.volume.options import crop, masked, parse_crop
from vvgt_cli.volume.registry import cut

TURNED = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def ramp(lo: float, hi: float, rgb=(1.0, 1.0, 1.0)) -> TransferFunction:
    x = np.array([lo, hi])
    return TransferFunction("ramp", PiecewiseOpacity(x, np.array([0.0, 0.5])), ColorMap(x, np.array([rgb, rgb])))


def cloud(shape=(10, 12, 14), **place) -> Volume:
    return Volume(np.random.default_rng(1).random(shape).astype(np.float32), name="cloud", **place)


# ---- crop and mask


def test_a_crop_keeps_its_place_in_the_world() -> None:
    volume = cloud(spacing=(1.0, 2.0, 0.5), origin=(5.0, -3.0, 2.0), direction=TURNED)
    part = crop(volume, parse_crop("2:9,:,3:"))
    assert part.dims == (7, 12, 7)
    np.testing.assert_array_equal(part.data, volume.data[3:, :, 2:9])
    np.testing.assert_allclose(part.affine @ [1, 2, 3, 1], volume.affine @ [3, 2, 6, 1])


@pytest.mark.parametrize("text", ["1:2", "1:2,3:4,5", "2:2,:,:", "5:3,:,:", "a:b,:,:", "-1:3,:,:", "1:2,3:4,5:6,7:8"])
def test_crops_that_are_none(text: str) -> None:
    refused(UsageError, "--crop", ReadOptions, crop=text)


def test_a_mask_hides_and_must_have_the_size() -> None:
    volume = Volume(np.arange(24, dtype=np.int16).reshape(2, 3, 4), slope=2.0, name="v")
    keep = np.zeros((2, 3, 4), np.uint8)
    keep[1] = 7
    part = masked(volume, Volume(keep))
    assert part.slope == 2.0
    assert part.data.dtype == np.float32
    np.testing.assert_array_equal(np.isfinite(part.data), keep > 0)
    np.testing.assert_array_equal(part.data[1], volume.data[1])
    with pytest.raises(DataError, match=r"--mask m: 4 x 3 x 1 voxels; expected the 4 x 3 x 2 of v"):
        masked(volume, Volume(keep[:1], name="m"))
    refused(DataError, "all of it is 0", masked, volume, Volume(keep * 0))
    big = replace(volume, data=volume.data.astype(np.int32) * 1000003)
    np.testing.assert_array_equal(masked(big, Volume(keep)).data[1], big.data[1])


def test_a_mask_is_where_its_file_says(vvgt, tmp_path: Path) -> None:
    affine = np.array([[0, -2, 0, 10], [1.5, 0, 0, -4], [0, 0, 1, 7], [0, 0, 0, 1.0]])
    values = np.random.default_rng(3).integers(1, 99, (5, 6, 7)).astype(np.int16)
    scan, keep = nibabel.Nifti1Image(values, affine), nibabel.Nifti1Image((values > 60).astype(np.uint8), affine)
    nibabel.save(scan, tmp_path / "v.nii")
    nibabel.save(nibabel.as_closest_canonical(keep), tmp_path / "m.nii")  # its axes in another order
    image = sitk.GetImageFromArray(np.asarray(keep.dataobj).T)
    image.SetSpacing((1.5, 2, 1)), image.SetOrigin((-10, 4, 7)), image.SetDirection((0, 1, 0, -1, 0, 0, 0, 0, 1))
    sitk.WriteImage(sitk.DICOMOrient(image, "AIR"), tmp_path / "m.nrrd")
    for name, how in (("m.nii", {}), ("m.nrrd", {}), ("m.nii", {"crop": "1:4,2:,:6"})):
        part = library.read_volume(tmp_path / "v.nii", mask=tmp_path / name, **how).data
        whole = values.T[:6, 2:, 1:4] if how else values.T
        np.testing.assert_array_equal(np.nan_to_num(part), np.where(whole > 60, whole, 0))
    part = library.read_volume(tmp_path / "v.nii", mask=tmp_path / "m.nii", spacing=(3, 1, 2)).data
    np.testing.assert_array_equal(np.nan_to_num(part), np.where(values.T > 60, values.T, 0))
    keep.affine[2, 3] += 1
    nibabel.save(nibabel.Nifti1Image(np.asarray(keep.dataobj), keep.affine), tmp_path / "m.nii")
    part = library.read_volume(tmp_path / "v.nii", mask=tmp_path / "m.nii", spacing=(1, 1, 1)).data
    np.testing.assert_array_equal(np.nan_to_num(part), np.where(values.T > 60, values.T, 0))
    said = vvgt("info", tmp_path / "v.nii", "--mask", tmp_path / "m.nii").error
    assert re.search("--mask m: 5 x 6 x 7 voxels.*; expected the grid of v", said), said


@pytest.mark.parametrize("how", [{}, {"crop": "1:,:2,:"}, {"spacing": (1, 2, 3)}])
def test_a_mask_without_a_place_is_applied_voxel_by_voxel(how: dict) -> None:
    place = {"direction": (0, 1, 0, 1, 0, 0, 0, 0, -1), "origin": (5, 0, 0), "spacing": (2, 2, 2)}
    keep = np.random.default_rng(4).integers(0, 2, (3, 4, 5)).astype(np.uint8)
    volume = Volume(np.ones((3, 4, 5), np.float32), **place)
    for mask in (Volume(keep), replace(volume, data=keep, unit="m", spacing=(2e-3,) * 3, origin=(5e-3, 0, 0))):
        part = cut(replace(volume, unit="mm"), ReadOptions(mask=mask, **how)).data
        np.testing.assert_array_equal(np.isfinite(part), keep[:, :2, 1:] if "crop" in how else keep)
    with pytest.warns(UserWarning, match="--mask lost: states no place; applied voxel by voxel"):
        cut(replace(volume, space="RAS"), ReadOptions(mask=Volume(keep, space="RAS", name="lost"), **how))
    there = Volume(keep, space="RAS", direction=(-1, 0, 0, 0, -1, 0, 0, 0, 1), origin=(4, 3, 0))
    part = cut(replace(there, data=np.ones_like(volume.data)), ReadOptions(mask=Volume(keep, space="RAS"))).data
    np.testing.assert_array_equal(np.isfinite(part), keep[:, ::-1, ::-1])  # the defaults are its place, and it fits
    wide = replace(volume, space="RAS", spacing=(2.03, 2, 2))
    refused(DataError, "expected the grid of", cut, volume, ReadOptions(mask=replace(wide, space=None, data=keep)))
    oblique = replace(volume, direction=(0.8, 0.6, 0, -0.6, 0.8, 0, 0, 0, 1), data=keep)
    refused(DataError, "expected the grid of", cut, volume, ReadOptions(mask=oblique, spacing=(1, 1, 1)))


def test_of_scalars_and_labels_on_the_command_line(vvgt, tmp_path: Path) -> None:
    affine = np.array([[0, -2, 0, 10], [1.5, 0, 0, -4], [0, 0, 1, 7], [0, 0, 0, 1.0]])
    nibabel.save(nibabel.Nifti1Image(balls().astype(np.int16), affine), tmp_path / "v.nii")
    nibabel.save(nibabel.Nifti1Image((balls() == 3).astype(np.uint8), affine), tmp_path / "m.nii")
    whole, part = (
        read_volume(str(tmp_path / "v.nii")),
        read_volume(str(tmp_path / "v.nii"), ReadOptions(crop=":,6:18,:")),
    )
    np.testing.assert_allclose(part.affine @ [0, 0, 0, 1], whole.affine @ [0, 6, 0, 1])
    out = tmp_path / "a.ply"
    vvgt.ok("init", tmp_path / "v.nii", "--tf", "gray", "--crop", ":,6:18,:", *SMALL[:4], "--frame", "world", "-o", out)
    _, header = read_ply(str(out))
    np.testing.assert_allclose(np.reshape(header.affine, (3, 4)), part.affine[:3], atol=1e-6)
    for options in (("--tf", "gray"), ("--labels", "auto")):
        mask = ("--mask", tmp_path / "m.nii", "--overwrite")
        vvgt.ok("init", tmp_path / "v.nii", *options, *mask, *SMALL[:4], "-o", out)
        means, frame = library.read_ply(out)[0].means, whole.unit_frame()
        world = means / frame.scale + frame.centre
        index = np.round((np.linalg.inv(whole.affine) @ np.c_[world, np.ones(len(world))].T).T[:, :3]).astype(int)
        if "--labels" in options:  # their extinction begins a voxel outside, and so does their surface
            index = np.where(index < 12, np.ceil(index + 0.5), np.floor(index - 0.5)).astype(int)
        assert np.mean(balls()[tuple(np.clip(index, 0, 23).T)] == 3) > 0.95
    assert "nothing of v" in vvgt("info", tmp_path / "v.nii", "--crop", "30:,:,:").error
    wrong = tmp_path / "w.nii"
    nibabel.save(nibabel.Nifti1Image(np.ones((2, 2, 2), np.uint8), affine), wrong)
    assert "2 x 2 x 2 voxels; expected the 24 x 24 x 24" in vvgt("info", tmp_path / "v.nii", "--mask", wrong).error


@pytest.mark.filterwarnings("ignore:.*in smaller bodies")
def test_the_largest_body_is_kept_in_memory_in_blocks_and_live(tmp_path: Path, vvgt) -> None:
    z, y, x = np.indices((20, 24, 40)) - 10.0
    head = np.hypot(np.hypot(z, y), x) < 8
    rest = (np.abs(z) < 9) & (np.abs(y) < 9) & (x > 18) & (x < 24)
    values = np.where(head, 40, np.where(rest, 200, -1000)).astype(np.int16)
    np.save(tmp_path / "v.npy", values)
    for stored in (False, True):
        data = read_volume(str(tmp_path / "v.npy"), ReadOptions(keep_largest=-300, stored=stored)).data[:]
        np.testing.assert_array_equal(np.isnan(data), rest)
        np.testing.assert_array_equal(data[~rest], values[~rest])
    with pytest.warns(
        UserWarning, match=r"--keep-largest -300: hides 40\.7 % of the voxels above it, in smaller bodies"
    ):
        assert (read_volume(str(tmp_path / "v.npy"), ReadOptions(keep_largest=-300)).data == 40).sum() == head.sum()
    with pytest.raises(DataError, match="--keep-largest 300: no voxel lies above"):
        read_volume(str(tmp_path / "v.npy"), ReadOptions(keep_largest=300))
    refused(UsageError, "--keep-largest nan: expected a finite", ReadOptions, keep_largest=float("nan"))
    whole = library.convert(values, "gray:0.9,1", max_gaussians=200, screen=40, steps=0, keep_largest=-300)
    assert whole.gaussians.means[:, 0].max() < 0.2
    few, blocks = ("--steps", 0), ("--blocks", 16)
    runs = {"a": few, "b": (*few, *blocks), "c": (*few, *blocks, "--workers", 2), "live": ("--live",)}
    for name, more in runs.items():
        given = ("--tf", "gray:0.9,1", "--keep-largest", -300, "--max-gaussians", 200, "--screen", 40, *more)
        with pytest.warns(UserWarning, match=r"hides 40\.7 % of the voxels above it") as notes:
            made = vvgt("convert", tmp_path / "v.npy", *given, "-o", tmp_path / f"{name}.ply")
        assert made.code == 0, made.err
        told = [str(note.message) for note in notes if note.category is UserWarning]  # of no file left open elsewhere
        assert len(told) == 1, told  # in blocks too
        assert read_ply(tmp_path / f"{name}.ply")[0].means[:, 0].max() < 0.2  # the rest lies from 0.4 on


# ---- colours


def colors(shape=(6, 8, 10), samples: int = 3) -> np.ndarray:
    """Smooth RGB or RGBA, (nz, ny, nx, samples) uint8."""
    z, y, x = np.mgrid[: shape[0], : shape[1], : shape[2]].astype(np.float64)
    bands = [x / x.max(), y / y.max(), z / z.max(), (x + y) / (x + y).max()]
    return np.round(255 * np.stack(bands[:samples], axis=-1)).astype(np.uint8)


def write_nifti(path: Path, values: np.ndarray) -> None:
    kind = np.dtype([(c, "u1") for c in "RGBA"[: values.shape[3]]])
    image = np.ascontiguousarray(values.transpose(2, 1, 0, 3)).view(kind)[..., 0]
    nibabel.save(nibabel.Nifti1Image(image, np.diag([1, 2, 3, 1.0])), path)


def write_nrrd(path: Path, values: np.ndarray) -> None:
    n, (nz, ny, nx) = values.shape[3], values.shape[:3]
    kind = "RGBA-color" if n == 4 else "RGB-color"
    header = f"NRRD0004\ntype: uchar\ndimension: 4\nsizes: {n} {nx} {ny} {nz}\nencoding: raw\n"
    header += f"kinds: {kind} domain domain domain\n\n"
    path.write_bytes(header.encode() + values.tobytes())


def write_tiff(path: Path, values: np.ndarray) -> None:
    extra = {"extrasamples": ["unassalpha"]} if values.shape[3] == 4 else {}
    tifffile.imwrite(path, values, photometric="rgb", **extra)


def write_vti(path: Path, values: np.ndarray) -> None:
    import pyvista

    image = pyvista.ImageData(dimensions=values.shape[2::-1])
    image.point_data["colours"] = values.reshape(-1, values.shape[3])
    image.save(path)


@pytest.mark.parametrize("samples", [3, 4])
@pytest.mark.parametrize(
    ("write", "name"),
    [
        (write_nifti, "a.nii.gz"),
        (write_nifti, "a.nii"),
        (write_nrrd, "a.nrrd"),
        (write_tiff, "a.tif"),
        (write_vti, "a.vti"),
        (write_vti, "a.vtk"),
    ],
)
def test_colours_of_every_format(tmp_path: Path, write, name: str, samples: int) -> None:
    values = colors(samples=samples)
    write(tmp_path / name, values)
    content = open_content(str(tmp_path / name), ReadOptions())
    assert content.color
    np.testing.assert_array_equal(np.stack([v.data for v in content.volumes], axis=-1), values)
    np.testing.assert_array_equal(read_volume(str(tmp_path / name), ReadOptions(component=1)).data, values[..., 1])
    source = load(SourceRequest(str(tmp_path / name)))
    grid = grid_of(source.layers, source.volume)
    weight = values[..., 3] if samples == 4 else values @ np.array([0.2126, 0.7152, 0.0722])
    seen = grid[..., 3] > 0
    np.testing.assert_array_equal(seen, weight > 0)
    np.testing.assert_allclose(grid[..., :3][seen] / grid[..., 3:][seen], values[..., :3][seen] / 255, atol=1e-5)
    distance = max(source.volume.extent) / 256
    np.testing.assert_allclose(
        grid[..., 3], -np.log1p(-np.minimum(weight / 255, 1 - 1e-5)) / distance, rtol=2e-4, atol=1e-4
    )


def test_the_largest_body_of_colours_is_refused_and_each_channel_has_its_own(vvgt, tmp_path: Path) -> None:
    write_nrrd(tmp_path / "a.nrrd", colors())
    given = ("convert", tmp_path / "a.nrrd", "--max-gaussians 100 --screen 40 --steps 0 -o", tmp_path / "a.ply")
    for more in ((), ("--blocks", 16), ("--component", "color")):
        done = vvgt.fails(2, *given, "--keep-largest", 10, *more)
        assert "a.nrrd has colours; expected scalars: give a --mask" in done
    refused(UsageError, "has colours", library.convert, str(tmp_path / "a.nrrd"), keep_largest=10)
    vvgt.ok(*given, "--keep-largest", 10, "--component", 0)
    for more in (("--overwrite",), ("--overwrite", "--blocks", 16)):
        with pytest.warns(UserWarning, match="--keep-largest 10: hides"):
            done = vvgt(*given, "--keep-largest", 10, "--component", "all", *more)
        assert done.code == 0, done.err


def test_colours_by_command(vvgt, tmp_path: Path) -> None:
    write_nrrd(tmp_path / "a.nrrd", colors())
    assert '"colors": "RGB"' in vvgt("info", tmp_path / "a.nrrd", "--json").out.decode()
    assert "opacity by luminance" in vvgt.ok("convert", tmp_path / "a.nrrd", *SMALL, "-o", tmp_path / "a.ply").err
    made, _ = read_ply(str(tmp_path / "a.ply"))
    order = np.argsort(made.means[:, 0])
    assert np.polyfit(made.means[order, 0], made.colors[order, 0], 1)[0] > 0.3  # red grows along x
    np.save(tmp_path / "f.npy", colors().astype(np.float32))
    assert "component" in vvgt("init", tmp_path / "f.npy", "-o", tmp_path / "b.ply").error
    vvgt.ok("init", tmp_path / "a.nrrd", "--component", 0, "-o", tmp_path / "c.ply")
    asked = vvgt("init", "example:blob:8", "--component", "color", "-o", tmp_path / "d.ply")
    assert "one component; expected several: omit --component color" in asked.error
    assert "several components" in vvgt("init", tmp_path / "a.nrrd", "--labels", "auto", "-o", tmp_path / "e.ply").error


def test_names_of_labels_are_kept_beside_other_layers(vvgt, tmp_path: Path) -> None:
    nibabel.save(nibabel.Nifti1Image(balls().astype(np.float32), np.eye(4)), tmp_path / "v.nii")
    nibabel.save(nibabel.Nifti1Image(balls().astype(np.int16), np.eye(4)), tmp_path / "l.nii")
    names = ["left kidney", "right kidney"]
    table = {k: {"name": name, "color": [1, k / 3, 0], "opacity": 0.5} for k, name in zip((1, 3), names, strict=True)}
    (tmp_path / "t.json").write_text(json.dumps(table))
    given = (tmp_path / "v.nii", "--tf", "gray", "--layer", f"{tmp_path / 'l.nii'},labels={tmp_path / 't.json'}")
    for options, out in (((), "a.ply"), (("--live",), "b.ply")):
        vvgt.ok("init" if not options else "convert", *given, *SMALL[:4], *options, "-o", tmp_path / out)
    vvgt.ok("recolor", tmp_path / "b.ply", "-o", tmp_path / "c.ply")
    for out in ("a.ply", "c.ply"):
        legend = json.loads(library.read_ply(tmp_path / out)[1].legend)
        assert [name for name, _ in legend["labels"]] == names


def test_rgb_looks_as_vtk_draws_dependent_components() -> None:
    """vtkGPUVolumeRayCastMapper's picture of RGBA, independent components off, at the same steps."""
    from tests.stiff_scenes import camera
    from tests.vtk_colors import dependent
    from vvgt_cli.dvr import RenderSettings, Scene, render_view
    from vvgt_cli.images.metrics import psnr

    values = colors((24, 24, 24), 4)
    bands = tuple(Volume(np.ascontiguousarray(values[..., c])) for c in range(4))
    opacity = TransferFunction("a", PiecewiseOpacity(np.array([0.0, 255]), np.array([0.0, 0.3])), ramp(0, 1).color_map)
    layer = Layer(bands[3], opacity, 1.0, "given", bands[:3], 255.0)
    scene = Scene.of_grid(bands[3], opacity, 1.0, grid_of([layer], bands[3]))
    view = camera(96, 96)
    theirs = dependent(values, scene, 0.3, view)
    ours = render_view(scene, view, RenderSettings(step=0.25, samples=1))
    assert theirs[..., 3].max() > 0.5
    assert psnr(theirs[..., :3], ours[..., :3]) > 38


# ---- channels


def write_ome(path: Path) -> np.ndarray:
    values = np.zeros((6, 2, 8, 10), np.uint16)
    values[:, 0, :, :5], values[:, 1, :, 5:] = 1000, 3000
    channel = {"Name": ["red", "cyan"], "Color": [-16776961, 16777215]}  # RGBA as signed 32 bits
    tifffile.imwrite(path, values, ome=True, metadata={"axes": "ZCYX", "Channel": channel})
    return values


def test_channels_in_their_own_colours_add_up(vvgt, tmp_path: Path) -> None:
    values = write_ome(tmp_path / "a.ome.tif")
    content = open_content(str(tmp_path / "a.ome.tif"), ReadOptions(component=ALL))
    assert list(content.colors) == [(1.0, 0.0, 0.0), (0.0, 1.0, 1.0)]
    source = load(SourceRequest(str(tmp_path / "a.ome.tif"), ReadOptions(component=ALL)))
    grid = grid_of(source.layers, source.volume)
    assert (grid[..., 0] > 0).tolist() == (values[:, 0] > 0).tolist()
    np.testing.assert_array_equal(grid[..., 1], grid[..., 2])
    told = json.loads(vvgt("info", tmp_path / "a.ome.tif", "--channel", "all", "--json").out)
    assert told["channels"] == 2
    unsure = vvgt("init", tmp_path / "a.ome.tif", "--tf", "hot", "-o", tmp_path / "a.ply")
    assert unsure.code == 2  # one, or all
    assert "--channel 0 to 1, a name, all" in unsure.error
    vvgt.ok("init", tmp_path / "a.ome.tif", "--channel", "all", *SMALL[:4], "-o", tmp_path / "a.ply")
    layer = f"{tmp_path / 'a.ome.tif'},channel=cyan,tf=gray"
    how = ("--channel 0 --tf hot --layer", layer, *SMALL[:4], "-o", tmp_path / "b.ply")
    assert "gray" in vvgt.ok("init", tmp_path / "a.ome.tif", *how).err


@pytest.mark.parametrize(
    ("asked", "numbers"),
    [
        *(("DAPI,RFP", [0, 2]), ("2,0", [2, 0]), ("RFP,0", [2, 0]), ("0,DAPI,0,1", [0, 1])),
        *(("GFP, membrane", [1]), ("RFP,GFP, membrane", [2, 1]), ("GFP, membrane,DAPI,2", [1, 0, 2])),
    ],
)
def test_several_channels_by_names_and_numbers(vvgt, tmp_path: Path, asked: str, numbers: list[int]) -> None:
    """A name may hold a comma, and each channel has the colour that it has among all."""
    path = tmp_path / "a.ome.tif"
    values = np.random.default_rng(0).integers(0, 999, (6, 3, 8, 10)).astype(np.uint16)
    names = ["DAPI", "GFP, membrane", "RFP"]
    tifffile.imwrite(path, values, ome=True, metadata={"axes": "ZCYX", "Channel": {"Name": names}})
    every, some = (open_content(str(path), ReadOptions(component=word)) for word in (ALL, asked))
    for volume, number in zip(some.volumes, numbers, strict=True):
        np.testing.assert_array_equal(volume.data, values[:, number])
    if len(numbers) > 1:
        assert list(some.colors) == [every.colors[k] for k in numbers]
        rows = json.loads(vvgt("info", path, "--channel", asked, "--json").out)["choices"]
        assert [(row["choice"], row["name"]) for row in rows] == [(f"--channel {k}", names[k]) for k in numbers]


def test_several_channels_in_python_and_of_a_layer(tmp_path: Path) -> None:
    write_ome(tmp_path / "a.ome.tif")
    goal = {"max_gaussians": 50, "screen": 32, "steps": 0}
    made = [library.convert(tmp_path / "a.ome.tif", **goal, component=how) for how in (["cyan", 0], "1,red")]
    np.testing.assert_array_equal(made[0].gaussians.means, made[1].gaussians.means)
    assert library.read_volume(tmp_path / "a.ome.tif", component=["cyan"]).data.max() == 3000
    source = load(replace(parse_layer(f"{tmp_path / 'a.ome.tif'},channel=cyan,0")))
    assert [layer.tf.name for layer in source.layers] == ["channel 1 cyan", "channel 0 red"]


@pytest.mark.parametrize("asked", ["DAPI,XY", "0,3", "XY,DAPI", "DAPI,", "all,XY"])
def test_channels_that_are_not_there(tmp_path: Path, asked: str) -> None:
    path, shape = str(tmp_path / "a.ome.tif"), (6, 3, 8, 10)
    for names, said in (
        (["DAPI", "GFP", "RFP"], "no channel '.*'; it has 0 'DAPI', 1 'GFP', 2 'RFP'$"),
        (["A,B"], "1 channel .*0 'A,B'"),
    ):
        meta = {"axes": "ZCYX", "Channel": {"Name": names}}
        tifffile.imwrite(path, np.zeros(shape, np.uint16)[:, : len(names)], ome=True, metadata=meta)
        refused(UsageError, said, open_content, path, ReadOptions(component=asked))
    assert open_content(path, ReadOptions(component="A,B")).single_volume


# ---- layers


def test_extinctions_add_and_colours_mix_by_extinction() -> None:
    volume = cloud()
    one, other = Layer(volume, ramp(0, 1, (1, 0, 0)), 1.0), Layer(volume, ramp(0.5, 2, (0, 0, 1)), 2.0)
    assert common_grid([one, other]) is volume
    both = grid_of([one, other], volume)
    np.testing.assert_allclose(both, grid_of([one], volume) + grid_of([other], volume), rtol=1e-6)
    np.testing.assert_allclose(both[..., 0] + both[..., 2], both[..., 3], rtol=1e-5)


def test_a_layer_is_placed_by_its_affine() -> None:
    """A linear field is the same wherever its samples are: turned, coarser and shifted."""
    first = cloud((12, 12, 12), spacing=(1.0, 1.0, 1.0))

    def field(spacing, origin, direction, shape) -> Volume:
        empty = Volume(np.zeros(shape, np.float32), spacing, origin, direction)
        k, j, i = np.mgrid[: shape[0], : shape[1], : shape[2]]
        x, y, z, _ = np.tensordot(empty.affine, np.stack([i, j, k, np.ones_like(i)]).astype(float), 1)
        return replace(empty, data=(x + 2 * y + 3 * z).astype(np.float32))

    exact = field((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), Volume.direction, (12, 12, 12))
    turned = field((2.0, 1.5, 2.0), (13.0, -1.0, -2.0), TURNED, (9, 12, 12))
    function = ramp(0, 100)
    layers = [Layer(first, ramp(2, 3), 1.0), Layer(turned, function, 1.0)]
    target = common_grid(layers)
    assert target is first
    np.testing.assert_allclose(grid_of(layers, target), grid_of([Layer(exact, function, 1.0)], exact), atol=1e-5)


def band(middle: float, width: float, rgb: tuple[float, float, float], opacity: float = 0.9) -> TransferFunction:
    x = middle + width * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    heights = PiecewiseOpacity(x, np.array([0.0, 0.0, opacity, 0.0, 0.0]))
    return TransferFunction("band", heights, ColorMap(x[[0, 4]], np.array([rgb, rgb])))


@pytest.mark.parametrize("light", ["none", "headlight"])
@pytest.mark.parametrize("other", ["scalars", "labels"])
def test_rays_classify_scalars_between_voxels(other: str, light: str) -> None:
    """Shells thinner than the values' steps between voxels, which a grid of classified voxels shows as rings."""
    z, y, x = np.mgrid[:20, :20, :20]
    r = np.sqrt((x - 9.3) ** 2 + (y - 9.8) ** 2 + (z - 10.1) ** 2)
    ball = Volume((100 - 8 * r).astype(np.float32), (1.0, 1.2, 0.9))
    corner = Volume(((x > 11) & (y > 11) & (r < 8)).astype(np.uint8) * 2, (1.0, 1.2, 0.9))
    beside = {"scalars": SourceRequest(ball, band(40, 4, (0.2, 0.5, 1.0), 0.3)), "labels": SourceRequest(corner)}
    opacity = 0.9 if other == "scalars" else 0.5
    request = SourceRequest(ball, band(60, 3, (1.0, 0.5, 0.2), opacity), layers=(beside[other],))
    scene = load(replace(request, light=LightOptions((light,)))).scene()
    camera = default_views("train", size=48)[3]
    shown = render_view(scene, camera, RenderSettings(samples=1))
    twin = render_view_reference(scene, camera, step=0.03)
    assert twin[..., 3].mean() > 0.3
    assert psnr(shown, twin) > 50  # 32 to 34 of a grid of classified voxels


def test_opaque_steps_of_layers_are_where_the_function_has_them() -> None:
    """Bins of tables are narrow beside a function's nodes, and surfaces that rays graze between samples are found."""
    z, y, x = np.mgrid[:16, :16, :16]
    hills = Volume((1000 + 40 * np.sin(0.9 * x) * np.cos(0.8 * y) * np.sin(0.7 * z + 1)).astype(np.float32))
    x = np.array([0.0, 1004.0, 1004.1, 4000.0])
    colors = np.array([(1.0, 0.2, 0.2), (1.0, 0.2, 0.2), (0.2, 1.0, 0.2), (0.2, 1.0, 0.2)])
    step = TransferFunction("step", PiecewiseOpacity(x, np.array([0.0, 0.0, 1.0, 1.0])), ColorMap(x, colors))
    scene = load(SourceRequest(hills, band(970, 5, (0.2, 0.2, 1.0)), layers=(SourceRequest(hills, step),))).scene()
    camera = default_views("train", size=64)[3]
    shown, twin = render_view(scene, camera, RenderSettings(samples=1)), render_view_reference(scene, camera, 0.03)
    assert psnr(shown, twin) > 52  # 50 with bins nine times as wide and steps that are looked for between ends alone


@pytest.mark.parametrize("slices", [1, 2, 4])
def test_thin_layers_on_another_grid_are_as_thick_as_their_boxes(slices: int) -> None:
    first = cloud((16, 16, 16))
    plate = Volume(np.full((slices, 12, 12), 5.0, np.float32), origin=(2.2, 1.7, 6.3))
    request = SourceRequest(first, band(9, 1, (1, 1, 1)), layers=(SourceRequest(plate, ramp(0, 10)),))
    scene = load(request).scene()
    views = default_views("train", size=40)
    ours, twin = (
        np.mean([render(scene, views[k])[..., 3].mean() for k in range(8)])
        for render in (render_view, render_view_reference)
    )
    assert abs(ours / twin - 1) < 0.3 / slices


def test_more_layers_of_scalars_than_rays_classify() -> None:
    volume = cloud((9, 10, 11))
    layers = tuple(SourceRequest(cloud((9, 10, 11)), ramp(0.1 * k, 1.5)) for k in range(9))
    scene = load(SourceRequest(volume, ramp(0, 2), layers=layers)).scene()
    view = default_views("train", size=40)[1]
    assert psnr(render_view(scene, view, RenderSettings(samples=1)), render_view_reference(scene, view)) > 45


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38])
def test_layers_with_values_that_are_none_or_huge_stay_finite(value: float) -> None:
    first = cloud((9, 9, 9))
    first.data[4, 4, 4] = value
    request = SourceRequest(first, ramp(0.2, 0.9), layers=(SourceRequest(cloud((9, 9, 9)), ramp(0.5, 0.6)),))
    for light in ("none", "headlight"):
        scene = load(replace(request, light=LightOptions((light,)))).scene()
        assert np.isfinite(render_view(scene, default_views("train", size=40)[0])).all()


def test_the_grid_is_as_fine_as_the_finest_layer() -> None:
    first = cloud((4, 5, 6), spacing=(2.0, 2.0, 4.0), origin=(1.0, 2.0, 3.0))
    fine = cloud((16, 20, 12), spacing=(1.0, 0.5, 1.0), origin=(1.0, 2.0, 3.0))
    target = common_grid([Layer(first, ramp(0, 1), 1.0), Layer(fine, ramp(0, 1), 1.0)])
    assert target.dims == (12, 20, 16)
    np.testing.assert_allclose(target.extent, first.extent)
    np.testing.assert_allclose(target.unit_frame().centre, first.unit_frame().centre)
    assert target.on_grid(replace(target, origin=tuple(v + 1e-5 for v in target.origin)))
    assert not target.on_grid(replace(target, origin=tuple(v + 0.1 for v in target.origin)))


def test_labels_are_not_interpolated_on_a_finer_grid() -> None:
    labels = Volume(balls(12), spacing=(2.0, 2.0, 2.0), origin=(0.5, 0.5, 0.5))
    fine = Volume(np.zeros((24, 24, 24), np.uint8))
    table = distinct([0, 1, 2, 3])
    table = replace(
        table,
        labels=tuple(replace(e, color=(1.0, 0.0, 0.0) if e.number != 2 else (0.0, 1.0, 0.0)) for e in table.labels),
    )
    grid = grid_of([Layer(fine, ramp(5, 6), 1.0), Layer(labels, table, 1.0)], fine)
    assert grid[..., 0].max() > 1
    assert grid[..., 1].max() == 0  # of label 2, which no voxel has


def test_layers_that_do_not_meet_or_fit_are_refused(vvgt, tmp_path: Path) -> None:
    first, far = cloud(), cloud(origin=(100.0, 0.0, 0.0))
    with pytest.raises(DataError, match="lies beside cloud in the world"):
        common_grid([Layer(first, ramp(0, 1), 1.0), Layer(far, ramp(0, 1), 1.0)])
    tiny = cloud((4, 4, 4), spacing=(0.05, 0.05, 0.05))
    refused(DataError, "20 times finer", common_grid, [Layer(first, ramp(0, 1), 1.0), Layer(tiny, ramp(0, 1), 1.0)])
    for text in ("", "a.nii,hue=3", "a.nii,time=x", "a.nii,tf="):
        refused(UsageError, "--layer", parse_layer, text)
    asked = SourceRequest("a,b.nii", tf="hot:0.2,0.8", labels="none")
    assert parse_layer("a,b.nii,tf=hot:0.2,0.8,labels=none") == asked
    gone = vvgt("init", "example:blob:8", "--layer", tmp_path / "no.nii", "-o", tmp_path / "a.ply")
    assert "no such file" in gone.error
    nibabel.save(nibabel.Nifti1Image(np.zeros((8, 8, 8, 3), np.float32), np.eye(4)), tmp_path / "four.nii")
    for out in ("a.ply", "a.html", "a_{}.ply"):
        steps = vvgt("convert", "example:blob:8", "--layer", tmp_path / "four.nii", "-o", tmp_path / out)
        assert (steps.code, "3 time steps; expected one per layer: --layer FILE,time=N (0 to 2)" in steps.error) == (
            2, True,
        ), steps.error  # fmt: skip


def test_a_scan_with_its_segmentation(vvgt, tmp_path: Path) -> None:
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    scan = np.zeros((16, 16, 16), np.float32)
    scan[2:14, 2:14, 2:14] = 1
    nibabel.save(nibabel.Nifti1Image(scan, affine), tmp_path / "ct.nii.gz")
    half = np.array([[1.0, 0, 0, -0.5], [0, 1, 0, -0.5], [0, 0, 1, -0.5], [0, 0, 0, 1]])
    seg = np.zeros((32, 32, 32), np.uint8)
    seg[12:20, 12:20, 12:20] = 5
    nibabel.save(nibabel.Nifti1Image(seg, half), tmp_path / "organ_seg.nii.gz")
    (tmp_path / "t.json").write_text('{"5": {"name": "organ", "color": [1, 0, 0]}}')
    layer = f"{tmp_path / 'organ_seg.nii.gz'},labels={tmp_path / 't.json'}"
    asked = ("--tf", "gray:0.5,1:0.05", "--layer", layer)
    out, report = tmp_path / "a.ply", tmp_path / "a.json"
    done = vvgt.ok("convert", tmp_path / "ct.nii.gz", *asked, *SMALL, "-o", out, "--report", report)
    assert "32 x 32 x 32" in done.err
    made, _ = read_ply(str(out))
    red = made.colors[:, 0] - made.colors[:, 1] > 0.5
    assert red.sum() > 5
    assert np.abs(made.means[red]).max() < 0.35 < np.abs(made.means[~red]).max()
    assert len(json.loads(report.read_text())["transfer_function"]["layers"]) == 2
    how = "--no-conditions --step 0.5 --json -q"
    own = vvgt("evaluate", out, "--volume", tmp_path / "ct.nii.gz", *asked, how)
    assert json.loads(own.out)["scores"]["psnr"] == pytest.approx(
        json.loads(report.read_text())["scores"]["psnr"], abs=1
    )
    kept = ("--checkpoint", tmp_path / "kept", "--overwrite")
    vvgt.ok("convert", tmp_path / "ct.nii.gz", *asked, *SMALL, *kept, "-o", tmp_path / "b.ply")
    assert out.read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_in_python(tmp_path: Path) -> None:
    few = {"max_gaussians": 100, "screen": 32, "steps": 0}
    part = library.convert(cloud().data, **few, crop="2:8,:,:", mask=np.ones((10, 12, 14)))
    assert part.gaussians.means.shape[1] == 3
    np.save(tmp_path / "m.npy", np.arange(10 * 12 * 14).reshape(10, 12, 14) % 2)
    masked = [library.read_volume(cloud().data, mask=m).data for m in (np.load(tmp_path / "m.npy"), tmp_path / "m.npy")]
    np.testing.assert_array_equal(*masked)
    request = SourceRequest(Volume(balls(12)), labels="auto")
    both = library.convert(Volume(balls(12).astype(np.float32)), library.Look("gray", layers=[request]), **few)
    assert np.ptp(both.gaussians.colors) > 0.1


def test_the_python_of_the_page_runs() -> None:
    page = Path(__file__).parent.parent / "docs" / "layers.md"
    code = page.read_text("utf-8").partition("```python\n")[2].partition("```")[0]
    names: dict = {}
    exec(compile(code, "docs/layers.md", "exec"), names)
    assert len(names["result"].gaussians) > 100


def test_several_functions_over_colours_channels_and_layers(vvgt, tmp_path: Path) -> None:
    """`--tf` twice: a file each, with the layer in both."""
    write_nrrd(tmp_path / "a.nrrd", colors())
    write_ome(tmp_path / "a.ome.tif")
    np.save(tmp_path / "scan.npy", balls(12).astype(np.float32))
    layer = ("--layer", f"{tmp_path / 'scan.npy'},tf=hot:0.2,1:0.5")
    for volume, options in (("a.nrrd", ()), ("a.ome.tif", ("--channel", "all")), ("scan.npy", layer)):
        functions = ("--tf", "gray:0.2,0.8:0.3", "--tf", "viridis:0.1,0.5:0.9", "--overwrite")
        vvgt.ok("convert", tmp_path / volume, *options, *functions, *SMALL, "-o", tmp_path / "o_{}.ply")
        made = [read_ply(str(path)) for path in sorted(tmp_path.glob("o_*.ply"))]
        assert len(made) == 2
        assert not np.array_equal(made[0][0].opacity_logits, made[1][0].opacity_logits)
