"""PET in standardised uptake values: activity per injected activity per gram of body weight.

Formula: QIBA's vendor-neutral pseudo-code for SUV
(https://qibawiki.rsna.org/index.php/Standardized_Uptake_Value_(SUV)); DICOM PS3.3, C.8.9.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from vvgt_cli.errors import DataError

SUV = "SUVbw"
PHILIPS = (0x7053, 0x1000)  # SUV per value, and who says so
TAGS = [
    *("Units", "SUVType", "CorrectedImage", "DecayCorrection", "PatientWeight", "SeriesDate", "SeriesTime"),
    *("RadiopharmaceuticalInformationSequence", "AcquisitionDate", "ActualFrameDuration", (0x7053, 0x0010), PHILIPS),
]
_UNITS = {"BQML": "Bq/ml", "GML": "g/ml", "CNTS": "counts"}
_LEAST = 1e5  # Bq: less is a dose in another unit
_HALVES = 10  # half-lives after which a scan is no scan of that dose


def in_suv(slices: list[Any], headers: list[Any], wanted: str | None, path: Path) -> tuple[list[Any], str]:
    """Return slices whose ``scaling`` gives SUV by body weight, and the unit of their values.

    ``headers`` are of the whole series. Values stay as stored if ``wanted`` is ``none``, and, with a message, if a
    header lacks something; raise DataError for that if it is ``bw``.
    """
    first = slices[0].header
    if first.get("Modality") != "PT":
        return slices, ""
    unit = _UNITS.get(first.get("Units"), "")
    if wanted == "none" or (wanted is None and first.get("Units") and not unit):
        return slices, unit
    earliest = min(headers, key=lambda header: _acquired(header) or datetime.max)
    try:
        factors = [_factor(s.header, earliest) for s in slices]
    except ValueError as why:
        text = f"{path}: no SUV, for want of {why}"
        if wanted is not None:
            raise DataError(f"{text}; expected it in the header: leave out --suv {wanted}") from None
        warnings.warn(f"{text}; values stay {f'in {unit}' if unit else 'as stored'}", stacklevel=3)
        return slices, unit
    return [replace(s, scaling=(s.scaling[0] * f, s.scaling[1] * f)) for s, f in zip(slices, factors, strict=True)], SUV


def _factor(header: Any, earliest: Any) -> float:
    """Return SUV per value; raise ValueError that names what a header, or the ``earliest`` of its series, lacks."""
    units = header.get("Units")
    if units == "GML" and header.get("SUVType") in (None, "", "BW"):
        return 1.0
    if units == "CNTS" and (factor := _number(header.get(PHILIPS))):
        return factor
    injected = (header.get("RadiopharmaceuticalInformationSequence") or [{}])[0]
    weight = _number(header.get("PatientWeight"))
    dose, half = (_number(injected.get(f"Radionuclide{key}")) for key in ("TotalDose", "HalfLife"))
    start, corrected = header.get("DecayCorrection"), header.get("CorrectedImage")
    stated = {
        "Units BQML, GML by body weight or CNTS with Philips' factor (7053,1000)": units == "BQML",
        "PatientWeight": weight > 0, "RadionuclideTotalDose in Bq": dose >= _LEAST,
        "DecayCorrection START or ADMIN": start in ("START", "ADMIN"),
        "RadionuclideHalfLife": half > 0 or start == "ADMIN",
        "ATTN and DECY in CorrectedImage": not corrected or {"ATTN", "DECY"} <= {*corrected},
    }  # fmt: skip
    if lacking := [key for key, there in stated.items() if not there]:
        raise ValueError(", ".join(lacking))
    decayed = 0.0 if start == "ADMIN" else _decay(injected, half, earliest) / half
    return float(1000 * weight / (dose * 2.0**-decayed))


def _decay(injected: Any, half: float, first: Any) -> float:
    """Return the seconds from injection to the start of the scan, to which images are corrected; raise ValueError."""
    acquired, scan = _acquired(first), _time(first.get("SeriesDate"), first.get("SeriesTime"))
    if scan is None or (acquired is not None and scan > acquired):  # of a series that was made later
        scan, at, frame = None, *(_number(first.get(f)) / 1000 for f in ("FrameReferenceTime", "ActualFrameDuration"))
        if acquired is not None and at > 0 and frame > 0:
            share = frame * math.log(2) / half
            scan = acquired + timedelta(seconds=half / math.log(2) * math.log(share / -math.expm1(-share)) - at)
    given = _time(injected.get("RadiopharmaceuticalStartDateTime"), "")
    given = given or (scan and _time(f"{scan:%Y%m%d}", injected.get("RadiopharmaceuticalStartTime")))
    if scan is None or given is None:
        raise ValueError("SeriesTime before AcquisitionTime" if scan is None else "RadiopharmaceuticalStartTime")
    seconds = (scan - given).total_seconds()
    if seconds < 0 and not injected.get("RadiopharmaceuticalStartDateTime"):
        seconds += timedelta(days=1).total_seconds()  # over midnight
    if not 0 <= seconds <= _HALVES * half:
        raise ValueError(f"a scan at most {_HALVES} half-lives after the injection ({seconds:g} s)")
    return seconds


def _acquired(header: Any) -> datetime | None:
    return _time(header.get("AcquisitionDate") or header.get("SeriesDate"), header.get("AcquisitionTime"))


def _time(date: Any, time: Any) -> datetime | None:
    """Return a date and time, local; None where they are missing or damaged."""
    from pydicom.valuerep import DT

    try:
        return datetime.replace(DT(f"{date}{time}"), tzinfo=None) if date and time is not None else None
    except (ValueError, TypeError):
        return None


def _number(value: Any) -> float:
    """Return a finite number, of an element or of text, else 0."""
    value = getattr(value, "value", value)
    try:
        number = float(value.decode() if isinstance(value, bytes) else value)
    except (TypeError, ValueError):
        return 0.0
    return number if math.isfinite(number) else 0.0
