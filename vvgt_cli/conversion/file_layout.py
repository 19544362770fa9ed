"""The layout of a conversion's file: what follows from the volume, its look and its light."""

from __future__ import annotations

from dataclasses import replace

from vvgt_cli.conversion.place import up_axis, with_place
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.field.layered import content_of
from vvgt_cli.field.source import StyledVolume
from vvgt_cli.gaussians import PlyOptions
from vvgt_cli.gaussians.header import legend_text
from vvgt_cli.look.labels import LabelTable
from vvgt_cli.look.resolve import unit_of_values

VIEW_DEGREE = 2  # default degree of harmonics where the light depends on the view: abs(n . v) is even


def degree_of(request: ConvertRequest, source: StyledVolume) -> int:
    """Return the degree of harmonics: 0 where the light does not depend on the view, else as requested or 2."""
    if source.lighting is None or not source.lighting.depends_on_view:
        return 0
    return VIEW_DEGREE if request.ply.sh_degree is None else request.ply.sh_degree


def harmonics_warning(degree: int, source: StyledVolume) -> str | None:
    """Return a message where the requested degree cannot represent the light."""
    if degree >= VIEW_DEGREE or source.lighting is None or not source.lighting.depends_on_view:
        return None
    return (
        f"--sh-degree {degree}: headlight and highlights change with the view; the file has their mean "
        f"over directions (--sh-degree {VIEW_DEGREE} represents them)"
    )


def ply_options(request: ConvertRequest, source: StyledVolume) -> PlyOptions:
    """Return the layout of the file, with everything that follows from the source.

    Raise DataError for a story that shows what the page does not have.
    """
    alone = not request.shares_output
    layers = source.page_layers if request.values and request.ply.comments and alone else ()
    ply = replace(
        request.ply,
        story=request.story and request.story.checked(layers, 1 if alone else None),
        up=up_axis(request.up, request.ply.frame, source.volume.space),
        unit_distance=source.unit_distance,
        unit_distance_label=source.unit_label,
        screen_size=request.fit.screen,
        rule=request.fit.rule,
        light=source.lighting,
        function=source.look_name,
        optics=source.optics(),
        legend=_legend(source),
        title=request.title or _example(request) or source.title,
    )
    return with_place(ply, source.volume)


def _example(request: ConvertRequest) -> str | None:
    """Return the name of a volume that comes with the program."""
    given = request.source.volume
    volume = given if isinstance(given, str) else content_of(given).path or ""
    return volume.split(":")[1] if volume.startswith("example:") else None


def _legend(source: StyledVolume) -> str | None:
    """Return the legend of one function, or of all label tables."""
    tf, stats = source.tf, source.statistics
    if len(source.layers) > 1 or isinstance(tf, LabelTable):
        return legend_text([layer.tf for layer in source.layers], 0.0, 0.0, "")
    return legend_text(tf, stats.lo, stats.hi, unit_of_values(source.volume.values_in, tf), source.volume.quantity)
