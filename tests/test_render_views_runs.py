"""`vvgt render-views`, run by run: resumed, refused, started afresh, and in parts."""

import json
import shutil

import pytest

from tests.processes import replaced
from tests.view_sets import BASE, SMALL, TF, VOLUME, make_views
from vvgt_cli import dvr
from vvgt_cli.conversion.manifest import read_run_manifest
from vvgt_cli.errors import DataError
from vvgt_cli.jit.ahead import RAYCAST
from vvgt_cli.score.record import Run


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A finished folder; read only."""
    return make_views(tmp_path_factory)


@pytest.fixture
def copied(made, tmp_path):
    return shutil.copytree(made, tmp_path / "views")


def stamps(folder):
    return {path.relative_to(folder): path.stat().st_mtime_ns for path in folder.rglob("*.*") if path.is_file()}


def test_the_same_command_renders_nothing_again(vvgt, copied):
    before = stamps(copied)
    assert "5 views, 0 to render here" in vvgt.ok(*BASE, "-o", copied).err
    assert stamps(copied) == before


def test_a_missing_and_a_cut_and_a_changed_file_are_made_again(vvgt, copied, made):
    before = stamps(copied)
    (copied / "train" / "train_000.exr").unlink()
    cut, changed = copied / "test" / "test_001.png", copied / "images" / "train_002.png"
    cut.write_bytes(cut.read_bytes()[:-20])
    changed.write_bytes(changed.read_bytes()[:-1] + b"x")
    (copied / "transforms_test.json").write_text("{}")
    assert "3 to render here" in vvgt(*BASE, "-o", copied).err
    for path in made.rglob("*.*"):
        if path.is_file():
            assert (copied / path.relative_to(made)).read_bytes() == path.read_bytes(), path.name
    after = stamps(copied)
    kept = {path for path, stamp in before.items() if after[path] == stamp}
    assert {"train_001.exr", "test_000.png", "points3d.ply", "transforms.json"} <= {path.name for path in kept}


@pytest.mark.parametrize("stored", [("--format", "png"), ("--format", "exr", "--half")])
def test_a_contact_sheet_made_again_is_the_same(vvgt, tmp_path, stored):
    call = (*BASE, *stored, "--no-points", "-o", tmp_path)
    vvgt.ok(*call)
    sheet = (tmp_path / "contact.png").read_bytes()  # of views in memory
    (tmp_path / "contact.png").unlink()
    vvgt.ok(*call)  # of those on disk
    assert (tmp_path / "contact.png").read_bytes() == sheet


def test_a_run_that_is_killed_goes_on(vvgt, tmp_path, made, monkeypatch):
    drawn, real = [], dvr.render_view

    def dying(scene, camera, settings=None):
        if len(drawn) == 2:
            raise KeyboardInterrupt
        drawn.append(camera.name)
        return real(scene, camera, settings)

    call = (*BASE, "-o", tmp_path / "v")
    monkeypatch.setattr(dvr, "render_view", dying)
    assert vvgt(*call).code == 130
    assert drawn == ["train_000", "train_001"]
    before = stamps(tmp_path / "v")
    assert not any(path.name.startswith(".") for path in before)
    (tmp_path / "v" / "test" / ".test_000.0123abcd.exr").write_text("left by a run that was killed outright")
    monkeypatch.setattr(dvr, "render_view", real)
    assert "3 to render here" in vvgt(*call).err
    after = stamps(tmp_path / "v")
    assert not any(path.name.startswith(".") for path in after)
    assert all(after[path] == stamp for path, stamp in before.items() if path.name != "manifest.json")
    for path in made.rglob("*.exr"):
        assert (tmp_path / "v" / path.relative_to(made)).read_bytes() == path.read_bytes()


def test_a_renderer_that_is_not_there_leaves_nothing(vvgt, tmp_path, monkeypatch):
    from vvgt_cli.dvr import vtk

    def refuse(scene, settings):
        raise DataError("no device here")

    monkeypatch.setattr(vtk, "view_renderer", refuse)
    assert "no device here" in vvgt(*BASE, "--renderer", "vtk", "-o", tmp_path / "v").error
    assert not (tmp_path / "v").exists()


def test_views_that_see_nothing_leave_nothing(vvgt, tmp_path):
    tf = '{"points": [{"x": 0.9999, "opacity": 0}, {"x": 1, "opacity": 1e-9, "rgb": [1, 0, 0]}]}'
    (tmp_path / "tf.json").write_text(tf)
    result = vvgt.fails(1, "render-views", VOLUME, "--tf", tmp_path / "tf.json", *SMALL, "-o", tmp_path / "v")
    assert "visible" in result
    assert not (tmp_path / "v").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("--step", 0.25), "step 0.5 there, 0.25 here"),
        (("--tf", "magma"), "another transfer function"),
        (("--views", 4), "views 3 there, 4 here, other cameras"),
        (("--background", 0, 0, 0), "background 1.0 0.0 0.5 there, 0.0 0.0 0.0 here"),
        (("--spacing", 1, 1, 2), "another volume"),
    ],
)
def test_another_run_is_refused_and_told_what_differs(vvgt, made, change, message):
    before = stamps(made)
    base = ["render-views", VOLUME, *SMALL, "--background", 1, 0, 0.5]
    result = vvgt.fails(2, *replaced([*base, "--tf", TF], *change), "-o", made)
    assert message in result
    assert "--overwrite" in result
    assert stamps(made) == before


def test_overwrite_starts_afresh_and_leaves_what_is_not_ours(vvgt, copied):
    (copied / "notes.txt").write_text("mine")
    vvgt.ok("render-views", VOLUME, "--tf", TF, "--views 2 --test-views 0 --size 20 --overwrite -o", copied)
    assert sorted(path.name for path in (copied / "train").iterdir()) == [
        f"train_00{i}.{suffix}" for i in range(2) for suffix in ("exr", "png")
    ]
    assert not (copied / "transforms_test.json").exists()
    assert not (copied / "test").exists()
    assert (copied / "notes.txt").read_text() == "mine"


def test_files_that_no_manifest_knows_are_not_replaced(vvgt, tmp_path):
    (tmp_path / "v").mkdir()
    (tmp_path / "v" / "transforms.json").write_text("mine")
    assert "transforms.json exists, and no manifest" in vvgt.fails(2, *BASE, "-o", tmp_path / "v")
    assert [path.name for path in (tmp_path / "v").iterdir()] == ["transforms.json"]
    for text in ("{", "[]", '{"format": "other"}', '{"files": {"../x": {"bytes": 1, "sha256": ""}}}'):
        (tmp_path / "v" / "manifest.json").write_text(text)
        assert "not a manifest" in vvgt.fails(1, *BASE, "-o", tmp_path / "v")
    assert (tmp_path / "v" / "transforms.json").read_text() == "mine"


def test_a_manifest_that_names_files_outside_is_refused(tmp_path):
    entry = {"bytes": 4, "sha256": "0"}
    for name in ("../x", "/x", "a/../../x"):
        path = tmp_path / "manifest.json"
        path.write_text(
            json.dumps({"format": "vvgt-views", "schema": 1, "hash": "", "settings": {}, "files": {name: entry}})
        )
        with pytest.raises(DataError, match="not a manifest"):
            read_run_manifest(path)


def test_shards_together_are_the_whole(vvgt, tmp_path, made):
    folder = tmp_path / "v"
    call = (*BASE, "-o", folder)
    rendered = []
    for i in (3, 1, 2):
        vvgt.ok(*call, "--shard", f"{i}/3")
        rendered.append(len(list(folder.rglob("*.exr"))))
        assert (folder / "contact.png").exists() == (i == 2)  # whoever finds every view
        assert (folder / "transforms.json").exists() == (i != 3)  # the first part describes the set
    assert rendered == [1, 3, 5]
    for path in made.rglob("*.*"):
        if path.is_file() and path.name != "manifest.json":
            assert (folder / path.relative_to(made)).read_bytes() == path.read_bytes(), path.name
    assert sorted(path.name for path in folder.glob("manifest*")) == [f"manifest-{i}-of-3.json" for i in (1, 2, 3)]
    before = stamps(folder)
    assert "5 views, 0 to render here" in vvgt(*call).err
    after = stamps(folder)
    assert {path: after[path] for path in before} == before
    assert "another" in vvgt("render-views", VOLUME, "--tf", "magma", *SMALL, "-o", folder, "--shard", "1/3").error


def test_no_points_leaves_out_the_cloud_and_nothing_else(vvgt, tmp_path, made, monkeypatch):
    folder, compiled = tmp_path / "views", []
    monkeypatch.setattr(Run, "compile", lambda self, kernels, volume=None: compiled.append(kernels))
    vvgt.ok(*BASE, "--no-points", "-o", folder)
    assert compiled == [RAYCAST]
    names = {path.relative_to(made) for path in made.rglob("*.*") if path.is_file()}
    found = {path.relative_to(folder) for path in folder.rglob("*.*") if path.is_file()}
    assert {path.name for path in names - found} == {"points3d.ply"}
    assert found <= names
    points = next(folder.rglob("points3D.bin")).read_bytes()
    assert points == bytes(8)  # their number
    assert next(made.rglob("points3D.bin")).stat().st_size > 8
    for path in found:
        if path.suffix in (".png", ".exr"):
            assert (folder / path).read_bytes() == (made / path).read_bytes(), path
