"""EXR and PNG files: what is written comes back, and nothing is lost or replaced unasked."""

import resource
import struct
import zlib

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.cameras.sets import default_views
from vvgt_cli.errors import DataError
from vvgt_cli.images import as_png, read_exr, read_png, write_exr, write_png


def rgba(height=9, width=13, seed=0):
    rng = np.random.default_rng(seed)
    alpha = rng.random((height, width, 1))
    alpha[0, :3, 0] = (0, 1, 1 / 255)
    return np.concatenate([rng.random((height, width, 3)) * alpha, alpha], axis=-1).astype(np.float32)


def test_exr_is_the_array_bit_for_bit(tmp_path):
    image = rgba()
    image[1, 1] = (np.inf, -np.inf, -0.0, 1e-42)
    image.view(np.uint32)[2, 2] = 0x7FC12345  # a NaN with a payload
    write_exr(tmp_path / "a.exr", image)
    back, camera = read_exr(tmp_path / "a.exr")
    assert back.dtype == np.float32
    assert back.tobytes() == image.tobytes()
    assert camera is None


def test_exr_half_rounds_to_half(tmp_path):
    image = rgba()
    write_exr(tmp_path / "a.exr", image, half=True)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0], image.astype(np.float16).astype(np.float32))


def test_exr_carries_the_camera_exactly(tmp_path):
    camera = default_views("test", size=16)[3]
    write_exr(tmp_path / "a.exr", rgba(16, 16), camera=camera)
    _, back = read_exr(tmp_path / "a.exr")
    assert back.rotation.tobytes() == camera.rotation.tobytes()
    assert back.translation.tobytes() == camera.translation.tobytes()
    for name in ("fx", "fy", "cx", "cy", "width", "height", "name"):
        assert getattr(back, name) == getattr(camera, name)


def test_exr_refuses_a_camera_of_another_size(tmp_path):
    with pytest.raises(DataError, match="16 x 16 px, the image 13 x 9"):
        write_exr(tmp_path / "a.exr", rgba(), camera=default_views("test", size=16)[0])
    assert not list(tmp_path.iterdir())


def test_exr_of_another_program(tmp_path):
    import OpenEXR

    rgb = np.random.default_rng(1).random((5, 6, 3)).astype(np.float32)
    OpenEXR.File({}, {"RGB": rgb}).write(str(tmp_path / "rgb.exr"))
    image, _ = read_exr(tmp_path / "rgb.exr")
    np.testing.assert_array_equal(image[..., :3], rgb)
    assert (image[..., 3] == 1).all()
    OpenEXR.File({}, {"Z": rgb[..., 0].copy()}).write(str(tmp_path / "z.exr"))
    refused(DataError, "channels Z; expected R, G, B, A", read_exr, tmp_path / "z.exr")
    OpenEXR.File({"vvgt.camera": '{"fx": 1}'}, {"RGB": rgb}).write(str(tmp_path / "bad.exr"))
    refused(DataError, r"vvgt\.camera; expected a camera", read_exr, tmp_path / "bad.exr")


@pytest.mark.parametrize("keep", [0, 3, 40, 200, -20])
def test_cut_or_foreign_files_are_data_errors(tmp_path, keep):
    write_exr(tmp_path / "a.exr", rgba(40, 40))
    write_png(tmp_path / "a.png", rgba(40, 40))
    for name, read in (("a.exr", read_exr), ("a.png", read_png)):
        path = tmp_path / name
        path.write_bytes(path.read_bytes()[:keep])
        refused(DataError, name, read, path)
        refused(DataError, "no such file", read, tmp_path / ("none_" + name))


def test_sizes_that_the_file_cannot_hold_are_refused(tmp_path):
    header = struct.pack(">IIBBBBB", 16000, 16000, 8, 6, 0, 0, 0)
    chunk = struct.pack(">I", 13) + b"IHDR" + header + struct.pack(">I", zlib.crc32(b"IHDR" + header))
    (tmp_path / "huge.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    refused(DataError, r"huge\.png: (claims 16000 x 16000|not an image)", read_png, tmp_path / "huge.png")
    write_exr(tmp_path / "a.exr", np.zeros((2, 3, 4)))
    lie = (
        (tmp_path / "a.exr")
        .read_bytes()
        .replace(struct.pack("<4i", 0, 0, 2, 1), struct.pack("<4i", 0, 0, 15999, 15999))
    )
    (tmp_path / "huge.exr").write_bytes(lie)
    refused(DataError, r"huge\.exr: claims 16000 x 16000", read_exr, tmp_path / "huge.exr")


def test_png_rgb_round_trip_is_exact_in_8_bits(tmp_path):
    levels = np.random.default_rng(2).integers(0, 256, (7, 11, 3))
    write_png(tmp_path / "a.png", levels / 255)
    back = read_png(tmp_path / "a.png")
    assert back.shape == (7, 11, 3)
    np.testing.assert_array_equal(np.rint(back * 255), levels)


def test_png_stores_straight_alpha(tmp_path):
    straight = np.random.default_rng(3).integers(0, 256, (8, 9, 4))
    straight[0, 0] = (255, 0, 0, 1)  # would be lost if alpha were applied in 8 bits on the way
    premultiplied = straight / 255
    premultiplied[..., :3] *= premultiplied[..., 3:]
    write_png(tmp_path / "a.png", premultiplied)
    seen = straight[..., 3:] > 0
    stored = _decode(tmp_path / "a.png")
    np.testing.assert_array_equal(stored[..., 3], straight[..., 3])
    np.testing.assert_array_equal(stored[..., :3] * seen, straight[..., :3] * seen)
    np.testing.assert_allclose(read_png(tmp_path / "a.png"), premultiplied, atol=1e-6)
    np.testing.assert_array_equal(as_png(premultiplied), read_png(tmp_path / "a.png"))


def _decode(path):
    """The stored bytes of an 8-bit RGBA PNG, by an independent decoder."""
    image = pytest.importorskip("PIL.Image").open(path)
    assert image.mode == "RGBA"
    return np.asarray(image).astype(int)


def test_png_clips_and_survives_nan(tmp_path):
    write_png(tmp_path / "a.png", np.array([[[-1.0, 2.0, np.nan]]]))
    assert read_png(tmp_path / "a.png").tolist() == [[[0, 1, 0]]]


def test_a_full_disk_leaves_no_part_of_a_picture(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))  # a limit of file sizes stands for the disk
    try:
        for name, write in (("a.png", write_png), ("a.exr", write_exr)):
            refused(DataError, rf"{name}: cannot be written .*File too large", write, tmp_path / name, rgba(99, 99))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("shape", [(4, 4), (4, 4, 2), (0, 4, 4), (4, 4, 5)])
def test_wrong_shapes_are_refused(tmp_path, shape):
    for name, write in (("a.png", write_png), ("a.exr", write_exr)):
        refused(DataError, "expected", write, tmp_path / name, np.zeros(shape))
    assert not list(tmp_path.iterdir())
