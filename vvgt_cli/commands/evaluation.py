"""Scores of Gaussians against their volume, on test views and under all viewing conditions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any, BinaryIO

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.sets import SIZE
from vvgt_cli.conversion.certify import rounded_error, verify
from vvgt_cli.conversion.gaussian_files import STDIN, file_rule, layout_of, levels_in_box, open_gaussians, shown_levels
from vvgt_cli.conversion.place import headset_axes, to_box_frame, upright_axes
from vvgt_cli.conversion.recolored import apply_function, light_of, looks_of
from vvgt_cli.errors import UsageError
from vvgt_cli.field.field import Field, Picture
from vvgt_cli.field.open import FieldNeeds, opened
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.field.source import SourceRequest, StyledVolume, tf_record, volume_record
from vvgt_cli.gaussians import Gaussians, PlyHeader
from vvgt_cli.gaussians.formats.streamed import VIEW, split_name
from vvgt_cli.gaussians.outputs import Output, check_outputs
from vvgt_cli.gaussians.rules import Rule
from vvgt_cli.gaussians.targets import target_of
from vvgt_cli.images import captioned, write_png
from vvgt_cli.images.metrics import Texture
from vvgt_cli.jit.ahead import EVALUATE, for_degree
from vvgt_cli.library.inputs import PathLike
from vvgt_cli.look.labels import LabelTable
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run, StageRecord, document
from vvgt_cli.score.viewing import (
    CLOSE,
    ConditionPicture,
    ViewingCondition,
    condition_pictures,
    condition_views,
    distance_pictures,
    eye_pictures,
    near_cameras,
    score_conditions,
    score_texture,
    texture_note,
    viewing_conditions,
    zoomed,
)
from vvgt_cli.score.views import preview as side_by_side
from vvgt_cli.score.views import psnr_note, score_test_views, scored_views
from vvgt_cli.splat.render import Shown
from vvgt_cli.volume import ReadOptions

PICTURED = 4  # test view of the preview: from the side
MIDDLE = 200  # pixels along the edge of what the reference's own error is measured on


@dataclass
class Evaluation:
    """Scores, what they were measured on, and whether the file's certificate holds (docs/report.md)."""

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
        """Return JSON with machine and versions."""
        return document("vvgt-evaluation", asdict(self))

    def table(self) -> str:
        """Return a table: one score per row, then the viewing conditions by PSNR, worst first."""
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
            lines.append(f"\n{'viewing condition':<32}{'psnr':>10}")
        lines += [f"{ViewingCondition(**one).name():<32}{one['psnr']:>10.2f}" for one in self.conditions]
        return "\n".join(lines) + "\n"


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4f}" if isinstance(value, float) else str(value)


def opened_as_recorded(
    run: Run, request: SourceRequest, gaussians: Gaussians, header: PlyHeader, size: int,
    options: BlockOptions | None = None,
) -> AbstractContextManager[Field]:  # fmt: skip
    """Return a context with the volume, by default in the file's own anatomical space, light and unit distance."""
    dark = replace(request, light=LightOptions())
    if dark.read.space is None and header.space == "LPS":
        dark = replace(dark, read=replace(dark.read, space="LPS"))
    other = header.live is not None and (
        dark.tf is not None or dark.labels is not None
    )  # not the function whose distance the header has
    recorded = dark.unit_distance is None and header.unit_distance is not None and not other
    if recorded:
        dark = replace(dark, unit_distance=repr(header.unit_distance))

    def lit(source: StyledVolume) -> StyledVolume:
        preset = source.lighting if header.version is None else header.light
        if other:
            preset = source.lighting or header.light
        first, *others = source.layers
        if recorded:
            first = replace(first, unit_label=f"{header.unit_distance_label}, as the .ply records")
        return replace(source, layers=(first, *others), lighting=request.light.lighting(preset, source.volume.space))

    def kernels(source: StyledVolume, in_blocks: bool) -> tuple[str, ...]:
        return source.kernels(for_degree(EVALUATE, gaussians.degree))

    return opened(run, dark, options, FieldNeeds(len(gaussians), size), kernels, look=lit)


@contextmanager
def together(field: Field, pictures: Sequence[Picture]) -> Iterator[None]:
    """Draw the pictures requested within the block together if the volume is in blocks; forget them afterwards."""
    field.views.expect(pictures)
    yield
    for picture in pictures:
        field.views.forget(picture)


def shown(gaussians: Gaussians, header: PlyHeader, source: StyledVolume, request: SourceRequest) -> Gaussians:
    """Return live Gaussians under the requested function; without one, and for other files, the file's own look.

    Raises:
        UsageError: labels are requested for values, or the reverse.
    """
    if header.live is None or replace(request, volume="", read=ReadOptions()) == SourceRequest(""):
        return gaussians
    carried = ["labels" if one.labels else "values" for one in header.live.layers]
    shown = ["labels" if isinstance(layer.tf, LabelTable) else "values" for layer in source.layers]
    if carried != shown:
        raise UsageError(
            f"{source.name}: {', '.join(shown)}, but the Gaussians carry {', '.join(carried)}; expected the volume and "
            "the --tf, --labels or --layer of the conversion, or none of these options to score the file's own look"
        )
    light = light_of(request.light, source.lighting, source.volume.space)
    options = replace(layout_of(header), light=light)
    return apply_function(gaussians, header, looks_of(source), options)


def score(
    console: Console, ply: str | BinaryIO, request: SourceRequest, options: BlockOptions | None, *, screen: int | None,
    rule: str | None, target: str | None, conditions: bool, step: float, preview: PathLike | None, overwrite: bool,
) -> Evaluation:  # fmt: skip
    """Score Gaussians against their volume; see `vvgt_cli.evaluate`."""
    if ply == STDIN == request.volume:
        raise UsageError("both OUT.ply and --volume are '-'; standard input can only be one of them")
    run = Run(console, ConversionReport("evaluate"))
    if (device := target_of(target)) is not None:
        if device.eye is not None and not conditions:
            raise UsageError(
                f"--no-conditions with --for {device.name}: its eyes are conditions; give one or the other"
            )
        screen, rule = screen or device.screen, rule or device.rule
    inputs = [*request.paths(), *([ply] if isinstance(ply, str) else [])]
    check_outputs(Output.of("--preview", preview, (".png",)), inputs, overwrite)
    manifest, chosen = (split_name(ply) if isinstance(ply, str) else None) or (None, None)
    levels = manifest if chosen in (None, VIEW) else None
    gaussians, header = open_gaussians(ply if levels is None else str(levels))
    header = header if levels is None else shown_levels(levels)[2]  # with their certificate
    size, drawn = screen or header.screen_size or SIZE, file_rule(header, rule)
    with opened_as_recorded(run, request, gaussians, header, size, options) as field:
        volume = field.source.volume
        inside: Shown = to_box_frame(shown(gaussians, header, field.source, request), volume)
        if levels is not None:
            inside = levels_in_box(levels, volume)
        for remark in _doubts(header, field.source):
            run.console.message(f"{ply}: {remark}")
        function = tf_record(field.source, request)
        evaluation = _scored(run, field, gaussians, inside, header, drawn, function, size, step)
        if preview is not None:
            camera, axes = default_views("test", size=size)[PICTURED], upright_axes(volume, header.up)
            with run.stage("preview"):
                sheet = side_by_side(field.views, inside, [camera, zoomed(camera, CLOSE)], axes, drawn)
                write_png(preview, captioned(sheet, 2), overwrite)
        if conditions:
            more = eye_pictures(target, headset_axes(volume, header.up))
            more += [] if isinstance(inside, Gaussians) else distance_pictures(size)
            _look_around(run, evaluation, field, inside, drawn, more)
    evaluation.stages = run.report.stages
    evaluation.seconds = run.finish().seconds
    return evaluation


def _doubts(header: PlyHeader, source: StyledVolume) -> Iterator[str]:
    """Yield reasons to doubt that the file was made from this volume and look."""
    if header.affine is not None and not np.allclose(header.affine, source.volume.affine[:3].ravel(), rtol=1e-6):
        yield f"its header's affine differs from that of {source.volume.name}; was it made from another volume?"
    if header.live is None and header.optics is not None and header.optics != source.optics():
        yield (
            f"made with other labels, functions or layers than {source.name}, according to its header "
            f"({header.optics}, not {source.optics() or 'scalars'})"
        )


def _scored(
    run: Run, volume: Field, carried: Gaussians, gaussians: Shown, header: PlyHeader, rule: Rule,
    function: dict[str, Any], size: int, step: float,
) -> Evaluation:  # fmt: skip
    """Score Gaussians (box frame) on the test views, and check their certificate.

    ``carried`` are those of the file, unit frame; ``function`` is the record of the volume's.
    """
    from vvgt_cli.dvr import REFERENCE

    with run.stage("reference") as stage:
        own = _reference_psnr(volume, size, step)
        stage.note = f"its own error {own:.1f} dB"
    views, record = len(default_views("test")), volume_record(volume.source)
    evaluation = Evaluation(len(carried), size, rule.name, step, views, record, function, own)
    settings = replace(REFERENCE, step=step)
    wanted = [Picture(camera, settings, part) for _, camera, part in scored_views(size)]
    with run.stage("test views") as stage, together(volume, wanted):
        bar = run.console.bar("test views")
        scores = score_test_views(volume.views, gaussians, size, settings, rule=rule, progress=bar)
        evaluation.scores = asdict(scores)
        stage.note = f"{psnr_note(scores)}, {size} px"
    if header.certificate is not None:
        looked_up = header.live is not None and isinstance(gaussians, Gaussians) and gaussians.live is None
        with run.stage("certificate") as stage:
            values = rounded_error(header, carried, volume)[0] if header.certificate.values_psnr else None
            verdict = verify(header.certificate, volume, gaussians, looked_up, values)
            evaluation.certificate = asdict(verdict) | {"holds": verdict.holds, "text": verdict.text()}
            stage.note = verdict.text()
    return evaluation


def _look_around(
    run: Run, evaluation: Evaluation, volume: Field, gaussians: Shown, rule: Rule, more: list[ConditionPicture]
) -> None:
    """Score the viewing conditions, ``more`` of a headset or of levels, and texture seen from near."""
    from vvgt_cli.dvr import RenderSettings

    size, settings = evaluation.size, RenderSettings()
    places = condition_pictures(viewing_conditions(size)) + more
    wanted = [Picture(camera, settings, blocks) for _, camera, blocks in places]
    with run.stage("conditions") as stage, together(volume, wanted):
        seen = condition_views(volume.views, places, settings, run.console.bar("conditions"))
        conditions = score_conditions(gaussians, seen, headset=rule.name)
        evaluation.conditions = [asdict(condition) for condition in conditions]
        stage.note = f"worst: {conditions[0].name()}, {conditions[0].psnr:.2f} dB"
    near = [Picture(camera, settings) for camera in near_cameras(size)]
    with run.stage("texture") as stage, together(volume, near):
        scores = score_texture(volume.views, gaussians, size, rule, settings, progress=run.console.bar("texture"))
        evaluation.texture = asdict(scores)
        stage.note = texture_note(scores)


def _reference_psnr(volume: Field, size: int, step: float) -> float:
    """Return the PSNR of the reference against half its step and twice its rays along a pixel's edge.

    Measured on the middle of the first test view: the whole of it would cost as much as eight views.
    """
    from vvgt_cli.dvr import REFERENCE, render_view
    from vvgt_cli.images.metrics import score_view

    middle = default_views("test", size=size)[0].middle(min(size // 2, MIDDLE))
    settings = replace(REFERENCE, step=step)
    finer = replace(settings, step=settings.step / 2, tiers=tuple((edge, 4 * rays) for edge, rays in settings.tiers))
    with together(volume, [Picture(middle, finer), Picture(middle, settings)]):
        images = [render_view(volume.views, middle, s) for s in (finer, settings)]
    return score_view(images[0], images[1], perceptual=False).psnr
