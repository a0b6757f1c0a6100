"""Delayed terms through a chain of stages: the stages, their equations, and a search with them."""

import numpy as np
import pytest
from scipy.stats import gamma

import ep2sindy as ep

RATE, DELAY = 1.3, ep.signals.Delay("x", 2.0, n_stages=4)


def logistic(t: np.ndarray) -> ep.Trajectory:
    """Growth x' = RATE x (1 - x_lag4), whose crowding is felt two seconds late: x alone."""
    names = ["x", *DELAY.names]
    library = ep.polynomial(names, degree=2)
    terms = [{"x": RATE, "x*x_lag4": -RATE}, *DELAY.equations.values()]
    model = ep.SparseModel(library, names, ep.model.coef_matrix(library, terms))
    return ep.Trajectory(t, model.simulate(t, [0.5] * 5).states[:, :1], ["x"])


def test_a_step_passes_the_stages_as_a_gamma_distribution() -> None:
    t = np.linspace(0.0, 40.0, 40001)
    run = ep.Trajectory(t, np.where(t < 10.0, 0.0, 1.0)[:, None], ["x"], units={"x": "A"})
    long = DELAY.along(run)
    assert long.state_names == ("x", "x_lag1", "x_lag2", "x_lag3", "x_lag4")
    assert long.units["x_lag4"] == "A"
    since = np.maximum(long.t - 10.0 + 0.5 * run.dt_s, 0.0)  # a straight line joins 0 and 1
    for k in range(4):
        exact = gamma.cdf(since, k + 1, scale=0.5)
        np.testing.assert_allclose(long.states[:, 1 + k], exact, atol=run.dt_s)


def test_the_start_is_left_out_until_it_is_forgotten() -> None:
    run = ep.Trajectory(np.arange(0.0, 20.0, 0.5), np.sin(np.arange(40.0))[:, None], ["x"])
    assert DELAY.along(run).t[0] == 6.0


def test_a_zone_keeps_its_place_in_the_name() -> None:
    delay = ep.signals.Delay("n_n@exit", 1.0, n_stages=2)
    assert delay.names == ("n_n_lag1@exit", "n_n_lag2@exit")
    assert delay.last == "n_n_lag2@exit"
    assert delay.equations == {
        "n_n_lag1@exit": {"n_n@exit": 2.0, "n_n_lag1@exit": -2.0},
        "n_n_lag2@exit": {"n_n_lag1@exit": 2.0, "n_n_lag2@exit": -2.0},
    }


def found_with(run: ep.Trajectory, delay: ep.signals.Delay) -> tuple[ep.Discovery, ep.Trajectory]:
    long = delay.along(run)
    method = ep.Regression(
        ep.Differential(ep.signals.NoSmoothing()), ep.BestSubset(max_terms=2), ep.FreeRunScore()
    )
    library = ep.polynomial(["x", delay.last], degree=2)
    return ep.discover(long, library.with_roles(ep.Roles(equations=delay.equations)), method), long


def test_a_search_finds_what_is_delayed_and_leaves_the_stages_as_they_are() -> None:
    found, long = found_with(logistic(np.arange(0.0, 90.0, 0.05)), DELAY)
    # What is left: the samples' straight lines, of second order in the step.
    assert found.model.terms("x") == pytest.approx({"x": RATE, "x*x_lag4": -RATE}, rel=1e-3)
    for state, terms in DELAY.equations.items():
        assert found.model.terms(state) == terms  # to the last digit
    run = ep.evaluate(found.model, long)
    assert run.status is ep.model.Status.SUSTAINED
    assert ep.model.limit_cycle(found.model, long.states[-1], period_s=1.0 / run.frequency_Hz["x"])


def test_another_delay_does_not_live() -> None:
    found, long = found_with(
        logistic(np.arange(0.0, 90.0, 0.05)), ep.signals.Delay("x", 1.0, n_stages=4)
    )
    assert ep.evaluate(found.model, long).status is not ep.model.Status.SUSTAINED


def test_a_run_at_unequal_steps_is_refused() -> None:
    t = np.arange(9.0) ** 2
    with pytest.raises(ValueError, match="at equal time steps"):
        ep.signals.Delay("x", 1.0).along(ep.Trajectory(t, np.sin(t)[:, None], ["x"]))
