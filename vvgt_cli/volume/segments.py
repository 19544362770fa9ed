"""`Segment`: what a volume's file says of one of its labels; readers put them into `Volume.segments`."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from xml.etree.ElementTree import ParseError, fromstring

from vvgt_cli.errors import DataError

MAX_NUMBER = 2**31  # of a label
DAMAGED = (DataError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, struct.error, ParseError)


@dataclass(frozen=True)
class Segment:
    """A label as a file describes it.

    Attributes:
        number: its voxels' value.
        name: its name; "" where the file says none.
        color: RGB in [0, 1]; None where the file says none.
        terms: (scheme, value, meaning) of category, type, type modifier, region and region modifier, "" where it says
            none.
        opacity: in [0, 1]; None where the file says none.
    """

    number: int
    name: str = ""
    color: tuple[float, float, float] | None = None
    terms: tuple[tuple[str, str, str], ...] = ()
    opacity: float | None = None


def segments_in(read: Callable[[], Iterable[Segment]], source: str) -> tuple[Segment, ...]:
    """Return the segments that ``read`` finds in a header, ascending by number.

    A table that is damaged, or gives one number two names, hides no volume: warn, and return no segments.
    """
    segments: dict[int, Segment] = {}
    try:
        for one in sorted(read(), key=lambda one: one.number):
            values = (*(one.color or ()), 1.0 if one.opacity is None else one.opacity)
            if abs(one.number) > MAX_NUMBER or not all(0 <= value <= 1 for value in values):
                raise ValueError(f"label {one.number}, colour and opacity {values}")
            if segments.setdefault(one.number, one).name != one.name:
                raise ValueError(f"label {one.number} is {segments[one.number].name[:40]!r} and {one.name[:40]!r}")
    except DAMAGED as error:
        text = " ".join(str(error).split())[:200] or type(error).__name__
        warnings.warn(f"{source}: its own table of labels is damaged and not used ({text})", stacklevel=2)
        return ()
    return tuple(segments.values())


def segments_of_xml(text: bytes) -> list[Segment]:
    """Return the segments of Caret's XML, ``<Label Key Red Green Blue Alpha>name</Label>`` with colours in [0, 1].

    Workbench and TotalSegmentator write it into extensions of NIfTI. Raise ValueError or ParseError for other texts.
    """
    segments = []
    for one in fromstring(text).iter("Label"):
        number = int(one.get("Key", ""))
        red, green, blue, alpha = (float(one.get(key, "1")) for key in ("Red", "Green", "Blue", "Alpha"))
        color = (red, green, blue)
        segments.append(Segment(number, (one.text or "").strip(), color, opacity=alpha if number else 0.0))
    return segments
