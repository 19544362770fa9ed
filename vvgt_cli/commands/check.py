"""`check`: the stability suite, one scene's share of it with its stiffness, or what a file of Gaussians is like."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

from vvgt_cli.checks import Case, Outcome, all_cases, run_case
from vvgt_cli.checks.stiffness import Stiffness, scene_cases, stiffness
from vvgt_cli.commands.check_splats import splats_opened
from vvgt_cli.field.source import SourceRequest, describe_source, load, tf_record, volume_record
from vvgt_cli.progress import Console
from vvgt_cli.score.record import document

TOLERANCE = 0.002  # RMS of RGBA


@dataclass
class CheckReport:
    """What the suite found; `to_json` is documented in docs/report.md.

    Attributes:
        outcomes: a case each.
        volume, transfer_function, stiffness: of the scene, where one was given.
        splats: name, number, size and rule of the file of Gaussians that was looked at.
    """

    outcomes: list[Outcome] = field(default_factory=list)
    volume: dict[str, Any] | None = None
    transfer_function: dict[str, Any] | None = None
    stiffness: Stiffness | None = None
    splats: dict[str, Any] | None = None

    @property
    def failed(self) -> list[Outcome]:
        """Cases that did not pass."""
        return [outcome for outcome in self.outcomes if not outcome.passed]

    def to_json(self) -> str:
        """JSON with machine and versions."""
        counts = {"cases": len(self.outcomes), "failed": len(self.failed)}
        return document("vvgt-check", counts | asdict(self))

    def table(self) -> str:
        """A row a case, a row a stage, and the scene's stiffness."""
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


def _stiffness_lines(found: Stiffness) -> list[str]:
    needed = found.needed_step
    steps = f"{needed:g} voxels" if needed is not None else f"less than {min(map(float, found.errors)):g} voxels"
    rows = {
        "largest optical depth of a step of 0.5": f"{found.depth_per_step:.4g}",
        "largest change of extinction per voxel": f"{found.change_per_voxel:.4g} of the largest extinction",
        "neighbours that change by more than half of it": f"{100 * found.abrupt:.3g} % of those that show anything",
        "explicit Euler overshoots in steps above": f"{found.explicit_step:.3g} voxels (this renderer in none)",
        "error by step in voxels (RMS of RGBA)": ", ".join(f"{k}: {v:.2g}" for k, v in found.errors.items()),
        f"step that an error of {found.tolerance:g} needs": steps,
    }
    width = max(map(len, rows))
    return [f"{key:<{width}}  {value}" for key, value in rows.items()]


def check(
    source: SourceRequest | None, tolerance: float | None, console: Console | None = None, splats: str | None = None
) -> CheckReport:
    """Run the suite; with a source, its own cases and its stiffness instead; with Gaussians, theirs.

    Args:
        source: volume and function to look at, None for the suite.
        tolerance: root-mean-square error of pictures in [0, 1] that the scene's step is chosen for, or that Gaussians
            may have; None: `TOLERANCE`, or that of `check_splats`.
        console: where progress goes.
        splats: file of Gaussians to look at, beside the source if there is one.

    Raises:
        UsageError, DataError: a source that cannot be read.
    """
    console = console or Console()
    if splats is not None:
        with splats_opened(splats, source, tolerance, console) as looked:
            outcomes = _run_cases(looked.cases, console)
        return CheckReport(outcomes, looked.volume, looked.function, splats=looked.about)
    if source is None:
        return CheckReport(_run_cases(list(all_cases()), console))
    loaded = load(source)
    console.say(describe_source(loaded))
    scene = loaded.scene()
    found = stiffness(scene, tolerance or TOLERANCE, console.bar("stiffness"))
    outcomes = _run_cases(list(scene_cases(scene)), console)
    return CheckReport(outcomes, volume_record(loaded), tf_record(loaded, source), found)


def _run_cases(cases: list[Case], console: Console) -> list[Outcome]:
    outcomes: list[Outcome] = []
    bar = console.bar("check")
    for case in cases:
        if outcomes and case.stage != outcomes[-1].stage:
            _say(console, outcomes, outcomes[-1].stage)
        outcomes.append(run_case(case))
        if bar:
            bar(len(outcomes), len(cases))
    _say(console, outcomes, outcomes[-1].stage)
    return outcomes


def _say(console: Console, outcomes: Iterable[Outcome], stage: str) -> None:
    own = [o for o in outcomes if o.stage == stage]
    failed = sum(not o.passed for o in own)
    console.stage(stage, sum(o.seconds for o in own), f"{len(own)} cases, {failed or 'none'} failed")
