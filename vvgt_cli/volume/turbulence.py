"""Incompressible turbulence in a periodic box by a pseudo-spectral method, isotropic or rotating and stratified.

    du/dt = u x w - 2 Omega z x u - N b z - grad p + nu lap u + f,   div u = 0,   w = curl u
    db/dt = -div(u b) + N u_z + nu lap b

b is the deviation of the temperature from its mean gradient, in units of velocity (Prandtl number 1), so that
``E = (|u|^2 + b^2) / 2`` changes only by forcing and viscosity. The box is 2 pi wide. Products are computed in space
and truncated at 2/3 of the wave numbers (Orszag 1971); time steps are RK4 with an integrating factor for the viscous
terms (Canuto et al., "Spectral Methods", 2007, appendix D). The forcing feeds the largest modes with constant power,
``f = P u_low / (2 E_low)`` (Machiels 1997). The two flows are small versions of the paper's data sets.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.progress import ProgressCallback
from vvgt_cli.volume.blocks import check_memory

POWER = 1.0  # input per unit volume, which sets the unit of time
FORCED = 2.5  # wave numbers below this are forced
RESOLVED = 1.2  # largest wave number kept, times the Kolmogorov length
COURANT = 0.8
BYTES = 500  # peak memory per grid point
TURNOVER = (math.pi**2 / POWER) ** (1 / 3)  # time of the forced eddies, half a box wide: (L^2 / P)^(1/3)


@dataclass(frozen=True)
class Flow:
    """The parameters of a flow.

    Attributes:
        size: grid points along each axis.
        viscosity: nu, which is also the diffusivity of b.
        power: power of the forcing; 0 lets the flow decay.
        rotation: Omega about z.
        stratification: N, None for a flow without b.
    """

    size: int
    viscosity: float
    power: float = POWER
    rotation: float = 0.0
    stratification: float | None = None

    def __post_init__(self) -> None:
        """Check the size."""
        if self.size < 8:
            raise UsageError(f"turbulence of {self.size} grid points per side: expected at least 8")
        check_memory(self.size**3 * BYTES, f"a flow of {self.size} x {self.size} x {self.size} points")


def resolved_viscosity(size: int) -> float:
    """Return the nu that just resolves the smallest eddies: kmax eta = `RESOLVED`, eta = (nu^3 / P)^(1/4)."""
    return float((RESOLVED * 3 / size) ** (4 / 3) * POWER ** (1 / 3))


class Solver:
    """The equations in Fourier space; a state is (3 or 4, n, n, n / 2 + 1) complex128, axes z, y, x: u, then b."""

    def __init__(self, flow: Flow) -> None:
        """Prepare the wave numbers of a flow."""
        self.flow, n = flow, flow.size
        line, half = np.fft.fftfreq(n, 1 / n), np.fft.rfftfreq(n, 1 / n)
        self.k = np.stack(np.broadcast_arrays(half[None, None, :], line[None, :, None], line[:, None, None]))
        self.k2 = (self.k**2).sum(axis=0)
        self.over_k2 = 1 / np.where(self.k2 > 0, self.k2, 1)
        self.kept = (np.abs(self.k) < n / 3).all(axis=0)
        # a mode also represents its conjugate, except where the wave number of x is its own mirror image
        self.weight = np.where((half == 0) | (half == n / 2), 1.0, 2.0) / n**6
        self.low = (self.k2 > 0) & (self.k2 < FORCED**2)

    def to_space(self, modes: np.ndarray) -> np.ndarray:
        """Transform modes to space, (c, n, n, n) float64."""
        return np.fft.irfftn(modes, s=(self.flow.size,) * 3, axes=(1, 2, 3))

    def to_modes(self, fields: np.ndarray) -> np.ndarray:
        """Transform fields to modes, the inverse of `to_space`."""
        return np.fft.rfftn(fields, axes=(1, 2, 3))

    def project(self, modes: np.ndarray) -> np.ndarray:
        """Return the divergence-free part of modes (3, ...)."""
        return np.asarray(modes - self.k * ((self.k * modes).sum(axis=0) * self.over_k2))

    def curl(self, u: np.ndarray) -> np.ndarray:
        """Return the modes of the vorticity."""
        return 1j * np.cross(self.k, u, axis=0)

    def energy(self, state: np.ndarray) -> float:
        """Return the mean of (|u|^2 + b^2) / 2, by Parseval's theorem."""
        return float((np.abs(state) ** 2 * self.weight).sum()) / 2

    def dissipation(self, state: np.ndarray) -> float:
        """Return nu times the mean of |grad u|^2 + |grad b|^2."""
        return float((np.abs(state) ** 2 * self.weight * self.k2).sum()) * self.flow.viscosity

    def slope(self, state: np.ndarray) -> np.ndarray:
        """Return d(state)/dt without the viscous terms."""
        flow, u = self.flow, state[:3]
        velocity = self.to_space(u)
        out = np.empty_like(state)
        out[:3] = self.to_modes(np.cross(velocity, self.to_space(self.curl(u)), axis=0))
        out[0] += 2 * flow.rotation * u[1]
        out[1] -= 2 * flow.rotation * u[0]
        if flow.stratification is not None:
            b = state[3]
            out[2] -= flow.stratification * b
            flux = self.to_modes(velocity * self.to_space(state[3:]))
            out[3] = flow.stratification * u[2] - 1j * (self.k * flux).sum(axis=0)
        out *= self.kept
        out[:3] = self.project(out[:3])
        if flow.power:
            low = u * self.low
            out[:3] += low * (flow.power / max(2 * self.energy(low), 1e-30))
        return out

    def step(self, state: np.ndarray, dt: float) -> np.ndarray:
        """Advance the state by ``dt``: RK4 for ``exp(nu k^2 t) state``."""
        half = np.exp(-self.flow.viscosity * self.k2 * (dt / 2))
        a = self.slope(state)
        b = self.slope(half * (state + dt / 2 * a))
        c = self.slope(half * state + dt / 2 * b)
        d = self.slope(half * (half * state + dt * c))
        return np.asarray(half * (half * (state + dt / 6 * a) + dt / 3 * (b + c)) + dt / 6 * d)

    def courant_step(self, state: np.ndarray) -> float:
        """Return the largest dt that the fastest particle and the fastest wave allow."""
        speed = float(np.abs(self.to_space(state[:3])).sum(axis=0).max())
        wave = max(self.flow.stratification or 0.0, 2 * abs(self.flow.rotation), 1e-9)
        return min(COURANT * 2 * math.pi / self.flow.size / max(speed, 1e-9), 1 / wave)

    def start(self, seed: int) -> np.ndarray:
        """Return a random divergence-free state with ``E(k) ~ k^4 exp(-k^2 / 4)``, kinetic energy 1 and b = 0."""
        n = self.flow.size
        u = self.project(self.to_modes(np.random.default_rng(seed).standard_normal((3, n, n, n)))) * self.kept
        u *= np.sqrt(self.k2 * np.exp(-self.k2 / 4))  # white noise has E(k) ~ k^2
        u /= math.sqrt(self.energy(u))
        return u if self.flow.stratification is None else np.concatenate([u, np.zeros_like(u[:1])])


def advance(solver: Solver, state: np.ndarray, time: float, progress: ProgressCallback | None = None) -> np.ndarray:
    """Advance the state by ``time``, in steps of `Solver.courant_step`; raise DataError if it is no longer finite."""
    now = 0.0
    while now < time * (1 - 1e-12):
        dt = min(solver.courant_step(state), time - now)
        state = solver.step(state, dt)
        now += dt
        if not math.isfinite(solver.energy(state)):
            raise DataError(f"turbulence: not finite after {now:g} units of time; try a larger size or viscosity")
        if progress:
            progress(min(int(1000 * now / time), 999), 1000)
    if progress:
        progress(1000, 1000)
    return state


def flow_of(kind: str, size: int) -> Flow:
    """Return the flow of a kind: "isotropic", or "stratified" (Froude number about 0.1, N = 5 x 2 Omega)."""
    if kind == "isotropic":
        return Flow(size, resolved_viscosity(size))
    return Flow(size, resolved_viscosity(size), rotation=0.4, stratification=4.0)


def fields(solver: Solver, state: np.ndarray) -> dict[str, np.ndarray]:
    """Return scalar fields (n, n, n) float64: ``speed``, ``vorticity`` (magnitude), ``temperature`` if there is b."""
    out = {
        "speed": np.linalg.norm(solver.to_space(state[:3]), axis=0),
        "vorticity": np.linalg.norm(solver.to_space(solver.curl(state[:3])), axis=0),
    }
    return out if len(state) == 3 else out | {"temperature": solver.to_space(state[3:])[0]}
