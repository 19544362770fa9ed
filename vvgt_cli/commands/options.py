"""Options that several commands share, each defined once, and the arguments that they stand for."""

from __future__ import annotations

import functools
import os
import re
import sys
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import click

from vvgt_cli.commands.process import interruption
from vvgt_cli.commands.words import SectionedCommand
from vvgt_cli.defaults import INIT, MAX_GAUSSIANS, SIZE
from vvgt_cli.progress import Console
from vvgt_cli.resources import parse_size, processors, set_memory

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]
THREAD_VARIABLES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "SLURM_CPUS_PER_TASK")


command = functools.partial(click.command, cls=SectionedCommand)


def bundle(**options: Decorator) -> Decorator:
    """Return a decorator that adds options, first the first."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        return functools.reduce(lambda decorated, option: option(decorated), reversed(options.values()), function)

    return decorate


def group(name: str, **options: Decorator) -> Decorator:
    """Return a decorator that adds options, which the command gets as one keyword argument: a dict of them by name."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            kwargs[name] = {key: kwargs.pop(key) for key in options}
            return function(*args, **kwargs)

        return bundle(**options)(wrapper)

    return decorate


def _component(ctx: click.Context, param: click.Parameter, value: str | None) -> int | str | None:
    if value == "":
        raise click.BadParameter("'' names none; expected a number, a name, magnitude, color or all")
    return int(value) if value and value.isascii() and value.isdecimal() else value


_READ = dict(
    dims=click.option(
        "--dims", nargs=3, type=click.IntRange(1), metavar="X Y Z",
        help="Voxels along x, y and z of a raw file, or of the grid that a mesh is resampled to.",
    ),
    dtype=click.option("--dtype", metavar="TYPE", help="Data type of a raw file: uint8, int16, float32, ..."),
    byte_order=click.option("--byte-order", type=click.Choice(["little", "big"]), help="Byte order of a raw file."),
    header_bytes=click.option(
        "--header-bytes", type=click.IntRange(0), default=0, metavar="N",
        help="Size of a raw file's header, which is skipped.",
    ),
    spacing=click.option(
        "--spacing", nargs=3, type=float, metavar="X Y Z", help="Voxel spacing in the file's unit, overriding its own."
    ),
    array=click.option(
        "--array", "--grid", "--series", "array", metavar="NAME",
        help="Array, grid, image, scene or DICOM series (number, name, UID or description) to read if there are "
        "several.",
    ),
    component=click.option(
        "--component", "--channel", "component", metavar="N|NAME|A,B|magnitude|color|all", callback=_component,
        help="Vector component or channel to read, by number (from 0) or name; 'color' reads the components as RGB or "
        "RGBA, 'DAPI,GFP' shows these channels together, each in its own colour, and 'all' every channel.",
    ),
    time=click.option(
        "--time", type=click.IntRange(0), metavar="N", help="Time step, or volume of a DICOM series, to read, from 0."
    ),
    suv=click.option(
        "--suv", type=click.Choice(["bw", "none"]),
        help="PET (DICOM) as SUV by body weight, or as stored. Default: bw where the file states weight and dose.",
    ),
    crop=click.option(
        "--crop", metavar="X0:X1,Y0:Y1,Z0:Z1",
        help="Range of voxels to keep, as Python slices: counted from 0, end excluded, either bound optional.",
    ),
    mask=click.option("--mask", metavar="FILE", help="Volume of the same grid; voxels where it is 0 are hidden."),
    keep_largest=click.option(
        "--keep-largest", type=float, metavar="VALUE",
        help="Of what lies above VALUE, hide all but the largest connected body: -300 removes the head rest of a CT. "
        "Each channel has its own; colours have none.",
    ),
)  # fmt: skip
read_options = group("read", **_READ)
placed_read_options = group(
    "read",
    **_READ,
    space=click.option(
        "--space", type=click.Choice(["RAS", "LPS"]), help="World space of anatomical volumes. Default: RAS."
    ),
)

tf_range_option = click.option(
    "--tf-range", default="data", show_default=True, metavar="data|rescale|LO,HI",
    help="Place the function's nodes at their own data values, or stretch them to the range of the data, or to LO,HI.",
)  # fmt: skip

unit_distance_option = click.option(
    "--opacity-unit-distance", metavar="LENGTH|paraview|mean-spacing",
    help="Distance over which the function's opacity accumulates. Default: given by the function, else paraview.",
)  # fmt: skip

LABELS = dict(
    labels=click.option(
        "--labels", metavar="TABLE|auto|none",
        help="Treat VOLUME as a label map coloured by TABLE (3D Slicer, ITK-SNAP, FreeSurfer, CSV, TSV, .seg.nrrd, "
        "DICOM SEG, JSON, dataset.json, ParaView); 'auto' takes its own names and colours, or assigns distinct ones, "
        "'none' treats it as scalars. Default: detected from header, name and values.",
    ),
    layers=click.option(
        "--layer", "layers", multiple=True, metavar="FILE[,tf=TF][,labels=TABLE]...",
        help="Add another volume, placed by its own coordinates, with its own tf, labels, distance, array, component "
        "(channel) or time. Repeatable.",
    ),
)  # fmt: skip

TF_HELP = (
    "Transfer function: a file, a preset such as ct-bone ('vvgt tf list' shows all), or the name of a matplotlib "
    "colour map. Default: made from the data."
)


iso_option = click.option(
    "--iso", metavar="LEVEL[,COLOR]", multiple=True,
    help="Show the isosurface at LEVEL, a data value or standard deviations above the mean (3sigma), instead of a "
    "function (--tf). Repeatable: outer ones are translucent. ',above' or ',below' says which values are inside.",
)  # fmt: skip


def optics_options(more: str = "", multiple: bool = False) -> Decorator:
    """Return the options of a look; ``--tf`` has ``more`` help, and several values if ``multiple``."""
    return group(
        "optics",
        tf=click.option("--tf", metavar="TF", multiple=multiple, help=TF_HELP + more),
        iso=iso_option,
        tf_range=tf_range_option,
        opacity_unit_distance=unit_distance_option,
        **LABELS,
    )


tf_options = optics_options()
output_option = click.option(
    "-o", "--output", required=True, metavar="OUT.ply",
    help="Output file; its ending selects the format, - is standard output.",
)  # fmt: skip
light_options = group(
    "light",
    lights=click.option(
        "--light", "lights", multiple=True, metavar="none|headlight|studio|X,Y,Z|left|...",
        help="Light at the eye ('headlight') or from a direction in the world: X,Y,Z, an axis (x, -x, ...), above, "
        "below, left, right, anterior, ... Repeatable. Or light from all around, traced along its paths: studio, "
        "overcast, window, sun, or a picture, FILE.hdr or .exr. Default: a headlight if the function has one, as "
        "presets such as ct-bone and label maps do, else none.",
    ),
    ambient=click.option(
        "--ambient", type=float, metavar="KA", help="Ambient coefficient. Default: the function's, or 0.1."
    ),
    diffuse=click.option(
        "--diffuse", type=float, metavar="KD", help="Diffuse coefficient. Default: the function's, or 0.7."
    ),
    specular=click.option(
        "--specular", type=float, metavar="KS",
        help="Specular coefficient; highlights are white. Default: the function's, or 0.2.",
    ),
    specular_power=click.option(
        "--specular-power", type=float, metavar="P",
        help="Specular exponent; larger is glossier. Default: the function's, or 10.",
    ),
)  # fmt: skip
layer_looks_option = click.option(
    "--layer", "layers", multiple=True, metavar="LAYER,tf=TF",
    help="Function (tf=) or table (labels=) of one layer or channel of several, by number or name; repeat for others.",
)  # fmt: skip

SECONDS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}
MEGABYTES = {"": 1.0, "b": 1e-6, "kb": 1e-3, "mb": 1.0, "gb": 1e3}


class Measure(click.ParamType[float]):
    """A number with an optional unit, converted to the first one of ``units``."""

    def __init__(self, name: str, units: dict[str, float]) -> None:
        """Take the name of the quantity and the factor of each unit."""
        self.name, self.units = name, units

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number, or raise click.BadParameter."""
        parts, number = re.fullmatch(r"\s*([-+.\de]*[.\d])\s*([a-z]*)\s*", str(value).lower()), 0.0
        with suppress(ValueError, TypeError, KeyError):
            number = float(parts[1]) * self.units[parts[2]]  # type: ignore[index]  # None: TypeError
        if not number > 0:
            units = ", ".join(filter(None, self.units))
            self.fail(f"{value!r} is not a {self.name}; expected a number above 0, with {units} or no unit")
        return number


title_option = click.option(
    "--title", metavar="TEXT",
    help="Title of pages, recorded in the file. Default: kind of scan and function, or labels; no names of files.",
)  # fmt: skip

story_option = click.option(
    "--story", metavar="STORY.json",
    help="Steps of text, camera, cut, function, labels, light and slices for a page (.html) to tell.",
)  # fmt: skip

values_option = click.option(
    "--no-values", "values", is_flag=True, default=True, flag_value=False,
    help="Omit the values from the page (.html) of a volume or a series, and with them slices and changes of its look.",
)  # fmt: skip

report_option = click.option(
    "--report", metavar="R.json", help="Save stages, times and scores as JSON; - is standard output."
)

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")

overwrite_option = click.option("--overwrite", is_flag=True, help="Overwrite existing files.")


def default_threads() -> int:
    """Return the threads without `--threads`: the first number in `THREAD_VARIABLES`, else the CPUs we may use."""
    for variable in THREAD_VARIABLES:
        value = os.environ.get(variable, "").split(",")[0].strip()
        if value.isascii() and value.isdecimal() and int(value) > 0:
            return int(value)
    return processors()


def set_threads(count: int) -> None:
    """Run the kernels on ``count`` threads; set before numba is imported if that is still possible."""
    if "numba" in sys.modules:
        import numba

        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
        return
    os.environ["NUMBA_NUM_THREADS"] = str(count)
    os.environ["OMP_NUM_THREADS"] = str(count)


def _device(ctx: click.Context, param: click.Parameter, value: str) -> str:
    from vvgt_cli.device import chosen

    return chosen(value)


def device_option(done: str) -> Decorator:
    """``--device``, for what is ``done`` there; a command gets "cpu" or "cuda"."""
    return click.option(
        "--device", type=click.Choice(["cpu", "cuda", "auto"]), default="cpu", show_default=True, callback=_device,
        help=f"Where {done}: auto is a GPU that is there and free, else the CPU.",
    )  # fmt: skip


def _threads(ctx: click.Context, param: click.Parameter, value: int | None) -> None:
    if not ctx.resilient_parsing:
        set_threads(value or default_threads())


def _memory(ctx: click.Context, param: click.Parameter, value: str | None) -> None:
    if not ctx.resilient_parsing:
        set_memory(None if value is None else parse_size(value))


def common_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--threads``, ``--memory`` and ``--quiet``; call the command with a ``console``."""

    @click.option(
        "--threads", type=click.IntRange(1, 1024), metavar="N", callback=_threads, expose_value=False,
        help="Number of threads. Default: NUMBA_NUM_THREADS, OMP_NUM_THREADS, SLURM_CPUS_PER_TASK or all CPUs.",
    )  # fmt: skip
    @click.option(
        "--memory", metavar="SIZE", callback=_memory, expose_value=False,
        help="Memory limit, such as 4G. Default: what the machine, cgroups and ulimit allow.",
    )  # fmt: skip
    @click.option("-q", "--quiet", is_flag=True, help="Print only errors.")
    @functools.wraps(function)
    def wrapper(*args: Any, quiet: bool, **kwargs: Any) -> Any:
        with warnings.catch_warnings():
            if quiet:
                warnings.simplefilter("ignore")  # they are notes on standard error
            # that of 3D Slicer (`vvgt_cli.commands.slicer`), if there is one
            console = click.get_current_context().find_object(type) or Console
            return function(*args, console=console(quiet, interruption=interruption), **kwargs)

    return wrapper


def _number_or(word: str, number: str) -> Callable[[click.Context, click.Parameter, str | None], int | str | None]:
    """Return the callback of an option that takes a ``word`` or a ``number``, so described in its error."""

    def parse(ctx: click.Context, param: click.Parameter, value: str | None) -> int | str | None:
        if value is None or value == word:
            return value
        if not (value.isascii() and value.isdecimal()):
            raise click.BadParameter(f"{value!r}; expected {word}, or {number}")
        return int(value)

    return parse


def _shard(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[int, int] | None:
    from vvgt_cli.conversion.manifest import parse_shard

    return None if value is None else (parse_shard(value).index, parse_shard(value).count)


_options = {
    "block_size": click.option(
        "--blocks", "block_size", metavar="SIZE|auto", callback=_number_or("auto", "a power of two from 16 on"),
        help="Process the volume in blocks of SIZE voxels along an edge (a power of two); 'auto' chooses by memory. "
        "Default: blocks if the volume is larger than 1 GiB or does not fit in memory.",
    ),
    "workers": click.option(
        "--workers", type=click.IntRange(1, 1024), metavar="N",
        help="Number of parallel worker processes, or of SLURM jobs with --scheduler slurm. Default: by processors, "
        "memory and size; 1 with --scheduler.",
    ),
    "scheduler": click.option(
        "--scheduler", metavar="local|slurm|ADDRESS",
        help="Process blocks with Dask: on this machine, as SLURM jobs, or through the scheduler at ADDRESS "
        "(tcp://...). Needs the extra 'cluster'.",
    ),
    "level": click.option(
        "--level", metavar="full|N", callback=_number_or("full", "the number of a level (0, 1, ...)"),
        help="Resolution level of an OME-Zarr, N5, Imaris or BigDataViewer image in blocks, 0 the finest. Default: the "
        "coarsest sufficient for --screen.",
    ),
}  # fmt: skip
_shard_option = {
    "shard": click.option(
        "--shard", metavar="I/N", callback=_shard,
        help="Process part I of N in a job array; -o is then a folder of blocks for 'vvgt merge'.",
    ),
}  # fmt: skip
block_options = group("blocks", **_options)
shared_block_options = group("blocks", **_options, **_shard_option)


def arguments(
    console: Console | None = None, optics: dict[str, Any] | None = None, light: dict[str, Any] | None = None,
    blocks: dict[str, Any] | None = None, read: Mapping[str, Any] = {}, **options: Any,
) -> dict[str, Any]:  # fmt: skip
    """Return the arguments of the function that a command calls, with its groups of options as the function takes them.

    Raise UsageError for options of blocks that do not fit together.
    """
    from vvgt_cli.library.inputs import Look

    if optics is not None:
        several = (optics["tf"] or [None]) if isinstance(optics["tf"], tuple) else [optics["tf"]]
        looks = [Look(**optics | {"tf": tf}, light=light) for tf in several]
        options["look"] = looks if len(looks) > 1 else looks[0]
    if blocks is not None and set(blocks.values()) != {None}:
        from vvgt_cli.field.settings import BlockOptions

        size = blocks.pop("block_size")
        options["blocks"] = BlockOptions(None if size == "auto" else size, **blocks)
    return {**options, **read, **({} if console is None else {"progress": console})}


fit_options = bundle(
    max_gaussians=click.option(
        "--max-gaussians", type=click.IntRange(1, 100_000_000), metavar="K",
        help=f"Maximum number of Gaussians. Default: {MAX_GAUSSIANS}.",
    ),
    screen=click.option(
        "--screen", type=click.IntRange(16, 8192), metavar="PX",
        help=f"Screen size that the file is optimised for and scored at, in pixels along an edge. Default: {SIZE}.",
    ),
    init=click.option(
        "--init", type=click.Choice(["moments", "wavelet", "uniform"]), default=INIT, show_default=True,
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


def rule_option(help: str, more: tuple[str, ...] = ()) -> Callable[[Any], Any]:
    """Return the option ``--rule``, which takes the rules and the names of ``more``."""
    return click.option("--rule", type=click.Choice([*RULES, *more]), help=help)


limit_options = bundle(
    target_psnr=click.option(
        "--target-psnr", type=click.FloatRange(0, 150), metavar="DB",
        help="Stop at this PSNR, skipping stages and Gaussians that are not needed for it.",
    ),
    time_budget=click.option(
        "--time-budget", type=Measure("time", SECONDS), metavar="TIME",
        help="Time for the whole run, such as 90, 10m or 1h; stages that do not fit are skipped.",
    ),
    max_megabytes=click.option(
        "--max-megabytes", type=Measure("file size", MEGABYTES), metavar="MB",
        help="Maximum file size in 10^6 bytes, also as 5MB or 800kB, of a .ply or a page; coarsens values, then "
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


ply_options = bundle(
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
