"""The volume of a request, opened under its look, in memory or in blocks, and the layout of its file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path

from vvgt_cli.conversion.place import placement_warnings, up_axis, with_place
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import DataError
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.field.field import Field
from vvgt_cli.field.layered import content_of
from vvgt_cli.field.open import MIN_BLOCKED, FieldNeeds, automatic, opened, store_beside
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.field.source import SourceRequest, StyledVolume, tf_record, volume_record
from vvgt_cli.gaussians import PlyOptions
from vvgt_cli.gaussians.formats.streamed import is_streamed
from vvgt_cli.gaussians.header import legend_text
from vvgt_cli.jit.ahead import CONVERT, DRAW, INIT, LIVE, RENDER, VOXELIZE, for_degree
from vvgt_cli.look.labels import LabelTable
from vvgt_cli.look.resolve import unit_of_values
from vvgt_cli.look.suggest import fitting
from vvgt_cli.refine import load_ahead
from vvgt_cli.score.record import Run
from vvgt_cli.volume.space import shear_text


@contextmanager
def open_field(
    run: Run, request: ConvertRequest, kernels: tuple[str, ...] | None = None, resumes: bool = True
) -> Iterator[Field]:
    """Open a request's volume under its look, in memory or in blocks, and compile ``kernels``, None for its own.

    Blocks are stored beside the output until it is written: after an interruption the same command reuses them, if it
    ``resumes``. Those of a shard are the output.

    Raises:
        DataError, UsageError: see `vvgt_cli.field.source.load`.
        MissingBlocks: blocks of other shards are missing.
    """
    if request.fit.device != "cpu":
        load_ahead()
    shard = request.blocks is not None and request.blocks.shard is not None
    beside = request.output if resumes else None
    if is_streamed(beside) and request.checkpoint is not None:
        beside = str(Path(request.checkpoint) / "levels")

    def needed(source: StyledVolume, in_blocks: bool) -> tuple[str, ...]:
        _report_source(run, request, source)
        alone = (RENDER, *INIT, *DRAW) if in_blocks else INIT  # views are cast with the blocks
        names = (CONVERT if request.scored else alone) if kernels is None else kernels
        return for_degree(source.kernels(names + (LIVE + VOXELIZE if request.live else ())), degree_of(request, source))

    needs = FieldNeeds(request.budget(), request.fit.screen, request.ply.sh_degree, request.out_of_core, request.live)
    store = nullcontext(BlockStore(Path(str(beside)).absolute())) if shard else store_beside(beside)
    with opened(run, request.source, request.blocks, needs, needed, store, request.fit.device) as field:
        yield field
        if isinstance(field, Blocked) and not shard:
            field.run_pass.store.remove()


@contextmanager
def opened_upright(
    run: Run, request: SourceRequest, blocks: BlockOptions | None, needs: FieldNeeds, kernels: tuple[str, ...],
    store: AbstractContextManager[BlockStore] | None = None, device: str = "cpu",
    look: Callable[[StyledVolume], StyledVolume] = lambda source: source,
) -> Iterator[Field]:  # fmt: skip
    """Open a volume that pinhole cameras see, laid out on first use; arguments and errors are those of `opened`.

    Raises:
        DataError: the volume is sheared.
    """

    def needed(source: StyledVolume, in_blocks: bool) -> tuple[str, ...]:
        if source.volume.sheared:
            text = shear_text(source.volume.axes)
            raise DataError(
                f"{source.volume.name}: {text}; expected right angles: no pinhole camera sees a sheared volume; "
                "resample it first ('vvgt convert' accepts it)"
            )
        return source.kernels(kernels)

    with opened(run, request, blocks, needs, needed, store, device, look, at_once=False) as field:
        yield field


def read_once(
    run: Run, sources: Sequence[SourceRequest], blocks: BlockOptions | None
) -> tuple[list[SourceRequest], BlockOptions | None]:
    """Return the requests for one volume under several looks with its content, unless it is processed in blocks.

    Errors are those of `vvgt_cli.field.layered.open_content`.
    """
    first = sources[0]
    blocks = blocks or automatic(first, run.console)
    if blocks is not None or len(sources) == 1:
        return list(sources), blocks
    with run.stage("volume") as stage:
        content = first.content()
        content.prepare()
        stage.note = f"{content.volumes[0].name}, for {len(sources)} functions"
    return [replace(source, volume=content) for source in sources], None


def _report_source(run: Run, request: ConvertRequest, source: StyledVolume) -> None:
    """Report what was read."""
    ply = ply_options(request, source)
    flattened = harmonics_warning(degree_of(request, source), source)
    for warning in [*placement_warnings(source.volume, ply), *([flattened] if flattened else [])]:
        run.console.message(warning)
    plain = request.source.tf is None and not source.gridded and source.volume.data.nbytes < MIN_BLOCKED
    if plain and (name := fitting(source.overall, source.volume)) and name not in source.layers[0].tf.name:
        run.console.message(f"{source.volume.name}: no look is given; --tf {name} is made for such data, try it")
    run.report.volume = volume_record(source)
    run.report.transfer_function = tf_record(source, request.source)
    fit = request.fit
    run.report.options = asdict(fit) | {
        "max_megabytes": request.megabytes, "frame": ply.frame, "up": ply.up, "sh_degree": ply.sh_degree,
    }  # fmt: skip


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
