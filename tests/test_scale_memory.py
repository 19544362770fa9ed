"""What blocks read and keep: slices of TIFF page by page, every voxel once, no more than a worker's memory."""

import gc
import mmap
import os
import weakref
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tests.test_scale import FIT, bodies, sorted_rows, store
from vvgt_cli.errors import UsageError
from vvgt_cli.field.settings import BlockOptions, block_bytes, block_edge, worker_count
from vvgt_cli.volume import ReadOptions, Volume
from vvgt_cli.volume import stored as stored_module
from vvgt_cli.volume.stored import Stored, read_block
from vvgt_cli.volume.tiff.reader import read_tiff


@pytest.mark.parametrize("coding", [None, "zlib"])
def test_slices_of_tiff_are_read_in_blocks_page_by_page(vvgt, tmp_path, coding):
    import tifffile

    values = np.round(bodies((34, 37, 20)) * 255).astype(np.uint8)
    folder = tmp_path / "slices"
    folder.mkdir()
    for z, plane in enumerate(values):
        tifffile.imwrite(folder / f"s{z}.tif", plane, compression=coding)
    tifffile.imwrite(
        tmp_path / "v.ome.tif", values[None, :, None], compression=coding or "lzma", metadata={"axes": "TZCYX"}
    )
    two = np.stack([values, values[::-1]], axis=1)  # channels within slices
    tifffile.imwrite(tmp_path / "two.tif", two, compression="zlib", imagej=False, metadata={"axes": "ZCYX"})
    tifffile.imwrite(tmp_path / "plain.tif", two, imagej=False, metadata={"axes": "ZCYX"})
    plain = read_tiff(tmp_path / "plain.tif", ReadOptions(stored=True, component=1))
    assert isinstance(plain.data, (Stored, np.memmap))  # neither whole nor a copy of a channel
    assert np.array_equal(plain.data[3:5, 2:9, 1:7], two[3:5, 1, 2:9, 1:7])
    channels = () if coding else ("two.tif", "plain.tif")  # which are the same both times
    sources = (folder, tmp_path / "v.ome.tif", *(tmp_path / name for name in channels))
    for source in sources:
        more = ("--channel", "0") if source.name in channels else ()
        files = []
        for blocks in ((), ("--blocks", "16")):
            path = tmp_path / "a.ply"
            vvgt.ok("init", source, "-o", path, *FIT, *more, *blocks, "--overwrite")
            files.append(sorted_rows(path)[1])
        assert np.array_equal(*files)


def test_slices_that_do_not_fit_together_are_a_line_in_blocks_too(vvgt, tmp_path):
    import tifffile

    for z in range(20):
        tifffile.imwrite(tmp_path / f"s{z}.tif", np.zeros((8, 9 if z == 17 else 10), np.uint8))
    run = vvgt.fails(1, "init", tmp_path, "-o", tmp_path / "a.ply", *FIT, "--blocks", "16")
    assert "s17.tif: 9 x 8 uint8; expected 10 x 8 uint8 as in s0.tif" in run


def test_a_small_file_that_unpacks_to_much_is_gone_through_in_blocks(vvgt, tmp_path, monkeypatch):
    import tifffile

    values = np.round(bodies((34, 37, 20))).astype(np.uint8)
    tifffile.imwrite(tmp_path / "v.tif", values, compression="zlib")
    monkeypatch.setattr("vvgt_cli.field.open.free_memory", lambda: 20_000)
    assert (tmp_path / "v.tif").stat().st_size < 20_000
    for source in (tmp_path / "v.tif", store("zarr3", tmp_path, values)):
        run = vvgt.ok("init", source, "-o", tmp_path / "a.ply", *FIT[:-1], "--overwrite")
        assert "processed in blocks" in run.err


def test_threads_share_a_file_of_pages(tmp_path):
    from concurrent.futures import ThreadPoolExecutor

    import tifffile

    values = np.random.default_rng(0).integers(0, 255, (60, 64, 64)).astype(np.uint8)
    tifffile.imwrite(tmp_path / "v.tif", values, compression="zlib")
    pages = read_tiff(tmp_path / "v.tif", ReadOptions(stored=True)).data
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda z: pages[z : z + 1, 0:64, 0:64], [*range(60)] * 4))
    assert np.array_equal(np.concatenate(found), np.concatenate([values] * 4))


def stored(dims, dtype, read=None, chunk=64):
    """A volume of ``dims`` (x, y, z) in chunks that nobody holds."""
    from vvgt_cli.volume.stored import Stored

    return Volume(Stored(read or (lambda slices: None), np.dtype(dtype), dims[::-1], (chunk,) * 3, "v"), (1.0,) * 3)


def test_counting_reads_every_voxel_once_and_little_more(tmp_path, monkeypatch):
    from vvgt_cli.field import reader
    from vvgt_cli.field.block_store import COUNTS, BlockStore
    from vvgt_cli.field.counting import CountBlocks
    from vvgt_cli.field.grid import Boxes
    from vvgt_cli.field.layered import OpenedFile

    values, read = bodies((100, 90, 80)).astype(np.float32), []

    def part(slices):
        read.append(values[slices].size)
        return values[slices].copy()

    volume = stored((100, 90, 80), np.float32, part)
    monkeypatch.setattr(reader, "open_content", lambda source, options: OpenedFile((volume,)))
    store = BlockStore(tmp_path)
    (store.folder / COUNTS).mkdir()
    place = reader.VolumeOrigin("counted once", ReadOptions(stored=True))
    task = CountBlocks(place, Boxes((100, 90, 80), (64, 64, 64)), 24, store, COUNTS)
    for number in range(len(task)):
        task(number)
    assert values.size <= sum(read) < 1.1 * values.size
    whole, (samples, _) = task.merged(), task.samples()
    assert (whole.lo, whole.hi) == (values.min(), values.max())
    assert (samples == values[3:12, 3:12, 3:12]).all(axis=(1, 2, 3)).any()


def test_the_memory_of_a_block_is_that_of_its_worker(monkeypatch):
    monkeypatch.setattr("vvgt_cli.field.settings.free_memory", lambda: 4 << 30)
    volume = stored((1536, 1536, 1536), np.float32)
    edges = {
        (who, n): block_edge(volume, BlockOptions(workers=n, scheduler=who))
        for who in (None, "local", "slurm")
        for n in (1, 8)
    }
    assert {edges[who, 1] for who in (None, "local", "slurm")} == {256}
    assert edges["local", 8] == edges[None, 8] == 128  # processes of one machine share it
    assert edges["slurm", 8] == 256  # each job has its own
    monkeypatch.setattr("vvgt_cli.field.settings.free_memory", lambda: 800 << 20)
    assert block_edge(volume, BlockOptions()) == 256
    assert block_edge(stored((1536, 1536, 1536), np.float64), BlockOptions()) == 128
    small = stored((48, 48, 48), np.uint8)
    assert block_edge(small, BlockOptions(workers=8)) == block_edge(small, BlockOptions())  # one block is one worker's
    assert block_bytes(stored((512, 512, 512), np.float32), 64) == 4 * 68**3  # with two voxels around it under light
    monkeypatch.setattr("vvgt_cli.field.settings.free_memory", lambda: 700 << 20)
    with pytest.raises(UsageError, match=r"2 workers .* take fewer --workers"):  # what each process keeps does not fit
        block_edge(volume, BlockOptions(workers=2))
    monkeypatch.setattr("vvgt_cli.field.settings.free_memory", lambda: 8 << 30)
    assert worker_count(BlockOptions(), 1 << 30, 0, 8, 1 << 30) == 5  # by default as many as fit


@pytest.mark.skipif(not os.path.exists("/proc/self/smaps"), reason="no /proc/self/smaps")
@pytest.mark.parametrize("turned", [False, True])
def test_of_a_mapped_file_no_more_than_a_little_is_held(tmp_path, monkeypatch, turned):
    path, most, most_held = tmp_path / "v.raw", 8 << 20, []
    with open(path, "wb") as file:
        file.truncate(64 << 22)  # a hole
        for z in range(64):
            file.seek((z << 22) + 17 * 2048 + z)
            file.write(bytes([z + 1]) * 30)
    data = np.memmap(path, np.uint8, "r", shape=(64, 2048, 2048))
    expected, mapped = data[3:60, 5:100, 7:90].copy(), stored_module._mapping_of(data)
    mapped.madvise(mmap.MADV_DONTNEED)

    class Counted:
        """Gives pages back, and says how many bytes of the file were held until then."""

        def madvise(self, advice):
            text = Path("/proc/self/smaps").read_text().partition(str(path))[2]
            most_held.append(int(text.partition("Rss:")[2].split()[0]) << 10)
            mapped.madvise(advice)

    monkeypatch.setattr(stored_module, "_mapping_of", lambda data: Counted())
    monkeypatch.setattr(stored_module, "MAPPED", most)
    if turned:
        volume, lo, hi = Volume(data.T, (1.0,) * 3), (3, 5, 7), (60, 100, 90)
        assert np.array_equal(read_block(volume, np.array(lo), np.array(hi)), expected.T)
    else:
        volume, lo, hi = Volume(data, (1.0,) * 3), (7, 5, 3), (90, 100, 60)
        assert np.array_equal(read_block(volume, np.array(lo), np.array(hi)), expected)
    assert 0 < max(most_held) <= most
    assert len(most_held) < 57  # not slice by slice


def test_of_a_tiles_tree_nothing_but_its_top_stays_in_memory(vvgt, tmp_path, monkeypatch):
    from vvgt_cli.closed_form import pyramid

    values, made = np.round(bodies((128, 90, 120)) * 255).astype(np.uint8), []
    path = tmp_path / "v_128x90x120_uint8.raw"
    path.write_bytes(values.tobytes())

    def watched(*args, build=pyramid.build_tree):
        assert sum(one() is not None for one in made) <= 1  # the one before
        tree = build(*args)
        made.append(weakref.ref(tree.moments))
        return tree

    monkeypatch.setattr(pyramid, "build_tree", watched)
    vvgt.ok("init", path, "-o", tmp_path / "a.ply", *FIT, "--blocks", "64")
    assert len(made) > 6


@pytest.mark.parametrize("blocks", [None, BlockOptions(16)])
@pytest.mark.parametrize("live", [False, True])
def test_a_converted_volume_is_released_at_once(monkeypatch, blocks, live):
    """In a batch, volumes that wait for Python's search for cycles are in memory together."""
    from matplotlib import colormaps  # whose first import keeps exceptions, with the frames of its callers

    from vvgt_cli.conversion import convert, convert_batch
    from vvgt_cli.conversion.batch import Functions
    from vvgt_cli.conversion.request import ConvertRequest, FitOptions
    from vvgt_cli.field.source import SourceRequest
    from vvgt_cli.progress import Console

    opened, fields, alive = convert.open_field, [], []

    @contextmanager
    def open_field(run, request):
        alive.append(sum(one() is not None for one in fields))
        with opened(run, request) as field:
            fields.append(weakref.ref(field))
            yield field

    monkeypatch.setattr(convert, "open_field", open_field)
    fit = FitOptions(200, screen=64, steps=None if live else 2)
    source = SourceRequest("example:marschner-lobb:16", tf=colormaps["viridis"].name)
    one = ConvertRequest(source, fit=fit, blocks=blocks, live=live)
    gc.disable()
    try:
        convert_batch._run(Functions(dict.fromkeys("abc", one)), None, Console(quiet=True))
    finally:
        gc.enable()
    assert alive == [0, 0, 0]
