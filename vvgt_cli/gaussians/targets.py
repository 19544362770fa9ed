"""Devices that a file is made for, as data: what is known of each, and what is guessed (docs/viewers.md, "Targets")."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vvgt_cli.errors import UsageError


@dataclass(frozen=True)
class Target:
    """A device: what it draws, and how people see it there.

    Attributes:
        name: value of ``--for``.
        max_gaussians: Gaussians that it draws at its frame rate.
        megabytes: largest file, 10^6 bytes.
        screen: pixels along the edge of its screen, as `vvgt_cli.conversion.request.FitOptions` has it.
        rule: name of the drawing rule of its programs.
        best: ending of the file that most of its programs open.
        unread: endings of files that none of them opens.
        eye: of a headset, pixels across an eye's picture, and the degrees that it spans outwards and inwards.
    """

    name: str
    max_gaussians: int
    megabytes: float
    screen: int
    rule: str
    best: str
    unread: tuple[str, ...] = ()
    eye: tuple[int, float, float] | None = None

    @property
    def focal(self) -> float | None:
        """Return the focal length in pixels of an eye's picture; None for a screen."""
        if self.eye is None:
            return None
        pixels, outwards, inwards = self.eye
        return pixels / (math.tan(math.radians(outwards)) + math.tan(math.radians(inwards)))


USD = (".usdc", ".usdz")
TARGETS = {
    target.name: target
    for target in (
        Target("quest", 200_000, 20, 1104, "playcanvas", ".html", USD, (1680, 54, 40)),
        Target("visionos", 200_000, 20, 2236, "inria", ".ply", USD, (3660, 50, 50)),
        Target("phone", 400_000, 20, 1080, "playcanvas", ".html", USD),
        Target("desktop", 1_000_000, 100, 2160, "inria", ".ply"),
    )
}


def target_of(name: str | None) -> Target | None:
    """Return a target by its name, None for none; raise UsageError if it is unknown."""
    if name is not None and name not in TARGETS:
        raise UsageError(f"target {name!r}; expected one of {', '.join(TARGETS)}")
    return None if name is None else TARGETS[name]


def check_opened(path: str, name: str | None) -> None:
    """Raise UsageError for a file that no program of a target opens; ``name`` is None for none."""
    target = target_of(name)
    if target is not None and path.lower().endswith(target.unread):
        raise UsageError(f"-o {path} with --for {name}: no program there opens it; expected {target.best}")
