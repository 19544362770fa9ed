"""The volume's values on its page: grids averaged and packed, in memory and in blocks, without what is cut off."""

import base64
import gzip
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians.formats.page_values import PageLayer, Values, packed, values_of
from vvgt_cli.look import read_transfer_function
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.labels import Label, LabelTable
from vvgt_cli.volume import Volume, averaged
from vvgt_cli.volume.stored import Stored

HOW = ("--max-gaussians", "60", "--screen", "32", "--steps", "0", "--overwrite")
SHOWN = TransferFunction(
    "ramp", PiecewiseOpacity(np.array([0.0, 1]), np.array([0.0, 0.5])), ColorMap(np.array([0.0]), np.ones((1, 3)))
)
TURNED = (0.8, -0.6, 0.0, -0.6, -0.8, 0.0, 0.0, 0.0, 1.0)  # oblique, and mirrored


def unpacked(content: bytes, facts: dict[str, Any]) -> np.ndarray:
    """Decode values (nz, ny, nx) float64, NaN where unknown, or numbers in the list of labels, -1 for none."""
    size = facts["bits"] // 8
    planes = np.frombuffer(gzip.decompress(content), np.uint8).reshape(size, -1)
    folded = np.ascontiguousarray(planes.T).view(f"<u{size}").reshape(facts["dims"][::-1])
    steps = (folded >> 1) ^ (0 - (folded & 1))
    codes = np.cumsum(steps, axis=2, dtype=folded.dtype).astype(np.int64)
    if "labels" in facts:
        return codes - 1
    codes -= facts["missing"]
    return np.where(codes < 0, np.nan, facts["lo"] + facts["step"] * codes)


def grids_of(volume: Volume, look: TransferFunction | LabelTable = SHOWN) -> Values:
    """The grid of a volume."""
    found = values_of([PageLayer(volume, look, 1.0)])
    assert found is not None
    return found


def grids_in(page: Path) -> list[tuple[dict[str, Any], np.ndarray]]:
    """Facts and decoded values of each grid that a page holds."""
    text = page.read_text("utf-8")
    scene = json.loads(re.search(r'id="scene">(.*?)</script>', text, re.S)[1])
    found = []
    for facts in scene.get("values", ()):
        content = re.search(rf'id="{facts["element"]}">([^<]+)</script>', text)[1]
        found.append((facts, unpacked(base64.b64decode(content), facts)))
    return found


def centres(facts: dict[str, Any]) -> np.ndarray:
    """World positions (nz, ny, nx, 3) of the middles of a grid's cells."""
    affine = np.reshape(facts["affine"], (3, 4))
    index = np.stack(np.meshgrid(*map(np.arange, facts["dims"]), indexing="ij"), -1).transpose(2, 1, 0, 3)
    return index @ affine[:, :3].T + affine[:, 3]


@pytest.mark.parametrize("dims", [(7, 9, 11), (3, 4, 5), (7, 3, 2)])
def test_cells_have_the_mean_of_their_parts_of_voxels(dims, monkeypatch):
    """Of a grid that divides the volume unevenly, read a few slices at a time."""
    data = np.random.default_rng(1).normal(size=(11, 9, 7))
    monkeypatch.setattr(averaged, "AT_ONCE", 2 * 9 * 7)
    found = averaged.averaged(Volume(data, slope=2.0, intercept=-3.0), dims)
    fine = data  # each voxel divided into as many parts as there are cells
    for axis, n in enumerate(dims[::-1]):
        fine = np.repeat(fine, n, axis)
    nx, ny, nz = dims
    wanted = fine.reshape(nz, 11, ny, 9, nx, 7).mean(axis=(1, 3, 5))
    np.testing.assert_allclose(found, 2 * wanted - 3, rtol=1e-12, atol=1e-12)


def test_chunks_of_a_file_are_read_once_each(monkeypatch):
    """Whether parts are smaller or larger than the chunks."""
    data, asked = np.random.default_rng(6).integers(0, 99, (11, 9, 14)).astype(np.int16), []

    def read(slices):
        asked.append(tuple((s.start, s.stop) for s in slices))
        return data[slices]

    lazy = Volume(Stored(read, data.dtype, data.shape, (4, 4, 5), "lazy"))
    wanted, labels = averaged.averaged(Volume(data), (5, 9, 3)), averaged.sampled(Volume(data), (5, 9, 3))
    np.testing.assert_array_equal(labels, data[[1, 5, 9]][:, :, [1, 4, 7, 9, 12]])
    for most, count in ((1, 3 * 3 * 3), (4 * 4 * 15, 3 * 3), (1 << 21, 1)):
        monkeypatch.setattr(averaged, "AT_ONCE", most)
        asked.clear()
        np.testing.assert_allclose(averaged.averaged(lazy, (5, 9, 3)), wanted, rtol=1e-12)
        assert len(asked) == len(set(asked)) == count
        assert all(a % edge == 0 for part in asked for (a, _), edge in zip(part, (4, 4, 5), strict=True))
        np.testing.assert_array_equal(averaged.sampled(lazy, (5, 9, 3)), labels)


def test_unknown_voxels_are_left_out_of_means(monkeypatch):
    monkeypatch.setattr(averaged, "AT_ONCE", 16)
    data = np.full((4, 4, 4), 5.0)
    data[:2, :2, :2], data[3, 3, 3], data[3, 3, 2] = np.nan, np.inf, 1.0
    found = averaged.averaged(Volume(data), (2, 2, 2))
    assert np.isnan(found[0, 0, 0])
    assert found[1, 1, 1] == pytest.approx((6 * 5 + 1) / 7)
    assert np.isfinite(found).sum() == 7


def test_cells_are_nearly_cubes_and_never_smaller_than_voxels():
    volume = Volume(np.zeros((10, 200, 200), np.uint8), spacing=(0.5, 0.5, 4.0))
    dims = averaged.coarser(volume, 20_000)
    assert np.prod(dims) <= 20_000
    assert dims[2] == 10  # 4 mm are larger than the cells
    assert dims[0] == dims[1] > 40
    assert averaged.coarser(volume, 400_000) == volume.dims


@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.uint16, np.float32])
@pytest.mark.parametrize("missing", [False, True])
def test_values_come_back_within_half_a_step_at_their_places(kind, missing, monkeypatch):
    """A field that is linear in the world, so that a cell's mean is its value in the middle."""
    monkeypatch.setattr("vvgt_cli.gaussians.formats.page_values.coarser", lambda volume, most: (11, 5, 18))
    volume = Volume(np.zeros((18, 20, 22)), (1.0, 1.3, 2.0), (5.0, -7.0, 30.0), TURNED, value_unit="K")
    index = np.stack(np.meshgrid(*map(np.arange, volume.dims), indexing="ij"), -1).transpose(2, 1, 0, 3)
    place = index @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    data = place @ (1.0, 30.0, 2.0)
    data = (data - data.min()) / np.ptp(data) * (200 if kind is np.uint8 else 30_000)
    whole = kind is not np.float32
    slope, intercept = (0.25, -10.0) if whole else (1.0, 0.0)
    kept = data.astype(np.float32)
    if missing and not whole:
        kept[:, :8] = np.nan
    volume = Volume(
        np.rint(data).astype(kind) if whole else kept, volume.spacing, volume.origin, TURNED, value_unit="K",
        slope=slope, intercept=intercept,
    )  # fmt: skip
    [facts], [content], *_ = grids_of(volume)
    found = unpacked(content, facts)
    assert facts["bits"] == (8 if kind is np.uint8 else 16)
    from_world = np.linalg.lstsq(np.c_[place.reshape(-1, 3), np.ones(place.size // 3)], data.ravel())[0]
    wanted = slope * (centres(facts) @ from_world[:3] + from_world[3]) + intercept
    known = np.isfinite(found)
    assert known.all() == (whole or not missing)
    rounding = 0.5 * slope if whole else 0.0  # of the stored values
    assert np.abs(found - wanted)[known].max() < 0.5 * facts["step"] + rounding + 1e-6
    assert facts["unit"] == "K"


def test_a_volume_of_few_voxels_is_exact():
    data = np.random.default_rng(2).integers(-1024, 3000, (5, 6, 7)).astype(np.int16)
    [facts], [content], *_ = grids_of(Volume(data, hounsfield=True, space="LPS"))
    np.testing.assert_array_equal(unpacked(content, facts), data)
    assert (facts["step"], facts["unit"]) == (1, "HU")
    flat = grids_of(Volume(np.full((2, 2, 2), 7, np.int16)))
    np.testing.assert_array_equal(unpacked(flat.contents[0], flat.facts[0]), 7)


@pytest.mark.parametrize("stretched", [False, True])
def test_values_are_hounsfield_units_where_a_function_of_those_says_so(stretched):
    """A scan whose file states no unit: air, and tissue; a histogram alone says too little."""
    data = np.full((8, 8, 8), -1000, np.int16)
    data[4:] = np.linspace(20, 60, 64).reshape(8, 8)
    source = SourceRequest(Volume(data), tf="ct-soft-tissue", tf_range="rescale" if stretched else "data")
    found = [load(one).values() for one in (source, replace(source, tf=None, tf_range="data"))]
    assert [one.facts[0]["unit"] for one in found] == ["" if stretched else "HU", ""]
    assert [one.facts[0]["ct"] for one in found] == [True, True]  # windows to choose from


def test_only_a_layer_alone_has_the_statistics_of_the_source():
    one = load(SourceRequest(Volume(np.arange(64, dtype=np.int16).reshape(4, 4, 4)), tf="gray"))
    assert [layer.statistics is one.overall for layer in one.page_layers] == [True]
    assert [layer.statistics for layer in replace(one, layers=one.layers * 2).page_layers] == [None, None]


def test_huge_ranges_fit_into_16_bits():
    data = np.random.default_rng(3).normal(size=(20, 20, 20))
    data[0, 0, 0], data[5, 5, 5] = -1e9, 1e9
    [facts], [content], *_ = grids_of(Volume(data))
    assert not facts["ct"]
    assert np.abs(unpacked(content, facts) - data).max() <= 0.5001 * facts["step"] < 2e4


def test_narrow_ranges_are_no_ct():
    [facts], *_ = grids_of(Volume(300 + 1e-13 * np.random.default_rng(3).normal(size=(8, 8, 8))))
    assert not facts["ct"]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_codes_are_packed_without_loss(dtype):
    codes = np.random.default_rng(4).integers(0, np.iinfo(dtype).max, (3, 4, 5), endpoint=True).astype(dtype)
    facts = {"bits": 8 * codes.itemsize, "dims": [5, 4, 3], "labels": []}
    np.testing.assert_array_equal(unpacked(packed(codes), facts), codes.astype(int) - 1)


def test_labels_are_sampled_and_refer_to_their_list(monkeypatch):
    monkeypatch.setattr("vvgt_cli.gaussians.formats.page_values.MAX_CELLS", 64)
    data = np.zeros((8, 8, 8), np.uint16)
    data[3:5], data[5:7], data[7:] = 7, 300, 9  # 9 is not in the table
    table = LabelTable("t", (Label(0, "air", (0, 0, 0), 0.0), Label(7, "<b>", (1, 0, 0)), Label(300, "c", (0, 1, 0))))
    [facts], [content], *_ = grids_of(Volume(data), table)
    assert [one["name"] for one in facts["labels"]] == ["<b>", "c"]
    assert (facts["dims"], facts["bits"]) == ([4, 4, 4], 8)
    np.testing.assert_array_equal(unpacked(content, facts)[:, 0, 0], [-1, 0, 1, -1])


def test_small_layers_leave_their_cells_to_large_ones(monkeypatch):
    monkeypatch.setattr("vvgt_cli.gaussians.formats.page_values.MAX_CELLS", 600)
    small, large = (Volume(np.random.default_rng(1).random((n, n, n)).astype(np.float32)) for n in (4, 8))
    layers = [PageLayer(volume, read_transfer_function("gray:0,1"), 1.0) for volume in (large, small)]
    assert [facts["dims"] for facts in values_of(layers).facts] == [[8, 8, 8], [4, 4, 4]]


@pytest.fixture
def scan(tmp_path):
    """A scan in HU-like values whose outside holds 999, a mask of its inside, and a label map."""
    nib = pytest.importorskip("nibabel")
    rng = np.random.default_rng(5)
    data = np.full((14, 16, 18), 999, np.int16)
    data[3:11, 3:13, 3:15] = rng.integers(0, 200, (8, 10, 12))
    inside = (data < 999).astype(np.uint8)
    labels = np.zeros(data.shape, np.uint8)
    labels[4:7, 4:9, 4:9] = 1
    for name, one in (("scan", data), ("mask", inside), ("labels", labels)):
        nib.save(nib.Nifti1Image(one, np.diag([-1, 1.5, 2, 1])), tmp_path / f"{name}.nii.gz")
    return tmp_path


def test_pages_hold_what_the_conversion_shows_in_memory_and_in_blocks(vvgt, scan):
    page = scan / "page.html"
    done = vvgt.ok("convert", scan / "scan.nii.gz", "-o", page, *HOW)
    assert "values of the volume (14 x 16 x 18 voxels)" in done.err
    [(facts, values)] = grids_in(page)
    assert (values.max(), facts["dims"]) == (999, [14, 16, 18])
    vvgt.ok("convert", scan / "scan.nii.gz", "--blocks", "16", "-o", scan / "blocks.html", *HOW)
    assert grids_in(scan / "blocks.html")[0][0] == facts
    np.testing.assert_array_equal(grids_in(scan / "blocks.html")[0][1], values)
    for how in (("--mask", scan / "mask.nii.gz"), ("--crop", "3:11,3:13,3:15")):
        for more in ((), ("--blocks", "16")):
            vvgt.ok("convert", scan / "scan.nii.gz", *how, *more, "-o", page, *HOW)
            [(facts, values)] = grids_in(page)
            assert np.nanmax(values) < 200  # nothing from outside
            assert np.isfinite(values).sum() == 8 * 10 * 12
    assert facts["affine"][3] == -3  # where it was
    none = vvgt("convert", scan / "scan.nii.gz", "--no-values", "-o", page, *HOW)
    assert (none.code, grids_in(page), "values of" in none.err) == (0, [], False)


@pytest.mark.parametrize("form", [(), ("--live",)])
def test_a_page_within_its_size_has_coarser_values_before_fewer_gaussians(vvgt, tmp_path, form):
    noise = np.random.default_rng(0).integers(0, 4096, (64, 64, 64)).astype(np.int16)  # hardly to be packed
    noise[:, :, 32:] = 0
    np.save(tmp_path / "noise.npy", noise)
    page, how = tmp_path / "page.html", ("--max-gaussians", "300", "--screen", "32", "--overwrite")
    given = ("convert", tmp_path / "noise.npy", *form, *how, *(() if "--live" in form else ("--steps", "0")))
    sizes, grids, counts = [], [], []
    refused = vvgt.fails(2, *given, "--max-megabytes", "900kB", "-o", page)
    least = float(re.findall(r"no Gaussian fits; expected ([\d.]+) MB or more", refused)[0])
    assert 0.9 < least < 1.2  # the viewer's
    limits = (9, least + 0.1, least + 0.005)
    for limit in limits:
        done = vvgt.ok(*given, "--max-megabytes", f"{limit:.4f}MB", "-o", page)
        sizes.append(page.stat().st_size)
        grids.append(grids_in(page)[0][0]["dims"])
        counts.append(re.findall(r"page\.html: (\d+) Gaussians", done.err)[-1])
    assert grids[0] == [64, 64, 64]
    assert grids[0] > grids[1] > grids[2]
    assert 0.9e6 < sizes[1] <= limits[1] * 1e6
    assert sizes[2] <= limits[2] * 1e6
    assert counts[0] == counts[1]


def test_a_lit_page_within_its_size_counts_its_harmonics(vvgt, tmp_path):
    grid = np.linspace(-1, 1, 48)
    ball = np.sin(20 * np.sqrt(sum(np.square(np.meshgrid(grid, grid, grid)))))
    np.save(tmp_path / "ball.npy", ball.astype(np.float32))
    page, how = (
        tmp_path / "page.html",
        ("--steps", "0", "--screen", "64", "--light", "headlight", "--max-megabytes", "1.5MB"),
    )
    done = vvgt.ok("convert", tmp_path / "ball.npy", *how, "-o", page)
    assert page.stat().st_size <= 1.5e6
    counts = {int(count.replace(",", "")) for count in re.findall(r"([\d,]+) Gaussians", done.err)}
    assert max(counts) < 1.1 * min(counts)


def test_labels_lie_over_the_scan_and_series_have_none(vvgt, scan, small_screen):
    page, layer = scan / "both.html", ("--layer", f"{scan / 'labels.nii.gz'},labels=auto")
    vvgt.ok("convert", scan / "scan.nii.gz", *layer, "--live", "-o", page, *HOW[:4])
    (_, values), (facts, rows) = grids_in(page)
    assert np.isfinite(values).all()
    assert (rows >= 0).sum() == 3 * 5 * 5
    assert len(facts["labels"]) == 1
    alone = vvgt.ok("view", scan / "labels.nii.gz", "--labels", "auto", "-o", page, "--overwrite")
    assert "names of 1 label," in alone.err
    assert [set(np.unique(rows)) for _, rows in grids_in(page)] == [{-1, 0}]
    assert "--no-values" in vvgt.fails(2, "view", scan / "scan.nii.gz", "--no-values")
    live = vvgt.ok("convert", scan / "labels.nii.gz", "--labels", "auto", "--live", "--overwrite", "-o", page, *HOW[:4])
    assert "names of 1 label," in live.err
    two = ("--tf", "gray", "--tf", "viridis")
    vvgt.ok("convert", scan / "scan.nii.gz", *two, "-o", page, *HOW)
    assert grids_in(page) == []


def test_results_have_values_in_files_and_cells(scan):
    import vvgt_cli as vvgt

    result = vvgt.convert(str(scan / "scan.nii.gz"), max_gaussians=60, screen=32, steps=0)
    result.save(scan / "result.html")
    [(facts, values)] = grids_in(scan / "result.html")
    assert values.shape == (18, 16, 14)
    assert facts["element"] in result._repr_html_()
    result.save(scan / "result.html", values=False)
    assert grids_in(scan / "result.html") == []
    result.save(scan / "result.html", comments=False)
    assert grids_in(scan / "result.html") == []
