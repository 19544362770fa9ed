"""The ray caster in torch, for CUDA: the kernel's definition and tables, all rays of a block of pixels at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.dvr.render import RenderSettings, tiers
from vvgt_cli.dvr.scene import Scene
from vvgt_cli.errors import DataError, UsageError

RAYS = 1 << 18  # marched at a time: bounds the memory
CHECK = 16  # steps between two looks at which rays still go on: each look waits for the device
OPAQUE = 1e-3  # times step^2: the kernel's
PARTS = 4  # sub-segments, a fixed number of them: all rays go through the same operations


def view_renderer(scene: Scene, settings: RenderSettings, device: str = "cuda") -> Callable[[Camera], np.ndarray]:
    """A function from a camera to its view, (height, width, 4) float32, premultiplied.

    Raises:
        UsageError: torch is not installed.
        DataError: torch finds no CUDA device.
    """
    try:
        import torch
    except ImportError:
        raise UsageError("the cuda renderer needs torch; install vvgt[cuda], or use the cpu renderer") from None
    if device == "cuda" and not torch.cuda.is_available():
        raise DataError("the cuda renderer found no CUDA device; use the cpu renderer, or check the driver")
    field = Field.upload(scene, device)

    def draw(camera: Camera) -> np.ndarray:
        image = np.zeros((camera.height, camera.width, 4), np.float32)

        for rays in tiers(settings, image):
            for offsets, mask, known in rays:
                new = field.pixels(camera, np.array(np.nonzero(mask)), offsets, settings.step)
                image[mask] = (known * image[mask] + len(offsets) * new) / (known + len(offsets))
        return image

    return draw


@dataclass(frozen=True)
class Field:
    """A scene on a device: ``values`` (1, 1, nz, ny, nx) float32, ``nodes`` and ``cumulative`` (n + 1, 4) float64."""

    scene: Scene
    values: Any
    nodes: Any
    cumulative: Any

    @classmethod
    def upload(cls, scene: Scene, device: str) -> Field:
        import torch

        values = torch.from_numpy(scene.values.astype(np.float32)).to(device)[None, None]
        nodes, cumulative = (torch.from_numpy(t).to(device) for t in (scene.optics.nodes, scene.optics.cumulative))
        return cls(scene, values, nodes, cumulative)

    def pixels(self, camera: Camera, pixels: np.ndarray, offsets: np.ndarray, step: float) -> np.ndarray:
        """Means over the rays at ``offsets`` (m, 2) of ``pixels`` (2, n), rows and columns: (n, 4) float32."""
        import torch

        at = 0.5 + offsets
        block = max(RAYS // len(at), 1)
        parts = []
        for start in range(0, pixels.shape[1], block):
            row, col = pixels[:, start : start + block, None]
            a, b = (col + at[:, 0] - camera.cx) / camera.fx, (row + at[:, 1] - camera.cy) / camera.fy
            local = np.stack([a, b, np.ones_like(a)], axis=-1).reshape(-1, 3)
            local /= np.linalg.norm(local, axis=1, keepdims=True)
            directions = torch.from_numpy(local @ camera.rotation).to(self.values.device)
            rgba = self.march(camera.position, directions, step)
            parts.append(rgba.reshape(-1, len(at), 4).mean(dim=1).float().cpu().numpy())
        return np.concatenate(parts)

    def march(self, eye: np.ndarray, directions: Any, step: float) -> Any:
        """Premultiplied RGBA (n, 4) float64 along unit ``directions`` (n, 3) float64 in the unit frame."""
        import torch

        scene, device = self.scene, directions.device
        edge = torch.as_tensor(scene.step, device=device)
        p = torch.as_tensor((eye + scene.half) / scene.step - 0.5, device=device)  # voxel coordinates
        d = directions / edge
        t0, t1 = self._span(p, d)
        count = torch.ceil((t1 - t0) * d.norm(dim=1) / step).clamp(min=1)
        dt = (t1 - t0) / count
        out = torch.zeros((len(d), 4), dtype=torch.float64, device=device)
        rays = torch.nonzero(t1 > t0)[:, 0]
        light = torch.zeros((len(rays), 4), dtype=torch.float64, device=device)
        light[:, 3] = 1
        u0 = self._coordinate(p + t0[rays, None] * d[rays])
        opaque = OPAQUE * min(step * step, 1.0)
        for i in range(1, int(count.max()) + 1):
            if i % CHECK == 0:
                go = (light[:, 3] >= opaque) & (count[rays] >= i)
                out[rays[~go]] = light[~go]
                rays, light, u0 = rays[go], light[go], u0[go]
                if len(rays) == 0:
                    break
            u1 = self._coordinate(p + (t0[rays] + i * dt[rays])[:, None] * d[rays])
            length = torch.where(count[rays] >= i, dt[rays], 0.0)
            light = self._composite(u0, u1, length, light)
            u0 = u1
        out[rays] = light
        hit = t1 > t0
        out[:, 3] = torch.where(hit, 1 - out[:, 3], 0.0)
        return out

    def _span(self, p: Any, d: Any) -> tuple[Any, Any]:
        """Entry and exit (n,) of rays p + t d, t >= 0, through the box; not entry < exit: missed."""
        import torch

        top = torch.as_tensor(self.scene.values.shape[::-1], device=d.device) - 0.5
        near, far = (-0.5 - p) / d, (top - p) / d
        parallel, inside = d == 0, (p >= -0.5) & (p <= top)
        endless = torch.full_like(d, torch.inf)
        first = torch.where(parallel, torch.where(inside, -endless, endless), torch.minimum(near, far))
        last = torch.where(parallel, torch.where(inside, endless, -endless), torch.maximum(near, far))
        t0, t1 = first.amax(dim=1).clamp(min=0), last.amin(dim=1)
        hit = t1 > t0
        return torch.where(hit, t0, 0.0), torch.where(hit, t1, 0.0)

    def _coordinate(self, points: Any) -> Any:
        """Table coordinates (n,) float64 at voxel coordinates (n, 3); NaN where a voxel around is not finite."""
        import torch

        nz, ny, nx = self.values.shape[2:]
        top = torch.tensor([nx, ny, nz], device=points.device) - 1
        points = torch.minimum(points.clamp(min=0), top)
        low = points.long()
        high = torch.minimum(low + 1, top)
        f = points - low
        flat = self.values.reshape(-1)
        total = torch.zeros(len(points), dtype=torch.float64, device=points.device)
        for corner in np.ndindex(2, 2, 2):
            at = [(high if up else low)[:, axis] for axis, up in enumerate(corner)]
            w = [f[:, axis] if up else 1 - f[:, axis] for axis, up in enumerate(corner)]
            total += w[0] * w[1] * w[2] * flat[(at[2] * ny + at[1]) * nx + at[0]]
        tables = self.scene.optics
        u = ((total - tables.lo) * tables.inv_width).clamp(0.0, float(tables.bins))
        return torch.where(torch.isfinite(total), u, torch.nan)

    def _rows(self, u: Any) -> tuple[Any, Any]:
        """Optics at u (n,) and their integrals over [0, u], (n, 4) each (`kernel._point`, `_integrals`)."""
        i = u.long().clamp(max=len(self.nodes) - 2)
        f = (u - i)[:, None]
        a, b = self.nodes[i], self.nodes[i + 1]
        return a + f * (b - a), self.cumulative[i] + f * a + 0.5 * f * f * (b - a)

    def _composite(self, u0: Any, u1: Any, length: Any, light: Any) -> Any:
        """``light`` (n, 4: r, g, b, T) behind segments along which the coordinate goes from u0 to u1."""
        import torch

        known = torch.isfinite(u0) & torch.isfinite(u1)
        u0, u1 = torch.where(known, u0, 0.0), torch.where(known, u1, 0.0)
        width = u1 - u0
        narrow = width.abs() < 0.5
        point = self._rows(0.5 * (u0 + u1))[0]
        wide = torch.where(narrow, 1.0, width)[:, None]
        ends = [self._rows(u0 + width * (k / PARTS))[1] for k in range(PARTS + 1)]
        color, trans = light[:, :3], light[:, 3]
        length = torch.where(known, length, 0.0)[:, None]
        for a, b in pairwise(ends):
            optics = torch.where(narrow[:, None], point / PARTS, (b - a) / wide) * length
            depth = optics[:, 3].clamp(min=0)
            absorbed = torch.where(depth > 0, -torch.expm1(-depth) / depth.clamp(min=1e-300), 1.0) * trans
            color = color + absorbed[:, None] * optics[:, :3]
            trans = trans * torch.exp(-depth)
        return torch.cat([color, trans[:, None]], dim=1)
