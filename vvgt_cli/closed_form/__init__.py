"""Variable Basis Mapping: volume to Gaussians in closed form, and what views can mend without moving anything."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vvgt_cli.defaults import MAX_GAUSSIANS, SIZE
from vvgt_cli.errors import UsageError
from vvgt_cli.gaussians.rules import INRIA, Rule
from vvgt_cli.progress import ProgressCallback

if TYPE_CHECKING:
    import numpy as np

    from vvgt_cli.cameras import Camera
    from vvgt_cli.closed_form.closed_form import ClosedForm
    from vvgt_cli.closed_form.tree import Leaves
    from vvgt_cli.dvr import Scene
    from vvgt_cli.gaussians import Gaussians

METHODS = ("moments", "wavelet", "uniform")


@dataclass(frozen=True)
class VbmOptions:
    """Options of the closed form.

    Attributes:
        max_gaussians: budget.
        size: image edge in pixels at the default views; opacities allow for the renderer's dilation there.
        method: "moments", "wavelet" (isotropic bank) or "uniform" (random samples).
        seed: of the random samples.
        degree: of the harmonics that colours have under a light that depends on the view.
        values: cells are split where values differ, for live files: the scene's red encodes the value, green its
            square, both scaled to [0, 1].
    """

    max_gaussians: int = MAX_GAUSSIANS
    size: int = SIZE
    method: str = "moments"
    seed: int = 0
    degree: int = 0
    values: bool = False

    def __post_init__(self) -> None:
        """Check the options; raise UsageError for an unknown method, or a number below 1."""
        if self.method not in METHODS:
            raise UsageError(f"init {self.method!r}; expected one of {', '.join(METHODS)}")
        if self.max_gaussians < 1:
            raise UsageError(f"{self.max_gaussians} Gaussians; expected at least 1")
        if self.size < 1:
            raise UsageError(f"size {self.size} px; expected at least 1")


@dataclass(frozen=True)
class Start:
    """Gaussians of the stage, and the pyramid that views may cut again (None for the comparison methods).

    Attributes:
        gaussians: one a cell.
        form: the pyramid.
        leaves: the cells, where they are those of ``values``.
    """

    gaussians: Gaussians
    form: ClosedForm | None
    leaves: Leaves | None = None


def initialise(scene: Scene, options: VbmOptions, progress: ProgressCallback | None = None) -> Start:
    """Return Gaussians by the closed form alone, without fitting to pictures; none where no view sees anything."""
    from vvgt_cli.closed_form.closed_form import closed_form

    form = closed_form(
        scene, options.max_gaussians, options.size, progress=progress, degree=options.degree, values=options.values
    )
    if progress:
        progress(100, 100)
    return start_of(form, options)


def start_of(form: ClosedForm, options: VbmOptions) -> Start:
    """Return the Gaussians of the method asked for, from a closed form."""
    from vvgt_cli.closed_form.wavelet import uniform_gaussians, wavelet_gaussians

    if options.values:
        leaves = form.cells_of_values()
        return Start(form.gaussians_of(leaves), form, leaves)
    if options.method == "wavelet":
        gaussians, kept = wavelet_gaussians(form.tree, form.budget, form.pixel), None
    elif options.method == "uniform":
        gaussians, kept = uniform_gaussians(form.tree, form.budget, form.pixel, options.seed), None
    else:
        gaussians, kept = form.gaussians(), form
    if kept is None and form.shading is not None:
        gaussians = form.shading.alone(gaussians, options.degree)
    return Start(gaussians, kept)


def backproject(
    start: Start, cameras: Sequence[Camera], views: np.ndarray, progress: ProgressCallback | None = None,
    rule: Rule = INRIA,
) -> tuple[Gaussians, str]:  # fmt: skip
    """Improve by views what needs no gradient descent: which cells are split, the style of surfaces, and colours.

    Args:
        start: from `initialise`.
        cameras: of the training views.
        views: (n, h, w, 4) float32 premultiplied.
        progress: called after each part.
        rule: by which they are drawn.

    Returns:
        Gaussians, and one line that says what was done.
    """
    from vvgt_cli.closed_form.closed_form import fit_to_views
    from vvgt_cli.closed_form.fit import solve_colors

    if start.form is None:
        return solve_colors(start.gaussians, cameras, views, progress=progress, rule=rule), "colours"
    return fit_to_views(start.form, cameras, views, progress, rule)
