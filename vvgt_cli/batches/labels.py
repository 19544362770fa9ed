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
        (layer,) = layers_of(open_parts(source.path, source.read), None, source.labels or AUTO)
        volume, table = layer.volume, layer.tf
        assert isinstance(table, LabelTable)
        labels = [label for label in table.labels if label.opacity > 0]
        stage.note = f"{volume.name}, {len(labels)} labels of {table.name}"
    index = str(Path(str(request.output).replace("{}", INDEX)).with_suffix(".json"))
    requests = []
    for label, share in zip(labels, shares(volume, labels, request.fit.max_gaussians), strict=True):
        alone = replace(source, volume=volume, labels=table.only(label.number))
        one = replace(request, source=alone, fit=replace(request.fit, max_gaussians=share))
        requests.append(named(one, file_name(label), "label"))
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
    found = {"format": "vvgt-labels", "volume": volume.name, "table": table.name, "files": rows}
    write_text(index, json.dumps(plain(found), indent=2) + "\n", request.overwrite)
    console.say(f"{index}: {len(rows)} labels")
    return found


def _row(label: Label, request: ConvertRequest, report: ConversionReport) -> dict[str, Any]:
    """A label's entry in the index."""
    return {
        "label": label.number, "name": label.name, "color": label.color, "opacity": label.opacity,
        "file": Path(str(request.output)).name, "gaussians": report.gaussians,
    }  # fmt: skip


def shares(volume: Volume, labels: Sequence[Label], budget: int) -> list[int]:
    """Gaussians of each label, at most ``budget`` in all but for one a label."""
    counts = np.zeros(len(labels))
    numbers = np.array([label.number for label in labels], np.float64)
    for z in range(len(volume.data)):
        values, many = np.unique(
            volume.slope * volume.data[z].astype(np.float64) + volume.intercept, return_counts=True
        )
        at = np.minimum(np.searchsorted(numbers, values), len(numbers) - 1)
        np.add.at(counts, at, np.where(numbers[at] == values, many, 0))
    weight = np.maximum(counts, 1) ** (2 / 3)
    weight = np.maximum(weight / weight.sum(), 0.01)
    return [max(int(budget * share), 1) for share in weight / weight.sum()]


def file_name(label: Label) -> str:
    """Its number, which no other has, and its name in plain characters."""
    return f"{label.number}-{re.sub(r'[^0-9A-Za-z]+', '-', label.name).strip('-')}".strip("-")
