"""The page of Gaussians that carry values, where the function and cuts can be changed (docs/live.md)."""

from __future__ import annotations

import gzip
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from vvgt_cli.cameras.sets import SIZE, pixel_width
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians, PlyOptions
from vvgt_cli.gaussians.constants import DILATION
from vvgt_cli.gaussians.formats.gsply_files import compressed_ply
from vvgt_cli.gaussians.formats.live import BYTES, ROW, live_bytes, live_json, log_lengths
from vvgt_cli.gaussians.formats.page_file import html_of_several, title_of, upright
from vvgt_cli.gaussians.formats.page_slices import Slices
from vvgt_cli.gaussians.formats.splats import Splats, morton_order, splats_of
from vvgt_cli.gaussians.frames import turn, up_matrix
from vvgt_cli.gaussians.live import OPAQUE, law_nodes
from vvgt_cli.gaussians.live_facts import LABEL_ROW, LAYER_ID, LiveFacts
from vvgt_cli.look.function import PiecewiseOpacity, TransferFunction
from vvgt_cli.look.labels import merge_labels
from vvgt_cli.look.lighting import MATTE, MAX_LIGHT, Lighting
from vvgt_cli.look.readers.minimal import read
from vvgt_cli.look.readers.names import named_function, names
from vvgt_cli.look.resolve import look_like_hounsfield, resolve
from vvgt_cli.look.tables import extinction
from vvgt_cli.volume.components import listed
from vvgt_cli.volume.types import triple

VALUES_ID = "values"  # prefix of the ids of elements with the bytes, followed by the number of the cloud
SAMPLED, FEW = 96, 12  # nodes for colours that are not interpolated linearly in RGB: of the file's function, of presets
ALIKE = 0.01  # difference of opacity and colour up to which functions are the same
_RAMP = {"points": [{"x": 0, "rgb": [1, 1, 1], "opacity": 0}, {"x": 1, "rgb": [1, 1, 1], "opacity": 0.1}]}
_HALF_TURN = np.diag([-1.0, -1.0, 1.0])  # the viewer shows PLY (x, y, z) at (-x, -y, z)


LiveForm = tuple[Gaussians, PlyOptions]  # Gaussians (unit frame) that carry values, and how they are written


class Extras(NamedTuple):
    """Contents of the page of one volume besides its Gaussians.

    Attributes:
        live: live form under the same look, for the function editor.
        slices: grids of values and labels.
    """

    live: LiveForm | None = None
    slices: Slices | None = None


def live_html(
    gaussians: Gaussians, options: PlyOptions, name: str, converted: Splats | None = None,
    slices: Slices | None = None,
) -> bytes:  # fmt: skip
    """Return the page as a single file, for ``gaussians`` in the unit frame.

    ``converted`` is a conversion under the same look, shown in their place until the look is changed.

    Raises:
        DataError, UsageError: see `splats_of`; also if a library is not installed.
    """
    return live_html_of_several([(options.title or title_of(name), gaussians, options)], name, converted, slices)


def live_html_of_several(
    clouds: Sequence[tuple[str, Gaussians, PlyOptions]], name: str, converted: Splats | None = None,
    slices: Slices | None = None,
) -> bytes:  # fmt: skip
    """Return the page of several named clouds that are shown under one function, which `shared_facts` must allow.

    ``converted``, ``slices``: see `live_html`.

    Raises:
        DataError, UsageError: see `live_html`.
    """
    shown, planes, facts = live_page_data([(gaussians, options) for _, gaussians, options in clouds])
    light = clouds[0][2].light
    if light is not None and light.headlight + len(light.directions) > 1:
        warnings.warn(f"{name}: the page shows one light at a time, and begins with the first", stacklevel=2)
    contents = dict(zip(facts["elements"], planes, strict=True)) | (slices.elements if slices else {})
    more: dict[str, Any] = {"live": facts} | (slices.scene if slices else {})
    if converted is not None:
        contents["splats-0"] = compressed_ply(converted, name)  # what `read_html` finds
        found = clouds[0][2].certificate
        score = "" if found is None else f", {found.psnr:.1f} dB"
        more["converted"] = {
            "file": "converted.compressed.ply", "element": "splats-0", "said": f"converted{score}",
            "count": len(converted),
        }  # fmt: skip
    named = [(one[0], splats) for one, splats in zip(clouds, shown, strict=True)]
    return html_of_several(named, name, contents, more, "splats" if converted is None else "live")


def page_of_several(clouds: Sequence[tuple[str, Gaussians, PlyOptions]], name: str) -> bytes:
    """Return the page of several named clouds, live if they can be shown under one function, else with fixed looks.

    Raises:
        DataError, UsageError: see `live_html`.
    """
    if shared_facts([None if gaussians.live is None else options.live for _, gaussians, options in clouds]):
        return live_html_of_several(clouds, name)
    baked = [
        (cloud, splats_of(replace(gaussians, live=None), replace(upright(options), live=None)))
        for cloud, gaussians, options in clouds
    ]
    return html_of_several(baked, name)


def contents(options: PlyOptions, name: str, names: Sequence[str] = (), slices: Slices | None = None) -> str:
    """Return one line that says what a page holds, for whoever sends it.

    Args:
        options: of the Gaussians that carry values, if there are any.
        name: of the page.
        names: in its list, of several clouds.
        slices: of its volume.
    """
    layers = () if options.live is None else options.live.layers
    valued = any(not layer.labels for layer in layers)
    parts = ["Gaussians", *(["data values, their histogram"] if valued else [])]
    labels = sum(len(layer.labels) for layer in layers) or (slices.labels if slices else 0)
    parts += [f"names of {labels} label{'s' * (labels > 1)}"] if labels else []
    stated = [layer.name for layer in layers if layer.name] if len(layers) > 1 else list(names)
    parts += [f"the names {listed(stated, ', ', 3)}"] if stated else []
    parts += [str(slices)] if slices else []
    parts += ["a checksum of the volume"] if options.certificate else []
    return f"{name} holds {', '.join(parts)}; its title is {options.title or title_of(name)!r} (--title)"


def shared_facts(facts: Sequence[LiveFacts | None]) -> LiveFacts | None:
    """Return common facts about the values of several files for one page, None if one page cannot show them all.

    The files must have the same number of layers, and values of the same range under the same function. The labels of
    label maps are merged: a number may have several names, each with the look of the first file that has it.
    """
    known = [one.layers for one in facts if one is not None]
    if len(known) < len(facts) or len({len(layers) for layers in known}) > 1:
        return None
    first, *others = [_shared_layer(same) for same in zip(*known, strict=True)]
    if first is None or None in others:
        return None
    return replace(first, others=tuple(one for one in others if one is not None))


def _shared_layer(facts: Sequence[LiveFacts]) -> LiveFacts | None:
    """Return common facts about one layer of each file, None if there are none."""
    first = facts[0]
    if all(one.labels for one in facts):
        return replace(first, labels=merge_labels(label for one in facts for label in one.labels))
    looks = {(bool(one.labels), one.lo, one.hi, one.function) for one in facts}
    return first if len(looks) == 1 else None


def live_page_data(clouds: Sequence[tuple[Gaussians, PlyOptions]]) -> tuple[list[Splats], list[bytes], dict[str, Any]]:
    """Return the data of a page of Gaussians (unit frame) that carry values, for one or several clouds.

    Returns:
        per cloud the columns, in an order that `.compressed.ply` keeps; per cloud the bytes of the values in that
        order, compressed by gzip; the facts for the scene's ``live``.

    Raises:
        DataError, UsageError: see `live_html`.
    """
    facts = shared_facts([options.live for _, options in clouds])
    assert facts is not None
    ordered, splats = [], []
    for gaussians, options in clouds:
        laid = upright(options)
        assert options.live is not None
        some = with_shared_labels(gaussians, options.live, facts).take(morton_order(turn(gaussians, laid.up).means))
        splats.append(splats_of(replace(some, live=None, harmonics=None), replace(laid, live=None, sh_degree=0)))
        ordered.append(some)
    logs, planes = log_lengths(ordered), []
    for some, (_, options) in zip(ordered, clouds, strict=True):
        rows = live_bytes(turn(some, upright(options).up), facts, logs)[:, : planes_of(facts)]
        planes.append(gzip.compress(np.ascontiguousarray(rows.T).tobytes(), 9, mtime=0))
    return splats, planes, _facts(ordered, facts, clouds[0][1])


def with_shared_labels(gaussians: Gaussians, before: LiveFacts, after: LiveFacts) -> Gaussians:
    """Return Gaussians with their label rows changed from those of their ``before`` facts to those of ``after``."""
    assert gaussians.live is not None
    live = gaussians.live.copy()
    for number, (one, all_) in enumerate(zip(before.layers, after.layers, strict=True)):
        if one.labels != all_.labels:
            rows = {label.key: row for row, label in enumerate(all_.labels)}
            mine = live[:, LAYER_ID] == number if after.others else np.full(len(live), True)
            to = np.array([rows[label.key] for label in one.labels])
            live[mine, LABEL_ROW] = to[live[mine, LABEL_ROW].astype(np.int64)]
    return replace(gaussians, live=live)


def planes_of(facts: LiveFacts) -> int:
    """Return how many columns of `live_bytes` a page stores, one after the other: all, or those before the rows."""
    return BYTES if facts.labels or facts.others else ROW


def _facts(clouds: Sequence[Gaussians], facts: LiveFacts, options: PlyOptions) -> dict[str, Any]:
    """Return the facts that the viewer needs in addition to the bytes; ``options`` are those of the first cloud."""
    distances = [layer.distance or options.unit_distance or 1.0 for layer in facts.layers]
    found = live_json(clouds, facts, [distance * (options.scale or 1.0) for distance in distances])
    for entry, layer, distance in zip(found["layers"], facts.layers, distances, strict=True):
        entry |= {"opacity_unit_distance": distance}
        entry |= {"nodes": []} if layer.labels else {"nodes": nodes_of(layer), "presets": presets_of(layer, entry)}
    axes = _axes(upright(options).up)
    return found | {
        "elements": [f"{VALUES_ID}-{k}" for k in range(len(clouds))],
        "planes": planes_of(facts),
        "light": _light(options.light, axes),
        "law": law_nodes().tolist(),
        "dilation": DILATION * pixel_width(options.screen_size or SIZE) ** 2,
        "axes": axes.tolist(),
        "box": [
            np.min([cloud.means.min(axis=0) for cloud in clouds], axis=0).tolist(),
            np.max([cloud.means.max(axis=0) for cloud in clouds], axis=0).tolist(),
        ],
    }


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
