"""`read_transfer_function`: transfer functions from files and names."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.look.function import TransferFunction
from vvgt_cli.look.isosurfaces import PREFIX
from vvgt_cli.look.readers import inviwo, lut, minimal, names, paraview, slicer
from vvgt_cli.look.readers.fields import load

# each: matches(parsed) -> bool, read(parsed, what, pick) -> TransferFunction
FORMATS = (paraview, minimal, slicer, inviwo, lut)
OWN = (".itf", ".vp", *lut.SUFFIXES)  # endings that nothing else has
SUFFIXES = (".json", ".xml", *OWN)


def read_transfer_function(source: str | os.PathLike[str] | Mapping[str, Any]) -> TransferFunction:
    """Read a transfer function; a file's format is recognised by its content.

    Args:
        source: path of a file (``presets.json#Name`` picks one of several functions; its modules list the
            formats), or a name (`vvgt_cli.look.readers.names`): one of ours, or a matplotlib colour map with an opacity
            ramp, ``NAME[:LO,HI[:MAX]]``, or ``iso:LEVEL``; or the parsed content of such a JSON file.

    Returns:
        The function; `vvgt_cli.look.resolve.resolve` maps it to the data.

    Raises:
        DataError: the file is not a transfer function, or a faulty one.
        UsageError: neither a file nor such a name.
    """
    if isinstance(source, Mapping):
        return _read(dict(source), "transfer function", "")
    source = os.fspath(source)
    if not source.strip():
        raise UsageError("an empty name; expected a transfer-function file or a colour-map name")
    path, pick = Path(source), ""
    if source.startswith(PREFIX) and not path.exists():  # before the # of a colour
        return names.read(source)
    if not path.exists() and "#" in source:
        head, _, pick = source.rpartition("#")
        path = Path(head)
    if path.is_dir():
        raise UsageError(f"{path} is a folder; expected a transfer-function file or a colour-map name")
    if not path.exists():
        if pick or "/" in source or "\\" in source or Path(source).suffix.lower() in SUFFIXES:
            raise UsageError(f"{path}: no such file; expected a transfer function ({', '.join(SUFFIXES)})")
        return names.read(source)
    try:
        return _read((lut.load if path.suffix.lower() in lut.SUFFIXES else load)(path), str(path), pick)
    except DataError:
        from vvgt_cli.look.label_files import is_table

        if not pick and is_table(path):
            raise DataError(
                f"{path}: a table of labels; expected a transfer function: give the table to --labels, 'vvgt info' "
                "lists it"
            ) from None
        raise


def _read(parsed: Any, what: str, pick: str) -> TransferFunction:
    """Return the function of a parsed file, by the first format that matches."""
    for reader in FORMATS:
        if reader.matches(parsed):
            return reader.read(parsed, what, pick)
    raise DataError(
        f"{what}: not a transfer function; expected a preset of ParaView or vtk.js (RGBPoints), an object with points, "
        "a volume property of 3D Slicer, a colour map of niivue (R, G, B), XML of ParaView or Inviwo"
    )
