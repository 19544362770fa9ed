"""Gaussians back on a grid of voxels (docs/live.md): sums of bells, and live values made to agree with their samples.

A value is linear along its Gaussian's gradient. Values are weighted by their bells and divided by the weights. Where
Gaussians overlap this blurs: values sampled from the grid, at the points that gave the Gaussians theirs, differ. What
is missing is added to means and slopes, `PASSES` times, each with `MOMENTUM` of the step before (heavy ball).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vvgt_cli.closed_form.gaussian_samples import NARROW, offsets
from vvgt_cli.dvr.kernel import sample as interpolated
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.frames import axes_of
from vvgt_cli.gaussians.live import SPREAD, VALUE, directions
from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations
from vvgt_cli.volume.writers import slabs

SOFT = 0.15  # voxels by which bells of values are widened, in quadrature, so that none falls between voxels
PASSES, MOMENTUM = 4, 0.5
PLANES = 4  # that one iteration of a thread fills


@dataclass(frozen=True)
class Bells:
    """Gaussians in voxel coordinates of a grid: centres (K, 3), axes (K, 3, 3) of a deviation, both float64."""

    centres: np.ndarray
    arms: np.ndarray

    @classmethod
    def of(cls, gaussians: Gaussians, affine: np.ndarray) -> Bells:
        """Place Gaussians on a grid, whose ``affine`` (4, 4) takes a voxel (i, j, k, 1) to their frame."""
        inward = np.linalg.inv(affine)
        centres = gaussians.means.astype(np.float64) @ inward[:3, :3].T + inward[:3, 3]
        return cls(centres, inward[:3, :3] @ axes_of(gaussians))

    def widened(self, soft: float) -> np.ndarray:
        """Return lower triangular factors (K, 3, 3) of the covariances, wider by ``soft`` voxels, in quadrature."""
        return np.linalg.cholesky(self.arms @ self.arms.transpose(0, 2, 1) + soft**2 * np.eye(3))

    def sums(
        self, fields: np.ndarray, slopes: np.ndarray, dims: tuple[int, int, int], planes: range, soft: float,
        reach: float, greatest: bool = False,
    ) -> np.ndarray:  # fmt: skip
        """Return sums of bells times ``fields`` on some planes of a grid, (planes, ny, nx, F) float32.

        Args:
            fields: (K, F) of each Gaussian at its centre.
            slopes: (K, 3) of the first field, per voxel.
            dims: voxels along (x, y, z).
            planes: which planes.
            soft: as of `widened`.
            reach: deviations out to which a bell counts.
            greatest: instead of sums, the greatest bell and the second field of its Gaussian.
        """
        factors = self.widened(soft)
        out = np.zeros((len(planes), dims[1], dims[0], fields.shape[1]), np.float32)
        inverse, half = np.linalg.inv(factors), reach * np.linalg.norm(factors, axis=2)
        slopes, fields = np.ascontiguousarray(slopes, np.float64), np.ascontiguousarray(fields, np.float64)
        deposit(self.centres, inverse, half, slopes, fields, reach, planes.start, greatest, out)
        return out


@dataclass(frozen=True)
class LiveValues:
    """Values of Gaussians: ``means`` (K,), ``rises`` (K, 3) per deviation along each axis, ``background`` elsewhere."""

    bells: Bells
    means: np.ndarray
    rises: np.ndarray
    background: float
    reach: float = 2.5

    @classmethod
    def of(cls, gaussians: Gaussians, bells: Bells, background: float) -> LiveValues:
        """Return the values that Gaussians carry."""
        assert gaussians.live is not None
        along, explained = directions(gaussians)
        rises = along * (gaussians.live[:, SPREAD] * explained / NARROW)[:, None]
        return cls(bells, gaussians.live[:, VALUE].astype(np.float64), rises, background)

    def on(self, bells: Bells, dims: tuple[int, int, int], planes: range) -> np.ndarray:
        """Return the values on planes of a grid, on which the Gaussians are ``bells``: (planes, ny, nx) float32."""
        slopes = np.einsum("kj,kji->ki", self.rises, np.linalg.inv(bells.arms))
        fields = np.stack([self.means, np.ones(len(self.means))], axis=1)
        sums = bells.sums(fields, slopes, dims, planes, SOFT, self.reach)
        weights = sums[..., 1]
        found: np.ndarray = np.where(weights > 0, sums[..., 0] / np.where(weights > 0, weights, 1), self.background)
        return found.astype(np.float32)

    def refined(self, dims: tuple[int, int, int], passes: int = PASSES) -> LiveValues:
        """Return values that agree better with their samples from the grid ``dims`` that they come from."""
        means, rises, points = self.means, self.rises, offsets()
        step, turn, now, before, least = np.zeros(len(means)), np.zeros_like(rises), self, self, np.inf
        for _ in range(passes):
            sums = np.zeros((len(means), 8))  # count, sum, sums of value times point and of points
            for planes in slabs(dims):
                more = range(planes.start, min(planes.stop + 1, dims[2]))  # points between two slabs
                sample(self.bells.centres, self.bells.arms, points, now.on(self.bells, dims, more), more.start,
                       planes.stop, dims[2], sums)  # fmt: skip
            count = np.maximum(sums[:, 0], 1)
            mean = sums[:, 1] / count
            rise = (sums[:, 2:5] - mean[:, None] * sums[:, 5:8]) / (NARROW**2 * count)[:, None]
            there = (sums[:, 0] > 0)[:, None]
            missing = np.where(there[:, 0], self.means - mean, 0)
            if (left := float(missing @ missing)) > 2 * least:  # diverges: Gaussians that were changed later
                return before
            before, least, step = now, left, MOMENTUM * step + missing
            turn = MOMENTUM * turn + np.where(there, self.rises - rise, 0)
            means, rises = means + step, rises + turn
            now = LiveValues(self.bells, means, rises, self.background, self.reach)
        return now


@parallel_kernel("f8:2 f8:3 f8:2 f8:2 f8:2 f8 i8 b1 f4:4", error_model="numpy")
def deposit(
    thread: ThreadSlice,
    centres: np.ndarray, inverse: np.ndarray, half: np.ndarray, slopes: np.ndarray, fields: np.ndarray, reach: float,
    first: int, greatest: bool, out: np.ndarray,
) -> None:  # fmt: skip
    """Add to ``out`` (nz, ny, nx, F), whose first plane is ``first``; see `Bells.sums`.

    ``inverse`` (K, 3, 3) takes voxels to deviations; ``half`` (K, 3) is how far a bell reaches along x, y and z.
    """
    nz, ny, nx, count = out.shape
    for part in iterations(thread, -(-nz // PLANES)):
        low, high = first + part * PLANES, first + min((part + 1) * PLANES, nz) - 1
        for k in range(len(centres)):
            cx, cy, cz = centres[k, 0], centres[k, 1], centres[k, 2]
            if cz + half[k, 2] < low or cz - half[k, 2] > high or abs(cx) > 1e9 or abs(cy) > 1e9:
                continue
            m = inverse[k]
            a0, a1, a2 = m[0, 0], m[1, 0], m[2, 0]
            aa = a0 * a0 + a1 * a1 + a2 * a2
            for z in range(max(math.ceil(cz - half[k, 2]), low), min(math.floor(cz + half[k, 2]), high) + 1):
                for y in range(max(math.ceil(cy - half[k, 1]), 0), min(math.floor(cy + half[k, 1]), ny - 1) + 1):
                    dy, dz = y - cy, z - cz
                    b0, b1, b2 = m[0, 1] * dy + m[0, 2] * dz, m[1, 1] * dy + m[1, 2] * dz, m[2, 1] * dy + m[2, 2] * dz
                    ab, bb = a0 * b0 + a1 * b1 + a2 * b2, b0 * b0 + b1 * b1 + b2 * b2
                    root = ab * ab - aa * (bb - reach * reach)
                    if root < 0:
                        continue
                    root, beside = math.sqrt(root), slopes[k, 1] * dy + slopes[k, 2] * dz
                    start, stop = (
                        max(math.ceil(cx - (ab + root) / aa), 0),
                        min(math.floor(cx + (root - ab) / aa), nx - 1),
                    )
                    for x in range(start, stop + 1):
                        dx = x - cx
                        bell, row = math.exp(-0.5 * ((aa * dx + 2 * ab) * dx + bb)), out[z - first, y, x]
                        if not greatest:
                            row[0] += bell * (fields[k, 0] + slopes[k, 0] * dx + beside)
                            for f in range(1, count):
                                row[f] += bell * fields[k, f]
                        elif bell > row[0]:
                            row[0], row[1] = bell, fields[k, 1]


@parallel_kernel("f8:2 f8:3 f8:2 f4:3 i8 i8 i8 f8:2", error_model="numpy")
def sample(
    thread: ThreadSlice,
    centres: np.ndarray, arms: np.ndarray, points: np.ndarray, values: np.ndarray, first: int, stop: int, depth: int,
    out: np.ndarray,
) -> None:  # fmt: skip
    """Add to ``out`` (K, 8) the samples at the points whose plane below is from ``first`` to ``stop``.

    ``values`` (planes, ny, nx) begin at plane ``first`` of ``depth``. Points in the box's outer half voxels have the
    value of its face, those beyond do not count.
    """
    _, ny, nx = values.shape
    for k in iterations(thread, len(centres)):
        for m in range(len(points)):
            p, q, r = points[m, 0], points[m, 1], points[m, 2]
            x = centres[k, 0] + (arms[k, 0, 0] * p + arms[k, 0, 1] * q + arms[k, 0, 2] * r)
            y = centres[k, 1] + (arms[k, 1, 0] * p + arms[k, 1, 1] * q + arms[k, 1, 2] * r)
            z = centres[k, 2] + (arms[k, 2, 0] * p + arms[k, 2, 1] * q + arms[k, 2, 2] * r)
            if not (-0.5 <= x < nx - 0.5 and -0.5 <= y < ny - 0.5 and -0.5 <= z < depth - 0.5):
                continue
            z = min(max(z, 0.0), depth - 1.0)
            if not first <= z < stop:
                continue
            value, row = interpolated(values, x, y, z - first), out[k]
            row[0] += 1
            row[1] += value
            row[2] += value * p
            row[3] += value * q
            row[4] += value * r
            row[5] += p
            row[6] += q
            row[7] += r
