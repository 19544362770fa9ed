"""The library: the same as the commands, for files and for what is in memory."""

import doctest
import html
import json
import math
import re
from importlib import import_module
from inspect import signature
from pathlib import Path

import nibabel
import numpy as np
import pytest
import pyvista
import tifffile
import xarray

import vvgt_cli as vvgt
from tests.headers import uncertified
from tests.processes import python
from tests.refused import refused
from vvgt_cli.commands.main import COMMANDS
from vvgt_cli.gaussians.formats.page_file import read_html

ROOT = Path(__file__).parent.parent
TF = {
    "points": [
        {"x": 0.2, "opacity": 0, "rgb": [0.2, 0.3, 0.9]},
        {"x": 0.6, "opacity": 0.4, "rgb": [0.9, 0.8, 0.2]},
        {"x": 1, "opacity": 0.1, "rgb": [1, 0.2, 0.1]},
    ],
    "opacity_unit_distance": 1.5,
}
SPACING = (1.0, 1.5, 2.0)
HOW = {"max_gaussians": 300, "screen": 48, "steps": 6}


@pytest.fixture(scope="module")
def field() -> np.ndarray:
    """(12, 16, 20) float32: a lump with a hollow, that no axis is like another in."""
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in (12, 16, 20)), indexing="ij")
    return (np.exp(-3 * (x**2 + (y - 0.2) ** 2 + 2 * z**2)) * (1 - 0.5 * np.exp(-20 * (x - 0.3) ** 2))).astype("f4")


@pytest.fixture(scope="module")
def converted(field) -> vvgt.Conversion:
    return vvgt.convert(field, TF, **HOW, spacing=SPACING)


def saved(result: vvgt.Result, path: Path) -> bytes:
    result.save(path)
    return uncertified(path)


def test_commands_and_library_leave_the_same_bytes(field, converted, tmp_path):
    from vvgt_cli.commands.main import run

    field.tofile(tmp_path / "a.raw")
    (tmp_path / "tf.json").write_text(json.dumps(TF))
    read = ("--dims", "20", "16", "12", "--dtype", "float32", "--spacing", *map(str, SPACING))
    how = ("--max-gaussians", "300", "--screen", "48", "--steps", "6", "--tf", str(tmp_path / "tf.json"), "-q")
    assert run(["convert", str(tmp_path / "a.raw"), *read, *how, "-o", str(tmp_path / "a.ply")]) == 0
    written = uncertified(tmp_path / "a.ply")
    assert saved(converted, tmp_path / "b.ply") == written
    read = {"dims": (20, 16, 12), "dtype": "float32", "spacing": SPACING}
    path = vvgt.convert(tmp_path / "a.raw", tmp_path / "tf.json", **HOW, **read)
    assert saved(path, tmp_path / "c.ply") == written
    header = written[: written.index(b"end_header")].decode()
    assert "frame world" in saved_world(converted, tmp_path / "w.ply")
    assert "frame unit" in header


def saved_world(result: vvgt.Result, path: Path) -> str:
    result.save(path, frame="world")
    return path.read_bytes().split(b"end_header")[0].decode()


def test_what_is_in_memory_is_read_alike(field, converted, tmp_path):
    grid = pyvista.ImageData(dimensions=field.shape[::-1], spacing=SPACING)
    grid["values"] = field.ravel()
    x, y, z = (np.arange(n) * step for n, step in zip(field.shape[::-1], SPACING, strict=True))
    labelled = xarray.DataArray(field, dims=("z", "y", "x"), coords={"x": x, "y": y, "z": z}, name="values")
    affine = np.diag([*SPACING, 1.0])
    wanted = saved(converted, tmp_path / "array.ply")
    inputs = {"image": (grid, {}), "labelled": (labelled, {}), "affine": (field, {"affine": affine})}
    inputs["turned"] = (labelled.transpose("x", "z", "y")[::-1], {})  # its coordinates say where values are
    inputs["volume"] = (vvgt.read_volume(field, spacing=SPACING), {})
    inputs["pyvista's"] = (grid["values"].reshape(field.shape), {"spacing": SPACING})  # has the methods of VTK's arrays
    for name, (volume, reading) in inputs.items():
        result = vvgt.convert(volume, TF, **HOW, **reading)
        unnamed = saved(result, tmp_path / f"{name}.ply").replace(b'"quantity": "values"', b'"quantity": ""')
        assert unnamed == wanted, name


def test_masked_values_are_nan(field):
    masked = np.ma.masked_greater((field * 255).astype(np.int16), 100)
    read = np.asarray(vvgt.read_volume(masked).data)
    assert np.array_equal(np.isnan(read), masked.mask)
    assert np.array_equal(read[~masked.mask], masked.compressed())
    assert vvgt.read_volume(np.ma.masked_array(np.ones((4, 4, 4), np.uint8))).data.dtype == np.uint8


def test_a_session_reads_once_and_leaves_the_same_bytes(field, tmp_path, monkeypatch):
    session = vvgt.Session(field, spacing=SPACING)
    alone = [saved(vvgt.convert(field, tf, **HOW, spacing=SPACING), tmp_path / f"{tf}.ply") for tf in ("gray", "hot")]
    from vvgt_cli.dvr import bricks

    monkeypatch.setattr(bricks, "brick_ranges", None)  # neither laid out again
    monkeypatch.setattr("vvgt_cli.volume.statistics", None)  # nor counted
    together = [saved(session.convert(tf, **HOW), tmp_path / f"s-{tf}.ply") for tf in ("gray", "hot")]
    assert together == alone
    _, images = vvgt.render_views(session, "gray", views=1, size=32)
    assert images[..., 3].max() > 0
    assert session.volume.spacing == SPACING
    with pytest.raises(vvgt.UsageError, match="spacing: the session's volume is read already"):
        vvgt.convert(session, "gray", spacing=SPACING)


def test_a_session_of_colours_is_its_file_in_blocks_too(field, tmp_path):
    colors = np.stack([field * 255, field * 40, 255 - field * 255], axis=-1).astype(np.uint8)
    tifffile.imwrite(tmp_path / "rgb.tif", colors, photometric="rgb")
    few = HOW | {"max_gaussians": 40, "steps": 0}
    made = [
        saved(vvgt.convert(volume, None, **few, blocks=16), tmp_path / f"{k}.ply")
        for k, volume in enumerate((tmp_path / "rgb.tif", vvgt.Session(tmp_path / "rgb.tif")))
    ]
    assert made[0] == made[1]


def test_an_affine_is_nibabels(field, tmp_path):
    affine = np.array([[0, -1.5, 0, 7], [1, 0, 0, -3], [0, 0, -2, 11], [0, 0, 0, 1.0]])
    image = nibabel.Nifti1Image(field.T, affine)
    nibabel.save(image, tmp_path / "a.nii.gz")
    file = vvgt.read_volume(tmp_path / "a.nii.gz")
    array = vvgt.read_volume(np.asarray(image.dataobj).T, affine=image.affine, space="RAS")
    np.testing.assert_array_equal(file.data, array.data)
    np.testing.assert_allclose(file.affine, array.affine, atol=1e-6)
    assert array.space == file.space == "RAS"


def test_results_are_drawn_scored_and_shown(field, converted):
    assert converted.scores["psnr"] > 25
    assert repr(converted).startswith(f"<Conversion: {len(converted.gaussians)} Gaussians, ")
    assert [stage.name for stage in converted.stages][:3] == ["read", "scene", "closed form"]
    image = converted.render()
    assert image.shape == (48, 48, 4)
    assert image[..., 3].max() > 0.2
    cameras, volume = vvgt.render_views(field, TF, cameras=vvgt.default_views("test", size=48)[4:5], spacing=SPACING)
    assert np.sqrt(np.mean((volume[0] - image) ** 2)) < 0.05
    np.testing.assert_array_equal(converted.render(cameras[0]), image)
    assert converted.preview(32).shape == (3 * 32, 3 * 32, 3)
    assert converted._repr_png_().startswith(b"\x89PNG")
    frame = converted._repr_html_()
    assert re.match(r'<iframe title="volume, [0-9]+ x [0-9]+ x [0-9]+" sandbox="allow-scripts allow-downloads" ', frame)
    page = html.unescape(re.search(r'srcdoc="([^"]*)"></iframe>$', frame)[1]).encode()
    assert len(read_html(page, "page")) == len(converted.gaussians)
    scores = vvgt.evaluate(converted, field, TF, spacing=SPACING, conditions=False, step=0.5)
    ten = [view["psnr"] for view in scores.scores["per_view"]]
    three = [-10 * np.log10(np.mean([10 ** (-ten[n] / 10) for n in (0, 4, 9)])), np.mean([ten[n] for n in (0, 4, 9)])]
    assert min(three) - 0.3 < converted.scores["psnr"] < max(three) + 0.3
    assert scores.size == 48


def test_a_result_is_refined_and_read_again(field, converted, tmp_path):
    from vvgt_cli.commands.main import run

    grid = pyvista.ImageData(dimensions=field.shape[::-1], spacing=SPACING)
    grid["values"] = field.ravel()
    grid.save(tmp_path / "a.vti")
    (tmp_path / "tf.json").write_text(json.dumps(TF))
    where = ["-o", str(tmp_path / "views"), "--tf", str(tmp_path / "tf.json"), "--size", "48", "--views", "8", "-q"]
    assert run(["render-views", str(tmp_path / "a.vti"), *where]) == 0
    better = vvgt.optimize(converted, tmp_path / "views", steps=20)
    assert better.scores["psnr"] > converted.scores["psnr"] - 0.5
    saved(better, tmp_path / "better.ply")
    gaussians, header = vvgt.read_ply(tmp_path / "better.ply")
    np.testing.assert_allclose(gaussians.means, better.gaussians.means, atol=1e-6)
    assert header.screen_size == 48
    converted.save(tmp_path / "start.ply")
    file = vvgt.optimize(tmp_path / "start.ply", tmp_path / "views", steps=20)
    assert saved(file, tmp_path / "file.ply") == (tmp_path / "better.ply").read_bytes()


@pytest.mark.parametrize(
    ("volume", "reading", "words"),
    [
        (np.zeros((4, 4, 4)), {"affine": np.eye(4), "spacing": (1, 1, 1)}, "leave out"),
        (np.zeros((4, 4, 4)), {"component": 1}, "an array is one volume"),
        (np.zeros((4, 4, 4)), {"max_gaussian": 5}, "max_gaussian: unknown option; expected one of dims, "),
        (np.zeros((4, 4, 4)), {"space": "RAS"}, "give affine too"),
        (np.zeros((4, 4, 4)), {"spacing": 2}, "spacing: 2; expected three numbers"),
        (np.zeros((4, 4, 4)), {"crop": (slice(1, 3),) * 3}, "crop: .*; expected text"),
        (np.zeros((4, 4, 4)), {"light": "headlight"}, "light: unknown option; of a look: vvgt.Look"),
        ("example:blob:8", {"affine": np.eye(4)}, "affine and origin are for arrays"),
        (pyvista.ImageData(dimensions=(3, 3, 3)), {}, "array"),
    ],
)
def test_bad_input_is_an_exception_that_says_what(volume, reading, words):
    refused(vvgt.VvgtError, words, vvgt.read_volume, volume, **reading)


def test_arguments_of_another_type_are_a_line(field, tmp_path):
    refused(vvgt.UsageError, "tf: 3; expected a file, a name", vvgt.convert, field, 3)
    for option, given in (("max_gaussians", 10.5), ("steps", "3"), ("screen", 64.5), ("max_gaussians", math.inf)):
        words = f"{option} {given!r}: expected a whole number"
        refused(vvgt.UsageError, words, vvgt.convert, field, TF, **{option: given})
    for name in ("none.ply", "none.spz", ""):
        refused(vvgt.DataError, "; expected a file of Gaussians", vvgt.read_ply, tmp_path / name)


def test_numbers_of_gaussians_may_be_floats_and_labels_names():
    organs = np.arange(512).reshape(8, 8, 8) // 256
    result = vvgt.convert(organs, vvgt.Look(labels={0: "left", 1: "right"}), max_gaussians=1e2, screen=32, steps=0)
    assert 0 < len(result.gaussians) <= 100
    assert '"right"' in str(result.ply.legend)


def test_saving_again_replaces_the_file_unless_forbidden(converted, tmp_path):
    small = converted.save(tmp_path / "a.ply")
    assert converted.save(tmp_path / "a.ply", sh_degree=1) > max(300 * 26 * 4, small)
    refused(vvgt.UsageError, "exists", converted.save, tmp_path / "a.ply", overwrite=False)
    refused(vvgt.UsageError, "expected a name ending in", converted.save, tmp_path / "x.obj")
    assert not (tmp_path / "x.obj").exists()


def test_an_option_that_is_none_is_a_line():
    refused(vvgt.UsageError, "steeps: unknown option", vvgt.convert, np.zeros((4, 4, 4)), steeps=3)


def test_a_conversion_with_an_output_is_the_file(field, tmp_path):
    result = vvgt.convert(field, TF, tmp_path / "a.ply", **HOW, report=tmp_path / "r.json")
    assert np.array_equal(vvgt.read_ply(tmp_path / "a.ply")[0].means, result.gaussians.means)
    assert json.loads((tmp_path / "r.json").read_text())["scores"]["psnr"] == result.scores["psnr"]
    refused(vvgt.UsageError, "exists", vvgt.convert, field, TF, tmp_path / "a.ply", **HOW)
    assert "check views" in vvgt.convert(field, TF, tmp_path / "b.ply", **HOW, dry_run=True)
    assert not (tmp_path / "b.ply").exists()
    vvgt.init(field, TF, tmp_path / "c.ply", max_gaussians=50)
    assert len(vvgt.read_ply(tmp_path / "c.ply")[0]) <= 50
    assert vvgt.convert(field, [TF, "hot"], tmp_path / "{}.ply", **HOW) is None
    assert len(list(tmp_path.glob("*.ply"))) == 4


def test_the_library_goes_through_blocks_too(tmp_path):
    data = np.random.default_rng(0).random((20, 24, 28)).astype(np.float32)
    data.tofile(tmp_path / "v_28x24x20_float32.raw")
    whole, blocks = (vvgt.convert(tmp_path / "v_28x24x20_float32.raw", TF, **HOW, blocks=b) for b in (None, 16))
    assert blocks.scores["psnr"] == pytest.approx(whole.scores["psnr"], abs=0.1)
    assert blocks.preview(48).shape == (144, 144, 3)  # pictures that nobody foresaw
    np.testing.assert_allclose(blocks.preview(48)[:, :48], whole.preview(48)[:, :48], atol=0.02)


@pytest.mark.parametrize(
    "module", [vvgt, *map(import_module, ("vvgt_cli.commands.session", "vvgt_cli.commands.synth"))]
)
def test_the_examples_in_docstrings_run(module):
    result = doctest.testmod(module, optionflags=doctest.ELLIPSIS)
    assert result.attempted >= 2
    assert result.failed == 0


SHARED = [name for name in vvgt.__all__ if name.replace("_", "-") in COMMANDS]


@pytest.mark.parametrize("name", SHARED)
def test_a_command_and_its_function_have_the_same_names_and_defaults(name):
    """Except for groups of options, each of which is one argument, and for what only one of the two can give."""
    command = import_module(f"vvgt_cli.commands.{name}").command
    options = {option.name: option for option in command.params}
    arguments = dict(signature(getattr(vvgt, name)).parameters)
    grouped = {key for key in ("look", "reading", "blocks", "light", "progress") if arguments.pop(key, None)}
    for key in ("after", "all_views", "command", *(["volume"] if name == "report" else [])):
        arguments.pop(key, None)
    assert len(SHARED) > 10
    assert name == "info" or "progress" in grouped
    assert set(arguments) <= set(options)
    for key, argument in arguments.items():
        if not options[key].required:
            assert (options[key].to_info_dict()["default"] or None) == (argument.default or None), key


def test_importing_costs_nothing_and_is_quiet():
    code = "import sys, vvgt_cli as vvgt; print(len({m for m in sys.modules if m.startswith(('numpy', 'numba'))}))"
    code += "; vvgt.convert; print('convert' in dir(vvgt))"
    out, err = python("-c", code)
    assert (out.split(), err) == (["0", "True"], "")
    assert (ROOT / "vvgt_cli" / "py.typed").exists()
    with pytest.raises(AttributeError, match="nothing_like_it"):
        _ = vvgt.nothing_like_it
    assert all(hasattr(vvgt, name) for name in vvgt.__all__)


def test_a_conversion_says_nothing_unless_asked(field, capfd):
    vvgt.convert(field, TF, max_gaussians=50, screen=32, steps=0)
    assert capfd.readouterr() == ("", "")
    vvgt.convert(field, TF, max_gaussians=50, screen=32, steps=0, progress=True)
    assert "closed form" in capfd.readouterr().err


@pytest.mark.parametrize("option", [{"space": "LPS"}, {"suv": "none"}, {"dtype": "int16"}])
def test_what_a_dataset_says_itself_is_refused(field, option):
    for data in (xarray.DataArray(field, dims=("z", "y", "x")), pyvista.wrap(field)):
        refused(vvgt.UsageError, f"{next(iter(option))}: a ", vvgt.read_volume, data, **option)


def test_a_dataset_of_xarray_and_curvilinear_places(field):
    at = {"z": 2.0 * np.arange(field.shape[0]), "lon": (("y", "x"), field[0]), "lat": (("y", "x"), field[0])}
    dataset = xarray.Dataset({"a": (("z", "y", "x"), field), "b": (("z", "y", "x"), -field)}, at)
    with pytest.warns(UserWarning, match=r"curvilinear \(lon, lat\), which is not read"):
        assert np.array_equal(vvgt.read_volume(dataset, array="b").data, -field)
    with pytest.raises(vvgt.UsageError, match=r"several variables: a .*; b"):
        vvgt.read_volume(dataset)
    dates = (("z", "y", "x"), np.zeros(field.shape, "M8[ns]"))
    with pytest.warns(UserWarning, match="curvilinear"):
        assert np.array_equal(vvgt.read_volume(dataset.drop_vars("b").assign(dates=dates)).data, field)
