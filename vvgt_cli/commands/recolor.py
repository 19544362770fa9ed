"""`recolor`: live Gaussians shown under another function, without the volume."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vvgt_cli.conversion.gaussian_files import open_gaussians, write_gaussians
from vvgt_cli.conversion.recolored import FunctionRequest, apply_function, parse_layer_look, resolve_look
from vvgt_cli.gaussians.formats import SUFFIXES
from vvgt_cli.gaussians.outputs import Output, claimed
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run


@dataclass(frozen=True)
class RecolorRequest:
    """Live Gaussians, and the look to write.

    Attributes:
        ply: a live file, "-" for standard input.
        function: look to show it under.
        output: file to write, of any format; "-" for a `.ply` on standard output.
        overwrite: replace it if it exists.
    """

    ply: str
    function: FunctionRequest
    output: str
    overwrite: bool = False


def recolor(request: RecolorRequest, console: Console | None = None) -> None:
    """Write an ordinary file of live Gaussians under a function.

    Raises:
        DataError: a file without values, or a function that hides them all.
        UsageError: an output that may not be written.
    """
    run = Run(console or Console(), ConversionReport("recolor"))
    function = request.function
    inputs = [request.ply, *function.paths()]
    with claimed([Output("-o", request.output, SUFFIXES, splats=True)], inputs, request.overwrite):
        with run.stage("read") as stage:
            gaussians, header = open_gaussians(request.ply)
            stage.note = f"{len(gaussians)} Gaussians"
        with run.stage("recolor") as stage:
            tf, options = resolve_look(request.ply, header, function)
            found = apply_function(gaussians, header, tf, options)
            stage.note = f"{len(found)} of them visible under {tf.name}"
        write_gaussians(run, request.output, found, options, request.overwrite)
    run.finish()


def function_of(
    tf: str | None,
    tf_range: str,
    unit_distance: str | None,
    labels: str | None = None,
    light: Mapping[str, Any] | None = None,
    layers: Sequence[str] = (),
) -> FunctionRequest | None:
    """Return the request that options make, None without any; raise UsageError for an invalid look of a layer."""
    looks = tuple(map(parse_layer_look, layers))
    found = FunctionRequest(tf, tf_range, unit_distance, labels, LightOptions(**(light or {})), looks)
    return None if found == FunctionRequest() else found
