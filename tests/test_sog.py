"""SOG: what is written against decoding written down pixel by pixel, codebooks against trying all, bad archives."""

import io
import itertools
import json
import math
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.random_clouds import turns
from tests.refused import refused
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.sog import (
    COMMENTS,
    META,
    SIZE,
    best_intervals,
    codebook,
    edges,
    nearest_turn,
    palette,
    places_in,
    read_sog,
    sog,
)
from vvgt_cli.gaussians.formats.splats import Splats, morton_order

COUNTS = {0: 0, 1: 3, 2: 8, 3: 15}


def some(count: int = 300, degree: int = 0) -> Splats:
    rng = np.random.default_rng(count + degree)
    quaternions = rng.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    columns = (
        rng.normal(0, 2, (count, 3)), rng.uniform(-6, 0, (count, 3)), quaternions, rng.normal(0, 3, count),
        rng.uniform(-1.7, 1.7, (count, 3)), rng.uniform(-0.8, 0.8, (count, COUNTS[degree], 3)),
    )  # fmt: skip
    return Splats(*(column.astype(np.float32) for column in columns), comments=("a line", "another"))


def members(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zipped(files: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content, compress_type=method)
    return stream.getvalue()


def decoded(files: dict[str, bytes], i: int) -> tuple[list[float], ...]:
    """Gaussian i as the engine's `GSplatSogIterator` reads it: mean, log-scales, (w, x, y, z), opacity, harmonics."""
    meta = json.loads(files[META])

    def texel(name: str, at: int) -> tuple[int, ...]:
        with Image.open(io.BytesIO(files[name])) as image:
            return image.convert("RGBA").getpixel((at % image.width, at // image.width))

    low, high = texel("means_l.webp", i), texel("means_u.webp", i)
    mean = []
    for a in range(3):
        t = ((high[a] << 8) + low[a]) / 65535
        n = meta["means"]["mins"][a] * (1 - t) + meta["means"]["maxs"][a] * t
        mean.append(math.copysign(math.exp(abs(n)) - 1, n))
    q = texel("quats.webp", i)
    a, b, c = ((v / 255 - 0.5) * math.sqrt(2) for v in q[:3])
    d = math.sqrt(max(0.0, 1 - (a * a + b * b + c * c)))
    turn = [[d, a, b, c], [a, d, b, c], [a, b, d, c], [a, b, c, d]][q[3] - 252]
    scales = [meta["scales"]["codebook"][v] for v in texel("scales.webp", i)[:3]]
    color = texel("sh0.webp", i)
    harmonics = [meta["sh0"]["codebook"][v] for v in color[:3]]
    if "shN" in meta:
        each, label = COUNTS[meta["shN"]["bands"]], texel("shN_labels.webp", i)
        n = label[0] + (label[1] << 8)
        for k in range(each):
            at = n % 64 * each + k + n // 64 * 64 * each
            harmonics += [meta["shN"]["codebook"][v] for v in texel("shN_centroids.webp", at)[:3]]
    return mean, scales, turn, [color[3] / 255], harmonics


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_pixel_decodes_as_in_the_engine(degree: int) -> None:
    before = some(70, degree)
    content = sog(before, "a")
    files, after = members(content), read_sog(content, "a")
    before = before.take(morton_order(before.means))
    turned, scaled = nearest_turn(before.quaternions, before.log_scales)
    opacities = 1 / (1 + np.exp(-before.logits.astype(np.float64)))
    assert after.comments == ("a line", "another")
    for i in range(70):
        mean, scales, turn, opacity, harmonics = decoded(files, i)
        ours = np.concatenate([after.f_dc[i], after.f_rest[i].ravel()])
        opacity_read = 1 / (1 + math.exp(-float(after.logits[i])))
        for found, expected in (
            (mean, after.means[i]), (scales, after.log_scales[i]), (turn, after.quaternions[i]),
            (opacity, [opacity_read]), (harmonics, ours),
        ):  # fmt: skip
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-6)
        assert abs(np.array(mean) - before.means[i]).max() < 1e-4 * (1 + abs(before.means[i]).max())
        assert abs(np.array(scales) - scaled[i]).max() < 0.02
        assert abs(np.dot(turn, turned[i])) > 1 - 3e-5
        assert abs(opacity[0] - opacities[i]) <= 0.5 / 255 + 1e-6
        assert abs(np.array(harmonics[:3]) - before.f_dc[i]).max() < 0.01
        assert abs(ours[3:] - before.f_rest[i].ravel()).max(initial=0) < 0.01


@pytest.mark.parametrize(
    ("count", "expected"),
    [(1, (4, 4)), (17, (8, 4)), (4096**2, (4096, 4096)), (4096**2 + 1, (4100, 4096)), (1 << 26, (8192, 8192))],
)
def test_images_are_as_wide_as_high_up_to_4096_px(count: int, expected: tuple[int, int]) -> None:
    """Many GPUs hold textures of 4,096 px, few of more than 16,384, which is WebP's limit, too."""
    assert edges(count) == expected
    assert expected[0] * expected[1] >= count


def matrices(quaternions: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    turn = turns(quaternions)
    return (turn * np.exp(2 * log_scales)[:, None]) @ turn.transpose(0, 2, 1)


def test_the_nearest_turn_is_the_same_ellipsoid() -> None:
    s = some(2000)
    before = s.quaternions.astype(np.float64), s.log_scales.astype(np.float64)
    after = nearest_turn(*before)
    np.testing.assert_allclose(matrices(*after), matrices(*before), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(after[0], axis=1), 1, rtol=1e-5)
    assert abs(after[0][:, 0]).min() > 0.85  # cos(62.8 degrees / 2): no turn is further from the 24
    assert (abs(after[0]).argmax(axis=1) == 0).all()


def test_intervals_are_the_best_of_all() -> None:
    rng = np.random.default_rng(2)
    for count in (2, 3, 4):
        means, weights = np.sort(rng.normal(size=11)), rng.uniform(0.2, 3, 11)

        def error(cuts: tuple[int, ...], means: np.ndarray = means, weights: np.ndarray = weights) -> float:
            parts = zip(np.split(means, cuts), np.split(weights, cuts), strict=True)
            return sum(float((w * (m - np.average(m, weights=w)) ** 2).sum()) for m, w in parts)

        best = min(itertools.combinations(range(1, 11), count - 1), key=error)
        expected = [
            np.average(m, weights=w)
            for m, w in zip(np.split(means, best), np.split(weights, best), strict=True)
        ]  # fmt: skip
        np.testing.assert_allclose(best_intervals(means, weights, count), expected, rtol=1e-12)


def test_a_codebook_holds_few_values_exactly_and_many_within_its_steps() -> None:
    few = np.array([[3.0, -1.0], [2.5, 3.0]], np.float32)
    book = codebook(few)
    assert (len(book), set(book)) == (SIZE, {-1.0, 2.5, 3.0})
    assert (book[places_in(book, few)] == few).all()
    many = np.random.default_rng(1).uniform(-4, 9, 30_000).astype(np.float32)
    book = codebook(many)
    assert (np.diff(book) > 0).all()
    assert np.sqrt(np.mean((book[places_in(book, many)] - many) ** 2)) < 1.05 * 13 / SIZE / math.sqrt(12)


def test_a_palette_holds_clusters() -> None:
    rng = np.random.default_rng(3)
    centres = rng.uniform(-9, 9, (40, 9))
    number = rng.integers(0, 40, 3000)
    rows, labels = palette(centres[number] + rng.normal(0, 1e-3, (3000, 9)), 40)
    assert rows.shape == (40, 9)
    assert abs(rows[labels] - centres[number]).max() < 0.02
    rows, labels = palette(centres[number], 64)
    assert len(rows) == 40  # equal rows are not cut
    np.testing.assert_allclose(rows[labels], centres[number], rtol=1e-6)


def test_the_same_gaussians_make_the_same_bytes() -> None:
    assert sog(some(500, 1), "a") == sog(some(500, 1), "a")


def changed(change: Callable[[Any], None]) -> bytes:
    files = members(sog(some(50, 1), "a"))
    meta = json.loads(files[META])
    change(meta)
    return zipped(files | {META: json.dumps(meta).encode()})


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda m: m.update(version=1), "has version 1; expected SOG of version 2"),
        (lambda m: m.update(count=10**9), "has count 1000000000"),
        (lambda m: m["means"].update(maxs=[1, 2, 500]), "float32"),
        (lambda m: m["means"].update(files=["../../etc/passwd", "x"]), "no '../../etc/passwd' in the archive"),
        (lambda m: m["scales"].update(codebook=[10**400] * 256), "no codebook of scales"),
        (lambda m: m["sh0"]["codebook"].__setitem__(3, None), "no codebook of sh0"),
        (lambda m: m["shN"].update(bands=2), "lines of 512"),
        (lambda m: m.update(quats=m["scales"]), "their largest component"),
    ],
)
def test_facts_that_cannot_be_are_one_line(change: Callable[[Any], None], text: str) -> None:
    content = changed(change)
    if "largest component" in text:  # the alpha of another image
        files = members(content)
        with Image.open(io.BytesIO(files["sh0.webp"])) as image:
            stream = io.BytesIO()
            image.save(stream, "WEBP", lossless=True, exact=True)
        content = zipped(files | {"scales.webp": stream.getvalue()})
    with pytest.raises(DataError) as error:
        read_sog(content, "bad.sog")
    assert text in str(error.value)
    assert str(error.value).startswith("bad.sog: ")
    assert "\n" not in str(error.value)


def test_small_archives_that_unpack_to_much_are_refused() -> None:
    files = members(sog(some(50), "a"))
    bomb = zipped(files | {META: b"[" + b" " * (1 << 24) + b"]"}, zipfile.ZIP_DEFLATED)
    assert len(bomb) < 1 << 17
    refused(DataError, "has 16,777,218 bytes; expected at most 1,048,576", read_sog, bomb, "bad.sog")
    stream = io.BytesIO()
    Image.new("RGBA", (8000, 8000)).save(stream, "WEBP", lossless=True, method=0, quality=0)
    refused(DataError, "is of 8000 x 8000 px", read_sog, zipped(files | {"means_l.webp": stream.getvalue()}), "bad.sog")


def test_archives_of_others_are_read() -> None:
    files = members(sog(some(50), "a"))
    del files[COMMENTS]
    assert read_sog(zipped(files, zipfile.ZIP_DEFLATED), "a").comments == ()
