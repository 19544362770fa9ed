"""`vvgt warmup`."""

from __future__ import annotations

import click

from vvgt_cli.commands import options as shared
from vvgt_cli.progress import Console


@shared.command("warmup", short_help="Compile the kernels ahead of time.")
@shared.common_options
def command(console: Console) -> None:
    """Compile the numerical kernels ahead of time and print the folder where they are stored.

    Otherwise the first run compiles for about half a minute. Useful for container images, job arrays and CI. The folder
    is inside the package if that is writable, else in the user's cache; NUMBA_CACHE_DIR overrides it. Code is specific
    to the processor type: on a mixed cluster, run this once per type.

    Examples:
      vvgt warmup
      NUMBA_CACHE_DIR=/scratch/kernels vvgt warmup && sbatch convert.sh
    """
    from vvgt_cli.errors import DataError
    from vvgt_cli.jit.ahead import ALL
    from vvgt_cli.jit.compile import compile_ahead
    from vvgt_cli.score.record import ConversionReport, Run

    run = Run(console, ConversionReport("warmup"))
    with run.stage("compile") as stage:
        count, left, folder = compile_ahead(ALL, progress=console.bar("compile"))
        stage.note = f"{count} kernels were missing" if count else "nothing was missing"
    if folder is None:
        raise DataError("no folder can keep the compiled kernels; set NUMBA_CACHE_DIR to a writable one")
    if left:
        raise DataError(f"{left} of {count} kernels were not compiled; see {folder}, and try again")
    click.echo(folder)
