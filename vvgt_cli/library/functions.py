"""The commands as functions. Each is as its command: `docs/commands` has what the options do."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Unpack

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.conversion.result import Conversion, Result
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians import Gaussians, PlyHeader
from vvgt_cli.library.inputs import (
    FunctionLike,
    Goal,
    GoalLike,
    LabelsLike,
    LightLike,
    LookLike,
    LooksLike,
    PathLike,
    Reading,
    VolumeLike,
    console_of,
    function_of,
    labels_of,
    light_of,
    looks_of,
    ply_of,
    source_of,
    under,
    volume_of,
)
from vvgt_cli.volume import Volume

if TYPE_CHECKING:
    import numpy as np

    from vvgt_cli.commands.evaluate import Evaluation
    from vvgt_cli.conversion.clouds import Clouds
    from vvgt_cli.field.settings import BlockOptions


def convert(
    volume: VolumeLike,
    look: LooksLike = None,
    goal: GoalLike = None,
    *,
    split_labels: bool = False,
    live: bool = False,
    after: Conversion | None = None,
    blocks: int | str | None = None,
    progress: bool = False,
    **reading: Unpack[Reading],
) -> Conversion | Clouds:
    """A volume under a transfer function as 3D Gaussians: ``vvgt convert`` without its files.

    >>> import vvgt_cli as vvgt
    >>> result = vvgt.convert("example:marschner-lobb:24", goal={"max_gaussians": 200, "size": 64, "steps": 0})
    >>> result.scores["psnr"] > 15
    True

    Args:
        volume: a path (or ``example:NAME``); an array (nz, ny, nx), of numpy or Dask, with ``spacing`` (x, y, z) or
            ``affine`` (4, 4); an xarray.DataArray; a pyvista.ImageData; or a `Volume`. A file of several time steps
            without ``time``, or a glob of volumes, is a series. Arrays of Dask are never computed as a whole.
        look: function, light, labels and layers: a `Look`; or the function alone. Several: a list of them, or a mapping
            of names to them.
        goal: budget, screen, limits: a `Goal`, or a mapping of some of its attributes.
        split_labels: of a label map, a result a label.
        live: the Gaussians carry the values under them: `Result.recolor` shows them under any function (docs/live.md).
        after: an earlier conversion of the same volume to go on from, a few times as fast where that is about as near:
            its Gaussians, under the new look, refined by some steps (docs/python.md).
        blocks: voxels along the edge of blocks, or "auto"; None: blocks where the file is large.
        progress: lines and bars on standard error.
        **reading: how to read the volume: see `Reading`.

    Returns:
        Gaussians in the unit frame with scores, stages, `save`, `render` and `preview`; of several frames, looks or
        labels `Clouds`: a mapping of names to results, with a `save` of all.

    Raises:
        DataError: input that is not what it must be, or a scene that shows nothing.
        UsageError: options that do not fit.
    """
    from vvgt_cli.conversion.convert_batch import convert_to_memory

    if not isinstance(after, Conversion | None):
        raise UsageError("after: expected what convert returns for one volume and look")
    looks, several = looks_of(look)
    source = source_of(volume, None, reading)
    request = replace(Goal.of(goal).request(source), blocks=_blocks(blocks), live=live)
    requests = {name: replace(request, source=under(source, one)) for name, one in looks.items()}
    return convert_to_memory(
        requests, several=several, split_labels=split_labels, after=after, console=console_of(progress)
    )


def _blocks(blocks: int | str | None) -> BlockOptions | None:
    from vvgt_cli.field.settings import BlockOptions

    return None if blocks is None else BlockOptions(None if isinstance(blocks, str) else blocks)


def read_volume(volume: VolumeLike, **reading: Unpack[Reading]) -> Volume:
    """A volume from a file, or from what is in memory.

    >>> import numpy as np, vvgt_cli as vvgt
    >>> vvgt.read_volume(np.zeros((4, 5, 6)), spacing=(1, 1, 2)).dims
    (6, 5, 4)

    Args:
        volume, reading: as of `convert`.

    Raises:
        DataError, UsageError: as `convert`.
    """
    return volume_of(volume, reading)


def read_ply(path: PathLike) -> tuple[Gaussians, PlyHeader]:
    """Gaussians of a standard ``.ply`` in the unit frame, and what its header says; other formats by their names.

    Raises:
        DataError: not a 3DGS ``.ply``, or one without Gaussians.
    """
    from vvgt_cli.conversion.gaussian_files import open_gaussians

    return open_gaussians(os.fspath(path))


def render_views(
    volume: VolumeLike,
    look: LookLike = None,
    cameras: Sequence[Camera] | int = 24,
    *,
    size: int = 400,
    step: float = 0.5,
    **reading: Unpack[Reading],
) -> tuple[list[Camera], np.ndarray]:
    """Pictures of a volume by our renderer, in memory; ``vvgt render-views`` writes them for trainers.

    >>> import vvgt_cli as vvgt
    >>> cameras, images = vvgt.render_views("example:blob:16", cameras=2, size=32)
    >>> images.shape
    (2, 32, 32, 4)

    Args:
        volume, look, reading: as of `convert`.
        cameras: in the unit frame, all of one size; or how many of the training views.
        size: pixels along the edge of the training views.
        step: along a ray, in voxels.

    Returns:
        cameras, images: (n, h, w, 4) float32, premultiplied RGBA.

    Raises:
        DataError, UsageError: as `convert`; cameras of several sizes.
    """
    import numpy as np

    from vvgt_cli.cameras.boxed import render_in_box
    from vvgt_cli.dvr import RenderSettings, render_view
    from vvgt_cli.field.source import load

    views = default_views("train", cameras, size=size) if isinstance(cameras, int) else list(cameras)
    if len({(view.width, view.height) for view in views}) != 1:
        raise UsageError(f"{len(views)} cameras of several sizes; expected one or more of one size")
    source = load(source_of(volume, look, reading))
    scene = source.scene()
    draw = render_in_box(lambda view: render_view(scene, view, RenderSettings(step=step)), source.volume.axes)
    return views, np.stack([draw(view) for view in views])


def evaluate(
    ply: PathLike | Result,
    volume: VolumeLike,
    look: LookLike = None,
    *,
    size: int | None = None,
    rule: str | None = None,
    step: float = 0.125,
    conditions: bool = True,
    blocks: int | str | None = None,
    progress: bool = False,
    **reading: Unpack[Reading],
) -> Evaluation:
    """Scores of a ``.ply``, or of a result, against its volume: ``vvgt evaluate``.

    Args:
        ply: path, or what `convert` or `optimize` returned.
        volume, look, reading: as of `convert`.
        size, rule: to score at and draw by; None: the file's.
        step: of the reference, in voxels.
        conditions: every rule at several sizes and close up, too.
        blocks: as of `convert`.
        progress: lines and bars on standard error.

    Raises:
        DataError, UsageError: as `convert`.
    """
    from vvgt_cli.commands import evaluate as pipeline

    source = source_of(volume, look, reading)
    request = pipeline.EvaluateRequest(ply_of(ply), source, size, rule, step, conditions, _blocks(blocks))
    return pipeline.evaluate(request, console_of(progress))


def recolor(
    ply: PathLike, look: FunctionLike | None = None, *, range: str = "data", unit_distance: str | float | None = None,
    labels: LabelsLike | None = None, light: LightLike = None, layers: Mapping[int | str, Any] | None = None,
) -> Result:  # fmt: skip
    """A live ``.ply`` under another function, without its volume: ``vvgt recolor``.

    Args:
        ply: path of a file that ``vvgt convert --live`` wrote.
        look: a function as of `Look`; None: the file's own.
        range, unit_distance: as of `Result.recolor`.
        labels: of a label map's file, a table as of `Look`; None: the file's own.
        light: as of `Look`; None: what the function's file says, else what the file was made under.
        layers: of a file of several layers or channels: functions, or tables of labels, by number or name.

    Returns:
        An ordinary cloud.

    Raises:
        DataError: a file whose Gaussians carry no values, or a function that shows nothing of them.
        UsageError: a range, a distance or a light that is none.
    """
    from vvgt_cli.conversion.gaussian_files import layout_of
    from vvgt_cli.score.record import ConversionReport

    gaussians, header = read_ply(ply)
    result = Result(gaussians, ConversionReport("recolor"), layout_of(header))
    distance = None if unit_distance is None else str(unit_distance)
    return result.recolor(
        function_of(look), range=range, unit_distance=distance, labels=labels_of(labels), light=light_of(light),
        layers=layers,
    )  # fmt: skip


def optimize(
    ply: PathLike | Result,
    views: PathLike,
    *,
    steps: int | None = None,
    time_budget: float | None = None,
    target_psnr: float | None = None,
    method: str = "frame",
    max_gaussians: int | None = None,
    size: int | None = None,
    rule: str | None = None,
    sh_degree: int | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Result:
    """Gaussians refined by gradient descent on views: ``vvgt optimize``.

    Args:
        ply: path, or what `convert` returned.
        views: folder that ``vvgt render-views`` wrote.
        steps, time_budget: one of the two: steps of one view each, or seconds.
        target_psnr: dB on the check views at which to end.
        method: "frame", "adam" or "3dgs"; max_gaussians: that "3dgs" may grow to.
        size, rule: of the screen that they are made for; None: the file's.
        sh_degree: of the spherical harmonics that are refined, 0 to 3; None: the file's.
        seed: of the order of views.
        progress: lines and bars on standard error.

    Returns:
        The best that the check views have seen.

    Raises:
        DataError: a ``.ply`` or a folder of views that is not one.
        UsageError: both of steps and time_budget, or none.
    """
    from vvgt_cli.commands.optimize import OptimizeRequest, budget, optimized
    from vvgt_cli.refine import OptimizeOptions
    from vvgt_cli.score.record import ConversionReport, Run

    how = OptimizeOptions.of(
        method, max_gaussians=max_gaussians, target_psnr=target_psnr, seed=seed, **budget(steps, time_budget)
    )
    run = Run(console_of(progress), ConversionReport("optimize"))
    result = optimized(run, OptimizeRequest(ply_of(ply), os.fspath(views), None, how, size, rule, sh_degree))
    run.finish()
    return result
