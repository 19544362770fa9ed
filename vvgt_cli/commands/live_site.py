"""What the page of live Gaussians asks of the server: itself, files to save, conversions for a function."""

from __future__ import annotations

import base64
import io
import json
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from vvgt_cli.cameras.sets import SIZE, pixel_width
from vvgt_cli.commands.converter import Converter, Failed, Made, Message, Progress, Said
from vvgt_cli.commands.server import Part
from vvgt_cli.conversion.gaussian_files import layout_of, open_gaussians
from vvgt_cli.errors import DataError, VvgtError
from vvgt_cli.gaussians import Gaussians, PlyOptions, as_stored, write_ply
from vvgt_cli.gaussians.formats import SUFFIXES, encoded, format_of
from vvgt_cli.gaussians.formats.gsply_files import compressed_ply
from vvgt_cli.gaussians.formats.page_file import page, upright, waiting_page
from vvgt_cli.gaussians.formats.page_live import light_sent, live_parts
from vvgt_cli.gaussians.formats.splats import columns_of
from vvgt_cli.gaussians.live import Table, baked
from vvgt_cli.gaussians.live_facts import function_text
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.readers.minimal import read
from vvgt_cli.progress import Console
from vvgt_cli.volume.readers import volume_name

JSON, BYTES, HTML = "application/json", "application/octet-stream", "text/html; charset=utf-8"
SCRIPT = '<script src="viewer.js"></script>'
NODES = 4096  # of a function that a page sends


def stored(gaussians: Gaussians, options: PlyOptions) -> bytes:
    """A `.ply` as the page's viewer wants it."""
    stream = io.BytesIO()
    write_ply(stream, replace(gaussians, live=None), replace(upright(options), live=None))
    return stream.getvalue()


@dataclass(frozen=True)
class Cloud:
    """What is shown.

    Attributes:
        gaussians: in the unit frame.
        options: how a file of them is laid out.
        name: of files to save, without ending.
        ply: the file that they were read of; None where they have changed since.
    """

    gaussians: Gaussians
    options: PlyOptions
    name: str
    ply: bytes | None = None

    @classmethod
    def of(cls, ply: bytes, name: str) -> Cloud:
        """What a `.ply` holds."""
        gaussians, header = open_gaussians(io.BytesIO(ply))
        return cls(gaussians, layout_of(header), name, ply)

    @property
    def live(self) -> bool:
        """Whether they can be shown under any function."""
        return self.gaussians.live is not None and self.options.live is not None and not self.options.live.others

    def file(self, suffix: str) -> Part:
        """As it is saved."""
        if (other := format_of(f"x.{suffix}")) is not None:
            return Part(BYTES, lambda: encoded(other, self.gaussians, self.options, f"{self.name}.{suffix}"))
        if self.ply is not None:
            return Part(BYTES, lambda: self.ply or b"")
        stream = io.BytesIO()
        write_ply(stream, self.gaussians, self.options)
        return Part(BYTES, stream.getvalue)

    def under(self, tf: TransferFunction, light: Any = None) -> Cloud:
        """The same with the colours of another function, on data values, with an opacity_unit_distance.

        Args:
            tf: the function.
            light: as the page sends it; None: the file's own.

        Raises:
            DataError, UsageError: it is no light, or the Gaussians carry labels.
        """
        from vvgt_cli.conversion.live import lit

        facts, scale, distance = self.options.live, self.options.scale or 1.0, tf.opacity_unit_distance
        assert facts is not None
        assert distance is not None
        if facts.labels:
            raise DataError("what is shown carries labels; expected no function")
        lighting = self.options.light if light is None else light_sent(light, self.options)
        table = Table.of_function(tf, facts.lo, facts.hi, distance * scale)
        pixel = pixel_width(self.options.made_for or SIZE)
        found = as_stored(lit(baked(self.gaussians, table, pixel), lighting))
        facts = replace(facts, function=function_text(tf, facts.lo, facts.hi))
        options = replace(
            self.options, live=facts, certificate=None, unit_distance=distance, unit_distance_label="file",
            light=lighting, function=tf.name, sh_degree=None,
        )  # fmt: skip
        return replace(self, gaussians=found, options=options, ply=None)


def function_sent(sent: Any) -> TransferFunction:
    """The function that a page has sent.

    Raises:
        DataError: none, or one without the distance that its opacity is per.
    """
    what = "the page's function"
    if not isinstance(sent, dict) or not isinstance(sent.get("points"), list) or len(sent["points"]) > NODES:
        raise DataError(f"{what}: expected an object with a list of at most {NODES} points")
    if unknown := sorted(set(sent) - {"name", "points", "opacity_unit_distance"}):
        raise DataError(f"{what}: {unknown[0]!r}; expected name, points and opacity_unit_distance")
    tf = read(sent, what)
    if tf.opacity_unit_distance is None:
        raise DataError(f"{what}: no opacity_unit_distance; expected the length that its opacity is per")
    return tf


def page_of(cloud: Cloud, converts: bool) -> dict[str, bytes]:
    """The text of a page, named "", and the file that it asks for.

    Args:
        cloud: what it shows, live where that can be.
        converts: the volume is at hand, to be converted for a function.

    Raises:
        DataError: a library is missing that pages of live Gaussians need.
    """
    if not cloud.live:
        file, name = stored(cloud.gaussians, cloud.options), "0.ply"
        splats, elements, more = columns_of(file, cloud.name), SCRIPT, {}
    else:
        [splats], [planes], facts = live_parts([(cloud.gaussians, cloud.options)])
        file, name = compressed_ply(splats, cloud.name), "0.compressed.ply"
        held = base64.b64encode(planes).decode("ascii")
        elements = f'<script type="{BYTES}" id="{facts["held"][0]}">{held}</script>\n{SCRIPT}'
        more = {"live": facts, "server": {"converts": converts, "name": cloud.name}}
    text = page(cloud.name, splats, [{"name": cloud.name, "file": name}], elements, more)
    return {"": text.encode("utf-8"), name: file}


class Desk:
    """What the server has for the page, as it comes: progress, the live form, better ones.

    Args:
        parts, posts: of the site; filled in here.
        name: of what is shown, without ending.
        console: for messages.
    """

    def __init__(
        self, parts: dict[str, Part], posts: dict[str, Callable[[Any], Part]], name: str, console: Console
    ) -> None:  # fmt: skip
        self.parts, self.posts, self.name, self.console = parts, posts, name, console
        self.error: VvgtError | None = None
        self.first: Callable[[], Cloud] | None = None
        self.better: bytes | None = None
        self.converter: Converter | None = None
        self.begun = threading.Event()  # the volume has been read, or cannot be
        self.there = threading.Event()  # the first page, or an error
        self.waited_for = False  # by a page, for the first one
        self.state: dict[str, Any] = {"number": 0, "state": "first", "said": "starting"}

    def await_volume(self, converter: Converter) -> None:
        """Begin with the live form of a volume; a page that asks meanwhile waits for it."""
        self.converter = converter
        text = waiting_page(self.name, SCRIPT).encode("utf-8")
        self.parts[""] = Part(HTML, lambda: text)
        self.parts["state"] = Part(JSON, self._told)
        with converter.lock:
            converter.ask(None)

    def show(self, cloud: Cloud) -> None:
        """Show the Gaussians of a file, live where they can be."""
        self.first = lambda: cloud
        try:
            parts = page_of(cloud, converts=False)
        except DataError as error:
            self.console.say(f"{error}; shown under the file's own function")
            parts = page_of(replace(cloud, gaussians=replace(cloud.gaussians, live=None)), converts=False)
        self._show(parts, cloud.live)

    def _show(self, parts: dict[str, bytes], live: bool) -> None:
        if live:
            self.posts["save"] = self.save
        if live and self.converter is not None:
            self.posts["function"] = self.function
        for name, content in parts.items():
            self.parts[name] = _part(content, BYTES if name else HTML)
        self.there.set()

    def _told(self) -> bytes:
        self.waited_for = self.waited_for or not self.there.is_set()
        return json.dumps(self.state).encode()

    def function(self, sent: Any) -> Part:
        """Convert the volume for a function that the page sends, or for none: what is being done ends.

        Raises:
            DataError: it is no function.
        """
        assert self.converter is not None
        tf = None if sent is None else function_sent(sent)
        with self.converter.lock:
            self.parts.pop(f"{self.state['number']}.ply", None)
            self.better = None
            if tf is None:
                self.converter.cancel()
                self.state = {"number": -1, "state": "none", "said": ""}
            else:
                number = self.converter.ask(tf)
                self.state = {"number": number, "state": "working", "said": "beginning"}
            answer = json.dumps({"number": self.state["number"]}).encode()
        return Part(JSON, lambda: answer)

    def save(self, sent: Any) -> Part:
        """A file of what is shown: a better form by its number, else the first one, under a function if one is sent.

        Raises:
            DataError: something else is asked for, or what was shown is not there any more.
        """
        keys = {"file", "number", "function", "light"}
        if not isinstance(sent, dict) or sent.get("file") not in ("ply", "html") or not set(sent) <= keys:
            raise DataError(
                "what to save: expected an object with file, ply or html, and a number, or a function and a light"
            )
        better, number = self.better, sent.get("number")
        if number is not None and (better is None or number != self.state["number"]):
            raise DataError("what was shown is not there any more; try again")
        assert self.first is not None
        cloud = self.first() if number is None or better is None else Cloud.of(better, self.name)
        if sent.get("function") is not None and cloud.live:
            cloud = cloud.under(function_sent(sent["function"]), sent.get("light"))
        return cloud.file(sent["file"])

    def hear(self, number: int, message: Message) -> None:
        """What the converter has to say of a job, in its thread."""
        first = not self.there.is_set()
        if isinstance(message, Said):
            if first:
                self.console.say(message.line)
                self.begun.set()
        elif isinstance(message, Progress):
            self.state = {**self.state, "said": message.text}
        elif isinstance(message, Failed):
            if first:
                self.error = message.error
            self.state = {"number": number, "state": "failed", "said": str(message.error)}
            self.there.set()
            self.begun.set()
        elif first:
            self._first(message)
        else:
            self._better(number, message)

    def _first(self, made: Made) -> None:
        self.first = cache(lambda: Cloud.of(made.ply, self.name))
        self._show(made.parts, made.live)
        self.state = {"number": 0, "state": "none", "said": ""}

    def _better(self, number: int, made: Made) -> None:
        self.better = made.ply
        self.parts[f"{number}.ply"] = _part(made.parts["ply"], BYTES)
        told = "converted" if made.psnr is None else f"converted, {made.psnr:.1f} dB"
        self.state = {"number": number, "state": "done", "said": told, "file": f"{number}.ply"}
        self.console.say(f"{told}, for the function of the page")


def _part(content: bytes, kind: str) -> Part:
    return Part(kind, lambda: content)


def plain_name(path: str) -> str:
    """A name to save under, of a file's: letters, digits and a few signs."""
    known = next((suffix for suffix in reversed(SUFFIXES) if path.lower().endswith(suffix)), "")
    name = volume_name(Path(path.removeprefix("example:")[: len(path) - len(known)]))
    found = re.sub(r"[^0-9A-Za-z._ -]+", "-", name).strip("-. ")
    return found or "volume"
