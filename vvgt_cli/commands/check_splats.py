"""`check` of a file of Gaussians, whatever program wrote it, against the volume and the look that it shows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.checks import Case, Figure
from vvgt_cli.checks.splats import SMALL, finite, order_cases, place_cases, row_cases, small_views, value_cases
from vvgt_cli.commands.evaluate import EvaluateRequest, opened, shown
from vvgt_cli.conversion.gaussian_files import file_rule, open_gaussians
from vvgt_cli.conversion.place import into_box
from vvgt_cli.errors import DataError
from vvgt_cli.field.field import Field, Picture
from vvgt_cli.field.source import SourceRequest, tf_record, volume_record
from vvgt_cli.gaussians import Gaussians, PlyHeader, in_unit_frame
from vvgt_cli.gaussians.certificate import WORD as CERTIFICATE
from vvgt_cli.gaussians.formats import read_columns
from vvgt_cli.gaussians.formats.splats import gaussians_of
from vvgt_cli.gaussians.frames import rescale
from vvgt_cli.gaussians.live_facts import WORD as LIVE
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.score.viewing import CLOSE, PREVIEW_VIEWS, condition_views, from_above, score_conditions, score_texture
from vvgt_cli.score.views import score_test_views

SIZE = 1080  # pixels, of files that do not say what they are made for
TOLERANCE = 0.056  # RMS of pictures in [0, 1]: 25 dB
VISIBLE = 0.5  # levels of 255 of texture: from about here on a lattice is seen


@dataclass(frozen=True)
class Looked:
    """What was read.

    Attributes:
        about: of the file, for the report.
        volume, function: records of them, None without a volume.
        cases: to run while the volume is open.
    """

    about: dict[str, Any]
    volume: dict[str, Any] | None
    function: dict[str, Any] | None
    cases: list[Case]


@contextmanager
def splats_opened(
    file: str, source: SourceRequest | None, tolerance: float | None, console: Console
) -> Iterator[Looked]:
    """What there is to check of a file of Gaussians; with a volume, which is open within the block, against it.

    Args:
        file: Gaussians in any format that is read.
        source: the volume and its look; None for what can be told without.
        tolerance: RMS of pictures in [0, 1] that passes; None: `TOLERANCE`.
        console: where progress goes.

    Raises:
        UsageError, DataError: not a file of Gaussians, or a volume that cannot be read.
    """
    columns = read_columns(file)
    good = finite(columns)
    if not good.any():
        raise DataError(f"{file}: {len(columns)} Gaussians, none of finite numbers; expected at least one")
    if good.all():
        gaussians, header = open_gaussians(file)
    else:  # the rest is looked at without them
        said = tuple(c for c in columns.comments if c.split()[:2] not in (["vvgt", LIVE], ["vvgt", CERTIFICATE]))
        stored, header = gaussians_of(replace(columns.take(np.flatnonzero(good)), comments=said), file)
        gaussians = in_unit_frame(stored, header)
    size = header.made_for or SIZE
    about = {"file": file.rpartition("/")[2], "gaussians": len(columns), "size": size, "rule": file_rule(header).name}
    cases = list(row_cases(columns, good))
    if source is None:
        yield Looked(about, None, None, [*cases, *value_cases(gaussians, None, size), *_order(gaussians, size)])
        return
    run = Run(console, ConversionReport("evaluate"))
    with opened(run, EvaluateRequest(file, source, size), gaussians, header) as field:
        looked_at = shown(gaussians, header, field.source, source)
        cases += [*value_cases(gaussians, 2.0, size), *_against(field, looked_at, header, size, tolerance or TOLERANCE)]
        yield Looked(about, volume_record(field.source), tf_record(field.source, source), cases)


def _rms(psnr: float, tolerance: float, more: str = "") -> Figure:
    return Figure(f"RMS in [0, 1] ({psnr:.1f} dB{more})", 10 ** (-psnr / 20), tolerance)


def _order(gaussians: Gaussians, size: int) -> Iterator[Case]:
    return order_cases(gaussians, default_views("test", size=size)[PREVIEW_VIEWS[1]])


def _against(field: Field, unit: Gaussians, header: PlyHeader, size: int, tolerance: float) -> Iterator[Case]:
    """Cases of Gaussians (unit frame) beside the volume."""
    from vvgt_cli.dvr import RenderSettings

    rule, settings, volume = file_rule(header), RenderSettings(), field.source.volume
    frame, gaussians = volume.unit_frame(), into_box(unit, volume)
    world = into_box(rescale(unit, frame.scale, -np.array(frame.centre), np.zeros(3)), volume)
    pictures = [Picture(camera, settings) for camera in small_views()]
    field.views.expect(pictures)
    seen = [field.views.view(*picture) for picture in pictures]
    for picture in pictures:
        field.views.forget(picture)
    yield from place_cases(gaussians, world, np.array(frame.half), seen, rule.at(SMALL / size))

    @cache
    def scores() -> Any:
        return score_test_views(field.views, gaussians, size, settings, rule=rule, perceptual=False, only=PREVIEW_VIEWS)

    @cache
    def seats() -> Any:
        places = [*from_above(size), (size, CLOSE)]
        return score_conditions(gaussians, condition_views(field.views, places, settings))

    def error(name: str) -> Figure:
        psnr = getattr(scores(), name)
        return _rms(psnr, tolerance)

    def near() -> Figure:
        psnr = next(s.psnr for s in seats() if s.field_of_view == CLOSE and s.rule == rule.name)
        return _rms(psnr, tolerance)

    def viewers(edge: int) -> Figure:
        worst = next(s for s in seats() if (s.size, s.field_of_view == CLOSE) == (edge, False))
        return _rms(worst.psnr, tolerance, f", {worst.rule}")

    def woven() -> Figure:
        texture = score_texture(field.views, gaussians, size, rule, settings)
        if texture.ours is None or texture.reference is None:
            return Figure("levels of 255 (nothing is opaque and smooth)", 0, VISIBLE)
        return Figure("levels of 255 more than the volume", texture.ours - texture.reference, VISIBLE)

    for name, what in (("psnr", "over black"), ("psnr_white", "over white"), ("psnr_alpha", "alpha")):
        yield Case("pictures", f"{what}, {size} px", partial(error, name))
    yield Case("pictures", "over black, close up", near)
    for edge, _ in from_above(size):
        yield Case("pictures", f"worst viewer, {edge} px", partial(viewers, edge))
    yield Case("pictures", "texture on smooth faces, near", woven)
    yield from _order(gaussians, size)
