"""Contents of a file, for `vvgt info`."""

from __future__ import annotations

import io
import json
import os
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from vvgt_cli.cameras.files import read_cameras
from vvgt_cli.conversion.gaussian_files import STDIN, open_gaussians
from vvgt_cli.conversion.index import is_index, read_index
from vvgt_cli.conversion.recolored import recolored
from vvgt_cli.device import describe as describe_gpu
from vvgt_cli.errors import DataError, SeveralArrays, SeveralComponents, SeveralSteps, UsageError, VvgtError
from vvgt_cli.files import seekable
from vvgt_cli.gaussians import as_ply, describe, read_ply
from vvgt_cli.gaussians.formats import format_of, is_page, is_splats, read_splats
from vvgt_cli.gaussians.formats.page_file import policy
from vvgt_cli.gaussians.formats.page_values import ELEMENT
from vvgt_cli.gaussians.formats.streamed import facts_of, split_name
from vvgt_cli.look import PER_VOXEL, Label
from vvgt_cli.look.label_files import is_table, labels_of, read_labels
from vvgt_cli.look.readers import OWN, SUFFIXES
from vvgt_cli.look.readers.names import names
from vvgt_cli.resources import free_memory, processors
from vvgt_cli.volume import ReadOptions, Volume
from vvgt_cli.volume.blocks import Packed
from vvgt_cli.volume.registry import contents, is_recognised
from vvgt_cli.volume.space import axis_facts

if TYPE_CHECKING:
    from vvgt_cli.field.layered import OpenedFile
    from vvgt_cli.field.source import SourceRequest


_PLY = (b"ply\n", b"ply\r")
LISTED = 50  # of several volumes in a file
CHEAP = 64 << 20  # bytes of a volume whose range is looked for
_HEAD = 65536  # bytes that tell a view set from a transfer function
_FUNCTION = re.compile(
    rb'RGBPoints|"(points|R|colorTransfer|volumeProperties)"|<(ColorMap|VolumeProperty|inviwo)', re.I
)


def machine_facts() -> dict[str, Any]:
    """Return what of this machine a run may use: processors, memory, GPU."""
    memory = free_memory()
    free = "unknown" if memory is None else f"{memory / 2**30:.1f} GiB free"
    return {"kind": "machine", "processors": processors(), "memory": free, "gpu": describe_gpu()}


def inspect(file: str, read: ReadOptions, function: SourceRequest | None = None) -> dict[str, Any]:
    """Return facts about a volume, a transfer function, a view set, a `.ply` or an index; the first is "kind".

    With ``function``, live Gaussians are described as they are under it.

    Raises:
        DataError: a file that is not valid, or not of a known kind.
        UsageError: no such file, or options that do not fit it.
    """
    if function is not None:
        return {"kind": "gaussians", "name": Path(file).name, **_shown(file, function)}
    if file == STDIN and _head_of_stdin().startswith(_PLY):
        return {"kind": "gaussians", "name": "standard input", **describe(*read_ply(sys.stdin.buffer))}
    if not os.path.exists(file) and os.path.isfile(file.rpartition("#")[0]):  # a preset of several
        return _transfer_function(file)
    if not os.path.exists(file) and file in names():
        return _transfer_function(file)
    path, streamed = seekable(file), split_name(file)
    if streamed is not None and streamed[1] is None:
        return {"kind": "streamed gaussians", "name": streamed[0].name, **facts_of(streamed[0])}
    if streamed is not None:
        return {"kind": "gaussians", "name": file, **describe(*read_splats(file))}
    if not os.path.isfile(path):  # standard input, example:NAME, a folder, a glob, FILE:/array, or nothing
        return _volume(file, read)
    name = Path(file)
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    known = format_of(name)
    if head.startswith(_PLY) or known:
        gaussians, header = read_splats(file)
        facts = {"kind": "gaussians", "name": name.name, **describe(gaussians, header)}
        if known is None:
            return facts
        size = path.stat().st_size
        more = {"policy": policy(path.read_text("utf-8"))} if is_page(file) else {}
        stated = {"bytes": size, "bytes_per_gaussian": round(size / len(gaussians), 1), "format": known.suffix}
        return facts | stated | more
    if is_index(name):
        index = read_index(name)
        about: dict[str, Any] = {key: index[key] for key in ("volume", "table") if key in index}
        return {"kind": f"index of {index['kind']}", "name": name.name, **about, "clouds": index["files"]}
    if is_table(name):
        return _table(file)
    if is_recognised(head) or name.suffix.lower() == ".p3d":  # JSON and XML that are no transfer functions
        return _volume(file, read)
    if name.suffix.lower() in SUFFIXES or head.lstrip()[:1] in (b"{", b"["):
        if b'"frames"' in head:
            return _views(name)
        try:
            return _transfer_function(file)
        except DataError:
            if name.suffix.lower() in OWN or _FUNCTION.search(head):
                raise
    return _volume(file, read)


def _shown(file: str, function: SourceRequest) -> dict[str, Any]:
    gaussians, header = open_gaussians(file)
    visible, options = recolored(file, gaussians, header, function)
    written = read_ply(io.BytesIO(as_ply(visible, options)))
    return {"function": options.function, "hidden": len(gaussians) - len(visible), **describe(*written)}


def _head_of_stdin() -> bytes:
    """Return the first bytes of standard input without consuming them."""
    stream = sys.stdin.buffer
    return stream.peek(4) if isinstance(stream, io.BufferedReader) else b""


def _views(path: Path) -> dict[str, Any]:
    cameras = read_cameras(path)
    first = cameras[0]
    return {
        "kind": "views",
        "name": path.name,
        "views": len(cameras),
        "sizes": sorted({f"{c.width} x {c.height}" for c in cameras}),
        "focal": [first.fx, first.fy],
        "distance": [
            min(float((c.position**2).sum() ** 0.5) for c in cameras),
            max(float((c.position**2).sum() ** 0.5) for c in cameras),
        ],
    }


def _transfer_function(file: str) -> dict[str, Any]:
    from vvgt_cli.look import read_transfer_function

    tf = read_transfer_function(file)
    lo, hi = tf.node_range()
    facts: dict[str, Any] = {"kind": "transfer function", "name": tf.name, "nodes": [lo, hi]}
    if tf.domain != "data":
        facts["nodes_in"] = tf.domain
    if tf.opacity_unit_share is not None:
        facts["opacity_per"] = f"{tf.opacity_unit_share:g} of the longest edge"
    if tf.opacity_unit_distance is not None:
        facts["opacity_per"] = f"{tf.opacity_unit_distance:g} ({tf.opacity_unit_label})"
    if tf.opacity_unit_label == PER_VOXEL:
        facts["opacity_per"] = "mean edge of a voxel"
    if tf.lighting is not None:
        facts["light"] = tf.lighting.text()
    return facts


def _table(file: str) -> dict[str, Any]:
    table = read_labels(file)
    entries = _entries(table.labels)
    return {"kind": "table of labels", "name": table.name, "labels": len(entries), "entries": entries}


def _entries(labels: Sequence[Label]) -> list[dict[str, Any]]:
    return [{"label": e.number, "name": e.name, "color": e.color, "opacity": e.opacity} for e in labels]


def _volume(file: str, read: ReadOptions) -> dict[str, Any]:
    """Describe a volume; if the file holds several, list them; of time steps, describe the first."""
    try:
        return _one(file, read)
    except SeveralSteps as error:
        facts = _one(file, replace(read, time=0))
        head = {"kind": facts.pop("kind"), "name": facts.pop("name")}
        rows = [{"step": k, "name": name, "option": f"--time {k}"} for k, name in enumerate(error.names[:LISTED])]
        steps = {"time_steps": error.steps, "shown": "time step 0 (--time N chooses)"}
        return {**head, **steps, **({"steps": rows} if rows else {}), **facts}
    except SeveralArrays as error:
        outer = file.rpartition(":/")[0] if not os.path.exists(file) else file
        pairs = list(zip(error.choices, error.names, strict=True))
        rows = [
            _choice(outer or file, replace(read, array=key), f"{error.option} {key}", name)
            for key, name in pairs[:LISTED]
        ]
        return {"kind": "several volumes", "name": Path(file).name, "count": len(pairs), "choices": rows}
    except SeveralComponents as error:
        rows = [
            _choice(file, replace(read, component=k), f"--component {k}", name)
            for k, name in zip(range(min(error.count, LISTED)), [*error.names] or [""] * error.count, strict=False)
        ]
        return {"kind": "several components", "name": Path(file).name, "count": error.count, "choices": rows}


def _choice(file: str, read: ReadOptions, option: str, name: str) -> dict[str, Any]:
    """Describe one of several volumes of a file: size, type, and the range if that is quick to find."""
    from vvgt_cli.field.layered import open_content

    facts: dict[str, Any] = {"choice": option, **({"name": name} if name not in ("", option.partition(" ")[2]) else {})}
    read = replace(read, stored=True, packed=True)
    try:
        try:
            content = open_content(file, read)
        except SeveralSteps as error:
            facts["time_steps"] = error.steps
            content = open_content(file, replace(read, time=0))
        except SeveralComponents as error:
            facts["components"] = error.count
            content = open_content(file, replace(read, component=0))
        volume = content.volumes[0]
        facts |= {"dims": volume.dims, "dtype": volume.data.dtype.name}
        facts |= {"channels": len(content.volumes)} if len(content.volumes) > 1 else _range(volume)
    except VvgtError as error:
        facts["error"] = " ".join(str(error).split())[:200]
    return facts


def _channels(content: OpenedFile) -> list[dict[str, Any]]:
    """Describe each channel of a volume: the option that selects it, its name, colour and range."""
    rows = []
    names = content.names or [""] * len(content.volumes)
    for k, name, color, volume in zip(content.numbers, names, content.colors, content.volumes, strict=True):
        shown = [round(v, 4) for v in color]
        rows.append({"choice": f"--channel {k}", "name": name, "color": shown, **_range(volume)})
    return rows


def _range(volume: Volume) -> dict[str, list[float]]:
    """Return the range of values if it is quick to find."""
    from vvgt_cli.volume import statistics

    if volume.data.nbytes > CHEAP:
        return {}
    stats = statistics(volume)
    return {"range": [stats.lo, stats.hi]}


def _one(file: str, read: ReadOptions) -> dict[str, Any]:
    from vvgt_cli.field.layered import open_content
    from vvgt_cli.look import unit_distance
    from vvgt_cli.look.suggest import fitting
    from vvgt_cli.volume import statistics
    from vvgt_cli.volume.label_maps import recognised

    listed = contents(file, read)
    try:
        content = open_content(file, replace(read, packed=True))
    except UsageError as error:  # a choice that is missing: the lists say how to make it
        if not listed or (read.array, read.component, read.time) != (None, None, None):
            raise
        return {"kind": "several volumes", "name": Path(file).name, **listed, "choice": str(error)}
    volume = content.volumes[0]
    kinds: dict[str, Any] = {}
    if content.color:
        kinds["colors"] = "RGBA"[: len(content.volumes)]
    elif content.overlapping:
        kinds["segment_layers"] = len(content.volumes)
    elif len(content.volumes) > 1:
        kinds |= {"channels": len(content.volumes), "choices": _channels(content)}
    elif not isinstance(volume.data, Packed) and recognised(volume):
        kinds["label_map"] = True
    if named := [label for one in content.volumes for label in labels_of(one.segments or (), one.name)]:
        kinds["segments"] = _entries(named)
    stats = statistics(volume)
    return {
        "kind": "volume",
        "name": volume.name,
        **kinds,
        "dims": volume.dims,
        "dtype": volume.data.dtype.name,
        "byte_order": sys.byteorder
        if volume.data.dtype.isnative
        else {"little": "big", "big": "little"}[sys.byteorder],
        "bytes": volume.data.nbytes,
        "spacing": volume.spacing,
        "origin": volume.origin,
        "direction": volume.direction,
        "space": volume.space or "none",
        "length_unit": "mm" if volume.space else volume.unit or "none",
        **axis_facts(volume.affine, volume.space),
        "extent": volume.extent,
        "scaling": [volume.slope, volume.intercept],
        **({"modality": volume.modality} if volume.modality else {}),
        "range": [stats.lo, stats.hi],
        **({"value_unit": volume.values_in} if volume.values_in else {}),
        "nan": stats.nan_count,
        "inf": stats.inf_count,
        "unit_distance": {name: unit_distance(name, volume, None)[0] for name in ("paraview", "mean-spacing")},
        **listed,
        **({} if kinds else {"tf": fitting(stats, volume)}),
    }


_SCENE = re.compile(r'id="scene">(.*?)</script>', re.S)
OURS = ("vvgt ", "SplatRenderMode")
FACE = (
    "shows what the volume shows, such as the face of a head whose skin is visible: --crop, --mask or a function "
    "without skin removes it"
)
LATER = "; other functions can be chosen later, which show what this one hides"


def what_leaves(file: str) -> dict[str, Any]:
    """Return what a file of Gaussians or a page of one cloud holds besides Gaussians: names, places, values.

    Raises:
        DataError: a file that is not valid.
        UsageError: not a file of Gaussians.
    """
    if not is_splats(file):
        raise UsageError(
            f"--sharing {file}: not Gaussians; expected a .ply, a page or another file that 'convert' wrote"
        )
    _, header = read_splats(file)
    layers = () if header.live is None else header.live.layers
    page = is_page(file)
    text = Path(file).read_text("utf-8") if page else ""
    scene = json.loads(_SCENE.findall(text)[0]) if page else {}
    held = f'id="{ELEMENT}-0"' in text and "of the volume, also of what its look hides"
    names = [name for layer in layers for name in (layer.name, *(label.name for label in layer.labels))]
    legend = json.loads(header.legend or "{}")
    scanned = header.space in ("RAS", "LPS")
    made, facts = header.certificate, dict[str, Any](kind="sharing", name=Path(file).name)
    details = {
        "title": header.title, "function": header.function,
        "command": made and made.command, "checksum": made and made.sha256,
        "range": legend.get("values"), "names": [*filter(None, names), *(name for name, _ in legend.get("labels", ()))],
        "place": header.affine and f"position and directions in the {'scanner' if scanned else 'world'}",
        "story": [step["text"] for step in scene.get("story", ())],
        "saved view, with its rulers, notes and story": unquote(scene.get("link", "")),
        "light": header.light and header.light.sky,
        "camera": header.camera and "eye and target in the world",
        "values": held or (layers and "data values under each Gaussian, and their histogram"),
        "other": [line for line in header.comments if not line.startswith(OURS)],
    }  # fmt: skip
    facts |= {key: value for key, value in details.items() if value}
    facts["picture"] = FACE + LATER * bool(held or layers)
    remove = "--no-comments omits all but the picture and the values, --title names it otherwise"
    return facts | {"remove": f"{remove}; positions of --frame world stay"}
