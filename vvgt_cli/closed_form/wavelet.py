"""Starts to compare with: a plain wavelet-to-Gaussian bank (`--init wavelet`), and random samples (`--init uniform`).

The bank holds one isotropic surrogate an atom. The Haar pyramid of the extinction is cut where its detail energy is
large; each remaining scaling atom (a box of edge H) becomes the isotropic Gaussian that the transition bank holds for
it: the least-squares fit to the box.
"""

from __future__ import annotations

import functools

import numpy as np

from vvgt_cli.closed_form.columns import FIRST, MASS
from vvgt_cli.closed_form.shape import make_gaussians, visible_color
from vvgt_cli.closed_form.tree import Tree, select
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.opacity import peak_opacity


@functools.cache
def box_surrogate() -> tuple[float, float]:
    """Return (sigma / H, mass kept) of the isotropic Gaussian nearest in L2 to a unit box of edge H in 3D.

    For a given sigma the best amplitude is <box, g> / <g, g>; both factor over the axes. Sigma by golden section.
    """
    x = (np.arange(4000) + 0.5) / 4000 * 8 - 4  # box edges at +-1/2

    def gain(sigma: float) -> tuple[float, float]:
        g = np.exp(-0.5 * (x / sigma) ** 2)
        overlap, norm = g[np.abs(x) < 0.5].sum(), (g**2).sum()
        amplitude = (overlap / norm) ** 3
        return amplitude * overlap**3, amplitude * (g.sum() / (np.abs(x) < 0.5).sum()) ** 3

    sigmas = np.linspace(0.2, 0.8, 601)
    best = sigmas[int(np.argmax([gain(s)[0] for s in sigmas]))]
    return float(best), gain(float(best))[1]


def detail_energy(tree: Tree) -> np.ndarray:
    """Return the largest energy (n,) of a cell's seven Haar details or those of any cell in it; 0 for base cells.

    The energy is the children's squared density minus the cell's own, times volume. A cell whose children are alike has
    none, and is still split where something finer in it has some.
    """
    mass, volume = tree.moments[:, MASS], tree.edge.prod(axis=1)
    energy = np.zeros(len(tree))
    np.add.at(energy, tree.parent[:-1], (mass**2 / volume)[:-1])
    energy -= mass**2 / volume
    energy[tree.children == 0] = 0
    np.maximum(energy, 0, out=energy)
    energy *= np.sqrt(tree.largest)
    for level in tree.levels[1:]:  # the segments of reduceat are the children of each cell
        children = np.maximum.reduceat(energy[: level.start], tree.first[level])
        energy[level] = np.maximum(energy[level], children)
    return energy


def wavelet_gaussians(tree: Tree, budget: int, pixel: float) -> Gaussians:
    """Return at most ``budget`` isotropic Gaussians; ``pixel`` is a pixel's width at the centre, unit frame."""
    ids = select(tree, budget, detail_energy(tree))
    moments, edge = tree.moments[ids], np.cbrt(tree.edges[tree.level[ids]].prod(axis=1))
    sigma, kept = box_surrogate()
    variances = np.repeat((sigma * edge)[:, None] ** 2, 3, axis=1)
    opacity = peak_opacity(moments[:, MASS] * kept, variances, pixel)
    means = moments[:, FIRST] / moments[:, [MASS]]
    axes = np.broadcast_to(np.eye(3), (len(ids), 3, 3))
    return make_gaussians(means, variances, axes, opacity, visible_color(moments))


def uniform_gaussians(tree: Tree, budget: int, pixel: float, seed: int) -> Gaussians:
    """Draw ``budget`` isotropic Gaussians uniformly where the scene has extinction that some view sees.

    A base cell's extinction is shared by the samples expected in it; sigma is half the mean distance of the samples.
    """
    base = np.flatnonzero(tree.children == 0)
    if not len(base) or budget < 1:
        base = base[:0]
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.integers(0, max(len(base), 1), budget if len(base) else 0))
    moments, edge = tree.moments[base[chosen]], np.broadcast_to(tree.edges[0], (len(chosen), 3))
    centre = moments[:, FIRST] / moments[:, [MASS]]
    points = centre + edge * (rng.random(centre.shape) - 0.5)
    volume = len(base) * (edge[0].prod() if len(edge) else 0.0)
    sigma = 0.5 * (volume / max(len(chosen), 1)) ** (1 / 3)
    variances = np.full((len(chosen), 3), sigma**2)
    mass = moments[:, MASS] * len(base) / max(len(chosen), 1)
    axes = np.broadcast_to(np.eye(3), (len(chosen), 3, 3))
    return make_gaussians(points, variances, axes, peak_opacity(mass, variances, pixel), visible_color(moments))
