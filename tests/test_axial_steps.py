"""The fused loops of the axial model against the same scheme written out, array by array."""

import numba
import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.thruster import closures
from ep2sindy.thruster.axial import heavy_kernels as heavy
from ep2sindy.thruster.axial import kernels
from ep2sindy.thruster.axial import state_kernels as kept
from ep2sindy.thruster.axial.electron_kernels import COLDEST_EV, electron_step
from ep2sindy.thruster.axial.model import build_model, cell_faces, lengths_and_centres
from ep2sindy.thruster.axial.settings import to_json
from ep2sindy.thruster.axial.simulate import first_fields
from ep2sindy.thruster.axial.starts import GuessedStart
from ep2sindy.thruster.constants import E_CHARGE, M_ELECTRON
from tests.thrusters import at, slope_at

POINT = ep.thruster.OperatingPoint(300.0, 5.0)
N_CELLS = 41
DT_S = 2e-8
THRUSTERS = {
    "default": ep.thruster.Thruster(),
    "three charges": ep.thruster.Thruster(
        propellant=ep.thruster.propellant("xenon"), charge_states=3, conduction_coulomb=0.7
    ),
    "plume": ep.thruster.Thruster(plume=ep.thruster.ConicalPlume(20.0)),
}
INNER = slice(1, -1)


@pytest.fixture(params=THRUSTERS)
def moving(request):
    """Model, state and scratch arrays of a discharge under way."""
    thruster = THRUSTERS[request.param]
    faces = cell_faces(thruster, N_CELLS, 2.0)
    model = build_model(thruster, POINT, faces, end_s=1.0)
    z = lengths_and_centres(faces)[1]
    state = GuessedStart().begin(model, z, to_json({"thruster": thruster})).state
    if thruster.plume is not None:
        model.spread[:] = 1.0 + z / z[-2]
        model.spread_at[:] = 0.5 * (model.spread[1:] + model.spread[:-1])
        model.per_spread[:], model.per_spread_at[:] = 1.0 / model.spread, 1.0 / model.spread_at
        model.per_before[1:] = model.spread_at / (model.spread * model.dz)[1:]
        model.per_behind[:-1] = model.spread_at / (model.spread * model.dz)[:-1]
    charges = len(state.n_i)
    work = kept.new_work(charges, N_CELLS + 2)
    sums = kept.new_sums(len(kept.CELL_SUMS) + kept.PER_CHARGE * (charges - 1), N_CELLS + 2)
    assert first_fields(state, model)
    for _ in range(20):
        heavy.heavy_step(state, model, DT_S, sums, work)
        assert electron_step(state, model, DT_S, work)
    return model, state, sums, work


def test_loops_go_over_cells_and_faces_and_stay_within_the_arrays():
    ghosts = np.zeros(5)
    assert list(kept.inside.py_func(ghosts)) == [1, 2, 3]
    assert list(kept.faces.py_func(ghosts)) == [0, 1, 2, 3]


def agree(found, expected, tolerance=1e-12):
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * scale)


def slopes(q, model):
    """Half of van Leer's slopes, zero at extrema, in the outermost cells and in the ghosts."""
    a = (q[INNER] - q[:-2]) * model.to_left[INNER]
    b = (q[2:] - q[INNER]) * model.to_right[INNER]
    s, steady = np.zeros(q.size), a * b > 0.0
    s[INNER][steady] = a[steady] * b[steady] / (a + b)[steady]
    s[[1, -2]] = 0.0
    return model.slope_weight * s


def rusanov(n_l, u_l, n_r, u_r, c2):
    g_l, g_r, s = n_l * u_l, n_r * u_r, np.maximum(np.abs(u_l), np.abs(u_r)) + np.sqrt(c2)
    momentum = g_l * u_l + g_r * u_r + c2 * (n_l + n_r) - s * (g_r - g_l)
    return 0.5 * (g_l + g_r - s * (n_r - n_l)), 0.5 * momentum


def through_faces(n, g, z, model):
    """Fluxes of ions of charge z, and of their momentum, through all faces."""
    c2, u = model.sound_speed_squared, g / n
    s_n, s_u = slopes(n, model), slopes(u, model)
    bohm = np.sqrt(z * E_CHARGE * model.anode_T_e_eV / model.ion_mass)
    first = rusanov(n[1], min(u[1], -bohm), n[1], u[1], c2)
    left, right = slice(1, -2), slice(2, -1)
    inner = rusanov((n + s_n)[left], (u + s_u)[left], (n - s_n)[right], (u - s_u)[right], c2)
    last = g[-2], g[-2] * u[-2] + c2 * n[-2]
    return [np.r_[a, b, c] for a, b, c in zip(first, inner, last, strict=True)]


def rates_of(n, g, nn, state, model):
    """Rates of change of ions, their flux and neutrals in the cells, and what sums record."""
    charges = range(1, len(n) + 1)
    n_e = sum(z * n[z - 1] for z in charges)
    d_n, d_g, d_nn = np.zeros_like(n), np.zeros_like(g), np.zeros_like(nn)
    born = state.rates[0] * n_e * nn
    consumed, d_n[0], d_g[0] = born.copy(), born, born * model.birth_speed
    for (below, above), rate in zip(model.further.astype(int), state.rates[1:], strict=True):
        source, speed = (n[below - 1], g[below - 1] / n[below - 1]) if below else (nn, None)
        born = rate * n_e * source
        momentum_gain = born * (model.birth_speed if speed is None else speed)
        d_n[above - 1] += born
        d_g[above - 1] += momentum_gain
        if below:
            d_n[below - 1] -= born
            d_g[below - 1] -= momentum_gain
        else:
            consumed += born
    before, behind, faces, walls = model.per_before, model.per_behind, [], []
    for z in charges:
        k, lost = z - 1, np.sqrt(z) * state.wall_loss
        flux, momentum = through_faces(n[k], g[k], z, model)
        widening = model.sound_speed_squared * n[k] * (behind - before)
        momentum_gain = z * E_CHARGE / model.ion_mass * n[k] * state.E + widening
        d_n[k, INNER] += (flux[:-1] * before[INNER] - flux[1:] * behind[INNER]) - (lost * n[k])[
            INNER
        ]
        d_g[k, INNER] += momentum[:-1] * before[INNER] - momentum[1:] * behind[INNER]
        d_g[k, INNER] += (momentum_gain - lost * g[k])[INNER]
        d_nn += lost * n[k]
        faces.append(flux)
        walls.append(lost * n[k])
    flux = model.neutral_speed * (nn + slopes(nn, model))[:-1]
    flux[0] = model.neutral_inflow - sum(each[0] for each in faces)
    d_nn[INNER] += flux[:-1] * model.neutral_before[INNER] - flux[1:] * model.neutral_behind[INNER]
    d_nn -= consumed
    cells = {kept.FACE_I + kept.PER_CHARGE * k: each[:-1] for k, each in enumerate(faces)}
    cells |= {kept.FACE_N: flux[:-1], kept.WALL_LOSS: sum(walls)[INNER]}
    out = model.spread_at[-1] * np.array([each[-1] for each in faces])
    series = {kept.BEAM: np.dot(charges, out), kept.IONS_OUT: out.sum()}
    series |= {kept.NEUTRALS_OUT: model.spread_at[-1] * flux[-1]}
    return (d_n, d_g, d_nn), cells | {kept.IONIZATION: consumed[INNER]}, series


def held(n, g):
    """Ions of a higher charge, where too rare, move with the singly charged ones."""
    for k in range(1, len(n)):
        rare = n[k] < heavy.RAREST * n[0]
        n[k] = np.where(rare, heavy.RAREST * n[0], n[k])
        g[k] = np.where(rare, heavy.RAREST * g[0], g[k])
    return n, g


def test_a_heavy_step_is_heuns_step_of_the_scheme(moving):
    model, state, sums, work = moving
    sums.cells[:] = sums.series[:] = 0.0
    for each in (state.n_i, state.flux_i, state.rates):
        each[1:, 5:15] *= 1e-20  # higher charges, too rare to move by themselves
    n, g, nn = state.n_i.copy(), state.flux_i.copy(), state.n_n.copy()
    (d_n, d_g, d_nn), cells, series = rates_of(n, g, nn, state, model)
    new_n, new_g = held(n + DT_S * d_n, g + DT_S * d_g)
    (e_n, e_g, e_nn), cells_2, series_2 = rates_of(new_n, new_g, nn + DT_S * d_nn, state, model)
    new_n, new_g = held(0.5 * (n + new_n + DT_S * e_n), 0.5 * (g + new_g + DT_S * e_g))
    heavy.heavy_step(state, model, DT_S, sums, work)
    for k in range(len(n)):
        agree(state.n_i[k, INNER], new_n[k, INNER])
        agree(state.flux_i[k, INNER], new_g[k, INNER])
        agree(work.u[k, INNER], (new_g / new_n)[k, INNER])
    agree(state.n_n[INNER], (nn + 0.5 * DT_S * (d_nn + e_nn))[INNER])
    for place, rate in cells.items():
        agree(sums.cells[place, INNER], 0.5 * DT_S * (rate + cells_2[place]))
    for place, rate in series.items():
        expected = 0.5 * DT_S * (rate + series_2[place])
        assert sums.series[place] == pytest.approx(expected, rel=1e-12)


def plain_collisions(T, hot, n, log_n, state, model):
    """Frequencies in 1/s, and losses in eV/(m^3 s) with their slopes in T_e."""
    table, nn = model.table, state.n_n
    log_lambda = at(table, closures.COULOMB_LOG, T) - 0.5 * log_n
    coulomb = n * at(table, closures.COULOMB, T) * log_lambda
    on_wall = model.wall_collision_weight * at(table, closures.WALL_COLLISION, T)
    with_neutrals = at(table, closures.MOMENTUM, T) + at(table, closures.EVENTS, hot)
    nu = nn * with_neutrals + coulomb + model.anomalous + on_wall
    wall = n * model.wall_power_weight * at(table, closures.WALL_POWER, T)
    wall_slope = (
        n * model.wall_power_weight * np.maximum(slope_at(table, closures.WALL_POWER, T), 0.0)
    )
    inelastic = n * nn * at(table, closures.INELASTIC, hot)
    inelastic_slope = n * nn * np.maximum(slope_at(table, closures.INELASTIC, hot), 0.0)
    if model.drift_credit:
        inelastic -= n * nn * at(table, closures.DRIFT_EVENTS, hot) * state.drift_eV
    for k, ((below, _), cost) in enumerate(zip(model.further, model.further_eV, strict=True)):
        source = nn if below == 0 else state.n_i[int(below) - 1]
        inelastic += n * source * at(table, closures.FURTHER + k, hot) * cost
    return nu, coulomb, (inelastic, inelastic_slope), (wall, wall_slope)


def plain_temperature(T, n, flux, kappa, losses, heating, state, model):
    """The implicit step of the electrons' heat, and its flux at both ends, by a dense solver.

    flux: n u_e through faces.
    """
    conducting = 0.5 * (kappa[1:] + kappa[:-1]) * model.per_between
    flux = 2.5 * flux
    power_law = np.maximum(1.0 - 0.1 * model.slope_weight * np.abs(flux) / conducting, 0.0) ** 5
    down = np.maximum(flux, 0.0) + conducting * power_law
    up = np.minimum(flux, 0.0) - conducting * power_law
    matrix, known, i = np.eye(T.size), T.copy(), np.arange(1, T.size - 1)
    before, behind = DT_S * model.per_before[INNER], DT_S * model.per_behind[INNER]
    (inelastic, inelastic_slope), (wall, wall_slope) = losses
    slope = DT_S * (inelastic_slope + wall_slope)[INNER]
    matrix[i, i - 1], matrix[i, i + 1] = -before * down[:-1], behind * up[1:]
    matrix[i, i] = 1.5 * n[INNER] + behind * down[1:] - before * up[:-1] + slope
    sources = DT_S * (heating - inelastic - wall)[INNER]
    known[INNER] = state.energy[INNER] + slope * T[INNER] + sources
    scale = np.abs(matrix).max(axis=1)
    new = np.linalg.solve(matrix / scale[:, None], known / scale)
    return new, (down * new[:-1] + up * new[1:])[[0, -1]]


def test_an_electron_step_is_that_of_the_scheme(moving):
    model, state, _, work = moving
    z = np.arange(1, len(state.n_i) + 1)
    for each in (*state.n_i, *state.flux_i, state.n_n):
        each[[0, -1]] = each[[1, -2]]
    n, g, T = z @ state.n_i, z @ state.flux_i, state.T_e_eV.copy()
    change = n / state.log_n[1]
    log_n = state.log_n[0] + 2.0 * (change - 1.0) / (change + 1.0)
    T[0] = max(2.0 * model.anode_T_e_eV - T[1], COLDEST_EV)
    T[-1] = max(2.0 * model.cathode_T_e_eV - T[-2], COLDEST_EV)
    hot = T + 2.0 / 3.0 * model.drift_weight * state.drift_eV
    nu, coulomb, inelastic, wall = plain_collisions(T, hot, n, log_n, state, model)
    mobility = E_CHARGE / M_ELECTRON * nu / (nu**2 + model.omega_ce**2)
    kappa = model.conduction_factor * mobility * n * T
    kappa /= 1.0 + model.conduction_coulomb * coulomb / nu
    gradient = np.zeros(T.size)
    gradient[INNER] = model.pressure_factor * ((n * T)[2:] - (n * T)[:-2]) * model.per_span[INNER]
    volume = model.dz * model.spread
    drive = (model.dz / n * (g / mobility + gradient))[INNER].sum()
    load = (model.dz / (n * mobility * model.spread))[INNER].sum() / (E_CHARGE * model.area)
    current = (model.supply[0] + drive) / (load + model.resistance)
    total = current / (E_CHARGE * model.area)
    backwards = total / model.spread - g
    E = (backwards / mobility - gradient) / n
    drift = 0.5 * (backwards / n) ** 2 / (mobility * nu) * (model.drift_weight > 0.0)
    through = 0.5 * (g[1:] + g[:-1]) - total / model.spread_at
    losses = inelastic, wall
    new, ends = plain_temperature(T, n, through, kappa, losses, backwards * E, state, model)

    assert electron_step(state, model, DT_S, work)
    for found, expected in (
        (state.n_e, n), (state.flux_q, g), (state.log_n[0], log_n), (work.per_n, 1.0 / n),
        (state.E, E), (state.drift_eV, drift), (state.T_e_eV, new), (state.energy, 1.5 * n * new),
    ):  # fmt: skip
        agree(found[INNER], expected[INNER])
    assert state.instant[kept.CURRENT] == pytest.approx(current, rel=1e-12)
    watts = E_CHARGE * model.area
    paid = [loss + slope * (new - T) for loss, slope in losses]
    z, out, exit_kg = z[:, None], state.flux_i[:, -2], model.ion_mass * model.spread_at[-1]
    on_walls = z**1.5 * state.n_i * at(model.table, closures.ION_LOSS, T) * model.wall_ion_weight
    powers = {
        kept.THRUST: model.area * exit_kg * (out**2 / state.n_i[:, -2]).sum(),
        kept.WALL_CURRENT: watts * (volume * on_walls)[:, INNER].sum(),
        kept.P_ANODE: -watts * ends[0],
        kept.P_CATHODE: watts * model.spread_at[-1] * ends[1],
        kept.POWER: current * (model.dz * E)[INNER].sum(),
        kept.P_IONS: watts * (volume * g * E)[INNER].sum(),
        kept.P_INELASTIC: watts * (volume * paid[0])[INNER].sum(),
        kept.P_WALL: watts * (volume * paid[1])[INNER].sum(),
    }
    for place, expected in powers.items():
        assert state.instant[place] == pytest.approx(expected, rel=1e-11)


def test_a_time_step_divides_what_is_left_within_the_cfl_number(moving):
    model, state, _, work = moving

    @numba.njit(**kept.ENTRY)
    def found(model, left, work):
        return kernels.time_step(model, left, work)

    speed = np.abs(state.flux_i / state.n_i) + np.sqrt(model.sound_speed_squared)
    heavy.heavy_step(state, model, 0.0, kept.new_sums(*found_shape(state)), work)
    top = (speed * model.inverse_dz)[:, INNER].max()
    expected = 1.5e-6 / np.ceil(1.5e-6 * top / model.cfl)
    assert found(model, 1.5e-6, work) == pytest.approx(expected, rel=1e-12)


def found_shape(state):
    """Arguments of `new_sums` for a state."""
    charges, size = state.n_i.shape
    return len(kept.CELL_SUMS) + kept.PER_CHARGE * (charges - 1), size
