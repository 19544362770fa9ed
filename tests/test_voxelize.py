"""Gaussians back on a grid of voxels: kernels, places, formats, and the error that files state."""

from dataclasses import replace
from pathlib import Path

import nibabel
import numpy as np
import pytest
import pyvista
import SimpleITK

import vvgt_cli as vvgt
from tests.refused import refused
from vvgt_cli.closed_form.gaussian_samples import NARROW, offsets
from vvgt_cli.closed_form.values_back import Bells, LiveValues, sample
from vvgt_cli.conversion.place import to_unit_frame, with_place
from vvgt_cli.conversion.result import Result
from vvgt_cli.conversion.voxelize import values_error
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply, write_ply
from vvgt_cli.gaussians.frames import rotations
from vvgt_cli.gaussians.live_facts import LiveFacts
from vvgt_cli.look.labels import Label
from vvgt_cli.score.record import ConversionReport
from vvgt_cli.volume import Volume, read_volume, writers

DIMS = (12, 10, 8)  # x, y, z
TILTED = tuple(rotations(np.array([[0.9, 0.2, -0.3, 0.1]]))[0].ravel())
MIRRORED = (0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # i along -y, j along -x
SLOPE = np.array([2.0, 5.0, -3.0])  # per voxel
NEAR = 0.15  # of a range of 88: at the box's faces samples are those of its outer voxels


def grid(direction=TILTED, space: str | None = "RAS") -> Volume:
    place = {"spacing": (0.8, 1.1, 2.0), "origin": (4.0, -7.0, 30.0), "direction": direction, "space": space}
    return Volume(np.zeros(DIMS[::-1], np.float32), **place, unit="" if space else "um")


def facts(lo: float, hi: float, **more) -> LiveFacts:
    return LiveFacts(lo, hi, DIMS, (900, *[1] * 255), **more)


def linear(volume: Volume, slope: np.ndarray = SLOPE, step: int = 2) -> Result:
    """A Gaussian per ``step`` voxels along each axis, which carry the samples of 40 + slope . (i, j, k)."""
    at = np.stack(np.meshgrid(*(np.arange((step - 1) / 2, n, step) for n in DIMS), indexing="ij"), -1).reshape(-1, 3)
    frame, count = volume.unit_frame(), len(at)
    sizes = step / np.sqrt(12) * np.array(frame.step)
    bells, sums = Bells(at, np.tile(np.eye(3) * step / np.sqrt(12), (count, 1, 1))), np.zeros((count, 8))
    sample(bells.centres, bells.arms, offsets(), wanted(slope).astype(np.float32), 0, DIMS[2], DIMS[2], sums)
    mean = sums[:, 1] / sums[:, 0]
    rise = (sums[:, 2:5] - mean[:, None] * sums[:, 5:]) / (NARROW**2 * sums[:, :1])  # a deviation along x, y and z
    live = np.zeros((count, 9))
    live[:, 0], live[:, 1] = mean, NARROW * np.linalg.norm(rise, axis=1)
    gradient = rise / sizes
    live[:, 2], live[:, 6:] = 0.1, gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-30)
    means = (at + 0.5) * frame.step - frame.half
    box = Gaussians(means, np.log(np.tile(sizes, (count, 1))), np.tile([1.0, 0, 0, 0], (count, 1)), np.zeros(count),
                    np.full((count, 3), 0.25), live=live)  # fmt: skip
    span = 40 + np.array(np.meshgrid(*([0, n - 1] for n in DIMS), indexing="ij")).reshape(3, -1).T @ slope
    ply = with_place(
        PlyOptions(
            live=facts(
                float(span.min()), float(max(span.max(), span.min() + 1)), function='{"points": []}', quantity="depth"
            )
        ),
        volume,
    )
    return Result(to_unit_frame(box, volume), ConversionReport("convert"), ply)


def wanted(slope: np.ndarray = SLOPE) -> np.ndarray:
    k, j, i = np.meshgrid(*(np.arange(n) for n in DIMS[::-1]), indexing="ij")
    return 40 + i * slope[0] + j * slope[1] + k * slope[2]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    linear(grid()).save(tmp_path / "live.ply")
    return tmp_path / "live.ply"


def some(count: int = 30) -> Bells:
    rng = np.random.default_rng(3)
    arms = rotations(rng.normal(size=(count, 4))) * rng.uniform(0.1, 1.5, (count, 1, 3))
    return Bells(rng.uniform(-1, 9, (count, 3)), arms)


@pytest.mark.parametrize("greatest", [False, True])
def test_sums_of_bells_are_their_float64_twins(greatest: bool) -> None:
    rng, bells, dims, reach, soft = np.random.default_rng(4), some(), (9, 8, 7), 2.5, 0.2
    fields, slopes = rng.uniform(1, 2, (30, 2)), rng.normal(size=(30, 3))
    found = bells.sums(fields, slopes, dims, range(2, 7), soft, reach, greatest)
    at = (
        np.stack(np.meshgrid(*(np.arange(n) for n in dims), indexing="ij"), -1)[None]
        - bells.centres[:, None, None, None]
    )
    inverse = np.linalg.inv(bells.arms @ bells.arms.transpose(0, 2, 1) + soft**2 * np.eye(3))
    p = np.einsum("kxyzi,kij,kxyzj->kxyz", at, inverse, at)
    bell = np.where(p <= reach**2, np.exp(-p / 2), 0)
    first = fields[:, 0, None, None, None] + np.einsum("kxyzi,ki->kxyz", at, slopes)
    twin = np.stack([(bell * first).sum(0), (bell * fields[:, 1, None, None, None]).sum(0)], -1)
    if greatest:
        best = bell.max(0)
        twin = np.stack([best, np.where(best > 0, fields[bell.argmax(0), 1], 0)], -1)
    np.testing.assert_allclose(found, twin.transpose(2, 1, 0, 3)[2:7], rtol=2e-5, atol=1e-5)


def test_samples_are_trilinear() -> None:
    bells, points, values = some(), offsets(), np.random.default_rng(5).normal(size=(7, 8, 9)).astype(np.float32)
    out = np.zeros((30, 8))
    for planes in (range(3), range(3, 7)):
        part = values[planes.start : planes.stop + 1]
        sample(bells.centres, bells.arms, points, part, planes.start, planes.stop, 7, out)
    twin = np.zeros((30, 8))
    for k in range(30):
        for point in points:
            x, y, z = at = bells.centres[k] + bells.arms[k] @ point
            if (at < -0.5).any() or x >= 8.5 or y >= 7.5 or z >= 6.5:
                continue
            low, value = np.floor(np.clip(at, 0, [8, 7, 6])).astype(int), 0.0
            t = np.clip(at, 0, [8, 7, 6]) - low
            for corner in np.ndindex(2, 2, 2):
                i, j, n = np.minimum(low + corner, [8, 7, 6])
                value += values[n, j, i] * np.prod(np.where(corner, t, 1 - t))
            twin[k] += [1, value, *(value * point), *point]
    np.testing.assert_allclose(out, twin, rtol=1e-5, atol=1e-5)
    assert twin[:, 0].sum() > 500


def test_a_constant_is_exact_where_gaussians_are() -> None:
    result = linear(grid(), np.zeros(3))
    alone = replace(result, gaussians=result.gaussians.take(np.arange(20)))
    values = alone.voxelize().data
    np.testing.assert_allclose(values, 40, rtol=3e-7)  # sums are float32
    bells = Bells.of(alone.gaussians, np.linalg.inv(np.eye(4)))
    values = LiveValues.of(alone.gaussians, bells, 7.0).on(Bells(bells.centres * 6 + 6, bells.arms * 6), DIMS, range(8))
    there = values != 7
    np.testing.assert_allclose(values[there], 40, rtol=3e-7)
    assert 0.02 < there.mean() < 0.9


@pytest.mark.parametrize("direction", [TILTED, MIRRORED, (1, 0, 0, 0, 1, 0, 0, 0, 1)])
def test_a_linear_field_comes_back_in_its_place(direction) -> None:
    volume = grid(direction)
    found = linear(volume).voxelize()
    np.testing.assert_allclose(found.affine, volume.affine, atol=1e-9)
    assert (found.space, found.quantity) == ("RAS", "depth")
    np.testing.assert_allclose(found.data, wanted(), atol=NEAR)
    finer = linear(volume).voxelize(dims=(24, 10, 8))
    assert finer.spacing == pytest.approx((0.4, 1.1, 2.0))
    np.testing.assert_allclose(
        finer.data[:, :, 1:-1], (wanted()[:, :, [0]] - 0.5 + np.arange(24))[:, :, 1:-1], atol=NEAR
    )


def test_another_grid_is_in_the_same_box_or_that_of_a_volume(file: Path) -> None:
    coarse = vvgt.voxelize(file, spacing=(1.6, 2.2, 4.0))
    assert coarse.dims == (6, 5, 4)
    ends = [[one.affine @ (*at, 1) for at in ((-0.5,) * 3, np.array(one.dims) - 0.5)] for one in (coarse, grid())]
    np.testing.assert_allclose(*ends, atol=1e-9)
    other = replace(grid(MIRRORED), origin=(3.0, -5.0, 31.0))
    like = vvgt.voxelize(file, like=other)
    k, j, i = np.meshgrid(*(np.arange(n) for n in DIMS[::-1]), indexing="ij")
    index = np.stack([i, j, k, np.ones_like(i)], -1) @ (np.linalg.inv(grid().affine) @ other.affine).T
    inside = ((index[..., :3] > 0) & (index[..., :3] < np.array(DIMS) - 1)).all(-1)
    assert inside.sum() > 20
    np.testing.assert_allclose(like.data[inside], 40 + index[inside][:, :3] @ SLOPE, atol=NEAR)


def test_slabs_change_nothing(monkeypatch) -> None:
    whole = linear(grid()).voxelize().data
    monkeypatch.setattr(writers, "AT_ONCE", 3 * 16 * 120)
    assert len(list(writers.slabs(DIMS))) == 3
    np.testing.assert_array_equal(linear(grid()).voxelize().data, whole)


def test_passes_bring_values_nearer_to_what_they_were_sampled_from() -> None:
    slope = np.array([3.0, 0, 0])
    bells = Bells(np.random.default_rng(7).uniform(0, 7, (60, 3)), np.tile(np.eye(3), (60, 1, 1)))
    values = LiveValues(bells, bells.centres @ slope + np.sin(bells.centres[:, 1]), np.tile(slope, (60, 1)), 0.0)
    errors = []
    for passes in (0, 1, 4):
        found, sums = values.refined((8, 8, 8), passes).on(bells, (8, 8, 8), range(8)), np.zeros((60, 8))
        sample(bells.centres, bells.arms, offsets(), found, 0, 8, 8, sums)
        errors.append(np.abs(sums[:, 1] / sums[:, 0] - values.means).mean())
    assert errors[2] < 0.8 * errors[1] < 0.7 * errors[0]


@pytest.mark.parametrize("suffix", writers.SUFFIXES)
@pytest.mark.parametrize("space", ["RAS", "LPS", None])
def test_every_format_comes_back_in_its_place(suffix: str, space: str | None, tmp_path: Path) -> None:
    along = (1, 0, 0, 0, 1, 0, 0, 0, 1) if suffix == ".zarr" else TILTED
    volume = grid(along, space)
    result, path = linear(volume), tmp_path / f"back{suffix}"
    result.save(tmp_path / "a.ply")
    assert vvgt.voxelize(tmp_path / "a.ply", path) is None
    source = f"{path}/0" if suffix == ".zarr" else str(path)
    back = read_volume(source, vvgt_options(space if suffix in (".nii", ".nii.gz", ".nrrd", ".mha") else None))
    np.testing.assert_allclose(back.slope * np.asarray(back.data) + back.intercept, wanted(), atol=NEAR)
    mm = 1000 if space is None and suffix.startswith(".nii") else 1  # NIfTI's world is anatomical, its units are read
    if suffix != ".npy":  # which has no place
        np.testing.assert_allclose(back.affine[:3] * mm, volume.affine[:3], atol=1e-4)
    if suffix in (".nrrd", ".mha"):
        assert (back.space, back.unit) == (space, "" if space else "um")
    refused(vvgt.UsageError, "folder" if suffix == ".zarr" else "exists", vvgt.voxelize, tmp_path / "a.ply", path)
    assert not list(tmp_path.glob(".*"))


def vvgt_options(space: str | None):
    from vvgt_cli.volume import ReadOptions

    return ReadOptions(space=space)


def test_other_readers_find_values_and_places(file: Path, tmp_path: Path) -> None:
    at, affine = (5, 2, 3), grid().affine
    for suffix in (".nii.gz", ".mha", ".nrrd", ".vti"):
        vvgt.voxelize(file, tmp_path / f"a{suffix}")
    image = nibabel.load(tmp_path / "a.nii.gz")
    np.testing.assert_allclose(image.affine, affine, atol=1e-5)
    value = wanted()[at[::-1]]
    assert np.asarray(image.dataobj)[at] == pytest.approx(value, abs=NEAR)
    place = (affine @ (*at, 1))[:3]
    for suffix in (".mha", ".nrrd"):
        image = SimpleITK.ReadImage(str(tmp_path / f"a{suffix}"))
        np.testing.assert_allclose(image.TransformIndexToPhysicalPoint(at), place * (-1, -1, 1), atol=1e-4)
        assert image[at] == pytest.approx(value, abs=NEAR)
    image = pyvista.read(tmp_path / "a.vti")
    number = at[0] + DIMS[0] * (at[1] + DIMS[1] * at[2])
    np.testing.assert_allclose(image.GetPoint(number), place, atol=1e-4)
    assert image["values"][number] == pytest.approx(value, abs=NEAR)


def test_labels_are_those_of_the_nearest_body(tmp_path: Path) -> None:
    result = linear(grid())
    half = (wanted(np.array([1.0, 0, 0])) - 40 >= 6).astype(int)
    rows = (result.gaussians.live[:, 0] > -1).astype(float)
    centres = np.stack(np.meshgrid(*(np.arange(0.5, n, 2) for n in DIMS), indexing="ij"), -1).reshape(-1, 3)
    rows = (centres[:, 0] > 6).astype(float)
    live = np.column_stack([result.gaussians.live, rows])
    labels = (Label(7, "left", (1, 0, 0), 1.0), Label(300, "right", (0, 1, 0), 1.0))
    ply = replace(result.ply, live=LiveFacts(7, 300, DIMS, labels=labels))
    both = Result(replace(result.gaussians, live=live), result.report, ply)
    found = both.voxelize().data
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, np.where(half, 300, 7))
    apart = replace(both, gaussians=both.gaussians.take(np.flatnonzero(rows)))
    assert set(np.unique(apart.voxelize().data)) == {0, 300}


def test_a_layer_is_chosen_by_number_or_name(tmp_path: Path) -> None:
    one, two = linear(grid()), linear(grid(), -SLOPE)
    live = [np.column_stack([r.gaussians.live, np.zeros(len(r.gaussians)), np.full(len(r.gaussians), k)])
            for k, r in enumerate((one, two))]  # fmt: skip
    arrays = {name: np.concatenate([array] * 2) for name, array in one.gaussians.arrays().items()}
    first, second = replace(one.ply.live, name="dapi"), replace(two.ply.live, name="gfp")
    ply = replace(one.ply, live=replace(first, others=(second,)))
    both = Result(Gaussians(**arrays | {"live": np.concatenate(live)}), one.report, ply)
    np.testing.assert_allclose(both.voxelize(layer="gfp").data, wanted(-SLOPE), atol=NEAR)
    np.testing.assert_allclose(both.voxelize(layer=0).data, wanted(), atol=NEAR)
    refused(vvgt.UsageError, r"has 2 layers; expected --layer, one of 0 \(dapi\), 1 \(gfp\)", both.voxelize)


@pytest.mark.parametrize("suffix", [".nii.gz", ".nrrd", ".mha", ".vti", ".npy", ".vdb"])
def test_density_keeps_the_optical_mass_and_colours(suffix: str, tmp_path: Path) -> None:
    """Of one small Gaussian, thin enough that its mass is its depth, and one with harmonics and a colour below 0."""
    scales, colors = np.log([[0.05, 0.08, 0.1], [0.06] * 3]), [[0.2, 0.5, 0.9], [-0.2, 0.5, 0.5]]
    turns = [[1, 0.2, 0, 0], [1, 0, 0, 0]]
    blob = Gaussians([[0.1, 0, 0], [-0.4, 0.1, 0]], scales, turns, [-5.0] * 2, colors, harmonics=np.ones((2, 3, 3)))
    write_ply(tmp_path / "a.ply", blob, PlyOptions(comments=False))
    path = tmp_path / f"a{suffix}"
    vvgt.voxelize(tmp_path / "a.ply", path, density=True, dims=(40, 30, 30))
    dense = vvgt.voxelize(tmp_path / "a.ply", density=True, dims=(40, 30, 30))
    mass = dense.data.sum() * np.prod(dense.spacing)
    thin = 1 / (1 + np.exp(5))
    area = 2 * np.pi * np.array([0.05 * 0.08 + 0.08 * 0.1 + 0.05 * 0.1, 3 * 0.06**2]).sum() / 3
    assert mass == pytest.approx(thin * area, rel=0.02)
    at = np.unravel_index(dense.data[:, :, 20:].argmax(), dense.data[:, :, 20:].shape)
    if suffix == ".npy":
        color = np.load(path)[at[0], at[1], at[2] + 20, 1:]
    elif suffix == ".vdb":
        color = [read_volume(f"{path}", replace(vvgt_options(None), array="color", component=c)) for c in range(3)]
        color = np.array([np.asarray(v.data).max() for v in color])
        assert color[0] == pytest.approx(0.2, abs=1e-3)
        color[2] = 0.9 if color[2] == pytest.approx(0.9, abs=1e-3) else 0
        color[1] = 0.5
    else:
        parts = [read_volume(str(path), replace(vvgt_options(None), component=c)) for c in range(4)]
        np.testing.assert_allclose(parts[0].data, dense.data, rtol=1e-5)
        np.testing.assert_allclose(parts[0].affine, dense.affine, atol=1e-5)
        color = np.array([np.asarray(v.data)[at[0], at[1], at[2] + 20] for v in parts[1:]])
    np.testing.assert_allclose(color, [0.2, 0.5, 0.9], atol=1e-3)


@pytest.fixture(scope="module")
def converted(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("live")
    z, y, x = np.mgrid[:14, :18, :22]
    values = 100 * np.exp(-((x - 9) ** 2 + (y - 8) ** 2 + (z - 6) ** 2) / 40).astype(np.float32)
    np.save(folder / "v.npy", values)
    vvgt.convert(folder / "v.npy", "viridis", folder / "live.ply", live=True, max_gaussians=400, screen=256)
    return folder


def test_a_certificate_states_the_error_of_values(converted: Path) -> None:
    gaussians, header = read_ply(converted / "live.ply")
    made = header.certificate
    volume = read_volume(str(converted / "v.npy"))
    back = vvgt.voxelize(converted / "live.ply")
    wrong = np.asarray(volume.data, np.float64) - back.data
    span = header.live.hi - header.live.lo
    assert made.values_psnr == pytest.approx(20 * np.log10(span / np.sqrt((wrong**2).mean())), abs=0.01)
    assert made.values_error == pytest.approx(np.abs(wrong).max(), rel=1e-3)
    assert made.values_psnr > 26
    assert vvgt.info(converted / "live.ply")["certificate"]["values_psnr"] == made.values_psnr
    found = vvgt.evaluate(converted / "live.ply", converted / "v.npy", "viridis", conditions=False, step=1).certificate
    assert (found["values_psnr"], found["values_recorded"]) == (made.values_psnr, made.values_psnr)
    assert f"values {made.values_psnr:.2f} dB ({made.values_psnr:.2f})" in found["text"]
    assert values_error(replace(header, live=None), gaussians, volume) is None


def test_evaluate_finds_values_that_were_changed(converted: Path, tmp_path: Path) -> None:
    gaussians, header = read_ply(converted / "live.ply")
    live = gaussians.live.copy()
    live[:, 0] *= 0.8
    options = PlyOptions(**header.facts())
    write_ply(tmp_path / "a.ply", replace(gaussians, live=live), options)
    found = vvgt.evaluate(tmp_path / "a.ply", converted / "v.npy", "viridis", conditions=False, step=1).certificate
    assert not found["holds"]
    assert "values " in found["text"]


def test_the_command_is_the_function(vvgt, file: Path, tmp_path: Path) -> None:
    out = vvgt.ok("voxelize", file, "-o", tmp_path / "a.nrrd", "--dims", 6, 5, 4)
    assert "6 x 5 x 4 voxels" in out.err
    assert not out.out
    import vvgt_cli

    np.testing.assert_array_equal(
        read_volume(str(tmp_path / "a.nrrd")).data, vvgt_cli.voxelize(file, dims=(6, 5, 4)).data
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"output": "a.tif"}, "expected a name ending in .nii.gz"),
        ({"layer": "9"}, "no layers of that name"),
        ({"layer": 0, "density": True}, "--layer selects values"),
        ({"spacing": (0, 1, 1)}, "expected three positive numbers"),
        ({"spacing": (1e-9, 1e-9, 1e-9)}, "expected a spacing that fits"),
        ({"dims": (10**5, 10**5, 10**5)}, "one plane of 100000 x 100000 x 100000 voxels: needs "),
        ({"dims": (9000, 9000, 9000)}, "9000 x 9000 x 9000 voxels: needs "),
        ({"dims": (9000, 9000, 90000), "output": "a.nrrd"}, "No space left on device: needs "),
        ({"dims": (4, 4, 4), "like": "example:blob:8"}, "--like gives the whole grid"),
        ({"like": "nothing.nrrd"}, "nothing.nrrd"),
    ],
)
def test_what_cannot_be_done_is_one_line(options, words: str, file: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    refused(vvgt.VvgtError, words, vvgt.voxelize, file, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["live.ply"]


def test_files_without_values_are_one_line(file: Path, tmp_path: Path) -> None:
    gaussians, _ = read_ply(file)
    write_ply(tmp_path / "plain.ply", replace(gaussians, live=None), PlyOptions(comments=False))
    refused(vvgt.DataError, "carry no values; expected a .ply of", vvgt.voxelize, tmp_path / "plain.ply")
    refused(vvgt.UsageError, "states no grid; expected --dims", vvgt.voxelize, tmp_path / "plain.ply", density=True)
    content = bytearray((tmp_path / "plain.ply").read_bytes())
    content[-68:-64] = np.float32(np.nan).tobytes()  # x of the last row
    (tmp_path / "nan.ply").write_bytes(content)
    with pytest.warns(match="1 "):
        dense = vvgt.voxelize(tmp_path / "nan.ply", density=True, dims=(8, 8, 8))
    assert np.isfinite(dense.data).all()
    refused(vvgt.UsageError, "turned; choose", vvgt.voxelize, file, tmp_path / "a.zarr")
