"""Optics grids: label maps, colours and layers that are stiff, extreme or odd, from the ray caster to the file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.mapping import SIZE, hard
from vvgt_cli.checks.raycast import bounded, difference
from vvgt_cli.checks.scenes import Hard, camera, function, rough
from vvgt_cli.checks.whole import whole
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.dvr import Scene
from vvgt_cli.dvr.layers import Layer, common_grid, grid_of
from vvgt_cli.errors import DataError
from vvgt_cli.look.labels import Label, LabelTable, check_labels, distinct
from vvgt_cli.volume import Volume

STAGE = "optics grid"
RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
Color = tuple[float, float, float]


def summed(layers: Sequence[Layer]) -> Scene:
    """The scene that layers add up to."""
    target = common_grid(layers)
    return Scene.of_grid(target, layers[0].tf, layers[0].unit_distance, grid_of(layers, target))


def labels(data: np.ndarray, shown: Sequence[tuple[int, Color, float]], distance: float = 1.0) -> Layer:
    """A label map under (number, colour, opacity)."""
    edge = (distance,) * 3
    return Layer(Volume(data, edge), LabelTable("check", tuple(Label(n, str(n), c, a) for n, c, a in shown)), distance)


def _every_voxel() -> Scene:
    """Each voxel a label of its own, opacities from 0 to 1."""
    shape, rng = (6, 7, 8), np.random.default_rng(2)
    n = math.prod(shape)
    shown = [(k, tuple(rng.random(3)), float(rng.random())) for k in range(1, n + 1)]
    return summed([labels(np.arange(1, n + 1, dtype=np.uint16).reshape(shape), shown)])


def _lonely(opacity: float) -> Scene:
    data = np.zeros((9, 9, 9), np.uint8)
    data[4, 4, 4] = 7
    return summed([labels(data, [(7, RED, opacity)])])


def _checkerboard(opacity: float) -> Scene:
    """Labels 1 and 3 in turns; what 2 looks like is nowhere."""
    data = np.where(np.indices((6, 6, 6)).sum(axis=0) % 2, 1, 3).astype(np.int16)
    return summed([labels(data, [(1, RED, opacity), (2, GREEN, 1.0), (3, BLUE, opacity)])])


def _solid_beside_nothing() -> Scene:
    """Opacity 1 beside opacity 0: what is hidden has an entry, and no part in the border's colour."""
    data = np.ones((8, 8, 8), np.int8)
    data[:, :, 4:] = 2
    return summed([labels(data, [(1, RED, 1.0), (2, GREEN, 0.0)])])


def _thousands() -> Scene:
    """All 65,536 labels of 16 bits."""
    data = np.random.default_rng(3).permutation(41 * 40 * 40).reshape(41, 40, 40) % 65_536
    return summed([Layer(Volume(data.astype(np.uint16)), distinct(range(65_536)), 40.0)])


def _far_numbers() -> Scene:
    """Labels near the ends of 32 bits, of a type that no table of bits covers."""
    data = np.where(rough((6, 7, 8)) < 0.5, -(2**31) + 1, 2**31 - 1)
    return summed([labels(data, [(-(2**31) + 1, RED, 0.3), (2**31 - 1, BLUE, 0.6)])])


def _sheets() -> Scene:
    """Sheets of one voxel, each of another label, without a gap."""
    data = np.broadcast_to(np.arange(1, 10, dtype=np.uint8), (9, 9, 9)).copy()
    return summed([labels(data, [(k, (RED, GREEN, BLUE)[k % 3], 0.3) for k in range(1, 10)])])


def _depth(per_voxel: float) -> Scene:
    """Random labels of this optical depth a voxel."""
    data = (rough((6, 7, 8), 4) * 3).astype(np.uint8)
    found = labels(data, [(1, RED, 1.0), (2, BLUE, 1.0)])
    return summed([Layer(found.volume, found.tf, -math.log(1e-5) / per_voxel)])


def _lengths(factor: float) -> Scene:
    data = (rough((5, 6, 4), 3) * 3).astype(np.uint8)
    return summed([labels(data, [(1, RED, 0.3), (2, BLUE, 0.6)], factor)])


def _rgb(value: float, shape: tuple[int, int, int] = (4, 5, 6)) -> Scene:
    """Colours that are one everywhere."""
    bands = tuple(Volume(np.full(shape, value * share, np.float32)) for share in (1.0, 0.5, 0.25))
    layer = Layer(bands[0], function([0, 1], [0, 0.5]), 1.0, "given", (bands[0], bands[1], bands[2]), 1.0)
    return summed([layer])


def _barely() -> Scene:
    """A layer of which half a voxel lies in the first one's box."""
    first, other = Volume(rough((6, 6, 6))), Volume(rough((6, 6, 6), 1), origin=(5.5, 0.0, 0.0))
    ramp = function([0, 1], [0, 0.4])
    return summed([Layer(first, ramp, 1.0), Layer(other, function([0, 1], [0.9, 0.9], [RED, RED]), 1.0)])


def _finer() -> Scene:
    """A scan with labels in voxels of half its edge, turned by a quarter."""
    turned = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    fine = Volume((rough((10, 10, 10), 5) * 3).astype(np.uint8), (0.5,) * 3, (4.25, -0.25, -0.25), turned)
    table = LabelTable("check", (Label(1, "1", RED, 0.3), Label(2, "2", BLUE, 0.9)))
    return summed([Layer(Volume(rough((5, 5, 5))), function([0, 1], [0, 0.3]), 1.0), Layer(fine, table, 1.0)])


def hard_grids() -> list[Hard]:
    """Every scene, in order."""
    return [
        Hard("labels of one voxel each", _every_voxel),
        *(Hard(f"one voxel of a label of opacity {a:g}", partial(_lonely, a)) for a in (1e-5, 1.0)),
        *(Hard(f"two labels in turns, opacity {a:g}", partial(_checkerboard, a)) for a in (0.3, 1.0)),
        Hard("opacity 1 beside opacity 0", _solid_beside_nothing),
        Hard("65,536 labels", _thousands, points=1),
        Hard("labels near the ends of 32 bits", _far_numbers),
        Hard("sheets of one voxel", _sheets),
        *(Hard(f"labels of depth {d:g} a voxel", partial(_depth, d)) for d in (1e-6, 1e-2)),
        *(Hard(f"labels of depth {d:g} a voxel", partial(_depth, d), 1 / 128, 2e-2) for d in (1e2, 1e6)),
        *(Hard(f"labels, lengths of {f:g}", partial(_lengths, f)) for f in (1e-30, 1e30)),
        *(Hard(f"one colour of {v:g}", partial(_rgb, v)) for v in (1e-3, 1.0)),
        Hard("one colour, one voxel", partial(_rgb, 0.5, (1, 1, 1))),
        Hard("one colour, one slice", partial(_rgb, 0.5, (7, 8, 1))),
        Hard("layers that meet in half a voxel", _barely),
        Hard("labels finer than their scan, turned", _finer),
    ]


WHOLE = (
    "labels of one voxel each", "one voxel of a label of opacity 1", "two labels in turns, opacity 1",
    "labels of depth 1e+06 a voxel", "one colour of 1", "layers that meet in half a voxel",
)  # fmt: skip


def _pictured(row: Hard) -> Figure:
    return difference(row.make(), camera(fov=row.fov), row.step, row.error)


def _no_green(make: partial[Scene]) -> Figure:
    """Neither a pixel nor a Gaussian has a colour that no label has."""
    from vvgt_cli.dvr import RenderSettings, render_view

    scene = make()
    seen = render_view(scene, camera(), RenderSettings(samples=1))
    require(seen.any(), "nothing seen: the case compares nothing")
    made = initialise(scene, VbmOptions(300, SIZE)).gaussians
    return Figure("green", float(max(seen[..., 1].max(), np.abs(made.colors[:, 1]).max())), 1e-6)


def _refused(number: int) -> Figure:
    """Tables that are none: no label, one twice, none visible."""
    entries = ((), (Label(1, "a", RED), Label(1, "b", RED)), (Label(1, "a", RED, 0.0),))[number]
    try:
        check_labels([LabelTable("check", entries)])
    except DataError as error:
        require("\n" not in str(error), "an error of several lines")
        return Figure("accepted", 0, 0)
    return Figure("accepted", 1, 0)


def cases() -> Iterator[Case]:
    """All of them."""
    rows = hard_grids()
    for row in rows:
        yield Case(STAGE, f"{row.name}: picture", partial(_pictured, row))
    for row in rows:
        yield Case(STAGE, f"{row.name}: closed form", partial(hard, row))
        if row.name in WHOLE:
            yield Case(STAGE, f"{row.name}: whole way", partial(lambda row: whole(row.make()), row))
    long = {row.name: row for row in rows}["labels of depth 1e+06 a voxel"]
    yield Case(STAGE, f"{long.name}, steps of four voxels", partial(lambda row: bounded(row.make(), camera()), long))
    for make in (partial(_checkerboard, 0.3), partial(_checkerboard, 1.0), partial(_solid_beside_nothing)):
        name = make.func.__name__.strip("_") + "".join(f" of {a:g}" for a in make.args)
        yield Case(STAGE, f"no colour is invented: {name.replace('_', ' ')}", partial(_no_green, make))
    for number, name in enumerate(("no label", "a label twice", "none visible")):
        yield Case(STAGE, f"refused: {name}", partial(_refused, number))
