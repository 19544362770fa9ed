"""`Gaussians`: a set of 3D Gaussians in the parametrisation of standard 3DGS files."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vvgt_cli.errors import DataError

SH_C0 = 0.28209479177387814  # rgb = 0.5 + SH_C0 * f_dc
HARMONICS = {0: 0, 1: 3, 2: 8, 3: 15}  # coefficients per channel by degree, without degree 0's
_WIDTHS = {"means": 3, "log_scales": 3, "quaternions": 4, "opacity_logits": 0, "colors": 3}


@dataclass(frozen=True)
class Gaussians:
    """K Gaussians, a float32 struct of arrays, in the unit frame unless stated otherwise.

    Attributes:
        means: (K, 3) centres.
        log_scales: (K, 3) natural logs of the standard deviations along the principal axes.
        quaternions: (K, 4) rotation (w, x, y, z), of any non-zero norm.
        opacity_logits: (K,) logit of the peak alpha.
        colors: (K, 3) RGB in display space, 0.5 + SH_C0 * f_dc; may lie outside [0, 1].
        harmonics: (K, M, 3) view-dependent RGB, added to the colour by direction from the eye to the centre, as M = 3,
            8 or 15 coefficients in the order of `vvgt_cli.gaussians.frames.basis`; None for none.
        live: (K, 9) carried values, for a look under any function (`vvgt_cli.gaussians.live`): mean and spread of the
            data value, length in the unit frame, axis of the normals with their concentration as its length, and
            gradient direction with the share of the spread that it explains as its length; (K, 10) for a label map,
            with the row of the label; (K, 11) for several layers, with the number of the layer last; None for a fixed
            look.

    Raises:
        DataError: an array has the wrong shape, or a value is not finite.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacity_logits: np.ndarray
    colors: np.ndarray
    harmonics: np.ndarray | None = None
    live: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Convert the arrays to contiguous float32 and check them."""
        count = len(self.means)
        shapes: dict[str, list[tuple[int, ...]]] = {f: [(count, n) if n else (count,)] for f, n in _WIDTHS.items()}
        if self.harmonics is not None:
            shapes["harmonics"] = [(count, terms, 3) for terms in HARMONICS.values() if terms]
        if self.live is not None:
            shapes["live"] = [(count, n) for n in (9, 10, 11)]
        for field, expected in shapes.items():
            array = np.ascontiguousarray(getattr(self, field), dtype=np.float32)
            if array.shape not in expected:
                raise DataError(f"Gaussians.{field}: shape {array.shape}; expected {' or '.join(map(str, expected))}")
            if not np.isfinite(array).all():
                bad = int(np.count_nonzero(~np.isfinite(array).reshape(count, -1).all(axis=1)))
                raise DataError(f"Gaussians.{field}: {bad} of {count} rows are not finite; expected finite values")
            object.__setattr__(self, field, array)

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        terms = 0 if self.harmonics is None else self.harmonics.shape[1]
        return next(degree for degree, count in HARMONICS.items() if count == terms)

    @property
    def opacity(self) -> np.ndarray:
        """Peak alpha (K,) float64."""
        return 1 / (1 + np.exp(-np.clip(self.opacity_logits.astype(np.float64), -700, 700)))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return every array that is present, by name, in the order of the fields."""
        columns = {field: getattr(self, field) for field in (*_WIDTHS, "harmonics", "live")}
        return {field: array for field, array in columns.items() if array is not None}

    def take(self, index: np.ndarray) -> Gaussians:
        """Return the subset or permutation that ``index`` selects."""
        return Gaussians(**{field: array[index] for field, array in self.arrays().items()})

    def of_degree(self, degree: int) -> Gaussians:
        """Return the Gaussians with harmonics up to ``degree``, 0 to 3: missing ones are zeros, higher ones dropped."""
        if degree == self.degree:
            return self
        terms = np.zeros((len(self), HARMONICS[degree], 3), np.float32)
        if self.harmonics is not None:
            shared = min(terms.shape[1], self.harmonics.shape[1])
            terms[:, :shared] = self.harmonics[:, :shared]
        return replace(self, harmonics=terms if degree else None)


NOTHING = Gaussians(*(np.zeros((0, width) if width else 0) for width in _WIDTHS.values()))


def concatenate(parts: list[Gaussians]) -> Gaussians:
    """Concatenate sets of Gaussians of the same degree."""
    fields = parts[0].arrays()
    return Gaussians(**{field: np.concatenate([getattr(part, field) for part in parts]) for field in fields})
