"""`vvgt convert` in blocks: the closed form, gradient descent and a score on views marched through the volume."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras.blocks import BLOCK
from vvgt_cli.conversion.case import PROGRAM, Case, expected_wide
from vvgt_cli.conversion.convert import improve, ply_options
from vvgt_cli.conversion.plan import Plan, Planner, check_memory
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.conversion.stages import CheckViews, Seats, TestViews, TrainingViews
from vvgt_cli.conversion.stages.closed_form import MEMORY
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians import as_stored
from vvgt_cli.jit.ahead import CONVERT, MERGE
from vvgt_cli.network.card import find_model, read_card
from vvgt_cli.progress import Console
from vvgt_cli.resources import free_memory
from vvgt_cli.runs.gaussian_files import write_gaussians
from vvgt_cli.runs.outputs import claimed, write_text
from vvgt_cli.runs.place import out_of_box
from vvgt_cli.runs.record import ConversionReport, Run
from vvgt_cli.runs.source import tf_record, volume_record
from vvgt_cli.runs.views import Views
from vvgt_cli.scale.merge import Cut, pyramid
from vvgt_cli.scale.parts import Parts
from vvgt_cli.scale.plan import Plan as BlockPlan
from vvgt_cli.scale.run import beside, make_parts, refuse
from vvgt_cli.scale.settings import ALWAYS, BlockOptions
from vvgt_cli.scale.sight import CHECK, TRAIN, Sight, marched, score_gaussians, score_text
from vvgt_cli.vbm import Start

if TYPE_CHECKING:
    from vvgt_cli.runs.source import Source


A_GAUSSIAN = MEMORY[1]  # bytes


def convert_in_blocks(
    request: ConvertRequest, options: BlockOptions, console: Console | None = None
) -> ConversionReport:
    """Volume to `.ply`, of which only blocks are ever in memory: views are marched through each while it is there.

    Raises:
        UsageError, DataError: as `vvgt_cli.conversion.convert.convert`; what blocks cannot do.
    """
    refuse(request, options)
    _refuse(request)
    run = Run(console or Console(), ConversionReport("convert"))
    request = replace(request, fit=replace(request.fit, max_gaussians=request.budget()))
    if request.fit.model is not None:
        read_card(find_model(request.fit.model))  # fails before the work, not after
    plan = _planned(request)
    check_memory(plan)
    _check_gaussians(plan)
    with claimed(request.outputs(), request.inputs(), request.overwrite), beside(request.output) as parts:
        sight = _sight(plan, request.fit.size)
        source = make_parts(run, request, options, parts, sight)
        run.report.plan = plan.record()
        work = _made(run, request, source, parts, sight, plan)
        _write(run, request, source, work)
        parts.remove()
    return run.report


def _refuse(request: ConvertRequest) -> None:
    """What of a conversion is not done in blocks."""
    budget = request.limits.time_budget
    for given, option in (
        (request.checkpoint, "--checkpoint"),
        (request.preview, "--preview"),
        (budget, "--time-budget"),
    ):
        if given is not None:
            raise UsageError(
                f"{option}: not of a volume that is gone through in blocks; leave it out"
                + (" (blocks that are done are kept as it is)" if option == "--checkpoint" else "")
            )


def _planned(request: ConvertRequest) -> Plan:
    """The stages after the closed form, with the number and size of the views that blocks are marched for."""
    fit = request.fit
    case = Case(gaussians=fit.max_gaussians, cells=0.0, voxels=0.0, size=fit.size, view=0.0, there=PROGRAM)
    guess = expected_wide(fit.max_gaussians, fit.size)  # views are marched before there are Gaussians
    planner = Planner(
        request.limits, fit.max_gaussians, fit.steps, request.ply.sh_degree or 0, fit.size, guess, fit.model
    )
    plan = planner.plan(case, 0.0, begun=True)
    plan.stages = [stage for stage in plan.stages if not isinstance(stage, TestViews | Seats)]
    plan.left_out.append(("seats", "they need the whole volume in memory"))
    return plan


def _check_gaussians(plan: Plan) -> None:
    """Refuse more Gaussians than the memory holds beside the views: they are not gone through in blocks.

    Raises:
        UsageError: with the number that would fit, if any does.
    """
    free = free_memory()
    views = sum(stage.cost(plan.case).memory for stage in plan.stages if isinstance(stage, CheckViews | TrainingViews))
    room = math.inf if free is None else free - ALWAYS - views
    if plan.gaussians * A_GAUSSIAN > room:
        fewer = int(room / A_GAUSSIAN)
        raise UsageError(
            f"{plan.gaussians} Gaussians need about {plan.gaussians * A_GAUSSIAN / 2**30:.1f} GiB of memory while they "
            f"are fitted; {f'--max-gaussians {fewer} would fit' if fewer > 0 else 'give the job more memory'}, or try "
            "'vvgt init', which writes them in blocks"
        )


def _sight(plan: Plan, size: int) -> Sight:
    """The views that a plan's stages ask for."""
    train = next((stage for stage in plan.stages if isinstance(stage, TrainingViews)), None)
    check = any(isinstance(stage, CheckViews) for stage in plan.stages)
    return Sight(size, check) if train is None else Sight(size, check, train.count, train.edge)


@dataclass(frozen=True)
class Marched(Stage):
    """Views put together from what blocks have left of them, in the place of a stage that renders them."""

    instead: CheckViews | TrainingViews
    parts: Parts
    plan: BlockPlan
    sight: Sight

    @property
    def name(self) -> str:  # type: ignore[override]
        """That of the stage."""
        return self.instead.name

    def cost(self, case: Case) -> Cost:
        """As the stage: the same views are held."""
        return self.instead.cost(case)

    def run(self, work: Work) -> None:
        """Put them together."""
        kind = CHECK if isinstance(self.instead, CheckViews) else TRAIN
        with work.run.stage(self.name) as stage:
            found = list(marched(self.parts, self.plan.grid, self.sight, kind))
            cameras = [look.camera for look, _ in found]
            if kind == CHECK:
                images = np.stack([image.reshape(-1, BLOCK, 4) for _, image in found])
                work.check = Views(cameras, images, [look.blocks for look, _ in found if look.blocks is not None])
                stage.note = f"{len(found)} of {self.sight.size} px, blocks of them"
            else:
                edge = self.sight.edge
                work.train = Views(cameras, np.stack([image.reshape(edge, edge, 4) for _, image in found]))
                work.train_rule = work.rule.at(edge / work.fit.size)
                stage.note = f"{len(found)} of {edge} px to fit to, one ray a pixel, steps of {found[0][0].step:g}"


def _made(run: Run, request: ConvertRequest, source: Source, parts: Parts, sight: Sight, plan: Plan) -> Work:
    """The Gaussians, fitted and scored."""
    blocks = BlockPlan.load(parts)
    run.compile(dict.fromkeys((*MERGE, *(name for name in CONVERT if ".dvr." not in name))))
    run.report.volume, run.report.transfer_function = volume_record(source), tf_record(source, request.source)
    run.report.options = asdict(request.fit) | asdict(request.limits) | {
        "frame": blocks.ply.frame, "up": blocks.ply.up, "sh_degree": blocks.ply.sh_degree,
    }  # fmt: skip
    with run.stage("closed form") as stage:
        forest, opaque = pyramid(parts, blocks)
        gaussians, spared = Cut(forest, opaque, blocks).whole()
        stage.note = f"{len(gaussians)} Gaussians, of {forest.base} cells in {len(forest.tiles)} tiles"
    if spared:
        run.leave_out(f"{spared} Gaussians", "so faint that viewers differ on what they draw of them")
    work = Work(run, None, request.fit, request.limits)  # type: ignore[arg-type]  # nothing asks for the scene
    work.start, work.gaussians = Start(gaussians, None), gaussians
    stages: list[Stage] = [
        Marched(stage, parts, blocks, sight) if isinstance(stage, CheckViews | TrainingViews) else stage
        for stage in plan.stages
    ]
    improve(work, replace(plan, stages=stages))
    work.gaussians = as_stored(work.made())
    with run.stage(TestViews.name) as stage:
        scores = score_gaussians(work.gaussians, parts, blocks.grid, request.fit.size, request.fit.rule)
        run.report.scores = asdict(scores)
        stage.note = score_text(scores, request.fit.size)
    return work


def _write(run: Run, request: ConvertRequest, source: Source, work: Work) -> None:
    """Write the file and the report."""
    assert request.output is not None
    gaussians = out_of_box(work.made(), source.volume)
    write_gaussians(run, request.output, gaussians, ply_options(request, source), request.overwrite)
    run.finish()
    if request.report:
        write_text(request.report, run.report.to_json(), request.overwrite)
