"""`Gaussians`: a set of 3D Gaussians as standard 3DGS files parametrise them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vvgt_cli.errors import DataError

SH_C0 = 0.28209479177387814  # rgb = 0.5 + SH_C0 * f_dc
HARMONICS = {0: 0, 1: 3, 2: 8, 3: 15}  # coefficients a channel up to a degree, without degree 0's
_WIDTHS = {"means": 3, "log_scales": 3, "quaternions": 4, "opacity_logits": 0, "colors": 3}


@dataclass(frozen=True)
class Gaussians:
    """K Gaussians, float32 struct of arrays, unit frame unless a writer says otherwise.

    Attributes:
        means: (K, 3) centres.
        log_scales: (K, 3) natural logs of the standard deviations along the principal axes.
        quaternions: (K, 4) rotation (w, x, y, z), of any non-zero norm.
        opacity_logits: (K,) logit of the peak alpha.
        colors: (K, 3) RGB in display space, 0.5 + SH_C0 * f_dc; may lie outside [0, 1].
        harmonics: (K, M, 3) what is added to the colour by the direction from the eye to the centre, RGB, M = 3, 8 or
            15 coefficients as `vvgt_cli.gaussians.harmonics.basis` orders them; None: the same from everywhere.
        live: (K, 6) what they can be shown by under any function (`vvgt_cli.gaussians.live`): mean and spread of the
            data value under each, its length in the unit frame, and the direction of the gradient, as long as the share
            of the spread that it explains; (K, 7) of a label map: then the row of the label; (K, 8) of
            several layers: last the number of the layer; None: one look.

    Raises:
        DataError: wrong shapes, or a value that is not finite.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacity_logits: np.ndarray
    colors: np.ndarray
    harmonics: np.ndarray | None = None
    live: np.ndarray | None = None

    def __post_init__(self) -> None:
        count = len(self.means)
        shapes: dict[str, list[tuple[int, ...]]] = {f: [(count, n) if n else (count,)] for f, n in _WIDTHS.items()}
        if self.harmonics is not None:
            shapes["harmonics"] = [(count, terms, 3) for terms in HARMONICS.values() if terms]
        if self.live is not None:
            shapes["live"] = [(count, n) for n in (6, 7, 8)]
        for field, expected in shapes.items():
            array = np.ascontiguousarray(getattr(self, field), dtype=np.float32)
            if array.shape not in expected:
                raise DataError(f"Gaussians.{field}: shape {array.shape}; expected {' or '.join(map(str, expected))}")
            if not np.isfinite(array).all():
                bad = int(np.count_nonzero(~np.isfinite(array).reshape(count, -1).all(axis=1)))
                raise DataError(f"Gaussians.{field}: {bad} of {count} rows are not finite")
            object.__setattr__(self, field, array)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Of the spherical harmonics, 0 to 3."""
        terms = 0 if self.harmonics is None else self.harmonics.shape[1]
        return next(degree for degree, count in HARMONICS.items() if count == terms)

    def arrays(self) -> dict[str, np.ndarray]:
        """Every field that is there, by name, in the order of the fields."""
        found = {field: getattr(self, field) for field in (*_WIDTHS, "harmonics", "live")}
        return {field: array for field, array in found.items() if array is not None}

    def take(self, index: np.ndarray) -> Gaussians:
        """The subset (or permutation) that ``index`` selects."""
        return Gaussians(**{field: array[index] for field, array in self.arrays().items()})

    def of_degree(self, degree: int) -> Gaussians:
        """With harmonics up to ``degree``, 0 to 3: zeros where there are none, those above it left out."""
        if degree == self.degree:
            return self
        terms = np.zeros((len(self), HARMONICS[degree], 3), np.float32)
        if self.harmonics is not None:
            shared = min(terms.shape[1], self.harmonics.shape[1])
            terms[:, :shared] = self.harmonics[:, :shared]
        return replace(self, harmonics=terms if degree else None)


def concatenate(parts: list[Gaussians]) -> Gaussians:
    """One set of several, of one degree, in their order."""
    fields = parts[0].arrays()
    return Gaussians(**{field: np.concatenate([getattr(part, field) for part in parts]) for field in fields})
