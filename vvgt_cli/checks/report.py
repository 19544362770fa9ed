"""The report of `vvgt check`: cases are run, and their outcomes listed."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, field
from itertools import groupby
from typing import Any

from vvgt_cli.checks import Case, Outcome, run_case
from vvgt_cli.checks.stiffness import Stiffness
from vvgt_cli.progress import Console
from vvgt_cli.score.record import document


@dataclass
class CheckReport:
    """Outcomes of a check; docs/report.md describes `to_json`.

    Attributes:
        outcomes: one for each case.
        volume, transfer_function: records of the scene, if one was given.
        stiffness: of the scene; None for a file of Gaussians.
        splats: name, number, size and rule of the file of Gaussians, if one was given.
    """

    outcomes: list[Outcome] = field(default_factory=list)
    volume: dict[str, Any] | None = None
    transfer_function: dict[str, Any] | None = None
    stiffness: Stiffness | None = None
    splats: dict[str, Any] | None = None

    @property
    def failed(self) -> list[Outcome]:
        """Return the outcomes that did not pass."""
        return [outcome for outcome in self.outcomes if not outcome.passed]

    def to_json(self) -> str:
        """Return JSON with machine and versions."""
        counts = {"cases": len(self.outcomes), "failed": len(self.failed)}
        return document("vvgt-check", counts | asdict(self))

    def table(self) -> str:
        """Return a table: a row for each case and each stage, and the scene's stiffness."""
        stage, name = (max(len(getattr(o, key)) for o in self.outcomes) for key in ("stage", "name"))
        lines = [f"{'':<6}{'stage':<{stage}}  {'case':<{name}}  {'measured':>9} {'limit':>9}  of what"]
        for o in self.outcomes:
            numbers = f"{_number(o.value)} {_number(o.limit)}"
            row = f"{'ok' if o.passed else 'FAIL':<6}{o.stage:<{stage}}  {o.name:<{name}}  {numbers}"
            lines.append(f"{row}  {o.what if o.passed else o.problem}".rstrip())
        cases, failed = (Counter(o.stage for o in some) for some in (self.outcomes, self.failed))
        lines += ["", *(f"{key:<{stage}}  {cases[key]:>4} cases, {failed[key] or 'none'} failed" for key in cases)]
        if self.stiffness:
            lines += ["", *_stiffness_lines(self.stiffness)]
        return "\n".join(lines) + "\n"


def _number(value: float | None) -> str:
    return f"{'-' if value is None else f'{value:.3g}':>9}"


def _stiffness_lines(result: Stiffness) -> list[str]:
    needed = result.needed_step
    steps = f"{needed:g} voxels" if needed is not None else f"less than {min(map(float, result.errors)):g} voxels"
    rows = {
        "largest optical depth of a step of 0.5": f"{result.depth_per_step:.4g}",
        "largest change of extinction per voxel": f"{result.change_per_voxel:.4g} of the largest extinction",
        "neighbours that differ by more than half of it": f"{100 * result.abrupt:.3g} % of the visible pairs",
        "explicit Euler overshoots with steps above": f"{result.explicit_step:.3g} voxels (this renderer never does)",
        "error by step in voxels (RMS of RGBA)": ", ".join(f"{k}: {v:.2g}" for k, v in result.errors.items()),
        f"largest step with an error of at most {result.tolerance:g}": steps,
    }
    width = max(map(len, rows))
    return [f"{key:<{width}}  {value}" for key, value in rows.items()]


def run_cases(cases: list[Case], console: Console) -> list[Outcome]:
    """Run cases, with a line on the console for each stage."""
    outcomes: list[Outcome] = []
    bar = console.bar("check")
    for stage, group in groupby(cases, lambda case: case.stage):
        begin = len(outcomes)
        for case in group:
            outcomes.append(run_case(case))
            if bar:
                bar(len(outcomes), len(cases))
        done = outcomes[begin:]
        failed = sum(not o.passed for o in done)
        console.stage(stage, sum(o.seconds for o in done), f"{len(done)} cases, {failed or 'none'} failed")
    return outcomes
