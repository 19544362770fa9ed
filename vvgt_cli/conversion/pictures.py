"""A cache of pictures for a series: only blocks of pixels that differ from the previous frame are drawn again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.blocks import BLOCK, Blocks
from vvgt_cli.conversion.changes import Changes
from vvgt_cli.field.field import Picture, ViewRenderer

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings


class RememberedViews:
    """Views of a frame that reuse unchanged blocks of pixels of the previous frame.

    Attributes:
        largest: pixels along an edge; larger pictures are not cached.
        views: views of the frame that is being converted.
    """

    def __init__(self, largest: int, views: ViewRenderer | None = None) -> None:
        """Start with an empty cache."""
        self.largest, self.views = largest, views
        self._kept: dict[str, tuple[Camera, np.ndarray, np.ndarray]] = {}  # camera, picture, (rows, columns) bool

    def expect(self, pictures: Sequence[Picture]) -> None:
        """Implement `ViewRenderer.expect`."""
        missing = [picture._replace(blocks=self.missing(picture)) for picture in pictures]
        assert self.views is not None
        self.views.expect([one for one in missing if one.blocks is None or len(one.blocks.numbers)])

    def view(self, camera: Camera, settings: RenderSettings, blocks: Blocks | None = None) -> np.ndarray:
        """Implement `ViewRenderer.view`."""
        picture = Picture(camera, settings, blocks)
        missing = self.missing(picture)
        if missing is not None and not len(missing.numbers):
            image = np.zeros((camera.height, camera.width, 4), np.float32)
        else:
            assert self.views is not None
            image = self.views.view(camera, settings, missing)
        return self.put(picture, missing, image)

    def forget(self, picture: Picture) -> None:
        """Keep the picture, for the next frame."""

    def invalidate(self, changes: Changes | None) -> None:
        """Discard cached blocks that show a change; None discards all pictures."""
        if changes is None:
            self._kept.clear()
        for camera, _, known in self._kept.values():
            known &= ~changes.seen_by(camera) if changes else False

    def last(self, view: Picture) -> np.ndarray | None:
        """Return a cached picture (h, w, 4), whose blocks may be of different frames; None without one."""
        found = self._kept.get(_key(view))
        return None if found is None else found[1].copy()

    def new_bytes(self, views: Sequence[Picture]) -> int:
        """Return the bytes that caching ``views`` would add."""
        sizes = {_key(view): (view.camera.width, view.camera.height) for view in views}
        return sum(16 * w * h for key, (w, h) in sizes.items() if key not in self._kept and max(w, h) <= self.largest)

    def missing(self, view: Picture) -> Blocks | None:
        """Return the blocks of a picture that have to be drawn; None for the whole."""
        found = self._kept.get(_key(view))
        if found is None:
            return view.blocks
        numbers = np.flatnonzero(~found[2]) if view.blocks is None else view.blocks.numbers
        return Blocks(view.camera.width, view.camera.height, numbers[~found[2].ravel()[numbers]])

    def put(self, view: Picture, drawn: Blocks | None, image: np.ndarray) -> np.ndarray:
        """Cache the blocks ``drawn`` in ``image`` (h, w, 4), and return the picture with the cached ones."""
        camera, key = view.camera, _key(view)
        if max(camera.width, camera.height) > self.largest:
            return image
        if key not in self._kept:
            known = np.zeros((-(-camera.height // BLOCK), -(-camera.width // BLOCK)), bool)
            self._kept[key] = camera, np.zeros_like(image), known
        _, whole, known = self._kept[key]
        mask = np.ones(image.shape[:2], bool) if drawn is None else drawn.mask()
        whole[mask] = image[mask]
        known.flat[slice(None) if drawn is None else drawn.numbers] = True
        if view.blocks is None:
            return whole.copy()
        return np.where(view.blocks.mask()[..., None], whole, np.float32(0))


def _key(view: Picture) -> str:
    return view._replace(blocks=None).key
