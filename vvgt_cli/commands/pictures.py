"""Pictures or a movie of Gaussians as viewers draw them, or of a volume by the ray caster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.cameras import Camera, orbit_views
from vvgt_cli.cameras.files import read_cameras, transforms_json
from vvgt_cli.cameras.sets import SIZE
from vvgt_cli.cameras.types import camera_in_box, render_in_box
from vvgt_cli.commands.view_sets import draw_views
from vvgt_cli.conversion.frames import FrameSeries, is_glob_of_volumes
from vvgt_cli.conversion.gaussian_files import file_rule, open_gaussians, shown_levels
from vvgt_cli.conversion.index import FRAMES, frame_facts, is_pattern, put_name
from vvgt_cli.conversion.manifest import Shard
from vvgt_cli.conversion.opened import opened_upright
from vvgt_cli.conversion.recolored import MIP, NAMES, XRAY, Draw, draw_gaussians, grey, recolored
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import DataError, SeveralSteps, UsageError
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.field.field import Field, Resident
from vvgt_cli.field.grid import Boxes
from vvgt_cli.field.open import FieldNeeds
from vvgt_cli.field.rays import HALO
from vvgt_cli.field.reader import Scalars, VoxelBox
from vvgt_cli.field.settings import BlockOptions
from vvgt_cli.field.source import SourceRequest, StyledVolume
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians import Gaussians, PlyHeader
from vvgt_cli.gaussians.formats.streamed import by_view
from vvgt_cli.gaussians.frames import upright_matrix
from vvgt_cli.gaussians.outputs import Output, check_folder, check_outputs, write_text
from vvgt_cli.images.compose import BLACK
from vvgt_cli.jit.ahead import DRAW, GREATEST, GREY, RAYCAST, for_degree
from vvgt_cli.library.inputs import PathLike
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.tables import Optics, exposed_distance
from vvgt_cli.progress import Console
from vvgt_cli.score.record import Run
from vvgt_cli.volume import Statistics
from vvgt_cli.volume.libraries import need
from vvgt_cli.volume.readers import is_glob

VIEWS_FILE, PICTURE = "transforms.json", ".png"
Seen = Callable[[Camera], Gaussians]  # what a camera is shown
Part = tuple[VoxelBox, np.ndarray, np.ndarray]  # voxels with a halo; the first (3,) without it, and the end, (x, y, z)
MIP_RAYS, MIP_STEP = 2, 0.25  # rays along a pixel's edge, and voxels between their samples


@dataclass(frozen=True)
class Drawing:
    """What to draw, from where, and into which files: arguments of `vvgt_cli.render`.

    Attributes:
        source: files of Gaussians, None for an empty frame, or volumes; several are frames.
        function: look of live Gaussians; None: the file's.
        facts: step, time and stem of each frame, for places in the output's name, as far as its input states them.
    """

    source: tuple[str | None, ...] | SourceRequest
    function: SourceRequest | None
    blocks: BlockOptions | None
    output: str
    camera: PathLike | None
    orbit: int | None
    size: int | None
    rule: str | None
    exr: bool
    background: Sequence[float] | None
    overwrite: bool
    facts: Sequence[Mapping[str, Any]] = ({},)

    @property
    def png(self) -> bool:
        """Whether the output is one picture, or numbered ones."""
        return Path(self.output).suffix.lower() == PICTURE

    @property
    def movie(self) -> bool:
        """Whether the output is a movie."""
        return Path(self.output).suffix.lower() in SUFFIXES

    def views(self, frames: int, size: int | None = None, up: str = "none") -> list[list[Camera]]:
        """Return the views of each frame; ``size`` (pixels) and ``up`` (axis to circle) are an orbit's defaults.

        Several views are shared evenly among the frames, in their order; all frames have a single one in common.

        Raises:
            UsageError: no views are given, several for one picture, or fewer than frames.
        """
        still = self.camera is None and (self.png or frames > 1)
        if (self.camera is None) == (self.orbit is None) and not still:
            raise UsageError(
                "give the views with either --camera FILE or --orbit N, or one picture, as -o out.png, or a series for "
                "a movie, as 'run_*.vti'"
            )
        if self.camera is not None:
            cameras = read_cameras(os.fspath(self.camera), self.size)
        else:
            circle = orbit_views(self.orbit or 1, size=self.size or size or SIZE)
            cameras = [camera_in_box(camera, upright_matrix(up))[0] for camera in circle]
        if self.png and len(cameras) > 1 and not is_pattern(self.output):
            raise UsageError(f"-o {self.output}: one picture of {len(cameras)} views; expected a directory")
        cameras *= frames if len(cameras) == 1 else 1
        if len(cameras) < frames:
            raise UsageError(
                f"{len(cameras)} views of {frames} frames; expected a view of each, as --orbit {frames}, or one of all"
            )
        ends = [k * len(cameras) // frames for k in range(frames + 1)]
        return [cameras[a:b] for a, b in pairwise(ends)]

    def files(self, cameras: list[Camera]) -> list[str]:
        """Return the movie, or the picture of each view."""
        if self.movie:
            return [self.output]
        if not self.png:
            return [str(Path(self.output, f"{camera.name}{PICTURE}")) for camera in cameras]
        if not is_pattern(self.output):
            return [self.output] * len(cameras)
        frames = [((k + 1) * len(self.facts) - 1) // len(cameras) for k in range(len(cameras))]  # as of `views`
        return [put_name("-o", self.output, FRAMES, str(k), self.facts[frame]) for k, frame in enumerate(frames)]

    def check(self, frames: int) -> list[list[Camera]]:
        """Return the views of frames yet to be read; raise UsageError or DataError for bad options or outputs."""
        where = Path(self.output)
        if self.rule in NAMES and self.background is not None:
            raise UsageError(f"--background: pictures of --rule {self.rule} are opaque; omit it")
        if self.movie and self.exr:
            raise UsageError(f"--exr writes pictures, -o {where} is a movie; give only one of the two")
        if frames > 1 and not (self.movie or (self.png and is_pattern(self.output))):
            raise UsageError(
                f"-o {where}: got {frames} frames; expected a movie, as -o time.gif or -o time.mp4, or a picture of "
                "each, as -o 'out_{:04d}.png' (or --time N for one time step of a file)"
            )
        shares = self.views(frames)
        cameras = list(chain(*shares))
        files = self.files(cameras)
        if self.movie and len({(camera.width, camera.height) for camera in cameras}) > 1:
            raise UsageError(f"-o {where}: views of several sizes; a movie has one: give --size")
        outputs = [Output("-o", file) for file in files]
        outputs += [Output("--exr", str(Path(file).with_suffix(".exr"))) for file in files if self.exr]
        if where.suffix.lower() == ".mp4":
            _ffmpeg(str(where))
        if not (self.movie or self.png):
            check_folder(where, "images")
            outputs.append(Output("-o", str(where / VIEWS_FILE)))
        if self.movie or self.png or where.is_dir():
            inputs = self.source.paths() if isinstance(self.source, SourceRequest) else list(filter(None, self.source))
            check_outputs(outputs, inputs, self.overwrite)
        return shares


def draw_files(run: Run, request: Drawing) -> int:
    """Write one PNG (and EXR) per view and `transforms.json`, single pictures, or a movie; return the number of views.

    Errors are those of `vvgt_cli.render`.
    """
    given = request.source
    if not isinstance(given, SourceRequest):
        return _render(run, replace(request, facts=frame_facts(given)), given)
    file = given.volume if isinstance(given.volume, str) else ""
    over_time = request.movie and request.camera is None and request.orbit is None and not is_glob(file)
    if not file or not (over_time or is_glob_of_volumes(given)):
        try:
            return _render(run, replace(request, facts=frame_facts([file or None])), [given])
        except SeveralSteps:  # which are the frames
            pass
    series = FrameSeries(ConvertRequest(given, request.output, blocks=request.blocks), Shard())
    facts = [series.places(stem) for stem in series.stems]
    return _render(run, replace(request, facts=facts), series.sources(), series)


def _render(
    run: Run, request: Drawing, frames: Sequence[str | SourceRequest | None], series: FrameSeries | None = None
) -> int:  # fmt: skip
    """Draw all frames, of volumes as ``series`` prepares them, one in memory at a time; return the number of views."""
    shares = request.check(len(frames))
    if series is not None and len(frames) > 1:
        series.prepare(run)
        request, frames = replace(request, blocks=series.request.blocks), series.sources()
    with ExitStack() as stack:
        start = next((given, share) for given, share in zip(frames, shares, strict=True) if given is not None)
        draw, by, first = _frame(run, request, *start, stack)
        if first is not None:
            shares = request.views(len(frames), first.screen_size, first.up)
        cameras, opened = list(chain(*shares)), [draw]
        del draw

        def pictures() -> Iterator[np.ndarray]:
            bar, done, shown = run.console.bar("render"), 0, len(frames) == 1
            quiet, blank = Run(Console(quiet=True), run.report), _blank(request.rule)
            for given, share in zip(frames, shares, strict=True):
                if given is None:
                    draw = blank
                else:
                    draw = opened.pop() if opened else _frame(quiet, request, given, share, stack, first)[0]
                for camera in share:
                    picture = draw(camera)
                    yield picture
                    shown, done = shown or bool(picture[..., 3].any()), done + 1
                    if bar:
                        bar(done, len(cameras))
                del draw
                stack.close()
            if not shown:
                raise DataError(f"nothing is visible in any of {len(frames)} frames; try another function")

        with run.stage("render") as stage:
            note = (_movie if request.movie else _pictures)(request, pictures(), cameras)
            stage.note = f"{len(cameras)} views of {cameras[0].width} x {cameras[0].height} px by {by} in {note}"
    return len(cameras)


def _blank(rule: str | None) -> Draw:
    """Return the renderer of a frame that holds nothing: transparent, or black where ``rule`` draws opaque pictures."""
    opaque = float(rule in NAMES)
    return lambda camera: np.tile(np.array([0, 0, 0, opaque], np.float32), (camera.height, camera.width, 1))


def _frame(
    run: Run, request: Drawing, source: str | SourceRequest, cameras: list[Camera], stack: ExitStack,
    first: PlyHeader | None = None,
) -> tuple[Draw, str, PlyHeader | None]:  # fmt: skip
    """Return the renderer of a frame, its name, and the header of Gaussians; ``first`` is that of the first frame."""
    if isinstance(source, SourceRequest):
        return (*_volume(run, request, source, cameras, stack), None)
    with run.stage("read") as stage:
        seen, gaussians, header = _opened(request, source, first)
        stage.note = f"{len(gaussians)} Gaussians, {header.frame} frame"
    if request.rule in NAMES:
        edge = 2.0 * header.scale / first.scale if first and first.scale and header.scale else 2.0
        draw, by = draw_gaussians(source, gaussians, header, request.rule, request.function, edge), request.rule
        run.compile(GREY)
    else:
        from vvgt_cli.splat import render

        rule = file_rule(first or header, request.rule)
        run.compile(for_degree(DRAW, gaussians.degree))
        draw, by = lambda camera: render(seen(camera), camera, rule), rule.name
    return _placed(draw, source, header, first), by, header


def _in_range(name: str, header: PlyHeader, first: PlyHeader) -> PlyHeader:
    """Return the header with the histograms of the first file's values, or raise DataError if they differ in range."""
    if first.live is None or header.live is None or not first.live.shown_like(header.live):
        raise DataError(
            f"{name}: its values have another range or function than those of the first frame; expected frames that "
            "'vvgt convert --live' makes of one series"
        )
    pairs = zip(header.live.layers, first.live.layers, strict=True)
    own, *others = [replace(layer, histogram=same.histogram) for layer, same in pairs]
    return replace(header, live=replace(own, others=tuple(others)))


def _placed(draw: Draw, name: str, header: PlyHeader, first: PlyHeader | None) -> Draw:
    """Return the renderer of a file's Gaussians for cameras in the unit frame of the first file, if both are known.

    Raises:
        DataError: the files' worlds have different axes or units.
    """
    if first is None or not (first.scale and first.centre and header.scale and header.centre):
        return draw
    for one, other in ((header.space, first.space), (header.length_unit, first.length_unit)):
        if one and other and one != other:
            raise DataError(f"{name}: positions in {one}; expected {other}, as in the first frame")
    factor, offset = first.scale / header.scale, first.scale * np.subtract(header.centre, first.centre)
    return lambda camera: draw(replace(camera, translation=(camera.rotation @ offset + camera.translation) / factor))


def _volume(
    run: Run, request: Drawing, asked: SourceRequest, cameras: list[Camera], stack: ExitStack
) -> tuple[Draw, str]:
    """Return the ray caster of a volume, in memory or in blocks, and its name; ``stack`` closes the blocks."""
    from vvgt_cli.dvr import RenderSettings

    mip, xray = request.rule == MIP, request.rule == XRAY
    needs, kernels = FieldNeeds(1, cameras[0].height, values=xray), GREATEST if mip else RAYCAST
    look: dict[str, Any] = {"look": as_xray} if xray else {}
    field = stack.enter_context(opened_upright(run, asked, request.blocks, needs, kernels, **look))
    where = " in blocks" if isinstance(field, Blocked) else ""
    if mip:
        return render_in_box(mip_of(field), field.source.volume.axes), f"MIP{where}"
    if xray and isinstance(field, Blocked):
        field = field.with_look(field.source)
    draw = draw_views(field, RenderSettings(), cameras)
    return ((lambda camera: grey(draw(camera)[..., 3])), f"X-ray{where}") if xray else (draw, f"ray casting{where}")


def _opened(request: Drawing, name: str, first: PlyHeader | None) -> tuple[Seen, Gaussians, PlyHeader]:
    """Return the Gaussians for a camera, those for all or the coarsest level, and the header; a frame may be empty."""
    manifest, function = by_view(name), None if request.rule in NAMES else request.function
    if manifest is None:
        several = isinstance(request.source, tuple) and len(request.source) > 1
        gaussians, header = open_gaussians(name, empty=several)
        if first is not None and (request.rule in NAMES or request.function is not None):
            header = _in_range(name, header, first)
        if function is not None:
            gaussians, _ = recolored(name, gaussians, header, function, empty=several)
        return lambda camera: gaussians, gaussians, header
    seen, coarsest, header = shown_levels(manifest)
    return seen, coarsest if function is None else recolored(name, coarsest, header, function)[0], header


def _pictures(request: Drawing, pictures: Iterator[np.ndarray], cameras: list[Camera]) -> str:
    """Write PNG and EXR, and `transforms.json` beside those in a directory; return the output."""
    from vvgt_cli.images import over, write_exr, write_png

    where = Path(request.output)
    if not request.png:
        where.mkdir(exist_ok=True)
    for file, camera, image in zip(request.files(cameras), cameras, pictures, strict=True):
        if request.exr:
            write_exr(Path(file).with_suffix(".exr"), image, camera=camera, overwrite=request.overwrite)
        write_png(file, image if request.background is None else over(image, request.background), request.overwrite)
    if not request.png:
        write_text(str(where / VIEWS_FILE), transforms_json(cameras), request.overwrite)
    return str(where)


def _movie(request: Drawing, pictures: Iterator[np.ndarray], cameras: list[Camera]) -> str:
    """Write one movie, and return its name and what it holds."""
    from vvgt_cli.images import over

    rate = SLOW if cameras[0] is cameras[-1] else RATE
    shown = (over(picture, request.background or BLACK) for picture in pictures)
    size = write_movie(request.output, shown, request.overwrite, rate)
    return f"{request.output}: {len(cameras) / rate:.1f} s, {size / 1e6:.2f} MB"


def as_xray(source: StyledVolume) -> StyledVolume:
    """Return a volume under the extinction of its X-ray, unlit; raise UsageError for an optics grid."""
    source.require_scalar_field()
    layer = source.layers[0]
    assert isinstance(layer.tf, TransferFunction)
    distance = exposed_distance(layer.tf, source.overall, 2 / source.volume.unit_frame().scale)
    return replace(source, layers=(replace(layer, unit_distance=distance),), lighting=None)


def mip_of(field: Field) -> Draw:
    """Return the function that draws the MIP of a volume, for cameras in its box frame.

    Raises:
        UsageError: labels, channels or layers.
    """
    source = field.source
    source.require_scalar_field()
    if isinstance(field, Blocked):
        return lambda camera: grey(_greatest(source, _blocks(field), camera))
    assert isinstance(field, Resident)
    optics = _of_range(source.overall, field.layout.slope, field.layout.intercept)
    whole = VoxelBox(field.layout.values, None, optics, np.zeros(3, np.int64))
    part = whole, whole.begin, np.array(source.volume.dims)
    return lambda camera: grey(_greatest(source, [part], camera))


def _blocks(field: Blocked) -> Iterator[Part]:
    """Yield the blocks of a volume."""
    reader, volume = field.reader, field.source.volume
    assert isinstance(reader, Scalars)
    optics = _of_range(field.source.overall, reader.rule.slope, reader.rule.intercept)
    blocks = Boxes(volume.dims, (field.edge, field.edge, field.edge))
    for number in range(len(blocks)):
        lo, hi = blocks.at(number)
        box = reader.box(np.maximum(lo - HALO, 0), np.minimum(hi + HALO, volume.dims))
        yield replace(box, optics=optics), lo, hi


def _greatest(source: StyledVolume, parts: Iterable[Part], camera: Camera) -> np.ndarray:
    """Return the mean over a pixel of the greatest values along its rays, (h, w) float32 of the range of values."""
    from vvgt_cli.dvr.march import greatest
    from vvgt_cli.dvr.render import BoxFrame, camera_arrays

    n, frame, dims = MIP_RAYS, source.volume.unit_frame(), np.array(source.volume.dims)
    larger = camera.resized(n)
    rays = camera_arrays(BoxFrame(np.array(frame.half), np.array(frame.step)), larger)
    out = np.zeros((larger.height, larger.width), np.float32)
    for box, lo, hi in parts:
        faces = np.stack([np.where(lo == 0, -np.inf, lo - 0.5), np.where(hi == dims, np.inf, hi - 0.5), dims])
        greatest(box.voxels, box.optics, faces, box.begin.astype(np.float64), *rays, MIP_STEP, out)
    return out.reshape(camera.height, n, camera.width, n).mean(axis=(1, 3))


def _of_range(statistics: Statistics, slope: float, intercept: float) -> Optics:
    """Return tables whose coordinate goes from 0 to 1 over the range of data values."""
    width = (statistics.hi - statistics.lo) or 1.0
    return Optics.linear(1.0)._replace(lo=(statistics.lo - intercept) / slope, inv_width=slope / width)


SUFFIXES = (".gif", ".mp4")
RATE, SLOW = 25, 5  # pictures per second, a hundredth times 4 and 20, which GIF can represent; SLOW is as pages play
_QUALITY = "18"  # of x264: visually almost lossless
_MOST = 1 << 16  # colours that a palette is computed from
_COLORS, _SAMPLES, _ROUNDS = 256, 16, 3  # size of a GIF's palette, pictures sampled for it, rounds of clustering


def write_movie(path: str | Path, pictures: Iterable[np.ndarray], overwrite: bool = False, rate: int = RATE) -> int:
    """Write pictures as a looping movie, and return its size in bytes.

    Args:
        path: a file that ends in one of `SUFFIXES`.
        pictures: (h, w, 3) float32 RGB in [0, 1] (clipped), at least one, all of the same size.
        overwrite: replace an existing file.
        rate: pictures per second.

    Raises:
        DataError: the library fails or is not installed, or the file cannot be written.
        UsageError: the file exists and ``overwrite`` is not set.
    """
    frames = (np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8) for picture in pictures)
    with atomic_write(path, overwrite) as temporary:
        (_gif if Path(path).suffix.lower() == ".gif" else _mp4)(temporary, frames, rate)
        return temporary.stat().st_size


def _gif(path: Path, frames: Iterator[np.ndarray], rate: int) -> None:
    """Write a GIF that loops forever, with one palette for all pictures, so that static parts do not flicker."""
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    some = [np.asarray(image).reshape(-1, 3) for image in images[:: max(len(images) // _SAMPLES, 1)]]
    colors = np.unique(np.concatenate(some), axis=0)  # each once, so that the background does not dominate
    colors = colors[:: max(len(colors) // _MOST, 1)]
    palette = Image.fromarray(colors[None]).quantize(_COLORS, Image.Quantize.MEDIANCUT, kmeans=_ROUNDS)
    if not colors[0].any():  # clusters are means, of which none is black
        entries = np.array(palette.getpalette(), np.uint8).reshape(-1, 3)
        entries[entries.sum(axis=1).argmin()] = 0
        palette.putpalette(entries.ravel().tolist())
    drawn = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    drawn[0].save(path, save_all=True, append_images=drawn[1:], duration=1000 // rate, loop=0, optimize=False)


def _ffmpeg(source: str) -> Any:
    return need("imageio_ffmpeg", "share", source, ".mp4, unlike .gif,")


def _mp4(path: Path, frames: Iterator[np.ndarray], rate: int) -> None:
    """Write H.264 that all players support: 4:2:0, with the last row or column repeated to get even sizes."""
    library, writer = _ffmpeg(str(path)), None
    try:
        for frame in frames:
            height, width = frame.shape[:2]
            even = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            if writer is None:
                writer = library.write_frames(
                    str(path), (even.shape[1], even.shape[0]), fps=rate, codec="libx264", macro_block_size=2,
                    output_params=["-crf", _QUALITY, "-movflags", "+faststart"], ffmpeg_log_level="error",
                )  # fmt: skip
                writer.send(None)
            writer.send(np.ascontiguousarray(even))
    except (OSError, RuntimeError) as error:
        raise DataError(f"{path.name}: ffmpeg failed ({' '.join(str(error).split())[:200]})") from None
    finally:
        if writer is not None:
            writer.close()
