"""Spherical harmonics: order and signs of 3DGS, turns and reflections, the .ply, and that nothing loses them."""

import io
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.refused import refused
from tests.splat_twin import basis_slopes, view_slopes
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.cameras.types import camera_in_box
from vvgt_cli.conversion.resume import Checkpoint
from vvgt_cli.conversion.stages.refinement import without_undrawn
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import Gaussians, PlyOptions, as_stored, describe, in_unit_frame, read_ply, write_ply
from vvgt_cli.gaussians.frames import (
    UP_NAMES,
    basis,
    directions,
    mixing,
    rescale,
    transform,
    turn,
    turned,
    up_matrix,
    view_colors,
)
from vvgt_cli.gaussians.types import HARMONICS
from vvgt_cli.network.prepare import interpolate, pack
from vvgt_cli.splat import render
from vvgt_cli.splat.harmonics import deposit

DEGREES = (1, 2, 3)


def cloud(count: int = 60, degree: int = 3, seed: int = 0, size: float = 0.3) -> Gaussians:
    rng = np.random.default_rng(seed)
    terms = HARMONICS[degree]
    return Gaussians(
        rng.uniform(-0.6, 0.6, (count, 3)),
        np.log(0.1) + rng.normal(0, 0.4, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(0.5, 1, count),
        rng.uniform(0, 1, (count, 3)),
        rng.normal(0, size, (count, terms, 3)) if terms else None,
    )


def sphere(count: int = 200, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def orthogonal(seed: int, mirrored: bool) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * (-1 if (np.linalg.det(q) < 0) != mirrored else 1)


def written(gaussians: Gaussians, **options: object) -> bytes:
    stream = io.BytesIO()
    write_ply(stream, gaussians, PlyOptions(**options))
    return stream.getvalue()


def original(d: np.ndarray, sh: np.ndarray) -> np.ndarray:
    """`computeColorFromSH` of 3DGS (cuda_rasterizer/forward.cu), line by line, without the 0.5; ``sh`` (K, 16, 3)."""
    x, y, z = (d[:, i : i + 1] for i in range(3))
    c0, c1 = 0.28209479177387814, 0.4886025119029199
    c2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
    c3 = (
        *(-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154),
        *(-0.4570457994644658, 1.445305721320277, -0.5900435899266435),
    )
    s = [sh[:, i] for i in range(16)]
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    result = c0 * s[0] - c1 * y * s[1] + c1 * z * s[2] - c1 * x * s[3]
    result += c2[0] * xy * s[4] + c2[1] * yz * s[5] + c2[2] * (2 * zz - xx - yy) * s[6]
    result += c2[3] * xz * s[7] + c2[4] * (xx - yy) * s[8]
    result += c3[0] * y * (3 * xx - yy) * s[9] + c3[1] * xy * z * s[10] + c3[2] * y * (4 * zz - xx - yy) * s[11]
    result += c3[3] * z * (2 * zz - 3 * xx - 3 * yy) * s[12] + c3[4] * x * (4 * zz - xx - yy) * s[13]
    return result + c3[5] * z * (xx - yy) * s[14] + c3[6] * x * (xx - 3 * yy) * s[15]


def test_colours_are_those_of_the_original():
    g = cloud()
    eye = np.array([2.0, -1.5, 0.7])
    d, _ = directions(g.means, eye)
    f_dc = (g.colors.astype(np.float64) - 0.5) / 0.28209479177387814
    expected = 0.5 + original(d, np.concatenate([f_dc[:, None], g.harmonics], axis=1))
    np.testing.assert_allclose(view_colors(g, eye), expected, atol=1e-12)


def test_the_basis_is_that_of_the_books():
    """Of derivatives of Legendre's polynomials: real harmonics, m from -l to l, with the phase (-1)^m."""
    d = sphere()
    azimuth, columns = np.arctan2(d[:, 1], d[:, 0]), []
    for degree in DEGREES:
        legendre = np.polynomial.Legendre.basis(degree)
        for m in range(-degree, degree + 1):
            n = abs(m)
            norm = (2 * degree + 1) / (4 * np.pi) * math.factorial(degree - n) / math.factorial(degree + n)
            across = (-1) ** n * (1 - d[:, 2] ** 2) ** (n / 2) * legendre.deriv(n)(d[:, 2])
            around = np.sin(n * azimuth) if m < 0 else np.cos(n * azimuth)
            columns.append(np.sqrt(norm * (2 if m else 1)) * across * around)
    np.testing.assert_allclose(basis(d, 3), np.stack(columns, axis=1), atol=1e-12)


@pytest.mark.parametrize("degree", DEGREES)
def test_slopes_agree_with_central_differences(degree):
    d, h = sphere(), 1e-5
    slopes = basis_slopes(d, degree)
    for axis in range(3):
        step = h * np.eye(3)[axis]
        difference = (basis(d + step, degree) - basis(d - step, degree)) / (2 * h)
        np.testing.assert_allclose(slopes[:, :, axis], difference, atol=1e-8)
    g, eye = cloud(40, degree), np.array([0.4, -0.9, 0.8])
    loss = np.random.default_rng(1).normal(size=(40, 3))
    by_harmonics, by_means = view_slopes(g, eye, loss)
    for axis in range(3):  # moving the eye is moving all centres the other way
        high, low = (view_colors(g, eye - sign * h * np.eye(3)[axis]) for sign in (1, -1))
        expected = ((high - low) * loss).sum(axis=1) / (2 * h)
        np.testing.assert_allclose(by_means[:, axis], expected, atol=1e-7)
    step = np.random.default_rng(2).normal(size=g.harmonics.shape).astype(np.float32)
    change = view_colors(replace(g, harmonics=g.harmonics + step), eye) - view_colors(g, eye)
    assert (change * loss).sum() == pytest.approx((by_harmonics * step).sum(), rel=1e-5)


def test_a_centre_at_the_eye_has_its_base_colour_and_no_slope():
    g = cloud(3)
    eye = g.means[1].astype(np.float64)
    np.testing.assert_array_equal(view_colors(g, eye)[1], g.colors[1])
    assert np.isfinite(view_slopes(g, eye, np.ones((3, 3)))[1]).all()
    assert np.isfinite(render(g, look_at(tuple(eye), width=8, height=8, fov=40.0))).all()


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("degree", DEGREES)
def test_turned_harmonics_show_what_they_showed(degree, mirrored):
    d = sphere()
    for seed in range(20):
        matrix = orthogonal(seed, mirrored)
        mix = mixing(matrix, degree)
        np.testing.assert_allclose(basis(d @ matrix.T, degree) @ mix, basis(d, degree), atol=1e-12)
        np.testing.assert_allclose(mix @ mix.T, np.eye(HARMONICS[degree]), atol=1e-12)
        other = orthogonal(seed + 50, mirrored)
        np.testing.assert_allclose(mixing(other @ matrix, degree), mixing(other, degree) @ mix, atol=1e-12)


@pytest.mark.parametrize("up", UP_NAMES)
def test_up_turns_harmonics_with_the_gaussians(up):
    g, eye = cloud(), np.array([1.5, -2.0, 0.6])
    matrix = up_matrix(up)
    placed = turn(g, up)
    np.testing.assert_allclose(view_colors(placed, matrix @ eye), view_colors(g, eye), atol=2e-6)
    np.testing.assert_allclose(turn(placed, up, inverse=True).harmonics, g.harmonics, atol=1e-6)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_scene_seen_in_another_frame_is_the_same_picture(mirrored):
    g, camera = cloud(200, size=0.5), look_at((2.0, -1.7, 1.1), width=48, height=40, fov=40.0)
    matrix = orthogonal(3, mirrored)
    inside, flipped = camera_in_box(camera, matrix)
    assert flipped == mirrored
    picture = render(g, inside)
    np.testing.assert_allclose(
        render(transform(g, matrix), camera), picture[:, ::-1] if flipped else picture, atol=3e-4
    )
    plain = render(replace(g, harmonics=None), inside)
    assert np.abs(plain - picture).max() > 0.05  # they do matter


def test_a_shear_turns_by_the_nearest_rotation_and_a_scale_by_none():
    g = cloud()
    np.testing.assert_allclose(transform(g, 3 * np.eye(3)).harmonics, g.harmonics, rtol=1e-6)
    np.testing.assert_array_equal(rescale(g, 3.0, np.ones(3), np.zeros(3)).harmonics, g.harmonics)
    matrix = orthogonal(5, False) @ np.diag([1.0, 2.0, 0.5])
    left, _, right = np.linalg.svd(matrix)
    np.testing.assert_allclose(transform(g, matrix).harmonics, turned(g, left @ right), atol=1e-6)


@pytest.mark.parametrize("degree", DEGREES)
def test_the_file_holds_them_channel_by_channel_and_comes_back_to_the_byte(degree):
    g = cloud(7, degree)
    content = written(g)
    terms = HARMONICS[degree]
    rows = np.frombuffer(content.split(b"end_header\n", 1)[1], "<f4").reshape(7, -1)
    assert rows.shape[1] == 17 + 3 * terms
    np.testing.assert_array_equal(rows[:, 9 : 9 + terms], g.harmonics[:, :, 0])  # red first
    np.testing.assert_array_equal(rows[:, 9 + 2 * terms : 9 + 3 * terms], g.harmonics[:, :, 2])
    back, header = read_ply(io.BytesIO(content))
    assert (header.sh_degree, back.degree) == (degree, degree)
    np.testing.assert_array_equal(back.harmonics, g.harmonics)
    assert written(back) == content
    assert describe(back, header)["harmonics_largest"] == np.abs(g.harmonics).max()


@pytest.mark.parametrize("degree", DEGREES)
def test_zeros_are_padding_and_a_negative_zero_is_not(degree):
    g = cloud(7, 0)
    content = written(g, sh_degree=degree)
    back, header = read_ply(io.BytesIO(content))
    assert (header.sh_degree, back.harmonics) == (degree, None)
    assert written(back, sh_degree=header.sh_degree) == content
    zeros = g.of_degree(degree)
    assert written(zeros) == content
    zeros.harmonics[3, 0, 1] = -0.0
    content = written(zeros)
    assert written(read_ply(io.BytesIO(content))[0]) == content


def test_the_degree_of_a_file_is_the_one_that_is_asked_for():
    g = cloud(7, 2)
    lower, header = read_ply(io.BytesIO(written(g, sh_degree=1)))
    assert header.sh_degree == 1
    np.testing.assert_array_equal(lower.harmonics, g.harmonics[:, :3])
    higher, header = read_ply(io.BytesIO(written(g, sh_degree=3)))
    assert header.sh_degree == 3
    np.testing.assert_array_equal(higher.harmonics[:, :8], g.harmonics)
    assert not higher.harmonics[:, 8:].any()
    none, header = read_ply(io.BytesIO(written(g, sh_degree=0)))
    assert (header.sh_degree, none.harmonics) == (0, None)
    assert written(none) == written(replace(g, harmonics=None))
    with pytest.raises(UsageError, match="0 to 3"):
        PlyOptions(sh_degree=4)


@pytest.mark.parametrize("up", ["none", "z", "-x"])
@pytest.mark.parametrize("frame", ["unit", "world"])
def test_files_of_other_frames_come_back(frame, up):
    g, eye = cloud(), np.array([1.5, -2.0, 0.6])
    place = {"scale": 0.013, "centre": (-120.0, 35.5, 100.0)}
    stored, header = read_ply(io.BytesIO(written(g, frame=frame, up=up, **place)))
    back = in_unit_frame(stored, header)
    np.testing.assert_allclose(back.harmonics, g.harmonics, atol=1e-6)
    np.testing.assert_allclose(view_colors(back, eye), view_colors(as_stored(g), eye), atol=1e-4)
    if up != "none":
        assert np.abs(stored.harmonics - g.harmonics).max() > 0.1


GOOD = written(cloud(3, 1))
LIES = {
    "nan": (GOOD[: -4 * 9] + np.float32(np.nan).tobytes() + GOOD[-4 * 8 :], "harmonics: 1 of 3 rows are not finite"),
    "names": (
        GOOD.replace(b"f_rest_8", b"f_rest_9"),
        "f_rest_9 among 9 f_rest properties; expected them from f_rest_0",
    ),
    "double": (GOOD.replace(b"float f_rest_8", b"double f_rest_8"), "f_rest_8 is double; expected float"),
    "count": (GOOD.replace(b"f_rest_8", b"rest"), "8 f_rest properties"),
}


@pytest.mark.parametrize("case", LIES)
def test_files_that_lie_get_one_line(case):
    content, message = LIES[case]
    refused(DataError, message, read_ply, io.BytesIO(content))


def test_shapes_that_cannot_be():
    g = cloud(5)
    for shape in ((5, 4, 3), (4, 3, 3), (5, 3), (5, 0, 3), (5, 3, 1)):
        with pytest.raises(DataError, match=r"harmonics: shape .* expected \(5, 3, 3\) or \(5, 8, 3\) or"):
            replace(g, harmonics=np.zeros(shape))
    assert cloud(0, 2).take(np.zeros(0, int)).harmonics.shape == (0, 8, 3)


def test_what_makes_gaussians_of_gaussians_keeps_their_harmonics(tmp_path):
    g = cloud()
    order = np.random.default_rng(0).permutation(60)[:40]
    np.testing.assert_array_equal(g.take(order).harmonics, g.harmonics[order])
    np.testing.assert_array_equal(as_stored(g).harmonics, g.harmonics)
    bright = replace(g, opacity_logits=np.where(np.arange(60) < 10, -9.0, 2.0))
    np.testing.assert_array_equal(without_undrawn(bright, 400).harmonics, g.harmonics[10:])
    kept = Checkpoint(tmp_path, "key")
    kept.save("fitted.npz", g)
    back = kept.load("fitted.npz")[0]
    assert {name: array.tobytes() for name, array in back.arrays().items()} == {
        name: array.tobytes() for name, array in g.arrays().items()
    }
    kept.save("fitted.npz", replace(g, harmonics=None))
    assert kept.load("fitted.npz")[0].harmonics is None
    half = interpolate(g, replace(g, harmonics=3 * g.harmonics), 0.5)
    np.testing.assert_allclose(half.harmonics, 2 * g.harmonics, rtol=1e-6)


def test_networks_refuse_them_in_one_line():
    refused(DataError, r"degree 3: a network supports only colours .* degree 0", pack, cloud())


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_slopes_of_one_channel_alone_are_deposited(degree):
    """Those of the colour times the terms that it is a sum of, 1 first."""
    rng, eye = np.random.default_rng(3), np.array([2.0, -1.0, 0.5])
    means, values = rng.uniform(-1, 1, (5, 3)).astype(np.float32), np.array([*np.eye(3), [0, 0, 0], [1, -2, 3]])
    toward = (means - eye) / np.linalg.norm(means - eye, axis=1, keepdims=True)
    terms = np.concatenate([np.ones((5, 1)), basis(toward, degree)], axis=1)
    out = np.ones((5, terms.shape[1], 3))
    deposit(means, eye, values, out)
    np.testing.assert_allclose(out, 1 + terms[:, :, None] * values[:, None, :], atol=1e-6)
