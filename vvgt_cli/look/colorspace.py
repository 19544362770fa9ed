"""Colour spaces with vtkMath's constants (sRGB, D65, 2 degree observer), vectorised over (..., 3) float64."""

from __future__ import annotations

import numpy as np

WHITE = np.array([0.9505, 1.0, 1.089])
RGB_TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
XYZ_TO_RGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
# ProLab (Konovalenko et al., arXiv 2012.07653): projective map of XYZ / white
PROLAB = np.array([[75.54, 486.66, 167.39], [617.72, -595.45, -22.27], [48.34, 194.94, -243.28]])
PROLAB_DIVISOR = np.array([0.7554, 3.8666, 1.6739])
PROLAB_INVERSE = np.array(
    [
        [0.00137063282117354, 0.00138738203138321, 0.000816068851107095],
        [0.00137063282117354, -0.000243154854293407, 0.000965329194924993],
        [0.00137063282117354, 8.08345942991924e-05, -0.00317481896776885],
    ]
)
PROLAB_INVERSE_DIVISOR = np.array([-0.00862936717882646, -0.000243154854293407, 0.000965329194924994])


def rgb_to_xyz(rgb: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1] to XYZ (vtkMath::RGBToXYZ)."""
    linear = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
    result: np.ndarray = linear @ RGB_TO_XYZ.T
    return result


def xyz_to_rgb(xyz: np.ndarray) -> np.ndarray:
    """XYZ to sRGB in [0, 1]; out-of-gamut colours are divided by their largest component (vtkMath::XYZToRGB)."""
    linear = xyz @ XYZ_TO_RGB.T
    curved = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    rgb = np.where(linear > 0.0031308, curved, 12.92 * linear)
    largest = rgb.max(axis=-1, keepdims=True)
    result: np.ndarray = np.maximum(np.where(largest > 1.0, rgb / np.maximum(largest, 1.0), rgb), 0.0)
    return result


def rgb_to_lab(rgb: np.ndarray) -> np.ndarray:
    """sRGB to CIE L*a*b* (vtkMath::RGBToLab)."""
    t = rgb_to_xyz(np.asarray(rgb, dtype=np.float64)) / WHITE
    f = np.where(t > 0.008856, np.cbrt(t), 7.787 * t + 16.0 / 116.0)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def lab_to_rgb(lab: np.ndarray) -> np.ndarray:
    """CIE L*a*b* to sRGB in [0, 1] (vtkMath::LabToRGB)."""
    lightness, a, b = np.moveaxis(lab, -1, 0)
    y = (lightness + 16) / 116
    f = np.stack([a / 500 + y, y, y - b / 200], axis=-1)
    return xyz_to_rgb(np.where(f**3 > 0.008856, f**3, (f - 16.0 / 116.0) / 7.787) * WHITE)


def rgb_to_prolab(rgb: np.ndarray) -> np.ndarray:
    """sRGB to ProLab (vtkMath::RGBToProLab)."""
    xyz = rgb_to_xyz(np.asarray(rgb, dtype=np.float64)) / WHITE
    result: np.ndarray = (xyz @ PROLAB.T) / (xyz @ PROLAB_DIVISOR + 1.0)[..., None]
    return result


def prolab_to_rgb(lab: np.ndarray) -> np.ndarray:
    """ProLab to sRGB in [0, 1] (vtkMath::ProLabToRGB)."""
    xyz = (lab @ PROLAB_INVERSE.T) / (lab @ PROLAB_INVERSE_DIVISOR + 1.0)[..., None]
    return xyz_to_rgb(xyz * WHITE)


def rgb_to_hsv(rgb: np.ndarray) -> np.ndarray:
    """RGB to hue, saturation, value, each in [0, 1] (vtkMath::RGBToHSV); hue 0 without saturation."""
    rgb = np.asarray(rgb, dtype=np.float64)
    r, g, b = np.moveaxis(rgb, -1, 0)
    value, low = rgb.max(axis=-1), rgb.min(axis=-1)
    span = np.where(value > low, value - low, 1.0)
    hue = np.where(
        r == value, (g - b) / span / 6, np.where(g == value, 1 / 3 + (b - r) / span / 6, 2 / 3 + (r - g) / span / 6)
    )
    hue = np.where(value > low, np.where(hue < 0, hue + 1, hue), 0.0)
    saturation = np.where(value > 0, (value - low) / np.where(value > 0, value, 1.0), 0.0)
    return np.stack([hue, saturation, value], axis=-1)


def hsv_to_rgb(hsv: np.ndarray) -> np.ndarray:
    """Hue in [0, 1], saturation, value to RGB (vtkMath::HSVToRGB)."""
    hue, saturation, value = (c[..., None] for c in np.moveaxis(hsv, -1, 0))
    pure = np.clip(np.abs((6 * hue + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    result: np.ndarray = value * (saturation * pure + 1 - saturation)
    return result


def lab_to_msh(lab: np.ndarray) -> np.ndarray:
    """L*a*b* to Moreland's polar Msh ("Diverging Color Maps for Scientific Visualization", 2009)."""
    lightness, a, b = np.moveaxis(lab, -1, 0)
    m = np.sqrt(lightness**2 + a**2 + b**2)
    ratio = np.clip(lightness / np.where(m > 0, m, 1.0), -1, 1)
    s = np.where(m > 0.001, np.arccos(ratio), 0.0)
    h = np.where(s > 0.001, np.arctan2(b, a), 0.0)
    return np.stack([m, s, h], axis=-1)


def msh_to_lab(msh: np.ndarray) -> np.ndarray:
    """Moreland's Msh to L*a*b*."""
    m, s, h = np.moveaxis(msh, -1, 0)
    return np.stack([m * np.cos(s), m * np.sin(s) * np.cos(h), m * np.sin(s) * np.sin(h)], axis=-1)
