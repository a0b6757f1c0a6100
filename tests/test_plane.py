"""The (z, r) model: what is conserved, what is symmetric, what its outputs say."""

import json

import numba
import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.app.schema import study_of
from ep2sindy.data.fields import check_field
from ep2sindy.studies import pointwise
from ep2sindy.studies.source import open_prepared
from ep2sindy.thruster.axial.settings import to_json
from ep2sindy.thruster.axial.state_kernels import ENTRY
from ep2sindy.thruster.parameters import Thruster
from ep2sindy.thruster.plane import electron_kernels as electrons
from ep2sindy.thruster.plane import heavy_kernels as heavy
from ep2sindy.thruster.plane import kernels
from ep2sindy.thruster.plane.grid import MaskedGrid
from ep2sindy.thruster.plane.simulate import (
    OPERATING_POINT_2D,
    PLANES,
    PROFILES,
    THRUSTER_2D,
    Rows,
    build_model,
    initial_state,
    simulate_2d,
)
from ep2sindy.thruster.plane.state_kernels import new_work
from ep2sindy.thruster.transport import AnomalousTransport
from tests import programs

N_Z, N_R = 20, 24
BRIEF = {"duration_s": 3e-5, "warm_up_s": 5e-6, "n_z": N_Z, "n_r": N_R, "progress": False}
DT_S = 1e-8


def set_up(*, plane=False, **changes):
    """Grid, constants with changes, and the first state with its electrons solved."""
    grid = MaskedGrid(THRUSTER_2D, N_Z, N_R, plane=plane)
    model = build_model(THRUSTER_2D, OPERATING_POINT_2D, grid)
    state = initial_state(grid, model)
    model = model._replace(**changes)
    work = new_work(N_Z, N_R)
    heavy.velocities(state.gas, model)
    assert electrons.electron_step(state, model, 0.0, work.columns)
    return grid, model, state, work


def rows_of(n_rows, grid):
    """Room for samples of the state, as the kernels take it."""
    rows = Rows.allocate(n_rows, grid)
    return [tuple(rows.planes), rows.profiles, rows.series]


@pytest.fixture(scope="module")
def brief_run():
    return simulate_2d(**BRIEF)


@pytest.mark.parametrize(
    ("n_z", "n_r", "channel", "side", "exit_column"),
    [(41, 49, 25, 12, 21), (62, 74, 38, 18, 31), (82, 98, 50, 24, 41)],
)
def test_a_grid_gives_half_of_its_rows_to_the_channel(n_z, n_r, channel, side, exit_column):
    grid = MaskedGrid(Thruster(), n_z, n_r)
    counts = grid.plasma.sum(axis=1)
    assert set(counts[:exit_column]) == {channel}
    assert set(counts[exit_column:]) == {n_r} == {channel + 2 * side}
    assert grid.area[side:-side].sum() == pytest.approx(Thruster().area, rel=1e-14)
    np.testing.assert_allclose(grid.r_faces[[side, -side - 1]], [0.035, 0.05], rtol=1e-14)
    assert 0.0275 < grid.r_faces[0] < 0.0285
    assert 0.0565 < grid.r_faces[-1] < 0.0575


def test_a_plane_grid_has_the_same_cross_section():
    grid = MaskedGrid(Thruster(), N_Z, N_R, plane=True)
    inside = slice(grid.n_side, -grid.n_side)
    assert np.ptp(grid.perimeter) == 0.0
    assert grid.area[inside].sum() == pytest.approx(Thruster().area, rel=1e-14)


def test_what_enters_leaves_or_stays_in_every_step():
    _, model, state, work = set_up()
    inflow = model.neutral_inflow * THRUSTER_2D.area * DT_S
    for _ in range(20):
        before, left = kernels.count_heavy(state, model), state.left[0]
        heavy.heavy_step(state, model, DT_S, work)
        assert electrons.electron_step(state, model, DT_S, work.columns)
        gained = kernels.count_heavy(state, model) - before
        # rounding of the sum over all atoms, of which a step's inflow is a thousandth
        assert gained + state.left[0] - left == pytest.approx(inflow, rel=1e-9)


def test_ions_that_reach_a_wall_return_there_as_neutrals():
    grid, model, state, work = set_up(neutral_speed=0.0, neutral_diffusion=0.0)
    state.ionization[:] = 0.0
    state.gas.flux_z[:] = np.maximum(state.gas.flux_z, 0.0)  # none to the anode
    heavy.velocities(state.gas, model)
    before = (state.gas.neutrals * grid.area * grid.plasma).sum(axis=1)
    heavy.heavy_step(state, model, DT_S, work)
    after = (state.gas.neutrals * grid.area * grid.plasma).sum(axis=1)
    channel = slice(1, grid.exit_column)
    assert np.all(state.wall[channel] > 0.0)
    np.testing.assert_allclose((after - before)[channel], DT_S * state.wall[channel], rtol=1e-6)


def test_ions_at_rest_reach_a_wall_by_the_rarefaction_into_vacuum():
    grid, model, state, work = set_up()
    state.gas.flux_r[:] = 0.0
    heavy.velocities(state.gas, model)
    c = np.sqrt(model.electron_sound_squared * state.T_e_eV + model.ion_sound_squared)

    @numba.njit(**ENTRY)
    def filled(i, gas, model, c, fluxes):
        heavy.wall_fluxes(heavy.column(gas, i), model, i, c, fluxes)

    face = grid.n_side
    for i in range(grid.exit_column):
        filled(i, state.gas, model, c[i], work.radial)
        expected = -grid.perimeter[face] * state.gas.n[i, face] * np.exp(-1.0) * c[i]
        assert work.radial.n[face] == pytest.approx(expected, rel=1e-14)


def test_a_uniform_stream_stays_uniform_away_from_the_walls():
    grid, model, state, work = set_up()
    state.ionization[:], state.E[:], state.T_e_eV[:] = 0.0, 0.0, 10.0
    state.gas.n[:], state.gas.flux_z[:], state.gas.flux_r[:] = 3e17, 3e17 * 9e3, 0.0
    heavy.velocities(state.gas, model)
    heavy.heavy_step(state, model, DT_S, work)
    inner = np.s_[grid.exit_column + 5 : -4, 6:-6]  # a stage reaches two cells
    np.testing.assert_allclose(state.gas.n[inner], 3e17, rtol=1e-14)
    np.testing.assert_allclose(state.gas.u_z[inner], 9e3, rtol=1e-14)
    np.testing.assert_allclose(state.gas.u_r[inner], 0.0, atol=1e-9)


def test_a_plane_discharge_is_symmetric_about_mid_radius():
    grid, model, state, work = set_up(plane=True)
    rows = rows_of(20, grid)
    assert kernels.advance(state, model, work, 1e-7, False, *rows) == 20
    inside = grid.plasma
    for values, sign in ((state.gas.n, 1), (state.gas.u_z, 1), (state.gas.u_r, -1)):
        values = np.where(inside, values, 0.0)
        scale = np.abs(values).max()
        np.testing.assert_allclose(values, sign * values[:, ::-1], rtol=0, atol=1e-10 * scale)
    assert np.abs(state.gas.u_r[inside]).max() > 100.0


def test_averages_are_means_of_the_states_in_between():
    grid, model, state, work = set_up()
    n, step_s = 10, 2e-9
    # 0.95 of a step fits into step_s: the same ten steps whichever way they are sampled
    model = model._replace(cfl=step_s / 0.95 * kernels.fastest_rate(state, model))
    single, mean = rows_of(n, grid), rows_of(1, grid)
    (fields, profiles, series), (mean_fields, mean_profiles, mean_series) = single, mean
    assert kernels.advance(state, model, work, step_s, False, *single) == n
    _, _, again, _ = set_up()
    assert kernels.advance(again, model, work, n * step_s, True, *mean) == 1
    pairs = zip((*mean_fields, mean_profiles), (*fields, profiles), strict=True)
    for one, many in pairs:
        scale = np.nanmax(np.abs(many))  # float32 rounds at 6e-8
        np.testing.assert_allclose(one[0], many.mean(axis=0, dtype=float), atol=3e-7 * scale)
    np.testing.assert_allclose(mean_series[0, :2], series[:, :2].mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(mean_series[0, 2:], series[-1, 2:], rtol=1e-12)


def test_field_and_resistor_share_the_voltage():
    _, model, state, work = set_up()
    electrons.ohm(state, model, work.columns)
    drop = -model.dz * state.reference_field.sum() - model.resistance * state.current[0]
    assert drop == pytest.approx(-model.voltage, rel=1e-12)


def test_the_mean_field_is_that_of_the_reference_density():
    """<n ln(n/n_ref)> = 0: summed over r, n E misses the pressure's part alone."""
    grid, model, state, work = set_up()
    weight = np.where(grid.plasma, state.gas.n * grid.area, 0.0)
    electrons.sum_columns(state, model, work.columns)
    excess = weight * (state.log_n - work.columns.log_ref[:, None])
    np.testing.assert_allclose(excess.sum(axis=1), 0.0, atol=1e-12 * np.abs(excess).sum())


@pytest.mark.parametrize("p", [-3.0, -1e-5, 1e-7, 1e-5, 0.5, 20.0])
def test_fitted_fluxes_are_exact_between_two_temperatures(p):
    """Steady convection and conduction without sources: T = a + b exp(p x)."""
    before, behind = electrons.exponential_weights(2.0, 2.0 * p)
    exact = 2.0 * p * (5.0 - (9.0 - 5.0) / np.expm1(p))
    assert before * 5.0 - behind * 9.0 == pytest.approx(exact, rel=1e-11)


def test_fitted_fluxes_without_convection_are_conduction():
    assert electrons.exponential_weights(2.0, 0.0) == (2.0, 2.0)


def test_the_vectorised_logarithm_is_exact_to_rounding():
    x = 10.0 ** np.random.default_rng(0).uniform(-5, 25, 1000)
    found = np.array([electrons.logarithm(value) for value in x])
    np.testing.assert_allclose(found, np.log(x), rtol=4e-16, atol=4e-16)


def test_simulate_returns_labelled_si_fields(brief_run):
    check_field(brief_run)
    assert dict(brief_run.sizes) == {"time": 21, "z": N_Z, "r": N_R}
    assert brief_run["time"].values[0] == 0.0
    for name in PLANES:
        assert brief_run[name].dims == ("time", "z", "r")
        assert brief_run[name].dtype == np.float32
    for name in PROFILES:
        assert brief_run[name].dims == ("time", "z")
        assert np.isfinite(brief_run[name]).all()
    assert brief_run["I_d"].dtype == np.float64
    settings = json.loads(brief_run.attrs["parameters"])
    assert settings["settings"]["n_r"] == N_R
    assert settings["thruster"]["wall"]["class"] == "SheathWall"
    assert "depend on z alone" in brief_run.attrs["note"]
    assert brief_run.attrs["mass_balance"] == pytest.approx(1.0, abs=1e-9)


def test_the_thrusters_body_is_masked_at_all_times(brief_run):
    plasma = MaskedGrid(THRUSTER_2D, N_Z, N_R).plasma
    for name in PLANES:
        assert (np.isfinite(brief_run[name].values) == plasma).all()


def test_ions_leave_the_channel_and_spread(brief_run):
    at_exit = brief_run.sel(z=0.025, method="nearest").isel(time=-1)
    beam = at_exit.where((at_exit["r"] > 0.035) & (at_exit["r"] < 0.05), drop=True)
    assert float(beam["u_ir"].isel(r=0)) < 0.0 < float(beam["u_ir"].isel(r=-1))


def test_discharge_voltage_follows_the_series_resistance(brief_run):
    drop = THRUSTER_2D.series_resistance * brief_run["I_d"]
    np.testing.assert_allclose(300.0 - brief_run["V_d"], drop, rtol=1e-12)


@pytest.mark.parametrize("warm_up_s", [0.0, 1e-3])
def test_diverged_run_comes_back_marked_and_finite(warm_up_s):
    held_back = Thruster(transport=AnomalousTransport(1 / 3000, 1 / 3000))
    settings = BRIEF | {"duration_s": 1e-3, "warm_up_s": warm_up_s}
    field = simulate_2d(held_back, **settings)
    assert field.attrs["status"] == "diverged"
    assert field.attrs["cycle"] == "none"
    assert field.sizes["time"] < 668
    plasma = MaskedGrid(held_back, N_Z, N_R).plasma
    assert all(np.isfinite(field[name].values[:, plasma]).all() for name in PLANES)
    assert all(np.isfinite(field[name]).all() for name in (*PROFILES, "I_d", "V_d", "thrust"))


def test_the_config_names_the_set_that_the_package_takes_by_default(tmp_path):
    small = [f"data.{name}={value}" for name, value in (BRIEF | {"progress": "false"}).items()]
    config = programs.composed(
        "+exp=pointwise", "data=simulation_2d", f"data.cache={tmp_path}", *small
    )
    study = study_of(pointwise.Study, config)
    field = open_prepared(study.data, study.prepare)
    parameters = json.loads(field.attrs["parameters"])
    for name, value in (("thruster", THRUSTER_2D), ("operating_point", OPERATING_POINT_2D)):
        assert parameters[name] == json.loads(to_json({name: value}))[name]


def test_second_call_reads_identical_values(tmp_path):
    first = ep.thruster.simulate_2d(cache=tmp_path, **BRIEF)
    (path,) = tmp_path.iterdir()
    assert path.name.startswith("plane_300V_5mgs_")
    written = path.stat().st_mtime_ns
    second = ep.thruster.simulate_2d(cache=tmp_path, **BRIEF)
    assert path.stat().st_mtime_ns == written
    xr.testing.assert_identical(first.drop_attrs(), second.drop_attrs())
    assert all(first[name].dtype == second[name].dtype for name in first.variables)
    ep.thruster.simulate_2d(cache=tmp_path, **(BRIEF | {"averaged": False}))
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_z": 5}, r"n_z must be 10 or more .* got 5"),
        ({"thruster": Thruster(inner_radius=0.003)}, r"the plume must end before the axis"),
    ],
)
def test_bad_settings_say_what_must_hold(settings, message):
    with pytest.raises(ValueError, match=message):
        simulate_2d(**(BRIEF | settings))
