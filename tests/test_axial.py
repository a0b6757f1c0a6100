"""The axial model's averages, balances, starts and options: exact, on short runs."""

import numba
import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from benchmarks.hallthruster import calibrated_run
from ep2sindy.thruster.axial.electron_kernels import solve_from_both_ends
from ep2sindy.thruster.axial.model import cell_faces
from ep2sindy.thruster.propellants import PropellantTable
from ep2sindy.thruster.verdict import assess_status, cycle_peaks, diagnose, multiplicity
from tests.thrusters import POINT, brief

ZONE = (0.015, 0.025)


@pytest.fixture(scope="module")
def run():
    return brief()


def largest(balance):
    return max(float(np.abs(balance[name]).max()) for name in balance if name != "residual")


@pytest.mark.parametrize("settings", [{}, {"stretch": 2.0}, {"reconstruct": False}])
def test_the_balance_of_a_zone_closes_over_every_sample(settings):
    balance = ep.thruster.zone_balance(brief(**settings), ZONE)
    assert float(np.abs(balance["residual"]).max()) < 1e-6 * largest(balance)  # float32 fields
    ions = balance["change_i"] - balance["inflow_i"] - balance["ionization"] + balance["wall_loss"]
    assert float(np.abs(ions).max()) < 1e-6 * largest(balance)


@pytest.mark.parametrize(
    "thruster",
    [
        ep.thruster.Thruster(),
        ep.thruster.Thruster(anode=ep.thruster.AnodeSheath()),
        ep.thruster.Thruster(propellant=ep.thruster.propellant("xenon"), charge_states=2),
        ep.thruster.Thruster(propellant=ep.thruster.propellant("krypton"), conduction_coulomb=0.7),
    ],
    ids=["default", "anode sheath", "two charges", "krypton"],
)
def test_mass_and_energy_are_conserved(thruster):
    field = brief(thruster)
    assert field.attrs["mass_balance"] == pytest.approx(1.0, abs=1e-6)  # float32 fields
    assert field.attrs["energy_balance"] == pytest.approx(1.0, abs=1e-9)


def test_where_the_power_goes_adds_up(run):
    lost = sum(run[name] for name in ("P_inelastic", "P_wall", "P_anode", "P_cathode"))
    heated = run["P_in"] - run["P_ions"]
    assert float(lost.mean()) == pytest.approx(float(heated.mean()), rel=0.3)  # the rest is stored
    bare = brief(
        ep.thruster.Thruster(series_resistance=0.0)
    )  # what the cathode leaves to the plasma
    np.testing.assert_allclose(bare["P_in"], 280.0 * bare["I_d"], rtol=1e-9)


def test_samples_are_averages_over_their_step():
    fine = brief(sample_s=1e-6, duration_s=1e-4, cfl=0.2)
    coarse = brief(sample_s=1e-5, duration_s=1.6e-4, cfl=0.2)
    blocks = fine["n_i"].values[:100].astype(float).reshape(10, 10, 40).mean(axis=1)
    # each sample is cut into equal steps, so these differ, and the coupled code is of first order
    np.testing.assert_allclose(blocks, coarse["n_i"].values[:10], rtol=2e-2)
    instants = fine["n_i"].values[9:100:10]  # at the ends of the coarse samples
    assert np.abs(instants / coarse["n_i"].values[:10] - 1.0).max() > 0.1


def test_instantaneous_samples_on_request():
    field = brief(averaged=False)
    assert "ionization" not in field
    assert "mass_balance" not in field.attrs
    assert float(np.abs(field["n_i"] - brief()["n_i"]).max()) > 0.0
    np.testing.assert_array_equal(field["n_i"].values[-1], field["end_n_i"].values.astype("f4"))


def test_the_average_of_a_product_is_not_the_product_of_averages(run):
    product = run["n_i"] * run["n_n"] * run["R_ion"]
    assert not np.allclose(run["ionization"], product, rtol=1e-4)
    assert 0.9 < float((run["ionization"] / product).median()) < 1.1
    zone = ep.Zone(z=ZONE)
    data = ep.zone_average(run, zone, states=["n_i"], products=["R_ion*n_i*n_n", "n_i*u_iz"])
    kept = ep.zone_average(run, zone, states=["n_i"], inputs=["ionization", "flux_i"])
    np.testing.assert_array_equal(data.inputs, kept.inputs)
    assert data.units["<R_ion*n_i*n_n>"] == "m^-3 s^-1"


@pytest.mark.parametrize("size", [12, 13, 402])
@pytest.mark.parametrize("scale", [1.0, 1e18])
def test_the_solver_from_both_ends_solves(size, scale):
    rng = np.random.default_rng(0)
    lower, upper, known = -rng.random((3, size))
    diagonal = 2.5 + rng.random(size)
    matrix = np.diag(diagonal) + np.diag(lower[1:], -1) + np.diag(upper[:-1], 1)
    matrix[[0, -1]] = np.eye(size)[[0, -1]]  # T is given at the ends
    T = np.zeros(size)
    T[0], T[-1] = 3.0, 4.0
    known[0], known[-1] = T[0], T[-1]

    @numba.njit
    def solved(lower, diagonal, upper, known, T):
        solve_from_both_ends(lower, diagonal, upper, known, T, np.zeros(T.size), np.zeros(T.size))

    solved(*(scale * each for each in (lower, diagonal, upper, known)), T)
    np.testing.assert_allclose(T, np.linalg.solve(matrix, known), rtol=1e-12)


def test_a_restart_goes_on_to_the_last_digit(tmp_path):
    whole = brief(duration_s=6e-4)
    first = brief(duration_s=3e-4)
    first.to_netcdf(tmp_path / "first.nc", engine="h5netcdf")
    for initial in (first, tmp_path / "first.nc", ep.thruster.Restart(first)):
        rest = brief(initial=initial, warm_up_s=0.0, duration_s=2e-4)
        after = whole.isel(time=slice(first.sizes["time"], None))
        np.testing.assert_array_equal(rest["n_i"], after["n_i"].values[: rest.sizes["time"]])
        np.testing.assert_array_equal(rest["I_d"], after["I_d"].values[: rest.sizes["time"]])


def test_a_restart_on_another_grid_is_interpolated_and_says_so(run):
    field = brief(initial=run, n_cells=60, warm_up_s=0.0)
    assert field.attrs["initial"].endswith("interpolated from 40 to 60 cells")
    guessed = brief(n_cells=60, warm_up_s=0.0)
    for name, near in {"n_i": 0.2, "n_n": 0.1}.items():  # in one sample n_i changes by a tenth
        there = run[name].isel(time=-1).interp(z=field["z"]).dropna("z")
        off = np.abs(field[name].isel(time=0) / there - 1.0).median()
        assert off < near
    assert np.abs(guessed["n_n"].isel(time=0) / there - 1.0).median() > 0.1


def test_a_restart_at_another_operating_point_is_a_continuation(run):
    field = brief(point=ep.thruster.OperatingPoint(310.0, 5.0), initial=run, warm_up_s=0.0)
    assert "interpolated" not in field.attrs["initial"]
    same = brief(initial=run, warm_up_s=0.0)
    np.testing.assert_allclose(field["n_n"][0], same["n_n"][0], rtol=3e-3)
    assert 0.0 < float(field["I_d"][0] - same["I_d"][0]) < 0.3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda run: brief(
            ep.thruster.Thruster(propellant=ep.thruster.propellant("krypton")), initial=run),
         r"only in the same thruster: propellant was"),
        (lambda run: brief(initial=run.assign_attrs(status="diverged")), r"did not diverge"),
        (lambda run: brief(initial=run[["n_i"]]), r"must be a run of simulate"),
        (lambda run: ep.thruster.zone_balance(run, (0.03, 0.0498)),
         r"must end before the last cell"),
    ],
)  # fmt: skip
def test_bad_input_says_the_way_out(run, make, message):
    with pytest.raises(ValueError, match=message):
        make(run)


def test_a_soft_start_holds_back_until_it_is_released():
    starts = ep.thruster.SoftStart(hold_s=5e-4), ep.thruster.ColdStart()
    fields = [brief(initial=start, warm_up_s=0.0) for start in starts]
    assert [field.attrs["initial"] for field in fields] == [start.label for start in starts]
    held, free = (field["I_d"].values for field in fields)
    assert held[0] < 6.0  # of 280 V over 40 ohm, 7 A, most is the plasma's
    assert held.max() > 2.0 * held[0]  # let go
    assert free.max() > 20.0  # it ignites


def test_two_charges_are_ionised_further():
    thruster = ep.thruster.Thruster(propellant=ep.thruster.propellant("xenon"), charge_states=2)
    field = brief(thruster)
    assert "average_of" not in field["ionization"].attrs  # rates of its own ionise the second
    fraction = float((field["n_i2"] / field["n_i"]).mean())
    assert 1e-3 < fraction < 0.3
    exit_speed = field["u_iz2"].isel(z=-1).mean() / field["u_iz"].isel(z=-1).mean()
    assert 1.1 < float(exit_speed) < 1.5  # sqrt(2) for ions that fell all the way


def test_first_order_fluxes_damp():
    sharp, blunt = (brief(reconstruct=on, duration_s=1e-3) for on in (True, False))
    assert float(blunt["I_d"].std()) < float(sharp["I_d"].std())


def test_a_stretched_grid_has_long_cells_in_the_plume():
    thruster = ep.thruster.Thruster()
    lengths = np.diff(cell_faces(thruster, 100, 2.0))
    assert lengths.sum() == pytest.approx(thruster.domain_length)
    assert lengths[-1] / lengths[0] == pytest.approx(2.0, rel=0.02)
    assert np.all(np.abs(np.diff(lengths)) < 0.1 * lengths[:-1])  # smooth
    np.testing.assert_allclose(np.diff(cell_faces(thruster, 50, 1.0)), 1e-3)


@pytest.mark.parametrize(
    ("f_Hz", "status"), [(15e3, "oscillating"), (58e3, "oscillating"), (143e3, "transit")]
)
def test_a_transit_oscillation_is_told_from_breathing(f_Hz, status):
    t = 1.5e-6 * np.arange(4000)
    assert assess_status(4.0 + np.sin(2e0 * np.pi * f_Hz * t), 1.5e-6) == status


def verdict_on(current, *, diverged=False):
    t = 1.5e-6 * np.arange(current.size)
    field = xr.Dataset({"I_d": ("time", current)}, coords={"time": t})
    return diagnose(field, diverged=diverged, flow_A=4.0)


@pytest.mark.parametrize(("amplitude", "cycle"), [(6.0, "strong"), (2.0, "weak")])
def test_a_result_names_its_cycle(amplitude, cycle):
    current = 4.0 + amplitude * np.sin(2.0 * np.pi * 14e3 * 1.5e-6 * np.arange(4000))
    assert verdict_on(current)["cycle"] == cycle


@pytest.mark.parametrize(("late_A", "status"), [(0.0, "out"), (0.39, "out"), (0.41, "steady")])
def test_a_discharge_that_has_gone_out_is_not_steady(late_A, status):
    assert verdict_on(np.repeat([4.0, late_A], 2000))["status"] == status


def test_efficiency_is_by_the_mean_power(run):
    """A series resistor lowers the voltage where the current is high."""
    resistive = brief(ep.thruster.Thruster(series_resistance=10.0))
    for field in (run, resistive):
        power = float((field["I_d"] * field["V_d"]).mean())
        squared = float(field["thrust"].mean()) ** 2
        expected = squared / (2.0 * 1e-6 * POINT.mass_flow_mg_s * power)
        assert field.attrs["anode_efficiency"] == pytest.approx(expected, rel=1e-12)
    apart = float(resistive["I_d"].mean() * resistive["V_d"].mean())
    assert power < 0.9999 * apart


def cold_xenon(hottest_eV):
    T = np.linspace(1.0, hottest_eV, 30)
    xenon = ep.thruster.XenonFits()
    table = PropellantTable(
        name="cold xenon", mass=xenon.mass, ionization_eV=12.13, excitation_eV=8.32,
        T_e_eV=tuple(T),
        ionization_rate=tuple(xenon.ionization(T)),
        excitation_rate=tuple(xenon.events(T) - xenon.ionization(T)),
        momentum_rate=tuple(xenon.momentum(T)),
    )  # fmt: skip
    return ep.thruster.Thruster(propellant=table)


def test_drift_beyond_the_table_is_no_divergence():
    """T_e stays cold while a spike of the field drives T_e + 2K/3 beyond the table's 200 eV."""
    field = calibrated_run("withplume", duration_s=3e-5, n_cells=60)
    assert field.attrs["status"] != "diverged"
    assert field.sizes["time"] == 21
    assert float(field["T_e_eV"].max()) < 60.0


def test_rates_that_do_not_cover_the_run_say_so():
    field = brief(cold_xenon(12.0))
    assert "cover T_e up to 12 eV, and the run reached T_e + 2K/3" in field.attrs["rates"]
    warmest = float(brief()["T_e_eV"].max()) + 1.0  # not so T_e + 2 K/3
    field = brief(cold_xenon(warmest))
    assert float(field["T_e_eV"].max()) < warmest
    assert f"cover T_e up to {warmest:g} eV" in field.attrs["rates"]
    assert brief().attrs["rates"] == "covered"


@pytest.mark.parametrize(("last_A", "status"), [(1e-300, "out"), (4.0, "diverged")])
def test_a_discharge_that_falls_to_nothing_has_gone_out(last_A, status):
    assert verdict_on(np.geomspace(4.0, last_A, 400), diverged=True)["status"] == status


@pytest.mark.parametrize("m", [1, 2, 3])
def test_a_cycle_that_repeats_after_m_has_that_multiplicity(m):
    t = 1.5e-6 * np.arange(6000)
    heights = 1.0 + np.arange(m) / m
    current = 4.0 + heights[np.floor(15e3 * t).astype(int) % m] * np.sin(2 * np.pi * 15e3 * t)
    peaks = cycle_peaks(current, 1.5e-6, 15e3)
    assert peaks.size == 135
    again, spread = multiplicity(peaks)
    assert again == m
    assert spread == pytest.approx(heights.std() / (4.0 + heights.mean()), abs=2e-3)


def test_peaks_without_order_have_a_spread_and_no_multiplicity():
    again, spread = multiplicity(5.0 + np.random.default_rng(0).normal(size=400))
    assert np.isnan(again)
    assert spread == pytest.approx(0.2, rel=0.1)
    assert np.isnan(multiplicity(np.ones(5))).all()
