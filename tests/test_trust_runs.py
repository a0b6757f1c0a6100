"""Runs of models: they end, and say when and why."""

import numpy as np
import pytest

from tests.models import model_of


@pytest.mark.parametrize(("rate", "x0"), [({"x^20": 1e300}, 1e10), ({"x^2": 1e200}, 1e150)])
def test_a_first_step_that_overflows_is_a_verdict(rate: dict[str, float], x0: float) -> None:
    run = model_of({"x": rate}).simulate(np.linspace(0.0, 1.0, 11), [x0])
    assert run.diverged
    assert run.message == "the first step overflows: a rate at t = 0 s is not finite"
    np.testing.assert_array_equal(run.states, [[x0]])


def test_a_fast_decay_is_integrated_implicitly_to_its_end() -> None:
    t = np.linspace(0.0, 10.0, 101)
    run = model_of({"x": {"x": -1e9}, "y": {"x": 1e9, "y": -1.0}}).simulate(t, [1.0, 1.0])
    assert not run.diverged
    assert "stiff from t = " in run.message
    np.testing.assert_allclose(run.states[1:, 1], 2.0 * np.exp(-t[1:]), atol=1e-6)
    np.testing.assert_array_equal(run.t, t)


def test_a_stiff_oscillator_goes_through_its_jumps() -> None:
    """Van der Pol at mu = 1000: its period is mu (3 - 2 ln 2) + 7.014 mu^(-1/3).

    Source: Dorodnitsyn 1947; the next term is O(ln(mu) / mu).
    """
    mu = 1000.0
    equations = {"x": {"y": 1.0}, "y": {"y": mu, "x^2*y": -mu, "x": -1.0}}
    t = np.linspace(0.0, 4000.0, 8001)
    run = model_of(equations).simulate(t, [2.0, 0.0])
    assert not run.diverged
    x = run.states[:, 0]
    falls = t[1:][(x[:-1] > 0.0) & (x[1:] <= 0.0)]
    expected = mu * (3.0 - 2.0 * np.log(2.0)) + 7.014 * mu ** (-1 / 3)
    assert np.diff(falls) == pytest.approx(expected, abs=1.0)  # two samples
