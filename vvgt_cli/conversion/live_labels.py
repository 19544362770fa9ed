"""`vvgt convert --live` of a label map: each Gaussian belongs to one label, whose look can be changed later."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vvgt_cli.closed_form import Start
from vvgt_cli.closed_form.columns import MASS
from vvgt_cli.errors import DataError
from vvgt_cli.field.field import Field
from vvgt_cli.field.source import Source
from vvgt_cli.gaussians import Gaussians
from vvgt_cli.gaussians.live import lengths
from vvgt_cli.gaussians.live_facts import MOST_LABELS, LiveFacts
from vvgt_cli.look.fog import THIN, label_fog
from vvgt_cli.look.histogram import UNIT_SHARE
from vvgt_cli.look.labels import Label, LabelTable
from vvgt_cli.look.tables import extinction
from vvgt_cli.score.record import Run
from vvgt_cli.volume.label_maps import extents_of


def live_labels(source: Source) -> tuple[Label, ...]:
    """Return the labels that Gaussians can belong to, invisible ones included, which other tables may show.

    Raises:
        DataError: there are more than `MOST_LABELS`.
    """
    table = source.tf
    assert isinstance(table, LabelTable)
    found = tuple(label for label in table.labels if label.number != 0 or label.opacity > 0)
    if len(found) > MOST_LABELS:
        raise DataError(f"{source.name}: {len(found)} labels; expected at most {MOST_LABELS} with --live")
    return found


def label_facts(source: Source, labels: tuple[Label, ...]) -> LiveFacts:
    """Return the header of live Gaussians with these labels."""
    numbers = [float(label.number) for label in labels]
    return LiveFacts(min(numbers), max(numbers), source.volume.dims, labels=labels)


def label_fog_field(field: Field, labels: tuple[Label, ...]) -> Field:
    """Return the field of a label map as one thin fog, whose labels differ in colour."""
    layer = field.source.layers[0]
    assert isinstance(layer.tf, LabelTable)
    voxels = {value: extent.count for value, extent in extents_of(layer.volume).items()}
    table = label_fog(layer.tf, {e.number: voxels.get(float(e.number), 0) for e in labels})
    return field.with_look(field.source.with_tables([table]))


def with_labels(run: Run, field: Field, start: Start, labels: tuple[Label, ...]) -> Gaussians:
    """Return the Gaussians of the fog with the rows of their labels, without those outside all labels."""
    from vvgt_cli.closed_form.labelled import assign_labels

    assert start.leaves is not None
    frame, source = field.source.volume.unit_frame(), field.source
    with run.stage("labels") as stage:
        maps = [(source.layers[0].volume, [label.number for label in labels])]
        owner, gradient = assign_labels(start.gaussians, maps, np.array(frame.half), np.array(frame.step))
        known = np.flatnonzero(owner >= 0)
        gaussians, leaves = start.gaussians.take(known), start.leaves.take(known)
        owner, gradient = owner[known], gradient[known]
        tau = extinction(np.full(len(known), THIN), 2 * UNIT_SHARE)
        length = lengths(leaves.moments[:, MASS], tau, leaves.edge.prod(axis=1))
        live = np.column_stack([np.zeros((len(owner), 2)), length, gradient, gradient, owner])
        stage.note = f"{len(np.unique(owner))} of {len(labels)} labels have Gaussians"
    return replace(gaussians, live=live, harmonics=None)
