"""The ray caster on a CUDA device: what the CPU's kernels call, compiled for it by numba-cuda, a thread a pixel."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.dvr import grid, shading
from vvgt_cli.dvr.kernel import (
    FLAGS,
    OPAQUE,
    U,
    box_span,
    inverse,
    is_flat,
    pass_segment,
    pixels_of,
    sample,
    skip,
    table_coordinate,
    values_met,
)
from vvgt_cli.dvr.layout import Optics, Voxels
from vvgt_cli.dvr.runs import BORROWED
from vvgt_cli.dvr.vectors import add, lane, zeros4
from vvgt_cli.jit.cache import source_digest
from vvgt_cli.jit.decorators import inlined

if TYPE_CHECKING:
    from vvgt_cli.dvr.scene import Scene

LEAP = 8  # samples between two looks at the empty-space map
THREADS = 128  # of a block
Draw = Callable[..., None]  # arguments as of `kernel.render_tiles` from ``eye`` on

_jit = inlined(fastmath=FLAGS, error_model="numpy", **BORROWED)


@_jit
def cast(
    voxels: Voxels, optics: Optics, empty: np.ndarray, light: Any, px: float, py: float, pz: float, dx: float,
    dy: float, dz: float, step: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Follow a ray as `kernel.cast` does, or `lit.cast` where there is a ``light``, in float64 and sample by sample.

    Runs of samples are for vector instructions, which a thread of a GPU does not have.
    """
    nz, ny, nx = voxels.values.shape
    seen, trans = zeros4(), 1.0
    red = green = blue = 0.0
    t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
    if not t1 > t0:
        return 0.0, 0.0, 0.0, 0.0
    count = max(int(math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step)), 1)  # noqa: RUF046 # a float on the device
    dt = (t1 - t0) / count
    opaque = OPAQUE * min(step * step, 1.0)
    ix, iy, iz, per_step = inverse(dx), inverse(dy), inverse(dz), 1.0 / dt
    flat = is_flat(optics)
    before = u0 = -1.0  # -1: no sample there, or not finite
    i, stop = 0, 0
    while i <= count and trans >= opaque:
        if i >= stop:
            at = i - 1 if u0 >= 0.0 else i  # the segment that comes from there is still to be seen
            start = skip((nz, ny, nx), empty, px, py, pz, dx, dy, dz, ix, iy, iz, t0, dt, per_step, count, at)
            if start > count:
                break
            if start > at:
                before, u0, i = -1.0, -1.0, max(start - 1, 0)  # one earlier, for what bends the next
            stop = i + LEAP
        t = t0 + i * dt
        u1 = table_coordinate(sample(voxels.values, px + t * dx, py + t * dy, pz + t * dz), optics)
        met = values_met(before, u0, u1, flat)
        if met[0] >= 0.0 and met[1] > optics.dark[U(int(met[0]))]:
            own, trans, s = pass_segment(
                voxels, optics, (px, py, pz), (dx, dy, dz), t - dt, dt, u0, u1, met, zeros4(), trans
            )
            if light is None:
                seen = add(seen, own)
            else:
                factor, white = shading.shading(
                    voxels.values, light, px + s * dx, py + s * dy, pz + s * dz,
                    dx * light.edge[0], dy * light.edge[1], dz * light.edge[2],
                )  # fmt: skip
                most = lane(own, 3)
                white *= most
                red += min(factor * lane(own, 0) + white, most)
                green += min(factor * lane(own, 1) + white, most)
                blue += min(factor * lane(own, 2) + white, most)
        before, u0 = u0, u1
        i += 1
    if light is None:
        red, green, blue = lane(seen, 0), lane(seen, 1), lane(seen, 2)
    return red, green, blue, 1.0 - trans


_field_pixel, _grid_pixel = pixels_of(cast), pixels_of(grid.cast)


@cache
def _kernels(key: int) -> dict[tuple[bool, bool], Any]:
    """Return the device's kernels by whether they draw an optics grid, and whether there is a light.

    numba-cuda keeps them on disk by their own code and the numbers around it: ``key`` stands for what they call.
    """
    import numba.cuda

    cuda: Any = numba.cuda  # which numba-cuda replaces
    config: Any = numba.config
    config.CUDA_LOW_OCCUPANCY_WARNINGS = False

    def made(pixel: Any, lit: bool) -> Any:
        @cuda.jit(cache=True, fastmath=FLAGS)
        def unlit_pixels(data, eye, basis, lens, step, places, offsets, out):  # type: ignore[no-untyped-def]
            n = cuda.grid(1)
            if n < out.shape[0] and key != 0:
                sums = pixel(
                    data[0], data[1], data[2], None, eye, basis, lens, step, places[1, n], places[0, n], offsets
                )
                for f in range(4):
                    out[n, f] = sums[f] / offsets.shape[0]

        @cuda.jit(cache=True, fastmath=FLAGS)
        def lit_pixels(data, eye, basis, lens, step, places, offsets, out):  # type: ignore[no-untyped-def]
            n = cuda.grid(1)
            if n < out.shape[0] and key != 0:
                sums = pixel(
                    data[0], data[1], data[2], data[3], eye, basis, lens, step, places[1, n], places[0, n], offsets
                )
                for f in range(4):
                    out[n, f] = sums[f] / offsets.shape[0]

        return lit_pixels if lit else unlit_pixels

    return {(False, lit): made(_field_pixel, lit) for lit in (False, True)} | {
        (True, lit): made(_grid_pixel, lit) for lit in (False, True)
    }


def scene_arrays(scene: Scene) -> tuple[Any, ...]:
    """Return what a ray of a scene reads, as the arguments of `cast` or `grid.cast` in front of the ray."""
    light = () if scene.light is None else (scene.light,)
    if scene.grid is None:
        return scene.voxels, scene.optics, scene.empty, *light
    return scene.texels, scene.voxels if light else scene.texels, scene.empty, *light


class DeviceRays:
    """Casts the rays of a scene on the first CUDA device; once that has failed, on the CPU.

    Attributes:
        scene: what is drawn, without these rays.
        say: told in a line that the device has failed.
    """

    def __init__(self, scene: Scene, say: Callable[[str], None]) -> None:
        self.scene, self.say, self.failed = replace(scene, rays=None), say, False

    @cached_property
    def on_device(self) -> tuple[Any, ...]:
        """The scene's arrays on the device.

        Raises:
            MemoryError: more bytes than are free there.
        """
        from numba import cuda

        data = scene_arrays(self.scene)
        needed, (free, _) = _bytes(data), cuda.current_context().get_memory_info()
        if needed > free:
            raise MemoryError(f"the volume needs {needed / 1e9:.1f} GB, of which {free / 1e9:.1f} are free")
        found: tuple[Any, ...] = _sent(data)
        return found

    def __call__(self, *args: Any) -> None:
        """Draw pixels; arguments as of `kernel.render_tiles` from ``eye`` on."""
        from vvgt_cli.dvr.render import host_rays

        if not self.failed:
            try:
                return self._cast(*args)
            except Exception as error:  # the driver's, the compiler's and numba's, which share no class
                self.failed = True
                self.__dict__.pop("on_device", None)
                reason = " ".join(str(error).split())[:200]
                self.say(f"the GPU failed ({reason}); views are drawn on the CPU")
        return host_rays(self.scene)(*args)

    def _cast(
        self, eye: np.ndarray, basis: np.ndarray, lens: np.ndarray, step: float, _order: np.ndarray,
        offsets: np.ndarray, mask: np.ndarray, known: int, out: np.ndarray,
    ) -> None:  # fmt: skip
        from numba import cuda

        places = np.ascontiguousarray(np.nonzero(mask), np.int64)
        if not places.shape[1]:
            return
        data = self.on_device
        pixels = cuda.device_array((places.shape[1], 4), np.float32)
        rest = map(cuda.to_device, (places, np.ascontiguousarray(offsets, np.float64)))
        key = int(source_digest(_kernels.__wrapped__), 16) >> 4  # of 16 hexadecimal digits: within int64
        render = _kernels(key or 1)[self.scene.grid is not None, self.scene.light is not None]
        camera = map(cuda.to_device, (eye, basis, lens))
        render[-(-places.shape[1] // THREADS), THREADS](data, *camera, step, *rest, pixels)
        share = len(offsets) / (known + len(offsets))
        out[mask] = (1 - share) * out[mask] + share * pixels.copy_to_host()


def _sent(value: Any) -> Any:
    """Return arrays, or tuples of them, with the arrays on the device."""
    from numba import cuda

    if isinstance(value, tuple):
        made = map(_sent, value)
        return value._make(made) if hasattr(value, "_make") else tuple(made)
    return cuda.to_device(value) if isinstance(value, np.ndarray) else value


def _bytes(value: Any) -> int:
    """Return the bytes of arrays, or tuples of them."""
    return sum(map(_bytes, value)) if isinstance(value, tuple) else getattr(value, "nbytes", 0)
