"""The look that splats of a label map which can be shown under any table are placed by: all visible labels alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from vvgt_cli.look.fog import NAME, THIN
from vvgt_cli.look.labels import LabelTable

HIDDEN = 0.25  # how much a label of opacity 0 counts, which another table may show
SMALL = 2 / 3  # power of a label's voxels that its cells count less by: small ones are to keep their shape
GOLDEN = 0.6180339887498949  # labels of neighbouring numbers get codes far from each other


def label_fog(table: LabelTable, voxels: Mapping[int, int]) -> LabelTable:
    """A table in which the labels of ``voxels`` have the opacity `THIN`, and a code each of its own.

    Red is the code in [0, 1] and green its square: their means over a cell say whether it holds several labels. Blue is
    how much the label counts, by its ``voxels``.
    """
    least, labels = max(min(voxels.values(), default=1), 1), []
    for number, label in enumerate(table.labels):
        code, weight = (number * GOLDEN) % 1, (least / max(voxels.get(label.number, least), least)) ** SMALL
        weight *= 1 if label.opacity > 0 else HIDDEN
        labels.append(replace(label, color=(code, code**2, weight), opacity=THIN if label.number in voxels else 0.0))
    return LabelTable(NAME, tuple(labels))
