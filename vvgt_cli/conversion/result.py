"""What a run leaves in memory: Gaussians, how they came about, and what can be done with them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.cameras.sets import SIZE
from vvgt_cli.conversion.place import AUTO, NONE, into_box, preview, upright, way_up
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.files import atomic_write
from vvgt_cli.gaussians import Gaussians, PlyOptions, write_ply
from vvgt_cli.gaussians.formats import encoded, format_of
from vvgt_cli.gaussians.formats.page_file import iframe
from vvgt_cli.gaussians.formats.streamed import is_streamed
from vvgt_cli.gaussians.rules import INRIA, rule_of
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.score.record import ConversionReport, StageRecord
from vvgt_cli.score.viewing import PREVIEW_VIEWS

if TYPE_CHECKING:
    from vvgt_cli.field.field import Field
    from vvgt_cli.look.function import TransferFunction
    from vvgt_cli.look.labels import LabelTable

FROM_THE_SIDE = 4  # test view that pictures show where none is asked for


@dataclass(repr=False)
class Result:
    """Gaussians of a conversion or a refinement.

    Attributes:
        gaussians: in the unit frame, as a file holds them.
        report: stages with their times, scores, what was left out; `report.to_json()` is what ``--report`` writes.
        ply: how a file of them is written, unless `save` is told otherwise.
    """

    gaussians: Gaussians
    report: ConversionReport
    ply: PlyOptions

    def __repr__(self) -> str:
        scores = self.scores
        psnr = "" if scores is None else f", {scores['psnr']:.2f} dB"
        return f"<{type(self).__name__}: {len(self.gaussians)} Gaussians{psnr}, {self.report.seconds:.1f} s>"

    @property
    def scores(self) -> dict[str, Any] | None:
        """Means over the test views, by name (docs/report.md); None where none was drawn."""
        return self.report.scores

    @property
    def stages(self) -> list[StageRecord]:
        """What was done, in order, each with its seconds."""
        return self.report.stages

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        frame: str | None = None,
        up: str | None = None,
        sh_degree: int | None = None,
        comments: bool | None = None,
        overwrite: bool = True,
    ) -> int:
        """Write a standard ``.ply``, or another format by the name's ending, whole or not at all.

        Args:
            path: the file: ``.ply``, ``.html`` (a page that shows them), one of `vvgt_cli.gaussians.formats.SUFFIXES`.
            frame: "unit" or "world"; None, here and below: as `ply` says.
            up: what viewers show upwards: a world axis, an anatomical direction, "none" or "auto" (superior in the unit
                frame of an anatomical space); "auto" where another frame is asked for.
            sh_degree: 0 to 3, of the file: zeros where there are no harmonics, those above it left out.
            comments: write what the file is into its header.
            overwrite: replace a file that exists, as a notebook's cell that is run again must.

        Returns:
            Bytes written.

        Raises:
            UsageError: the file exists, or a value that is none of these; streamed levels.
            DataError: a library that the format needs is not installed.
        """
        if is_streamed(os.fspath(path)):
            raise UsageError(
                f"{os.fspath(path)}: levels are made of a volume's closed form, not of finished Gaussians; expected a "
                ".ply or another format, or 'vvgt convert VOLUME -o FOLDER/lod-meta.json'"
            )
        old, space = self.ply, None if self.ply.space == NONE else self.ply.space
        frame = frame or old.frame
        ply = replace(
            old,
            frame=frame,
            up=old.up if up is None and frame == old.frame else way_up(up or AUTO, frame, space),
            sh_degree=old.sh_degree if sh_degree is None else sh_degree,
            comments=old.comments if comments is None else comments,
        )
        known = format_of(path)
        with atomic_write(path, overwrite) as temporary:
            if known is None:
                return write_ply(temporary, self.gaussians, ply, self.normals())
            return temporary.write_bytes(encoded(known, self.gaussians, ply, os.fspath(path)))

    def recolor(
        self, look: str | TransferFunction | None = None, *, range: str = "data", unit_distance: str | None = None,
        labels: str | LabelTable | None = None, light: LightOptions | None = None,
        layers: Mapping[int | str, str | TransferFunction | LabelTable] | None = None,
    ) -> Result:  # fmt: skip
        """What Gaussians that carry values (``convert(..., live=True)``) are under another function: ``vvgt recolor``.

        Args:
            look: file, colour map's name, or a function; None: that which they have.
            range: "data", "rescale" or "LO,HI": where the function's nodes lie.
            unit_distance: world length that opacity is per, "paraview" or "mean-spacing"; None: the function's own.
            labels: of a label map's: a table, its file, or "auto"; None: that which they have.
            light: what falls on them; None: what the function's file says, else what they were made under.
            layers: of several layers or channels: functions, or tables of labels, by number or name; the others keep
                that which they have.

        Raises:
            DataError: they carry none, or the function shows nothing of them.
            UsageError: a range, a distance or a light that is none.
        """
        from vvgt_cli.conversion.recolored import FunctionRequest, apply_function, layer_look, placed_function

        others = tuple(layer_look(self.ply, key, one) for key, one in (layers or {}).items())
        asked = FunctionRequest(look, range, unit_distance, labels, light or LightOptions(), others)
        tf, options = placed_function("result", self.ply, asked)
        found = apply_function(self.gaussians, self.ply, tf, options)
        return Result(found, ConversionReport("recolor"), options)

    def normals(self) -> np.ndarray | None:
        """Normals (K, 3) that a `.ply` of them has, unit frame; None for zeros."""
        return None

    def _repr_html_(self) -> str | None:
        """What notebooks show: the page, live where the Gaussians are; nothing where a library is missing."""
        name = str(self.report.volume.get("name") or "result")
        page = format_of("x.html")
        assert page is not None
        try:
            return iframe(encoded(page, self.gaussians, self.ply, name), name)
        except DataError:
            return None

    def render(self, camera: Camera | None = None, *, size: int | None = None, rule: str | None = None) -> np.ndarray:
        """The Gaussians as viewers draw them.

        Args:
            camera: in the unit frame; None: a test view from the side.
            size: pixels along the edge where no camera is given; None: what the Gaussians are made for.
            rule: of `vvgt_cli.gaussians.rules`; None: that of the Gaussians.

        Returns:
            (h, w, 4) float32, premultiplied RGBA.

        Raises:
            UsageError: no such rule.
        """
        from vvgt_cli.splat import render

        if camera is None:
            camera = default_views("test", size=size or self.ply.made_for or SIZE)[FROM_THE_SIDE]
        return render(self.gaussians, camera, rule_of(rule or self.ply.rule or INRIA))


@dataclass(repr=False)
class Conversion(Result):
    """What became of a volume under a transfer function.

    Attributes:
        field: the volume under its function, labels, layers and light.
    """

    field: Field

    def normals(self) -> np.ndarray | None:
        """Directions (K, 3) of the mean gradient around each Gaussian, unit frame; None where nothing is lit."""
        return self._normals

    @cached_property
    def _normals(self) -> np.ndarray | None:
        volume = self.field.source.volume
        normals = self.field.normals(into_box(self.gaussians, volume))
        if normals is None:
            return None
        turned = normals @ np.linalg.inv(volume.axes)
        found: np.ndarray = turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)
        return found

    def preview(self, size: int | None = None, views: Sequence[int] = PREVIEW_VIEWS) -> np.ndarray:
        """Volume, splats and eight times their difference, a row a test view, with the way up upwards.

        Args:
            size: pixels along a picture's edge; None: what the Gaussians are made for.
            views: numbers of test views, 0 to 9.

        Returns:
            (h, 3 w, 3) float32 RGB in [0, 1], rows below each other.
        """
        cameras = default_views("test", size=size or self.ply.made_for or SIZE)
        volume = self.field.source.volume
        axes, inside = upright(volume, self.ply.up), into_box(self.gaussians, volume)
        return preview(self.field.views, inside, [cameras[n] for n in views], axes, self.ply.rule or INRIA)

    def _repr_png_(self) -> bytes:
        """What stands for it where a notebook is not shown by a browser."""
        from vvgt_cli.images import png_bytes

        return png_bytes(self.preview(SIZE, (FROM_THE_SIDE,)))
