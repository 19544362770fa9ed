"""`check` of a file of Gaussians from any program, alone or against the volume and look that it shows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.checks import Case, Figure
from vvgt_cli.checks.report import CheckReport, run_cases
from vvgt_cli.checks.splats import (
    ORIENTATION_SIZE,
    finite_rows,
    order_cases,
    orientation_cameras,
    place_cases,
    row_cases,
    value_cases,
)
from vvgt_cli.commands.evaluation import opened_as_recorded, shown, together
from vvgt_cli.conversion.gaussian_files import file_rule, open_gaussians
from vvgt_cli.conversion.place import to_box_frame
from vvgt_cli.errors import DataError
from vvgt_cli.field.field import Field, Picture
from vvgt_cli.field.source import SourceRequest, tf_record, volume_record
from vvgt_cli.gaussians import Gaussians, PlyHeader, in_unit_frame
from vvgt_cli.gaussians.formats import read_columns
from vvgt_cli.gaussians.formats.splats import gaussians_of
from vvgt_cli.gaussians.frames import rescale
from vvgt_cli.gaussians.header import CERTIFICATE
from vvgt_cli.gaussians.live_facts import WORD as LIVE
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.score.viewing import (
    CLOSE,
    PREVIEW_VIEWS,
    condition_pictures,
    condition_views,
    score_conditions,
    score_texture,
    screens,
)
from vvgt_cli.score.views import score_test_views

SIZE = 1080  # pixels, for files without a recorded size
TOLERANCE = 0.056  # RMS of pictures in [0, 1]: 25 dB
VISIBLE = 0.5  # levels of 255 of texture above which a lattice becomes visible


def check_splats(file: str, source: SourceRequest | None, tolerance: float | None, console: Console) -> CheckReport:
    """Check a file of Gaussians, alone or against the volume and look of ``source``.

    Pictures pass with an RMS error in [0, 1] of at most ``tolerance``, None: `TOLERANCE`. Raise UsageError or DataError
    for a file that does not hold Gaussians, or a volume that cannot be read.
    """
    columns = read_columns(file)
    good = finite_rows(columns)
    if not good.any():
        raise DataError(f"{file}: {len(columns)} Gaussians, none with finite values; expected at least one")
    if good.all():
        gaussians, header = open_gaussians(file)
    else:  # check the others, whose values and certificate no longer fit
        comments = tuple(c for c in columns.comments if c.split()[:2] not in (["vvgt", LIVE], ["vvgt", CERTIFICATE]))
        stored, header = gaussians_of(replace(columns.take(np.flatnonzero(good)), comments=comments), file)
        gaussians = in_unit_frame(stored, header)
    size = header.screen_size or SIZE
    about = {"file": file.rpartition("/")[2], "gaussians": len(columns), "size": size, "rule": file_rule(header).name}
    cases = list(row_cases(columns, good))
    if source is None:
        cases += [*value_cases(gaussians, None, size), *_order(gaussians, size)]
        return CheckReport(run_cases(cases, console), splats=about)
    run = Run(console, ConversionReport("evaluate"))
    with opened_as_recorded(run, source, gaussians, header, size) as field:
        current = shown(gaussians, header, field.source, source)
        cases += [*value_cases(gaussians, 2.0, size), *_against(field, current, header, size, tolerance or TOLERANCE)]
        function = tf_record(field.source, source)
        return CheckReport(run_cases(cases, console), volume_record(field.source), function, splats=about)


def _rms(psnr: float, tolerance: float, more: str = "") -> Figure:
    """Return a PSNR as an RMS error."""
    return Figure(f"RMS in [0, 1] ({psnr:.1f} dB{more})", 10 ** (-psnr / 20), tolerance)


def _order(gaussians: Gaussians, size: int) -> Iterator[Case]:
    return order_cases(gaussians, default_views("test", size=size)[PREVIEW_VIEWS[1]])


def _against(field: Field, unit: Gaussians, header: PlyHeader, size: int, tolerance: float) -> Iterator[Case]:
    """Yield the cases of Gaussians (unit frame) against the volume."""
    from vvgt_cli.dvr import RenderSettings

    rule, settings, volume = file_rule(header), RenderSettings(), field.source.volume
    frame, gaussians = volume.unit_frame(), to_box_frame(unit, volume)
    world = to_box_frame(rescale(unit, frame.scale, -np.array(frame.centre), np.zeros(3)), volume)
    pictures = [Picture(camera, settings) for camera in orientation_cameras()]
    with together(field, pictures):
        seen = [field.views.view(*picture) for picture in pictures]
    yield from place_cases(gaussians, world, np.array(frame.half), seen, rule.at(ORIENTATION_SIZE / size))

    @cache
    def scores() -> Any:
        return score_test_views(field.views, gaussians, size, settings, rule=rule, every=False)

    @cache
    def conditions() -> Any:
        places = condition_pictures([*screens(size), (size, CLOSE)])
        return score_conditions(gaussians, condition_views(field.views, places, settings))

    def error(name: str) -> Figure:
        psnr = getattr(scores(), name)
        return _rms(psnr, tolerance)

    def near() -> Figure:
        psnr = next(s.psnr for s in conditions() if s.field_of_view == CLOSE and s.rule == rule.name)
        return _rms(psnr, tolerance)

    def viewers(edge: int) -> Figure:
        worst = next(s for s in conditions() if (s.size, s.field_of_view == CLOSE) == (edge, False))
        return _rms(worst.psnr, tolerance, f", {worst.rule}")

    def woven() -> Figure:
        texture = score_texture(field.views, gaussians, size, rule, settings)
        if texture.ours is None or texture.reference is None:
            return Figure("levels of 255 (nothing is opaque and smooth)", 0, VISIBLE)
        return Figure("levels of 255 more than the volume", texture.ours - texture.reference, VISIBLE)

    for name, what in (("psnr", "over black"), ("psnr_white", "over white"), ("psnr_alpha", "alpha")):
        yield Case("pictures", f"{what}, {size} px", partial(error, name))
    yield Case("pictures", "over black, close up", near)
    for edge, _ in screens(size):
        yield Case("pictures", f"worst viewer, {edge} px", partial(viewers, edge))
    yield Case("pictures", "texture on smooth faces, near", woven)
    yield from _order(gaussians, size)
