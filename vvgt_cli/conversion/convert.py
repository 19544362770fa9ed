"""The conversion of one volume under a look: read, plan, closed form, refinement, write, score, certify."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from vvgt_cli.conversion.certify import with_certificate
from vvgt_cli.conversion.fitting import check_request, fit, work_of
from vvgt_cli.conversion.gaussian_files import levels_in_box, read_back, write_gaussians, write_parts
from vvgt_cli.conversion.levels import write_levels
from vvgt_cli.conversion.opened import open_field
from vvgt_cli.conversion.place import to_unit_frame
from vvgt_cli.conversion.plan import WarmStart
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.conversion.result import Conversion
from vvgt_cli.conversion.resume import Checkpoint, checkpoint_folder
from vvgt_cli.conversion.stage import Work
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.field.field import Field
from vvgt_cli.files import is_stream
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.formats import format_of, is_page
from vvgt_cli.gaussians.formats.streamed import folder_of
from vvgt_cli.gaussians.outputs import claimed, write_text
from vvgt_cli.gaussians.types import NOTHING
from vvgt_cli.jit.ahead import EVALUATE
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.score.viewing import PREVIEW_VIEWS

Unscored = Callable[[Conversion], None]  # is called with a conversion before it has scores and a certificate


def convert_one(
    request: ConvertRequest, console: Console | None = None, *, warm: WarmStart | None = None,
    finished: Gaussians | None = None, unscored: Unscored | None = None,
) -> Conversion:  # fmt: skip
    """Convert a volume to the output of a request, or only in memory where there is none.

    Args:
        request: the request.
        console: destination of messages.
        warm: warm start that is tried before the closed form.
        finished: finished Gaussians, box frame, that only need scores.
        unscored: called with the conversion before it has scores and a certificate.

    Returns:
        The Gaussians with the report. Without an output the volume stays open as long as they exist, for drawing it.

    Raises:
        UsageError: options contradict each other, or an output may not be written; raised before anything is read.
        DataError: the input is invalid, or nothing is visible.
    """
    check_request(request)
    run = Run(console or Console(), ConversionReport("convert" if request.scored else "init"))
    with ExitStack() as stack:
        stack.enter_context(folder_of(request.output))
        stack.enter_context(claimed(request.outputs(), request.inputs(), request.overwrite))
        stack.enter_context(checkpoint_folder(request.checkpoint))
        field = stack.enter_context(open_field(run, request))
        conversion = convert_field(run, request, field, warm, finished, unscored)
        if request.checkpoint is not None and not run.report.interrupted:
            Checkpoint(Path(request.checkpoint)).finish()
        if request.output is None:
            run.finish()
            weakref.finalize(conversion, stack.pop_all().close)
    return conversion


def convert_field(
    run: Run, request: ConvertRequest, field: Field, warm: WarmStart | None = None,
    finished: Gaussians | None = None, unscored: Unscored | None = None,
) -> Conversion:  # fmt: skip
    """Convert a field: closed form, refinement, file, scores on the test views, certificate; see `convert_one`."""
    work = work_of(run, request, field)
    scores = fit(work, request, warm, finished)
    gaussians = NOTHING  # where they are only on disk
    if work.gaussians is not None:
        gaussians = to_unit_frame(work.gaussians, field.source.volume)
    conversion = Conversion(gaussians, run.report, work.ply, field)
    early = bool(scores) and (request.writes > 1 or (work.gaussians is None and request.output is not None))
    if early:
        write(run, request, work, conversion, more="; complete; scoring next")
    if unscored is not None:
        unscored(conversion)
    if work.levels is not None and early:
        work.seen = conversion.seen = levels_in_box(str(request.output), field.source.volume)
    for stage in scores:
        stage.run(work)
    if work.parts is None or work.gaussians is not None:  # else their file is not written again, for a certificate
        conversion.ply = with_certificate(
            conversion.ply, run, field, work.fit, conversion.gaussians, request.command, work.live_psnr
        )
    if request.output is not None:
        if conversion.ply.certificate is not None or not early:
            write(run, request, work, conversion, again=early)
        write_beside(run, request, conversion)
    return conversion


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

    if format_of(str(request.output)) and not is_stream(str(request.output)):
        source = conversion.field.source
        run.compile(source.kernels(EVALUATE), source.kernel_type())
        read_back(run, str(request.output), conversion.gaussians, conversion.ply, conversion.field)
    if request.preview:
        with run.stage("preview"):
            write_png(request.preview, captioned(conversion.preview(), len(PREVIEW_VIEWS)), request.overwrite)
    run.finish()
    if request.report:
        write_text(request.report, run.report.to_json(), request.overwrite)
