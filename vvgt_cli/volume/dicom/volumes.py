"""Several volumes in one DICOM series: times, echoes, phases, b-values, magnitude and phase.

A series holds several where every position has several images. What tells them apart is an attribute, or a pair of
them, each of whose values has every position once; without one it is the file, or else the order of instance numbers.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Hashable, Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.reading import ReadOptions, listed, printable

FEW = 2  # slices: fewer than make a volume or a stack, beside one that has more
NEAR = 0.01  # share of the largest distance of neighbouring slices within which two are in one place
ATTRIBUTES = {  # by which volumes of a series differ: unit, and where functional groups have it
    "EchoTime": ("ms", "MREchoSequence", "EffectiveEchoTime"),
    "TemporalPositionIdentifier": ("", "FrameContentSequence", "TemporalPositionIndex"),
    "DiffusionBValue": ("s/mm2", "MRDiffusionSequence", "DiffusionBValue"),
    "TriggerTime": ("ms", "CardiacSynchronizationSequence", "NominalCardiacTriggerDelayTime"),
    "NominalPercentageOfCardiacPhase": ("%", "CardiacSynchronizationSequence", "NominalPercentageOfCardiacPhase"),
    "InversionTime": ("ms", "MRModifierSequence", "InversionTimes"),
    "ImageType": ("", "MRImageFrameTypeSequence", "FrameType"),
    "FrameReferenceTime": ("ms", "", ""),
    "KVP": ("kV", "CTXRayDetailsSequence", "KVP"),
    "AcquisitionNumber": ("", "FrameContentSequence", "FrameAcquisitionNumber"),
    "TimeSlotVector": ("", "", ""),
    "TimeSliceVector": ("", "", ""),
    "PhaseVector": ("", "", ""),
    "RRIntervalVector": ("", "", ""),
    "EnergyWindowVector": ("", "", ""),
    "DetectorVector": ("", "", ""),
    "AcquisitionTime": ("", "FrameContentSequence", "FrameAcquisitionDateTime"),
    "ContentTime": ("", "", ""),
}
_PARTS = {"M": "magnitude", "P": "phase", "R": "real", "I": "imaginary", "MAGNITUDE": "magnitude", "PHASE": "phase"}


def one_volume(slices: list[Any], options: ReadOptions, name: str, path: Path) -> list[Any]:
    """Return the slices of the volume asked for, or of the only one.

    The slices have one size and orientation. ``options.time`` is the number of the volume; ``name`` its name, "" for
    none.

    Raises:
        DataError: places that have different numbers of images, and nothing tells volumes apart.
        SeveralSteps: several volumes and none chosen.
        UsageError: no such one.
    """
    volumes = _volumes(slices, path)
    large = {key: volume for key, volume in volumes.items() if len(volume) > FEW}
    if large and len(large) < len(volumes):
        rest = sum(map(len, volumes.values())) - sum(map(len, large.values()))
        warnings.warn(f"{path}: skipped {rest} images in places of others", stacklevel=2)
        volumes = large
    names, n = list(volumes), len(volumes)
    listing = listed(names, ", ") if names != [""] else ""
    if name:
        if names.count(name) != 1:
            raise UsageError(f"{path}: no volume {name!r}; it has {listing or 'one'}; choose with --series SERIES/NAME")
        return volumes[name]
    source = f"{path} ({listing})" if listing else str(path)
    return volumes[names[options.step(n, source, "volumes in one series", names=names)]]


def _volumes(slices: list[Any], path: Path) -> dict[str, list[Any]]:
    """Return the volumes by name, in their order."""
    places = _places(slices)
    counts = np.bincount(places)
    most = int(counts.max())
    if most == 1:
        return {"": slices}
    for keys in _candidates(slices):
        groups: dict[Hashable, list[int]] = {}
        for k, s in enumerate(slices):
            groups.setdefault(tuple(s.facts.get(key) for key in keys) if keys else s.source, []).append(k)
        if len(groups) == most and all(len(set(places[ks])) == len(ks) for ks in groups.values()):
            return _named([[slices[k] for k in ks] for ks in groups.values()])
    if counts.min() < most:
        raise DataError(
            f"{path}: {len(slices)} images in {len(counts)} places, {counts.min()} to {most} in each, and no attribute "
            "tells volumes apart; expected as many in each: are files missing, or of another series?"
        )
    order = sorted(range(len(slices)), key=lambda k: (places[k], slices[k].instance, slices[k].frame))
    return _named([[slices[k] for k in order[step::most]] for step in range(most)])


def _places(slices: list[Any]) -> np.ndarray:
    """Return the number of the place of each slice (n,), along the normal."""
    normal = np.cross(*slices[0].rows)
    along = np.array([s.position @ normal for s in slices])
    order = np.argsort(along, kind="stable")
    gaps = np.diff(along[order])
    places = np.empty(len(slices), np.int64)
    places[order] = np.concatenate([[0], np.cumsum(gaps > NEAR * gaps.max())]) if gaps.size and gaps.max() > 0 else 0
    return places


def _candidates(slices: list[Any]) -> Iterator[tuple[str, ...]]:
    """Yield the attributes that differ, then pairs and triples of them; an empty one stands for the file."""
    keys = [key for key in dict.fromkeys(k for s in slices for k in s.facts)]
    differ = [key for key in keys if len({s.facts.get(key) for s in slices}) > 1]
    for n in (1, 2, 3):
        yield from combinations(differ, n)
        if n == 1:
            yield ()


def _named(volumes: list[list[Any]]) -> dict[str, list[Any]]:
    """Name volumes by the first attribute, or pair, that differs from one to the next, and order them."""

    def fixed(key: str) -> list[Any] | None:
        stated = [{s.facts.get(key) for s in volume} for volume in volumes]
        return None if any(len(one) != 1 for one in stated) else [one.pop() for one in stated]

    table = {key: values for key in ATTRIBUTES if (values := fixed(key)) is not None and len(set(values)) > 1}
    chosen = next(((key,) for key, values in table.items() if len(set(values)) == len(volumes)), tuple(table)[:2])
    values = list(zip(*(table[key] for key in chosen), strict=True)) or [()] * len(volumes)
    numbers = len(chosen) == 1 and all(isinstance(one[0], float) for one in values)
    order = sorted(
        range(len(volumes)), key=lambda k: (values[k][0] if numbers else 0.0, min(s.instance for s in volumes[k]))
    )
    named: dict[str, list[Any]] = {}
    for k, volume in enumerate(volumes[k] for k in order):
        parts = [_shown(key, value, table[key]) for key, value in zip(chosen, values[order[k]], strict=True)]
        name = ", ".join(parts) or f"volume {k}"
        named[name if name not in named else f"{name} ({k})"] = volume
    return named


def _shown(key: str, value: Any, others: Sequence[Any]) -> str:
    """Write a value as part of a name, ``EchoTime 4.92 ms``; of image types the words that differ."""
    if key == "ImageType" and isinstance(value, tuple):
        shared = set.intersection(*(set(other) for other in others if isinstance(other, tuple)))
        words = " ".join(str(_PARTS.get(word, word)) for word in value if word not in shared)
        return printable(words[:40]) or "ImageType"
    text = f"{value:g}" if isinstance(value, float) and math.isfinite(value) else str(value)
    return printable(f"{key} {text[:40]} {ATTRIBUTES[key][0]}".strip())
