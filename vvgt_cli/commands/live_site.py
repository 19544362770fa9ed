"""Requests of the page of live Gaussians: the page itself, files to save, conversions for a function."""

from __future__ import annotations

import base64
import io
import json
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from vvgt_cli.cameras.sets import SIZE, pixel_width
from vvgt_cli.commands.converter import ConsoleLine, Converted, Converter, Failed, Job, Message, Progress, Scored
from vvgt_cli.commands.server import Resource
from vvgt_cli.conversion.gaussian_files import layout_of, open_gaussians
from vvgt_cli.errors import DataError, VvgtError
from vvgt_cli.gaussians import Gaussians, PlyOptions, as_ply, as_stored
from vvgt_cli.gaussians.formats import SUFFIXES, encoded, format_of
from vvgt_cli.gaussians.formats.gsply_files import compressed_ply
from vvgt_cli.gaussians.formats.page_file import page, upright, waiting_page
from vvgt_cli.gaussians.formats.page_live import Extras, live_page_data, parse_light
from vvgt_cli.gaussians.formats.page_slices import Slices
from vvgt_cli.gaussians.formats.splats import columns_of
from vvgt_cli.gaussians.live import LayerTables, Looks, Palette, Table, baked
from vvgt_cli.gaussians.live_facts import MAX_LABELS, LiveFacts, function_text
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.label_files import table_of
from vvgt_cli.look.labels import Label, LabelTable, check_labels
from vvgt_cli.look.lighting import LightOptions
from vvgt_cli.look.readers.minimal import read
from vvgt_cli.progress import Console
from vvgt_cli.volume.readers import volume_name

JSON, BYTES, HTML = "application/json", "application/octet-stream", "text/html; charset=utf-8"
SLICES = "slices.json"
SCRIPT = '<script src="viewer.js"></script>'
NODES = 4096  # of a function that a page sends


def stored(gaussians: Gaussians, options: PlyOptions) -> bytes:
    """Return a `.ply` as the page's viewer reads it."""
    return as_ply(replace(gaussians, live=None), replace(upright(options), live=None))


@dataclass(frozen=True)
class ServedCloud:
    """Gaussians that a page shows.

    Attributes:
        gaussians: in the unit frame.
        options: how they are written.
        name: of files to save, without ending.
        ply: bytes of the file that they were read from; None if they have changed since.
    """

    gaussians: Gaussians
    options: PlyOptions
    name: str
    ply: bytes | None = None

    @classmethod
    def of(cls, ply: bytes, name: str) -> ServedCloud:
        """Read a `.ply`."""
        gaussians, header = open_gaussians(io.BytesIO(ply))
        return cls(gaussians, layout_of(header), name, ply)

    @property
    def live(self) -> bool:
        """Return whether they can be shown under any function."""
        return self.gaussians.live is not None and self.options.live is not None

    def file(self, suffix: str, live: ServedCloud | None = None, slices: Slices | None = None) -> Resource:
        """Return the file to save, in the format of an ending; ``live`` is the form for the editor of a page."""
        extras = Extras(None if live is None or not live.live else (live.gaussians, live.options), slices)
        if (other := format_of(f"x.{suffix}")) is not None:
            name = f"{self.name}.{suffix}"
            return Resource(BYTES, lambda: encoded(other, self.gaussians, self.options, name, extras))
        if self.ply is not None:
            return Resource(BYTES, lambda: self.ply or b"")
        return Resource(BYTES, lambda: as_ply(self.gaussians, self.options))

    def with_looks(self, sent: Any, light: Any = None) -> ServedCloud:
        """Return the cloud under other looks of its layers and a light (None: the file's).

        ``sent`` lists, for each layer, an object with a function or with labels, as `parse_function` and `parse_labels`
        have them.

        Raises:
            DataError, UsageError: looks or a light that are not valid, or looks of other layers.
        """
        layers = () if self.options.live is None else self.options.live.layers
        if not isinstance(sent, list) or len(sent) != len(layers) or not all(isinstance(one, dict) for one in sent):
            raise DataError(f"the page's layers: expected a list of {len(layers)} looks, each a function or labels")
        looks = [self._look(layer, one, len(layers)) for layer, one in zip(layers, sent, strict=True)]
        facts = [one for _, one in looks]
        if all(one.labels for one in facts):
            check_labels([LabelTable("the page's labels", one.labels) for one in facts])
        live, tables = replace(facts[0], others=tuple(facts[1:])), [table for table, _ in looks]
        options = replace(self.options, live=live)
        if live.function or live.others:
            options = replace(options, unit_distance=live.distance, unit_distance_label="file")
        if live.function and not live.others:
            options = replace(options, function=live.baked().get("name"))
        return self._shown(LayerTables(tuple(tables)) if live.others else tables[0], light, options)

    def _look(self, layer: LiveFacts, sent: dict[str, Any], layer_count: int) -> tuple[Table | Palette, LiveFacts]:
        """Return a layer's table and facts under a look that a page sends."""
        scale = self.options.scale or 1.0
        if "labels" in sent:
            labels, distance = parse_labels(sent["labels"], layer.labels).labels, layer.distance
            distance = distance or self.options.unit_distance or 1.0
            return Palette.of_labels(labels, distance * scale), replace(layer, labels=labels, distance=distance)
        if layer.labels:
            raise DataError("the cloud carries labels; expected labels, not a function")
        tf = parse_function(sent.get("function"))
        assert tf.opacity_unit_distance is not None
        table = Table.of_function(tf, layer.lo, layer.hi, tf.opacity_unit_distance * scale, layer.grain)
        text = function_text(tf, layer.lo, layer.hi, layer_count)
        return table, replace(layer, function=text, distance=tf.opacity_unit_distance)

    def _shown(self, table: Looks, light: Any, options: PlyOptions) -> ServedCloud:
        """Return the cloud baked under looks and a light: the page's, or else the file's."""
        from vvgt_cli.conversion.live import apply_light

        lighting = self.options.light if light is None else parse_light(light, self.options)
        pixel = pixel_width(self.options.screen_size or SIZE)
        found = as_stored(apply_light(baked(self.gaussians, table, pixel), lighting))
        options = replace(options, light=lighting, sh_degree=None, certificate=None)
        return replace(self, gaussians=found, options=options, ply=None)


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


def page_files(cloud: ServedCloud, converts: bool, sliced: bool = False) -> dict[str, bytes]:
    """Return the text of a page, named "", and the file that it loads; raise DataError if a library is missing.

    It ``converts`` a volume for functions if that has a single layer, and shows its slices if it is ``sliced``.
    """
    if not cloud.live:
        file, name = stored(cloud.gaussians, cloud.options), "0.ply"
        splats, elements, more = columns_of(file, cloud.name), SCRIPT, {}
    else:
        [splats], [planes], facts = live_page_data([(cloud.gaussians, cloud.options)])
        file, name = compressed_ply(splats, cloud.name), "0.compressed.ply"
        encoded_planes = base64.b64encode(planes).decode("ascii")
        elements = f'<script type="{BYTES}" id="{facts["elements"][0]}">{encoded_planes}</script>\n{SCRIPT}'
        more = {"live": facts, "server": {"converts": converts and len(facts["layers"]) == 1, "name": cloud.name}}
    if sliced:
        more["slices"] = {"from": SLICES}
    text = page(cloud.name, splats, [{"name": cloud.name, "file": name}], elements, more)
    return {"": text.encode("utf-8"), name: file}


class PageController:
    """State of the page, and answers to its requests: progress, the live form, better conversions.

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
        self.first: Callable[[], ServedCloud] | None = None
        self.read_slices: Callable[[], Slices | None] = lambda: None
        self._reading = threading.Lock()
        self.better: bytes | None = None
        self.converter: Converter | None = None
        self.ready = threading.Event()  # the volume has been read, or cannot be
        self.shown = threading.Event()  # the first page, or an error
        self.waited_for = False  # by a page, for the first one
        self.state: dict[str, Any] = {"number": 0, "state": "first", "said": "starting"}

    def await_volume(self, converter: Converter, slices: Callable[[], Slices | None]) -> None:
        """Start the live form of a volume; pages opened meanwhile wait for it. Its slices are read when asked for."""
        self.converter, self.read_slices = converter, cache(slices)
        self.resources[SLICES] = Resource(JSON, self._slices_json)
        text = waiting_page(self.name, SCRIPT).encode("utf-8")
        self.resources[""] = Resource(HTML, lambda: text)
        self.resources["state"] = Resource(JSON, self._state_json)
        with converter.lock:
            converter.submit(None)

    def show(self, cloud: ServedCloud) -> None:
        """Show the Gaussians of a file, live if possible."""
        self.first = lambda: cloud
        try:
            files = page_files(cloud, converts=False)
        except DataError as error:
            self.console.message(f"{error}; shown under the file's own function")
            files = page_files(replace(cloud, gaussians=replace(cloud.gaussians, live=None)), converts=False)
        self._show(files, cloud.live)

    def _show(self, files: dict[str, bytes], live: bool) -> None:
        if live:
            self.posts["save"] = self.save
        if live and self.converter is not None:
            self.posts["function"] = self.function
        for name, content in files.items():
            self.resources[name] = _resource(content, BYTES if name else HTML)
        self.shown.set()

    def _state_json(self) -> bytes:
        self.waited_for = self.waited_for or not self.shown.is_set()
        return json.dumps(self.state).encode()

    def slices(self) -> Slices | None:
        """Return the slices of the volume, read by one request at a time; None without a volume or for colours."""
        with self._reading:
            return self.read_slices()

    def _slices_json(self) -> bytes:
        found = self.slices()
        if found is None:
            raise DataError("slices: the volume has colours; expected values or labels")
        contents = {key: base64.b64encode(content).decode("ascii") for key, content in found.elements.items()}
        return json.dumps({"facts": found.facts, "contents": contents}).encode()

    def function(self, sent: Any) -> Resource:
        """Convert the volume for a function or labels, and a light, that the page sends; None ends the conversion.

        Raises:
            DataError, UsageError: neither a function nor labels, or a light that is not valid.
        """
        assert self.converter is not None
        assert self.first is not None
        job: Job = None
        if sent is not None:
            light = sent.pop("light", None) if isinstance(sent, dict) else None
            live = self.first().options.live
            known = () if live is None else live.labels
            labelled = isinstance(sent, dict) and "labels" in sent
            look = parse_labels(sent["labels"], known) if labelled else parse_function(sent)
            check_labels([look])
            job = look, None if light is None else LightOptions.of(parse_light(light, self.first().options))
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
        """Return a file of what is shown: a conversion by its number, else the first cloud under the look that is sent.

        A page of a conversion holds that as well, for its function editor.

        Raises:
            DataError: an invalid request, or a conversion that was replaced.
        """
        keys = {"file", "number", "function", "labels", "layers", "light"}
        if not isinstance(sent, dict) or sent.get("file") not in ("ply", "html") or not set(sent) <= keys:
            raise DataError(
                "save: expected file (ply or html), and optionally number, or function, labels or layers, and light"
            )
        better, number = self.better, sent.get("number")
        if number is not None and (better is None or number != self.state["number"]):
            raise DataError("that conversion was replaced by another; try again")
        assert self.first is not None
        cloud = self.first()
        looks = sent.get("layers") or [{key: sent[key]} for key in ("function", "labels") if sent.get(key) is not None]
        if looks and cloud.live:
            cloud = cloud.with_looks(looks, sent.get("light"))
        slices = self.slices() if sent["file"] == "html" else None
        if number is None or better is None:
            return cloud.file(sent["file"], slices=slices)
        conversion = ServedCloud.of(better, self.name)
        if not {"function", "labels"} & set(sent):
            return conversion.file(sent["file"], slices=slices)
        options = replace(cloud.options, certificate=conversion.options.certificate)
        return conversion.file(sent["file"], replace(cloud, options=options), slices)

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
        self.first = cache(lambda: ServedCloud.of(made.ply, self.name))
        self._show(made.files, made.live)
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
    found = re.sub(r"[^0-9A-Za-z._ -]+", "-", name).strip("-. ")
    return found or "volume"
