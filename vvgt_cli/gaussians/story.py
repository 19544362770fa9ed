"""Stories of pages: steps of a text with what is seen then (docs/page.md, "Stories"), shown by `page/story.mjs`."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.files import read_text
from vvgt_cli.look import MAX_LIGHT, LabelTable
from vvgt_cli.look.readers.minimal import read
from vvgt_cli.look.readers.names import names
from vvgt_cli.volume.components import expected

if TYPE_CHECKING:
    from vvgt_cli.gaussians.formats.page_values import PageLayer

MOST, LONG = 100, 2000  # steps; letters of a text, as in page/story.mjs
SIDES = ("front", "back", "left", "right", "top", "bottom", "fit", "reset")
LOOK = ("cut", "function", "labels", "layer", "light", "slices")  # what needs the volume's values
KEYS = ("text", "camera", *LOOK, "frame", "link")
Check: TypeAlias = Callable[[Any, str], None]
StoryLike: TypeAlias = "str | os.PathLike[str] | Mapping[str, Any]"


@dataclass(frozen=True)
class Story:
    """The steps of a story as its page has them, each complete.

    Attributes:
        what: name of the file, for errors.
        steps: ``text``, and those of `KEYS` that are not as the page begins.
    """

    what: str
    steps: tuple[dict[str, Any], ...]

    @property
    def size(self) -> int:
        """Bytes on a page."""
        return len(json.dumps(self.steps))

    def checked(self, layers: Sequence[PageLayer | None], frames: int | None = 1) -> Story:
        """Return the story for a page, with labels by number.

        Args:
            layers: the volume's, whose values the page holds; none: a page without values.
            frames: clouds of the page; None: unknown.

        Raises:
            DataError: a step shows what the page does not have.
        """
        steps = []
        for k, step in enumerate(self.steps, 1):
            where = f"{self.what}, step {k}"
            if frames is not None and step.get("frame", 0) >= frames:
                raise DataError(f"{where}: frame {step['frame']}; expected 0 to {frames - 1}, as the page has {frames}")
            used = [key for key in LOOK if key in step]
            whole = [layer for layer in layers if layer is not None]
            if used and (not layers or len(whole) < len(layers)):
                keys = ", ".join(key for key in KEYS if key not in LOOK)
                raise DataError(f"{where}: {used[0]!r} needs a page with values of one volume; expected {keys}")
            steps.append(_resolved(step, whole, where) if used else step)
        return replace(self, steps=tuple(steps))


def read_story(given: StoryLike) -> Story:
    """Return the story of a ``story.json`` or of its content: a step keeps what the one before it states.

    Raises:
        DataError: no file, no JSON, or not in the form of docs/page.md.
    """
    what, parsed = "story", given
    if not isinstance(given, Mapping):
        what = os.fspath(given)
        try:
            parsed = json.loads(read_text(what))
        except OSError as error:
            raise DataError(f"{what}: {error.strerror}; expected a story.json, as a page saves it") from None
        except ValueError as error:
            raise DataError(f'{what}: not JSON ({error}); expected {{"steps": [{{"text": ...}}, ...]}}') from None
    steps = _known(parsed, ("steps",), what).get("steps")
    if not isinstance(steps, list | tuple) or not 0 < len(steps) <= MOST:
        raise DataError(f"{what}: expected 'steps', a list of 1 to {MOST} steps")
    now: dict[str, Any] = {}
    told = []
    for k, step in enumerate(steps, 1):
        _check(step, f"{what}, step {k}")
        fresh = len(step) > 1 and ("link" in step or "link" in now)
        now = {key: value for key, value in (({} if fresh else now) | step).items() if value is not None}
        told.append(now)
    return Story(what, tuple(told))


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _known(value: Any, keys: Collection[str], where: str) -> Mapping[str, Any]:
    """Return an object that has some of the keys and no others."""
    if not isinstance(value, Mapping):
        raise DataError(f"{where}: got {_short(value)}; expected an object with {', '.join(keys)}")
    if unknown := [key for key in value if key not in keys]:
        raise DataError(f"{where}: unknown key {unknown[0]!r}; expected {', '.join(keys)}")
    return value


def _check(step: Any, where: str) -> None:
    """Check the form of a step."""
    text = _known(step, KEYS, where).get("text")
    if not isinstance(text, str) or not text.strip():
        raise DataError(f"{where}: {'no text' if text is None else f'text {_short(text)}'}; expected words to read")
    if len(text) > LONG:
        raise DataError(f"{where}: a text of {len(text)} letters; expected at most {LONG}: try two steps")
    if "link" in step and len(step) > 2:
        other = next(key for key in step if key not in ("text", "link"))
        raise DataError(f"{where}: link and {other}; expected a link, which states all that is seen, or the others")
    for key, check in CHECKS.items():
        if step.get(key) is not None:
            check(step[key], f"{where}: {key}")


def _number(lo: float = -math.inf, hi: float = math.inf, why: str = "") -> Check:
    """Return a check of a finite number within limits."""

    def check(value: Any, where: str) -> None:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise DataError(f"{where}: got {_short(value)}; expected a finite number")
        if not lo <= value <= hi:
            limits = f"{lo:g} to {hi:g}" if hi < math.inf else f"{lo:g} or more"
            raise DataError(f"{where}: {value:g}{why}; expected {limits}")

    return check


def _numbers(count: int, one: Check | None = None, nonzero: bool = False) -> Check:
    """Return a check of a list of numbers."""

    def check(value: Any, where: str) -> None:
        if not isinstance(value, list | tuple) or len(value) != count:
            raise DataError(f"{where}: got {_short(value)}; expected {count} numbers")
        for number in value:
            (one or _number())(number, where)
        if nonzero and not any(value):
            raise DataError(f"{where}: is 0; expected a direction of the world")

    return check


def _is(right: Callable[[Any], bool], expected: str) -> Check:
    """Return a check of a condition."""

    def check(value: Any, where: str) -> None:
        if not right(value):
            raise DataError(f"{where}: got {_short(value)}; expected {expected}")

    return check


def fields(**checks: Check) -> Check:
    """Return a check of an object."""

    def check(value: Any, where: str) -> None:
        for key, one in _known(value, checks, where).items():
            checks[key](one, f"{where}.{key}")

    return check


def _among(*known: str) -> Check:
    return _is(lambda value: value in known, f"one of {', '.join(known)}")


WHOLE = _is(lambda x: isinstance(x, int) and not isinstance(x, bool) and x >= 0, "a whole number from 0")
FLAG = _is(lambda value: isinstance(value, bool), "true or false")
SHARE, WITHIN, LIGHT = _number(0, 1), _number(0, 1, ", outside the volume"), _number(0, MAX_LIGHT)
DIRECTION = _numbers(3, nonzero=True)
CAMERA = fields(
    target=_numbers(3), pitch=_number(-90, 90), yaw=_number(), distance=_number(1e-6), orthographic=FLAG
)  # fmt: skip
CUT = fields(
    kind=_among("none", "plane", "box"), normal=DIRECTION, at=WITHIN, flipped=FLAG, box=_numbers(6, WITHIN)
)  # fmt: skip
LABEL = fields(
    name=_is(lambda x: isinstance(x, str), "a text"), number=WHOLE, opacity=SHARE, color=_numbers(3, SHARE)
)  # fmt: skip
OF_LIGHT = {
    "kind": _among("none", "headlight", "direction"), "from": DIRECTION, "ambient": LIGHT, "diffuse": LIGHT,
    "specular": LIGHT,
}  # fmt: skip
SLICES = fields(at=_numbers(3), window=_number(1e-30), level=_number(), on_cut=FLAG)


def _camera(value: Any, where: str) -> None:
    (_among(*SIDES) if isinstance(value, str) else CAMERA)(value, where)


def _cut(value: Any, where: str) -> None:
    CUT(value, where)
    needed = {"plane": "normal", "box": "box"}.get(value.get("kind"), "kind")
    if needed not in value:
        raise DataError(f"{where}: no {needed}; expected kind none, plane with normal and at, or box with box")
    box = value.get("box", ())
    if any(box[k] >= box[k + 1] for k in range(0, len(box), 2)):
        raise DataError(f"{where}.box: {_short(box)}; expected from and to of each axis, from below to")


def _function(value: Any, where: str) -> None:
    if isinstance(value, str):
        return
    points = _known(value, ("name", "points", "opacity_unit_distance"), where).get("points")
    _is(lambda x: isinstance(x, list) and len(x) > 1, "a name, or points as in the tf.json of a page")(points, where)
    for point in points or ():
        _is(lambda x: isinstance(x, dict) and set(x) == {"x", "opacity", "rgb"}, "x, opacity and rgb")(point, where)
        _number()(point["x"], f"{where}: x")
    read(dict(value), where)


def _labels(value: Any, where: str) -> None:
    _is(lambda x: isinstance(x, list) and len(x) > 0, "a list of labels, by name or number")(value, where)
    for one in value:
        LABEL(one, where)
        if ("name" in one) == ("number" in one):
            raise DataError(f"{where}: {_short(one)}; expected a name or a number, and opacity (0 hides) or color")


CHECKS: dict[str, Check] = {
    "camera": _camera, "cut": _cut, "function": _function, "labels": _labels, "layer": WHOLE, "frame": WHOLE,
    "light": fields(**OF_LIGHT),
    "slices": lambda value, where: None if value is True else SLICES(value, where),
    "link": _is(lambda x: isinstance(x, str) and "view=" in x, "what follows # in a link that a page copies"),
}  # fmt: skip


def _resolved(step: dict[str, Any], layers: Sequence[PageLayer], where: str) -> dict[str, Any]:
    """Return a step with labels by number; raise DataError for what the layers do not have."""
    number = step.get("layer", 0)
    if number >= len(layers):
        raise DataError(f"{where}: layer {number}; expected 0 to {len(layers) - 1}")
    look, function = layers[number].look, step.get("function")
    if function is not None and isinstance(look, LabelTable):
        raise DataError(f"{where}: function; layer {number} has labels: expected labels")
    if isinstance(function, str) and function not in (known := dict.fromkeys([*names(), look.name])):
        raise DataError(f"{where}: function {function!r}; {expected(function, known)}")
    distance = function.get("opacity_unit_distance") if isinstance(function, Mapping) else None
    if distance is not None and not math.isclose(distance, layers[number].distance, rel_tol=1e-3):
        own = layers[number].distance
        raise DataError(f"{where}: opacity per {distance:g}; expected per {own:g}, as in the tf.json of this page")
    if "labels" in step:
        if not isinstance(look, LabelTable):
            raise DataError(f"{where}: labels; layer {number} has a function: expected function")
        step = step | {"labels": [_numbered(one, look, where) for one in step["labels"]]}
    at = step["slices"].get("at") if isinstance(step.get("slices"), Mapping) else None
    if at is not None:
        box = layers[0].volume
        index = np.linalg.solve(box.affine[:3, :3], np.array(at) - box.affine[:3, 3])
        if (index < -0.5).any() or (index > np.array(box.dims) - 0.5).any():
            raise DataError(f"{where}: slices.at {at}: outside the volume; expected a place as a click shows it")
    return step


def _numbered(one: Mapping[str, Any], table: LabelTable, where: str) -> dict[str, Any]:
    """Return a label's entry by its number."""
    key = "name" if "name" in one else "number"
    numbers = [label.number for label in table.structures if getattr(label, key) == one[key]]
    if not numbers:
        known = [str(getattr(label, key)) for label in table.structures]
        raise DataError(f"{where}: no label {one[key]!r}; {expected(str(one[key]), known)}")
    return {"number": numbers[0]} | {part: one[part] for part in ("opacity", "color") if part in one}
