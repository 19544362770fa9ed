"""The certificate that a conversion writes into its file, and its verification (docs/certificate.md)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vvgt_cli.cameras.blocks import drawn_pixels
from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.conversion.voxelize import values_error
from vvgt_cli.field.digests import LARGEST
from vvgt_cli.field.field import Field
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.header import Certificate, FileFacts
from vvgt_cli.score.record import Run
from vvgt_cli.score.viewing import PREVIEW_VIEWS, ViewingCondition
from vvgt_cli.score.views import score_test_views
from vvgt_cli.splat.render import Shown

WITHIN = 0.1  # dB that the file format may cost


def with_certificate(
    ply: PlyOptions, run: Run, field: Field, fit: FitOptions, gaussians: Gaussians, command: str | None,
    live_psnr: float | None = None,
) -> PlyOptions:  # fmt: skip
    """Return the layout of a file with the certificate of the measurements of a run.

    Args:
        ply: layout of the file, with its place.
        run: the run; its report has the scores.
        field: the volume under its look.
        fit: options that the Gaussians were made for.
        gaussians: as they are written, unit frame.
        command: see `Certificate.command`.
        live_psnr: see `Certificate.live_psnr`; not rounded.
    """
    scores, conditions = run.report.scores, [ViewingCondition(**condition) for condition in run.report.conditions or ()]
    if not ply.comments or scores is None:
        return ply
    values, texture = rounded_error(ply, gaussians, field), run.report.texture or {"ours": None}
    found = Certificate(
        volume=ply.title or field.source.title,
        sha256=field.digest,
        look=field.source.shown_as(),
        size=fit.screen,
        rule=fit.rule,
        psnr=round(preview_psnr(scores), 2),
        views=len(PREVIEW_VIEWS),
        pixels=drawn_pixels(fit.screen),
        live_psnr=None if live_psnr is None else round(live_psnr, 2),
        conditions=tuple((condition.name(), round(condition.psnr, 2)) for condition in conditions),
        texture=None if texture["ours"] is None else (round(texture["ours"], 3), round(texture["reference"], 3)),
        position_error=position_error(gaussians, ply),
        values_psnr=values[0],
        values_error=values[1],
        command=command,
    )
    return replace(ply, certificate=found)


def rounded_error(ply: FileFacts, gaussians: Gaussians, field: Field) -> tuple[float | None, float | None]:
    """Return `values_error` of live Gaussians (unit frame) as certificates have it; Nones where there is none."""
    volume = field.source.volume
    if volume.data.nbytes > LARGEST:
        return None, None
    psnr, largest = values_error(ply, gaussians, volume) or (None, None)
    return psnr and round(psnr, 2), largest and float(f"{largest:.4g}")


def preview_psnr(scores: dict[str, Any]) -> float:
    """Return the mean PSNR (dB) of the test views that every conversion draws."""
    views = scores["per_view"]
    seen = views if len(views) <= len(PREVIEW_VIEWS) else [views[n] for n in PREVIEW_VIEWS]
    shown = [view["psnr"] for view in seen if view["psnr_foreground"] is not None]
    return float(np.mean(shown or [view["psnr"] for view in seen]))


def position_error(gaussians: Gaussians, ply: PlyOptions) -> float:
    """Return the greatest distance of a centre, as rounded by the file, from its exact position, in world units."""
    if ply.scale is None or ply.centre is None or ply.frame == "unit":  # the file holds the computed positions
        return 0.0
    exact = gaussians.means.astype(np.float64) / ply.scale + np.array(ply.centre)
    return float(f"{np.linalg.norm(exact.astype(np.float32) - exact, axis=1).max(initial=0):.3g}")


@dataclass(frozen=True)
class Verdict:
    """The result of the verification of a certificate.

    Attributes:
        same_volume: whether the values are those of the certificate; None where it has no digest.
        same_look: whether functions, tables, distances and light are those of the certificate.
        psnr: dB of the same views, now.
        recorded: dB in the certificate.
        values_psnr, values_recorded: dB of live values on the volume's grid, now and recorded; None without.
    """

    same_volume: bool | None
    same_look: bool
    psnr: float
    recorded: float
    values_psnr: float | None = None
    values_recorded: float | None = None

    @property
    def holds(self) -> bool:
        """Return whether nothing failed."""
        return not list(self.failures())

    def failures(self) -> Iterator[str]:
        """Yield a message for each failure."""
        if self.same_volume is False:
            yield "the values differ from those of the volume that it was made of"
        if not self.same_look:
            yield "made under another function, other labels, opacity distances or light"
        if not self.psnr >= self.recorded - WITHIN:
            yield f"{self.psnr:.2f} dB, {self.recorded:.2f} dB recorded"
        now, before = self.values_psnr, self.values_recorded
        if before is not None and not (now is not None and now >= before - WITHIN):
            yield f"values {'none' if now is None else f'{now:.2f} dB'}, {before:.2f} dB recorded"

    def text(self) -> str:
        """Return the verdict as one line."""
        if not self.holds:
            return f"does not hold: {'; '.join(self.failures())}"
        volume = "the volume was not compared (too large)" if self.same_volume is None else "the same volume"
        text = f"holds: {volume} and look, {self.psnr:.2f} dB ({self.recorded:.2f} dB recorded)"
        if self.values_recorded is None:
            return text
        return f"{text}, values {self.values_psnr:.2f} dB ({self.values_recorded:.2f})"


def verify(
    certificate: Certificate, field: Field, gaussians: Shown, looked_up: bool = False, values: float | None = None
) -> Verdict:
    """Verify a certificate against the volume: compare digests, and score its views again.

    Args:
        certificate: certificate of the file.
        field: the volume under its look.
        gaussians: Gaussians of the file, box frame, or what is shown of its levels to a camera.
        looked_up: the Gaussians of a live file are as `vvgt recolor` shows them, not as stored.
        values: dB of a live file's values on the volume's grid (`rounded_error`).
    """
    scores = score_test_views(field.views, gaussians, certificate.size, rule=certificate.rule, every=False)
    digests = certificate.sha256, None if certificate.sha256 is None else field.digest
    same = None if None in digests else digests[0] == digests[1]
    recorded = certificate.live_psnr if looked_up and certificate.live_psnr is not None else certificate.psnr
    own = certificate.values_psnr
    return Verdict(same, certificate.look == field.source.shown_as(), round(scores.psnr, 2), recorded, values, own)
