"""Looks at the check views in the course of a run."""

from __future__ import annotations

import numpy as np

from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.images.metrics import mean_psnr
from vvgt_cli.refine.options import Check, OptimizeRecord
from vvgt_cli.refine.states import State

GAIN = 0.01  # dB: less is none
FALLEN = 3.0  # dB below the best: rates were too large


class Judge:
    """Judge of a run by its check views, which keeps the best state that they have seen."""

    def __init__(self, state: State, check: Check | None, record: OptimizeRecord, rule: Rule = INRIA) -> None:
        """Judge ``state`` by the views of ``check``, drawn by ``rule``; scores go into ``record``."""
        self.state, self.check, self.record, self.rule = state, check, record, rule
        self.best: float | None = None
        self.kept: dict[str, np.ndarray] | None = None  # of what the state has saved, its arrays
        self.idle = 0

    def measure(self, seconds: float, settling: bool = False) -> bool:
        """Score the state, unless that has been done; True if it has fallen, and was put back to the best.

        Rates are kept up in the first half of a run, and pictures may get worse on the way: looks without gain count
        when it is ``settling``, and after a fall.
        """
        record = self.record
        if self.check is None or (record.checks and record.checks[-1][0] == record.steps):
            return False
        images = []
        cameras, views, blocks, weights = (*self.check, None, None)[:4]
        for i, camera in enumerate(cameras):
            part = None if blocks is None else blocks[i]
            image = self.state.picture(camera, self.rule, part)
            images.append(image if part is None else part.pick(image))
        now = mean_psnr(views, images, weights)
        record.checks.append((record.steps, seconds, now))
        fallen = self.best is not None and now < self.best - FALLEN and self.state.STEADY
        gained = self.best is None or now > self.best + GAIN
        self.idle = 0 if gained else self.idle + ((settling and self.state.STEADY) or fallen)
        if self.best is None or now > self.best:
            self.best, record.kept = now, record.steps
            self.kept = {k: array.copy() for k, array in self.state.saved().items() if k.startswith("array_")}
        if fallen:
            self._put_back()
        return fallen

    def _put_back(self) -> None:
        assert self.kept is not None
        self.state.restore(self.state.saved() | {name: array.copy() for name, array in self.kept.items()})

    def result(self, start: Gaussians) -> Gaussians:
        """Return the best state as Gaussians; the input itself where nothing was better."""
        self.record.psnr_after = self.best
        if self.check is None:
            self.record.kept = self.record.steps
        else:
            self._put_back()
        return self.state.gaussians() if self.record.kept else start
