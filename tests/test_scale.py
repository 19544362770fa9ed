"""The closed form in blocks: the same Gaussians as in memory, the same bytes whatever the blocks, workers and order."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from vvgt_cli.field.counting import counted, statistics_of, tally, with_limits
from vvgt_cli.gaussians import read_ply
from vvgt_cli.volume import ReadOptions, read_volume
from vvgt_cli.volume.stats import statistics

FIT = ("--max-gaussians", "3000", "--screen", "150", "-q")


def bodies(dims=(100, 90, 80)):
    """(nz, ny, nx) float in [0, 1]: balls, a shell, texture."""
    axes = [(np.arange(n) + 0.5) / n * 2 - 1 for n in dims]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    r = np.sqrt(x * x + y * y + z * z)
    values = np.exp(-60 * (r - 0.6) ** 2) * 0.5 + 0.9 * np.exp(-40 * ((x - 0.3) ** 2 + y * y + z * z))
    return np.clip(values + 0.03 * np.sin(30 * x) * np.sin(25 * y) * (values > 0.05), 0, 1)


@pytest.fixture
def raw(tmp_path):
    """A raw uint8 file of 100 x 90 x 80."""
    path = tmp_path / "v_100x90x80_uint8.raw"
    path.write_bytes(np.round(bodies() * 255).astype(np.uint8).tobytes())
    return path


def sorted_rows(path):
    """Rows of a .ply in an order of their own."""
    content = path.read_bytes()
    start = content.index(b"end_header\n") + 11
    rows = np.frombuffer(content, np.uint8, offset=start).reshape(len(read_ply(path)[0]), -1).view(np.uint32)
    return content[:start], rows[np.lexsort(rows.T)]


def same_gaussians(one, other):
    (head, rows), (head_2, rows_2) = sorted_rows(one), sorted_rows(other)
    return head == head_2 and rows.shape == rows_2.shape and np.array_equal(rows, rows_2)


def test_blocks_leave_the_gaussians_that_memory_does_in_any_size_of_block(vvgt, raw, tmp_path):
    memory = tmp_path / "memory.ply"
    vvgt.ok("init", raw, "-o", memory, *FIT)
    files = []
    for size in ("16", "auto"):
        path = tmp_path / f"{size}.ply"
        vvgt.ok("init", raw, "-o", path, *FIT, "--blocks", size)
        files.append(path.read_bytes())
    assert len(set(files)) == 1
    assert same_gaussians(memory, path)
    assert [p.name for p in tmp_path.iterdir() if "blocks" in p.name] == []


def in_memory_and_in_blocks(vvgt, raw, folder, *fit):
    """Convert in memory and in blocks of 32 voxels, and return both files."""
    one, other = folder / "a.ply", folder / "b.ply"
    vvgt.ok("init", raw, "-o", one, *fit)
    vvgt.ok("init", raw, "-o", other, *fit, "--blocks", "32")
    return one, other


@pytest.mark.parametrize("budget", ["7", "60000"])
def test_any_budget_is_cut_as_in_memory(vvgt, raw, tmp_path, budget):
    fit = ("--max-gaussians", budget, "--screen", "100", "-q")
    assert same_gaussians(*in_memory_and_in_blocks(vvgt, raw, tmp_path, *fit))


def test_surfaces_of_labels_lie_where_they_do_in_memory(vvgt, tmp_path):
    z, y, x = np.indices((44, 36, 40))
    r = np.sqrt((x - 19.5) ** 2 + (y - 17.5) ** 2 + (z - 21.5) ** 2)
    np.save(tmp_path / "v.npy", ((r < 14) + (r < 8)).astype(np.uint8))
    fit = ("--labels", "auto", "--light", "none", "--max-gaussians", "2000", "--screen", "200", "-q")
    assert same_gaussians(*in_memory_and_in_blocks(vvgt, tmp_path / "v.npy", tmp_path, *fit))


def test_opaque_anisotropic_and_turned_volumes_too(vvgt, tmp_path):
    path = tmp_path / "v.nhdr"
    (tmp_path / "v.raw").write_bytes(np.round(bodies((60, 70, 30)) * 4000 - 100).astype(">i2").tobytes())
    path.write_text(
        "NRRD0004\ntype: int16\ndimension: 3\nsizes: 60 70 30\nendian: big\nencoding: raw\nspace: LPS\n"
        "space directions: (0,1,0) (-1,0,0) (0,0,2.5)\nspace origin: (3,4,5)\ndata file: v.raw\n"
    )
    tf = tmp_path / "tf.json"
    tf.write_text('{"range": [0, 1000], "points": [{"x": 0.3, "rgb": [1, 0, 0], "opacity": 0},'
                  '{"x": 0.4, "rgb": [1, 1, 0], "opacity": 1}]}')  # fmt: skip
    one, other = tmp_path / "a.ply", tmp_path / "b.ply"
    options = ("--tf", tf, "--max-gaussians", "3000", "--screen", "200", "-q")
    vvgt.ok("init", path, "-o", one, *options)
    for size in ("16", "32"):
        vvgt.ok("init", path, "-o", other, *options, "--blocks", size, "--overwrite")
        assert same_gaussians(one, other)


@pytest.mark.parametrize(
    ("dtype", "factor", "scale"),
    [
        *(("uint8", 1, (1, 0)), ("int16", 1, (1, 0)), ("int16", 1, (-0.37, 11)), ("int32", 1, (1, 0))),
        *(("int32", 1e6, (-0.1, 3)), ("float32", 1, (1, 0)), ("float32", 1, (0.37, -11)), ("float32", 1e36, (-1, 0))),
        *(("float64", 1, (1, 0)), ("float64", 1.1e306, (1, 0)), ("float64", 1, (1.3e306, 0)), ("float16", 1, (1, 0))),
    ],
)
def test_counts_of_blocks_add_up_to_the_statistics(tmp_path, dtype, factor, scale):
    values = (bodies((30, 20, 25)) * 200 - 50) * factor
    values = values.astype(dtype) if dtype != "uint8" else np.round(bodies((30, 20, 25)) * 255).astype(dtype)
    if values.dtype.kind == "f":
        values[3, 4, 5:9], values[0, 0, 0] = np.nan, np.inf
    np.save(tmp_path / "v.npy", values)
    volume = replace(read_volume(str(tmp_path / "v.npy")), slope=float(scale[0]), intercept=float(scale[1]))
    store = [volume.data[a:b].copy() for a, b in ((11, 25), (0, 3), (3, 11))]
    whole = tally(store[0], volume).plus(tally(store[1], volume)).plus(tally(store[2], volume))
    whole, histogram = with_limits(whole, volume), None
    if not counted(volume):
        histogram = sum(tally(part, volume, (whole.lo, whole.hi)).histogram for part in store)
    ours, theirs = statistics_of(whole, volume, histogram), statistics(volume)
    assert (ours.lo, ours.hi, ours.nan_count, ours.inf_count) == (
        theirs.lo,
        theirs.hi,
        theirs.nan_count,
        theirs.inf_count,
    )
    finite = volume.data[np.isfinite(volume.data)]
    assert whole.stored == pytest.approx((finite.min(), finite.max()), rel=1e-12)
    assert np.array_equal(ours.histogram, theirs.histogram)
    assert np.array_equal(ours.edges, theirs.edges)


def store(kind, path, values, chunks=(16, 20, 24)):
    """A chunked file of an array; what to give to vvgt."""
    if kind == "hdf5":
        h5py = pytest.importorskip("h5py")
        with h5py.File(path / "v.h5", "w") as file:
            file.create_dataset("a", data=values, chunks=chunks, compression="gzip")
        return path / "v.h5"
    zarr = pytest.importorskip("zarr")
    version = int(kind[-1])
    array = zarr.create_array(
        path / "v.zarr", shape=values.shape, chunks=chunks, dtype=values.dtype, zarr_format=version, fill_value=0
    )
    array[:] = values
    return path / "v.zarr"


@pytest.mark.parametrize("kind", ["zarr2", "hdf5"])
def test_chunked_files_are_read_in_blocks(vvgt, tmp_path, kind):
    source = store(kind, tmp_path, bodies().astype(np.float32))
    assert same_gaussians(*in_memory_and_in_blocks(vvgt, source, tmp_path, *FIT))


def test_axes_of_an_array_in_a_file_are_turned_as_in_memory(tmp_path):
    h5py = pytest.importorskip("h5py")
    values = np.arange(6 * 5 * 4 * 2, dtype=np.int16).reshape(6, 5, 4, 2)
    with h5py.File(tmp_path / "v.h5", "w") as file:
        data = file.create_dataset("a", data=values, chunks=(2, 2, 3, 1))
        data.attrs["_FillValue"] = np.int16(7)
        data.attrs["scale_factor"] = 0.5
        for k, (name, centres) in enumerate([("x", range(6)), ("z", range(5, 0, -1)), ("y", range(4))]):
            file[name] = np.array(list(centres), np.float64)
            file[name].make_scale(name)
            data.dims[k].attach_scale(file[name])
    path = str(tmp_path / "v.h5")
    whole = read_volume(path, ReadOptions(array="a", component=1))
    left = read_volume(path, ReadOptions(array="a", component=1, stored=True))
    assert left.data.shape == whole.data.shape == (5, 4, 6)
    assert (left.spacing, left.origin) == (whole.spacing, whole.origin)
    scaled = whole.data * whole.slope + whole.intercept
    assert np.array_equal(left.data[:] * left.slope + left.intercept, scaled, equal_nan=True)
    assert np.array_equal(left.data[1:3, 2:, 1:5] * left.slope, scaled[1:3, 2:, 1:5], equal_nan=True)


def chunk_files(path):
    return sorted(p for p in path.rglob("*") if p.is_file() and not p.name.startswith((".z", "zarr.json")))


@pytest.mark.parametrize("kind", ["zarr2", "zarr3"])
def test_a_missing_chunk_is_fill_value_and_a_damaged_one_a_line_with_its_index(vvgt, tmp_path, kind):
    values = np.round(bodies((64, 64, 64)) * 255).astype(np.uint8)
    source = store(kind, tmp_path, values, (32, 32, 32))
    chunks = chunk_files(source)
    assert len(chunks) == 8
    chunks[5].write_bytes(b"nonsense")
    run = vvgt.fails(1, "init", source, "-o", tmp_path / "a.ply", *FIT, "--blocks", "32")
    assert "chunk (1, 0, 1) (z, y, x) is damaged" in run
    chunks[5].unlink()
    vvgt.ok("init", source, "-o", tmp_path / "a.ply", *FIT, "--blocks", "32")
    values[32:, :32, 32:] = 0
    np.save(tmp_path / "v.npy", values)
    vvgt.ok("init", tmp_path / "v.npy", "-o", tmp_path / "b.ply", *FIT)
    assert same_gaussians(tmp_path / "a.ply", tmp_path / "b.ply")


def test_a_level_of_an_image_is_chosen_by_the_screen(vvgt, tmp_path):
    group = pytest.importorskip("zarr").open_group(tmp_path / "v.zarr", mode="w", zarr_format=3)
    values = np.round(bodies((64, 64, 64)) * 255).astype(np.uint8)
    for n in range(3):
        group.create_array(str(n), data=values[:: 2**n, :: 2**n, :: 2**n])
    levels = [
        {"path": str(n), "coordinateTransformations": [{"type": "scale", "scale": [2.0**n] * 3}]} for n in range(3)
    ]
    axes = [{"name": name, "type": "space"} for name in "zyx"]
    group.attrs["ome"] = {"version": "0.5", "multiscales": [{"axes": axes, "datasets": levels}]}
    options = ("--max-gaussians", "500", "--overwrite")
    for size, level, grid in ((300, None, "64 x 64 x 64"), (30, None, "32 x 32 x 32"), (30, "full", "64 x 64 x 64"),
                              (30, "2", "16 x 16 x 16")):  # fmt: skip
        chosen = ["--level", level] if level else ["--blocks", "auto"]
        run = vvgt.ok("init", tmp_path / "v.zarr", "-o", tmp_path / "a.ply", "--screen", size, *options, *chosen)
        assert f": {grid} uint8" in run.err
    zipfile = shutil.make_archive(str(tmp_path / "v.zarr"), "zip", tmp_path / "v.zarr")
    for how in (("--level", "1"), ("--blocks", "auto", "--crop", "0:32,0:32,0:32")):
        source = zipfile if "--level" in how else tmp_path / "v.zarr"
        run = vvgt.ok("init", source, "-o", tmp_path / "a.ply", "--screen", 30, *options, *how)
        assert ": 32 x 32 x 32 uint8" in run.err
        step = np.abs(np.reshape(read_ply(tmp_path / "a.ply")[1].affine, (3, 4))[:, :3]).max()
        assert step == (2 if "--level" in how else 1)  # a crop counts the finest voxels, as in memory
    run = vvgt.fails(2, "init", tmp_path / "v.zarr", "-o", tmp_path / "a.ply", *options, "--level", "3")
    assert "expected full, or 0 to 2" in run
    run = vvgt.fails(2, "init", "example:blob:20", "-o", tmp_path / "a.ply", *options, "--level", "1")
    assert "has no resolution levels; expected OME-Zarr, N5, Imaris or BigDataViewer" in run


def test_memory_decides_by_itself(vvgt, tmp_path, monkeypatch):
    source = store("hdf5", tmp_path, bodies().astype(np.float32))
    assert "blocks" not in vvgt.ok("init", source, "-o", tmp_path / "a.ply", *FIT[:-1]).err
    monkeypatch.setattr("vvgt_cli.field.open.free_memory", lambda: 200 << 20)
    assert "processed in blocks" in vvgt.ok("init", source, "-o", tmp_path / "b.ply", *FIT[:-1]).err
    assert same_gaussians(tmp_path / "a.ply", tmp_path / "b.ply")
    monkeypatch.setattr("vvgt_cli.volume.blocks.free_memory", lambda: 1 << 20)
    vvgt.ok("render-views", source, "-o", tmp_path / "views", "--size", "40", "--views", "2")
    few = ("--max-gaussians", "300", "--screen", "48", "--steps", "2")
    assert (
        "processed in blocks"
        in vvgt.ok("evaluate", tmp_path / "b.ply", "--volume", source, "--step 2 --screen 48 --no-conditions").err
    )
    assert "processed in blocks" in vvgt.ok("convert", source, "-o", tmp_path / "d.ply", *few).err
    monkeypatch.setattr("vvgt_cli.field.settings.free_memory", lambda: 200 << 20)
    assert "MiB more" in vvgt.fails(2, "init", source, "-o", tmp_path / "c.ply", *FIT[:-1])


def test_what_blocks_cannot_do_is_a_line(vvgt, raw, tmp_path):
    for options, word in (
        (("--blocks", "48"), "power of two"),
        (("--shard", "1/2", "--report", "r.json"), "vvgt merge"),
        (("--shard", "3/2"), "I from 1 to N"),
    ):
        assert word in vvgt.fails(2, "init", raw, "-o", tmp_path / "a.ply", *FIT, *options)
    packed = tmp_path / "v_100x90x80_uint8.raw.gz"
    import gzip

    packed.write_bytes(gzip.compress(raw.read_bytes()))
    vvgt.ok("init", packed, "-o", tmp_path / "c.ply", *FIT, "--blocks", "auto")  # small: unpacked
    assert vvgt("merge", tmp_path, "-o", tmp_path / "d.ply").code == 2


def test_a_box_that_is_counted_slice_by_slice_has_the_counts_and_samples_of_the_whole(raw, tmp_path):
    from vvgt_cli.field.block_store import COUNTS, BlockStore
    from vvgt_cli.field.counting import CountBlocks
    from vvgt_cli.field.grid import Boxes
    from vvgt_cli.field.reader import VolumeOrigin

    merged = []
    for slices in (1, 7, 80):
        store = BlockStore(tmp_path / str(slices))
        (store.folder / COUNTS).mkdir(parents=True)
        task = CountBlocks(
            VolumeOrigin(str(raw), ReadOptions(stored=True)), Boxes((100, 90, 80), (64, 64, 64)), slices, store, COUNTS
        )
        for number in range(len(task)):
            task(number)
        merged.append((task.merged(), *task.samples()))
    whole, samples, weights = merged[0]
    assert whole.counts.sum() == 100 * 90 * 80
    assert len(samples) == len(weights) > 100
    x, y, z = (n // 16 * 16 + 3 for n in (50, 40, 30))
    assert (samples == read_volume(str(raw)).data[z : z + 9, y : y + 9, x : x + 9]).all(axis=(1, 2, 3)).any()
    for other in merged[1:]:
        assert np.array_equal(other[0].counts, whole.counts)
        assert np.array_equal(other[1], samples)
        assert np.array_equal(other[2], weights)


def test_only_what_may_be_labels_is_given_the_memory_of_layers(tmp_path, monkeypatch):
    from vvgt_cli.errors import UsageError
    from vvgt_cli.field.open import _measured
    from vvgt_cli.field.settings import BlockOptions, block_edge
    from vvgt_cli.field.source import SourceRequest

    monkeypatch.setattr("vvgt_cli.field.settings.free_memory", lambda: 700 << 20)
    for name, tf, fits in (
        ("v_1024x512x512_float32.raw", None, True),
        ("v_1024x512x512_uint8.raw", None, True),
        ("seg_1024x512x512_uint8.raw", None, False),
        ("seg_1024x512x512_uint8.raw", "ct-bone", True),
        ("seg_1024x512x512_float32.raw", None, False),
    ):
        with open(tmp_path / name, "wb") as file:
            file.truncate(1024 * 512 * 512 * (4 if "float" in name else 1))  # a hole: nothing of it is read
        volume, voxel = _measured(SourceRequest(str(tmp_path / name), tf=tf))
        if fits:
            assert block_edge(volume, BlockOptions(), voxel) == 128
        else:
            with pytest.raises(UsageError, match="MiB more"):
                block_edge(volume, BlockOptions(), voxel)


def test_parts_are_written_once_to_standard_output_too(vvgt, raw, tmp_path):
    line = ("init", raw, "--max-gaussians", "500", "--screen", "64", "--blocks", "32", "-q", "-o")
    vvgt.ok(*line, tmp_path / "a.ply")
    assert vvgt.ok(*line, "-").out == (tmp_path / "a.ply").read_bytes()
