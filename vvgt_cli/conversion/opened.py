"""The volume of a request, opened under its look, in memory or in blocks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict
from pathlib import Path

from vvgt_cli.conversion.file_layout import degree_of, harmonics_warning, ply_options
from vvgt_cli.conversion.place import placement_warnings
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.field.field import Field
from vvgt_cli.field.open import MIN_BLOCKED, FieldNeeds, opened, store_beside
from vvgt_cli.field.source import StyledVolume, tf_record, volume_record
from vvgt_cli.gaussians.formats.streamed import is_streamed
from vvgt_cli.jit.ahead import CONVERT, DRAW, INIT, LIVE, RENDER, for_degree
from vvgt_cli.look.suggest import fitting
from vvgt_cli.refine import load_ahead
from vvgt_cli.score.record import Run


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
        return for_degree(source.kernels(names + (LIVE if request.live else ())), degree_of(request, source))

    needs = FieldNeeds(request.budget(), request.fit.screen, request.ply.sh_degree, request.out_of_core, request.live)
    store = nullcontext(BlockStore(Path(str(beside)).absolute())) if shard else store_beside(beside)
    with opened(run, request.source, request.blocks, needs, needed, store, request.fit.device) as field:
        yield field
        if isinstance(field, Blocked) and not shard:
            field.run_pass.store.remove()


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
    run.report.options = asdict(fit) | asdict(request.limits) | {
        "max_megabytes": request.megabytes, "frame": ply.frame, "up": ply.up, "sh_degree": ply.sh_degree,
    }  # fmt: skip
