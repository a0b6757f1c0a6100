"""The facility's gas, what its pressure moves, and neutrals whose speed varies."""

import math
from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.thruster.axial.model import build_model, cell_faces, lengths_and_centres
from ep2sindy.thruster.constants import K_BOLTZMANN, M_XENON
from tests.thrusters import POINT, brief

TORR = 133.322  # Pa
GAUSS = ep.thruster.GaussianTransport()
SHIFT = ep.thruster.PressureShift(
    GAUSS, z0=-0.17682, dz=0.3594, pressure_Pa=4.735e-5 * TORR, alpha=15.0
)
Z = np.linspace(-0.02, 0.02, 81)


def at(pressure_Pa: float, **given: float) -> ep.thruster.OperatingPoint:
    return replace(POINT, background=ep.thruster.Background(pressure_Pa, **given))


def test_the_channel_takes_in_the_flux_of_a_gas_at_rest() -> None:
    thruster, T, p = ep.thruster.Thruster(), 300.0, 1e-5 * TORR
    flux = p / math.sqrt(2.0 * math.pi * M_XENON * K_BOLTZMANN * T)  # Hertz and Knudsen
    expected = 1e6 * flux * M_XENON * thruster.area
    assert at(p).inflow_mg_s(thruster) - 5.0 == pytest.approx(expected, rel=1e-12)
    tripled = at(p, ingestion=3.0).inflow_mg_s(thruster)
    assert tripled - 5.0 == pytest.approx(3.0 * expected, rel=1e-12)
    assert POINT.inflow_mg_s(thruster) == 5.0


def test_the_model_takes_the_ingested_flow_and_the_shift() -> None:
    thruster = ep.thruster.Thruster(transport=SHIFT)
    faces = cell_faces(thruster, 40, 1.0)
    dense = at(2e-3, ingestion=6.0)
    model = build_model(thruster, dense, faces, end_s=1e-3)
    flow = model.neutral_inflow * thruster.area * M_XENON
    assert flow == pytest.approx(1e-6 * dense.inflow_mg_s(thruster), rel=1e-12)
    distance = lengths_and_centres(faces)[1] - thruster.channel_length
    c = GAUSS.at(distance - 0.025 * SHIFT.shift(2e-3))
    np.testing.assert_allclose(model.anomalous, c * model.omega_ce)


def test_the_transport_moves_towards_the_anode_with_the_pressure() -> None:
    """2.96 mm is what the calibrated SPT-100 of HallThruster.jl have at 1e-5 Torr."""
    thruster = ep.thruster.Thruster(transport=SHIFT)
    assert 0.025 * SHIFT.shift(1e-5 * TORR) == pytest.approx(2.957e-3, abs=2e-6)
    assert SHIFT.shift(0.0) == pytest.approx(-0.17682 + 0.3594 * 14.0 / 15.0)
    assert SHIFT.shift(0.5 * SHIFT.pressure_Pa) == pytest.approx(-0.17682 + 0.5 * 0.3594)
    assert SHIFT.shift(1e6) == pytest.approx(-0.17682)
    for background, shift in (
        (None, SHIFT.shift(0.0)),
        (ep.thruster.Background(1e-3), SHIFT.shift(1e-3)),
    ):
        found = thruster.transport_at(Z, background)
        np.testing.assert_allclose(found, GAUSS.at(Z - 0.025 * shift))
    plain = ep.thruster.Thruster(transport=GAUSS)
    np.testing.assert_array_equal(plain.transport_at(Z, ep.thruster.Background(1.0)), GAUSS.at(Z))


def test_the_pressure_is_part_of_a_simulation_and_its_balance_closes() -> None:
    settings = {"duration_s": 1e-4, "warm_up_s": 0.0, "n_cells": 30}
    field = brief(point=at(0.05), **settings)
    assert field.attrs["mass_balance"] == pytest.approx(1.0, abs=1e-3)  # stored in float32
    plain = brief(**settings)
    assert float(field["n_n"].mean()) > 1.01 * float(plain["n_n"].mean())


def test_a_speed_of_the_neutrals_follows_its_table() -> None:
    table = ep.thruster.NeutralSpeed([-0.025, 0.0], [200.0, 300.0])
    point = replace(POINT, neutral_speed=table)
    found = point.neutral_speed_at(np.array([-0.1, -0.025, -0.0125, 0.0, 0.1]))
    np.testing.assert_allclose(found, [200.0, 200.0, 250.0, 300.0, 300.0])
    np.testing.assert_array_equal(POINT.neutral_speed_at(Z), POINT.neutral_speed)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="pressure_Pa must be finite and zero or more"):
        ep.thruster.Background(-1.0)
    with pytest.raises(ValueError, match="everywhere, got 0 m/s"):
        ep.thruster.NeutralSpeed([0.0, 1.0], [1.0, 0.0])
