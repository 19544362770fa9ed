"""The turbulence solver on what is known: Taylor-Green, Arnold's flow, energy balances, order in time, divergence."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.turbulence import Flow, Solver, advance, fields, flow_of

QUIET = Flow(16, 0.05, power=0)


def grid(n):
    line = np.arange(n) * 2 * math.pi / n
    return np.meshgrid(line, line, line, indexing="ij")[::-1]  # x, y, z


def taylor_green(n):
    x, y, _ = grid(n)
    return np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y), np.zeros_like(x)])


def divergence(solver, state):
    """Largest, over the size of the modes."""
    return np.abs((solver.k * state[:3]).sum(axis=0)).max() / np.abs(state[:3]).max()


def test_the_two_dimensional_taylor_green_vortex_decays_as_it_must():
    """u = (sin x cos y, -cos x sin y, 0) exp(-2 nu t) solves the equations exactly (Taylor and Green 1937)."""
    solver = Solver(QUIET)
    state = advance(solver, solver.to_modes(taylor_green(16)), 3.0)
    expected = taylor_green(16) * math.exp(-2 * 0.05 * 3.0)
    assert np.abs(solver.to_space(state) - expected).max() < 1e-13


def test_the_three_dimensional_taylor_green_vortex_loses_what_viscosity_takes():
    """Brachet et al. 1983: energy 1/8, enstrophy's first values; dE/dt = -dissipation."""
    x, y, z = grid(32)
    start = np.stack([np.sin(x) * np.cos(y) * np.cos(z), -np.cos(x) * np.sin(y) * np.cos(z), np.zeros_like(x)])
    solver = Solver(Flow(32, 0.01, power=0))
    state = solver.to_modes(start)
    assert solver.energy(state) == pytest.approx(1 / 8, rel=1e-12)
    assert solver.dissipation(state) == pytest.approx(0.01 * 3 / 4, rel=1e-12)
    assert balance(solver, state) == pytest.approx(0, abs=1e-9)


def balance(solver, state, dt=1e-3):
    """dE/dt by central differences, less forcing, plus dissipation."""
    later, earlier = solver.step(state, dt), state
    middle = solver.step(state, dt / 2)
    change = (solver.energy(later) - solver.energy(earlier)) / dt
    return change - solver.flow.power + solver.dissipation(middle)


def test_it_starts_with_the_spectrum_that_is_stated():
    """E(k) ~ k^4 exp(-k^2 / 4) has a mean k^2 of 10."""
    solver = Solver(replace(QUIET, size=32))
    assert solver.dissipation(solver.start(1)) == pytest.approx(2 * QUIET.viscosity * 10, rel=0.05)


def test_without_forcing_and_viscosity_energy_is_kept():
    solver = Solver(Flow(16, 1e-12, power=0, rotation=2.0, stratification=3.0))
    state = solver.start(2)
    later = state
    for _ in range(20):
        later = solver.step(later, 2e-3)
    assert solver.energy(later) == pytest.approx(solver.energy(state), rel=1e-9)
    assert np.abs(later - state).max() > 1e-2 * np.abs(state).max()


def test_velocity_stays_free_of_divergence_and_within_the_kept_modes():
    solver = Solver(flow_of("stratified", 16))
    state = advance(solver, solver.start(4), 0.3)
    assert divergence(solver, state) < 1e-13
    assert np.abs(state[:, ~solver.kept]).max() == 0


def test_turbulence_is_that_of_its_seed():
    solver = Solver(flow_of("isotropic", 12))
    one, same, other = (advance(solver, solver.start(seed), 0.2) for seed in (7, 7, 8))
    assert np.array_equal(one, same)
    assert np.abs(one - other).max() > 0.1 * np.abs(one).max()
    found = fields(solver, one)
    assert set(found) == {"speed", "vorticity"}
    assert (found["speed"] ** 2).mean() / 2 == pytest.approx(solver.energy(one), rel=1e-12)


def test_sizes_and_states_that_cannot_be():
    refused(UsageError, "at least 8", Flow, 4, 0.1)
    refused(DataError, "of memory", Flow, 100_000, 0.1)
    solver = Solver(QUIET)
    refused(DataError, "not finite", advance, solver, solver.start(0) * np.nan, 0.1)
