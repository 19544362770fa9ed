"""Anatomical spaces: bringing volumes to one, and axes in words.

A space is named by where its axes point: RAS+ (right, anterior, superior; NIfTI) or LPS+ (left, posterior, superior;
DICOM and ITK). The two differ by half a turn about the third axis.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.volume.types import Volume

SPACES = ("RAS", "LPS")
_OPPOSITE = {"R": "L", "L": "R", "A": "P", "P": "A", "S": "I", "I": "S"}
_WORDS = {"right": "R", "left": "L", "anterior": "A", "posterior": "P", "superior": "S", "inferior": "I"}
MILLIMETRES = {
    "m": 1e3, "meter": 1e3, "metre": 1e3, "cm": 10.0, "mm": 1.0, "millimeter": 1.0, "millimetre": 1.0,
    "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "micron": 1e-3, "microns": 1e-3, "micrometer": 1e-3, "nm": 1e-6,
}  # fmt: skip


def in_space(volume: Volume, wanted: str | None) -> Volume:
    """The volume with direction and origin in an anatomical space; as it is where its file states none.

    Args:
        volume: in the space that its format is in.
        wanted: one of `SPACES`; None: RAS where the volume has a space.

    Raises:
        UsageError: a space is wanted of a volume that has none.
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


def millimetres(unit: str) -> float:
    """Length of a unit in mm; 1 for an unknown one."""
    return MILLIMETRES.get(unit.strip().strip('"').lower(), 1.0)


def world_axis(name: str, space: str | None) -> str:
    """The signed axis (x, -x, ...) of a world direction: an anatomical word, or such an axis itself.

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
    """What `vvgt info` says of an affine (3 or 4, 4): where index axes run, their handedness, the numbers."""
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    return {
        "axes": dict(zip("ijk", axis_words(axes, space), strict=True)),
        "handedness": "right" if np.linalg.det(axes) > 0 else "left",
        "affine": affine[:3].tolist(),
    }


def axis_words(axes: np.ndarray, space: str | None) -> list[str]:
    """Where index axes i, j, k run: "L-R" is from left to right, "-y" against world y.

    An axis that is more than half a degree off the world axis nearest to it says by how many degrees.

    Args:
        axes: (3, 3) world directions of the index axes, unit vectors as columns.
        space: one of `SPACES`; anything else: the space is not anatomical.
    """
    found = []
    for column in axes.T:
        k = int(np.abs(column).argmax())
        along = column[k] > 0
        if space not in SPACES:
            word = ("" if along else "-") + "xyz"[k]
        else:
            ends = _OPPOSITE[space[k]], space[k]
            word = "-".join(ends if along else ends[::-1])
        off = float(np.degrees(np.arccos(min(abs(column[k]), 1.0))))
        found.append(f"{word} ({off:.0f} degrees off)" if off > 0.5 else word)
    return found


def shear_text(axes: np.ndarray) -> str:
    """The least angle between index axes, (3, 3) unit vectors as columns, as a line says it."""
    cosines = [abs(float(axes[:, a] @ axes[:, b])) for a, b in ((0, 1), (0, 2), (1, 2))]
    return f"index axes {np.degrees(np.arccos(min(max(cosines), 1.0))):.1f} degrees apart"
