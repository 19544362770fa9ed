"""`Field`: a volume under its function, labels, layers and light, in memory (`Resident`) or in blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.blocks import Blocks
from vvgt_cli.field.digests import values_digest
from vvgt_cli.field.source import Source
from vvgt_cli.field.workload import Workload, measure
from vvgt_cli.gaussians import Gaussians

if TYPE_CHECKING:
    from vvgt_cli.closed_form import Start, VbmOptions
    from vvgt_cli.dvr import RenderSettings, Scene
    from vvgt_cli.dvr.scene import PreparedVolume

AT_ONCE = 1 << 17  # Gaussians whose samples are in memory


class Picture(NamedTuple):
    """A picture of the volume: the arguments of `vvgt_cli.dvr.render_view`."""

    camera: Camera
    settings: RenderSettings
    blocks: Blocks | None = None


class ViewRenderer(Protocol):
    """Renders pictures of a volume."""

    def expect(self, pictures: Sequence[Picture]) -> None:
        """Announce pictures: a volume in blocks draws all that it knows of in one pass."""

    def view(self, camera: Camera, settings: RenderSettings, blocks: Blocks | None = None) -> np.ndarray:
        """Return a picture (h, w, 4) float32, premultiplied RGBA; with ``blocks`` zero elsewhere."""

    def forget(self, picture: Picture) -> None:
        """Release a picture that is not asked for again."""


class Field(Protocol):
    """What a conversion asks of a volume.

    Attributes:
        source: the volume, whose values may lie in its file, and its look.
        views: its pictures.
    """

    views: ViewRenderer

    @property
    def source(self) -> Source: ...

    def workload(self, size: int, gaussians: int) -> Workload:
        """Return what the costs of stages depend on, for images of ``size`` px and a budget of Gaussians."""

    def pyramid(self, options: VbmOptions, progress: Callable[[int, int], None] | None = None) -> Start:
        """Return the closed form: the pyramid of cells, and Gaussians of those that fit the budget."""

    def sample(self, gaussians: Gaussians) -> np.ndarray:
        """Return mean value, spread and gradient under Gaussians of the box frame, (K, 5) float32.

        See `vvgt_cli.closed_form.gaussian_samples.values_of`.

        Raises:
            UsageError: an optics grid, which has no values.
        """

    def with_look(self, source: Source) -> Field:
        """Return the volume under another look: a `Source` that ``self.source`` made of itself.

        The statistics of a layer on its own are found here.
        """

    def normals(self, gaussians: Gaussians) -> np.ndarray | None:
        """Return the directions (K, 3) of the mean gradient around Gaussians of the box frame; None without light."""

    def digest(self) -> str | None:
        """Return the SHA-256 of the values of all volumes; None where there are more than `LARGEST` bytes of them."""


@dataclass
class Resident:
    """A field whose values are in memory, and which draws its own pictures.

    Attributes:
        source: what was read.
        scene: its values laid out for the kernels.
        views: its pictures; None makes it draw them itself.
    """

    source: Source
    scene: Scene
    views: ViewRenderer = field(default=None)  # type: ignore[assignment] # set below

    def __post_init__(self) -> None:
        self.views = self.views or self

    @classmethod
    def of(cls, source: Source) -> Resident:
        """Return the field of a source, laid out for the kernels."""
        return cls(source, source.scene())

    @cached_property
    def layout(self) -> PreparedVolume:
        """The one scalar field for the kernels."""
        from vvgt_cli.dvr.scene import PreparedVolume

        return self.source.layout or PreparedVolume.of(self.source.volume)

    def workload(self, size: int, gaussians: int) -> Workload:
        """See `Field.workload`."""
        return measure(self.scene, size, gaussians)

    def pyramid(self, options: VbmOptions, progress: Callable[[int, int], None] | None = None) -> Start:
        """See `Field.pyramid`."""
        from vvgt_cli.closed_form import initialise

        return initialise(self.scene, options, progress)

    def expect(self, pictures: Sequence[Picture]) -> None:
        """Do nothing: each picture is drawn when it is asked for."""

    def view(self, camera: Camera, settings: RenderSettings, blocks: Blocks | None = None) -> np.ndarray:
        """See `ViewRenderer.view`."""
        from vvgt_cli.dvr import render_view

        return render_view(self.scene, camera, settings, blocks)

    def forget(self, picture: Picture) -> None:
        """Do nothing: no picture is kept."""

    def normals(self, gaussians: Gaussians) -> np.ndarray | None:
        """See `Field.normals`."""
        if self.scene.light is None:
            return None
        from vvgt_cli.closed_form.lit import at_points, mean_normals, normal_points

        points = normal_points(gaussians)
        return mean_normals(points, at_points(self.scene, points), self.scene.half)

    def sample(self, gaussians: Gaussians) -> np.ndarray:
        """See `Field.sample`."""
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

    def with_look(self, source: Source) -> Resident:
        """See `Field.with_look`."""
        from vvgt_cli.volume import statistics

        if source.layers[0].volume is not self.source.layers[0].volume:
            source = replace(source, statistics=statistics(source.volume))
        return Resident.of(source if source.gridded or self.source.gridded else replace(source, layout=self.layout))

    @cached_property
    def _digest(self) -> str | None:
        return values_digest(self.source.volumes)

    def digest(self) -> str | None:
        """See `Field.digest`."""
        return self._digest
