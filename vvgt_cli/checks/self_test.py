"""Cases of an installation: kernels compile and agree with float64 twins, scenes convert, files can be read back."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vvgt_cli.cameras import Camera, default_views
from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.closed_form import VbmOptions, backproject, initialise
from vvgt_cli.closed_form.fit import BRIGHTEST
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.dvr import RenderSettings, Scene, render_view, render_view_reference, render_views
from vvgt_cli.dvr.layers import Layer, grid_of
from vvgt_cli.gaussians import Gaussians, PlyOptions, as_ply, as_stored, read_ply
from vvgt_cli.gaussians.formats import FORMATS, Format, encoded
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.images.metrics import score_views
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.labels import Label, LabelTable
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.refine import OptimizeOptions, optimize
from vvgt_cli.splat import project, render, render_backward, render_reference
from vvgt_cli.volume import Volume

if TYPE_CHECKING:
    from vvgt_cli.closed_form.tree import Tree


EDGE = 12  # voxels
FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "colors")
SMOOTH = replace(INRIA, reach=4.0, shifted=True, min_alpha=0.0, max_alpha=1.0, min_transmittance=0.0)
ROUNDED = 0.02  # RMS of pictures: formats of fewer bits than float32 round


def self_test_cases() -> Iterator[Case]:
    """Yield the cases of an installation."""
    yield Case("kernels", "compiled and kept for later runs", _kernels)
    yield Case("splats", "picture against the twin", _picture)
    yield Case("splats", "gradients against the twin", _gradients)
    for cases in zip(*(scene_cases(scene, name) for name, scene in _scenes().items()), strict=True):
        yield from cases
    for known in (one for one in FORMATS if one.lacks(one.suffix) is None):
        yield Case("files", f"{known.suffix} written and read", partial(_write_and_read, known))


def _kernels() -> Figure:
    from vvgt_cli.jit.ahead import CONVERT
    from vvgt_cli.jit.compile import compile_ahead

    compiled, missing, folder = compile_ahead(CONVERT)
    require(folder or not compiled, "no folder can keep compiled kernels; set NUMBA_CACHE_DIR to a writable one")
    return Figure("kernels that do not compile", missing, 0)


def _scenes() -> dict[str, Scene]:
    """Return a step function of opacity 1, a faint lit ramp and a label map, by name."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, EDGE)] * 3, indexing="ij")
    blob = np.exp(-2 * (x * x + 1.5 * y * y + 0.7 * z * z) + 0.4 * np.sin(3 * x + y))
    labels = Volume((blob * 2).astype(np.uint8))
    table = LabelTable("labels", (Label(1, "half", (1, 0, 0), 0.5), Label(2, "solid", (0, 0, 1), 1.0)))

    def scalar(nodes: list[float], opacity: list[float]) -> Scene:
        colors = ColorMap(np.array([0.0, 1.0]), np.array([[0.0, 0.2, 1.0], [1.0, 0.8, 0.0]]))
        function: object = TransferFunction("f", PiecewiseOpacity(np.array(nodes), np.array(opacity)), colors)
        return Scene.build(Volume(blob), function, 1.0)  # type: ignore[arg-type]

    return {
        "step function": scalar([0, 0.5, 0.5001, 1], [0, 0, 1, 1]),
        "lit ramp": scalar([0, 0.2, 1], [0, 0, 0.1]).lit(Lighting()),
        "labels": Scene.of_grid(labels, table, 1.0, grid_of([Layer(labels, table, 1.0)], labels)),
    }


def _cloud(count: int = 200) -> Gaussians:
    """Return random Gaussians in the unit frame."""
    rng = np.random.default_rng(0)
    return Gaussians(
        rng.uniform(-0.6, 0.6, (count, 3)), np.log(0.06) + rng.normal(0, 0.3, (count, 3)), rng.normal(size=(count, 4)),
        rng.normal(0, 2, count), rng.uniform(0, 1, (count, 3)),
    )  # fmt: skip


def _picture() -> Figure:
    gaussians, camera = _cloud(), default_views("check", size=48)[0]
    off = np.abs(render(gaussians, camera) - render_reference(gaussians, camera))
    require((off > 4e-5).mean() <= 3e-3, f"{(off > 4e-5).mean():.3g} of the values differ from the twin")
    return Figure("difference from the twin", float(off.max()), 0.01)  # a pixel at a threshold may fall either way


def _gradients() -> Figure:
    """Compare how much steps along the gradient raise a picture of the twin with what the gradient says, by field."""
    rng, camera = np.random.default_rng(1), default_views("check", size=48)[0]
    gaussians, grad = _cloud(40), rng.normal(size=(48, 48, 4)).astype(np.float32)
    projection = project(gaussians, camera, SMOOTH)
    ours = render_backward(gaussians, camera, projection, render(gaussians, camera, projection=projection), grad)
    worst = 0.0
    for field in FIELDS:
        at, slopes = getattr(gaussians, field), getattr(ours, field)
        step = 1e-4 * np.abs(rng.normal(size=at.shape).astype(np.float32)) * np.sign(slopes)  # up everywhere
        low, high = (replace(gaussians, **{field: at + sign * step}) for sign in (-1, 1))
        rise = (grad * (render_reference(high, camera, SMOOTH) - render_reference(low, camera, SMOOTH))).sum()
        expected = (slopes * (getattr(high, field).astype(np.float64) - getattr(low, field))).sum()
        worst = max(worst, float(abs(rise / expected - 1)))
    return Figure("difference from the twin, relative", worst, 2e-3)


def _write_and_read(known: Format) -> Figure:
    """Compare pictures of Gaussians before and after a file of a format."""
    gaussians, camera = _cloud(), default_views("check", size=48)[0]
    with tempfile.TemporaryDirectory(prefix="vvgt-") as folder:
        path = Path(folder) / f"check{known.suffix}"
        path.write_bytes(encoded(known, gaussians, PlyOptions(), path.name))
        back, _ = open_gaussians(str(path))
    off = render(back, camera) - render(gaussians, camera)
    return Figure("RMS of RGBA", float(np.sqrt(np.mean(np.square(off)))), ROUNDED)


FINE = RenderSettings(step=0.125, samples=1)
SIZE, BUDGET, STEPS = 48, 200, 25  # of the conversion
FORM_BUDGET, FORM_SIZE = 1000, 64  # of the closed form whose mass is compared


def scene_cases(scene: Scene, name: str = "") -> Iterator[Case]:
    """Yield the cases of a scene; ``name`` is appended to their names."""
    camera, of = default_views("check", size=16)[0], f", {name}" if name else ""
    twin = partial(compare_with_twin, scene, camera, 1 / 8, 2e-2, empty=True)
    yield Case("ray caster", f"16 x 16 pixels against the twin{of}", twin)
    yield Case("ray caster", f"steps of four voxels{of}", partial(bound_long_steps, scene, camera))
    yield Case("closed form", f"optical mass, K = {FORM_BUDGET:,}{of}", partial(compare_levels, scene))
    yield Case("conversion", f"K = {BUDGET}, {SIZE} px, {STEPS} steps{of}", partial(convert_scene, scene))


def require_valid(image: np.ndarray) -> None:
    """Require premultiplied colours of at most 1: finite, not below 0, none brighter than its alpha."""
    require(np.isfinite(image).all(), f"{np.count_nonzero(~np.isfinite(image))} values are not finite")
    require(image.min() >= 0, f"a value of {image.min():.3g}")
    require(image[..., 3].max() <= 1, f"alpha {image[..., 3].max():.9g}")
    require((image[..., :3] <= image[..., 3:] + 2e-6).all(), "a colour brighter than its alpha")


def compare_with_twin(
    scene: Scene, camera: Camera, twin_step: float, limit: float = 3e-3, empty: bool = False
) -> Figure:
    """Measure the mean difference of a view from its float64 twin, relative to the twin's largest value.

    The twin samples at ``twin_step`` smallest voxel edges; ``limit`` is what passes; ``empty`` views may show nothing.
    """
    image = render_view(scene, camera, FINE)
    require_valid(image)
    twin = render_view_reference(scene, camera, step=twin_step)
    require(empty or twin.any(), "the twin is empty: there is nothing to compare")
    scale = max(float(twin.max()), 1e-12)
    return Figure("difference from the twin, mean", float(np.abs(image - twin).mean() / scale), limit)


def bound_long_steps(scene: Scene, camera: Camera) -> Figure:
    """Measure the largest value of a view in steps of four voxels, which may be inaccurate but not above 1."""
    image = render_view(scene, camera, RenderSettings(step=4.0, samples=1))
    require_valid(image)
    return Figure("largest value", float(image.max()), 1.0)


def require_in_range(gaussians: Gaussians, scene: Scene, budget: int) -> None:
    """Require no more Gaussians than the budget, opacities and colours in range and centres in the box."""
    require(0 < len(gaussians) <= budget, f"{len(gaussians)} Gaussians for a budget of {budget}")
    opacity = gaussians.opacity
    require(opacity.max() <= 0.9901, f"opacity {opacity.max():.6g}")
    require(gaussians.colors.min() >= -1e-6, f"colour {gaussians.colors.min():.3g}")
    brightest = 1.0 if scene.light is None else BRIGHTEST
    require(gaussians.colors.max() <= brightest + 1e-6, f"colour {gaussians.colors.max():.3g}")
    beyond = (np.abs(gaussians.means) - scene.half * (1 + 1e-6)).max()
    require(beyond <= 0, f"a centre {beyond:.3g} outside the box")
    require(gaussians.log_scales.max() < 1, f"a scale of {np.exp(float(gaussians.log_scales.max())):.3g}")


def require_cuts_keep_mass(tree: Tree) -> None:
    """Require that no cut through the pyramid gains or loses optical mass, or exceeds its budget."""
    from vvgt_cli.closed_form.tree import leaves_of, select

    whole = float(tree.moments[-1, 0])
    for budget in (1, 10, 300):
        ids = select(tree, budget)
        kept = float(leaves_of(tree, ids).moments[:, 0].sum())
        require(len(ids) <= budget, f"{len(ids)} cells for a budget of {budget}")
        require(abs(kept - whole) <= 1e-9 * whole, f"{kept / whole - 1:.3g} of the mass gained by a cut of {budget}")


def compare_levels(scene: Scene) -> Figure:
    """Measure how far the optical mass of cells of two voxels is from that of cells of one."""
    from vvgt_cli.closed_form.closed_form import closed_form
    from vvgt_cli.closed_form.moments import (
        BEND,  # its mean may be missed by a sixth of that
        base_cells,
    )

    fine, coarse = (base_cells(scene, np.full(3, level)).moments[:, 0].sum() for level in (0, 1))
    form = closed_form(scene, FORM_BUDGET, FORM_SIZE)
    require(len(form.tree), "no view shows anything")
    require_cuts_keep_mass(form.tree)
    require_in_range(form.gaussians(), scene, FORM_BUDGET)
    return Figure("optical mass off, relative", abs(float(coarse / fine) - 1), BEND / 6)


def convert_scene(scene: Scene) -> Figure:
    """Measure the loss between closed form and file on views that nothing was fitted to; no stage may lose."""
    cameras, checks = (default_views(which, 4, size=SIZE) for which in ("train", "check"))
    views, reference = render_views(scene, cameras), render_views(scene, checks)
    start = initialise(scene, VbmOptions(BUDGET, SIZE))
    require(0 < len(start.gaussians) <= BUDGET, f"{len(start.gaussians)} Gaussians for a budget of {BUDGET}")
    refitted, _ = backproject(start, cameras, views)
    options = OptimizeOptions(steps=STEPS, check_every=5)
    better, record = optimize(refitted, cameras, views, options, (checks, reference))
    gaussians, _ = read_ply(io.BytesIO(as_ply(as_stored(better))))
    images = [render(gaussians, camera) for camera in checks]
    require(all(np.isfinite(image).all() for image in images), "a picture that is not finite")
    score = score_views(reference, images, perceptual=False)
    assert record.psnr_before is not None
    return Figure("dB lost from closed form to file", record.psnr_before - score.psnr, 0.01)
