"""`vvgt convert --live`: Gaussians that carry data values, so that they can be shown under any function.

The closed form of a fog of all values except the background places them; nothing is fitted to views. The requested
look is baked in, for programs that ignore the values.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from vvgt_cli.cameras.blocks import GOLDEN
from vvgt_cli.cameras.sets import pixel_width
from vvgt_cli.closed_form import Start
from vvgt_cli.closed_form.columns import MASS
from vvgt_cli.conversion.place import to_box_frame, to_frame_of, to_unit_frame
from vvgt_cli.conversion.recolored import lit, looks_of, lookup_table, visible_cloud
from vvgt_cli.conversion.request import ConvertRequest, FitOptions
from vvgt_cli.conversion.stage import Cost, Stage, Work
from vvgt_cli.conversion.stages import ClosedFormStage, TestViews
from vvgt_cli.conversion.stages.refinement import SMALLEST
from vvgt_cli.errors import NoLiveForm, NothingVisible
from vvgt_cli.field.field import Field
from vvgt_cli.field.source import StyledVolume
from vvgt_cli.field.workload import Workload
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.formats import is_page
from vvgt_cli.gaussians.live import LENGTH, Looks, Table, baked, lengths
from vvgt_cli.gaussians.live_facts import AXIS, LAYER_ID, LiveFacts, grain_of
from vvgt_cli.gaussians.types import concatenate
from vvgt_cli.look.function import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.histogram import UNIT_SHARE, worth_showing
from vvgt_cli.look.labels import Label, LabelTable
from vvgt_cli.look.lighting import Lighting, is_sky
from vvgt_cli.look.recognise import background_bins
from vvgt_cli.look.tables import extinction
from vvgt_cli.score.record import Run
from vvgt_cli.score.views import psnr_note, score_test_views
from vvgt_cli.volume.label_maps import extents_of
from vvgt_cli.volume.stats import Statistics
from vvgt_cli.volume.types import triple

FOG_NAME = "fog"
THIN, THICK = 0.02, 0.3  # opacity per `UNIT_SHARE` of the box's edge, right beside the background and farthest from it
BETWEEN = 9  # places around a node where the function that is given may show something
NODES = 129  # of a function over 256 bins
HIDDEN_WEIGHT = 0.25  # how much a label of opacity 0 counts, which another table may show
VOXELS_POWER = 2 / 3  # power of a label's voxels that its cells count less by: small ones are to keep their shape


def check_live(request: ConvertRequest) -> None:
    """Raise NoLiveForm, which names them, for options of a request that live files do not take."""
    fit, light = request.fit, request.source.light
    given = {
        "--target-psnr": fit.target_psnr is not None,
        "--time-budget": fit.time_budget is not None,
        "--max-megabytes (or write a page, -o OUT.html)": fit.max_megabytes is not None and not is_page(request.output),
        "--steps": bool(fit.steps),
        "--model": fit.model is not None,
        "--init": fit.init != "moments",
        "--checkpoint": request.checkpoint is not None,
        "--sh-degree": request.ply.sh_degree is not None,
        "--no-comments": not request.ply.comments,
        f"--light {' '.join(light.lights)}": any(map(is_sky, light.lights)),
    }
    if names := [name for name, there in given.items() if there]:
        raise NoLiveForm(f"--live: the file is made for every function, without fitting; remove {', '.join(names)}")


def live_refusal(request: ConvertRequest, source: StyledVolume) -> str | None:
    """Return the reason why a source has no live file; None where it has one."""
    try:
        check_live(request)
        check_layers(source)
    except NoLiveForm as error:
        return str(error)
    return None


@dataclass(frozen=True)
class LiveForm(Stage):
    """Gaussians with values, and their look baked in, in place of those that are fitted to views."""

    name: ClassVar[str] = "live form"

    def cost(self, workload: Workload) -> Cost:
        """Return the cost of the closed form, which is most of it."""
        return ClosedFormStage().cost(workload)

    def run(self, work: Work) -> None:
        """Make the Gaussians; raise NoLiveForm for colours, and NothingVisible if nothing is visible."""
        source, fit = work.field.source, work.fit
        check_layers(source)
        if len(source.layers) > 1:
            gaussians, facts = _several_layers(work.run, fit, work.field)
        else:
            facts = LiveFacts.of(source.volume, source.overall, source.tf)
            gaussians = _one_layer(work.run, fit, work.field)
        table, lighting = _baked_look(source, facts), box_lighting(source)
        assert gaussians.live is not None
        work.gaussians = lit(baked(gaussians, table, pixel_width(fit.screen)), gaussians.live[:, AXIS], lighting)
        work.ply = replace(work.ply, live=facts)


@dataclass(frozen=True)
class LiveLook(Stage):
    """The score of live Gaussians as `vvgt recolor` shows them; other viewers show what is baked in."""

    name: ClassVar[str] = "live look"
    scores: ClassVar[bool] = True

    def cost(self, workload: Workload) -> Cost:
        """Return the cost of the test views."""
        return TestViews().cost(workload)

    def run(self, work: Work) -> None:
        """Score the Gaussians."""
        fit, source = work.fit, work.field.source
        assert work.ply.live is not None
        table, lighting = _baked_look(source, work.ply.live), box_lighting(source)
        shown = visible_cloud(work.current(), table, lighting, pixel_width(fit.screen))
        name = source.look_name
        with work.run.stage(self.name) as stage:
            live = score_test_views(work.field.views, shown, fit.screen, rule=fit.rule, every=False)
            stage.note = f"{psnr_note(live)} under {name} as 'vvgt recolor' shows it; scoring next as others show it"
        work.live_psnr = live.psnr


def _baked_look(source: StyledVolume, facts: LiveFacts) -> Looks:
    """Return the lookup table of a source's functions, for live Gaussians with these facts."""
    return lookup_table(facts, looks_of(source), source.volume.unit_frame().scale)


def _one_layer(run: Run, fit: FitOptions, field: Field) -> Gaussians:
    """Return the live Gaussians of one layer, box frame."""
    source = field.source
    if isinstance(source.tf, LabelTable):
        labels = source.tf.structures
        foggy = label_fog_field(field, labels)
        found = with_labels(run, foggy, fog_start(run, foggy, fit), labels)
    else:
        foggy = field.with_look(source.with_function(fog(source.overall, source.tf)))
        found = with_values(run, foggy, fog_start(run, foggy, fit))
    return widen_narrow(found, fit.screen)


def _several_layers(run: Run, fit: FitOptions, field: Field) -> tuple[Gaussians, LiveFacts]:
    """Return the live Gaussians of all layers, which share the budget evenly, in the box frame of the first."""
    source, found, facts = field.source, [], []
    count, left, half = len(source.layers), fit.max_gaussians, np.array(source.volume.unit_frame().half)
    for number, layer in enumerate(source.layers):
        share = replace(fit, max_gaussians=max(left // (count - number), 1))
        run.console.message(f"layer {number} of {count}: {layer.name}")
        alone = field.with_look(source.single_layer(number))
        layer_facts = LiveFacts.of(layer.volume, alone.source.overall, layer.tf, count)
        layer_facts = replace(layer_facts, name=layer.volume.name, distance=layer.unit_distance)
        facts.append(replace(layer_facts, dims=source.volume.dims))
        try:
            some = _one_layer(run, share, alone)
        except NothingVisible:  # a frame of a series in which it is empty
            run.skip(layer.volume.name, "only background")
            continue
        frames = layer.volume.unit_frame(), source.volume.unit_frame()
        some = to_box_frame(to_frame_of(to_unit_frame(some, layer.volume), *frames), source.volume)
        some = some.take(np.flatnonzero((np.abs(some.means) <= half + 1e-6).all(axis=1)))
        assert some.live is not None
        live = np.zeros((len(some), LAYER_ID + 1), np.float32)
        live[:, : some.live.shape[1]] = some.live
        live[:, LAYER_ID] = number
        found.append(replace(some, live=live))
        left -= len(some)
    if not found:
        raise NothingVisible(source.volume.name, source.name)
    first, *others = facts
    return concatenate(found), replace(first, others=tuple(others))


def check_layers(source: StyledVolume) -> None:
    """Raise NoLiveForm if a layer has colours, neither values nor labels."""
    if any(layer.colors for layer in source.layers):
        raise NoLiveForm(
            f"{source.name}: has colours, which Gaussians cannot carry as one value; expected scalars or labels with "
            "--live: choose one component by --component N, or remove --live"
        )


def box_lighting(source: StyledVolume) -> Lighting | None:
    """Return the light of a source, with directions in the box frame."""
    if source.lighting is None:
        return None
    inward = np.linalg.inv(source.volume.axes)
    turned = [triple((inward @ np.array(direction)).tolist()) for direction in source.lighting.directions]
    return replace(source.lighting, directions=tuple(turned))


def function_table(source: StyledVolume) -> Table:
    """Return the lookup table of the function of a source, with lengths in the unit frame."""
    stats, tf, volume = source.overall, source.tf, source.volume
    assert isinstance(tf, TransferFunction)
    distance = source.unit_distance * volume.unit_frame().scale
    return Table.of_function(tf, stats.lo, stats.hi, distance, grain_of(volume.dims))


def fog_start(run: Run, field: Field, fit: FitOptions) -> Start:
    """Return the closed form of a fog; raise NothingVisible if the volume is only background."""
    from vvgt_cli.closed_form import VbmOptions

    with run.stage("closed form") as stage:
        options = VbmOptions(max_gaussians=fit.max_gaussians, size=fit.screen, values=True)
        start = field.pyramid(options, run.console.bar("closed form"))
        if not len(start.gaussians):
            raise NothingVisible(field.source.volume.name, field.source.name)
        stage.note = f"{len(start.gaussians)} Gaussians of all values but background"
    return start


def with_values(run: Run, field: Field, start: Start) -> Gaussians:
    """Return the Gaussians of a closed form with the data values under them, without those that have none."""
    assert start.leaves is not None
    with run.stage("values") as stage:
        values = field.sample(start.gaussians)
        known = np.flatnonzero(np.isfinite(values).all(axis=1))
        gaussians, values, leaves = start.gaussians.take(known), values[known], start.leaves.take(known)
        tau = function_table(field.source).at(values[:, 0], values[:, 1])[:, 3]
        length = lengths(leaves.moments[:, MASS], tau, leaves.edge.prod(axis=1))
        live = np.insert(values, LENGTH, length, axis=1)
        span = field.source.overall.hi - field.source.overall.lo
        stage.note = f"mean spread {100 * float(values[:, 1].mean()) / (span or 1):.1f} % of the range"
    return replace(gaussians, live=live, harmonics=None)


def widen_narrow(gaussians: Gaussians, size: int) -> Gaussians:
    """Widen Gaussians to at least `SMALLEST` px of the screen, below which viewers discard them; their mass stays."""
    least = np.log(SMALLEST * pixel_width(size))
    widening = np.maximum(least - gaussians.log_scales.max(axis=1).astype(np.float64), 0)
    return replace(gaussians, log_scales=gaussians.log_scales + widening[:, None])


def label_fog_field(field: Field, labels: tuple[Label, ...]) -> Field:
    """Return the field of a label map as one thin fog, whose labels differ in colour."""
    layer = field.source.layers[0]
    assert isinstance(layer.tf, LabelTable)
    voxels = {value: extent.count for value, extent in extents_of(layer.volume).items()}
    table = label_fog(layer.tf, {e.number: voxels.get(float(e.number), 0) for e in labels})
    return field.with_look(field.source.with_tables([table]))


def with_labels(run: Run, field: Field, start: Start, labels: tuple[Label, ...]) -> Gaussians:
    """Return the Gaussians of the fog with the rows of their labels, without those outside all labels."""
    from vvgt_cli.closed_form.gaussian_samples import labels_and_gradients

    assert start.leaves is not None
    frame, source = field.source.volume.unit_frame(), field.source
    with run.stage("labels") as stage:
        maps = [(source.layers[0].volume, [label.number for label in labels])]
        owner, gradient = labels_and_gradients(start.gaussians, maps, np.array(frame.half), np.array(frame.step))
        known = np.flatnonzero(owner >= 0)
        gaussians, leaves = start.gaussians.take(known), start.leaves.take(known)
        owner, gradient = owner[known], gradient[known]
        tau = extinction(np.full(len(known), THIN), 2 * UNIT_SHARE)
        length = lengths(leaves.moments[:, MASS], tau, leaves.edge.prod(axis=1))
        live = np.column_stack([np.zeros((len(owner), 2)), length, gradient, gradient, owner])
        stage.note = f"{len(np.unique(owner))} of {len(labels)} labels have Gaussians"
    return replace(gaussians, live=live, harmonics=None)


def fog(statistics: Statistics, shown: TransferFunction | None = None) -> TransferFunction:
    """Return a function that is transparent only in the background, and denser the farther a value is from it.

    Args:
        statistics: range and histogram of the data.
        shown: a function on data values whose visible values must not be transparent.

    Returns:
        Opacity per `UNIT_SHARE`; red is the value as a share of the range, green its square: their means over a cell
        give the variance of its values.
    """
    counts = np.asarray(statistics.histogram, np.float64)
    lo, hi = float(statistics.lo), float(statistics.hi)
    first, last = background_bins(counts)
    if not worth_showing(slice(0, first), counts):  # padding below it
        first = 0
    t = np.linspace(0, 1, NODES)
    at = t * len(counts)
    below, above = (first - at) / max(first, 1), (at - last) / max(len(counts) - last, 1)
    far = np.maximum(below, above) if last > first else t
    opacity = np.where(far > 0, THIN + (THICK - THIN) * far, 0.0)
    x = lo + (hi - lo) * t
    if lo == hi:
        x, opacity = np.array([lo]), np.array([THIN])
    elif shown is not None:
        about = x[:, None] + (x[1] - x[0]) * np.linspace(-0.5, 0.5, BETWEEN)
        opacity = np.maximum(opacity, np.minimum(shown.opacity(about).max(axis=1), THIN))
    if not opacity.any():
        opacity[:] = THIN
    share = t[: len(x)]
    colors = np.stack([share, share**2, np.zeros(len(x))], axis=1)
    return TransferFunction(
        FOG_NAME,
        PiecewiseOpacity(x, opacity),
        ColorMap(x, colors),
        opacity_unit_share=UNIT_SHARE,
        opacity_unit_label=FOG_NAME,
    )


def label_fog(table: LabelTable, voxels: Mapping[int, int]) -> LabelTable:
    """Return a table that gives each label in ``voxels`` the opacity `THIN` and a code of its own.

    Red is the code in [0, 1] and green its square: their means over a cell show whether it holds several labels. Blue
    is the weight of the label, from its number of ``voxels``.
    """
    least, labels = max(min(voxels.values(), default=1), 1), []
    for number, label in enumerate(table.labels):
        code, weight = (number * GOLDEN) % 1, (least / max(voxels.get(label.number, least), least)) ** VOXELS_POWER
        weight *= 1 if label.opacity > 0 else HIDDEN_WEIGHT
        labels.append(replace(label, color=(code, code**2, weight), opacity=THIN if label.number in voxels else 0.0))
    return LabelTable(FOG_NAME, tuple(labels))
