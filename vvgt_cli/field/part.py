"""The voxels of a box of a volume, which render their own pictures (`VolumePart`)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vvgt_cli.cameras import Blocks, Camera
from vvgt_cli.dvr.layout import Light
from vvgt_cli.dvr.render import BoxFrame, RenderSettings, camera_arrays, for_thin, tiers
from vvgt_cli.field.rays import HALO, LONGEST, Bundle, caster, meeting
from vvgt_cli.field.reader import Layers, Scalars, VoxelBox
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.frames import rescale

REACH = 16  # voxels around a part that may hide it
PART_RADIUS = 1.25  # of a part in its frame: half its diagonal; the default views show all but its corners


class VolumePart:
    """The voxels of a box, cut out of a volume: a ray is transparent before and behind them.

    Its frame is centred on the box, with the directions of the volume's box frame, scaled so that half the diagonal is
    `PART_RADIUS`.

    Attributes:
        centre: (3,) centre in the volume's box frame.
        scale: lengths in its frame per length in the unit frame.
    """

    def __init__(
        self, reader: Scalars | Layers, frame: BoxFrame, dims: tuple[int, int, int], lo: np.ndarray, hi: np.ndarray,
        light: Light | None = None,
    ) -> None:  # fmt: skip
        """Read the voxels ``lo`` to ``hi`` (3,), x first, of a volume of ``dims`` voxels with this ``frame``."""
        halo = REACH + HALO
        self.box: VoxelBox = reader.box(np.maximum(lo - halo, 0), np.minimum(hi + halo, dims))
        self._lo, self._hi, self._dims, self._frame, self._light = lo, hi, dims, frame, light
        self.centre = (lo + hi) / 2 * frame.step - frame.half
        self.scale = PART_RADIUS / float(np.linalg.norm((hi - lo) / 2 * frame.step))
        self._empty = self.box.empty()

    @property
    def views(self) -> VolumePart:
        """The renderer of its pictures, as `vvgt_cli.field.field.Field.views`."""
        return self

    def view(
        self, camera: Camera, settings: RenderSettings, blocks: Blocks | None = None, grown: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Render a picture (h, w, 4) of the part, as `render_view` does.

        Args:
            camera: camera in the part's frame.
            settings: settings of the rays.
            blocks: blocks to render, None for all.
            grown: voxels along each axis by which the faces that cut the volume move outwards, at most `REACH`; a box
                without extent is transparent.
        """
        eye, basis, lens = self._arrays(camera)
        lo = np.where(self._lo > 0, self._lo - grown, 0.0)
        hi = np.where(self._hi < self._dims, self._hi + grown, self._dims)
        cast = caster(self.box, self._empty, lo, hi, self._dims, self._light)
        out = np.zeros((camera.height, camera.width, 4), np.float32)
        box = BoxFrame((self._hi - self._lo) / 2 * self._frame.step * self.scale, self._frame.step * self.scale)
        for rays in tiers(for_thin(settings, box, camera), out, blocks):
            for offsets, mask, known in rays:
                row, column = np.nonzero(mask)
                pixels = np.stack([column, row], axis=1)
                bundle = Bundle(eye, basis, lens, min(settings.step, LONGEST), pixels, offsets)
                near = meeting(bundle, lo - 0.5, hi - 0.5)
                sums = np.zeros((len(pixels), 4))
                sums[near] = cast(bundle, near).sum(axis=1)
                out[row, column] = (known * out[row, column] + sums) / (known + len(offsets))
        return out

    def shown(self, camera: Camera) -> np.ndarray:
        """Return the share (h, w) float32 of each pixel's light from the part that passes the voxels before it.

        Voxels up to `REACH` before the part count: where its faces lie inside a body, other parts hide them.
        """
        eye, basis, lens = self._arrays(camera)
        column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        pixels = np.stack([column.ravel(), row.ravel()], axis=1)
        bundle = Bundle(eye, basis, lens, LONGEST, pixels, np.zeros((1, 2)))
        through = np.ones(len(pixels), np.float32)
        for lo, hi in self._before(eye):
            near = meeting(bundle, lo - 0.5, hi - 0.5)
            seen = caster(self.box, self._empty, lo, hi, self._dims, self._light)(bundle, near)
            through[near] *= 1 - seen[:, 0, 3]
        return through.reshape(camera.height, camera.width)

    def weights(self, camera: Camera, width: float) -> np.ndarray:
        """Return (h, w) factors by which errors of a part's picture count in pictures of the volume.

        They are `shown`, and lower where the picture changes with the place of the faces that cut the volume: Gaussians
        reach over these, and only those of both sides together show what is there. Faces move by an eighth of the part
        at most. Two by two pixels have a factor in common.

        Args:
            camera: camera in the part's frame, with an even number of pixels along each edge.
            width: length by which Gaussians reach over a face, in the part's frame.
        """
        grown = np.minimum(width / (self._frame.step * self.scale), np.minimum((self._hi - self._lo) / 8, REACH))
        single = RenderSettings(step=LONGEST, samples=1)
        half = camera.resized(0.5)
        inner, outer = (self.view(half, single, grown=by) for by in (-grown, grown))
        weights: np.ndarray = self.shown(half) * (1 - np.abs(outer - inner).max(axis=2))
        return weights.repeat(2, axis=0).repeat(2, axis=1)

    def _before(self, eye: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield boxes of voxels (first, end) that rays from an eye, in voxels, may pass before they enter the part.

        A ray has entered once it has passed the near face of each axis, so that the boxes, one an axis, do not overlap.
        """
        lo, hi = np.maximum(self._lo - REACH, 0), np.minimum(self._hi + REACH, self._dims)
        for axis in range(3):
            first, end = lo.copy(), hi.copy()
            if eye[axis] < self._lo[axis] - 0.5:
                end[axis] = lo[axis] = self._lo[axis]
            elif eye[axis] > self._hi[axis] - 0.5:
                first[axis] = hi[axis] = self._hi[axis]
            else:
                continue
            if (first < end).all():
                yield first, end

    def _arrays(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return `camera_arrays` of a camera in the part's frame, in voxels of the volume."""
        frame = BoxFrame(self._frame.half * self.scale, self._frame.step * self.scale)
        eye, basis, lens = camera_arrays(frame, camera)
        return eye + self.centre / self._frame.step, basis * self.scale, lens

    def moved_in(self, gaussians: Gaussians) -> Gaussians:
        """Return Gaussians of the volume's box frame in the part's frame."""
        return rescale(gaussians, self.scale, -self.centre, np.zeros(3))

    def moved_out(self, gaussians: Gaussians) -> Gaussians:
        """Return Gaussians of the part's frame in the volume's box frame."""
        return rescale(gaussians, 1 / self.scale, np.zeros(3), self.centre)
