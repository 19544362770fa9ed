"""Volumes and functions that are stiff, extreme or odd; each a scene that stages must cope with."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.dvr import Scene
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.volume import Volume

EYE = (2.2, -1.6, 1.1)
RAMP_X, RAMP_Y = (0.0, 0.3, 0.5, 1.0), (0.0, 0.0, 0.6, 0.2)
RAMP_RGB = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, 0.0, 0.0))
BIG = ">f8"


def function(x: object, opacity: object, rgb: object = None) -> TransferFunction:
    """Opacity and colour linear between nodes; white without colours."""
    at = np.asarray(x, np.float64)
    colors = np.ones((len(at), 3)) if rgb is None else np.asarray(rgb, np.float64)
    return TransferFunction("check", PiecewiseOpacity(at, np.asarray(opacity, np.float64)), ColorMap(at, colors))


def ramp(factor: float = 1.0, offset: float = 0.0) -> TransferFunction:
    """Two slopes and a plateau of nothing, coloured, over [offset, offset + factor]."""
    return function(np.array(RAMP_X) * factor + offset, RAMP_Y, RAMP_RGB)


def step(opacity: float, width: float = 1e-4) -> TransferFunction:
    """Nothing below 0.5, ``opacity`` from 0.5 + ``width`` on."""
    return function([0, 0.5, 0.5 + width, 1], [0, 0, opacity, opacity])


def rough(shape: tuple[int, int, int] = (9, 8, 10), seed: int = 0) -> np.ndarray:
    """Independent values in [0, 1), float64."""
    return np.random.default_rng(seed).uniform(0, 1, shape)


def smooth(n: int = 10) -> np.ndarray:
    """A lopsided blob of values in [0, 1.4), (n, n, n) float64."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    return np.exp(-2 * (x * x + 1.5 * y * y + 0.7 * z * z) + 0.4 * np.sin(3 * x + y))


def camera(width: int = 16, height: int = 16, eye: tuple[float, float, float] = EYE, fov: float = 40.0) -> Camera:
    """A camera that looks at the centre of the box."""
    return look_at(eye, width=width, height=height, fov=fov)


@dataclass(frozen=True)
class Hard:
    """A scene and what its reference needs.

    Attributes:
        name: what is hard about it.
        make: builds it.
        step: of the float64 twin that it is compared with, in the smallest voxel edge.
        error: allowed of views, mean difference over the largest value.
        mass: allowed of optical mass, relative.
        points: of the quadrature that the mass is compared with, along a voxel's edge.
        fov: degrees, of the camera: needles are looked at closely.
    """

    name: str
    make: Callable[[], Scene]
    step: float = 1 / 32
    error: float = 3e-3
    mass: float = 1e-2
    points: int = 6
    fov: float = 40.0


def build(data: np.ndarray | Volume, tf: TransferFunction, distance: float = 1.0) -> Scene:
    """A scene; voxels of edge 1 where only an array is given."""
    volume = data if isinstance(data, Volume) else Volume(data)
    return Scene.build(volume, tf, distance)  # frozen, the protocol's name is not


def _scene(data: np.ndarray, tf: TransferFunction, spacing: tuple[float, float, float] = (1.0,) * 3) -> Scene:
    return build(Volume(data, spacing), tf, float(np.mean(spacing)))


def _depth(per_voxel: float) -> Scene:
    return _scene(smooth(), step(-math.expm1(-per_voxel)))


def _capped(per_voxel: float) -> Scene:
    """Opacity 1 per a distance so short that one voxel has this optical depth: the cap on opacity limits none."""
    return build(smooth(), step(1.0), -math.log(1e-5) / per_voxel)


def _values(factor: float, offset: float = 0.0) -> Scene:
    return _scene(rough((6, 7, 8), 4) * factor + offset, ramp(factor, offset))


def _lengths(factor: float) -> Scene:
    return _scene(rough((5, 6, 4), 3), ramp(), (factor,) * 3)


def _stretched(axis: int) -> Scene:
    spacing = [1.0, 1.0, 1.0]
    spacing[axis] = 1000.0
    return _scene(rough((4, 4, 4), 3), ramp(), (spacing[0], spacing[1], spacing[2]))


def _holes(bad: float) -> Scene:
    data = rough((8, 8, 8), 7)
    data[2:4, 3:5, 2:6] = bad
    return _scene(data, function([0, 1], [0.2, 0.4]))


def _lonely() -> Scene:
    data = np.full((6, 6, 6), np.nan)
    data[2:4, 2:4, 2:4] = 0.7
    return _scene(data, function([0, 1], [0.2, 0.4]))


def _sheet() -> Scene:
    data = np.zeros((9, 9, 9))
    data[:, :, 4] = 1.0
    return _scene(data, function([0, 0.5, 1], [0, 0, 0.9]))


def _checkerboard() -> Scene:
    z, y, x = np.indices((6, 6, 6))
    return _scene(((x + y + z) % 2).astype(np.float32), function([0, 1], [0.0, 0.8], [[1, 0, 0], [0, 0, 1]]))


def _star() -> Scene:
    data = np.zeros((11, 11, 11), np.float32)
    data[5, 5, 5] = 1.0
    return _scene(data, function([0, 1], [0.0, 1.0]))


def _typed(kind: str) -> Scene:
    dtype = np.dtype(kind)
    top = 200.0 if dtype.kind == "f" else float(min(np.iinfo(dtype).max, 2**40))
    low = 0.0 if dtype.kind in "fu" else -top
    data = (low + (top - low) * rough((6, 7, 8), 5)).astype(dtype)
    return _scene(data, ramp(top - low, low))


def _scaled() -> Scene:
    data = (rough((6, 7, 8), 5) * 255).astype(np.uint8)
    volume = Volume(data, slope=-0.5 / 255, intercept=0.75)
    return build(volume, function([0.25, 0.5, 0.75], [0.0, 0.5, 0.2], RAMP_RGB[:3]))


def hard_scenes() -> list[Hard]:
    """Every scene, in order."""
    return [
        *(Hard(f"step function, depth {d:g} a voxel", partial(_depth, d)) for d in (1e-6, 1e-4, 1e-2, 1.0)),
        *(Hard(f"step function, depth {d:g} a voxel", partial(_capped, d)) for d in (1e2, 1e4, 1e6)),
        Hard("step function of opacity 1", lambda: _scene(smooth(), step(1.0))),
        Hard("step function between two floats", lambda: _scene(smooth(), step(0.7, 1.2e-16))),
        Hard("shell of a hundredth of the range", partial(_shell, 0.01), 1 / 128, 6e-3, 6e-2, 12),
        Hard("shell of a thousandth of the range", partial(_shell, 0.001), 1 / 256, 2e-2, 6e-2, 12),
        Hard("constant", lambda: _scene(np.full((4, 5, 6), 0.5), ramp())),
        Hard("constant beyond the last node", lambda: _scene(np.full((4, 5, 6), 7.0), ramp())),
        Hard("one voxel", lambda: _scene(rough((1, 1, 1), 3) + 0.4, ramp())),
        *(Hard(f"one slice along {a}", partial(_slice, i)) for i, a in enumerate("zyx")),
        Hard("one row of voxels", lambda: _scene(rough((1, 1, 9), 3), ramp())),
        *(Hard(f"spacing 1000:1 along {a}", partial(_stretched, i), fov=0.08) for i, a in enumerate("xyz")),
        *(Hard(f"lengths of {f:g}", partial(_lengths, f)) for f in (1e-30, 1e30)),
        *(Hard(f"values of {f:g}", partial(_values, f)) for f in (1e-30, 1e30, 1e300)),
        Hard("values of 1e6 that differ by 1", lambda: _values(1.0, 1e6)),
        *(Hard(f"a block of {b:g}", partial(_holes, b), error=2e-2) for b in (np.nan, np.inf, -np.inf)),
        Hard("NaN all around eight voxels", _lonely, error=2e-2),
        Hard("a sheet one voxel thin", _sheet, error=2e-2, mass=2e-2, points=12),  # steps of 1/8 pass beside its peak
        Hard("checkerboard of voxels", _checkerboard),
        Hard("a single voxel that shows", _star, mass=6e-2, points=12),  # -ln(1 - a) peaks within its cell
        *(Hard(f"values of type {kind}", partial(_typed, kind)) for kind in TYPES),
        Hard("values scaled by a negative slope", _scaled),
    ]


TYPES = ("u1", "<u2", ">u2", "<i2", ">i4", "<u4", "<i8", ">f4", BIG, "<f2", "i1")


def _shell(width: float) -> Scene:
    return build(smooth(7), function([0, 0.5 - width, 0.5, 0.5 + width, 1], [0, 0, 0.9, 0, 0]))


def _slice(axis: int) -> Scene:
    shape = [7, 8, 9]
    shape[axis] = 1
    return _scene(rough((shape[0], shape[1], shape[2]), 3), ramp())
