"""`evaluate`: a `.ply` against the volume it was made from, on the test views, and from every condition."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any, BinaryIO

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.sets import SIZE
from vvgt_cli.conversion.certify import verify
from vvgt_cli.conversion.gaussian_files import STDIN, file_rule, layout_of, open_gaussians
from vvgt_cli.conversion.place import preview, to_box_frame, upright_axes
from vvgt_cli.conversion.recolored import SeveralLooks, apply_function, light_of
from vvgt_cli.errors import UsageError
from vvgt_cli.field.field import Field, Picture, Resident
from vvgt_cli.field.open import FieldNeeds, automatic, blocked, store_beside
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.field.source import Source, SourceRequest, describe_source, load, tf_record, volume_record
from vvgt_cli.gaussians import Gaussians, PlyHeader
from vvgt_cli.gaussians.outputs import Output, check_outputs
from vvgt_cli.gaussians.rules import Rule
from vvgt_cli.images.metrics import Texture
from vvgt_cli.jit.ahead import EVALUATE, for_blocks, for_degree
from vvgt_cli.look.labels import LabelTable
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run, StageRecord, document
from vvgt_cli.score.viewing import (
    CLOSE,
    ViewingCondition,
    condition_pictures,
    condition_views,
    near_cameras,
    score_conditions,
    score_texture,
    texture_note,
    viewing_conditions,
    zoomed,
)
from vvgt_cli.score.views import psnr_note, score_test_views, scored_views

PICTURED = 4  # test view of the preview: from the side
MIDDLE = 200  # pixels along the edge of what the reference's own error is measured on


@dataclass(frozen=True)
class EvaluateRequest:
    """What to score.

    Attributes:
        ply: Gaussians, "-" for standard input, or a stream of them.
        source: the volume and the function that they were made from.
        size: pixels along an image's edge; None: what the file is made for.
        rule: of `vvgt_cli.gaussians.rules` to draw by; None: the file's.
        step: of the reference, in voxels.
        conditions: score every rule at several sizes and close up as well, and texture on smooth areas.
        blocks: how the volume is processed in blocks; None: in memory, or in blocks where it is large.
        preview: PNG to write (reference, ours, difference of a test view and of a close-up), None for none.
        overwrite: replace it if it exists.
    """

    ply: str | BinaryIO
    source: SourceRequest
    size: int | None = None
    rule: str | None = None
    step: float = 0.125
    conditions: bool = True
    blocks: BlockOptions | None = None
    preview: str | None = None
    overwrite: bool = False

    def inputs(self) -> list[str]:
        """Files that are read."""
        return [*self.source.paths(), *([self.ply] if isinstance(self.ply, str) else [])]


@dataclass
class Evaluation:
    """Scores, the measurements they rest on, and whether the certificate of the file holds (docs/report.md)."""

    gaussians: int
    size: int
    rule: str
    step: float
    views: int
    volume: dict[str, Any]
    transfer_function: dict[str, Any]
    reference_psnr: float
    scores: dict[str, Any] = field(default_factory=dict)
    conditions: list[dict[str, Any]] = field(default_factory=list)
    texture: dict[str, Any] | None = None
    certificate: dict[str, Any] | None = None
    stages: list[StageRecord] = field(default_factory=list)
    seconds: float = 0.0

    def to_json(self) -> str:
        """JSON with machine and versions."""
        return document("vvgt-evaluation", asdict(self))

    def table(self) -> str:
        """The scores, a row a number, then the conditions by PSNR, worst first."""
        lines = [f"made for {self.size} px, drawn as {self.rule}"]
        for key, value in self.scores.items():
            if key != "per_view":
                lines.append(f"{key.replace('_', ' '):<24}{_cell(value):>12}")
        lines.append(f"reference against a finer one: PSNR {self.reference_psnr:.2f} dB (middle of the first view)")
        if self.texture is not None:
            lines.append(f"texture on smooth areas, near: {texture_note(Texture(**self.texture))}")
        if self.certificate is not None:
            lines.append(f"certificate {self.certificate['text']}")
        if self.conditions:
            lines.append(f"\n{'condition':<32}{'psnr':>10}")
        lines += [
            f"{ViewingCondition(**condition).name():<32}{condition['psnr']:>10.2f}" for condition in self.conditions
        ]
        return "\n".join(lines) + "\n"


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4f}" if isinstance(value, float) else str(value)


@contextmanager
def opened(run: Run, request: EvaluateRequest, gaussians: Gaussians, header: PlyHeader) -> Iterator[Field]:
    """The volume, with the file's own anatomical space, light and unit distance where none is asked for."""
    size, asked = request.size or header.made_for or SIZE, request.source.light
    dark = replace(request.source, light=LightOptions())
    if dark.read.space is None and header.space == "LPS":
        dark = replace(dark, read=replace(dark.read, space="LPS"))
    other = header.live is not None and (
        dark.tf is not None or dark.labels is not None
    )  # not the function whose distance the header has
    recorded = dark.unit_distance is None and header.unit_distance is not None and not other
    if recorded:
        dark = replace(dark, unit_distance=repr(header.unit_distance))

    def lit(source: Source) -> Source:
        preset = source.lighting if header.version is None else header.light
        if other:
            preset = source.lighting or header.light
        first, *others = source.layers
        if recorded:
            first = replace(first, unit_label=f"{header.unit_distance_label}, as the .ply records")
        return replace(source, layers=(first, *others), lighting=asked.lighting(preset, source.volume.space))

    kernels, options = for_degree(EVALUATE, gaussians.degree), request.blocks or automatic(dark, run.console)
    if options is None:
        with run.stage("read") as stage:
            source = lit(load(dark))
            stage.note = describe_source(source)
        run.compile(source.kernels(kernels), source.kernel_type())
        with run.stage("scene"):
            resident = Resident.of(source)
        yield resident
        return
    with store_beside(None) as store, blocked(run, dark, options, store, FieldNeeds(len(gaussians), size)) as found:
        found.source = lit(found.source)
        run.compile(for_blocks(found.source.kernels(kernels)), found.source.kernel_type())
        yield found


@contextmanager
def _together(field: Field, pictures: Sequence[Picture]) -> Iterator[None]:
    """Pictures that are asked for within: those of a volume in blocks are made together, and let go of."""
    field.views.expect(pictures)
    yield
    for picture in pictures:
        field.views.forget(picture)


def shown(gaussians: Gaussians, header: PlyHeader, source: Source, request: SourceRequest) -> Gaussians:
    """What carries values, under the function that is given; else the look of the file.

    Raises:
        UsageError: values that are looked at as labels, or the other way round.
    """
    if header.live is None or (request.labels is None and request.tf is None and not request.layers):
        return gaussians
    carried = ["labels" if one.labels else "values" for one in header.live.layers]
    shown = ["labels" if isinstance(layer.tf, LabelTable) else "values" for layer in source.layers]
    if carried != shown:
        raise UsageError(
            f"{source.name}: {', '.join(shown)}, but the Gaussians carry {', '.join(carried)}; expected the volume and "
            "--tf, --labels or --layer as they were converted with, or none of these, to score the look of the file"
        )
    looks = SeveralLooks(tuple((layer.tf, layer.unit_distance) for layer in source.layers))
    light = light_of(request.light, source.lighting, source.volume.space)
    options = replace(layout_of(header), unit_distance=source.unit_distance, light=light)
    return apply_function(gaussians, header, looks if header.live.others else source.tf, options)


def evaluate(request: EvaluateRequest, console: Console | None = None) -> Evaluation:
    """Score a `.ply` against its volume.

    Raises:
        UsageError, DataError: inputs that are not what they must be.
    """
    if request.ply == STDIN == request.source.volume:
        raise UsageError("both OUT.ply and --volume are '-': standard input holds one of them")
    run = Run(console or Console(), ConversionReport("evaluate"))
    if request.preview:
        check_outputs([Output("--preview", request.preview, (".png",))], request.inputs(), request.overwrite)
    gaussians, header = open_gaussians(request.ply)
    with opened(run, request, gaussians, header) as volume:
        source = volume.source
        gaussians = shown(gaussians, header, source, request.source)
        gaussians = to_box_frame(gaussians, source.volume)
        for remark in _doubts(request, header, source):
            run.console.message(f"{request.ply}: {remark}")
        return _scored(run, request, volume, gaussians, header)


def _doubts(request: EvaluateRequest, header: PlyHeader, source: Source) -> Iterator[str]:
    """What speaks against the file being of this volume, looked at so."""
    if header.affine is not None and not np.allclose(header.affine, source.volume.affine[:3].ravel(), rtol=1e-6):
        yield f"its header's affine is not that of {source.volume.name}: of another volume?"
    if header.live is None and header.optics is not None and header.optics != source.optics():
        yield (
            f"made under other labels, functions or layers than {source.name}, as its header says "
            f"({header.optics}, not {source.optics() or 'scalars'})"
        )


def _scored(run: Run, request: EvaluateRequest, volume: Field, gaussians: Gaussians, header: PlyHeader) -> Evaluation:
    """The scores, and a preview."""
    from vvgt_cli.dvr import REFERENCE
    from vvgt_cli.images import write_png

    source = volume.source
    size, rule = request.size or header.made_for or SIZE, file_rule(header, request.rule)
    with run.stage("reference") as stage:
        own = _reference_psnr(volume, size, request.step)
        stage.note = f"its own error {own:.1f} dB"
    evaluation = Evaluation(
        len(gaussians), size, rule.name, request.step, len(default_views("test")), volume_record(source),
        tf_record(source, request.source), own,
    )  # fmt: skip
    settings = replace(REFERENCE, step=request.step)
    wanted = [Picture(camera, settings, part) for _, camera, part in scored_views(size, perceptual=True)]
    with run.stage("test views") as stage, _together(volume, wanted):
        bar = run.console.bar("test views")
        scores = score_test_views(volume.views, gaussians, size, settings, rule=rule, progress=bar)
        evaluation.scores = asdict(scores)
        stage.note = f"{psnr_note(scores)}, {size} px"
    if header.certificate is not None:
        with run.stage("certificate") as stage:
            verdict = verify(header.certificate, volume, gaussians, header.live is not None and gaussians.live is None)
            evaluation.certificate = asdict(verdict) | {"holds": verdict.holds, "text": verdict.text()}
            stage.note = verdict.text()
    if request.preview:
        camera, axes = default_views("test", size=size)[PICTURED], upright_axes(source.volume, header.up)
        with run.stage("preview"):
            sheet = preview(volume.views, gaussians, [camera, zoomed(camera, CLOSE)], axes, rule)
            write_png(request.preview, sheet, request.overwrite)
    if request.conditions:
        _look_around(run, evaluation, volume, gaussians, rule)
    evaluation.stages = run.report.stages
    evaluation.seconds = run.finish().seconds
    return evaluation


def _look_around(run: Run, evaluation: Evaluation, volume: Field, gaussians: Gaussians, rule: Rule) -> None:
    """Seats, and texture from near."""
    from vvgt_cli.dvr import RenderSettings

    size, settings = evaluation.size, RenderSettings()
    places = viewing_conditions(size)
    wanted = [Picture(camera, settings, blocks) for _, camera, blocks in condition_pictures(places)]
    with run.stage("conditions") as stage, _together(volume, wanted):
        seen = condition_views(volume.views, places, settings, progress=run.console.bar("conditions"))
        conditions = score_conditions(gaussians, seen)
        evaluation.conditions = [asdict(condition) for condition in conditions]
        stage.note = f"worst: {conditions[0].name()}, {conditions[0].psnr:.2f} dB"
    near = [Picture(camera, settings) for camera in near_cameras(size)]
    with run.stage("texture") as stage, _together(volume, near):
        found = score_texture(volume.views, gaussians, size, rule, settings, progress=run.console.bar("texture"))
        evaluation.texture = asdict(found)
        stage.note = texture_note(found)


def _reference_psnr(volume: Field, size: int, step: float) -> float:
    """PSNR of the reference against half its step and twice its rays along a pixel's edge.

    Measured on the middle of the first test view: the whole of it would cost as much as eight views.
    """
    from vvgt_cli.dvr import REFERENCE, render_view
    from vvgt_cli.images.metrics import score_view

    whole = default_views("test", size=size)[0]
    edge = min(size // 2, MIDDLE)
    offset = (size - edge) // 2
    middle = replace(whole, cx=whole.cx - offset, cy=whole.cy - offset, width=edge, height=edge)
    settings = replace(REFERENCE, step=step)
    finer = replace(settings, step=settings.step / 2, tiers=tuple((edge, 4 * rays) for edge, rays in settings.tiers))
    with _together(volume, [Picture(middle, finer), Picture(middle, settings)]):
        images = [render_view(volume.views, middle, s) for s in (finer, settings)]
    return score_view(images[0], images[1], perceptual=False).psnr
