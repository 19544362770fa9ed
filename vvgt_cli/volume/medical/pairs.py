"""AFNI (``.HEAD`` with ``.BRIK``) and Philips (``.PAR`` with ``.REC``), read by nibabel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.volume.labelled import Axis, labelled_volume
from vvgt_cli.volume.medical.nifti import other_of_pair
from vvgt_cli.volume.reading import ReadOptions, Volume, library_errors, need, unit_rows, volume_name

_UNITS = {77001: "ms", 77002: "s"}  # of TAXIS_NUMS (AFNI, README.attributes)


def read_pair(path: Path, options: ReadOptions) -> Volume:
    """Read a pair by either of its files; values are scaled, float32 where the file has a factor.

    Philips' values are the "floating point" ones (1 / scale slope), which compare between scans. A fourth axis is time
    where only dynamics differ along it, else ``component`` takes a number or a label along it (AFNI's sub-bricks).
    """
    afni = path.name.lower().endswith((".head", ".brik", ".brik.gz"))
    kind, names = ("AFNI", (".HEAD", ".BRIK")) if afni else ("Philips PAR/REC", (".PAR", ".REC"))
    header, image = (other_of_pair(path, suffix) for suffix in names)
    if header is None or image is None:
        raise DataError(f"{path}: one file of a pair; expected {names[0]} and {names[1]} of the same name side by side")
    nibabel = need("nibabel", "neuro", str(path), kind)
    with library_errors(str(path), f"{kind} ({'3dAFNItoNIFTI' if afni else 'dcm2niix'} may convert it to NIfTI)"):
        files = {"header": nibabel.FileHolder(str(header)), "image": nibabel.FileHolder(str(image))}
        if afni:
            loaded = need("nibabel.brikhead", "neuro", str(path), kind).AFNIImage.from_file_map(files)
        else:
            loaded = nibabel.parrec.PARRECImage.from_file_map(files, scaling="fp")
        data, shape = loaded.dataobj, loaded.shape
        dtype = data[tuple(slice(0, 1) for _ in shape)].dtype
        if dtype == np.float64 and data.dtype != np.float64:
            dtype = np.dtype(np.float32)
        axes = [Axis(name, n, role=name) for name, n in zip("xyz", shape, strict=False)]
        axes += [(_bricks if afni else _dynamics)(loaded.header, n) for n in shape[3:]]
        lengths, direction = unit_rows(loaded.affine[:3, :3].T.tolist())
        chunks = None if image.suffix.lower() == ".gz" else (*shape[:2], *(1 for _ in shape[2:]))

        def part(index: tuple[Any, ...]) -> np.ndarray:
            return np.asarray(data[index]).astype(dtype, copy=False)

        volume = labelled_volume(
            part, dtype, axes, {}, replace(options, spacing=None), str(path), volume_name(path), chunks
        )
        origin = tuple(loaded.affine[:3, 3].tolist())
        return replace(volume, spacing=options.spacing_or(lengths), origin=origin, direction=direction, space="RAS")


def _bricks(header: Any, size: int) -> Axis:
    """Return AFNI's fourth axis: time where the header has a time axis, else sub-bricks with their labels."""
    nums, floats = (header.info.get(key) for key in ("TAXIS_NUMS", "TAXIS_FLOATS"))
    if nums and floats:
        unit = _UNITS.get(nums[2], "")
        return Axis("time", size, floats[0] + floats[1] * np.arange(size) if unit else None, unit, "t")
    labels = tuple(map(str, header.get_volume_labels() or ()))
    return Axis("sub-brick", size, labels=labels if len(labels) == size else ())


def _dynamics(header: Any, size: int) -> Axis:
    """Return Philips' fourth axis: time where it is of dynamics alone, else with a label of what differs."""
    differ = header.get_volume_labels()
    if set(differ) == {"dynamic scan number"}:
        return Axis("dynamic", size, role="t")
    labels = [", ".join(f"{key} {values[n]}" for key, values in differ.items()) for n in range(size)]
    return Axis("volume", size, labels=tuple(labels) if differ else ())
