"""`vvgt convert --live`: Gaussians that carry the values under them, and so can be shown under any function.

They are placed by the closed form of a fog of all values but the background's; nothing is fitted to views. The look
asked for is baked in, for programs that know nothing of values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras.sets import pixel_width
from vvgt_cli.closed_form.columns import MASS
from vvgt_cli.conversion.certify import certified
from vvgt_cli.conversion.live_labels import carrying_labels, fog_of_labels, label_facts, labels_of
from vvgt_cli.conversion.place import in_frame_of, into_box, out_of_box
from vvgt_cli.conversion.recolored import Look, SeveralLooks, lit_by, looked_up
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.conversion.result import Conversion
from vvgt_cli.conversion.stage import Work
from vvgt_cli.conversion.stages import TestViews, ViewingConditions
from vvgt_cli.conversion.stages.refinement import SMALLEST
from vvgt_cli.errors import NothingVisible, UsageError
from vvgt_cli.field.field import Field
from vvgt_cli.gaussians import Gaussians, PlyOptions, as_stored
from vvgt_cli.gaussians.live import LENGTH, Table, baked, lengths
from vvgt_cli.gaussians.live_facts import GRADIENT, LAYER_ID, LiveFacts
from vvgt_cli.gaussians.types import concatenate
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.labels import LabelTable
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.score.record import Run
from vvgt_cli.score.viewing import PREVIEW_VIEWS
from vvgt_cli.score.views import psnr_note, score_test_views
from vvgt_cli.volume.types import triple

if TYPE_CHECKING:
    from vvgt_cli.closed_form import Start
    from vvgt_cli.field.source import Source


def check_live(request: ConvertRequest) -> None:
    """Refuse what a live file does not go with.

    Raises:
        UsageError: an option that has no meaning here.
    """
    fit, limits, light = request.fit, request.limits, request.source.light
    given = {
        "--target-psnr": limits.target_psnr is not None,
        "--time-budget": limits.time_budget is not None,
        "--max-size": limits.max_megabytes is not None,
        "--steps": fit.steps is not None,
        "--model": fit.model is not None,
        "--init": fit.init != "vbm",
        "--checkpoint": request.checkpoint is not None,
        "--sh-degree": request.ply.sh_degree is not None,
        "--no-comments": not request.ply.comments,
        "--shadows": light.shadows,
        "--ambient-occlusion": light.occlusion is not None,
    }
    if names := [name for name, there in given.items() if there]:
        raise UsageError(f"--live: a file for every function, made in one way; leave out {', '.join(names)}")


def refusal(request: ConvertRequest, source: Source) -> str | None:
    """Why there is no live file of a source; None where there is one."""
    try:
        check_live(request)
        check_layers(source)
        in_box(source)
    except UsageError as error:
        return str(error)
    return None


def live_conversion(
    run: Run, request: ConvertRequest, field: Field, ply: PlyOptions, scored: bool = True,
    unscored: Callable[[Conversion], None] | None = None,
) -> Conversion:  # fmt: skip
    """Place, look up, bake, score where asked to; ``ply`` as of an ordinary conversion, ``unscored`` as well.

    Raises:
        UsageError: colours, or a light that needs the volume.
        DataError: nothing is visible.
    """
    source, fit = field.source, request.fit
    lighting, pixel = in_box(source), pixel_width(fit.size)
    check_layers(source)
    if len(source.layers) > 1:
        gaussians, facts = _of_layers(run, request, field)
        look: Look = SeveralLooks(tuple((layer.tf, layer.unit_distance) for layer in source.layers))
    else:
        gaussians, facts, look = _of_one(run, request, field), _facts(source), source.tf
    table = looked_up(facts, look, source.unit_distance, source.volume.unit_frame().scale)
    gaussians = as_stored(lit(baked(gaussians, table, pixel), lighting))
    found = Conversion(out_of_box(gaussians, source.volume), run.report, replace(ply, live=facts), field)
    if unscored is not None:
        unscored(found)
    if scored:
        psnr = _score(run, request, field, gaussians, lit_by(gaussians, table, lighting, pixel))
        found.ply = certified(found.ply, run, field, fit, found.gaussians, request.command, psnr)
    return found


def _facts(source: Source, several: int = 1) -> LiveFacts:
    """What a file says of the values or labels of one layer; ``several``: layers that share a header."""
    if isinstance(source.tf, LabelTable):
        return label_facts(source, labels_of(source))
    return LiveFacts.of(source.volume, source.overall, source.tf, several)


def _of_one(run: Run, request: ConvertRequest, field: Field) -> Gaussians:
    """Gaussians of one layer, box frame, that carry what is under them."""
    from vvgt_cli.look.fog import fog

    source = field.source
    if isinstance(source.tf, LabelTable):
        labels = labels_of(source)
        foggy = fog_of_labels(field, labels)
        found = carrying_labels(run, foggy, placed_by(run, foggy, request), labels)
    else:
        foggy = field.with_look(source.with_function(fog(source.overall, source.tf)))
        found = carrying(run, foggy, placed_by(run, foggy, request))
    return wide_enough(found, request.fit.size)


def _of_layers(run: Run, request: ConvertRequest, field: Field) -> tuple[Gaussians, LiveFacts]:
    """Gaussians of each layer, in the box frame of the first; they share the budget evenly."""
    source, parts, facts = field.source, [], []
    count, left, half = len(source.layers), request.fit.max_gaussians, np.array(source.volume.unit_frame().half)
    for number, layer in enumerate(source.layers):
        share = replace(request, fit=replace(request.fit, max_gaussians=max(left // (count - number), 1)))
        run.console.say(f"layer {number} of {count}: {layer.name}")
        alone = field.with_look(source.single_layer(number))
        said = replace(_facts(alone.source, count), name=layer.volume.name, distance=layer.unit_distance)
        facts.append(replace(said, dims=source.volume.dims))
        try:
            some = _of_one(run, share, alone)
        except NothingVisible:  # a frame of a series in which it is empty
            run.leave_out(layer.volume.name, "nothing but background")
            continue
        some = into_box(in_frame_of(out_of_box(some, layer.volume), layer.volume, source.volume), source.volume)
        some = some.take(np.flatnonzero((np.abs(some.means) <= half + 1e-6).all(axis=1)))
        assert some.live is not None
        live = np.zeros((len(some), LAYER_ID + 1), np.float32)
        live[:, : some.live.shape[1]] = some.live
        live[:, LAYER_ID] = number
        parts.append(replace(some, live=live))
        left -= len(some)
    if not parts:
        raise NothingVisible(source.volume.name, source.name)
    first, *others = facts
    return concatenate(parts), replace(first, others=tuple(others))


def check_layers(source: Source) -> None:
    """Refuse what has neither values nor labels.

    Raises:
        UsageError: colours of their own.
    """
    if any(layer.colors for layer in source.layers):
        raise UsageError(
            f"{source.name}: colours, of which a Gaussian cannot carry one value; expected scalars or labels with "
            "--live: take one component with --component N, or leave out --live"
        )


def _score(run: Run, request: ConvertRequest, field: Field, gaussians: Gaussians, shown: Gaussians) -> float:
    """As `vvgt recolor` shows them under the function (dB, returned), and as other viewers do."""
    from vvgt_cli.dvr import RenderSettings

    fit, source = request.fit, field.source
    name = source.name if len(source.layers) > 1 else source.tf.name
    with run.stage("live look") as stage:
        live = score_test_views(
            field.views, shown, fit.size, RenderSettings(), rule=fit.rule, perceptual=False, only=PREVIEW_VIEWS
        )
        stage.note = f"{psnr_note(live)} under {name} as 'vvgt recolor' shows it; next as other viewers show the file"
    work = Work(run, field, fit, gaussians=gaussians)
    for stage_of_scores in (TestViews(request.scored_whole), ViewingConditions()):
        stage_of_scores.run(work)
    return live.psnr


def in_box(source: Source) -> Lighting | None:
    """A source's light, its directions in the box frame.

    Raises:
        UsageError: shadows or occlusion, of a preset.
    """
    if source.lighting is None:
        return None
    inward = np.linalg.inv(source.volume.axes)
    turned = [triple((inward @ np.array(direction)).tolist()) for direction in source.lighting.directions]
    return replace(source.lighting, directions=tuple(turned))


def lit(gaussians: Gaussians, lighting: Lighting | None) -> Gaussians:
    """Gaussians that carry values with their colours under a light in their frame."""
    from vvgt_cli.closed_form.relight import relight

    assert gaussians.live is not None
    return gaussians if lighting is None else relight(gaussians, gaussians.live[:, GRADIENT], lighting)


def table_of(source: Source) -> Table:
    """Of a source's function, lengths in the unit frame."""
    numbers, tf = source.overall, source.tf
    assert isinstance(tf, TransferFunction)
    facts = LiveFacts.of(source.volume, numbers, tf)
    distance = source.unit_distance * source.volume.unit_frame().scale
    return Table.of_function(tf, facts.lo, facts.hi, distance, facts.grain)


def placed_by(run: Run, field: Field, request: ConvertRequest) -> Start:
    """The closed form of the fog.

    Raises:
        NothingVisible: nothing but background.
    """
    from vvgt_cli.closed_form import VbmOptions

    with run.stage("closed form") as stage:
        options = VbmOptions(max_gaussians=request.fit.max_gaussians, size=request.fit.size, values=True)
        start = field.pyramid(options, run.console.bar("closed form"))
        if not len(start.gaussians):
            raise NothingVisible(field.source.volume.name, field.source.name)
        stage.note = f"{len(start.gaussians)} Gaussians of what may be shown"
    return start


def carrying(run: Run, field: Field, start: Start) -> Gaussians:
    """Gaussians of a field's look with the values under them, without those that have none."""
    assert start.leaves is not None
    with run.stage("values") as stage:
        values = field.sample(start.gaussians)
        known = np.flatnonzero(np.isfinite(values).all(axis=1))
        gaussians, values, leaves = start.gaussians.take(known), values[known], start.leaves.take(known)
        tau = table_of(field.source).at(values[:, 0], values[:, 1])[:, 3]
        length = lengths(leaves.moments[:, MASS], tau, leaves.edge.prod(axis=1))
        live = np.insert(values, LENGTH, length, axis=1)
        span = field.source.overall.hi - field.source.overall.lo
        stage.note = f"mean spread {100 * float(values[:, 1].mean()) / (span or 1):.1f} % of the range"
    return replace(gaussians, live=live, harmonics=None)


def wide_enough(gaussians: Gaussians, size: int) -> Gaussians:
    """None narrower than `SMALLEST` px of the screen: viewers leave such out. Their mass stays."""
    least = np.log(SMALLEST * pixel_width(size))
    widening = np.maximum(least - gaussians.log_scales.max(axis=1).astype(np.float64), 0)
    return replace(gaussians, log_scales=gaussians.log_scales + widening[:, None])
