"""`Gaussians`: a set of 3D Gaussians as standard 3DGS files parametrise them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vvgt_cli.errors import DataError

SH_C0 = 0.28209479177387814  # rgb = 0.5 + SH_C0 * f_dc


@dataclass(frozen=True)
class Gaussians:
    """K Gaussians, float32 struct of arrays, unit frame unless a writer says otherwise.

    Attributes:
        means: (K, 3) centres.
        log_scales: (K, 3) natural logs of the standard deviations along the principal axes.
        quaternions: (K, 4) rotation (w, x, y, z), of any non-zero norm.
        opacity_logits: (K,) logit of the peak alpha.
        colors: (K, 3) RGB in display space, 0.5 + SH_C0 * f_dc; may lie outside [0, 1].

    Raises:
        DataError: wrong shapes, or a value that is not finite.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacity_logits: np.ndarray
    colors: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.means)
        expected = {"means": 3, "log_scales": 3, "quaternions": 4, "opacity_logits": 0, "colors": 3}
        for field, width in expected.items():
            array = np.ascontiguousarray(getattr(self, field), dtype=np.float32)
            shape = (count, width) if width else (count,)
            if array.shape != shape:
                raise DataError(f"Gaussians.{field}: shape {array.shape}; expected {shape}")
            if not np.isfinite(array).all():
                bad = int(np.count_nonzero(~np.isfinite(array).reshape(count, -1).all(axis=1)))
                raise DataError(f"Gaussians.{field}: {bad} of {count} rows are not finite")
            object.__setattr__(self, field, array)

    def __len__(self) -> int:
        return len(self.means)

    def take(self, index: np.ndarray) -> Gaussians:
        """The subset (or permutation) that ``index`` selects."""
        return Gaussians(
            self.means[index],
            self.log_scales[index],
            self.quaternions[index],
            self.opacity_logits[index],
            self.colors[index],
        )
