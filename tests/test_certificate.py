"""What files say of their own error: written, read from every format, checked against the volume."""

import json
import math
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest

import vvgt_cli
from tests.processes import replaced
from vvgt_cli.commands.main import run
from vvgt_cli.conversion.certify import Verdict, position_error, preview_psnr
from vvgt_cli.conversion.stages import TestViews, ViewingConditions
from vvgt_cli.errors import DataError
from vvgt_cli.field.digests import values_digest
from vvgt_cli.gaussians import PlyOptions, read_ply, write_ply
from vvgt_cli.gaussians.formats import FORMATS, encoded, read_splats
from vvgt_cli.gaussians.header import Certificate, parse_header
from vvgt_cli.volume import Volume
from vvgt_cli.volume.stored import Stored

DIMS = (20, 18, 22)  # x, y, z
FULL = Certificate(
    volume="head.nrrd", sha256="ab" * 32, look="0123456789ab", size=400, rule="inria", psnr=40.25, views=3,
    pixels=160000, conditions=(("inria 400 px", 39.5), ("viser 800 px", 38.0)), texture=(0.61, 0.46),
    position_error=1e-5, command="vvgt convert head.nrrd --tf 'a b.json'",
)  # fmt: skip
SMALL = ("--screen", "64", "--max-gaussians", "300", "--steps", "8")
RAW = ("--dims", *map(str, DIMS), "--dtype", "uint8")


def ball(shift=0.0):
    x, y, z = np.meshgrid(*(np.arange(n) for n in DIMS), indexing="ij")
    r = np.sqrt((x - 9.5 - shift) ** 2 + (y - 8.5) ** 2 + (z - 10.5) ** 2)
    return np.clip(255 * (1.5 - r / 6), 0, 255).astype(np.uint8).transpose(2, 1, 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("certificate")
    ball().tofile(made / "ball.raw")
    ball(1.0).tofile(made / "moved.raw")
    points = [{"x": 0, "opacity": 0, "rgb": [1, 0, 0]}, {"x": 1, "opacity": 0.8, "rgb": [1, 1, 0]}]
    (made / "tf.json").write_text(json.dumps({"points": points}))
    points[1]["opacity"] = 0.5
    (made / "other.json").write_text(json.dumps({"points": points}))
    return made


@pytest.fixture(scope="module")
def made(folder):
    """A converted file, to be read only; the volume and the function were given by their whole paths."""
    args = ("convert", folder / "ball.raw", *RAW, "--tf", folder / "tf.json", *SMALL, "-o", folder / "out.ply")
    assert run([str(arg) for arg in args]) == 0
    return folder / "out.ply"


def evaluated(vvgt, folder, ply, volume="ball.raw", tf="tf.json", *more):
    how = (*RAW, "--tf", folder / tf, "--no-conditions", "--step", "1", "--json", *more)
    return json.loads(vvgt.ok("evaluate", ply, "--volume", folder / volume, *how).out)["certificate"]


def test_a_line_gives_the_certificate_back() -> None:
    assert FULL.line().startswith("vvgt certificate {")
    assert "\n" not in FULL.line()
    assert Certificate.of(FULL.line().split(None, 2)[2]) == FULL
    least = replace(FULL, sha256=None, conditions=(), texture=None, command=None)
    assert Certificate.of(least.line().split(None, 2)[2]) == least


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{}", "nonsense",
        FULL.line().split(None, 2)[2].replace("40.25", "NaN"),
        FULL.line().split(None, 2)[2].replace("40.25", '"40.25"'),
        FULL.line().split(None, 2)[2].replace('"size": 400', '"size": true'),
        FULL.line().split(None, 2)[2].replace('"volume"', '"volumes"'),
        json.dumps(FULL.facts() | {"texture": [1]}),
        json.dumps(FULL.facts() | {"texture": [1, "2"]}),
    ],
)  # fmt: skip
def test_a_certificate_that_is_none_is_one_line(text) -> None:
    header = "\n".join(
        ["ply", "format binary_little_endian 1.0", f"comment vvgt certificate {text}", "element vertex 0"]
        + [f"property float {name}" for name in ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]]
        + [f"property float {name}_{k}" for name, n in (("scale", 3), ("rot", 4)) for k in range(n)]
        + ["end_header", ""]
    )
    with pytest.raises(DataError, match="expected one that vvgt writes"):
        parse_header(header.encode(), "x.ply")


def test_a_conversion_certifies_its_file(made) -> None:
    found = read_ply(made)[1].certificate
    assert (found.volume, found.size, found.rule) == ("volume, 20 x 18 x 22", 64, "inria")
    assert (found.views, found.pixels) == (3, 64**2)
    assert found.psnr > 20
    assert len(found.conditions) == 10
    assert found.conditions[0][1] == min(dB for _, dB in found.conditions)
    assert found.command.startswith("vvgt convert VOLUME --")
    assert "/" not in found.command
    for words in ("--tf tf.json", "--screen 64", "--max-gaussians 300", "--steps 8", "--dims 20 18 22"):
        assert words in found.command
    assert "out.ply" not in found.command


def test_a_frame_is_the_same_whichever_job_of_an_array_made_it(vvgt, folder, tmp_path) -> None:
    for k, name in enumerate(("ball", "moved")):
        (tmp_path / f"t_{k}.raw").write_bytes((folder / f"{name}.raw").read_bytes())
    args = (tmp_path / "t_*.raw", *RAW, "--tf", folder / "tf.json", *SMALL, "--shard", "2/2")
    vvgt.ok("convert", *args, "-o", tmp_path / "out_{}.ply")
    found = read_ply(tmp_path / "out_1.ply")[1].certificate
    assert found.command.startswith("vvgt convert VOLUME ")
    assert "--shard" not in found.command
    assert "out_" not in found.command


def test_no_folder_is_named_whatever_its_name(vvgt, folder, tmp_path) -> None:
    odd = tmp_path / "pa=tient, one"
    odd.mkdir()
    shutil.copy(folder / "ball.raw", odd / "ball.raw")
    args = (odd / "ball.raw", *RAW, "--tf", folder / "tf.json", *SMALL, "-o", tmp_path / "odd.ply")
    vvgt.ok("convert", *args)
    found = read_ply(tmp_path / "odd.ply")[1].certificate
    assert found.command.startswith("vvgt convert VOLUME ")


def test_no_comments_no_certificate(vvgt, folder, tmp_path) -> None:
    args = (folder / "ball.raw", *RAW, "--tf", folder / "tf.json", *SMALL, "--no-comments")
    vvgt.ok("convert", *args, "-o", tmp_path / "out.ply")
    assert read_ply(tmp_path / "out.ply")[1].certificate is None
    assert b"sha256" not in (tmp_path / "out.ply").read_bytes()


@pytest.mark.parametrize("known", FORMATS, ids=lambda known: known.suffix)
def test_every_format_carries_it(made, tmp_path, known) -> None:
    gaussians, header = read_ply(made)
    path = tmp_path / f"out{known.suffix}"
    path.write_bytes(encoded(known, gaussians, PlyOptions(**header.facts()), path.name))
    assert header.certificate is not None
    assert read_splats(path)[1].certificate == header.certificate


def test_another_format_is_certified_and_judged(vvgt, folder, made, tmp_path) -> None:
    args = (folder / "ball.raw", *RAW, "--tf", folder / "tf.json", *SMALL)
    vvgt.ok("convert", *args, "-o", tmp_path / "out.spz")
    expected = read_ply(made)[1].certificate
    assert read_splats(tmp_path / "out.spz")[1].certificate == expected
    told = vvgt.ok("info", tmp_path / "out.spz").out.decode()
    assert expected.sha256 in told
    assert f"psnr {expected.psnr:g}" in told
    assert evaluated(vvgt, folder, tmp_path / "out.spz")["same_volume"]


def test_it_holds_for_the_volume_it_was_made_of(vvgt, folder, made) -> None:
    found = evaluated(vvgt, folder, made)
    assert found["holds"]
    assert found["same_volume"]
    assert found["same_look"]
    assert found["psnr"] == found["recorded"]  # the same views, drawn the same way
    blocks = evaluated(vvgt, folder, made, "ball.raw", "tf.json", "--blocks", "16")
    assert blocks["holds"]
    assert blocks["same_volume"]


def test_it_does_not_hold_for_another_volume_function_or_damaged_gaussians(vvgt, folder, made, tmp_path) -> None:
    moved = evaluated(vvgt, folder, made, "moved.raw")
    assert not moved["holds"]
    assert moved["same_volume"] is False
    assert "values differ from those" in moved["text"]
    other = evaluated(vvgt, folder, made, "ball.raw", "other.json")
    assert not other["holds"]
    assert other["same_volume"]
    assert not other["same_look"]
    gaussians, header = read_ply(made)
    faded = replace(gaussians, opacity_logits=gaussians.opacity_logits - 1)
    write_ply(tmp_path / "faded.ply", faded, PlyOptions(**header.facts()))
    found = evaluated(vvgt, folder, tmp_path / "faded.ply")
    assert not found["holds"]
    assert found["same_volume"]
    assert found["same_look"]
    assert found["psnr"] < found["recorded"] - 1


def test_gaussians_that_change_lose_it(vvgt, folder, made, tmp_path) -> None:
    views = tmp_path / "views"
    args = (folder / "ball.raw", *RAW, "--tf", folder / "tf.json", "--size", "64", "--views", "4", "-o", views)
    vvgt.ok("render-views", *args)
    vvgt.ok("optimize", made, "--views", views, "--steps", "2", "-o", tmp_path / "more.ply")
    assert read_ply(tmp_path / "more.ply")[1].certificate is None


def test_a_live_file_keeps_its_own_and_a_recolored_one_has_none(vvgt, folder, tmp_path) -> None:
    args = (folder / "ball.raw", *RAW, "--tf", folder / "tf.json", "--screen", "64", "--max-gaussians", "300", "--live")
    vvgt.ok("convert", *args, "-o", tmp_path / "live.ply")
    certificate = read_ply(tmp_path / "live.ply")[1].certificate
    assert certificate.live_psnr is not None
    found = evaluated(vvgt, folder, tmp_path / "live.ply")  # with --tf: as recolor shows it
    assert (found["holds"], found["recorded"]) == (True, certificate.live_psnr)
    assert found["psnr"] == pytest.approx(found["recorded"], abs=0.02)
    recolor = ("recolor", tmp_path / "live.ply", "--tf", folder / "other.json", "-o", tmp_path / "other.ply")
    vvgt.ok(*recolor)
    assert read_ply(tmp_path / "other.ply")[1].certificate is None


def test_from_python(tmp_path) -> None:
    result = vvgt_cli.convert(ball(), max_gaussians=300, screen=64, steps=0)
    result.save(tmp_path / "a.ply")
    found = read_ply(tmp_path / "a.ply")[1].certificate
    assert found.command is None
    assert found.psnr == round(preview_psnr(result.scores), 2)


def test_the_digest_is_of_values_type_and_dims_not_of_how_they_lie() -> None:
    data = np.random.default_rng(3).integers(0, 1000, (150, 20, 140)).astype(">u2")
    first = values_digest([Volume(data)])
    assert first == values_digest([Volume(np.asfortranarray(data.astype("<u2")))])
    other = data.copy()
    other[149, 19, 139] += 1
    assert values_digest([Volume(other)]) != first
    assert values_digest([Volume(data.astype(np.int32))]) != first
    assert values_digest([Volume(data.reshape(75, 40, 140))]) != first
    assert values_digest([Volume(data), Volume(data)]) != first


def test_positions_far_from_the_origin_are_known_to_be_rounded(made) -> None:
    gaussians, _ = read_ply(made)
    near = PlyOptions(frame="world", scale=0.1, centre=(1.0, 2.0, 3.0))
    far = replace(near, centre=(5e6, 2.0, 3.0))
    assert position_error(gaussians, PlyOptions(scale=0.1, centre=(5e6, 0.0, 0.0))) == 0  # the unit frame
    assert 0 < position_error(gaussians, near) < 2e-6
    assert 0.1 < position_error(gaussians, far) <= 0.25 + 1e-6  # half a step of float32 at 5e6


def test_a_verdict_names_what_does_not_hold() -> None:
    assert Verdict(True, True, 40.0, 40.05).text() == "holds: the same volume and look, 40.00 dB (40.05 dB recorded)"
    assert Verdict(None, True, 40.0, 40.0).text().startswith("holds: the volume was not compared (too large)")
    assert Verdict(True, True, 39.8, 40.0).text() == "does not hold: 39.80 dB, 40.00 dB recorded"
    assert not Verdict(True, True, math.nan, 40.0).holds


@pytest.mark.parametrize("chunks", [(7, 5, 11), (64, 64, 64), (1, 30, 1), (150, 2, 140)])
def test_the_digest_reads_each_chunk_once_whatever_its_shape(chunks, monkeypatch) -> None:
    data = np.random.default_rng(3).integers(0, 1000, (40, 30, 50)).astype(np.uint16)
    read = np.zeros([-(-n // c) for n, c in zip(data.shape, chunks, strict=True)], int)

    def part(slices):
        touched = tuple(slice(k.start // c, -(-k.stop // c)) for k, c in zip(slices, chunks, strict=True))
        read[touched] += 1
        return data[slices]

    monkeypatch.setattr("vvgt_cli.field.digests.AT_ONCE", 3000)
    stored = Stored(part, data.dtype, data.shape, chunks, "x")
    assert values_digest([Volume(stored)]) == values_digest([Volume(data)])
    assert (read == 1).all()


def test_texture_is_certified_as_it_is_measured_from_near(vvgt, folder, tmp_path) -> None:
    from vvgt_cli.conversion.gaussian_files import open_gaussians
    from vvgt_cli.conversion.place import to_box_frame
    from vvgt_cli.field.source import SourceRequest, load
    from vvgt_cli.score.viewing import score_texture, texture_cameras
    from vvgt_cli.volume import ReadOptions

    points = [{"x": 0, "opacity": 0, "rgb": [1, 0, 0]}, {"x": 60, "opacity": 1, "rgb": [1, 0.9, 0.8]}]
    (tmp_path / "solid.json").write_text(json.dumps({"points": points}))
    solid = (folder / "ball.raw", *RAW, "--tf", tmp_path / "solid.json", "--max-gaussians", "1500", "--steps", "0")
    vvgt.ok("convert", *solid, "--screen", "192", "-o", tmp_path / "out.ply", "--report", tmp_path / "r.json")
    gaussians, header = open_gaussians(str(tmp_path / "out.ply"))
    source = load(SourceRequest(str(folder / "ball.raw"), ReadOptions(dims=DIMS, dtype="uint8"),
                                str(tmp_path / "solid.json")))  # fmt: skip
    boxed, cameras = to_box_frame(gaussians, source.volume), texture_cameras(192)
    assert [(c.width, c.height) for c in cameras] == [(64, 64)]
    found = score_texture(source.scene(), boxed, 192, header.rule, cameras=cameras)
    assert found.blocks >= 4
    assert header.certificate.texture == pytest.approx((found.ours, found.reference), abs=1e-3)
    assert json.loads((tmp_path / "r.json").read_text())["texture"]["blocks"] == found.blocks
    assert f"texture {header.certificate.texture[0]:g}" in vvgt("info", tmp_path / "out.ply").out.decode()
    vvgt.ok("convert", *solid, "--screen", "192", "--blocks", "16", "-o", tmp_path / "blocks.ply")
    assert read_ply(tmp_path / "blocks.ply")[1].certificate.texture[1] == pytest.approx(found.reference, abs=0.01)
    small = (folder / "ball.raw", *RAW, "--tf", folder / "tf.json", *SMALL)
    vvgt.ok(*replaced(("convert", *small), "--screen", "48"), "-o", tmp_path / "small.ply")
    assert read_ply(tmp_path / "small.ply")[1].certificate.texture is None  # 16 px: no block of 32


@pytest.mark.parametrize(("name", "more"), [("out.ply", ()), ("out.spz", ()), ("out.ply", ("--live",))])
def test_a_run_that_ends_among_its_scores_leaves_the_whole_file(vvgt, folder, tmp_path, monkeypatch, name, more):
    def end(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(ViewingConditions, "run", end)
    how = SMALL[: 4 if more else 6]
    words = ("--tf", folder / "tf.json", *how, *more, "-o", tmp_path / name)
    result = vvgt("convert", folder / "ball.raw", *RAW, *words)
    assert result.code == 130
    assert "complete; scoring next" in result.err
    assert os.listdir(tmp_path) == [name]
    gaussians, header = read_splats(tmp_path / name)
    assert len(gaussians) > 100
    assert header.version is not None
    assert header.certificate is None
    assert (header.live is not None) == bool(more)


@pytest.mark.parametrize("once", ["stream", "checkpoint", "comments"])
def test_what_cannot_be_written_twice_or_has_no_certificate_is_written_once(
    vvgt, folder, tmp_path, monkeypatch, once
):  # fmt: skip
    there = []
    monkeypatch.setattr(TestViews, "run", lambda *args: there.append((tmp_path / "out.ply").exists()))
    options = {
        "stream": ("-o", "-"),
        "checkpoint": ("-o", tmp_path / "out.ply", "--checkpoint", tmp_path / "kept"),
        "comments": ("-o", tmp_path / "out.ply", "--no-comments"),
    }[once]
    result = vvgt.ok("convert", folder / "ball.raw", *RAW, "--tf", folder / "tf.json", *SMALL, *options)
    assert there == [once == "comments"]
    assert "certificate " not in result.err
    assert result.err.count("\nwrite ") == 1


def test_a_page_is_whole_before_it_is_scored(vvgt, folder, tmp_path, monkeypatch) -> None:
    page, seen = tmp_path / "out.html", []
    monkeypatch.setattr(TestViews, "run", lambda *args: seen.append(page.read_text("utf-8")))
    command = ("convert", folder / "ball.raw", *RAW, "--tf", folder / "tf.json", *SMALL, "-o", page)
    result = vvgt.ok(*command)
    for held in ("values-0", "splats-0"):
        assert f'id="{held}"' in seen[0], held
    assert result.err.count("\nvalues") == 1


def test_no_view_is_rendered_twice_to_be_scored(vvgt, folder, tmp_path, monkeypatch) -> None:
    import vvgt_cli.dvr
    from vvgt_cli.field.field import Picture

    rendered, render_view = [], vvgt_cli.dvr.render_view

    def counted(scene, camera, settings=None, blocks=None):
        if isinstance(scene, vvgt_cli.dvr.Scene) and camera.width >= 512:
            rendered.append(Picture(camera, settings, blocks).key)
        return render_view(scene, camera, settings, blocks)

    monkeypatch.setattr("vvgt_cli.dvr.render_view", counted)
    how = ("--tf", folder / "tf.json", "--max-gaussians", "300", "--screen", "512", "--live")
    vvgt.ok("convert", folder / "ball.raw", *RAW, *how, "-o", tmp_path / "out.ply")
    assert len(rendered) == len(set(rendered)) == 4  # three test views, one on the next larger screen
