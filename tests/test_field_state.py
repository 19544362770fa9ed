"""Runs in blocks: layers of scalars, their functions, and what stored blocks depend on."""

import json
from dataclasses import replace
from pathlib import Path

import nibabel
import numpy as np
import pytest
import tifffile

import vvgt_cli as vvgt
from vvgt_cli.field.open import FieldNeeds, _settings
from vvgt_cli.field.source import SourceRequest
from vvgt_cli.images import read_png
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.volume import ReadOptions, Volume


@pytest.fixture
def layers(tmp_path: Path) -> list[str]:
    """Files of two balls that overlap, and a function."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 64)] * 3, indexing="ij")
    for name, at in (("one", -0.25), ("two", 0.3)):
        np.save(tmp_path / f"{name}.npy", np.exp(-13 * ((x - at) ** 2 + y**2 + z**2)).astype(np.float32))
    points = [{"x": v, "rgb": [1, v, 0], "opacity": o} for v, o in ((0.2, 0), (0.5, 0.3), (1.0, 0.9))]
    (tmp_path / "tf.json").write_text(json.dumps({"points": points}))
    return [str(tmp_path / name) for name in ("one.npy", "two.npy", "tf.json")]


def test_layers_of_scalars_are_drawn_whole_after_the_cells(layers: list[str], vvgt, tmp_path: Path) -> None:
    one, two, tf = layers
    look = ("--tf", tf, "--layer", f"{two},tf={tf}")
    how = ("--screen", 200, "--max-gaussians", 2000, "--steps", 8, "--blocks", 16)
    vvgt.ok("convert", one, *look, *how, "-o", tmp_path / "a.ply", "--report", tmp_path / "r.json")
    recorded = json.loads((tmp_path / "r.json").read_text())["scores"]["psnr"]
    found = vvgt("evaluate", tmp_path / "a.ply", "--volume", one, *look, "--no-conditions", "--json")
    assert json.loads(found.out)["scores"]["psnr"] == pytest.approx(recorded, abs=1)


def test_a_layer_without_labels_has_its_histogram(layers: list[str], tmp_path: Path) -> None:
    one, two, tf = layers
    layer = SourceRequest(two, labels="none")
    how = {"size": 40, "background": (0, 0, 0)}
    look = vvgt.Look(tf, layers=[layer])
    for name, blocks in (("a", None), ("b", 16)):
        vvgt.render(one, tmp_path / name, look=look, orbit=1, blocks=blocks, **how)
    a, b = (read_png(next((tmp_path / name).glob("*.png"))) for name in "ab")
    np.testing.assert_allclose(a, b, atol=0.01)


def test_stored_blocks_depend_on_all_that_is_in_memory() -> None:
    x = np.linspace(0, 1, 400)
    rgb = np.stack([x, x, x], axis=1)
    function = TransferFunction("t", PiecewiseOpacity(x, x / 2), ColorMap(x, rgb))
    other = rgb.copy()
    other[200] = (1, 0, 0)
    volume = Volume(np.zeros((4, 5, 6), np.float32))
    request = SourceRequest(volume, tf=function, layers=(SourceRequest(volume, tf=function),))
    recolored = replace(function, color_map=ColorMap(x, other))
    requests = [
        request,
        replace(request, tf=recolored),
        replace(request, volume=replace(volume, spacing=(1, 1, 1.3))),
        replace(request, volume=replace(volume, slope=2.0)),
        replace(request, read=ReadOptions(mask=Volume(np.ones((4, 5, 6), np.uint8)))),
        replace(request, layers=(SourceRequest(volume, tf=recolored),)),
    ]
    found = [json.dumps(_settings(one, FieldNeeds(1, 1))) for one in requests]
    assert len(set(found)) == len(requests)
    assert json.dumps(_settings(request, FieldNeeds(1, 1))) == found[0]


def test_a_mask_in_memory_hides_a_file_in_blocks(layers: list[str], tmp_path: Path) -> None:
    mask = np.zeros((64, 64, 64), np.uint8)
    mask[:, :, :20] = 1
    ends = []
    for blocks in (None, 32):
        file = tmp_path / f"{blocks}.ply"
        vvgt.init(layers[0], layers[2], file, max_gaussians=500, screen=60, mask=mask, blocks=blocks)
        ends.append(vvgt.read_ply(file)[0].means[:, 0].max())
    assert ends[0] == pytest.approx(ends[1], abs=1e-5)
    assert ends[0] < 0


@pytest.mark.parametrize("kind", ["space", "unit", "colours"])
def test_a_layer_that_is_moved_or_coloured_is_drawn_in_blocks_as_in_memory(kind: str, tmp_path: Path) -> None:
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 24)] * 3, indexing="ij")
    ball = np.exp(-6 * ((x - 0.3) ** 2 + (y + 0.2) ** 2 + z**2)).astype(np.float32)
    for name, values in (("first", ball), ("other", ball[::-1])):
        nibabel.save(nibabel.Nifti1Image(values.T, np.diag([0.5, 0.5, 0.5, 1.0])), tmp_path / f"{name}.nii")
    source: str | Volume = str(tmp_path / "first.nii")
    layer, reading = f"{tmp_path / 'other.nii'},tf=hot", {}
    if kind == "space":
        reading = {"space": "LPS"}
    elif kind == "unit":
        source = Volume(ball, spacing=(0.5, 0.5, 0.5), unit="mm")
        head = "NRRD0004\ntype: float\ndimension: 3\nsizes: 24 24 24\nendian: little\nencoding: raw\n"
        head += 'space dimension: 3\nspace units: "um" "um" "um"\nspace origin: (0,0,0)\n'
        head += "space directions: (500,0,0) (0,500,0) (0,0,500)\n\n"
        (tmp_path / "other.nrrd").write_bytes(head.encode() + ball[::-1].astype("<f4").tobytes())
        layer = f"{tmp_path / 'other.nrrd'},tf=hot"
    else:
        rgb = np.repeat((255 * ball[..., None]).astype(np.uint8), 3, 3)
        tifffile.imwrite(tmp_path / "c.tif", rgb, photometric="rgb")
        np.save(tmp_path / "first.npy", ball)
        source, layer = str(tmp_path / "first.npy"), str(tmp_path / "c.tif")
    pictures = []
    for blocks in (None, 16):
        look = vvgt.Look("gray:0.2,1", layers=[layer])
        vvgt.render(source, tmp_path / f"{blocks}", look=look, orbit=1, size=48, blocks=blocks, **reading)
        pictures.append(read_png(next((tmp_path / f"{blocks}").glob("*.png"))))
    assert pictures[0].max() > 0.1
    np.testing.assert_allclose(*pictures, atol=0.01)
