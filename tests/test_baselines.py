"""Forecasts without a model: what each of them knows, at equal steps and others."""

import numpy as np
import pytest
from statsmodels.tsa.ar_model import ar_select_order

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.baselines import (
    Autoregression,
    Harmonics,
    Neighbours,
    Persistence,
    baseline_errors,
    fit_baselines,
    go_on,
)


def oscillator(n: int = 3000, *, process_noise: float = 0.01, level: float = 0.1) -> np.ndarray:
    """An autoregression of order two that is moved at random at every step."""
    rng, x = np.random.default_rng(0), [0.0, 0.0]
    for _ in range(n):
        x.append(1.6 * x[-1] - 0.9 * x[-2] + level + process_noise * rng.standard_normal())
    return np.array(x[2:])


def record(x: np.ndarray, t: np.ndarray | None = None, u: np.ndarray | None = None) -> Trajectory:
    t = np.arange(float(len(x))) if t is None else t
    if u is None:
        return Trajectory(t, x[:, None], ("x",))
    return Trajectory(t, x[:, None], ("x",), u[:, None], ("u",))


def ahead(baseline, run: Trajectory, first: int, n: int) -> np.ndarray:
    return baseline.ahead(run.states[:first], run.t[: first + n], run.inputs[: first + n])[:, 0]


def test_an_autoregression_has_the_order_of_least_aic_and_goes_on() -> None:
    x = oscillator()
    found = Autoregression.of(record(x))
    periods = 3000 / (2.0 * np.pi / np.arccos(1.6 / (2.0 * np.sqrt(0.9))))
    lags = ar_select_order(x, maxlag=int(2.0 * 3000 / periods), ic="aic").ar_lags
    assert found.order == max(lags)
    assert found.coef[:2, 0, 0] == pytest.approx([1.6, -0.9], abs=0.1)
    t = np.arange(3500.0)
    far = found.ahead(x[:, None], t, np.empty((3500, 0)))
    assert far[-1, 0] == pytest.approx(0.1 / (1.0 - 1.6 + 0.9), abs=0.01)


def test_several_states_regress_on_each_other() -> None:
    t = 0.1 * np.arange(1200)
    run = Trajectory(t, np.column_stack([np.cos(t), -np.sin(t)]), ("x", "v"))
    found = Autoregression.of(run)
    later = found.ahead(run.states[:1000], t[:1100], run.inputs[:1100])
    np.testing.assert_allclose(later, run.states[1000:1100], atol=1e-3)


def test_positive_signals_regress_in_logarithms_where_these_are_likelier() -> None:
    x = oscillator(process_noise=0.3)
    assert Autoregression.of(record(np.exp(x))).least is not None
    assert Autoregression.of(record(x + 20.0)).least is None
    grows = record(np.exp(x))
    exact = np.exp(1.6 * x[1999] - 0.9 * x[1998] + 0.1)
    assert ahead(Autoregression.of(grows), grows, 2000, 1)[0] == pytest.approx(exact, rel=0.05)
    silent = grows.states.copy()
    silent[1998] = 0.0  # after the fitted part, a sample need not be positive
    later = Autoregression.of(grows).ahead(silent[:2000], grows.t[:2010], grows.inputs[:2010])
    assert np.isfinite(later).all()


def test_inputs_are_known_ahead() -> None:
    rng = np.random.default_rng(1)
    u, x = rng.standard_normal(600), np.zeros(600)
    for k in range(1, 600):
        x[k] = 0.5 * x[k - 1] + 2.0 * u[k] - u[k - 1] + 3.0
    run = record(x, u=u)
    found = Autoregression.of(run.window(0, 400))
    np.testing.assert_allclose(ahead(found, run, 450, 50), x[450:500], atol=1e-6)


def test_missing_samples_and_other_steps_are_interpolated() -> None:
    x, rng = oscillator(), np.random.default_rng(2)
    kept = np.delete(np.arange(3000), rng.choice(2900, 30, replace=False))
    daily = record(x[kept], t=kept.astype(float))
    found = Autoregression.of(daily)
    assert found.step_s == 1.0
    assert found.coef[:2, 0, 0] == pytest.approx([1.6, -0.9], abs=0.15)
    t = np.cumsum(rng.uniform(0.5, 1.5, 800))
    uneven = record(np.sin(0.3 * t), t=t)
    for baseline in (Autoregression.of(uneven.window(0, 600)), Neighbours.of(uneven, 40)):
        np.testing.assert_allclose(
            ahead(baseline, uneven, 700, 20), np.sin(0.3 * t[700:720]), atol=0.15
        )


def test_rows_do_not_lead_across_a_gap() -> None:
    """The second segment is turned over: a row across the gap would say so."""
    t = np.arange(600.0)
    x = np.sin(0.4 * t)
    x[300:] *= -1.0
    gap = slice(280, 300)
    for run, atol in ((record(np.delete(x, gap), t=np.delete(t, gap)), 1e-9), (record(x), 0.0)):
        known = Trajectory(run.t[:500], run.states[:500], run.state_names)
        after = Autoregression.of(known).ahead(run.states[:500], run.t[:600], np.empty((600, 0)))
        off = np.abs(after[:50] - run.states[500:550]).max()
        assert off < atol if atol else off > 1e-6


def test_the_simple_baselines_go_on_as_they_say() -> None:
    t, rng = 0.1 * np.arange(1200), np.random.default_rng(0)
    run = record(np.cos(t) + 0.01 * rng.standard_normal(1200), t=t)
    cycle = Harmonics.of(run.window(0, 900))
    # 72 phases are tried.
    np.testing.assert_allclose(ahead(cycle, run, 900, 60), np.cos(t[900:960]), atol=0.06)
    np.testing.assert_array_equal(ahead(Persistence(), run, 900, 60), np.full(60, run.states[899]))
    assert Harmonics.of(record(rng.standard_normal(400))) is None


def test_neighbours_know_what_is_deterministic_and_not_linear() -> None:
    """The logistic map has no linear correlation at all, and is forecast by analogues."""
    x = [0.3]
    for _ in range(1999):
        x.append(3.99 * x[-1] * (1.0 - x[-1]))
    run = record(np.array(x))
    errors = baseline_errors(run, ["x"], n_fitted=1500, longest=4)
    assert errors["neighbours"][0] < 0.05
    assert errors["autoregression"][0] > 0.8
    assert (np.diff(errors["neighbours"]) > 0.0).all()  # errors double at every step
    noise = record(np.random.default_rng(0).standard_normal(2000))
    errors = baseline_errors(noise, ["x"], n_fitted=1500, longest=4)
    assert errors["neighbours"] == pytest.approx(np.ones(4), abs=0.15)


def test_nothing_but_the_past_enters() -> None:
    t, rng = np.arange(600.0), np.random.default_rng(0)
    x = np.sin(0.3 * t) + 0.1 * rng.standard_normal(600)
    later = x.copy()
    later[500:] = rng.standard_normal(100)
    found = fit_baselines(record(x).window(0, 400), 20)
    assert set(found) == {"persistence", "harmonics", "autoregression", "neighbours"}
    starts = np.array([420, 500])
    for baseline in found.values():
        ours, theirs = (go_on(baseline, record(each), starts, 20) for each in (x, later))
        np.testing.assert_array_equal(ours, theirs)
