"""The certificate that a conversion writes into its file, and whether a file's still holds (docs/certificate.md)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any

import numpy as np

from vvgt_cli.conversion.request import FitOptions
from vvgt_cli.field.field import Field
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.certificate import Certificate, epoch
from vvgt_cli.score.record import Run
from vvgt_cli.score.viewing import PREVIEW_VIEWS, ViewingCondition
from vvgt_cli.score.views import score_test_views

WITHIN = 0.1  # dB that a file may have lost, by its format


def certified(
    ply: PlyOptions, run: Run, field: Field, fit: FitOptions, gaussians: Gaussians, command: str | None,
    live_psnr: float | None = None,
) -> PlyOptions:  # fmt: skip
    """Options of a file with the certificate of what the run has measured.

    Args:
        ply: the file's options, with its place.
        run: whose report has the scores.
        field: the volume under its look.
        fit: what the Gaussians were made for.
        gaussians: as they are written, unit frame.
        command: as `Certificate.command`; ``live_psnr``: as of it, not rounded.
    """
    scores, conditions = run.report.scores, [ViewingCondition(**condition) for condition in run.report.conditions or ()]
    if not ply.comments or scores is None:
        return ply
    found = Certificate(
        volume=PurePath(field.source.volume.name).name,
        sha256=field.digest(),
        look=field.source.shown_as(),
        size=fit.size,
        rule=fit.rule,
        psnr=round(first_views(scores), 2),
        views=len(PREVIEW_VIEWS),
        live_psnr=None if live_psnr is None else round(live_psnr, 2),
        conditions=tuple((condition.name(), round(condition.psnr, 2)) for condition in conditions),
        texture=_texture(run.report.texture),
        position_error=position_error(gaussians, ply),
        seconds=round(run.elapsed(), 1) if epoch() is None else None,
        command=command,
    )
    return replace(ply, certificate=found)


def _texture(found: dict[str, Any] | None) -> tuple[float, float] | None:
    if found is None or found["ours"] is None:
        return None
    return round(found["ours"], 3), round(found["reference"], 3)


def first_views(scores: dict[str, Any]) -> float:
    """PSNR, dB, of the test views that every conversion draws, whether others were drawn or not."""
    views = scores["per_view"]
    seen = views if len(views) <= len(PREVIEW_VIEWS) else [views[n] for n in PREVIEW_VIEWS]
    shown = [view["psnr"] for view in seen if view["psnr_foreground"] is not None]
    return float(np.mean(shown or [view["psnr"] for view in seen]))


def position_error(gaussians: Gaussians, ply: PlyOptions) -> float:
    """Greatest distance of a centre as the file rounds it from the centre itself, in units of the world."""
    if ply.scale is None or ply.centre is None or ply.frame == "unit":  # as they are computed
        return 0.0
    exact = gaussians.means.astype(np.float64) / ply.scale + np.array(ply.centre)
    return float(f"{np.linalg.norm(exact.astype(np.float32) - exact, axis=1).max(initial=0):.3g}")


@dataclass(frozen=True)
class Verdict:
    """Whether a certificate still holds.

    Attributes:
        same_volume: whether the values are those that it was made of; None where it does not say.
        same_look: whether functions, tables, distances and light are.
        psnr: dB, of the same views, now.
        recorded: dB that it says.
    """

    same_volume: bool | None
    same_look: bool
    psnr: float
    recorded: float

    @property
    def holds(self) -> bool:
        """All of it."""
        return not list(self.failures())

    def failures(self) -> Iterator[str]:
        """What does not hold, a remark each."""
        if self.same_volume is False:
            yield "the volume's values are not those that it was made of"
        if not self.same_look:
            yield "made under another function, other labels, opacity distances or light"
        if not self.psnr >= self.recorded - WITHIN:
            yield f"{self.psnr:.2f} dB, {self.recorded:.2f} dB recorded"

    def text(self) -> str:
        """One line."""
        if not self.holds:
            return f"does not hold: {'; '.join(self.failures())}"
        volume = "the volume was not compared (too large)" if self.same_volume is None else "the same volume"
        return f"holds: {volume} and look, {self.psnr:.2f} dB ({self.recorded:.2f} dB recorded)"


def checked(certificate: Certificate, field: Field, gaussians: Gaussians, looked_up: bool = False) -> Verdict:
    """A file's certificate against the volume: its digests, and its views drawn and scored again.

    Args:
        certificate: the file's.
        field: the volume under its look.
        gaussians: the file's, box frame.
        looked_up: of a live file, they are as `vvgt recolor` shows them, not as they are stored.
    """
    from vvgt_cli.dvr import RenderSettings

    scores = score_test_views(
        field.views, gaussians, certificate.size, RenderSettings(), rule=certificate.rule, perceptual=False,
        only=PREVIEW_VIEWS,
    )  # fmt: skip
    digests = certificate.sha256, None if certificate.sha256 is None else field.digest()
    same = None if None in digests else digests[0] == digests[1]
    recorded = certificate.live_psnr if looked_up and certificate.live_psnr is not None else certificate.psnr
    return Verdict(same, certificate.look == field.source.shown_as(), round(scores.psnr, 2), recorded)
