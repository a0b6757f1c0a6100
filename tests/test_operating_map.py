"""Where laws say that a cycle begins, and that it ends."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.model.comparison import Status
from ep2sindy.model.fixed_point import rest_point
from ep2sindy.operating.map import law_map
from ep2sindy.operating.records import OperatingRecord
from ep2sindy.signals.spectrum import relative_amplitude
from tests.models import model_of
from tests.test_operating_law import recorded
from tests.test_stability import HOPF

ONES = np.ones(2)


def at_one() -> OperatingRecord:
    return OperatingRecord(replace(recorded(1.0, 0.0).run, parameters={"a": 1.0}))


def hopf() -> ep.operating.OperatingLaw:
    """r' = r (a - r^2), phase' = 1: a cycle of radius sqrt(a) and period 2 pi where a > 0."""
    pairs = tuple((state, term) for state, terms in HOPF.items() for term in terms)
    coef = np.array([[0.0, 1.0] if s == t else [HOPF[s][t], 0.0] for s, t in pairs])
    return ep.operating.OperatingLaw(
        functions=ep.polynomial(["a"], degree=1),
        library=model_of(HOPF).library,
        states=("x", "y"),
        coefficients=pairs,
        coef=coef,
        points=np.array([[0.5], [1.5]]),
    )


def test_a_cycle_begins_where_the_fixed_point_turns_unstable() -> None:
    near = at_one()
    found = law_map(hopf(), [near], [{"a": a} for a in (-0.5, -0.1, 0.1, 1.0)])
    assert [p.status for p in found] == [Status.DECAYS] * 2 + [Status.SUSTAINED] * 2
    np.testing.assert_allclose([p.growth_per_s for p in found], [-0.5, -0.1, 0.1, 1.0], atol=1e-6)
    assert [p.inside for p in found] == [False, False, False, True]
    for point in found[2:]:
        assert point.frequency_Hz == pytest.approx(0.5 / np.pi, rel=1e-6)
        # A perturbation along the radius decays by exp(-2 a t).
        expected = np.exp(-4.0 * np.pi * point.parameters["a"])
        assert point.second == pytest.approx(expected, rel=1e-3, abs=1e-6)
    assert np.isnan(found[0].frequency_Hz)
    assert np.isnan(found[3].relative_amplitude)  # both states swing around zero


@pytest.mark.parametrize(
    ("mean", "std", "expected"),
    [
        ([2.0, 1.0], [1.0, 1.0], (0.625**0.5)),
        ([2.0, 1e-11], [1.0, 1.0], 0.5),  # a current, and its growth rate
        ([1e-3], [1.0], np.nan),
        ([0.0, -4.0], [0.0, 1.0], 32.0**-0.5),
    ],
)
def test_an_amplitude_is_no_ratio_to_a_mean_of_zero(
    mean: list[float], std: list[float], expected: float
) -> None:
    found = relative_amplitude(np.array(mean), np.array(std))
    assert found == pytest.approx(expected, nan_ok=True)


def test_the_amplitude_of_a_signal_and_its_growth_rate_is_that_of_the_signal() -> None:
    t = 0.01 * np.arange(6000)
    signal = np.exp(np.sin(t))
    states = np.column_stack([signal, np.cos(t)])
    record = OperatingRecord(ep.Trajectory(t, states, ["I", "g"], parameters={"a": 1.0}))
    expected = record.cycle.std[0] / record.cycle.mean[0]
    assert record.relative_amplitude == pytest.approx(expected)


def test_a_law_of_some_parameters_is_mapped_at_points_of_more() -> None:
    near = at_one()
    more = replace(near, run=replace(near.run, parameters={"b": 7.0, "a": 1.0}))
    (alone,) = law_map(hopf(), [near], [{"a": 1.2}])
    (found,) = law_map(hopf(), [more], [{"b": 7.0, "a": 1.2}])
    assert found.frequency_Hz == alone.frequency_Hz
    assert found.parameters == {"b": 7.0, "a": 1.2}


def test_a_start_where_a_state_passes_through_zero_ends_no_run() -> None:
    near = at_one()
    states = near.run.states.copy()
    states[near.slowest] = [1.0, 1e-9]
    near = replace(near, run=replace(near.run, states=states))
    (found,) = law_map(hopf(), [near], [{"a": 1.0}])
    assert found.status is Status.SUSTAINED


def test_a_model_that_runs_away_has_no_cycle() -> None:
    wild = replace(hopf(), coef=np.abs(hopf().coef))
    near = at_one()
    (found,) = law_map(wild, [near], [{"a": 1.0}])
    assert found.status is Status.DIVERGES
    assert np.isnan(found.relative_amplitude)


def test_fixed_points_and_their_eigenvalues_are_exact() -> None:
    model = model_of({"x": {"x": 2.0, "x*y": -1.0}, "y": {"x*y": 1.0, "y": -3.0}})
    rest = rest_point(model, np.array([2.5, 2.5]), ONES, ONES > 0.0)
    assert rest is not None
    np.testing.assert_allclose(rest.state, [3.0, 2.0], rtol=1e-8)
    assert rest.growth_per_s == pytest.approx(0.0, abs=1e-8)
    assert 2.0 * np.pi * rest.frequency_Hz == pytest.approx(6**0.5, abs=1e-8)
    drift = model_of({"x": {"1": 1.0}, "y": {"1": 1.0}})
    assert rest_point(drift, ONES, ONES, ONES > 0.0) is None
