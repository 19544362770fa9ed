"""`vvgt tf suggest`: each function shows its range of values, none hides everything, and all look different."""

from itertools import pairwise

import numpy as np
import pytest
from vtkmodules.vtkCommonCore import vtkMath

from vvgt_cli.cameras import default_views
from vvgt_cli.dvr import RenderSettings, render_view
from vvgt_cli.errors import DataError
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.look import read_transfer_function
from vvgt_cli.look.suggest import suggest
from vvgt_cli.volume import Volume, statistics


def of(values, count=10, voxels=64.0):
    numbers = statistics(Volume(np.asarray(values).reshape(-1, 1, 1)))
    return numbers, suggest(numbers, count, voxels, 0.5)


rng = np.random.default_rng(0)
DATA = {
    "turbulence": rng.normal(5.0, 2.0, 50_000),
    "air and tissue": np.concatenate([rng.normal(0.02, 0.002, 40_000), rng.uniform(0.2, 1.0, 10_000)]),
    "signed around zero": np.concatenate(
        [np.zeros(30_000), rng.uniform(0.2, 1, 5_000), -rng.uniform(0.2, 1, 5_000)]
    ),
    "labels": rng.choice(np.arange(30, dtype=np.uint8), 50_000, p=np.r_[0.7, np.full(29, 0.3 / 29)]),
    "two values": rng.choice(np.array([0, 255], np.uint8), 50_000),
    "an outlier": np.concatenate([rng.normal(0, 1, 50_000), [1e6]]),
}  # fmt: skip


@pytest.mark.parametrize("name", DATA)
@pytest.mark.parametrize("count", [1, 2, 10, 37])
def test_every_function_shows_some_voxels_and_none_is_a_wall(name, count):
    values = DATA[name].astype(np.float64)
    _, found = of(DATA[name], count)
    assert len(found) == count
    for function in found:
        opacity = np.interp(values, function.x, function.opacity)
        assert (np.diff(function.x) > 0).all()
        assert 0 < opacity.max() <= 0.5
        depth = -np.log1p(-opacity).mean() * 64  # of a ray through the volume, on average
        assert 0 < depth < 8
        assert 0 < function.share <= 1


@pytest.mark.parametrize(("name", "hidden"), [("air and tissue", 0.02), ("signed around zero", 0.0), ("labels", 0.0)])
def test_background_is_left_out(name, hidden):
    _, found = of(DATA[name])
    assert max(float(np.interp(hidden, f.x, f.opacity)) for f in found) < 0.01


def test_bands_follow_each_other_and_cover_what_is_there():
    numbers, found = of(DATA["turbulence"], 8)
    starts = [function.x[0] for function in found]
    assert starts == sorted(starts)
    for before, after in pairwise(found):
        assert before.x[-1] > after.x[0]  # ramps meet
        assert before.x[2] < after.x[1]  # plateaus do not
    assert sum(function.share for function in found) == pytest.approx(1, abs=1e-12)
    for end, node in ((numbers.lo, 0), (numbers.hi, -1)):  # solid up to the ends of the data
        function = found[node]
        assert np.interp(end, function.x, function.opacity) == function.opacity.max()


@pytest.mark.parametrize("count", [2, 10, 20])
def test_colours_are_told_apart(count):
    _, found = of(DATA["turbulence"], count)
    middle = np.zeros((count, 3))
    for function, lab in zip(found, middle, strict=True):
        vtkMath.RGBToLab(function.rgb[1:3].mean(axis=0), lab)
    apart = np.linalg.norm(middle[:, None] - middle, axis=-1)[~np.eye(count, dtype=bool)]
    assert apart.min() > 100 / count  # a just noticeable difference is about 2
    assert (middle[:, 0] > 40).all()  # visible on black


def test_files_are_functions_and_the_same_ones_again(vvgt, tmp_path):
    paths = vvgt.ok("tf", "suggest", "example:marschner-lobb:24", "-n", 3, "-o", tmp_path / "a").out.decode().split()
    assert paths == [str(tmp_path / "a" / f"band_{k}.json") for k in (1, 2, 3)]
    vvgt("tf", "suggest", "example:marschner-lobb:24", "-n", 3, "-o", tmp_path / "b")
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
    function = read_transfer_function(paths[0])
    assert function.name.startswith("band 1 of 3")
    assert function.opacity_unit_distance == pytest.approx(2 / 24)
    numbers = statistics(load(SourceRequest("example:marschner-lobb:24")).volume)
    wanted = suggest(numbers, 3, 24.0, function.opacity_unit_distance)[0]
    np.testing.assert_array_equal(function.opacity_nodes.x, wanted.x)
    np.testing.assert_array_equal(function.opacity_nodes.y, wanted.opacity)


@pytest.mark.parametrize("volume", ["example:marschner-lobb:32", "example:random:32", "example:blob:32"])
def test_pictures_are_neither_empty_nor_a_silhouette(vvgt, tmp_path, volume):
    vvgt.ok("tf", "suggest", volume, "-n", 4, "-o", tmp_path / "a")
    camera = default_views("test", size=48)[4]
    for path in (tmp_path / "a").iterdir():
        scene = load(SourceRequest(volume, tf=str(path))).scene()
        alpha = render_view(scene, camera, RenderSettings(samples=1))[..., 3]
        assert alpha.mean() > 0.01, path.name
        assert (alpha[alpha > 0.01] > 0.99).mean() < 0.8, path.name


def test_what_cannot_be_suggested(vvgt, tmp_path):
    numbers = statistics(Volume(np.full((2, 2, 2), 7.0)))
    with pytest.raises(DataError, match="every value of the data is 7"):
        suggest(numbers, 3, 2.0, 1.0)
    call = ("tf", "suggest", "example:blob:8", "-o", tmp_path / "a", "-n", 2)
    vvgt.ok(*call)
    (tmp_path / "a" / "band_1.json").write_text("mine")
    assert "--overwrite" in vvgt.fails(2, *call)
    assert (tmp_path / "a" / "band_1.json").read_text() == "mine"
    vvgt.ok(*call, "--overwrite")
    assert (tmp_path / "a" / "band_1.json").read_text() != "mine"
    assert "no directory" in vvgt("tf", "suggest", "example:blob:8", "-o", tmp_path / "b" / "c").error
    assert "is a file" in vvgt("tf", "suggest", "example:blob:8", "-o", tmp_path / "a" / "band_1.json").error
    assert vvgt("tf", "suggest", "example:blob:8", "-n", 0, "-o", tmp_path / "d").code == 2
