"""Cases of colours that depend on the view: against the float64 twin, at the extremes, in other frames and in files."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from vvgt_cli.cameras import default_views
from vvgt_cli.cameras.boxed import boxed
from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.clouds import cloud, view
from vvgt_cli.checks.files import one_line
from vvgt_cli.checks.forward import sane
from vvgt_cli.closed_form.fit import solve_colors
from vvgt_cli.gaussians import Gaussians, PlyOptions, read_ply, write_ply
from vvgt_cli.gaussians.frames import transform
from vvgt_cli.gaussians.types import HARMONICS
from vvgt_cli.refine import OptimizeOptions, optimize
from vvgt_cli.splat import project, render, render_backward, render_backward_reference, render_reference

STAGE = "harmonics"
QUARTERS = {
    "x": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "y": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    "z": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
}  # fmt: skip
NEARER = {"frame": 0.6, "adam": 0.95}  # squared error after 80 steps over that before
MIRROR = np.diag([-1.0, 1.0, 1.0])


def shiny(count: int, degree: int, size: float = 0.3) -> Gaussians:
    """A cloud with random harmonics of ``size``."""
    terms = np.random.default_rng(degree).normal(0, size, (count, HARMONICS[degree], 3))
    return replace(cloud(count, 20 + degree), harmonics=terms)


def _picture(degree: int) -> Figure:
    gaussians, c = shiny(200, degree), view()
    image = render(gaussians, c)
    sane(image)
    off = np.abs(image - render_reference(gaussians, c))
    require((off > 4e-5).mean() <= 3e-3, f"{(off > 4e-5).mean():.3g} of the pixels differ from the twin")
    return Figure("difference from the twin", float(off.max()), 0.01)


def _slopes(degree: int) -> Figure:
    """Gradients of means and harmonics relative to a Gaussian's own size of them, all but a few."""
    gaussians, c = shiny(200, degree), view()
    grad = np.random.default_rng(0).normal(size=(c.height, c.width, 4)).astype(np.float32)
    p = project(gaussians, c)
    ours = render_backward(gaussians, c, p, render(gaussians, c, projection=p), grad)
    twin = render_backward_reference(gaussians, c, grad.astype(np.float64))
    worst = 0.0
    for field in ("means", "harmonics"):
        a, b = getattr(ours, field).reshape(200, -1), twin[field].reshape(200, -1)
        off = np.abs(a - b).max(axis=1) / (np.abs(b).max(axis=1) + 1e-2 * np.abs(b).mean() + 1e-12)
        worst = max(worst, float(np.quantile(off, 0.97, method="higher")))
    return Figure("difference from the twin, relative", worst, 2e-3)


def _zeros(degree: int) -> Figure:
    """Coefficients that are all 0 change no bit of a picture."""
    gaussians, c = cloud(300, 21), view()
    differ = render(gaussians.of_degree(degree), c) != render(gaussians, c)
    return Figure("values that differ", float(differ.sum()), 0)


def _huge(size: float) -> Figure:
    gaussians, c = shiny(100, 3), view()
    huge = replace(gaussians, harmonics=np.sign(gaussians.arrays()["harmonics"]) * np.float32(size))
    image = render(huge, c)
    sane(image)
    return Figure("brightest over what float32 holds", float(image.max()) / float(np.finfo(np.float32).max), 1.0)


def _turned(matrix: np.ndarray) -> Figure:
    """Gaussians of another frame, seen from there: the same picture, in a mirror where the frame is."""
    gaussians, c = shiny(200, 3), view()
    inside, flipped = boxed(c, matrix)
    picture = render(gaussians, inside)
    there = render(transform(gaussians, matrix), c)
    return Figure("difference", float(np.abs((picture[:, ::-1] if flipped else picture) - there).max()), 2e-3)


def _written(gaussians: Gaussians) -> bytes:
    stream = io.BytesIO()
    write_ply(stream, gaussians, PlyOptions())
    return stream.getvalue()


def _file(degree: int) -> Figure:
    """Written, read, written: the same coefficients and the same bytes."""
    gaussians = shiny(100, degree)
    content = _written(gaussians)
    back, header = read_ply(io.BytesIO(content))
    require(header.sh_degree == back.degree == degree, f"degree {header.sh_degree} in the header, {back.degree} read")
    require(_written(back) == content, "a second trip changes the bytes")
    differ = back.arrays()["harmonics"] != gaussians.arrays()["harmonics"]
    return Figure("coefficients that differ", float(differ.sum()), 0)


def _not_a_number() -> object:
    content = bytearray(_written(shiny(10, 1)))
    content[-4 * 9 : -4 * 8] = np.array([np.nan], "<f4").tobytes()  # blue's last
    return read_ply(io.BytesIO(bytes(content)))


def _one_view() -> Figure:
    """Colours and harmonics of degree 3 from one view: no farther from it, and none flares up elsewhere."""
    truth, cameras = shiny(60, 3), default_views("train", 4, size=40)
    views = np.stack([render(truth, cameras[0])])
    start = replace(truth, harmonics=None)
    solved = solve_colors(start, cameras[:1], views, degree=3)
    before, after = (float(np.square(render(g, cameras[0]) - views[0]).sum()) for g in (start, solved))
    require(after <= before, f"squared error {before:.3g} before, {after:.3g} after")
    brightest = max(float(render(solved, camera)[..., :3].max()) for camera in cameras)
    return Figure("brightest from elsewhere", brightest, 2.0)


def _found(method: str) -> Figure:
    """From the base colours towards views that harmonics made, by rates that get there in 80 steps: 3DGS' do not."""
    truth, cameras = shiny(60, 2), default_views("train", 8, size=32)
    views = np.stack([render(truth, camera) for camera in cameras])
    start = truth.of_degree(0).of_degree(2)
    result, _ = optimize(start, cameras, views, OptimizeOptions.of(method, steps=80), (cameras, views))
    require(result.degree == 2, f"harmonics of degree {result.degree}")

    def error(gaussians: Gaussians) -> float:
        return sum(float(np.square(render(gaussians, c) - v).sum()) for c, v in zip(cameras, views, strict=True))

    return Figure("squared error over that before", error(result) / error(start), NEARER[method])


def cases() -> Iterator[Case]:
    """All of them."""
    for degree in (1, 2, 3):
        yield Case(STAGE, f"degree {degree}", partial(_picture, degree))
        yield Case(STAGE, f"gradients, degree {degree}", partial(_slopes, degree))
        yield Case(STAGE, f"degree {degree}, all coefficients 0", partial(_zeros, degree))
        yield Case(STAGE, f"file, degree {degree}", partial(_file, degree))
    for size in (1e6, 1e30, 3e38):
        yield Case(STAGE, f"coefficients of {size:g}", partial(_huge, size))
    for axis, matrix in QUARTERS.items():
        yield Case(STAGE, f"turned by 90 degrees about {axis}", partial(_turned, np.array(matrix, np.float64)))
    yield Case(STAGE, "in a mirror", partial(_turned, MIRROR))
    yield Case(STAGE, "refused: a NaN", partial(one_line, _not_a_number))
    yield Case(
        STAGE, "refused: four coefficients", partial(one_line, lambda: replace(cloud(5), harmonics=np.ones((5, 4, 3))))
    )
    yield Case(STAGE, "solved from one view", _one_view)
    for method in NEARER:
        yield Case(STAGE, f"{method}, back to where views come from", partial(_found, method))
