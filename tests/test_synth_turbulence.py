"""The turbulence solver on what is known: Taylor-Green, Arnold's flow, energy balances, order in time, divergence."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.refused import refused
from vvgt_cli.errors import DataError, UsageError
from vvgt_cli.volume.turbulence import Flow, Solver, advance, fields, flow_of, resolved_viscosity

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


def test_a_three_dimensional_beltrami_flow_decays_as_it_must():
    """curl u = u, so that u x curl u = 0 (Arnold, Beltrami, Childress): exp(-nu t)."""
    x, y, z = grid(16)
    flow = np.stack([np.sin(z) + np.cos(y), np.sin(x) + np.cos(z), np.sin(y) + np.cos(x)])
    solver = Solver(QUIET)
    state = advance(solver, solver.to_modes(flow), 2.0)
    assert np.abs(solver.to_space(state) - flow * math.exp(-0.05 * 2.0)).max() < 1e-13


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


@pytest.mark.parametrize("kind", ["isotropic", "stratified"])
def test_energy_changes_by_forcing_and_viscosity_alone(kind):
    solver = Solver(replace(flow_of(kind, 16), viscosity=0.1))
    state = advance(solver, solver.start(1), 0.5)
    assert solver.energy(state) > 0.5
    assert balance(solver, state) == pytest.approx(0, abs=1e-5)
    if kind == "stratified":
        assert solver.energy(state[3:]) > 1e-3


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


@pytest.mark.parametrize("kind", ["isotropic", "stratified"])
def test_the_error_falls_with_the_fourth_power_of_the_step(kind):
    solver = Solver(flow_of(kind, 12))
    start = solver.start(3)
    counts, ends = (4, 8, 16, 64), []
    for count in counts:
        state = start
        for _ in range(count):
            state = solver.step(state, 0.4 / count)
        ends.append(state)
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    order = -np.polyfit(np.log(counts[:-1]), np.log(errors), 1)[0]
    assert order == pytest.approx(4, abs=0.2)


def test_velocity_stays_free_of_divergence_and_within_the_kept_modes():
    solver = Solver(flow_of("stratified", 16))
    state = advance(solver, solver.start(4), 0.3)
    assert divergence(solver, state) < 1e-13
    assert np.abs(state[:, ~solver.kept]).max() == 0


def test_products_of_modes_do_not_fold_back():
    """The flow of a fine grid, cut at what a coarse one keeps, has the coarse grid's slope there."""
    coarse, fine = Solver(replace(QUIET, size=12)), Solver(replace(QUIET, size=24))
    state = coarse.start(5)
    wide = np.zeros((3, 24, 24, 13), complex)
    at = np.fft.fftfreq(12, 1 / 12).astype(int)
    wide[np.ix_(range(3), at, at, range(7))] = state * 8  # numpy's transforms are sums over n^3 points
    expected = fine.slope(wide)[np.ix_(range(3), at, at, range(7))] / 8
    kept = coarse.kept
    assert np.allclose(coarse.slope(state)[:, kept], expected[:, kept], atol=1e-9 * np.abs(expected).max())


def test_turbulence_is_that_of_its_seed():
    solver = Solver(flow_of("isotropic", 12))
    one, same, other = (advance(solver, solver.start(seed), 0.2) for seed in (7, 7, 8))
    assert np.array_equal(one, same)
    assert np.abs(one - other).max() > 0.1 * np.abs(one).max()
    found = fields(solver, one)
    assert set(found) == {"speed", "vorticity"}
    assert (found["speed"] ** 2).mean() / 2 == pytest.approx(solver.energy(one), rel=1e-12)


def test_the_smallest_eddies_fit():
    assert (resolved_viscosity(64) ** 3) ** 0.25 * 64 / 3 == pytest.approx(1.2)


def test_sizes_and_states_that_cannot_be():
    refused(UsageError, "at least 8", Flow, 4, 0.1)
    refused(DataError, "of memory", Flow, 100_000, 0.1)
    solver = Solver(QUIET)
    refused(DataError, "not finite", advance, solver, solver.start(0) * np.nan, 0.1)
