"""`vvgt check` of files of Gaussians, whatever wrote them: what is found in good ones and in damaged ones."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.random_clouds import random_cloud
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.checks import run_case
from vvgt_cli.checks.splats import is_mirror, order_cases, orientation_cameras, orientations, place_cases, value_cases
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.formats import read_columns
from vvgt_cli.gaussians.formats.splats import ply_bytes
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.splat import render

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
from damaged import broken_rows, plain_opacities
from damaged import mirrored as mirror_image

POINTS = [{"x": 20, "opacity": 0, "rgb": [1, 0, 0]}, {"x": 220, "opacity": 0.2, "rgb": [1, 1, 0.5]}]
EDGE = 24  # voxels


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A volume that looks the same from nowhere else, its function, and a conversion."""
    from vvgt_cli.commands.main import run

    made = tmp_path_factory.mktemp("splats")
    z, y, x = np.indices((EDGE,) * 3)
    blobs = [((6, 8, 9), 3.5), ((17, 8, 9), 2.5), ((17, 16, 14), 2.0), ((9, 15, 5), 2.0)]
    data = sum(np.exp(-((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) / (2 * s * s)) for (a, b, c), s in blobs)
    np.save(made / "blobs.npy", np.clip(255 * data, 0, 255).astype(np.uint8))
    (made / "tf.json").write_text(json.dumps({"points": POINTS}))
    look = ["--tf", str(made / "tf.json"), "--screen", "128", "--max-gaussians", "2000", "--steps", "8"]
    assert run(["convert", str(made / "blobs.npy"), *look, "-o", str(made / "good.ply"), "--quiet"]) == 0
    return made


@pytest.fixture
def made(folder):
    return folder / "good.ply"


@pytest.fixture
def scene(folder):
    """What goes with a file: its volume and function."""
    return "--volume", folder / "blobs.npy", "--tf", folder / "tf.json"


def failed(vvgt, path, *more):
    result = vvgt("check", path, *more, "--json")
    document = json.loads(result.out)
    names = {f"{o['stage']}: {o['name']}": o for o in document["outcomes"] if not o["passed"]}
    assert result.code == (1 if names else 0), result.err
    return names, document


def test_a_conversion_passes_with_and_without_its_volume(vvgt, made, scene):
    names, document = failed(vvgt, made, *scene)
    assert names == {}
    assert {o["stage"] for o in document["outcomes"]} == {"file", "values", "place", "pictures", "order"}
    assert document["splats"]["file"] == "good.ply"
    assert document["splats"]["size"] == 128
    assert document["volume"]["dims"] == [EDGE] * 3
    assert document["stiffness"] is None
    names, document = failed(vvgt, made)
    assert names == {}
    assert {o["stage"] for o in document["outcomes"]} == {"file", "values", "order"}


def test_light_without_a_volume_is_refused(vvgt, made):
    for line, text in ((("--light", "headlight"), "--light"), ((made, "--specular-power", 5), "--specular-power")):
        found = vvgt("check", *line)
        assert (found.code, found.error.startswith(f"vvgt: error: {text}: only with a volume")) == (2, True), (
            found.error
        )


@pytest.mark.parametrize("ending", [".spz", ".glb", ".compressed.ply"])
def test_other_formats_are_checked_like_a_ply(vvgt, made, scene, tmp_path, ending):
    from vvgt_cli.conversion.gaussian_files import layout_of, open_gaussians
    from vvgt_cli.gaussians.formats import encoded, format_of

    gaussians, header = open_gaussians(str(made))
    path = tmp_path / f"other{ending}"
    path.write_bytes(encoded(format_of(path), gaussians, layout_of(header), str(path)))
    names, document = failed(vvgt, path, *scene)
    assert names == {}
    assert len(document["outcomes"]) > 20


def damaged(made, folder, change):
    path = folder / "damaged.ply"
    path.write_bytes(ply_bytes(change(read_columns(made))))
    return path


def test_rows_without_numbers_and_giants_are_counted_and_the_rest_is_looked_at(vvgt, made, scene, tmp_path):
    names, document = failed(vvgt, damaged(made, tmp_path, broken_rows), *scene)
    assert names["file: centres that are not finite"]["value"] == 100
    assert names["values: largest sigma"]["value"] == pytest.approx(np.exp(3) / 2, rel=1e-3)
    assert any(name.startswith("pictures: over black") for name in names)
    assert "file: sizes that are not finite" not in names
    assert document["splats"]["gaussians"] == len(read_columns(made))
    alone, _ = failed(vvgt, damaged(made, tmp_path, broken_rows))
    assert set(alone) >= {"file: centres that are not finite", "values: largest sigma"}


def test_opacities_where_logits_are_expected_show_in_the_pictures(vvgt, made, scene, tmp_path):
    names, _ = failed(vvgt, damaged(made, tmp_path, plain_opacities), *scene)
    assert any(name.startswith("pictures: alpha") for name in names)
    assert not any(name.startswith(("file", "place")) for name in names)


def lopsided() -> Gaussians:
    """Gaussians that look the same from nowhere else: a corner, an edge, and what is between."""
    means = np.array([[0.7, 0, 0], [0.7, 0.5, 0], [0.7, 0.5, 0.4], [-0.3, 0.2, -0.6], [0.1, -0.7, 0.3]])
    shape = np.log(np.tile([0.15, 0.1, 0.05], (5, 1)))
    turns = np.random.default_rng(0).normal(size=(5, 4))
    return Gaussians(means, shape, turns, np.full(5, 2.0), np.eye(5, 3) + 0.2)


@pytest.mark.parametrize("name", ["-x y z", "y x z", "z -y -x", "x y -z"])
def test_another_orientation_is_named(name):
    good = lopsided()
    seen = [render(good, camera) for camera in orientation_cameras()]
    matrix = dict(orientations())[name]
    laid = transform(good, np.linalg.inv(matrix))
    turned = run_case(list(place_cases(laid, laid, np.ones(3), seen))[1])
    assert not turned.passed
    assert f"with axes {name}" in turned.what
    assert ("mirror image" in turned.what) == is_mirror(name) == (np.linalg.det(matrix) < 0)
    assert run_case(list(place_cases(good, good, np.ones(3), seen))[1]).value == 0


def test_a_mirrored_file_is_found_by_the_command(vvgt, made, scene, tmp_path):
    names, _ = failed(vvgt, damaged(made, tmp_path, mirror_image), *scene)
    assert "with axes -x y z, a mirror image" in names["place: axes swapped or mirrored"]["what"]


def test_the_check_recognises_world_coordinates_without_a_header(vvgt, made, scene, tmp_path, monkeypatch):
    monkeypatch.setattr("vvgt_cli.commands.check_splats.SIZE", 128)

    def moved(columns):
        return replace(columns, means=columns.means * EDGE / 2 + EDGE / 2 - 0.5,
                       log_scales=columns.log_scales + np.log(EDGE / 2), comments=())  # fmt: skip

    names, _ = failed(vvgt, damaged(made, tmp_path, moved), *scene)
    assert re.search("read as world coordinates", names["place: centres outside the volume's box"]["what"])


def values(gaussians, edge=2.0):
    return {case.name: run_case(case) for case in value_cases(gaussians, edge, 1000)}


def test_extreme_values_are_found_one_by_one():
    plain = random_cloud(200, size=0.02)
    assert all(outcome.passed for outcome in values(plain).values())
    tiny = values(replace(plain, log_scales=np.full((200, 3), -12.0)))
    assert not tiny["sigma below a quarter of a pixel at 1000 px"].passed
    assert not values(replace(plain, opacity_logits=np.full(200, -9.0)))["too faint for viewers to draw"].passed
    assert not values(replace(plain, colors=plain.colors + 3))["colours outside -0.5 to 1.5"].passed
    giant = plain.log_scales.copy()
    giant[7] = 1.0
    assert values(replace(plain, log_scales=giant))["largest sigma"].value == pytest.approx(np.e / 2)
    assert not values(replace(plain, log_scales=giant), None)["largest sigma"].passed


def test_centres_far_from_the_origin_are_too_coarse(vvgt, made, tmp_path):
    def far(columns):
        return replace(columns, means=columns.means + np.float32(5e6), comments=())

    names, _ = failed(vvgt, damaged(made, tmp_path, far))
    assert "file: centres that float32 rounds by a tenth of sigma" in names


def test_order_by_distance_matters_where_large_ones_overlap_at_the_side():
    camera = look_at((0, -3, 0), width=64, height=64, fov=90)
    shape = np.log(np.tile([0.5, 0.5, 0.5], (2, 1)))
    colors = np.array([[1, 0, 0], [0, 1, 0.0]])
    # the second is deeper, but nearer to the eye
    pair = Gaussians(np.array([[1.6, -0.5, 0], [0.6, -0.3, 0]]), shape, np.eye(4)[[0, 0]], np.full(2, 3.0), colors)
    found = {case.name: run_case(case) for case in order_cases(pair, camera)}
    assert not found["sorted by distance, not by depth"].passed
    apart = replace(pair, means=np.array([[1.6, -0.1, 0], [-1.6, 0.1, 0]]), log_scales=shape - 2)
    assert {case.name: run_case(case) for case in order_cases(apart, camera)}["sorted by distance, not by depth"].passed
    assert found["the deepest tile"].value == 2
    assert not {c.name: run_case(c) for c in order_cases(replace(pair, colors=colors * 4), camera)}[
        "the brightest pixel"
    ].passed


def test_wrong_use_and_unreadable_files_are_one_line(vvgt, made, tmp_path):
    assert vvgt("check", "example:blob:16", "--volume", "example:blob:16").code == 2
    assert "--tf" in vvgt("check", made, "--tf", "viridis").error
    cut = tmp_path / "cut.ply"
    cut.write_bytes(made.read_bytes()[:-10])
    assert "truncated" in vvgt.fails(1, "check", cut)
    nothing = damaged(made, tmp_path, lambda columns: replace(columns, means=columns.means * np.nan))
    assert "none with finite values" in vvgt("check", nothing).error
