"""Pictures of volumes under the function that is made when none is given, or under the named ones, a PNG each.

python benchmarks/automatic.py docs/automatic [NAME=VOLUME ...]
python benchmarks/automatic.py docs/named --named [NAME=VOLUME ...]

Without volumes: scans that `scans` makes, and the frog. VOLUME is a file or example:NAME; with --named NAME is that of
the function.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scans import angiography, cone_beam, density, head, nuclei, orbital, trunk

from vvgt_cli.cameras.sets import look_at
from vvgt_cli.cameras.types import render_in_box
from vvgt_cli.dvr import RenderSettings, Scene, render_view
from vvgt_cli.images import write_png
from vvgt_cli.look import from_histogram, read_transfer_function, resolve, unit_distance
from vvgt_cli.volume import ReadOptions, Volume, read_volume, statistics

SIZE, SIZE_NAMED, AZIMUTH, ELEVATION, FIELD = 180, 160, 60.0, 12.0, 36.0  # px, degrees
MADE: dict[str, Callable[[], Volume]] = {
    "mr-t1": lambda: head("t1"),
    "mr-t2": lambda: head("t2"),
    "ct-head": lambda: head("ct"),
    "ct-abdomen": lambda: trunk(contrast=False),
    "ct-angiography": lambda: trunk(contrast=True),
    "cone-beam": cone_beam,
    "microscopy": nuclei,
}
EXAMPLES = ("frog",)
NAMED: dict[str, Callable[[], Volume]] = {
    "ct-bone": lambda: trunk(contrast=False),
    "ct-soft-tissue": lambda: trunk(contrast=False),
    "ct-vessels": lambda: trunk(contrast=True),
    "ct-lung": lambda: trunk(contrast=False),
    "ct-skin": lambda: head("ct"),
    "mr-head": lambda: head("t1"),
    "mr-angio": angiography,
    "density-contour": density,
    "density-difference": orbital,
}


def picture(volume: Volume, name: str | None) -> tuple[np.ndarray, str]:
    """(px, px, 3) picture over black, and the function's name; without a name that which is made."""
    numbers = statistics(volume)
    size = SIZE if name is None else SIZE_NAMED
    if name is None:
        tf = from_histogram(numbers, volume.hounsfield, volume.preset)
    else:
        tf = resolve(read_transfer_function(name), numbers, hounsfield=volume.hounsfield)
    distance, limits = unit_distance(None, volume, tf)[0], (numbers.lo, numbers.hi)
    scene = Scene.build(volume, tf, distance, limits, lighting=tf.lighting)
    azimuth, elevation = np.radians([AZIMUTH, ELEVATION])
    level = np.cos(elevation)
    eye = 3 * np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)])
    camera = look_at(eye, width=size, height=size, fov=FIELD)
    draw = render_in_box(lambda boxed: render_view(scene, boxed, RenderSettings()), volume.axes)
    return np.clip(draw(camera)[..., :3], 0, 1), tf.name


def main(folder: str, *given: str) -> None:
    named, given = "--named" in given, tuple(word for word in given if word != "--named")
    volumes = dict(NAMED if named else MADE) if not given else {}
    for entry in given or [f"{name}=example:{name}" for name in EXAMPLES if not named]:
        name, _, source = entry.partition("=")
        volumes[name] = lambda source=source: read_volume(source, ReadOptions())
    Path(folder).mkdir(parents=True, exist_ok=True)
    for name, volume in volumes.items():
        image, function = picture(volume(), name if named else None)
        write_png(Path(folder) / f"{name}.png", image, overwrite=True)
        print(f"{name}: {function}")


if __name__ == "__main__":
    main(*sys.argv[1:])
