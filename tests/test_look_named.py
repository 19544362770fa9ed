"""Named functions and contours of densities: what they are over, where they lie on data, in memory and in blocks."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path

import mrcfile
import numpy as np
import pytest

from vvgt_cli.errors import UsageError
from vvgt_cli.field.open import needs_histogram
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.look import from_histogram, read_transfer_function, resolve
from vvgt_cli.look.readers.names import names
from vvgt_cli.look.recognise import foreground, moments
from vvgt_cli.look.suggest import fitting
from vvgt_cli.volume import Volume, statistics
from vvgt_cli.volume.bodies import largest

RANDOM = np.random.default_rng(11)
CT = np.concatenate([RANDOM.normal(-1000, 15, 5000), RANDOM.normal(40, 40, 4000), RANDOM.normal(700, 150, 1000)])
CT = CT.reshape(20, 20, 25).astype(np.float32)


def blob(sign: float = 1.0) -> np.ndarray:
    """Noise of deviation 0.01 about 0.1, with a ball of about 1 in it; ``sign`` -1: another one below it."""
    z, y, x = np.indices((24, 24, 24))
    values = 0.1 + RANDOM.normal(0, 0.01, (24, 24, 24))
    values += np.exp(-(((z - 12) ** 2 + (y - 12) ** 2 + (x - 7) ** 2) / 8))
    return (values + min(sign, 0) * np.exp(-(((z - 12) ** 2 + (y - 12) ** 2 + (x - 17) ** 2) / 8))).astype(np.float32)


def save(path: Path, values: np.ndarray) -> str:
    with mrcfile.new(path, values) as file:
        file.voxel_size = 1.5
    return str(path)


@pytest.mark.parametrize("name", names())
def test_every_name_is_a_function_that_can_be_written_and_read_again(name: str, tmp_path: Path, vvgt) -> None:
    function = read_transfer_function(name)
    assert function.name == name
    assert function.opacity_unit_share == 1 / 256
    assert max(function.opacity_nodes.y) <= 0.5
    assert (function.otherwise is not None) == name.startswith("ct-")
    vvgt.ok("tf", "convert", name, tmp_path / "own.json")
    again = read_transfer_function(str(tmp_path / "own.json"))
    for one, other in ((function, again), (function.otherwise, again.otherwise)):
        if one is not None:
            assert one.domain == other.domain
            x = np.linspace(*one.node_range(), 50)
            np.testing.assert_array_equal(one.opacity(x), other.opacity(x))
            np.testing.assert_array_equal(one.color(x), other.color(x))


def test_the_list_names_them_all(vvgt) -> None:
    lines = vvgt("tf", "list").out.decode().splitlines()
    assert [line.split()[0] for line in lines] == list(names())
    assert all(len(line.split(None, 1)[1]) > 10 for line in lines)
    with pytest.raises(UsageError, match="did you mean ct-bone"):
        read_transfer_function("ct-bones")


@pytest.mark.parametrize("name", [n for n in names() if n.startswith("ct-")])
def test_hounsfield_units_are_taken_as_they_are_and_others_by_percentiles(name: str) -> None:
    function = read_transfer_function(name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(resolve(function, statistics(Volume(CT))).breakpoints(), function.breakpoints())
        crop = statistics(Volume(CT[10:]))  # without air: the file has to say
        np.testing.assert_array_equal(resolve(function, crop, hounsfield=True).breakpoints(), function.breakpoints())
    stored = statistics(Volume((CT + 3000) * 0.25))
    with pytest.warns(
        UserWarning, match=r"values 48.* to 1030.* are not in Hounsfield units; shown by percentiles of the foreground"
    ):
        shown = resolve(function, stored)
    lo, hi = shown.node_range()
    assert 500 < lo < hi <= stored.hi
    assert shown.support(stored.lo, stored.hi)
    np.testing.assert_allclose(resolve(function, stored, (0, 1)).node_range(), (0, 1))


def test_foreground_leaves_air_out_of_percentiles() -> None:
    """The median of what is not air, however much air there is."""
    points = [{"x": x, "rgb": [1, 1, 1], "opacity": x} for x in (0.0, 0.5, 1.0)]
    function = read_transfer_function({"range": "foreground", "points": points})
    for air in (4000, 40000):
        values = np.concatenate([RANDOM.normal(10, 2, air), RANDOM.uniform(100, 300, 5000)])[None, None]
        lo, middle, hi = resolve(function, statistics(Volume(values))).breakpoints()
        assert 10 < lo < 102
        assert middle == pytest.approx(200, abs=8)
        assert hi == pytest.approx(300, abs=1)
    flat = np.full(256, 10.0)
    assert foreground(flat) is flat


@pytest.mark.parametrize("kind", ["f4", "i2", "u1"])
def test_sigma_counts_from_the_mean(kind: str) -> None:
    values = RANDOM.normal(120, 9, 200_000).reshape(20, 100, 100).astype(kind)
    numbers = statistics(Volume(values))
    mean, deviation = moments(numbers.histogram.astype(float), numbers.edges)
    assert mean == pytest.approx(values.mean(dtype=float), abs=0.5)
    assert deviation == pytest.approx(values.std(dtype=float), rel=0.01)
    shown = resolve(read_transfer_function("density-contour"), numbers)
    assert shown.opacity_nodes.x[0] == pytest.approx(mean + 1.5 * deviation)


def test_moments_of_extreme_values_are_finite() -> None:
    numbers = statistics(Volume(np.array([[[-1e308, 0, 1e308]]])))
    found = moments(numbers.histogram.astype(float), numbers.edges)
    assert np.isfinite(found).all()
    assert found[1] == pytest.approx(1e308 * np.sqrt(2 / 3), rel=0.01)


@pytest.mark.parametrize(("sign", "name"), [(1, "density-contour"), (-1, "density-difference")])
def test_densities_are_contoured_when_no_function_is_given(tmp_path: Path, sign: float, name: str) -> None:
    values = blob(sign)
    volume = Volume(values, preset="density")
    numbers = statistics(volume)
    shown = from_histogram(numbers, preset=volume.preset)
    assert shown.name == f"automatic ({name})"
    high, low = values.max(), values.min()
    assert shown.opacity(np.array([0.1])) == 0
    assert shown.opacity(np.array([high])) > 0.2
    assert (shown.opacity(np.array([low])) > 0.2) == (sign < 0)
    assert fitting(numbers, volume) == name
    assert from_histogram(numbers).name == "automatic (histogram)"


def test_a_density_without_anything_above_its_noise_is_shown_by_its_histogram() -> None:
    values = np.full((4, 4, 4), 1.0)
    values[:2] = 0
    assert from_histogram(statistics(Volume(values)), preset="density").name == "automatic (histogram)"


def test_info_names_a_function_that_fits(tmp_path: Path, vvgt) -> None:
    def suggested(source: str) -> str | None:
        return json.loads(vvgt("info", source, "--json").out).get("tf")

    assert suggested(save(tmp_path / "v.mrc", blob())) == "density-contour"
    assert suggested(save(tmp_path / "w.mrc", blob(-1))) == "density-difference"
    np.save(tmp_path / "ct.npy", CT)
    assert suggested(str(tmp_path / "ct.npy")) == "ct-bone"
    np.save(tmp_path / "soft.npy", np.where(CT > 200, 40, CT))
    assert suggested(str(tmp_path / "soft.npy")) == "ct-soft-tissue"
    np.save(tmp_path / "lung.npy", phantom("chest"))
    assert suggested(str(tmp_path / "lung.npy")) == "ct-lung"
    np.save(tmp_path / "any.npy", RANDOM.uniform(0, 1, (5, 6, 7)))
    assert suggested(str(tmp_path / "any.npy")) is None
    assert b"nodes_in" in vvgt("info", "mr-head").out


def phantom(part: str, *, rest: float = -930, noise: float = 12) -> np.ndarray:
    """Hounsfield units on a grid of 4 mm, with blurred edges: a head in its rest, a chest, an abdomen, a bottle."""
    rng = np.random.default_rng(1)
    z, y, x = (4.0 * (np.indices((60, 70, 90)).T - [29.5, 34.5, 44.5])).T
    values = np.full(x.shape, -1000.0)

    def fill(value: float, centre: tuple[float, float, float], radii: tuple[float, float, float]) -> None:
        inside = sum(((a - c) / r) ** 2 for a, c, r in zip((z, y, x), centre, radii, strict=True)) < 1
        values[inside] = value

    if part == "head":
        fill(rest, (0, 20, 0), (400, 115, 105))
        fill(-1000, (0, 20, 0), (400, 100, 90))
        values[(y < 0) & (values == rest)] = -1000
        for value, smaller in ((-90, 0), (20, 4), (1000, 6), (35, 13)):
            fill(value, (0, 0, 0), (100 - smaller, 95 - smaller, 75 - smaller))
        for side in (-35, 0, 35):
            fill(-1000, (-30, -55, side), (25, 22, 14))
    elif part == "water":
        fill(0, (0, 0, 0), (900, 25, 25))
    else:
        for value, radii in ((-95, (900, 115, 165)), (45, (900, 95, 145))):
            fill(value, (0, 0, 0), radii)
        for side in (-72, 72) if part == "chest" else ():
            fill(-840, (0, 5, side), (100, 80, 55))
        for _ in range(12 if part == "abdomen" else 0):
            fill(-1000, tuple(rng.uniform(-60, 60, 3)), (20, 20, 20))
        fill(500, (0, 75, 0), (900, 18, 18))
    for axis in range(3):
        values = (np.roll(values, 1, axis) + 2 * values + np.roll(values, -1, axis)) / 4
    return (values + rng.normal(0, noise, values.shape)).clip(-1024, 3071).astype(np.int16)


@pytest.mark.parametrize(
    ("part", "options", "name"),
    [
        ("head", {}, "ct-bone"),
        ("head", {"rest": -880}, "ct-bone"),
        ("head", {"noise": 60}, "ct-bone"),
        ("chest", {}, "ct-lung"),
        ("chest", {"noise": 60}, "ct-lung"),
        ("abdomen", {}, "ct-bone"),
        ("water", {}, "ct-soft-tissue"),
    ],
)
def test_lungs_are_those_of_a_chest(part: str, options: dict[str, float], name: str) -> None:
    """Not the surfaces and the rest of a head, whose voxels lie between air and tissue too."""
    volume = Volume(phantom(part, **options), hounsfield=True)
    assert fitting(statistics(volume), volume) == name


def engine(rng: np.random.Generator) -> np.ndarray:
    """Two metals in air, 0 to 255."""
    values = np.zeros((60, 70, 90))
    values[8:50, 10:60, 8:80] = 150
    values[15:40, 20:50, 20:70] = 0
    values[20:30, 10:60, 30:40] = 220
    return (values + rng.normal(8, 3, values.shape)).clip(0, 255)


def brain(rng: np.random.Generator) -> np.ndarray:
    """Nested tissues under a coil's slope, with the noise of magnitudes."""
    z, y, x = (np.indices((60, 70, 90)).T - [29.5, 34.5, 44.5]).T
    radius = np.sqrt((z / 26) ** 2 + (y / 31) ** 2 + (x / 36) ** 2)
    values = np.select([radius < 0.5, radius < 0.8, radius < 0.85, radius < 0.95], [230, 170, 30, 330], 0)
    return np.hypot(values * (1 + x / 120) + rng.normal(0, 9, x.shape), rng.normal(0, 9, x.shape))


def cushion(rng: np.random.Generator, shell: float) -> np.ndarray:
    """A ball of tissue, in Hounsfield units, above a slab of foam in a shell."""
    z, y, x = np.indices((60, 70, 90))
    values = np.where((z - 20) ** 2 + (y - 35) ** 2 + (x - 45) ** 2 < 300, 40.0, -1000.0)
    values[41:59, 8:62, 8:82] = shell
    values[42:58, 10:60, 10:80] = -800
    return values + rng.normal(0, 12, values.shape)


def flame(rng: np.random.Generator) -> np.ndarray:
    z, y, x = np.indices((60, 70, 90)) / 45 - 1
    return np.exp(-4 * (x**2 + y**2)) * np.exp(-(z**2)) * 2100


@pytest.mark.parametrize(
    ("make", "kind", "facts", "name"),
    [
        (engine, "u1", {"space": "RAS"}, None),
        (engine, "f4", {"space": "RAS"}, None),
        (engine, "i2", {"modality": "CT"}, None),
        (brain, "i2", {"space": "RAS"}, "mr-head"),
        (brain, "i2", {}, None),  # of no space, of unknown size
        (brain, "i2", {"modality": "MR"}, "mr-head"),
        (brain, "i2", {"modality": "PT", "space": "RAS"}, None),
        (brain, "i2", {"space": "RAS", "spacing": (0.02, 0.02, 0.02)}, None),
        (brain, "u1", {"space": "RAS"}, None),
        (flame, "f4", {}, None),
        (lambda rng: cushion(rng, -800), "i2", {"modality": "CT", "hounsfield": True}, "ct-soft-tissue"),
        (lambda _: 40 - 840 * np.pad(np.ones((8, 8, 8)), 16), "i2", {"hounsfield": True}, "ct-soft-tissue"),  # a bubble
        (lambda rng: cushion(rng, 200), "i2", {"modality": "CT", "hounsfield": True}, "ct-soft-tissue"),
        (lambda rng: phantom("head") + 1024, "i2", {"space": "RAS"}, None),  # stored values
        (lambda rng: phantom("chest") + 1024, "i2", {"space": "RAS"}, None),
        (lambda rng: phantom("head"), "i2", {"space": "RAS"}, "ct-bone"),
        (lambda rng: phantom("head"), "i2", {"modality": "MR"}, "mr-head"),
        (lambda rng: phantom("chest"), "i2", {"space": "RAS"}, "ct-lung"),
    ],
)
def test_a_preset_fits_or_none(make: Callable, kind: str, facts: dict[str, object], name: str | None) -> None:
    values = make(np.random.default_rng(2)).clip(0 if kind == "u1" else None, 255 if kind == "u1" else None)
    volume = Volume(values.astype(kind), **{"spacing": (2.5, 2.5, 2.5), **facts})
    assert fitting(statistics(volume), volume) == name


def test_largest_is_the_body_with_most_voxels() -> None:
    mask = np.zeros((5, 6, 7), bool)
    mask[0, 0, :6] = mask[2:4, 2:4, 2:4] = True
    mask[4, 4, 4] = True  # a corner does not connect
    found = largest(mask)
    assert found.sum() == 8
    assert found[2:4, 2:4, 2:4].all()
    assert not largest(np.zeros((2, 3, 4), bool)).any()


@pytest.mark.parametrize("name", ["density-contour", "ct-bone", "mr-head"])
def test_blocks_count_for_functions_of_the_histogram(name: str) -> None:
    assert needs_histogram(SourceRequest("v.mrc", tf=name))
    assert not needs_histogram(SourceRequest("v.mrc", tf="viridis"))
