"""Layers of which none need hold the others, converted together."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from vvgt_cli.commands.convert import convert
from vvgt_cli.conversion.result import Conversion
from vvgt_cli.dvr.layers import MAX_FINER
from vvgt_cli.field.layered import OpenedFile
from vvgt_cli.library.inputs import LightLike, Look, source_of
from vvgt_cli.look import ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.volume import Volume, triple
from vvgt_cli.volume.types import ALIKE

AROUND = "around"  # name of an empty volume that holds all

Layer = tuple[OpenedFile, Look]


def together(layers: Sequence[Layer], light: LightLike, **options: Any) -> Conversion:
    """Convert volumes, each with its look, under one light, wherever they lie; ``options`` are those of `convert`.

    Raises:
        DataError, UsageError: see `convert`.
    """
    (first, look), *rest = _ordered(layers)
    look = replace(look, light=light, layers=[source_of(*one, {}) for one in rest])
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", f"{AROUND}, none: nothing is visible")
        result = convert(first, look, **options)
    assert isinstance(result, Conversion)
    return result


def _ordered(layers: Sequence[Layer]) -> list[Layer]:
    """Return the layers, first one whose box holds those of all; else an empty volume that does comes first."""
    volumes = [content.volumes[0] for content, _ in layers]
    unit = np.array(list(product((0, 1), repeat=3)))
    corners = [(unit * v.dims - 0.5) * v.spacing @ v.axes.T + v.origin for v in volumes]
    everything = np.concatenate(corners)
    for k, v in enumerate(volumes):
        index = (everything - v.origin) @ np.linalg.inv(v.axes).T / v.spacing
        if (index > -0.5 - ALIKE).all() and (index < np.array(v.dims) - 0.5 + ALIKE).all():
            return [layers[k], *layers[:k], *layers[k + 1 :]]
    low, high = everything.min(axis=0), everything.max(axis=0)
    dims = np.ceil((high - low) / (MAX_FINER * min(min(v.spacing) for v in volumes))).astype(int)
    step = (high - low) / dims
    empty = np.zeros(dims[::-1], np.uint8)
    around = Volume(
        empty, triple(step.tolist()), triple((low + step / 2).tolist()), name=AROUND, space=volumes[0].space,
        unit=volumes[0].unit,
    )  # fmt: skip
    clear = PiecewiseOpacity(np.zeros(1), np.zeros(1))
    nothing = TransferFunction("none", clear, ColorMap(np.zeros(1), np.zeros((1, 3))))
    return [(OpenedFile((around,)), Look(nothing)), *layers]
