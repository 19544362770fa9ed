"""Colour maps in bytes: niivue's ``.json``, MRIcroGL's ``.clut`` and ImageJ's ``.lut``.

niivue has an object of the lists ``R``, ``G``, ``B``, ``A`` and their positions ``I``, each 0 to 255; MRIcroGL has
them as INI, ``nodeintensity0=0`` and ``nodergba0=R|G|B|A``. 0 and 255 are ``min`` and ``max`` of the file where max is
above min, else of the data. A is opacity per voxel, the step of both programs' ray casters (``sliceSize``). ImageJ
(LutLoader) reads 256 reds, then greens, then blues, also behind NIH Image's header of 32 bytes, or 256 lines of text,
``[index] red green blue``; they spread over the data range and get a linear ramp of opacity.
"""

from __future__ import annotations

import configparser
import re
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.files import seekable
from vvgt_cli.look.function import PER_VOXEL, ColorMap, PiecewiseOpacity, TransferFunction
from vvgt_cli.look.readers.fields import floats, number, text_of
from vvgt_cli.look.readers.paraview import RAMP

SUFFIXES = (".clut", ".lut")
SIZE = 256  # colours of a map of ImageJ's


def load(path: Path) -> dict[str, Any]:
    """Return a ``.clut`` or ``.lut`` file in niivue's form, or raise DataError."""
    if path.suffix.lower() == ".clut":
        return _clut(text_of(path), path)
    with open(seekable(path), "rb") as stream:
        raw = stream.read(1024)  # of 970 bytes the rest is a resource fork
    count, columns = SIZE, np.frombuffer(raw, np.uint8)
    if raw.startswith(b"ICOL"):
        count, columns = int.from_bytes(raw[6:8], "big"), columns[32:]
    elif len(raw) not in (3 * SIZE, 970):
        rows = [line for line in text_of(path).splitlines() if line.strip() and not re.search("[A-Za-z]", line)]
        values = np.array(floats(str(path), " ".join(rows).replace(",", " ")))
        columns = values.reshape(SIZE, -1)[:, -3:].T.ravel() if values.size in (3 * SIZE, 4 * SIZE) else values[:0]
    if not 2 <= count <= SIZE or len(columns) < 3 * count:
        raise DataError(f"{path}: not a lookup table of ImageJ's; expected 256 colours, as bytes or lines of text")
    channels = columns[: 3 * count].reshape(3, count).tolist()
    at = [k * SIZE / count for k in range(count)]
    return {**dict(zip("RGB", channels, strict=True)), "A": at, "I": at, "name": path.stem + RAMP}


def _clut(text: str, path: Path) -> dict[str, Any]:
    """Parse MRIcroGL's colour map into niivue's form."""
    ini = configparser.ConfigParser(strict=False, interpolation=None)
    try:
        ini.read_string(text)
        entries = {key: value for section in ini.values() for key, value in section.items()}
        nodes = [map(float, entries[f"nodergba{k}"].split("|")) for k in range(int(entries["numnodes"]))]
        places = [float(entries[f"nodeintensity{k}"]) for k in range(len(nodes))]
        columns = dict(zip("RGBA", map(list, zip(*nodes, strict=True)), strict=True))
        return columns | {"I": places} | {key: float(entries.get(key, 0)) for key in ("min", "max")}
    except (configparser.Error, KeyError, ValueError) as error:
        reason = " ".join(str(error).split())[:80]
        raise DataError(f"{path}: {reason}; expected numnodes, nodeintensity0=0, nodergba0=R|G|B|A, ...") from None


def matches(parsed: Any) -> bool:
    """Return whether it is a colour map of niivue, or one that `load` returned."""
    return isinstance(parsed, dict) and {"R", "G", "B"} <= set(parsed)


def read(parsed: dict[str, Any], what: str, pick: str = "") -> TransferFunction:
    """Return the function of a colour map; without ``A`` opacity is niivue's, 0 at the first node and 64 at others.

    Raises:
        DataError: lists of different lengths, positions that do not ascend from 0, values outside of 0 to 255,
            a colour map of labels, or ``pick`` of a preset by name.
    """
    if pick or "labels" in parsed:
        raise DataError(f"{what}: expected one colour map, without #{pick or 'NAME'} and without labels (see --labels)")
    given = {key: parsed[key] for key in "RGBAI" if isinstance(parsed.get(key), list)}
    lists = {key: np.array([number(f"{what}: {key}", v) for v in values]) for key, values in given.items()}
    count, name = len(lists.get("R", ())), str(parsed.get("name") or Path(what).stem)
    lists = {"A": np.minimum(np.arange(count) * 64.0, 64.0), "I": np.linspace(0, 255, count)} | lists
    if count < 2 or {len(values) for values in lists.values()} != {count} or len(lists) < 5:
        raise DataError(f"{what}: expected lists R, G, B, A and I of one length above 1")
    rows, ramp = np.array([lists[key] for key in "RGBAI"]), name.endswith(RAMP)
    if rows.min() < 0 or rows.max() > SIZE or rows[4, 0] or (np.diff(rows[4]) < 0).any():  # MRIcroGL has 256 for 255
        raise DataError(f"{what}: expected numbers from 0 to 255, I ascending from 0")
    *rgb, opacity, at = rows.clip(0, 255) / 255
    at[-1] = at[-1] if ramp else 1.0  # niivue's makeLut stretches the last segment
    lo, hi = (number(f"{what}: {key}", parsed.get(key) or 0) for key in ("min", "max"))
    x = lo + (hi - lo) * at if hi > lo else at
    return TransferFunction(
        name,
        PiecewiseOpacity(x, opacity),
        ColorMap(x, np.transpose(rgb)),
        domain="data" if hi > lo else "fraction",
        opacity_unit_label="file" if ramp else PER_VOXEL,
    )
