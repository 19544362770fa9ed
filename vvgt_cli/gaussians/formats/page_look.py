"""The look of a page, which can be changed where it holds the volume's values (docs/live.md)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.formats.page_file import html_of_several, title_of, upright
from vvgt_cli.gaussians.formats.page_values import Values
from vvgt_cli.gaussians.formats.splats import Splats, splats_of
from vvgt_cli.gaussians.frames import up_matrix
from vvgt_cli.gaussians.live import OPAQUE
from vvgt_cli.gaussians.live_facts import LiveFacts
from vvgt_cli.look.function import PiecewiseOpacity, TransferFunction
from vvgt_cli.look.lighting import MATTE, MAX_LIGHT, Lighting
from vvgt_cli.look.readers.minimal import read
from vvgt_cli.look.readers.names import named_function, names
from vvgt_cli.look.resolve import look_like_hounsfield, resolve
from vvgt_cli.look.tables import extinction
from vvgt_cli.volume.components import listed
from vvgt_cli.volume.types import triple

PLY = PlyOptions()
SAMPLED, FEW = 96, 12  # nodes for colours that are not interpolated linearly in RGB: of the file's function, of presets
ALIKE = 0.01  # difference of opacity and colour up to which functions are the same
_RAMP = {"points": [{"x": 0, "rgb": [1, 1, 1], "opacity": 0}, {"x": 1, "rgb": [1, 1, 1], "opacity": 0.1}]}
_HALF_TURN = np.diag([-1.0, -1.0, 1.0])  # the viewer shows PLY (x, y, z) at (-x, -y, z)


def contents(options: PlyOptions, name: str, names: Sequence[str] = (), values: Values | None = None) -> str:
    """Return one line that says what a page holds, for whoever sends it.

    Args:
        options: of its Gaussians.
        name: of the page.
        names: in its list, of several clouds.
        values: of its volume.
    """
    parts = ["Gaussians", *([str(values)] if values else [])]
    labels = values.labels if values else 0
    parts += [f"names of {labels} label{'s' * (labels > 1)}"] if labels else []
    stated = [one["title"] for one in values.facts if one["title"]] if values else list(names)
    parts += [f"the names {listed(stated, ', ', 3)}"] if stated else []
    parts += ["a checksum of the volume"] if options.certificate else []
    return f"{name} holds {', '.join(parts)}; its title is {options.title or title_of(name)!r} (--title)"


def html(splats: Splats, name: str, values: Values | None = None, options: PlyOptions = PLY) -> bytes:
    """Return the page of one cloud as a single file, with the values of its volume, laid out by ``options``.

    Raise DataError if a library is not installed.
    """
    return html_of_several([(title_of(name, splats.comments), splats)], name, *page_contents(values, options))


def page_contents(values: Values | None, options: PlyOptions) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Return the contents of elements by their ids, and entries of the scene, for the values of a volume."""
    if values is None:
        return {}, {}
    look = {} if values.look is None else {"look": look_entry(values, options)}
    return values.elements, values.scene | look


def page_of_several(
    clouds: Sequence[tuple[str, Gaussians, PlyOptions]], name: str, values: Sequence[Values | None] = ()
) -> bytes:
    """Return the page of several named clouds; raise DataError, UsageError as `html` does.

    ``values``: of the volume of each, all with the look of the first; looks are fixed where one has none.
    """
    baked = [
        (cloud, splats_of(replace(gaussians, live=None), replace(upright(options), live=None)))
        for cloud, gaussians, options in clouds
    ]
    held = [one for one in values if one is not None and one.look is not None]
    if not held or len(held) < len(clouds):
        return html_of_several(baked, name)
    elements, framed = dict[str, bytes](), list[list[dict[str, Any]]]()
    for k, one in enumerate(held):
        framed.append([{**facts, "element": f"{facts['element']}-{k}"} for facts in one.facts])
        elements |= {facts["element"]: content for facts, content in zip(framed[-1], one.contents, strict=True)}
    return html_of_several(baked, name, elements, {"framed": framed, "look": look_entry(held[0], clouds[0][2])})


def look_entry(values: Values, options: PlyOptions) -> dict[str, Any]:
    """Return the look that a page begins with: its layers, light, and the volume's axes and box in the viewer."""
    assert values.look is not None
    scale, axes = options.scale or 1.0, _axes(upright(options).up)
    if options.light is not None and options.light.headlight + len(options.light.directions) > 1:
        warnings.warn("the page shows one light at a time under other looks, and begins with the first", stacklevel=2)
    first = values.facts[0]
    half = np.linalg.norm(np.reshape(first["affine"], (3, 4))[:, :3], axis=0) * first["dims"] * scale / 2
    return {
        "layers": [_layer_entry(layer, scale) for layer in values.look.layers],
        "light": _light(options.light, axes), "axes": axes.tolist(), "box": [(-half).tolist(), half.tolist()],
    }  # fmt: skip


def _layer_entry(layer: LiveFacts, scale: float) -> dict[str, Any]:
    """Return a layer of `look_entry`."""
    distance = layer.distance or 1.0
    entry: dict[str, Any] = {
        "title": layer.name, "labels": [label.page_entry() for label in layer.labels],
        "values": [layer.lo, layer.hi], "unit": layer.unit, "quantity": layer.quantity,
        "histogram": list(layer.histogram), "name": layer.baked().get("name", ""),
        "unit_distance": distance * scale, "opacity_unit_distance": distance, "nodes": [],
    }  # fmt: skip
    return entry if layer.labels else entry | {"nodes": nodes_of(layer), "presets": presets_of(layer, entry)}


def _light(lighting: Lighting | None, axes: np.ndarray) -> dict[str, Any]:
    """Return the initial light of the page: the file's headlight, else its first light, or none, of `MATTE` matter."""
    one = lighting or MATTE
    kind = "none" if lighting is None else "headlight" if one.headlight else "direction"
    toward = np.array(one.directions[0] if one.directions else (-0.5, -0.7, 0.5)) @ axes
    return {
        "kind": kind, "from": (toward / np.linalg.norm(toward)).tolist(), "ambient": one.ambient,
        "diffuse": one.diffuse, "specular": one.specular, "power": one.specular_power,
    }  # fmt: skip


def parse_light(sent: Any, options: PlyOptions) -> Lighting | None:
    """Parse the JSON of a light that a page of these options sends (as `_light` writes).

    Raise DataError or UsageError if it is not valid.
    """
    numbers = ("ambient", "diffuse", "specular", "power")
    if not isinstance(sent, dict) or sent.get("kind") not in ("none", "headlight", "direction"):
        raise DataError("the page's light: expected an object of kind none, headlight or direction")
    toward = sent.get("from")
    if not isinstance(toward, list) or len(toward) != 3:
        raise DataError("the page's light: expected from, three numbers")
    if not all(
        isinstance(x, int | float) and abs(x) <= MAX_LIGHT for x in (*toward, *map(sent.get, numbers))
    ) or not any(toward):
        raise DataError(f"the page's light: expected finite numbers for from, {', '.join(numbers)}")
    if sent["kind"] == "none":
        return None
    found = _axes(upright(options).up) @ np.array(toward, np.float64)
    directions = () if sent["kind"] == "headlight" else (triple((found / np.linalg.norm(found)).tolist()),)
    ambient, diffuse, specular, power = (float(sent[name]) for name in numbers)
    return Lighting(sent["kind"] == "headlight", directions, ambient, diffuse, specular, power)


def _axes(up: str) -> np.ndarray:
    """Return the axes of the unit frame in the viewer's frame, as rows."""
    found: np.ndarray = (_HALF_TURN @ up_matrix(up)).T
    return found


def nodes_of(facts: LiveFacts) -> list[dict[str, Any]]:
    """Return nodes with opacity and colour, between which both are linear; there are two at a step."""
    return _nodes(read(facts.baked() or _RAMP | {"range": [facts.lo, facts.hi]}, "the file's function"), SAMPLED)


def presets_of(facts: LiveFacts, entry: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the named functions for values that are or look like Hounsfield units, or of the kind of the file's name.

    The file's own function is not among them, unless it was changed and has kept the name.

    Args:
        facts: of the layer.
        entry: its part of the scene, whose ``unit_distance`` opacities become per.
    """
    named, found, known = names(), [], facts.statistics()
    hounsfield = facts.unit == "HU" or (not facts.unit and look_like_hounsfield(known))
    kind = "ct" if hounsfield else entry["name"].split("-")[0] if entry["name"] in named else ""
    for name in [name for name in named if name.split("-")[0] == kind]:
        tf = named_function(name)
        if tf.otherwise is not None and not hounsfield:  # a guess
            continue
        tf = resolve(tf, known, hounsfield=True)
        assert tf.opacity_unit_share is not None
        times = entry["unit_distance"] / (2 * tf.opacity_unit_share)  # the longest edge is 2
        tf = replace(tf, opacity_nodes=_per_longer(tf.opacity_nodes, times))
        light = tf.lighting and {key: getattr(tf.lighting, key) for key in ("ambient", "diffuse", "specular")}
        if tf.support(facts.lo, facts.hi) and not _is_own(tf, facts):
            found.append({"name": name, "shows": named[name], "nodes": _nodes(tf, FEW), "light": light})
    return found


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
        found, wanted = extinction((longer[1:] + longer[:-1]) / 2, 1.0), extinction(between, 1.0)
        far = np.flatnonzero((np.abs(found - wanted) > 0.004 * wanted) & (x[1:] > x[:-1]))  # twice that beside 0
        if not far.size:
            return PiecewiseOpacity(x, longer)
        x, y = np.insert(x, far + 1, (x[far] + x[far + 1]) / 2), np.insert(y, far + 1, y_between[far])


def _nodes(tf: TransferFunction, sampled: int) -> list[dict[str, Any]]:
    """Return nodes, with so many more for colours that are not interpolated linearly in RGB."""
    places = [tf.opacity_nodes.x, tf.color_map.x]
    if tf.color_map.space != "RGB":
        places.append(np.linspace(tf.color_map.x[0], tf.color_map.x[-1], sampled))
    nodes = []
    at = np.unique(np.concatenate(places))
    for x, limits in zip(at.tolist(), tf.limits(at).tolist(), strict=True):
        below, above = ({"x": x, "y": float(f"{y:.8g}"), "rgb": [round(c, 4) for c in rgb]} for y, *rgb in limits)
        nodes += [below] if below == above else [below, above]
    return nodes
