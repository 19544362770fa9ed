"""Stiff, extreme and odd scenes, and the few helpers that make them: scalar volumes, label maps, colours, layers."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from vvgt_cli.cameras import Camera
from vvgt_cli.cameras.sets import look_at
from vvgt_cli.dvr import Scene
from vvgt_cli.dvr.layers import Layer, common_grid, grid_of
from vvgt_cli.dvr.reference import optics_at
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.labels import Label, LabelTable, distinct
from vvgt_cli.volume import Volume

RAMP_X, RAMP_Y = (0.0, 0.3, 0.5, 1.0), (0.0, 0.0, 0.6, 0.2)
RAMP_RGB = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, 0.0, 0.0))
RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
TYPES = ("u1", "<u2", ">u2", "<i2", ">i4", "<u4", "<i8", ">f4", ">f8", "<f2", "i1")


def function(x: object, opacity: object, rgb: object = None) -> TransferFunction:
    """Return a function that is linear between nodes; white without colours."""
    at = np.asarray(x, np.float64)
    colors = np.ones((len(at), 3)) if rgb is None else np.asarray(rgb, np.float64)
    return TransferFunction("check", PiecewiseOpacity(at, np.asarray(opacity, np.float64)), ColorMap(at, colors))


def ramp(factor: float = 1.0, offset: float = 0.0) -> TransferFunction:
    """Return two slopes and a transparent plateau, coloured, over [offset, offset + factor]."""
    return function(np.array(RAMP_X) * factor + offset, RAMP_Y, RAMP_RGB)


def step(opacity: float, width: float = 1e-4) -> TransferFunction:
    """Return a function that is 0 below 0.5 and ``opacity`` from 0.5 + ``width`` on."""
    return function([0, 0.5, 0.5 + width, 1], [0, 0, opacity, opacity])


def rough(shape: tuple[int, int, int] = (9, 8, 10), seed: int = 0) -> np.ndarray:
    """Return independent values in [0, 1), float64."""
    return np.random.default_rng(seed).uniform(0, 1, shape)


def smooth(n: int = 10) -> np.ndarray:
    """Return a lopsided blob of values in [0, 1.4), (n, n, n) float64."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    return np.exp(-2 * (x * x + 1.5 * y * y + 0.7 * z * z) + 0.4 * np.sin(3 * x + y))


def camera(width: int = 16, height: int = 16, eye: tuple[float, float, float] = (2.2, -1.6, 1.1), fov=40.0) -> Camera:
    """Return a camera that looks at the centre of the box."""
    return look_at(eye, width=width, height=height, fov=fov)


def build(data: np.ndarray, tf: TransferFunction, distance: float = 1.0, spacing=(1.0, 1.0, 1.0)) -> Scene:
    """Return the scene of an array."""
    return Scene.build(Volume(data, spacing), tf, distance)


def quadrature(scene: Scene, points: int) -> float:
    """Return the optical mass of a scene in float64, by the midpoint rule at ``points``^3 a voxel."""
    axes = [(np.arange(n * points) + 0.5) / points - 0.5 for n in scene.volume.dims]
    tau, _ = optics_at(scene, np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3))
    return float(tau.sum() * np.prod(scene.step / points))


@dataclass(frozen=True)
class Stiff:
    """A scene and the effort that its references need.

    Attributes:
        make: builds it.
        step: of the float64 twin, in the smallest voxel edge.
        error: allowed mean difference of a view, relative to its largest value.
        mass: allowed relative error of optical mass.
        points: of the quadrature, along a voxel's edge.
        fov: of the camera in degrees; needles are seen from near.
    """

    make: Callable[[], Scene]
    step: float = 1 / 32
    error: float = 3e-3
    mass: float = 1e-2
    points: int = 6
    fov: float = 40.0


def _capped(per_voxel: float) -> Scene:
    """Opacity 1 per a distance so short that a voxel has this optical depth, whatever opacities are capped at."""
    return build(smooth(), step(1.0), -math.log(1e-5) / per_voxel)


def _holes(bad: float) -> Scene:
    data = rough((8, 8, 8), 7)
    data[2:4, 3:5, 2:6] = bad
    return build(data, function([0, 1], [0.2, 0.4]))


def _nearly(value: float, shape: tuple[int, int, int], at: object, inside: float, tf: TransferFunction) -> Scene:
    """One value everywhere, but for voxels ``at`` somewhere."""
    data = np.full(shape, value)
    data[at] = inside
    return build(data, tf)


def _typed(kind: str) -> Scene:
    dtype = np.dtype(kind)
    top = 200.0 if dtype.kind == "f" else float(min(np.iinfo(dtype).max, 2**40))
    low = 0.0 if dtype.kind in "fu" else -top
    return build((low + (top - low) * rough((6, 7, 8), 5)).astype(dtype), ramp(top - low, low))


def _scaled() -> Scene:
    volume = Volume((rough((6, 7, 8), 5) * 255).astype(np.uint8), slope=-0.5 / 255, intercept=0.75)
    return Scene.build(volume, function([0.25, 0.5, 0.75], [0.0, 0.5, 0.2], RAMP_RGB[:3]), 1.0)


def _shell(width: float) -> Scene:
    return build(smooth(7), function([0, 0.5 - width, 0.5, 0.5 + width, 1], [0, 0, 0.9, 0, 0]))


def _values(factor: float, offset: float = 0.0) -> Scene:
    return build(rough((6, 7, 8), 4) * factor + offset, ramp(factor, offset))


def _random(shape: tuple[int, int, int], spacing=(1.0, 1.0, 1.0)) -> Scene:
    return build(rough(shape, 3), ramp(), float(np.mean(spacing)), spacing)


def _checkerboard() -> Scene:
    return build(np.indices((6, 6, 6)).sum(axis=0) % 2.0, function([0, 1], [0.0, 0.8], [RED, BLUE]))


SCALARS = {
    **{f"depth {d:g} a voxel": Stiff(partial(build, smooth(), step(-math.expm1(-d)))) for d in (1e-6, 1e-4, 1e-2, 1.0)},
    **{f"depth {d:g} a voxel": Stiff(partial(_capped, d)) for d in (1e2, 1e4, 1e6)},
    "opacity 1": Stiff(lambda: build(smooth(), step(1.0))),
    "a step between two floats": Stiff(lambda: build(smooth(), step(0.7, 1.2e-16))),
    "shell of a hundredth": Stiff(partial(_shell, 0.01), 1 / 128, 6e-3, 6e-2, 12),
    "shell of a thousandth": Stiff(partial(_shell, 0.001), 1 / 256, 2e-2, 6e-2, 12),
    "constant": Stiff(lambda: build(np.full((4, 5, 6), 0.5), ramp())),
    "constant beyond the last node": Stiff(lambda: build(np.full((4, 5, 6), 7.0), ramp())),
    "one voxel": Stiff(lambda: build(rough((1, 1, 1), 3) + 0.4, ramp())),
    **{f"{n} voxels": Stiff(partial(_random, n)) for n in ((1, 8, 9), (7, 1, 9), (7, 8, 1), (1, 1, 9))},
    **{
        f"spacing {s}": Stiff(partial(_random, (4, 4, 4), s), fov=0.08)
        for s in ((1e3, 1.0, 1.0), (1.0, 1e3, 1.0), (1.0, 1.0, 1e3))
    },
    **{f"lengths of {f:g}": Stiff(partial(_random, (5, 6, 4), (f, f, f))) for f in (1e-30, 1e30)},
    **{f"values of {f:g}": Stiff(partial(_values, f)) for f in (1e-30, 1e30, 1e300)},
    "values of 1e6 that differ by 1": Stiff(lambda: _values(1.0, 1e6)),
    **{f"a block of {b:g}": Stiff(partial(_holes, b), error=2e-2) for b in (np.nan, np.inf, -np.inf)},
    "NaN around eight voxels": Stiff(
        lambda: _nearly(np.nan, (6, 6, 6), np.s_[2:4, 2:4, 2:4], 0.7, function([0, 1], [0.2, 0.4])), error=2e-2
    ),
    "a sheet one voxel thin": Stiff(  # steps of 1/8 pass beside its peak
        lambda: _nearly(0.0, (9, 9, 9), np.s_[:, :, 4], 1.0, function([0, 0.5, 1], [0, 0, 0.9])), 1 / 32, 2e-2, 2e-2, 12
    ),
    "checkerboard": Stiff(_checkerboard),
    "a single visible voxel": Stiff(  # -ln(1 - a) peaks within its cell
        lambda: _nearly(0.0, (11, 11, 11), (5, 5, 5), 1.0, function([0, 1], [0, 1])), mass=6e-2, points=12
    ),
    **{f"type {kind}": Stiff(partial(_typed, kind)) for kind in TYPES},
    "a negative slope": Stiff(_scaled),
}


def layers_scene(*layers: Layer) -> Scene:
    """Return the scene that layers add up to."""
    target = common_grid(layers)
    return Scene.of_grid(target, layers[0].tf, layers[0].unit_distance, grid_of(layers, target))


def labels(data: np.ndarray, shown: Sequence[tuple[int, tuple, float]], edge: float = 1.0, distance=None) -> Scene:
    """Return the scene of a label map; ``shown`` has numbers, colours and opacities."""
    table = LabelTable("check", tuple(Label(n, str(n), c, a) for n, c, a in shown))
    return layers_scene(Layer(Volume(data, (edge,) * 3), table, distance or edge))


def _three(seed: int, shape: tuple[int, int, int] = (6, 7, 8)) -> np.ndarray:
    """Labels 0 to 2 at random."""
    return (rough(shape, seed) * 3).astype(np.uint8)


def _every_voxel() -> Scene:
    """Each voxel a label of its own, with an opacity from 0 to 1."""
    rng, data = np.random.default_rng(2), np.arange(1, 337, dtype=np.uint16).reshape(6, 7, 8)
    return labels(data, [(k, tuple(rng.random(3)), float(rng.random())) for k in range(1, 337)])


def _lonely(opacity: float) -> Scene:
    data = np.zeros((9, 9, 9), np.uint8)
    data[4, 4, 4] = 7
    return labels(data, [(7, RED, opacity)])


def in_turns(opacity: float) -> Scene:
    """Return labels 1 and 3 in turns, red and blue; label 2, green, is nowhere."""
    data = np.where(np.indices((6, 6, 6)).sum(axis=0) % 2, 1, 3).astype(np.int16)
    return labels(data, [(1, RED, opacity), (2, GREEN, 1.0), (3, BLUE, opacity)])


def solid_beside_nothing() -> Scene:
    """Return a label of opacity 1 beside a green one of opacity 0, which has no share in the border's colour."""
    data = np.ones((8, 8, 8), np.int8)
    data[:, :, 4:] = 2
    return labels(data, [(1, RED, 1.0), (2, GREEN, 0.0)])


def _all_of_16_bits() -> Scene:
    data = np.random.default_rng(3).permutation(41 * 40 * 40).reshape(41, 40, 40) % 65_536
    return layers_scene(Layer(Volume(data.astype(np.uint16)), distinct(range(65_536)), 40.0))


def _far_numbers() -> Scene:
    """Labels near the ends of 32 bits, a type that no table of bits covers."""
    ends = -(2**31) + 1, 2**31 - 1
    return labels(np.where(rough((6, 7, 8)) < 0.5, *ends), [(ends[0], RED, 0.3), (ends[1], BLUE, 0.6)])


def _sheets() -> Scene:
    """Sheets of one voxel, each another label."""
    data = np.broadcast_to(np.arange(1, 10, dtype=np.uint8), (9, 9, 9)).copy()
    return labels(data, [(k, (RED, GREEN, BLUE)[k % 3], 0.3) for k in range(1, 10)])


def _label_depth(per_voxel: float) -> Scene:
    return labels(_three(4), [(1, RED, 1.0), (2, BLUE, 1.0)], 1.0, -math.log(1e-5) / per_voxel)


def _colour(value: float, shape: tuple[int, int, int] = (4, 5, 6)) -> Scene:
    bands = tuple(Volume(np.full(shape, value * share, np.float32)) for share in (1.0, 0.5, 0.25))
    return layers_scene(Layer(bands[0], function([0, 1], [0, 0.5]), 1.0, "given", bands, 1.0))


def _barely() -> Scene:
    """A layer of which half a voxel lies in the first one's box."""
    first, other = Volume(rough((6, 6, 6))), Volume(rough((6, 6, 6), 1), origin=(5.5, 0.0, 0.0))
    red = function([0, 1], [0.9, 0.9], [RED, RED])
    return layers_scene(Layer(first, function([0, 1], [0, 0.4]), 1.0), Layer(other, red, 1.0))


def _finer() -> Scene:
    """A scan with labels in voxels of half its edge, turned by a quarter."""
    turned = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    fine = Volume(_three(5, (10, 10, 10)), (0.5,) * 3, (4.25, -0.25, -0.25), turned)
    table = LabelTable("check", (Label(1, "1", RED, 0.3), Label(2, "2", BLUE, 0.9)))
    return layers_scene(Layer(Volume(rough((5, 5, 5))), function([0, 1], [0, 0.3]), 1.0), Layer(fine, table, 1.0))


TWO = [(1, RED, 0.3), (2, BLUE, 0.6)]
GRIDS = {
    "a label for each voxel": Stiff(_every_voxel),
    **{f"a voxel of a label of opacity {a:g}": Stiff(partial(_lonely, a)) for a in (1e-5, 1.0)},
    **{f"labels in turns, opacity {a:g}": Stiff(partial(in_turns, a)) for a in (0.3, 1.0)},
    "opacity 1 beside opacity 0": Stiff(solid_beside_nothing),
    "65,536 labels": Stiff(_all_of_16_bits, points=1),
    "labels near the ends of 32 bits": Stiff(_far_numbers),
    "sheets of one voxel": Stiff(_sheets),
    **{f"labels of depth {d:g} a voxel": Stiff(partial(_label_depth, d)) for d in (1e-6, 1e-2)},
    **{f"labels of depth {d:g} a voxel": Stiff(partial(_label_depth, d), 1 / 128, 2e-2) for d in (1e2, 1e6)},
    **{f"labels, lengths of {f:g}": Stiff(partial(labels, _three(3, (5, 6, 4)), TWO, f)) for f in (1e-30, 1e30)},
    **{f"a colour of {v:g}": Stiff(partial(_colour, v)) for v in (1e-3, 1.0)},
    **{f"a colour, {n} voxels": Stiff(partial(_colour, 0.5, n)) for n in ((1, 1, 1), (7, 8, 1))},
    "layers that meet in half a voxel": Stiff(_barely),
    "labels finer than their scan, turned": Stiff(_finer),
}
