"""Closures of the LANDMARK cases; the cases themselves run in test_hallthruster_agreement."""

import numpy as np

from benchmarks.landmark import ExponentialWall, TabulatedRates
from ep2sindy.thruster.constants import M_XENON

T = np.array([5.0, 10.0, 20.0])
DISTANCE = np.array([-2e-3, -1e-3, 0.0, 1e-3, 2e-3])


def rates(*energy_eV: float) -> TabulatedRates:
    return TabulatedRates(
        mean_energy_eV=energy_eV, ionization_rate=(1e-14, 3e-14), energy_loss_rate=(1e-13, 5e-13)
    )


def test_the_wall_is_the_benchmarks_formula():
    wall = ExponentialWall((0.5, 1.0))
    np.testing.assert_allclose(wall.power(T, 0.0, M_XENON), 1.5e7 * T * np.exp(-20.0 / (1.5 * T)))
    np.testing.assert_array_equal(wall.power_weight(DISTANCE), [0.5, 0.5, 1.0, 1.0, 1.0])
    np.testing.assert_array_equal(wall.collision_weight(DISTANCE), [1.0, 1.0, 0.0, 0.0, 0.0])


def test_rates_are_linear_in_the_mean_energy_from_zero_and_constant_beyond():
    table = rates(10.0, 20.0)
    found = table.ionization(np.array([5.0, 15.0, 20.0, 90.0]) / 1.5)
    np.testing.assert_allclose(found, [5e-15, 2e-14, 3e-14, 3e-14])
    others = (table.events, table.drift_events, table.coulomb)
    assert not any(each(T).any() for each in others)
    assert (table.drift_weight, table.charge_states) == (0.0, 1)
