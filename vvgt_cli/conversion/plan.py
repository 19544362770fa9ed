"""What `convert` will do: a list of stages, chosen by what they cost and what a user allows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from vvgt_cli.conversion.request import FitOptions, Limits, file_bytes
from vvgt_cli.conversion.stage import Stage
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
from vvgt_cli.conversion.stages.views import views_of
from vvgt_cli.defaults import STEPS
from vvgt_cli.errors import UsageError
from vvgt_cli.field.workload import Workload, for_budget, view_edge
from vvgt_cli.resources import free_memory

MOST_STEPS = 400  # where a target or a time asks for as many as it takes
FEWEST_STEPS = 8  # less is not worth the views
ENOUGH_STEPS = 24  # as good as back-projection; fewer are taken after it
SMALLEST = 64  # pixels along the edge of a training view that is small: four tiles
WRITE = 0.1  # seconds of the file, each time
SURE = 0.8  # of an estimate of memory: as little has been enough


@dataclass
class Plan:
    """What is going to be done.

    Attributes:
        case: what costs follow from.
        gaussians: budget.
        stages: in order.
        spent: seconds before the first of them.
        bytes: of the file.
        left_out: (stage, why) of what is not done.
        writes: how often the file is written.
    """

    case: Workload
    gaussians: int
    stages: list[Stage]
    spent: float = 0.0
    bytes: int = 0
    left_out: list[tuple[str, str]] = field(default_factory=list)
    writes: int = 1

    @property
    def writing(self) -> float:
        """Seconds of writing the file."""
        return self.case.pace * WRITE * self.writes

    def seconds_of(self, stages: Sequence[Stage]) -> float:
        """That they should take, and writing the file."""
        return sum(stage.cost(self.case).seconds for stage in stages) + self.writing

    @property
    def seconds(self) -> float:
        """Of the whole run."""
        return self.spent + self.seconds_of(self.stages)

    @property
    def working_memory(self) -> float:
        """Bytes that stages take beside the program and the volume."""
        return sum(stage.cost(self.case).memory for stage in self.stages)

    @property
    def memory(self) -> float:
        """Bytes of the whole process at its most."""
        return self.case.base_bytes + self.working_memory

    def after(self, stage: Stage) -> float:
        """Seconds of what follows a stage."""
        return self.seconds_of(self.stages[self.stages.index(stage) + 1 :])

    def costs(self) -> list[tuple[str, float]]:
        """(label, seconds) of every stage."""
        stages = [(stage.label(), stage.cost(self.case).seconds) for stage in self.stages]
        return [("so far", self.spent), *stages, ("write", self.writing)]

    def record(self) -> dict[str, Any]:
        """Plain values for the report."""
        return {
            "gaussians": self.gaussians,
            "seconds": self.seconds,
            "memory": self.memory,
            "bytes": self.bytes,
            "stages": [self._record(stage) for stage in self.stages],
            "left_out": self.left_out,
        }

    def _record(self, stage: Stage) -> dict[str, Any]:
        seconds, memory = stage.cost(self.case)
        chosen = {entry.name: getattr(stage, entry.name) for entry in fields(stage)}
        return {"name": stage.name, "seconds": seconds, "memory": memory, **chosen}

    def text(self) -> str:
        """The plan as `--dry-run` prints it."""
        lines = [f"{name:<24}{seconds:8.1f} s" for name, seconds in self.costs()]
        lines += [f"{name:<24}{'-':>8}    {why}" for name, why in self.left_out]
        lines.append(
            f"{'whole':<24}{self.seconds:8.1f} s, {self.memory / 2**30:.1f} GiB of memory, "
            f"{self.bytes / 1e6:.1f} MB with {self.gaussians} Gaussians"
        )
        return "\n".join(lines)


@dataclass(frozen=True)
class Planner:
    """What decides.

    Attributes:
        limits, fit: what the user asks for; ``fit.max_gaussians`` within the limits.
        sh_degree: degree of the spherical harmonics in the file.
        wide: Gaussians are wide enough to be seen in small views.
        whole: all ten test views are scored.
        writes: how often the file is written.
    """

    limits: Limits
    fit: FitOptions
    sh_degree: int = 0
    wide: bool = True
    whole: bool = False
    writes: int = 1

    @property
    def vbm(self) -> bool:
        """Whether the closed form has cells, of which a tree can be cut again."""
        return self.fit.init == "vbm"

    def plan(self, case: Workload, spent: float, begun: bool = False) -> Plan:
        """Which stages fit, after ``spent`` seconds; ``begun``: the closed form is done."""
        count = self.fit.max_gaussians
        plan = Plan(case, count, [], spent, file_bytes(count, self.sh_degree), writes=self.writes)
        first: list[Stage] = [ClosedFormStage()]
        last: list[Stage] = [TestViews(self.whole), ViewingConditions()]
        left = None
        if self.limits.time_budget is not None:
            left = self.limits.time_budget - spent - plan.seconds_of([*([] if begun else first), *last])
        between = self._improvements(plan, left)
        cut = any(isinstance(stage, CellsByError) for stage in between)
        if self._anew() or any(isinstance(stage, BackProjection) for stage in between):
            first = [ClosedFormStage(anew=True)]
        elif cut:
            first = [ClosedFormStage(cut=True)]
        plan.stages = [*([] if begun else first), *between, *last]
        return plan

    def _improvements(self, plan: Plan, left: float | None) -> list[Stage]:
        """What needs views: gradient descent, as asked for, as long as there is time, or as much as pays."""
        case = plan.case
        open_end = self.limits.target_psnr is not None or left is not None
        network, left = self._network(plan, left)
        few = self.fit.steps is not None and self.fit.steps < ENOUGH_STEPS and left is None
        small = self.wide and not few and not network and self.fit.size >= 2 * SMALLEST
        steps = wanted = self.fit.steps if self.fit.steps is not None else MOST_STEPS if open_end else STEPS
        while left is not None and steps > 0 and self._seconds(case, steps, small) > left:
            steps = min(steps - 1, int(steps * 0.9))
        if not wanted or steps < min(FEWEST_STEPS, wanted):
            plan.left_out.append(("refinement", _room(left) if wanted else "no steps are asked for"))
            return self._without_steps(plan, network, left)
        if self.fit.model is None:
            plan.left_out.append(("network", "gradient descent gains more in its time; --model runs it"))
        if not few:
            plan.left_out.append(("back-projection", "gradient descent gains more in its time"))
        *before, descent = self._descent(steps, small, wanted)
        return [*before, *([BackProjection()] if few else []), *network, descent]

    def _descent(self, steps: int, small: bool, most: int) -> list[Stage]:
        """Gradient descent and its views; cells by error but before few steps, and before a network."""
        enough = steps >= ENOUGH_STEPS
        return [
            CheckViews(),
            TrainingViews(views_of(steps, small), view_edge(self.fit.size, small)),
            *([CellsByError(small, keep=not self._anew())] if enough and self.vbm and self.fit.model is None else []),
            Refinement(steps, most, small, overlap=enough and self.vbm),
        ]

    def _anew(self) -> bool:
        """Whether the cells may be cut for fewer Gaussians in the end."""
        return self.limits.target_psnr is not None

    def _seconds(self, case: Workload, steps: int, small: bool) -> float:
        """Of so many steps, with their views, ``small`` ones or not, and the check views."""
        return sum(stage.cost(case).seconds for stage in self._descent(steps, small, steps))

    def _without_steps(self, plan: Plan, network: list[Stage], left: float | None) -> list[Stage]:
        """Back-projection instead, if there is time; check views where there is a target and time for them."""
        views = self._seconds(plan.case, 0, False)
        whole = views + BackProjection().cost(plan.case).seconds
        projected = left is None or left >= whole
        if not projected:
            plan.left_out.append(("back-projection", f"about {whole:.1f} s with its views, {_room(left)}"))
        check = CheckViews(fine=bool(network) or self.limits.target_psnr is not None)
        train = TrainingViews(views_of(0, small=False), view_edge(self.fit.size, small=False), fitted=bool(network))
        if projected or network:
            return [check, train, *([BackProjection()] if projected else []), *network]
        judge = self.limits.target_psnr is not None and (left is None or left >= views)
        return [check] if judge else []

    def _network(self, plan: Plan, left: float | None) -> tuple[list[Stage], float | None]:
        """The network, where one is asked for and there is time; and what is left."""
        if self.fit.model is None:
            return [], left
        stage = Network(self.fit.model)
        seconds = stage.cost(plan.case).seconds
        if left is not None and left < seconds + self._seconds(plan.case, 0, False):
            plan.left_out.append(("network", f"about {seconds:.1f} s, {_room(left)}"))
            return [], left
        return [stage], None if left is None else left - seconds


def _room(left: float | None) -> str:
    return f"{max(left or 0.0, 0.0):.1f} s are left"


def check_memory(plan: Plan, pictures: float = 0.0, beside: Callable[[Workload], float] = lambda _: 0.0) -> None:
    """Refuse what would not fit, rather than have the system end it.

    Args:
        plan: of the stages that are left.
        pictures: bytes of them that are kept beside what the stages take.
        beside: bytes that are kept of such a workload's Gaussians.

    Raises:
        UsageError: with the size or the Gaussians that would fit.
    """
    free, size = free_memory(), plan.case.size
    if free is None:
        return
    views = sum(stage.cost(plan.case).memory for stage in plan.stages if isinstance(stage, CheckViews | TrainingViews))
    if (drawn := views + pictures) > free:
        raise UsageError(
            f"--size {size}: views need {drawn / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB are free; --size "
            f"{max(int(size * (free / drawn) ** 0.5), 1)} would fit, or 'vvgt init', which renders none"
        )
    need = SURE * plan.working_memory + pictures + beside(plan.case)
    form, fewer = plan.stages[0], plan.gaussians
    if not isinstance(form, ClosedFormStage) or need <= free:
        return
    while fewer > 1:
        case = for_budget(plan.case, fewer)
        if SURE * (form.cost(case).memory + views) + pictures + beside(case) <= free:
            break
        fewer //= 2
    raise UsageError(
        f"{plan.gaussians} Gaussians need about {need / 2**30:.2f} GiB of memory more, {free / 2**30:.2f} GiB are "
        f"free; --max-gaussians {fewer} would fit, or give the job more"
    )
