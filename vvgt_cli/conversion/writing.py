"""Writing a conversion: the file, again with its certificate, and what is written beside it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vvgt_cli.conversion.gaussian_files import read_back, write_gaussians, write_parts
from vvgt_cli.conversion.levels import write_levels
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.conversion.result import Conversion
from vvgt_cli.conversion.resume import Checkpoint, checkpoint_folder
from vvgt_cli.conversion.stage import Work
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.gaussians.formats import format_of, is_page
from vvgt_cli.gaussians.formats.streamed import folder_of
from vvgt_cli.gaussians.outputs import claimed, write_text
from vvgt_cli.jit.ahead import EVALUATE
from vvgt_cli.score.record import Run
from vvgt_cli.score.viewing import PREVIEW_VIEWS


@contextmanager
def outputs_of(request: ConvertRequest, run: Run) -> Iterator[None]:
    """Claim the outputs of a request and its checkpoints, which are removed once the output is complete.

    Raises:
        UsageError: an output may not be written; raised before anything is read.
    """
    with (
        folder_of(request.output),
        claimed(request.outputs(), request.inputs(), request.overwrite),
        checkpoint_folder(request.checkpoint),
    ):
        yield
        if request.checkpoint is not None and not run.report.interrupted:
            Checkpoint(Path(request.checkpoint)).finish()


def write(
    run: Run, request: ConvertRequest, work: Work, conversion: Conversion, again: bool = False, more: str = ""
) -> None:
    """Write the file, a page with all its contents, or ``again`` with its certificate; ``more`` ends the message."""
    output, stage, overwrite = request.output, "certificate" if again else "write", request.overwrite or again
    assert output is not None
    if work.levels is not None:
        assert isinstance(work.field, Blocked)
        write_levels(run, work.field.run_pass, work.levels, output, overwrite, conversion.ply, stage)
    elif work.parts is not None and work.gaussians is None:
        write_parts(run, output, work.parts, overwrite)
    else:
        page = is_page(output) and request.ply.comments
        limit = None if request.megabytes is None else 1e6 * request.megabytes
        values = conversion.values(run, limit) if page and request.values else None
        write_gaussians(
            run, output, conversion.gaussians, conversion.ply, overwrite, conversion.normals(), stage, more, values
        )


def write_beside(run: Run, request: ConvertRequest, conversion: Conversion) -> None:
    """Report what the file's format costs, and write preview and report."""
    from vvgt_cli.images import captioned, write_png

    if format_of(str(request.output)):
        source = conversion.field.source
        run.compile(source.kernels(EVALUATE), source.kernel_type())
        read_back(run, str(request.output), conversion.gaussians, conversion.ply, conversion.field)
    if request.preview:
        with run.stage("preview"):
            write_png(request.preview, captioned(conversion.preview(), len(PREVIEW_VIEWS)), request.overwrite)
    run.finish()
    if request.report:
        write_text(request.report, run.report.to_json(), request.overwrite)
