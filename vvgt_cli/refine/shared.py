"""Steps that similar Gaussians share, estimated together: one Gaussian's own slopes are too noisy.

A Gaussian's step is Adam's: of its own slopes, view by view, most of which is noise. But what the closed form gets
wrong it gets wrong alike in Gaussians that are alike: too wide where the opacity is high, too pale beside what is dark.
So the directions of all are regressed, again at each step, on what is known of each Gaussian at the start, and what the
regression predicts, times `factor`, is added to each one's step: a mean over thousands has hardly any noise, and may
go further, as long as predictions agree from step to step. This is descent on the parameters
``theta_i + A phi_i`` of Gaussian i, in which A is shared by all. phi are the numbers known and random features of them
(Rahimi and Recht 2007), so that A phi may bend.
"""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.closed_form.sharpen import curves, mix_neighbours
from vvgt_cli.refine import steps
from vvgt_cli.refine.steps import FEATURES, KNOWN, RUN
from vvgt_cli.splat.lanes import LANES

GAIN = 7.0  # factor on the predicted steps at first (docs/log/refinement.md)
BOUNDS = 2.0, 14.0  # least and largest factor
AGREEING, PACE = 0.52, 0.3  # cosine between predictions in a row at which the factor stays; how fast it changes else
RECALL = 0.8  # of the running cosine, a step
LEAST = 500  # Gaussians: of fewer, noise is foretold too
SAMPLE = 12_000  # Gaussians that are regressed on, or less than twice as many
RIDGE = 1e-3  # of a feature's squares
FARTHEST = 3.0  # standard deviations that a number counts
BENT = 1.5  # length of the random directions
ONE, MAX_FEATURE = 40, 127  # of a feature in 8 bits, which is what it is fitted with too
BATCH = 1024 * LANES  # Gaussians whose features are made at once
NONE = np.zeros((0, FEATURES, LANES), np.int8), np.zeros((KNOWN, FEATURES), np.float32)  # where nothing is shared


def aligned(means: np.ndarray, factors: np.ndarray, logits: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Return numbers known of each Gaussian, and its axes in an order and with signs that mean the same for all.

    Args:
        means: (K, 3) float32.
        factors: (K, 3, 3) float32 with covariance ``M M^T``; columns are put in order in place: the shortest first,
            each towards where the neighbours lie. The covariance stays.
        logits: (K,) of opacity.
        colors: (K, 3).

    Returns:
        (K, 17) float32 of mean 0 and variance 1, within `FARTHEST`: logit, log lengths of the axes, colour; how
        the means of the neighbours' differ from them; where the neighbours lie, along the axes. Neighbours are those of
        `vvgt_cli.closed_form.sharpen.mix_neighbours`, each by how near it is.
    """
    lengths = np.sqrt(np.square(factors.astype(np.float64)).sum(axis=1))
    order = np.argsort(lengths, axis=1, kind="stable")
    lengths = np.maximum(np.take_along_axis(lengths, order, axis=1), 1e-12)
    factors[:] = np.take_along_axis(factors, order[:, None, :], axis=2)
    values = np.concatenate([logits[:, None], np.log(lengths), colors, means], axis=1, dtype=np.float32)
    mixed, front, around = np.empty_like(values), np.empty_like(values), np.empty(len(means))
    ones, half = np.ones(len(means)), np.full(3, max(float(np.abs(means).max()), 1e-12))
    mix_neighbours(*curves(means, half), means, lengths.mean(axis=1), ones, ones, values, mixed, front, around)
    beside = mixed - values
    pull = np.einsum("kij,ki->kj", factors, beside[:, 7:]) / lengths**2
    factors *= np.where(pull < 0, np.float32(-1), np.float32(1))[:, None, :]
    far = np.minimum(np.abs(pull), FARTHEST).astype(np.float32)  # in lengths of the axis: flat ones have no bound
    known = np.concatenate([values[:, :7], beside[:, :7], far], axis=1)
    spread = known.std(axis=0, dtype=np.float64)
    scaled = (known - known.mean(axis=0, dtype=np.float64)) / np.where(spread > 1e-9, spread, np.inf)
    return np.clip(scaled, -FARTHEST, FARTHEST).astype(np.float32)


def sample_of(count: int) -> tuple[int, int]:
    """Return every how many runs of `RUN` of ``count`` Gaussians are regressed on, and how many Gaussians that makes.

    All below twice `SAMPLE`, else at least `SAMPLE` and less than twice as many.
    """
    every = max(count // SAMPLE, 1)
    return (1, count) if every == 1 else (every, -(-(count // RUN) // every) * RUN)


def sampled(numbers: np.ndarray) -> np.ndarray:
    """Return rows of ``numbers`` (K, m) that `sample_of` chooses: (n, m)."""
    every, count = sample_of(len(numbers))
    if every == 1:
        return numbers
    runs = numbers[: len(numbers) - len(numbers) % RUN].reshape(-1, RUN, numbers.shape[1])
    return runs[::every].reshape(count, -1)


class SharedSteps:
    """The regression, made once a run: features of all, and what turns directions of the sample into weights.

    Attributes:
        features: (ceil(K / LANES), FEATURES, LANES) int8, of which `ONE` is 1: 1, the numbers known, random features;
            the last block is filled up with 0.
        solver: (FEATURES, n) float32, ridge regression on the n Gaussians of the sample: their directions (n,) to the
            features' weights.
        factor: on what is foretold: grows while predictions agree with the ones before, and falls where they turn.
        agreement: running mean of the cosine between two in a row.
        before: (KNOWN, FEATURES) the last ones, zero at first.
    """

    def __init__(self, known: np.ndarray) -> None:
        """Prepare from ``known`` (K, 17), as `aligned` returns it."""
        count, inputs = known.shape
        rng = np.random.default_rng(0)  # the same features in each run
        mixing = (rng.normal(size=(inputs, FEATURES - inputs - 1)) * (BENT / np.sqrt(inputs))).astype(np.float32)
        offsets = rng.normal(size=mixing.shape[1]).astype(np.float32)
        some = sampled(known)
        middle = np.maximum(some @ mixing + offsets, 0).mean(axis=0)

        def rows(part: np.ndarray) -> np.ndarray:
            bent = np.maximum(part @ mixing + offsets, 0) - middle
            features = np.concatenate([np.ones((len(part), 1), np.float32), part, bent], axis=1)
            return np.clip(np.rint(features * ONE), -MAX_FEATURE, MAX_FEATURE)

        numbers = rows(some).astype(np.float64)
        square = numbers.T @ numbers
        square[np.diag_indices(FEATURES)] *= 1 + RIDGE
        square[np.diag_indices(FEATURES)] += 1e-9  # of a feature that none has
        self.solver = np.linalg.solve(square, numbers.T).astype(np.float32)
        self.factor, self.agreement, self.before = GAIN, AGREEING, np.zeros((KNOWN, FEATURES))
        self.features = np.zeros((-(-count // LANES), FEATURES, LANES), np.int8)
        for begin in range(0, count, BATCH):
            part = np.zeros((-(-min(BATCH, count - begin) // LANES) * LANES, FEATURES), np.int8)
            part[: min(BATCH, count - begin)] = rows(known[begin : begin + BATCH])
            blocks = part.reshape(-1, LANES, FEATURES)
            self.features[begin // LANES : begin // LANES + len(blocks)] = blocks.transpose(0, 2, 1)

    def weights(self, directions: np.ndarray) -> np.ndarray:
        """Return (KNOWN, FEATURES) float32: `factor` x the regression of finite ``directions`` (COUNT, n).

        Not of what turns the axes: it has no sign that means the same for all.
        """
        weights = np.empty((KNOWN, FEATURES), np.float32)
        steps.regress(self.solver, directions, self.factor, weights)
        plain = weights.astype(np.float64) / self.factor
        size = math.sqrt(float(np.square(plain).sum()) * float(np.square(self.before).sum()))
        if 0 < size < math.inf:
            cosine = float((plain * self.before).sum()) / size
            self.agreement = RECALL * self.agreement + (1 - RECALL) * cosine
            self.factor = min(max(self.factor * math.exp(PACE * (self.agreement - AGREEING)), BOUNDS[0]), BOUNDS[1])
        self.before = plain
        return weights

    def last(self) -> np.ndarray:
        """Return the last prediction (KNOWN x FEATURES), its factor and agreement, in one array."""
        return np.append(self.before, (self.factor, self.agreement))

    def saved(self) -> dict[str, np.ndarray]:
        """Return what the next steps depend on."""
        return {"last": self.last()}

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Put back what `saved` gave."""
        self.before = saved["last"][:-2].reshape(KNOWN, FEATURES)
        self.factor, self.agreement = map(float, saved["last"][-2:])


def shared_steps(means: np.ndarray, factors: np.ndarray, logits: np.ndarray, colors: np.ndarray) -> SharedSteps | None:
    """Prepare from a start, whose axes are put in order in place; None with too few Gaussians for it."""
    if len(means) < LEAST:
        return None
    return SharedSteps(aligned(means, factors, logits, colors))
