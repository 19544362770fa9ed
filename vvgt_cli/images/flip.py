"""LDR-FLIP, the perceived difference when alternating between two images.

Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild: "FLIP: A Difference Evaluator for Alternating
Images", HPG 2020. Sections and equations are numbered as in the paper.
"""

from __future__ import annotations

import math

import numpy as np

from vvgt_cli.errors import DataError
from vvgt_cli.images.filters import correlate, separable

PIXELS_PER_DEGREE = 67.0206  # 0.7 m from a 0.7 m wide display of 3840 pixels
Q_C, P_C, P_T = 0.7, 0.4, 0.95  # colour: exponent, and the knee of the error redistribution
Q_F, FEATURE_WIDTH = 0.5, 0.082  # features: exponent, width of the detector in degrees
# contrast sensitivity, sum of Gaussians a sqrt(pi / b) exp(-pi^2 r^2 / b): (a, b) a term, in degrees
CSF = {"A": [(1.0, 0.0047)], "RG": [(1.0, 0.0053)], "BY": [(34.1, 0.04), (13.5, 0.025)]}
CSF_WIDEST = 0.04

RGB_TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
XYZ_TO_RGB = np.linalg.inv(RGB_TO_XYZ)
WHITE = RGB_TO_XYZ.sum(axis=1)


def flip(reference: np.ndarray, ours: np.ndarray, pixels_per_degree: float = PIXELS_PER_DEGREE) -> float:
    """Return the mean LDR-FLIP error in [0, 1] of sRGB images in [0, 1], (h, w, 3) each (clipped).

    Raises:
        DataError: the shapes differ or are not (h, w, 3).
    """
    return float(flip_map(reference, ours, pixels_per_degree).mean(dtype=np.float64))


def flip_map(reference: np.ndarray, ours: np.ndarray, pixels_per_degree: float = PIXELS_PER_DEGREE) -> np.ndarray:
    """Return the LDR-FLIP error of each pixel, (h, w) float32 in [0, 1]; arguments and errors as in `flip`."""
    reference, ours = np.asarray(reference), np.asarray(ours)
    if reference.shape != ours.shape or reference.ndim != 3 or reference.shape[2] != 3 or 0 in reference.shape:
        raise DataError(f"FLIP of images {reference.shape} and {ours.shape}; expected the same (h, w, 3)")
    opponent = [_opponent(np.clip(image, 0, 1)) for image in (reference, ours)]
    colors = [_perceived(image, pixels_per_degree) for image in opponent]
    error = _redistributed(_hyab(*colors))
    features = [_features(image[0], pixels_per_degree) for image in opponent]
    edges, points = (np.abs(a - b) for a, b in zip(*features, strict=True))
    feature = (np.maximum(edges, points) / np.float32(math.sqrt(2))) ** np.float32(Q_F)
    result: np.ndarray = error ** (1 - np.clip(feature, 0, 1))
    return result


def _opponent(srgb: np.ndarray) -> np.ndarray:
    """Convert sRGB (h, w, 3) to the planes Y, Cx, Cz, (3, h, w) float32, of the linearised opponent space."""
    planes = np.ascontiguousarray(np.moveaxis(srgb, -1, 0), dtype=np.float32)
    linear = np.where(
        planes > 0.04045,
        ((planes + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4),
        planes / np.float32(12.92),
    )
    to_opponent = np.array([[0, 116, 0], [500, -500, 0], [0, 200, -200]]) @ (RGB_TO_XYZ / WHITE[:, None])
    planes = _mix(to_opponent, linear)
    planes[0] -= 16
    return planes


def _mix(matrix: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Multiply planes (3, h, w) by a 3 x 3 matrix, float32."""
    result: np.ndarray = (matrix.astype(np.float32) @ planes.reshape(3, -1)).reshape(planes.shape)
    return result


def _perceived(opponent: np.ndarray, ppd: float) -> np.ndarray:
    """Filter planes by contrast sensitivity and convert them to Hunt-adjusted L*a*b* (3, h, w) (section 4.1)."""
    radius = math.ceil(3 * math.sqrt(CSF_WIDEST / (2 * math.pi**2)) * ppd)
    x = np.arange(-radius, radius + 1) / ppd
    filtered = np.empty_like(opponent)
    for plane, out, terms in zip(opponent, filtered, CSF.values(), strict=True):
        kernels = [np.exp(-(math.pi**2) * x**2 / b) for _, b in terms]
        weights = [a * math.sqrt(math.pi / b) for a, b in terms]
        total = sum(w * k.sum() ** 2 for w, k in zip(weights, kernels, strict=True))
        padded = np.pad(plane, radius, mode="edge")
        out[:] = sum(separable(padded, k, k * (w / total)) for w, k in zip(weights, kernels, strict=True))
    filtered[0] += 16
    to_xyz = np.array([[1 / 116, 1 / 500, 0], [1 / 116, 0, 0], [1 / 116, 0, -1 / 200]])  # relative to white
    linear = np.clip(_mix(XYZ_TO_RGB @ (WHITE[:, None] * to_xyz), filtered), 0, 1)
    return _hunt_lab(linear)


def _hunt_lab(linear: np.ndarray) -> np.ndarray:
    """Convert linear RGB planes (3, h, w) to L*a*b* with a* and b* scaled by lightness (equation 4)."""
    t = _mix(RGB_TO_XYZ / WHITE[:, None], linear)
    delta = 6 / 29
    x, y, z = np.where(t > delta**3, np.cbrt(t), t / np.float32(3 * delta**2) + np.float32(4 / 29))
    lightness = 116 * y - 16
    scale = np.float32(0.01) * lightness
    return np.stack([lightness, 500 * (x - y) * scale, 200 * (y - z) * scale])


def _hyab(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the HyAB distance (h, w) of L*a*b* planes (3, h, w) (equation 5)."""
    difference = a - b
    result: np.ndarray = np.abs(difference[0]) + np.hypot(difference[1], difference[2])
    return result


def _redistributed(distance: np.ndarray) -> np.ndarray:
    """Map colour distances to errors in [0, 1], most of that range for small distances (section 4.1.4)."""
    green, blue = (_hunt_lab(np.eye(3, dtype=np.float32)[i].reshape(3, 1, 1)) for i in (1, 2))
    largest = float(_hyab(green, blue)[0, 0]) ** Q_C
    power = distance ** np.float32(Q_C)
    knee = P_C * largest
    above = P_T + (power - knee) / (largest - knee) * (1 - P_T)
    return np.where(power < knee, power * np.float32(P_T / knee), above).astype(np.float32)


def _features(y: np.ndarray, ppd: float) -> tuple[np.ndarray, np.ndarray]:
    """Return edge and point strength of the luminance plane (h, w), (h, w) each (section 4.2)."""
    sigma = 0.5 * FEATURE_WIDTH * ppd
    radius = math.ceil(3 * sigma)
    x = np.arange(-radius, radius + 1)
    gauss = np.exp(-(x**2) / (2 * sigma**2))
    gauss /= gauss.sum()
    edge, point = _balanced(-x * gauss), _balanced((x**2 / sigma**2 - 1) * gauss)
    padded = np.pad((y + 16) / 116, radius, mode="edge")
    smooth_x = correlate(padded, gauss, 1)
    strengths = []
    for kernel in (edge, point):
        along_x = correlate(correlate(padded, kernel, 1), gauss, 0)
        along_y = correlate(smooth_x, kernel, 0)
        strengths.append(np.hypot(along_x, along_y))
    return strengths[0], strengths[1]


def _balanced(kernel: np.ndarray) -> np.ndarray:
    """Scale positive weights to a sum of 1, negative ones to a sum of -1."""
    result: np.ndarray = np.where(kernel < 0, kernel / -kernel[kernel < 0].sum(), kernel / kernel[kernel > 0].sum())
    return result
