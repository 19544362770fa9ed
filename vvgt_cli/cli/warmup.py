"""`vvgt warmup`."""

from __future__ import annotations

import click

from vvgt_cli.cli.options import common_options
from vvgt_cli.progress import Console


@click.command("warmup", short_help="Compile the kernels before they are needed.")
@common_options
def command(console: Console) -> None:
    """Compile what the commands need, and print the folder where it lies.

    A first run compiles for half a minute otherwise. For container images, job arrays and CI: whoever can read
    the folder starts warm. It is the package's own where that can be written to, else one in the user's
    cache; NUMBA_CACHE_DIR names another. Code is kept per processor type: on a cluster of several, once on each.

    \b
    Examples:
      vvgt warmup
      NUMBA_CACHE_DIR=/scratch/kernels vvgt warmup && sbatch convert.sh
    """
    from vvgt_cli.errors import DataError
    from vvgt_cli.jit.ahead import ALL
    from vvgt_cli.jit.compile import compile_ahead
    from vvgt_cli.runs.record import ConversionReport, Run

    run = Run(console, ConversionReport("warmup"))
    with run.stage("compile") as stage:
        count, left, folder = compile_ahead(ALL, progress=console.bar("compile"))
        stage.note = f"{count} kernels were missing" if count else "nothing was missing"
    if folder is None:
        raise DataError("the compiled kernels could not be kept; try NUMBA_CACHE_DIR=FOLDER that can be written to")
    if left:
        raise DataError(f"{left} of {count} kernels were not compiled; see {folder}, and try again")
    click.echo(folder)
