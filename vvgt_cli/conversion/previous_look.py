"""The warm start of a conversion from an earlier one of the same volume under another function, light or screen."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from vvgt_cli.conversion.live import box_lighting, function_table
from vvgt_cli.conversion.place import to_box_frame
from vvgt_cli.conversion.plan import Plan, WarmStart
from vvgt_cli.conversion.recolored import lit
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.conversion.result import Conversion
from vvgt_cli.conversion.stage import Work
from vvgt_cli.conversion.stages import CheckViews, Refinement, TestViews, TrainingViews
from vvgt_cli.conversion.stages.views import suits_small_views, view_count
from vvgt_cli.defaults import WARM_STEPS
from vvgt_cli.errors import UsageError
from vvgt_cli.field.field import Field
from vvgt_cli.field.source import StyledVolume
from vvgt_cli.field.workload import view_edge
from vvgt_cli.gaussians import Gaussians, as_stored
from vvgt_cli.gaussians.live import TAU
from vvgt_cli.jit.ahead import LIVE

FAR = 7.5  # dB on the check views below the last cold conversion, before the steps
WORSE = 2.0  # the same after the steps, since other looks allow other errors
FAINT = 1e-3  # share of the mean extinction below which a colour means nothing
MAX_RATIO = 50.0  # greatest ratio of extinctions
OTHER = 0.5  # distance of colours from which nothing of the earlier descent is kept
OPAQUE = 1e-5, 0.9999  # least and largest opacity
GRADIENT = slice(5, 8)  # columns of samples


class PreviousLook(WarmStart):
    """The Gaussians of an earlier conversion of the same volume, recoloured and refined by a few steps."""

    name = "starting from the earlier conversion"

    def __init__(self, earlier: Conversion) -> None:
        """Start from ``earlier``."""
        self.earlier = earlier

    def obstacle(self, work: Work, plan: Plan, request: ConvertRequest) -> str | None:
        """Implement `WarmStart.obstacle`; raise UsageError if the earlier conversion is of another volume."""
        if why := self._unlike(work, request):
            return why
        work.run.compile(LIVE, work.field.source.kernel_type())
        with work.run.stage("earlier") as stage:
            work.gaussians = as_stored(recolor_earlier(self.earlier, work.field))
            stage.note = f"{len(work.gaussians)} Gaussians of {self.earlier.field.source.name} under the new look"
        return self._refine(work, plan)

    def _unlike(self, work: Work, request: ConvertRequest) -> str | None:
        """Return the reason against recolouring; None for none."""
        field, before = work.field, self.earlier.field
        sources, refinement = (before.source, field.source), self.earlier.report.refinement
        if any(source.gridded for source in sources):
            return "labels, channels or layers"
        if any(source.lighting is not None and source.lighting.sky is not None for source in sources):
            return "a sky"
        if {work.degree, self.earlier.gaussians.degree} - {0, 2}:
            return "harmonics of another degree than 2"
        if refinement is None or request.fit.steps == 0 or request.fit.model is not None:
            return "no steps, or a network"
        budget = self.earlier.report.options["max_gaussians"]
        if not len(self.earlier.gaussians) <= work.fit.max_gaussians <= budget:
            return f"it has {len(self.earlier.gaussians)} Gaussians, of at most {budget}"
        if not _same_volume(field, before):
            raise UsageError(f"after: a conversion of {before.source.volume.name}; expected one of the same volume")
        return None

    def _refine(self, work: Work, plan: Plan) -> str | None:
        """Refine the recoloured Gaussians; return the reason why they are not good enough, None if they are."""
        record: dict[str, Any] = self.earlier.report.refinement or {}
        standard = record.get("standard", record["psnr_after"])
        steps = min(work.fit.steps or WARM_STEPS, WARM_STEPS)
        small = suits_small_views(work.current(), work.fit.screen)
        stages = (
            TrainingViews(view_count(steps, small), view_edge(work.fit.screen, small)),
            Refinement(steps, steps, small),
        )
        check = CheckViews()
        work.field.views.expect([view for stage in (check, *stages) for view in stage.views(work.fit)])
        check.run(work)
        if work.psnr(work.current()) < standard - FAR:
            return "the look differs too much"
        work.ending = plan.seconds_of([stage for stage in plan.stages if isinstance(stage, TestViews)])
        for stage in stages:
            stage.run(work)
        made = work.run.report.refinement
        assert made is not None
        made["standard"] = standard
        if made["reason"] == "steps" and made["psnr_after"] < (work.fit.target_psnr or -math.inf):
            return "more steps for --target-psnr"
        if made["reason"] == "steps" and made["psnr_after"] < standard - WORSE:
            return f"{standard - made['psnr_after']:.1f} dB worse on the check views than the last conversion without"
        return None


def recolor_earlier(earlier: Conversion, field: Field) -> Gaussians:
    """Return the Gaussians of an earlier conversion, in place, under the look of a field of the same volume; box frame.

    Each Gaussian covers a mean value and a spread, to which both looks assign an extinction and a colour. Optical
    depths are scaled by the ratio of extinctions. Colours and harmonics are those of the new look, plus the deviation
    that descent found under the old one, weighted by how similar the two colours are.
    """
    before, source = earlier.field.source, field.source
    gaussians = to_box_frame(earlier.gaussians, source.volume)
    samples = field.sample(gaussians)
    there = np.isfinite(samples).all(axis=1)
    samples[~there] = 0
    old, a = _look_alone(before, gaussians, samples)
    new, b = _look_alone(source, gaussians, samples)
    least = max(FAINT * float(a.mean()), 1e-30)  # where the earlier look showed nothing
    ratio = np.where(there, ((b + least) / (a + least)).clip(1 / MAX_RATIO, MAX_RATIO), 1)
    depth = -np.log1p(-np.minimum(gaussians.opacity, OPAQUE[1])) * ratio
    peak = (-np.expm1(-depth)).clip(*OPAQUE)
    alike = 1 - np.linalg.norm(new.colors - old.colors, axis=1) / OTHER
    kept = np.where(there & (a > least), alike.clip(0, 1), 0)[:, None]
    colors = new.colors + kept * (gaussians.colors - old.colors)
    harmonics = new.harmonics
    if harmonics is not None and old.harmonics is not None and gaussians.harmonics is not None:
        harmonics = harmonics + kept[:, None] * (gaussians.harmonics - old.harmonics)
    if harmonics is None:
        colors = np.maximum(colors, 0)
    return replace(gaussians, opacity_logits=np.log(peak / (1 - peak)), colors=colors, harmonics=harmonics)


def _look_alone(look: StyledVolume, gaussians: Gaussians, samples: np.ndarray) -> tuple[Gaussians, np.ndarray]:
    """Return Gaussians with the colours of a look at ``samples`` (K, 8), and (K,) extinctions."""
    sums = function_table(look).of(samples)
    tau = sums[:, TAU]
    plain = replace(gaussians, colors=sums[:, :TAU] / np.maximum(tau, 1e-30)[:, None], harmonics=None)
    gradient = samples[:, GRADIENT].astype(np.float64)
    normals = gradient / np.maximum(np.linalg.norm(gradient, axis=1), 1e-30)[:, None]
    return lit(plain, normals, box_lighting(look)), tau


def _same_volume(field: Field, other: Field) -> bool:
    """Return whether two fields are of one volume, under any look."""
    first, second = field.source.volume, other.source.volume
    if first is second:
        return True
    there = first.dims == second.dims and np.array_equal(first.affine, second.affine)
    return there and field.digest is not None and field.digest == other.digest
