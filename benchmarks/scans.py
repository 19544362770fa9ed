"""Volumes with the values of scans, for the pictures of automatic functions: made, not measured."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from vvgt_cli.volume import Volume

HEAD, TRUNK = (150, 160, 130), (150, 130, 180)  # voxels (z, y, x)
# values of air, muscle, fat, bone, liquor, grey and white matter, ventricles
HEADS = {
    "ct": (-1000, 40, -90, 1000, 0, 36, 30, 8),
    "t1": (0, 110, 330, 25, 30, 170, 230, 40),
    "t2": (0, 90, 260, 20, 480, 190, 130, 470),
}


def blur(values: np.ndarray, sigma: float | Sequence[float]) -> np.ndarray:
    """Gaussian filter of (nz, ny, nx) values, periodic; sigma in voxels."""
    spectrum = np.fft.rfftn(values)
    for axis, (n, s) in enumerate(zip(values.shape, np.broadcast_to(sigma, 3), strict=True)):
        k = np.fft.rfftfreq(n) if axis == 2 else np.fft.fftfreq(n)
        spectrum *= np.exp(-2 * (np.pi * k * s) ** 2).reshape([-1 if a == axis else 1 for a in range(3)])
    return np.fft.irfftn(spectrum, s=values.shape, axes=(0, 1, 2))


def texture(shape: tuple[int, ...], sigma: float, seed: int) -> np.ndarray:
    """Filtered noise of deviation 1."""
    noise = blur(np.random.default_rng(seed).standard_normal(shape), sigma)
    return noise / noise.std()


class Body:
    """A grid of ``shape`` (z, y, x) over boxes of half edges ``half`` mm, that ellipsoids and tubes are put into."""

    def __init__(self, shape: tuple[int, int, int], half: tuple[float, float, float], background: float) -> None:
        self.lines = [np.linspace(-e, e, k) for e, k in zip(half, shape, strict=True)]
        self.z, self.y, self.x = np.meshgrid(*self.lines, indexing="ij")
        self.values = np.full(shape, float(background))
        self.spacing = tuple(2 * e / (k - 1) for e, k in zip(half, shape, strict=True))[::-1]

    def radius(self, centre: Sequence[float], radii: Sequence[float]) -> np.ndarray:
        """Squared distance from a centre (x, y, z) in radii."""
        return sum(((g - c) / r) ** 2 for g, c, r in zip((self.x, self.y, self.z), centre, radii, strict=True))  # type: ignore[return-value]

    def ellipsoid(
        self, centre: Sequence[float], radii: Sequence[float], value: float, inside: np.ndarray | None = None
    ) -> np.ndarray:
        """Fill an ellipsoid and return which voxels it holds."""
        mask = self.radius(centre, radii) < 1
        if inside is not None:
            mask &= inside
        self.values[mask] = value
        return mask

    def tube(self, points: Sequence[Sequence[float]], radius: float, value: float) -> None:
        """Fill what lies within a radius of a line through points (x, y, z)."""
        line = np.asarray(points, dtype=float)
        for a, b in pairwise(line):
            low, high = np.minimum(a, b) - radius, np.maximum(a, b) + radius
            ends = [(np.searchsorted(g, low[2 - k]), np.searchsorted(g, high[2 - k])) for k, g in enumerate(self.lines)]
            part = tuple(slice(int(i), int(j)) for i, j in ends)
            at, along = np.stack([self.x[part], self.y[part], self.z[part]], -1), b - a
            u = np.clip(((at - a) @ along) / max(along @ along, 1e-9), 0, 1)
            self.values[part][((at - a - u[..., None] * along) ** 2).sum(-1) < radius**2] = value


def head(kind: str) -> Volume:
    """A head by CT (Hounsfield units) or MR (``t1``, ``t2``: with noise, and coils nearer to the face)."""
    body = Body(HEAD, (112, 112, 92), 0)
    air, muscle, fat, bone, liquor, grey, white, ventricle = HEADS[kind]
    body.values[:] = air
    rough = texture(HEAD, 6, 1) * 0.012
    skin = body.radius((0, 0, 15), (72, 92, 88)) + rough
    body.values[skin < 1] = muscle
    body.ellipsoid((0, 35, -50), (50, 55, 60), muscle)
    body.values[((body.x / 55) ** 2 + ((body.y + 10) / 60) ** 2 < 1) & (body.z < -20)] = muscle
    body.ellipsoid((0, 95, -10), (12, 14, 22), muscle)
    body.values[(skin < 1) & (skin > 0.9) & (body.z > 0)] = fat
    body.values[body.radius((0, -5, 25), (66, 85, 80)) + rough < 1] = bone
    brain, folds = body.radius((0, -5, 25), (60, 79, 74)) + rough, texture(HEAD, 3.2, 2)
    body.values[brain < 1] = liquor
    body.values[(brain < 0.93) & (folds < 1.1)] = grey
    body.values[(brain < 0.75) & (folds < 0.6)] = white
    body.values[(abs(body.x) < 2) & (brain < 0.93) & (body.z > 30)] = liquor
    hollow = air if kind == "ct" else 10
    for side in (-1, 1):
        body.ellipsoid((side * 14, -5, 30), (7, 32, 14), ventricle)
    for side in (-1, 1):
        body.ellipsoid((side * 30, 72, -2), (15, 15, 15), 10 if kind == "ct" else liquor)
        body.ellipsoid((side * 34, 60, -32), (13, 14, 15), hollow)
    body.ellipsoid((0, 65, -42), (9, 30, 8), hollow)
    body.tube([(-35, 65, -75), (-25, 82, -72), (0, 90, -70), (25, 82, -72), (35, 65, -75)], 7, bone)
    for side in (-1, 1):
        body.tube([(side * 45, 20, -45), (side * 35, 65, -75)], 6, bone)
    body.tube([(0, -25, -30), (0, -25, -112)], 16, bone)
    body.tube([(0, -38, -30), (0, -38, -112)], 6, muscle)
    for k in range(-3, 4):
        body.tube([(k * 6, 86 - abs(k) * 3, -62), (k * 6, 86 - abs(k) * 3, -52)], 2.6, 2200 if kind == "ct" else 5)
    values, noise = blur(body.values, 0.8), np.random.default_rng(3)
    if kind == "ct":
        values = np.clip(values + noise.normal(0, 12, HEAD), -1024, 3071)
    else:
        values *= 1 + 0.25 * (body.y / 112) + 0.15 * (body.x / 92)
        real = values + noise.normal(0, 9, HEAD)
        values = np.clip(np.hypot(real, noise.normal(0, 9, HEAD)), 0, 4095)
    return Volume(values.astype(np.int16), body.spacing, name=f"head {kind}")  # type: ignore[arg-type]


def trunk(contrast: bool) -> Volume:
    """An abdomen by CT, Hounsfield units; with contrast its vessels and kidneys are bright."""
    body = Body(TRUNK, (180, 130, 180), -1000)
    body.values[body.radius((0, 0, 0), (160, 105, 1e5)) < 1] = -100
    wall = body.radius((0, 0, 0), (140, 84, 1e5))
    body.values[(body.radius((0, 0, 0), (148, 92, 1e5)) < 1) & (wall > 1)] = 55
    inner, mixed = wall < 1, texture(TRUNK, 7, 5)
    body.values[inner] = np.where(mixed[inner] > 0, -80, 35)
    body.ellipsoid((-65, 10, 70), (68, 62, 65), 110 if contrast else 70, inner)
    body.ellipsoid((85, -20, 80), (30, 35, 45), 120 if contrast else 60, inner)
    for side in (-1, 1):
        body.ellipsoid((side * 62, -35, 10), (24, 24, 50), 180 if contrast else 40, inner)
        body.ellipsoid((side * 56, -33, 10), (9, 9, 26), -80, inner)
        body.ellipsoid((side * 62, 0, 190), (55, 70, 70), -850, inner)
    body.values[(mixed > 0.9) & inner & (body.z < 40) & (body.y > 0)] = -900
    _vessels(body, 380 if contrast else 150)
    body.tube([(20, -30, 180), (20, -30, -60)], 10, 150 if contrast else 90)
    _bones(body)
    body.values[(abs(body.y + 118) < 4) & (abs(body.x) < 150)] = -200
    values = blur(body.values, 0.8) + np.random.default_rng(1).normal(0, 18, TRUNK)
    return Volume(np.clip(values, -1024, 3071).astype(np.int16), body.spacing, name="trunk")  # type: ignore[arg-type]


def _vessels(body: Body, value: float) -> None:
    body.tube([(0, -30, 180), (0, -28, -60)], 10, value)
    for side in (-1, 1):
        body.tube([(0, -28, -60), (side * 30, -20, -120), (side * 60, 10, -180)], 7, value)
        body.tube([(0, -28, 10), (side * 45, -35, 12)], 4, value)
    body.tube([(0, -25, 50), (0, 15, 40), (-20, 25, -10)], 4.5, value)
    body.tube([(0, -25, 60), (-50, 0, 75)], 4, value)
    body.tube([(0, -25, 60), (70, -15, 80)], 3.5, value)


def _bones(body: Body) -> None:
    for z in np.arange(-170, 180, 32):
        body.ellipsoid((0, -60, z), (22, 18, 12), 350)
        body.ellipsoid((0, -60, z), (19, 15, 10), 220)
        body.tube([(0, -80, z), (0, -98, z - 8)], 5, 500)
        for side in (-1, 1):
            body.tube([(0, -75, z), (side * 40, -70, z - 6)], 4, 400)
    for z in np.arange(20, 180, 26):
        for side in (-1, 1):
            angles = np.linspace(-1.2, 1.3, 12)
            rib = [(side * 144 * np.cos(a), 88 * np.sin(a), z - 18 * (a + 1.2)) for a in angles]
            body.tube(rib, 5, 600)
            body.tube(rib, 3, 250)
    for side in (-1, 1):
        angles = np.linspace(-1.3, 0.7, 10)
        body.tube([(side * 109 * np.cos(a), 70 * np.sin(a), -110 - 25 * np.cos(2 * a)) for a in angles], 9, 550)


def cone_beam() -> Volume:
    """A head by cone-beam CT: cupped, noisy, cut by a cylinder, in no units."""
    values = head("ct").data[10:140, 15:145, 5:125].astype(float)
    _, y, x = np.mgrid[tuple(slice(-1, 1, n * 1j) for n in values.shape)]
    out = np.hypot(x, y)
    values = values * 0.72 + 180 * out**2 + np.random.default_rng(2).normal(0, 90, values.shape) + 1000
    values[out > 0.97] = 0
    return Volume(np.clip(values, 0, 4095).astype(np.uint16), (1.4, 1.4, 1.5), name="cone beam")


def nuclei() -> Volume:
    """A stack of a fluorescence microscope: blobs that fade with depth, photon noise, slices apart."""
    shape, random = (70, 180, 180), np.random.default_rng(4)
    values, (z, y, x) = np.zeros(shape), np.indices(shape)
    for _ in range(90):
        centre, radii, bright = (
            random.uniform((8, 0, 0), (62, 180, 180)),
            random.uniform(5, 9, 3),
            random.uniform(0.4, 1),
        )
        part = tuple(slice(max(0, int(c - 12)), int(c + 12)) for c in centre)
        away = [((g[part] - c) / r) ** 2 for g, c, r in zip((z, y, x), centre, radii * (0.6, 1, 1), strict=True)]
        values[part] = np.maximum(values[part], (sum(away) < 1) * bright)
    values *= 1 + 0.3 * texture(shape, 1.5, 9)
    photons = np.clip(blur(values, (2.5, 1, 1)) * np.exp(-z / 90), 0, None) * 900 + 60
    counts = random.poisson(photons) + random.normal(100, 4, shape)
    return Volume(np.clip(counts, 0, 65535).astype(np.uint16), (0.2, 0.2, 0.5), name="nuclei")


def angiography() -> Volume:
    """Time-of-flight angiography of a head, MR: vessels on a noisy, darker brain, in no units."""
    body = Body(HEAD, (80, 95, 70), 0)
    brain = body.radius((0, 0, 0), (70, 88, 66))
    body.values[brain < 1] = 110
    body.values[brain < 0.86] = 150
    for side in (-1, 1):
        carotid = [(side * 22, 10, -70), (side * 24, 14, -40), (side * 14, 22, -18), (side * 16, 12, -4)]
        body.tube(carotid, 3.2, 900)
        body.tube([carotid[-1], (side * 38, 14, 2), (side * 52, 4, 14), (side * 60, -14, 30)], 2.2, 800)
        body.tube([(side * 38, 14, 2), (side * 50, 28, 18), (side * 52, 30, 40)], 1.6, 700)
        body.tube([carotid[-1], (side * 4, 32, 2), (side * 4, 52, 18), (side * 4, 46, 42)], 1.8, 750)
        body.tube([(side * 6, -12, -70), (0, -8, -36)], 2.2, 850)
        body.tube([(0, -4, -10), (side * 18, -22, -4), (side * 24, -52, 4), (side * 14, -66, 16)], 1.8, 750)
    body.tube([(0, -8, -36), (0, -4, -10)], 2.8, 880)
    random = np.random.default_rng(6)
    values = blur(body.values, 0.7) * (1 + 0.05 * texture(HEAD, 5, 6))
    values = np.hypot(values + random.normal(0, 12, HEAD), random.normal(0, 12, HEAD))
    return Volume(values.astype(np.int16), body.spacing, name="angiography", space="RAS")  # type: ignore[arg-type]


def density() -> Volume:
    """The map of a particle by cryo-electron microscopy: a ring of helices in a noisy box, angstroms."""
    shape = (110, 110, 110)
    body = Body(shape, (80, 80, 80), 0)
    turn = np.linspace(0, 6 * np.pi, 60)
    for k in range(7):
        angle = 2 * np.pi * k / 7
        for radius, high in ((44, 0), (30, 10)):
            middle = radius * np.array([np.cos(angle), np.sin(angle)])
            coil = [(middle[0] + 5 * np.cos(t), middle[1] + 5 * np.sin(t), high - 30 + 60 * t / turn[-1]) for t in turn]
            body.tube(coil, 3.0, 1.0)
    values = blur(body.values, 1.3) + 0.02 * texture(shape, 1.2, 8)
    return Volume(values.astype(np.float32), body.spacing, name="density", density=True)  # type: ignore[arg-type]


def orbital() -> Volume:
    """A 3d orbital (xy) of hydrogen: lobes of both signs, angstroms."""
    axis = np.linspace(-14, 14, 100)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    values = x * y * np.exp(-np.sqrt(x * x + y * y + z * z) / 1.6)
    return Volume(values.astype(np.float32), (0.28, 0.28, 0.28), name="orbital", density=True)
