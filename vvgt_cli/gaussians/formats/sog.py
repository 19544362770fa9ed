"""PlayCanvas' SOG, version 2: Gaussians as images, one pixel each, with JSON metadata, in an uncompressed zip.

The format is that read by the engine 2.23.3 and splat-transform 3.7.0:

| image | red, green, blue | alpha |
| --- | --- | --- |
| `means_l`, `means_u` | low and high byte of sign(x) log(1 + abs(x)), in 65,535 steps from `mins` to `maxs` | 255 |
| `quats` | the three smaller components, from -1/sqrt(2) to 1/sqrt(2), in the order w, x, y, z; the largest is positive | 252 plus the number of the largest |
| `scales` | indices of the log-scales in a codebook of 256 | 255 |
| `sh0` | indices of the harmonics of degree 0 in another codebook | opacity times 255 |
| `shN_labels` | row of the palette, low and high byte | 255 |
| `shN_centroids` | 64 rows of the palette per line, 3, 8 or 15 pixels each: indices in a codebook | 255 |
"""  # noqa: E501

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians.formats.splats import DEGREES, Splats, morton_order, opacities_of
from vvgt_cli.gaussians.header import MIP
from vvgt_cli.gaussians.opacity import logits_of
from vvgt_cli.gaussians.types import HARMONICS
from vvgt_cli.version import VERSION
from vvgt_cli.volume.libraries import library_errors

MAX_GAUSSIANS = 1 << 26  # Gaussians in one set of images
META = "meta.json"
IMAGES = ("means_l", "means_u", "quats", "scales", "sh0", "shN_centroids", "shN_labels")
_STEPS, _BYTE = 65535, 255
_FIRST = 252  # alpha of a quaternion whose w is the largest
_ROW = 64  # rows of the palette per line of `shN_centroids`
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
_SPARE = 4096  # pixels that an image may have beyond four per Gaussian
_LARGEST_LOG = 80.0  # of a coordinate; float32 overflows at 88


def edges(count: int) -> tuple[int, int]:
    """Return width and height, multiples of 4 px, of images that hold ``count`` > 0 pixels."""
    width = 4 * math.ceil(math.sqrt(count) / 4)
    return width, 4 * math.ceil(count / width / 4)


def images_of(splats: Splats) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Encode columns as images by name, (h, w, 4) uint8, and the content of `meta.json`, keeping their order."""
    count = len(splats)
    width, height = edges(count)

    def image(columns: np.ndarray, alpha: np.ndarray | int = _BYTE) -> np.ndarray:
        pixels = np.zeros((height * width, 4), np.uint8)
        pixels[:count, : columns.shape[1]], pixels[:count, 3] = columns, alpha
        return pixels.reshape(height, width, 4)

    means = splats.means.astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(axis=0), logs.max(axis=0)
    steps = np.rint((logs - low) / np.where(high > low, high - low, 1.0) * _STEPS).astype(np.int64)
    quaternions, log_scales = nearest_turn(splats.quaternions, splats.log_scales)
    largest = np.abs(quaternions).argmax(axis=1)
    signs = np.where(np.take_along_axis(quaternions, largest[:, None], axis=1) < 0, -1.0, 1.0)
    others = np.take_along_axis(quaternions * signs, _OTHERS[largest], axis=1)
    scales, colors = codebook(log_scales), codebook(splats.f_dc)
    opacities = np.rint(opacities_of(splats.logits).astype(np.float64) * _BYTE)
    images = {
        "means_l.webp": image(steps & _BYTE),
        "means_u.webp": image(steps >> 8),
        "quats.webp": image(np.rint((others / math.sqrt(2) + 0.5) * _BYTE).clip(0, _BYTE), _FIRST + largest),
        "scales.webp": image(places_in(scales, log_scales)),
        "sh0.webp": image(places_in(colors, splats.f_dc), opacities),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": f"vvgt {VERSION}"},
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors.tolist(), "files": ["sh0.webp"]},
    }
    if splats.f_rest.shape[1]:
        few = LARGEST_PALETTE  # as many as splat-transform makes
        while few > max(count, 1024):
            few //= 2
        rows, labels = palette(splats.f_rest.reshape(count, -1), few)
        rows = rows.reshape(len(rows), -1, 3)
        book = codebook(rows)
        lines = np.zeros((math.ceil(len(rows) / _ROW) * _ROW, rows.shape[1], 4), np.uint8)
        lines[: len(rows), :, :3], lines[: len(rows), :, 3] = places_in(book, rows), _BYTE
        images["shN_centroids.webp"] = lines.reshape(-1, _ROW * rows.shape[1], 4)
        images["shN_labels.webp"] = image(np.stack([labels & _BYTE, labels >> 8], axis=1))
        meta["shN"] = {
            "count": len(rows),
            "bands": DEGREES[rows.shape[1]],
            "codebook": book.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    return images, meta


def webp(image: np.ndarray) -> bytes:
    """Encode an image (h, w, 4) uint8 as lossless WebP."""
    from PIL import Image

    stream = io.BytesIO()
    # other methods take up to 70 times as long for files that are no smaller
    Image.fromarray(image).save(stream, "WEBP", lossless=True, quality=30, method=1, exact=True)
    return stream.getvalue()


def splats_in(meta: Any, read: Callable[[str], bytes], name: str) -> Splats:
    """Decode the columns that ``meta``, the parsed `meta.json`, describes, without comments, or raise DataError."""
    if not isinstance(meta, dict) or meta.get("version") != 2:
        found = meta.get("version") if isinstance(meta, dict) else None
        raise DataError(f"{name}: {META} has version {found!r:.40}; expected SOG of version 2")
    count = meta.get("count")
    if type(count) is not int or not 0 < count <= MAX_GAUSSIANS:
        raise DataError(f"{name}: {META} has count {count!r:.40}; expected 1 to {MAX_GAUSSIANS}")

    def pixels(part: str, number: int = 0, width: int = 0, needed: int = count) -> np.ndarray:
        return _pixels(read, _files(meta, part, name), number, width, needed, name)

    low, high = (_numbers(meta, "means", key, 3, name) for key in ("mins", "maxs"))
    if max(np.abs(low).max(), np.abs(high).max()) > _LARGEST_LOG:
        raise DataError(
            f"{name}: {META} has means up to exp({max(np.abs(low).max(), np.abs(high).max()):.4g}); expected the range "
            "of float32"
        )
    steps = pixels("means")[:, :3] + 256.0 * pixels("means", 1)[:, :3]
    logs = low + (high - low) * (steps / _STEPS)
    quats = pixels("quats")
    if quats[:, 3].min() < _FIRST:
        raise DataError(f"{name}: quats have {quats[:, 3].min()} as their largest component; expected 252 to 255")
    sh0 = pixels("sh0")
    return Splats(
        (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32),
        _numbers(meta, "scales", "codebook", SIZE, name)[pixels("scales")[:, :3]].astype(np.float32),
        _quaternions(quats),
        logits_of(sh0[:, 3] / np.float32(_BYTE)),
        _numbers(meta, "sh0", "codebook", SIZE, name)[sh0[:, :3]].astype(np.float32),
        _harmonics(meta, pixels, name) if meta.get("shN") else np.zeros((count, 0, 3), np.float32),
    )


def _quaternions(pixels: np.ndarray) -> np.ndarray:
    others = (pixels[:, :3] / _BYTE - 0.5) * math.sqrt(2)
    largest = pixels[:, 3].astype(np.int64) - _FIRST
    result = np.zeros((len(pixels), 4))
    np.put_along_axis(result, _OTHERS[largest], others, axis=1)
    rest = np.sqrt(np.maximum(1 - (others**2).sum(axis=1), 0))
    np.put_along_axis(result, largest[:, None], rest[:, None], axis=1)
    result /= np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-6)
    return result.astype(np.float32)


def _harmonics(meta: dict[str, Any], pixels: Callable[..., np.ndarray], name: str) -> np.ndarray:
    rows, bands = (meta["shN"].get(key) if isinstance(meta["shN"], dict) else None for key in ("count", "bands"))
    if type(rows) is not int or not 0 < rows <= LARGEST_PALETTE or bands not in (1, 2, 3):
        raise DataError(
            f"{name}: shN has count {rows!r:.40}, bands {bands!r:.40}; expected 1 to {LARGEST_PALETTE}, and 1 to 3"
        )
    each = HARMONICS[int(bands)]
    labels = pixels("shN", 1).astype(np.int64)
    labels = labels[:, 0] + 256 * labels[:, 1]
    needed = math.ceil((int(labels.max()) + 1) / _ROW) * _ROW * each
    centroids = pixels("shN", 0, _ROW * each, needed)[:, :3].reshape(-1, each, 3)
    book: np.ndarray = _numbers(meta, "shN", "codebook", SIZE, name).astype(np.float32)
    return book[centroids][labels]


def _part(meta: dict[str, Any], part: str, key: str) -> Any:
    found = meta.get(part)
    return found.get(key) if isinstance(found, dict) else None


def _files(meta: dict[str, Any], part: str, name: str) -> list[str]:
    found, needed = _part(meta, part, "files"), 2 if part in ("means", "shN") else 1
    if not isinstance(found, list) or len(found) != needed or not all(isinstance(file, str) for file in found):
        raise DataError(f"{name}: {META} does not name the images of {part}; expected {needed}")
    return found


def _numbers(meta: dict[str, Any], part: str, key: str, count: int, name: str) -> np.ndarray:
    found = _part(meta, part, key)
    if isinstance(found, list) and len(found) == count and all(type(value) in (int, float) for value in found):
        with np.errstate(over="ignore"):
            values = np.array([float(value) if abs(value) < 1e300 else np.inf for value in found]).astype(np.float32)
        if np.isfinite(values).all():
            return values.astype(np.float64)
    raise DataError(f"{name}: {META} has no {key} of {part}; expected {count} finite numbers")


def _pixels(
    read: Callable[[str], bytes], files: list[str], number: int, width: int, needed: int, name: str
) -> np.ndarray:
    """Read the first ``needed`` pixels (n, 4) uint8 of an image, whose width must be ``width`` unless that is 0."""
    from PIL import Image

    what = f"{name}: {files[number][:80]!r}"
    with Image.open(io.BytesIO(read(files[number])), formats=["WEBP"]) as image:
        size = image.width * image.height
        if not needed <= size <= 4 * needed + _SPARE + image.width * 64 or (width and image.width != width):
            wide = f"lines of {width}, " if width else ""
            raise DataError(f"{what} is of {image.width} x {image.height} px; expected {wide}{needed} px or a few more")
        return np.array(image.convert("RGBA")).reshape(-1, 4)[:needed]


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the Hamilton product of quaternions (..., 4), (w, x, y, z)."""
    (aw, ax, ay, az), (bw, bx, by, bz) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def _quarters() -> tuple[np.ndarray, np.ndarray]:
    """Return the quaternions (24, 4) and the permutations of the scales that go with them (24, 3)."""
    half = np.sqrt(0.5)
    about, axes = [np.array([half, half, 0, 0]), np.array([half, 0, half, 0])], [[0, 2, 1], [2, 1, 0]]
    found, orders = [np.array([1.0, 0, 0, 0])], [[0, 1, 2]]
    for k in range(24):
        for quarter, swapped in zip(about, axes, strict=True):
            turned = _product(found[k], quarter)
            if all(abs(turned @ other) < 0.999 for other in found):
                found.append(turned)
                orders.append([orders[k][axis] for axis in swapped])
    return np.array(found), np.array(orders)


QUARTERS, ORDERS = _quarters()
_AT_ONCE = 1 << 13  # Gaussians


def nearest_turn(quaternions: np.ndarray, log_scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the same ellipsoids with the smallest rotations (largest w), float64, whose numbers are more alike.

    ``quaternions`` (K, 4), (w, x, y, z), have norm 1; log-scales (K, 3) keep their type.
    """
    turned, scaled = np.empty((len(quaternions), 4)), np.empty_like(log_scales)
    for start in range(0, len(quaternions), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        candidates = _product(quaternions[part, None].astype(np.float64), QUARTERS)  # (k, 24, 4)
        best = np.abs(candidates[..., 0]).argmax(axis=1)
        turned[part] = candidates[np.arange(len(best)), best]
        scaled[part] = np.take_along_axis(log_scales[part], ORDERS[best], axis=1)
    return turned, scaled


SIZE = 256  # values of a codebook, indexed by a byte
BINS = 8192  # of the histogram that is divided into intervals
LARGEST_PALETTE = 1 << 16  # rows, indexed by two bytes


def codebook(values: np.ndarray) -> np.ndarray:
    """Return `SIZE` values (float32, ascending) that represent any number of finite ones.

    Their histogram is divided into intervals with the smallest squared error, where a bin is weighted by the square
    root of its count. Equal weights would make larger files, and full counts would quantise rare values (large
    Gaussians) coarsely.
    """
    flat = values.ravel().astype(np.float64)
    low, high = float(flat.min()), float(flat.max())
    places = np.minimum((flat - low) / ((high - low) or 1.0) * BINS, BINS - 1).astype(np.int64)
    counts, sums = np.bincount(places, minlength=BINS), np.bincount(places, flat, BINS)
    some = counts > 0
    means, weights = sums[some] / counts[some], np.sqrt(counts[some])
    if len(means) > SIZE:
        means = best_intervals(means, weights, SIZE)
    return np.concatenate([means, np.full(SIZE - len(means), means[-1])]).astype(np.float32)


def places_in(book: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the index of the nearest value of a codebook, uint8 in the shape of ``values``."""
    book = book.astype(np.float64)
    return np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)


def best_intervals(means: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Return the means (count,) float64 of the intervals of ascending numbers (n > count,) with least squared error."""
    from vvgt_cli.gaussians.formats.codebook_kernels import divide

    shifted = means - means.mean()  # avoids cancellation in the sums of squares
    sums = np.zeros((3, len(means) + 1))
    sums[:, 1:] = np.cumsum([weights, weights * shifted, weights * shifted**2], axis=1)
    cuts = np.zeros((count + 1, len(means) + 1), np.int32)
    divide(sums, cuts)
    found, end = np.empty(count, np.float64), len(means)
    for k in range(count, 0, -1):
        start = int(cuts[k, end])
        found[k - 1] = (sums[1, end] - sums[1, start]) / (sums[0, end] - sums[0, start])
        end = start
    found += means.mean()
    return found


def palette(points: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Cluster ``points`` (n, d) into at most ``most`` rows.

    Returns:
        rows (m, d) float32; (n,) int32, the row of each point.
    """
    from vvgt_cli.gaussians.formats.codebook_kernels import cut_clusters

    rows, labels = cut_clusters(np.ascontiguousarray(points, np.float32), min(most, len(points)))
    return rows, labels


COMMENTS = "vvgt.json"  # a member of the archive that other programs ignore
_LARGEST = 1 << 30  # bytes of a member
_LARGEST_TEXT = 1 << 20


def sog(splats: Splats, name: str) -> bytes:
    """Encode columns as a `.sog`, along the Morton curve; raise DataError for more Gaussians than a file can hold."""
    if len(splats) > MAX_GAUSSIANS:
        raise DataError(f"{name}: {len(splats):,} Gaussians; expected at most {MAX_GAUSSIANS:,} in a .sog; try a .ply")
    images, meta = images_of(splats.take(morton_order(splats.means)))
    meta |= {"model": "antialiased"} if MIP in splats.comments else {}
    members = {META: json.dumps(meta, separators=(",", ":")).encode()}
    members |= {file: webp(image) for file, image in images.items()}
    members[COMMENTS] = json.dumps(list(splats.comments)).encode()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for file, content in members.items():
            archive.writestr(zipfile.ZipInfo(file), content)
    return stream.getvalue()


def read_sog(content: bytes, name: str) -> Splats:
    """Read the columns of a `.sog` of version 2, or raise DataError."""
    with library_errors(name, "a .sog"), zipfile.ZipFile(io.BytesIO(content)) as archive:

        def read(file: str, largest: int = _LARGEST) -> bytes:
            try:
                size = archive.getinfo(file).file_size
            except KeyError:
                raise DataError(f"{name}: no {file[:80]!r} in the archive; expected a .sog, with {META}") from None
            if size > largest:
                raise DataError(f"{name}: {file[:80]!r} has {size:,} bytes; expected at most {largest:,}")
            return archive.read(file)

        splats = splats_in(json.loads(read(META, _LARGEST_TEXT)), read, name)
        if COMMENTS not in archive.namelist():
            return splats
        found = json.loads(read(COMMENTS, _LARGEST_TEXT))
        lines = found if isinstance(found, list) else []
        return replace(splats, comments=tuple(str(line).replace("\n", " ") for line in lines))
