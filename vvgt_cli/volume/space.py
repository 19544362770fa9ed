"""Positions of volumes: index axes, anatomical spaces and units of length.

A space is named by where its axes point: RAS+ (right, anterior, superior; NIfTI) or LPS+ (left, posterior, superior;
DICOM and ITK). The two differ by half a turn about the third axis.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.volume.options import ReadOptions
from vvgt_cli.volume.stored import Stored
from vvgt_cli.volume.types import IDENTITY, Volume, triple

SPACES = ("RAS", "LPS")
_OPPOSITE = {"R": "L", "L": "R", "A": "P", "P": "A", "S": "I", "I": "S"}
_WORDS = {"right": "R", "left": "L", "anterior": "A", "posterior": "P", "superior": "S", "inferior": "I"}
METRES = {  # length of a unit in metres, its short name, and others
    1e3: ("km", "kilometer", "kilometre"), 1.0: ("m", "meter", "metre"), 1e-2: ("cm", "centimeter", "centimetre"),
    1e-3: ("mm", "millimeter", "millimetre"), 1e-6: ("um", "µm", "micron", "micrometer", "micrometre"),
    1e-9: ("nm", "nanometer", "nanometre"), 1e-10: ("angstrom", "Å"), 1e-12: ("pm", "picometer", "picometre"),
}  # fmt: skip
MILLIMETRE, MICROMETRE = 1e-3, 1e-6
_LENGTHS = {name: metres for metres, names in METRES.items() for name in names}


def unit_rows(vectors: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the lengths of three axes (3, 3), one a row, and the row-major matrix with unit axes as columns."""
    rows = np.asarray(vectors).tolist()
    lengths = tuple(math.hypot(*row) for row in rows)
    unit = [[c / n if n > 0 else float(i == k) for k, c in enumerate(row)]
            for i, (row, n) in enumerate(zip(rows, lengths, strict=True))]  # fmt: skip
    return lengths, tuple(unit[column][row] for row in range(3) for column in range(3))


def placed(field: Any, steps: Any, origin: Any, options: ReadOptions, name: str, **facts: Any) -> Volume:
    """Make the volume of a field whose index axes step along given vectors.

    ``steps`` (3, 3) are the world vectors of a step along x, y and z, one a row, and ``origin`` is the centre of the
    first voxel. ``options.spacing`` replaces the lengths of the steps; ``facts`` are other attributes of `Volume`.
    """
    spacing, direction = unit_rows(steps)
    first = tuple(np.asarray(origin, np.float64).tolist())
    return Volume(field, options.spacing_or(spacing), first, direction, name, **facts)


def in_space(volume: Volume, wanted: str | None) -> Volume:
    """Bring direction and origin to a space (of `SPACES`; None: RAS); leave them where the file states no space.

    Raise UsageError if one is ``wanted`` then.
    """
    if volume.space is None:
        if wanted is not None:
            raise UsageError(
                f"--space {wanted}: {volume.name} states no anatomical space; leave it out (NIfTI with an sform or "
                "qform, DICOM, and NRRD and MetaImage that name a space have one)"
            )
        return volume
    wanted = wanted or "RAS"
    if wanted == volume.space:
        return volume
    signs = (-1.0, -1.0, 1.0)
    direction = tuple(signs[k // 3] * v + 0.0 for k, v in enumerate(volume.direction))  # + 0.0: no -0
    origin = tuple(s * o + 0.0 for s, o in zip(signs, volume.origin, strict=True))
    return replace(volume, direction=direction, origin=origin, space=wanted)


def beside(volume: Volume, other: Volume) -> Volume:
    """Return a volume with its place in the anatomical space and the unit of length of another, if both state one."""
    if volume.space and other.space:
        return in_space(volume, other.space)
    own, its = metres(volume.unit), metres(other.unit)
    if volume.space or other.space or not (own and its) or own == its:
        return volume
    spacing, origin = (triple(v * own / its for v in lengths) for lengths in (volume.spacing, volume.origin))
    return replace(volume, spacing=spacing, origin=origin, unit=other.unit)


def laid(mask: Volume, volume: Volume) -> Volume | None:
    """Return a mask with its index axes in the order and directions of a volume's, if it has these axes in memory.

    Return None where one of both states no place, or not in the same space: then voxels are all that compares. A mask
    that states the defaults of files, under which it does not fit, has lost its place, which a warning says.
    """
    lost = (np.abs(mask.affine) == np.eye(4)).all()
    mask = beside(mask, volume)
    stated = [bool(v.space or any(v.origin) or v.direction != IDENTITY) for v in (mask, volume)]
    if not all(stated) or mask.space != volume.space:
        return None
    signs = np.rint(np.linalg.inv(mask.axes) @ volume.axes)
    across = np.abs(signs)
    if (across.sum(0) == 1).all() and (across.sum(1) == 1).all() and not isinstance(mask.data, Stored):
        flips = tuple(slice(None, None, -1 if sign < 0 else 1) for sign in signs.sum(0)[::-1])
        data = mask.data.transpose([2 - k for k in across.argmax(0)[::-1]])[flips]
        lengths = np.array(mask.spacing) @ across
        first = mask.affine @ [*np.where(signs.sum(1) < 0, np.array(mask.dims) - 1, 0), 1]
        turned = tuple((mask.affine[:3, :3] @ signs / lengths).ravel().tolist())
        mask = replace(mask, data=data, spacing=triple(lengths), origin=tuple(first[:3].tolist()), direction=turned)
    if lost and not mask.on_grid(volume):
        warnings.warn(f"--mask {mask.name}: states no place; applied voxel by voxel", stacklevel=3)
        return None
    return mask


def metres(unit: str) -> float | None:
    """Return the length of a unit in metres, None for a name that is not a unit of length."""
    word = unit.strip().replace("\u03bc", "µ")
    singular = word.lower().rstrip("s") if len(word) > 2 else ""  # "ms" is milliseconds
    return next((_LENGTHS[w] for w in (word, word.lower(), singular) if w in _LENGTHS), None)


def unit_name(length: float | None) -> str:
    """Return the short name of the unit of a length in metres, "" where there is no such unit."""
    return METRES[length][0] if length in METRES else ""


def one_unit(units: Sequence[str], source: str, spacing_given: bool) -> tuple[np.ndarray, str]:
    """Find the factors that bring lengths along several axes to one unit.

    ``units`` are those of the axes, as the file writes them, "" where it states none. They need not compare where the
    caller has given the spacing.

    Returns:
        Factors (n,) float64, and the short name of the unit of the first axis that states one, "" if none does or it is
        not a length (with a warning).

    Raises:
        UsageError: units that do not compare.
    """
    stated = [unit for unit in units if unit.strip()]
    lengths = [metres(unit) for unit in stated]
    if len(set(lengths)) > 1 and None in lengths and not spacing_given:
        raise UsageError(f"{source}: lengths in {', '.join(stated)}; expected one unit of length: try --spacing X Y Z")
    if not stated or None in lengths:
        if stated:
            warnings.warn(f"{source}: unit {stated[0]!r} is not a known unit of length; numbers are kept", stacklevel=3)
        return np.ones(len(units)), ""
    base = lengths[0] or 1.0
    return np.array([(metres(unit) or base) / base for unit in units]), unit_name(base)


def world_axis(name: str, space: str | None) -> str:
    """Return the signed axis (x, -x, ...) of a world direction: an anatomical word, or such an axis itself.

    Raises:
        UsageError: an anatomical word where the space is not.
    """
    if name not in _WORDS:
        return name
    if space is None:
        raise UsageError(f"--up {name}: the volume states no anatomical space; try x, -x, y, -y, z or -z")
    letter = _WORDS[name]
    for axis, towards in zip("xyz", space, strict=True):
        if letter in (towards, _OPPOSITE[towards]):
            return axis if letter == towards else f"-{axis}"
    raise ValueError(name)


def axis_facts(affine: np.ndarray, space: str | None) -> dict[str, object]:
    """Describe an affine (3 or 4, 4) for `vvgt info`: where index axes run, their handedness, the numbers."""
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    return {
        "axes": dict(zip("ijk", axis_words(axes, space), strict=True)),
        "handedness": "right" if np.linalg.det(axes) > 0 else "left",
        "affine": affine[:3].tolist(),
    }


def axis_words(axes: np.ndarray, space: str | None) -> list[str]:
    """Describe where index axes i, j, k run: "L-R" is from left to right, "-y" against world y.

    ``axes`` (3, 3) are unit vectors in columns. One more than half a degree off the nearest world axis says by how
    many.
    """
    words = []
    for column in axes.T:
        k = int(np.abs(column).argmax())
        along = column[k] > 0
        if space not in SPACES:
            word = ("" if along else "-") + "xyz"[k]
        else:
            ends = _OPPOSITE[space[k]], space[k]
            word = "-".join(ends if along else ends[::-1])
        off = float(np.degrees(np.arccos(min(abs(column[k]), 1.0))))
        words.append(f"{word} ({off:.0f} degrees off)" if off > 0.5 else word)
    return words


def shear_text(axes: np.ndarray) -> str:
    """Describe the least angle between index axes, (3, 3) unit vectors as columns."""
    cosines = [abs(float(axes[:, a] @ axes[:, b])) for a, b in ((0, 1), (0, 2), (1, 2))]
    return f"index axes {np.degrees(np.arccos(min(max(cosines), 1.0))):.1f} degrees apart"
