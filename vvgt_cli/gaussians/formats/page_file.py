"""The HTML page that shows Gaussians, and its single-file form, which opens without a server.

`page/` holds the template and `viewer.js.gz`, which `make page` builds from `page.mjs`, SuperSplat's viewer and the
PlayCanvas engine (CONTRIBUTING.md, "Dependencies"). Frames of a series are stored whole, or as differences from the
last whole one (`page/patch.mjs`).
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from html import escape
from importlib.resources import files
from itertools import product
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import PlyOptions
from vvgt_cli.gaussians.formats.gsply_files import compressed_ply, read_compressed_ply
from vvgt_cli.gaussians.formats.splats import Splats, morton_order
from vvgt_cli.gaussians.frames import up_matrix
from vvgt_cli.gaussians.header import facts_in
from vvgt_cli.gaussians.rules import INRIA, RULES
from vvgt_cli.gaussians.types import HARMONICS

PROGRAM = "viewer.js.gz"
_SPLATS = re.compile(rb'<script type="application/octet-stream" id="splats-\d+">([A-Za-z0-9+/=]+)</script>')
_SCRIPTS, _STYLES = re.compile("<script>(.*?)</script>", re.S), re.compile("<style>(.*?)</style>", re.S)
_FAR = 99  # percentile of distances from the middle that counts as the radius of a cloud
TEXTS = 100_000  # most bytes of titles, names, functions and histograms
ENGINE_REACH = 4.0  # largest p that the engine draws
_SEEN = -3.0  # opacity logit above which a Gaussian counts as visible
_DRAWN = -5.5  # and below which it is not drawn: 1/255
_FAINT = 0.05  # share of all opacity that may be out of view where it is spread over faint Gaussians
_DISTANCE, _FIELD = 3.0, 40.0  # of orbit cameras: distance in radii, field of view in degrees
VIEWER = (-1.0, -1.0, 1.0)  # times PLY x, y and z: the viewer's axes
_CELLS = 40  # of a silhouette, along the longest edge
_LARGER, _FLAT = 1.1, 1.5  # how many times as large a silhouette is for another view to be chosen, and one from above
_RAISED, _TILTED = 0.1, 0.364  # height of the eye before a face, and beside other content, in horizontal distances


def page_bytes(degree: int) -> tuple[float, float]:
    """Return the most bytes of a page without Gaussians and values, and of each Gaussian with harmonics of a degree."""
    header = sum(len(asset(name)) for name in ("page.html", "page.css", "inflate.js")) + TEXTS
    packed = 16 + 72 / 256 + 3 * HARMONICS[degree]  # of a .compressed.ply: chunks of 256
    return header + (len(asset(PROGRAM)) + 2 * 4096) * 4 / 3, packed * 4 / 3  # base64; headers and what gzip adds


def asset(name: str) -> bytes:
    """Return a file of `page/`."""
    return files("vvgt_cli.gaussians.formats").joinpath("page", name).read_bytes()


def upright(options: PlyOptions) -> PlyOptions:
    """Return the options for viewing: the unit frame, with the same axis up as in `vvgt render`.

    Viewers show PLY -y up. Files without comments about their frame stay as they are.
    """
    if not options.comments:
        return options
    return replace(options, frame="unit", up="z" if options.up == "none" else options.up)


def camera(splats: Splats) -> dict[str, Any]:
    """Return the initial camera of the page: the file's own, else of the view in which its content is recognised best.

    That is the face of a body, and otherwise the side with the largest silhouette.

    Returns:
        position and target in the viewer's axes, where PLY (x, y, z) is (-x, -y, z); the field of view in degrees, of
        the shorter side of the window.
    """
    facts = facts_in(list(splats.comments), "page")
    if stated := asked(splats):
        return stated
    middle, half = np.zeros(3), 1.0
    if facts.get("frame") != "unit":
        middle = np.median(splats.means, axis=0).astype(np.float64)
        half = float(np.percentile(np.linalg.norm(splats.means - middle, axis=1), _FAR)) or 1.0
    target, towards = middle * VIEWER, _face(facts) or _largest_side(splats)
    eye = target + _DISTANCE * half * np.array(towards) / np.linalg.norm(towards)
    return {"position": eye.tolist(), "target": target.tolist(), "fov": _FIELD}


def _face(facts: Mapping[str, Any]) -> tuple[float, float, float] | None:
    """Return the direction from a body to an eye that sees its face, in the viewer's axes; None of other files."""
    front = {"RAS": 1, "LPS": -1}.get(facts.get("space") or "")
    if front is None:
        return None
    x, y, z = up_matrix(facts.get("up", "none")) @ (0, front, 0) * VIEWER
    return None if abs(y) > 0.5 else (float(x), _RAISED, float(z))  # the face may look up


def _largest_side(splats: Splats) -> tuple[float, float, float]:
    """Return the direction to an eye that sees the side with the largest silhouette, in the viewer's axes.

    A silhouette is the number of cells of a grid in which there is a visible Gaussian. The eye is high above content
    that lies flat.
    """
    places = _visible([splats])
    if not len(places):  # of a volume that is not converted yet
        return (-1.0, _TILTED, 0.0)
    cells = np.round(_CELLS * (places - places[:1]) / max(float(np.ptp(places, axis=0).max()), 1e-12))
    x, y, z = (len(np.unique(np.delete(cells, axis, axis=1), axis=0)) for axis in range(3))
    if y > _FLAT * max(x, z):
        return (-0.3, 1.0, 0.0)
    return (0.0, _TILTED, -1.0) if z > _LARGER * x else (-1.0, _TILTED, 0.0)


def asked(splats: Splats) -> dict[str, Any] | None:
    """Return the camera that the file states, as `camera` does."""
    facts = facts_in(list(splats.comments), "page")
    if "camera" not in facts or "scale" not in facts:
        return None
    *places, field = facts["camera"]
    points = np.reshape(places, (2, 3))
    if facts["frame"] == "unit":
        points = (points - facts["centre"]) * facts["scale"]
    eye, target = points @ up_matrix(facts.get("up", "none")).T * (-1, -1, 1)
    return {"position": eye.tolist(), "target": target.tolist(), "fov": field}


def outermost(clouds: Sequence[Splats]) -> list[list[float]]:
    """Return points in the viewer's axes that must be in view for everything visible of ``clouds`` to fit.

    These are the farthest Gaussians in 98 directions, of all that are not faint, and of fog the densest 95 %. The list
    is empty if nothing is visible, and if the first cloud states a camera, which stays where it is.
    """
    if clouds and asked(clouds[0]):
        return []
    return farthest(_visible(clouds))


def farthest(places: np.ndarray) -> list[list[float]]:
    """Return those of some places (N, 3) that are the farthest in one of 98 directions."""
    towards = np.array([d for d in product(range(-2, 3), repeat=3) if any(d)]).T
    if not len(places):
        return []
    return places[np.unique((places @ towards).argmax(axis=0))].round(3).tolist()


def _visible(clouds: Sequence[Splats]) -> np.ndarray:
    """Return places (N, 3), in the viewer's axes, of Gaussians that are not faint, and of fog of the densest 95 %."""
    logits = np.concatenate([splats.logits for splats in clouds])
    ordered = np.sort(logits).astype(np.float64)
    opacity = np.cumsum(1 / (1 + np.exp(-np.maximum(ordered, -80))))
    first = np.searchsorted(opacity, _FAINT * opacity[-1]) if len(ordered) else 0
    least = np.clip(ordered[first : first + 1], _DRAWN, _SEEN)
    return np.concatenate([splats.means for splats in clouds])[logits >= least] * VIEWER


def rule_parameters(splats: Splats) -> dict[str, Any]:
    """Return the viewer's parameters for the rendering rule that the file names, or for the default one."""
    rule = RULES.get(facts_in(list(splats.comments), "page").get("rule", ""), INRIA)
    return {
        "dilation": rule.dilation, "compensate": rule.compensate, "shifted": rule.shifted,
        "reach": min(rule.reach, ENGINE_REACH),
        "minAlpha": rule.min_alpha, "minVariance": rule.min_variance,
    }  # fmt: skip


def page(
    title: str,
    splats: Splats,
    frames: Sequence[dict[str, Any]],
    elements: str,
    more: Mapping[str, Any] = MappingProxyType({}),
) -> str:
    """Return the text of the page.

    Args:
        title: title of the window.
        splats: columns of the first frame.
        frames: per frame its ``name`` and ``file``; if it is embedded in the page, the id of its
            ``element``, and for a difference the number of the ``whole`` frame that it refers to.
        elements: HTML elements with the viewer.
        more: further entries of the scene for the viewer.
    """
    seen = {"camera": camera(splats)} | ({} if "outermost" in more else {"outermost": outermost([splats])})
    return _text(title, {"rule": rule_parameters(splats), **seen, "frames": list(frames), **more}, elements)


def waiting_page(title: str, elements: str) -> str:
    """Return the text of a page that waits for its Gaussians, and asks the server for progress."""
    place = {"position": [0, 0, _DISTANCE], "target": [0, 0, 0], "fov": _FIELD}
    return _text(title, {"waits": True, "camera": place, "frames": []}, elements)


def _text(title: str, scene: Mapping[str, Any], elements: str) -> str:
    document = json.dumps(scene).replace("<", "\\u003c")  # so that no name can end the script
    text, style = (asset(name).decode("utf-8") for name in ("page.html", "page.css"))
    for place, value in (("STYLE", style), ("TITLE", escape(title)), ("SCENE", document), ("PARTS", elements)):
        text = text.replace(f"<!--{place}-->", value, 1)
    return text


def policy(text: str, source: str = "") -> str:
    """Return a page's content security policy, by hashes; ``source``, as "'self'", is where it loads files from."""
    scripts = [part.encode("utf-8") for part in _SCRIPTS.findall(text)]
    if 'id="program"' in text:
        scripts.append(gzip.decompress(asset(PROGRAM)))
    styles = [part.encode("utf-8") for part in _STYLES.findall(text)]
    script, style = (" ".join(f"'sha256-{_digest(one)}'" for one in some) for some in (scripts, styles))
    also = f"{source} " if source else ""
    return (
        f"default-src 'none'; script-src {also}{script} blob:; worker-src blob:; style-src {style}; "
        f"img-src data: blob:; connect-src {also}data: blob:"
    )


def _digest(content: bytes) -> str:
    return base64.b64encode(hashlib.sha256(content).digest()).decode("ascii")


def html_of_several(
    clouds: Sequence[tuple[str, Splats]],
    name: str,
    embedded: Mapping[str, bytes] = MappingProxyType({}),
    more: Mapping[str, Any] = MappingProxyType({}),
) -> bytes:
    """Return the page as a single file: the viewer by gzip, and each cloud as a `.compressed.ply`, in base64.

    Frames that share Gaussians with an earlier one are stored as differences.

    Args:
        clouds: names in the page's list, and columns; the first cloud is shown initially.
        name: name of the file.
        embedded: further content of the page, by element id.
        more: further entries of the scene for the viewer.
    """
    contents = [("program", "text/plain", asset(PROGRAM))]
    contents += [(key, "application/octet-stream", content) for key, content in embedded.items()]
    shown = stored_frames(clouds)
    contents += [(f"splats-{k}", "application/octet-stream", frame.content) for k, frame in enumerate(shown)]
    elements = [
        f'<script type="{kind}" id="{key}">{base64.b64encode(content).decode("ascii")}</script>'
        for key, kind, content in contents
    ]
    elements.append(f"<script>{asset('inflate.js').decode('utf-8')}</script>")
    frames: list[dict[str, Any]] = [
        {"name": text, "file": f"{k}.compressed.ply", "element": f"splats-{k}"} for k, (text, _) in enumerate(clouds)
    ]
    for frame, (_, whole) in zip(frames, shown, strict=True):
        frame |= {} if whole is None else {"whole": whole}
    more = {"outermost": outermost([splats for _, splats in clouds]), **more}
    return page(title_of(name, clouds[0][1].comments), clouds[0][1], frames, "\n".join(elements), more).encode("utf-8")


def iframe(content: bytes, name: str) -> str:
    """Return an iframe for notebooks that shows a page without access to the enclosing page or the network."""
    text = escape(content.decode("utf-8"))
    style = "width: 100%; height: 540px; border: 0; background: #000"
    allowed = (
        'sandbox="allow-scripts allow-downloads" allow="fullscreen; clipboard-write; web-share; xr-spatial-tracking"'
    )
    return f'<iframe title="{escape(name)}" {allowed} style="{style}" srcdoc="{text}"></iframe>'


def title_of(name: str, comments: Iterable[str] = ()) -> str:
    """Return the title that a file states, else its name without folder and ending."""
    stated: str | None = facts_in(list(comments), name).get("title")
    return re.split(r"[/\\]", name)[-1].removesuffix(".html") if stated is None else stated


def read_html(content: bytes, name: str) -> Splats:
    """Read the columns of a page written by `html`.

    Raises:
        DataError: the page is not from vvgt, or holds several clouds.
    """
    clouds = _SPLATS.findall(content)
    if not clouds:
        raise DataError(f"{name}: a page without Gaussians; expected one that vvgt wrote")
    if len(clouds) > 1:
        raise DataError(f"{name}: a page of {len(clouds)} clouds of Gaussians; expected one: try the .ply of one cloud")
    return read_compressed_ply(base64.b64decode(clouds[0]), name)


LEAST = 0.2  # smallest share of rows in common with the whole frame
GAP = 16  # equal bytes that are kept within a run, as a new run costs 8 bytes


class StoredFrame(NamedTuple):
    """A frame stored in a page: a `.compressed.ply`, or the difference from that of frame ``whole``."""

    content: bytes
    whole: int | None


def stored_frames(clouds: Sequence[tuple[str, Splats]]) -> list[StoredFrame]:
    """Return all frames (name, columns), those that share rows with the last whole frame as differences."""
    clouds, stored = _of_one_length(clouds), list[StoredFrame]()
    while len(stored) < len(clouds):
        first = len(stored)
        key = clouds[first][1]
        changed = [_changed(key, splats) for _, splats in clouds[first + 1 :]]
        count = next((k for k, rows in enumerate(changed) if rows is None), len(changed))
        ever = np.any([rows for rows in changed[:count] if rows is not None], axis=0) if count else None
        order = None if ever is None else morton_order(key.means)
        if order is not None and ever is not None:
            order = order[np.argsort(ever[order], kind="stable")]  # unchanged Gaussians first
        name, splats = clouds[first]
        base = compressed_ply(splats, name, order)
        stored.append(StoredFrame(base, None))
        for name, splats in clouds[first + 1 : first + 1 + count]:
            stored.append(StoredFrame(patch(base, compressed_ply(splats, name, order)), first))
    return stored


def _of_one_length(clouds: Sequence[tuple[str, Splats]]) -> list[tuple[str, Splats]]:
    """Pad comments to the same length, because some, such as certificates, differ from frame to frame."""
    sizes = [sum(len(f"comment {line}\n".encode()) for line in splats.comments) for _, splats in clouds]
    if len(set(sizes)) < 2:
        return list(clouds)
    return [
        (name, replace(splats, comments=(*splats.comments, " " * (max(sizes) - size))))
        for (name, splats), size in zip(clouds, sizes, strict=True)
    ]


def _changed(key: Splats, splats: Splats) -> np.ndarray | None:
    """Return a mask (K,) of the rows that differ, None if the frames have too little in common."""
    if len(key) != len(splats) or key.f_rest.shape != splats.f_rest.shape:
        return None
    rows = np.zeros(len(key), bool)
    for field in fields(Splats):
        a, b = getattr(key, field.name), getattr(splats, field.name)
        if isinstance(a, np.ndarray):
            rows |= (a != b).reshape(len(rows), -1).any(axis=1)
    return rows if rows.mean() <= 1 - LEAST else None


def patch(base: bytes, content: bytes) -> bytes:
    """Return the difference of ``content`` from ``base`` of the same length: runs, each (place, length, bytes)."""
    a, b = np.frombuffer(base, np.uint8), np.frombuffer(content, np.uint8)
    at = np.flatnonzero(a != b)
    if not len(at):
        return b""
    breaks = np.flatnonzero(np.diff(at) > GAP)
    first, last = at[np.concatenate([[0], breaks + 1])], at[np.concatenate([breaks, [len(at) - 1]])] + 1
    runs = zip(first.tolist(), last.tolist(), strict=True)
    return b"".join(struct.pack("<II", i, j - i) + content[i:j] for i, j in runs)
