"""OpenVDB files that OpenVDB 10 wrote (tests/fixtures/vdb/write_vdb.cc), against the values that it read from them."""

import shutil
import struct
import tarfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.refused import refused
from tests.vdb_files import plume, vdb
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.look import from_histogram
from vvgt_cli.look.suggest import fitting
from vvgt_cli.volume import ReadOptions, read_volume, statistics
from vvgt_cli.volume.components import magnitude
from vvgt_cli.volume.openvdb import codec
from vvgt_cli.volume.openvdb.codec import Cursor
from vvgt_cli.volume.openvdb.reader import brick_array
from vvgt_cli.volume.openvdb.tree import Tree
from vvgt_cli.volume.stored import Stored

ARCHIVE = Path(__file__).parent / "fixtures" / "vdb" / "grids.tar.xz"


@dataclass(frozen=True)
class Case:
    """A line of expected.tsv."""

    file: str
    grid: str
    dtype: str
    components: int
    dims: tuple[int, ...]
    spacing: tuple[float, ...]
    origin: tuple[float, ...]
    raw: str

    @classmethod
    def parse(cls, line: str) -> "Case":
        f = line.split("\t")
        numbers = [tuple(float(v) for v in f[k : k + 3]) for k in (7, 10)]
        return cls(f[0], f[1], f[2], int(f[3]), tuple(map(int, f[4:7])), numbers[0], numbers[1], f[13])

    def values(self, folder: Path) -> np.ndarray:
        """(nz, ny, nx, c) as OpenVDB has them."""
        return np.fromfile(folder / self.raw, self.dtype).reshape(*self.dims[::-1], self.components)


def cases() -> list[Case]:
    with tarfile.open(ARCHIVE) as archive:
        table = archive.extractfile("./expected.tsv")
        return [Case.parse(line) for line in table.read().decode().splitlines()]


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("vdb")
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(path, filter="data")
    return path


REFUSED = ("sheared", "frustum")


@pytest.mark.parametrize(
    "case", [c for c in cases() if c.grid not in REFUSED], ids=lambda c: f"{c.file}-{c.grid}".replace(" ", "_")
)
def test_every_grid_is_equal_to_the_last_bit(folder: Path, case: Case) -> None:
    expected = case.values(folder)
    for component in range(case.components):
        options = ReadOptions(array=case.grid, component=component if case.components > 1 else None)
        volume = read_volume(str(folder / case.file), options)
        assert isinstance(read_volume(str(folder / case.file), replace(options, stored=True)).data, Stored)
        assert volume.dims == case.dims
        assert volume.data.dtype == np.dtype(case.dtype)
        assert np.asarray(volume.data).tobytes() == np.ascontiguousarray(expected[..., component]).tobytes()
        # a rotated grid's edges come from its axes here, from differences of positions there
        np.testing.assert_allclose(volume.spacing, case.spacing, rtol=1e-14)
        np.testing.assert_allclose(volume.origin, case.origin, rtol=1e-14, atol=1e-14)
    if case.components > 1:
        volume = read_volume(str(folder / case.file), ReadOptions(array=case.grid, component="magnitude"))
        np.testing.assert_array_equal(np.asarray(volume.data), magnitude(np.moveaxis(expected, -1, 0)))


def test_slabs_are_the_parts_of_the_whole(folder: Path) -> None:
    for grid in ("tiles", "root"):
        lazy, whole = (
            read_volume(str(folder / "tiles.vdb"), ReadOptions(array=grid, stored=stored)).data
            for stored in (True, False)
        )
        for start, stop in ((0, 1), (0, 3), (5, 22), (7, 9), (len(whole) - 2, len(whole)), (4, 4)):
            np.testing.assert_array_equal(lazy[start:stop], whole[start:stop])
        np.testing.assert_array_equal(lazy[3:12, 1:3, 2:5], whole[3:12, 1:3, 2:5])
        assert whole.flags.c_contiguous
        assert not whole.flags.writeable


def test_leaves_beyond_the_box_are_left_out() -> None:
    """As where none of their voxels is active."""
    origins = np.array([(x, y, z) for z in (0, 8) for y in (-8, 0, 8) for x in (0, 8, 16)], np.int64)
    leaves = np.arange(len(origins) * 512, dtype=np.float32).reshape(-1, 8, 8, 8)
    tree = Tree(np.float32([-1]), [], origins, np.full((len(origins), 64), 255, np.uint8), leaves)
    for lo, hi in (((0, 0, 0), (7, 7, 7)), ((3, -8, 0), (12, 7, 7)), ((8, 8, 8), (30, 15, 15))):
        found = brick_array(tree, np.array(lo), np.array(hi), None, "a.vdb", "grid 'a'")[:]
        whole = np.full((40, 40, 40), -1, np.float32)  # z, y, x from -8
        for (x, y, z), leaf in zip(origins + 8, leaves, strict=True):
            whole[z : z + 8, y : y + 8, x : x + 8] = leaf.T
        box = tuple(slice(a + 8, b + 9) for a, b in zip(lo[::-1], hi[::-1], strict=True))
        np.testing.assert_array_equal(found, whole[box])


def test_a_grid_that_is_walked_through_is_not_laid_out(folder: Path) -> None:
    volume = read_volume(str(folder / "tiles.vdb"), ReadOptions(array="tiles", packed=True))
    assert isinstance(volume.data, Stored)
    numbers = statistics(volume)
    assert (numbers.lo, numbers.hi, numbers.histogram.sum()) == (1.5, 4.5, volume.data.size)


@pytest.mark.parametrize(
    ("file", "options", "error", "message"),
    [
        ("many.vdb", {}, UsageError, r"several grids: density\[0\] \(float\); .*choose one with --grid NAME"),
        ("many.vdb", {"array": "density"}, UsageError, "2 grids 'density'.*name one with its number"),
        ("many.vdb", {"array": "velocity"}, UsageError, "3 components.*--component 0 to 2, or --component magnitude"),
        ("many.vdb", {"array": "other"}, DataError, "float, tree 4-3-2.*expected values of type float"),
        ("tiles.vdb", {"array": "far"}, DataError, "span 4000000001 x 6 x 6"),
        ("transforms.vdb", {"array": "frustum"}, DataError, "a frustum"),
    ],
)
def test_what_cannot_be_read(folder: Path, file: str, options: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        read_volume(str(folder / file), ReadOptions(**options))


def test_the_only_grid_needs_no_name(folder: Path) -> None:
    refused(UsageError, "grid 'velocity' has 3 components", read_volume, str(folder / "version223.vdb"))
    volume = read_volume(str(folder / "version223.vdb"), ReadOptions(component="magnitude", spacing=(2, 3, 4)))
    assert (volume.name, volume.spacing, volume.data.dtype) == ("version223", (2, 3, 4), np.float32)


@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (8, struct.pack("<I", 221), "format version 221; expected 222 to 225"),
        (20, b"\0", "written as an OpenVDB stream"),
        (0, b"x", "named like a OpenVDB file, but its content is of no known format"),
    ],
)
def test_damaged_headers(folder: Path, tmp_path: Path, at: int, value: bytes, message: str) -> None:
    data = bytearray((folder / "version222.vdb").read_bytes())
    data[at : at + len(value)] = value
    (tmp_path / "v.vdb").write_bytes(data)
    refused(DataError, message, read_volume, str(tmp_path / "v.vdb"), ReadOptions(array="float"))


def test_version_225_adds_a_type_of_grid_only(folder: Path, tmp_path: Path) -> None:
    data = bytearray((folder / "sphere.vdb").read_bytes())
    data[8:12] = struct.pack("<I", 225)
    (tmp_path / "v.vdb").write_bytes(data)
    found, known = (
        read_volume(str(path), ReadOptions(array="fog")) for path in (tmp_path / "v.vdb", folder / "sphere.vdb")
    )
    np.testing.assert_array_equal(np.asarray(found.data), np.asarray(known.data))


def packed(data: bytes) -> Cursor:
    return Cursor(memoryview(struct.pack("<q", len(data)) + data), "v.vdb")


def test_a_bomb_is_not_unpacked() -> None:
    with pytest.raises(DataError, match="holds 2049 bytes where 2048 are expected"):
        codec.read_block(packed(zlib.compress(bytes(1 << 24))), 2048, codec.ZIP)
    refused(DataError, "damaged ZIP", codec.read_block, packed(b"nonsense"), 2048, codec.ZIP)


def test_nanovdb_says_how_to_convert(tmp_path: Path) -> None:
    (tmp_path / "v.nvdb").write_bytes(b"NanoVDB2" + bytes(100))
    refused(DataError, r"nanovdb_convert v\.nvdb v\.vdb", read_volume, str(tmp_path / "v.nvdb"))


def test_a_grid_by_name_on_the_command_line(vvgt, folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "sphere.vdb", tmp_path)
    assert b'"float32"' in vvgt.ok("info", tmp_path / "sphere.vdb", "--grid", "surface", "--json").out
    told = vvgt.ok("info", tmp_path / "sphere.vdb")
    assert b"--grid surface, dims 41 41 41, dtype float32, range -3 3" in told.out
    assert b"--grid fog, dims 35 35 35" in told.out
    assert "fog (float)" in vvgt("init", tmp_path / "sphere.vdb", "-o", tmp_path / "a.ply").error


@pytest.mark.parametrize("peak", [1.0, 60.0])
def test_density_is_taken_of_several_grids_and_shown_as_smoke(tmp_path: Path, peak: float) -> None:
    grids = plume(24, peak)
    path = str(vdb(tmp_path / "a.vdb", grids))
    with pytest.warns(UserWarning, match=r"grid density; --grid, or a --layer with array=, takes another: flame"):
        volume = read_volume(path, ReadOptions())
    assert (volume.quantity, volume.preset) == ("density", "smoke")
    numbers = statistics(volume)
    shown = from_histogram(numbers, preset=volume.preset)
    assert shown.name == "automatic (smoke)"
    assert shown.lighting is not None
    tau = -np.log1p(-shown.opacity(np.array([0, 0.1, 0.2, 0.4]) * peak))
    np.testing.assert_allclose(tau[1:] / tau[1], [1, 2, 4], rtol=0.03)  # proportional to the density
    assert tau[0] == 0
    depth = 256 * tau[1] / (0.1 * peak) * np.asarray(volume.data).max(axis=None) * 0.4
    assert 1 < depth < 20  # of a ray that crosses much of the densest smoke
    assert read_volume(path, ReadOptions(array="flame")).preset == "fire"
    assert fitting(numbers, volume) == "smoke"


def test_smoke_of_nothing_is_shown_by_its_histogram(tmp_path: Path) -> None:
    values = -plume(16)["density"]
    volume = read_volume(str(vdb(tmp_path / "a.vdb", {"density": values})), ReadOptions())
    assert from_histogram(statistics(volume), preset=volume.preset).name == "automatic (histogram)"


def test_smoke_and_fire_are_two_layers(tmp_path: Path, vvgt) -> None:
    path = vdb(tmp_path / "a.vdb", plume(16))
    vdb(tmp_path / "b.vdb", {name: values for name, values in plume(16).items() if name == "flame"})
    few = ("--max-gaussians", 100, "--screen", 32, "--steps", 0)
    with pytest.warns(UserWarning, match="grid density"):
        made = vvgt("convert", path, "--layer", f"{path},array=flame", *few, "-o", tmp_path / "a.ply")
    assert made.code == 0, made.err
    assert "automatic (smoke)) + a (automatic (fire))" in made.err
    assert "automatic (fire)" in vvgt("convert", tmp_path / "b.vdb", *few, "-o", tmp_path / "b.ply").err
