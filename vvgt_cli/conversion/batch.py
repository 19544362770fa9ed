"""Batches: several clouds of one run, as files with an index, as one page, or in memory.

A batch is the frames of a series (`frames`), several functions, or the labels of a map (`labels`): it yields an `Item`
for each cloud, and `convert_batch` converts them. `CANNOT` lists the options that each kind of batch does not take.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vvgt_cli.conversion.index import FRAMES, FUNCTIONS, LABELS
from vvgt_cli.conversion.opened import read_once
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.defaults import INIT
from vvgt_cli.errors import UsageError
from vvgt_cli.field.layered import content_of
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.look.labels import NO_LABELS
from vvgt_cli.score.record import Run

if TYPE_CHECKING:
    from vvgt_cli.conversion.plan import WarmStart

ONE, LIVE, LEVELS, ONE_FILE = "one volume", "--live", "streamed levels", "one file of several clouds"
LAYERS, NODES = "labels of layers", "one file with a node for each function"
NO_PAGE = "a file that is no page"
UNSAFE = re.compile(r"[^\w.-]+")  # characters that are not put into file names
WHOLE = "the limit is for one cloud, and there are several; try --max-gaussians"
CANNOT: dict[str, dict[str, str]] = {  # by kind of batch or output: options that it does not take, and a remedy
    ONE: {
        "--shard": "for a series give -o a place for the number, as out_{:04d}.ply; jobs share one volume by "
        "'vvgt init --shard' and 'vvgt merge'"
    },
    FRAMES: {
        "--checkpoint": "a series resumes from its manifest; remove it",
        "--dry-run": "a plan is for one volume; try it on one of the frames",
        "after": "a series starts from its own frames; remove it",
    },
    FUNCTIONS: {
        "--checkpoint": "it is for one conversion; run the functions one by one",
        "--dry-run": "a plan is for one function; try it on one of them",
        "--shard": "shards are for series; run the functions one by one",
        "--live": "one live file can be shown under any function by 'vvgt recolor'; give one --tf",
        "--split-labels": "labels have a table of their own; give one or the other",
        "after": "only one conversion can start from another; give one function",
    },
    LABELS: {
        "--tf": "the colours of labels come from --labels; remove it",
        "--labels none": "it needs labels; remove it",
        "--dry-run": "a plan is for one file; remove it",
        "--shard": "shards are for series; remove it",
        "--checkpoint": "it is for one conversion; remove it",
        "--max-megabytes": WHOLE,
        "--time-budget": "it is for one conversion, and there are several; try --steps",
        "--live": "a live file of the whole map can show each label alone; remove one of them",
        "after": "only one conversion can start from another; remove it",
    },
    LIVE: {"--dry-run": "live files need no plan; remove it", "after": "live files need no earlier one; remove it"},
    LEVELS: {
        "--init": "levels are cuts of moments, which other methods do not make; remove it",
        "--frame world": "viewers choose levels by distances in the unit frame; remove it",
        "--live": "their format has no place for values; write another, as -o out.ply",
        "--split-labels": "labels share the Gaussians of one finished cloud; write another format, as -o out_{}.ply",
    },
    NO_PAGE: {"--story": "only pages show stories; write one, as -o out.html"},
    NODES: {"--for": "all nodes are drawn together, and a device's limit is of each; give --max-gaussians"},
    ONE_FILE: {
        "--report": "a report is of one cloud; write a file each, as -o out_{}.ply",
        "--preview": "a preview is of one cloud; write a file each, as -o out_{}.ply",
        "--checkpoint": "it is for one conversion; write a file each, as -o out_{}.ply",
        "--max-megabytes": WHOLE,
        "--no-values": "it holds none but of a series; remove it",
    },
}
CANNOT[LAYERS] = {option: why for option, why in CANNOT[LABELS].items() if option not in ("--tf", "--labels none")} | {
    "a file each": "each layer has a frame of its own; write one file, as -o out.glb (.usdc, .usdz, .html)"
}


@dataclass(frozen=True)
class Item:
    """One cloud of a batch.

    Attributes:
        name: name in the index, on pages and as a key.
        stem: part of file names: a frame's number, a function's name, a label's number and name.
        request: request of its conversion, without outputs.
        facts: further entries of its row in the index.
        gaussians: finished Gaussians, box frame, that only need scores; None where they are yet to be made.
    """

    name: str
    stem: str
    request: ConvertRequest
    facts: Mapping[str, Any] = field(default_factory=dict)
    gaussians: Gaussians | None = None


class Batch(ABC):
    """Several clouds to be made of one source.

    Attributes:
        kind: `FRAMES`, `FUNCTIONS` or `LABELS`.
        request: request that all share; its outputs have a place for the name.
        volume: name of the source.
        stems: stems of all items; `prepare` may have to find them first.
        facts: entries of the index as a whole.
        resumes: whether a later run of the same command continues where this one ends, by a manifest of `settings`.
        previous: warm start of each item, where items resemble each other.
    """

    kind: str
    resumes = False
    previous: WarmStart | None = None

    def __init__(self, request: ConvertRequest, volume: str, stems: Sequence[str] = ()) -> None:
        """Store what all items share."""
        self.request, self.volume, self.stems = request, volume, list(stems)
        self.facts: dict[str, Any] = {}

    def check_names(self) -> None:
        """Raise UsageError if two items have one name, as far as names are known."""
        if len(set(self.stems)) < len(self.stems):
            stated = ", ".join(dict.fromkeys(self.stems))
            raise UsageError(f"{len(self.stems)} {self.kind}, named {stated}: expected one name each; rename one")

    @abstractmethod
    def prepare(self, run: Run) -> None:
        """Read what all items share."""

    @abstractmethod
    def items(self, run: Run, wanted: Callable[[str], bool]) -> Iterator[Item]:
        """Yield the items with a stem that is ``wanted``; skip those that show nothing, with a message."""

    def places(self, stem: str) -> Mapping[str, Any]:
        """Return what an item's input states for places in names: step, time and stem of frames."""
        return {}

    def settings(self) -> dict[str, Any]:
        """Return everything that the files depend on, for a batch that ``resumes`` and is prepared."""
        return {}


class Functions(Batch):
    """One volume under several functions or looks, read and laid out once.

    Args:
        requests: conversion of each function or look, by name.
    """

    kind = FUNCTIONS

    def __init__(self, requests: Mapping[str, ConvertRequest]) -> None:
        """Store the requests, with file names made of their names."""
        request = next(iter(requests.values()))
        given = request.source.volume
        volume = Path(given).name if isinstance(given, str) else content_of(given).volumes[0].name
        super().__init__(request, volume, [UNSAFE.sub("-", name).strip("-.") or "function" for name in requests])
        self._requests = dict(requests)

    def prepare(self, run: Run) -> None:
        """Read the volume, where it fits in memory."""
        requests = self._requests
        sources, blocks = read_once(run, [one.source for one in requests.values()], self.request.blocks)
        pairs = zip(requests.items(), sources, strict=True)
        self._requests = {name: replace(one, source=source, blocks=blocks) for (name, one), source in pairs}

    def items(self, run: Run, wanted: Callable[[str], bool]) -> Iterator[Item]:
        """Yield an item for each function."""
        for number, ((name, request), stem) in enumerate(zip(self._requests.items(), self.stems, strict=True), 1):
            if wanted(stem):
                fact = request.source.tf if isinstance(request.source.tf, str) else name
                run.console.progress(f"{fact}: function {number} of {len(self._requests)}")
                yield Item(name, stem, request, {"function": fact})


def options_in(request: ConvertRequest) -> set[str]:
    """Return the options of `CANNOT` that a request uses."""
    fit, source = request.fit, request.source
    used = {
        "--checkpoint": request.checkpoint, "--report": request.report, "--preview": request.preview,
        "--live": request.live, "--tf": source.tf, "--layer": source.layers, "--steps": fit.steps,
        "--model": fit.model, "--labels none": source.labels == NO_LABELS,
        "--max-megabytes": fit.max_megabytes, "--time-budget": fit.time_budget,
        "--target-psnr": fit.target_psnr, "--device": fit.device != "cpu", "--for": fit.target,
        "--init": fit.init != INIT, "--frame world": request.ply.frame != "unit",
        "--story": request.story,
    }  # fmt: skip
    return {option for option, value in used.items() if value}


def check_options(kind: str, used: Iterable[str]) -> None:
    """Raise UsageError, with a remedy, for the first option that a kind of batch or output does not take."""
    for option, why in CANNOT[kind].items():
        if option in used:
            raise UsageError(f"{option} with {kind}: {why}")
