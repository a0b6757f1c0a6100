"""The discharge's circuit and supply: exact networks, records that are driven, what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.thruster.axial.electron_kernels import follow_circuit, thevenin
from ep2sindy.thruster.axial.model import build_model, cell_faces, lengths_and_centres
from ep2sindy.thruster.axial.settings import to_json
from ep2sindy.thruster.axial.starts import GuessedStart
from ep2sindy.thruster.axial.state_kernels import CURRENT, SUPPLY, VOLTAGE
from ep2sindy.thruster.plane.simulate import OPERATING_POINT_2D, THRUSTER_2D
from tests.thrusters import POINT, brief

COIL = ep.thruster.Circuit(inductance=1e-4)
SINE = ep.thruster.ModulatedVoltage(fraction=0.05, frequency_Hz=2e4)


def driven(supply, **settings):
    return brief(point=replace(POINT, supply=supply), **settings)


def step_response(circuit, load_ohm, dt, n_steps):
    """Voltage over a resistor behind the circuit, after the supply is switched on at rest."""
    thruster = ep.thruster.Thruster(circuit=circuit, series_resistance=2.0)
    faces = cell_faces(thruster, 20, 1.0)
    model = build_model(thruster, POINT, faces, end_s=1.0)
    centres = lengths_and_centres(faces)[1]
    parameters = to_json({"thruster": thruster})
    state = GuessedStart().begin(model, centres, parameters).state
    state.instant[:] = 0.0
    state.instant[SUPPLY] = 100.0
    found = []
    for _ in range(n_steps):
        source, resistance = thevenin.py_func(state, model, dt)
        state.instant[CURRENT] = source / (resistance + load_ohm)
        follow_circuit.py_func(state, model, dt, source - resistance * state.instant[CURRENT])
        found.append(state.instant[VOLTAGE])
    return np.array(found)


def test_a_coil_and_a_capacitor_answer_a_step_as_the_exact_network():
    """L I' = V - R I - U, C U' = I - U/load: by its matrix exponential."""
    from scipy.linalg import expm

    R, load, dt, n = 2.0, 50.0, 2e-8, 4000
    for L, C in ((2e-4, 3e-7), (0.0, 3e-7), (2e-4, 0.0)):
        found = step_response(ep.thruster.Circuit(inductance=L, capacitance=C), load, dt, n)
        t = dt * np.arange(1, n + 1)
        if L and C:
            A = np.array([[-R / L, -1.0 / L], [1.0 / C, -1.0 / (C * load)]])
            end = np.linalg.solve(A, [-100.0 / L, 0.0])
            exact = np.array([(end - expm(A * now) @ end)[1] for now in t[:: n // 8]])
        else:
            tau = L / (R + load) if L else C * R * load / (R + load)
            exact = 100.0 * load / (R + load) * (1.0 - np.exp(-t[:: n // 8] / tau))
        np.testing.assert_allclose(found[:: n // 8], exact, atol=0.4)  # of 96 V: first order in dt


def test_the_supply_is_recorded_as_it_was_asked_for():
    field = driven(SINE, averaged=False)
    end = field["time"].values + 1.5e-6  # values at the end of each sample
    phase = 2.0 * np.pi * SINE.frequency_Hz * end
    np.testing.assert_allclose(field["V_supply"], 300.0 * (1.0 + 0.05 * np.sin(phase)), atol=1e-3)
    drop = field["V_supply"] - field["V_d"]
    resistance = ep.thruster.Thruster().series_resistance
    np.testing.assert_allclose(drop, resistance * field["I_d"], rtol=1e-9, atol=1e-9)


def test_the_voltage_is_held_during_the_warm_up():
    plain, sine = brief(), driven(SINE)
    assert float(sine["I_d"][0]) == pytest.approx(float(plain["I_d"][0]), rel=0.02)
    assert float(np.abs(sine["I_d"] - plain["I_d"]).max()) > 0.1


def test_a_large_capacitor_holds_the_voltage_and_a_large_coil_the_current():
    def run(circuit):
        thruster = ep.thruster.Thruster(series_resistance=2.0, circuit=circuit)
        return brief(thruster)

    plain = run(None)
    held = run(ep.thruster.Circuit(capacitance=1e-2))
    steady = run(ep.thruster.Circuit(inductance=1.0))
    assert float(held["V_d"].std()) < 0.05 * float(plain["V_d"].std())
    assert float(steady["I_d"].std()) < 0.05 * float(plain["I_d"].std())
    for field in (plain, held, steady):
        assert field.attrs["energy_balance"] == pytest.approx(1.0, abs=1e-4)
        assert field.attrs["mass_balance"] == pytest.approx(1.0, abs=1e-4)


def test_a_run_goes_on_with_its_circuit():
    thruster = ep.thruster.Thruster(circuit=ep.thruster.Circuit(inductance=1e-4, capacitance=1e-7))
    step = 1.5e-6
    whole = brief(thruster, duration_s=200 * step)
    first = brief(thruster, duration_s=99 * step)
    second = brief(thruster, duration_s=100 * step, warm_up_s=0.0, initial=first)
    np.testing.assert_array_equal(whole["V_d"][100:], second["V_d"])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (ep.thruster.Circuit, "an inductance or a capacitance: both are 0"),
    ],
)
def test_what_no_circuit_can_be_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("thruster", "point", "words"),
    [
        ({"circuit": COIL}, {}, "a circuit"),
        ({}, {"supply": SINE}, "a supply whose voltage varies"),
        ({}, {"background": ep.thruster.Background(1e-3)}, "a background gas"),
    ],
)
def test_the_z_r_model_refuses_what_it_does_not_solve(thruster, point, words):
    shaped = replace(THRUSTER_2D, **thruster)
    driven_so = replace(OPERATING_POINT_2D, **point)
    with pytest.raises(ValueError, match=f"does not solve {words}"):
        ep.thruster.simulate_2d(shaped, driven_so, progress=False)
