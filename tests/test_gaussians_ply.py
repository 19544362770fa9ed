"""The .ply: layout, bitwise round trips, frames, and files that lie."""

import io
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.random_clouds import turns
from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import SH_C0, Gaussians, PlyOptions, as_stored, describe, in_unit_frame, read_ply, write_ply
from vvgt_cli.gaussians.ply import colors_to_f_dc, f_dc_to_colors
from vvgt_cli.volume.types import Volume

FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "colors")
MODERATE = st.floats(-(2.0**100), 2.0**100, width=32)


def random_gaussians(count=50, seed=0):
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-1, 1, (count, 3)), rng.normal(-4, 1, (count, 3)), rng.normal(size=(count, 4)),
        rng.normal(size=count), rng.uniform(-0.5, 2, (count, 3)),
    )  # fmt: skip


def written(gaussians, **options):
    stream = io.BytesIO()
    assert write_ply(stream, gaussians, PlyOptions(**options)) == len(stream.getvalue())
    return stream.getvalue()


def same_bytes(a, b):
    return all(getattr(a, f).tobytes() == getattr(b, f).tobytes() for f in FIELDS)


@st.composite
def any_gaussians(draw):
    count = draw(st.integers(1, 6))
    quaternions = draw(arrays(np.float32, (count, 4), elements=MODERATE))
    quaternions[~quaternions.any(axis=1), 0] = 1
    return Gaussians(
        draw(arrays(np.float32, (count, 3), elements=MODERATE)),
        draw(arrays(np.float32, (count, 3), elements=MODERATE)),
        quaternions,
        draw(arrays(np.float32, count, elements=MODERATE)),
        draw(arrays(np.float32, (count, 3), elements=st.one_of(MODERATE, st.floats(0, 1, width=32)))),
    )


@given(any_gaussians(), st.integers(0, 3), st.booleans())
def test_round_trip_is_bitwise(gaussians, degree, comments):
    content = written(gaussians, sh_degree=degree, comments=comments)
    again, header = read_ply(io.BytesIO(content))
    assert (header.count, header.sh_degree) == (len(gaussians), degree)
    assert same_bytes(again, as_stored(gaussians))  # everything but the colours is the input, bit for bit
    for field in FIELDS[:-1]:
        assert getattr(again, field).tobytes() == getattr(gaussians, field).tobytes()
    assert written(again, sh_degree=degree, comments=comments) == content


@given(arrays(np.uint32, (64, 3), elements=st.integers(0, 2**32 - 1)))
def test_color_conversions_are_a_generalised_inverse_pair_on_all_floats(bits):
    values = bits.view(np.float32)
    values = np.where(np.isfinite(values) & (np.abs(values) < 1e37), values, np.float32(0.3))
    f_dc = colors_to_f_dc(values)
    np.testing.assert_array_equal(colors_to_f_dc(f_dc_to_colors(f_dc)), f_dc)
    colors = f_dc_to_colors(values)
    np.testing.assert_array_equal(f_dc_to_colors(colors_to_f_dc(colors)), colors)


def test_color_conversions_at_the_seams_where_float_spacing_changes():
    seams = np.concatenate([2.0 ** np.arange(-30, 30), np.float32(0.5 + SH_C0 * 2.0 ** np.arange(-30, 20))])
    seams = np.concatenate([seams, -seams, 0.5 - seams]).astype(np.float32)
    near = (seams.view(np.int32)[:, None] + np.arange(-50, 51)).astype(np.int32).view(np.float32)
    f_dc = colors_to_f_dc(near)
    np.testing.assert_array_equal(colors_to_f_dc(f_dc_to_colors(f_dc)), f_dc)
    colors = f_dc_to_colors(near)
    np.testing.assert_array_equal(f_dc_to_colors(colors_to_f_dc(colors)), colors)


def test_layout_is_the_one_that_loaders_count_on():
    header, data = written(random_gaussians(7)).split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    assert lines[:4] == ["ply", "format binary_little_endian 1.0", "element vertex 7", "property float x"]
    order = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert " ".join(line.split()[2] for line in lines if line.startswith("property")) == order
    assert [line.startswith("comment") for line in lines[20:]] == [True] * len(lines[20:])
    rows = np.frombuffer(data, "<f4").reshape(7, 17)
    gaussians = random_gaussians(7)
    assert not rows[:, 3:6].any()
    np.testing.assert_array_equal(rows[:, :3], gaussians.means)
    np.testing.assert_array_equal(rows[:, 9], gaussians.opacity_logits)
    np.testing.assert_array_equal(rows[:, 10:13], gaussians.log_scales)
    np.testing.assert_array_equal(rows[:, 13:], gaussians.quaternions)
    np.testing.assert_allclose(0.5 + SH_C0 * rows[:, 6:9], gaussians.colors, atol=1e-6)


@pytest.mark.parametrize(("degree", "size"), [(0, 68), (1, 104), (2, 164), (3, 248)])
def test_sh_padding_is_zero_and_comments_are_optional(degree, size):
    content = written(random_gaussians(3), sh_degree=degree, comments=False)
    assert b"comment" not in content
    rows = np.frombuffer(content.split(b"end_header\n", 1)[1], "<f4").reshape(3, size // 4)
    assert not rows[:, 9 : size // 4 - 8].any()


def test_a_path_is_written_like_a_stream(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, random_gaussians())
    assert path.read_bytes() == written(random_gaussians())
    assert same_bytes(read_ply(path)[0], as_stored(random_gaussians()))


def covariance(gaussians):
    scaled = turns(gaussians.quaternions.astype(float)) * np.exp(gaussians.log_scales.astype(float))[:, None, :]
    return scaled @ scaled.transpose(0, 2, 1)


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_up_turns_means_and_covariances_alike(up):
    gaussians = random_gaussians()
    turned, _ = read_ply(io.BytesIO(written(gaussians, up=up)))
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1 if up[0] == "-" else 1
    # a viewer shows PLY (x, y, z) as (-x, -y, z) with +y up: the axis must come out at PLY -y
    np.testing.assert_allclose(turned.means[:, 1], -(gaussians.means @ axis), atol=1e-7)
    rotation, *_ = np.linalg.lstsq(gaussians.means.astype(float), turned.means.astype(float), rcond=None)
    assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-5)
    expected = rotation.T @ covariance(gaussians) @ rotation
    np.testing.assert_allclose(covariance(turned), expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("up", ["none", "z"])
def test_world_frame_is_the_volumes_and_comes_back(up):
    volume = Volume(np.zeros((4, 6, 8), np.uint8), spacing=(2.0, 1.0, 0.5), origin=(10.0, 20.0, 30.0))
    gaussians = random_gaussians()
    frame = volume.unit_frame()
    place = {"scale": frame.scale, "centre": frame.centre}
    content = written(gaussians, frame="world", up=up, **place, unit_distance=1.5)
    world, header = read_ply(io.BytesIO(content))
    assert (header.frame, header.unit_distance, header.unit_distance_label) == ("world", 1.5, "given")
    if up == "none":  # unit +1 along x is the face of the box, half a voxel beyond the last centre
        centre = np.array([10 + 7 * 2 / 2, 20 + 5 / 2, 30 + 3 * 0.5 / 2])
        np.testing.assert_allclose(world.means, centre + gaussians.means * 8.0, rtol=1e-6)
    np.testing.assert_allclose(np.exp(world.log_scales), 8.0 * np.exp(gaussians.log_scales), rtol=1e-5)
    back = in_unit_frame(world, header)
    np.testing.assert_allclose(back.means, gaussians.means, atol=1e-6)
    np.testing.assert_allclose(covariance(back), covariance(gaussians), rtol=1e-4, atol=1e-9)


def test_options_and_values_that_cannot_be_written():
    refused(UsageError, "0 to 3", PlyOptions, sh_degree=4)
    refused(UsageError, "unit frame", write_ply, io.BytesIO(), random_gaussians(), PlyOptions(frame="world"))
    refused(UsageError, "expected one of none", PlyOptions, up="w")
    nothing = random_gaussians().take(np.zeros(0, int))
    refused(DataError, "at least one", write_ply, io.BytesIO(), nothing)
    bright = Gaussians(np.zeros((1, 3)), np.zeros((1, 3)), np.ones((1, 4)), np.zeros(1), np.full((1, 3), 3e38))
    refused(DataError, "too large", write_ply, io.BytesIO(), bright)
    flat = Gaussians(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 4)), np.zeros(1), np.zeros((1, 3)))
    refused(DataError, "quaternions are zero", write_ply, io.BytesIO(), flat)


GOOD = written(random_gaussians(3))
LIES = {
    "ascii": (GOOD.replace(b"binary_little_endian", b"ascii"), "format ascii"),
    "big": (GOOD.replace(b"binary_little_endian", b"binary_big_endian"), "format binary_big_endian"),
    "no format": (GOOD.replace(b"format binary_little_endian 1.0\n", b""), "format missing"),
    "magic": (b"plx" + GOOD[3:], "not with 'ply'"),
    "empty": (b"", "not with 'ply'"),
    "endless": (GOOD.split(b"end_header")[0], "no 'end_header'"),
    "count": (GOOD.replace(b"vertex 3", b"vertex 999999999999"), "truncated"),
    "negative": (GOOD.replace(b"vertex 3", b"vertex -3"), "whole number"),
    "truncated": (GOOD[:-1], "truncated"),
    "longer": (GOOD + b"\0", "followed by"),
    "mesh": (GOOD.replace(b"element vertex 3", b"element face 3"), "expected one element"),
    "second": (GOOD.replace(b"end_header", b"element face 0\nend_header"), "header line"),
    "missing": (GOOD.replace(b"float scale_1", b"float size_1"), "no scale_1"),
    "twice": (GOOD.replace(b"float ny", b"float nx"), "twice"),
    "double": (GOOD.replace(b"float opacity", b"double opacity"), "expected float"),
    "list": (GOOD.replace(b"property float nx", b"property list uchar int nx"), "scalar type"),
    "rest": (GOOD.replace(b"float nx", b"float f_rest_0"), "1 f_rest properties"),
    "comment": (GOOD.replace(b"vvgt up none", b"vvgt up wide"), "expected one that vvgt writes"),
    "world": (GOOD.replace(b"frame unit", b"frame world"), "scale and centre"),
    "binary": (GOOD.replace(b"vvgt up", b"vvgt \xff\xfe"), "not text"),
    "nan": (GOOD[:-4] + np.float32(math.nan).tobytes(), "not finite"),
    "zero": (GOOD[:-16] + bytes(16), "quaternions are zero"),
}


@pytest.mark.parametrize("case", LIES)
def test_files_that_lie_get_one_line(case, tmp_path):
    content, message = LIES[case]
    path = tmp_path / "lie.ply"
    path.write_bytes(content)
    for source in (path, io.BytesIO(content)):
        refused(DataError, message, read_ply, source)


def test_other_programs_property_order_is_read():
    fields = [*"xyz", "red", "opacity", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2"]
    fields += ["f_dc_0", "f_dc_1", "f_dc_2"]
    rows = np.zeros(2, np.dtype([(f, "u1" if f == "red" else "<f4") for f in fields]))
    rows["rot_0"], rows["y"], rows["opacity"] = 1, (3, 4), (5, 6)
    comments = ("by hand", "vvgt later a fact of a later version")
    header = "ply\r\nformat binary_little_endian 1.0\r\nobj_info none\r\n\r\n"
    header += "".join(f"comment {c}\r\n" for c in comments)
    header += "element vertex 2\r\n"
    header += "".join(f"property {'uchar' if f == 'red' else 'float'} {f}\r\n" for f in fields) + "end_header\r\n"
    gaussians, parsed = read_ply(io.BytesIO(header.encode() + rows.tobytes()))
    assert (gaussians.means[:, 1].tolist(), gaussians.opacity_logits.tolist()) == ([3, 4], [5, 6])
    assert (parsed.comments, parsed.version, parsed.frame) == (comments, None, "unit")


def test_describe_counts_and_ranges():
    gaussians, header = read_ply(io.BytesIO(written(random_gaussians(20), up="y")))
    summary = describe(gaussians, header)
    assert (summary["gaussians"], summary["bytes_per_gaussian"], summary["up"]) == (20, 68, "y")
    for key, values in (("sigma", np.exp(gaussians.log_scales)), ("opacity", gaussians.opacity)):
        assert summary[key] == pytest.approx([values.min(), np.median(values), values.max()], rel=1e-5)
    for key, values in (("box", gaussians.means), ("color", gaussians.colors)):
        ends = values.min(axis=0).tolist(), values.max(axis=0).tolist()
        assert (summary[f"{key}_min"], summary[f"{key}_max"]) == ends


@pytest.mark.long
def test_five_million_gaussians_round_trip(tmp_path):
    gaussians = random_gaussians(5_000_000)
    write_ply(tmp_path / "big.ply", gaussians, PlyOptions(sh_degree=1))
    assert same_bytes(read_ply(tmp_path / "big.ply")[0], as_stored(gaussians))
