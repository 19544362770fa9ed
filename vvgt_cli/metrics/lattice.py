"""How much a regular lattice shows in a picture: what the eye sees in close-ups and PSNR does not."""

from __future__ import annotations

import math

import numpy as np

SPOT = 2  # frequencies around a peak, in cycles a picture
AWAY = np.radians([25, 35, 55, 65])  # directions to compare with, from either axis


def lattice(image: np.ndarray, period: float) -> tuple[float, float]:
    """Power of a picture's spectrum at a lattice's frequency along its axes, against that around it.

    Args:
        image: (n, n) one channel; the lattice's lines run along its axes.
        period: of the lattice in pixels.

    Returns:
        (dB of the mean power at the two axes over that at as high frequencies in other directions, amplitude of the
        lattice's first harmonic in units of the image).

    Raises:
        ValueError: a picture that is not square, or a period of which the spectrum cannot tell.
    """
    n = len(image)
    cycles = n / period
    if image.shape != (n, n) or not 3 * SPOT <= cycles <= n / 2 - SPOT - 1:
        raise ValueError(f"{image.shape} px and a period of {period:g}; expected a square of 6 periods or more")
    window = np.hanning(n)
    power = np.abs(np.fft.fft2((image - image.mean()) * window[:, None] * window)) ** 2
    places = np.fft.fftfreq(n) * n

    def spot(x: float, y: float) -> float:
        return float(power[np.ix_(np.abs(places - y) <= SPOT, np.abs(places - x) <= SPOT)].sum())

    on = (spot(cycles, 0) + spot(0, cycles)) / 2
    off = np.mean([spot(cycles * math.cos(a), s * cycles * math.sin(a)) for a in AWAY for s in (1, -1)])
    amplitude = 2 * math.sqrt(on) / (n * float((window**2).sum()))  # Parseval, of a sine under the window
    return 10 * math.log10(max(on, 1e-300) / max(float(off), 1e-300)), amplitude
