"""`render`: pictures or a movie of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vvgt_cli.cameras import Camera, orbit_views
from vvgt_cli.cameras.boxed import to_box_frame
from vvgt_cli.cameras.files import read_cameras, transforms_json
from vvgt_cli.cameras.sets import SIZE
from vvgt_cli.conversion.gaussian_files import file_rule, open_gaussians
from vvgt_cli.conversion.recolored import FunctionRequest, recolored
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians import Gaussians, PlyHeader, in_unit_frame
from vvgt_cli.gaussians.formats.levels import StreamedLevels, by_view
from vvgt_cli.gaussians.formats.splats import gaussians_of
from vvgt_cli.gaussians.frames import up_matrix, upright_matrix
from vvgt_cli.gaussians.outputs import Output, check_outputs, write_text
from vvgt_cli.gaussians.rules import Rule
from vvgt_cli.images.compose import BLACK
from vvgt_cli.images.movies import RATE, SUFFIXES, movie_ready, write_movie
from vvgt_cli.jit.ahead import DRAW, for_degree
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run

VIEWS_FILE = "transforms.json"
Seen = Callable[[Camera], Gaussians]  # what a camera is shown


@dataclass(frozen=True)
class RenderRequest:
    """Pictures to draw.

    Attributes:
        ply: Gaussians, "-" for standard input; of streamed levels those that the name selects
            (`vvgt_cli.gaussians.formats.levels`).
        output: directory for the images, or a movie by its ending (`vvgt_cli.images.movies.SUFFIXES`).
        camera: view-set file, or None.
        orbit: number of views on a circle around the file's up axis, or None; one of the two is given.
        size: image height in pixels; None: the view set's own, or what the file is made for.
        rule: one of `vvgt_cli.gaussians.rules` to draw by; None: the file's.
        exr: write EXR too.
        background: RGB in [0, 1] behind the pictures, None for transparent PNGs and black movies.
        overwrite: replace images that exist.
        function: look to show live Gaussians under; None: the look of the file.
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
    function: FunctionRequest | None = None

    @property
    def movie(self) -> bool:
        """Return whether the output is a movie."""
        return Path(self.output).suffix.lower() in SUFFIXES

    def cameras(self, size: int | None = None, up: str = "none") -> list[Camera]:
        """Return the views; ``size`` (pixels) and ``up`` (axis to circle) are an orbit's defaults."""
        if self.camera is not None:
            return read_cameras(self.camera, self.size)
        cameras = orbit_views(self.orbit or 0, size=self.size or size or SIZE)
        return [to_box_frame(camera, upright_matrix(up))[0] for camera in cameras]


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
    """Write one PNG (and EXR) per view and `transforms.json`, or a movie of the views; return their number.

    Raises:
        UsageError: an image exists, or the directory cannot be made.
        DataError: Gaussians or a view set that are not valid, or a missing library for movies.
    """
    console = console or Console()
    run = Run(console, ConversionReport("render"))
    cameras = request.cameras()
    if request.movie:
        if request.exr:
            raise UsageError(f"--exr writes pictures, -o {request.output} is a movie; give only one of the two")
        check_outputs([Output("-o", request.output)], [request.ply], request.overwrite)
        movie_ready(request.output)
    else:
        names = [f"{c.name}.png" for c in cameras] + ([f"{c.name}.exr" for c in cameras] if request.exr else [])
        _check_directory(request, [*names, VIEWS_FILE])
    with run.stage("read") as stage:
        seen, gaussians, header = _opened(request)
        stage.note = f"{len(gaussians)} Gaussians, {header.frame} frame"
    cameras, rule = request.cameras(header.made_for, header.up), file_rule(header, request.rule)
    run.compile(for_degree(DRAW, gaussians.degree))
    with run.stage("render") as stage:
        note = (_movie if request.movie else _pictures)(request, console, seen, cameras, rule)
        stage.note = f"{len(cameras)} views of {cameras[0].width} x {cameras[0].height} px by {rule.name} in {note}"
    return len(cameras)


def _opened(request: RenderRequest) -> tuple[Seen, Gaussians, PlyHeader]:
    """Return the Gaussians for a camera, those for all cameras or the coarsest level, and the header."""
    manifest = by_view(request.ply)
    if manifest is None:
        gaussians, header = open_gaussians(request.ply)
        gaussians = recolored(request.ply, gaussians, header, request.function)
        return lambda camera: gaussians, gaussians, header
    levels = StreamedLevels(manifest)
    coarsest, header = gaussians_of(levels.level(str(levels.count - 1)), request.ply)
    turned = up_matrix(header.up)

    def seen(camera: Camera) -> Gaussians:
        field = math.degrees(2 * math.atan(min(camera.width / camera.fx, camera.height / camera.fy) / 2))
        return in_unit_frame(*gaussians_of(levels.seen_from(turned @ camera.position, field), request.ply))

    return seen, recolored(request.ply, coarsest, header, request.function), header


def _pictures(request: RenderRequest, console: Console, seen: Seen, cameras: list[Camera], rule: Rule) -> str:
    """Write PNG, EXR and `transforms.json`; return the directory."""
    from vvgt_cli.images import over, write_exr, write_png
    from vvgt_cli.splat import render

    directory = Path(request.output)
    directory.mkdir(exist_ok=True)
    bar = console.bar("render")
    for done, camera in enumerate(cameras, 1):
        image = render(seen(camera), camera, rule)
        if request.exr:
            write_exr(directory / f"{camera.name}.exr", image, camera=camera, overwrite=request.overwrite)
        shown = image if request.background is None else over(image, request.background)
        write_png(directory / f"{camera.name}.png", shown, request.overwrite)
        if bar:
            bar(done, len(cameras))
    write_text(str(directory / VIEWS_FILE), transforms_json(cameras), request.overwrite)
    return str(directory)


def _movie(request: RenderRequest, console: Console, seen: Seen, cameras: list[Camera], rule: Rule) -> str:
    """Write one movie; return its name and what it holds.

    Raises:
        UsageError: views of several sizes.
    """
    from vvgt_cli.images import over
    from vvgt_cli.splat import render

    if len({(camera.width, camera.height) for camera in cameras}) > 1:
        raise UsageError(f"-o {request.output}: views of several sizes; a movie has one: give --size")
    bar = console.bar("render")

    def pictures() -> Iterator[np.ndarray]:
        for done, camera in enumerate(cameras, 1):
            yield over(render(seen(camera), camera, rule), request.background or BLACK)
            if bar:
                bar(done, len(cameras))

    size = write_movie(request.output, pictures(), request.overwrite)
    return f"{request.output}: {len(cameras) / RATE:.1f} s, {size / 1e6:.2f} MB"
