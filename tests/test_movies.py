"""Turntables: every picture is there, in order and in time, and the last leads to the first."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from vvgt_cli.cameras import orbit_views
from vvgt_cli.cameras.files import transforms_json
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.commands.render import write_movie
from vvgt_cli.dvr import RenderSettings, render_view
from vvgt_cli.errors import DataError
from vvgt_cli.field.source import SourceRequest, load
from vvgt_cli.gaussians import Gaussians, PlyOptions, write_ply
from vvgt_cli.images.metrics import psnr
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.splat import render


@pytest.fixture
def ply(tmp_path):
    rng = np.random.default_rng(2)
    means = rng.uniform(-0.7, 0.7, (40, 3))
    colors = np.round(rng.uniform(0, 1, (40, 3)))
    gaussians = Gaussians(means, np.full((40, 3), -2.2), np.tile((1, 0, 0, 0), (40, 1)), np.full(40, 3), colors)
    write_ply(tmp_path / "a.ply", gaussians, PlyOptions(made_for=64))
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
    assert "pip install 'vvgt[share]'" in result.error
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
