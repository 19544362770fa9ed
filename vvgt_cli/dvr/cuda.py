"""The ray caster on a CUDA device: what the CPU's kernels call, compiled for it by numba-cuda, a thread a pixel."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from vvgt_cli.dvr.kernel import (
    FLAGS,
    OPAQUE,
    U,
    box_span,
    inverse,
    is_flat,
    pass_segment,
    sample,
    skip,
    table_coordinate,
    values_met,
)
from vvgt_cli.dvr.layout import Optics, Voxels
from vvgt_cli.dvr.march import LEAP, direction, shade_segment
from vvgt_cli.dvr.vectors import Vector, add, lane, zeros4
from vvgt_cli.jit.decorators import inlined
from vvgt_cli.jit.gpu import cuda, free_bytes, gpu_kernel, sent, size_of

if TYPE_CHECKING:
    from vvgt_cli.dvr.scene import Scene

THREADS = 128  # of a block
REGISTERS = 96  # of a thread: rays wait for memory, so that many of them beat few that keep all in registers
Draw = Callable[..., None]  # arguments as of `march.render_tiles` from ``eye`` on

_jit = inlined(fastmath=FLAGS, error_model="numpy", borrowed=True)


@_jit
def cast(
    voxels: Voxels, optics: Optics, empty: np.ndarray, light: Any, p: Vector, d: Vector, step: float
) -> tuple[float, float, float, float]:
    """Return premultiplied (r, g, b, alpha) along a ray, as `march` does, in float64 and sample by sample.

    Runs of samples are for vector instructions, which a thread of a GPU does not have. Arguments as of `march`.
    """
    (px, py, pz), (dx, dy, dz) = p, d
    nz, ny, nx = voxels.values.shape
    seen, flat = zeros4(), is_flat(optics)
    trans, red, green, blue = 1.0, 0.0, 0.0, 0.0
    t0, t1 = box_span(px, py, pz, dx, dy, dz, nx, ny, nz)
    if not t1 > t0:
        return 0.0, 0.0, 0.0, 0.0
    steps = math.ceil((t1 - t0) * math.sqrt(dx * dx + dy * dy + dz * dz) / step)
    count = max(int(steps), 1)  # a float on the device
    dt = (t1 - t0) / count
    opaque = OPAQUE * min(step * step, 1.0)
    ix, iy, iz, per_step = inverse(dx), inverse(dy), inverse(dz), 1.0 / dt
    look = d if light is None else (dx * light.edge[0], dy * light.edge[1], dz * light.edge[2])
    before = u0 = -1.0  # -1: no sample there, or not finite
    i, stop, known = 0, 0, -1
    ahead = 0.0  # sample ``known``, asked for before the one ahead of it is used: memory is slow
    while i <= count and trans >= opaque:
        if i >= stop:
            at = i - 1 if u0 >= 0.0 else i  # the segment that comes from there is still to be seen
            start = skip((nz, ny, nx), empty, px, py, pz, dx, dy, dz, ix, iy, iz, t0, dt, per_step, count, at)
            if start >= count:
                break
            if start > at:
                before, u0, i = -1.0, -1.0, max(start - 1, 0)  # one earlier, for what bends the next
            stop = i + LEAP
        t = t0 + i * dt
        value = ahead if known == i else sample(voxels.values, px + t * dx, py + t * dy, pz + t * dz)
        s, known = t + dt, i + 1
        ahead = sample(voxels.values, px + s * dx, py + s * dy, pz + s * dz)
        u1 = table_coordinate(value, optics)
        met = values_met(before, u0, u1, flat)
        if met[0] >= 0.0 and met[1] > optics.dark[U(int(met[0]))]:
            before_it = trans
            own, trans, begin, end = pass_segment(voxels, optics, p, d, t - dt, dt, u0, u1, met, zeros4(), trans)
            if light is None:
                seen = add(seen, own)
            elif lane(own, 3) > 0.0:
                r, g, b = shade_segment(own, light, voxels.values, p, d, look, begin, end, before_it)
                red, green, blue = red + r, green + g, blue + b
        before, u0 = u0, u1
        i += 1
    if light is None:
        red, green, blue = lane(seen, 0), lane(seen, 1), lane(seen, 2)
    return red, green, blue, 1.0 - trans


@_jit
def _store(
    data: Any, light: Any, camera: np.ndarray, step: float, width: int, places: np.ndarray,
    offsets: np.ndarray, out: np.ndarray, n: int,
) -> None:  # fmt: skip
    """Store the mean of the rays of pixel ``places[n]``, counted row by row, into row ``n`` of ``out`` (m, 4).

    ``camera`` (5, 4): eye, the rows of the basis, lens, as of `march.render_tiles`; ``data``: `scene_arrays`.
    """
    row, col, rays = places[n] // width, places[n] % width, offsets.shape[0]
    p = camera[0, 0], camera[0, 1], camera[0, 2]
    red = green = blue = alpha = 0.0
    for ray in range(rays):
        d = direction(camera[1:4], camera[4], col + 0.5 + offsets[ray, 0], row + 0.5 + offsets[ray, 1])
        r, g, b, a = cast(data[0], data[1], data[2], light, p, d, step)
        red, green, blue, alpha = red + r, green + g, blue + b, alpha + a
    out[n, 0], out[n, 1], out[n, 2], out[n, 3] = red / rays, green / rays, blue / rays, alpha / rays


@gpu_kernel(fastmath=FLAGS, max_registers=REGISTERS)
def plain_pixels(data, camera, step, width, places, offsets, out):  # type: ignore[no-untyped-def]
    """Apply `_store` to a pixel, without a light."""
    n = cuda.grid(1)
    if n < out.shape[0]:
        _store(data, None, camera, step, width, places, offsets, out, n)


@gpu_kernel(fastmath=FLAGS, max_registers=REGISTERS)
def lit_pixels(data, camera, step, width, places, offsets, out):  # type: ignore[no-untyped-def]
    """Apply `_store` to a pixel, with the light that lies in ``data``."""
    n = cuda.grid(1)
    if n < out.shape[0]:
        _store(data, data[3], camera, step, width, places, offsets, out, n)


def scene_arrays(scene: Scene) -> tuple[Any, ...]:
    """Return what a ray of a scene reads, as the arguments of `cast` in front of the ray."""
    return scene.voxels, scene.optics, scene.empty, *(() if scene.light is None else (scene.light,))


class DeviceRays:
    """Casts the rays of a scene on the first CUDA device; once that has failed, on the CPU.

    Attributes:
        scene: what is drawn, without these rays.
        report: gets a line if the device fails.
    """

    def __init__(self, scene: Scene, report: Callable[[str], None]) -> None:
        """Take a scene; nothing is sent to the device before a ray is cast."""
        self.scene, self.report, self.failed = replace(scene, rays=None), report, False

    @cached_property
    def on_device(self) -> tuple[Any, ...]:
        """The scene's arrays on the device.

        Raises:
            MemoryError: more bytes than are free there.
        """
        data = scene_arrays(self.scene)
        needed, free = size_of(data), free_bytes()
        if needed > free:
            raise MemoryError(f"the volume needs {needed / 1e9:.1f} GB, of which {free / 1e9:.1f} are free")
        return tuple(sent(data))

    def __call__(self, *args: Any) -> None:
        """Draw pixels; arguments as of `march.render_tiles` from ``eye`` on."""
        from vvgt_cli.dvr.render import host_rays

        if not self.failed:
            try:
                return self._cast(*args)
            except Exception as error:  # the driver's, the compiler's and numba's, which share no class
                self.failed = True
                self.__dict__.pop("on_device", None)
                reason = " ".join(str(error).split())[:200]
                self.report(f"the GPU failed ({reason}); views are drawn on the CPU")
        return host_rays(self.scene)(*args)

    def _cast(
        self, eye: np.ndarray, basis: np.ndarray, lens: np.ndarray, step: float, _order: np.ndarray,
        offsets: np.ndarray, mask: np.ndarray, known: int, out: np.ndarray,
    ) -> None:  # fmt: skip
        places = np.flatnonzero(mask)
        if not len(places):
            return
        data, pixels = self.on_device, cuda.device_array((len(places), 4), np.float32)
        camera = np.zeros((5, 4))
        camera[0, :3], camera[1:4, :3], camera[4] = eye, basis, lens
        there = sent((camera, places.astype(np.int32), np.asarray(offsets, np.float64)))
        render = plain_pixels if self.scene.light is None else lit_pixels
        blocks = -(-len(places) // THREADS)
        render[blocks, THREADS](data, there[0], step, mask.shape[1], *there[1:], pixels)
        rows, share = out.reshape(-1, 4), np.float32(len(offsets) / (known + len(offsets)))
        drawn = pixels.copy_to_host()
        rows[places] = drawn if known == 0 else (1 - share) * rows[places] + share * drawn
