"""Opening a volume's field in blocks, on request or where that is faster or needs less memory."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.errors import SeveralComponents, Unsuitable, UsageError
from vvgt_cli.field.block_store import BlockStore
from vvgt_cli.field.blocked import Blocked, Pass
from vvgt_cli.field.counting import BlockAccess
from vvgt_cli.field.digests import digest
from vvgt_cli.field.field import Field, Resident
from vvgt_cli.field.grid import TILE_VOXELS
from vvgt_cli.field.layered import OpenedFile, content_of
from vvgt_cli.field.runners import Processes, Runner
from vvgt_cli.field.settings import BlockOptions, block_bytes, block_edge, worker_count
from vvgt_cli.field.source import SourceRequest, StyledVolume, describe_source, load
from vvgt_cli.field.workload import PROGRAM
from vvgt_cli.files import write_arrays
from vvgt_cli.gaussians.outputs import STDOUT
from vvgt_cli.jit.ahead import COUNT_REAL, COUNT_WHOLE, for_blocks
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.labels import NO_LABELS
from vvgt_cli.look.lighting import PICTURES
from vvgt_cli.progress import Console
from vvgt_cli.resources import free_memory
from vvgt_cli.score.record import Run
from vvgt_cli.version import VERSION
from vvgt_cli.volume import ReadOptions, Volume
from vvgt_cli.volume.label_maps import named_so
from vvgt_cli.volume.medical.masks import mask_files
from vvgt_cli.volume.readers import SCHEMES, STEPPED
from vvgt_cli.volume.stored import Stored, is_file_backed, planes

if TYPE_CHECKING:
    from vvgt_cli.field.cells import Reader

LAYOUT = 10  # version of the stored blocks: increase it whenever their content changes
MIN_BLOCKED = 1 << 30  # bytes of values: more are processed in blocks, with a tenth of the memory (docs/log/blocks.md)
LARGE = 0.25  # share of the free memory: smaller files are always read whole
CELL_BYTES = 300  # of a base cell in memory
ZARR = {".zarray", ".zgroup", ".zattrs", "zarr.json", "attributes.json"}  # a Zarr or N5 folder has one of these
INDEXES = (".pvti", ".pvd", ".series", ".xml")  # files that name other files
# compressed: small files may hold many voxels
PACKED = (".h5", ".hdf5", ".he5", ".hdf", ".nc", ".ims", ".czi", ".nd2", ".vtkhdf")
RANGES, LAYER_VOXEL = 0.15, 24  # bytes per voxel: the map of empty space, an optics grid (`dvr.layers.VOXEL_BYTES`)
OWN = {"uint8": 0, "uint16": 0, "float32": 0, "int8": 1}  # bytes per voxel of the kernels' copy; other types 4
LAYERED_BYTES = 80  # per voxel of an optics grid while a block is in memory


@dataclass(frozen=True)
class FieldNeeds:
    """The purpose that a field is opened for, which its stored blocks depend on.

    Attributes:
        gaussians: budget of Gaussians.
        size: edge of the screen in pixels.
        degree: degree of spherical harmonics that was requested.
        on_disk: base cells stay on disk, so that there may be more than fit in memory.
        values: Gaussians will carry values for any function, which needs the histogram as well.
    """

    gaussians: int
    size: int
    degree: int | None = None
    on_disk: bool = False
    values: bool = False


@contextmanager
def store_beside(output: str | None) -> Iterator[BlockStore]:
    """Provide a block store next to the output to resume from, removed after errors that would only repeat."""
    if output is None or output == STDOUT:
        with tempfile.TemporaryDirectory(prefix="vvgt-") as folder:
            yield BlockStore(Path(folder) / "blocks")
        return
    target = Path(output).absolute()
    store = BlockStore(target.with_name(f".{target.name[:80]}.blocks"))
    try:
        yield store
    except (UsageError, Unsuitable):
        store.remove()
        raise


def thread_count() -> int:
    """Return the number of threads that the commands set, 1 outside of them."""
    return int(os.environ.get("NUMBA_NUM_THREADS", "1"))


@contextmanager
def blocked(
    run: Run, request: SourceRequest, options: BlockOptions, store: BlockStore, needs: FieldNeeds
) -> Iterator[Blocked]:
    """Open a field in blocks; its workers end with the context, its stored blocks stay.

    Raises:
        DataError, UsageError: see `vvgt_cli.field.source.load`; also for a pipe, or compressed values that can only
            be read from front to back.
        MissingBlocks: other shards' blocks are missing.
    """
    request, message = _resolved(request, options, needs.size)
    if message:
        run.console.message(message)
    settings = _settings(request, needs)
    edge = store.kept_edge(settings) if options.size is None else options.size
    volume, voxel = _measured(request)
    threads = thread_count()
    most = threads if isinstance(request.volume, str) else 1  # values in memory would be copied to each worker
    least = block_bytes(volume, 1 << TILE_VOXELS, voxel)
    options = replace(options, workers=worker_count(options, volume.data.size, needs.gaussians, most, least))
    edge = edge or block_edge(volume, options, voxel)
    with runner_of(options, threads) as runner:
        run_pass = Pass(runner, store, run.console.bar, options.shard)
        if store.open({**settings, "blocks": edge}, ours=options.shard is None):
            run.console.message(f"resuming with the blocks in {store.folder}")
        request = _with_body(request, store)
        run.compile(COUNT_WHOLE + COUNT_REAL)
        access = BlockAccess(
            store, edge, lambda task: run_pass(task, "count"), needs.values or needs_histogram(request)
        )
        with run.stage("read") as stage:
            source = load(request, access)
            reader, visible = _reader(source, access)
            shared = f", {runner.workers} workers" if runner.workers > 1 else ""
            stage.note = f"{describe_source(source)}; in blocks of {edge}{shared}"
        key = digest(str(sorted(settings.items())))

        def look(other: StyledVolume) -> tuple[StyledVolume, Reader, float]:
            if other.layers[0].volume is not source.layers[0].volume:
                other = replace(other, statistics=access.statistics(other.volume))
            return other, *_reader(other, access)

        yield Blocked(source, reader, run_pass, edge, visible, key, look)


@contextmanager
def opened(
    run: Run, request: SourceRequest, options: BlockOptions | None, needs: FieldNeeds,
    kernels: Callable[[StyledVolume, bool], tuple[str, ...]], store: AbstractContextManager[BlockStore] | None = None,
    device: str = "cpu", look: Callable[[StyledVolume], StyledVolume] = lambda source: source, at_once: bool = True,
) -> Iterator[Field]:  # fmt: skip
    """Open a volume under its look as a field, in memory, or in blocks if it is large.

    Args:
        run: gets the stages.
        request: volume and look.
        options: block options; None: in blocks only if the volume is large (`automatic`).
        needs: purpose of the field.
        kernels: returns the kernels to compile for a source, which may be in blocks.
        store: provides the store of blocks; None for a temporary one.
        device: "cpu" or "cuda", which renders a volume in memory.
        look: changes the source before kernels are compiled.
        at_once: lay a volume in memory out for the kernels, and trace its light, now, not on first use.

    Raises:
        DataError, UsageError: see `vvgt_cli.field.source.load`.
        MissingBlocks: other shards' blocks are missing.
    """
    from vvgt_cli.field.reader import Layers

    options = options or automatic(request, run.console)
    if options is None:
        with run.stage("read") as stage:
            source = look(load(request))
            stage.note = describe_source(source)
        run.compile(kernels(source, False), source.kernel_type())
        field = Resident(source, device=device, report=run.console.message)
        if at_once:
            with run.stage("scene"):
                _ = field.scene
        yield field
        return
    with store or store_beside(None) as blocks, blocked(run, request, options, blocks, needs) as in_blocks:
        in_blocks.source = look(in_blocks.source)
        if isinstance(in_blocks.reader, Layers):  # under the light that the look has
            in_blocks.reader = replace(in_blocks.reader, smooth=in_blocks.source.smooth)
        run.compile(for_blocks(kernels(in_blocks.source, True)), in_blocks.source.kernel_type())
        yield in_blocks


def _measured(request: SourceRequest) -> tuple[Volume, int | None]:
    """Return the volume, its values still in the file, and bytes per voxel where they are not those of its type."""
    content, layered = request.content(stored=True), request.labels not in (None, NO_LABELS) or bool(request.layers)
    volume = content.volumes[0]
    if isinstance(request.volume, str):
        layered |= not content.single_volume or (request.tf is None and named_so(volume))
    return volume, LAYERED_BYTES if layered else None


def _resolved(request: SourceRequest, options: BlockOptions, size: int) -> tuple[SourceRequest, str | None]:
    """Return the request for workers, with absolute paths and a resolution level, and a message or None."""
    if not isinstance(request.volume, str):
        return request, None
    path = request.volume
    if path == "-" or (os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path))):
        raise UsageError(f"{path}: a pipe, which can only be read once; expected a file to read in blocks")
    absolute = _absolute(path)
    read, message = _at_level(request.read, absolute, options, size)  # no message: nothing was chosen

    def at_level(layer: SourceRequest) -> SourceRequest:
        if not isinstance(layer.volume, str):
            return layer
        file = _absolute(layer.volume)
        return replace(
            layer, volume=file, read=_at_level(layer.read, file, options, size)[0] if message else layer.read
        )

    layers = tuple(map(at_level, request.layers))
    if isinstance(read.mask, str):
        read = replace(read, mask=str(Path(read.mask).absolute()))
    return replace(request, volume=absolute, read=read, layers=layers), message


def _with_body(request: SourceRequest, store: BlockStore) -> SourceRequest:
    """Return the request with a mask in the store in place of ``keep_largest``, so that workers need not find the body.

    Each of several channels keeps its own body, which workers find.
    """
    read, path = request.read, store.folder / "body.npy"
    if read.keep_largest is None or not isinstance(request.volume, str):
        return request
    volumes = request.content(stored=True).volumes
    if len(volumes) > 1:
        return request
    if not path.is_file():
        shown = np.array([~np.isnan(plane) for plane in planes(volumes[0])], np.uint8)
        write_arrays(path, shown)
    return replace(request, read=replace(read, mask=str(path.absolute()), keep_largest=None))


def _absolute(path: str) -> str:
    """Return a path that is valid in other processes; names with a scheme stay as they are."""
    scheme = path.partition(":")[0] in SCHEMES and not os.path.exists(path)
    return path if scheme else str(Path(path).absolute())


def _reader(source: StyledVolume, access: BlockAccess) -> tuple[Reader, float]:
    """Return the reader of a source's boxes, and its approximate number of visible voxels."""
    from vvgt_cli.closed_form.samples import estimate, visible_share
    from vvgt_cli.dvr.scene import kernel_rule
    from vvgt_cli.field.reader import Layers, Scalars
    from vvgt_cli.look.tables import Optics, build_tables

    volume, frame = source.volume, source.volume.unit_frame()
    if not source.gridded:
        assert isinstance(source.tf, TransferFunction)
        task, whole, stats = access.counts(volume)
        rule = kernel_rule(volume, lambda: whole.stored)
        optics = build_tables(
            source.tf, (stats.lo, stats.hi), slope=rule.slope, intercept=rule.intercept,
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
    reader = Layers(layers, places, grid, volume.dims, frame.scale, Optics.linear(top), source.smooth)
    return reader, reader.visible()


def _at_level(read: ReadOptions, path: str, options: BlockOptions, size: int) -> tuple[ReadOptions, str | None]:
    """Select a resolution level: the requested one, else the coarsest that is fine enough for the screen."""
    from vvgt_cli.cameras.sets import pixel_width
    from vvgt_cli.closed_form.closed_form import MIN_CELL
    from vvgt_cli.volume.registry import level_shapes

    shapes = level_shapes(path, read)
    if not shapes:
        if options.level is not None:
            kinds = "OME-Zarr, N5, Imaris or BigDataViewer"
            raise UsageError(f"{path}: has no resolution levels; expected {kinds}: omit --level {options.level}")
        return read, None
    if options.level is not None:
        return replace(read, level=0 if options.level == "full" else int(options.level)), None
    if read.crop or read.mask is not None or read.spacing:  # of the finest voxels
        return replace(read, level=0), None
    fits = [n for n, shape in enumerate(shapes) if shape and 2 / max(shape) <= MIN_CELL * pixel_width(size)]
    level = max(fits, default=0)
    sizes = " x ".join(map(str, reversed(shapes[level])))
    return replace(read, level=level), f"level {level} of {len(shapes)} ({sizes}): fine enough for the screen"


def stored_files(path: str) -> list[Path]:
    """Return the slices of a folder or glob, or the file or other folder itself; an empty list if nothing exists."""
    from vvgt_cli.volume.tiff.slices import matching, slices_of

    if not os.path.exists(path):
        return matching(path)
    return (slices_of(Path(path)) if os.path.isdir(path) else []) or [Path(path)]


def automatic(request: SourceRequest, console: Console) -> BlockOptions | None:
    """Return block options for a large volume or a lazy array, None to read the volume whole.

    Raises:
        DataError, UsageError: see `read_volume`.
    """
    if not isinstance(request.volume, str) and any(isinstance(one.data, Stored) for one in request.content().volumes):
        console.message("a Dask array: processed in blocks (docs/scale.md)")
        return BlockOptions()
    if not better_in_blocks(request):
        return None
    console.message("large: processed in blocks (docs/scale.md)")
    return BlockOptions()


def better_in_blocks(request: SourceRequest) -> bool:
    """Return whether a volume in a file is large (`MIN_BLOCKED`), or would not fit in memory with everything else.

    Raises:
        DataError, UsageError: see `read_volume`.
    """
    path, free = request.volume, free_memory()
    if not isinstance(path, str) or path == "-":
        return False
    inside = not os.path.exists(path) and not stored_files(path) and ":/" in path
    place = path.rpartition(":/")[0] if inside else path
    zarr = os.path.isdir(place) and ZARR & set(os.listdir(place))
    h5 = os.path.isfile(place) and place.lower().endswith(PACKED)
    files = stored_files(place)
    tiff = files and files[0].suffix.lower() in (".tif", ".tiff")
    index = os.path.isfile(place) and place.lower().endswith(INDEXES)
    away = path.partition(":")[0] in STEPPED
    masks = mask_files(path)
    packed = away or zarr or h5 or tiff or index or masks  # small files may hold many voxels
    size = sum(file.stat().st_size for file in files)
    if not packed and size < MIN_BLOCKED and (free is None or size <= LARGE * free):
        return False
    try:
        content = request.content(stored=True)
    except SeveralComponents:  # reported when it is read
        return False
    volumes = content.volumes
    if not masks and not all(map(is_file_backed, volumes)):
        return False
    if sum(volume.data.nbytes for volume in volumes) >= MIN_BLOCKED:
        return True
    if free is None:
        return False
    from vvgt_cli.closed_form.closed_form import MAX_BASE_CELLS

    own = LAYER_VOXEL + 4 * len(volumes) if len(volumes) > 1 else OWN.get(volumes[0].data.dtype.name, 4)
    loaded = sum(volume.data.nbytes for volume in volumes if isinstance(volume.data, Stored))
    voxels = volumes[0].data.size
    return loaded + (own + RANGES) * voxels + PROGRAM + CELL_BYTES * min(voxels, MAX_BASE_CELLS) > free


def needs_histogram(request: SourceRequest) -> bool:
    """Return whether a function depends on the histogram of the values, and not only on their range."""
    from vvgt_cli.look import read_transfer_function

    if request.tf is None:
        return True
    given = [request.tf, *(layer.tf for layer in request.layers if layer.labels in (None, NO_LABELS))]
    functions = [read_transfer_function(tf) if isinstance(tf, str) else tf for tf in given]
    return any(tf is None or tf.of_histogram for tf in functions)


def runner_of(options: BlockOptions, threads: int) -> Runner:
    """Return the runner of the options' workers, which share ``threads``."""
    workers = options.workers or 1
    if options.scheduler is not None:
        from vvgt_cli.field.runners import DaskRunner

        return DaskRunner(options.scheduler, workers, threads)
    return Processes(workers, threads) if workers > 1 else Runner()


def _settings(request: SourceRequest, needs: FieldNeeds) -> dict[str, Any]:
    """Return everything that stored blocks depend on."""
    tf = request.tf
    text = Path(tf).read_text("utf-8", "replace") if isinstance(tf, str) and os.path.isfile(tf) else digest(tf)
    return {
        "version": [VERSION, LAYOUT],
        "volume": facts_of(request.volume),
        "files": [facts_of(path) for path in request.paths()],
        "read": {one.name: digest(getattr(request.read, one.name)) for one in fields(request.read)},
        "function": [text, request.tf_range, request.unit_distance],
        "look": [repr(request.light), facts_of(request.labels), *map(_layer_facts, request.layers)],
        "skies": [facts_of(light) for light in request.light.lights if light.lower().endswith(PICTURES)],
        "series": digest(*request.statistics),
        "gaussians": [needs.gaussians, needs.degree, needs.on_disk, needs.values],
        "size": needs.size,
    }


def _layer_facts(layer: SourceRequest) -> list[Any]:
    """Return everything that the look of a layer depends on."""
    return [digest(replace(layer, volume="")), *map(facts_of, (layer.volume, layer.tf, layer.labels))]


def facts_of(volume: Any) -> list[Any]:
    """Return a file's name, size and time, or a digest of anything else."""
    if not isinstance(volume, str):
        volumes = content_of(volume).volumes if isinstance(volume, Volume | OpenedFile) else ()
        return [digest(*volumes) if volumes else digest(volume)]
    outer = [name for name in (volume, volume.rpartition(":/")[0], volume.partition("#")[0]) if name]
    files = next((some for name in outer if (some := stored_files(name))), [])
    whole = [inner for file in files for inner in (file.rglob("*") if file.is_dir() else (file,))]
    stats = [file.stat() for file in whole]
    return [volume, sum(f.st_size for f in stats), max(f.st_mtime_ns for f in stats)] if stats else [volume]
