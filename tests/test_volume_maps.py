"""Density maps: MRC against mrcfile, cube and OpenDX against numpy; place, types, byte orders, stacks, damage."""

import bz2
import gzip
import tracemalloc
import warnings
from collections.abc import Callable
from itertools import permutations
from pathlib import Path

import mrcfile
import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError, SeveralSteps, UsageError
from vvgt_cli.volume import ReadOptions, Volume, blocks, read_volume
from vvgt_cli.volume.maps.text import BOHR

VALUES = np.random.default_rng(5).integers(0, 100, (3, 4, 5))  # z, y, x


def save(path: Path, values: np.ndarray, **words: object) -> str:
    """What mrcfile writes, with words of the header set."""
    with mrcfile.new(path, values) as file:
        file.voxel_size = (1.5, 2.0, 2.5)
        for name, value in words.items():
            setattr(file.header, name, value)
    return str(path)


def place(volume: Volume, z: int, y: int, x: int) -> np.ndarray:
    """World position of a voxel of the array."""
    return (volume.affine @ [x, y, z, 1])[:3]


@pytest.mark.parametrize(("code", "mode"), [("i1", 0), ("i2", 1), ("f4", 2), ("u2", 6), ("f2", 12)])
@pytest.mark.parametrize("order", ["<", ">"])
def test_mrc_modes_and_byte_orders(tmp_path: Path, code: str, mode: int, order: str) -> None:
    source = save(tmp_path / "v.mrc", VALUES.astype(order + code))
    volume = read_volume(source)
    with mrcfile.open(source) as file:
        assert file.header.mode == mode
        np.testing.assert_array_equal(volume.data, file.data)
    assert isinstance(volume.data, np.memmap)
    assert volume.data.dtype == np.dtype(order + code)
    assert volume.spacing == (1.5, 2.0, 2.5)
    assert (volume.preset, volume.space) == ("density", None)


def test_mrc_bytes_of_imod_are_unsigned_where_it_says_so(tmp_path: Path) -> None:
    source = Path(save(tmp_path / "v.mrc", VALUES.astype("i1")))
    content = bytearray(source.read_bytes())
    content[152:160] = np.array([1146047817, 0], "<i4").tobytes()
    source.write_bytes(content)
    assert read_volume(str(source)).data.dtype == np.uint8
    content[156] = 1
    source.write_bytes(content)
    assert read_volume(str(source)).data.dtype == np.int8


@pytest.mark.parametrize("axes", list(permutations((1, 2, 3))))
def test_mrc_axes_lie_as_mapc_mapr_and_maps_say(tmp_path: Path, axes: tuple[int, int, int]) -> None:
    """Columns, rows and sections start at NXSTART, NYSTART, NZSTART, and run along x, y and z of the cell."""
    start = (7, -2, 4)  # of columns, rows, sections
    words = dict(zip(("mapc", "mapr", "maps", "nxstart", "nystart", "nzstart"), (*axes, *start), strict=True))
    counts = {axis: n for axis, n in zip(axes, (5, 4, 3), strict=True)}
    cell = {name: counts[k] * step for k, (name, step) in enumerate(zip("xyz", (1.5, 2.0, 2.5), strict=True), 1)}
    source = save(tmp_path / "v.map", VALUES.astype("f4"), **words, mx=counts[1], my=counts[2], mz=counts[3])
    with mrcfile.mmap(source, "r+") as file:
        file.header.cella = tuple(cell.values())
    volume = read_volume(source)
    for z, y, x in ((0, 0, 0), (2, 1, 4)):
        along = dict(zip(axes, (x + start[0], y + start[1], z + start[2]), strict=True))
        expected = [along[k] * step for k, step in zip((1, 2, 3), (1.5, 2.0, 2.5), strict=True)]
        np.testing.assert_allclose(place(volume, z, y, x), expected, atol=1e-5)
    np.testing.assert_array_equal(volume.data, VALUES)


def test_mrc_origin_wins_over_the_start(tmp_path: Path) -> None:
    source = save(tmp_path / "v.mrc", VALUES.astype("f4"), origin=(10.5, -20.25, 3.0), nxstart=5)
    np.testing.assert_allclose(read_volume(source).origin, (10.5, -20.25, 3.0))


def test_mrc_cells_may_be_skewed(tmp_path: Path) -> None:
    """A hexagonal cell: b lies 120 degrees from a."""
    volume = read_volume(save(tmp_path / "v.map", VALUES.astype("f4"), cellb=(90, 90, 120)))
    expected = np.array([1.5 * 2 + 2.0 * 3 * np.cos(2 * np.pi / 3), 2.0 * 3 * np.sin(2 * np.pi / 3), 2.5])
    np.testing.assert_allclose(place(volume, 1, 3, 2), expected, atol=1e-5)
    assert volume.sheared


def test_mrc_without_a_cell_has_steps_of_1(tmp_path: Path) -> None:
    source = save(tmp_path / "v.mrc", VALUES.astype("f4"), cella=(0, 0, 0))
    with pytest.warns(UserWarning, match=r"no cell; .*1 angstrom wide \(--spacing"):
        assert read_volume(source).spacing == (1, 1, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_volume(source, ReadOptions(spacing=(2, 2, 3))).spacing == (2, 2, 3)
        read_volume(save(tmp_path / "w.mrc", VALUES.astype("f4")))


@pytest.mark.parametrize(("suffix", "pack"), [(".mrc.gz", gzip.compress), (".map.bz2", bz2.compress)])
def test_mrc_packed(tmp_path: Path, suffix: str, pack: Callable[[bytes], bytes]) -> None:
    plain = Path(save(tmp_path / "v.mrc", VALUES.astype("f4")))
    packed = tmp_path / f"w{suffix}"
    packed.write_bytes(pack(plain.read_bytes()))
    for how in (ReadOptions(), ReadOptions(packed=True)):
        np.testing.assert_array_equal(read_volume(str(packed), how).data[:], VALUES)
    packed.write_bytes(pack(plain.read_bytes()[:-8]))
    refused(DataError, "its header declares", read_volume, str(packed))


def test_mrc_stack_of_volumes_is_a_series(tmp_path: Path) -> None:
    path = tmp_path / "v.mrc"
    stack = np.stack([VALUES, VALUES + 1]).astype("f4")
    with mrcfile.new(path, stack) as file:
        assert file.is_volume_stack()
    with pytest.raises(SeveralSteps) as found:
        read_volume(str(path))
    assert found.value.steps == 2
    np.testing.assert_array_equal(read_volume(str(path), ReadOptions(time=1)).data, VALUES + 1)
    refused(UsageError, "0 to 1", read_volume, str(path), ReadOptions(time=2))


def test_mrc_extended_header_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "v.mrc"
    with mrcfile.new(path, VALUES.astype("i2")) as file:
        file.set_extended_header(np.arange(30, dtype="i4"))
    np.testing.assert_array_equal(read_volume(str(path)).data, VALUES)


CUBE = "a comment\nanother\n{atoms}  -2.0 1.0 0.5{nval}\n {n[0]} 0.5 0 0\n {n[1]} 0 0.25 0\n {n[2]} 0 0.1 1\n"
ATOMS = "  8   8.0   0.0   0.0   0.2\n  1   1.0   0.0   1.4  -0.9\n"
GRID = np.random.default_rng(6).standard_normal((3, 4, 5, 2)).astype("f4")  # along x, y, z; two values


def text(values: np.ndarray) -> str:
    """Rows of up to six values, as programs write them; a row's end after each run along z."""
    runs = values.reshape(values.shape[0] * values.shape[1], -1)
    return "".join("".join(f" {v:.7E}" + "\n" * (k % 6 == 5) for k, v in enumerate(run)) + "\n" for run in runs)


@pytest.mark.parametrize(("sign", "unit"), [(1, BOHR), (-1, 1.0)])
def test_cube(tmp_path: Path, sign: int, unit: float) -> None:
    head = CUBE.format(atoms=2, nval="", n=[3 * sign, 4 * sign, 5 * sign])
    (tmp_path / "v.cube").write_text(head + ATOMS + text(GRID[..., 0]))
    volume = read_volume(str(tmp_path / "v.cube"))
    for i, j, k in ((0, 0, 0), (2, 1, 3)):
        assert volume.data[i, j, k] == pytest.approx(GRID[i, j, k, 0], rel=1e-6)
        expected = unit * np.array([-2 + 0.5 * i, 1 + 0.25 * j + 0.1 * k, 0.5 + k])
        np.testing.assert_allclose(place(volume, i, j, k), expected, atol=1e-6)
    assert (volume.preset, volume.unit) == ("density", "angstrom")


def test_text_takes_the_memory_of_its_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the text nor the numbers are held twice; what does not fit is refused, with a way out."""
    n = 48
    head = CUBE.format(atoms=0, nval="", n=[n] * 3)
    path = tmp_path / "v.cube"
    path.write_text(head + text(np.random.default_rng(1).random((n, n, n))))
    monkeypatch.setattr(blocks, "_CHUNK", 1 << 13)
    tracemalloc.start()
    volume = read_volume(str(path))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert volume.data.nbytes == 4 * n**3 < peak < 1.5 * volume.data.nbytes
    monkeypatch.setattr(blocks, "free_memory", lambda: 4 * n**3 - 1)
    with pytest.raises(DataError, match=r"needs 442368 bytes of memory, .*convert it to a format of plain numbers"):
        read_volume(str(path))


@pytest.mark.parametrize("orbitals", [True, False])
def test_cube_of_several_values(tmp_path: Path, orbitals: bool) -> None:
    head = CUBE.format(atoms=-2 if orbitals else 2, nval="" if orbitals else " 2", n=[3, 4, 5])
    path = tmp_path / "v.cube"
    path.write_text(head + ATOMS + ("  2  21\n  22\n" if orbitals else "") + text(GRID))
    refused(UsageError, "orbitals 21, 22" if orbitals else "2 components", read_volume, str(path))
    for k in (0, 1):
        np.testing.assert_allclose(read_volume(str(path), ReadOptions(component=k)).data, GRID[..., k], rtol=1e-6)


DX = (
    "# from APBS\nobject 1 class gridpositions counts 3 4 5\norigin -2.0 1.0 0.5\ndelta 0.5 0 0\ndelta 0 0.25 0\n"
    "delta 0 0.1 1\nobject 2 class gridconnections counts 3 4 5\nobject 3 class array type {kind} rank 0 items 60 "
    "{form}data follows\n"
)
END = '\nattribute "dep" string "positions"\nobject "regular positions regular connections" class field\n'


@pytest.mark.parametrize("form", ["", "lsb ", "msb "])
def test_dx(tmp_path: Path, form: str) -> None:
    values = GRID[..., 0]
    kind = {"": "double", "lsb ": "float", "msb ": "float"}[form]
    body = text(values).encode() if not form else values.astype("<f4" if form == "lsb " else ">f4").tobytes()
    (tmp_path / "v.dx").write_bytes(DX.format(kind=kind, form=form).encode() + body + END.encode())
    volume = read_volume(str(tmp_path / "v.dx"))
    np.testing.assert_allclose(volume.data, values, rtol=1e-6)
    np.testing.assert_allclose(place(volume, 2, 1, 3), [-1, 1.55, 3.5], atol=1e-6)
    assert (volume.preset, volume.unit) == ("density", "angstrom")


def test_dx_as_another_library_writes_it(tmp_path: Path) -> None:
    grids = pytest.importorskip("gridData")
    grids.Grid(GRID[..., 0], origin=[1, 2, 3], delta=[0.5, 1, 2]).export(str(tmp_path / "v.dx"))
    volume = read_volume(str(tmp_path / "v.dx"))
    np.testing.assert_allclose(volume.data, GRID[..., 0], rtol=1e-5)
    np.testing.assert_allclose(place(volume, 2, 3, 4), [2, 5, 11], atol=1e-4)
