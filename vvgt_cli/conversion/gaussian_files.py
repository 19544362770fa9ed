"""Gaussians in and out of a run: read into the unit frame, written by a stage, kept elsewhere where writing fails."""

from __future__ import annotations

import os
import secrets
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from vvgt_cli.errors import DataError, VvgtError
from vvgt_cli.files import atomic_write, is_stream
from vvgt_cli.gaussians import Gaussians, PlyHeader, PlyOptions, in_unit_frame, read_ply, write_ply
from vvgt_cli.gaussians.formats import encoded, format_of, read_splats
from vvgt_cli.gaussians.formats.page_live import page_of_several
from vvgt_cli.gaussians.outputs import STDOUT
from vvgt_cli.gaussians.rules import INRIA, Rule, rule_of
from vvgt_cli.score.record import Run

STDIN = STDOUT


def file_rule(header: PlyHeader, asked: str | None = None) -> Rule:
    """The rule to draw by: that asked for, else the file's, else the usual one.

    Raises:
        UsageError: no such rule.
    """
    return rule_of(asked or header.rule or INRIA)


def open_gaussians(source: str | BinaryIO) -> tuple[Gaussians, PlyHeader]:
    """Read Gaussians (a path, "-" for a `.ply` on standard input, or a stream of one) into the unit frame.

    Raises:
        DataError: not a file of Gaussians, or one without any.
    """
    if isinstance(source, str) and source != STDIN:
        gaussians, header = read_splats(source)
    else:
        gaussians, header = read_ply(sys.stdin.buffer if isinstance(source, str) else source)
    if not len(gaussians):
        raise DataError(f"{source}: holds no Gaussians; expected at least one")
    return in_unit_frame(gaussians, header), header


def layout_of(header: PlyHeader) -> PlyOptions:
    """What makes a file laid out, placed and commented as the one read was."""
    told = header.facts() | {"date": None}  # of what was written then
    return PlyOptions(sh_degree=header.sh_degree, comments=header.version is not None, **told)


def write_gaussians(
    run: Run,
    output: str,
    gaussians: Gaussians,
    options: PlyOptions,
    overwrite: bool,
    normals: np.ndarray | None = None,
    stage: str = "write",
    more: str = "",
) -> None:
    """The stage that writes Gaussians in the format of the name, to standard output as a `.ply`; records the size.

    ``normals`` (K, 3) are of a `.ply`. The stage is called ``stage``, and there may be ``more`` to say of it.
    """
    report = run.report
    with run.stage(stage) as record:
        if output == STDOUT:
            report.bytes = write_ply(sys.stdout.buffer, gaussians, options, normals)
            sys.stdout.buffer.flush()
        else:
            report.bytes = _write_file(output, gaussians, options, overwrite, normals)
        report.gaussians = len(gaussians)
        record.note = f"{output}: {len(gaussians)} Gaussians, {report.bytes / 1e6:.1f} MB{more}"


def is_page(output: str | None) -> bool:
    """Whether an output is a page, which takes several clouds."""
    known = None if output in (None, STDOUT) else format_of(str(output))
    return known is not None and known.suffix == ".html"


def write_page(run: Run, output: str, clouds: Sequence[tuple[str, str]], overwrite: bool) -> None:
    """The stage that writes several files of Gaussians as one page.

    Args:
        run: gets the stage and the size.
        output: the page.
        clouds: (name in the page's list, file) of each.
        overwrite: replace it if it exists.

    Raises:
        DataError: a file that is none of Gaussians, or no file.
    """
    if not clouds:
        raise DataError(f"{output}: nothing is visible in any of what it was to show; try another function")
    with run.stage("write") as stage:
        shown: list[tuple[str, Gaussians, PlyOptions]] = []
        rules = set[str]()
        for name, file in clouds:
            gaussians, header = open_gaussians(file)
            rules.add(header.rule or INRIA.name)
            shown.append((name, gaussians, layout_of(header)))
            run.report.gaussians += len(gaussians)
        with atomic_write(output, overwrite) as temporary:
            run.report.bytes = temporary.write_bytes(page_of_several(shown, output))
        if len(rules) > 1:
            run.console.message(
                f"{output}: made for {', '.join(sorted(rules))}; the page draws all as it draws the first"
            )
        stage.note = (
            f"{output}: {len(clouds)} clouds, {run.report.gaussians} Gaussians, {run.report.bytes / 1e6:.1f} MB"
        )


def _write_file(
    output: str, gaussians: Gaussians, options: PlyOptions, overwrite: bool, normals: np.ndarray | None
) -> int:
    """Write a file; where that fails, put a `.ply` elsewhere and say so: it may have taken hours."""
    if is_stream(output):
        with open(output, "ab") as stream:
            return write_ply(stream, gaussians, options, normals)
    known = format_of(output)
    try:
        with atomic_write(output, overwrite) as temporary:
            if known is None:
                return write_ply(temporary, gaussians, options, normals)
            return temporary.write_bytes(encoded(known, gaussians, options, output))
    except VvgtError as error:
        if known is None and isinstance(error, DataError) and not isinstance(error.__cause__, OSError):
            raise  # these Gaussians cannot be written anywhere
        place = _rescue(Path(output), gaussians, options, normals)
        if place is None:
            raise
        raise type(error)(f"{error}; what was computed lies in {place}") from error


def _rescue(output: Path, gaussians: Gaussians, options: PlyOptions, normals: np.ndarray | None) -> Path | None:
    """Write a `.ply` to the temporary folder, else to the working folder; where it is, None where neither takes it."""
    name = f"{output.stem[:80]}.{secrets.token_hex(4)}.ply"
    for find in (tempfile.gettempdir, os.getcwd):
        try:
            with atomic_write(Path(find(), name)) as temporary:
                write_ply(temporary, gaussians, options, normals)
            return Path(find(), name)
        except (OSError, VvgtError):
            continue
    return None
