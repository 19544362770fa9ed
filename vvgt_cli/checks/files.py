"""Cases of the `.ply`: every layout there and back to the bit, extremes, files that lie."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from vvgt_cli.checks import Case, Figure, require
from vvgt_cli.checks.clouds import FIELDS, cloud, extremes
from vvgt_cli.errors import DataError
from vvgt_cli.gaussians import Gaussians, PlyOptions, as_stored, read_ply, write_ply
from vvgt_cli.gaussians.ply import in_unit_frame
from vvgt_cli.splat.reference import covariances
from vvgt_cli.volume.types import UnitFrame

STAGE = ".ply"
FRAME = UnitFrame(0.013, (1.0, 0.8, 0.5), (0.01, 0.01, 0.02), (-120.0, 35.5, 1e4))


def _written(gaussians: Gaussians, options: PlyOptions | None = None) -> bytes:
    stream = io.BytesIO()
    count = write_ply(stream, gaussians, options)
    require(count == len(stream.getvalue()), f"{count} bytes reported, {len(stream.getvalue())} written")
    return stream.getvalue()


def _bitwise(gaussians: Gaussians, options: PlyOptions) -> Figure:
    """Written, read, written: the same Gaussians and the same bytes."""
    content = _written(gaussians, options)
    back, header = read_ply(io.BytesIO(content))
    require(header.sh_degree == (options.sh_degree or 0), f"harmonics of degree {header.sh_degree}")
    require(_written(back, options) == content, "a second trip changes the bytes")
    stored = as_stored(gaussians)
    differ = sum(getattr(back, f).tobytes() != getattr(stored, f).tobytes() for f in FIELDS)
    return Figure("fields that differ", differ, 0)


def _many(count: int) -> Figure:
    return _bitwise(cloud(count), PlyOptions())


def _placed(frame: str, up: str) -> Figure:
    """Placed elsewhere and turned, and back: means and covariances as they were."""
    gaussians = cloud(200, 3)
    options = PlyOptions(frame=frame, up=up, scale=FRAME.scale, centre=FRAME.centre)
    back = in_unit_frame(*read_ply(io.BytesIO(_written(gaussians, options))))
    centres = np.abs(back.means - gaussians.means).max()
    shapes = np.abs(covariances(back) - covariances(gaussians)).max() / np.abs(covariances(gaussians)).max()
    return Figure("off, largest", float(max(centres, shapes)), 2e-4 if frame == "world" else 1e-6)


def one_line(make: Callable[[], object]) -> Figure:
    """A `DataError` of one line is what ``make`` should end with."""
    try:
        make()
    except DataError as error:
        require("\n" not in str(error), "an error of several lines")
        return Figure("accepted", 0, 0)
    return Figure("accepted", 1, 0)


def _patched(old: bytes, new: bytes) -> Callable[[], object]:
    content = _written(cloud(10))
    return lambda: read_ply(io.BytesIO(content.replace(old, new, 1)))


def _with_row(value: float) -> Callable[[], object]:
    content = bytearray(_written(cloud(10)))
    content[-4 * 17 : -4 * 16] = np.array([value], "<f4").tobytes()
    return lambda: read_ply(io.BytesIO(bytes(content)))


def cases() -> Iterator[Case]:
    """All of them."""
    for degree in range(4):
        yield Case(STAGE, f"padded to degree {degree}", partial(_bitwise, cloud(100), PlyOptions(sh_degree=degree)))
    for count in (1, 10, 1_000_000):
        yield Case(STAGE, f"K = {count:,}", partial(_many, count))
    yield Case(STAGE, "extreme Gaussians", partial(_bitwise, extremes(), PlyOptions(comments=False)))
    for up in ("none", "x", "-y", "z"):
        for frame in ("unit", "world"):
            yield Case(STAGE, f"frame {frame}, up {up}", partial(_placed, frame, up))
    refused = {
        "K = 0": lambda: write_ply(io.BytesIO(), cloud(0)),
        "cut short": lambda: read_ply(io.BytesIO(_written(cloud(10))[:-1])),
        "a byte too many": lambda: read_ply(io.BytesIO(_written(cloud(10)) + b"\0")),
        "big-endian": _patched(b"binary_little_endian", b"binary_big_endian"),
        "ASCII": _patched(b"binary_little_endian", b"ascii"),
        "a count of 1e18": _patched(b"vertex 10\n", b"vertex 1000000000000000000\n"),
        "no rotation": _patched(b"float rot_3", b"float rot_x"),
        "a NaN": _with_row(np.nan),
        "an infinity": _with_row(-np.inf),
        "not a .ply": lambda: read_ply(io.BytesIO(b"\x89PNG\r\n")),
    }
    for name, make in refused.items():
        yield Case(STAGE, f"refused: {name}", partial(one_line, make))
