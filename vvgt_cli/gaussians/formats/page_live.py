"""The page of Gaussians that carry values: under a function that is changed in the page, and cut (docs/live.md)."""

from __future__ import annotations

import gzip
from dataclasses import replace
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.formats.live import live_bytes, live_json
from vvgt_cli.gaussians.formats.page_file import html_of_several, title_of, upright
from vvgt_cli.gaussians.formats.splats import Splats, morton_order, splats_of
from vvgt_cli.gaussians.frames import turn, up_matrix
from vvgt_cli.gaussians.live import law_nodes
from vvgt_cli.gaussians.live_facts import LiveFacts
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.lighting import MOST, Lighting
from vvgt_cli.look.readers.minimal import read
from vvgt_cli.volume.types import triple

HELD = "values"  # the element that holds the bytes
PLANES = (0, 1, 2, 4, 5, 6)  # columns of `live_bytes` that are not 0; of labels all
SAMPLED = 96  # nodes of colours on other lines than straight ones in RGB
_RAMP = {"points": [{"x": 0, "rgb": [1, 1, 1], "opacity": 0}, {"x": 1, "rgb": [1, 1, 1], "opacity": 0.1}]}
_HALF_TURN = np.diag([-1.0, -1.0, 1.0])  # the viewer has PLY (x, y, z) at (-x, -y, z)


def live_html(gaussians: Gaussians, options: PlyOptions, name: str) -> bytes:
    """The page as one file; ``gaussians`` in the unit frame.

    Raises:
        DataError, UsageError: as `splats_of`, or a library that is missing.
    """
    splats, planes, facts = live_parts(gaussians, options)
    return html_of_several([(title_of(name), splats)], name, {HELD: planes}, {"live": facts})


def live_parts(gaussians: Gaussians, options: PlyOptions) -> tuple[Splats, bytes, dict[str, Any]]:
    """What a page of Gaussians (unit frame) that carry values is made of.

    Returns:
        the columns, in an order that `.compressed.ply` keeps; the bytes of their values, in that order, packed by
        gzip; the facts about them that are the scene's ``live``.

    Raises:
        DataError, UsageError: as `live_html`.
    """
    assert gaussians.live is not None
    assert options.live is not None
    facts, laid = options.live, upright(options)
    gaussians = gaussians.take(morton_order(turn(gaussians, laid.up).means))  # as the page's file has them
    turned = turn(gaussians, laid.up)
    splats = splats_of(replace(gaussians, live=None, harmonics=None), replace(laid, live=None, sh_degree=0))
    planes = np.ascontiguousarray(live_bytes(turned, facts)[:, planes_of(facts)].T)
    return splats, gzip.compress(planes.tobytes(), 9, mtime=0), _facts(gaussians, options, laid.up)


def planes_of(facts: LiveFacts) -> tuple[int, ...]:
    """Columns of `live_bytes` that a page holds, one after the other."""
    return (*PLANES, 3, 7) if facts.labels else PLANES


def _facts(gaussians: Gaussians, options: PlyOptions, up: str) -> dict[str, Any]:
    """What the page's program needs beside the bytes."""
    assert options.live is not None
    facts = options.live
    said = live_json(gaussians, facts, (options.unit_distance or 1.0) * (options.scale or 1.0))
    said.pop("function")
    axes = _axes(up)
    return said | {
        "held": HELD,
        "opacity_unit_distance": options.unit_distance or 1.0,
        "light": _light(options.light, axes),
        "law": law_nodes().tolist(),
        "name": facts.baked().get("name", ""),
        "nodes": [] if facts.labels else nodes_of(facts),
        "axes": axes.tolist(),
        "box": [gaussians.means.min(axis=0).tolist(), gaussians.means.max(axis=0).tolist()],
    }


def _light(lighting: Lighting | None, axes: np.ndarray) -> dict[str, Any]:
    """What the page begins with: the file's light (of several the one at the eye, else the first), or none."""
    one = lighting or Lighting()
    kind = "none" if lighting is None else "headlight" if one.headlight else "direction"
    toward = np.array(one.directions[0] if one.directions else (-0.5, -0.7, 0.5)) @ axes
    return {
        "kind": kind, "from": (toward / np.linalg.norm(toward)).tolist(), "ambient": one.ambient,
        "diffuse": one.diffuse, "specular": one.specular, "power": one.specular_power,
    }  # fmt: skip


def light_sent(sent: Any, options: PlyOptions) -> Lighting | None:
    """The light that a page of a file laid out so sends: what `_light` says, changed.

    Raises:
        DataError, UsageError: it is none.
    """
    numbers = ("ambient", "diffuse", "specular", "power")
    if not isinstance(sent, dict) or sent.get("kind") not in ("none", "headlight", "direction"):
        raise DataError("the page's light: expected an object of kind none, headlight or direction")
    toward = sent.get("from")
    if not isinstance(toward, list) or len(toward) != 3:
        raise DataError("the page's light: expected from, three numbers")
    if not all(isinstance(x, int | float) and abs(x) <= MOST for x in (*toward, *map(sent.get, numbers))) or not any(
        toward
    ):
        raise DataError(f"the page's light: expected finite numbers for from, {', '.join(numbers)}")
    if sent["kind"] == "none":
        return None
    found = _axes(upright(options).up) @ np.array(toward, np.float64)
    directions = () if sent["kind"] == "headlight" else (triple((found / np.linalg.norm(found)).tolist()),)
    ambient, diffuse, specular, power = (float(sent[name]) for name in numbers)
    return Lighting(sent["kind"] == "headlight", directions, ambient, diffuse, specular, power)


def _axes(up: str) -> np.ndarray:
    """Rows: the axes of the unit frame in the viewer's."""
    found: np.ndarray = (_HALF_TURN @ up_matrix(up)).T
    return found


def nodes_of(facts: LiveFacts) -> list[dict[str, Any]]:
    """Nodes of both opacity and colour, straight lines between them; two where the function steps."""
    tf = read(facts.baked() or _RAMP | {"range": [facts.lo, facts.hi]}, "the file's function")
    places = [tf.opacity_nodes.x, tf.color_map.x]
    if tf.color_map.space != "RGB":
        places.append(np.linspace(tf.color_map.x[0], tf.color_map.x[-1], SAMPLED))
    nodes = []
    for x in np.unique(np.concatenate(places)).tolist():
        below, above = (_limit(tf, x, side) for side in (-np.inf, np.inf))
        nodes += [below] if below == above else [below, above]
    return nodes


def _limit(tf: TransferFunction, x: float, side: float) -> dict[str, Any]:
    """The function beside x, the nearest number but nodes' own on that side."""
    beside = np.array([np.nextafter(x, side)])
    y, rgb = float(tf.opacity(beside)[0]), tf.color(beside)[0]
    return {"x": x, "y": round(y, 6), "rgb": [round(c, 4) for c in rgb.tolist()]}
