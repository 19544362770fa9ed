"""Options of the commands that make Gaussians, and the request that they make."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from vvgt_cli.cli.options import MEGABYTES, SECONDS, Measure, group
from vvgt_cli.defaults import INIT, MAX_GAUSSIANS, SIZE

if TYPE_CHECKING:
    from vvgt_cli.conversion.request import ConvertRequest
    from vvgt_cli.field.source import SourceRequest

fit_options = group(
    "fit",
    max_gaussians=click.option(
        "--max-gaussians", type=click.IntRange(1, 100_000_000), default=MAX_GAUSSIANS, show_default=True, metavar="K",
        help="Maximum number of Gaussians.",
    ),
    size=click.option(
        "--size", type=click.IntRange(16, 8192), default=SIZE, show_default=True, metavar="PX",
        help="Screen size that the file is optimised for and scored at, in pixels along an edge.",
    ),
    init=click.option(
        "--init", type=click.Choice(["vbm", "wavelet", "uniform"]), default=INIT, show_default=True,
        help="Closed form: multi-resolution moments, one isotropic Gaussian per wavelet atom, or random samples.",
    ),
    seed=click.option(
        "--seed", type=click.IntRange(0), default=0, show_default=True, metavar="N",
        help="Random seed of --init uniform.",
    ),
)  # fmt: skip

# `vvgt_cli.gaussians.rules.RULES`; a test compares
RULES = ("inria", "compensated", "spark", "playcanvas", "viser", "three", "babylon", "cesium")


TARGETS = ("quest", "visionos", "phone", "desktop")  # `vvgt_cli.gaussians.targets.TARGETS`; a test compares


def target_option(help: str) -> Callable[[Any], Any]:
    """Return the option ``--for``."""
    return click.option("--for", "target", type=click.Choice(TARGETS), help=help)


def rule_option(help: str, default: str | None = None, more: tuple[str, ...] = ()) -> Callable[[Any], Any]:
    """Return the option ``--rule``, which takes the rules and the names of ``more``."""
    return click.option(
        "--rule", type=click.Choice([*RULES, *more]), default=default, show_default=default is not None, help=help
    )


limit_options = group(
    "limits",
    target_psnr=click.option(
        "--target-psnr", type=click.FloatRange(0, 150), metavar="DB",
        help="Stop at this PSNR, skipping stages and Gaussians that are not needed for it.",
    ),
    time_budget=click.option(
        "--time-budget", type=Measure("time", SECONDS), metavar="TIME",
        help="Time for the whole run, such as 90, 10m or 1h; stages that do not fit are skipped.",
    ),
    max_megabytes=click.option(
        "--max-size", "max_megabytes", type=Measure("file size", MEGABYTES), metavar="MB",
        help="Maximum file size in 10^6 bytes, also as 5MB or 800kB, of a .ply or a page; coarsens slices, then "
        "reduces the number of Gaussians.",
    ),
)  # fmt: skip


def _camera(context: click.Context, option: click.Parameter, text: str | None) -> tuple[float, ...] | None:
    from vvgt_cli.gaussians.header import camera_of

    try:
        return None if text is None else camera_of(text.split(","))
    except ValueError:
        raise click.BadParameter(
            f"{text!r}; expected eye, target (another place) and field of view (above 0, below 180 degrees), "
            "seven numbers separated by commas"
        ) from None


ply_options = group(
    "ply",
    frame=click.option(
        "--frame", type=click.Choice(["unit", "world"]), default="unit", show_default=True,
        help="Coordinates: centred and scaled to a longest edge of 2, or those of the volume's physical space.",
    ),
    up=click.option(
        "--up", metavar="DIRECTION", default="auto", show_default=True,
        type=click.Choice([
            *("auto", "none", "x", "-x", "y", "-y", "z", "-z"),
            *("superior", "inferior", "anterior", "posterior", "left", "right"),
        ]),
        help="Direction that viewers show upwards: anatomical, or a world axis. 'none' keeps the axes; 'auto' is "
        "superior for anatomical volumes in the unit frame, else none.",
    ),
    camera=click.option(
        "--camera", metavar="EX,EY,EZ,TX,TY,TZ,FOV", callback=_camera,
        help="Where pages open: eye and target in the volume's physical space, and the vertical field of view in "
        "degrees. Recorded in the file. Default: all of it in view.",
    ),
    sh_degree=click.option(
        "--sh-degree", type=click.IntRange(0, 3), metavar="N",
        help="Degree of the spherical harmonics in the file, padded with zeros or truncated. Default: as computed.",
    ),
    comments=click.option("--no-comments", "comments", is_flag=True, default=True, flag_value=False,
        help="Omit the comments (frame, unit distance, version, certificate, ...) from the header."),
)  # fmt: skip


def source_request(
    volume: str, read: dict[str, Any], optics: dict[str, Any], light: dict[str, Any] | None = None
) -> SourceRequest:
    """Return the source that the shared options of `options.py` describe."""
    from vvgt_cli.field.source import SourceRequest, parse_layer
    from vvgt_cli.look.lighting import LightOptions
    from vvgt_cli.volume import ReadOptions

    return SourceRequest(
        volume, ReadOptions(**read), optics["tf"], optics["tf_range"], optics["opacity_unit_distance"],
        light=LightOptions(**(light or {})), labels=optics["labels"],
        layers=tuple(parse_layer(text, read.get("space")) for text in optics["layers"]),
    )  # fmt: skip


def convert_request(
    volume: str, *, fit: dict[str, Any], ply: dict[str, Any], read: dict[str, Any], optics: dict[str, Any],
    light: dict[str, Any], steps: int | None = None, target: str | None = None, model: str | None = None,
    device: str = "cpu", limits: dict[str, Any] | None = None, **more: Any,
) -> ConvertRequest:  # fmt: skip
    """Return the request that the options of `convert` and `init` describe; ``more`` are fields of it."""
    from vvgt_cli.conversion.request import ConvertRequest, FitOptions, Limits
    from vvgt_cli.gaussians import PlyOptions

    up, source = ply.pop("up"), source_request(volume, read, optics, light)
    fitted = FitOptions(**fit, steps=steps, model=model, device=device, target=target)
    return ConvertRequest(source, fit=fitted, limits=Limits(**(limits or {})), ply=PlyOptions(**ply), up=up, **more)
