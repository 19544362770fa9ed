"""The splatter on a CUDA device: what the kernels of the CPU call, a thread a Gaussian or a pixel, a block a tile.

Arrays are those of `splat.kernel`, `splat.tiles` and `splat.backward`, on the device, but for tile lists: ``start``
(tiles + 1,) int64 where each tile's entries begin in ``keys`` (pairs,) uint64, the depth's bits in front of the
Gaussian's number; and ``first`` (K,) int64 where each Gaussian's pairs begin, in no order. ``view`` float64: rotation,
translation, lens, then what the caller adds. ``status`` (2,) int64: pairs counted so far, pairs in all. Where there are
more pairs than room for them, all lists are empty: whoever draws asks `Splatter.fits`, and draws again.

No result depends on the order of threads: numbers that are counted up by many are integers, entries are sorted by keys
that all differ, and sums of floats have one order.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.errors import DeviceFailed
from vvgt_cli.gaussians.constants import TILE
from vvgt_cli.gaussians.rules import Rule
from vvgt_cli.jit.gpu import cuda, free_bytes, gpu_kernel, sent
from vvgt_cli.splat.backward import SUMS, slope_at, total_of
from vvgt_cli.splat.buffer import (
    AREA,
    BLUE,
    END_ROW,
    FIELDS,
    FIRST_ROW,
    GREEN,
    HALF,
    RED,
    ZERO,
    U,
    alpha_at,
    f32,
    fetch_one,
)
from vvgt_cli.splat.kernel import tiles_of
from vvgt_cli.splat.lanes import box_of, place_of, project_one, reach_of, slope_one, store_one
from vvgt_cli.splat.render import pose
from vvgt_cli.splat.tiles import blend_pixel

THREADS = 256  # of a block that works on Gaussians
SCANNERS, SORTERS = 1024, 512  # of the blocks that add up tiles, and that sort a tile's entries
NEARBY = 4096  # keys that are sorted in the block's own memory; more of them where they lie
GROUP = 8  # Gaussians whose sums over a tile's pixels are formed together
LANE = AREA // GROUP  # threads that form the sums of each
FETCH = 8 * GROUP  # Gaussians that are fetched together
BATCH, FETCHED = AREA * int(FIELDS), FETCH * int(FIELDS)  # of the memory that a block shares
TERMS, SLOPES, PARTS = (3, GROUP * AREA), (3, AREA), AREA * SUMS
POSE = 12  # numbers in front of the lens in a view
VIEW = POSE + 6
COUNTED, PAIRS = 0, 1  # of a status


@cuda.jit(device=True)
def pose_in(view):  # type: ignore[no-untyped-def]
    """Return the rotation and translation of a view as `lanes.pose_of` does."""
    return (
        view[0], view[1], view[2], view[3], view[4], view[5], view[6], view[7], view[8], view[9], view[10], view[11]
    )  # fmt: skip


@gpu_kernel("f4:2 f4:3 f4:1 f8:1 f8:1 i8 f4:2 f4:1 i4:2 i8:1 i8:1 i8:1")
def project(means, factors, logits, view, rule, tiles_x, flat, depth, extent, first, counts, status):  # type: ignore[no-untyped-def]
    """Project a Gaussian, count it in its tiles (``counts``), and take places for its pairs."""
    k, i = cuda.grid(1), cuda.threadIdx.x
    taken = cuda.shared.array(2, np.int64)  # by the block: so far, and where its places begin
    if i == 0:
        taken[0] = 0
    cuda.syncthreads()
    place, x0, y0, x1, y1 = 0, 0, 0, 0, 0
    if k < means.shape[0]:
        opacity = 1.0 / (1.0 + math.exp(-np.float64(logits[k])))
        lens = view[POSE], view[POSE + 1], view[POSE + 2], view[POSE + 3]
        way = rule[0], rule[1], rule[2], rule[3], rule[4]
        drawn = project_one(place_of(k, means, factors), opacity, pose_in(view), lens, way)
        reach = reach_of(drawn[6], way[3])
        box = box_of(drawn[0], drawn[1], reach, drawn[7], drawn[8], view[POSE + 4], view[POSE + 5])
        store_one(k, box, drawn, opacity, drawn[9], flat, depth, extent)
        x0, y0, x1, y1 = tiles_of(extent, k)
        place = cuda.atomic.add(taken, 0, (x1 - x0) * (y1 - y0))
    cuda.syncthreads()
    if i == 0:
        taken[1] = cuda.atomic.add(status, COUNTED, taken[0])
    cuda.syncthreads()
    if k < means.shape[0]:
        first[k] = taken[1] + place
        for ty in range(y0, y1):
            for tx in range(x0, x1):
                cuda.atomic.add(counts, ty * tiles_x + tx, 1)


@gpu_kernel("i8:1 i8:1 i8:1 i8:1 i8")
def add_up(counts, start, cursor, status, room):  # type: ignore[no-untyped-def]
    """Turn counts into places, ``start`` and a copy of it, one block; sets the counts back to 0."""
    i, tiles = cuda.threadIdx.x, counts.shape[0]
    sums = cuda.shared.array(SCANNERS, np.int64)
    each = (tiles + cuda.blockDim.x - 1) // cuda.blockDim.x
    begin, end = min(i * each, tiles), min((i + 1) * each, tiles)
    own = 0
    for tile in range(begin, end):
        own += counts[tile]
    sums[i] = own
    cuda.syncthreads()
    step = 1
    while step < cuda.blockDim.x:
        before = sums[i - step] if i >= step else 0
        cuda.syncthreads()
        sums[i] += before
        cuda.syncthreads()
        step *= 2
    pairs = sums[cuda.blockDim.x - 1]
    at = sums[i] - own
    for tile in range(begin, end):
        start[tile] = cursor[tile] = at if pairs <= room else 0
        at += counts[tile]
        counts[tile] = 0
    if i == 0:
        start[tiles] = pairs if pairs <= room else 0
        status[PAIRS], status[COUNTED] = pairs, 0


@gpu_kernel("i4:1 i4:2 i8 i8:1 i8 i8:1 u8:1")
def file_pairs(depth, extent, tiles_x, status, room, cursor, keys):  # type: ignore[no-untyped-def]
    """Put a Gaussian's key into each of its tiles' lists, in no order; ``depth`` as int32, whose bits sort alike."""
    k = cuda.grid(1)
    if k < extent.shape[0] and status[PAIRS] <= room:
        x0, y0, x1, y1 = tiles_of(extent, k)
        key = (np.uint64(depth[k]) << np.uint64(32)) | np.uint64(k)
        for ty in range(y0, y1):
            for tx in range(x0, x1):
                keys[cuda.atomic.add(cursor, ty * tiles_x + tx, 1)] = key


@cuda.jit(device=True)
def sort_block(keys, base, count):  # type: ignore[no-untyped-def]
    """Sort ``count`` keys from ``base`` on with all threads of the block (a bitonic network, Batcher 1968).

    Of a length that is no power of two the rest would be the greatest keys, which no exchange moves.
    """
    size = np.int32(2)
    while size < 2 * count:
        half = size >> 1
        stride = half
        while stride > 0:
            i, low = np.int32(cuda.threadIdx.x), np.int32(0)
            while low < count:
                low = ((i & -stride) << 1) | (i & (stride - 1))
                high = low | stride if stride < half else low ^ (size - 1)
                if high < count:
                    one, other = keys[base + low], keys[base + high]
                    if other < one:
                        keys[base + low], keys[base + high] = other, one
                i += cuda.blockDim.x
            cuda.syncthreads()
            stride >>= 1
        size <<= 1


@gpu_kernel("i8:1 u8:1")
def sort_tiles(start, keys):  # type: ignore[no-untyped-def]
    """Sort a tile's keys, a block a tile."""
    near = cuda.shared.array(NEARBY, np.uint64)
    begin, end = start[cuda.blockIdx.x], start[cuda.blockIdx.x + 1]
    if end - begin > NEARBY:
        sort_block(keys, begin, end - begin)
        return
    for i in range(cuda.threadIdx.x, end - begin, cuda.blockDim.x):
        near[i] = keys[begin + i]
    cuda.syncthreads()
    sort_block(near, 0, end - begin)
    for i in range(cuda.threadIdx.x, end - begin, cuda.blockDim.x):
        keys[begin + i] = near[i]


@cuda.jit(device=True)
def fetch_key(key, i, extent, flat, colors, ox, oy, fetched):  # type: ignore[no-untyped-def]
    """Copy the Gaussian of a key, its colour clamped at 0, into place i of ``fetched``; return its number."""
    k: Any = np.int64(key & np.uint64(0xFFFFFFFF))
    at = U(i) * FIELDS
    fetch_one(k, at, extent, flat, ox, oy, fetched)
    fetched[at + RED], fetched[at + GREEN] = max(colors[k, 0], ZERO), max(colors[k, 1], ZERO)
    fetched[at + BLUE] = max(colors[k, 2], ZERO)
    return k


@gpu_kernel("i8:1 i8:1 u8:1 i4:2 f4:2 f4:2 i8 f4:1 f4:3", fastmath=True)
def blend(tiles, start, keys, extent, flat, colors, tiles_x, rule, image):  # type: ignore[no-untyped-def]
    """Blend front to back into ``image`` (height, width, 4), a block each of ``tiles``, a thread a pixel."""
    fetched = cuda.shared.array(BATCH, np.float32)
    tile, i = tiles[cuda.blockIdx.x], cuda.threadIdx.x
    x, y, ox, oy = i % TILE, i // TILE, (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    inside = ox + x < image.shape[1] and oy + y < image.shape[0]
    way = rule[0], rule[1], rule[2], rule[3], rule[4], rule[5]
    t = f32(1) if inside else f32(-1)
    red, green, blue, row, col = ZERO, ZERO, ZERO, f32(y), f32(x) + HALF
    begin, end = start[tile], start[tile + 1]
    while begin < end and not cuda.syncthreads_and(np.int32(t <= ZERO)):
        count = min(AREA, end - begin)
        if i < count:
            fetch_key(keys[begin + i], i, extent, flat, colors, ox, oy, fetched)
        cuda.syncthreads()
        for n in range(count):
            at = U(n) * FIELDS
            if fetched[at + FIRST_ROW] <= row < fetched[at + END_ROW]:
                dx, dy = col - fetched[at + U(3)], row + HALF - fetched[at + U(4)]
                h, q = fetched[at + U(1)] * dy, fetched[at + U(2)] * dy * dy
                weight, t = blend_pixel(t, dx, fetched[at], h, q, fetched[at + U(5)], way)
                red += weight * fetched[at + RED]
                green += weight * fetched[at + GREEN]
                blue += weight * fetched[at + BLUE]
        begin += AREA
    if inside:
        image[oy + y, ox + x, 0], image[oy + y, ox + x, 1] = red, green
        image[oy + y, ox + x, 2], image[oy + y, ox + x, 3] = blue, f32(1) - abs(t)


@cuda.jit(device=True)
def sum_columns(terms, slopes, n, lane, u, v, parts):  # type: ignore[no-untyped-def]
    """Write the nine `SUMS` of Gaussian n of a group over every second pixel of a column into ``parts``.

    ``terms`` (3, GROUP x AREA): G, weight and alpha dL/dalpha of each pixel; ``slopes`` (3, AREA): dL/d(r, g, b).
    """
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = ZERO
    for row in range(lane // TILE, TILE, LANE // TILE):
        j = row * TILE + lane % TILE
        g, weight = terms[0, n * AREA + j], terms[1, n * AREA + j]
        dy = f32(row) + HALF - v
        s0 += terms[2, n * AREA + j]
        s1 += g
        s2 += g * dy
        s3 += g * dy * dy
        s4 += weight * slopes[0, j]
        s5 += weight * slopes[1, j]
        s6 += weight * slopes[2, j]
    dx, at = f32(lane % TILE) + HALF - u, (n * LANE + lane) * SUMS
    parts[at], parts[at + 1], parts[at + 2], parts[at + 3] = s0, s1 * dx, s2, s1 * dx * dx
    parts[at + 4], parts[at + 5], parts[at + 6], parts[at + 7], parts[at + 8] = s2 * dx, s3, s4, s5, s6


@gpu_kernel("i8:1 u8:1 i8:1 i4:2 f4:2 f4:2 i8 f4:1 f4:3 f4:3 f4:2", fastmath=True)
def pair_sums(start, keys, first, extent, flat, colors, tiles_x, rule, image, grad, pairs):  # type: ignore[no-untyped-def]
    """Write each pair's nine `SUMS`, as `backward.pair_sums` does, a block a tile, a thread a pixel.

    For `GROUP` Gaussians at a time, threads write their pixels' terms side by side; then they add these up, each a part
    of a column.
    """
    fetched = cuda.shared.array(FETCHED, np.float32)  # one a line, by which the simulator tells them apart
    places = cuda.shared.array(FETCH, np.int64)
    terms = cuda.shared.array(TERMS, np.float32)
    slopes = cuda.shared.array(SLOPES, np.float32)
    parts = cuda.shared.array(PARTS, np.float32)
    tile, i = cuda.blockIdx.x, cuda.threadIdx.x
    tx, ty = tile % tiles_x, tile // tiles_x
    x, y, ox, oy = i % TILE, i // TILE, tx * TILE, ty * TILE
    inside = ox + x < image.shape[1] and oy + y < image.shape[0]
    way = rule[0], rule[1], rule[2], rule[3], rule[4], rule[5]
    t, behind, by_alpha, row, col = f32(1) if inside else f32(-1), ZERO, ZERO, f32(y), f32(x) + HALF
    for f in range(3):
        slopes[f, i] = ZERO
    if inside:
        by_alpha = grad[oy + y, ox + x, 3]
        behind = image[oy + y, ox + x, 3] * by_alpha
        for f in range(3):
            slopes[f, i] = grad[oy + y, ox + x, f]
            behind += image[oy + y, ox + x, f] * slopes[f, i]
    begin, end, ended = start[tile], start[tile + 1], 0
    for entry in range(begin, end, GROUP):
        count, ahead = min(GROUP, end - entry), (entry - begin) % FETCH  # of those that were fetched together
        if ahead == 0:
            ended = cuda.syncthreads_and(np.int32(t <= ZERO))
            if i < min(FETCH, end - entry):
                k = fetch_key(keys[entry + i], i, extent, flat, colors, ox, oy, fetched)
                x0, y0, x1, _ = tiles_of(extent, k)
                places[i] = first[k] + (ty - y0) * (x1 - x0) + tx - x0
        cuda.syncthreads()
        for n in range(count):
            at, g, weight, moved = U(ahead + n) * FIELDS, ZERO, ZERO, ZERO
            if not ended and fetched[at + FIRST_ROW] <= row < fetched[at + END_ROW]:
                dx, dy, opacity = col - fetched[at + U(3)], row + HALF - fetched[at + U(4)], fetched[at + U(5)]
                h, q = fetched[at + U(1)] * dy, fetched[at + U(2)] * dy * dy
                raw = alpha_at(dx, fetched[at], h, q, opacity, way[2], way[3], way[4])
                own = fetched[at + RED] * slopes[0, i] + fetched[at + GREEN] * slopes[1, i]
                own += fetched[at + BLUE] * slopes[2, i] + by_alpha
                weight, slope, t, behind = slope_at(raw, t, behind, own, way)
                g, moved = (raw + opacity * way[4]) * slope, raw * slope
            terms[0, n * AREA + i], terms[1, n * AREA + i], terms[2, n * AREA + i] = g, weight, moved
        cuda.syncthreads()
        n, at = i // LANE, U(ahead + i // LANE) * FIELDS
        if n < count:
            sum_columns(terms, slopes, n, i % LANE, fetched[at + U(3)], fetched[at + U(4)], parts)
        cuda.syncthreads()
        if i < count * SUMS:
            total = ZERO
            for lane in range(LANE):
                total += parts[(i // SUMS * LANE + lane) * SUMS + i % SUMS]
            pairs[places[ahead + i // SUMS], i % SUMS] = total


@gpu_kernel("i8:1 f4:2 i4:2 f4:2 f4:2 f4:3 f4:2 f8:1 f8:1 i8:1 f4:2")
def own_axes(first, pairs, extent, flat, means, factors, colors, view, rule, status, rows):  # type: ignore[no-untyped-def]
    """Write a Gaussian's gradients along its own axes into its column of ``rows`` (13, K), as `backward.own_axes`."""
    k = cuda.grid(1)
    if k >= means.shape[0] or status[PAIRS] > pairs.shape[0]:
        return
    for f in range(13):
        rows[f, k] = ZERO
    x0, y0, x1, y1 = tiles_of(extent, k)
    if x1 > x0:
        sums = total_of(pairs, first[k], first[k] + (x1 - x0) * (y1 - y0))
        conic = np.float64(flat[k, 2]), np.float64(flat[k, 3]), np.float64(flat[k, 4])
        lens = view[POSE], view[POSE + 1]
        by = slope_one(place_of(k, means, factors), sums, conic, pose_in(view), lens, rule[0], rule[1])
        rows[0, k], rows[1, k], rows[2, k], rows[3, k], rows[4, k] = by[0], by[1], by[2], by[3], by[4]
        rows[5, k], rows[6, k], rows[7, k], rows[8, k] = by[5], by[6], by[7], by[8]
        rows[9, k] = sums[0] * (1.0 - flat[k, 6])
        for f in range(3):
            if colors[k, f] >= ZERO:
                rows[10 + f, k] = sums[6] if f == 0 else sums[7] if f == 1 else sums[8]


KERNELS = project, add_up, file_pairs, sort_tiles, blend, pair_sums, own_axes


def view_numbers(camera: Camera) -> np.ndarray:
    """Return a camera as the `VIEW` numbers that kernels read, float64."""
    rot, trans, lens = pose(camera)
    return np.concatenate([rot.ravel(), trans, lens])


class Splatter:
    """Draws and differentiates K Gaussians in views of one size, by one rule.

    Attributes:
        image: (height, width, 4) float32 on the device, what `draw` has drawn.
        room: pairs of a tile and a Gaussian that there is room for.
    """

    def __init__(self, count: int, width: int, height: int, rule: Rule, stream: Any, summed: bool = False) -> None:
        """Take memory for ``count`` Gaussians; ``summed``: for `slopes` as well."""
        self.count, self.stream, self.summed, self.room = count, stream, summed, 0
        self.across, self.tiles = -(-width // TILE), -(-width // TILE) * -(-height // TILE)
        self.rule, self.blending = sent((rule.projecting(), rule.blending()), stream)
        self.flat, self.extent = self._array((count, 7), np.float32), self._array((count, 4), np.int32)
        self.bits, self.first = self._array((count,), np.int32), self._array((count,), np.int64)
        self.depth = self.bits.view(np.float32)
        self.counts, self.cursor = sent((np.zeros(self.tiles, np.int64), np.zeros(self.tiles, np.int64)), stream)
        self.start, self.status = sent((np.zeros(self.tiles + 1, np.int64), np.zeros(2, np.int64)), stream)
        self.every = sent(np.arange(self.tiles), stream)
        self.image, self.blank = sent(2 * (np.zeros((height, width, 4), np.float32),), stream)
        self._make_room(4 * count + self.tiles)

    def _array(self, shape: tuple[int, ...], kind: Any) -> Any:
        return cuda.device_array(shape, kind, stream=self.stream)

    def _make_room(self, pairs: int) -> None:
        """Take memory for as many pairs.

        Raises:
            DeviceFailed: less is free.
        """
        needed, self.keys, self.pairs = (8 + 4 * SUMS * self.summed) * pairs, None, None
        if needed > (free := free_bytes()):
            raise DeviceFailed(f"pictures need {needed / 1e9:.1f} GB, of which {free / 1e9:.1f} are free")
        self.room, self.keys = pairs, self._array((pairs,), np.uint64)
        self.pairs = self._array((pairs if self.summed else 1, SUMS), np.float32)

    def draw(self, means: Any, factors: Any, logits: Any, colors: Any, view: Any, tiles: Any = None) -> None:
        """Draw into ``image``, all tiles or those whose numbers ``tiles`` (n,) int64 holds, 0 elsewhere."""
        chosen, stream = self.every if tiles is None else tiles, self.stream
        if tiles is not None:
            self.image.copy_to_device(self.blank, stream)
        blocks = -(-self.count // THREADS), THREADS, stream
        project[blocks](
            means, factors, logits, view, self.rule, self.across, self.flat, self.depth, self.extent, self.first,
            self.counts, self.status,
        )  # fmt: skip
        add_up[1, SCANNERS, stream](self.counts, self.start, self.cursor, self.status, self.room)
        file_pairs[blocks](self.bits, self.extent, self.across, self.status, self.room, self.cursor, self.keys)
        sort_tiles[self.tiles, SORTERS, stream](self.start, self.keys)
        blend[len(chosen), AREA, stream](
            chosen, self.start, self.keys, self.extent, self.flat, colors, self.across, self.blending, self.image
        )

    def slopes(self, means: Any, factors: Any, colors: Any, view: Any, grad: Any, rows: Any) -> None:
        """Write gradients along the axes into ``rows`` (13, K), from those by the picture, ``grad`` as ``image``."""
        pair_sums[self.tiles, AREA, self.stream](
            self.start, self.keys, self.first, self.extent, self.flat, colors, self.across, self.blending, self.image,
            grad, self.pairs,
        )  # fmt: skip
        own_axes[-(-self.count // THREADS), THREADS, self.stream](
            self.first, self.pairs, self.extent, self.flat, means, factors, colors, view, self.rule, self.status, rows
        )

    def fits(self) -> bool:
        """Wait, and return whether there was room for what was drawn last; else there is now."""
        pairs = int(self.status.copy_to_host(stream=self.stream)[PAIRS])
        if self.stream:
            self.stream.synchronize()
        if pairs <= self.room:
            return True
        self._make_room(pairs + pairs // 2)
        return False
