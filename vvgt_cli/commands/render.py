"""`render`: pictures or a movie of Gaussians as viewers draw them, or of a volume by the ray caster."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.cameras import Camera, orbit_views
from vvgt_cli.cameras.boxed import render_in_box, to_box_frame
from vvgt_cli.cameras.files import read_cameras, transforms_json
from vvgt_cli.cameras.sets import SIZE
from vvgt_cli.commands.render_views import draw_in_blocks
from vvgt_cli.conversion.gaussian_files import file_rule, open_gaussians
from vvgt_cli.conversion.grey import MIP, NAMES, XRAY, Draw, draw_gaussians, grey
from vvgt_cli.conversion.recolored import FunctionRequest, recolored
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.field.grid import Boxes
from vvgt_cli.field.open import FieldNeeds, automatic, blocked, store_beside
from vvgt_cli.field.rays import HALO
from vvgt_cli.field.reader import Box, Scalars
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.field.source import Source, SourceRequest, describe_source, load
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians import Gaussians, PlyHeader, in_unit_frame
from vvgt_cli.gaussians.formats.levels import StreamedLevels, by_view
from vvgt_cli.gaussians.formats.splats import gaussians_of
from vvgt_cli.gaussians.frames import up_matrix, upright_matrix
from vvgt_cli.gaussians.outputs import Output, check_outputs, write_text
from vvgt_cli.images.compose import BLACK
from vvgt_cli.jit.ahead import DRAW, GREATEST, GREY, RAYCAST, for_blocks, for_degree
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.tables import Optics, exposed_distance
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run
from vvgt_cli.volume import Statistics
from vvgt_cli.volume.space import shear_text

VIEWS_FILE, PICTURE = "transforms.json", ".png"
Seen = Callable[[Camera], Gaussians]  # what a camera is shown
Part = tuple[Box, np.ndarray, np.ndarray]  # voxels with a halo; the first one (3,) without it, and the end, (x, y, z)
MIP_RAYS, MIP_STEP = 2, 0.25  # rays along a pixel's edge, and voxels between their samples


@dataclass(frozen=True)
class RenderRequest:
    """Pictures to draw.

    Attributes:
        given: file of Gaussians, "-" for standard input, of streamed levels those that the name selects
            (`vvgt_cli.gaussians.formats.levels`); or a volume with its look.
        output: directory for the images, one picture (`PICTURE`), or a movie by its ending
            (`SUFFIXES`).
        camera: view-set file, or None.
        orbit: number of views on a circle around the up axis, or None; not both. A single picture needs neither.
        size: image height in pixels; None: the view set's own, or what the Gaussians are made for.
        rule: one of `vvgt_cli.gaussians.rules` to draw Gaussians by, or of `vvgt_cli.conversion.grey.NAMES`, also for a
            volume; None: the Gaussians' file's.
        exr: write EXR too.
        background: RGB in [0, 1] behind the pictures, None for transparent PNGs and black movies.
        overwrite: replace images that exist.
        function: look to show live Gaussians under; None: the look of the file.
        blocks: how a volume is processed in blocks; None: in memory, or in blocks if it is large.
    """

    given: str | SourceRequest
    output: str
    camera: str | None = None
    orbit: int | None = None
    size: int | None = None
    rule: str | None = None
    exr: bool = False
    background: tuple[float, float, float] | None = None
    overwrite: bool = False
    function: FunctionRequest | None = None
    blocks: BlockOptions | None = None

    @property
    def single(self) -> bool:
        """Return whether the output is one picture."""
        return Path(self.output).suffix.lower() == PICTURE

    @property
    def movie(self) -> bool:
        """Return whether the output is a movie."""
        return Path(self.output).suffix.lower() in SUFFIXES

    def cameras(self, size: int | None = None, up: str = "none") -> list[Camera]:
        """Return the views; ``size`` (pixels) and ``up`` (axis to circle) are an orbit's defaults.

        Raises:
            UsageError: no views are given, or several for one picture.
        """
        if (self.camera is None) == (self.orbit is None) and not (self.single and self.camera is None):
            raise UsageError("give the views with either --camera FILE or --orbit N, or one picture, as -o out.png")
        if self.camera is not None:
            cameras = read_cameras(self.camera, self.size)
        else:
            cameras = orbit_views(self.orbit or 1, size=self.size or size or SIZE)
        if self.single and len(cameras) > 1:
            raise UsageError(f"-o {self.output}: one picture of {len(cameras)} views; expected a directory")
        if self.camera is not None:
            return cameras
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
    """Write one PNG (and EXR) per view and `transforms.json`, one picture, or a movie; return the number of views.

    Raises:
        UsageError: an image exists, or the directory cannot be made.
        DataError: Gaussians, a volume or a view set that are not valid, or a missing library for movies.
    """
    console = console or Console()
    run = Run(console, ConversionReport("render"))
    cameras = request.cameras()
    if request.rule in NAMES and request.background is not None:
        raise UsageError(f"--background: pictures of --rule {request.rule} are opaque; omit it")
    if request.movie and request.exr:
        raise UsageError(f"--exr writes pictures, -o {request.output} is a movie; give only one of the two")
    if request.movie or request.single:
        inputs = [request.given] if isinstance(request.given, str) else request.given.paths()
        floats = [Output("--exr", str(Path(request.output).with_suffix(".exr")))] if request.exr else []
        check_outputs([Output("-o", request.output), *floats], inputs, request.overwrite)
    else:
        names = [f"{c.name}.png" for c in cameras] + ([f"{c.name}.exr" for c in cameras] if request.exr else [])
        _check_directory(request, [*names, VIEWS_FILE])
    if request.movie:
        movie_ready(request.output)
    with ExitStack() as stack:
        if isinstance(request.given, str):
            draw, cameras, by = _gaussians(run, request, request.given)
        else:
            draw, by = _volume(run, request, request.given, cameras, stack)
        with run.stage("render") as stage:
            note = (_movie if request.movie else _pictures)(request, console, draw, cameras)
            stage.note = f"{len(cameras)} views of {cameras[0].width} x {cameras[0].height} px by {by} in {note}"
    return len(cameras)


def _gaussians(run: Run, request: RenderRequest, name: str) -> tuple[Draw, list[Camera], str]:
    """Return the renderer of Gaussians, the views in their file's orientation, and the name of the rule."""
    from vvgt_cli.splat import render

    if request.rule in NAMES:
        with run.stage("read") as stage:
            gaussians, header = open_gaussians(name)
            stage.note = f"{len(gaussians)} Gaussians, {header.frame} frame"
        draw = draw_gaussians(name, gaussians, header, request.rule, request.function)
        run.compile(GREY)
        return draw, request.cameras(header.made_for, header.up), request.rule
    with run.stage("read") as stage:
        seen, gaussians, header = _opened(request, name)
        stage.note = f"{len(gaussians)} Gaussians, {header.frame} frame"
    rule = file_rule(header, request.rule)
    run.compile(for_degree(DRAW, gaussians.degree))
    return lambda camera: render(seen(camera), camera, rule), request.cameras(header.made_for, header.up), rule.name


def _volume(
    run: Run, request: RenderRequest, asked: SourceRequest, cameras: list[Camera], stack: ExitStack
) -> tuple[Draw, str]:
    """Return the ray caster of a volume, in memory or in blocks, and its name; ``stack`` closes the blocks."""
    from vvgt_cli.dvr import RenderSettings, render_view

    settings, options = RenderSettings(), request.blocks or automatic(asked, run.console)
    if options is not None:
        needs = FieldNeeds(1, cameras[0].height, values=request.rule == XRAY)
        found = stack.enter_context(blocked(run, asked, options, stack.enter_context(store_beside(None)), needs))
        source = _upright(found.source)
        if request.rule == MIP:
            run.compile(GREATEST, source.kernel_type())
            return render_in_box(mip_of(found), source.volume.axes), "MIP in blocks"
        if request.rule == XRAY:
            found = found.with_look(as_xray(source))
            source = found.source
        run.compile(for_blocks(source.kernels(RAYCAST)), source.kernel_type())
        draw = draw_in_blocks(found, settings, cameras)
        return (absorbed(draw), "X-ray in blocks") if request.rule else (draw, "ray casting in blocks")
    with run.stage("read") as stage:
        source = _upright(load(asked))
        stage.note = describe_source(source)
    if request.rule == MIP:
        run.compile(GREATEST, source.kernel_type())
        return render_in_box(mip_of(source), source.volume.axes), "MIP"
    if request.rule == XRAY:
        source = as_xray(source)
    run.compile(source.kernels(RAYCAST), source.kernel_type())
    scene = source.scene()
    draw = render_in_box(lambda camera: render_view(scene, camera, settings), source.volume.axes)
    return (absorbed(draw), "X-ray") if request.rule else (draw, "ray casting")


def _upright(source: Source) -> Source:
    """Refuse a sheared volume, which no pinhole camera sees."""
    if source.volume.sheared:
        text = shear_text(source.volume.axes)
        raise DataError(f"{source.volume.name}: {text}; expected right angles: 'vvgt convert' accepts it")
    return source


def _opened(request: RenderRequest, name: str) -> tuple[Seen, Gaussians, PlyHeader]:
    """Return the Gaussians for a camera, those for all cameras or the coarsest level, and the header."""
    manifest = by_view(name)
    if manifest is None:
        gaussians, header = open_gaussians(name)
        gaussians = recolored(name, gaussians, header, request.function)
        return lambda camera: gaussians, gaussians, header
    levels = StreamedLevels(manifest)
    coarsest, header = gaussians_of(levels.level(str(levels.count - 1)), name)
    turned = up_matrix(header.up)

    def seen(camera: Camera) -> Gaussians:
        field = math.degrees(2 * math.atan(min(camera.width / camera.fx, camera.height / camera.fy) / 2))
        return in_unit_frame(*gaussians_of(levels.seen_from(turned @ camera.position, field), name))

    return seen, recolored(name, coarsest, header, request.function), header


def _pictures(request: RenderRequest, console: Console, draw: Draw, cameras: list[Camera]) -> str:
    """Write PNG and EXR, and `transforms.json` beside several; return the directory or file."""
    from vvgt_cli.images import over, write_exr, write_png

    where = Path(request.output)
    if not request.single:
        where.mkdir(exist_ok=True)
    bar = console.bar("render")
    for done, camera in enumerate(cameras, 1):
        image = draw(camera)
        path = where if request.single else where / f"{camera.name}.png"
        if request.exr:
            write_exr(path.with_suffix(".exr"), image, camera=camera, overwrite=request.overwrite)
        shown = image if request.background is None else over(image, request.background)
        write_png(path, shown, request.overwrite)
        if bar:
            bar(done, len(cameras))
    if not request.single:
        write_text(str(where / VIEWS_FILE), transforms_json(cameras), request.overwrite)
    return str(where)


def _movie(request: RenderRequest, console: Console, draw: Draw, cameras: list[Camera]) -> str:
    """Write one movie, and return its name and what it holds; raise UsageError for views of several sizes."""
    from vvgt_cli.images import over

    if len({(camera.width, camera.height) for camera in cameras}) > 1:
        raise UsageError(f"-o {request.output}: views of several sizes; a movie has one: give --size")
    bar = console.bar("render")

    def pictures() -> Iterator[np.ndarray]:
        for done, camera in enumerate(cameras, 1):
            yield over(draw(camera), request.background or BLACK)
            if bar:
                bar(done, len(cameras))

    size = write_movie(request.output, pictures(), request.overwrite)
    return f"{request.output}: {len(cameras) / RATE:.1f} s, {size / 1e6:.2f} MB"


def as_xray(source: Source) -> Source:
    """Return a volume under the extinction of its X-ray, unlit; raise UsageError for an optics grid."""
    source.require_scalar_field()
    layer = source.layers[0]
    assert isinstance(layer.tf, TransferFunction)
    distance = exposed_distance(layer.tf, source.statistics, 2 / source.volume.unit_frame().scale)
    return replace(source, layers=(replace(layer, unit_distance=distance),), lighting=None)


def absorbed(draw: Draw) -> Draw:
    """Return the function that draws what is absorbed in the pictures of ``draw``."""
    return lambda camera: grey(draw(camera)[..., 3])


def mip_of(field: Blocked | Source) -> Draw:
    """Return the function that draws the MIP of a volume in blocks or in memory, for cameras in its box frame.

    Raises:
        UsageError: labels, channels or layers.
    """
    source = field.source if isinstance(field, Blocked) else field
    source.require_scalar_field()
    if isinstance(field, Blocked):
        return lambda camera: grey(_greatest(source, _blocks(field), camera))
    from vvgt_cli.dvr.scene import kernel_values

    values, slope, intercept = kernel_values(source.volume)
    whole = Box(values, None, _of_range(source.statistics, slope, intercept), np.zeros(3, np.int64))
    part = whole, whole.begin, np.array(source.volume.dims)
    return lambda camera: grey(_greatest(source, [part], camera))


def _blocks(field: Blocked) -> Iterator[Part]:
    """Yield the blocks of a volume."""
    reader, volume = field.reader, field.source.volume
    assert isinstance(reader, Scalars)
    optics = _of_range(field.source.statistics, reader.rule.slope, reader.rule.intercept)
    blocks = Boxes(volume.dims, (field.edge, field.edge, field.edge))
    for number in range(len(blocks)):
        lo, hi = blocks.at(number)
        box = reader.box(np.maximum(lo - HALO, 0), np.minimum(hi + HALO, volume.dims))
        yield replace(box, optics=optics), lo, hi


def _greatest(source: Source, parts: Iterable[Part], camera: Camera) -> np.ndarray:
    """Return the mean over a pixel of the greatest values along its rays, (h, w) float32 of the range of values."""
    from vvgt_cli.dvr.march import greatest
    from vvgt_cli.dvr.render import Box as Frame
    from vvgt_cli.dvr.render import camera_arrays

    n, frame, dims = MIP_RAYS, source.volume.unit_frame(), np.array(source.volume.dims)
    larger = replace(
        camera, fx=n * camera.fx, fy=n * camera.fy, cx=n * camera.cx, cy=n * camera.cy,
        width=n * camera.width, height=n * camera.height,
    )  # fmt: skip
    rays = camera_arrays(Frame(np.array(frame.half), np.array(frame.step)), larger)
    out = np.zeros((larger.height, larger.width), np.float32)
    for box, lo, hi in parts:
        faces = np.stack([np.where(lo == 0, -np.inf, lo - 0.5), np.where(hi == dims, np.inf, hi - 0.5), dims])
        greatest(box.voxels, box.optics, faces, box.begin.astype(np.float64), *rays, MIP_STEP, out)
    mean: np.ndarray = out.reshape(camera.height, n, camera.width, n).mean(axis=(1, 3))
    return mean


def _of_range(statistics: Statistics, slope: float, intercept: float) -> Optics:
    """Return tables whose coordinate goes from 0 to 1 over the range of data values."""
    width = (statistics.hi - statistics.lo) or 1.0
    return Optics.linear(1.0)._replace(lo=(statistics.lo - intercept) / slope, inv_width=slope / width)


SUFFIXES = (".gif", ".mp4")
RATE = 25  # pictures per second: 4 hundredths each, which GIF can represent
_QUALITY = "18"  # of x264: visually almost lossless
_MOST = 1 << 16  # colours that a palette is computed from
_COLORS, _SAMPLES, _ROUNDS = 256, 16, 3  # size of a GIF's palette, pictures sampled for it, rounds of clustering


def movie_ready(path: str | Path) -> None:
    """Check that a movie of this name can be written; raise DataError if a library that it needs is not installed."""
    if Path(path).suffix.lower() == ".mp4":
        _ffmpeg(str(path))


def write_movie(path: str | Path, pictures: Iterable[np.ndarray], overwrite: bool = False) -> int:
    """Write pictures as a looping movie, and return its size in bytes.

    Args:
        path: a file that ends in one of `SUFFIXES`.
        pictures: (h, w, 3) float32 RGB in [0, 1] (clipped), at least one, all of the same size.
        overwrite: replace an existing file.

    Raises:
        DataError: the library fails or is not installed, or the file cannot be written.
        UsageError: the file exists and ``overwrite`` is not set.
    """
    frames = (np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8) for picture in pictures)
    with atomic_write(path, overwrite) as temporary:
        (_gif if Path(path).suffix.lower() == ".gif" else _mp4)(temporary, frames)
        return temporary.stat().st_size


def _gif(path: Path, frames: Iterator[np.ndarray]) -> None:
    """Write a GIF that loops forever, with one palette for all pictures, so that static parts do not flicker."""
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    some = [np.asarray(image).reshape(-1, 3) for image in images[:: max(len(images) // _SAMPLES, 1)]]
    colors = np.unique(np.concatenate(some), axis=0)  # each once, so that the background does not dominate
    colors = colors[:: max(len(colors) // _MOST, 1)]
    palette = Image.fromarray(colors[None]).quantize(_COLORS, Image.Quantize.MEDIANCUT, kmeans=_ROUNDS)
    drawn = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    drawn[0].save(path, save_all=True, append_images=drawn[1:], duration=1000 // RATE, loop=0, optimize=False)


def _ffmpeg(source: str) -> Any:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise DataError(
            f"{source}: .mp4 needs imageio_ffmpeg ({error}); try: pip install 'vvgt[share]', or .gif"
        ) from None
    return imageio_ffmpeg


def _mp4(path: Path, frames: Iterator[np.ndarray]) -> None:
    """Write H.264 that all players support: 4:2:0, with the last row or column repeated to get even sizes."""
    library, writer = _ffmpeg(str(path)), None
    try:
        for frame in frames:
            height, width = frame.shape[:2]
            even = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            if writer is None:
                writer = library.write_frames(
                    str(path), (even.shape[1], even.shape[0]), fps=RATE, codec="libx264", macro_block_size=2,
                    output_params=["-crf", _QUALITY, "-movflags", "+faststart"], ffmpeg_log_level="error",
                )  # fmt: skip
                writer.send(None)
            writer.send(np.ascontiguousarray(even))
    except (OSError, RuntimeError) as error:
        raise DataError(f"{path.name}: ffmpeg failed ({' '.join(str(error).split())[:200]})") from None
    finally:
        if writer is not None:
            writer.close()
