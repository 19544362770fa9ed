"""`vvgt convert --split-labels`: one `.ply` a label of a label map, and an index; together they are the whole."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.batches.functions import named
from vvgt_cli.conversion.convert import convert
from vvgt_cli.conversion.request import ConvertRequest
from vvgt_cli.errors import NothingVisible, UsageError
from vvgt_cli.progress import Console
from vvgt_cli.runs.layered import AUTO, NONE, layers_of, open_parts
from vvgt_cli.runs.outputs import Output, check_outputs, write_text
from vvgt_cli.runs.record import ConversionReport, Run, plain
from vvgt_cli.transfer.labels import Label, LabelTable
from vvgt_cli.volume import Volume

INDEX = "index"  # in the place of a label's name
LONGEST = 80  # characters of a label's name in a file's


def convert_labels(request: ConvertRequest, console: Console | None = None) -> dict[str, Any]:
    """Convert each visible label alone, on the grid and in the frame of the whole, and write the index.

    The budget is dealt out by the labels' surfaces (voxels to the power of 2/3), a hundredth at least where that fits.

    Returns:
        The index, as its JSON has it.

    Raises:
        UsageError: outputs without a place for the name, a function or layers beside the labels.
        DataError: as `convert`.
    """
    console = console or Console()
    source = request.source
    if source.tf is not None or source.layers or source.labels == NONE:
        raise UsageError("--split-labels is of one label map: leave out --tf, --layer and --labels none")
    named(request, INDEX, "label")  # its errors come before the volume
    run = Run(console, ConversionReport("convert"))
    with run.stage("volume") as stage:
        maps = [
            (layer.volume, layer.tf)
            for layer in layers_of(open_parts(source.path, source.read), None, source.labels or AUTO)
            if isinstance(layer.tf, LabelTable)
        ]
        shown = [(volume, table, label) for volume, table in maps for label in table.labels if label.opacity > 0]
        labels = [label for *_, label in shown]
        title, tables = maps[0][0].name, " + ".join(table.name for _, table in maps)
        stage.note = f"{title}, {len(labels)} labels of {tables}"
    index = str(Path(str(request.output).replace("{}", INDEX)).with_suffix(".json"))
    requests = []
    for (volume, table, label), share in zip(shown, shares(shown, request.fit.max_gaussians), strict=True):
        alone = replace(source, volume=volume, labels=table.only(label.number))
        one = replace(request, source=alone, fit=replace(request.fit, max_gaussians=share))
        again = sum(other.number == label.number for other in labels) > 1  # of segments that overlap
        name = f"{volume.name.rpartition(' ')[2]}-{file_name(label)}" if again else file_name(label)
        requests.append(named(one, name, "label"))
    outputs = [output for one in requests for output in one.outputs()]
    check_outputs([*outputs, Output("-o", index, (".json",), binary=False)], source.paths(), request.overwrite)
    rows = []
    for label, one in zip(labels, requests, strict=True):
        console.say(f"label {label.number}, {label.name}: to {one.output}")
        try:
            report = convert(one, console)
        except NothingVisible as error:
            console.say(f"{error}; it gets no file")
            continue
        rows.append(_row(label, one, report))
        if report.refinement and report.refinement["reason"] == "interrupted":
            raise KeyboardInterrupt
    found = {"format": "vvgt-labels", "volume": title, "table": tables, "files": rows}
    write_text(index, json.dumps(plain(found), indent=2) + "\n", request.overwrite)
    console.say(f"{index}: {len(rows)} labels")
    return found


def _row(label: Label, request: ConvertRequest, report: ConversionReport) -> dict[str, Any]:
    """A label's entry in the index."""
    return {
        "label": label.number, "name": label.name, "color": label.color, "opacity": label.opacity,
        "file": Path(str(request.output)).name, "gaussians": report.gaussians,
    }  # fmt: skip


def shares(shown: Sequence[tuple[Volume, LabelTable, Label]], budget: int) -> list[int]:
    """Gaussians of each label, at most ``budget`` in all but for one a label."""
    weight = np.array([max(count, 1) for count in _voxels(shown)], np.float64) ** (2 / 3)
    weight = np.maximum(weight / weight.sum(), 0.01)
    return [max(int(budget * share), 1) for share in weight / weight.sum()]


def _voxels(shown: Sequence[tuple[Volume, LabelTable, Label]]) -> list[int]:
    """Voxels of each label in its map; every map is counted once."""
    counts: dict[int, dict[float, int]] = {}
    for volume, *_ in shown:
        if id(volume) in counts:
            continue
        own = counts[id(volume)] = {}
        for z in range(len(volume.data)):
            values, many = np.unique(volume.data[z], return_counts=True)
            for value, n in zip(volume.slope * values.astype(np.float64) + volume.intercept, many, strict=True):
                own[float(value)] = own.get(float(value), 0) + int(n)
    return [counts[id(volume)].get(float(label.number), 0) for volume, _, label in shown]


def file_name(label: Label) -> str:
    """Its number, which no other has, and its name in plain characters."""
    return f"{label.number}-{re.sub(r'[^0-9A-Za-z]+', '-', label.name)[:LONGEST].strip('-')}".strip("-")
