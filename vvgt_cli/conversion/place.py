"""Between the box frame, where a run's Gaussians are, and the unit frame of files: which way round and which way up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.boxed import render_in_box
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.frames import rescale, transform, upright_matrix
from vvgt_cli.gaussians.live import LENGTH
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.volume import Volume
from vvgt_cli.volume.space import shear_text, world_axis

if TYPE_CHECKING:
    from vvgt_cli.dvr import Scene
    from vvgt_cli.dvr.render import Viewed

AUTO, NONE = "auto", "none"


def up_axis(up: str, frame: str, space: str | None) -> str:
    """World axis that viewers show upwards: superior for `AUTO` in the unit frame of an anatomical space, else `NONE`.

    Args:
        up: a world axis, an anatomical direction, `AUTO` or `NONE`.
        frame: of the file: positions in "world" stay what they are beside other data, unless a turn is asked for.
        space: of the volume, None where it is not anatomical.

    Raises:
        UsageError: an anatomical direction where the space is not.
    """
    if up == AUTO:
        up = "superior" if space is not None and frame == "unit" else NONE
    return world_axis(up, space)


def to_unit_frame(gaussians: Gaussians, volume: Volume) -> Gaussians:
    """Gaussians of the volume's box frame in its unit frame."""
    return transform(gaussians, volume.axes)


def to_box_frame(gaussians: Gaussians, volume: Volume) -> Gaussians:
    """Gaussians of the volume's unit frame in its box frame."""
    axes = volume.axes
    straight = np.array_equal(axes, np.eye(3))
    return gaussians if straight else transform(gaussians, np.linalg.inv(axes))


def to_frame_of(gaussians: Gaussians, volume: Volume, other: Volume) -> Gaussians:
    """Gaussians of a volume's unit frame in that of another; the lengths that they carry, too."""
    own, its = volume.unit_frame(), other.unit_frame()
    before, factor = own.scale * (np.array(own.centre) - np.array(its.centre)), its.scale / own.scale
    moved = rescale(gaussians, factor, before, np.zeros(3))
    if gaussians.live is None:
        return moved
    live = gaussians.live.copy()
    live[:, LENGTH] *= factor
    return replace(moved, live=live)


def with_place(ply: PlyOptions, volume: Volume) -> PlyOptions:
    """The layout of a file, with the records of where the volume is."""
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
    """What there is to say of a volume's place before the work: sheared axes, a turn that the file will not record."""
    said = []
    if volume.sheared:
        said.append(
            f"{volume.name}: {shear_text(volume.axes)} (a tilted gantry?): Gaussians are sheared with them; opacity "
            "stays per length along the index axes, and pictures are of the volume unsheared"
        )
    if not ply.comments and (ply.up != NONE or ply.frame != "unit"):
        said.append(
            f"--no-comments: nothing in the file will say that it is in the {ply.frame} frame with up {ply.up}; "
            "'vvgt evaluate' and 'vvgt render' will take it as the unit frame with up none"
        )
    return said


def upright_axes(volume: Volume, up: str) -> np.ndarray:
    """(3, 3): box frame to a frame with world directions in which ``up`` is +z; what previews are seen in."""
    result: np.ndarray = upright_matrix(up) @ volume.axes
    return result


def preview(
    scene: Scene | Viewed, gaussians: Gaussians, cameras: Sequence[Camera], axes: np.ndarray, rule: str | Rule = INRIA
) -> np.ndarray:
    """Reference, ours and their difference, a row a camera of the frame that ``axes`` (`upright_axes`) leads to."""
    from vvgt_cli.dvr import RenderSettings, render_view
    from vvgt_cli.images import side_by_side
    from vvgt_cli.splat import render

    reference = render_in_box(lambda camera: render_view(scene, camera, RenderSettings()), axes)
    ours = render_in_box(lambda camera: render(gaussians, camera, rule), axes)
    return np.concatenate([side_by_side(reference(camera), ours(camera)) for camera in cameras])
