"""The plan of a conversion: a list of stages, chosen by their costs and the user's limits, or a warm start."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

from vvgt_cli.conversion.request import ConvertRequest, FitOptions, file_bytes
from vvgt_cli.conversion.stage import Stage, Work
from vvgt_cli.conversion.stages import (
    BackProjection,
    CellsByError,
    CheckViews,
    ClosedFormStage,
    Network,
    Refinement,
    TestViews,
    TrainingViews,
    ViewingConditions,
)
from vvgt_cli.conversion.stages.parts import OutOfCore
from vvgt_cli.conversion.stages.refinement import early_end, most_steps, steps_in_time
from vvgt_cli.conversion.stages.views import view_count
from vvgt_cli.errors import UsageError
from vvgt_cli.field.field import ViewRenderer
from vvgt_cli.field.workload import Workload, for_budget, view_edge
from vvgt_cli.resources import free_memory
from vvgt_cli.score.record import Run
from vvgt_cli.score.viewing import UPRIGHT, Axes

ENOUGH_STEPS = 24  # as good as back-projection, which precedes fewer steps
FINISHING = 20  # steps on whole views after those on parts: few enough that cells by error are left out
SMALLEST = 64  # pixels along the edge of a training view that is small: four tiles
WRITE = 0.1  # seconds of writing the file once
SURE = 0.8  # share of the estimated memory that is certainly needed


@dataclass
class Plan:
    """The stages of a conversion, with their expected costs.

    Attributes:
        workload: counts and machine pace that costs follow from.
        gaussians: budget of Gaussians.
        stages: stages in order.
        spent: seconds before the first stage.
        bytes: size of the file.
        skipped: (stage, reason) of stages that are not run.
        writes: number of times that the file is written.
    """

    workload: Workload
    gaussians: int
    stages: list[Stage]
    spent: float = 0.0
    bytes: int = 0
    skipped: list[tuple[str, str]] = field(default_factory=list)
    writes: int = 1

    @property
    def writing(self) -> float:
        """Return the seconds of writing the file."""
        return self.workload.pace * WRITE * self.writes

    def seconds_of(self, stages: Sequence[Stage]) -> float:
        """Return the expected seconds of some stages and of writing the file."""
        return sum(stage.cost(self.workload).seconds for stage in stages) + self.writing

    @property
    def seconds(self) -> float:
        """Return the expected seconds of the whole run."""
        return self.spent + self.seconds_of(self.stages)

    @property
    def working_memory(self) -> float:
        """Return the bytes that stages need in addition to program and volume."""
        return sum(stage.cost(self.workload).memory for stage in self.stages)

    @property
    def memory(self) -> float:
        """Return the peak memory of the process in bytes."""
        return self.workload.base_bytes + self.working_memory

    def after(self, stage: Stage) -> float:
        """Return the expected seconds after a stage."""
        return self.seconds_of(self.stages[self.stages.index(stage) + 1 :])

    def for_finished(self, count: int, degree: int) -> Plan:
        """Return the plan for ``count`` finished Gaussians with harmonics of ``degree``: only scores."""
        return replace(
            self, gaussians=count, workload=replace(self.workload, gaussians=count), bytes=file_bytes(count, degree),
            stages=[stage for stage in self.stages if stage.scores], skipped=[],
        )  # fmt: skip

    def costs(self) -> list[tuple[str, float]]:
        """List (label, seconds) of every stage."""
        stages = [(stage.label(), stage.cost(self.workload).seconds) for stage in self.stages]
        return [("so far", self.spent), *stages, ("write", self.writing)]

    def record(self) -> dict[str, Any]:
        """Return plain values for the report."""
        return {
            "gaussians": self.gaussians,
            "seconds": self.seconds,
            "memory": self.memory,
            "bytes": self.bytes,
            "stages": [self._record(stage) for stage in self.stages],
            "skipped": self.skipped,
        }

    def _record(self, stage: Stage) -> dict[str, Any]:
        seconds, memory = stage.cost(self.workload)
        chosen = {entry.name: getattr(stage, entry.name) for entry in fields(stage)}
        return {"name": stage.name, "seconds": seconds, "memory": memory, **chosen}

    def text(self) -> str:
        """Return the plan as `--dry-run` prints it."""
        lines = [f"{name:<24}{seconds:8.1f} s" for name, seconds in self.costs()]
        lines += [f"{name:<24}{'-':>8}    {why}" for name, why in self.skipped]
        lines.append(
            f"{'whole':<24}{self.seconds:8.1f} s, {self.memory / 2**30:.1f} GiB of memory, "
            f"{self.bytes / 1e6:.1f} MB with {self.gaussians} Gaussians"
        )
        return "\n".join(lines)


@dataclass(frozen=True)
class Planner:
    """The choice of stages for a request.

    Attributes:
        fit: the user's options and limits; ``max_gaussians`` is within the latter.
        sh_degree: degree of the spherical harmonics in the file.
        wide: whether Gaussians are wide enough to be seen in small views.
        whole: whether all ten test views are scored.
        writes: number of times that the file is written.
        axes: those of a headset, `vvgt_cli.conversion.place.headset_axes`.
        parts: the stage that makes all Gaussians out of core; None: they are made in memory.
    """

    fit: FitOptions
    sh_degree: int = 0
    wide: bool = True
    whole: bool = False
    writes: int = 1
    axes: Axes = UPRIGHT
    parts: OutOfCore | None = None

    def plan(self, workload: Workload, spent: float, begun: bool = False) -> Plan:
        """Return the stages that fit after ``spent`` seconds; with ``begun`` the closed form is done."""
        count = self.fit.max_gaussians
        plan = Plan(workload, count, [], spent, file_bytes(count, self.sh_degree), writes=self.writes)
        first: list[Stage] = [ClosedFormStage()]
        levels = self.parts is not None and self.parts.levels
        last: list[Stage] = [TestViews(self.whole), ViewingConditions(self.fit.target, self.axes, levels)]
        if self.parts is not None:
            plan.stages = [self.parts, *([] if levels else self._finish()), *last]
            return plan
        left = None
        if self.fit.time_budget is not None:
            left = self.fit.time_budget - spent - plan.seconds_of([*([] if begun else first), *last])
        between = self._improvements(plan, left)
        cut = any(isinstance(stage, CellsByError) for stage in between)
        if self._recuts() or any(isinstance(stage, BackProjection) for stage in between):
            first = [ClosedFormStage(recut=True)]
        elif cut:
            first = [ClosedFormStage(recut_by_error=True)]
        plan.stages = [*([] if begun else first), *between, *last]
        return plan

    def _improvements(self, plan: Plan, left: float | None) -> list[Stage]:
        """Return the stages that need views: gradient descent by `most_steps`, fewer if time is short."""
        workload = plan.workload
        network, left = self._network(plan, left)
        few = self.fit.steps is not None and self.fit.steps < ENOUGH_STEPS and left is None
        small = self.wide and not few and not network and self.fit.screen >= 2 * SMALLEST
        wanted = most_steps(self.fit)
        steps = steps_in_time(wanted, left, lambda steps: self._seconds(workload, steps, small))
        if not steps:
            plan.skipped.append(("refinement", _time_left(left) if wanted else "no steps are requested"))
            return self._without_steps(plan, network, left)
        if self.fit.model is None:
            plan.skipped.append(("network", "gradient descent gains more in the same time; --model runs it"))
        if not few:
            plan.skipped.append(("back-projection", "gradient descent gains more in the same time"))
        *before, descent = self._descent(steps, small, wanted)
        return [*before, *([BackProjection()] if few else []), *network, descent]

    def _finish(self) -> list[Stage]:
        """Return the few steps on whole views that follow those on parts; none where time is limited."""
        steps = min(FINISHING, self.fit.steps or FINISHING)
        return self._descent(steps, self.wide, steps) if self.fit.time_budget is None else []

    def _descent(self, steps: int, small: bool, most: int) -> list[Stage]:
        """Return gradient descent with its views, and cells by error unless steps are few or a network runs."""
        enough = steps >= ENOUGH_STEPS and self.fit.init == "moments"  # else no pyramid can be cut again
        return [
            CheckViews(),
            TrainingViews(view_count(steps, small), view_edge(self.fit.screen, small)),
            *([CellsByError(small, keep=not self._recuts())] if enough and self.fit.model is None else []),
            Refinement(steps, most, small, early_end(self.fit, steps), overlap=enough),
        ]

    def _recuts(self) -> bool:
        """Return whether the pyramid may be cut again, for fewer Gaussians."""
        return self.fit.target_psnr is not None

    def _seconds(self, workload: Workload, steps: int, small: bool) -> float:
        """Return the expected seconds of descent with its views (``small`` or not) and the check views."""
        return sum(stage.cost(workload).seconds for stage in self._descent(steps, small, steps))

    def _without_steps(self, plan: Plan, network: list[Stage], left: float | None) -> list[Stage]:
        """Return back-projection instead, if there is time, or check views for a target."""
        views = self._seconds(plan.workload, 0, False)
        whole = views + BackProjection().cost(plan.workload).seconds
        projected = left is None or left >= whole
        if not projected:
            plan.skipped.append(("back-projection", f"about {whole:.1f} s with its views, {_time_left(left)}"))
        check = CheckViews(fine=bool(network) or self.fit.target_psnr is not None)
        train = TrainingViews(view_count(0, small=False), view_edge(self.fit.screen, small=False), fitted=bool(network))
        if projected or network:
            return [check, train, *([BackProjection()] if projected else []), *network]
        measured = self.fit.target_psnr is not None and (left is None or left >= views)
        return [check] if measured else []

    def _network(self, plan: Plan, left: float | None) -> tuple[list[Stage], float | None]:
        """Return the network, if requested and in time, and the time that remains."""
        if self.fit.model is None:
            return [], left
        stage = Network(self.fit.model)
        seconds = stage.cost(plan.workload).seconds
        if left is not None and left < seconds + self._seconds(plan.workload, 0, False):
            plan.skipped.append(("network", f"about {seconds:.1f} s, {_time_left(left)}"))
            return [], left
        return [stage], None if left is None else left - seconds


def _time_left(left: float | None) -> str:
    return f"{max(left or 0.0, 0.0):.1f} s remain"


def check_memory(plan: Plan, pictures: float = 0.0, beside: Callable[[Workload], float] = lambda _: 0.0) -> None:
    """Check that a plan fits into memory, before the system would end the process.

    Args:
        plan: plan of the remaining stages.
        pictures: bytes of pictures that are kept in addition.
        beside: bytes of Gaussians that are kept in addition, for a workload.

    Raises:
        UsageError: names the size or the number of Gaussians that would fit.
    """
    free, size = free_memory(), plan.workload.size
    if free is None:
        return
    views = sum(
        stage.cost(plan.workload).memory for stage in plan.stages if isinstance(stage, CheckViews | TrainingViews)
    )
    if (drawn := views + pictures) > free:
        raise UsageError(
            f"--screen {size}: views need {drawn / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB are free; --screen "
            f"{max(int(size * (free / drawn) ** 0.5), 1)} would fit, or try 'vvgt init', which renders none"
        )
    need = SURE * plan.working_memory + pictures + beside(plan.workload)
    form, fewer = plan.stages[0], plan.gaussians
    if not isinstance(form, ClosedFormStage) or need <= free:
        return
    while fewer > 1:
        workload = for_budget(plan.workload, fewer)
        if SURE * (form.cost(workload).memory + views) + pictures + beside(workload) <= free:
            break
        fewer //= 2
    raise UsageError(
        f"{plan.gaussians} Gaussians need about {need / 2**30:.2f} GiB of memory more, {free / 2**30:.2f} GiB are "
        f"free; --max-gaussians {fewer} would fit, or give the job more"
    )


def report_target(run: Run, fit: FitOptions, megabytes: float | None) -> None:
    """Report what a device allows, where the file is made for one."""
    if fit.target is not None:
        most = "" if megabytes is None else f"{megabytes:g} MB, "
        run.console.message(
            f"for {fit.target}: at most {most}{fit.max_gaussians} Gaussians, {fit.screen} px, drawn as {fit.rule}"
        )


class WarmStart(ABC):
    """Gaussians of an earlier conversion, tried before the closed form.

    Attributes:
        name: what is skipped where they are not taken.
    """

    name: ClassVar[str]

    def try_start(self, work: Work, plan: Plan, request: ConvertRequest) -> bool:
        """Derive the Gaussians of ``work`` from the earlier ones, and return whether they are as good as new ones.

        If they are, ``plan`` keeps only `TestViews`, and the other scores if ``scored_whole``; else ``work`` is reset.
        """
        why = self.obstacle(work, plan, request)
        if why is None:
            plan.stages = [s for s in plan.stages if isinstance(s, TestViews) or (s.scores and request.scored_whole)]
            return True
        work.reset()
        if why:
            work.run.skip(self.name, why)
        return False

    @abstractmethod
    def obstacle(self, work: Work, plan: Plan, request: ConvertRequest) -> str | None:
        """Derive the Gaussians of ``work``; return the reason why they are not taken, "" if there is nothing to say."""

    def renderer(self, views: ViewRenderer) -> ViewRenderer | None:
        """Return the renderer to convert by, which caches pictures of ``views``; None for no other."""
        return None

    def keep(self, work: Work, plan: Plan) -> None:  # noqa: B027
        """Store a conversion that did not start from another."""

    def facts(self) -> dict[str, Any]:
        """Return entries of the index for the last conversion."""
        return {}

    def memory(self, plan: Plan, fit: FitOptions) -> tuple[int, Callable[[Workload], float]]:
        """Return the bytes of pictures that it will keep, and a function of a workload for those of Gaussians."""
        return 0, lambda _: 0.0
