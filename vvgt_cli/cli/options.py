"""Options that several commands share, each defined once."""

from __future__ import annotations

import functools
import os
import sys
import warnings
from collections.abc import Callable
from typing import Any

import click

from vvgt_cli.cli.process import interruption
from vvgt_cli.progress import Console
from vvgt_cli.resources import parse_size, processors, set_memory

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]
THREAD_VARIABLES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "SLURM_CPUS_PER_TASK")


def group(name: str, **options: Decorator) -> Decorator:
    """Several options as one keyword argument, a dict by option name.

    Keeps commands from carrying a dozen parameters: ``group("read", dims=click.option(...))`` calls the
    command with ``read={"dims": ...}``.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            kwargs[name] = {key: kwargs.pop(key) for key in options}
            return function(*args, **kwargs)

        decorated: Callable[..., Any] = wrapper
        for option in reversed(options.values()):
            decorated = option(decorated)
        return decorated

    return decorate


def _component(ctx: click.Context, param: click.Parameter, value: str | None) -> int | str | None:
    if value is None or value == "magnitude":
        return value
    return int(value) if value.isascii() and value.isdecimal() else value


_READ = dict(
    dims=click.option(
        "--dims",
        nargs=3,
        type=click.IntRange(1),
        metavar="X Y Z",
        help="Voxels of a raw file, or of the grid to resample a mesh to; also X,Y,Z.",
    ),
    dtype=click.option("--dtype", metavar="TYPE", help="Type of a raw file's values: uint8, int16, float32, ..."),
    byte_order=click.option("--byte-order", type=click.Choice(["little", "big"]), help="Of a raw file."),
    header_bytes=click.option(
        "--header-bytes", type=click.IntRange(0), default=0, metavar="N", help="Bytes before a raw file's values."
    ),
    spacing=click.option(
        "--spacing", nargs=3, type=float, metavar="X Y Z", help="Voxel edges, in place of the file's; also X,Y,Z."
    ),
    array=click.option(
        "--array",
        "--grid",
        "--series",
        "array",
        metavar="NAME",
        help="Which array, grid or series (of DICOM: number, UID or description), where there are several.",
    ),
    component=click.option(
        "--component",
        "--channel",
        "component",
        metavar="N|NAME|magnitude|color|all",
        callback=_component,
        help="Which component of vectors, or which channel: its number from 0, or its name; color: components are "
        "red, green, blue and perhaps opacity; all: every channel in its own colour.",
    ),
    time=click.option(
        "--time", type=click.IntRange(0), metavar="N", help="Which time step, from 0, where the file holds several."
    ),
    crop=click.option(
        "--crop", metavar="X0:X1,Y0:Y1,Z0:Z1", help="Voxels to keep, from 0, the last excluded; ends may be left out."
    ),
    mask=click.option("--mask", metavar="FILE", help="Volume of the same size: where it is 0 nothing is shown."),
)
read_options = group("read", **_READ)
placed_read_options = group(
    "read",
    **_READ,
    space=click.option(
        "--space", type=click.Choice(["RAS", "LPS"]), help="World of a volume with an anatomical space. Default: RAS."
    ),
)

tf_range_option = click.option(
    "--tf-range", default="data", show_default=True, metavar="data|rescale|LO,HI",
    help="Where the function's nodes lie: at their own data values, stretched to the data's range, or to LO,HI "
    "(LO HI).",
)  # fmt: skip

unit_distance_option = click.option(
    "--opacity-unit-distance", metavar="LENGTH|paraview|mean-spacing",
    help="Distance that the function's opacity refers to. Default: the function's own, else paraview.",
)  # fmt: skip

LABELS = dict(
    labels=click.option(
        "--labels", metavar="TABLE|auto|none",
        help="VOLUME is a label map: its table (3D Slicer, ITK-SNAP, FreeSurfer, .seg.nrrd, DICOM SEG, JSON), or auto "
        "for distinct colours. Default: auto where it is recognised by name and type; none: scalars.",
    ),
    layers=click.option(
        "--layer", "layers", multiple=True, metavar="FILE[,tf=TF][,labels=TABLE]...",
        help="Lay another volume over VOLUME, where both say they are, with its own tf, labels, distance, array, "
        "component (channel) or time; may be repeated.",
    ),
)  # fmt: skip

TF_HELP = "Transfer function: a file, or a matplotlib colour map's name. Default: made from the values."
tf_options = group(
    "optics",
    tf=click.option("--tf", metavar="TF", help=TF_HELP),
    tf_range=tf_range_option,
    opacity_unit_distance=unit_distance_option,
    **LABELS,
)
tfs_options = group(
    "optics",
    tf=click.option(
        "--tf", metavar="TF", multiple=True, help=f"{TF_HELP} Again: one file a function, its name for {{}} in OUT.ply."
    ),
    tf_range=tf_range_option,
    opacity_unit_distance=unit_distance_option,
    **LABELS,
)

light_options = group(
    "light",
    lights=click.option(
        "--light", "lights", multiple=True, metavar="none|headlight|X,Y,Z|left|above|...",
        help="Light at the eye, or from a direction in the world: X,Y,Z, an axis (x, -x, ...), above, below, left, "
        "right, anterior, ...; may be repeated. Default: the function's, if its file has one, else none.",
    ),
    ambient=click.option(
        "--ambient", type=float, metavar="KA", help="Part of the colour that is there without light. Default: 0.1."
    ),
    diffuse=click.option(
        "--diffuse", type=float, metavar="KD", help="Part of the colour where light falls straight. Default: 0.7."
    ),
    specular=click.option("--specular", type=float, metavar="KS", help="White of the highlights. Default: 0.2."),
    specular_power=click.option(
        "--specular-power", type=float, metavar="P", help="The larger, the smaller are highlights. Default: 10."
    ),
    shadows=click.option("--shadows", is_flag=True, help="Lights from directions throw shadows, with soft edges."),
    occlusion=click.option(
        "--ambient-occlusion", "occlusion", type=float, is_flag=False, flag_value=0.1, metavar="[RADIUS]",
        help="Darker where much is around, within RADIUS (the longest edge is 2; without a number 0.1).",
    ),
)  # fmt: skip

overwrite_option = click.option("--overwrite", is_flag=True, help="Replace files that exist.")


def default_threads() -> int:
    """Threads without `--threads`: the first of `THREAD_VARIABLES` that holds a number, else the CPUs free to us."""
    for variable in THREAD_VARIABLES:
        value = os.environ.get(variable, "").split(",")[0].strip()
        if value.isascii() and value.isdecimal() and int(value) > 0:
            return int(value)
    return processors()


def set_threads(count: int) -> None:
    """Let the kernels run on ``count`` threads; before numba is imported where that is still possible."""
    if "numba" in sys.modules:
        import numba
        from numba.core import config

        numba.set_num_threads(min(count, config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
        return
    os.environ["NUMBA_NUM_THREADS"] = str(count)
    os.environ["OMP_NUM_THREADS"] = str(count)


def _threads(ctx: click.Context, param: click.Parameter, value: int | None) -> None:
    if not ctx.resilient_parsing:
        set_threads(value or default_threads())


def _memory(ctx: click.Context, param: click.Parameter, value: str | None) -> None:
    if not ctx.resilient_parsing:
        set_memory(None if value is None else parse_size(value))


def common_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """``--threads``, ``--memory`` and ``--quiet``; the command gets a ``console``."""

    @click.option(
        "--threads",
        type=click.IntRange(1, 1024),
        metavar="N",
        callback=_threads,
        expose_value=False,
        help="CPU threads. Default: OMP_NUM_THREADS, SLURM_CPUS_PER_TASK, or all that may be used.",
    )
    @click.option(
        "--memory",
        metavar="SIZE",
        callback=_memory,
        expose_value=False,
        help="Memory to count on, as 4G. Default: what machine, cgroups and limits leave the process.",
    )
    @click.option("-q", "--quiet", is_flag=True, help="Say nothing on standard error but errors.")
    @functools.wraps(function)
    def wrapper(*args: Any, quiet: bool, **kwargs: Any) -> Any:
        with warnings.catch_warnings():
            if quiet:
                warnings.simplefilter("ignore")  # they are notes on standard error
            return function(*args, console=Console(quiet, interruption=interruption), **kwargs)

    return wrapper
