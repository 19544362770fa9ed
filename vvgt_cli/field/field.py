"""`Field`: a volume under its function, labels, layers and light, wherever its values are; and one in memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.blocks import Blocks
from vvgt_cli.field.digests import volume_digest
from vvgt_cli.field.source import Source
from vvgt_cli.field.workload import Workload, measure
from vvgt_cli.gaussians import Gaussians

if TYPE_CHECKING:
    from vvgt_cli.closed_form import Start, VbmOptions
    from vvgt_cli.dvr import RenderSettings, Scene
    from vvgt_cli.dvr.scene import PreparedVolume
    from vvgt_cli.look.function import TransferFunction
    from vvgt_cli.look.labels import LabelTable
    from vvgt_cli.volume import Volume


AT_ONCE = 1 << 17  # Gaussians whose samples are in memory


class Picture(NamedTuple):
    """A picture of the volume: the arguments of `vvgt_cli.dvr.render_view`."""

    camera: Camera
    settings: RenderSettings
    blocks: Blocks | None = None


class Field(Protocol):
    """What a conversion asks of a volume.

    Attributes:
        source: the volume, whose values may lie in its file, and all that it is shown by.
    """

    @property
    def source(self) -> Source: ...

    def case(self, size: int, gaussians: int) -> Workload:
        """What the costs of stages follow from, for images of ``size`` px and a budget of Gaussians."""

    def start(self, options: VbmOptions, progress: Callable[[int, int], None] | None = None) -> Start:
        """The closed form."""

    def expect(self, views: Sequence[Picture]) -> None:
        """Pictures that will be asked for: those of a volume in blocks are made together."""

    def view(self, camera: Camera, settings: RenderSettings, blocks: Blocks | None = None) -> np.ndarray:
        """A picture (h, w, 4) float32, premultiplied RGBA; with ``blocks`` zero elsewhere."""

    def forget(self, view: Picture) -> None:
        """A picture that is not asked for again."""

    def normals(self, gaussians: Gaussians) -> np.ndarray | None:
        """Directions (K, 3) of the mean gradient around Gaussians, all in the box frame; None where nothing is lit."""

    def under(self, gaussians: Gaussians) -> np.ndarray:
        """(K, 5) float32 of `vvgt_cli.closed_form.gaussian_samples.values_of` under Gaussians of the box frame.

        Raises:
            UsageError: an optics grid, which has no values.
        """

    def shown_by(self, tf: TransferFunction) -> Field:
        """The same volume under another function on data values, unlit.

        Raises:
            UsageError: an optics grid, which has no function.
        """

    def labelled_by(self, tables: Sequence[LabelTable]) -> Field:
        """The same label maps under other tables, as `Source.labelled_by`.

        Raises:
            UsageError: not labels alone.
        """

    def alone(self, number: int) -> Field:
        """One of several layers as a field of its own, on its own grid, unlit."""

    def digest(self) -> str:
        """Of the volume's content."""

    def volumes(self) -> list[Volume]:
        """Every volume that is read for it: that of each layer, and its colours."""

    def hidden(self, budget: int, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Cells (nz, ny, nx) bool that some training view sees, and their edges (3,) in voxels."""


@dataclass(frozen=True)
class Resident:
    """A field whose values are in memory.

    Attributes:
        source: what was read.
        scene: the same laid out for the kernels.
    """

    source: Source
    scene: Scene

    @cached_property
    def layout(self) -> PreparedVolume:
        """Of one field, for the kernels."""
        from vvgt_cli.dvr.scene import PreparedVolume

        return self.source.layout or PreparedVolume.of(self.source.volume)

    def case(self, size: int, gaussians: int) -> Workload:
        """See `Field`."""
        return measure(self.scene, size, gaussians)

    def start(self, options: VbmOptions, progress: Callable[[int, int], None] | None = None) -> Start:
        """See `Field`."""
        from vvgt_cli.closed_form import initialise

        return initialise(self.scene, options, progress)

    def expect(self, views: Sequence[Picture]) -> None:
        """Nothing: each is drawn when it is asked for."""

    def view(self, camera: Camera, settings: RenderSettings, blocks: Blocks | None = None) -> np.ndarray:
        """See `Field`."""
        from vvgt_cli.dvr import render_view

        return render_view(self.scene, camera, settings, blocks)

    def forget(self, view: Picture) -> None:
        """Nothing: none is kept."""

    def normals(self, gaussians: Gaussians) -> np.ndarray | None:
        """See `Field`."""
        if self.scene.light is None:
            return None
        from vvgt_cli.closed_form.lit import at_points, mean_normals, normal_points

        points = normal_points(gaussians)
        return mean_normals(points, at_points(self.scene, points), self.scene.half)

    def under(self, gaussians: Gaussians) -> np.ndarray:
        """See `Field`."""
        from vvgt_cli.closed_form.gaussian_samples import POINTS, in_voxels, offsets, sample_points, values_of

        self.source.one_field()
        scene, values = self.scene, np.empty((len(gaussians), 5), np.float32)
        nothing, dims = np.zeros(3, np.int64), np.array(self.source.volume.dims)
        for k in range(0, len(gaussians), AT_ONCE):
            part = gaussians.take(np.arange(k, min(k + AT_ONCE, len(gaussians))))
            samples = np.full((len(part), POINTS), np.nan, np.float32)
            where = in_voxels(part, scene.half, scene.step)
            sample_points(scene.voxels, *where, offsets(), nothing, nothing, dims, samples)
            values[k : k + len(part)] = values_of(samples, part, self.layout.slope, self.layout.intercept)
        return values

    def shown_by(self, tf: TransferFunction) -> Resident:
        """See `Field`."""
        source = replace(self.source.shown_by(tf), layout=self.layout)
        return Resident(source, source.scene())

    def labelled_by(self, tables: Sequence[LabelTable]) -> Resident:
        """See `Field`."""
        source = self.source.labelled_by(tables)
        return Resident(source, source.scene())

    def alone(self, number: int) -> Resident:
        """See `Field`."""
        from vvgt_cli.volume import statistics

        source = self.source.alone(number, statistics(self.source.layers[number].volume))
        return Resident(source, source.scene())

    def digest(self) -> str:
        """See `Field`."""
        return volume_digest(self.source.volume)

    def volumes(self) -> list[Volume]:
        """See `Field`."""
        return [volume for layer in self.source.layers for volume in (layer.volume, *(layer.colors or ()))]

    def hidden(self, budget: int, size: int) -> tuple[np.ndarray, np.ndarray]:
        """See `Field`."""
        from vvgt_cli.closed_form.closed_form import closed_form
        from vvgt_cli.closed_form.tree import HIDDEN

        seen = closed_form(self.scene, budget, size).seen
        return seen.largest > HIDDEN, seen.edge
