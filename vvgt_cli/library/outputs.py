"""Files that functions of the API write where they are given names for them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

from vvgt_cli.conversion.gaussian_files import write_gaussians
from vvgt_cli.conversion.result import Result
from vvgt_cli.gaussians.outputs import Output, claimed, write_text
from vvgt_cli.library.inputs import PathLike, console_of
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run


def written(
    make: Callable[[Run], Result], name: str, inputs: Sequence[str], output: PathLike | None,
    report: PathLike | None = None, *, overwrite: bool, progress: bool | Console, suffixes: tuple[str, ...] = (".ply",),
) -> Result:  # fmt: skip
    """Return a result, written where there is an output, and its report; both are checked before the work begins.

    Args:
        make: makes the result.
        name: of the run.
        inputs: files that are read, which no output may replace.
        output: file of Gaussians, "-" for standard output, None for none.
        report: JSON to write, likewise.
        overwrite: replace files that exist.
        progress: print messages and bars on standard error, or the console that does.
        suffixes: endings that the output may have.

    Raises:
        UsageError, DataError: see `check_outputs`.
    """
    outputs = Output.of("-o", output, suffixes, splats=True) + Output.of("--report", report, (".json",), binary=False)
    run = Run(console_of(progress), ConversionReport(name))
    with claimed(outputs, inputs, overwrite):
        result = make(run)
        if output is not None:
            write_gaussians(run, os.fspath(output), result.gaussians, result.ply, overwrite)
        run.finish()
        if report is not None:
            write_text(report, run.report.to_json(), overwrite)
    return result
