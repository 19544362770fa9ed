"""Colours of cells under light in closed form: what does not depend on the view, and harmonics of what does.

Every base cell is shaded at its centroid and counts by what the cameras see of it, so that of an opaque body its
surface counts. The head-light's terms are even in n . d: with ``|x|^p = A + B x^2``, least squares over [0, 1] weighted
by x (what is seen at a grazing angle covers few pixels), a Gaussian's colour is the quadratic form ``A g + B d^T Q d``
of its direction d, Q the mean of n n^T and g its trace: harmonics of degree 0 and 2, without a picture. Highlights of
lights at infinity are projected onto the harmonics for the main axis of Q.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vvgt_cli.closed_form.columns import COLOR, COLUMNS, FIRST, MASS, RED, SEEN, SEEN_COLOR, SEEN_RED, X, Y, Z
from vvgt_cli.closed_form.fit import BRIGHTEST
from vvgt_cli.closed_form.tree import Leaves, Tree
from vvgt_cli.dvr.kernel import FLAGS, mean_optics, sample, table_coordinate
from vvgt_cli.dvr.layout import LIT, Light, Optics, Voxels
from vvgt_cli.dvr.light import scene_light, sphere
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.dvr.shading import fixed_diffuse, normal, shade_at
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.frames import C2, axes_of, basis
from vvgt_cli.gaussians.types import HARMONICS, SH_C0
from vvgt_cli.jit.decorators import parallel_kernel
from vvgt_cli.jit.threads import ThreadSlice, iterations
from vvgt_cli.look.lighting import Lighting

NORMALS, TINT, FIXED, MEAN, SUMS = slice(1, 7), slice(7, 10), slice(10, 13), slice(13, 16), 16
SEEN_LITTLE = 1e-12  # of the mass: all of it counts where the cameras see no more
AROUND = 96  # directions that highlights are projected on
CHUNK = 1 << 14  # Gaussians whose highlights are projected at once
DEGREE = 2  # of the harmonics of Gaussians relit by a light that depends on the view


@parallel_kernel("Voxels Voxels Optics f8:1 f8:2 f8:2", LIT, fastmath=FLAGS, error_model="numpy")
def point_normals(
    thread: ThreadSlice, voxels: Voxels, shaded: Voxels, optics: Optics, edge: np.ndarray, points: np.ndarray,
    out: np.ndarray,
) -> None:  # fmt: skip
    """Write normal (x, y, z) and extinction at voxel coordinates ``points`` (n, 3) into ``out`` (n, 4).

    ``shaded`` as of `Scene`; ``edge`` (3,) of `Light`; extinction per unit-frame length, the edge voxels' beyond.
    """
    for k in iterations(thread, len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        out[k, 0], out[k, 1], out[k, 2] = normal(shaded.values, edge, x, y, z)
        u = table_coordinate(sample(voxels.values, x, y, z), optics)
        out[k, 3] = max(mean_optics(u, u, optics)[3], 0.0) if u >= 0.0 else 0.0


@parallel_kernel("Light f8:2 f8:2 i8:1 i8:1 f8:1 f8:1 f8:2", LIT, fastmath=FLAGS, error_model="numpy")
def _shade(
    thread: ThreadSlice,
    light: Light,
    normals: np.ndarray,
    moments: np.ndarray,
    first: np.ndarray,
    last: np.ndarray,
    half: np.ndarray,
    step: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write sums over rows ``first[k]`` to ``last[k]`` of ``moments`` (n, 18) into ``out`` (k, 16).

    Weight (what is seen), times n n^T (xx, xy, xz, yy, yz, zz), colour, colour without what depends on the view, and
    times n. ``normals`` (n, 3) at the rows' centroids; ``half``, ``step`` (3,) of `Scene`.
    """
    for k in iterations(thread, len(first)):
        row = out[k]
        row[:] = 0.0
        mass = seen = 0.0
        for m in range(first[k], last[k]):
            mass += moments[m, MASS]
            seen += moments[m, SEEN]
        shift = SEEN if seen > SEEN_LITTLE * mass else MASS
        color = SEEN_RED if seen > SEEN_LITTLE * mass else RED
        for m in range(first[k], last[k]):
            cell = moments[m]
            w = cell[shift]
            if not w > 0.0:
                continue
            row[0] += w
            if light.traced:
                x = (cell[X] / cell[MASS] + half[0]) / step[0] - 0.5
                y = (cell[Y] / cell[MASS] + half[1]) / step[1] - 0.5
                z = (cell[Z] / cell[MASS] + half[2]) / step[2] - 0.5
                for c in range(3):
                    row[10 + c] += shade_at(light, c, x, y, z) * cell[color + c]
                continue
            n0, n1, n2 = normals[m, 0], normals[m, 1], normals[m, 2]
            factor = light.ambient + light.diffuse * fixed_diffuse(light, n0, n1, n2)
            row[1] += w * n0 * n0
            row[2] += w * n0 * n1
            row[3] += w * n0 * n2
            row[4] += w * n1 * n1
            row[5] += w * n1 * n2
            row[6] += w * n2 * n2
            for c in range(3):
                row[7 + c] += cell[color + c]
                row[10 + c] += factor * cell[color + c]
            row[13] += w * n0
            row[14] += w * n1
            row[15] += w * n2


@dataclass(frozen=True)
class Shading:
    """Inputs of the colours of cells under light, wherever the volume's values are.

    Attributes:
        light: as kernels take it.
        half, step: (3,) of the volume, as `Scene` has them.
        normals: unit normals (n, 3) at points (n, 3) of the box frame, zeros where there is no gradient; by default
            there are only those of base cells.
    """

    light: Light
    half: np.ndarray
    step: np.ndarray
    normals: Callable[[np.ndarray], np.ndarray] = np.zeros_like

    @classmethod
    def of(cls, scene: Scene) -> Shading | None:
        """Build from a scene in memory; None where nothing is lit."""
        if scene.light is None:
            return None
        return cls(scene.light, scene.half, scene.step, lambda points: at_points(scene, points)[:, :3])

    def lit(self, tree: Tree, leaves: Leaves, base: np.ndarray) -> np.ndarray:
        """Return the means (k, 16) of `sums` over the base cells of ``leaves``.

        ``base`` (n, 3): normals at the centroids of the tree's base cells.
        """
        inside = leaves.node >= 0  # others lie below the tree's base: a row of their own
        means = np.empty((len(leaves), SUMS))
        means[inside] = self.sums(tree.moments, base, *base_rows(tree, leaves.node[inside]))
        below = leaves.moments[~inside]
        if len(below):
            means[~inside] = self.sums(below, self.normals(centroids(below)))
        return means

    def alone(self, gaussians: Gaussians, degree: int) -> Gaussians:
        """Return Gaussians with their own colours under the light, as it is at their centres."""
        rows = _rows(gaussians.means)
        rows[:, COLOR] = rows[:, SEEN_COLOR] = gaussians.colors
        return colored(gaussians, self.light, self.sums(rows, self.normals(rows[:, FIRST])), degree)

    def sums(
        self, rows: np.ndarray, normals: np.ndarray, first: np.ndarray | None = None, last: np.ndarray | None = None
    ) -> np.ndarray:
        """Return `_shade` of each row, or of rows ``first`` to ``last``, over the weight: means (k, 16)."""
        if first is None or last is None:
            first, last = np.arange(len(rows)), np.arange(1, len(rows) + 1)
        out = np.empty((len(first), SUMS))
        normals, rows = np.ascontiguousarray(normals), np.ascontiguousarray(rows)
        _shade(self.light, normals, rows, first, last, self.half, self.step, out)
        out /= np.maximum(out[:, :1], np.finfo(np.float64).tiny)
        return out


def centroids(moments: np.ndarray) -> np.ndarray:
    """Return centroids (n, 3) of rows of moments, box frame."""
    return moments[:, FIRST] / moments[:, [MASS]]


def at_points(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Return normals and extinction (n, 4) of `point_normals` at points (n, 3) of the box frame."""
    out = np.empty((len(points), 4))
    at = np.ascontiguousarray((points + scene.half) / scene.step - 0.5)
    point_normals(scene.voxels, scene.shaded, scene.optics, scene.step, at, out)
    return out


def mean_normals(gaussians: Gaussians, look_up: Callable[[np.ndarray], np.ndarray], half: np.ndarray) -> np.ndarray:
    """Return (K, 3) unit directions of the mean gradient of optical mass around Gaussians, box frame; zeros for none.

    Args:
        gaussians: box frame; each counts at its centre, and a standard deviation along each axis.
        look_up: returns normals and extinction (n, 4) at points (n, 3); normals are weighted by the extinction.
        half: (3,) half extents of the box: beyond it nothing counts.
    """
    arms = axes_of(gaussians).transpose(0, 2, 1)  # (K, 3, 3)
    arms = np.concatenate([np.zeros_like(arms[:, :1]), arms, -arms], axis=1)
    points = (gaussians.means[:, None, :] + arms).reshape(-1, 3)
    samples = look_up(points)
    inside = (np.abs(points) < half).all(axis=1)
    weight = np.where(inside, samples[:, 3], 0)
    weight[::7] = np.maximum(weight[::7], 1e-12)  # where there is nothing, the direction at the centre
    mean = (weight[:, None] * samples[:, :3]).reshape(-1, 7, 3).sum(axis=1) / weight.reshape(-1, 7).sum(axis=1)[:, None]
    return directions(mean)


def directions(mean: np.ndarray) -> np.ndarray:
    """Return (n, 3) unit vectors along means of normals; zeros where they cancel out."""
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    return np.where(length > 1e-3, mean / np.where(length > 1e-3, length, 1), 0)


def _rows(points: np.ndarray) -> np.ndarray:
    """Return rows of moments (n, 18) of mass 1 at points (n, 3), black."""
    rows = np.zeros((len(points), COLUMNS))
    rows[:, [MASS, SEEN]] = 1
    rows[:, FIRST] = points
    return rows


def base_rows(tree: Tree, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return first and last + 1 of the base cells, in Morton order, within ``nodes`` (k,) of a tree."""
    first, last = nodes, nodes
    while (inner := tree.children[first] > 0).any():
        down = tree.first[last] + tree.children[last] - 1
        first, last = np.where(inner, tree.first[first], first), np.where(inner, down, last)
    return first, last + 1


def colored(gaussians: Gaussians, light: Light, out: np.ndarray, degree: int) -> Gaussians:
    """Colour Gaussians by the means ``out`` (K, 16) of `Shading.sums`."""
    colors, terms = out[:, FIXED].copy(), np.zeros((len(out), HARMONICS[degree], 3))
    normals = out[:, NORMALS][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)  # of xx, xy, xz, yy, yz, zz
    white = np.ones((1, 3))
    if light.head:
        for tint, factor, power in ((out[:, TINT], light.diffuse, 1.0), (white, light.specular, light.power)):
            mean, across = even(normals, power, degree)
            colors += factor * mean[:, None] * tint
            if degree >= 2:
                terms[:, 3:8] += factor * across[:, :, None] * tint[:, None, :]
    if light.specular > 0 and len(light.directions):
        mean, all_terms = highlights(normals, light.directions, light.power, degree)
        colors += light.specular * mean[:, None]
        terms += light.specular * all_terms[:, :, None]
    return replace(gaussians, colors=np.clip(colors, 0, BRIGHTEST), harmonics=terms if degree else None)


def relight(gaussians: Gaussians, axis: np.ndarray, lighting: Lighting) -> Gaussians:
    """Colour Gaussians under a light that is no sky.

    Args:
        gaussians: of one colour each.
        axis: (K, 3) in their frame, as long as the normals agree (`normal_axis` of `gaussian_samples`): that share has
            a normal along it, the rest normals in all directions; zeros where there are none: ambient light only.
        lighting: directions in the same frame.
    """
    light = scene_light(lighting, np.eye(3), np.ones(3), (1, 1, 1))
    share = np.linalg.norm(axis.astype(np.float64), axis=1)
    normals, rest = axis / np.maximum(share, 1e-30)[:, None], np.where(share > 0, 1 - share, 0)
    sums = np.zeros((len(gaussians), SUMS))
    sums[:, 0] = 1
    sums[:, NORMALS] = share[:, None] * normals[:, [0, 0, 0, 1, 1, 2]] * normals[:, [0, 1, 2, 1, 2, 2]]
    sums[:, TINT] = gaussians.colors
    lights, mean = len(light.directions) + int(light.head), 1 / (light.power + 1)  # mean of abs(n . h)^power
    diffuse = share * np.abs(normals @ light.directions.T).sum(axis=1) + rest * lights / 2
    sums[:, FIXED] = gaussians.colors * (light.ambient + light.diffuse * diffuse)[:, None]
    sums[:, FIXED] += (light.specular * lights * mean * rest)[:, None]
    return colored(gaussians, light, sums, DEGREE if lighting.depends_on_view else 0)


def even(normals: np.ndarray, power: float, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean over directions (n,) and coefficients of degree 2 (n, 5) of the mean of abs(n . d)^power.

    ``normals`` (n, 3, 3) are means of n n^T, of a trace below 1 where some have no normal.
    """
    trace = np.trace(normals, axis1=1, axis2=2)
    if degree < 2:
        return trace * 2 / (power + 2), np.zeros((len(normals), 5))
    at_zero, square = 48 * np.array([[1 / 6, -1 / 4], [-1 / 4, 1 / 2]]) @ [1 / (power + 2), 1 / (power + 4)]
    m = square * (normals - trace[:, None, None] * np.eye(3) / 3)
    across = [
        2 * m[:, 0, 1] / C2[0], -2 * m[:, 1, 2] / C2[0], m[:, 2, 2] / 2 / C2[1], -2 * m[:, 0, 2] / C2[0],
        (m[:, 0, 0] - m[:, 1, 1]) / 2 / C2[2],
    ]  # fmt: skip
    return trace * (at_zero + square / 3), np.stack(across, axis=1)


def highlights(normals: np.ndarray, directions: np.ndarray, power: float, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean over directions (n,) and coefficients (n, M) of the highlights of lights at infinity.

    Args:
        normals: (n, 3, 3) means of n n^T.
        directions: (lights, 3) unit vectors towards the lights.
        power: of abs(n . h).
        degree: of the harmonics.
    """
    eyes = sphere(AROUND)  # directions that cameras look along
    projected = np.concatenate([np.full((AROUND, 1), SH_C0), basis(eyes, degree)], axis=1) * (4 * np.pi / AROUND)
    between = directions[:, None, :] - eyes
    between /= np.maximum(np.linalg.norm(between, axis=2, keepdims=True), 1e-9)
    harmonics = np.zeros((len(normals), 1 + HARMONICS[degree]))
    for start in range(0, len(normals), CHUNK):
        part = slice(start, start + CHUNK)
        main = np.linalg.eigh(normals[part])[1][:, :, 2]
        trace = np.trace(normals[part], axis1=1, axis2=2)
        for k in range(len(directions)):
            harmonics[part] += trace[:, None] * (np.minimum(np.abs(main @ between[k].T), 1) ** power @ projected)
    return harmonics[:, 0] * SH_C0, harmonics[:, 1:]
