"""Results of a run in memory, which can be saved, drawn, previewed and recoloured."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.cameras.sets import SIZE
from vvgt_cli.conversion.gaussian_files import write_file
from vvgt_cli.conversion.place import AUTO, NONE, to_box_frame, up_axis, upright_axes
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.formats import PAGE, SUFFIXES, encoded, format_of
from vvgt_cli.gaussians.formats.page_file import iframe
from vvgt_cli.gaussians.formats.page_values import PageLayer, Values
from vvgt_cli.gaussians.formats.streamed import is_streamed
from vvgt_cli.gaussians.outputs import Output, check_outputs
from vvgt_cli.gaussians.rules import INRIA, rule_of
from vvgt_cli.gaussians.story import StoryLike, read_story
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.progress import Console
from vvgt_cli.score.record import ConversionReport, Run, StageRecord
from vvgt_cli.score.viewing import PREVIEW_VIEWS
from vvgt_cli.score.views import preview

if TYPE_CHECKING:
    from vvgt_cli.field.field import Field
    from vvgt_cli.look.function import TransferFunction
    from vvgt_cli.look.labels import LabelTable
    from vvgt_cli.volume import Volume

FROM_THE_SIDE = 4  # test view of pictures by default
CERTIFICATES = 4096  # bytes of a page that are enough for its certificate


@dataclass(repr=False)
class Result:
    """The Gaussians of a conversion or a refinement, with their report.

    Attributes:
        gaussians: Gaussians in the unit frame, as a file holds them.
        report: stages with times, scores, skipped stages; ``--report`` writes `report.to_json()`.
        ply: default layout of a file.
    """

    gaussians: Gaussians
    report: ConversionReport
    ply: PlyOptions

    def __repr__(self) -> str:
        """Return a summary: Gaussians, PSNR and time."""
        scores = self.scores
        psnr = "" if scores is None else f", {scores['psnr']:.2f} dB"
        return f"<{type(self).__name__}: {len(self.gaussians)} Gaussians{psnr}, {self.report.seconds:.1f} s>"

    @property
    def scores(self) -> dict[str, Any] | None:
        """Return mean scores over the test views by name (docs/report.md); None where none were drawn."""
        return self.report.scores

    @property
    def stages(self) -> list[StageRecord]:
        """Return the stages in order, each with its seconds."""
        return self.report.stages

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        frame: str | None = None,
        up: str | None = None,
        sh_degree: int | None = None,
        comments: bool | None = None,
        values: bool = True,
        story: StoryLike | None = None,
        overwrite: bool = True,
    ) -> int:
        """Write a standard ``.ply``, or another format by the ending of the name, atomically.

        Args:
            path: the file: ``.ply``, ``.html`` (a viewer page) or one of `vvgt_cli.gaussians.formats.SUFFIXES`.
            frame: "unit" or "world"; None, here and below: that of `ply`.
            up: direction that viewers show upwards: a world axis, an anatomical one, "none" or "auto" (superior in the
                unit frame of an anatomical space); None with another frame: "auto".
            sh_degree: degree in the file, 0 to 3: missing harmonics are zeros, those above it are dropped.
            comments: describe the file in its header.
            values: a page of a conversion also holds the values of its volume, so that its look can be changed.
            story: for a page to tell: a ``story.json`` or its content (docs/page.md).
            overwrite: replace an existing file; the default, since cells of notebooks are run again.

        Returns:
            Number of bytes written.

        Raises:
            UsageError: the file exists, a value is invalid, or no format has the name's ending.
            DataError: a library that the format needs is not installed, or the story is not valid.
        """
        if is_streamed(os.fspath(path)):
            raise UsageError(
                f"{os.fspath(path)}: streamed levels need the volume, not finished Gaussians; expected a "
                ".ply or another format, or 'vvgt convert VOLUME -o FOLDER/lod-meta.json'"
            )
        check_outputs([Output("save", os.fspath(path), SUFFIXES, splats=True)], [], overwrite)
        ply, known = self.layout(frame, up, sh_degree, comments), format_of(path)
        page = known is not None and known.suffix == ".html"
        if story is not None:
            if not page:
                raise UsageError(f"{os.fspath(path)}: only pages show stories; expected .html, or no story")
            ply = replace(ply, story=read_story(story).checked(self.page_layers() if values and ply.comments else ()))
        held = self.values() if values and page and ply.comments else None
        return write_file(os.fspath(path), self.gaussians, ply, overwrite, None if known else self.normals(), held)

    def layout(
        self, frame: str | None = None, up: str | None = None, sh_degree: int | None = None,
        comments: bool | None = None,
    ) -> PlyOptions:  # fmt: skip
        """Return the layout of a file; arguments as in `save`. Raise UsageError if a value is invalid."""
        old, space = self.ply, None if self.ply.space == NONE else self.ply.space
        frame = frame or old.frame
        return replace(
            old,
            frame=frame,
            up=old.up if up is None and frame == old.frame else up_axis(up or AUTO, frame, space),
            sh_degree=old.sh_degree if sh_degree is None else sh_degree,
            comments=old.comments if comments is None else comments,
        )

    def recolor(
        self, tf: str | TransferFunction | None = None, *, tf_range: str = "data",
        opacity_unit_distance: str | None = None, labels: str | LabelTable | None = None,
        light: LightOptions | None = None,
        layers: Mapping[int | str, str | TransferFunction | LabelTable] | None = None,
    ) -> Result:  # fmt: skip
        """Return live Gaussians (``convert(..., live=True)``) under another function: ``vvgt recolor``.

        Args:
            tf: file, colour map's name, or a function; None: their own.
            tf_range: "data", "rescale" or "LO,HI": position of the function's nodes.
            opacity_unit_distance: a length in the world, "paraview" or "mean-spacing"; None: the function's own.
            labels: for a label map, a table, its file, or "auto"; None: their own.
            light: light options; None: those of the function's file, else those they were made under.
            layers: for several layers or channels, functions or label tables by number or name; the others keep
                theirs.

        Raises:
            DataError: they carry no values, or the function shows nothing of them.
            UsageError: an invalid range, distance or light.
        """
        from vvgt_cli.conversion.recolored import layer_look, recolored
        from vvgt_cli.field.source import SourceRequest

        others = tuple(layer_look(self.ply, key, one) for key, one in (layers or {}).items())
        asked = SourceRequest(
            "", tf=tf, tf_range=tf_range, unit_distance=opacity_unit_distance, labels=labels,
            light=light or LightOptions(), layers=others,
        )  # fmt: skip
        found, options = recolored("result", self.gaussians, self.ply, asked)
        return Result(found, ConversionReport("recolor"), options)

    def voxelize(
        self, *, dims: Sequence[int] | None = None, spacing: Sequence[float] | None = None, like: Volume | None = None,
        layer: int | str | None = None, density: bool = False,
    ) -> Volume:  # fmt: skip
        """Return live values or labels, or the extinction of any Gaussians, on a grid; see `vvgt_cli.voxelize`."""
        from vvgt_cli.conversion.voxelize import array_of, planes_of

        return array_of(planes_of("result", self.ply, self.gaussians, dims, spacing, like, layer, density))

    def values(self, run: Run | None = None, limit: float | None = None) -> Values | None:
        """Return the values of the volume for a page of at most ``limit`` bytes; None where there are none."""
        return None

    def page_layers(self) -> Sequence[PageLayer | None]:
        """Return the layers whose values a page holds."""
        return ()

    def normals(self) -> np.ndarray | None:
        """Return the normals (K, 3) for a `.ply`, unit frame; None for zeros."""
        return None

    def _repr_html_(self) -> str | None:
        """Return the viewer page for a notebook; None where a library is missing."""
        name = self.ply.title or "result"
        try:
            return iframe(encoded(PAGE, self.gaussians, self.ply, name, self.values()), name)
        except DataError:
            return None

    def render(self, camera: Camera | None = None, *, size: int | None = None, rule: str | None = None) -> np.ndarray:
        """Draw the Gaussians as viewers do.

        Args:
            camera: a camera in the unit frame; None: a test view from the side.
            size: pixels along the edge where no camera is given; None: the size that the Gaussians are made for.
            rule: one of `vvgt_cli.gaussians.rules`, or of a live result "mip" or "xray"; None: that of the Gaussians.

        Returns:
            (h, w, 4) float32, premultiplied RGBA.

        Raises:
            UsageError: the rule is unknown.
            DataError: a MIP or X-ray of Gaussians without values.
        """
        from vvgt_cli.conversion.recolored import NAMES, draw_gaussians
        from vvgt_cli.splat import render

        if camera is None:
            camera = default_views("test", size=size or self.ply.screen_size or SIZE)[FROM_THE_SIDE]
        if rule in NAMES:
            return draw_gaussians("result", self.gaussians, self.ply, rule)(camera)
        return render(self.gaussians, camera, rule_of(rule or self.ply.rule or INRIA))


@dataclass(repr=False)
class Conversion(Result):
    """The result of a conversion, with its volume.

    Attributes:
        field: the volume under its function, labels, layers and light.
        seen: returns what viewers show of levels to a camera in the box frame; None where all Gaussians are shown.
    """

    field: Field
    seen: Callable[[Camera], Gaussians] | None = None

    @cached_property
    def _values(self) -> dict[float | None, Values | None]:
        """Values by the limit of the page that they are for."""
        return {}

    def values(self, run: Run | None = None, limit: float | None = None) -> Values | None:
        """Implement `Result.values`."""
        if limit not in self._values:
            with (run or Run(Console(quiet=True), ConversionReport("init"))).stage("values") as stage:
                bare = replace(self.gaussians, live=None), replace(self.ply, live=None)
                room = None if limit is None else limit - CERTIFICATES - len(encoded(PAGE, *bare, ""))
                found = self._values[limit] = self.field.source.values(room)
                colours = all(layer.colors for layer in self.field.source.layers)
                why = (
                    "the volume has colours" if colours else f"--max-megabytes leaves {max(room or 0, 0) / 1e6:.2f} MB"
                )
                stage.note = str(found or f"none: {why}")
        return self._values[limit]

    def page_layers(self) -> Sequence[PageLayer | None]:
        """Implement `Result.page_layers`."""
        return self.field.source.page_layers

    def normals(self) -> np.ndarray | None:
        """Return the direction (K, 3) of the mean gradient around each Gaussian, unit frame; None without a light."""
        return self._normals

    @cached_property
    def _normals(self) -> np.ndarray | None:
        volume = self.field.source.volume
        normals = self.field.normals(to_box_frame(self.gaussians, volume))
        if normals is None:
            return None
        turned = normals @ np.linalg.inv(volume.axes)
        return turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)

    def preview(self, size: int | None = None, views: Sequence[int] = PREVIEW_VIEWS) -> np.ndarray:
        """Draw volume, splats and eight times their difference, one row per test view, upright.

        Args:
            size: pixels along a picture's edge; None: the size that the Gaussians are made for.
            views: numbers of test views, 0 to 9.

        Returns:
            (h, 3 w, 3) float32 RGB in [0, 1], rows below each other.
        """
        cameras = default_views("test", size=size or self.ply.screen_size or SIZE)
        volume = self.field.source.volume
        axes, inside = upright_axes(volume, self.ply.up), self.seen or to_box_frame(self.gaussians, volume)
        return preview(self.field.views, inside, [cameras[n] for n in views], axes, self.ply.rule or INRIA)

    def _repr_png_(self) -> bytes:
        """Return a PNG preview, for notebooks outside a browser."""
        from vvgt_cli.images import png_bytes

        return png_bytes(self.preview(SIZE, (FROM_THE_SIDE,)))
