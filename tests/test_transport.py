"""Anomalous transport along the axis."""

import numpy as np
import pytest

import ep2sindy as ep


def test_anomalous_coefficient_is_linear_across_the_exit():
    transport = ep.thruster.AnomalousTransport(1 / 300, 1 / 145, 3e-3)
    c = transport.at(np.array([-2e-3, -1.5e-3, 0.0, 1.5e-3, 2e-3]))
    middle = 0.5 * (1 / 300 + 1 / 145)
    np.testing.assert_allclose(c, [1 / 300, 1 / 300, middle, 1 / 145, 1 / 145])


def test_the_trough_keeps_its_share_and_no_more():
    trough = ep.thruster.GaussianTransport(c_far=0.06, trough=0.1, center=1e-3, width=2e-3)
    c = trough.at(np.array([1e-3, 3e-3, -1.0]))
    np.testing.assert_allclose(c, [0.006, 0.06 * (1.0 - 0.9 * np.exp(-0.5)), 0.06])


def test_points_are_met_and_the_way_between_is_a_power():
    model = ep.thruster.MultiLogTransport(distance=[-0.02, 0.0, 0.01], c=[1e-2, 1e-3, 1e-1])
    np.testing.assert_allclose(model.at(np.array([-0.02, 0.0, 0.01])), [1e-2, 1e-3, 1e-1])
    np.testing.assert_allclose(model.at(np.array([-0.01, 0.005])), [10**-2.5, 1e-2])
    np.testing.assert_allclose(model.at(np.array([-1.0, 1.0])), [1e-2, 1e-1])


def test_equal_points_are_the_two_zone_model_without_zones():
    distance = np.linspace(-0.025, 0.025, 11)
    flat = ep.thruster.MultiLogTransport([-0.01, 0.01], [0.0125, 0.0125]).at(distance)
    np.testing.assert_allclose(flat, ep.thruster.AnomalousTransport(0.0125, 0.0125).at(distance))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ep.thruster.GaussianTransport(trough=1.5), r"GaussianTransport\.trough must be"),
        (lambda: ep.thruster.MultiLogTransport([0.0, 0.0], [0.1, 0.1]), r"must increase: 0 follow"),
    ],
)
def test_bad_transport_says_what_must_hold(build, message):
    with pytest.raises(ValueError, match=message):
        build()
