"""Transforms between the box frame of a run and the unit frame of files, and the up axis of viewers."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.frames import rescale, transform, upright_matrix
from vvgt_cli.gaussians.live import LENGTH
from vvgt_cli.volume import UnitFrame, Volume
from vvgt_cli.volume.space import shear_text, world_axis

if TYPE_CHECKING:
    from vvgt_cli.score.viewing import Axes

AUTO, NONE = "auto", "none"


def up_axis(up: str, frame: str, space: str | None) -> str:
    """Return the world axis that viewers show upwards; `AUTO` is superior in the unit frame of an anatomical space.

    Args:
        up: a world axis, an anatomical direction, `AUTO` or `NONE`.
        frame: frame of the file; in "world", positions match other data, and `AUTO` is `NONE`.
        space: anatomical space of the volume, or None.

    Raises:
        UsageError: an anatomical direction where the space is not.
    """
    if up == AUTO:
        up = "superior" if space is not None and frame == "unit" else NONE
    return world_axis(up, space)


def to_unit_frame(gaussians: Gaussians, volume: Volume) -> Gaussians:
    """Transform Gaussians from the box frame of the volume to its unit frame."""
    return transform(gaussians, volume.axes)


def to_box_frame(gaussians: Gaussians, volume: Volume) -> Gaussians:
    """Transform Gaussians from the unit frame of the volume to its box frame."""
    axes = volume.axes
    aligned = np.array_equal(axes, np.eye(3))
    return gaussians if aligned else transform(gaussians, np.linalg.inv(axes))


def to_frame_of(gaussians: Gaussians, frame: UnitFrame, target: UnitFrame) -> Gaussians:
    """Transform Gaussians, and the lengths that they carry, from the unit frame of one volume to that of another."""
    before, factor = frame.scale * (np.array(frame.centre) - np.array(target.centre)), target.scale / frame.scale
    moved = rescale(gaussians, factor, before, np.zeros(3))
    if gaussians.live is None:
        return moved
    live = gaussians.live.copy()
    live[:, LENGTH] *= factor
    return replace(moved, live=live)


def with_place(ply: PlyOptions, volume: Volume) -> PlyOptions:
    """Return the layout of a file with the place of the volume."""
    frame = volume.unit_frame()
    return replace(
        ply,
        scale=frame.scale,
        centre=frame.centre,
        space=volume.space or NONE,
        length_unit=(volume.unit or None) if volume.space is None else None,
        affine=tuple(volume.affine[:3].ravel().tolist()),
    )


def placement_warnings(volume: Volume, ply: PlyOptions) -> list[str]:
    """Return warnings about the place of a volume: sheared axes, or a rotation that the file will not record."""
    warnings = []
    if volume.sheared:
        warnings.append(
            f"{volume.name}: {shear_text(volume.axes)} (a tilted gantry?): Gaussians are sheared with them; opacity "
            "stays per length along the index axes, and pictures are of the volume unsheared"
        )
    if not ply.comments and (ply.up != NONE or ply.frame != "unit"):
        warnings.append(
            f"--no-comments: the file will not record that it is in the {ply.frame} frame with up {ply.up}; "
            "'vvgt evaluate' and 'vvgt render' will assume the unit frame with up none"
        )
    return warnings


def upright_axes(volume: Volume, up: str) -> np.ndarray:
    """Return the (3, 3) matrix from the box frame to the frame of previews: world directions with ``up`` along +z."""
    return upright_matrix(up) @ volume.axes


def headset_axes(volume: Volume, up: str) -> Axes:
    """Return the rows of `upright_axes` with what is up in a viewer along +z; without an ``up`` that is PLY -y."""
    return tuple(map(tuple, upright_axes(volume, "-y" if up == NONE else up).tolist()))
