"""Options of commands that process a volume in blocks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from vvgt_cli.cli.options import group

if TYPE_CHECKING:
    from vvgt_cli.field.settings import BlockOptions


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
    if value is None:
        return None
    index, _, count = value.partition("/")
    if not (index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count)):
        raise click.BadParameter(f"{value!r}; expected I/N with I from 1 to N, as 3/8")
    return int(index), int(count)


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
        "coarsest sufficient for --size.",
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


def block_options_of(blocks: dict[str, Any]) -> BlockOptions | None:
    """Return the options of blocks, None to let the program choose; raise UsageError if they do not fit together."""
    from vvgt_cli.field.settings import BlockOptions

    if all(value is None for value in blocks.values()):
        return None
    size = blocks.pop("block_size")
    return BlockOptions(**{**blocks, "size": None if size == "auto" else size})
