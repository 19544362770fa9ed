"""Rendering rules of programs: differences between viewers, as data (docs/viewers.md).

S is the projected covariance in px^2, S' = S + dilation on its diagonal, p = d^T S'^-1 d / 2 at d px from the centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.constants import DILATION, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

FARTHEST = 6.0  # p beyond which no rule draws anything: exp(-6) < 1/255


@dataclass(frozen=True)
class Rule:
    """The rendering rule of a program.

    Attributes:
        name: value of ``--rule``.
        programs: programs that render this way.
        dilation: px^2 added to the diagonal of projected covariances.
        compensate: whether opacity is multiplied by sqrt(det S / det S'), so that dilation adds no mass.
        reach: largest p that is drawn.
        shifted: whether the falloff is (exp(-p) - exp(-reach)) / (1 - exp(-reach)) instead of exp(-p).
        min_alpha: alpha below which a splat skips a pixel.
        max_alpha: upper bound of alpha.
        min_variance: px^2 of the larger eigenvalue of S' below which a splat is skipped.
        min_transmittance: a splat that would reduce a pixel's transmittance further is skipped, and ends the pixel.
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
        """Return the rule for views scaled by ``ratio``, which show the same as full-size ones at fewer pixels."""
        return replace(self, dilation=self.dilation * ratio**2, min_variance=self.min_variance * ratio**2)

    def projecting(self) -> np.ndarray:
        """Return the parameters of `kernel.project`, (5,): dilation, compensate, min_alpha, reach, min_variance."""
        reach = min(self.reach, FARTHEST)
        return np.array([self.dilation, self.compensate, self.min_alpha, reach, self.min_variance], np.float64)

    def blending(self) -> np.ndarray:
        """Return `tiles.blend`'s (6,): min_alpha, max_alpha, -reach / 8, falloff scale and shift, min_transmittance."""
        reach = min(self.reach, FARTHEST)
        rest = math.exp(-self.reach) if self.shifted else 0.0
        falloff = 1 / (1 - rest), rest / (1 - rest)
        ends = self.min_alpha, self.max_alpha, -reach / 8
        return np.array([*ends, *falloff, self.min_transmittance], np.float32)


# WebGL blends every splat whatever is in front of it. 0.999 stands for no clamp, a billionth for no end: 8 bits per
# channel show no difference, and gradients would divide by what float32 rounds to 0.
WEBGL: dict[str, Any] = {"max_alpha": 0.999, "min_transmittance": 1e-9}
# Cesium's unit is a quarter pixel, its splat a square to p = 4 along its axes: as much is left of a circle to 4.68.
# PlayCanvas' shaders use half pixels: in pixels its variance of 0.3 is a quarter of that, its length of 2 half.
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
        Rule("three", "three.js", compensate=True, reach=2.0, min_alpha=0.0, **WEBGL),
        Rule("babylon", "Babylon.js", dilation=DILATION / 4, reach=4.0, min_alpha=0.0, **WEBGL),
        Rule("cesium", "CesiumJS", DILATION / 16, reach=4.68, min_alpha=0.0, min_variance=0.125, **WEBGL),
    )
}

VIEWERS = ("inria", "compensated", "spark", "playcanvas", "viser")  # of programs made for splats


def rule_of(rule: str | Rule) -> Rule:
    """Return a rule by its name; raise UsageError if there is none."""
    if isinstance(rule, Rule):
        return rule
    if rule not in RULES:
        raise UsageError(f"rule {rule!r}; expected one of {', '.join(RULES)}")
    return RULES[rule]
