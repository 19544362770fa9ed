"""Mapping a transfer function to the data: ``--tf-range``, ``--opacity-unit-distance``, and what is visible."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.look.function import BY, PER_VOXEL, TransferFunction
from vvgt_cli.look.isosurfaces import Isosurfaces
from vvgt_cli.look.recognise import foreground, in_hounsfield, moments
from vvgt_cli.volume import Statistics, Volume
from vvgt_cli.volume.components import listed

ABOUT_ONE = 2.0  # span of data up to which nodes in [0, 1] are values of theirs


def parse_tf_range(spec: str | tuple[float, float]) -> str | tuple[float, float]:
    """Return ``data``, ``rescale`` or two ascending numbers; raise UsageError for anything else."""
    if spec in ("data", "rescale"):
        return spec
    try:
        lo, hi = (float(v) for v in (spec.split(",") if isinstance(spec, str) else spec))
    except ValueError:
        raise UsageError(f"--tf-range {spec!r}; expected data, rescale or two numbers LO,HI") from None
    if not (math.isfinite(lo) and math.isfinite(hi) and lo < hi):
        raise UsageError(f"--tf-range {lo:g},{hi:g}; expected two finite numbers, LO below HI")
    return lo, hi


def resolve(
    tf: TransferFunction, statistics: Statistics, tf_range: str | tuple[float, float] = "data", hounsfield: bool = False
) -> TransferFunction:
    """Return the function with its nodes on data values.

    With ``data``, nodes in [0, 1] over data that are not may be meant as fractions of the range. A note says which was
    assumed: values if the data overlap [0, 1] and span no more than `ABOUT_ONE`, else as with ``rescale``.

    ``tf_range``: ``data`` takes nodes as they are (fractions and percentiles: of the data), ``rescale`` stretches them
    linearly to the data range, ``LO,HI`` to that range. ``hounsfield`` is whether the file states Hounsfield units;
    else the histogram decides.

    Raises:
        DataError: no finite voxel; a function of one position to stretch.
        UsageError: an invalid ``tf_range``, or a range for a function of percentiles.
    """
    chosen = parse_tf_range(tf_range)
    lo, hi = _data_range(statistics)
    if tf.otherwise is not None and chosen == "data" and not (hounsfield or look_like_hounsfield(statistics)):
        warnings.warn(
            f"{tf.name}: values {lo:g} to {hi:g} are not in Hounsfield units; shown by {BY[tf.otherwise.domain]}, a "
            "guess: compare with no --tf, or give --tf-range LO,HI",
            stacklevel=2,
        )
        tf = replace(tf.otherwise, name=f"{tf.name} ({BY[tf.otherwise.domain]})")
    if not isinstance(chosen, str) or chosen == "rescale" or tf.domain == "fraction":
        return placed(tf, (lo, hi) if isinstance(chosen, str) else chosen)
    if isinstance(tf, Isosurfaces):
        return tf.placed(statistics, hounsfield or look_like_hounsfield(statistics))
    if tf.domain in BY:
        return tf.moved(_positions(tf, statistics))
    first, last = tf.node_range()
    if not (first >= 0 and last <= 1 and (lo < 0 or hi > 1)):
        return tf
    where = f"{tf.name}: all nodes lie in [{first:g}, {last:g}], the data in [{lo:g}, {hi:g}]"
    if first == last or (lo <= 1 and hi >= 0 and hi / 2 - lo / 2 <= ABOUT_ONE / 2):
        warnings.warn(f"{where}; taken as data values (--tf-range rescale stretches them to the data)", stacklevel=2)
        return tf
    asked = f"--tf-range {first:g},{last:g}"
    warnings.warn(f"{where}; stretched to the data, as with --tf-range rescale ({asked}: data values)", stacklevel=2)
    return tf.rescaled(lo, hi)


def placed(tf: TransferFunction, limits: tuple[float, float] | None) -> TransferFunction:
    """Return the function on data values, stretched to ``limits``; raise UsageError where they do not suit it."""
    if tf.domain in BY:
        if limits is not None:
            raise UsageError(f"{tf.name}: its nodes are {BY[tf.domain]} of the data; omit --tf-range")
        return tf
    if tf.domain == "fraction":
        if limits is None:
            raise UsageError(
                f"{tf.name}: its nodes are fractions of the range of the data; give that range as --tf-range LO,HI"
            )
        share = tf.breakpoints()
        return tf.moved(limits[0] * (1 - share) + limits[1] * share)
    return tf if limits is None else tf.rescaled(*limits)


def unit_of_values(stated: str, tf: object) -> str:
    """Return the unit of values: the file's, else HU under a function that is over those; "" if unknown."""
    return stated or ("HU" if isinstance(tf, TransferFunction) and tf.otherwise is not None else "")


def look_like_hounsfield(statistics: Statistics) -> bool:
    """Return whether the histogram of data values is that of Hounsfield units."""
    counts = np.asarray(statistics.histogram, dtype=np.float64)
    return bool(counts.any()) and in_hounsfield(counts, np.asarray(statistics.edges, dtype=np.float64))


def _positions(tf: TransferFunction, statistics: Statistics) -> np.ndarray:
    """Return data values of the breakpoints (m,) of a function on percentiles, standard deviations or means."""
    counts, edges = (np.asarray(a, dtype=np.float64) for a in (statistics.histogram, statistics.edges))
    if tf.domain == "sigma" and counts.any():
        mean, deviation = moments(counts, edges)
        return mean + deviation * tf.breakpoints()
    front = foreground(counts) if tf.domain in ("foreground", "mean") and counts.any() else counts
    if tf.domain == "mean":  # of densities, which begin at 0
        scaled = front * np.clip(edges[:-1] / 2 + edges[1:] / 2, 0, None)
        return tf.breakpoints() * (float(scaled.sum() / front[scaled > 0].sum()) if scaled.any() else 1.0)
    return _quantiles(front, edges, tf.breakpoints())


def percentiles(statistics: Statistics, fraction: np.ndarray) -> np.ndarray:
    """Return data values below which ``fraction`` (n,) in [0, 1] of the voxels lie, linear within bins, (n,)."""
    counts, edges = (np.asarray(a, dtype=np.float64) for a in (statistics.histogram, statistics.edges))
    return _quantiles(counts, edges, fraction)


def _quantiles(counts: np.ndarray, edges: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    cumulative = np.concatenate([[0.0], np.cumsum(counts)])
    if cumulative[-1] <= 0:
        raise DataError("the data have no finite voxel; expected some to take percentiles of")
    # from the first bin that counts to the last
    first, last = np.flatnonzero(counts)[[0, -1]] + [0, 2]
    return np.interp(fraction, cumulative[first:last] / cumulative[-1], edges[first:last])


def unit_distance(spec: str | float | None, volume: Volume, tf: TransferFunction | None = None) -> tuple[float, str]:
    """Return the world length that opacities are per, and its source.

    Args:
        spec: a positive number; ``paraview``: diagonal of the box of voxel centres over the cube root of the number of
            cells, prod(dims - 1), as ParaView's domain of ScalarOpacityUnitDistance does (axes of one voxel are
            skipped: with k others it is the k-th root; a single voxel has the mean spacing); ``mean-spacing``:
            arithmetic mean of the three spacings; None: the function's own, or ``paraview``.
        volume: dimensions and spacing.
        tf: the function, None if only the volume decides.

    Returns:
        (distance, label), the label one of ``given``, ``file``, ``paraview``, ``mean-spacing``, or the function's own.

    Raises:
        UsageError: an invalid ``spec``.
    """
    if spec is None:
        if tf is not None and tf.opacity_unit_distance is not None:
            return tf.opacity_unit_distance, tf.opacity_unit_label
        if tf is not None and tf.opacity_unit_share is not None:
            return tf.opacity_unit_share * max(volume.extent), tf.opacity_unit_label
        spec = PER_VOXEL if tf is not None and tf.opacity_unit_label == PER_VOXEL else "paraview"
    mean = sum(volume.spacing) / 3
    if spec == PER_VOXEL:
        return mean, PER_VOXEL
    if spec == "paraview":
        axes = [(n - 1, s) for n, s in zip(volume.dims, volume.spacing, strict=True) if n > 1]
        if not axes:
            return mean, "paraview"
        diagonal = math.hypot(*(n * s for n, s in axes))
        return diagonal / math.prod(n for n, _ in axes) ** (1 / len(axes)), "paraview"
    try:
        distance = float(spec)
    except ValueError:
        distance = math.nan
    if not (math.isfinite(distance) and distance > 0):
        raise UsageError(f"--opacity-unit-distance {spec}; expected a positive number, paraview or mean-spacing")
    return distance, "given"


def check_visible(tf: TransferFunction, statistics: Statistics) -> None:
    """Raise DataError if the function (on data values) makes every value of the data transparent."""
    lo, hi = _data_range(statistics)
    if tf.support(lo, hi):
        return
    everywhere = [f"[{a:g}, {b:g}]" for a, b in tf.support(-math.inf, math.inf)]
    where = f"in {listed(everywhere, ', ', 6)}" if everywhere else "nowhere"
    raise DataError(
        f"{tf.name}: nothing is visible: the data lie in [{lo:g}, {hi:g}], opacity is above 0 "
        f"{where}; try --tf-range rescale, or another function"
    )


def _data_range(statistics: Statistics) -> tuple[float, float]:
    lo, hi = float(statistics.lo), float(statistics.hi)
    if not (math.isfinite(lo) and math.isfinite(hi) and lo <= hi):
        raise DataError("the data have no finite voxel; expected some to colour")
    return lo, hi
