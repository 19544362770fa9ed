"""Viewing conditions: every rule of `vvgt_cli.gaussians.rules`, several sizes, from afar and close up."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vvgt_cli.cameras import FIELD_OF_VIEW, Camera, camera_in_box, default_views, look_at
from vvgt_cli.cameras.blocks import ENOUGH, Blocks, picked, spread_blocks
from vvgt_cli.gaussians.rules import INRIA, RULES, Rule
from vvgt_cli.gaussians.targets import target_of
from vvgt_cli.progress import ProgressCallback, counted

if TYPE_CHECKING:
    from vvgt_cli.dvr import RenderSettings, Scene, Viewed
    from vvgt_cli.images.metrics import Texture
    from vvgt_cli.splat.render import Shown

SIZES = (400, 800, 2160)  # pixels: a small window, half a screen, a 4K screen
CLOSE = 10.0  # degrees: a quarter of the default field of view
NEAR = 14.0  # degrees, for texture: faces fill the picture, and cells are some pixels wide
TEXTURED = 3  # a conversion measures texture in the middle of a near view, one part in so many of its edge
VIEWS = (0, 4, 9)  # test views: above, side, below
SIDE = (4,)  # one view is enough to find the worst condition
# In a headset a body's longest edge is 2 m, its middle 1.3 m up and, at first, 2 m away (formats/page/where.mjs).
AWAY = (2.0, 1.5)  # metres from the middle to the eyes: at first, and half a metre before the surface, an arm's length
Axes = tuple[tuple[float, ...], ...]
UPRIGHT: Axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
UP, APART = 0.3, 0.063  # metres: eyes 1.6 m up, and between both
DISTANCES = (6.0, 1.2, 0.6)  # unit frame, beside that of the test views, 3: about a level farther, nearer and inside
PREVIEW_VIEWS = VIEWS  # of previews, and of scores without a report


@dataclass(frozen=True)
class ViewingCondition:
    """A drawing rule, a size and a field of view, with the PSNR measured there.

    Attributes:
        rule: drawing rule of the splats.
        size: pixels along the picture's edge.
        field_of_view: degrees.
        psnr: mean dB of the views, over black.
        where: name of the place in a headset, or of the distance from levels; "" for a screen.
    """

    rule: str
    size: int
    field_of_view: float
    psnr: float
    where: str = ""

    def name(self) -> str:
        """Return the name in tables and messages."""
        return self.where or f"{self.rule} {self.size} px" + (
            "" if self.field_of_view == FIELD_OF_VIEW else " close up"
        )


def viewing_conditions(size: int) -> list[tuple[int, float]]:
    """List the (size, field of view) at which a file made for ``size`` px is scored."""
    return [(edge, FIELD_OF_VIEW) for edge in sorted({*SIZES, size})] + [(size, CLOSE)]


def screens(size: int) -> list[tuple[int, float]]:
    """List (size, field of view) of the target size and of the next larger screen."""
    return [(size, FIELD_OF_VIEW), (2160 if size < 2160 else 2 * size, FIELD_OF_VIEW)]


def zoomed(camera: Camera, field_of_view: float) -> Camera:
    """Return a camera at the same place with another field of view in degrees and square pixels."""
    focal = camera.height / 2 / float(np.tan(np.radians(field_of_view) / 2))
    return replace(camera, fx=focal, fy=focal)


class ViewingPlace(NamedTuple):
    """A viewing condition without its rule; attributes as in `ViewingCondition`."""

    size: int
    field_of_view: float
    where: str = ""


ConditionPicture = tuple[ViewingPlace, Camera, Blocks | None]  # and the blocks that are scored, None for all
ConditionView = tuple[ConditionPicture, np.ndarray]  # and the reference (h, w, 3) float32 of the blocks, or the whole


def condition_pictures(
    places: Iterable[tuple[int, float]], views: Collection[int] = VIEWS, enough: int = ENOUGH
) -> list[ConditionPicture]:
    """List every place with the camera of each view, and the blocks of its picture that are scored."""
    pictures = []
    for size, field_of_view in places:
        cameras = default_views("test", size=size)
        for i in views:
            camera, blocks = zoomed(cameras[i], field_of_view), spread_blocks(size, size, i, enough)
            pictures.append((ViewingPlace(size, field_of_view), camera, blocks))
    return pictures


def distance_pictures(size: int, views: Collection[int] = SIDE, enough: int = ENOUGH) -> list[ConditionPicture]:
    """List pictures of the middle from `DISTANCES`, as `condition_pictures`, for levels that distances select."""
    pictures = []
    for distance in DISTANCES:
        place = ViewingPlace(size, FIELD_OF_VIEW, f"from {distance:g}")
        cameras = default_views("test", size=size, radius=distance)
        pictures += [(place, cameras[i], spread_blocks(size, size, i, enough)) for i in views]
    return pictures


def eye_pictures(
    target: str | None, axes: Axes = UPRIGHT, views: Collection[int] = VIEWS, enough: int = ENOUGH
) -> list[ConditionPicture]:
    """List the pictures of both eyes in a headset, as `condition_pictures`; none for a screen.

    Eyes look at the middle of the body from the azimuths of the test views; the middle `FIELD_OF_VIEW` degrees count.

    Args:
        target: name of a device, None for none.
        axes: rows of the (3, 3) matrix from the box frame to one whose +z is up in the headset.
        views: numbers of the test views.
        enough: approximate number of blocks per view.
    """
    device = target_of(target)
    if device is None or device.focal is None:
        return []
    size, pictures = round(2 * device.focal * float(np.tan(np.radians(FIELD_OF_VIEW / 2)))), []
    for away in AWAY:
        place = ViewingPlace(size, FIELD_OF_VIEW, f"{device.name} both eyes {away:g} m")
        for i in views:
            x, y, _ = default_views("test")[i].position
            ring = away / float(np.hypot(x, y))
            head = look_at((ring * x, ring * y, UP), width=size, height=size)
            for right in (-APART / 2, APART / 2):
                eye = replace(head, translation=head.translation - (right, 0, 0))
                pictures.append((place, camera_in_box(eye, np.array(axes))[0], spread_blocks(size, size, i, enough)))
    return pictures


def condition_views(
    scene: Scene | Viewed,
    pictures: Sequence[ConditionPicture],
    settings: RenderSettings | None = None,
    progress: ProgressCallback | None = None,
) -> Iterator[ConditionView]:
    """Render the references of `condition_pictures` and `eye_pictures`, one at a time."""
    from vvgt_cli.dvr import render_view

    for place, camera, blocks in counted(pictures, progress):
        image = render_view(scene, camera, settings, blocks)[..., :3]
        yield (place, camera, blocks), picked(image, blocks)


def score_texture(
    scene: Scene | Viewed,
    gaussians: Shown,
    size: int,
    rule: str | Rule = INRIA,
    settings: RenderSettings | None = None,
    progress: ProgressCallback | None = None,
    cameras: Sequence[Camera] | None = None,
) -> Texture:
    """Measure texture on smooth areas in pictures of ``size`` px, by ``cameras`` (None: `near_cameras`)."""
    from vvgt_cli.dvr import render_view
    from vvgt_cli.images.metrics import texture
    from vvgt_cli.splat import render

    places = counted(near_cameras(size) if cameras is None else cameras, progress)
    return texture((render_view(scene, camera, settings), render(gaussians, camera, rule)) for camera in places)


def near_cameras(size: int) -> list[Camera]:
    """Return the default cameras of `score_texture`: the `VIEWS`, close up (`NEAR`)."""
    cameras = default_views("test", size=size)
    return [zoomed(cameras[i], NEAR) for i in VIEWS]


def texture_cameras(size: int) -> list[Camera]:
    """Return the cameras of a conversion's texture: the middle of the close view from the side."""
    return [zoomed(default_views("test", size=size)[i], NEAR).middle(size // TEXTURED) for i in SIDE]


def texture_note(texture: Texture) -> str:
    """Return texture as a message."""
    if texture.ours is None:
        return "nothing in it is opaque and smooth"
    return (
        f"{texture.ours:.2f} levels of 255, the volume {texture.reference:.2f}; "
        f"worst tenth {texture.ours_worst:.2f} and {texture.reference_worst:.2f}"
    )


def score_conditions(
    gaussians: Shown, seen: Iterable[ConditionView], rules: Collection[str] = tuple(RULES),
    headset: str = INRIA.name,
) -> list[ViewingCondition]:  # fmt: skip
    """Score every rule at every place, on the blocks of `condition_views`; worst first; ``headset``: its rule."""
    from vvgt_cli.images.metrics import psnr
    from vvgt_cli.splat import render

    errors: dict[tuple[str, ViewingPlace], list[float]] = {}
    for (place, camera, blocks), reference in seen:
        for rule in (headset,) if place.where else rules:
            ours = picked(render(gaussians, camera, rule, blocks=blocks)[..., :3], blocks)
            errors.setdefault((rule, place), []).append(psnr(reference, ours))
    conditions = [
        ViewingCondition(rule, *place[:2], float(np.mean(dbs)), place.where) for (rule, place), dbs in errors.items()
    ]
    return sorted(conditions, key=lambda condition: condition.psnr)
