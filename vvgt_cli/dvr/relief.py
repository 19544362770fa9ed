"""Extinction of label maps without its steps of voxels: what their normals are taken from."""

from __future__ import annotations

import numpy as np

from vvgt_cli.dvr.layout import Mixture, Voxels

REACH = 1  # voxels on either side that count
SLAB = 8  # slices that are filtered at once


class Shaded:
    """What rays shade: the values of a scene or of a box of voxels, and what their normals are taken from."""

    values: np.ndarray
    mixture: Mixture | None
    relief: np.ndarray | None

    @property
    def voxels(self) -> Voxels:
        """`values` as kernels take them."""
        return Voxels(self.values)

    @property
    def mixed(self) -> bool:
        """Whether rays meet layers of scalars."""
        return self.mixture is not None and self.mixture.scalars is not None

    @property
    def relieved(self) -> Voxels:
        """What the normals of texels are taken from: `relief`, or else `values`."""
        return Voxels(self.values if self.relief is None else self.relief)

    @property
    def shaded(self) -> Voxels:
        """What the normals of all matter are taken from: `relieved`, or `values` where there are scalars, too."""
        return self.voxels if self.mixed else self.relieved


def smoothed(extinction: np.ndarray) -> np.ndarray:
    """Return sums of extinction (nz, ny, nx) float32 over 3 x 3 x 3 voxels, read-only.

    Beyond an edge the edge voxels go on. Where all voxels are alike, so are the sums, to the bit.
    """
    nz, ny, nx = extinction.shape
    out = np.empty(extinction.shape, np.float32)
    for z in range(0, nz, SLAB):
        part = extinction
        for axis, (lo, hi, n) in enumerate(((z, min(z + SLAB, nz), nz), (0, ny, ny), (0, nx, nx))):
            wide = part.take(np.clip(np.arange(lo - REACH, hi + REACH), 0, n - 1), axis).swapaxes(0, axis)
            part = (wide[:-2] + wide[2:] + wide[1:-1]).swapaxes(0, axis)
        out[z : z + SLAB] = part
    out.flags.writeable = False
    return out
