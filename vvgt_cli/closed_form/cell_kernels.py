"""The kernels under `tree` and `shape`: order, look-up, sums of children, principal axes."""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.closed_form.columns import COLUMNS, MASS, MOMENTS, RED, SEEN, SQUARE, XX, YY, ZZ, X, Y, Z
from vvgt_cli.jit.decorators import inlined, parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations

SWEEPS = 8  # of Jacobi rotations: each squares the error, three are enough for most
TINY = 1e-300  # of what is divided by
CONVERGED = 1e-30  # off-diagonal squares, of the trace's square


@inlined()
def _spread_bits(number: int) -> np.uint64:
    """Return the 21 lowest bits of ``number`` with two zeros between them."""
    v = np.uint64(number)
    v = (v | (v << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    v = (v | (v << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    v = (v | (v << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    v = (v | (v << np.uint64(2))) & np.uint64(0x1249249249249249)
    return v  # noqa: RET504 - one expression would be of another type


@parallel_kernel("i4:2 u8:1")
def morton_codes(thread: ThreadSlice, index: np.ndarray, out: np.ndarray) -> None:
    """Write Morton codes ``out`` (n,) uint64, x lowest, of ``index`` (n, 3) int32 below 2^21."""
    for n in iterations(thread, len(index)):
        x, y, z = _spread_bits(index[n, 0]), _spread_bits(index[n, 1]), _spread_bits(index[n, 2])
        out[n] = x | (y << np.uint64(1)) | (z << np.uint64(2))


@parallel_kernel("i4:2 f8:1 f4:3 f4:3 f4:2")
def look_up(
    thread: ThreadSlice, index: np.ndarray, ratio: np.ndarray, mean: np.ndarray, largest: np.ndarray, out: np.ndarray
) -> None:
    """Write ``mean`` and ``largest`` (nz, ny, nx) at the middles of cells, clamped to the grid, into ``out`` (n, 2).

    ``index`` (n, 3) int32 cell indices; ``ratio`` (3,) a cell's edges in those of the grid's cells.
    """
    nz, ny, nx = mean.shape
    for n in iterations(thread, len(index)):
        i = min(max(math.floor((index[n, 0] + 0.5) * ratio[0]), 0), nx - 1)
        j = min(max(math.floor((index[n, 1] + 0.5) * ratio[1]), 0), ny - 1)
        k = min(max(math.floor((index[n, 2] + 0.5) * ratio[2]), 0), nz - 1)
        out[n, 0], out[n, 1] = mean[k, j, i], largest[k, j, i]


@parallel_kernel("f8:2 i8:1 f4:2 f8:2 f8:1")
def take_base(
    thread: ThreadSlice, moments: np.ndarray, keep: np.ndarray, seen: np.ndarray, out: np.ndarray, top: np.ndarray
) -> None:
    """Copy rows ``keep`` (n,) of ``moments`` (m, 13) into a pyramid's base ``out`` (n, 18), ``top`` (n,).

    ``seen`` (m, 2): mean and largest transmittance.
    """
    for n in iterations(thread, len(keep)):
        row, mean = moments[keep[n]], np.float64(seen[keep[n], 0])
        top[n] = seen[keep[n], 1]
        for column in range(MOMENTS):
            out[n, column] = row[column]
        out[n, SEEN] = row[MASS] * mean
        square = 0.0
        for band in range(3):
            out[n, SEEN + 1 + band] = row[RED + band] * mean
            square += row[RED + band] ** 2
        out[n, SQUARE] = square * mean / max(row[MASS], TINY)


@parallel_kernel("f8:2 f8:1 i8:1 f8:2 f8:1")
def sum_children(
    thread: ThreadSlice, rows: np.ndarray, top: np.ndarray, start: np.ndarray, out: np.ndarray, out_top: np.ndarray
) -> None:
    """Sum rows (n, 18) from one ``start`` (m,) to the next into ``out`` (m, 18), with the largest of ``top`` (n,)."""
    for m in iterations(thread, len(start)):
        stop = start[m + 1] if m + 1 < len(start) else len(rows)
        for column in range(COLUMNS):
            out[m, column] = rows[start[m], column]
        out_top[m] = top[start[m]]
        for n in range(start[m] + 1, stop):
            for column in range(COLUMNS):
                out[m, column] += rows[n, column]
            out_top[m] = max(out_top[m], top[n])


@parallel_kernel("f8:2 f8:1 f8:1 f8 f8:1", error_model="numpy")
def score_splits(
    thread: ThreadSlice, moments: np.ndarray, top: np.ndarray, edge: np.ndarray, plain: float, out: np.ndarray
) -> None:
    """Write `tree.split_score` of rows of ``moments`` (n, 18), ``top`` (n,), edges ``edge`` (3,), into ``out`` (n,).

    ``plain``: variance added to that of the colours; infinite: colours do not count.
    """
    area = (edge[0] * edge[1] * edge[2]) ** (2.0 / 3.0)
    for n in iterations(thread, len(out)):
        row, mass = moments[n], moments[n, MASS]
        x, y, z = row[X] / mass, row[Y] / mass, row[Z] / mass
        variance = max((row[XX] + row[YY] + row[ZZ]) / mass - (x * x + y * y + z * z), 0.0)
        seen, share = row[SEEN], 1.0
        if plain < math.inf:
            shade = row[SQUARE]
            for band in range(1, 4):
                shade -= row[SEEN + band] ** 2 / max(seen, TINY)
            share = max(shade, 0.0) / max(seen, TINY) + plain
        out[n] = -math.expm1(-mass / area) * area * math.sqrt(top[n] * seen / mass) * variance * share


@inlined(error_model="numpy")
def _rotate(a: np.ndarray, v: np.ndarray, p: int, q: int) -> None:
    """Apply one Jacobi rotation to symmetric ``a`` (3, 3) that makes a[p, q] zero; ``v`` (3, 3) gathers them."""
    if a[p, q] == 0.0:
        return
    theta = (a[q, q] - a[p, p]) / (2 * a[p, q])
    t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1))
    c = 1 / math.sqrt(t * t + 1)
    s = t * c
    for k in range(3):
        a[k, p], a[k, q] = c * a[k, p] - s * a[k, q], s * a[k, p] + c * a[k, q]
    for k in range(3):
        a[p, k], a[q, k] = c * a[p, k] - s * a[q, k], s * a[p, k] + c * a[q, k]
    for k in range(3):
        v[k, p], v[k, q] = c * v[k, p] - s * v[k, q], s * v[k, p] + c * v[k, q]


@parallel_kernel("f8:3 f8:2 f8:3", error_model="numpy")
def principal_axes(thread: ThreadSlice, cov: np.ndarray, values: np.ndarray, vectors: np.ndarray) -> None:
    """Compute eigenvalues (n, 3), ascending, and eigenvectors (n, 3, 3; columns) of symmetric ``cov`` by Jacobi."""
    for n in iterations(thread, len(cov)):
        a, v = np.empty((3, 3)), np.zeros((3, 3))
        for row in range(3):
            v[row, row] = 1.0
            for column in range(3):
                a[row, column] = cov[n, row, column]
        scale = abs(a[0, 0]) + abs(a[1, 1]) + abs(a[2, 2])
        for _ in range(SWEEPS):
            off = a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2] + a[1, 2] * a[1, 2]
            if off <= CONVERGED * scale * scale:
                break
            _rotate(a, v, 0, 1)
            _rotate(a, v, 0, 2)
            _rotate(a, v, 1, 2)
        least, middle, most = 0, 1, 2  # `np.argsort` takes 1 s to compile
        if a[least, least] > a[middle, middle]:
            least, middle = middle, least
        if a[middle, middle] > a[most, most]:
            middle, most = most, middle
        if a[least, least] > a[middle, middle]:
            least, middle = middle, least
        for column, order in enumerate((least, middle, most)):
            values[n, column] = a[order, order]
            for row in range(3):
                vectors[n, row, column] = v[row, order]
