"""Refinement: time of a step's parts: `python benchmarks/optimize.py [PLY|VOLUME ...] [--gaussians K]`.

Milliseconds with one and with all threads (medians of alternated repeats, 400 px), the speed-up, beside it that of bare
arithmetic, and a floor: the arithmetic of the tile rows that the Gaussians' pixel boxes cover, for forward and backward
pass (none of it is saved where pixels end early, so opaque scenes may lie below). What steps gain: `refinement.py`.
"""

from __future__ import annotations

from collections.abc import Callable

import click
import numba
import numpy as np
from floors import alternate, flops, machine
from splat import PIXEL_FLOPS, covered_pixels, sampled

from vvgt_cli.cameras import default_views
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.ply import read_ply
from vvgt_cli.gaussians.rules import INRIA
from vvgt_cli.refine.loss import add_ssim_gradient, loss_gradient
from vvgt_cli.refine.states import OwnAxes
from vvgt_cli.refine.steps import own_axes
from vvgt_cli.splat import blend, render
from vvgt_cli.splat.kernel import project_factors, tile_lists
from vvgt_cli.splat.render import depth_order, moments, own_axes_backward, pose
from vvgt_cli.volume import read_volume

REPEATS = 9
BACKWARD_FLOPS = 60  # a pixel: the forward's 30, colour against gradient 8, what is behind 5, nine sums 12, division


def part_calls(gaussians: Gaussians, target: np.ndarray) -> dict[str, Callable[[], object]]:
    """The parts of a step, each as a call of its own on fixed input."""
    camera = default_views("train")[3]
    state = OwnAxes(gaussians, [camera])
    means, factors, logits, colors = state.arrays
    p = state.project(camera)
    depth = np.linalg.norm(means - camera.position, axis=1).astype(np.float32)
    scratch = p.flat.copy(), depth.copy(), p.extent.copy()
    order = depth_order(depth)
    image = blend(p, colors, camera.height, camera.width)
    grad = np.empty_like(image)
    weights = np.float32(0), np.float32(1), np.float32(0.5)
    squares = np.empty(camera.height)
    loss_gradient(image, target, *weights, grad, squares)
    pairs = moments(p, colors, image, grad)
    rows, _ = own_axes_backward(means, factors, colors, camera, p, pairs)
    state.taken = 1
    still = np.zeros(5), state.CLIPS, state.spread, *state.BETAS, 1  # rates 0: the scene stays as it is
    tiles_y = -(-camera.height // 16)
    return {
        "project": lambda: project_factors(means, factors, logits, *pose(camera), INRIA.projecting(), *scratch),
        "sort": lambda: depth_order(depth),
        "file into tiles": lambda: tile_lists(order, p.extent, p.tiles_x, tiles_y, numba.get_num_threads()),
        "blend": lambda: blend(p, colors, camera.height, camera.width),
        "loss": lambda: loss_gradient(image, target, *weights, grad, squares),
        "(ssim)": lambda: add_ssim_gradient(image, target, 0.2, np.zeros_like(grad)),
        "moments": lambda: moments(p, colors, image, grad),
        "gradients": lambda: own_axes_backward(means, factors, colors, camera, p, pairs),
        "update": lambda: own_axes(
            rows, *still, *state.arrays, state.darkest, state.first, state.second, *state.common(rows)
        ),
    }


@numba.njit(parallel=True, cache=True)
def arithmetic(out):  # type: ignore[no-untyped-def]
    """Nothing but arithmetic, in equal chunks: the speed-up that threads of this machine can have."""
    for chunk in numba.prange(out.shape[0]):
        x = 1.0 + chunk
        for _ in range(60_000):
            x = x * 0.999999 + 1e-6
        out[chunk] = x


def with_threads(threads: int, call: Callable[[], object]) -> Callable[[], object]:
    def run() -> None:
        numba.set_num_threads(threads)
        call()

    return run


@click.command(help=__doc__)
@click.argument("files", nargs=-1)
@click.option("--gaussians", "count", default=100_000, help="Of volumes.")
def main(files: tuple[str, ...], count: int) -> None:
    """Milliseconds of a step's parts on each .ply or volume."""
    print(machine())
    rate = flops(np.float32)
    most = numba.get_num_threads()
    camera, out = default_views("train")[3], np.empty(256)
    for name in files or ("example:frog", "example:channels"):
        gaussians = read_ply(name)[0] if name.endswith(".ply") else sampled(read_volume(name), count)
        target = render(gaussians, camera) * np.float32(0.9)
        calls = part_calls(gaussians, target) | {"(arithmetic)": lambda: arithmetic(out)}
        both = {(part, n): with_threads(n, call) for part, call in calls.items() for n in (1, most)}
        times = alternate(both, REPEATS)  # type: ignore[type-var, arg-type]
        numba.set_num_threads(most)
        for label, chosen in (
            ("forward", ("project", "sort", "file into tiles", "blend")),
            ("step", [part for part in calls if part[0] != "("]),
        ):
            for n in (1, most):
                times[label, n] = sum(times[part, n] for part in chosen)  # type: ignore[index]
        pixels = covered_pixels(OwnAxes(gaussians, [camera]).project(camera))
        print(f"{name}: {len(gaussians)} Gaussians, {pixels / 1e6:.0f} million pixels; 1 thread, {most} threads")
        for part in (*calls, "forward", "step"):
            one, all_of_them = times[part, 1], times[part, most]  # type: ignore[index]
            print(f"  {part:<16}{one * 1e3:9.2f}{all_of_them * 1e3:9.2f} ms, x {one / all_of_them:.2f}")
        floor = pixels * (PIXEL_FLOPS + BACKWARD_FLOPS) / rate * 1e3
        print(f"  floor           {floor:18.2f} ms (flops, no early end)")


if __name__ == "__main__":
    main()
