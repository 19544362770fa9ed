"""The header of a 3DGS `.ply`, checked before any data is read; its facts, legends and certificates."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.gaussians.frames import up_matrix
from vvgt_cli.gaussians.live_facts import WORD, LiveFacts, live_facts, one_comment
from vvgt_cli.gaussians.types import HARMONICS
from vvgt_cli.look import LabelTable, Lighting, TransferFunction, hex_color, labels_legend, parse_lighting
from vvgt_cli.version import VERSION

REST_COUNTS = {3 * terms: degree for degree, terms in HARMONICS.items()}  # f_rest properties: 0, 9, 24, 45
REQUIRED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
_BASIC = {"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"}
_SIZED = {"int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4"}
TYPES = _BASIC | _SIZED | {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8"}
MAX_BYTES = 1 << 20  # of the longest header that is accepted
CERTIFICATE = "certificate"  # keyword of the comment
MIP = "SplatRenderMode: mip"  # Brush's marker for opacity compensated for dilation
_ADVICE = "expected a binary little-endian 3DGS .ply, as written by vvgt and SuperSplat"


@dataclass(frozen=True, kw_only=True)
class FileFacts:
    """Facts about Gaussians in the comments of a file's header; None where a file does not state one.

    Attributes:
        frame: "unit" (box-centred, longest edge 2) or "world" (the volume's physical space).
        up: world axis that points up in viewers, one of `frames.UP_NAMES`.
        scale, centre: the volume's `UnitFrame`; a file in world space needs both.
        unit_distance: world length that opacity refers to.
        unit_distance_label: how that distance was chosen; None is written as "given".
        screen_size: edge of the target screen in pixels.
        rule: name of the rendering rule that the Gaussians are made for.
        space: anatomical space of the world, "RAS", "LPS" or "none"; written with the affine.
        affine: 3 x 4 row-major, from voxel index (i, j, k, 1) of the volume to world position.
        light: lighting of the scene.
        optics: digest of the tables and functions of an optics grid.
        live: the values that the Gaussians carry; None if they have a fixed look.
        length_unit: unit of the world if it has no anatomical space (whose unit is mm).
        function: name of the transfer function.
        certificate: measurements of the conversion; None if the Gaussians were changed since.
        legend: legend of the file's look (`legend_text`); live files keep it in ``live``.
        title: title of pages, which names no file unless it was chosen.
        camera: where pages open: eye and target, world, and the vertical field of view in degrees.
    """

    frame: str = "unit"
    up: str = "none"
    scale: float | None = None
    centre: tuple[float, float, float] | None = None
    unit_distance: float | None = None
    unit_distance_label: str | None = None
    screen_size: int | None = None
    rule: str | None = None
    space: str | None = None
    affine: tuple[float, ...] | None = None
    light: Lighting | None = None
    optics: str | None = None
    live: LiveFacts | None = None
    length_unit: str | None = None
    function: str | None = None
    certificate: Certificate | None = None
    legend: str | None = None
    title: str | None = None
    camera: tuple[float, ...] | None = None

    def facts(self) -> dict[str, Any]:
        """Return the facts by name."""
        return {entry.name: getattr(self, entry.name) for entry in fields(FileFacts)}


@dataclass(frozen=True)
class PlyHeader(FileFacts):
    """The content of a header.

    Attributes:
        size: bytes up to and including the line `end_header`.
        count: number of vertices.
        dtype: one vertex, little-endian, packed.
        sh_degree: degree of the spherical harmonics in the file (0 to 3).
        comments: comment lines, without the word "comment".
        version: version of the vvgt that wrote the file, None for other programs.
    """

    size: int
    count: int
    dtype: np.dtype
    sh_degree: int
    comments: tuple[str, ...] = ()
    version: str | None = None


def header_lines(content: bytes, name: str) -> tuple[list[str], int]:
    """Return the lines of the header, of at most `MAX_BYTES` bytes, and its size in bytes."""
    if not content.startswith((b"ply\n", b"ply\r\n")):
        raise DataError(f"{name}: starts with {content[:8]!r}, not with 'ply'; {_ADVICE}")
    position = 0
    lines: list[str] = []
    while True:
        end = content.find(b"\n", position, MAX_BYTES)
        if end < 0:
            raise DataError(f"{name}: no 'end_header' in the first {min(len(content), MAX_BYTES)} bytes; {_ADVICE}")
        try:
            line = content[position:end].decode("utf-8").strip()
        except UnicodeDecodeError:
            raise DataError(f"{name}: the header is not text; {_ADVICE}") from None
        position = end + 1
        if line == "end_header":
            return lines, position
        lines.append(line)


def _vertex_count(words: list[str], name: str) -> int:
    if len(words) != 3 or words[1] != "vertex":
        raise DataError(
            f"{name}: element {' '.join(words[1:])!r}; expected one element, 'vertex' "
            "(is it a mesh or a compressed .ply? try splat-transform to convert it)"
        )
    if not (words[2].isdecimal() and words[2].isascii() and len(words[2]) < 16):
        raise DataError(f"{name}: vertex count {words[2]!r}; expected a whole number")
    return int(words[2])


def _property(words: list[str], fields: dict[str, str], name: str) -> None:
    if len(words) != 3 or words[1] not in TYPES:
        raise DataError(f"{name}: property {' '.join(words[1:])!r}; expected a scalar type and a name")
    if words[2] in fields:
        raise DataError(f"{name}: property {words[2]!r} appears twice in the header; expected it once")
    if (words[2] in REQUIRED or words[2].startswith("f_rest_")) and TYPES[words[1]] != "<f4":
        raise DataError(f"{name}: property {words[2]} is {words[1]}; expected float")
    fields[words[2]] = TYPES[words[1]]


def _sh_degree(fields: dict[str, str], name: str) -> int:
    missing = [field for field in REQUIRED if field not in fields]
    if missing:
        raise DataError(f"{name}: no {', '.join(missing)} among its {len(fields)} properties; {_ADVICE}")
    rest = [field for field in fields if field.startswith("f_rest_")]
    if len(rest) not in REST_COUNTS:
        raise DataError(f"{name}: {len(rest)} f_rest properties; expected {', '.join(map(str, REST_COUNTS))}")
    odd = set(rest) - set(rest_names(REST_COUNTS[len(rest)]))
    if odd:
        raise DataError(f"{name}: property {min(odd)} among {len(rest)} f_rest properties; expected them from f_rest_0")
    return REST_COUNTS[len(rest)]


def rest_names(degree: int) -> list[str]:
    """Return the property names of harmonics up to a degree: red's coefficients, then green's, then blue's."""
    return [f"f_rest_{i}" for i in range(3 * HARMONICS[degree])]


def parse_header(content: bytes, name: str) -> PlyHeader:
    """Parse the header at the beginning of a file; raise DataError if it is not that of a 3DGS `.ply`."""
    lines, size = header_lines(content, name)
    formats, count, comments = [], None, []
    fields: dict[str, str] = {}
    for line in lines[1:]:
        words = line.split()
        if not words or words[0] == "obj_info":
            continue
        if words[0] == "comment":
            comments.append(line[len("comment") :].strip())
        elif words[0] == "format":
            formats.append(" ".join(words[1:]))
        elif words[0] == "element" and count is None:
            count = _vertex_count(words, name)
        elif words[0] == "property" and count is not None:
            _property(words, fields, name)
        else:
            raise DataError(f"{name}: header line {line[:60]!r}; {_ADVICE}")
    if formats != ["binary_little_endian 1.0"]:
        raise DataError(f"{name}: format {', '.join(formats) or 'missing'}; expected binary_little_endian 1.0")
    if count is None:
        raise DataError(f"{name}: no element vertex; {_ADVICE}")
    degree = _sh_degree(fields, name)
    dtype = np.dtype(list(fields.items()))
    return PlyHeader(size, count, dtype, degree, tuple(comments), **facts_in(comments, name, list(fields)))


def facts_in(comments: list[str], name: str, columns: Sequence[str] = ()) -> dict[str, Any]:
    """Return the `FileFacts` and the version that a file's comments state, by name; ``columns`` are the file's.

    Raises:
        DataError: a comment begins with "vvgt" and is not valid.
    """
    facts: dict[str, Any] = {}
    lives: list[dict[str, Any]] = [{}]
    for comment in comments:
        ours, word, text = [*comment.split(None, 2), "", "", ""][:3]
        if ours != "vvgt" or not word:
            continue
        try:
            if word == WORD:
                more = one_comment(text)
                if "name" in more and lives[-1]:
                    lives.append({})
                live = lives[-1]
                live |= more | {"labels": live.get("labels", ()) + more["labels"]} if "labels" in more else more
            elif word == CERTIFICATE:
                facts[CERTIFICATE] = Certificate.of(text)
            else:
                facts |= _one_comment(word, text)
        except (ValueError, IndexError, UsageError):
            raise DataError(f"{name}: comment {comment[:80]!r}; expected one that vvgt writes") from None
    if facts.get("frame") == "world" and "scale" not in facts:
        raise DataError(f"{name}: in world space without scale and centre; expected both in its comments")
    return facts | {"live": live_facts(lives, list(columns))}


def _one_comment(word: str, text: str) -> dict[str, Any]:
    """Return the facts of a comment ``vvgt WORD TEXT``; raise ValueError, IndexError or UsageError for others."""
    words = text.split()
    if word == "frame":
        if words[0] not in ("unit", "world"):
            raise ValueError(text)
        if len(words) == 1:
            return {"frame": words[0]}
        if (words[1], words[3]) != ("scale", "centre") or len(words) != 7:
            raise ValueError(text)
        scale, *centre = _finite([words[2], *words[4:]])
        if scale <= 0:
            raise ValueError(scale)
        return {"frame": words[0], "scale": scale, "centre": tuple(centre)}
    if word == "up":
        up_matrix(words[0])
        return {"up": words[0]}
    if word == "unit-distance":
        return {"unit_distance": _finite(words[:1])[0], "unit_distance_label": text[len(words[0]) :].strip()}
    if word == "size":
        if words[1] != "rule" or len(words) != 3 or not words[0].isdecimal() or not 0 < int(words[0]) <= 2**20:
            raise ValueError(text)
        return {"screen_size": int(words[0]), "rule": words[2]}
    if word == "camera":
        return {"camera": camera_of(words)}
    if word == "space":
        if text not in ("RAS", "LPS", "none"):
            raise ValueError(text)
        return {"space": text}
    if word == "light":
        return {"light": parse_lighting(text)}
    if word in ("function", "title"):
        return {word: str(json.loads(text))}
    if word == "legend":
        return {"legend": checked(text)}
    if word == "affine":
        affine = _finite(words)
        axes = np.reshape(affine, (3, 4))[:, :3]  # another count: ValueError
        if not axes.any() or np.linalg.det(axes / np.abs(axes).max()) == 0:
            raise ValueError(text)
        return {"affine": tuple(affine)}
    if word in ("length-unit", "optics"):
        return {word.replace("-", "_"): words[0]}
    return {} if text else {"version": word}


def camera_of(words: Sequence[str]) -> tuple[float, ...]:
    """Return the seven numbers of a camera (eye, target, vertical field of view in degrees), or raise ValueError."""
    numbers = _finite(list(words))
    if len(numbers) != 7 or numbers[:3] == numbers[3:6] or not 0 < numbers[6] < 180:
        raise ValueError(words)
    return tuple(numbers)


def comment_lines(facts: FileFacts) -> list[str]:
    """Return the header lines with the version and the facts; `parse_header` reads them."""
    lines = [f"comment vvgt {VERSION}"]
    frame = f"comment vvgt frame {facts.frame}"
    if facts.scale is not None and facts.centre is not None:
        frame += f" scale {float(facts.scale)!r} centre {' '.join(repr(float(c)) for c in facts.centre)}"
    lines += [frame, f"comment vvgt up {facts.up}"]
    if facts.affine is not None:
        numbers = " ".join(repr(float(a)) for a in facts.affine)
        lines += [f"comment vvgt space {facts.space or 'none'}", f"comment vvgt affine {numbers}"]
    if facts.length_unit is not None:
        lines.append(f"comment vvgt length-unit {facts.length_unit}")
    named = (("title", facts.title), ("function", facts.function))
    lines += [f"comment vvgt {word} {json.dumps(text)}" for word, text in named if text is not None]
    if facts.legend is not None and not facts.live:
        lines.append(f"comment vvgt legend {facts.legend}")
    if facts.unit_distance is not None:
        label = facts.unit_distance_label or "given"
        lines.append(f"comment vvgt unit-distance {float(facts.unit_distance)!r} {label}")
    if facts.camera is not None:
        lines.append(f"comment vvgt camera {' '.join(repr(float(v)) for v in facts.camera)}")
    if facts.screen_size is not None:
        lines.append(f"comment vvgt size {facts.screen_size} rule {facts.rule or 'inria'}")
    if facts.light is not None:
        lines.append(f"comment vvgt light {facts.light.text()}")
    if facts.optics is not None:
        lines.append(f"comment vvgt optics {facts.optics}")
    if facts.live is not None:
        lines += facts.live.lines()
    if facts.certificate is not None:
        lines.append(f"comment {facts.certificate.line()}")
    if facts.rule == "compensated":
        lines.append(f"comment {MIP}")
    return lines


def _finite(words: list[str]) -> list[float]:
    values = [float(word) for word in words]
    if not all(math.isfinite(value) for value in values):
        raise ValueError(words)
    return values


MAX_LEGEND_NODES, MAX_LEGEND = 32, 2500  # nodes, characters: space in a header is limited


def legend_text(tf: object, lo: float, hi: float, unit: str, quantity: str = "") -> str | None:
    """Return one line of JSON: value range, unit, quantity, nodes (value, opacity, colour); or labels (name, colour).

    Args:
        tf: function on data values or label table; of several layers a list, whose label tables have a legend. Anything
            else has none, and None is returned.
        lo: smallest value.
        hi: largest value.
        unit: unit of the values, "" if unknown.
        quantity: what the values are, "" if unknown.
    """
    if tables := [one for one in (tf if isinstance(tf, list) else [tf]) if isinstance(one, LabelTable)]:
        return labels_legend([label for table in tables for label in table.labels], MAX_LEGEND)
    if not isinstance(tf, TransferFunction):
        return None
    places = np.unique(np.concatenate([[lo, hi], tf.opacity_nodes.x, tf.color_map.x]).clip(lo, hi))
    if len(places) > MAX_LEGEND_NODES or tf.color_map.space != "RGB":
        places = np.linspace(lo, hi, MAX_LEGEND_NODES) if hi > lo else np.array([lo])
    nodes: list[list[Any]] = []
    digits = 6 - math.floor(math.log10((hi / 2 - lo / 2) or abs(lo) or 1.0))  # six of the range
    for x, limits in zip(places.tolist(), tf.limits(places).tolist(), strict=True):
        below, above = ([round(x, digits), round(opacity, 4), hex_color(rgb)] for opacity, *rgb in limits)
        nodes += [above] if x <= lo or below == above else [below] if x >= hi else [below, above]  # both at a step
    return json.dumps({"values": [lo, hi], "unit": unit, "quantity": quantity, "nodes": nodes})


def checked(text: str) -> str:
    """Check that a text is a legend, and return it; raise ValueError for others."""
    legend = json.loads(text)
    if not isinstance(legend, dict) or not ("nodes" in legend or "labels" in legend):
        raise ValueError(text)
    return text


@dataclass(frozen=True)
class Certificate:
    """Measurements made during a conversion, valid only for the Gaussians of that file.

    Attributes:
        volume: title of the volume, which names no file unless it was chosen.
        sha256: hexadecimal digest of its values; None for a volume too large to be read twice.
        look: digest of functions, label tables, unit distances and light.
        size: edge of the target screen in pixels.
        rule: name of the rule of `vvgt_cli.gaussians.rules` that the scores used.
        psnr: mean PSNR in dB of the first scored views against the volume.
        views: number of these views.
        pixels: number of pixels that were scored of each.
        live_psnr: PSNR in dB of a live file recoloured with its own function; None for other files.
        conditions: name and PSNR in dB of each viewing condition that was scored, worst first.
        texture: texture of smooth areas close up, of the Gaussians and of the volume, in levels of 255; None if
            nothing is opaque and smooth.
        position_error: largest distance of a stored centre from the computed one, in world units.
        values_psnr: PSNR in dB, over the range of values, of a live file's values on the volume's grid
            (`vvgt voxelize`); None for other files.
        values_error: the largest error there, data value.
        command: the command line without folders, outputs, names of volumes and options that do not affect the
            result; None from Python.
    """

    volume: str
    sha256: str | None
    look: str
    size: int
    rule: str
    psnr: float
    views: int
    pixels: int
    live_psnr: float | None = None
    conditions: tuple[tuple[str, float], ...] = ()
    texture: tuple[float, float] | None = None
    position_error: float = 0.0
    values_psnr: float | None = None
    values_error: float | None = None
    command: str | None = None

    def facts(self) -> dict[str, Any]:
        """Return the known values by name."""
        values = vars(self) | {"conditions": dict(self.conditions)}
        return {key: value for key, value in values.items() if value not in (None, {})}

    def line(self) -> str:
        """Return the header comment, one line of ASCII without the word "comment"."""
        return f"vvgt {CERTIFICATE} {json.dumps(self.facts())}"

    @classmethod
    def of(cls, text: str) -> Certificate:
        """Parse the JSON that `line` writes after its keyword, or raise ValueError."""
        values = json.loads(text)
        if not isinstance(values, dict) or not isinstance(values.get("conditions", {}), dict):
            raise ValueError(text)
        conditions = tuple((str(name), _number(value)) for name, value in values.pop("conditions", {}).items())
        woven = values.pop("texture", None)
        if woven is not None and (not isinstance(woven, list) or len(woven) != 2):
            raise ValueError(text)
        texture = None if woven is None else (_number(woven[0]), _number(woven[1]))
        kinds = {
            "volume": str, "sha256": str, "look": str, "size": int, "rule": str, "psnr": float, "views": int,
            "pixels": int, "live_psnr": float, "position_error": float, "values_psnr": float, "values_error": float,
            "command": str,
        }  # fmt: skip
        if not {"volume", "look", "size", "rule", "psnr", "views", "pixels"} <= set(values) <= set(kinds):
            raise ValueError(text)
        known: dict[str, Any] = {"sha256": None, "texture": texture}
        for key, value in values.items():
            kind = kinds[key]
            values[key] = _number(value) if kind is float else value
            if not isinstance(values[key], kind) or isinstance(value, bool):
                raise ValueError(text)
        return cls(**(known | values), conditions=conditions)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(value)
    return float(value)
