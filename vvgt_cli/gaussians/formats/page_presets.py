"""Functions that a page offers for a volume of values, by what the data are, with small pictures of the volume.

A picture is cast in parallel rays, in steps of a cell of a coarser grid, from before and the left of a body, or else as
the page begins: a glance at what a function shows, of about two kilobytes.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from vvgt_cli.gaussians.live import OPAQUE
from vvgt_cli.gaussians.live_facts import LiveFacts
from vvgt_cli.look import MATTE, ColorMap, Lighting, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.readers.names import named_function, names, titles
from vvgt_cli.look.resolve import look_like_hounsfield, resolve
from vvgt_cli.look.suggest import fitting
from vvgt_cli.look.tables import extinction
from vvgt_cli.volume.types import Volume

FEW = 12  # nodes of presets for colours that are not interpolated linearly in RGB
ALIKE = 0.01  # difference of opacity and colour up to which functions are the same
EDGE, QUALITY = 84, 80  # px of a small picture; of its WebP
CELLS, ENTRIES = 1 << 19, 1 << 12  # of the grid that it is drawn from; of a function's table
THINNEST = 0.02  # of the longest edge: a sheet that is drawn
STEP, STEPS = 0.6, 256  # of a cell's edge, between samples; and at most so many on a ray
_HEADLIGHT = {key: getattr(MATTE, key) for key in ("ambient", "diffuse", "specular")}


def kind_of(facts: LiveFacts, volume: Volume) -> str:
    """Return what a volume's values are, as the names of functions begin: "ct", "mr", "density", ...; "" unknown."""
    known = facts.statistics()
    if facts.unit == "HU" or (not facts.unit and volume.modality in ("", "CT") and look_like_hounsfield(known)):
        return "ct"
    return "" if facts.unit else (fitting(known, volume) or "").split("-")[0]


def presets_of(facts: LiveFacts, distance: float, edge: float, kind: str, name: str = "") -> list[dict[str, Any]]:
    """Return functions for values of a kind, or of that of the file's function; three of the values' shares for others.

    The file's own function is not among them, unless it was changed and has kept the name.

    Args:
        facts: of the layer.
        distance: world length that opacities shall be per.
        edge: world length of the box's longest edge.
        kind: of `kind_of`.
        name: of the file's function.

    Of kinds other than CT, one by shares comes first.

    Returns:
        of each ``name``, ``title``, ``shows``, ``nodes`` and ``light``: its coefficients, None for none.
    """
    named, presets, known = names(), [], facts.statistics()
    hounsfield = kind == "ct"
    kind = kind or (name.split("-")[0] if name in named else "")
    for name in [name for name in named if kind and name.split("-")[0] == kind]:
        tf = named_function(name)
        if tf.otherwise is not None and not hounsfield:  # a guess
            continue
        tf = _per(resolve(tf, known, hounsfield=True), distance, edge)
        if tf.support(facts.lo, facts.hi) and not _is_own(tf, facts):
            presets.append(_entry(name, tf))
    return _by_shares(facts)[: 0 if hounsfield else 1 if presets else None] + presets


def told(name: str, facts: LiveFacts, distance: float, edge: float) -> dict[str, Any]:
    """Return a named function as `presets_of` does, without a picture, whatever the values are."""
    hounsfield = facts.unit == "HU" or (not facts.unit and look_like_hounsfield(facts.statistics()))
    tf = resolve(named_function(name), facts.statistics(), hounsfield=hounsfield)
    return _entry(name, _per(tf, distance, edge))


def _per(tf: TransferFunction, distance: float, edge: float) -> TransferFunction:
    """Return one of our functions with opacity per a distance, in a box of a longest edge."""
    assert tf.opacity_unit_share is not None
    return replace(tf, opacity_nodes=_per_longer(tf.opacity_nodes, distance / (edge * tf.opacity_unit_share)))


def _entry(name: str, tf: TransferFunction) -> dict[str, Any]:
    """Return a function of ours as the page has it."""
    light = tf.lighting and {key: getattr(tf.lighting, key) for key in _HEADLIGHT}
    about = {"name": name, "title": titles()[name], "shows": names()[name]}
    return about | {"nodes": function_nodes(tf, FEW), "light": light}


def _by_shares(facts: LiveFacts) -> list[dict[str, Any]]:
    """Return two surfaces and a layer at shares of the values other than the commonest, the background."""
    counts = np.array(facts.histogram, np.float64)
    if not facts.function or facts.lo == facts.hi or len(np.flatnonzero(counts)) < 2:
        return []
    counts[counts.argmax()] = 0
    (lo, hi), below = (facts.lo, facts.hi), np.cumsum(counts) / counts.sum()
    few, third, middle, most = (
        lo + (hi - lo) * (np.searchsorted(below, q) + 0.5) / len(counts) for q in (0.1, 0.3, 0.5, 0.7)
    )
    wide, own = max((most - third) / 2, (hi - lo) / 40), facts.tf("the file")

    def made(title: str, shows: str, light: dict[str, float] | None, *places: tuple[float, float]) -> dict[str, Any]:
        x, y = np.array(places).T
        return {
            "name": title, "title": title, "shows": shows, "light": light,
            "nodes": [
                {"x": at, "y": opacity, "rgb": rgb} for at, opacity, rgb in
                zip(x.tolist(), y.tolist(), own.color(x).round(4).tolist(), strict=True)
            ],
        }  # fmt: skip

    ends = (lo, 0.0), (hi, 0.0)
    return [
        made(
            "soft surface", "the more opaque the higher the value, lit", _HEADLIGHT,
            (lo, 0), (few, 0), (hi, 0.5),
        ),
        made(
            "hard surface", f"from {middle:.4g}, solid and lit", _HEADLIGHT,
            (lo, 0), (middle, 0), (min(middle + (hi - lo) / 100, hi), 0.8), (hi, 0.8),
        ),
        made(
            "one layer", f"about {middle:.4g}", None,
            ends[0], (max(middle - wide, lo), 0), (middle, 0.5), (min(middle + wide, hi), 0), ends[1],
        ),
    ]  # fmt: skip


def _is_own(tf: TransferFunction, facts: LiveFacts) -> bool:
    """Return whether a function of the same unit distance shows what the file's own does, to `ALIKE`."""
    if not facts.function:
        return False
    x, own = np.linspace(facts.lo, facts.hi, 257), facts.tf("the file")
    there, other = tf.opacity(x)[:, None], own.opacity(x)[:, None]
    off = np.hstack([there - other, there * tf.color(x) - other * own.color(x)])
    return bool(np.abs(off).max() < ALIKE)


def _per_longer(nodes: PiecewiseOpacity, times: float) -> PiecewiseOpacity:
    """Return opacity per a unit distance so many times as long, with nodes until its extinction is right to 1 %."""
    x, y = nodes.x, np.minimum(nodes.y, OPAQUE)
    while True:
        y_between = (y[1:] + y[:-1]) / 2
        longer, between = (-np.expm1(times * np.log1p(-part)) for part in (y, y_between))
        interpolated, wanted = extinction((longer[1:] + longer[:-1]) / 2, 1.0), extinction(between, 1.0)
        far = np.flatnonzero((np.abs(interpolated - wanted) > 0.004 * wanted) & (x[1:] > x[:-1]))  # twice that beside 0
        if not far.size:
            return PiecewiseOpacity(x, longer)
        x, y = np.insert(x, far + 1, (x[far] + x[far + 1]) / 2), np.insert(y, far + 1, y_between[far])


def function_nodes(tf: TransferFunction, sampled: int) -> list[dict[str, Any]]:
    """Return nodes, between which opacity and colour are linear; two at a step.

    There are ``sampled`` more for colours that are not interpolated linearly in RGB.
    """
    places = [tf.opacity_nodes.x, tf.color_map.x]
    if tf.color_map.space != "RGB":
        places.append(np.linspace(tf.color_map.x[0], tf.color_map.x[-1], sampled))
    nodes = []
    at = np.unique(np.concatenate(places))
    for x, limits in zip(at.tolist(), tf.limits(at).tolist(), strict=True):
        below, above = ({"x": x, "y": float(f"{y:.8g}"), "rgb": [round(c, 4) for c in rgb]} for y, *rgb in limits)
        nodes += [below] if below == above else [below, above]
    return nodes


def function_of(nodes: list[dict[str, Any]]) -> TransferFunction:
    """Return the function of nodes."""
    x = np.array([node["x"] for node in nodes])
    opacity, colors = np.array([node["y"] for node in nodes]), np.array([node["rgb"] for node in nodes])
    return TransferFunction("", PiecewiseOpacity(x, opacity), ColorMap(x, colors))


def offers(facts: LiveFacts, volume: Volume, values: np.ndarray, lighting: Lighting | None) -> dict[str, Any]:
    """Return a ``picture`` of a volume as its file shows it, and its ``presets``, each with one.

    Args:
        facts: of the layer.
        volume: the scalars.
        values: their means (nz, ny, nx) on a grid of the same box.
        lighting: of the file.
    """
    if not facts.function:
        return {"presets": []}
    edge, distance = max(volume.extent), facts.distance or 1.0
    own = None if lighting is None else {key: getattr(lighting, key) for key in _HEADLIGHT}
    sketch = Sketch(values, volume.affine[:3], volume.extent, volume.space)
    presets = presets_of(facts, distance, edge, kind_of(facts, volume), facts.baked().get("name", ""))
    for one in presets:
        one["picture"] = sketch.picture(function_of(one["nodes"]), distance, edge, one["light"])
    return {"picture": sketch.picture(facts.tf("the file"), distance, edge, own), "presets": presets}


class Sketch:
    """A volume as it is seen from one side, on a coarser grid: what small pictures under functions have in common."""

    def __init__(
        self, values: np.ndarray, affine: np.ndarray, extent: tuple[float, float, float], space: str | None
    ) -> None:
        """Cast rays.

        Args:
            values: (nz, ny, nx), NaN unknown.
            affine: (3, 4), index (x, y, z, 1) of some grid of the same box to world.
            extent: edges of the box, world lengths.
            space: of the world, such as "RAS"; None: unknown.
        """
        spacing, size = np.linalg.norm(affine[:, :3], axis=0), np.array(extent)
        cell = (size.prod() / CELLS) ** (1 / 3)
        dims = np.clip(np.ceil(size / cell).astype(int), 1, values.shape[::-1])
        for axis, n in enumerate(dims[::-1].tolist()):  # means of runs of voxels
            first = np.arange(n) * values.shape[axis] // n
            many = np.diff(first, append=values.shape[axis]).reshape([-1 if k == axis else 1 for k in range(3)])
            values = np.add.reduceat(values, first, axis) / many
        known = np.isfinite(values)
        values = np.where(known, values, values[known].min() if known.any() else 0)
        turned = (affine[:, :3] / spacing).T  # the world's directions in the volume's axes
        size = np.maximum(size / size.max(), THINNEST)
        eye, up = turned @ _eye(space), turned @ np.array([0, 0, -1 if space and space[2] == "I" else 1])
        right = np.cross(up, eye) / np.linalg.norm(np.cross(up, eye))
        up, step = np.cross(eye, right), size / dims
        half = max(np.abs(right) @ size, np.abs(up) @ size) / 2
        across = half * (2 * (np.arange(EDGE) + 0.5) / EDGE - 1)
        through = float(np.linalg.norm(size))
        self.length = max(STEP * float(step.min()), through / STEPS)
        deep = np.arange(through / 2, -through / 2, -self.length)
        # (EDGE, EDGE, n, 3), from the upper left and from before, in cells
        pixels = (across[None, :, None, None] * right - across[:, None, None, None] * up + size / 2) / step - 0.5
        at = pixels.astype(np.float32) + (deep[:, None] * eye / step).astype(np.float32)
        inside = ((at > -0.5) & (at < dims - 0.5)).all(axis=-1)
        self.ray = np.flatnonzero(inside) // len(deep)
        self.first = np.searchsorted(self.ray, self.ray)  # sample of the same ray
        slopes = [
            np.gradient(values, width, axis=k) if values.shape[k] > 1 else 0 * values
            for k, width in enumerate(step[::-1])
        ]
        grid = np.stack([values, *slopes[::-1], ~known], axis=-1).astype(np.float32)
        samples = _between(grid, at[inside].clip(0, dims - 1))
        self.values, self.unknown = samples[:, 0], samples[:, 4] > 0
        steep = np.linalg.norm(samples[:, 1:4], axis=1)
        self.facing = np.where(steep > 0, np.abs(samples[:, 1:4] @ eye) / np.maximum(steep, 1e-30), 1)

    def picture(self, tf: TransferFunction, distance: float, edge: float, light: Mapping[str, float] | None) -> str:
        """Return an address that is a picture itself, over black.

        Args:
            tf: function on data values.
            distance: world length that its opacity is per.
            edge: world length of the longest edge of the box.
            light: coefficients of a headlight; None: none.
        """
        from PIL import Image

        lo, hi = float(self.values.min()), float(self.values.max())
        x = np.linspace(lo, hi, ENTRIES)
        entry = np.rint((self.values - lo) / ((hi - lo) or 1) * (ENTRIES - 1)).astype(np.int32)
        depth = (extinction(tf.opacity(x), distance) * self.length * edge)[entry]
        depth[self.unknown] = 0
        before = np.concatenate([[0], np.cumsum(depth)])
        weight = np.exp(before[self.first] - before[:-1]) * -np.expm1(-depth)
        if light is not None:
            weight *= light["ambient"] + light["diffuse"] * self.facing
        colors = tf.color(x)[entry]
        pixels = np.stack([np.bincount(self.ray, weight * colors[:, c], EDGE * EDGE) for c in range(3)], axis=-1)
        shown = (255 * pixels.clip(0, 1)).round().astype(np.uint8).reshape(EDGE, EDGE, 3)
        content = io.BytesIO()
        Image.fromarray(shown).save(content, "WEBP", quality=QUALITY)
        return "data:image/webp;base64," + base64.b64encode(content.getvalue()).decode("ascii")


def _between(grid: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return what a grid (nz, ny, nx, m) has at places (n, 3) in cells, x first, interpolated linearly: (n, m)."""
    low = np.floor(at).astype(np.int32)
    top, strides = np.array(grid.shape[2::-1]) - 1, np.array([1, grid.shape[2], grid.shape[2] * grid.shape[1]])
    ends = [np.minimum(low + end, top) * strides for end in (0, 1)]
    share, flat = (at - low).astype(np.float32), grid.reshape(-1, grid.shape[3])
    values = np.zeros((len(at), grid.shape[3]), np.float32)
    for corner in product((0, 1), repeat=3):
        i, j, k = (ends[end][:, axis] for axis, end in enumerate(corner))
        u, v, w = (share[:, axis] if end else 1 - share[:, axis] for axis, end in enumerate(corner))
        values += (u * v * w)[:, None] * flat.take(i + j + k, axis=0)
    return values


def _eye(space: str | None) -> np.ndarray:
    """Return the direction to the eye (3,) in the world: before, left and above of a body, or as orbits begin."""
    if space is None:
        eye = np.array([1.0, 0, 0.36])
    else:
        left, front, above = (1 if letter == positive else -1 for letter, positive in zip(space, "LAS", strict=True))
        eye = np.array([0.6 * left, 1.0 * front, 0.3 * above])
    eye /= np.linalg.norm(eye)
    return eye
