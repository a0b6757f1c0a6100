"""The plume's cross-section: exact cones, an integral, and angles that are refused."""

import math

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.thruster.axial.heavy_kernels import heavy_step
from ep2sindy.thruster.axial.model import (
    build_model,
    cell_faces,
    followers_of,
    lengths_and_centres,
)
from ep2sindy.thruster.axial.settings import to_json
from ep2sindy.thruster.axial.simulate import simulate
from ep2sindy.thruster.axial.starts import GuessedStart
from ep2sindy.thruster.axial.state_kernels import CELL_SUMS, new_sums, new_work
from ep2sindy.thruster.balance import zone_balance
from ep2sindy.thruster.constants import E_CHARGE, M_XENON
from ep2sindy.thruster.parameters import OperatingPoint, Thruster
from ep2sindy.thruster.plume import ConicalPlume, Plume, ThermalPlume, relative_area
from ep2sindy.thruster.propellant_files import propellant

DISTANCE = np.array([-0.02, -0.01, -1e-3, 2e-3, 5e-3, 0.02, 0.05])
RADII = {"inner_radius": 0.035, "outer_radius": 0.05}
SPEED = np.linspace(-2e3, 2e4, DISTANCE.size)
PLASMA = {"exit_T_e_eV": 25.0, "ion_mass": M_XENON}


@pytest.mark.parametrize("degrees", [0.0, 10.0, 40.0])
def test_a_cone_grows_as_its_radii(degrees: float) -> None:
    thruster = ep.thruster.Thruster()
    plume = ep.thruster.ConicalPlume(degrees)
    tangents = plume.tangents(SPEED, **PLASMA)
    growth = math.tan(math.radians(degrees)) * np.maximum(DISTANCE, 0.0)
    outer, inner = 0.05 + growth, np.maximum(0.035 - growth, 0.0)
    expected = np.pi * (outer**2 - inner**2) / thruster.area
    found = relative_area(DISTANCE, tangents, **RADII)
    np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_a_tangent_that_varies_is_integrated() -> None:
    """tan = x/L beyond the exit, linear: h = x^2/(2 L), from the first place on."""
    L = 0.1
    z = np.concatenate([[-0.01, 0.0], np.linspace(0.0, 0.05, 300)[1:]])
    growth = np.maximum(z, 0.0) ** 2 / (2.0 * L)
    expected = ((0.05 + growth) ** 2 - (0.035 - growth) ** 2) / (0.05**2 - 0.035**2)
    found = relative_area(z, np.maximum(z, 0.0) / L, **RADII)
    np.testing.assert_allclose(found, expected, atol=2e-5)  # of dz^2/(2 L) in h


def test_a_thermal_plume_spreads_by_sound_over_speed() -> None:
    sound = math.sqrt(5.0 * E_CHARGE * 25.0 / (3.0 * M_XENON))
    speed = np.array([-500.0, 0.0, sound, 2.0 * sound, 17_000.0])
    found = ep.thruster.ThermalPlume().tangents(speed, **PLASMA)
    np.testing.assert_allclose(found, [1.0, 1.0, 1.0, 0.5, sound / 17_000.0])


@pytest.mark.parametrize("degrees", [46.0, math.nan])
def test_an_angle_out_of_range_is_refused(degrees: float) -> None:
    with pytest.raises(ValueError, match=r"half_angle_deg must be from 0 to 45, got .*; give"):
        ep.thruster.ConicalPlume(degrees)


POINT = OperatingPoint(300.0, 5.0)
SHORT = {"duration_s": 1.5e-4, "warm_up_s": 1.5e-4, "progress": False}


@pytest.mark.parametrize("plume", [ConicalPlume(20.0), ThermalPlume()])
def test_a_discharge_that_spreads_conserves_mass_and_energy(plume: Plume) -> None:
    field = simulate(Thruster(plume=plume), POINT, **SHORT)
    assert field.attrs["mass_balance"] == pytest.approx(1.0, abs=1e-6)
    assert field.attrs["energy_balance"] == pytest.approx(1.0, abs=1e-6)
    area = field["area"].isel(time=-1)
    assert float(area[0]) == 1.0
    assert bool((area.diff("z") >= 0.0).all())
    assert float(area[-1]) > 1.2


def test_a_beam_thins_as_its_area_grows() -> None:
    """Without sources n u A stays the same at every place, of ions and of neutrals."""
    thruster = Thruster(ion_temperature=0.0, plume=ConicalPlume(30.0))
    faces = cell_faces(thruster, 100, 2.0)
    model = build_model(thruster, POINT, faces, end_s=1.0)
    parameters = to_json({"thruster": thruster})
    state = GuessedStart().begin(model, lengths_and_centres(faces)[1], parameters).state
    assert followers_of(thruster, model, state, faces) == []
    speed, inflow = 5000.0, model.neutral_inflow
    state.n_i[:] = 1e17 / model.spread
    state.flux_i[:] = speed * state.n_i
    state.n_n[:] = inflow / POINT.neutral_speed / model.spread
    sums, work = new_sums(len(CELL_SUMS), 102), new_work(1, 102)
    for _ in range(200):
        heavy_step(state, model, 1e-8, sums, work)
    beyond = slice(62, 100)  # ions are not replaced at the anode; the last cell is first order
    through = (state.flux_i[0] * model.spread)[beyond]
    np.testing.assert_allclose(through, speed * 1e17, rtol=2e-3)
    neutrals = (state.n_n * model.spread)[1:-2]
    np.testing.assert_allclose(neutrals[60:], inflow / POINT.neutral_speed, rtol=2e-3)


def test_thrust_is_the_axial_part_of_the_momentum() -> None:
    whole = simulate(Thruster(plume=ConicalPlume(30.0, axial_thrust=False)), POINT, **SHORT)
    axial = simulate(Thruster(plume=ConicalPlume(30.0)), POINT, **SHORT)
    np.testing.assert_allclose(axial["thrust"], whole["thrust"] * np.cos(np.pi / 6.0))
    np.testing.assert_allclose(axial["half_angle"], 30.0)


def test_a_thermal_plume_goes_on_from_its_end_to_the_last_digit() -> None:
    thruster, half = Thruster(plume=ThermalPlume()), {**SHORT, "duration_s": 7.5e-5}
    whole = simulate(thruster, POINT, **SHORT)
    first = simulate(thruster, POINT, **half)
    second = simulate(thruster, POINT, **{**half, "warm_up_s": 0.0}, initial=first)
    joined = np.concatenate([first["I_d"].values, second["I_d"].values[:-1]])
    np.testing.assert_array_equal(joined[: whole.sizes["time"]], whole["I_d"].values[: joined.size])


def test_a_balance_is_of_a_zone_in_the_channel() -> None:
    field = simulate(Thruster(plume=ThermalPlume()), POINT, **SHORT)
    balance = zone_balance(field, (0.0, 0.024))
    scale = float(np.abs(balance["change_n"]).max())
    assert float(np.abs(balance["residual"]).max()) < 1e-5 * scale
    with pytest.raises(ValueError, match="into the plume; end it at the exit"):
        zone_balance(field, (0.0, 0.03))


@pytest.mark.parametrize("charges", [2, 3])
def test_ions_of_every_charge_conserve_mass_and_energy(charges: int) -> None:
    thruster = Thruster(propellant=propellant("xenon"), charge_states=charges)
    field = simulate(thruster, POINT, **SHORT)
    assert field.attrs["mass_balance"] == pytest.approx(1.0, abs=1e-6)
    assert field.attrs["energy_balance"] == pytest.approx(1.0, abs=1e-6)
    means = [float(field[f"n_i{k}"].mean()) for k in ("", 2, 3)[:charges]]
    assert sorted(means, reverse=True) == means
    assert min(means) > 1e-4 * means[0]
