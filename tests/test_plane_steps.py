"""The fused loops of the (z, r) model against the same scheme written out, array by array."""

import numpy as np
import pytest

from ep2sindy.thruster import closures
from ep2sindy.thruster.constants import E_CHARGE, M_ELECTRON
from ep2sindy.thruster.plane import heavy_kernels as heavy
from ep2sindy.thruster.plane import kernels
from ep2sindy.thruster.plane.electron_kernels import electron_step
from ep2sindy.thruster.plane.grid import MaskedGrid
from ep2sindy.thruster.plane.simulate import (
    OPERATING_POINT_2D,
    THRUSTER_2D,
    build_model,
    initial_state,
)
from ep2sindy.thruster.plane.state_kernels import new_work
from tests.thrusters import at, slope_at

DT_S = 1e-8
N_STEPS = 20  # until ions move along r, too
GAS = ("n", "flux_z", "flux_r", "neutrals")


@pytest.fixture(scope="module", params=[(20, 24), (21, 29)])
def moving(request):
    """Model, state and scratch arrays of a discharge under way."""
    grid = MaskedGrid(THRUSTER_2D, *request.param)
    model = build_model(THRUSTER_2D, OPERATING_POINT_2D, grid)
    state, work = initial_state(grid, model), new_work(*request.param)
    heavy.velocities(state.gas, model)
    assert electron_step(state, model, 0.0, work.columns)
    for _ in range(N_STEPS):
        heavy.heavy_step(state, model, DT_S, work)
        assert electron_step(state, model, DT_S, work.columns)
    state.gas.flux_z[grid.exit_column] *= -0.1  # back to the thruster's front face
    heavy.velocities(state.gas, model)
    return grid, model, state, work


def slopes(q):
    """Half of van Leer's slopes along a line of cells, zero at extrema and at the ends."""
    a, b, s = q[1:-1] - q[:-2], q[2:] - q[1:-1], np.zeros_like(q)
    steady = a * b > 0.0
    s[1:-1][steady] = a[steady] * b[steady] / (a + b)[steady]
    return s


def rusanov(n_l, u_l, n_r, u_r, c):
    g_l, g_r, s = n_l * u_l, n_r * u_r, np.maximum(np.abs(u_l), np.abs(u_r)) + c
    momentum = g_l * u_l + g_r * u_r + c**2 * (n_l + n_r) - s * (g_r - g_l)
    return 0.5 * (g_l + g_r - s * (n_r - n_l)), 0.5 * momentum


def between(n, u, v, c):
    """Fluxes of ions between the cells of a line: of density, momentum along it and across."""
    s_n, s_u, s_v = slopes(n), slopes(u), slopes(v)
    left, right = np.s_[:-1], np.s_[1:]
    mass, along = rusanov((n + s_n)[left], (u + s_u)[left], (n - s_n)[right], (u - s_u)[right], c)
    return mass, along, mass * np.where(mass > 0.0, (v + s_v)[left], (v - s_v)[right])


def along_z(model, n, u, v, nn, *, channel):
    """Fluxes (mass, z, r, neutrals) through all faces of a row of cells, from its first on."""
    c2, speed = model.ion_sound_squared, model.neutral_speed
    if channel:  # it begins at the anode
        bohm = np.sqrt(model.electron_sound_squared * model.boundary_T_e_eV)
        mass, along = rusanov(n[0], min(u[0], -bohm), n[0], u[0], np.sqrt(c2))
        first = mass, along, mass * v[0], model.neutral_inflow - mass
    else:  # at the thruster's front face
        out = min(u[0], 0.0)
        first = n[0] * out, n[0] * (out**2 + c2), n[0] * out * v[0], -n[0] * out
    out = max(u[-1], 0.0)
    last = n[-1] * out, n[-1] * (out**2 + c2), n[-1] * out * v[-1], speed * nn[-1]
    inner = [*between(n, u, v, np.sqrt(c2)), speed * (nn + slopes(nn))[:-1]]
    return [np.r_[a, b, c] for a, b, c in zip(first, inner, last, strict=True)]


def along_r(model, size, c, n, u, v, nn, *, channel):
    """Fluxes (mass, r, z, neutrals) outward through all faces of a column, times the perimeter."""
    mass, along, across = between(n, u, v, c)
    spread = model.neutral_diffusion / model.dr
    inner = [mass, along, across, spread * (nn[:-1] - nn[1:])]
    ends = []
    for k, outward in ((0, -1.0), (-1, 1.0)):
        at, out = n[k], outward * u[k]
        if not channel:
            out = max(out, 0.0)
        elif out < c:
            at, out = at * np.exp(out / c - 1.0), c
        atoms = -at * out if channel else heavy.SIDE_SPEED * model.neutral_speed * nn[k]
        flux = outward * at * out
        ends.append((flux, at * (out**2 + c**2), flux * v[k], outward * atoms))
    return [size * np.r_[a, b, c] for a, b, c in zip(ends[0], inner, ends[1], strict=True)]


def rates_of(gas, grid, model, state):
    """Rates of change of the four conserved quantities, and what is lost on the way, per second."""
    inside = grid.plasma
    lost = {"left": 0.0, "side": np.zeros(grid.n_z), "wall": np.zeros(grid.n_z)}
    n, u, v, nn = gas["n"], gas["flux_z"] / gas["n"], gas["flux_r"] / gas["n"], gas["neutrals"]
    born = state.ionization[:, None] * n * nn
    speed2 = model.electron_sound_squared * state.T_e_eV + model.ion_sound_squared
    wider = speed2[:, None] * n * np.diff(grid.perimeter) / grid.area  # pressure along r
    momentum_gain = E_CHARGE / model.ion_mass * n * state.E + born * model.neutral_speed
    rates = np.array([born, momentum_gain, wider, -born])
    for j in range(grid.n_r):
        first = 0 if inside[0, j] else grid.exit_column
        line = (q[first:, j] for q in (n, u, v, nn))
        flux = np.array(along_z(model, *line, channel=first == 0))
        rates[:, first:, j] -= np.diff(flux) / model.dz
        lost["left"] += grid.area[j] * (flux[0, -1] + flux[3, -1])
        if first > 0:
            lost["wall"][first] -= grid.area[j] * flux[0, 0] / model.dz
    for i in range(grid.n_z):
        row, channel = np.flatnonzero(inside[i]), i < grid.exit_column
        size = grid.perimeter[row[0] : row[-1] + 2]
        line = (q[i, row] for q in (n, v, u, nn))
        flux = np.array(along_r(model, size, np.sqrt(speed2[i]), *line, channel=channel))
        flux = flux[[0, 2, 1, 3]]
        rates[:, i, row] -= np.diff(flux) / grid.area[row]
        lost["wall" if channel else "side"][i] += flux[0, -1] - flux[0, 0]
        if not channel:
            lost["left"] += model.dz * (flux[[0, 3], -1] - flux[[0, 3], 0]).sum()
    return dict(zip(GAS, rates, strict=True)), lost


def plain_step(grid, model, state, dt):
    """Heun's step of ions and neutrals in a frozen field."""
    gas = {name: np.where(grid.plasma, getattr(state.gas, name), 1.0) for name in GAS}
    rates, lost = rates_of(gas, grid, model, state)
    new = {name: gas[name] + dt * rates[name] for name in GAS}
    again, lost_again = rates_of(new, grid, model, state)
    new = {name: 0.5 * (gas[name] + new[name] + dt * again[name]) for name in GAS}
    return new, {name: 0.5 * (lost[name] + lost_again[name]) for name in lost}


def agree(found, expected):
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_a_heavy_step_is_heuns_step_of_the_scheme(moving):
    grid, model, state, work = moving
    left = state.left[0]
    for _ in range(3):
        expected, lost = plain_step(grid, model, state, DT_S)
        heavy.heavy_step(state, model, DT_S, work)
        inside = grid.plasma
        for name in GAS:
            agree(getattr(state.gas, name)[inside], expected[name][inside])
        agree(state.gas.u_z[inside], (expected["flux_z"] / expected["n"])[inside])
        agree(state.gas.u_r[inside], (expected["flux_r"] / expected["n"])[inside])
        agree(state.wall, lost["wall"])
        agree(state.side, lost["side"])
        left += DT_S * lost["left"]
    assert state.left[0] == pytest.approx(left, rel=1e-13)


def plain_columns(grid, model, state):
    """Sums over r, and what electrons lose by collisions, with its slope in T_e."""
    gas, T, table = state.gas, state.T_e_eV, model.table
    n, area = np.where(grid.plasma, gas.n, 1.0), np.where(grid.plasma, grid.area, 0.0)
    products = n, gas.flux_z, n * gas.neutrals, n * n, n * np.log(n)
    n_a, flux, n_nn, n_n, n_log = ((area * each).sum(axis=1) for each in products)
    flux += model.dz * (np.cumsum(state.side) - 0.5 * state.side)
    hot = T + 2.0 / 3.0 * model.drift_weight * state.drift_eV
    log_lambda = at(table, closures.COULOMB_LOG, T) - 0.5 * np.log(n_n / n_a)
    with_neutrals = at(table, closures.MOMENTUM, T) + at(table, closures.EVENTS, hot)
    nu = n_nn * with_neutrals + n_n * log_lambda * at(table, closures.COULOMB, T)
    nu = (nu + state.wall * at(table, closures.WALL_COLLISION, hot)) / n_a + model.anomalous
    of_side = 2.5 * state.side
    loss, slope = (
        n_nn * value(table, closures.INELASTIC, hot)
        + state.wall * value(table, closures.WALL_POWER, hot)
        for value in (at, slope_at)
    )
    losses = loss + of_side * T, np.maximum(slope, 0.0) + of_side
    return n_a, flux, n_log / n_a, nu, losses, at(table, closures.IONIZATION, hot)


def with_ends(T, model):
    """Temperatures along z, with those half a cell outside both ends."""
    edge = model.boundary_T_e_eV
    first, last = (max(2.0 * edge - T[k], 0.3 * edge) for k in (0, -1))
    return np.r_[first, T, last]


def centred(q, model):
    return (q[2:] - q[:-2]) / (2.0 * model.dz)


def plain_temperature(T, n, flux, conductance, losses, heating, state, model):
    """The implicit step of the electrons' heat, by a dense solver. flux: of electrons."""
    edge, conducts = model.boundary_T_e_eV, model.conduction_factor * conductance / model.dz
    (loss, slope), product = losses, conducts * T
    ends = 2.0 * edge * conducts[[0, -1]]
    kappa = np.r_[ends[0], 0.5 * (product[1:] + product[:-1]), ends[1]]
    convection = 2.5 * np.r_[flux[0], 0.5 * (flux[1:] + flux[:-1]), flux[-1]]
    p = convection / kappa
    down, up = kappa * p / -np.expm1(-p), kappa * p / np.expm1(p)  # flux: down T - up T_next
    s, dt = DT_S / model.dz, DT_S
    matrix = np.diag(1.5 * n + dt * slope + s * (up[:-1] + down[1:]))
    matrix -= s * (np.diag(down[1:-1], -1) + np.diag(up[1:-1], 1))
    known = state.energy + dt * (slope * T + heating - loss)
    known[0], known[-1] = known[0] + s * down[0] * edge, known[-1] + s * up[-1] * edge
    return np.linalg.solve(matrix / n[:, None], known / n)


@pytest.mark.parametrize("drift_weight", [0.0, 1.0])
def test_an_electron_step_is_that_of_the_scheme(moving, drift_weight):
    grid, model, state, work = moving
    model = model._replace(drift_weight=drift_weight)
    state.T_e_eV[0] = 2.0 * model.boundary_T_e_eV  # beyond what a ghost cell mirrors
    n, flux, log_ref, nu, losses, ionization = plain_columns(grid, model, state)
    T, log_n = state.T_e_eV.copy(), np.log(np.where(grid.plasma, state.gas.n, 1.0))
    conductance = n * E_CHARGE / M_ELECTRON * nu / (nu**2 + model.omega_ce**2)
    around = with_ends(T, model)
    beyond = np.pad(log_ref, 1, mode="edge")
    gradient = centred(around, model) + T * centred(beyond, model)
    drive = model.voltage + model.dz * (flux / conductance + gradient).sum()
    current = drive / (model.resistance + model.dz * (1.0 / conductance).sum() / E_CHARGE)
    electrons = flux - current / E_CHARGE
    climb = electrons / conductance + gradient
    drift = 0.5 * electrons**2 / (n * conductance * nu)
    # What lies before the front face repeats the plume's first column.
    before, column = grid.exit_column - 1, ~grid.plasma[grid.exit_column - 1]
    log_n[before, column] = log_n[before + 1, column]
    pressure = around[:, None] * (np.pad(log_n, ((1, 1), (0, 0)), mode="edge") - beyond[:, None])
    new = plain_temperature(T, n, electrons, conductance, losses, electrons * climb, state, model)
    assert electron_step(state, model, DT_S, work.columns)
    assert state.current[0] == pytest.approx(current, rel=1e-12)
    for found, expected in (
        (state.ionization, ionization), (state.reference_field, -climb), (state.drift_eV, drift),
        (state.E[grid.plasma], (-climb[:, None] - centred(pressure, model))[grid.plasma]),
        (state.T_e_eV, new), (state.energy, 1.5 * n * new),
        (state.log_n[grid.plasma], log_n[grid.plasma]),
    ):  # fmt: skip
        agree(found, expected)


@pytest.mark.parametrize("place", [-1e-6, 0.0, 1.0, np.nan])
def test_electrons_beyond_the_table_break_the_run(moving, place):
    """The table's last row has no next one to interpolate to."""
    _, model, state, work = moving
    state = state._replace(T_e_eV=state.T_e_eV.copy())
    state.T_e_eV[3] = closures.TABLE_TOP_EV + place if place >= 0.0 else place
    assert not electron_step(state, model, DT_S, work.columns)


def test_the_fastest_rate_is_that_of_the_fastest_cell(moving):
    grid, model, state, _ = moving
    c = np.sqrt(model.electron_sound_squared * state.T_e_eV + model.ion_sound_squared)[:, None]
    rates = (np.abs(state.gas.u_z) + c) / grid.dz + (np.abs(state.gas.u_r) + c) / grid.dr
    assert kernels.fastest_rate(state, model) == pytest.approx(rates[grid.plasma].max(), rel=1e-14)


def test_a_share_of_the_state_is_added_to_the_sample(moving):
    grid, model, state, work = moving
    planes, profiles, numbers = work.planes, work.profiles, work.numbers
    planes[:], profiles[:], numbers[:] = 1.0, 2.0, 3.0
    kernels.add(state, model, 0.25, planes, profiles, numbers)
    gas, inside = state.gas, grid.plasma
    for plane, values in zip(planes, (gas.n, gas.neutrals, gas.u_z, gas.u_r), strict=True):
        np.testing.assert_allclose(plane[inside], 1.0 + 0.25 * values[inside], rtol=1e-15)
        assert (plane[~inside] == 1.0).all()
    along = (state.T_e_eV, state.ionization, state.reference_field)
    np.testing.assert_allclose(profiles, 2.0 + 0.25 * np.array(along), rtol=1e-15)
    ends = model.area * gas.flux_z[-1] * gas.u_z[-1]
    plume = np.s_[grid.exit_column :, [0, -1]]
    sides = model.perimeter[[0, -1]] * np.maximum(gas.u_r[plume] * [-1.0, 1.0], 0.0)
    thrust = model.ion_mass * (ends.sum() + model.dz * (gas.flux_z[plume] * sides).sum())
    expected = [3.0 + 0.25 * state.current[0], 3.0 + 0.25 * thrust]
    np.testing.assert_allclose(numbers, expected, rtol=1e-14)
