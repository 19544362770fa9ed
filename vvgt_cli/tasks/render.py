"""`render`: pictures of a `.ply`, and the view set that they were made with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from vvgt_cli.cameras import Camera, orbit_views
from vvgt_cli.cameras.boxed import boxed
from vvgt_cli.cameras.files import read_cameras, transforms_json
from vvgt_cli.cameras.sets import SIZE
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.frames import upright_matrix
from vvgt_cli.jit.ahead import DRAW, for_degree
from vvgt_cli.progress import Console
from vvgt_cli.runs.gaussian_files import file_rule, open_gaussians
from vvgt_cli.runs.outputs import write_text
from vvgt_cli.runs.record import ConversionReport, Run

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
        gaussians, header = open_gaussians(request.ply)
        stage.note = f"{len(gaussians)} Gaussians, {header.frame} frame"
    cameras, rule = request.cameras(header.made_for, header.up), file_rule(header, request.rule)
    run.compile(for_degree(DRAW, gaussians.degree))
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
