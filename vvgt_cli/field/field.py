"""`Field`: a volume with its look (functions, labels, layers, light), in memory (`Resident`) or in blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from vvgt_cli.cameras import Blocks, Camera
from vvgt_cli.device import on_device
from vvgt_cli.dvr.render import Viewed
from vvgt_cli.field.digests import digest, values_digest
from vvgt_cli.field.source import StyledVolume
from vvgt_cli.field.workload import Workload, measure
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.progress import ProgressCallback

if TYPE_CHECKING:
    from vvgt_cli.closed_form import Start, VbmOptions
    from vvgt_cli.dvr import PreparedVolume, RenderSettings, Scene

AT_ONCE = 1 << 17  # Gaussians whose samples are held in memory at a time


class Picture(NamedTuple):
    """One view of the volume: the arguments of `vvgt_cli.dvr.render_view`."""

    camera: Camera
    settings: RenderSettings
    blocks: Blocks | None = None

    @property
    def key(self) -> str:
        """Return the digest of what it shows."""
        camera = self.camera
        lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        numbers = None if self.blocks is None else self.blocks.numbers
        return digest(camera.rotation, camera.translation, lens, self.settings, numbers)

    @property
    def drawn(self) -> Blocks:
        """Return its blocks, all of them of a whole picture."""
        return self.blocks or Blocks.whole(self.camera.width, self.camera.height)


class ViewRenderer(Viewed, Protocol):
    """A renderer of pictures of a volume."""

    def expect(self, pictures: Sequence[Picture]) -> None:
        """Announce pictures: a volume in blocks renders them in a single pass, one in memory on request."""

    def forget(self, picture: Picture) -> None:
        """Release a picture that will not be requested again."""


class Field(ViewRenderer, Protocol):
    """Everything a conversion needs to know about a volume, which renders its own pictures.

    Attributes:
        source: the volume and its look; the values may still be in the file.
        renderer: renders its pictures; None selects the field itself.
    """

    source: StyledVolume
    renderer: ViewRenderer | None

    @property
    def views(self) -> ViewRenderer:
        """The renderer of its pictures."""
        return self.renderer or self  # a reference to itself would keep the volume until Python looks for cycles

    def workload(self, size: int, gaussians: int) -> Workload:
        """Return the counts and timings that stage costs depend on, for ``size`` px images and a Gaussian budget."""

    def pyramid(self, options: VbmOptions, progress: ProgressCallback | None = None) -> Start:
        """Return the closed form: the pyramid of cells, and the Gaussians that fit the budget."""

    def sample(self, gaussians: Gaussians) -> np.ndarray:
        """Return mean value, spread, normals' axis and gradient under Gaussians of the box frame, (K, 8) float32.

        Raise UsageError for an optics grid.
        """

    def with_look(self, source: StyledVolume) -> Field:
        """Return the field of the same volume with another look; statistics of a single layer are computed here."""

    def normals(self, gaussians: Gaussians) -> np.ndarray | None:
        """Return the mean gradient directions (K, 3) around Gaussians of the box frame; None without light."""

    @cached_property
    def digest(self) -> str | None:
        """SHA-256 of all volumes' values; None if they exceed `LARGEST` bytes."""
        return values_digest(self.source.volumes)


@dataclass
class Resident(Field):
    """A field with its values in memory, which renders its own pictures.

    Attributes:
        source: the volume and its look.
        renderer: renders its pictures; None selects the field itself.
        device: "cpu" or "cuda", which renders them where it is the field itself.
        report: gets a line if the device fails.
    """

    source: StyledVolume
    renderer: ViewRenderer | None = None
    device: str = "cpu"
    report: Callable[[str], None] = print
    _drawn: dict[str, np.ndarray] = field(default_factory=dict)  # pixels of pictures' blocks, by `Picture.key`

    @cached_property
    def scene(self) -> Scene:
        """The volume under its look, laid out for the kernels: on first use, as a sky's light takes long."""
        return on_device(self.source.scene(), self.device, self.report)

    @cached_property
    def layout(self) -> PreparedVolume:
        """The scalar field, laid out for the kernels."""
        from vvgt_cli.dvr.scene import PreparedVolume

        return self.source.layout or PreparedVolume.of(self.source.volume)

    def workload(self, size: int, gaussians: int) -> Workload:
        """Implement `Field.workload`."""
        return measure(self.scene, size, gaussians)

    def pyramid(self, options: VbmOptions, progress: ProgressCallback | None = None) -> Start:
        """Implement `Field.pyramid`."""
        from vvgt_cli.closed_form import initialise

        return initialise(self.scene, options, progress)

    def expect(self, pictures: Sequence[Picture]) -> None:
        """Do nothing: each picture is rendered on request."""

    def view(self, camera: Camera, settings: RenderSettings, blocks: Blocks | None = None) -> np.ndarray:
        """Implement `ViewRenderer.view`."""
        from vvgt_cli.dvr import render_view

        if blocks is None:
            return render_view(self.scene, camera, settings)
        key = Picture(camera, settings, blocks).key
        if key in self._drawn:
            return blocks.image(self._drawn[key])
        image = render_view(self.scene, camera, settings, blocks)
        self._drawn[key] = image[blocks.mask()]
        return image

    def forget(self, picture: Picture) -> None:
        """Implement `ViewRenderer.forget`."""
        self._drawn.pop(picture.key, None)

    def normals(self, gaussians: Gaussians) -> np.ndarray | None:
        """Implement `Field.normals`."""
        if self.scene.light is None:
            return None
        from vvgt_cli.closed_form.lit import at_points, mean_normals

        return mean_normals(gaussians, lambda points: at_points(self.scene, points), self.scene.half)

    def sample(self, gaussians: Gaussians) -> np.ndarray:
        """Implement `Field.sample`."""
        from vvgt_cli.closed_form.gaussian_samples import in_voxels, samples_of, values_of

        self.source.require_scalar_field()
        scene, values = self.scene, np.empty((len(gaussians), 8), np.float32)
        nothing, dims = np.zeros(3, np.int64), np.array(self.source.volume.dims)
        for k in range(0, len(gaussians), AT_ONCE):
            part = gaussians.take(np.arange(k, min(k + AT_ONCE, len(gaussians))))
            where = in_voxels(part, scene.half, scene.step)
            samples = samples_of(scene.voxels, *where, nothing, nothing, dims, scene.step)
            values[k : k + len(part)] = values_of(*samples, part, self.layout.slope, self.layout.intercept)
        return values

    def with_look(self, source: StyledVolume) -> Resident:
        """Implement `Field.with_look`."""
        from vvgt_cli.volume import statistics

        if source.layers[0].volume is not self.source.layers[0].volume:
            source = replace(source, statistics=statistics(source.volume))
        gridded = source.gridded or self.source.gridded
        source = source if gridded else replace(source, layout=self.layout)
        return Resident(source, device=self.device, report=self.report)
