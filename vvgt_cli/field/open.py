"""A volume's field, wherever its values are: in memory, or in blocks where it is asked for or quicker."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.errors import SeveralComponents, Unsuitable, UsageError
from vvgt_cli.field.blocked import Blocked, Pass
from vvgt_cli.field.counting import Counted
from vvgt_cli.field.digests import digest
from vvgt_cli.field.layered import NONE, Content, content_of, open_parts
from vvgt_cli.field.parts import Parts
from vvgt_cli.field.runners import Here, Processes, Runner
from vvgt_cli.field.settings import BlockOptions, block_edge
from vvgt_cli.field.source import Source, SourceRequest, describe_source, load
from vvgt_cli.gaussians.outputs import STDOUT
from vvgt_cli.jit.ahead import COUNT_REAL, COUNT_WHOLE
from vvgt_cli.look.label_files import holds_table
from vvgt_cli.progress import Console
from vvgt_cli.resources import free_memory
from vvgt_cli.score.record import Run
from vvgt_cli.version import VERSION
from vvgt_cli.volume import ReadOptions, Volume
from vvgt_cli.volume.label_maps import named_so
from vvgt_cli.volume.readers import SCHEMES, STEPPED
from vvgt_cli.volume.stored import Stored, is_file_backed

if TYPE_CHECKING:
    from vvgt_cli.field.cells import Reader

LAYOUT = 3  # of parts: one more whenever what is in them changes
HELD = 1 << 30  # bytes of values: more are processed in blocks, with a tenth of the memory (docs/log/blocks.md)
LARGE = 0.25  # of the free memory: a file of less is read as ever
PROGRAM, A_CELL = 3e8, 300  # bytes: interpreter, libraries and kernels; a base cell in memory
ZARR = {".zarray", ".zgroup", ".zattrs", "zarr.json", "attributes.json"}  # files of which a folder has one
INDEXES = (".pvti", ".pvd", ".series")  # of files elsewhere
PACKED = (
    ".h5",
    ".hdf5",
    ".he5",
    ".hdf",
    ".nc",
    ".ims",
    ".czi",
    ".nd2",
    ".vtkhdf",
)  # files of few bytes may hold many voxels
RANGES, LAYER_VOXEL = 0.15, 20  # bytes a voxel: the map of empty space, an optics grid
OWN = {"uint8": 0, "uint16": 0, "float32": 0, "int8": 1}  # bytes a voxel of the kernels' copy; others 4
LAYERED_BYTES = 60  # of a voxel of an optics grid while a block of it is there


@dataclass(frozen=True)
class Wanted:
    """What a field is opened for.

    Attributes:
        gaussians, size: budget, and pixels of the screen.
        degree: of harmonics that are asked for.
        most: base cells, None: as many as memory holds.
        values: it is to stand for any function, so the histogram of its values is needed, too.
    """

    gaussians: int
    size: int
    degree: int | None = None
    most: int | None = None
    values: bool = False


@contextmanager
def beside(output: str | None) -> Iterator[Parts]:
    """Where blocks are kept: beside the output, so that the same command goes on there after it was ended.

    They are removed where the same command would end the same way.
    """
    if output is None or output == STDOUT:
        with tempfile.TemporaryDirectory(prefix="vvgt-") as folder:
            yield Parts(Path(folder) / "blocks")
        return
    target = Path(output).absolute()
    parts = Parts(target.with_name(f".{target.name[:80]}.blocks"))
    try:
        yield parts
    except (UsageError, Unsuitable):
        parts.remove()
        raise


@contextmanager
def blocked(run: Run, request: SourceRequest, options: BlockOptions, parts: Parts, wanted: Wanted) -> Iterator[Blocked]:
    """A field in blocks; its workers end with the context, its parts stay.

    Raises:
        DataError, UsageError: as `vvgt_cli.field.source.load`; a pipe, or compressed values that can be read front to
            back only.
        Later: other shards' blocks are missing.
    """
    request, told = _settled(request, options, wanted.size)
    if told:
        run.console.say(told)
    settings = _settings(request, wanted)
    edge = parts.kept_edge(settings) if options.size is None else options.size
    edge = edge or _edge(request, options)
    with _runner(options) as runner:
        do = Pass(runner, parts, run.console.bar, options.shard)
        if parts.open({**settings, "blocks": edge}, ours=options.shard is None):
            run.console.say(f"going on with the blocks in {parts.folder}")
        run.compile(COUNT_WHOLE + COUNT_REAL)
        access = Counted(parts, edge, lambda task: do(task, "count"), wanted.values or needs_histogram(request))
        with run.stage("read") as stage:
            source = load(request, access)
            reader, visible = _reader(source, access)
            shared = f", {runner.workers} workers" if runner.workers > 1 else ""
            stage.note = f"{describe_source(source)}; in blocks of {edge}{shared}"
        key = digest(str(sorted(settings.items())))

        def look(other: Source) -> tuple[Source, Reader, float]:
            if other.layers[0].volume is not source.layers[0].volume:
                other = replace(other, statistics=access.statistics(other.volume))
            return other, *_reader(other, access)

        yield Blocked(source, reader, do, edge, visible, key, look)


def _edge(request: SourceRequest, options: BlockOptions) -> int:
    """Voxels along the edge of blocks, by the memory and what a voxel takes of it."""
    given, layered = request.volume, request.labels not in (None, NONE) or bool(request.layers)
    if isinstance(given, str):
        read = replace(request.read, stored=True, packed=True)
        content = open_parts(given, read)
        volume, layered = content.volumes[0], layered or not content.one_field
        layered |= request.tf is None and (holds_table(content.path) or named_so(volume))
    else:
        volume = content_of(given).volumes[0]
    return block_edge(volume, options, LAYERED_BYTES if layered else None)


def _settled(request: SourceRequest, options: BlockOptions, size: int) -> tuple[SourceRequest, str | None]:
    """The request as workers take it too: absolute paths, the level of a file that has several; and what to say."""
    if not isinstance(request.volume, str):
        return request, None
    path = request.volume
    if path == "-" or (os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path))):
        raise UsageError(f"{path}: a pipe is read front to back, once; blocks need a file")
    absolute = _absolute(path)
    layers = tuple(
        replace(layer, volume=_absolute(layer.volume)) if isinstance(layer.volume, str) else layer
        for layer in request.layers
    )
    read, told = _at_level(request.read, absolute, options, size)
    if isinstance(read.mask, str):
        read = replace(read, mask=str(Path(read.mask).absolute()))
    return replace(request, volume=absolute, read=read, layers=layers), told


def _absolute(path: str) -> str:
    """A path as other processes find it, too; a scheme's name is one already."""
    scheme = path.partition(":")[0] in SCHEMES and not os.path.exists(path)
    return path if scheme else str(Path(path).absolute())


def _reader(source: Source, access: Counted) -> tuple[Reader, float]:
    """What reads boxes of a source, and about how many of its voxels are visible."""
    from vvgt_cli.closed_form.samples import estimate, visible_share
    from vvgt_cli.dvr.scene import kernel_rule
    from vvgt_cli.field.reader import Layers, Scalars
    from vvgt_cli.look.tables import Optics, build_tables

    volume, frame = source.volume, source.volume.unit_frame()
    if not source.gridded:
        task, whole, numbers = access.counts(volume)
        rule = kernel_rule(volume, lambda: whole.stored)
        optics = build_tables(
            source.tf, (numbers.lo, numbers.hi), slope=rule.slope, intercept=rule.intercept,
            unit_distance=source.unit_distance, world_per_unit=1 / frame.scale,
            voxel=float(np.mean(frame.step)),
        )  # fmt: skip
        bricks, weights = task.samples()
        visible = estimate(visible_share(optics, rule.apply(bricks)), weights, volume.data.size)
        return Scalars(access.place(volume), rule, optics), visible
    top = sum(layer.largest for layer in source.layers) / frame.scale
    grid = replace(volume, data=np.zeros((1, 1, 1), np.uint8))
    places = tuple(tuple(map(access.place, (layer.volume, *(layer.colors or ())))) for layer in source.layers)
    layers = tuple(replace(layer, volume=grid, colors=None) for layer in source.layers)
    reader = Layers(layers, places, grid, volume.dims, frame.scale, Optics.linear(top))
    return reader, reader.visible()


def _at_level(read: ReadOptions, path: str, options: BlockOptions, size: int) -> tuple[ReadOptions, str | None]:
    """The level of a file of several: as asked for, else the coarsest whose voxels the screen cannot tell apart."""
    from vvgt_cli.cameras.sets import pixel_width
    from vvgt_cli.closed_form.closed_form import MIN_CELL
    from vvgt_cli.volume.registry import level_shapes

    shapes = level_shapes(path, read)
    if not shapes:
        if options.level is not None:
            raise UsageError(
                f"{path}: no OME-Zarr, N5 or Imaris image, which alone have levels; leave out --level {options.level}"
            )
        return read, None
    if options.level is not None:
        return replace(read, level=0 if options.level == "full" else int(options.level)), None
    fits = [n for n, shape in enumerate(shapes) if shape and 2 / max(shape) <= MIN_CELL * pixel_width(size)]
    level = max(fits, default=0)
    sizes = " x ".join(map(str, reversed(shapes[level])))
    return replace(read, level=level), f"level {level} of {len(shapes)} ({sizes}): finer ones the screen cannot tell"


def files_of(path: str) -> list[Path]:
    """The slices in a folder or of a glob; a file, or a folder of anything else, itself; none where nothing is."""
    from vvgt_cli.volume.tiff.slices import matching, slices_of

    if not os.path.exists(path):
        return matching(path)
    return (slices_of(Path(path)) if os.path.isdir(path) else []) or [Path(path)]


def automatic(request: SourceRequest, console: Console) -> BlockOptions | None:
    """Blocks where nothing is asked for: of a large volume or a lazy array; None: it is read as a whole.

    Raises:
        DataError, UsageError: as `read_volume`.
    """
    given = request.volume
    if not isinstance(given, str) and any(isinstance(one.data, Stored) for one in content_of(given).volumes):
        console.say("a Dask array: processed in blocks (docs/scale.md)")
        return BlockOptions()
    if not better_in_blocks(request):
        return None
    console.say("large: processed in blocks (docs/scale.md)")
    return BlockOptions()


def better_in_blocks(request: SourceRequest) -> bool:
    """Whether a volume in a file is large (`HELD`), or does not fit in memory with the rest.

    Raises:
        DataError, UsageError: as `read_volume`.
    """
    from vvgt_cli.closed_form.closed_form import MAX_BASE_CELLS

    path, free = request.volume, free_memory()
    if not isinstance(path, str) or path == "-":
        return False
    inside = not os.path.exists(path) and not files_of(path) and ":/" in path
    place = path.rpartition(":/")[0] if inside else path
    zarr = os.path.isdir(place) and ZARR & set(os.listdir(place))
    h5 = os.path.isfile(place) and place.lower().endswith(PACKED)
    files = files_of(place)
    tiff = files and files[0].suffix.lower() in (".tif", ".tiff")
    index = os.path.isfile(place) and place.lower().endswith(INDEXES)
    away = path.partition(":")[0] in STEPPED
    packed = away or zarr or h5 or tiff or index  # few bytes may hold many voxels
    size = sum(file.stat().st_size for file in files)
    if not packed and size < HELD and (free is None or size <= LARGE * free):
        return False
    try:
        content = open_parts(path, replace(request.read, stored=True, packed=True))
    except SeveralComponents:  # to be chosen: said where it is read
        return False
    volumes = content.volumes
    if not all(map(is_file_backed, volumes)):
        return False
    if sum(volume.data.nbytes for volume in volumes) >= HELD:
        return True
    if free is None:
        return False
    own = LAYER_VOXEL if len(volumes) > 1 else OWN.get(volumes[0].data.dtype.name, 4)
    held = sum(volume.data.nbytes for volume in volumes if isinstance(volume.data, Stored))
    voxels = volumes[0].data.size
    return held + (own + RANGES) * voxels + PROGRAM + A_CELL * min(voxels, MAX_BASE_CELLS) > free


def needs_histogram(request: SourceRequest) -> bool:
    """Whether a function follows from the histogram of the values, and not from their range alone."""
    from vvgt_cli.look import read_transfer_function

    if request.tf is None:
        return True
    given = [request.tf, *(layer.tf for layer in request.layers if layer.labels is None)]
    functions = [read_transfer_function(tf) if isinstance(tf, str) else tf for tf in given]
    return any(tf is None or tf.of_histogram for tf in functions)


def _runner(options: BlockOptions) -> Runner:
    threads = int(os.environ.get("NUMBA_NUM_THREADS", "1"))
    if options.scheduler is not None:
        from vvgt_cli.field.dask_runner import Dask

        return Dask(options.scheduler, options.workers, threads)
    return Processes(options.workers, threads) if options.workers > 1 else Here()


def _settings(request: SourceRequest, wanted: Wanted) -> dict[str, Any]:
    """All that parts depend on."""
    tf = request.tf
    text = Path(tf).read_text("utf-8", "replace") if isinstance(tf, str) and os.path.isfile(tf) else repr(tf)
    return {
        "version": [VERSION, LAYOUT],
        "volume": _facts(request.volume),
        "files": [_facts(path) for path in request.paths()],
        "read": {key: repr(value) for key, value in asdict(request.read).items() if value is not None},
        "function": [text, request.tf_range, request.unit_distance],
        "look": [repr(request.light), _facts(request.labels), *(repr(layer) for layer in request.layers)],
        "series": digest(*request.statistics),
        "gaussians": [wanted.gaussians, wanted.degree, wanted.most, wanted.values],
        "size": wanted.size,
    }


def _facts(volume: Any) -> list[Any]:
    """A file's name, size and time, or what else a volume or table is."""
    if not isinstance(volume, str):
        held = content_of(volume).volumes if isinstance(volume, Volume | Content) else ()
        return [digest(*(one.data for one in held)) if held else repr(volume)]
    outer = [name for name in (volume, volume.rpartition(":/")[0], volume.partition("#")[0]) if name]
    files = next((some for name in outer if (some := files_of(name))), [])
    whole = [inner for file in files for inner in (file.rglob("*") if file.is_dir() else (file,))]
    found = [file.stat() for file in whole]
    return [volume, sum(f.st_size for f in found), max(f.st_mtime_ns for f in found)] if found else [volume]
