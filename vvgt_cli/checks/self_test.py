"""Cases of an installation: kernels compile and agree with float64 twins, scenes convert, files can be read back."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.scene import scene_cases
from vvgt_cli.conversion.gaussian_files import open_gaussians
from vvgt_cli.dvr import Scene
from vvgt_cli.dvr.layers import Layer, grid_of
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.formats.choose import FORMATS, Format, encoded
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.labels import Label, LabelTable
from vvgt_cli.look.lighting import Lighting
from vvgt_cli.splat import project, render, render_backward, render_reference
from vvgt_cli.volume import Volume

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
    for known in filter(_installed, FORMATS):
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


def _installed(known: Format) -> bool:
    """Return whether the library that a format needs is installed."""
    try:
        known.needs(known.suffix)
    except DataError:
        return False
    return True


def _write_and_read(known: Format) -> Figure:
    """Compare pictures of Gaussians before and after a file of a format."""
    gaussians, camera = _cloud(), default_views("check", size=48)[0]
    with tempfile.TemporaryDirectory(prefix="vvgt-") as folder:
        path = Path(folder) / f"check{known.suffix}"
        path.write_bytes(encoded(known, gaussians, PlyOptions(), path.name))
        back, _ = open_gaussians(str(path))
    off = render(back, camera) - render(gaussians, camera)
    return Figure("RMS of RGBA", float(np.sqrt(np.mean(np.square(off)))), ROUNDED)
