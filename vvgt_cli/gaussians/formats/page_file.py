"""The page that shows Gaussians: its text, and the whole of it as one file that opens without a server.

`page/` holds its text, and `viewer.js.gz`, which `make page` builds of `page.mjs`, SuperSplat's viewer and the
PlayCanvas engine (CONTRIBUTING.md, "Dependencies").
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from itertools import product
from types import MappingProxyType
from typing import Any

import numpy as np

from vvgt_cli.cameras import orbit_views
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import PlyOptions
from vvgt_cli.gaussians.certificate import epoch
from vvgt_cli.gaussians.formats.gsply_files import read_compressed_ply
from vvgt_cli.gaussians.formats.page_frames import held_frames
from vvgt_cli.gaussians.formats.splats import Splats
from vvgt_cli.gaussians.rules import INRIA, RULES

PROGRAM = "viewer.js.gz"
_RULE = re.compile(r"vvgt size \d+ rule (\w+)$")
_UNIT = re.compile(r"vvgt frame unit\b")
_SPLATS = re.compile(rb'<script type="application/octet-stream" id="splats-\d+">([A-Za-z0-9+/=]+)</script>')
_FAR = 99  # percentile of the distances from the middle that a camera stands back by
_SEEN = -3.0  # logit of the opacity from which on a Gaussian is one that is seen
_DISTANCE, _FIELD = 3.0, 40.0  # of the orbits' cameras, in half edges of the unit frame and in degrees


def asset(name: str) -> bytes:
    """A file of `page/`."""
    return files("vvgt_cli.gaussians.formats").joinpath("page", name).read_bytes()


def upright(options: PlyOptions) -> PlyOptions:
    """How Gaussians are laid out to be looked at: in the unit frame, with the way up of `vvgt render` upwards.

    Viewers turn every file as 3DGS' files want it: PLY -y is up. Files that do not say where they are stay as they are.
    """
    if not options.comments:
        return options
    return replace(options, frame="unit", up="z" if options.up == "none" else options.up)


def dated(options: PlyOptions) -> PlyOptions:
    """With the day on which a page is written, or that of SOURCE_DATE_EPOCH (seconds), for the same bytes every day."""
    if not options.comments:
        return options
    seconds = epoch()
    when = datetime.now() if seconds is None else datetime.fromtimestamp(seconds, UTC)
    return replace(options, date=f"{when:%Y-%m-%d}")


def camera(splats: Splats) -> dict[str, Any]:
    """Where the page's camera begins: where `vvgt render --orbit` does, or as far from the middle of other files.

    Returns:
        Position and target in the viewer's axes, which have PLY (x, y, z) at (-x, -y, z); the field of view in degrees.
    """
    middle, half = np.zeros(3), 1.0
    if not any(_UNIT.match(line) for line in splats.comments):
        middle = np.median(splats.means, axis=0).astype(np.float64)
        half = float(np.percentile(np.linalg.norm(splats.means - middle, axis=1), _FAR)) or 1.0
    x, y, z = orbit_views(1, radius=_DISTANCE * half)[0].position  # +z is up
    target = middle * (-1, -1, 1)
    return {"position": (target + np.array([-x, z, y])).tolist(), "target": target.tolist(), "fov": _FIELD}


def outermost(clouds: Sequence[Splats]) -> list[list[float]]:
    """Places in the viewer's axes that a window has to hold for what is seen of all ``clouds`` to be whole in it.

    Of 26 directions each one's farthest Gaussian; none where nothing is seen.
    """
    places = np.concatenate([splats.means[splats.logits > _SEEN] for splats in clouds]) * (-1.0, -1.0, 1.0)
    towards = np.array([d for d in product((-1, 0, 1), repeat=3) if any(d)]).T
    if not len(places):
        return []
    found: list[list[float]] = places[np.unique((places @ towards).argmax(axis=0))].round(3).tolist()
    return found


def drawing(splats: Splats) -> dict[str, Any]:
    """What the page's viewer changes to draw by the rule that the file names, or by the usual one."""
    said = (_RULE.match(line) for line in splats.comments)
    rule = RULES.get(next((found[1] for found in said if found), ""), INRIA)
    return {
        "dilation": rule.dilation, "compensate": rule.compensate, "shifted": rule.shifted,
        "minAlpha": rule.min_alpha, "minVariance": rule.min_variance,
    }  # fmt: skip


def page(
    title: str,
    splats: Splats,
    frames: Sequence[dict[str, Any]],
    parts: str,
    more: Mapping[str, Any] = MappingProxyType({}),
) -> str:
    """The page's text.

    Args:
        title: of the window.
        splats: of the first frame.
        frames: of each its ``name``, its ``file``, what it is ``held`` in, where that is in the page, and the number
            of the ``whole`` frame that it is held as the difference from.
        parts: elements that bring the viewer.
        more: of the scene, for the program.
    """
    seen = {"camera": camera(splats), "outermost": outermost([splats])}
    return _text(title, {"rule": drawing(splats), **seen, "frames": list(frames), **more}, parts)


def waiting_page(title: str, parts: str) -> str:
    """The text of a page whose Gaussians are being made: it asks the server how far they are."""
    place = {"position": [0, 0, _DISTANCE], "target": [0, 0, 0], "fov": _FIELD}
    return _text(title, {"waits": True, "camera": place, "frames": []}, parts)


def _text(title: str, scene: Mapping[str, Any], parts: str) -> str:
    said = json.dumps(scene).replace("<", "\\u003c")  # no name ends the script
    text = asset("page.html").decode("utf-8")
    for place, value in (("TITLE", escape(title)), ("SCENE", said), ("PARTS", parts)):
        text = text.replace(f"<!--{place}-->", value, 1)
    return text


def html(splats: Splats, name: str) -> bytes:
    """The page of one cloud as one file."""
    return html_of_several([(title_of(name), splats)], name)


def html_of_several(
    clouds: Sequence[tuple[str, Splats]],
    name: str,
    parts: Mapping[str, bytes] = MappingProxyType({}),
    more: Mapping[str, Any] = MappingProxyType({}),
) -> bytes:
    """The page as one file: the viewer packed by gzip, each cloud as a `.compressed.ply`, all in base64.

    Of frames that share Gaussians only the first is whole.

    Args:
        clouds: each one's name, as the page's list has it, and columns; the first is shown at first.
        name: of the file.
        parts: by the elements' ids, other content that the page holds.
        more: of the scene, for the program.
    """
    held = [("program", "text/plain", asset(PROGRAM))]
    held += [(key, "application/octet-stream", content) for key, content in parts.items()]
    shown = held_frames(clouds)
    held += [(f"splats-{k}", "application/octet-stream", frame.content) for k, frame in enumerate(shown)]
    elements = [
        f'<script type="{kind}" id="{key}">{base64.b64encode(content).decode("ascii")}</script>'
        for key, kind, content in held
    ]
    elements.append(f"<script>{asset('inflate.js').decode('utf-8')}</script>")
    frames: list[dict[str, Any]] = [
        {"name": cloud, "file": f"{k}.compressed.ply", "held": f"splats-{k}"} for k, (cloud, _) in enumerate(clouds)
    ]
    for frame, (_, whole) in zip(frames, shown, strict=True):
        frame |= {} if whole is None else {"whole": whole}
    more = {"outermost": outermost([splats for _, splats in clouds]), **more}
    return page(title_of(name), clouds[0][1], frames, "\n".join(elements), more).encode("utf-8")


def framed(content: bytes, name: str) -> str:
    """A page within another, as notebooks show it: its program reaches nothing of that one, and no network."""
    text = escape(content.decode("utf-8"))
    style = "width: 100%; height: 540px; border: 0; background: #000"
    allowed = 'sandbox="allow-scripts allow-downloads" allow="fullscreen"'
    return f'<iframe title="{escape(name)}" {allowed} style="{style}" srcdoc="{text}"></iframe>'


def title_of(name: str) -> str:
    """Of a page's file: no folder, no ending."""
    return re.split(r"[/\\]", name)[-1].removesuffix(".html")


def read_html(content: bytes, name: str) -> Splats:
    """The columns of a page that `html` wrote.

    Raises:
        DataError: another page, or one of several clouds.
    """
    found = _SPLATS.findall(content)
    if not found:
        raise DataError(f"{name}: a page without Gaussians; expected one that vvgt wrote")
    if len(found) > 1:
        raise DataError(
            f"{name}: a page of {len(found)} clouds of Gaussians; expected one: try the .ply of one of them"
        )
    return read_compressed_ply(base64.b64decode(found[0]), name)
