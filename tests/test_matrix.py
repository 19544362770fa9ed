"""A conversion with each kind of kernel, in memory and in blocks: the errors of the two agree."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.processes import replaced
from vvgt_cli.images import read_exr

nib = pytest.importorskip("nibabel")
tifffile = pytest.importorskip("tifffile")

DIMS = (28, 24, 30)  # z, y, x: eight blocks of 16 voxels
AGREE, CLOSER = 0.15, 0.3  # dB: of the test views (of 50 dB), and of the worst viewing condition: single pixels decide
SMALL = ("--screen", "64", "--max-gaussians", "800", "--steps", "60")  # after 30 they may still be 0.4 dB apart
BLOCKS = ("--blocks", "16")
RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def function(*points):
    """JSON of a function: (value, opacity, r, g, b) each."""
    return json.dumps({"points": [{"x": x, "opacity": a, "rgb": rgb} for x, a, *rgb in points]})


TF = function((0, 0, 0.2, 0.3, 0.9), (0.25, 0, 0.4, 0.3, 0.6), (0.6, 0.3, 0.9, 0.4, 0.2), (1, 0.8, 1, 0.9, 0.6))


def ball(center, radius):
    z, y, x = (axis - c for axis, c in zip(np.indices(DIMS).astype(float), center, strict=True))
    return np.clip(1.5 - np.sqrt(z * z + y * y + x * x) / radius, 0, 1)


def nifti(path, data):
    """Data (z, y, x[, t]) as NIfTI has them."""
    order = (2, 1, 0, *range(3, data.ndim))
    nib.save(nib.Nifti1Image(np.ascontiguousarray(data.transpose(order)), RAS), path)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Two balls that touch, as scalars, labels, colours and time steps."""
    folder = tmp_path_factory.mktemp("matrix")
    one, two = ball((13, 11, 11), 6), ball((17, 14, 21), 5)
    values = np.maximum(one, 0.7 * two)
    labels = (one > 0.5) + 2 * ((two > 0.5) & (one <= 0.5)) + 2 * (ball((13, 11, 11), 3) > 0.5)
    nifti(folder / "scalars.nii", values.astype(np.float32))
    nifti(folder / "labels.nii", labels.astype(np.uint8))
    nifti(folder / "mask.nii", (np.indices(DIMS)[2] > 9).astype(np.uint8))
    nifti(folder / "four.nii", np.stack([values, np.roll(values, 2, axis=1)], axis=-1).astype(np.float32))
    colors = np.stack([values * 255, 200 * (values > 0) * (1 - values), values * 128], axis=-1).astype(np.uint8)
    tifffile.imwrite(folder / "rgb.tif", colors, photometric="rgb")
    (folder / "tf.json").write_text(TF)
    (folder / "lit.json").write_text(json.dumps(json.loads(TF) | {"lighting": {"ambient": 0.3}}))
    return folder


@pytest.fixture
def at(data, monkeypatch):
    monkeypatch.chdir(data)
    return data


# a row for each kind of kernel: rays and moments of a function or of a grid, with light or without
ROWS = {  # name: (volume, options); all of `convert`, to one .ply
    "function, cropped and masked": (
        "scalars.nii",
        (
            "--tf",
            "tf.json",
            "--crop",
            "3:28,:,2:",
            "--max-megabytes",
            "0.05",
            "--mask",
            "mask.nii",
            "--rule",
            "playcanvas",
        ),
    ),
    "sky": ("scalars.nii", ("--tf", "tf.json", "--light", "sun")),
    "colours in the world": ("rgb.tif", ("--target-psnr", "35", "--frame", "world", "--up", "z")),
    "layers, lit": ("scalars.nii", ("--tf", "tf.json", "--layer", "labels.nii,labels=auto", "--light", "above")),
    "wavelet, lit, of a time step": (
        "four.nii",
        ("--time", "1", "--tf", "tf.json", "--init", "wavelet", "--light", "headlight", "--sh-degree", "3"),
    ),
    "model, lit by the function": ("scalars.nii", ("--tf", "lit.json", "--model", "vvgt-small")),
}
LONG = list(ROWS)[-2:]


def converted(vvgt, volume, options, out: Path, *more):
    """The report of a conversion."""
    report = out.with_suffix(".report.json")
    vvgt.ok("convert", volume, *replaced(SMALL, *options, *more), "-o", out, "--report", report, "--overwrite")
    return json.loads(report.read_text())


@pytest.mark.parametrize("row", [pytest.param(row, marks=[pytest.mark.long] * (row in LONG)) for row in ROWS])
def test_memory_and_blocks_of_any_size_agree(vvgt, at, tmp_path, row):
    memory = converted(vvgt, *ROWS[row], tmp_path / "memory.ply")
    blocks = converted(vvgt, *ROWS[row], tmp_path / "16.ply", *BLOCKS)
    assert abs(memory["scores"]["psnr"] - blocks["scores"]["psnr"]) <= AGREE
    assert abs(memory["conditions"][0]["psnr"] - blocks["conditions"][0]["psnr"]) <= CLOSER
    assert memory["scores"]["psnr"] > 20
    assert [stage["name"] for stage in memory["stages"] if stage["name"] not in ("scene", "compile")] == [
        stage["name"] for stage in blocks["stages"] if stage["name"] != "compile"
    ]
    more = ("--workers", "2") if row == "sky" else ()
    converted(vvgt, *ROWS[row], tmp_path / "32.ply", "--blocks", "32", *more)
    assert (tmp_path / "16.ply").read_bytes() == (tmp_path / "32.ply").read_bytes()
    assert not [path for path in tmp_path.iterdir() if path.suffix not in (".ply", ".json")]


def test_pictures_and_scores_of_a_file_are_the_same_in_memory_and_in_blocks(vvgt, at, tmp_path):
    volume, options = ROWS["layers, lit"]
    vvgt.ok("init", volume, *options, "--screen", "32", "--max-gaussians", "200", "-o", tmp_path / "a.ply")
    shared = ("evaluate", tmp_path / "a.ply", "--volume", volume, *options, "--step", "1", "--json")
    memory, blocks = (json.loads(vvgt(*shared, *more).out) for more in ((), BLOCKS))
    assert memory["reference_psnr"] == pytest.approx(blocks["reference_psnr"], abs=CLOSER)
    assert memory["scores"]["psnr"] == pytest.approx(blocks["scores"]["psnr"], abs=AGREE)
    for one, other in zip(memory["conditions"], blocks["conditions"], strict=True):
        assert one["psnr"] == pytest.approx(other["psnr"], abs=CLOSER)
    assert memory["texture"] == pytest.approx(blocks["texture"], abs=0.05, nan_ok=True)
    for name, how in (("memory", ()), ("blocks", BLOCKS)):
        few = ("--views", "2", "--test-views", "1", "--size", "48")
        vvgt.ok("render-views", volume, *options, *how, *few, "-o", tmp_path / name)
    for path in sorted((tmp_path / "memory").glob("t*/*.exr")):
        one, other = (read_exr(tmp_path / name / path.parent.name / path.name)[0] for name in ("memory", "blocks"))
        assert one.max() > 0.3
        np.testing.assert_allclose(one, other, atol=2e-3)
        assert np.abs(one - other).mean() < 1e-4
