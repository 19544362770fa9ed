"""Reading of Gaussians into the unit frame, and writing by a stage, to another place where writing fails."""

from __future__ import annotations

import math
import os
import secrets
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, BinaryIO

import numpy as np

from vvgt_cli.cameras import SIZE, Camera, default_views, spread_blocks
from vvgt_cli.conversion.place import to_box_frame
from vvgt_cli.conversion.request import HARMONIC_BYTES, VERTEX_BYTES
from vvgt_cli.errors import DataError, VvgtError
from vvgt_cli.files import atomic_write, check_disk_space, is_stream
from vvgt_cli.gaussians import Gaussians, PlyHeader, PlyOptions, in_unit_frame, read_ply, write_ply
from vvgt_cli.gaussians.formats import encoded, format_of, is_page, read_splats
from vvgt_cli.gaussians.formats.page_look import contents
from vvgt_cli.gaussians.formats.page_values import Values
from vvgt_cli.gaussians.formats.splats import gaussians_of
from vvgt_cli.gaussians.formats.streamed import StreamedLevels
from vvgt_cli.gaussians.frames import transform, up_matrix
from vvgt_cli.gaussians.outputs import STDOUT
from vvgt_cli.gaussians.ply import ply_header, ply_rows
from vvgt_cli.gaussians.rules import INRIA, Rule, rule_of
from vvgt_cli.score.record import Run
from vvgt_cli.score.viewing import PREVIEW_VIEWS
from vvgt_cli.score.views import score_test_views

if TYPE_CHECKING:
    from vvgt_cli.conversion.cut import FinishedParts
    from vvgt_cli.field.field import Field
    from vvgt_cli.volume import Volume


STDIN = STDOUT


def file_rule(header: PlyHeader, asked: str | None = None) -> Rule:
    """Return the drawing rule: the requested one, else the file's, else the default; raise UsageError if unknown."""
    return rule_of(asked or header.rule or INRIA)


def open_gaussians(source: str | BinaryIO, empty: bool = False) -> tuple[Gaussians, PlyHeader]:
    """Read Gaussians (a path, "-" for a `.ply` on standard input, or a stream of one) into the unit frame.

    Raises:
        DataError: not a file of Gaussians, or one without any, unless it may be ``empty``.
    """
    if isinstance(source, str) and source != STDIN:
        gaussians, header = read_splats(source)
    else:
        gaussians, header = read_ply(sys.stdin.buffer if isinstance(source, str) else source)
    if not (len(gaussians) or empty):
        raise DataError(f"{source}: holds no Gaussians; expected at least one")
    return in_unit_frame(gaussians, header), header


def shown_levels(manifest: Path) -> tuple[Callable[..., Gaussians], Gaussians, PlyHeader]:
    """Return what the engine shows of levels to a camera, the coarsest level (unit frame), and the header of all.

    The camera is in the unit frame, or in one that ``axes`` (3, 3) turn into it.
    """
    levels, name = StreamedLevels(manifest), str(manifest)
    coarsest, header = gaussians_of(replace(levels.level(str(levels.count - 1)), comments=levels.comments), name)
    turned = up_matrix(header.up)

    def seen(camera: Camera, axes: np.ndarray | None = None) -> Gaussians:
        field = math.degrees(2 * math.atan(min(camera.width / camera.fx, camera.height / camera.fy) / 2))
        eye = camera.position if axes is None else axes @ camera.position
        return in_unit_frame(*gaussians_of(levels.seen_from(turned @ eye, field), name))

    return seen, coarsest, header


def levels_in_box(manifest: str | Path, volume: Volume) -> Callable[[Camera], Gaussians]:
    """Return what the engine shows of a volume's levels to a camera in its box frame, in that frame."""
    seen, _, _ = shown_levels(Path(manifest))
    return lambda camera: to_box_frame(seen(camera, volume.axes), volume)


def layout_of(header: PlyHeader) -> PlyOptions:
    """Return the layout, place and comments of a file that was read, for writing another."""
    return PlyOptions(sh_degree=header.sh_degree, comments=header.version is not None, **header.facts())


def write_gaussians(
    run: Run,
    output: str,
    gaussians: Gaussians,
    options: PlyOptions,
    overwrite: bool,
    normals: np.ndarray | None = None,
    stage: str = "write",
    more: str = "",
    values: Values | None = None,
) -> None:
    """Write Gaussians in the format of the name, or as a `.ply` to standard output, and record the size.

    Args:
        run: gets the stage and the size.
        output: file, or "-".
        gaussians: Gaussians, unit frame.
        options: layout of the file.
        overwrite: replace an existing file.
        normals: (K, 3), for a `.ply`.
        stage: name of the stage.
        more: end of its message.
        values: of the volume, for a page.
    """
    report = run.report
    with run.stage(stage) as record:
        if output == STDOUT:
            report.bytes = write_ply(sys.stdout.buffer, gaussians, options, normals)
            sys.stdout.buffer.flush()
        else:
            report.bytes = write_file(output, gaussians, options, overwrite, normals, values)
        report.gaussians = len(gaussians)
        record.note = f"{output}: {len(gaussians)} Gaussians, {report.bytes / 1e6:.1f} MB{more}"
    if is_page(output) and not more:
        run.console.message(contents(options, output, values=values))


def write_parts(run: Run, output: str, parts: FinishedParts, overwrite: bool) -> None:
    """Write Gaussians that are on disk as a `.ply`, part by part, and record their number and bytes.

    Args:
        run: gets the stage.
        output: file, or "-".
        parts: Gaussians, box frame.
        overwrite: replace an existing file.
    """
    from vvgt_cli.closed_form.lit import directions

    plan, count = parts.cut.plan, len(parts)
    axes, degree = np.array(plan.axes).reshape(3, 3), plan.written_degree
    turned = np.linalg.inv(axes)
    if output != STDOUT:
        check_disk_space(output, count * (VERTEX_BYTES + HARMONIC_BYTES[degree]))
    with run.stage("write") as stage, _sink(output, overwrite) as sink:
        written = sink.write(ply_header(count, degree, plan.ply))
        for gaussians, normals in parts:
            normals = None if normals is None else directions(normals @ turned)
            written += sink.write(ply_rows(transform(gaussians, axes), plan.ply, normals).data)
        stage.note = f"{output}: {count} Gaussians, {written / 1e6:.1f} MB{parts.why_fewer()}"
    run.report.gaussians, run.report.bytes = count, written


@contextmanager
def _sink(output: str, overwrite: bool) -> Iterator[IO[bytes]]:
    """Yield a file to write to; once it is complete, it replaces the output or is copied to standard output."""
    if output == STDOUT:
        with tempfile.TemporaryFile() as sink:
            yield sink
            sink.seek(0)
            shutil.copyfileobj(sink, sys.stdout.buffer)
            sys.stdout.buffer.flush()
        return
    with atomic_write(output, overwrite) as temporary, open(temporary, "wb") as sink:
        yield sink


def write_file(
    output: str, gaussians: Gaussians, options: PlyOptions, overwrite: bool, normals: np.ndarray | None,
    values: Values | None,
) -> int:  # fmt: skip
    """Write a file and return its bytes; if that fails, save a `.ply` elsewhere, since the run may have taken hours."""
    known = format_of(output)
    if is_stream(output):
        with open(output, "ab") as stream:
            if known is None:
                return write_ply(stream, gaussians, options, normals)
            return stream.write(encoded(known, gaussians, options, output, values))
    try:
        with atomic_write(output, overwrite) as temporary:
            if known is None:
                return write_ply(temporary, gaussians, options, normals)
            return temporary.write_bytes(encoded(known, gaussians, options, output, values))
    except VvgtError as error:
        if known is None and isinstance(error, DataError) and not isinstance(error.__cause__, OSError):
            raise  # these Gaussians cannot be written anywhere
        place = _rescue(Path(output), gaussians, options, normals)
        if place is None:
            raise
        raise type(error)(f"{error}; the Gaussians were saved to {place}") from error


def _rescue(output: Path, gaussians: Gaussians, options: PlyOptions, normals: np.ndarray | None) -> Path | None:
    """Write a `.ply` to the temporary or the working folder, and return its path; None if both fail."""
    name = f"{output.stem[:80]}.{secrets.token_hex(4)}.ply"
    for find in (tempfile.gettempdir, os.getcwd):
        try:
            with atomic_write(Path(find(), name)) as temporary:
                write_ply(temporary, gaussians, options, normals)
            return Path(find(), name)
        except (OSError, VvgtError):
            continue
    return None


def read_back(
    run: Run, output: str, gaussians: Gaussians, options: PlyOptions, field: Field | None = None
) -> None:  # fmt: skip
    """Report how close pictures of a written file are to those of the Gaussians, unless it is a `.ply`.

    Args:
        run: gets a stage.
        output: the written file.
        gaussians: Gaussians before writing, unit frame.
        options: layout of the file.
        field: their volume; the loss of PSNR against its pictures is reported instead.
    """
    from vvgt_cli.images.metrics import psnr
    from vvgt_cli.splat import render

    if format_of(output) is None:
        return
    with run.stage("read back") as stage:
        clouds, size = (gaussians, in_unit_frame(*read_splats(output))), options.screen_size or SIZE
        rule, scores = rule_of(options.rule or INRIA), []
        if field is not None:
            before, after = (
                score_test_views(
                    field.views, to_box_frame(cloud, field.source.volume), size, rule=rule, every=False
                ).psnr
                for cloud in clouds
            )
            stage.note = (
                f"PSNR {after:.2f} dB, a .ply would have {before:.2f}: the format costs {before - after:.2f} dB"
            )
            return
        for i in PREVIEW_VIEWS:
            camera, blocks = default_views("test", size=size)[i], spread_blocks(size, size, i)
            both = [render(cloud, camera, rule, blocks=blocks)[..., :3] for cloud in clouds]
            scores.append(psnr(*(np.clip(image if blocks is None else blocks.pick(image), 0, 1) for image in both)))
        stage.note = f"{np.mean(scores):.2f} dB from the Gaussians before writing, {len(scores)} views of {size} px"
