"""The number for a lattice: found where there is one, at its amplitude; and how much of one the closed form has."""

import math
from dataclasses import replace

import numpy as np
import pytest

from vvgt_cli.cameras.sets import look_at
from vvgt_cli.closed_form import VbmOptions, initialise
from vvgt_cli.dvr import Scene, render_view
from vvgt_cli.look.readers import minimal
from vvgt_cli.splat import render
from vvgt_cli.volume import Volume

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


def waves(period, amplitude, n=256):
    x = np.arange(n)
    return amplitude * (np.sin(2 * np.pi * x / period) + np.sin(2 * np.pi * x / period)[:, None])


def test_a_lattice_is_found_in_noise_at_its_period():
    noise = np.random.default_rng(0).normal(0, 0.01, (256, 256))
    db, amplitude = lattice(noise + waves(11.0, 0.02), 11.0)
    assert db > 20
    assert amplitude == pytest.approx(0.02, rel=0.3)
    assert lattice(noise + waves(11.0, 0.02), 7.0)[0] < 6
    assert abs(lattice(noise, 11.0)[0]) < 6


def test_lines_along_either_axis_count_alike():
    noise = np.random.default_rng(0).normal(0, 0.01, (256, 256))
    lines = 0.02 * np.sin(2 * np.pi * np.arange(256) / 11.0)
    across, down = lattice(noise + lines, 11.0), lattice((noise + lines).T, 11.0)
    assert across == pytest.approx(down, rel=1e-6)
    assert across[0] > 20
    assert across[1] == pytest.approx(0.02 / np.sqrt(2), rel=0.3)  # of two axes one has it


def test_what_cannot_be_measured_is_refused():
    for image, period in ((np.zeros((64, 32)), 8.0), (np.zeros((64, 64)), 20.0), (np.zeros((64, 64)), 2.0)):
        with pytest.raises(ValueError, match="period"):
            lattice(image, period)


def test_a_translucent_block_close_up_shows_little_of_its_cells():
    """From afar through a narrow field, so that all cells of the block have one period."""
    values = np.zeros((32, 32, 32), np.float32)
    values[2:30, 2:30, 2:30] = 1
    points = [{"x": x, "rgb": [0.9, 0.6, 0.3], "opacity": 0.04 * x} for x in (0.0, 1.0)]
    scene = Scene.build(Volume(values), minimal.read({"points": points}, "fog"), 1.0, (0.0, 1.0))
    gaussians = initialise(scene, VbmOptions(6000, 1080)).gaussians
    camera = look_at((40.0, 0.001, 0.0), width=256, height=256, fov=1.0)
    camera = replace(camera, fx=256 * 40.0, fy=256 * 40.0)  # a width of 1, of 2, at the volume
    ours, reference = (image[..., :3].mean(axis=2) for image in (render(gaussians, camera), render_view(scene, camera)))
    voxel = 2 / 32 * 256  # pixels
    found = [lattice(ours - reference, voxel * 2.0**level)[1] for level in (-2, -1, 0, 1)]
    assert max(found) < 0.008 * reference.mean()  # a spread of 1.5 has 0.011
