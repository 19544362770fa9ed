"""What `convert` will do: which stages, how many Gaussians, views and steps, and what that should cost."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.cameras.sets import SET_VIEWS
from vvgt_cli.errors import UsageError
from vvgt_cli.resources import free_memory

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene

VERTEX_BYTES = 68  # x y z, normals, three colours, opacity, three scales, four of rotation: float32
HARMONIC_BYTES = {0: 0, 1: 36, 2: 96, 3: 180}  # zeros up to a degree
HEADER_BYTES = {0: 1000, 1: 1200, 2: 1600, 3: 2200}
DEFAULT_STEPS = 96  # of gradient descent: the knee of error against seconds (docs/plan.md)
DEFAULT_HALF_STEPS = 120  # likewise, on views half the size
MOST_STEPS = 400  # where a target or a time asks for as many as it takes
FEWEST_STEPS = 8  # less is not worth the views
ENOUGH_STEPS = 24  # as good as back-projection; fewer are taken after it
REFINE_VIEWS = 72  # training views of gradient descent, which learns fewer by heart
STEPS_A_SET = 48  # of gradient descent, for each further 24 views
SMALLER = (8, 4, 2)  # parts of the budget that a target is tried with first
PROBE = 80  # pixels along the edge of the view that is timed
# Seconds on two cores where 200,000 random float64 sort in `SORT`, fitted to conversions: docs/plan.md.
SORT = 0.95e-3
CLOSED_FORM = 0.85, 1.6, 0.25  # always, per 10^6 cells, per 10^6 voxels in bricks that are not empty
STEP = 0.013, 0.035  # per 400 x 400 px, per 100,000 Gaussians
HALF_STEP = 0.006, 0.017  # likewise, on a view half that size
WHOLE = 400  # pixels along the edge of a training view, at most: more show no more (docs/optimize.md)
SMALLEST_HALF = 64  # pixels along the edge of a training view half that size: four tiles
BACK_PROJECTION = 140.0  # steps
NETWORK = 0.5, 4.0  # always, per 100,000 Gaussians (docs/network.md)
VIEW = 1.1  # of the view that is timed
FINER = 1.8  # of the view that is timed: check and test views
SCORE, SCORE_ALL = (3, 0.03), (10, 0.2)  # views, and seconds a view beside its rendering
SEATS = 2, 0.3  # check views, and seconds beside them
MEMORY = 2.6e8, 294.0, 1240.0  # bytes: program and kernels, a cell, a Gaussian
SURE = 0.8  # of an estimate of memory: as little has been enough
VIEW_MEMORY = 22.0  # bytes a pixel of each view


@dataclass(frozen=True)
class Limits:
    """What a user allows, any or none.

    Attributes:
        target_psnr: dB on the check views that are enough.
        time_budget: wall seconds of the whole run, from the start of reading on.
        max_megabytes: size of the file, 10^6 bytes.
    """

    target_psnr: float | None = None
    time_budget: float | None = None
    max_megabytes: float | None = None

    def __post_init__(self) -> None:
        if self.target_psnr is not None and not 0 <= self.target_psnr <= 150:
            raise UsageError(f"--target-psnr {self.target_psnr:g}: expected 0 to 150 dB")
        if self.time_budget is not None and not 0 < self.time_budget < math.inf:
            raise UsageError(f"--time-budget {self.time_budget:g}: expected more than 0 seconds")
        if self.max_megabytes is not None and not 0 < self.max_megabytes < math.inf:
            raise UsageError(f"--max-size {self.max_megabytes:g}: expected more than 0 MB")

    def gaussians(self, most: int, sh_degree: int) -> int:
        """As many Gaussians as budget and file size allow.

        Raises:
            UsageError: not even one fits the size.
        """
        if self.max_megabytes is None:
            return most
        header, each = HEADER_BYTES[sh_degree], VERTEX_BYTES + HARMONIC_BYTES[sh_degree]
        fit = int((self.max_megabytes * 1e6 - header) // each)
        if fit < 1:
            least = (header + each) / 1e6
            raise UsageError(f"--max-size {self.max_megabytes:g}: no Gaussian fits; expected {least:.4f} MB or more")
        return min(most, fit)


def view_edge(size: int, half: bool) -> int:
    """Pixels along the edge of a training view: the size that the file is made for, or half of it, within bounds."""
    return min(size, WHOLE) // (2 if half else 1)


def views_of(steps: int) -> int:
    """Training views of so many steps: in a short run more steps gain more than more views."""
    fewest = SET_VIEWS["train"]
    return fewest * min(max(steps // STEPS_A_SET, 1), REFINE_VIEWS // fewest)


@dataclass(frozen=True)
class Costs:
    """Seconds and bytes that stages should take on this machine; docs/plan.md says how they were fitted.

    Attributes:
        closed_form: moments, pyramid and choice of cells.
        view: a view to fit to; ``judge`` a check or test view, of blocks of the size made for.
        back_projection: of 24 views.
        network: one pass of a network.
        step: of gradient descent, with its share of the looks at check views; ``half_step`` on a view half the size.
        score: test views.
        write: the file.
        memory: of the whole process at its most, bytes, without its views.
        there: of that, what the program and the volume have taken when the plan is made.
        view_memory: of a view to fit to, bytes; ``judge_memory`` of a check view.
    """

    closed_form: float
    view: float
    judge: float
    back_projection: float
    network: float
    step: float
    half_step: float
    score: float
    write: float
    memory: float
    there: float
    view_memory: float
    judge_memory: float

    def at(self, pace: float) -> Costs:
        """The same on a machine that takes ``pace`` times as long; what was timed, and what is small, stays."""
        names = ("closed_form", "back_projection", "network", "step", "half_step")
        return replace(self, **{name: getattr(self, name) * pace for name in names})


@dataclass
class Plan:
    """What is going to be done.

    Attributes:
        gaussians: budget.
        back_project: whether views correct the closed form by cells and colours, instead of many steps or before few.
        steps: of gradient descent, as many as there should be time for.
        most_steps: where there is more time than that.
        network: model that improves the Gaussians before the steps, or None.
        half: training views are half as large as they may be: descent gains as much in less time (docs/optimize.md).
        view_size: pixels along a training view's edge.
        judge: there is time for check views where a target asks for them.
        seconds, bytes, memory: estimates of the whole run, its file, its memory at most.
        stages: (stage, seconds) estimates in order.
        left_out: (stage, why) of what is not done.
    """

    gaussians: int
    back_project: bool = False
    steps: int = 0
    most_steps: int = 0
    network: str | None = None
    half: bool = False
    view_size: int = 0
    judge: bool = True
    seconds: float = 0.0
    bytes: int = 0
    memory: float = 0.0
    stages: list[tuple[str, float]] = field(default_factory=list)
    left_out: list[tuple[str, str]] = field(default_factory=list)

    def record(self) -> dict[str, Any]:
        """Plain values for the report."""
        return asdict(self)

    def text(self) -> str:
        """The plan as `--dry-run` prints it."""
        lines = [f"{name:<17}{seconds:8.1f} s" for name, seconds in self.stages]
        lines += [f"{name:<17}{'-':>8}    {why}" for name, why in self.left_out]
        lines.append(
            f"{'whole':<17}{self.seconds:8.1f} s, {self.memory / 2**30:.1f} GiB of memory, "
            f"{self.bytes / 1e6:.1f} MB with {self.gaussians} Gaussians"
        )
        return "\n".join(lines)


@dataclass(frozen=True)
class Planner:
    """What decides.

    Attributes:
        limits: what the user allows.
        gaussians: budget.
        steps: of gradient descent that the user asks for; None: the plan's choice.
        sh_degree: harmonics in the file.
        size: pixels along the edge of images that the file is made for.
        wide: Gaussians are wide enough to be seen in views half the size.
        model: network that the user asks for.
    """

    limits: Limits
    gaussians: int
    steps: int | None
    sh_degree: int
    size: int
    wide: bool = True
    model: str | None = None

    def plan(self, costs: Costs, spent: float, begun: bool = False) -> Plan:
        """Which stages fit, after ``spent`` seconds; ``begun``: the closed form is done."""
        plan = Plan(self.gaussians, memory=costs.memory)
        plan.bytes = file_bytes(self.gaussians, self.sh_degree)
        last = [("test views", costs.score), ("write", costs.write)]
        plan.stages = [("so far", spent)] + ([] if begun else [("closed form", costs.closed_form)])
        left = None
        if self.limits.time_budget is not None:
            left = self.limits.time_budget - sum(seconds for _, seconds in [*plan.stages, *last])
        self._views(plan, costs, left)
        plan.view_size = view_edge(self.size, plan.half)
        views = views_of(plan.steps) * (0.25 if plan.half else 1)
        plan.memory += views * costs.view_memory + SET_VIEWS["check"] * costs.judge_memory
        plan.stages += last
        plan.seconds = sum(seconds for _, seconds in plan.stages)
        return plan

    def _views(self, plan: Plan, costs: Costs, left: float | None) -> None:
        """What needs views: gradient descent, as asked for, as long as there is time, or as much as pays."""
        open_end = self.limits.target_psnr is not None or left is not None
        left = self._network(plan, costs, left)
        few = self.steps is not None and self.steps < ENOUGH_STEPS and left is None
        half = self.wide and not few and plan.network is None and self.size >= 2 * SMALLEST_HALF
        usual = DEFAULT_HALF_STEPS if half else DEFAULT_STEPS
        steps = wanted = self.steps if self.steps is not None else MOST_STEPS if open_end else usual
        while left is not None and steps > 0 and _refinement(costs, steps, half) > left:
            steps = min(steps - 1, int(steps * 0.9))
        if wanted and steps >= min(FEWEST_STEPS, wanted):
            plan.steps, plan.most_steps, plan.half = steps, wanted, half
            plan.stages.append((f"{'half ' if half else ''}views, {steps} steps", _refinement(costs, steps, half)))
            if self.model is None:
                plan.left_out.append(("network", "gradient descent gains more in its time; --model runs it"))
            if few:
                plan.back_project = True
                plan.stages.append(("back-projection", costs.back_projection))
            else:
                plan.left_out.append(("back-projection", "gradient descent gains more in its time"))
        else:
            plan.left_out.append(("refinement", _room(left) if wanted else "no steps are asked for"))
            self._without_steps(plan, costs, left)

    def _without_steps(self, plan: Plan, costs: Costs, left: float | None) -> None:
        """Back-projection instead, if there is time, and whether there is any for check views."""
        views = _refinement(costs, 0, False)
        plan.back_project = left is None or left >= views + costs.back_projection
        if plan.back_project:
            plan.stages.append(("back-projection", views + costs.back_projection))
        else:
            why = f"about {views + costs.back_projection:.1f} s with its views, {_room(left)}"
            plan.left_out.append(("back-projection", why))
            if plan.network:
                plan.stages.append(("views", views))
        plan.judge = plan.back_project or plan.network is not None or left is None or left >= views

    def _network(self, plan: Plan, costs: Costs, left: float | None) -> float | None:
        """The network, where one is asked for and there is time; returns what is left."""
        if self.model is None:
            return left
        if left is not None and left < costs.network + _refinement(costs, 0, False):
            plan.left_out.append(("network", f"about {costs.network:.1f} s, {_room(left)}"))
            return left
        plan.network = self.model
        plan.stages.append(("network", costs.network))
        return None if left is None else left - costs.network


def file_bytes(gaussians: int, sh_degree: int) -> int:
    """Of a `.ply`."""
    return HEADER_BYTES[sh_degree] + gaussians * (VERTEX_BYTES + HARMONIC_BYTES[sh_degree])


def _room(left: float | None) -> str:
    return f"{max(left or 0.0, 0.0):.1f} s are left"


def _refinement(costs: Costs, steps: int, half: bool) -> float:
    """Seconds of so many steps, with their views, ``half`` the size or whole, and the check views."""
    step, share = (costs.half_step, 0.25) if half else (costs.step, 1.0)
    return steps * step + views_of(steps) * share * costs.view + SET_VIEWS["check"] * costs.judge


def estimate(scene: Scene, size: int, gaussians: int, all_views: bool = False) -> Costs:
    """What stages should cost: a small view is timed, the rest follows from counts and the machine's pace.

    ``all_views``: the score is that of all test views, with the perceptual measures.
    """
    from vvgt_cli.cameras.blocks import BLOCK, spread_blocks
    from vvgt_cli.dvr.scene import BRICK
    from vvgt_cli.vbm.closed_form import expected_cells

    there = MEMORY[0] + _volume_bytes(scene)
    cells, pace, edge = expected_cells(scene, size, gaussians), _pace(), view_edge(size, half=False)
    blocks = spread_blocks(size, size)
    judged = size**2 if blocks is None else blocks.numbers.size * BLOCK**2  # pixels
    pixels = (edge / 400) ** 2
    voxels = np.count_nonzero(scene.empty == 0) * BRICK**3
    count = min(gaussians, cells)
    step, half_step = (pace * (each[0] * pixels + each[1] * count / 1e5) for each in (STEP, HALF_STEP))
    view = VIEW * _view_seconds(scene, edge)
    judge = FINER * view * judged / edge**2
    views, beside = SCORE_ALL if all_views else SCORE
    return Costs(
        closed_form=pace * (CLOSED_FORM[0] + CLOSED_FORM[1] * cells / 1e6 + CLOSED_FORM[2] * voxels / 1e6),
        view=view,
        judge=judge,
        back_projection=BACK_PROJECTION * step,
        network=pace * (NETWORK[0] + NETWORK[1] * count / 1e5),
        step=step,
        half_step=half_step,
        score=views * (judge + pace * beside * judged / 400**2) + SEATS[0] * judge + pace * SEATS[1],
        write=pace * 0.1,
        memory=there + working_memory(scene, size, gaussians),
        there=there,
        view_memory=VIEW_MEMORY * edge**2,
        judge_memory=VIEW_MEMORY * judged,
    )


def working_memory(scene: Scene, size: int, gaussians: int) -> float:
    """Bytes of cells and Gaussians at their most."""
    from vvgt_cli.vbm.closed_form import expected_cells

    cells = expected_cells(scene, size, gaussians)
    return MEMORY[1] * cells + MEMORY[2] * min(gaussians, cells)


def check_plan_memory(plan: Plan, costs: Costs, scene: Scene, size: int) -> None:
    """Refuse what would not fit, rather than have the system end it.

    Raises:
        UsageError: with the Gaussians that would fit.
    """
    need, free = SURE * (plan.memory - costs.there), free_memory()
    if free is None or need <= free:
        return
    views, fewer = plan.memory - costs.memory, plan.gaussians
    while fewer and SURE * (working_memory(scene, size, fewer) + views) > free:
        fewer //= 2
    advice = f"--max-gaussians {fewer} would fit" if fewer else "no number of Gaussians would fit"
    raise UsageError(
        f"{plan.gaussians} Gaussians need about {need / 2**30:.2f} GiB of memory more, {free / 2**30:.2f} GiB are "
        f"free; {advice}, or give the job more"
    )


def _volume_bytes(scene: Scene) -> int:
    """Of the values, and of the copy where the kernels need another type."""
    data, values = scene.volume.data, scene.values
    return data.nbytes + (0 if np.may_share_memory(data, values) else values.nbytes)


def _view_seconds(scene: Scene, size: int) -> float:
    """Of a check view with one ray a pixel and half-voxel steps, from one of `PROBE` px."""
    from vvgt_cli.cameras import default_views
    from vvgt_cli.dvr import RenderSettings, render_view

    settings = RenderSettings(samples=1)
    camera = default_views("check", size=PROBE)[0]
    render_view(scene, camera, settings)  # compiled, or loaded
    return _quickest(lambda: render_view(scene, camera, settings)) * (size / PROBE) ** 2


def _quickest(call: Callable[[], object]) -> float:
    """Seconds of the quickest of three calls."""
    taken = []
    for _ in range(3):
        begin = time.perf_counter()
        call()
        taken.append(time.perf_counter() - begin)
    return min(taken)


def _pace() -> float:
    """How many times as long as the machine of the fit this one takes: a sort, and the threads."""
    import numba

    values = np.random.default_rng(0).random(200_000)
    return _quickest(lambda: np.sort(values)) / SORT * (2 / numba.get_num_threads()) ** 0.7
