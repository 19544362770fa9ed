"""Turntables and movies over time: every picture is there, in order and in time, and the last leads to the first."""

import json
import sys
import weakref
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from tifffile import imwrite

from vvgt_cli.cameras import orbit_views
from vvgt_cli.cameras.files import transforms_json
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.commands import pictures as command
from vvgt_cli.commands.pictures import write_movie
from vvgt_cli.commands.render import render as write_views
from vvgt_cli.conversion.gaussian_files import layout_of
from vvgt_cli.dvr import RenderSettings, render_view
from vvgt_cli.errors import DataError
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply, write_ply
from vvgt_cli.gaussians.frames import rescale, upright_matrix
from vvgt_cli.gaussians.rules import rule_of
from vvgt_cli.images.metrics import psnr
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.splat import render


@pytest.fixture
def ply(tmp_path):
    rng = np.random.default_rng(2)
    means = rng.uniform(-0.7, 0.7, (40, 3))
    colors = np.round(rng.uniform(0, 1, (40, 3)))
    gaussians = Gaussians(means, np.full((40, 3), -2.2), np.tile((1, 0, 0, 0), (40, 1)), np.full(40, 3), colors)
    write_ply(tmp_path / "a.ply", gaussians, PlyOptions(screen_size=64))
    return gaussians, tmp_path / "a.ply"


def gif(path):
    """Pictures (n, h, w, 3) in [0, 1] and the milliseconds of each."""
    with Image.open(path) as image:
        times, pictures = [], []
        for k in range(image.n_frames):
            image.seek(k)
            pictures.append(np.asarray(image.convert("RGB"), np.float32) / 255)
            times.append(image.info["duration"])
        return np.stack(pictures), times, image.info.get("loop")


def mp4(path):
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(path))
    about = next(reader)
    width, height = about["size"]
    frames = [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]
    return np.stack(frames) / np.float32(255), about


def even_steps(pictures):
    """Whether the step from the last picture to the first is like all others."""
    steps = [float(((a - b) ** 2).mean()) for a, b in zip(pictures, np.roll(pictures, -1, axis=0), strict=True)]
    return min(steps) > 0 and steps[-1] < 1.5 * max(steps[:-1]) and steps[-1] > 0.5 * min(steps[:-1])


def test_a_gif_of_an_orbit_repeats_without_a_jump(ply, tmp_path, vvgt):
    gaussians, path = ply
    assert "0.8 s" in vvgt.ok("render", path, "--orbit", 20, "-o", tmp_path / "turn.gif").err
    pictures, times, loop = gif(tmp_path / "turn.gif")
    assert pictures.shape == (20, 64, 64, 3)
    assert (set(times), loop) == ({40}, 0)
    for k, camera in enumerate(orbit_views(20, size=64)):
        assert psnr(render(gaussians, camera)[..., :3], pictures[k]) > 28
    assert even_steps(pictures)
    assert not even_steps(pictures[:15])
    assert list(tmp_path.glob("*.json")) == []
    assert not pictures[:, :2, :2].any()  # what is empty is black


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Three volumes of a ball whose values grow from frame to frame, the first of them dark, as files and as one."""
    folder = tmp_path_factory.mktemp("run")
    ball = np.exp(-4 * np.linalg.norm(np.stack(np.meshgrid(*3 * [np.linspace(-1, 1, 20)], indexing="ij")), axis=0) ** 2)
    frames = np.stack([k * ball for k in (0.05, 1, 2)]).astype(np.float32)
    for k, frame in enumerate(frames):
        np.save(folder / f"run_{k + 8}.npy", frame)
    imwrite(folder / "run.ome.tif", frames, ome=True, metadata={"axes": "TZYX"}, photometric="minisblack")
    return folder


LOOK = ("--tf", "viridis:0.1,1", "--size", 24)


def test_a_gif_of_few_colours_has_them_all(tmp_path):
    picture = (np.random.default_rng(0).integers(0, 256, (4, 4, 3)) / 255).astype(np.float32)
    write_movie(tmp_path / "a.gif", [picture, picture[::-1]])
    np.testing.assert_allclose(gif(tmp_path / "a.gif")[0], [picture, picture[::-1]], atol=1e-6)


@pytest.mark.parametrize("blocks", [(), ("--blocks", 16)])
def test_a_series_of_volumes_is_a_movie_over_time(run, tmp_path, vvgt, blocks):
    """Each frame is the picture of its volume in the range of all; a dark one is the background."""
    for name in ("run_*.npy", "run.ome.tif"):
        vvgt.ok("render", run / name, *LOOK, *blocks, "--background", 0, 0, 1, "-o", tmp_path / f"{name[-3:]}.gif")
    pictures, times, _ = gif(tmp_path / "npy.gif")
    np.testing.assert_array_equal(pictures, gif(tmp_path / "tif.gif")[0])
    assert (pictures.shape, set(times)) == ((3, 24, 24, 3), {200})
    np.testing.assert_allclose(pictures[0] - (0, 0, 1), 0, atol=0.03)  # the palette rounds
    for k in (1, 2):
        vvgt.ok(
            "render",
            run / f"run_{k + 8}.npy",
            *LOOK,
            "--tf-range 0,2 --background",
            0,
            0,
            1,
            "-o",
            tmp_path / f"{k}.png",
        )
        with Image.open(tmp_path / f"{k}.png") as alone:
            assert psnr(np.asarray(alone.convert("RGB"), np.float32) / 255, pictures[k]) > 28
    done = vvgt.ok("render", run / "run_*.npy", *LOOK, *blocks, "--rule mip --orbit 7 -o", tmp_path / "m_{:02d}.png")
    assert "7 views" in done.err
    greatest = [np.asarray(Image.open(tmp_path / f"m_{k:02d}.png"))[..., :3].max() / 255 for k in range(7)]
    np.testing.assert_allclose(greatest, [0, 0, 0.5, 0.5, 1, 1, 1], atol=0.06)
    vvgt.ok("render", run / "run_*.npy", *LOOK, *blocks, "--rule xray -o", tmp_path / "x.gif")
    assert (np.diff(gif(tmp_path / "x.gif")[0].mean(axis=(1, 2, 3))) > 0).all()


def test_a_label_map_without_labels_is_an_empty_frame(tmp_path, vvgt):
    table = {n: {"name": str(n), "color": [1, 0, 0], "opacity": 0.9} for n in (1, 2)}
    (tmp_path / "table.json").write_text(json.dumps(table))
    for k in range(3):
        np.save(tmp_path / f"map_{k}.npy", np.full((8, 8, 8), k, np.uint8))
    for labels in ("auto", tmp_path / "table.json"):
        out = ("--size 16 --overwrite -o", tmp_path / "{}.png")
        vvgt.ok("render", tmp_path / "map_?.npy", "--labels", labels, *out)
        shown = [np.asarray(Image.open(tmp_path / f"{k}.png"))[..., 3].any() for k in range(3)]
        assert shown == [False, True, True]


def test_a_layer_of_a_series_that_shows_nothing_is_named(run, tmp_path, vvgt):
    far = {"points": [{"x": x, "rgb": [1, 0, 0], "opacity": x - 50} for x in (50, 51)]}
    (tmp_path / "far.json").write_text(json.dumps(far))
    layer = f"{run / 'run_9.npy'},tf={tmp_path / 'far.json'}"
    with pytest.warns(UserWarning, match="run_9, transfer function: nothing is visible: the data lie in") as said:
        vvgt.ok("render", run / "run_*.npy", *LOOK, "--layer", layer, "-o", tmp_path / "time.gif")
    assert len({str(one.message) for one in said}) == 1  # of which one is shown


def test_a_frame_is_opened_for_its_own_views_after_the_one_before_is_gone(run, tmp_path, monkeypatch):
    opened, held, volume = [], [], command._volume

    def watched(run, request, asked, cameras, stack):
        assert not [one for one in held if one() is not None]
        stack.callback(opened.append, "closed")
        opened.append([camera.name for camera in cameras])
        draw, by = volume(run, request, asked, cameras, stack)
        held.append(weakref.ref(draw))
        return draw, by

    monkeypatch.setattr(command, "_volume", watched)
    assert write_views(run / "run_*.npy", tmp_path / "a.gif", "viridis", orbit=7, size=16) == 7
    names = [camera.name for camera in orbit_views(7)]
    assert opened == [names[:2], "closed", names[2:4], "closed", names[4:], "closed"]


def test_files_of_gaussians_are_a_movie_over_time(ply, tmp_path, vvgt):
    """Each is where its volume is, seen by the first file's camera and rule; an empty one is black."""
    gaussians = replace(ply[0], log_scales=ply[0].log_scales - 2)  # thin: what they look like depends on the rule
    up = replace(orbit_views(1, size=64)[0], rotation=orbit_views(1)[0].rotation @ upright_matrix("x"))
    options = PlyOptions(scale=1.0, centre=(0, 0, 0), up="x", screen_size=64, rule="compensated")
    write_ply(tmp_path / "f_8", gaussians, options)
    write_ply(tmp_path / "f_9", gaussians, replace(options, scale=2.0, centre=(0.1, 0, 0), up="none", rule="inria"))
    head = (tmp_path / "f_8").read_bytes().partition(b"end_header")[0].replace(b"vertex 40", b"vertex 0")
    (tmp_path / "f_10").write_bytes(head + b"end_header\n")
    vvgt.ok("render", tmp_path / "f_*", "-o", tmp_path / "time.gif")
    pictures, times, _ = gif(tmp_path / "time.gif")
    assert (len(pictures), set(times)) == (3, {200})
    moved = rescale(gaussians, 0.5, np.zeros(3), np.array([0.1, 0, 0]))
    for some, picture in zip((gaussians, moved), pictures, strict=False):
        assert psnr(render(some, up, rule_of("compensated"))[..., :3], picture) > 40
    assert pictures[2].max() < 0.03  # the palette rounds


def test_live_files_of_unlike_boxes_and_histograms_have_one_exposure(tmp_path, vvgt):
    """The same box alone and in one of twice the edge, where most values are 0, has the same X-ray."""
    ball = np.zeros((8, 8, 8), np.float32)
    ball[2:6, 2:6, 2:6] = 1
    np.save(tmp_path / "run_0.npy", ball)
    np.save(tmp_path / "run_1.npy", np.pad(ball, 4))
    for k in range(2):
        live = "--live --max-gaussians 60 --screen 48 -q --tf viridis --tf-range 0,1 -o"
        vvgt.ok("convert", tmp_path / f"run_{k}.npy", live, tmp_path / f"live_{k}.ply")
    first, second = (read_ply(tmp_path / f"live_{k}.ply")[1] for k in range(2))
    assert first.scale == 2 * second.scale
    larger, around = read_ply(tmp_path / "live_1.ply")[0], replace(layout_of(second), centre=first.centre)
    write_ply(tmp_path / "live_1.ply", larger, around)
    write_ply(tmp_path / "live_2.ply", larger, replace(around, space="LPS"))
    vvgt.ok("render", tmp_path / "live_[01].ply", "--rule xray --size 48 -o", tmp_path / "x_{}.png")
    one, other = (np.asarray(Image.open(tmp_path / f"x_{k}.png"), float)[..., 0] for k in range(2))
    assert one.max() > 100
    np.testing.assert_allclose(one.mean(), other.mean(), rtol=0.15)
    write_ply(tmp_path / "live_3.ply", read_ply(tmp_path / "live_0.ply")[0], replace(layout_of(first), space="RAS"))
    said = vvgt.fails(1, "render", tmp_path / "live_[23].ply", "-o", tmp_path / "time.gif")
    assert "live_3.ply: positions in RAS; expected LPS, as in the first frame" in said


def test_frames_that_are_no_movie_are_named(run, ply, tmp_path, vvgt):
    for k, hi in enumerate((1, 1, 2)):
        live = f"--live --max-gaussians 60 --screen 48 -q --tf viridis --tf-range 0,{hi} -o"
        vvgt.ok("convert", run / "run_9.npy", live, tmp_path / f"live_{k}.ply")
    (tmp_path / "live_3.ply").write_bytes(b"ply\n")
    for k in range(3):
        imwrite(tmp_path / f"slice_{k}.tif", np.full((8, 8), k, np.uint8))
    time = ("-o", tmp_path / "time.gif")
    for code, said, *words in (
        (2, "got 3 frames; expected a movie, as -o time.gif", run / "run_*.npy", *LOOK, "-o", tmp_path / "a.png"),
        (
            2,
            "got 3 frames; expected a movie, as -o time.gif",
            run / "run.ome.tif",
            *LOOK,
            "--orbit 4 -o",
            tmp_path / "d",
        ),
        (2, "2 views of 3 frames", run / "run_*.npy", *LOOK, "--orbit 2", *time),
        (2, "no such files", tmp_path / "none_*.ply", *time),
        (2, "either --camera FILE or --orbit N", tmp_path / "liv?_0.ply", *time),
        (2, "either --camera FILE or --orbit N", tmp_path / "slice_?.tif", *time),
        (2, "either --camera FILE or --orbit N", run / "run_9.npy", *LOOK, *time),
        (1, "live_2.ply: its values have another range or function", tmp_path / "live_[0-2].ply", "--rule mip", *time),
        (
            1,
            "nothing is visible in any of 2 frames",
            tmp_path / "live_[01].ply",
            "--tf viridis:0.99,1 --size 24",
            *time,
        ),
        (1, "live_3.ply: no 'end_header'", tmp_path / "live_[03].ply", *time),
    ):
        assert said in vvgt.fails(code, "render", *words)
        assert not (tmp_path / "time.gif").exists()


def test_an_mp4_of_an_orbit_over_white(ply, tmp_path, vvgt):
    pytest.importorskip("imageio_ffmpeg")
    vvgt.ok("render", ply[1], "--orbit", 10, "--size", 63, "--background", 1, 1, 1, "-o", tmp_path / "turn.mp4")
    pictures, about = mp4(tmp_path / "turn.mp4")
    assert pictures.shape == (10, 64, 64, 3)
    assert about["fps"] == 25
    assert about["codec"] == "h264"
    assert pictures[:, :3, :3].min() > 0.95  # corners are background
    assert even_steps(pictures)


def test_movies_are_not_replaced_unasked(ply, tmp_path, vvgt):
    (tmp_path / "turn.gif").write_bytes(b"old")
    assert "exists" in vvgt("render", ply[1], "--orbit", 2, "-o", tmp_path / "turn.gif").error
    vvgt.ok("render", ply[1], "--orbit", 2, "--overwrite", "-o", tmp_path / "turn.gif")
    assert len(gif(tmp_path / "turn.gif")[0]) == 2


def test_a_movie_has_one_size(ply, tmp_path, vvgt):
    views = [replace(look_at((3, 0, 0), width=width, height=16), name=f"v{width}") for width in (16, 18)]
    (tmp_path / "views.json").write_text(transforms_json(views))
    result = vvgt.fails(2, "render", ply[1], "--camera", tmp_path / "views.json", "-o", tmp_path / "a.gif")
    assert "views of several sizes" in result


def test_bad_calls_are_one_line(ply, tmp_path, vvgt, monkeypatch):
    assert "--exr writes pictures" in vvgt("render", ply[1], "--orbit", 2, "--exr", "-o", tmp_path / "a.gif").error
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    result = vvgt("render", ply[1], "--orbit", 2, "-o", tmp_path / "a.mp4")
    assert result.code == 1
    assert "'imageio-ffmpeg>=" in result.error
    assert "read" not in result.err.replace(result.error, "")


def test_errors_of_ffmpeg_are_reported(tmp_path):
    pytest.importorskip("imageio_ffmpeg")

    def pictures():
        yield np.zeros((16, 16, 3), np.float32)
        raise OSError("ffmpeg went away")

    with pytest.raises(DataError, match="ffmpeg went away"):
        write_movie(tmp_path / "a.mp4", pictures())
    assert list(tmp_path.iterdir()) == []


def test_a_volume_is_drawn_by_the_ray_caster_in_memory_and_in_blocks(tmp_path, vvgt):
    z, y, x = np.indices((20, 24, 32))
    np.save(tmp_path / "v.npy", np.exp(-((z - 9) ** 2 + (y - 8) ** 2 + (x - 20) ** 2) / 40).astype(np.float32))
    look = ("--tf", "viridis:0.3,0.6", "--light", "headlight", "--size", 48)
    for name, more in {"whole": (), "blocks": ("--blocks", 16)}.items():
        done = vvgt.ok("render", tmp_path / "v.npy", *look, *more, "-o", tmp_path / f"{name}.png")
        assert ("in blocks of 16" in done.err) == bool(more)
    whole, blocks = (np.asarray(Image.open(tmp_path / f"{name}.png"), float) for name in ("whole", "blocks"))
    assert whole.shape == (48, 48, 4)
    assert 0.02 < (whole[..., 3] > 128).mean() < 0.5
    assert np.abs(whole - blocks).mean() < 0.5
    source = load(SourceRequest(str(tmp_path / "v.npy"), tf="viridis:0.3,0.6", light=LightOptions(("headlight",))))
    camera = orbit_views(3, size=48)[0]
    assert (camera.rotation == orbit_views(1, size=48)[0].rotation).all()
    wanted = render_view(source.scene(), camera, RenderSettings())
    np.testing.assert_allclose(whole[..., 3] / 255, wanted[..., 3], atol=0.01)
    vvgt.ok("render", tmp_path / "v.npy", *look, "--orbit", 3, "-o", tmp_path / "d")
    first = np.asarray(Image.open(sorted((tmp_path / "d").glob("*.png"))[0]), float)
    np.testing.assert_array_equal(first, whole)
    assert (tmp_path / "d" / "transforms.json").is_file()
    assert not (tmp_path / "transforms.json").exists()
    vvgt.ok("render", tmp_path / "v.npy", *look, "--orbit", 4, "-o", tmp_path / "t.gif")
    assert len(gif(tmp_path / "t.gif")[0]) == 4


def test_a_single_picture_and_what_it_is_not_given(ply, tmp_path, vvgt):
    vvgt.ok("render", ply[1], "--exr", "-o", tmp_path / "a.png")
    assert (tmp_path / "a.exr").is_file()
    assert "exists" in vvgt("render", ply[1], "-o", tmp_path / "a.png").error
    (tmp_path / "a.png").unlink()
    assert "a.exr exists" in vvgt("render", ply[1], "--exr", "-o", tmp_path / "a.png").error
    assert not (tmp_path / "a.png").exists()
    for more, said in (
        (("--orbit", 2, "-o", tmp_path / "b.png"), "one picture of 2 views"),
        (("--crop", "1:,:,:", "-o", tmp_path / "b.png"), "holds Gaussians; reading options"),
        (("--blocks", 16, "-o", tmp_path / "b.png"), "holds Gaussians; reading options"),
        (("-o", tmp_path / "d"), "or one picture"),
    ):
        assert said in vvgt.fails(2, "render", ply[1], *more)
    assert "is for Gaussians" in vvgt.fails(2, "render", "example:blob:12", "--rule", "inria", "-o", tmp_path / "b.png")
    assert not (tmp_path / "b.png").exists()
