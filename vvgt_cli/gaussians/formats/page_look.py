"""The look of a page, which can be changed where it holds the volume's values (docs/page.md)."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import repeat
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.formats.page_file import VIEWER, html_of_several, title_of, upright
from vvgt_cli.gaussians.formats.page_presets import function_nodes, told
from vvgt_cli.gaussians.formats.page_values import Values
from vvgt_cli.gaussians.formats.splats import Splats, splats_of
from vvgt_cli.gaussians.frames import up_matrix
from vvgt_cli.gaussians.live_facts import LiveFacts
from vvgt_cli.gaussians.story import LIGHT, OF_LIGHT, fields
from vvgt_cli.look.lighting import MATTE, Lighting
from vvgt_cli.look.readers.minimal import read
from vvgt_cli.look.readers.names import names
from vvgt_cli.volume.components import listed
from vvgt_cli.volume.types import triple

PLY = PlyOptions()
SAMPLED = 96  # nodes for colours that are not interpolated linearly in RGB
_RAMP = {"points": [{"x": 0, "rgb": [1, 1, 1], "opacity": 0}, {"x": 1, "rgb": [1, 1, 1], "opacity": 0.1}]}


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
    parts += [f"a story of {len(options.story.steps)} steps"] if options.story else []
    return f"{name} holds {', '.join(parts)}; its title is {options.title or title_of(name)!r} (--title)"


def html(splats: Splats, name: str, values: Values | None = None, options: PlyOptions = PLY) -> bytes:
    """Return the page of one cloud as a single file, with the values of its volume, laid out by ``options``.

    Raise DataError if a library is not installed.
    """
    return html_of_several([(title_of(name, splats.comments), splats)], name, *page_contents(values, options))


def page_contents(values: Values | None, options: PlyOptions) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Return the contents of elements by their ids, and entries of the scene, for a volume's values and a story."""
    story: dict[str, Any] = {"story": options.story.steps} if options.story else {}
    if values is None:
        return {}, story
    look = {} if values.look is None else {"look": look_entry(values, options)}
    return values.elements, {"values": values.facts} | look | story


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
    elements, scene = page_contents(None, clouds[0][2])
    if held and len(held) == len(clouds):
        framed = list[list[dict[str, Any]]]()
        for k, one in enumerate(held):
            framed.append([{**facts, "element": f"{facts['element']}-{k}"} for facts in one.facts])
            elements |= {facts["element"]: content for facts, content in zip(framed[-1], one.contents, strict=True)}
        scene |= {"framed": framed, "look": look_entry(held[0], clouds[0][2])}
    return html_of_several(baked, name, elements, scene)


def look_entry(values: Values, options: PlyOptions) -> dict[str, Any]:
    """Return the look that a page begins with: its layers, light, and the volume's axes and box in the viewer."""
    assert values.look is not None
    scale, axes = options.scale or 1.0, _axes(upright(options).up)
    if options.light is not None and options.light.headlight + len(options.light.directions) > 1:
        warnings.warn("the page shows one light at a time under other looks, and begins with the first", stacklevel=2)
    if options.light is not None and options.light.sky:
        warnings.warn("the page lights other looks by a headlight: its own rays know no sky", stacklevel=2)
    steps = options.story.steps if options.story else ()
    first, shown = values.facts[0], {str(step.get("function")) for step in steps}
    edges = np.reshape(first["affine"], (3, 4))[:, :3] * first["dims"]  # (3, 3), a column for each index axis
    half, lengths = np.abs(edges).sum(axis=1) * scale / 2, np.linalg.norm(edges, axis=0)
    half[np.abs(edges / lengths).argmax(axis=0)] = lengths * scale / 2  # along the nearest axis of the world
    return {
        "layers": [
            _layer_entry(layer, scale, offered, shown)
            for layer, offered in zip(values.look.layers, values.offered or repeat({}), strict=False)
        ],
        "light": _light(options.light, axes), "axes": axes.tolist(), "box": [(-half).tolist(), half.tolist()],
    }  # fmt: skip


def _layer_entry(layer: LiveFacts, scale: float, offered: Mapping[str, Any], shown: Collection[str]) -> dict[str, Any]:
    """Return a layer of `look_entry`; of what `page_presets.offers` returned; ``shown``: by a story."""
    distance = layer.distance or 1.0
    entry: dict[str, Any] = {
        "title": layer.name, "labels": [label.page_entry() for label in layer.labels],
        "values": [layer.lo, layer.hi], "unit": layer.unit, "quantity": layer.quantity,
        "histogram": list(layer.histogram), "name": layer.baked().get("name", ""),
        "unit_distance": distance * scale, "opacity_unit_distance": distance, "nodes": [],
    }  # fmt: skip
    if layer.labels:
        return entry
    presets = list(offered.get("presets", ()))
    known = {one["name"] for one in presets}
    presets += [told(name, layer, distance, 2 / scale) for name in names() if name in shown and name not in known]
    return {**entry, "nodes": nodes_of(layer), **offered, "presets": presets}


def _light(lighting: Lighting | None, axes: np.ndarray) -> dict[str, Any]:
    """Return the initial light of the page: the file's headlight, else its first light, or none, of `MATTE` matter."""
    lighting = MATTE if lighting is not None and lighting.sky else lighting
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
    parts, what = OF_LIGHT | {"power": LIGHT}, "the page's light"
    fields(**parts)(sent, what)
    if missing := [key for key in parts if key not in sent]:
        raise DataError(f"{what}: no {missing[0]}; expected {', '.join(parts)}")
    if sent["kind"] == "none":
        return None
    direction = _axes(upright(options).up) @ np.array(sent["from"], np.float64)
    directions = () if sent["kind"] == "headlight" else (triple((direction / np.linalg.norm(direction)).tolist()),)
    ambient, diffuse, specular, power = (float(sent[name]) for name in ("ambient", "diffuse", "specular", "power"))
    return Lighting(sent["kind"] == "headlight", directions, ambient, diffuse, specular, power)


def _axes(up: str) -> np.ndarray:
    """Return the axes of the unit frame in the viewer's frame, as rows."""
    return (np.diag(VIEWER) @ up_matrix(up)).T


def nodes_of(facts: LiveFacts) -> list[dict[str, Any]]:
    """Return nodes with opacity and colour, between which both are linear; there are two at a step."""
    return function_nodes(
        read(facts.baked() or _RAMP | {"range": [facts.lo, facts.hi]}, "the file's function"), SAMPLED
    )
