"""Views for trainers of a volume that is processed in blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.boxed import render_in_box, to_box_frame
from vvgt_cli.commands.view_files import POINTS
from vvgt_cli.errors import UsageError
from vvgt_cli.field.blocked import Blocked
from vvgt_cli.field.field import Picture
from vvgt_cli.field.open import FieldNeeds, automatic, blocked, store_beside
from vvgt_cli.score.record import Run

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings
    from vvgt_cli.field.settings import BlockOptions
    from vvgt_cli.field.source import SourceRequest

TOGETHER = 1 << 24  # pixels of views that are made at once


def fields_of(
    run: Run,
    source: SourceRequest,
    options: BlockOptions | None,
    functions: dict[Path, str | None],
    size: int,
    renderer: str,
    stack: ExitStack,
) -> list[Blocked] | None:
    """Open a field in blocks for each function, None if the volume is read as a whole.

    Args:
        run: reports to the console.
        source: the volume; its ``tf`` is not used.
        options: of blocks, None: automatic.
        functions: by folder.
        size: pixels of a view's height.
        renderer: requested ray caster.
        stack: closes the fields.

    Raises:
        UsageError: a renderer that needs the volume in memory.
    """
    options = options or automatic(source, run.console)
    if options is None:
        return None
    if renderer != "vvgt":
        raise UsageError(f"--renderer {renderer}: needs the whole volume in memory; in blocks: vvgt")
    fields = []
    for folder, tf in functions.items():
        store = stack.enter_context(store_beside(str(folder)))
        fields.append(
            stack.enter_context(blocked(run, replace(source, tf=tf), options, store, FieldNeeds(POINTS, size)))
        )
    return fields


def draw_in_blocks(
    field: Blocked, settings: RenderSettings, cameras: Sequence[Camera]
) -> Callable[[Camera], np.ndarray]:
    """Return a function that draws a volume in blocks; at most `TOGETHER` pixels of coming views at once."""
    axes = field.source.volume.axes
    left = list(cameras)

    def inside(camera: Camera) -> np.ndarray:
        if not field.pictures:
            many = max(TOGETHER // (camera.width * camera.height), 1)
            field.views.expect([Picture(to_box_frame(other, axes)[0], settings) for other in left[:many]])
            del left[:many]
        image = field.views.view(camera, settings)
        field.views.forget(Picture(camera, settings))
        return image

    return render_in_box(inside, axes)
