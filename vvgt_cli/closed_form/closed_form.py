"""The stage itself: moments, visibility, pyramid, choice of cells, Gaussians; and what views can mend."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vvgt_cli.cameras import Camera, default_views, pixel_width
from vvgt_cli.closed_form.fit import blending_weights, solve_colors, weights_and_errors
from vvgt_cli.closed_form.lit import Shading
from vvgt_cli.closed_form.moments import Cells, base_cells, exponents
from vvgt_cli.closed_form.pyramid import Pyramid, Tile
from vvgt_cli.closed_form.samples import visible_voxels
from vvgt_cli.closed_form.shape import ROUND, STYLES, SurfaceStyle
from vvgt_cli.closed_form.surface_offset import opaque_field
from vvgt_cli.closed_form.tree import Leaves, Tree, leaves_of, select, split, split_score, value_score
from vvgt_cli.closed_form.visibility import visibility
from vvgt_cli.dvr import BoxFrame, Scene
from vvgt_cli.gaussians import INRIA, Gaussians, Rule
from vvgt_cli.progress import ProgressCallback
from vvgt_cli.splat import render

MAX_BASE_CELLS = 5_000_000  # an upper bound: half of them are there, as a rule; 104 bytes each, twice for the pyramid
CELLS_A_GAUSSIAN, FEW_CELLS = 40, 500_000  # at most: more gain less than steps do in their time
LEAST_CELLS = 8  # a Gaussian, of cells on disk
OF_VALUES = 20  # cells a Gaussian that stands for any function, which is seldom small (5: -1 dB)
FINEST = -2  # cells of a quarter voxel at most
MIN_CELL = 1.2  # pixels: a smaller base cell cannot be told from its neighbours
NEARLY = 0.99  # share of the budget, of which up to 7 more are missing: cells are split by eights
MARCH_SIZE = 128  # pixels of the visibility march
FEW = 0.04  # share of hidden cells that are left where they are: of some fogs, which lose by it
SMALLER = 1.75  # power: of smaller cells more are hidden (2: fogs lose 0.2 dB, 1.5: bone loses as much)
REFINE_FROM = 0.3  # share of the budget given out before views say where the error is
REFINE_ROUNDS = 2
CUT_VIEWS = 8
LARGER_SIZE_WEIGHT = 0.6  # of the error at twice the size, where styles of surface compete
INSIDE = 0.1  # least transmittance of what other functions may show (0: dark insides; 0.3: surfaces lose 1 dB)
TWICE_EVERY = 6  # of so many views one counts as seen at twice its size when colours are solved
MIN_FACTOR, MAX_FACTOR = 0.25, 30.0  # times the mean, for errors at a score: what is flat keeps cells for other views
UNSEEN = 0.08  # of the mean blending weight in views: Gaussians below are hidden (0.1: fogs lose, 0.05: less gain)
SHARED = 1.0  # mean scores that the cells above count for: an error of few pixels says little


@dataclass(frozen=True, kw_only=True)
class ClosedForm(Pyramid):
    """A pyramid in memory, all of it one tile, ready to be cut for any budget.

    Attributes:
        whole: the tile.
        budget: most Gaussians.
        scene: what base cells are split from; None: they are not split, as only blocks of the volume are in memory.
    """

    whole: Tile
    budget: int
    scene: Scene | None = None

    @property
    def tree(self) -> Tree:
        """Moments of every cell that some view sees."""
        return self.whole.tree

    def gaussians(self, style: SurfaceStyle = ROUND) -> Gaussians:
        """Return Gaussians of the cells that the moments alone choose."""
        return self.gaussians_of(leaves_of(self.tree, select(self.tree, self.budget)), style)

    def cells_of_values(self) -> Leaves:
        """Return cells for any function: those of `tree.value_score`."""
        return leaves_of(self.tree, select(self.tree, self.budget, value_score(self.tree, self.labels)))

    def gaussians_of(self, leaves: Leaves, style: SurfaceStyle = ROUND) -> Gaussians:
        """Return the Gaussians of cells, one each."""
        return super().gaussians_of(self.shaded(leaves, self.whole), style)

    def cut_by_error(self, drawn: Gaussians, cameras: Sequence[Camera], views: np.ndarray, rule: Rule) -> Gaussians:
        """Return `gaussians` of cells chosen by the errors of ``drawn`` that views (n, h, w, 4) show, by ``rule``.

        Where no view sees some of those drawn, more cells are cut than the budget has, and those not seen are dropped.
        """
        score = split_score(self.tree)
        ids = select(self.tree, self.budget, score)
        weights, errors = weights_and_errors(drawn, cameras, views, rule, power=2)
        score = scores_by_error(self.tree, ids, errors, score)
        seen = 1 - float(unseen(weights, self.budget).sum()) / max(len(weights), 1)
        if seen > 1 - FEW:
            return self.gaussians_of(leaves_of(self.tree, select(self.tree, self.budget, score)), ROUND)
        wanted = round(self.budget * min(seen**-SMALLER, 2.0))
        leaves = self.shaded(leaves_of(self.tree, select(self.tree, wanted, score)), self.whole)
        blurred = self.blurred(leaves)
        shown = np.flatnonzero(~unseen(blending_weights(blurred, cameras, rule), self.budget))
        return self.sharpened(leaves.take(shown), blurred.take(shown))

    def refined(self, cameras: Sequence[Camera], views: np.ndarray, style: SurfaceStyle, rule: Rule) -> Gaussians:
        """Return Gaussians for the budget: three tenths by the moments, then cells with the largest error are split."""
        start = max(int(self.budget * REFINE_FROM), 1)
        leaves = leaves_of(self.tree, select(self.tree, start))
        smallest = max(2 * MIN_CELL * self.pixel, 2.0 ** (FINEST + 1) * self.step.min())  # edge of a cell to split
        for done in range(1, REFINE_ROUNDS + 1):
            gaussians = solve_colors(self.gaussians_of(leaves, style), cameras, views, rounds=1, rule=rule)
            _, error = weights_and_errors(gaussians, cameras, views, rule)
            room = start + (self.budget - start) * done // REFINE_ROUNDS - len(leaves)
            order = np.argsort(-error, kind="stable")
            order = order[leaves.edge[order].min(axis=1) >= smallest]
            leaves = split(self.tree, leaves, order, room, self.scene, self.seen)
        return self.gaussians_of(leaves, style)


def closed_form(
    scene: Scene,
    budget: int,
    size: int,
    cameras: Sequence[Camera] | None = None,
    progress: ProgressCallback | None = None,
    degree: int = 0,
    values: bool = False,
) -> ClosedForm:
    """Compute moments, visibility and pyramid of a scene.

    Args:
        scene: volume under a transfer function.
        budget: most Gaussians.
        size: image edge in pixels that the file is made for.
        cameras: what may see the scene; by default the training views.
        progress: called with (per cent done, 100), within parts that take long too.
        degree: of the harmonics under a light that depends on the view.
        values: of a scene that stands for any function: what it hides counts, too.
    """
    step, half = np.asarray(scene.step), np.asarray(scene.half)
    exponent = exponents(step, base_level(scene, size, budget, values))
    cells = base_cells(scene, exponent, progress=part(progress, 0, 50))
    return form_of(
        cells, half, step, budget, size, cameras, part(progress, 50, 95), scene.labels, Shading.of(scene), degree,
        scene, values,
    )  # fmt: skip


def part(progress: ProgressCallback | None, first: int, last: int) -> Callable[[float], None]:
    """Return a callback that maps its share to ``first`` to ``last`` per cent of the whole and reports it."""
    return lambda share: progress(round(first + (last - first) * share), 100) if progress else None


def form_of(
    cells: Cells,
    half: np.ndarray,
    step: np.ndarray,
    budget: int,
    size: int,
    cameras: Sequence[Camera] | None = None,
    progress: Callable[[float], None] | None = None,
    labels: bool = False,
    shading: Shading | None = None,
    degree: int = 0,
    scene: Scene | None = None,
    values: bool = False,
) -> ClosedForm:
    """Return the closed form over base cells, wherever the values are; arguments and result as of `closed_form`.

    ``progress`` is called with the completed share.
    """
    report = progress or (lambda share: None)
    box = BoxFrame(half, step)
    cameras = cameras or default_views("train", size=MARCH_SIZE)
    seen = visibility(box, cells, cameras, progress=lambda share: report(0.5 * share))
    if values:
        seen = seen.at_least(INSIDE)
    opaque = opaque_field(cells, step, half, labels)
    report(0.6)
    whole = Tile.of(cells, seen, step, shading=shading)
    report(1)
    return ClosedForm(
        seen, opaque, half, step, pixel_width(size), labels, shading, degree, whole=whole, budget=budget, scene=scene
    )


def base_level(scene: Scene, size: int, budget: int, values: bool = False) -> int:
    """Return the finest level whose base cells fit the memory, the budget and what the images can resolve."""
    return level_within(
        scene.step, visible_voxels(scene), most_cells(budget, values), finest_level(scene.step, pixel_width(size))
    )


def most_cells(budget: int, values: bool = False, on_disk: bool = False) -> int:
    """Return how many base cells a budget needs and memory, or a disk, holds; ``values``: as of `closed_form`."""
    wanted = min(MAX_BASE_CELLS, max((OF_VALUES if values else CELLS_A_GAUSSIAN) * budget, FEW_CELLS))
    return max(wanted, LEAST_CELLS * budget) if on_disk else wanted


def level_within(step: np.ndarray, voxels: float, most: float, finest: int) -> int:
    """Return the finest level from ``finest`` on that cuts ``voxels`` of edges ``step`` into at most ``most`` cells."""
    level = finest
    # a long voxel holds more cells than 8^-level
    while voxels / np.prod(2.0 ** exponents(step, level)) > most:
        level += 1
    return level


def finest_level(step: np.ndarray, pixel: float) -> int:
    """Return the level of cells that pixels just resolve; ``step`` (3,) voxel, ``pixel`` pixel edges, unit frame."""
    return max(FINEST, math.floor(math.log2(MIN_CELL * pixel / float(step.min()))))


def bound(form: ClosedForm) -> str:
    """Return why there are no more Gaussians, where there are fewer than the budget."""
    finest = 2.0 ** exponents(form.step, finest_level(form.step, form.pixel)) * form.step
    if (form.tree.edges[0] > 1.5 * finest).any():
        return f"memory for at most {MAX_BASE_CELLS} cells"
    return "the screen cannot tell smaller cells apart"


def expected_cells(voxels: float, step: np.ndarray, size: int, budget: int) -> float:
    """Estimate the base cells of the closed form of ``budget`` Gaussians for images of ``size`` px."""
    level = level_within(step, voxels, most_cells(budget), finest_level(step, pixel_width(size)))
    return voxels / float(np.prod(2.0 ** exponents(step, level)))


def fit_to_views(
    form: ClosedForm,
    cameras: Sequence[Camera],
    views: np.ndarray,
    progress: ProgressCallback | None = None,
    rule: Rule = INRIA,
) -> tuple[Gaussians, str]:
    """Cut the pyramid where views see errors, then colour its cells by all of them.

    Where bodies are opaque, styles of surface compete on every third view.

    Args:
        form: what to cut.
        cameras: of the training views.
        views: (n, h, w, 4) float32 premultiplied.
        progress: called after each cut and at the end.
        rule: by which the views are drawn.

    Returns:
        The Gaussians and one line that says what was done.
    """
    few = range(0, len(cameras), max(len(cameras) // CUT_VIEWS, 1))
    some, images = [cameras[i] for i in few], views[list(few)]
    styles = list(STYLES) if form.opaque.any else ["round"]
    tick = progress or (lambda done, total: None)
    cuts = []
    for number, name in enumerate(styles):
        cuts.append(solve_colors(form.refined(some, images, STYLES[name], rule), some, images, rounds=1, rule=rule))
        tick(number + 1, len(styles) + 1)
    best = 0
    if len(cuts) > 1:
        best = int(np.argmin([_loss(cut, some, images, rule) for cut in cuts]))
    gaussians = solve_colors(cuts[best], cameras, views, twice_every=TWICE_EVERY, rule=rule)
    tick(len(styles) + 1, len(styles) + 1)
    return gaussians, "cells by image error" + (f", {styles[best]} surfaces" if form.opaque.any else "")


def _loss(gaussians: Gaussians, cameras: Sequence[Camera], views: np.ndarray, rule: Rule) -> float:
    """Return mean squared colour error at the views' size, plus `LARGER_SIZE_WEIGHT` times that at twice the size.

    That is of pictures averaged 2 x 2. A file that leans on the renderer's 0.3 px looks right at one size only.
    """
    total = 0.0
    for camera, view in zip(cameras, views, strict=True):
        halved = render(gaussians, camera, rule.at(0.5))
        total += float(np.mean((render(gaussians, camera, rule) - view)[..., :3] ** 2))
        total += LARGER_SIZE_WEIGHT * float(np.mean((halved - view)[..., :3] ** 2))
    return total / len(cameras)


def scores_by_error(tree: Tree, ids: np.ndarray, errors: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Scale scores of splits by the ratio of the pictures' errors to those that the scores predicted.

    Args:
        tree: the pyramid.
        ids: (k,) cells that were drawn, one Gaussian each: a cut of the tree.
        errors: (k,) >= 0, what the pictures have of each, in any unit.
        score: (n,) of every cell, by `tree.split_score`.

    Returns:
        (n,) new scores for `tree.select`. A cell's factor is the sum of errors over that of scores of the cells drawn
        within it, drawn towards its parent's; cells below one that was drawn have its factor. Errors in proportion to
        the scores change nothing.
    """
    wrong, predicted = np.zeros(len(tree)), np.zeros(len(tree))
    wrong[ids], predicted[ids] = errors, score[ids]
    for level in tree.levels[:-1]:
        parents = tree.parent[level]
        for sums in (wrong, predicted):
            sums[parents[0] : parents[-1] + 1] += np.bincount(parents - parents[0], sums[level])
    if not (wrong[-1] > 0 and predicted[-1] > 0):
        return score
    factor, mean = np.ones(len(tree)), wrong[-1] / predicted[-1]
    prior = SHARED * predicted[-1] / len(ids)
    for level in tree.levels[-2::-1]:
        above = factor[tree.parent[level]]
        factor[level] = np.where(
            predicted[level] > 0, (wrong[level] / mean + prior * above) / (predicted[level] + prior), above
        )
    return score * np.clip(factor, MIN_FACTOR, MAX_FACTOR)


def unseen(weights: np.ndarray, most: int) -> np.ndarray:
    """Return (n,) bool: whose blending ``weights`` (n,) are below `UNSEEN`, or not among the ``most`` largest."""
    hidden: np.ndarray = weights < UNSEEN * weights.mean() if len(weights) else np.zeros(0, bool)
    hidden[np.argsort(weights, kind="stable")[: max(len(weights) - most, 0)]] = True
    return hidden
