"""How programs draw a Gaussian: what differs between viewers, as data (docs/viewers.md).

S is the projected covariance in px^2, S' = S + dilation on its diagonal, p = d^T S'^-1 d / 2 at d px from the centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.constants import DILATION, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

FARTHEST = 6.0  # p beyond which nothing is drawn by any rule: exp(-6) < 1/255


@dataclass(frozen=True)
class Rule:
    """One program's way.

    Attributes:
        name: as ``--rule`` takes it.
        programs: that draw so.
        dilation: px^2 on the diagonal of projected covariances.
        compensate: opacity times sqrt(det S / det S'), so that dilation adds no mass.
        reach: largest p that is drawn.
        shifted: falloff (exp(-p) - exp(-reach)) / (1 - exp(-reach)) in place of exp(-p).
        min_alpha: below it a splat leaves a pixel alone; ``max_alpha``: the most that it covers.
        min_variance: px^2 of the larger eigenvalue of S' below which a splat is left out.
        min_transmittance: a splat that would bring a pixel below it is not drawn, and ends the pixel.
    """

    name: str
    programs: str
    dilation: float = DILATION
    compensate: bool = False
    reach: float = math.inf
    shifted: bool = False
    min_alpha: float = MIN_ALPHA
    max_alpha: float = MAX_ALPHA
    min_variance: float = 0.0
    min_transmittance: float = MIN_TRANSMITTANCE

    def at(self, ratio: float) -> Rule:
        """The rule for views of ``ratio`` times the size: they show what the whole size does, at fewer points."""
        return replace(self, dilation=self.dilation * ratio**2, min_variance=self.min_variance * ratio**2)

    def projecting(self) -> np.ndarray:
        """(5,) float64 as `kernel.project` takes it: dilation, compensate, min_alpha, reach, min_variance."""
        reach = min(self.reach, FARTHEST)
        return np.array([self.dilation, self.compensate, self.min_alpha, reach, self.min_variance], np.float64)

    def blending(self) -> np.ndarray:
        """(6,) float32 as `tiles.blend` takes it: min_alpha, max_alpha, -reach / 8, falloff's factor and offset, and
        min_transmittance."""
        reach = min(self.reach, FARTHEST)
        rest = math.exp(-self.reach) if self.shifted else 0.0
        falloff = 1 / (1 - rest), rest / (1 - rest)
        ends = self.min_alpha, self.max_alpha, -reach / 8
        return np.array([*ends, *falloff, self.min_transmittance], np.float32)


# WebGL blends every splat whatever is in front of it. 0.999 stands for no clamp: 8 bits a channel cannot tell.
WEBGL: dict[str, Any] = {"max_alpha": 0.999, "min_transmittance": 0.0}
# PlayCanvas' shaders count in half pixels: its 0.3 and 2 are a quarter and half as much in pixels.
HALF_PIXELS: dict[str, Any] = {"dilation": DILATION / 4, "min_variance": 0.125}
INRIA = Rule("inria", "Inria's renderer, gsplat, nerfstudio, OpenSplat")
RULES = {
    rule.name: rule
    for rule in (
        INRIA,
        Rule("compensated", "gsplat antialiased, Brush, Mip-Splatting", compensate=True),
        Rule("spark", "Spark (three.js)", compensate=True, reach=4.0, min_alpha=0.5 / 255, **WEBGL),
        Rule("playcanvas", "SuperSplat, PlayCanvas", reach=4.0, shifted=True, **HALF_PIXELS, **WEBGL),
        Rule("viser", "viser", reach=4.0, min_alpha=0.01, **WEBGL),
    )
}


def rule_of(rule: str | Rule) -> Rule:
    """A rule by its name.

    Raises:
        UsageError: no such rule.
    """
    if isinstance(rule, Rule):
        return rule
    if rule not in RULES:
        raise UsageError(f"rule {rule!r}; expected one of {', '.join(RULES)}")
    return RULES[rule]
