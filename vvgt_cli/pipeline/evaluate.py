"""`evaluate`: a `.ply` against the volume it was made from, at several sizes, on the test views."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians import PlyHeader
from vvgt_cli.jit.ahead import EVALUATE
from vvgt_cli.pipeline.convert import describe_source, tf_record, volume_record
from vvgt_cli.pipeline.place import into_box
from vvgt_cli.pipeline.record import ConversionReport, Run, Stage, document
from vvgt_cli.pipeline.render import STDIN, open_gaussians
from vvgt_cli.pipeline.score import psnr_note, score_test_views
from vvgt_cli.pipeline.source import Source, SourceRequest, load
from vvgt_cli.progress import Console

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene


@dataclass(frozen=True)
class EvaluateRequest:
    """What to score.

    Attributes:
        ply: Gaussians, "-" for standard input.
        source: the volume and the function that they were made from.
        size: pixels along an image's edge at 1x.
        scales: multiples of the size to score at.
        step: of the reference, in voxels.
    """

    ply: str
    source: SourceRequest
    size: int = 400
    scales: tuple[int, ...] = (1, 2, 4)
    step: float = 0.125


@dataclass
class Evaluation:
    """Scores by scale, with what they were measured on; `to_json` is documented in docs/report.md."""

    gaussians: int
    size: int
    step: float
    views: int
    volume: dict[str, Any]
    transfer_function: dict[str, Any]
    reference_psnr: float
    scores: dict[str, dict[str, Any]] = field(default_factory=dict)
    stages: list[Stage] = field(default_factory=list)
    seconds: float = 0.0

    def to_json(self) -> str:
        """JSON with machine and versions."""
        return document("vvgt-evaluation", asdict(self))

    def table(self) -> str:
        """The scores as text: a row a number, a column a scale."""
        scales = list(self.scores)
        rows = [("", *(f"{scale} ({self.size * int(scale[:-1])} px)" for scale in scales))]
        for key in next(iter(self.scores.values())):
            if key == "per_view":
                continue
            values = [self.scores[scale][key] for scale in scales]
            rows.append((key.replace("_", " "), *map(_cell, values)))
        width = max(len(row[0]) for row in rows) + 2
        lines = [f"{row[0]:<{width}}" + "".join(f"{cell:>16}" for cell in row[1:]) for row in rows]
        lines.append(f"reference against a finer one: PSNR {self.reference_psnr:.2f} dB (middle of the first view, 1x)")
        return "\n".join(line.rstrip() for line in lines) + "\n"


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4f}" if isinstance(value, float) else str(value)


def _load(request: SourceRequest, header: PlyHeader) -> Source:
    """The source, with the file's own anatomical space and unit distance where none is asked for."""
    if request.read.space is None and header.space == "LPS":
        request = replace(request, read=replace(request.read, space="LPS"))
    if request.unit_distance is not None or header.unit_distance is None:
        return load(request)
    source = load(replace(request, unit_distance=repr(header.unit_distance)))
    return replace(source, unit_label=f"{header.unit_distance_label}, as the .ply records")


def evaluate(request: EvaluateRequest, console: Console | None = None) -> Evaluation:
    """Score a `.ply` against its volume.

    Raises:
        UsageError, DataError: inputs that are not what they must be.
    """
    from vvgt_cli.dvr import REFERENCE

    if request.ply == STDIN == request.source.volume:
        raise UsageError("both OUT.ply and --volume are '-': standard input holds one of them")
    run = Run(console or Console(), ConversionReport("evaluate"))
    with run.stage("read") as stage:
        gaussians, header = open_gaussians(request.ply, run.console)
        source = _load(request.source, header)
        gaussians = into_box(gaussians, source.volume)
        stage.note = f"{len(gaussians)} Gaussians; {describe_source(source)}"
    if header.affine is not None and not np.allclose(header.affine, source.volume.affine[:3].ravel(), rtol=1e-6):
        run.console.say(f"{request.ply}: its header's affine is not that of {source.volume.name}: of another volume?")
    run.compile(EVALUATE, source.kernel_type())
    with run.stage("scene"):
        scene = source.scene()
    with run.stage("reference") as stage:
        own = _reference_psnr(scene, request)
        stage.note = f"its own error {own:.1f} dB"
    evaluation = Evaluation(
        len(gaussians), request.size, request.step, len(default_views("test")), volume_record(source),
        tf_record(source, request.source), own,
    )  # fmt: skip
    for scale in sorted(set(request.scales)):
        with run.stage(f"test views {scale}x") as stage:
            bar = run.console.bar(f"test views {scale}x")
            settings = replace(REFERENCE, step=request.step)
            scores, _ = score_test_views(scene, gaussians, request.size * scale, settings, progress=bar)
            evaluation.scores[f"{scale}x"] = asdict(scores)
            stage.note = psnr_note(scores)
    evaluation.stages = run.report.stages
    evaluation.seconds = run.finish().seconds
    return evaluation


def _reference_psnr(scene: Scene, request: EvaluateRequest) -> float:
    """PSNR of the reference against half its step and twice its rays along a pixel's edge.

    Measured on the middle quarter of the first test view: the whole of it would cost as much as eight views.
    """
    from vvgt_cli.dvr import REFERENCE, render_view
    from vvgt_cli.metrics import score_view

    whole = default_views("test", size=request.size)[0]
    edge = request.size // 2
    offset = (request.size - edge) // 2
    middle = replace(whole, cx=whole.cx - offset, cy=whole.cy - offset, width=edge, height=edge)
    settings = replace(REFERENCE, step=request.step)
    finer = replace(settings, step=settings.step / 2, tiers=tuple((edge, 4 * rays) for edge, rays in settings.tiers))
    images = [render_view(scene, middle, s) for s in (finer, settings)]
    return score_view(images[0], images[1], perceptual=False).psnr
