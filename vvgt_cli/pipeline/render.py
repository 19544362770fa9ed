"""`render`: pictures of a `.ply`, and the view set that they were made with."""

from __future__ import annotations

import os
import secrets
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from vvgt_cli.cameras import Camera, orbit_views
from vvgt_cli.cameras.boxed import boxed
from vvgt_cli.cameras.files import read_cameras, transforms_json
from vvgt_cli.cameras.sets import SIZE
from vvgt_cli.errors import DataError, UsageError, VvgtError
from vvgt_cli.files import atomic_write, is_stream
from vvgt_cli.gaussians import Gaussians, PlyHeader, PlyOptions, in_unit_frame, read_ply, write_ply
from vvgt_cli.gaussians.frames import upright_matrix
from vvgt_cli.jit.ahead import DRAW
from vvgt_cli.pipeline.outputs import STDOUT, write_text
from vvgt_cli.pipeline.record import ConversionReport, Run
from vvgt_cli.progress import Console
from vvgt_cli.splat.rules import INRIA, Rule, rule_of
from vvgt_cli.volume.types import UnitFrame

STDIN = STDOUT
VIEWS_FILE = "transforms.json"


@dataclass(frozen=True)
class RenderRequest:
    """Pictures to make.

    Attributes:
        ply: Gaussians, "-" for standard input.
        output: directory for the images.
        camera: view-set file, or None.
        orbit: number of views on a circle around the file's way up, or None; one of the two is given.
        size: image height in pixels; None: the view set's own, or what the file is made for.
        rule: of `vvgt_cli.splat.rules` to draw by; None: the file's.
        exr: write EXR too.
        background: RGB in [0, 1] that PNGs stand on, None for transparent.
        overwrite: replace images that exist.
    """

    ply: str
    output: str
    camera: str | None = None
    orbit: int | None = None
    size: int | None = None
    rule: str | None = None
    exr: bool = False
    background: tuple[float, float, float] | None = None
    overwrite: bool = False

    def cameras(self, size: int | None = None, up: str = "none") -> list[Camera]:
        """The views asked for; of an orbit, ``size``: pixels where none are, ``up``: axis that it circles."""
        if self.camera is not None:
            return read_cameras(self.camera, self.size)
        cameras = orbit_views(self.orbit or 0, size=self.size or size or SIZE)
        return [boxed(camera, upright_matrix(up))[0] for camera in cameras]


def file_rule(header: PlyHeader, asked: str | None = None) -> Rule:
    """The rule to draw by: that asked for, else the file's, else the usual one.

    Raises:
        UsageError: no such rule.
    """
    return rule_of(asked or header.rule or INRIA)


def open_gaussians(source: str | BinaryIO, console: Console) -> tuple[Gaussians, PlyHeader]:
    """Read a `.ply` (a path, "-" for standard input, or a stream) into the unit frame, and say what was left out.

    Raises:
        DataError: not a 3DGS `.ply`, or one without Gaussians.
    """
    gaussians, header = read_ply(sys.stdin.buffer if source == STDIN else source)
    if not len(gaussians):
        raise DataError(f"{source}: holds no Gaussians; expected at least one")
    if header.sh_degree and not header.version:
        console.say(f"{source}: spherical harmonics of degree {header.sh_degree}; only the base colour is used")
    return in_unit_frame(gaussians, header), header


def layout_of(header: PlyHeader) -> PlyOptions:
    """What makes a file laid out, placed and commented as the one read was."""
    frame = None
    if header.scale is not None and header.centre is not None:
        frame = UnitFrame(header.scale, (1, 1, 1), (1, 1, 1), header.centre)  # of which scale and centre are written
    return PlyOptions(
        frame=header.frame,
        up=header.up,
        sh_degree=header.sh_degree,
        comments=header.version is not None,
        unit_frame=frame,
        unit_distance=header.unit_distance,
        unit_distance_label=header.unit_distance_label or "given",
        made_for=header.made_for,
        rule=header.rule,
        space=header.space or "none",
        affine=header.affine,
    )


def write_gaussians(run: Run, output: str, gaussians: Gaussians, options: PlyOptions, overwrite: bool) -> None:
    """The stage that writes a `.ply`, or standard output for "-", and records its size."""
    report = run.report
    with run.stage("write") as stage:
        if output == STDOUT:
            report.bytes = write_ply(sys.stdout.buffer, gaussians, options)
            sys.stdout.buffer.flush()
        else:
            report.bytes = _write_file(output, gaussians, options, overwrite)
        report.gaussians = len(gaussians)
        stage.note = f"{output}: {len(gaussians)} Gaussians, {report.bytes / 1e6:.1f} MB"


def _write_file(output: str, gaussians: Gaussians, options: PlyOptions, overwrite: bool) -> int:
    """Write a `.ply`; where that fails, put it elsewhere and say so: it may have taken hours."""
    if is_stream(output):
        with open(output, "ab") as stream:
            return write_ply(stream, gaussians, options)
    try:
        with atomic_write(output, overwrite) as temporary:
            return write_ply(temporary, gaussians, options)
    except VvgtError as error:
        if isinstance(error, DataError) and not isinstance(error.__cause__, OSError):
            raise  # these Gaussians cannot be written anywhere
        place = _elsewhere(Path(output), gaussians, options)
        if place is None:
            raise
        raise type(error)(f"{error}; what was computed lies in {place}") from error


def _elsewhere(output: Path, gaussians: Gaussians, options: PlyOptions) -> Path | None:
    """Write a `.ply` to the temporary folder, else to the working folder; where it is, None where neither takes it."""
    name = f"{output.stem[:80]}.{secrets.token_hex(4)}.ply"
    for find in (tempfile.gettempdir, os.getcwd):
        try:
            with atomic_write(Path(find(), name)) as temporary:
                write_ply(temporary, gaussians, options)
            return Path(find(), name)
        except (OSError, VvgtError):
            continue
    return None


def _check_directory(request: RenderRequest, names: list[str]) -> None:
    directory = Path(request.output)
    if directory.exists() and not directory.is_dir():
        raise UsageError(f"-o {directory}: is a file; expected a directory for the images")
    if not directory.parent.is_dir():
        raise UsageError(f"-o {directory}: no directory {directory.parent}; make it first")
    if request.overwrite:
        return
    for name in names:
        if (directory / name).exists():
            raise UsageError(f"-o {directory}: {name} exists; choose another directory or pass --overwrite")


def render_file(request: RenderRequest, console: Console | None = None) -> int:
    """Write one PNG (and EXR) a view and `transforms.json`; returns the number of views.

    Raises:
        UsageError: an image exists, or the directory cannot be.
        DataError: a `.ply` or view set that is not one.
    """
    from vvgt_cli.images import over, write_exr, write_png
    from vvgt_cli.splat import render

    console = console or Console()
    run = Run(console, ConversionReport("render"))
    cameras = request.cameras()
    names = [f"{c.name}.png" for c in cameras] + ([f"{c.name}.exr" for c in cameras] if request.exr else [])
    _check_directory(request, [*names, VIEWS_FILE])
    with run.stage("read") as stage:
        gaussians, header = open_gaussians(request.ply, console)
        stage.note = f"{len(gaussians)} Gaussians, {header.frame} frame"
    cameras, rule = request.cameras(header.made_for, header.up), file_rule(header, request.rule)
    run.compile(DRAW)
    directory = Path(request.output)
    directory.mkdir(exist_ok=True)
    with run.stage("render") as stage:
        bar = console.bar("render")
        for done, camera in enumerate(cameras, 1):
            image = render(gaussians, camera, rule)
            if request.exr:
                write_exr(directory / f"{camera.name}.exr", image, camera=camera, overwrite=request.overwrite)
            shown = image if request.background is None else over(image, request.background)
            write_png(directory / f"{camera.name}.png", shown, request.overwrite)
            if bar:
                bar(done, len(cameras))
        write_text(str(directory / VIEWS_FILE), transforms_json(cameras), request.overwrite)
        stage.note = (
            f"{len(cameras)} views of {cameras[0].width} x {cameras[0].height} px by {rule.name} in {directory}"
        )
    return len(cameras)
