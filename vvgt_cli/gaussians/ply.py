"""The standard 3DGS `.ply`: a writer and a validating reader (docs/conventions.md)."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from vvgt_cli.errors import DataError, UsageError, naming
from vvgt_cli.files import seekable
from vvgt_cli.gaussians.frames import rescale, turn, up_matrix
from vvgt_cli.gaussians.header import MAX_BYTES, REQUIRED, FileFacts, PlyHeader, comment_lines, parse_header, rest_names
from vvgt_cli.gaussians.live_facts import COLUMNS, GRADIENT, LABEL, LABEL_ROW, LAYER, LAYER_ID, NXYZ, VALUES, LiveFacts
from vvgt_cli.gaussians.story import Story
from vvgt_cli.gaussians.types import HARMONICS, SH_C0, Gaussians
from vvgt_cli.volume.space import axis_facts

FRAMES = ("unit", "world")
OPAQUE = 16.0  # logit of an opacity of 1 - 1e-7


@dataclass(frozen=True)
class PlyOptions(FileFacts):
    """Options for writing a file, and the facts in its header.

    Attributes:
        sh_degree: degree of the harmonics in the file, 0 to 3: missing ones are zeros, and higher ones are dropped;
            None keeps the Gaussians' own degree.
        comments: whether the header states the facts and the version.
        story: of a page.
    """

    sh_degree: int | None = None
    comments: bool = True
    story: Story | None = None

    def __post_init__(self) -> None:
        """Check the axis, frame and degree."""
        up_matrix(self.up)
        if self.frame not in FRAMES:
            raise UsageError(f"frame {self.frame!r}: expected one of {', '.join(FRAMES)}")
        if self.sh_degree is not None and self.sh_degree not in HARMONICS:
            raise UsageError(f"SH degree {self.sh_degree}: expected 0 to 3")


def colors_to_f_dc(colors: np.ndarray) -> np.ndarray:
    """Convert display RGB (K, 3) float32 to SH band 0, ``(rgb - 0.5) / SH_C0``, rounded once from float64.

    With `f_dc_to_colors` this forms a generalised inverse pair: ``W(R(W(c))) == W(c)`` and ``R(W(R(f))) == R(f)`` bit
    by bit. At every magnitude one of the two floating-point grids is finer by at least 1.13, so a round trip through it
    is exact; ``R(W(c)) == c`` itself holds for c in (0.25, 1.5], where the grid of f_dc is the finer one.
    """
    with np.errstate(over="ignore"):
        return ((colors.astype(np.float64) - 0.5) / SH_C0).astype(np.float32)


def f_dc_to_colors(f_dc: np.ndarray) -> np.ndarray:
    """Convert SH band 0 (K, 3) float32 to display RGB, ``0.5 + SH_C0 * f_dc``, rounded once from float64."""
    return (0.5 + SH_C0 * f_dc.astype(np.float64)).astype(np.float32)


def as_stored(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians as a unit-frame file would restore them, with colours rounded in the same way."""
    return replace(gaussians, colors=f_dc_to_colors(colors_to_f_dc(gaussians.colors)))


def property_names(sh_degree: int = 0, live: bool = False) -> list[str]:
    """Return the float32 properties of a file in order; ``live`` adds those of carried values."""
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *rest_names(sh_degree),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
        *(COLUMNS if live else ()),
    ]


def write_ply(
    target: str | Path | BinaryIO,
    gaussians: Gaussians,
    options: PlyOptions | None = None,
    normals: np.ndarray | None = None,
) -> int:
    """Write Gaussians (unit frame) to a path or a binary stream, and return the number of bytes.

    A path is written directly: callers that must not leave a partial file pass the temporary name of
    `vvgt_cli.files.atomic_write`. The bytes depend only on the arguments and the version. ``normals`` (K, 3), unit
    frame, are zeros by default.

    Raises:
        DataError: there are no Gaussians, or a value does not fit in float32 in the chosen frame.
        UsageError: the frame is "world" and scale or centre are missing.
    """
    options = options or PlyOptions()
    if gaussians.live is None or options.live is None:
        gaussians, options = replace(gaussians, live=None), replace(options, live=None)
    if not len(gaussians):
        raise DataError("no Gaussians to write; expected at least one")
    rows = ply_rows(gaussians, options, normals)
    degree = gaussians.degree if options.sh_degree is None else options.sh_degree
    header = ply_header(len(gaussians), degree, options, gaussians.live is not None)
    if isinstance(target, str | Path):
        with open(target, "wb") as stream:
            stream.write(header)
            stream.write(rows.data)  # not tofile, whose errors give no reason
    else:
        target.write(header)
        target.write(rows.tobytes())
    return len(header) + rows.nbytes


def as_ply(gaussians: Gaussians, options: PlyOptions | None = None, normals: np.ndarray | None = None) -> bytes:
    """Return the file that `write_ply` would write, with its errors."""
    stream = io.BytesIO()
    write_ply(stream, gaussians, options, normals)
    return stream.getvalue()


def ply_rows(gaussians: Gaussians, options: PlyOptions, normals: np.ndarray | None = None) -> np.ndarray:
    """Return the rows of a file, (K, properties) float32 little-endian, as `write_ply` writes them, with its errors."""
    _check_rotations(gaussians, "Gaussians to write")
    placed = turn(gaussians if options.sh_degree is None else gaussians.of_degree(options.sh_degree), options.up)
    if options.frame == "world":
        if options.scale is None or options.centre is None:
            raise UsageError("frame 'world': no unit frame of the volume; expected PlyOptions(scale=..., centre=...)")
        centre = up_matrix(options.up) @ np.array(options.centre)
        placed = rescale(placed, 1 / options.scale, np.zeros(3), centre)
    f_dc = colors_to_f_dc(placed.colors)
    if not np.isfinite(f_dc).all():
        raise DataError("colours too large for float32 spherical harmonics; expected values near [0, 1]")
    names = property_names(placed.degree, placed.live is not None)
    end = len(names) - (0 if placed.live is None else len(COLUMNS))
    rows = np.zeros((len(placed), len(names)), dtype="<f4")  # (K, properties)
    rows[:, 0:3] = placed.means
    if normals is not None:
        rows[:, 3:6] = normals @ up_matrix(options.up).T
    rows[:, 6:9] = f_dc
    if placed.harmonics is not None:
        rows[:, 9 : end - 8] = placed.harmonics.transpose(0, 2, 1).reshape(len(placed), end - 17)
    rows[:, end - 8] = placed.opacity_logits
    rows[:, end - 7 : end - 4] = placed.log_scales
    rows[:, end - 4 : end] = placed.quaternions
    if placed.live is not None:
        rows[:, 3:6], rows[:, end:] = placed.live[:, GRADIENT], placed.live[:, VALUES]
        if options.live is not None:
            return _with_numbers(rows, placed.live, options.live)
    return rows


def _with_numbers(rows: np.ndarray, live: np.ndarray, facts: LiveFacts) -> np.ndarray:
    """Append the integer columns of `_numbers` to rows of floats (K, n); without any, return the rows."""
    extra = _numbers(facts)
    if not extra:
        return rows
    out = np.empty(len(rows), [("floats", "<f4", rows.shape[1]), *((name, kind) for name, _, kind, _ in extra)])
    out["floats"] = rows
    for name, _, _, column in extra:
        out[name] = live[:, column]
    return out


def _numbers(facts: LiveFacts) -> list[tuple[str, str, str, int]]:
    """Return the integer columns: name, type in the file and in memory, and column of `Gaussians.live`.

    The row of a label takes one byte, or two for more than 256 labels; the number of a layer takes one.
    """
    labels, columns = facts.most_labels, []
    if labels:
        columns.append((LABEL, *(("uchar", "u1") if labels <= 256 else ("ushort", "<u2")), LABEL_ROW))
    if facts.others:
        columns.append((LAYER, "uchar", "u1", LAYER_ID))
    return columns


def ply_header(count: int, degree: int, options: PlyOptions, live: bool = False) -> bytes:
    """Return the header of a file of ``count`` Gaussians with harmonics of ``degree``; ``live`` adds carried values.

    Raise DataError for names and functions that make it longer than readers accept.
    """
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]  # some loaders count lines
    lines += [f"property float {name}" for name in property_names(degree, live)]
    if live and options.live is not None:
        lines += [f"property {kind} {name}" for name, kind, _, _ in _numbers(options.live)]
    lines += [*(comment_lines(options) if options.comments else []), "end_header", ""]
    content = "\n".join(lines).encode("ascii")
    if len(content) > MAX_BYTES:
        raise DataError(
            f"the header takes {len(content)} bytes with names and functions; expected at most {MAX_BYTES}; shorten "
            "the names of labels or layers"
        )
    return content


def _rows(source: str | Path | BinaryIO, name: str) -> tuple[PlyHeader, np.ndarray]:
    """Read the header and structured rows; the size is checked before anything is allocated."""
    if isinstance(source, str | Path):
        with open(seekable(source), "rb") as stream:
            header = parse_header(stream.read(MAX_BYTES), name)
            size = stream.seek(0, io.SEEK_END)
            check_size(header, size, name)
            if not header.count:
                return header, np.zeros(0, header.dtype)
            rows = np.memmap(stream, dtype=header.dtype, mode="r", offset=header.size, shape=(header.count,))
        return header, rows
    content = source.read()
    header = parse_header(content, name)
    check_size(header, len(content), name)
    return header, np.frombuffer(content, dtype=header.dtype, count=header.count, offset=header.size)


def check_size(header: PlyHeader, size: int, name: str) -> None:
    """Raise DataError unless a file of ``size`` bytes has the size that its header states."""
    expected = header.size + header.count * header.dtype.itemsize
    if size != expected:
        what = "truncated" if size < expected else "followed by data that is not Gaussians"
        raise DataError(
            f"{name}: {size} bytes; expected {expected} by its header, for {header.count} vertices of "
            f"{header.dtype.itemsize} bytes: the file is {what}"
        )


def read_ply(source: str | Path | BinaryIO) -> tuple[Gaussians, PlyHeader]:
    """Read a 3DGS `.ply` from a path or a binary stream, in the frame of the file.

    Properties are found by name, in any order. Harmonics that are all zero count as padding and are dropped;
    ``header.sh_degree`` keeps their degree. In files of other programs, rows that cannot be rendered are skipped with a
    warning.

    Raises:
        DataError: the file is not a binary little-endian 3DGS `.ply`, does not have the size that its header states, or
            was written by vvgt and has values that are not finite.
    """
    name = str(source) if isinstance(source, str | Path) else getattr(source, "name", "stream")
    header, rows = _rows(source, str(name))
    if header.version is None:
        rows = _drawable(rows, header, str(name))

    def columns(*names: str) -> np.ndarray:
        return np.stack([rows[n] for n in names], axis=-1).astype(np.float32)

    with naming(str(name)):
        gaussians = Gaussians(
            columns("x", "y", "z"),
            columns("scale_0", "scale_1", "scale_2"),
            columns("rot_0", "rot_1", "rot_2", "rot_3"),
            np.array(rows["opacity"], dtype=np.float32),
            f_dc_to_colors(columns("f_dc_0", "f_dc_1", "f_dc_2")),
            _harmonics(columns(*rest_names(header.sh_degree))) if header.sh_degree else None,
            _values(header, columns),
        )
    _check_rotations(gaussians, str(name))
    return gaussians, header


def _drawable(rows: np.ndarray, header: PlyHeader, name: str) -> np.ndarray:
    """Return the rows with finite values and non-zero rotation, opacity +inf as `OPAQUE`, and warn about the rest."""
    opaque = rows["opacity"] == np.inf
    rotated = np.any([rows[f"rot_{k}"] for k in range(4)], axis=0)
    values = [rows[key] for key in (*REQUIRED, *rest_names(header.sh_degree)) if key != "opacity"]
    kept = np.logical_and.reduce([*map(np.isfinite, values), rotated, opaque | np.isfinite(rows["opacity"])])
    if kept.all() and not opaque.any():
        return rows
    unusual = {"skipped (a value not finite, or rotation 0)": ~kept, "read as opaque (opacity inf)": opaque & kept}
    counts = [f"{count} {what}" for what, these in unusual.items() if (count := np.count_nonzero(these))]
    warnings.warn(f"{name}: of {len(kept)} Gaussians {', '.join(counts)}", stacklevel=3)
    rows = rows[kept]
    rows["opacity"][opaque[kept]] = OPAQUE
    return rows


def _harmonics(rest: np.ndarray) -> np.ndarray | None:
    """Reshape a file's harmonics from (K, 3 M), channel by channel, to (K, M, 3); None if all bits are zero."""
    terms = rest.shape[1] // 3
    return rest.reshape(-1, 3, terms).transpose(0, 2, 1) if rest.view(np.uint32).any() else None


def _values(header: PlyHeader, columns: Callable[..., np.ndarray]) -> np.ndarray | None:
    """Return `Gaussians.live` from columns, None if there are none; raise DataError if a value is out of its range."""
    if header.live is None:
        return None
    facts, numbers = header.live, _numbers(header.live)
    values = columns(*COLUMNS, *NXYZ, *(name for name, *_ in numbers))
    if facts.others and not facts.most_labels:
        values = np.insert(values, LABEL_ROW, 0, axis=1)
    layer = values[:, LAYER_ID].astype(np.int64) if facts.others else np.zeros(len(values), np.int64)
    if layer.max(initial=0) >= len(facts.layers):
        raise DataError(f"layer number {layer.max()}; expected less than {len(facts.layers)}")
    if facts.most_labels:
        most = np.array([len(one.labels) or 1 for one in facts.layers])[layer]
        wrong = np.flatnonzero(values[:, LABEL_ROW] >= most)
        if len(wrong):
            raise DataError(f"label row {values[wrong[0], LABEL_ROW]:g}; expected less than {most[wrong[0]]}")
    if (values[:, 1] < 0).any() or (values[:, 2] <= 0).any():
        raise DataError("negative spreads, or lengths that are not positive; expected the columns that vvgt writes")
    return values


def _check_rotations(gaussians: Gaussians, name: str) -> None:
    zero = int(np.count_nonzero(~gaussians.quaternions.any(axis=1)))
    if zero:
        raise DataError(f"{name}: {zero} of {len(gaussians)} rotation quaternions are zero; expected a non-zero norm")


def in_unit_frame(gaussians: Gaussians, header: PlyHeader) -> Gaussians:
    """Undo the frame and the up rotation that the file's comments state, if any."""
    if header.frame == "world":
        assert header.scale is not None  # parse_header has checked it
        shift = up_matrix(header.up) @ np.array(header.centre)
        gaussians = rescale(gaussians, header.scale, -shift, np.zeros(3))
    return turn(gaussians, header.up, inverse=True)


def live_summary(gaussians: Gaussians, facts: LiveFacts) -> dict[str, object]:
    """Return the part of `describe` about carried values."""
    assert gaussians.live is not None
    if facts.others:
        rows_of_layers: list[dict[str, object]] = []
        for k, layer in enumerate(facts.layers):
            own = gaussians.take(np.flatnonzero(gaussians.live[:, LAYER_ID] == k))
            look = {"labels": len(layer.labels)} if layer.labels else {
                "values": [layer.lo, layer.hi], "function": layer.baked().get("name", ""),
            }  # fmt: skip
            rows_of_layers.append({"layer": k, "name": layer.name, "gaussians": len(own), **look})
        return {"live_layers": rows_of_layers}
    if facts.labels:
        counts = np.bincount(gaussians.live[:, LABEL_ROW].astype(np.int64), minlength=len(facts.labels)).tolist()
        rows = zip(facts.labels, counts, strict=True)
        return {"live_labels": [{"label": e.number, "name": e.name, "gaussians": n} for e, n in rows]}
    summary: dict[str, object] = {"live_values": [facts.lo, facts.hi], "live_unit": facts.unit or "none"}
    for column, name in enumerate(COLUMNS[:3]):
        summary[f"live_{name}"] = [float(f"{q:.6g}") for q in np.percentile(gaussians.live[:, column], (0, 50, 100))]
    return summary | {"live_function": facts.baked().get("name", "")}


def describe(gaussians: Gaussians, header: PlyHeader) -> dict[str, object]:
    """Return the summary of a `.ply` for `vvgt info`: counts, frame, box, and percentiles of sizes and opacities."""
    summary: dict[str, object] = {
        "gaussians": len(gaussians),
        "bytes": header.size + header.count * header.dtype.itemsize,
        "bytes_per_gaussian": header.dtype.itemsize,
        "sh_degree": header.sh_degree,
        "frame": header.frame,
        "up": header.up,
        "space": header.space,
        **(axis_facts(np.reshape(header.affine, (3, 4)), header.space) if header.affine else {}),
        "unit_distance": header.unit_distance,
        "unit_distance_label": header.unit_distance_label,
        "version": header.version,
        **{key: value for key in ("length_unit", "function") if (value := getattr(header, key)) is not None},
        **({} if header.light is None else {"light": header.light.text()}),
        **({} if header.certificate is None else {"certificate": header.certificate.facts()}),
        **({} if header.live is None else live_summary(gaussians, header.live)),
    }
    if len(gaussians):
        sigma = np.exp(np.clip(gaussians.log_scales.astype(np.float64), -700, 700))
        for key, values in (("sigma", sigma), ("opacity", gaussians.opacity)):
            summary[key] = [float(f"{q:.6g}") for q in np.percentile(values, (0, 50, 100))]
        for key, values in (("box", gaussians.means), ("color", gaussians.colors)):
            summary |= {f"{key}_min": values.min(axis=0).tolist(), f"{key}_max": values.max(axis=0).tolist()}
        summary["harmonics_largest"] = float(np.abs(gaussians.arrays().get("harmonics", np.zeros(1))).max())
    return summary
