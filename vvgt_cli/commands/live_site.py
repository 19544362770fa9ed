"""Requests of the page of a volume: the page itself, its values, files to save, conversions for a look."""

from __future__ import annotations

import base64
import io
import json
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.commands.converter import ConsoleLine, Converted, Converter, Failed, Job, Message, Progress, Scored
from vvgt_cli.commands.server import Resource
from vvgt_cli.conversion.gaussian_files import layout_of, open_gaussians
from vvgt_cli.errors import DataError, VvgtError
from vvgt_cli.gaussians import Gaussians, PlyOptions, as_ply
from vvgt_cli.gaussians.formats import SUFFIXES, encoded, format_of
from vvgt_cli.gaussians.formats.page_file import page, upright, waiting_page
from vvgt_cli.gaussians.formats.page_look import look_entry, parse_light
from vvgt_cli.gaussians.formats.page_values import Values
from vvgt_cli.gaussians.formats.splats import columns_of
from vvgt_cli.gaussians.live_facts import MAX_LABELS, LiveFacts, function_text
from vvgt_cli.look import Label, LabelTable, Lighting, LightOptions, TransferFunction, check_labels
from vvgt_cli.look.label_files import table_of
from vvgt_cli.look.readers.minimal import read
from vvgt_cli.progress import Console
from vvgt_cli.volume.readers import volume_name

JSON, BYTES, HTML = "application/json", "application/octet-stream", "text/html; charset=utf-8"
VALUES = "values.json"
SCRIPT = '<script src="viewer.js"></script>'
NODES = 4096  # of a function that a page sends


def stored(gaussians: Gaussians, options: PlyOptions) -> bytes:
    """Return a `.ply` as the page's viewer reads it."""
    return as_ply(replace(gaussians, live=None), replace(upright(options), live=None))


def cloud_of(ply: bytes) -> tuple[Gaussians, PlyOptions]:
    """Return the Gaussians of a `.ply`, unit frame, and how they are written."""
    gaussians, header = open_gaussians(io.BytesIO(ply))
    return gaussians, layout_of(header)


def look_of(known: LiveFacts, sent: Mapping[str, Any]) -> LiveFacts:
    """Return the look of a volume under what a page sends, a function or labels; its own without them.

    Raises:
        DataError, UsageError: a look that is not valid, or of another volume.
    """
    if sent.get("labels") is not None:
        return replace(known, labels=parse_labels(sent["labels"], known.labels).labels)
    if sent.get("function") is None:
        return known
    if known.labels:
        raise DataError("the volume holds labels; expected labels, not a function")
    tf = parse_function(sent["function"])
    return replace(known, function=function_text(tf, known.lo, known.hi), distance=tf.opacity_unit_distance)


def parse_labels(sent: Any, known: Sequence[Label]) -> LabelTable:
    """Return the labels of a cloud as a page sends them: a list of number, color (RGB in [0, 1]) and opacity.

    Raise DataError for another list, or labels of another cloud.
    """
    what = "the page's labels"
    if not isinstance(sent, list) or not 0 < len(sent) <= MAX_LABELS or not all(isinstance(e, dict) for e in sent):
        raise DataError(f"{what}: expected a list of at most {MAX_LABELS} objects")
    looks = {label.number: label for label in table_of({str(one.get("number")): one for one in sent}, what).labels}
    if sorted(looks) != sorted(label.number for label in known):
        raise DataError(f"{what} differ from the cloud's; expected all of these")
    return LabelTable(what, tuple(replace(looks[label.number], name=label.name) for label in known))


def parse_function(sent: Any) -> TransferFunction:
    """Return the function of a page; raise DataError without one, or without an opacity unit distance."""
    what = "the page's function"
    if not isinstance(sent, dict) or not isinstance(sent.get("points"), list) or len(sent["points"]) > NODES:
        raise DataError(f"{what}: expected an object with a list of at most {NODES} points")
    if unknown := sorted(set(sent) - {"name", "points", "opacity_unit_distance"}):
        raise DataError(f"{what}: {unknown[0]!r}; expected name, points and opacity_unit_distance")
    tf = read(sent, what)
    if tf.opacity_unit_distance is None:
        raise DataError(f"{what}: no opacity_unit_distance; expected the length that its opacity is per")
    return tf


def page_files(gaussians: Gaussians, options: PlyOptions, title: str, values: Values | None) -> dict[str, bytes]:
    """Return the text of a page, named "", and the files that it loads; raise DataError if a library is missing.

    With the ``values`` of a volume its look can be changed, and one of a single layer is converted for it.
    """
    file, name = stored(gaussians, options), "0.ply"
    splats, files, more = columns_of(file, title), {name: file}, dict[str, Any]()
    if values is not None and values.look is not None:
        look = look_entry(values, options)
        contents = {key: base64.b64encode(content).decode("ascii") for key, content in values.elements.items()}
        files[VALUES] = json.dumps({"facts": values.facts, "contents": contents}).encode()
        more = {
            "values": {"from": VALUES}, "look": look,
            "server": {"converts": not values.look.others, "name": title},
            "outermost": [[x, y, z] for x, y, z in corners(look)],
        }  # fmt: skip
    text = page(title, splats, [{"name": title, "file": name}], SCRIPT, more)
    return {"": text.encode("utf-8")} | files


def corners(look: Mapping[str, Any]) -> list[list[float]]:
    """Return the corners of the volume's box in the viewer's axes."""
    ends = np.array(list(product(*np.transpose(look["box"]))))
    return (ends @ np.array(look["axes"])).round(3).tolist()


class PageController:
    """State of the page, and answers to its requests: progress and conversions.

    Args:
        resources, posts: of the site; filled in here.
        name: of what is shown, without ending.
        console: for messages.
    """

    def __init__(
        self, resources: dict[str, Resource], posts: dict[str, Callable[[Any], Resource]], name: str, console: Console
    ) -> None:  # fmt: skip
        """Create the state of a page without Gaussians."""
        self.resources, self.posts, self.name, self.console = resources, posts, name, console
        self.error: VvgtError | None = None
        self.first: Callable[[], PlyOptions] | None = None  # how the first page's Gaussians are written
        self.values: Values | None = None
        self.better: bytes | None = None
        self.converter: Converter | None = None
        self.ready = threading.Event()  # the volume has been read, or cannot be
        self.shown = threading.Event()  # the first page, or an error
        self.waited_for = False  # by a page, for the first one
        self.state: dict[str, Any] = {"number": 0, "state": "first", "said": "starting"}

    def await_volume(self, converter: Converter) -> None:
        """Start to read a volume; pages opened meanwhile wait for it."""
        self.converter = converter
        text = waiting_page(self.name, SCRIPT).encode("utf-8")
        self.resources[""] = Resource(HTML, lambda: text)
        self.resources["state"] = Resource(JSON, self._state_json)
        with converter.lock:
            converter.submit(None)

    def show(self, gaussians: Gaussians, options: PlyOptions) -> None:
        """Show the Gaussians of a file under their own look."""
        if gaussians.live is not None:
            self.console.message("shown under the file's own look; 'vvgt recolor' shows it under others")
        self._show(page_files(gaussians, options, self.name, None))

    def _show(self, files: dict[str, bytes], values: Values | None = None) -> None:
        self.values = values
        if values is not None and self.converter is not None:
            self.posts |= {"save": self.save, "function": self.function}
        for name, content in files.items():
            kind = JSON if name == VALUES else BYTES if name else HTML
            self.resources[name] = _resource(content, kind)
        self.shown.set()

    def _state_json(self) -> bytes:
        self.waited_for = self.waited_for or not self.shown.is_set()
        return json.dumps(self.state).encode()

    def function(self, sent: Any) -> Resource:
        """Convert the volume for a function or labels, and a light, that the page sends; None ends the conversion.

        Raises:
            DataError, UsageError: neither a function nor labels, or a light that is not valid.
        """
        assert self.converter is not None
        job: Job = None
        if sent is not None:
            light, asked = self._light(sent)
            known = self._look()
            look: TransferFunction | LabelTable | None = None
            if "labels" in asked:
                look = parse_labels(asked["labels"], known.labels)
                check_labels([look])
            elif not known.others:
                look = parse_function(asked)
            job = look, None if light is None else LightOptions.of(light[0])
        with self.converter.lock:
            self.resources.pop(f"{self.state['number']}.ply", None)
            self.better = None
            if job is None:
                self.converter.cancel()
                self.state = {"number": -1, "state": "none", "said": ""}
            else:
                number = self.converter.submit(job)
                self.state = {"number": number, "state": "working", "said": "beginning"}
            answer = json.dumps({"number": self.state["number"]}).encode()
        return Resource(JSON, lambda: answer)

    def save(self, sent: Any) -> Resource:
        """Return a conversion by its number as a file, a page with the values of the volume and the look that is sent.

        Raises:
            DataError: an invalid request, or a conversion that was replaced.
        """
        keys = {"file", "number", "function", "labels", "layers", "light"}
        if not isinstance(sent, dict) or sent.get("file") not in ("ply", "html") or not set(sent) <= keys:
            raise DataError("save: expected file (ply or html), number, and optionally function, labels or layers")
        better, number = self.better, sent.get("number")
        if number is None:
            raise DataError("not converted under this look yet; try again when it is")
        if better is None or number != self.state["number"]:
            raise DataError("that conversion was replaced by another; try again")
        known, name = format_of(f"x.{sent['file']}"), f"{self.name}.{sent['file']}"
        if known is None:
            return _resource(better, BYTES)
        values = self.values and self.values._replace(look=look_of(self._look(), sent))
        return _resource(encoded(known, *cloud_of(better), name, values), BYTES)

    def _look(self) -> LiveFacts:
        """Return the look that the page began with."""
        assert self.values is not None
        assert self.values.look is not None
        return self.values.look

    def _light(self, sent: Any) -> tuple[tuple[Lighting | None] | None, dict[str, Any]]:
        """Return the light that a page sends, in a tuple, or None, and what else it sends."""
        asked = dict(sent) if isinstance(sent, dict) else {}
        light = asked.pop("light", None)
        assert self.first is not None
        return (None if light is None else (parse_light(light, self.first()),)), asked

    def on_message(self, number: int, message: Message) -> None:
        """Handle a message of the converter, on its thread."""
        first = not self.shown.is_set()
        if isinstance(message, ConsoleLine):
            if first:
                self.console.message(message.line)
                self.ready.set()
        elif isinstance(message, Progress):
            if self.state["state"] in ("first", "working"):
                self.state = {**self.state, "said": message.text}
        elif isinstance(message, Failed):
            self._failed(number, message.error)
        elif isinstance(message, Scored):
            self._scored(message)
        elif first:
            self._first(message)
        else:
            self._better(number, message)

    def _first(self, made: Converted) -> None:
        self.first = cache(lambda: cloud_of(made.ply)[1])
        self._show(made.files, made.values)
        self.state = {"number": 0, "state": "none", "said": ""}

    def _better(self, number: int, made: Converted) -> None:
        self.better = made.ply
        self.resources[f"{number}.ply"] = _resource(made.files["ply"], BYTES)
        self.state = {"number": number, "state": "done", "said": "converted", "file": f"{number}.ply", "scored": False}
        self.console.message("converted for the page's function and light")

    def _failed(self, number: int, error: VvgtError) -> None:
        if self.state["state"] in ("first", "working"):
            if not self.shown.is_set():
                self.error = error
            self.state = {"number": number, "state": "failed", "said": str(error)}
            self.shown.set()
            self.ready.set()
            return
        if self.state["state"] == "done":
            self.state = {**self.state, "said": f"converted, not scored: {error}", "scored": True}
        self.console.message(f"not scored: {error}")

    def _scored(self, scored: Scored) -> None:
        if self.better is not None:
            self.better = scored.ply
            self.state = {**self.state, "said": f"converted, {scored.psnr:.1f} dB", "scored": True}
        self.console.message(f"{scored.psnr:.1f} dB on the test views")


def _resource(content: bytes, kind: str) -> Resource:
    return Resource(kind, lambda: content)


def plain_name(path: str) -> str:
    """Return a file's name to save under: letters, digits, dot, underscore, blank and dash."""
    known = max((suffix for suffix in SUFFIXES if path.lower().endswith(suffix)), key=len, default="")
    name = volume_name(Path(path.removeprefix("example:")[: len(path) - len(known)]))
    plain = re.sub(r"[^0-9A-Za-z._ -]+", "-", name).strip("-. ")
    return plain or "volume"
