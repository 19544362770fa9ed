"""A volume's values and labels under Gaussians, and which way they rise: samples at the points of each."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist

import numpy as np

from vvgt_cli.dvr.kernel import FLAGS, sample
from vvgt_cli.dvr.layout import TUPLES, Voxels
from vvgt_cli.dvr.shading import normal
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.frames import axes_of, rotations
from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations
from vvgt_cli.volume import Volume
from vvgt_cli.volume.stored import values_at

POINTS = 48  # a Gaussian
NARROW = 0.7  # standard deviations of the points: where Gaussians overlap the values are the neighbours' too
WIDE = 1.5  # standard deviations of the points that say where a label ends
CHUNK = 1 << 14  # Gaussians whose labels are looked up at once
PRIMES = 2, 3, 5
NORMAL_SUMS = 7  # of a Gaussian's normals n: n n^T (xx, xy, xz, yy, yz, zz), and how many points there are


def offsets() -> np.ndarray:
    """Return (POINTS, 3) points of a Gaussian in its standard deviations: a Halton sequence and its mirror image.

    They have the covariance of the law, so that the spread of a linear field is exact.
    """
    law = NormalDist()
    half = np.array([[law.inv_cdf(_radical(k, base)) for base in PRIMES] for k in range(1, POINTS // 2 + 1)])
    half = half @ np.linalg.inv(np.linalg.cholesky(half.T @ half / len(half))).T * NARROW
    return np.concatenate([half, -half])


def reach() -> float:
    """Return the standard deviations within which all `offsets` lie."""
    return float(np.linalg.norm(offsets(), axis=1).max())


def _radical(k: int, base: int) -> float:
    """Return the digits of k after the point, in reverse (van der Corput)."""
    digits, share = 0.0, 1.0 / base
    while k:
        k, digit = divmod(k, base)
        digits, share = digits + digit * share, share / base
    return digits


@parallel_kernel("Voxels f8:2 f8:3 f8:2 i8:1 i8:1 i8:1 f8:1 f4:2 f8:2", TUPLES, fastmath=FLAGS, error_model="numpy")
def sample_points(
    thread: ThreadSlice,
    voxels: Voxels, centres: np.ndarray, arms: np.ndarray, points: np.ndarray, begin: np.ndarray, lo: np.ndarray,
    hi: np.ndarray, step: np.ndarray, out: np.ndarray, normals: np.ndarray,
) -> None:  # fmt: skip
    """Write ``voxels`` at ``centres`` (n, 3) + ``arms`` (n, 3, 3) ``points`` (m, 3) into ``out`` (n, m).

    All in voxel coordinates of the volume, of which ``begin`` (3,) is the first of ``voxels``. Written are values of
    points within the voxels ``lo`` to ``hi`` (3,), each half an edge to either side of its centre. Their normals, zero
    without a gradient, are added to ``normals`` (n, NORMAL_SUMS); ``step`` (3,) edges of a voxel, box frame.
    """
    for k in iterations(thread, len(centres)):
        row = normals[k]
        for m in range(len(points)):
            p0, p1, p2 = points[m, 0], points[m, 1], points[m, 2]
            x = centres[k, 0] + (arms[k, 0, 0] * p0 + arms[k, 0, 1] * p1 + arms[k, 0, 2] * p2)
            y = centres[k, 1] + (arms[k, 1, 0] * p0 + arms[k, 1, 1] * p1 + arms[k, 1, 2] * p2)
            z = centres[k, 2] + (arms[k, 2, 0] * p0 + arms[k, 2, 1] * p1 + arms[k, 2, 2] * p2)
            inside = x >= lo[0] - 0.5 and y >= lo[1] - 0.5 and z >= lo[2] - 0.5
            if inside and x < hi[0] - 0.5 and y < hi[1] - 0.5 and z < hi[2] - 0.5:
                out[k, m] = sample(voxels.values, x - begin[0], y - begin[1], z - begin[2])
                n0, n1, n2 = normal(voxels.values, step, x - begin[0], y - begin[1], z - begin[2])
                row[0] += n0 * n0
                row[1] += n0 * n1
                row[2] += n0 * n2
                row[3] += n1 * n1
                row[4] += n1 * n2
                row[5] += n2 * n2
                row[6] += 1.0


def samples_of(
    voxels: Voxels, centres: np.ndarray, arms: np.ndarray, begin: np.ndarray, lo: np.ndarray, hi: np.ndarray,
    step: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return `sample_points` at `offsets`: values (n, POINTS) float32, NaN outside, and (n, NORMAL_SUMS)."""
    samples, sums = np.full((len(centres), POINTS), np.nan, np.float32), np.zeros((len(centres), NORMAL_SUMS))
    sample_points(voxels, centres, arms, offsets(), begin, lo, hi, step, samples, sums)
    return samples, sums


def in_voxels(gaussians: Gaussians, half: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (K, 3) and axes of a standard deviation (K, 3, 3), columns, of box-frame Gaussians, in voxels."""
    arms = axes_of(gaussians) / step[:, None]
    return (gaussians.means.astype(np.float64) + half) / step - 0.5, np.ascontiguousarray(arms)


def values_of(
    samples: np.ndarray, sums: np.ndarray, gaussians: Gaussians, slope: float, intercept: float
) -> np.ndarray:
    """Return (K, 8) float32 of points of Gaussians: mean and spread of the values, `normal_axis`, gradient.

    The gradient is fitted by least squares; it is as long as the share of the spread that it explains. Samples that are
    not finite do not count; a row without any has NaN.

    Args:
        samples: (K, POINTS) as kernels read them.
        sums: (K, NORMAL_SUMS) of normals.
        gaussians: in the box frame, as are the axis and the gradient.
        slope: of the data value ``slope * sample + intercept``.
        intercept: of the data value.
    """
    known = np.isfinite(samples)
    count = known.sum(axis=1)
    values = np.where(known, samples, 0).astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = values.sum(axis=1) / count
        differences = np.where(known, values - mean[:, None], 0)
        spread = np.sqrt((differences**2).sum(axis=1) / count)
    rise, gradient = _rise(differences * np.sign(slope), gaussians)
    explained = np.sqrt(((rise @ offsets().T) ** 2).mean(axis=1)) / np.maximum(spread, 1e-30)
    gradient *= (explained.clip(0, 1) / np.maximum(np.linalg.norm(gradient, axis=1), 1e-30))[:, None]
    columns = np.stack([mean * slope + intercept, spread * abs(slope)], axis=1)
    return np.concatenate([columns, normal_axis(sums), gradient], axis=1).astype(np.float32)


def _rise(differences: np.ndarray, gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Fit by least squares how values rise that differ so (K, POINTS) from their mean at `offsets`.

    Return the rise a standard deviation along each axis, and the gradient in the Gaussians' frame, both (K, 3).
    """
    points, axes = offsets(), rotations(gaussians.quaternions.astype(np.float64))
    rise = differences @ points @ np.linalg.inv(points.T @ points)
    return rise, np.einsum("kij,kj->ki", axes, rise / np.exp(gaussians.log_scales.astype(np.float64)))


def normal_axis(sums: np.ndarray) -> np.ndarray:
    """Return the main axes (K, 3) of normals from their ``sums`` (K, NORMAL_SUMS), as long as they agree.

    The length is the largest eigenvalue of the mean n n^T minus the mean of the others: 1 where all normals are
    parallel, 0 where they point everywhere, or there are none. What a light adds is then close to the length times
    that of one normal along the axis, and the rest times the mean over all directions. Unlike that of a mean gradient,
    the direction is the same on both sides of a thin plate, and every voxel's noise counts as it does on a ray.
    """
    mean = sums[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3) / np.maximum(sums[:, 6], 1)[:, None, None]
    along, axes = np.linalg.eigh(mean)
    length = along[:, 2] - along[:, :2].mean(axis=1)
    return axes[:, :, 2] * length.clip(0, 1)[:, None]


def labels_and_gradients(
    gaussians: Gaussians, maps: Sequence[tuple[Volume, Sequence[int]]], half: np.ndarray, step: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (K,) int64 of the labels that most points of each Gaussian lie in, -1 for none, and gradients (K, 3).

    Args:
        gaussians: box frame.
        maps: label maps on one grid, each with the numbers of its labels, ascending; rows count through all of them.
        half: (3,) half extents of the grid, unit frame.
        step: (3,) voxel edges of the grid, unit frame.

    Returns:
        Rows; and unit vectors of the box frame along which the share of the label rises, by least squares; zeros
        within a label.
    """
    assigned, gradient = np.empty(len(gaussians), np.int64), np.zeros((len(gaussians), 3))
    for k in range(0, len(gaussians), CHUNK):
        part = gaussians.take(np.arange(k, min(k + CHUNK, len(gaussians))))
        assigned[k : k + CHUNK] = _label_assignment(_rows(part, maps, half, step, NARROW))
        own = (_rows(part, maps, half, step, WIDE) == assigned[None, k : k + CHUNK, None]).any(axis=0)
        gradient[k : k + CHUNK] = _rise(own - own.mean(axis=1, keepdims=True), part)[1]
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return assigned, gradient / np.where(length > 1e-9, length, np.inf)


def _rows(
    gaussians: Gaussians, maps: Sequence[tuple[Volume, Sequence[int]]], half: np.ndarray, step: np.ndarray, wide: float
) -> np.ndarray:
    """Return (maps, K, points) int64 rows of the labels at points of ``wide`` standard deviations, -1 for none."""
    centres, arms = in_voxels(gaussians, half, step)
    points = centres[:, None, :] + np.einsum("kij,mj->kmi", arms, offsets() * (wide / NARROW))
    index = np.rint(points).astype(np.int64)
    inside = ((index >= 0) & (index < np.array(maps[0][0].dims))).all(axis=2)
    rows, first = np.full((len(maps), *inside.shape), -1, np.int64), 0
    for layer, (volume, numbers) in enumerate(maps):
        values, known = values_at(volume, index[inside]), np.asarray(numbers, np.float64)
        at = np.minimum(np.searchsorted(known, values), len(known) - 1)
        rows[layer][inside] = np.where(known[at] == values, first + at, -1)
        first += len(known)
    return rows


def _label_assignment(rows: np.ndarray) -> np.ndarray:
    """Return (K,) the row that comes most often among (maps, K, points), -1 where there is none."""
    every = np.sort(rows.transpose(1, 0, 2).reshape(rows.shape[1], -1), axis=1)
    best, most = np.full(len(every), -1, np.int64), np.zeros(len(every), np.int64)
    run = np.zeros(len(every), np.int64)
    for m in range(every.shape[1]):
        same = every[:, m] == every[:, m - 1] if m else np.zeros(len(every), bool)
        run = np.where(same, run + 1, 1)
        better = (run > most) & (every[:, m] >= 0)
        best[better], most[better] = every[better, m], run[better]
    return best
